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
from ptsmc_jax.figures.style import objective_display
from ptsmc_jax.scenario import parsing
from ptsmc_jax.scenario.tables import Tune, objective_name
from ptsmc_jax.simulation.catalogues import CATALOGUES
from tuning.errors import UsageError
from tuning.output import campaign_report, compare_report, page_charts, reports, summaries
from tuning.output.report import Block, Chart, Code, Picture, Section, Table
from tuning.studies import campaign_folder, front

HERE = Path(__file__).parent
# the table of a finished result, by command
TABLES = {
    "simulate": "trajectory.csv",
    "tune": "history.csv",
    "map": "map.csv",
    "margins": "margins.csv",
    "compare": "compare.csv",
}
INPUT_FILES = ("versions.json", store.SUMMARY, "scenario.toml", *TABLES.values())  # to read
PNG_HEADER = b"\x89PNG\r\n\x1a\n"  # first bytes of a PNG file
# caption of the scenario in a page, by command: whose gains it has
SCENARIO_NOTES = {
    "tune": "These are the gains of the scenario; tuned.toml is the same scenario with the tuned gains.",
    "pareto": "These are the gains of the scenario; the table above has the gains of each point.",
    "compare": "These are the gains of the scenario; the gains of each law are listed above.",
}
# captions of the figures
CAPTIONS = {
    "history": "Gains and objective of every starting point over the steps of the local search, as in history.csv. "
    "Each stage has at most tune.steps steps, and may have other trials than the one before.",
    "tradeoff": "Torque and error after t_f of each held-out trial; its axis names the torque.",
    "sensitivities": "Change of each metric in per cent for one per cent of each gain.",
    "profiles": "The objective along each gain between its bounds, with the other gains as found; marked points break "
    "a limit.",
    "front": "The front of accuracy against peak torque.",
    "slew_times": "The error and the costs of the slew over the prescribed time; open points break a requirement.",
    "robustness": "The error, the torque and the margins over the limit on the peak sensitivity; open points break "
    "a requirement.",
    "map": "Error and peak torque over the two keys, with the stability limits of the loop; points break "
    "a requirement.",
    "nichols": "The open loop at each axis of the plant's input, the others closed.",
    "sensitivity": "Transfer of disturbances (S) and noise (T) over the frequency.",
    "margins": "Margins of the nominal loop in the approach phase, with its gains frozen; grey: times that no "
    "requirement judges, because the gains change within the settling time of the loop.",
    "fan": "The error over time: the fraction of trials inside each band.",
    "distributions": "The fraction of the trials up to each value; the scale stretches both ends.",
    "inputs": "Metrics (up) over the sampled inputs (across), a point for each trial; limits are dashed.",
    "wheels": "Momentum of each reaction wheel over time.",
    "wheel_torque": "Torque of each reaction wheel over time.",
    "disturbance": "The disturbance as the observer estimates it; the true one is black.",
    "torque_by_angle": "Peak torque over the initial angle from the reference.",
    "settling": "Settling time over the initial angle from the reference.",
    "error": "Attitude error, or the first state, over time.",
    "sliding": "Sliding variable over time.",
    "convergence": "Error and sliding variable over the time to go; dotted: the exact motion; black: the slopes of the "
    "theory.",
    "torque": "Delivered torque over time.",
    "attitude": "Attitude over time.",
    "rate": "Body rate over time.",
    "states": "States over time.",
}


@dataclass(frozen=True)
class Result:
    """The content of a result folder."""

    folder: Path
    versions: dict[str, Any]
    source: Path  # the file with the summary
    summary: dict[str, Any]
    scenario: dict[str, Any]  # tables of scenario.toml; empty for `ptsmc reproduce`
    plant: str  # kind of the plant


def read(folder: Path) -> Result:
    """Return the `Result` in a folder; raise RefusedError or ScenarioError if it holds no finished result."""
    if not folder.is_dir():
        raise RefusedError(f"{folder} is no folder; allowed is a folder that a ptsmc command wrote")
    for name in INPUT_FILES:
        if _is_outside(folder, folder / name):
            raise RefusedError(f"{folder / name} is a link out of the folder; allowed is a file in it")
    versions = store.read_versions(folder)
    command = str(versions.get("command"))
    if command not in reports.REPORTS:
        wrong = "holds no result, or its versions.json is damaged"
        if command == "export":
            wrong = "has exported code, which has no page"
        raise RefusedError(f"{folder} {wrong}; allowed is a folder of `ptsmc {'`, `'.join(reports.REPORTS)}`")
    source = folder / ("map.csv" if command == "map" else store.SUMMARY)
    for path in (source, folder / TABLES.get(command, source.name)):
        if not path.exists():
            remedy = "to its end" if path.name == store.SUMMARY else "with --force"
            raise RefusedError(
                f"{path} does not exist: the results of `ptsmc {command}` are incomplete; run the same command {remedy}"
            )
    if command == "montecarlo":
        campaign_folder.open_folder(folder).stored_parts()  # raises RefusedError for a damaged part
    with reports.name_in_errors(source):
        is_map = command == "map"
        summary = {"rows": _read_rows(source)} if is_map else msgspec.json.decode(source.read_bytes(), type=dict)
    scenario = {} if command == "reproduce" else parsing.read_toml(folder / "scenario.toml")
    with reports.name_in_errors(folder / "scenario.toml"):
        plant = scenario.get("plant", {}).get("kind", "spacecraft")
        if plant not in CATALOGUES:
            raise ValueError(f"plant.kind is {plant!r}")
    return Result(folder, versions, source, summary, scenario, plant)


def _read_rows(path: Path) -> list[list[str]]:
    """Return all rows of a CSV file; the first one has the names of the columns."""
    with path.open(newline="", encoding="utf-8") as file:
        rows = list(csv.reader(file))
    if len(rows) < 2:
        raise ValueError("it has no rows")
    for number, row in enumerate(rows, 1):
        if len(row) != len(rows[0]):
            raise ValueError(f"line {number} must have {len(rows[0])} cells, one for each column name")
    return rows


def _is_outside(folder: Path, path: Path) -> bool:
    """Return whether a path of a result folder is, or lies behind, a link to a place outside the folder."""
    # unlike Path.resolve it does not raise for a link to itself
    return not Path(os.path.realpath(path)).is_relative_to(os.path.realpath(folder))


def build(folder: Path) -> str:
    """Return the page of a result folder.

    Raises:
        RefusedError: the folder holds no finished result, or a damaged file.
        ScenarioError: its scenario.toml cannot be read.
        UsageError: plotly or jinja2 is not installed.
    """
    result = read(folder)
    try:
        from jinja2 import Environment
        from plotly.offline import get_plotlyjs
    except ImportError as error:
        raise UsageError(f"the page needs {error.name}: pip install 'ptsmc-jax[report]'") from None
    with reports.name_in_errors(result.source):
        report = reports.build(result.versions["command"], result.summary, result.plant)
    charts = _charts(result)
    sections = [
        *(replace(section, blocks=[*charts.pop(section.title, []), *section.blocks]) for section in report.sections),
        *(Section(title, blocks) for title, blocks in charts.items()),
        *_figure_sections(result),
        *_origin_sections(result),
    ]
    figures = {block.name: block.figure for section in sections for block in section.blocks if isinstance(block, Chart)}
    scripts = [get_plotlyjs(), (HERE / "page.js").read_text(encoding="utf-8")] if figures else []
    checksums = [
        base64.b64encode(hashlib.sha256(script.encode("utf-8")).digest()).decode("ascii") for script in scripts
    ]
    allowed = " ".join(f"'sha256-{checksum}'" for checksum in checksums) or "'none'"
    environment = Environment(autoescape=True, trim_blocks=True, lstrip_blocks=True)
    template = environment.from_string((HERE / "page.html").read_text(encoding="utf-8"))
    return template.render(
        title=f"ptsmc {result.versions['command']}: {folder.resolve().name}",
        report=report,
        sections=sections,
        policy=f"default-src 'none'; img-src data: blob:; style-src 'unsafe-inline'; script-src {allowed}",
        style=(HERE / "page.css").read_text(encoding="utf-8"),
        # < is escaped, so that no text in the data can close the HTML element
        figures=json.dumps(figures, allow_nan=False, separators=(",", ":")).replace("<", "\\u003c"),
        scripts=scripts,
    )


def _history_charts(result: Result) -> list[Block]:
    """Return the charts of a run."""
    spacecraft = result.plant == "spacecraft"
    with reports.name_in_errors(result.folder / TABLES["simulate"]):
        head, *rows = _read_rows(result.folder / TABLES["simulate"])
        values = np.array([[float(cell or "nan") for cell in row] for row in rows])
        columns = dict(zip(head, values.T, strict=True))
        t = columns["t"]
        q = np.stack([columns[f"q{k + 1}"] for k in range(4)], axis=1) if spacecraft else None
    with reports.name_in_errors(result.folder / "scenario.toml"):
        law = result.scenario["controller"]
        marks = {"t_f": float(law["t_f"])}
        delta = float(law.get("delta", 0.0))
    if delta >= 0.05 * t[-1]:  # otherwise the labels of t_f - delta and t_f overlap
        marks["t_f - delta"] = marks["t_f"] - delta
    caption = "Drag to zoom, double-click to see all; the dotted lines are the hand-over and t_f."
    charts: list[Block] = [Chart("history", page_charts.history(columns, spacecraft, marks), caption, "tall")]
    if q is not None:
        caption = "The body and its axes over time; dashed: the inertial axes. Drag to turn the view."
        charts.append(Chart("attitude", page_charts.attitude(t, q), caption, "square"))
    return charts


def _search_chart(result: Result) -> Chart:
    """Return the chart of a search."""
    caption = "The objective along the local search from each starting point; a hollow point breaks a limit."
    with reports.name_in_errors(result.folder / "scenario.toml"):
        tune = result.scenario.get("tune", {})
        objective = Tune(**{key: tune[key] for key in ("minimise", "statistic", "level") if key in tune})
        display = objective_display(objective_name(objective), objective.minimise, result.plant)
    with reports.name_in_errors(result.folder / TABLES["tune"]):
        head, *rows = _read_rows(result.folder / TABLES["tune"])
        points = [dict(zip(head, row, strict=True)) for row in rows]
        return Chart("search", page_charts.search(points, head[3], *display), caption)


def _front_chart(result: Result) -> Chart:
    """Return the chart of a front of error against torque."""
    caption = "Hover over a point for its gains. Bars are 95 % intervals; the dashed line is the required limit."
    with reports.name_in_errors(result.folder / "scenario.toml"):
        requirement = result.scenario.get("requirements", {}).get("peak_torque")
    limit = requirement.get("limit") if isinstance(requirement, dict) else requirement
    with reports.name_in_errors(result.source):
        return Chart("front", page_charts.front(front.read(result.summary), limit), caption)


def _charts(result: Result) -> dict[str, list[Block]]:
    """Return the charts and the table that only the page shows, by the titles of their sections."""
    command = result.versions["command"]
    if command == "simulate":
        with reports.name_in_errors(result.source):
            trial = reports.drawn_table(summaries.run(result.summary))
        charts: dict[str, list[Block]] = {"History": _history_charts(result)}
        return {**charts, "Trial": [trial]} if trial.rows else charts
    if command == "tune":
        return {"Search": [_search_chart(result)]}
    if command == "montecarlo":
        with reports.name_in_errors(result.folder / "scenario.toml"):
            return {"Gains": [campaign_report.gain_table(result.scenario, result.plant)]}
    if command == "compare":
        with reports.name_in_errors(result.source):
            return compare_report.charts(summaries.read(summaries.Compare, result.summary).laws)
    if command == "pareto" and result.summary["against"] == "torque":
        return {front.KINDS["torque"].title: [_front_chart(result)]}
    return {}


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
        pictures.append(Picture(path.stem.replace("_", " "), source, CAPTIONS.get(path.stem, "")))
    if pictures:
        yield Section("Figures", pictures)


def _origin_sections(result: Result) -> Iterator[Section]:
    """Return the sections with the scenario, the command line, and the versions."""
    versions = result.versions
    path = result.folder / "scenario.toml"
    if path.exists():
        note = SCENARIO_NOTES.get(versions["command"], "")
        yield Section("Scenario", [Code(path.read_text(encoding="utf-8"), note)])
    command_line = versions.get(store.COMMAND_LINE, "")
    yield Section("How to make this again", [Code(command_line, "In the folder where it was called.")])
    rows = [(name, json.dumps(value) if not isinstance(value, str) else value) for name, value in versions.items()]
    yield Section("Made by", [Table(("", "version"), rows)])
