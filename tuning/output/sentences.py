"""What a result's `summary.json` says, as tables and sentences: the same in the terminal and on the page."""

import re
from collections.abc import Callable, Iterator, Mapping, Sequence
from typing import Any

from ptsmc_jax.simulation import catalogues
from ptsmc_jax.simulation.catalogues import CATALOGUES, MARGINS, percent
from tuning.output.cells import Summary, Table, digits, lost, many, valued


def verdict(entry: Summary) -> str:
    """A verdict of a summary in one line; over many trials with the share of them that keeps the limit."""
    from ptsmc_jax.simulation.requirements import Verdict

    text = str(Verdict.read(entry))
    if entry.get("share_of_time") is not None or "share_interval" not in entry:
        return text
    low, high = entry["share_interval"]
    text += f"; {percent(entry['share'])} % of trials keep the limit (95 %: {percent(low)} to {percent(high)} %)"
    if entry["quantile"] is not None and entry["confidence"] is not None:
        text += f", at least {percent(entry['share_bound'])} % at {100 * entry['confidence']:g} % one-sided confidence"
        if entry["share"] > entry["quantile"]:
            so_many = "so many failures" if entry["failures"] else "no failure"
            text += f"; with {so_many} {entry['fewest_trials']} trials would do"
    return text


def run(summary: Summary, kind: str) -> Table:
    """Metrics of one run; kind: of its plant."""
    none = "never" if summary["status"] in ("ok", "missed") else "-"
    rows = [
        (name, digits(summary[name], ".5g", none), entry.unit, entry.meaning)
        for name, entry in CATALOGUES[kind].items()
        if name in summary
    ]
    return Table(("metric", "value", "unit", "meaning"), rows)


def with_unit(name: str, kind: str) -> str:
    """A column of rows, or of a map, with its unit; kind: of the plant. A map's gain margins are factors.

    >>> with_unit("largest_peak_torque", "spacecraft"), with_unit("delay_margin", "chain"), with_unit("status", "chain")
    ('largest_peak_torque [N m]', 'delay_margin [s]', 'status')
    >>> with_unit("initial_angle", "spacecraft"), with_unit("initial_angle", "chain")
    ('initial_angle [rad]', 'initial_angle [x1]')
    """
    units = catalogues.units(kind)
    units |= {"torque": units["peak_torque"], "delay_margin": "s"}
    unit = units.get(re.sub("^(linear|largest|hold)_(?=torque|peak|window|delay)", "", name), "-")
    return name if unit == "-" else f"{name} [{unit}]"


def grid(pairs: Sequence[Mapping[str, Any]], keys: tuple[str, str], kind: str) -> Iterator[str]:
    """What was flown over two keys, across and up; pairs: a map's rows by column, x and y those of the keys.

    kind: of the plant.
    """
    flown = [pair for pair in pairs if pair["status"] == "flown"]
    with_error = [pair for pair in flown if pair["window_error"] == pair["window_error"]]  # not NaN
    if with_error:
        best = min(with_error, key=lambda pair: (_lost(pair), pair["window_error"]))
        where = f"{keys[0]} = {best['x']:.4g} and {keys[1]} = {best['y']:.4g}"
        failed = f", where {_lost(best):.0f} trials failed or missed" if _lost(best) else ""
        error, peak = (valued(best[name], name, kind) for name in ("window_error", "peak_torque"))
        beside = f"where the mean peak of the input is {peak}{failed}"
        yield f"the smallest RMS window error is {error}, at {where}, {beside}"
    lost = sum(_lost(pair) > 0 for pair in flown)
    yield f"{len(flown)} of {len(pairs)} pairs flown, {lost} with trials that failed or missed"


def _lost(pair: Mapping[str, Any]) -> float:
    """How many trials of a pair did not end well."""
    return pair["failures"] + pair["missed"]


def run_lines(summary: Summary) -> list[str]:
    """Status of one run, its error beside the floor, and how the samples of a controller's C ended."""
    bad_time = summary["bad_time"]
    when = "" if bad_time is None or bad_time != bad_time else f", at {bad_time:.4g} s"
    what = f", {summary['reason']}{when}" if summary["reason"] else ""
    error = summary.get("window_error")
    told = [] if error is None or error != error else [f"window error {error:.3e}{floor(error, summary.get('floor'))}"]
    samples = [f"{count} {status}" for status, count in summary.get("controller_statuses", {}).items()]
    decided = [f"samples of the controller: {', '.join(samples)}"] if samples else []
    return [f"status: {summary['status']}{what}", *decided, *told]


def run_verdicts(summary: Summary, kind: str) -> list[Summary]:
    """The verdicts of one run, as those over many trials are told."""
    units = {**CATALOGUES[kind], **MARGINS}
    return [
        {"metric": name, "worst": summary.get(name), "at_least": False, **entry, "unit": units[name].unit, "trials": 1,
         "failures": int(not entry["met"])}
        for name, entry in summary["verdicts"].items()
    ]  # fmt: skip


def tuning(summary: Summary) -> Table:
    """Gains and what they do, beside the paper's and those before."""
    from tuning.search.gains import base, units

    paper = summary.get("paper_is", "paper")  # the heading of its column
    groups = {paper: summary.get("paper"), "before": summary.get("before"), "tuned": summary["fresh"]}
    groups = {name: group for name, group in groups.items() if group is not None}
    rows: list[tuple[str, ...]] = []
    kind = summary.get("plant", "spacecraft")  # not yet said in earlier results
    gain_units = units(kind) | summary.get("gain_units", {})
    for gain in dict.fromkeys(name for group in groups.values() for name in group["gains"]):
        values = [group["gains"].get(gain, group["gains"].get(base(gain))) for group in groups.values()]
        if len(set(values)) > 1 and not (gain == "observer_gain" and "observer_gain_1" in summary["fresh"]["gains"]):
            rows.append((gain, *(digits(v, ".6g") for v in values), gain_units[base(gain)]))
    trials = summary["fresh"]["trials"]
    for label, metric, statistic in (
        ("RMS window error", "window_error", "rms"),
        ("largest window error", "window_error", "max"),
        ("mean peak torque", "peak_torque", "mean"),
        ("largest peak torque", "peak_torque", "max"),
        ("mean effort", "effort", "mean"),
    ):
        values = [group[metric][statistic] if group[metric] else None for group in groups.values()]
        rows.append((label, *(digits(v, ".4g") for v in values), CATALOGUES[kind][metric].unit))
        if label == "RMS window error" and summary["fresh"].get("floor"):
            floors = [group.get("floor") for group in groups.values()]
            rows.append(("times the floor", *(ratio(v) for v in map(over_floor, values, floors)), ""))
    rows.append(("failed or missed", *(str(trials - group["counts"]["ok"]) for group in groups.values()), ""))
    return Table(("", *groups, "unit"), rows)


def tuning_heading(summary: Summary) -> str:
    """What the gains were judged on."""
    judged = summary.get("judged_on", "flight clock")
    return f"the gains are judged on {many(summary['fresh']['trials'], 'fresh trial')} ({judged})"


PAPER = {  # columns of the paper's gains in words
    "paper": "the paper's gains",
    "paper, scaled": "the paper's gains, scaled to this body and period",
    "paper's law": "the paper's law with the paper's gains",
}


def accuracy(summary: Summary) -> Iterator[str]:
    """How accurate the tuned gains are; no praise where trials do not arrive or limits are broken."""
    fresh, times = summary["fresh"], summary["accuracy_gain_over_paper"]
    bad, ended = lost(fresh["counts"])
    if bad:
        yield f"with the tuned gains {bad} of {fresh['trials']} fresh trials do not arrive: {ended}"
    broken = [v["metric"] for v in summary["verdicts"] if not v["met"]]
    paper = PAPER[summary.get("paper_is", "paper")]
    if times is not None and fresh["counts"].get("ok", 0):
        within = summary.get("accuracy_gain_interval")
        they_break = f"break {' and '.join(broken)}" if broken else ""
        if times >= 1.0:
            but = f", but {they_break}" if broken else ""
            yield f"the tuned gains are {ratio(times)} times as accurate as {paper}{_between(within, ratio)}{but}"
        else:
            within = None if within is None else [1.0 / v for v in reversed(within)]
            worse = f"the tuned gains are less accurate than {paper}: they leave {ratio(1.0 / times)} times the error"
            theirs = summary.get("broken_by", {}).get("paper")
            by_paper = f"; broken by {paper}: {' and '.join(theirs)}" if theirs else ""
            and_too = f", and {they_break}" if broken else ""
            yield f"{worse}{_between(within, ratio)}{and_too}{by_paper}"
    yield from paper_refused(summary)
    cut = fresh.get("saturated")
    if cut and cut["max"]:
        often = f"{percent(cut['mean'])} % of a fresh trial on average and {percent(cut['max'])} % at most"
        yield f"limits of the actuators cut the command of the tuned gains, for {often}"
    trained, fresh = summary["training"]["window_error"], fresh["window_error"]
    before = summary.get("before")
    if fresh and before and before["window_error"] and before["window_error"]["rms"] < fresh["rms"]:
        theirs = summary.get("broken_by", {}).get("before")
        why = f", but break {' and '.join(theirs)}" if theirs else ": see tune.bounds and the requirements"
        yield f"the scenario's own gains are more accurate than the tuned ones{why}"
    if trained and fresh:
        errors = ", ".join(
            f"{error['rms']:.3e} on the {where} trials" + _between(error.get("rms_interval"), "{:.3e}".format)
            for where, error in (("training", trained), ("fresh", fresh))
        )
        yield f"the tuned gains' RMS window error is {errors}{floor(fresh['rms'], summary['fresh'].get('floor'))}"


def cautions(summary: Summary) -> Iterator[str]:
    """What is odd about the scenario, said loudly."""
    yield from (f"CAUTION: {said}" for said in summary.get("cautions", ()))


def floor(error: float | None, least: float | None) -> str:
    """How many times the error is what no controller can beat; nothing where there is no such floor."""
    times = over_floor(error, least)
    return "" if times is None else f", {ratio(times)} times the floor {least:.2e} that no controller can beat"


def ratio(times: float | None) -> str:
    """How many times, in three digits, without an exponent below a million; - where there is no number."""
    return digits(times, ".0f" if times is not None and 999.5 <= times < 1e6 else ".3g")


def over_floor(error: float | None, least: float | None) -> float | None:
    """How many times the error is what no controller can beat; None where there is no such floor."""
    return error / least if error and least else None


def paper_refused(summary: Summary) -> Iterator[str]:
    """Why nothing is set beside the paper's gains, if so."""
    if summary.get("paper_refused"):
        yield f"the paper's gains cannot fly this scenario, and are left out: {summary['paper_refused']}"


def _between(interval: Sequence[float] | None, text: Callable[[float], str]) -> str:
    return "" if interval is None else f" (95 %: {text(interval[0])} to {text(interval[1])})"


def claims(summary: Summary) -> Table:
    """Claims of the paper."""
    rows = [(claim["verdict"], f"{claim['where']}: {claim['claim']}", claim["measured"]) for claim in summary["claims"]]
    return Table(("verdict", "the paper", "measured"), rows)


def slips(summary: Summary) -> Table:
    """Slips of the paper."""
    rows = [(slip["where"], slip["correct"], slip["shown"]) for slip in summary["slips"]]
    return Table(("where", "what it must be", "shown by"), rows)
