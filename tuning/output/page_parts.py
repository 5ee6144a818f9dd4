"""What a page is made of: a heading, sections of blocks, and the result folder that they are made from."""

from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

from tuning.output import page_charts


@dataclass(frozen=True)
class Block:
    """A piece of a section: a table, bars, a picture, a chart, code or lines of text."""

    kind: str
    note: str = ""  # below it
    head: tuple[str, ...] = ()
    rows: list[tuple[str, ...]] = field(default_factory=list)
    bars: list[dict[str, Any]] = field(default_factory=list)
    alt: str = ""
    source: str = ""
    caption: str = ""
    name: str = ""
    shape: str = ""
    text: str = ""
    lines: list[str] = field(default_factory=list)


@dataclass(frozen=True)
class Section:
    """A heading and what stands under it."""

    title: str
    blocks: list[Block]


@dataclass(frozen=True)
class Heading:
    """What is said first; mood: good, bad or calm."""

    mood: str
    headline: str
    lines: list[str]


@dataclass(frozen=True)
class Result:
    """A result folder as read."""

    folder: Path
    versions: dict[str, Any]
    summary: dict[str, Any]
    scenario: dict[str, Any]  # as the file has it; empty: there is none
    charts: dict[str, page_charts.Chart] = field(default_factory=dict)  # filled while sections are made

    @property
    def kind(self) -> str:
        """The kind of the plant."""
        return self.scenario.get("plant", {}).get("kind", "spacecraft")

    def chart(self, name: str, made: page_charts.Chart, caption: str, shape: str = "") -> Block:
        """A chart of the page."""
        self.charts[name] = made
        return Block("chart", name=name, caption=caption, shape=shape)
