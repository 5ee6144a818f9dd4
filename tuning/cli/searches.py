"""Start, resume or show again the long searches of `tune`, `pareto` and `compare`."""

import contextlib
import sys
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Any

from tuning.cli import INTERRUPTED
from tuning.cli.options import how_to_resume, resumable
from tuning.output import terminal
from tuning.output.progress import Progress

if TYPE_CHECKING:
    from ptsmc_jax.scenario.tables import Scenario
    from tuning.search.journal import Journal

COMMANDS = ("tune", "pareto", "compare")
STATUS = {"met": 0, "not met": 1, "interrupted": INTERRUPTED}  # exit status


@dataclass(frozen=True)
class LongSearch:
    """A search that takes minutes to hours."""

    identity: dict[str, Any]  # entries of versions.json that identify it, see `store.begin_run`
    objective: str  # name of the objective in the progress
    work: Callable[[Progress, "Journal"], Any]  # runs the search; its result has a `status`
    write: Callable[[Path, Any], None]  # writes the result into a result folder
    check: Callable[[], object] = lambda: None  # raises configuration errors before a search, not before its result


def warn_about_seed(scenario: Path, seed: int) -> None:
    """Print a warning if a search found the gains of a scenario with the trials of this seed."""
    from ptsmc_jax.campaigns import store
    from tuning.search import custom_parts

    folder = custom_parts.find_results_folder(scenario)
    versions = {} if folder is None else store.read_versions(folder)
    if versions.get("command") in COMMANDS and versions.get("seed") == seed:
        print(
            f"ptsmc: {versions['command']} found the gains of {scenario} with the same trials of seed {seed}; use "
            "another --seed to verify them",
            file=sys.stderr,
        )


def run(search: LongSearch, loaded: "Scenario", folder: Path, *, force: bool, quiet: bool) -> int:
    """Show a finished search, resume an interrupted one, or begin a new one.

    Args:
        search: the search to run.
        loaded: the scenario.
        folder: the result folder.
        force: whether to begin a new search even if the folder has a finished or interrupted one.
        quiet: whether to print nothing but warnings and errors.

    Returns:
        The exit status of the command, see `STATUS`.
    """
    from ptsmc_jax.campaigns import store
    from ptsmc_jax.scenario import parsing, study

    tables = parsing.dump(loaded)
    summary = None if force else store.read_previous_summary(folder, tables, search.identity)
    was_finished = summary is not None and summary["status"] != "interrupted"
    if was_finished:
        difference = store.describe_difference(folder, tables, store.packages())
        if difference is not None:
            print(f"ptsmc: {folder} holds {difference}; --force runs it again", file=sys.stderr)
    else:
        with store.lock_folder(folder):
            is_resumed = not force and store.has_unfinished_run(folder, tables, search.identity)
            if not is_resumed:
                store.check_folder(folder, force)
            study(loaded)  # raises configuration errors before the search
            search.check()
            from tuning.search.journal import Journal

            journal = Journal(store.begin_run(folder, tables, search.identity, fresh=not is_resumed))
            with resumable(force):
                with Progress(quiet, search.objective, loaded.plant.kind) as report:
                    outcome = search.work(report, journal)
                store.write_folder(folder, lambda staging: search.write(staging, outcome))
            if outcome.status != "interrupted":
                store.end_run(folder)
            else:
                print(f"ptsmc: interrupted; {how_to_resume(force)}", file=sys.stderr)
        summary = store.read_previous_summary(folder, tables, search.identity)
    assert summary is not None
    from tuning.output import reports

    # only an earlier summary may be damaged
    with reports.name_in_errors(folder / store.SUMMARY) if was_finished else contextlib.nullcontext():
        status = STATUS[summary["status"]]
        result = reports.build(search.identity["command"], summary, loaded.plant.kind)
    if not quiet:
        terminal.print_report(result, folder, earlier=was_finished)
    return status
