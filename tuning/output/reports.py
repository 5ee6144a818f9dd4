"""The report of each command. Start with `build`. The longer reports have modules of their own."""

import contextlib
import csv
import math
import re
from collections import Counter
from collections.abc import Callable, Iterator, Mapping, Sequence
from pathlib import Path
from typing import Any

from ptsmc_jax.campaigns import store
from ptsmc_jax.campaigns.store import RefusedError
from ptsmc_jax.simulation import catalogues
from ptsmc_jax.simulation.catalogues import CATALOGUES, without_norms
from tuning.output import campaign_report, compare_report, front_report, margins_report, report, summaries, tune_report
from tuning.output.formats import (
    format_error,
    format_metric,
    format_named_error,
    format_number,
    heading,
    in_readable_unit,
    list_counts,
    parse_cell,
)
from tuning.output.report import Report, Section, Table
from tuning.studies import front

LOG_NOTE = """mean square: of the innovations over their variance. White innovations have a mean square of 1 and no
autocorrelation."""
MAP_NOTE = (
    "linear_window_error and linear_torque are predictions of linear theory for the noise alone, with explicit "
    "sampling. radius, gain_margin and delay_margin belong to the loop at the hand-over with frozen gains, hold_radius "
    "and the others with hold_ to the hold phase. A radius is the largest modulus of the poles that the controller "
    "moves, and the loop is stable up to 1. gain_margin and "
    "delay_margin are those of the worst axis; they are not positive if the loop is unstable. meets is 0 if a "
    "requirement is not met, which not_met names, or if a trial fails or does not converge at t_f. Gains that the "
    "scenario does not state are designed once, and not again for each pair."
)


def build(command: str, summary: Mapping[str, object], plant: str) -> Report:
    """Return the report of a result.

    Args:
        command: name of the command, a key of `REPORTS`.
        summary: the content of `summary.json`, from the file or just computed. For a map: {"rows": the rows of
            `map.csv`, with its head}.
        plant: kind of the plant.

    Raises:
        KeyError, AttributeError, TypeError, msgspec.ValidationError: `summary` is not from this version of the command.
    """
    return REPORTS[command](summary, plant)


@contextlib.contextmanager
def name_in_errors(path: Path) -> Iterator[None]:
    """Raise RefusedError with the name of a file instead of the errors that its content causes.

    The block must only read the content of this file: any other error in it would get the name of the file too.
    """
    try:
        yield
    except (csv.Error, AttributeError, LookupError, TypeError, ValueError, RecursionError) as error:
        problem = f"{error} is missing or not known" if isinstance(error, KeyError) else error
        raise RefusedError(
            f"{path} is damaged or of another version: {problem}; repeat its command with --force"
        ) from error


def run_report(summary: summaries.Run, plant: str) -> Report:
    """Return the report of one run of this kind of plant."""
    status, error = summary.status, summary.metrics.get("window_error")
    if status == "ok" and summary.verdicts:
        status = "met" if all(one.met for one in summary.verdicts) else "not met"
    headline, mood = report.headline(status, summary.verdicts, format_named_error(error, plant))
    lines = list[str]()
    if error is not None and summary.lower_bound:
        bound = format_error(summary.lower_bound, plant)
        lines.append(f"lower bound of the RMS error of many trials: {bound}; the error of one trial may be smaller")
    if summary.reason:
        when = "" if summary.bad_time is None else f", at {summary.bad_time:.4g} s"
        lines.append(f"status {summary.status}: {summary.reason}{when}")
    if summary.drawn:
        angle = " ".join(next(row for row in drawn_table(summary).rows if row[0] == "initial_angle")).rstrip(" -")
        lines.append(f"{angle} in this trial; summary.json has its initial state and dispersions under drawn")
    if summary.controller_statuses:
        lines.append(f"samples of the controller: {list_counts(summary.controller_statuses)}")
    missing = "never" if summary.status in ("ok", "not_converged") else "-"
    rows, shown = [], without_norms(summary.metrics)
    for name, entry in CATALOGUES[plant].items():
        if name in shown:
            unit, (value,) = in_readable_unit(name, entry.unit, summary.metrics[name])
            rows.append((name, format_number(value, ".5g", missing), unit, entry.meaning))
    metrics = Section("Metrics", [Table(("metric", "value", "unit", "meaning"), rows)])
    sections = [*report.requirement_sections(summary.verdicts), metrics]
    return Report(headline, mood, [*lines, *report.warning_lines(summary.warnings)], sections)


def drawn_table(summary: summaries.Run) -> Table:
    """Return the table of the initial state and the dispersions of a trial."""
    rows = []
    for name, entry in summary.drawn.items():
        unit, (value,) = in_readable_unit(name, entry["unit"], entry["value"])
        rows.append((name, format_number(value, ".6g"), unit))
    return Table(("quantity", "value", "unit"), rows)


def paper_report(summary: Mapping[str, Any]) -> Report:
    """Return the report of `ptsmc reproduce`."""
    claims = [(one["verdict"], f"{one['where']}: {one['claim']}", one["measured"]) for one in summary["claims"]]
    slips = [(one["where"], one["correct"], one["shown"]) for one in summary["slips"]]
    counts = ", ".join(f"{count}: {word}" for word, count in summary["verdicts"].items())
    return Report(
        f"{summary['verdicts'].get('holds', 0)} of {len(claims)} claims of the paper hold literally",
        "calm",
        [counts, "claims.md states the reasons, and quotes the errors"],
        [
            Section("Claims of the paper", [Table(("verdict", "the paper", "measured"), claims)]),
            Section("Errors of the paper", [Table(("where", "correct", "evidence"), slips)]),
        ],
    )


def identify_report(summary: Mapping[str, Any]) -> Report:
    """Return the report of `ptsmc identify`: tables of the estimated numbers and of the logs, or of a design."""
    summary = store.to_json_value(summary)
    if summary["status"] == "designed":
        return _design_report(summary)
    estimates, columns = [], ("estimate", "std", "lower", "upper", "start", "prior_std")
    for one in summary["parameters"]:
        unit, numbers = in_readable_unit(one["parameter"], one["unit"], *(one[column] for column in columns))
        estimate, std, lower, upper, start, prior_std = numbers
        prior = format_number(prior_std, ".3g", "none")
        if one["parameter"].startswith("disturbance_phase") and one["prior_std"] is not None:
            prior = "uniform"  # over the circle, the only dispersion of a phase
        digits = max(5, 2 + math.ceil(math.log10(abs(estimate) / std))) if estimate and std else 5
        interval = f"{lower:.{digits}g} to {upper:.{digits}g}"
        estimates.append((
            one["parameter"], f"{estimate:.{digits + 1}g}", f"{std:.3g}", interval, f"{start:.6g}", prior, unit or "-",
        ))  # fmt: skip
    for bias in summary["gyro_bias"]:
        for axis, value, std in zip("xyz", bias["estimate"], bias["std"], strict=True):
            name = f"gyro bias {axis} at the end of {bias['log']}"
            interval = f"{value - 1.96 * std:.5g} to {value + 1.96 * std:.5g}"
            estimates.append((name, f"{value:.6g}", f"{std:.3g}", interval, "-", "-", "rad/s"))
    estimate_head = ("parameter", "estimate", "1 sigma", "95 % interval", "scenario", "prior 1 sigma", "unit")
    logs = []
    for use, fits in (("estimation", summary["logs"]), ("validation", summary["validation"])):
        for fit in fits:
            largest = max((abs(value or 0.0) for value in fit["largest_autocorrelation"].values()), default=0.0)
            numbers = (str(fit["readings"]), str(fit["outliers"]), f"{fit['mean_square']:.4g}", f"{largest:.2g}")
            logs.append((fit["log"], use, f"{fit['duration']:.4g}", *numbers, "yes" if fit["white"] else "NO"))
    log_head = ("log", "use", "duration [s]", "readings", "outliers", "mean square", "autocorrelation", "white")
    sections = [
        Section("Estimates", [Table(estimate_head, estimates)]),
        Section("Logs", [Table(log_head, logs, LOG_NOTE)]),
    ]
    is_identified = summary["status"] == "identified"
    headline = "The model explains the telemetry" if is_identified else "The model is DOUBTFUL"
    return Report(headline, "good" if is_identified else "bad", summary["verdict"], sections)


def _design_report(summary: Mapping[str, Any]) -> Report:
    """Return the report of `ptsmc identify --design`."""
    rows = []
    for one in summary["parameters"]:
        numbers = one["value"], one["expected_std"], one["plain_std"]  # a 1 sigma may be infinite, None in the file
        unit, shown = in_readable_unit(one["parameter"], one["unit"], *numbers)
        rows.append((one["parameter"], *(format_number(number, ".3g", "none") for number in shown), unit))
    table = Table(
        ("parameter", "scenario", "expected 1 sigma", "after plain slews", "unit"), rows,
        "Plain slews: one about each axis, one after another, within the same limits and time.",
    )  # fmt: skip
    lines = ["send the torque in profile.csv, and record attitude, rate and torque for ptsmc identify"]
    headline = f"Proposed a manoeuvre of {summary['duration']:.4g} s"
    return Report(headline, "calm", [*lines, *summary["undetermined"]], [Section("Expected accuracy", [table])])


def map_report(rows: Sequence[Sequence[str]], plant: str) -> Report:
    """Return the report of the rows of a map.csv for this kind of plant; the first two columns are the keys."""
    head, *rows = rows
    pairs = [dict(zip(("x", "y", *head[2:]), map(parse_cell, row), strict=True)) for row in rows]
    headline, *lines = map_lines(pairs, (head[0], head[1]), plant)
    shown_head, *shown_rows = zip(
        *(_map_column(*column, plant=plant) for column in zip(head, *rows, strict=True)), strict=True
    )
    table = Table(shown_head, shown_rows, MAP_NOTE)
    return Report(headline[0].upper() + headline[1:], "calm", lines, [Section("Pairs", [table])])


def map_lines(pairs: Sequence[Mapping[str, Any]], keys: tuple[str, str], plant: str) -> Iterator[str]:
    """Return lines on the best pair that keeps every requirement, on the number of pairs that fail, and on the reasons.

    Args:
        pairs: the rows of a map by column; x and y are the values of the keys.
        keys: keys of the horizontal and of the vertical axis, with their units.
        plant: kind of the plant.
    """
    simulated = [pair for pair in pairs if pair["status"] == "simulated"]
    with_error = [pair for pair in simulated if pair["window_error"] == pair["window_error"]]  # is not NaN
    if with_error:
        keeping = [pair for pair in with_error if pair["meets"] == 1]
        best = min(keeping or with_error, key=lambda pair: (_count_failures(pair), pair["window_error"]))
        among = f" of the {len(keeping)} pairs that keep every requirement" if keeping else ""
        if not keeping and best["meets"] == 0:
            yield "no pair keeps every requirement"
        count = _count_failures(best)
        failures = f"; {count:.0f} of its trials failed or did not converge at t_f" if count else ""
        peak = format_metric(best["peak_torque"], "peak_torque", plant)
        yield (
            f"the smallest RMS error{among} is {format_error(best['window_error'], plant)} at "
            f"{_describe_value(keys[0], best['x'])} and {_describe_value(keys[1], best['y'])}, with a mean peak torque "
            f"of {peak}{failures}"
        )
    failed = sum(_count_failures(pair) > 0 for pair in simulated)
    yield (
        f"{len(simulated)} of {len(pairs)} pairs simulated, {failed} of them with trials that failed or "
        "did not converge at t_f"
    )
    texts = (pair["not_met"] for pair in simulated if isinstance(pair["not_met"], str))  # NaN: an empty cell
    not_met = Counter(" ".join(texts).split()).most_common()
    if not_met:
        yield f"not met: {', '.join(f'{name} at {count} of {len(simulated)} pairs' for name, count in not_met)}"
    refused = [pair["status"] for pair in pairs if pair["status"] != "simulated"]
    if refused:
        yield f"{len(refused)} of {len(pairs)} pairs are not allowed, the first one because {refused[0]}"


def _describe_value(key: str, value: float) -> str:
    """Return key, value and unit as text, such as "loop.period = 0.1 s" for the key "loop.period [s]"."""
    name, _, unit = key.partition(" [")
    return f"{name} = {value:.4g} {unit.removesuffix(']')}".rstrip()


def _count_failures(pair: Mapping[str, Any]) -> float:
    """Return how many trials of a pair failed or did not converge at t_f, as a float like all cells of map.csv."""
    return pair["failures"] + pair["not_converged"]


def _map_column(name: str, *cells: str, plant: str) -> tuple[str, ...]:
    """Return a column of map.csv with a readable unit in its heading."""
    values = [value for cell in cells if not isinstance(value := parse_cell(cell), str)]
    if len(values) < len(cells):
        return name, *cells
    metric = re.sub("^(linear|largest|hold)_(?=torque|peak|window|delay|gain)", "", name)
    units = catalogues.units(plant)
    units |= {"torque": units["peak_torque"]} | {margin: entry.unit for margin, entry in catalogues.MARGINS.items()}
    unit = units.get(metric, "-")
    unit, numbers = in_readable_unit(metric, unit, *values)
    return heading(name, unit), *(format_number(number, ".4g", "") for number in numbers)


REPORTS: dict[str, Callable[[Mapping[str, Any], str], Report]] = {
    "simulate": lambda summary, plant: run_report(summaries.run(summary), plant),
    "tune": lambda summary, _: tune_report.build(summaries.tune(summary)),
    "pareto": lambda summary, _: front_report.build(front.read(summary)),
    "compare": lambda summary, _: compare_report.build(summaries.read(summaries.Compare, summary)),
    "montecarlo": lambda summary, _: campaign_report.build(summaries.read(summaries.Campaign, summary)),
    "margins": lambda summary, _: margins_report.build(summaries.read(summaries.Margins, summary)),
    "identify": lambda summary, _: identify_report(summary),
    "map": lambda summary, plant: map_report(summary["rows"], plant),
    "reproduce": lambda summary, _: paper_report(summary),
}
