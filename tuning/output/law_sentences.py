"""Laws side by side in tables and words, a table for each question; and what a page draws of each."""

import dataclasses
import math
from collections.abc import Callable, Iterator
from dataclasses import dataclass
from typing import Any

from ptsmc_jax.simulation.catalogues import MARGINS
from tuning.output import page_charts, sentences
from tuning.output.cells import Summary, Table, digits, lost, many


@dataclass(frozen=True)
class Value:
    """One number of each law: a column of a table, a series of a chart."""

    name: str
    unit: str
    of: Callable[[Summary], float | int | None]
    digits: str = ".3g"
    interval: Callable[[Summary], Any] = lambda law: None  # 95 %, two numbers


@dataclass(frozen=True)
class Question:
    """What is asked of all laws, and the numbers that answer it.

    drawn: how many of them, the first ones, a chart shows, in one unit; judged: with whether all limits are met.
    """

    title: str
    values: tuple[Value, ...]
    drawn: int
    logarithmic: bool = True
    note: str = ""
    judged: bool = False
    what: str = ""  # on the axis of the chart, where it shows several
    limit: str = ""  # metric whose limit is drawn


def _untold(name: str, change: str) -> Value:
    """The window error with a change that the law is not told of, one of `WORDS`."""

    def of(law: Summary, key: str = "window_error") -> Any:
        return law["untold"].get(change, {}).get(key)

    return Value(name, "-", of, ".2e", lambda law: of(law, "window_error_interval"))


def _hold(name: str) -> Value:
    """Return a margin of the nominal loop in the hold phase; if it is required, the worst of the dispersed loops."""
    unit = MARGINS[name].unit

    def of(law: Summary) -> float | None:
        verdict = {v["metric"]: v for v in law["verdicts"]}.get(name)
        if verdict is not None:
            unlimited = verdict["failures"] == 0 and verdict["worst"] in (None, math.inf)  # JSON has no number for it
            return math.inf if unlimited else verdict["worst"]
        hold = (law["margins"] or {}).get("hold", {})
        return math.inf if name in hold and hold[name] is None else hold.get(name)  # null where it is unlimited

    return Value(name.removesuffix("_margin"), unit, of)


ERROR = Value("RMS window error", "-", lambda law: law["window_error"], ".2e", lambda law: law["window_error_interval"])
FLOOR = Value("times the floor", "", lambda law: sentences.over_floor(law["window_error"], law.get("floor")))
QUESTIONS = (
    Question(
        "How accurate?",
        (ERROR, FLOOR),
        1,
        judged=True,
        note="Bars are 95 % intervals; no controller can beat the dotted floor.",
    ),
    Question(
        "How much torque?",
        (
            Value("mean peak", "N m", lambda law: law["peak_torque"]),
            Value("largest", "N m", lambda law: law["largest_peak_torque"]),
        ),
        2,
        what="peak torque",
        limit="peak_torque",
    ),
    Question("How much is spent?", (Value("mean effort", "N m s", lambda law: law["effort"]),), 1),
    Question("How much does it chatter?", (Value("mean chattering", "N m/s", lambda law: law["chattering"]),), 1),
    Question(
        "When has it settled?",
        (
            Value("median", "s", lambda law: (law["settling_time"] or {}).get("0.5"), ".1f"),
            Value("nearest fifth", "s", lambda law: (law["settling_near_far"] or [None])[0], ".1f"),
            Value("farthest fifth", "s", lambda law: (law["settling_near_far"] or [None])[-1], ".1f"),
            Value("never", "trials", lambda law: law["unsettled"], "d"),
        ),
        3,
        logarithmic=False,
        what="settling time",
        note="Medians over all trials, and over the fifths of them that begin nearest and farthest from the reference.",
    ),
    Question(
        "What margins are left?",
        tuple(_hold(name) for name in MARGINS),
        1,
        logarithmic=False,
        limit="gain_margin",
        note="Margins are those of the nominal loop in the hold phase, at its worst input. A required margin is the "
        "worst of the dispersed loops, in the hold phase and the judged part of the approach phase. Below 0 the loop "
        "is unstable; at 0 it swings by itself. The chart shows the gain margin.",
    ),
    Question(
        "What if the model is wrong?",
        (
            dataclasses.replace(ERROR, name="as modelled"),
            _untold("inertia + 10 %", "heavier"),
            _untold("inertia - 10 %", "lighter"),
            _untold("a period later", "later"),
        ),
        4,
        what="RMS window error",
        note="The same gains and trials, with another inertia or delay than the law knows; bars: 95 %.",
    ),
)


@dataclass(frozen=True)
class Answer:
    """What laws say to a question: a law each row of the table."""

    title: str
    table: Table
    chart: page_charts.Chart
    note: str


def answers(summary: Summary) -> list[Answer]:
    """An answer to each question that some law has a number for."""
    laws = summary["laws"]
    answered = [q for q in QUESTIONS if any(value.of(law) is not None for value in q.values for law in laws.values())]
    return [Answer(q.title, _table(q, laws), _chart(q, laws), q.note) for q in answered]


def _chart(question: Question, laws: Summary) -> page_charts.Chart:
    drawn, each = question.values[: question.drawn], list(laws.values())
    series = {value.name: (list(map(value.of, each)), list(map(value.interval, each))) for value in drawn}
    axis = f"{question.what or drawn[0].name} [{drawn[0].unit}]"
    return page_charts.laws(list(laws), series, axis, _marks(question, each), question.logarithmic)


def _marks(question: Question, laws: list[Summary]) -> dict[str, float]:
    """What numbers of laws are drawn beside: the floor, a limit that is asked for."""
    if question.judged:
        floors = [law["floor"] for law in laws if law.get("floor")]
        return {"floor": min(floors)} if floors else {}
    limits = {verdict["metric"]: verdict["limit"] for law in laws for verdict in law["verdicts"]}
    return {"limit": limits[question.limit]} if question.limit in limits else {}


def _table(question: Question, laws: Summary) -> Table:
    columns = [value for value in question.values if any(value.of(law) is not None for law in laws.values())]
    first = columns[0]
    head = [f"{value.name} [{value.unit}]" if value.unit else value.name for value in columns]
    with_interval = question.judged and any(first.interval(law) for law in laws.values())
    required = list(dict.fromkeys(verdict["metric"] for law in laws.values() for verdict in law["verdicts"]))
    rows = []
    for name, law in laws.items():
        cells = [_cell(value, law) for value in columns]
        if with_interval:
            low, high = first.interval(law) or (None, None)
            cells.insert(1, "-" if low is None else f"{low:{first.digits}} to {high:{first.digits}}")
        if question.judged:
            beyond = {verdict["metric"]: _beyond(verdict) for verdict in law["verdicts"]}
            cells += [*(beyond.get(metric, "-") for metric in required), "yes" if law["met"] else "no"]
        rows.append((_name(name), *cells))
    if with_interval:
        head.insert(1, "95 %")
    if question.judged:
        head += [*(f"trials beyond {metric}" for metric in required), "all limits met"]
    return Table(("", *head), rows)


def _beyond(verdict: Summary) -> str:
    """How many trials break a requirement, and whether these are too many."""
    return f"{verdict['failures']} of {verdict['trials']}" + ("" if verdict["met"] else ": NOT met")


def _cell(value: Value, law: Summary) -> str:
    number = value.of(law)
    if number is not None and math.isinf(number):
        return "unlimited"
    return sentences.ratio(number) if value.digits == ".3g" else digits(number, value.digits)


def lines(summary: Summary) -> Iterator[str]:
    """The gains of each law, trials that went wrong, and limits that it breaks."""
    if summary["status"] == "interrupted":
        yield (
            f"interrupted while {_name(list(summary['laws'])[-1])} was tuned: its gains are the best so far, and laws "
            "after it are missing; the same command goes on from here"
        )
    yield from sentences.paper_refused(summary)
    for name, law in summary["laws"].items():
        gains = ", ".join(f"{gain} {value:.4g}" for gain, value in law["gains"].items())
        bound = "".join(f"; {gain} on its {side} bound" for gain, side in law["at_bound"].items())
        scaled = name == "paper" and summary.get("paper_is") == "paper, scaled"
        yield f"gains of {name}{', scaled to this body and period' if scaled else ''}: {gains}{bound}"
        bad, ended = lost(law["counts"])
        if bad:
            yield f"  of {summary['trials']} trials {ended}"
        yield from (f"  {sentences.verdict(verdict)}" for verdict in law["verdicts"] if not verdict["met"])
        for change, figures in law["untold"].items():
            if figures["lost"]:
                yield f"  {WORDS[change]} {figures['lost']} of {summary['trials']} trials fail or miss t_f"
    yield f"a trial has settled when its angle stays below {summary['settling_angle']:g} rad from then on"


WORDS = {
    "heavier": "with an inertia 10 % larger than the law knows",
    "lighter": "with an inertia 10 % smaller than the law knows",
    "later": "with a control period of delay more than the law knows",
}


def alike(summary: Summary) -> str:
    """How the laws were tuned and judged."""
    tuned = "each law is tuned alike in all of its gains, the scenario's own in those of tune.free where that is given"
    return f"{tuned}, and judged on {many(summary['trials'], 'fresh trial')}, {summary['judged_on']}"


def winner(summary: Summary) -> str:
    """Which law has the smallest error of those that meet every requirement, and how far the paper's is behind it."""
    errors = {name: law["window_error"] for name, law in summary["laws"].items() if law["met"]}
    errors = {name: error for name, error in errors.items() if error is not None}
    if not errors:
        return "no law meets every requirement"
    best, ours = min(errors, key=errors.__getitem__), "prescribed_time"
    behind = ""
    if ours in errors and best != ours:
        theirs = f"{errors[ours] / errors[best]:.3g} times that" if errors[best] else f"{errors[ours]:.2e}"
        behind = f"; {_name(ours)} has {theirs}"
    return f"of the laws that meet every requirement {_name(best)} has the smallest error, {errors[best]:.2e}{behind}"


def _name(law: str) -> str:
    return law.replace("_", " ")
