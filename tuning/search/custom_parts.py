"""Custom code that scenarios name: parts, metrics and controllers in C. Read `allow_scenario` first.

A simulation runs custom code, but reading a scenario does not. Commands report every file that they run for a scenario.
If a scenario is inside a folder of results, its code runs only with `--trust`, and only if its checksum is unchanged.
This is a reminder and no protection. The sender of the results can change `versions.json`, which marks a folder of
results and contains the checksums.
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
from ptsmc_jax.scenario import custom, systems
from ptsmc_jax.scenario.tables import Scenario

METRICS, CONTROLLER = "--metrics", custom.CONTROLLER_OPTION  # options that name custom code


def list_custom_code(scenario: Scenario, metrics: str | None = None, controller: Path | None = None) -> dict[str, str]:
    """Return the location of all custom code that a simulation of a scenario runs, by key or option.

    Args:
        scenario: the scenario.
        metrics: value of the option `--metrics`, or None.
        controller: value of the option `--controller`, or None.
    """
    options = {METRICS: metrics, CONTROLLER: controller}
    return custom.code_by_key(scenario) | {key: str(where) for key, where in options.items() if where is not None}


def location(key: str, where: str) -> str:
    """Return the path of the file with custom code, or the name of its module; key: scenario key or option."""
    return os.path.realpath(where) if key in (CONTROLLER, custom.DATA_FILE_KEY) else systems.location(where)


def checksum(key: str, where: str) -> str | None:
    """Return the present SHA-256 checksum of the code or the data file, or None if it is in no file."""
    if key == custom.DATA_FILE_KEY:
        return systems.sha256(where)
    return sources.checksum(Path(where)) if key == CONTROLLER else systems.checksum(where)


def allow_scenario(path: Path, scenario: Scenario, trusted: bool) -> None:
    """Report the custom code that a scenario file names, and check that it may run.

    Args:
        path: path of the scenario file.
        scenario: the scenario.
        trusted: whether the user gave `--trust`. It matters only inside a folder of results.

    Raises:
        RefusedError: See `allow_results`. It is raised only inside a folder of results.
    """
    programs, folder = list_custom_code(scenario), find_results_folder(path)
    if folder is None:
        _report_custom_code(programs, path)
    else:
        allow_results(programs, path, store.read_versions(folder), trusted)


def allow_results(programs: Mapping[str, str], results: Path, versions: Mapping[str, object], trusted: bool) -> None:
    """Report the custom code that results name, and check that it may run.

    Args:
        programs: locations of the code, see `list_custom_code`.
        results: folder or scenario file that names the code.
        versions: content of the `versions.json` of the results.
        trusted: whether the user gave `--trust`.

    Raises:
        RefusedError: The user did not give `--trust`, or the checksum of some code has changed.
    """
    if programs and not trusted:
        listed = " and ".join(f"{file} ({', '.join(keys)})" for file, keys in _group_by_file(programs).items())
        raise RefusedError(
            f"{results} names custom code, {listed}, which this command would run; "
            "read the code, then repeat the command with --trust"
        )
    unknown = check_unchanged(programs, results, versions)
    _report_custom_code(programs, results)
    for file in _group_by_file({key: programs[key] for key in unknown}):
        print(f"ptsmc: {results} has no checksum of {file}, which may have changed since", file=sys.stderr)


def check_unchanged(programs: Mapping[str, str], results: Path, versions: Mapping[str, object]) -> list[str]:
    """Check that custom code has the checksums that results contain.

    Args:
        programs: locations of the code, see `list_custom_code`.
        results: folder or scenario file that names the code.
        versions: content of the `versions.json` of the results.

    Returns:
        Keys of the code without a checksum in the results.

    Raises:
        RefusedError: The checksum of some code has changed.
    """
    unknown = []
    for key, where in programs.items():
        known, now = _known_checksums(versions, key), checksum(key, where)
        if not known:
            unknown.append(key)
        elif now is not None and now not in known:
            earlier = " or ".join(was[:12] for was in known)
            raise RefusedError(
                f"{results} was made with another {key}: {location(key, where)} had the SHA-256 {earlier} then, and "
                f"has {now[:12]} now; restore the earlier content of the file"
            )
    return unknown


def _known_checksums(versions: Mapping[str, object], key: str) -> list[str]:
    """Return the known checksums of custom code, a list without repetitions.

    A comparison has a checksum for each of its laws, under the same key.
    """
    laws = versions.get("custom_laws") if key == "controller.code" else None
    checksums = (versions.get(custom.checksum_name(key)), *(laws.values() if isinstance(laws, dict) else ()))
    return list(dict.fromkeys(map(str, filter(None, checksums))))


def copy_custom_files(tables: dict[str, Any], folder: Path) -> dict[str, Any]:
    """Copy the Python and data files of a scenario into a folder, and refer to the copies in its tables.

    The function does not copy modules and files that need other files, see `is_self_contained`. It changes and returns
    the tables.
    """
    for table, key in custom.find_code_keys(tables):
        place, _, name = table[key].rpartition(":")
        if place.endswith(".py") and is_self_contained(Path(place)):
            table[key] = f"{_copy_file(Path(place), folder).name}:{name}"
    for table in custom.find_data_tables(tables):
        table["file"] = _copy_file(Path(table["file"]), folder).name
    return tables


def _copy_file(file: Path, folder: Path) -> Path:
    """Return a copy of a file in a folder, with a number in its name if another file has the name."""
    content = file.read_bytes()
    copies = (folder / (file.name if k == 1 else f"{file.stem}_{k}{file.suffix}") for k in itertools.count(1))
    copy = next(one for one in copies if not one.exists() or one.read_bytes() == content)
    copy.write_bytes(content)
    return copy


def is_self_contained(file: Path) -> bool:
    """Return whether a copy of a Python file can run: it imports nothing from its folder and uses no `__file__`."""
    try:
        nodes = ast.walk(ast.parse(file.read_bytes()))
        uses_own_path = any(isinstance(node, ast.Name) and node.id == "__file__" for node in nodes)
    except (OSError, ValueError, SyntaxError, RecursionError):
        return False
    return not uses_own_path and len(systems.list_imported_files(file, file.parent)) == 1


def _report_custom_code(programs: Mapping[str, str], source: Path) -> None:
    """Print to stderr which existing files of custom code the command runs.

    Args:
        programs: place of the code, by the key of the scenario.
        source: the file that has the keys.
    """
    for file, keys in _group_by_file(programs).items():
        if os.path.isabs(file) and not os.path.exists(file):
            continue  # the command refuses an absent file
        *first, last = keys
        name = f"{', '.join(first)} and {last} of {source} name" if first else f"{last} of {source} names"
        print(f"ptsmc: runs {file}, which {name}", file=sys.stderr)


def _group_by_file(programs: Mapping[str, str]) -> dict[str, list[str]]:
    """Return the list of keys that name each file, by the path of the file."""
    files: dict[str, list[str]] = {}
    for key, where in programs.items():
        files.setdefault(location(key, where), []).append(key)
    return files


def find_results_folder(scenario: Path) -> Path | None:
    """Return the nearest folder of results above a scenario file, or None.

    The folders above the path as given come first, then those above the path with symbolic links resolved.
    """
    paths = Path(os.path.abspath(scenario)), Path(os.path.realpath(scenario))
    folders = (folder for path in paths for folder in path.parents)
    return next((folder for folder in folders if (folder / "versions.json").exists()), None)
