"""The `ptsmc` command. JAX is loaded by the commands that compute, after what they are given was looked at."""

import sys
from collections.abc import Callable
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any

from cyclopts import App, CycloptsError, Parameter

import ptsmc_jax

if TYPE_CHECKING:
    from ptsmc_jax.tables import Scenario
    from tuning.report import Tuning

app = App(
    name="ptsmc",
    help="Prescribed-time sliding mode control: reproduce the paper, simulate, tune the gains.",
    version=ptsmc_jax.__version__,
    help_format="plaintext",
    suppress_keyboard_interrupt=False,
)

ScenarioFile = Annotated[
    Path | None, Parameter(name="SCENARIO", help="Scenario file (TOML); none: the paper's Case I.")
]
Out = Annotated[Path | None, Parameter(help="Folder for the results; by default out/COMMAND-NAME.")]
Seed = Annotated[str, Parameter(help="Seed of every draw, a whole number from 0 to 4294967295.")]
Force = Annotated[bool, Parameter(negative="", help="Write into a folder that holds something already.")]
Quiet = Annotated[bool, Parameter(negative="", help="Print nothing but errors.")]
Figures = Annotated[bool, Parameter(negative="--no-figures", help="Draw figures.")]


class UsageError(ValueError):
    """An option that cannot be followed. Its text is one sentence."""


@app.command
def simulate(
    scenario: ScenarioFile = None,
    /,
    *,
    out: Out = None,
    seed: Seed = "0",
    trial: Annotated[
        str | None, Parameter(help="Draw this trial's dispersions; without it the run is nominal.")
    ] = None,
    force: Force = False,
    quiet: Quiet = False,
    figures: Figures = True,
) -> int:
    """Fly one run and write its history, metrics and figures.

    Exit status: 0 done and every requirement met, 1 done but not met or the run failed, 2 bad input.
    """
    key = _whole("--seed", seed)
    number = None if trial is None else _whole("--trial", trial)
    loaded, folder = _prepare(scenario, "simulate", out)
    from ptsmc_jax import store

    store.check(folder, force)
    from ptsmc_jax import runs
    from ptsmc_jax.scenario import study
    from tuning import single

    run = runs.fly(study(loaded, drawn=number is not None), key, number)
    store.write(folder, lambda making: single.write(making, loaded, run, key, number, figures))
    if not quiet:
        _show_run(run, folder)
    return 0 if run.met else 1


@app.command
def reproduce(*, out: Out = None, force: Force = False, quiet: Quiet = False, figures: Figures = True) -> int:
    """Fly every figure of the paper, and set its claims and its slips beside what is measured.

    Exit status: 0 done, 1 a run failed, 2 bad input.
    """
    from ptsmc_jax import store

    folder = out if out is not None else Path("out") / "reproduce"
    store.check(folder, force)
    from ptsmc_jax.configure import configure

    configure()
    from tuning import reproduction

    made = reproduction.reproduce()
    store.write(folder, lambda making: reproduction.write(making, made, figures))
    if not quiet:
        _show_reproduction(made, folder)
    return 0 if made.ok else 1


@app.command(name="map")
def map_(
    scenario: ScenarioFile = None,
    /,
    *,
    x: Annotated[str, Parameter(help="KEY=LOW:HIGH:COUNT of the scenario.")] = "loop.period=0.02:0.5:9",
    y: Annotated[str, Parameter(help="KEY=LOW:HIGH:COUNT of the scenario.")] = "controller.delta=0.05:5:9",
    trials: Annotated[str, Parameter(help="Trials of each pair, a whole number from 1 to 1000000.")] = "32",
    out: Out = None,
    seed: Seed = "0",
    force: Force = False,
    quiet: Quiet = False,
    figures: Figures = True,
) -> int:
    """Fly the scenario over two of its keys: window error and peak torque, with the borders of linear theory.

    Exit status: 0 done, 2 bad input. A pair that is not allowed or fails is marked, not dropped.
    """
    key, count = _whole("--seed", seed), _whole("--trials", trials, 1, 1_000_000)
    loaded, folder = _prepare(scenario, "map", out)
    from ptsmc_jax import store

    store.check(folder, force)
    from tuning import mapping

    try:
        across, up = mapping.axis(x, "--x"), mapping.axis(y, "--y")
    except mapping.AxisError as error:
        raise UsageError(str(error)) from None
    if across.key == up.key:
        raise UsageError(f"--y is {y}, but must be another key than --x")
    with _Progress(quiet, "RMS") as told:
        cells = mapping.fly(loaded, across, up, key, count, lambda done, total: told(done, total, float("nan"), True))
    store.write(folder, lambda making: mapping.write(making, loaded, across, up, cells, key, figures))
    if not quiet:
        _show_map(cells, folder)
    return 0


@app.command
def tune(
    scenario: ScenarioFile = None,
    /,
    *,
    out: Out = None,
    seed: Seed = "0",
    force: Force = False,
    quiet: Quiet = False,
    figures: Figures = True,
) -> int:
    """Find the gains with the smallest error after t_f that keep every limit, and prove them on fresh trials.

    Exit status: 0 done and every requirement met on the fresh trials, 1 done but not met, 2 bad input.
    """
    key = _whole("--seed", seed)
    loaded, folder = _prepare(scenario, "tune", out)
    from ptsmc_jax import schema, store, systems
    from ptsmc_jax.scenario import replace, study

    if loaded.tune is None:
        loaded = replace(loaded, tune={})
    own = getattr(loaded.plant, "system", None)
    done = None if force else store.previous(folder, "tune", schema.dump(loaded), key, **systems.source(own))
    if done is not None:
        if not quiet:
            _show_tuning(done, folder, "already done")
        return 0 if done["status"] == "met" else 1
    store.check(folder, force)
    study(loaded)  # what it refuses, it refuses before the search
    from tuning import report

    with _Progress(quiet, report.OBJECTIVES[loaded.tune.objective]) as told:  # pyright: ignore[reportOptionalMemberAccess]
        result: Tuning = report.tune(loaded, key, told)
    store.write(folder, lambda making: report.write(making, loaded, result, key, figures))
    if not quiet:
        _show_tuning(report.summary(result, key), folder, "done")
    return 0 if result.met else 1


def main() -> None:
    """Entry point: bad input ends in one sentence and exit status 2, without a traceback."""
    status: object = None
    try:
        status = app(sys.argv[1:], exit_on_error=False, print_error=False, result_action="return_value")
    except CycloptsError as error:
        _fail(" ".join(str(error).split()))
    except ValueError as error:
        if not _expected(error):
            raise
        _fail(str(error))
    except KeyboardInterrupt:
        print("ptsmc: interrupted; nothing was written", file=sys.stderr)
        sys.exit(130)
    except OSError as error:
        _fail(f"{error.strerror or error}: {error.filename}")
    sys.exit(status if isinstance(status, int) else 0)


def _expected(error: ValueError) -> bool:
    from ptsmc_jax.schema import ScenarioError
    from ptsmc_jax.store import RefusedError

    return isinstance(error, ScenarioError | RefusedError | UsageError)


def _fail(sentence: str) -> None:
    print(f"ptsmc: {sentence}", file=sys.stderr)
    sys.exit(2)


def _whole(option: str, value: str, least: int = 0, most: int = 2**32 - 1) -> int:
    if not (value.isascii() and value.isdigit() and len(value) <= 10 and least <= int(value) <= most):
        raise UsageError(f"{option} is {value}, but must be a whole number from {least} to {most}")
    return int(value)


def _prepare(scenario: Path | None, command: str, out: Path | None) -> "tuple[Scenario, Path]":
    """The checked scenario and the folder for the results; the backend is configured on the way."""
    from ptsmc_jax import schema

    raw = schema.load(scenario) if scenario is not None else {}
    from ptsmc_jax.configure import configure

    configure()
    from ptsmc_jax.scenario import from_tables

    name = scenario.stem if scenario is not None else "default"
    return from_tables(raw), out if out is not None else Path("out") / f"{command}-{name}"


class _Progress:
    """A progress bar on the error stream with the best error so far; silent where told to be."""

    def __init__(self, quiet: bool, objective: str):
        from rich.console import Console
        from rich.progress import BarColumn, MofNCompleteColumn, Progress, TextColumn, TimeElapsedColumn

        self._objective = objective
        self._bar = Progress(
            TextColumn("{task.description}"),
            BarColumn(30),
            MofNCompleteColumn(),
            TextColumn("steps"),
            TimeElapsedColumn(),
            console=Console(stderr=True),
            disable=quiet,
        )
        self._task = self._bar.add_task("compiling, choosing starts", total=None)

    def __enter__(self) -> Callable[[int, int, float, bool], None]:
        self._bar.start()
        return self._tell

    def __exit__(self, *_: object) -> None:
        self._bar.stop()

    def _tell(self, done: int, total: int, rms: float, admissible: bool) -> None:
        met = "limits met" if admissible else "limits not yet met"
        best = f"{self._objective} error {rms:.3e}, {met}" if rms == rms else "flying"
        self._bar.update(self._task, completed=done, total=total, description=best)


def _show_reproduction(made: Any, folder: Path) -> None:
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


def _show_map(cells: list[Any], folder: Path) -> None:
    flown = [cell for cell in cells if cell.status == "flown"]
    print(f"{len(flown)} of {len(cells)} pairs flown, {sum(cell.failures > 0 for cell in flown)} with failed trials")
    known = [cell for cell in flown if cell.window_error == cell.window_error]
    if known:
        best = min(known, key=lambda cell: cell.window_error)
        where = f"{best.x:.4g} (across) and {best.y:.4g} (up)"
        print(f"smallest RMS window error {best.window_error:.3g} at {where}, mean peak {best.peak_torque:.3g}")
    print(f"results in {folder}")


def _show_run(run: Any, folder: Path) -> None:
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


def _show_tuning(summary: dict[str, Any], folder: Path, how: str) -> None:
    from rich.console import Console
    from rich.table import Table

    from ptsmc_jax.metrics import CATALOGUES
    from ptsmc_jax.requirements import verdict_text
    from tuning import design
    from tuning.bounds import UNITS

    console = Console(highlight=False)
    groups = {"paper": summary["paper"], "before": summary.get("before"), "tuned": summary["fresh"]}
    groups = {name: group for name, group in groups.items() if group is not None}
    table = Table("", *groups, "unit", box=None, pad_edge=False)
    kind = summary.get("plant", "spacecraft")  # not yet said in earlier results
    for gain, unit in UNITS[kind].items():
        cells = [group["gains"].get(gain) for group in groups.values()]
        if len(set(cells)) > 1:
            table.add_row(gain, *(f"{cell:.6g}" for cell in cells), unit)
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
    console.print(
        f"tuning {how}; judged on {trials} fresh trials, {summary.get('judged_on', 'flight clock, exact sign')}:",
        soft_wrap=True,
    )
    console.print(table)
    if summary["accuracy_gain_over_paper"] is not None:
        console.print(f"accuracy: {summary['accuracy_gain_over_paper']:.1f} times the paper's gains'")
    for gain, side in summary["at_bound"].items():
        console.print(f"{gain} ended on its {side} bound", soft_wrap=True)
    for metric, ratio in summary["search"].get("largest_over_limit", {}).items():
        if ratio > 1.0:
            said = f"no gains found within the bounds keep {metric}: at best {ratio:.3g} times its limit in training"
            console.print(said, soft_wrap=True)
    for verdict in summary["verdicts"]:
        fields = ("metric", "limit", "unit", "worst", "failures", "trials", "quantile", "confidence")
        console.print(verdict_text(*(verdict.get(field) for field in fields)), soft_wrap=True)
    off = summary["search"].get("slopes_off_central_differences")
    if off is not None:
        shown = " and ".join(f"{value:.0e} at the {place}" for place, value in off.items() if value is not None)
        console.print(f"slopes by automatic differentiation agree with differences to {shown}", soft_wrap=True)
    shortest = summary.get("shortest_t_f")
    if shortest is not None:
        console.print(design.text(shortest["limit"], shortest["theory"], shortest["simulated"]), soft_wrap=True)
    console.print(f"results in {folder}", soft_wrap=True)
