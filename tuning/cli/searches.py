"""What `tune`, `pareto` and `compare` share: a long search that is shown again, gone on with, or begun."""

import importlib
import sys
import threading
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
STATUS = {"met": 0, "not met": 1, "interrupted": INTERRUPTED}  # of the exit


@dataclass(frozen=True)
class LongSearch:
    """A search that takes minutes to hours: what does it, and how its outcome is kept and shown."""

    known_by: dict[str, Any]  # what tells it from others in a folder, see `store.begin`
    goal: str  # what the progress says is minimised
    work: Callable[[Progress, "Journal"], Any]  # searches; what it returns has a `status`
    write: Callable[[Path, Any], None]  # fills a result folder with that outcome
    summary: Callable[[Any], dict[str, Any]]  # what `summary.json` says of it
    report: Callable[[dict[str, Any]], "Report"]  # of such a summary
    check: Callable[[], Any] = lambda: None  # raises what is refused besides the scenario, before a folder is begun
    needs: tuple[str, ...] = ()  # modules that take long to import, and only what follows the first steps needs


def say_seen(scenario: Path, seed: int) -> None:
    """Say so where a search found the gains of a scenario with the very trials of this seed, which prove nothing."""
    from ptsmc_jax.campaigns import store
    from tuning.search import own_parts

    folder = own_parts.results_of(scenario)
    made = {} if folder is None else store.read_versions(folder)
    if made.get("command") in COMMANDS and made.get("seed") == seed:
        print(
            f"ptsmc: {made['command']} found the gains of {scenario} with trials of seed {seed}, which are flown "
            "again: for a proof give another --seed",
            file=sys.stderr,
        )


def with_tune(scenario: "Scenario") -> "Scenario":
    """The scenario with a `tune` table, the default one where it has none. Raises ScenarioError without any gain."""
    from ptsmc_jax.scenario import free_gains, replace

    scenario = scenario if scenario.tune is not None else replace(scenario, tune={})
    free_gains.need_some(scenario)
    return scenario


def run(search: LongSearch, loaded: "Scenario", folder: Path, *, force: bool, quiet: bool) -> int:
    """A long search: shown again if it was done before, gone on with if it was interrupted. Returns the exit status."""
    from ptsmc_jax.campaigns import store
    from ptsmc_jax.scenario import parsing

    tables = parsing.dump(loaded)
    done = None if force else store.previous(folder, tables, search.known_by)
    if done is not None and done["status"] != "interrupted":
        other = store.difference(folder, tables, store.packages())
        if other is not None:
            print(f"ptsmc: {folder} holds {other}; --force runs it again", file=sys.stderr)
        if not quiet:
            terminal.show(search.report(done), folder, "already done")
        return STATUS[done["status"]]
    with store.in_use(folder):
        return _run(search, loaded, folder, force=force, quiet=quiet)


def _run(search: LongSearch, loaded: "Scenario", folder: Path, *, force: bool, quiet: bool) -> int:
    """Begin or resume a search in a folder that this process has locked. Returns the exit status."""
    from ptsmc_jax.campaigns import store
    from ptsmc_jax.scenario import parsing, study

    tables = parsing.dump(loaded)
    going_on = not force and store.begun(folder, tables, search.known_by)
    if not going_on:
        store.check(folder, force)
    study(loaded)  # what it refuses, it refuses before the search
    search.check()
    from tuning.search.journal import Journal

    journal = Journal(store.begin(folder, tables, search.known_by, fresh=not going_on))

    with resumable(force):
        threading.Thread(target=lambda: [*map(importlib.import_module, search.needs)], daemon=True).start()
        with Progress(quiet, search.goal) as report:
            outcome = search.work(report, journal)
        store.write(folder, lambda making: search.write(making, outcome))
    if outcome.status != "interrupted":
        store.end(folder)
    else:
        print(f"ptsmc: interrupted; {resume_by(force)}", file=sys.stderr)
    if not quiet:
        summary = store.plain(search.summary(outcome))  # as it is read when it is shown again
        terminal.show(search.report(summary), folder)
    return STATUS[outcome.status]
