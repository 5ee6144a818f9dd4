"""The content of a result for its readers: a headline, lines, and sections. The terminal and the page render it."""

from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass, field
from typing import TYPE_CHECKING

from tuning.output.formats import format_error, format_ratio, ratio_to_bound

if TYPE_CHECKING:  # summaries imports NumPy, which a command that computes nothing need not wait for
    from tuning.output.summaries import Entry


@dataclass(frozen=True)
class Table:
    """Cells as text. The first column names the row."""

    head: tuple[str, ...]
    rows: list[tuple[str, ...]]
    note: str = ""

    @property
    def shape(self) -> str:
        """Return "numbers" if the last column contains numbers; a last column of remarks has no heading."""
        numbers = bool(self.head[-1]) and all(row[-1][:1] and row[-1][:1] in "-0123456789" for row in self.rows)
        return "numbers" if numbers else ""


@dataclass(frozen=True)
class Text:
    """Lines of text."""

    lines: list[str]


@dataclass(frozen=True)
class Bars:
    """Requirements, each with a bar relative to its limit."""

    verdicts: "list[Entry]"
    lines: list[str]
    note: str = "The line is the limit; a bar that ends before it keeps the limit."


@dataclass(frozen=True)
class Chart:
    """A chart of the page, as Plotly's JSON."""

    name: str
    figure: dict[str, object]
    caption: str
    shape: str = ""


@dataclass(frozen=True)
class Picture:
    """A figure of the result folder."""

    alt: str
    source: str
    caption: str


@dataclass(frozen=True)
class Code:
    """Text that is printed without changes, such as a command."""

    text: str
    note: str = ""


Block = Table | Text | Bars | Chart | Picture | Code


@dataclass(frozen=True)
class Section:
    """A heading and its blocks."""

    title: str
    blocks: list[Block]


@dataclass(frozen=True)
class Report:
    """A result: the headline that the user decides by, the main lines, and the sections."""

    headline: str
    mood: str  # "good", "bad" or "calm", which selects the colour
    lines: list[str]
    sections: list[Section] = field(default_factory=list)

    def printed(self) -> Iterator[tuple[str, Table | list[str]]]:
        """Yield the tables and lines of all sections, the first of a section with its title and the others with ""."""
        for section in self.sections:
            title = section.title
            for block in section.blocks:
                if isinstance(block, Table | Text | Bars):
                    yield title, block if isinstance(block, Table) else block.lines
                    title = ""


HEADLINES = {
    "met": "every requirement is met",
    "not met": "NOT every requirement is met",
    "interrupted": "interrupted: the best result so far",
    "incomplete": "NOT finished",
    "ok": "the run reached its end",
}


def headline(status: str, verdicts: "Sequence[Entry]", error_text: str = "") -> tuple[str, str]:
    """Return the headline and its mood.

    Args:
        status: status of the summary.
        verdicts: verdicts on the requirements.
        error_text: the number that the user decides by, with its name; empty: there is none.
    """
    text = HEADLINES.get(status, f"the run failed: {status.replace('_', ' ')}")
    if not verdicts and status in ("met", "not met"):
        text = "every trial reached its end" if status == "met" else "NOT every trial reached its end"
    elif status == "not met" and {verdict.word for verdict in verdicts} - {"met"} == {"NOT shown"}:
        text = "NOT shown that every requirement is met"
    mood = {"met": "good", "ok": "calm"}.get(status, "bad")
    mood = "calm" if mood == "good" and not verdicts else mood
    return f"{error_text}: {text}" if error_text else text[0].upper() + text[1:], mood


def requirement_sections(verdicts: "Sequence[Entry]", format_verdict: "Callable[[Entry], str]" = str) -> list[Section]:
    """Return the section of the requirements, none without any; format_verdict: returns a verdict in words."""
    lines = [f"{format_verdict(verdict)}{per_cent_of_limit(verdict)}" for verdict in verdicts]
    return [Section("Requirements", [Bars(list(verdicts), lines)])] if verdicts else []


def per_cent_of_limit(entry: "Entry") -> str:
    """Return a text with the deciding value in per cent of the limit; empty if there is none."""
    if entry.margin is None or entry.at_least or entry.limit == 0.0:
        return ""
    if entry.fraction_of_time is not None:
        return f"; {format_ratio(100 * entry.margin)} % of the time allowed beyond the limit"
    subject = "" if entry.quantile is None else "the deciding trial is at "
    return f"; {subject}{format_ratio(100 * entry.margin)} % of the limit"


def bound_lines(value: float | None, lower_bound: float | None, plant: str) -> Iterator[str]:
    """Yield a sentence with the ratio of the RMS error of a campaign to its lower bound.

    Args:
        value: RMS window error of the campaign, in the unit of the metric, or None.
        lower_bound: lower bound of this error in the same unit, or None.
        plant: kind of the plant: "spacecraft", "chain" or "system".

    Yields:
        The sentence, unless a number is None or 0.
    """
    ratio = ratio_to_bound(value, lower_bound)
    if ratio is not None:
        yield f"{format_ratio(ratio)} times the lower bound of {format_error(lower_bound, plant)} with these sensors"


def warning_lines(texts: list[str]) -> list[str]:
    """Return the warnings about a scenario as lines."""
    return [f"WARNING: {text}" for text in texts]
