"""What `tune`, `pareto` and `compare` share: a long search that is shown again, gone on with, or begun."""

import sys
from collections.abc import Callable
from pathlib import Path
from typing import TYPE_CHECKING, Any

from tuning.cli.options import INTERRUPTED
from tuning.output import terminal

if TYPE_CHECKING:
    from ptsmc_jax.scenario.tables import Scenario

STATUS = {"met": 0, "not met": 1, "interrupted": INTERRUPTED}  # of the exit


def with_tune(scenario: "Scenario") -> "Scenario":
    """The scenario with a `tune` table, the default one where it has none."""
    from ptsmc_jax.scenario import replace

    return scenario if scenario.tune is not None else replace(scenario, tune={})


def run(
    loaded: "Scenario",
    folder: Path,
    known_by: dict[str, Any],
    force: bool,
    quiet: bool,
    goal: str,
    *,
    work: Callable[..., Any],
    write: Callable[[Path, Any], None],
    summary: Callable[[Any], dict[str, Any]],
    shown: Callable[[dict[str, Any], Path, str], None],
    check: Callable[[], Any] = lambda: None,
) -> int:
    """A long search: shown again if it was done before, gone on with if it was interrupted. Returns the exit status.

    check: what it refuses besides the scenario, before a folder is begun.
    """
    from ptsmc_jax.campaigns import store
    from ptsmc_jax.scenario import parsing, study

    tables = parsing.dump(loaded)
    done = None if force else store.previous(folder, tables, known_by)
    if done is not None and done["status"] != "interrupted":
        if not quiet:
            shown(done, folder, "already done")
        return STATUS[done["status"]]
    going_on = not force and store.begun(folder, tables, known_by)
    if not going_on:
        store.check(folder, force)
    study(loaded)  # what it refuses, it refuses before the search
    check()
    from tuning.search.journal import Journal

    journal = Journal(store.begin(folder, tables, known_by, fresh=not going_on))
    try:
        with terminal.Progress(quiet, goal) as report:
            found = work(report, journal)
    except KeyboardInterrupt:
        print("ptsmc: interrupted; the same command goes on from here", file=sys.stderr)
        return STATUS["interrupted"]
    store.write(folder, lambda making: write(making, found))
    if found.status != "interrupted":
        store.end(folder)
    if not quiet:
        shown(summary(found), folder, "interrupted" if found.status == "interrupted" else "done")
    return STATUS[found.status]
