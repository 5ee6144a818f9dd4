"""Long searches of `tune`, `pareto` and `compare`: begun, resumed, or shown again."""

import sys
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Any

from tuning.cli import INTERRUPTED
from tuning.cli.options import resumable, resume_by
from tuning.output import terminal
from tuning.output.progress import Progress

if TYPE_CHECKING:
    from ptsmc_jax.scenario.tables import Scenario
    from tuning.output.report import Report
    from tuning.search.journal import Journal

COMMANDS = ("tune", "pareto", "compare")
STATUS = {"met": 0, "not met": 1, "interrupted": INTERRUPTED}  # exit status


@dataclass(frozen=True)
class LongSearch:
    """A search that takes minutes to hours."""

    known_by: dict[str, Any]  # entries of versions.json that identify it, see `store.begin`
    objective: str  # name of the objective in the progress
    work: Callable[[Progress, "Journal"], Any]  # runs the search; its result has a `status`
    write: Callable[[Path, Any], None]  # fills a result folder with a result
    report: Callable[[dict[str, Any]], "Report"]  # of the content of summary.json
    check: Callable[[], Any] = lambda: None  # raises configuration errors that the scenario does not have


def say_seen(scenario: Path, seed: int) -> None:
    """Print a warning if a search found the gains of a scenario with the trials of this seed."""
    from ptsmc_jax.campaigns import store
    from tuning.search import custom_parts

    folder = custom_parts.results_of(scenario)
    made = {} if folder is None else store.read_versions(folder)
    if made.get("command") in COMMANDS and made.get("seed") == seed:
        print(
            f"ptsmc: {made['command']} found the gains of {scenario} with the same trials of seed {seed}; use another "
            "--seed to verify them",
            file=sys.stderr,
        )


def run(search: LongSearch, loaded: "Scenario", folder: Path, *, force: bool, quiet: bool) -> int:
    """Show a finished search, resume an interrupted one, or begin a new one. Returns the exit status."""
    from ptsmc_jax.campaigns import store
    from ptsmc_jax.scenario import parsing

    tables = parsing.dump(loaded)
    done = None if force else store.previous(folder, tables, search.known_by)
    earlier = done is not None and done["status"] != "interrupted"
    if earlier:
        other = store.difference(folder, tables, store.packages())
        if other is not None:
            print(f"ptsmc: {folder} holds {other}; --force runs it again", file=sys.stderr)
    else:
        with store.in_use(folder):
            _run(search, loaded, folder, force=force, quiet=quiet)
            done = store.previous(folder, tables, search.known_by)
    assert done is not None
    if not quiet:
        terminal.show(search.report(done), folder, earlier=earlier)
    return STATUS[done["status"]]


def _run(search: LongSearch, loaded: "Scenario", folder: Path, *, force: bool, quiet: bool) -> None:
    """Begin or resume a search in a folder that this process has locked, and write its result."""
    from ptsmc_jax.campaigns import store
    from ptsmc_jax.scenario import parsing, study

    tables = parsing.dump(loaded)
    going_on = not force and store.begun(folder, tables, search.known_by)
    if not going_on:
        store.check(folder, force)
    study(loaded)  # raises configuration errors before the search
    search.check()
    from tuning.search.journal import Journal

    journal = Journal(store.begin(folder, tables, search.known_by, fresh=not going_on))
    with resumable(force):
        with Progress(quiet, search.objective, loaded.plant.kind) as report:
            outcome = search.work(report, journal)
        store.write(folder, lambda making: search.write(making, outcome))
    if outcome.status != "interrupted":
        store.end(folder)
    else:
        print(f"ptsmc: interrupted; {resume_by(force)}", file=sys.stderr)
