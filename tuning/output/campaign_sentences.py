"""What the summary of a campaign says: how trials ended, quantiles, what drives them, and the gains that flew."""

from collections.abc import Iterator
from typing import Any

from ptsmc_jax.simulation import catalogues
from tuning.output import pointing_sentences, sentences
from tuning.output.cells import Summary, Table, digits, many

WEAK = 0.05  # rank correlation or share of the variance below which an input is not named


def quantiles(summary: Summary) -> list[Table]:
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


def counts(summary: Summary) -> Iterator[str]:
    """How the trials ended, and why."""
    if summary["flown"] < summary["trials"]:
        yield f"NOT finished: {summary['flown']} of {summary['trials']} trials are flown"
    for name in summary.get("unjudged", ()):
        yield f"NOT finished: {name} is asked for and not judged yet; the same `ptsmc montecarlo` again judges it"
    ends = ", ".join(f"{count} {status}" for status, count in summary["counts"].items() if count)
    of = f"the plan {summary['plan']} and seed" if summary.get("plan") else "seed"
    yield f"{many(summary['flown'], 'trial')} of {of} {summary['seed']}: {ends}"
    for reason in summary["reasons"]:
        first = "" if reason["first_bad_time"] is None else f", the first at {reason['first_bad_time']:.4g} s"
        yield f"  {reason['trials']} {reason['status']}: {reason['reason']}{first}"
    ended = {status: told for status, told in summary.get("controller_samples", {}).items() if told["samples"]}
    if ended:
        each = (f"{told['samples']} {status} in {many(told['trials'], 'trial')}" for status, told in ended.items())
        yield f"samples of the controller: {', '.join(each)}"
    if summary.get("plan"):
        yield "shares, quantiles and intervals hold for trials drawn at random: of the plan as far as its rows are"


def error(summary: Summary) -> Iterator[str]:
    """The RMS of the window errors, beside what no controller can beat."""
    rms = summary["quantiles"]["window_error"].get("rms")
    beside = sentences.floor(rms, summary.get("floor"))
    if beside:
        yield f"RMS window error {rms:.3e}{beside}"


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


def drivers(summary: Summary) -> Iterator[str]:
    """What drives the error and the metrics of the requirements, by more than chance shows in trials that have them."""
    from ptsmc_jax.numerics import statistics

    for name in dict.fromkeys(("window_error", *(v["metric"] for v in summary["verdicts"]))):
        known = summary["drivers"].get(name, {})
        trials = summary.get("driver_trials", {}).get(name, summary["flown"])  # not yet said in earlier results
        seen = [key for key, driver in known.items() if statistics.beyond_chance(driver, trials)]
        strength = {key: max(abs(v) for v in known[key].values() if v is not None) for key in seen}
        strongest = sorted((key for key in strength if strength[key] >= WEAK), key=lambda key: -strength[key])[:3]
        if strongest:
            ranks = {key: known[key]["rank_correlation"] for key in strongest}  # None of a number of a wheel, say
            each = {key: key if rank is None else f"{key} {rank:+.2f}" for key, rank in ranks.items()}
            texts = (f"{text} ({100 * known[key]['first_order']:.0f} %)" for key, text in each.items())
            yield f"{name} hangs on {', '.join(texts)}: rank correlation (share of the variance of its ranks)"
