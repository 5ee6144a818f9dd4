"""Systems and functions of one's own by where they stand, "FILE.py:NAME" or "package.module:NAME".

A scenario that names one is a program. `named` looks at the text alone; `digest`, `item` and `load` run what it names.
"""

import ast
import contextlib
import hashlib
import importlib
import importlib.util
import os
import re
import sys
import traceback
from collections.abc import Iterator
from pathlib import Path
from types import ModuleType
from typing import TYPE_CHECKING, NamedTuple

from ptsmc_jax import configure

if TYPE_CHECKING:
    from ptsmc_jax.plants.second_order import System

WHERE = '"FILE.py:NAME" or "package.module:NAME"'
ALLOWED = f"{WHERE}, a system made with plants.system"
LONGEST = 4096  # characters of a path, on Linux
OURS = ("ptsmc_jax", "tuning")  # packages that no folder of one's own has helpers of the name of


class _Ran(NamedTuple):
    """A file that was run."""

    module: ModuleType
    helpers: dict[str, str | None]  # files beside it that were imported, by path: their SHA-256


_NO_SLOPES = re.compile("support JVP|Differentiation rule for")  # in what JAX says then
_files: set[str] = set()  # of what was run, links followed
_ran: dict[tuple[str, str], _Ran] = {}  # by path and SHA-256: what has changed is run anew
# modules that the last ones imported from beside them: path and SHA-256
_helpers: dict[str, tuple[str, str | None]] = {}


def named(where: str, allowed: str) -> tuple[str, str]:
    """The file or module, and the name in it; looks at the text only. Raises ValueError where it is neither."""
    place, _, name = where.rpartition(":")
    file = place.endswith(".py")
    if not name.isidentifier() or len(where) > LONGEST or not where.isprintable():
        place = ""
    if not place or not (file or all(part.isidentifier() for part in place.split("."))):
        raise ValueError(f"it names nothing; allowed is {allowed}")
    return place, name


def location(where: str) -> str:
    """What would be run, as one may look at it: the file with its whole path, links followed, or the module."""
    place = where.rpartition(":")[0]
    return os.path.realpath(place) if place.endswith(".py") else f"the module {place}"


def load(where: object) -> "System":
    """The system that stands there, the same object as long as its file stays the same, see `item`; or is there."""
    from ptsmc_jax.plants.second_order import System  # scenarios without one are checked without JAX

    if not isinstance(where, str):
        if not isinstance(where, System):
            raise ValueError(f"allowed is {ALLOWED}")
        return where
    found = item(where, ALLOWED)
    if not isinstance(found, System):
        place = where.rpartition(":")[0]
        raise ValueError(f"{place} has a {type(found).__name__} of that name; allowed is {ALLOWED}")
    return found


def item(where: str, allowed: str) -> object:
    """What stands there under its name.

    Runs the file, as Python does with any import; it may import from its own folder, a module from where the command
    was called. Raises ValueError that says what is wrong in one line.
    """
    place, name = named(where, allowed)
    path = Path(place)
    content = _content(path) if place.endswith(".py") else b""
    try:
        with _importing_from(_home(place)):
            module = _run(path, content) if place.endswith(".py") else importlib.import_module(place)
    except (Exception, SystemExit) as error:
        raise ValueError(f"running {place} fails: {failure(error, place)}") from error
    _files.add(os.path.realpath(getattr(module, "__file__", None) or place))
    if not hasattr(module, name):
        raise ValueError(f"{place} has no such name; allowed is {allowed}")
    return getattr(module, name)


def failure(error: BaseException, place: str) -> str:
    """What went wrong in code of one's own, in one line: the error, and the last line of that file that led to it."""
    return f"{type(error).__name__}: {(str(error).splitlines() or [''])[0]}{line(error, place)}"


def at_fault(error: BaseException) -> str | None:
    """The file of one's own by which an error came; None: it came by none.

    What was kept of another trace, or has no slopes, JAX finds later, where no file of one's own is on the way: it is
    of one that was run.
    """
    if type(error).__name__ == "UnexpectedTracerError" or _NO_SLOPES.search(str(error)):
        return " or ".join(sorted(_files)) or None
    walked = [os.path.realpath(frame.f_code.co_filename) for frame, _ in traceback.walk_tb(error.__traceback__)]
    return next((file for file in reversed(walked) if file in _files), None)


def line(error: BaseException, place: str) -> str:
    """The last line of a file that led to an error, in parentheses after a space; nothing where none of it did."""
    walked = [(frame.f_code.co_filename, number) for frame, number in traceback.walk_tb(error.__traceback__)]
    numbers = [number for file, number in walked if os.path.realpath(file) == os.path.realpath(place)]
    return f" (line {numbers[-1]} of {Path(place).name})" if numbers else ""


def digest(where: object) -> str | None:
    """Return the SHA-256 of the file of a system or a function and of the files beside it that it imports.

    None if it is in no file. Runs the packages around a module, as Python does to find it.
    """
    place = where.rpartition(":")[0] if isinstance(where, str) else ""
    file: str | None = place
    if place and not place.endswith(".py"):
        try:
            with _importing_from(_home(place)):
                spec = importlib.util.find_spec(place)
        except (Exception, SystemExit):  # which `item` says
            spec = None
        file = None if spec is None else spec.origin
    if not file or _sha(file) is None:
        return None
    first, *others = imported(Path(file), Path(_home(place)))
    if not others:
        return _sha(str(first))
    each = sorted((one.name, str(_sha(str(one)))) for one in (first, *others))
    return hashlib.sha256(repr(each).encode()).hexdigest()


def imported(file: Path, folder: Path) -> list[Path]:
    """Return a Python file and the files of a folder that it imports, directly or not, as their texts say."""
    found: list[Path] = []
    waiting = [file]
    while waiting:
        one = waiting.pop()
        if one in found:
            continue
        found.append(one)
        with contextlib.suppress(OSError, ValueError, SyntaxError, RecursionError):
            for node in ast.walk(ast.parse(one.read_bytes())):
                names = [alias.name for alias in node.names] if isinstance(node, ast.Import) else []
                names += [node.module] if isinstance(node, ast.ImportFrom) and node.module else []
                tops = {name.partition(".")[0] for name in names} - set(OURS)
                waiting += [path for top in sorted(tops) for path in _files_of(folder / top)]
    return found


def _files_of(module: Path) -> list[Path]:
    """Return the files of a module or a package; none if there is no such module."""
    if module.is_dir():
        return sorted({module / "__init__.py", *module.rglob("*.py")})
    return [*filter(Path.is_file, [module.with_suffix(".py")])]


def _content(path: Path) -> bytes:
    try:
        return path.read_bytes()
    except (FileNotFoundError, NotADirectoryError):
        raise ValueError(f"the file {path} is not there") from None
    except OSError as error:
        raise ValueError(f"it cannot be read: {error.strerror}") from None


def _home(place: str) -> str:
    """The folder from which it may import."""
    return os.path.realpath(Path(place).parent if place.endswith(".py") else Path.cwd())


@contextlib.contextmanager
def _importing_from(folder: str) -> Iterator[None]:
    written, sys.dont_write_bytecode = sys.dont_write_bytecode, True  # a copy hides a change within the same second
    sys.path.insert(0, folder)
    try:
        yield
    finally:
        sys.path.remove(folder)
        sys.dont_write_bytecode = written


def _run(path: Path, content: bytes) -> ModuleType:
    """The file as a module of a name of its own; two files with one name do not meet, nor do those that they import.

    What is run is what was read and can be read: no compiled copy from a __pycache__ that came with it.
    """
    known = os.path.realpath(path), hashlib.sha256(content).hexdigest()
    ran = _ran.get(known)
    if ran is not None and all(_sha(file) == sha for file, sha in ran.helpers.items()):
        return ran.module
    home = _home(str(path))
    if not all(file.startswith(home + os.sep) and _sha(file) == sha for file, sha in _helpers.values()):
        for name in _helpers:  # all: one may have imported another
            sys.modules.pop(name, None)
        _helpers.clear()
        importlib.invalidate_caches()
    before = set(sys.modules)
    unique = hashlib.sha256("".join(known).encode(errors="surrogateescape")).hexdigest()[:12]
    spec = importlib.util.spec_from_file_location(f"_ptsmc_jax_{path.stem}_{unique}", path)
    assert spec is not None
    module = importlib.util.module_from_spec(spec)
    sys.modules[spec.name] = module  # dataclasses look their module up there
    configure.programs = None  # what they are made of may be patched from here on
    try:
        exec(compile(content, str(path), "exec", dont_inherit=True), module.__dict__)
    except BaseException:
        del sys.modules[spec.name]
        raise
    finally:
        _helpers.update(_beside(home, before))
    _ran[known] = _Ran(module, dict(_helpers.values()))
    return module


def _beside(home: str, before: set[str]) -> dict[str, tuple[str, str | None]]:
    """The modules from a folder that were not there before: path and SHA-256 by name."""
    found = {}
    for name in set(sys.modules) - before:
        top, file = name.partition(".")[0], os.path.realpath(getattr(sys.modules[name], "__file__", None) or "")
        if top not in OURS and top not in before and file.startswith(os.path.join(home, top)):
            found[name] = file, _sha(file)
    return found


def _sha(file: str) -> str | None:
    """SHA-256 of a file; None where it cannot be read."""
    try:
        return hashlib.sha256(Path(file).read_bytes()).hexdigest()
    except (OSError, ValueError):
        return None
