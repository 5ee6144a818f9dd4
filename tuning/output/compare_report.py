"""The report of a comparison of laws: a table and a chart for each question."""

import dataclasses
import math
from collections.abc import Callable, Iterator
from dataclasses import dataclass
from typing import Any

from ptsmc_jax.formulas import ARCSEC, pointing_angle
from ptsmc_jax.simulation.catalogues import MARGINS
from tuning.output.formats import (
    failed_counts,
    format_angle,
    format_count,
    format_number,
    format_ratio,
    list_counts,
    list_gains,
    ratio_to_bound,
    widened_lines,
)
from tuning.output.report import Block, Chart, Report, Section, Table, Text, warning_lines
from tuning.output.summaries import Compare, Interval, Law, Number


@dataclass(frozen=True)
class Value:
    """One number of each law: a column of a table, a series of a chart."""

    name: str
    unit: str
    read: Callable[[Law], Number]
    digits: str = ".3g"
    interval: Callable[[Law], Interval] = lambda law: None  # 95 % interval of the number


@dataclass(frozen=True)
class Question:
    """A question to all laws, and the numbers that answer it."""

    title: str
    values: tuple[Value, ...]
    drawn: int  # number of values in the chart, all in one unit
    logarithmic: bool = True
    note: str = ""
    judged: bool = False  # whether the table also shows the verdicts on the requirements
    axis_label: str = ""  # label of the chart's axis if it shows several values
    limit: str = ""  # metric whose limit the chart shows


def _to_arcsec(error: Any) -> Any:
    """Return a window error |v| or an interval of errors as angles [arcsec]; None for None."""
    return None if error is None else (ARCSEC * pointing_angle(error)).tolist()


def _error_column(name: str, change: str) -> Value:
    """Return the column of the pointing error with a model error.

    Args:
        name: heading of the column.
        change: name of the model error, a key of `CHANGES`.
    """
    return Value(
        name,
        "arcsec",
        lambda law: _to_arcsec(law.model_errors[change]["window_error"]) if change in law.model_errors else None,
        interval=lambda law: (
            _to_arcsec(law.model_errors[change]["window_error_interval"]) if change in law.model_errors else None
        ),
    )


def _margin_columns(name: str) -> tuple[Value, Value]:
    """Return two columns: the worst margin of all loops, for required margins only, and the nominal loop's margin."""

    def read_worst(law: Law) -> Number:
        """Return the worst margin over the dispersed loops, infinite if unlimited; None if it is not required."""
        verdict = next((entry for entry in law.verdicts if entry.metric == name), None)
        if verdict is None:
            return None
        return math.inf if verdict.worst is None and not verdict.failures else verdict.worst

    def read_nominal(law: Law) -> Number:
        """Return the margin of the nominal loop, infinite if unlimited; None if it was not computed."""
        if law.margins is None or "hold" not in law.margins:
            return None
        margin = law.margins["hold"][name]
        return math.inf if margin is None else margin  # null means that the margin is unlimited

    label, unit = name.removesuffix("_margin").replace("_", " "), MARGINS[name].unit
    return Value(f"{label}, worst loop", unit, read_worst), Value(f"{label}, nominal loop", unit, read_nominal)


ERROR = Value(
    "RMS pointing error", "arcsec", lambda law: _to_arcsec(law.window_error),
    interval=lambda law: _to_arcsec(law.window_error_interval),
)  # fmt: skip
BOUND = Value("ratio to the lower bound", "", lambda law: ratio_to_bound(law.window_error, law.lower_bound))
CHANGES = {
    "heavier": "an inertia 10 % larger than the law knows",
    "lighter": "an inertia 10 % smaller than the law knows",
    "later": "one more control period of delay than the law knows",
}
QUESTIONS = (
    Question(
        "How accurate?", (ERROR, BOUND), 1, judged=True,
        note="Bars are 95 % intervals; the dotted line is the lower bound.",
    ),
    Question(
        "How much torque?",
        (
            Value("mean peak", "N m", lambda law: law.peak_torque),
            Value("largest", "N m", lambda law: law.largest_peak_torque),
        ),
        2,
        axis_label="peak torque",
        limit="peak_torque",
    ),
    Question("How much effort?", (Value("mean effort", "N m s", lambda law: law.effort),), 1),
    Question("How much does it chatter?", (Value("mean chattering", "N m/s", lambda law: law.chattering),), 1),
    Question(
        "When has it settled?",
        (
            Value("median", "s", lambda law: (law.settling_time or {}).get("0.5"), ".1f"),
            Value("nearest fifth", "s", lambda law: (law.settling_near_far or (None, None))[0], ".1f"),
            Value("farthest fifth", "s", lambda law: (law.settling_near_far or (None, None))[1], ".1f"),
            Value("never", "trials", lambda law: law.unsettled, "d"),
        ),
        3,
        logarithmic=False,
        axis_label="settling time",
        note="Medians over all trials, and over the fifths of the trials that start nearest to and farthest from the "
        "reference.",
    ),
    Question(
        "Which stability margins?",
        tuple(column for name in MARGINS for column in _margin_columns(name)),
        2,
        logarithmic=False,
        axis_label="gain margin",
        limit="gain_margin",
        note="The nominal loop is analysed in the hold phase, at its worst input. The worst loop is the worst of the "
        "dispersed loops, in the hold phase and the analysed part of the approach phase; it is known for required "
        "margins only. Below 0 the loop is unstable. The chart shows the gain margin.",
    ),
    Question(
        "What if the model is wrong?",
        (
            dataclasses.replace(ERROR, name="as modelled"),
            _error_column("inertia + 10 %", "heavier"),
            _error_column("inertia - 10 %", "lighter"),
            _error_column("one more period of delay", "later"),
        ),
        4,
        axis_label="RMS pointing error",
        note="The same gains and trials, with another inertia or delay than the law knows. Bars are 95 % intervals.",
    ),
)  # fmt: skip


def build(summary: Compare) -> Report:
    """Return the report of a comparison."""
    headline = {
        "met": "The tuned prescribed-time law meets every requirement",
        "not met": "The tuned prescribed-time law does NOT meet every requirement",
    }.get(summary.status, "Interrupted: the best result so far")
    sections = [
        Section(question.title, [answer_table(question, summary.laws)])
        for question in QUESTIONS
        if _has_answer(question, summary.laws)
    ]
    method = [
        "the same search tuned each law; the section Gains lists the tuned gains of each law",
        f"results on {format_count(summary.trials, 'held-out trial')}, sampled at whole control periods from t = 0 "
        f"({summary.judged_on})",
    ]
    sections.append(Section("Gains", [Text(list(gain_lines(summary)))]))
    mood = "good" if summary.status == "met" else "bad"
    lines = [most_accurate_law(summary.laws), *method, *warning_lines(summary.warnings)]
    return Report(headline, mood, lines, sections)


def _has_answer(question: Question, laws: dict[str, Law]) -> bool:
    """Return whether a law has a value that the question reads."""
    return any(value.read(law) is not None for value in question.values for law in laws.values())


def charts(laws: dict[str, Law]) -> dict[str, list[Block]]:
    """Return the charts of the page by the titles of their sections."""
    from tuning.output import page_charts  # imports Matplotlib, which the terminal does not need

    names, charts_by_title = [_readable_name(law) for law in laws], dict[str, list[Block]]()
    for number, question in enumerate(QUESTIONS):
        if _has_answer(question, laws):
            drawn = question.values[: question.drawn]
            shown = [value for value in drawn if any(value.read(law) is not None for law in laws.values())]
            series = {
                value.name: ([value.read(law) for law in laws.values()], [value.interval(law) for law in laws.values()])
                for value in shown
            }
            axis = f"{question.axis_label or drawn[0].name} [{drawn[0].unit}]"
            marks = reference_lines(question, list(laws.values()))
            figure = page_charts.laws(names, series, axis, marks, question.logarithmic)
            charts_by_title[question.title] = [Chart(f"question_{number}", figure, question.note)]
    return charts_by_title


def reference_lines(question: Question, laws: list[Law]) -> dict[str, float]:
    """Return the horizontal line of a chart by its name; empty: none.

    For the accuracy it is the smallest lower bound of the error over all laws [arcsec], for a margin its limit.
    """
    if question.judged:
        bounds = [bound for law in laws if (bound := _to_arcsec(law.lower_bound))]
        return {"lower bound": min(bounds)} if bounds else {}
    limits = {verdict.metric: verdict.limit for law in laws for verdict in law.verdicts}
    return {"limit": limits[question.limit]} if question.limit in limits else {}


def answer_table(question: Question, laws: dict[str, Law]) -> Table:
    """Return the answers to a question, with a row for each law."""
    columns = [value for value in question.values if any(value.read(law) is not None for law in laws.values())]
    first = columns[0]
    head = [f"{value.name} [{value.unit}]" if value.unit else value.name for value in columns]
    with_interval = question.judged and any(first.interval(law) for law in laws.values())
    required = list(dict.fromkeys(verdict.metric for law in laws.values() for verdict in law.verdicts))
    rows = []
    for name, law in laws.items():
        cells = [format_answer(value, law) for value in columns]
        if with_interval:
            bounds = first.interval(law)
            cells.insert(1, "-" if bounds is None else f"{format_ratio(bounds[0])} to {format_ratio(bounds[1])}")
        if question.judged:
            violations = {
                verdict.metric: f"{verdict.failures} of {verdict.trials}" + ("" if verdict.met else f": {verdict.word}")
                for verdict in law.verdicts
            }
            cells += [*(violations.get(metric, "-") for metric in required), "yes" if law.met else "no"]
        rows.append((_readable_name(name), *cells))
    if with_interval:
        head.insert(1, "95 % interval")
    if question.judged:
        head += [*(f"violations of {metric}" for metric in required), "all limits met"]
    return Table(("", *head), rows)


def format_answer(value: Value, law: Law) -> str:
    """Return the number of a law as text."""
    number = value.read(law)
    if number is not None and math.isinf(number):
        return "unlimited"
    return format_ratio(number) if value.digits == ".3g" else format_number(number, value.digits)


def gain_lines(summary: Compare) -> Iterator[str]:
    """Return the gains of each law, its failed trials, and the limits that it breaks."""
    if summary.status == "interrupted":
        yield (
            f"interrupted while {_readable_name(list(summary.laws)[-1])} was tuned: its gains are the best so far, and "
            "the other laws are missing; the same command resumes the search"
        )
    if summary.published_unavailable:
        yield f"the published gains cannot be simulated in this scenario: {summary.published_unavailable}"
    for name, law in summary.laws.items():
        gains = list_gains(law.gains, law.gain_units, ".4g")
        bound = "".join(f"; {gain} on its {side} bound" for gain, side in law.at_bound.items())
        scaled = (
            ", scaled to this body and period"
            if (name, summary.published_label) == ("published", "published gains, scaled")
            else ""
        )
        yield f"{_readable_name(name)}{scaled}: {gains}{bound}"
        yield from (f"  {line}" for line in widened_lines(law.widened_bounds))
        failures = failed_counts(law.counts)
        if failures:
            yield f"  {sum(failures.values())} of {summary.trials} trials fail: {list_counts(failures)}"
        yield from (f"  {verdict}" for verdict in law.verdicts if not verdict.met)
        for change, results in law.model_errors.items():
            if results["failures"]:
                yield f"  {results['failures']} of {summary.trials} trials fail with {CHANGES[change]}"
    yield f"a trial has settled when its angle stays below {format_angle(summary.settling_angle)}"


def most_accurate_law(laws: dict[str, Law]) -> str:
    """Return a sentence on the most accurate law that meets every requirement, and on the prescribed-time law."""
    errors = {
        name: error for name, law in laws.items() if law.met and (error := _to_arcsec(law.window_error)) is not None
    }
    if not errors:
        return "no law meets every requirement"
    best, own_law = min(errors, key=errors.__getitem__), "prescribed_time"
    comparison = ""
    if own_law in errors and best != own_law:
        own_error = f"{errors[own_law]:.3g} arcsec"
        ratio = format_ratio(errors[own_law] / errors[best]) if errors[best] else None
        if ratio is not None:
            own_error = "an equal error" if ratio == "1" else f"{ratio} times this error"
        comparison = f"; {_readable_name(own_law)} has {own_error}"
    return (
        f"{_readable_name(best)} has the smallest RMS pointing error of the laws that meet every requirement, "
        f"{errors[best]:.3g} arcsec{comparison}"
    )


def _readable_name(law: str) -> str:
    """Return the name of a law in words."""
    return "published gains" if law == "published" else law.replace("_", " ")
