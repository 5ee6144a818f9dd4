"""What a result's `summary.json` says, as tables and sentences: the same in the terminal and on the page."""

import re
from collections.abc import Callable, Iterator, Mapping, Sequence
from typing import Any

from ptsmc_jax.simulation import catalogues
from ptsmc_jax.simulation.catalogues import CATALOGUES, MARGINS, percent
from tuning.output import pointing_sentences
from tuning.output.cells import Summary, Table, digits, lost, valued

WEAK = 0.05  # rank correlation or share of the variance below which an input is not named


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
    """
    units = catalogues.units(kind)
    units |= {"torque": units["peak_torque"], "delay_margin": "s"}
    units |= {"initial_angle": "rad"} if kind == "spacecraft" else {}
    unit = units.get(re.sub("^(linear|largest|hold)_(?=torque|peak|window|delay)", "", name), "-")
    return name if unit == "-" else f"{name} [{unit}]"


def grid(pairs: Sequence[Mapping[str, Any]], keys: tuple[str, str], kind: str) -> Iterator[str]:
    """What was flown over two keys, across and up; pairs: a map's rows by column, x and y those of the keys.

    kind: of the plant.
    """
    flown = [pair for pair in pairs if pair["status"] == "flown"]
    with_error = [pair for pair in flown if pair["window_error"] == pair["window_error"]]  # not NaN
    if with_error:
        best = min(with_error, key=lambda pair: (pair["failures"], pair["window_error"]))
        where = f"{keys[0]} = {best['x']:.4g} and {keys[1]} = {best['y']:.4g}"
        failed = f", where {best['failures']:.0f} trials failed" if best["failures"] else ""
        error, peak = (valued(best[name], name, kind) for name in ("window_error", "peak_torque"))
        beside = f"where the mean peak of the input is {peak}{failed}"
        yield f"the smallest RMS window error is {error}, at {where}, {beside}"
    yield f"{len(flown)} of {len(pairs)} pairs flown, {sum(pair['failures'] > 0 for pair in flown)} with failed trials"


def run_lines(summary: Summary) -> list[str]:
    """Status of one run, and its error beside the floor."""
    bad_time = summary["bad_time"]
    when = "" if bad_time is None or bad_time != bad_time else f", at {bad_time:.4g} s"
    what = f", {summary['reason']}{when}" if summary["reason"] else ""
    error = summary.get("window_error")
    told = [] if error is None or error != error else [f"window error {error:.3e}{floor(error, summary.get('floor'))}"]
    return [f"status: {summary['status']}{what}", *told]


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
    return f"the gains are judged on {summary['fresh']['trials']} fresh trials ({judged})"


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
        but = f", but break {' and '.join(broken)}" if broken else ""
        if times >= 1.0:
            yield f"the tuned gains are {ratio(times)} times as accurate as {paper}{_between(within, ratio)}{but}"
        else:
            within = None if within is None else [1.0 / v for v in reversed(within)]
            worse = f"the tuned gains are less accurate than {paper}: they leave {ratio(1.0 / times)} times the error"
            yield f"{worse}{_between(within, ratio)}{but}"
    yield from paper_refused(summary)
    cut = fresh.get("saturated")
    if cut and cut["max"]:
        often = f"{percent(cut['mean'])} % of a fresh trial on average and {percent(cut['max'])} % at most"
        yield f"limits of the actuators cut the command of the tuned gains, for {often}"
    trained, fresh = summary["training"]["window_error"], fresh["window_error"]
    before = summary.get("before")
    if fresh and before and before["window_error"] and before["window_error"]["rms"] < fresh["rms"]:
        yield "the scenario's own gains are more accurate than the tuned ones: see tune.bounds and the requirements"
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
    return digits(times, ".0f" if times is not None and 1000.0 <= times < 1e6 else ".3g")


def over_floor(error: float | None, least: float | None) -> float | None:
    """How many times the error is what no controller can beat; None where there is no such floor."""
    return error / least if error and least else None


def paper_refused(summary: Summary) -> Iterator[str]:
    """Why nothing is set beside the paper's gains, if so."""
    if summary.get("paper_refused"):
        yield f"the paper's gains cannot fly this scenario, and are left out: {summary['paper_refused']}"


def _between(interval: Sequence[float] | None, text: Callable[[float], str]) -> str:
    return "" if interval is None else f" (95 %: {text(interval[0])} to {text(interval[1])})"


def front(summary: Summary) -> Table:
    """Points that no other one beats, and the paper's and the scenario's own gains."""
    from tuning.search.gains import base

    units = CATALOGUES[summary["plant"]]
    points = [("", point) for point in summary["points"] if not point["dominated"]]
    names = list(points[0][1]["gains"]) if points else []
    points += [(name, summary[name]) for name in ("paper", "before") if name in summary]
    rows: list[tuple[str, ...]] = []
    for name, point in points:
        gains = [point["gains"].get(gain, point["gains"].get(base(gain))) for gain in names]
        cells = [digits(value, ".4g") for value in gains]
        if summary.get("floor"):
            cells.insert(0, ratio(over_floor(point["rms"], summary["floor"])))
        numbers = (digits(point["peak"], ".4g"), digits(point["mean_peak"], ".4g"), digits(point["rms"], ".3e"))
        rows.append((name, *numbers, _spread(point), *cells, _marks(point)))
    torque, beside = units["peak_torque"].unit, ("times the floor",) if summary.get("floor") else ()
    head = f"largest peak [{torque}]", f"mean peak [{torque}]", f"RMS error [{units['window_error'].unit}]", "+-"
    return Table(("", *head, *beside, *names, ""), rows)


def _spread(point: Summary) -> str:
    """Half the interval of a point's RMS error, as a share of that error."""
    if not point["interval"]:
        return "-"
    low, high = point["interval"]
    return f"{50 * (high - low) / point['rms']:.1f} %"


def _marks(point: Summary) -> str:
    """What is worth knowing of a point besides its numbers."""
    marks = [word for word in ("knee", "meets") if point.get(word)]
    return ", ".join(marks + ([f"{point['failures']} failed or missed"] if point["failures"] else []))


def front_lines(summary: Summary) -> Iterator[str]:
    """What is left out of a front, and whether anything on it will do."""
    yield from paper_refused(summary)
    if summary.get("floor"):
        yield f"the floor is {summary['floor']:.2e}: no controller can be more accurate, whatever its torque"
    kept = [point for point in summary["points"] if not point["dominated"]]
    found = len(summary["points"])
    without = summary.get("steps", found) - found
    if without:
        yield f"limits without a point of their own: {without}, which no gains keep, or the same gains as at another"
    lost = found - len(kept)
    if lost:
        yield f"points left out: {lost}, each beaten by another in error and torque by more than its interval"
    if summary["requirements"] and not any(point["meets"] for point in kept):
        yield "no gains on the front meet every requirement"


def front_heading(summary: Summary) -> str:
    """How many points, and on what they were judged."""
    kept = sum(not point["dominated"] for point in summary["points"])
    return f"{kept} points, each judged on {summary['trials']} fresh trials"


def slew_times(summary: Summary) -> Table:
    """Each prescribed time: the error, what it costs, its gains."""
    units, slews = CATALOGUES[summary["plant"]], summary["slews"]
    costs, names = (list(slews[0][key]) if slews else [] for key in ("costs", "gains"))
    rows: list[tuple[str, ...]] = []
    for slew in slews:
        numbers = (f"{slew['t_f']:g}", digits(slew["rms"], ".3e"), _spread(slew))
        cells = [digits(slew["costs"][name], ".4g") for name in costs] + [f"{slew['gains'][n]:.4g}" for n in names]
        rows.append((*numbers, *cells, _marks(slew)))
    head = (f"{name.replace('_', ' ')} [{units[name].unit}]" for name in costs)
    return Table(("t_f [s]", f"RMS error [{units['window_error'].unit}]", "+-", *head, *names, ""), rows)


def slew_times_lines(summary: Summary) -> Iterator[str]:
    """What the fastest slew costs beside the slowest, and which times have no gains."""
    units, slews = CATALOGUES[summary["plant"]], summary["slews"]
    if len(slews) > 1:
        fast, slow = slews[0], slews[-1]
        for name in fast["costs"]:
            one, other = fast["costs"][name], slow["costs"][name]
            if one and other:
                yield (f"{name.replace('_', ' ')}: {one:.4g} {units[name].unit} at t_f = {fast['t_f']:g} s, "
                       f"{one / other:.3g} times that at {slow['t_f']:g} s")  # fmt: skip
        if fast["rms"] and slow["rms"]:
            error, times = valued(fast["rms"], "window_error", summary["plant"]), ratio(fast["rms"] / slow["rms"])
            yield f"RMS window error: {error} at t_f = {fast['t_f']:g} s, {times} times that at {slow['t_f']:g} s"
    for t_f in summary["without"]:
        yield f"no gains keep the limits on the training trials at t_f = {t_f:g} s"
    if summary["requirements"] and not any(slew["meets"] for slew in slews):
        yield "at none of these times do gains meet every requirement on the fresh trials"


def slew_times_heading(summary: Summary) -> str:
    """How many times, and on what they were judged."""
    many = len(summary["slews"]) != 1
    times = f"{len(summary['slews'])} prescribed time{'s' if many else ''}"
    return f"gains tuned for {times}, {'each ' if many else ''}judged on {summary['trials']} fresh trials"


def campaign(summary: Summary) -> list[Table]:
    """Quantiles of every metric; those of shares of time, of which more is better, in a table of their own."""
    tables = [
        Table(("", "median", "99.73 %", "its 95 % interval", "largest", "unit"), _ends(summary, "0.9973", "max")),
        Table(
            ("", "median", "99.73 % reach", "its 95 % interval", "smallest", "unit"), _ends(summary, "0.0027", "min")
        ),
    ]
    return [table for table in tables if table.rows]


def _ends(summary: Summary, quantile: str, extreme: str) -> list[tuple[str, ...]]:
    """Rows of the metrics that have this quantile at their bad end."""
    rows: list[tuple[str, ...]] = []
    units = catalogues.units(summary["plant"])
    failed = sum(count for status, count in summary["counts"].items() if status not in ("ok", "missed"))
    for name, statistics in summary["quantiles"].items():
        if pointing_sentences.is_index(name) or quantile not in statistics:
            continue
        far = statistics[quantile]
        between = f"{_number(far['low'])}..{_number(far['high'])}"
        values = (_number(v) for v in (statistics["0.5"]["value"], far["value"]))
        never = statistics["without_value"] > failed  # as of a run that ends but never settles
        largest = "none" if never else _number(statistics.get(extreme))
        rows.append((name, *values, between, largest, units.get(name, "")))
    return rows


def _number(value: float | None) -> str:
    return "none" if value in (float("inf"), float("-inf")) else digits(value, ".3g")


def campaign_counts(summary: Summary) -> Iterator[str]:
    """How the trials ended, and why."""
    if summary["flown"] < summary["trials"]:
        yield f"NOT finished: {summary['flown']} of {summary['trials']} trials are flown"
    for name in summary.get("unjudged", ()):
        yield f"NOT finished: {name} is asked for and not judged yet; the same `ptsmc montecarlo` again judges it"
    counts = ", ".join(f"{count} {status}" for status, count in summary["counts"].items() if count)
    of = f"the plan {summary['plan']} and seed" if summary.get("plan") else "seed"
    yield f"{summary['flown']} trial{'s' if summary['flown'] != 1 else ''} of {of} {summary['seed']}: {counts}"
    for reason in summary["reasons"]:
        first = "" if reason["first_bad_time"] is None else f", the first at {reason['first_bad_time']:.4g} s"
        yield f"  {reason['trials']} {reason['status']}: {reason['reason']}{first}"
    if summary.get("plan"):
        yield "shares, quantiles and intervals hold for trials drawn at random: of the plan as far as its rows are"


def campaign_error(summary: Summary) -> Iterator[str]:
    """The RMS of the window errors, beside what no controller can beat."""
    error = summary["quantiles"]["window_error"].get("rms")
    beside = floor(error, summary.get("floor"))
    if beside:
        yield f"RMS window error {error:.3e}{beside}"


def flown_gains(scenario: dict[str, Any], kind: str) -> Table:
    """The law, observer and filter of a scenario's tables, with the numbers that they fly with; kind: of its plant."""
    from ptsmc_jax.scenario import keys
    from ptsmc_jax.scenario.layouts import SCENARIOS

    rows: list[tuple[str, ...]] = []
    for table in ("controller", "observer", "filter", "sensors"):
        given = scenario.get(table, {})
        own = given.get("kind") == "own"  # its class, which reading does not run, has the units
        kinds: Any = SCENARIOS[kind].TABLES.get(table, {})
        struct = kinds.get(given.get("kind"))  # of the same name another kind's key has another unit
        units = {key.name: key.unit for key in keys.of(struct)} if struct else {}
        for key, value in given.items():
            numbers = value if isinstance(value, list) else [value]
            each = [f"{one:.6g}" if isinstance(one, float | int) else str(one) for one in numbers]
            text = f"{each[0]} each" if len(each) > 1 and len(set(each)) == 1 else ", ".join(each)
            unit = "" if own and key not in ("t_f", "delta") else (units.get(key) or "").replace("-", "")
            rows.append((f"{table}.{key}", text, unit))
    return Table(("key", "value", "unit"), rows)


def campaign_drivers(summary: Summary) -> Iterator[str]:
    """What drives the error and the metrics of the requirements, by more than chance shows among so many trials."""
    from ptsmc_jax.numerics import statistics

    for name in dict.fromkeys(("window_error", *(v["metric"] for v in summary["verdicts"]))):
        drivers = summary["drivers"].get(name, {})
        seen = [key for key, driver in drivers.items() if statistics.beyond_chance(driver, summary["flown"])]
        strength = {key: max(abs(v) for v in drivers[key].values() if v is not None) for key in seen}
        strongest = sorted((key for key in strength if strength[key] >= WEAK), key=lambda key: -strength[key])[:3]
        if strongest:
            ranks = {key: drivers[key]["rank_correlation"] for key in strongest}  # None of a number of a wheel, say
            each = {key: key if rank is None else f"{key} {rank:+.2f}" for key, rank in ranks.items()}
            texts = (f"{text} ({100 * drivers[key]['first_order']:.0f} %)" for key, text in each.items())
            yield f"{name} hangs on {', '.join(texts)}: rank correlation (share of its variance)"


def claims(summary: Summary) -> Table:
    """Claims of the paper."""
    rows = [(claim["verdict"], f"{claim['where']}: {claim['claim']}", claim["measured"]) for claim in summary["claims"]]
    return Table(("verdict", "the paper", "measured"), rows)


def slips(summary: Summary) -> Table:
    """Slips of the paper."""
    rows = [(slip["where"], slip["correct"], slip["shown"]) for slip in summary["slips"]]
    return Table(("where", "what it must be", "shown by"), rows)
