"""`ptsmc report`: a result folder as one page of HTML that needs no other file and runs no foreign code.

The page is made from the files in the folder. Its policy allows its own two scripts, known by their checksums, and
nothing from elsewhere; every text is escaped.
"""

import base64
import csv
import hashlib
import json
import os
import sys
from collections.abc import Iterator
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import msgspec
import numpy as np

from ptsmc_jax.campaigns import store
from ptsmc_jax.campaigns.store import RefusedError
from ptsmc_jax.scenario import parsing
from tuning.errors import UsageError
from tuning.output import campaign_report, page_captions, page_charts, reports
from tuning.output.report import Block, Chart, Code, Picture, Report, Section, Table
from tuning.studies import front

HERE = Path(__file__).parent
INPUT_FILES = ("versions.json", store.SUMMARY, "scenario.toml", "trajectory.csv", "history.csv", "map.csv")  # to read
PNG_HEADER = b"\x89PNG\r\n\x1a\n"  # first bytes of a PNG file


@dataclass(frozen=True)
class Result:
    """The content of a result folder."""

    folder: Path
    versions: dict[str, Any]
    summary: dict[str, Any]
    scenario: dict[str, Any]  # tables of scenario.toml; empty without a scenario

    @property
    def plant(self) -> str:
        """Return the kind of the plant."""
        return self.scenario.get("plant", {}).get("kind", "spacecraft")


def read(folder: Path) -> Result:
    """Read a result folder. Raises RefusedError if it holds no finished result."""
    if not folder.is_dir():
        raise RefusedError(f"{folder} is no folder; allowed is a folder that a ptsmc command wrote")
    for name in INPUT_FILES:
        if _is_outside(folder, folder / name):
            raise RefusedError(f"{folder / name} is a link out of the folder; allowed is a file in it")
    versions = store.read_versions(folder)
    command = versions.get("command")
    if str(command) not in reports.REPORTS:
        raise RefusedError(f"{folder} holds no result; allowed is a folder that a ptsmc command wrote")
    try:
        if command == "map":
            summary = {"rows": _read_rows(folder / "map.csv")}
        else:
            summary = json.loads((folder / store.SUMMARY).read_text(encoding="utf-8"))
        path = folder / "scenario.toml"
        scenario = parsing.parse_toml(path.read_text(encoding="utf-8"), str(path)) if path.exists() else {}
    except FileNotFoundError:
        raise _unfinished_error(folder, versions) from None
    except (ValueError, RecursionError) as error:
        raise RefusedError(f"{folder} holds a file that cannot be read: {error}") from None
    return Result(folder, versions, summary, scenario)


def _read_rows(path: Path) -> list[list[str]]:
    """Return the rows of a CSV file with its head."""
    with path.open(newline="", encoding="utf-8") as file:
        return list(csv.reader(file))


def _is_outside(folder: Path, path: Path) -> bool:
    """Return whether a path of a result folder is, or lies behind, a link to a place outside the folder."""
    # unlike Path.resolve it does not raise for a link to itself
    return not Path(os.path.realpath(path)).is_relative_to(os.path.realpath(folder))


def _unfinished_error(folder: Path, versions: dict[str, Any]) -> RefusedError:
    unfinished = f"{folder} holds a {versions['command']} that is not finished"
    return RefusedError(f"{unfinished}; run the same command to its end")


def build(folder: Path) -> str:
    """Return the page of a result folder.

    Raises:
        RefusedError: the folder holds no finished result, or files that cannot be read.
        UsageError: plotly or jinja2 is not installed.
    """
    result = read(folder)
    try:
        from jinja2 import Environment
        from markupsafe import Markup
        from plotly.offline import get_plotlyjs
    except ImportError as error:
        raise UsageError(f"the page needs {error.name}: pip install 'ptsmc-jax[report]'") from None
    try:
        command = result.versions["command"]
        report = _add_charts(reports.build(command, result.summary, result.plant), result)
    except FileNotFoundError:
        raise _unfinished_error(folder, result.versions) from None
    except (msgspec.ValidationError, KeyError, AttributeError, TypeError) as error:
        version = result.versions.get("ptsmc-jax")
        raise RefusedError(f"{folder} holds a summary of another version ({version}): {error}; make it again") from None
    except (csv.Error, IndexError, ValueError) as error:  # for example, a CSV file is truncated
        raise RefusedError(f"{folder} holds a file that cannot be read: {error}") from None
    sections = [*report.sections, *_figure_sections(result), *_origin_sections(result)]
    charts_by_name = {
        block.name: block.figure for section in sections for block in section.blocks if isinstance(block, Chart)
    }
    drawing_script = (HERE / "page.js").read_text(encoding="utf-8")
    library = get_plotlyjs() if charts_by_name else ""
    scripts = (
        " ".join(f"'sha256-{_policy_checksum(script)}'" for script in (library, drawing_script))
        if charts_by_name
        else "'none'"
    )
    # < is escaped, so that no text in the data can close the HTML element
    charts = json.dumps(charts_by_name, allow_nan=False, separators=(",", ":")).replace("<", "\\u003c")
    environment = Environment(autoescape=True, trim_blocks=True, lstrip_blocks=True)
    template = environment.from_string((HERE / "page.html").read_text(encoding="utf-8"))
    return template.render(
        title=f"ptsmc {result.versions['command']}: {folder.resolve().name}",
        report=report,
        sections=sections,
        policy=Markup(f"default-src 'none'; img-src data: blob:; style-src 'unsafe-inline'; script-src {scripts}"),
        style=Markup((HERE / "page.css").read_text(encoding="utf-8")),
        charts=Markup(charts) if charts_by_name else "",
        library=Markup(library),
        drawing=Markup(drawing_script),
    )


def _policy_checksum(script: str) -> str:
    """Return the SHA-256 of a script in base64, as the page's Content-Security-Policy lists allowed scripts."""
    return base64.b64encode(hashlib.sha256(script.encode("utf-8")).digest()).decode("ascii")


def _history_charts(result: Result) -> list[Block]:
    """Return the charts of a run."""
    columns = page_charts.read_trajectory(result.folder / "trajectory.csv")
    law = result.scenario["controller"]
    marks = {"t_f": law["t_f"], **({"t_f - delta": law["t_f"] - law["delta"]} if "delta" in law else {})}
    if "delta" in law and law["delta"] < 0.05 * columns["t"][-1]:  # the labels of t_f - delta and t_f would overlap
        del marks["t_f - delta"]
    spacecraft = result.plant == "spacecraft"
    caption = "Drag to zoom, double-click to see all; the dotted lines are the hand-over and t_f."
    charts: list[Block] = [Chart("history", page_charts.history(columns, spacecraft, marks), caption, "tall")]
    if spacecraft:
        q = np.stack([columns[f"q{k + 1}"] for k in range(4)], axis=1)
        caption = "The body and its axes over time; dashed: the inertial axes. Drag to turn the view."
        charts.append(Chart("attitude", page_charts.attitude(columns["t"], q), caption, "square"))
    return charts


def _search_chart(result: Result) -> Chart:
    """Return the chart of a search."""
    head, *rows = _read_rows(result.folder / "history.csv")
    points = [dict(zip(head, row, strict=True)) for row in rows]
    caption = "The objective along the local search from each starting point; a hollow point breaks a limit."
    return Chart("search", page_charts.search(points, head[2]), caption)


def _front_chart(result: Result) -> Chart:
    """Return the chart of a front of error against torque."""
    caption = "Hover over a point for its gains. Bars are 95 % intervals; the dashed line is the required limit."
    requirement = result.scenario.get("requirements", {}).get("peak_torque")
    limit = requirement.get("limit") if isinstance(requirement, dict) else requirement
    return Chart("front", page_charts.front(front.read(result.summary), limit), caption)


def _add_charts(report: Report, result: Result) -> Report:
    """Return a report with the charts and the table that only the page shows."""
    command, sections = result.versions["command"], report.sections
    if command == "simulate":
        sections = [*sections, Section("History", _history_charts(result))]
    elif command == "tune":
        sections = [*sections, Section("Search", [_search_chart(result)])]
    elif command == "montecarlo":
        gains = campaign_report.gain_table(result.scenario, result.plant)
        sections = [*sections, Section("Gains", [gains])]
    elif command == "pareto" and result.summary["against"] == "torque":
        sections = [replace(section, blocks=[_front_chart(result), *section.blocks]) for section in sections]
    return replace(report, sections=sections)


def _figure_sections(result: Result) -> Iterator[Section]:
    """Return the section of the figures in the folder."""
    pictures = []
    for path in sorted((result.folder / "figures").glob("*.png")):
        is_outside = _is_outside(result.folder, path)
        content = path.read_bytes() if path.is_file() and not is_outside else b""
        if not content.startswith(PNG_HEADER):
            reason = "is a link out of the folder" if is_outside else "is no PNG file"
            print(f"ptsmc: {path} {reason}, and is not in the page", file=sys.stderr)
            continue
        source = "data:image/png;base64," + base64.b64encode(content).decode("ascii")
        pictures.append(Picture(path.stem.replace("_", " "), source, page_captions.CAPTIONS.get(path.stem, "")))
    if pictures:
        yield Section("Figures", pictures)


def _origin_sections(result: Result) -> Iterator[Section]:
    """Return the sections with the scenario, the command line, and the versions."""
    versions = result.versions
    path = result.folder / "scenario.toml"
    if path.exists():
        note = page_captions.SCENARIO.get(versions["command"], "")
        yield Section("Scenario", [Code(path.read_text(encoding="utf-8"), note)])
    command_line = versions.get(store.COMMAND_LINE, "")
    yield Section("How to make this again", [Code(command_line, "In the folder where it was called.")])
    rows = [(name, json.dumps(value) if not isinstance(value, str) else value) for name, value in versions.items()]
    yield Section("Made by", [Table(("", "version"), rows)])
