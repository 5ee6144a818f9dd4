"""Result folders: checks before writing, and files that are complete or absent."""

import contextlib
import csv
import importlib.metadata
import json
import math
import os
import platform
import re
import secrets
import shlex
import shutil
import sys
import time
from collections import Counter
from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from pathlib import Path
from typing import IO, Any

import tomli_w

from ptsmc_jax import provenance, units
from ptsmc_jax.scenario import parsing
from ptsmc_jax.scenario.errors import wrong

try:
    import fcntl
except ImportError:  # Windows has no fcntl
    fcntl = None

JOURNAL = "journal.bin"  # file of an unfinished run
SUMMARY = "summary.json"  # file of a finished run
IDENTITY = (SUMMARY, "versions.json", "scenario.toml")  # files that differ between results
TEMPORARY_PREFIX = ".making-"  # beginning of the names of temporary files and folders
MADE_OF_RESULTS = {  # files made from a result, with a mark near their beginning; other files are the user's and stay
    "figures/*.png": b"Creator\0ptsmc",  # written by `style.save`
    "report.html": b'<meta name="generator" content="ptsmc">',
    "worst.csv": b"trial,status,reason,bad_time,",
    "why.csv": b"metric,trial,value,input,drawn,",
}
CODE, COMMAND_LINE = "code_checksum", "command_line"  # keys of `versions.json`
Tables = Mapping[str, Any]  # tables of a scenario, or of versions.json
PACKAGES = ("ptsmc-jax", "jax", "jaxlib", "numpy", "scipy", "optax")


class RefusedError(ValueError):
    """The command refuses a folder, a file or an option. The text of the error is one sentence."""


class InUseError(RefusedError):
    """Another process is writing into the folder."""


def versions(command: str, seed: int | None, **others: object) -> dict[str, Any]:
    """Return the content of versions.json: command, seed (None: no random numbers), versions, machine."""
    command_line = shlex.join([*(Path(program).name for program in sys.argv[:1]), *sys.argv[1:]])
    return {"command": command, "seed": seed, **others, COMMAND_LINE: command_line, **_environment()}


def _environment() -> dict[str, str]:
    """Return the versions and the machine. An interrupted run resumes only with the same ones."""
    machine = {"platform": platform.platform(), "machine": platform.machine()}
    return {"python": platform.python_version(), **packages(), **machine}


def packages() -> dict[str, str]:
    """Versions of the packages that numbers depend on, and a checksum of the source code of ptsmc."""
    versions = {name: importlib.metadata.version(name) for name in PACKAGES}
    return {**versions, CODE: provenance.code_checksum(*provenance.PACKAGES)[:16]}


def read_versions(folder: Path) -> dict[str, Any]:
    """Return the content of a result's versions.json; empty if it cannot be read."""
    return _read_json(folder / "versions.json")


def _read_json(path: Path) -> dict[str, Any]:
    """Return the object in a JSON file, {} if the file cannot be read or has no object."""
    try:
        content = json.loads(path.read_text(encoding="utf-8"))
    except (OSError, ValueError, RecursionError):
        return {}
    return content if isinstance(content, dict) else {}


def read_previous_summary(folder: Path, scenario: Tables, made_by: Tables) -> dict[str, Any] | None:
    """Return the summary of an earlier run of the same scenario, command, seed and other inputs.

    Args:
        folder: the result folder.
        scenario: tables of the scenario of this run, with all defaults.
        made_by: command, seed and other inputs of this run, see `versions`.

    Returns:
        The content of `summary.json`, or None if the folder has no summary of this run.
    """
    summary = {} if describe_difference(folder, scenario, made_by) else _read_json(folder / SUMMARY)
    return summary if "status" in summary else None


def has_unfinished_run(folder: Path, scenario: Tables, made_by: Tables) -> bool:
    """Return whether the folder contains this run and it is incomplete, see `begin_run`.

    Args:
        folder: the result folder.
        scenario: tables of the scenario of this run, with all defaults.
        made_by: command, seed and other inputs of this run, see `versions`.

    Raises:
        RefusedError: it contains another unfinished run, or one of other versions.
    """
    if not (folder / JOURNAL).exists():
        return False
    refuse_other_run(folder, scenario, {**made_by, **_environment()})
    return True


def refuse_other_run(folder: Path, scenario: Tables, made_by: Tables) -> None:
    """Raise an error if the folder contains another run than this one, see `describe_difference`.

    Args:
        folder: the result folder.
        scenario: tables of the scenario of this run, with all defaults.
        made_by: command, seed and other inputs of this run, see `versions`.

    Raises:
        RefusedError: the folder contains a run of another scenario, command, seed or version.
    """
    other = describe_difference(folder, scenario, made_by)
    if other is not None:
        raise RefusedError(
            f"--out is {folder}, which holds {other}; allowed is a new folder, or --force to start again"
        )


def begin_run(folder: Path, scenario: Tables, made_by: Tables, *, fresh: bool) -> Path:
    """Make the folder of a run that can be resumed; return the path of its journal.

    Args:
        folder: the result folder.
        scenario: tables of the scenario.
        made_by: see `versions`.
        fresh: start again: empty the journal and remove the summary.
    """

    def fill(temporary: Path) -> None:
        write_run_files(temporary, scenario, made_by)
        if fresh:
            (temporary / JOURNAL).touch()
            remove_summary(folder)

    write_folder(folder, fill)
    return folder / JOURNAL


def remove_summary(folder: Path) -> None:
    """Remove the summary of a result and the files made from it, which would not belong to the next result."""
    if not ((folder / SUMMARY).exists() or "command" in read_versions(folder)):
        return
    for pattern, marker in MADE_OF_RESULTS.items():
        for path in folder.glob(pattern):
            with contextlib.suppress(FileNotFoundError, IsADirectoryError):  # another shard may have removed the file
                if marker in path.read_bytes()[:1024]:
                    path.unlink()
    (folder / SUMMARY).unlink(missing_ok=True)


def _is_equal(new: Path, old: Path) -> bool:
    """Return whether two files are equal. The command line in `versions.json` is ignored."""
    if new.name == "versions.json":
        versions_of_both = [{**read_versions(path.parent), COMMAND_LINE: None} for path in (new, old)]
        return versions_of_both[0] == versions_of_both[1]
    return old.exists() and new.read_bytes() == old.read_bytes()


def end_run(folder: Path) -> None:
    """Remove the journal of a finished run."""
    (folder / JOURNAL).unlink(missing_ok=True)


def describe_difference(folder: Path, scenario: Tables, made_by: Tables) -> str | None:
    """Describe the first difference between the run in a folder and this run.

    Args:
        folder: the result folder.
        scenario: tables of the scenario of this run, with all defaults.
        made_by: entries of versions.json that must be equal, such as command and seed.

    Returns:
        The content of the folder, such as "a run with seed 1, not 2", as the object of "the folder holds". None if the
        runs are equal.
    """
    versions = read_versions(folder)
    try:
        old_tables = parsing.read_toml(folder / "scenario.toml")
    except (OSError, ValueError):
        return "files, but no scenario.toml of a run that can be read"
    if not versions:
        return "files, but no versions.json of a run that can be read"
    old_values, new_values = _values_by_key(old_tables), _values_by_key(json.loads(json.dumps(_name_objects(scenario))))
    for name, value in made_by.items():
        old = versions.get(name)
        if name == CODE and old is not None and old != value:
            return f"a run of another version of the source code (checksum {old}, not {value})"
        if old != value:
            this_run = "which is not used here" if value is None else f"not {value}"
            return f"a run without {name}" if old is None else f"a run with {name} {old}, {this_run}"
    for key in dict.fromkeys((*old_values, *new_values)):
        old, new = old_values.get(key, "absent"), new_values.get(key, "absent")
        if old != new:
            return f"a run of another scenario: {key} is {old} there, and {new} here"
    return None


def _values_by_key(tables: Tables) -> dict[str, object]:
    """Return the values of a scenario by the names of their keys, such as loop.period or sensors[0].period."""
    values: dict[str, object] = {}
    for name, content in tables.items():
        listed = {f"{name}[{k}]": table for k, table in enumerate(content)} if isinstance(content, list) else {}
        for place, table in (listed or {name: content}).items():
            values |= {f"{place}.{k}": v for k, v in table.items()} if isinstance(table, dict) else {place: table}
    return values


def check_folder(folder: Path, force: bool) -> None:
    """Raise RefusedError if this folder must not be written to; force: it may have content."""
    existing = _existing_part(folder)
    if not existing.is_dir():
        place = "which" if existing == folder else f"but {existing}"
        raise RefusedError(f"--out is {folder}, {place} is a file; allowed is a new folder")
    if not os.access(existing, os.W_OK):
        raise _unwritable_error(folder)
    if existing == folder and not force and not is_empty(folder):
        raise RefusedError(
            f"--out is {folder}, which holds something already; allowed is a new folder, or --force to write into it"
        )


def _existing_part(folder: Path) -> Path:
    """Return the folder if it exists, or else the first of its parents that does."""
    return next(path for path in (folder, *folder.parents) if path.exists())


def _unwritable_error(folder: Path) -> RefusedError:
    """Return the error for a folder that cannot be written to."""
    existing = _existing_part(folder)
    return RefusedError(f"--out is {folder}, but nothing may be written into {existing}; allowed is a folder elsewhere")


def is_empty(folder: Path) -> bool:
    """Return whether a folder is empty, except for the lock file of `lock_folder`."""
    return all(path.name == _lock_file_path(folder).name for path in folder.iterdir())


@contextlib.contextmanager
def lock_folder(folder: Path, *, force: bool = True, shared: bool = False) -> Iterator[None]:
    """Lock a result folder while this process writes into it; the lock ends with the process, even if it is killed.

    Platforms without `fcntl` and file systems without locks are not protected.

    Args:
        folder: the result folder, which need not exist yet.
        force: whether the folder may have content.
        shared: other processes that also share may write at the same time, such as the shards of a campaign.

    Raises:
        InUseError: another process writes into the folder.
        RefusedError: see `check_folder`, or no file can be created.
    """
    check_folder(folder, force=True)  # before a folder or a file is made
    path = _lock_file_path(folder)
    new_parents = [parent for parent in path.parents if not parent.exists()]
    lock = _open_locked(path, shared=shared)
    if lock is None:
        if not path.exists():  # a file system without new files, such as /proc
            raise _unwritable_error(folder)
        raise InUseError(f"{folder} is in use by another ptsmc process; wait for its end, or choose another folder")
    try:
        check_folder(folder, force)
        yield
    finally:
        with contextlib.suppress(OSError), lock:
            _lock(lock, shared=False)  # raises an error if other processes share the lock
            path.unlink()
        for parent in new_parents:
            with contextlib.suppress(OSError):  # the folder is not empty
                parent.rmdir()


def _lock_file_path(folder: Path) -> Path:
    """Return the path of the file that is locked during a run in this result folder."""
    folder = Path(os.path.realpath(folder))
    return _temporary_place(folder) / f".{folder.name}.lock"


def _open_locked(path: Path, *, shared: bool) -> IO[str] | None:
    """Open and lock a file; return None if another process holds the lock."""
    for _ in range(30):  # another process may release or remove the lock file at this moment
        with contextlib.suppress(BlockingIOError, FileNotFoundError):
            path.parent.mkdir(parents=True, exist_ok=True)
            file = path.open("a+")
            try:
                _lock(file, shared=shared)
                if os.path.samestat(os.fstat(file.fileno()), path.stat()):
                    return file
            except BaseException:
                file.close()
                raise
            file.close()
        time.sleep(0.01)
    return None


def _lock(file: IO[str], *, shared: bool) -> None:
    """Lock an open file, if there are locks. Raises BlockingIOError if another process holds the lock."""
    if fcntl is None:
        return
    try:
        fcntl.flock(file, (fcntl.LOCK_SH if shared else fcntl.LOCK_EX) | fcntl.LOCK_NB)
    except OSError as error:  # the file system may have no locks
        if isinstance(error, BlockingIOError):
            raise


def check_file(file: Path, force: bool, option: str = "--force") -> None:
    """Raise an error if a file must not be written.

    Args:
        file: the file to write.
        force: whether an existing file may be replaced.
        option: name of the option that sets `force`, for the error.

    Raises:
        RefusedError: the file exists already, it is a folder, or its folder does not exist.
    """
    if not file.parent.is_dir():
        raise RefusedError(
            f"the file is {file}, but {file.parent} is no folder; allowed is a file in an existing folder"
        )
    if file.is_dir() or (file.exists() and not force):
        allowed = "another name" if file.is_dir() else f"another name, or {option} to write over it"
        raise RefusedError(f"the file is {file}, which exists already; allowed is {allowed}")


def write_folder(folder: Path, fill: Callable[[Path], None]) -> None:
    """Write a result folder: `fill` writes into a temporary folder, whose files are then moved.

    If the folder contains another result, see `IDENTITY`, its summary, figures and tables are removed. versions.json is
    moved first and the summary last: a folder with a summary is complete.
    """
    folder = Path(os.path.realpath(folder))
    folder.parent.mkdir(parents=True, exist_ok=True)
    temporary = _temporary_place(folder) / f".{folder.name}{TEMPORARY_PREFIX}{secrets.token_hex(4)}"
    temporary.mkdir()
    try:
        fill(temporary)
        if not folder.exists():
            with contextlib.suppress(OSError):  # another shard has made the folder
                temporary.rename(folder)
                return
        order = {"versions.json": -1, SUMMARY: 1}
        files = (path for path in temporary.rglob("*") if path.is_file())
        if any((temporary / name).exists() and not _is_equal(temporary / name, folder / name) for name in IDENTITY):
            remove_summary(folder)
        for path in sorted(files, key=lambda path: order.get(path.name, 0)):
            target = folder / path.relative_to(temporary)
            target.parent.mkdir(parents=True, exist_ok=True)
            os.replace(path, target)
    finally:
        shutil.rmtree(temporary, ignore_errors=True)


def _temporary_place(folder: Path) -> Path:
    """Return the place for temporary files of a result folder: its parent if that is possible, otherwise itself.

    folder: its path without links.
    """
    inside = folder.is_mount() or (folder.is_dir() and not os.access(folder.parent, os.W_OK))
    return folder if inside else folder.parent


def write_run_files(folder: Path, scenario: Tables, made_by: Tables, summary: Tables | None = None) -> None:
    """Write scenario.toml and versions.json of a run, and summary.json if there is a summary.

    Args:
        folder: the result folder.
        scenario: tables of the scenario.
        made_by: command, seed and other inputs of the run, see `versions`.
        summary: content of `summary.json`; None if there is no summary yet.
    """
    write_toml(folder / "scenario.toml", scenario)
    write_json(folder / "versions.json", versions(**made_by))
    if summary is not None:
        write_json(folder / SUMMARY, summary)


def write_toml(path: Path, tables: Tables) -> None:
    """Write a TOML file, with arrays on one line. The units of the keys of a complete scenario are comments."""
    text, before = tomli_w.dumps(_name_objects(tables)), ""
    while text != before:  # the innermost arrays are joined first
        text, before = re.sub(r"\[\n((?: +[^\]\s][^\n]*,\n)+) *\]", _join_array, text), text
    write_text(path, _add_units(text, tables) if "plant" in tables else text)


def _add_units(text: str, tables: Tables) -> str:
    """Return the text of a scenario file with units; tables: its tables, see `parsing.dump`."""
    lines, known, count = list[str](), dict[str, str](), Counter[str]()
    for line in text.split("\n"):
        if header := re.fullmatch(r"\[+([\w.]+)\]+", line):
            known = parsing.units_of_keys(tables, header[1], count[header[1]])
            count[header[1]] += 1
        unit = known.get(line.partition(" = ")[0])
        lines.append(f"{line}  # {unit}" if unit in units.EXAMPLES else line)
    return "\n".join(lines)


def write_json(path: Path, value: object) -> None:
    """Write a JSON file; numbers that are not finite become null."""
    write_text(path, json.dumps(to_json_value(value), indent=2, allow_nan=False) + "\n")


def write_text(path: Path, text: str) -> None:
    """Write a text file as a whole; bytes that are not UTF-8, from names of files, become escapes."""
    with replace_file(path) as temporary:
        temporary.write_text(text, encoding="utf-8", errors="backslashreplace")


def write_csv(path: Path, header: Sequence[str], rows: Iterable[Sequence[Any]]) -> None:
    """Write a CSV file. Its numbers have enough digits to be read back exactly.

    Args:
        path: the file; it replaces an existing one when all rows are written.
        header: names of the columns.
        rows: the cells of each row, in the order of the columns.
    """
    with replace_file(path) as temporary, temporary.open("w", newline="", encoding="utf-8") as file:
        writer = csv.writer(file)
        writer.writerow(header)
        writer.writerows([value.item() if hasattr(value, "item") else value for value in row] for row in rows)


@contextlib.contextmanager
def replace_file(path: Path) -> Iterator[Path]:
    """Yield a temporary file that replaces `path` at the end, or is removed after an error."""
    temporary = path.with_name(f"{TEMPORARY_PREFIX}{secrets.token_hex(8)}")
    try:
        yield temporary
        os.replace(temporary, path)
    except OSError as error:
        if error.filename is not None:
            error.filename = str(path)  # name this file in the error, not the temporary file
        raise
    finally:
        with contextlib.suppress(OSError):
            temporary.unlink()


def _join_array(array: re.Match[str]) -> str:
    """Return the text of a TOML array on one line, from the match of an array with one line for each entry."""
    return "[" + ", ".join(item.strip().removesuffix(",") for item in array[1].rstrip("\n").split("\n")) + "]"


def to_json_value(value: Any) -> Any:
    """Return a value for a JSON file: numbers, lists, dicts; None for a number that is not finite."""
    if isinstance(value, Mapping):
        return {str(k): to_json_value(v) for k, v in value.items()}
    if isinstance(value, list | tuple):
        return [to_json_value(v) for v in value]
    if hasattr(value, "tolist"):
        return to_json_value(value.tolist())
    if isinstance(value, float) and not math.isfinite(value):
        return None
    return value


def _name_objects(value: object) -> Any:
    """Return tables with names instead of objects made in Python; reading refuses such a name."""
    if isinstance(value, Mapping):
        return {k: _name_objects(v) for k, v in value.items()}
    if isinstance(value, list | tuple):
        return [_name_objects(v) for v in value]
    kind = value if isinstance(value, type) else type(value)
    return value if isinstance(value, bool | int | float | str) else f"<{kind.__name__} made in Python>"


def check_names_code(tables: Tables) -> None:
    """Raise ScenarioError if a value was made in Python, such as the class of a custom law."""
    for key, value in _values_by_key(tables).items():
        try:
            json.dumps(value)
        except TypeError:
            allowed = 'the name of code in a file, such as "parts.py:Name", because a scenario file cannot contain code'
            raise wrong(key, _name_objects(value), allowed) from None
