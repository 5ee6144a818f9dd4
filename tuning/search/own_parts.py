"""Programs that scenarios name: custom parts and metrics. A simulation runs their code, reading a scenario does not.

Commands report every file that they run for a scenario. If a scenario lies in results, its programs run only with
`--trust`, and not if their recorded checksum has changed. This is a reminder and no protection: whoever sends results
can change or omit the file by which they are recognised, and the checksums too.
"""

import ast
import itertools
import os
import sys
from collections.abc import Mapping
from pathlib import Path
from typing import Any

from ptsmc_jax.campaigns import store
from ptsmc_jax.campaigns.store import RefusedError
from ptsmc_jax.onboard import sources
from ptsmc_jax.scenario import own, systems
from ptsmc_jax.scenario.tables import Scenario

METRICS, CONTROLLER = "--metrics", own.CONTROLLER  # options that name programs


def named(scenario: Scenario, metrics: str | None = None, controller: Path | None = None) -> dict[str, str]:
    """What flying a scenario runs, with metrics of one's own and a controller's C: where it stands, by its key."""
    options = {METRICS: metrics, CONTROLLER: controller}
    return own.programs(scenario) | {key: str(where) for key, where in options.items() if where is not None}


def location(key: str, where: str) -> str:
    """What would be run, as one may look at it."""
    return os.path.realpath(where) if key == CONTROLLER else systems.location(where)


def digest(key: str, where: str) -> str | None:
    """SHA-256 of what would be run, as it is now; None: there is none."""
    return sources.digest(Path(where)) if key == CONTROLLER else systems.digest(where)


def allow_scenario(path: Path, scenario: Scenario, trusted: bool) -> None:
    """Report the programs that a scenario file names, and let them run; in results see `allow`, and its errors."""
    programs, folder = named(scenario), results_of(path)
    if folder is None:
        _report(programs, path)
    else:
        allow(programs, path, store.read_versions(folder), trusted)


def allow(programs: Mapping[str, str], results: Path, made: Mapping[str, Any], trusted: bool) -> None:
    """Report the programs that results name, and let them run.

    Args:
        programs: see `named`.
        results: the folder or the scenario file that names them.
        made: its `versions.json`.
        trusted: whether the user gave --trust.

    Raises:
        RefusedError: without --trust, or if a program is not the one that the results were made with.
    """
    if programs and not trusted:
        listed = " and ".join(f"{file} ({', '.join(keys)})" for file, keys in _by_file(programs).items())
        raise RefusedError(
            f"{results} names code of its own, {listed}, which this command would run; "
            "allowed is --trust, for one who has read it"
        )
    unknown = check_unchanged(programs, results, made)
    _report(programs, results)
    for file in _by_file({key: programs[key] for key in unknown}):
        print(f"ptsmc: {results} has no checksum of {file}, which may have changed since", file=sys.stderr)


def check_unchanged(programs: Mapping[str, str], results: Path, made: Mapping[str, Any]) -> list[str]:
    """Raise RefusedError if a program is not the one that results were made with.

    Returns the keys of the programs whose checksum the results do not have.
    """
    unknown = []
    for key, where in programs.items():
        known, now = _digests(made, key), digest(key, where)
        if not known:
            unknown.append(key)
        elif now is not None and now not in known:
            then = " or ".join(was[:12] for was in known)
            raise RefusedError(
                f"{results} was made with another {key} than {location(key, where)} is now "
                f"(SHA-256 {then} then, {now[:12]} now); allowed is the file as it was"
            )
    return unknown


def _digests(made: Mapping[str, Any], key: str) -> list[str]:
    """What results knew a program by, of a comparison also its laws: each stands under this key in its own scenario."""
    laws = made.get("own_laws") if key == "controller.code" else None
    digests = (made.get(own.digest_name(key)), *(laws.values() if isinstance(laws, dict) else ()))
    return list(dict.fromkeys(map(str, filter(None, digests))))


def carry(tables: dict[str, Any], folder: Path) -> dict[str, Any]:
    """The tables of a scenario, their Python files copied into a folder and named as they lie in it.

    Not a file that needs others, see `alone`, nor a module: these are named where they lie.
    """
    for table, key in own.named(tables):
        place, _, name = table[key].rpartition(":")
        file = Path(place)
        if not place.endswith(".py") or not alone(file):
            continue
        content = file.read_bytes()
        copies = (folder / (file.name if k == 1 else f"{file.stem}_{k}.py") for k in itertools.count(1))
        copy = next(one for one in copies if not one.exists() or one.read_bytes() == content)
        copy.write_bytes(content)
        table[key] = f"{copy.name}:{name}"
    return tables


def alone(file: Path) -> bool:
    """Whether a copy of a Python file can be run: it imports nothing from its own folder, and asks not where it is."""
    try:
        nodes = ast.walk(ast.parse(file.read_bytes()))
        asks = any(isinstance(node, ast.Name) and node.id == "__file__" for node in nodes)
    except (OSError, ValueError, SyntaxError, RecursionError):
        return False
    return not asks and len(systems.imported(file, file.parent)) == 1


def _report(programs: Mapping[str, str], where_named: Path) -> None:
    for file, keys in _by_file(programs).items():
        *first, last = keys
        name = f"{', '.join(first)} and {last} of {where_named} name" if first else f"{last} of {where_named} names"
        print(f"ptsmc: runs {file}, which {name}", file=sys.stderr)


def _by_file(programs: Mapping[str, str]) -> dict[str, list[str]]:
    """The keys that name each file."""
    files: dict[str, list[str]] = {}
    for key, where in programs.items():
        files.setdefault(location(key, where), []).append(key)
    return files


def results_of(scenario: Path) -> Path | None:
    """Return the nearest folder with results above a scenario file, links followed or not; None if there is none."""
    paths = Path(os.path.abspath(scenario)), Path(os.path.realpath(scenario))
    folders = (folder for path in paths for folder in path.parents)
    return next((folder for folder in folders if (folder / "versions.json").exists()), None)
