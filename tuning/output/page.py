"""`ptsmc report`: a result folder as one page of HTML that needs nothing else and runs nothing that a user typed.

Made from the files in the folder alone. The page's policy allows its own two scripts, known by their digests, and
nothing from elsewhere; every text is escaped.
"""

import base64
import csv
import hashlib
import json
import os
import sys
from collections.abc import Callable, Iterable, Iterator
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np

from ptsmc_jax.campaigns import store
from ptsmc_jax.campaigns.store import RefusedError
from ptsmc_jax.scenario import parsing
from tuning.errors import UsageError
from tuning.output import (
    campaign_sentences,
    cells,
    front_sentences,
    law_sentences,
    margin_sentences,
    page_captions,
    page_charts,
    pointing_sentences,
    search_sentences,
    sentences,
)
from tuning.output.page_parts import Block, Heading, Result, Section
from tuning.studies import front

HERE = Path(__file__).parent
FILES = ("versions.json", store.SUMMARY, "scenario.toml", "trajectory.csv", "history.csv", "map.csv")  # that are read
PNG = b"\x89PNG\r\n\x1a\n"  # how such a file begins


def read(folder: Path) -> Result:
    """A result folder. Raises RefusedError where it holds no finished result."""
    if not folder.is_dir():
        raise RefusedError(f"{folder} is no folder; allowed is one that a ptsmc command left")
    for name in FILES:
        if _leads_out(folder, folder / name):
            raise RefusedError(f"{folder / name} is a link out of the folder; allowed is a file in it")
    versions = store.read_versions(folder)
    command = versions.get("command")
    if str(command) not in SECTIONS:
        raise RefusedError(f"{folder} holds no result; allowed is a folder that a ptsmc command left")
    try:
        summary = json.loads((folder / store.SUMMARY).read_text(encoding="utf-8")) if command != "map" else {}
        path = folder / "scenario.toml"
        scenario = parsing.toml(path.read_text(encoding="utf-8"), str(path)) if path.exists() else {}
    except FileNotFoundError:
        raise _unfinished(folder, versions) from None
    except (ValueError, RecursionError) as error:
        raise RefusedError(f"{folder} holds a file that cannot be read: {error}") from None
    return Result(folder, versions, summary, scenario)


def _leads_out(folder: Path, path: Path) -> bool:
    """Whether a path of a result folder is, or lies behind, a link to a place outside the folder."""
    # unlike Path.resolve it does not raise for a link to itself
    return not Path(os.path.realpath(path)).is_relative_to(os.path.realpath(folder))


def _unfinished(folder: Path, versions: dict[str, Any]) -> RefusedError:
    said = f"{folder} holds a {versions['command']} that is not finished"
    return RefusedError(f"{said}; run the same command to its end")


def build(folder: Path) -> str:
    """The page of a result folder. Raises RefusedError where there is none, UsageError without plotly or jinja2."""
    result = read(folder)
    try:
        from jinja2 import Environment
        from markupsafe import Markup
        from plotly.offline import get_plotlyjs
    except ImportError as error:
        raise UsageError(f"the page needs {error.name}: pip install 'ptsmc-jax[report]'") from None
    try:
        heading, sections = SECTIONS[result.versions["command"]](result)
    except FileNotFoundError:
        raise _unfinished(folder, result.versions) from None
    except KeyError as error:
        by = result.versions.get("ptsmc-jax")
        raise RefusedError(f"{folder} lacks {error}, as results of another version do ({by}); make it again") from None
    except (csv.Error, IndexError, ValueError) as error:  # a table that is cut
        raise RefusedError(f"{folder} holds a file that cannot be read: {error}") from None
    sections = [*sections, *_pictures(result), *_origin(result)]
    drawing = (HERE / "page.js").read_text(encoding="utf-8")
    library = get_plotlyjs() if result.charts else ""
    scripts = " ".join(f"'sha256-{_digest(script)}'" for script in (library, drawing)) if result.charts else "'none'"
    # no < in the data: nothing in it can end its element
    charts = json.dumps(result.charts, allow_nan=False, separators=(",", ":")).replace("<", "\\u003c")
    environment = Environment(autoescape=True, trim_blocks=True, lstrip_blocks=True)
    template = environment.from_string((HERE / "page.html").read_text(encoding="utf-8"))
    return template.render(
        title=f"ptsmc {result.versions['command']}: {folder.resolve().name}",
        verdict=heading,
        sections=sections,
        policy=Markup(f"default-src 'none'; img-src data: blob:; style-src 'unsafe-inline'; script-src {scripts}"),
        style=Markup((HERE / "page.css").read_text(encoding="utf-8")),
        charts=Markup(charts) if result.charts else "",
        library=Markup(library),
        drawing=Markup(drawing),
    )


def _digest(script: str) -> str:
    return base64.b64encode(hashlib.sha256(script.encode("utf-8")).digest()).decode("ascii")


def _table(table: cells.Table, note: str = "") -> Block:
    # the last column contains numbers, or words, units or marks; marks have no heading
    numbers = bool(table.head[-1]) and all(row[-1][:1] in "-0123456789" for row in table.rows)
    return Block("table", head=table.head, rows=table.rows, note=note, shape="numbers" if numbers else "")


def _text(lines: Iterable[str]) -> Block:
    return Block("text", lines=[line.strip() for line in lines])


def _limits(verdicts: list[dict[str, Any]]) -> list[Section]:
    """Each requirement as a bar on its limit, and in words."""
    if not verdicts:
        return []
    bars = []
    for verdict in verdicts:
        bars.append({
            "label": verdict["metric"].replace("_", " "), "text": sentences.verdict(verdict) + _distance(verdict),
            "met": verdict["met"], "limit": 300, "width": round(min(400.0, 300.0 * _nearness(verdict)), 1),
        })  # fmt: skip
    note = "The line is the limit; a bar that ends before it keeps the limit."
    return [Section("Requirements", [Block("bars", bars=bars, note=note)])]


def _verdict(summary: dict[str, Any], lines: Iterable[str], requirements: bool) -> Heading:
    status = summary["status"]
    headline = {
        "met": "Every requirement is met" if requirements else "Every trial ended well; nothing was required",
        "not met": "NOT every requirement is met" if requirements else "NOT every trial ended well",
        "interrupted": "Interrupted: the best so far",
        "unfinished": "NOT finished",
        "ok": "The run ended well; nothing was required",
    }.get(status, f"The run failed: {status}")
    lines = [*lines, *sentences.cautions(summary)]
    mood = {"met": "good", "ok": "calm"}.get(status, "bad")
    return Heading(mood if requirements or mood == "bad" else "calm", headline, lines)


def _simulate(result: Result) -> tuple[Heading, list[Section]]:
    summary, spacecraft = result.summary, result.kind == "spacecraft"
    verdicts = sentences.run_verdicts(summary, result.kind)
    if summary["status"] == "ok" and verdicts:
        summary = {**summary, "status": "met" if all(v["met"] for v in verdicts) else "not met"}
    lines = [*sentences.run_lines(result.summary), *map(sentences.verdict, verdicts)]
    columns = page_charts.read(result.folder / "trajectory.csv")
    law = result.scenario["controller"]
    marks = {"t_f": law["t_f"], **({"t_f - delta": law["t_f"] - law["delta"]} if "delta" in law else {})}
    if "delta" in law and law["delta"] < 0.05 * columns["t"][-1]:  # the labels would lie on each other
        del marks["t_f - delta"]
    drawn = page_charts.history(columns, spacecraft, marks)
    caption = "Drag to zoom, double-click to see all; dotted are the hand-over and t_f."
    charts = [result.chart("history", drawn, caption, "tall")]
    if spacecraft:
        q = np.stack([columns[f"q{k + 1}"] for k in range(4)], axis=1)
        caption = "The body with its axes as it turns; dashed: the inertial axes. Drag to look from elsewhere."
        charts.append(result.chart("attitude", page_charts.attitude(columns["t"], q), caption, "square"))
    sections = [*_limits(verdicts), Section("Metrics", [_table(sentences.run(result.summary, result.kind))])]
    return _verdict(summary, lines, bool(verdicts)), [*sections, Section("History", charts)]


def _tune(result: Result) -> tuple[Heading, list[Section]]:
    summary = result.summary
    gains = ", ".join(f"{name} {value:.6g}" for name, value in summary["gains"].items())
    farthest = max(summary["verdicts"], key=_nearness, default=None)
    lines = [f"tuned gains: {gains}", *sentences.accuracy(summary)]
    if farthest is not None:
        lines.insert(1, sentences.verdict(farthest) + _distance(farthest))
    with (result.folder / "history.csv").open(newline="", encoding="utf-8") as file:
        rows = list(csv.DictReader(file))
    goal = list(rows[0])[2]
    caption = "The way of every start to the optimum next to it, by slopes; a hollow point breaks a limit."
    said_of = (search_sentences.advice, search_sentences.search, search_sentences.trust, search_sentences.shortest)
    trust = _text(line for lines_of in said_of for line in lines_of(summary))
    sections = [
        *_limits(summary["verdicts"]),
        Section("Gains", [_table(sentences.tuning(summary), sentences.tuning_heading(summary).capitalize() + ".")]),
        Section("Can the result be trusted?", [trust]),
        Section("Search", [result.chart("search", page_charts.search(rows, goal), caption)]),
    ]
    return _verdict(summary, lines, bool(summary["verdicts"])), sections


def _nearness(verdict: dict[str, Any]) -> float:
    """How near a verdict comes to its limit, 1 at it; infinite where a trial has no value."""
    margin = verdict["margin"]
    return float("inf") if margin is None or margin != margin else margin


def _distance(verdict: dict[str, Any]) -> str:
    """How far what decides a verdict is from its limit: the largest value, or that of the share that is asked for."""
    margin = verdict["margin"]
    if margin is None or margin != margin or verdict.get("at_least") or verdict["limit"] == 0.0:
        return ""
    if verdict.get("share_of_time") is not None:
        return f"; beyond the limit for {sentences.ratio(100 * margin)} % of the time that it may be"
    share = f"{sentences.ratio(100 * margin)} % of the limit"
    if verdict.get("quantile") is None or verdict["trials"] == 1:
        return f"; {'the worst' if verdict['trials'] > 1 else 'that'} is {share}"
    return f"; the trial that decides is at {margin * verdict['limit']:.4g}, {share}"


def _pareto(result: Result) -> tuple[Heading, list[Section]]:
    found = front.read(result.summary)
    blocks = [_table(front_sentences.results(found)), _text(front_sentences.remarks(found)),
              _table(front_sentences.gains(found))]  # fmt: skip
    if found.against == "torque":
        caption = "Hover over a point for its gains. Bars are 95 % intervals; the dashed line is the required limit."
        requirement = result.scenario.get("requirements", {}).get("peak_torque")
        limit = requirement.get("limit") if isinstance(requirement, dict) else requirement
        blocks.insert(0, result.chart("front", page_charts.front(found, limit), caption))
    lines = [*front_sentences.answers(found), front_sentences.heading(found)]
    heading = _verdict(result.summary, lines, bool(found.requirements))
    if found.requirements:
        met, points = sum(point.meets for point in found.kept), len(found.kept)
        heading = replace(heading, headline=f"{met} of {points} points meet every requirement")
    return heading, [Section(front.KINDS[found.against].title, blocks)]


def _compare(result: Result) -> tuple[Heading, list[Section]]:
    summary = result.summary
    lines = [
        law_sentences.alike(summary),
        law_sentences.winner(summary),
        *sentences.cautions(summary),
    ]
    headline = {
        "met": "The paper's law, tuned, meets every requirement",
        "not met": "The paper's law, tuned, does NOT meet every requirement",
    }.get(summary["status"], "Interrupted: the best so far")
    sections = [
        Section(answer.title, [result.chart(f"question_{k}", answer.chart, answer.note), _table(answer.table)])
        for k, answer in enumerate(law_sentences.answers(summary))
    ]
    sections.append(Section("Gains", [_text(law_sentences.lines(summary))]))
    return Heading("good" if summary["status"] == "met" else "bad", headline, lines), sections


def _montecarlo(result: Result) -> tuple[Heading, list[Section]]:
    summary = result.summary
    note = (
        "Quantiles lie between order statistics, with 95 % intervals (-: beyond every trial, since so many fail or "
        "never settle, or so few are flown); a failed trial is beyond every quantile."
    )
    larger = (
        "Shares of time within a limit, of which more is better: what 99.73 % of the trials reach, and the smallest. A "
        "failed trial counts as 0."
    )
    tables = campaign_sentences.quantiles(summary)
    quantiles = [_table(table, said) for table, said in zip(tables, (note, larger), strict=False)]
    sections = [
        *_limits(summary["verdicts"]),
        Section("Metrics", [*quantiles, _text(campaign_sentences.drivers(summary))]),
        Section("Gains", [_table(campaign_sentences.flown_gains(result.scenario, result.kind))]),
    ]
    pointing = [_table(table) for table in pointing_sentences.tables(summary)]
    if pointing:
        sections.insert(-1, Section("Pointing", [_text(pointing_sentences.heading(summary)), *pointing]))
    lines = [*campaign_sentences.counts(summary), *campaign_sentences.error(summary)]
    return _verdict(summary, lines, bool(summary["verdicts"])), sections


def _map(result: Result) -> tuple[Heading, list[Section]]:
    with (result.folder / "map.csv").open(newline="", encoding="utf-8") as file:
        rows = list(csv.reader(file))
    head = tuple(sentences.with_unit(name, result.kind) for name in rows[0])
    table = cells.Table(head, [tuple(map(cells.short, row)) for row in rows[1:]])
    pairs = [dict(zip(("x", "y", *rows[0][2:]), map(cells.number, row), strict=True)) for row in rows[1:]]
    first, *others = sentences.grid(pairs, (rows[0][0], rows[0][1]), result.kind)
    heading = Heading("calm", first[0].upper() + first[1:], others)
    return heading, [Section("Pairs", [_table(table, page_captions.MAP)])]


def _margins(result: Result) -> tuple[Heading, list[Section]]:
    summary = result.summary
    lines = list(margin_sentences.lines(summary, with_least=False))
    if summary.get("open"):
        why = ": a limit of the actuators cuts the command" if summary.get("cut", True) else " in the sample looked at"
        heading = Heading("bad", f"The nominal loop is open in the hold phase{why}", lines)
    elif summary["stable"] and any(loop["judged"] and not loop["stable"] for loop in summary["before"]):
        said = (
            "The nominal loop is stable in the hold phase, but in the approach phase, with its gains frozen, it is NOT"
        )
        heading = Heading("bad", f"{said}: {margin_sentences.left(summary)}", lines)
    elif summary["stable"]:
        heading = Heading("calm", f"The nominal loop is stable: {margin_sentences.left(summary)}", lines)
    else:
        heading = Heading("bad", "The nominal loop is NOT stable in the hold phase", lines)
    return heading, [Section("Margins", [_table(margin_sentences.table(summary))])]


def _reproduce(result: Result) -> tuple[Heading, list[Section]]:
    summary = result.summary
    counted = ", ".join(f"{count}: {word}" for word, count in summary["verdicts"].items())
    sections = [
        Section("Claims of the paper", [_table(sentences.claims(summary))]),
        Section("Slips of the paper, and what shows them", [_table(sentences.slips(summary))]),
    ]
    held, claims = summary["verdicts"].get("holds", 0), len(summary["claims"])
    return Heading("calm", f"{held} of {claims} claims of the paper hold as they are written", [counted]), sections


SECTIONS: dict[str, Callable[[Result], tuple[Heading, list[Section]]]] = {
    "simulate": _simulate,
    "tune": _tune,
    "pareto": _pareto,
    "compare": _compare,
    "montecarlo": _montecarlo,
    "map": _map,
    "margins": _margins,
    "reproduce": _reproduce,
}


def _pictures(result: Result) -> Iterator[Section]:
    """The figures of the folder."""
    blocks = []
    for path in sorted((result.folder / "figures").glob("*.png")):
        out = _leads_out(result.folder, path)
        content = path.read_bytes() if path.is_file() and not out else b""
        if not content.startswith(PNG):
            why = "is a link out of the folder" if out else "is no PNG file"
            print(f"ptsmc: {path} {why}, and is not in the page", file=sys.stderr)
            continue
        source = "data:image/png;base64," + base64.b64encode(content).decode("ascii")
        name = path.stem.replace("_", " ")
        blocks.append(Block("picture", alt=name, source=source, caption=page_captions.CAPTIONS.get(path.stem, "")))
    if blocks:
        yield Section("Figures", blocks)


def _origin(result: Result) -> Iterator[Section]:
    """The scenario, how to make the result again, and what made it."""
    versions = result.versions
    path = result.folder / "scenario.toml"
    if path.exists():
        note = page_captions.SCENARIO.get(versions["command"], "")
        yield Section("Scenario", [Block("code", text=path.read_text(encoding="utf-8"), note=note)])
    call = versions.get(store.COMMAND_LINE, "")
    yield Section("How to make this again", [Block("code", text=call, note="In the folder where it was called.")])
    rows = [(name, json.dumps(value) if not isinstance(value, str) else value) for name, value in versions.items()]
    yield Section("Made by", [_table(cells.Table(("", "version"), rows))])
