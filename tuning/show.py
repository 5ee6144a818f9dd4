"""What the commands print: progress while they work, results when they are done."""

from collections.abc import Callable, Iterator, Sequence
from pathlib import Path
from typing import Any

AGREE = 0.01  # slopes off from differences by more than this share say little


class Progress:
    """A progress bar on the error stream with the best so far and the time left; silent where told to be."""

    def __init__(self, quiet: bool, goal: str = ""):
        from rich.console import Console
        from rich.progress import (
            BarColumn,
            MofNCompleteColumn,
            Progress,
            TextColumn,
            TimeElapsedColumn,
            TimeRemainingColumn,
        )

        self._goal = goal
        self._bar = Progress(
            TextColumn("{task.description}"),
            BarColumn(20),
            MofNCompleteColumn(),
            TimeElapsedColumn(),
            TextColumn("left"),
            TimeRemainingColumn(elapsed_when_finished=True),
            console=Console(stderr=True),
            disable=quiet,
        )
        self._what, self._task = "", self._bar.add_task("compiling", total=None)

    def __enter__(self) -> "Progress":
        self._bar.start()
        return self

    def __exit__(self, *_: object) -> None:
        self._bar.stop()

    def __call__(self, what: str, done: int, total: int, value: float = float("nan"), over: float = 0.0) -> None:
        """What is being done, steps done and in all; the best goal so far, how far it is beyond a limit."""
        if what != self._what:
            self._what = what
            self._bar.reset(self._task, total=total or None)
        limits = "limits met" if over == 0.0 else f"{100 * over:.3g} % beyond a limit"
        best = f": {self._goal} {value:.4g}, {limits}" if value == value else ""
        self._bar.update(self._task, completed=done, total=total or None, description=what + best)


def reproduction(made: Any, folder: Path) -> None:
    """Claims and slips of the paper."""
    from rich.box import SIMPLE
    from rich.console import Console
    from rich.table import Table

    console = Console(highlight=False)
    style: Any = {"title_justify": "left", "box": SIMPLE, "pad_edge": False}
    table = Table("verdict", "the paper", "measured", title="Claims", **style)
    for claim in made.claims:
        table.add_row(claim.verdict, f"{claim.where}: {claim.claim}", claim.measured)
    console.print(table)
    table = Table(
        "where", "what it must be", "shown by", title="Slips", title_justify="left", box=SIMPLE, pad_edge=False
    )
    for slip in made.slips:
        table.add_row(slip.where, slip.correct, slip.shown)
    console.print(table)
    console.print("why, and the slips as printed: claims.md", soft_wrap=True)
    console.print(f"results in {folder}", soft_wrap=True)


def grid(cells: list[Any], folder: Path) -> None:
    """What was flown over two keys."""
    flown = [cell for cell in cells if cell.status == "flown"]
    print(f"{len(flown)} of {len(cells)} pairs flown, {sum(cell.failures > 0 for cell in flown)} with failed trials")
    known = [cell for cell in flown if cell.window_error == cell.window_error]
    if known:
        best = min(known, key=lambda cell: cell.window_error)
        where = f"{best.x:.4g} (across) and {best.y:.4g} (up)"
        print(f"smallest RMS window error {best.window_error:.3g} at {where}, mean peak {best.peak_torque:.3g}")
    print(f"results in {folder}")


def run(run: Any, folder: Path) -> None:
    """Metrics and verdicts of one run."""
    from rich.console import Console
    from rich.table import Table

    console = Console(highlight=False)
    table = Table("metric", "value", "unit", "meaning", box=None, pad_edge=False)
    for name, (unit, meaning) in run.catalogue.items():
        value, none = run.metrics[name], "never" if run.status in ("ok", "missed") else "-"
        table.add_row(name, none if value != value else f"{value:.5g}", unit, meaning)
    what = f", {run.reason}, at {run.bad_time:.4g} s" if run.reason else ""
    console.print(f"status: {run.status}{what}", soft_wrap=True)
    console.print(table)
    for verdict in run.verdicts:
        console.print(str(verdict), soft_wrap=True)
    console.print(f"results in {folder}", soft_wrap=True)


def tuning(summary: dict[str, Any], folder: Path, how: str) -> None:
    """What a tuning run found, as its `summary.json` says."""
    from rich.console import Console
    from rich.table import Table

    from ptsmc_jax.metrics import CATALOGUES
    from ptsmc_jax.requirements import verdict_text
    from tuning import design
    from tuning.gains import UNITS, base

    console = Console(highlight=False)
    groups = {"paper": summary["paper"], "before": summary.get("before"), "tuned": summary["fresh"]}
    groups = {name: group for name, group in groups.items() if group is not None}
    table = Table("", *groups, "unit", box=None, pad_edge=False)
    kind = summary.get("plant", "spacecraft")  # not yet said in earlier results
    for gain in dict.fromkeys(name for group in groups.values() for name in group["gains"]):
        cells = [group["gains"].get(gain, group["gains"].get(base(gain))) for group in groups.values()]
        if len(set(cells)) > 1 and not (gain == "observer_gain" and "observer_gain_1" in summary["gains"]):
            table.add_row(gain, *("-" if v is None else f"{v:.6g}" for v in cells), UNITS[kind][base(gain)])
    trials = summary["fresh"]["trials"]
    rows = (
        ("RMS window error", "window_error", "rms"),
        ("largest window error", "window_error", "max"),
        ("mean peak torque", "peak_torque", "mean"),
        ("largest peak torque", "peak_torque", "max"),
        ("mean effort", "effort", "mean"),
    )
    for label, metric, statistic in rows:
        cells = (group[metric][statistic] if group[metric] else None for group in groups.values())
        table.add_row(label, *("-" if cell is None else f"{cell:.4g}" for cell in cells), CATALOGUES[kind][metric][0])
    table.add_row("failed or missed", *(str(trials - group["counts"]["ok"]) for group in groups.values()), "")

    def say(text: str) -> None:
        console.print(text, soft_wrap=True)

    say(f"tuning {how}; judged on {trials} fresh trials, {summary.get('judged_on', 'flight clock, exact sign')}:")
    console.print(table)
    for line in (*_accuracy(summary), *_search(summary), *_trust(summary)):
        say(line)
    for verdict in summary["verdicts"]:
        fields = ("metric", "limit", "unit", "worst", "failures", "trials", "quantile", "confidence")
        say(verdict_text(*(verdict.get(field) for field in fields)))
    shortest = summary.get("shortest_t_f")
    if shortest is not None:
        say(design.text(shortest["limit"], shortest["theory"], shortest["simulated"]))
    if summary["status"] == "interrupted":
        say("interrupted: these are the best gains so far; the same command goes on from here")
    say(f"results in {folder}")


def _accuracy(summary: dict[str, Any]) -> Iterator[str]:
    times = summary["accuracy_gain_over_paper"]
    if times is not None:
        yield f"accuracy: {times:.1f} times the paper's gains'" + _between(summary.get("accuracy_gain_interval"), ".1f")
    trained, fresh = summary["training"]["window_error"], summary["fresh"]["window_error"]
    if trained and fresh:
        both = [f"{where} {one['rms']:.3e}" + _between(one.get("rms_interval"), ".3e")
                for where, one in (("training", trained), ("fresh", fresh))]  # fmt: skip
        yield f"RMS window error: {', '.join(both)}"


def _between(interval: Sequence[float] | None, digits: str) -> str:
    return "" if interval is None else f" (95 %: {interval[0]:{digits}} to {interval[1]:{digits}})"


def _search(summary: dict[str, Any]) -> Iterator[str]:
    found = summary["search"]
    if found["dropped_starts"]:
        yield f"starts dropped, since they met a number that is not finite: {found['dropped_starts']}"
    for metric, ratio in found.get("largest_over_limit", {}).items():
        if ratio > 1.0:
            yield f"no gains found within the bounds keep {metric}: at best {ratio:.3g} times its limit in training"
    hardest = found.get("hardest")
    if hardest is not None and hardest["unbounded"]:
        moved = " and ".join(name.replace("_", " ") for name in hardest["moved"])
        yield (
            f"worst case: {hardest['metric']} has none over {moved}, which reach a singularity of the law; "
            f"ask for a share of the trials instead, {hardest['metric']} = {{ limit = .., quantile = 0.99 }}"
        )
    elif hardest is not None:
        said = f"worst case inside the dispersions: {hardest['metric']} {hardest['ratio']:.3f} times its limit"
        yield said + ("; tune.worst_case = true tunes for it" if hardest["beyond"] else "")
    if "rollouts" in found:
        yield (
            f"search: {found['rollouts']} rollouts without and {found['gradients']} with gradients, "
            f"{found['seconds']:.0f} s"
        )
    smooth = found.get("goal_under_the_smooth_sign")
    if smooth is not None:
        off = 100 * (smooth / found["goal"] - 1)
        yield f"descended under the smooth sign, settled under the exact one: their goals differ by {off:+.2g} % here"
    checked = summary.get("differential_evolution")
    if checked is not None:
        yield (
            f"differential evolution: {checked['value']:.4e}, the search is {100 * checked['distance']:+.2f} % from it "
            f"({checked['rollouts']} rollouts)"
        )


def _trust(summary: dict[str, Any]) -> Iterator[str]:
    believed = summary.get("trust")
    influence = {} if believed is None else believed["influence"]
    for gain, side in summary["at_bound"].items():
        yield f"{gain} ended on its {side} bound" + (f": {influence[gain]}" if gain in influence else "")
    for gain, how in influence.items():
        if how == "none":
            yield f"{gain} has no influence: the goal changes by less than 1 % between its bounds"
    if believed is not None:
        off = believed["slopes_off_central_differences"]
        shown = " and ".join(f"{value:.0e} at the {place}" for place, value in off.items() if value is not None)
        if max(value for value in off.values() if value is not None) <= AGREE:
            yield f"slopes by automatic differentiation agree with differences to {shown}"
        else:
            yield (
                f"slopes by automatic differentiation are off from differences by {shown}: the loop chatters or "
                "breaks off there, and the descent had little to go by; trust the global check (--global-check) instead"
            )


def comparison(summary: dict[str, Any], folder: Path, how: str) -> None:
    """Laws side by side, as `summary.json` says."""
    from rich.console import Console
    from rich.table import Table

    console, laws = Console(highlight=False), summary["laws"]
    table = Table("", *(law.replace("_", " ") for law in laws), "unit", box=None, pad_edge=False)

    def row(label: str, unit: str, value: Callable[[dict[str, Any]], float | None], digits: str = ".3g") -> None:
        cells = (value(found) for found in laws.values())
        table.add_row(label, *("-" if cell is None else f"{cell:{digits}}" for cell in cells), unit)

    row("RMS window error", "-", lambda found: found["window_error"], ".2e")
    row("mean peak torque", "N m", lambda found: found["peak_torque"])
    row("largest", "N m", lambda found: found["largest_peak_torque"])
    row("mean effort", "N m s", lambda found: found["effort"])
    row("mean chattering", "N m/s", lambda found: found["chattering"])
    row("settles, median", "s", lambda found: (found["settling_time"] or {}).get("0.5"), ".1f")
    row("  nearest fifth", "s", lambda found: (found["settling_near_far"] or [None])[0], ".1f")
    row("  farthest fifth", "s", lambda found: (found["settling_near_far"] or [None])[-1], ".1f")
    row("  never", "", lambda found: found["unsettled"], "d")
    table.add_row("all limits met", *("yes" if found["met"] else "no" for found in laws.values()), "")
    told = f"each law tuned alike, judged on {summary['trials']} fresh trials"
    console.print(f"comparison {how}: {told}, flight clock, exact sign", soft_wrap=True)
    console.print(table)
    for law, found in summary["laws"].items():
        gains = ", ".join(f"{name} {value:.4g}" for name, value in found["gains"].items())
        bound = "".join(f"; {name} on its {side} bound" for name, side in found["at_bound"].items())
        console.print(f"{law}: {gains}{bound}", soft_wrap=True)
        missed = [f"{n} {status}" for status, n in found["counts"].items() if n and status != "ok"]
        if missed:
            console.print(f"  of {summary['trials']} trials {', '.join(missed)}", soft_wrap=True)
    console.print(f"settles: from when the angle stays below {summary['settling_angle']:g} rad", soft_wrap=True)
    console.print(f"results in {folder}", soft_wrap=True)


def front(summary: dict[str, Any], folder: Path, how: str) -> None:
    """A front of accuracy against torque, as its `summary.json` says."""
    from rich.console import Console
    from rich.table import Table

    from ptsmc_jax.metrics import CATALOGUES

    console, units = Console(highlight=False), CATALOGUES[summary["plant"]]
    kept = [point for point in summary["points"] if not point["dominated"]]
    names = list(kept[0]["gains"]) if kept else []
    table = Table("", f"peak {units['peak_torque'][0]}", "mean", f"error {units['window_error'][0]}",
                  "+-", *names, "", box=None, pad_edge=False)  # fmt: skip
    rows = [("", point) for point in kept] + [(name, summary[name]) for name in ("paper", "before") if name in summary]
    for name, point in rows:
        low, high = point["interval"] or (point["rms"], point["rms"])
        marks = [word for word in ("knee", "meets") if point[word]]
        if point["failures"]:
            marks.append(f"{point['failures']} failed or missed")
        cells = (f"{point['gains'].get(gain, float('nan')):.4g}" for gain in names)
        table.add_row(name, f"{point['peak']:.4g}", f"{point['mean_peak']:.4g}", f"{point['rms']:.3e}",
                      f"{50 * (high - low) / point['rms']:.1f} %", *cells, ", ".join(marks))  # fmt: skip
    console.print(f"front {how}: {len(kept)} points, each judged on {summary['trials']} fresh trials", soft_wrap=True)
    console.print(table)
    lost = len(summary["points"]) - len(kept)
    if lost:
        console.print(f"{lost} more left out: others are better in both, beyond the interval", soft_wrap=True)
    if summary["requirements"] and not any(point["meets"] for point in kept):
        console.print("no gains on the front meet every requirement", soft_wrap=True)
    console.print(f"results in {folder}", soft_wrap=True)
