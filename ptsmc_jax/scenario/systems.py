"""Load custom systems, classes and functions by name, "FILE.py:NAME" or "package.module:NAME".

Start with `load_object`. `split_name` and `location` examine the name only. `load_object` and `load` run the code.
`checksum` may run packages around a module.
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

from ptsmc_jax import configure
from ptsmc_jax.plants.second_order import System

NAME_FORMS = '"FILE.py:NAME" or "package.module:NAME"'
SYSTEM_NAME_FORMS = f"{NAME_FORMS}, a system made with plants.system"
OWN_PACKAGES = ("ptsmc_jax", "tuning")  # packages that are never helpers of custom code


# in JAX's messages for code without derivatives or batches
_NOT_SUPPORTED = re.compile("support JVP|Differentiation rule for|vmap is only supported for")
_executed_paths: set[str] = set()  # real paths of all files that were run
_executed_files: dict[tuple[str, str], ModuleType] = {}  # by path and checksum, so that a changed file is run again
# modules that custom files imported from their own folder: path and SHA-256 by name
_helpers: dict[str, tuple[str, str | None]] = {}


def split_name(qualified_name: str, allowed: str) -> tuple[str, str]:
    """Split a text into the file or module and the name in it; raise ValueError if it is not of this form.

    Nothing is run. `allowed` describes the allowed texts in the error.
    """
    place, _, name = qualified_name.rpartition(":")
    file = place.endswith(".py")
    is_module = all(part.isidentifier() for part in place.split("."))
    if not name.isidentifier() or not qualified_name.isprintable() or not (file or is_module):
        raise ValueError(f"it names nothing; allowed is {allowed}")
    return place, name


def location(qualified_name: str) -> str:
    """Return the real path of the file, or "the module NAME", so that the user can read the code before a run."""
    place = qualified_name.rpartition(":")[0]
    return os.path.realpath(place) if place.endswith(".py") else f"the module {place}"


def load(system_or_name: object) -> System:
    """Return a system, or load it by its name.

    The result is the same object as long as the file does not change, see `load_object`.

    Args:
        system_or_name: a system, or a name such as "pendulum.py:SYSTEM".

    Raises:
        ValueError: there is no object of this name, or it is no system.
    """
    if not isinstance(system_or_name, str):
        if not isinstance(system_or_name, System):
            raise ValueError(f"allowed is {SYSTEM_NAME_FORMS}")
        return system_or_name
    loaded = load_object(system_or_name, SYSTEM_NAME_FORMS)
    if not isinstance(loaded, System):
        place = system_or_name.rpartition(":")[0]
        raise ValueError(f"{place} has a {type(loaded).__name__} of that name; allowed is {SYSTEM_NAME_FORMS}")
    return loaded


def load_object(qualified_name: str, allowed: str) -> object:
    """Run the file or module and return the object of the name in it.

    A file can import from its own folder, and a module from the current folder. A file runs again only if it or a file
    that it imported has changed.

    Args:
        qualified_name: "FILE.py:NAME" or "package.module:NAME".
        allowed: description of the allowed texts, for errors.

    Raises:
        ValueError: there is no such file or name, or running it fails; the message has one line.
    """
    place, name = split_name(qualified_name, allowed)
    try:
        content = Path(place).read_bytes() if place.endswith(".py") else b""
    except FileNotFoundError:
        raise ValueError(f"the file {place} does not exist") from None
    except OSError as error:
        raise ValueError(f"it cannot be read: {error.strerror}") from None
    try:
        with _importing_from(_import_folder(place)):
            module = _run_file(Path(place), content) if place.endswith(".py") else importlib.import_module(place)
    except (Exception, SystemExit) as error:
        if isinstance(error, ModuleNotFoundError) and f"{place}.".startswith(f"{error.name}."):
            raise ValueError(f"there is no module {place}; allowed is {allowed}") from None
        raise ValueError(f"running {place} fails: {describe_failure(error, place)}") from error
    _executed_paths.add(os.path.realpath(getattr(module, "__file__", None) or place))
    if not hasattr(module, name):
        raise ValueError(f"{place} has no such name; allowed is {allowed}")
    return getattr(module, name)


def describe_failure(error: BaseException, place: str) -> str:
    """Describe an error in custom code in one line: its type and text, and the line of the file that raised it."""
    return f"{type(error).__name__}: {(str(error).splitlines() or [''])[0]}{failing_line(error, place)}"


def find_faulty_file(error: BaseException) -> str | None:
    """Return the custom file that caused an error, None if no custom code is involved.

    JAX reports leaked tracers, missing derivatives and missing batches later, when no custom file is in the traceback.
    All custom files that were run are then returned, joined by "or".
    """
    if type(error).__name__ == "UnexpectedTracerError" or _NOT_SUPPORTED.search(str(error)):
        return " or ".join(sorted(_executed_paths)) or None
    files = [os.path.realpath(frame.f_code.co_filename) for frame, _ in traceback.walk_tb(error.__traceback__)]
    return next((file for file in reversed(files) if file in _executed_paths), None)


def failing_line(error: BaseException, place: str) -> str:
    """Return the last line of a file in an error's traceback as " (line 3 of FILE.py)", empty if there is none."""
    frames = [(frame.f_code.co_filename, number) for frame, number in traceback.walk_tb(error.__traceback__)]
    numbers = [number for file, number in frames if os.path.realpath(file) == os.path.realpath(place)]
    return f" (line {numbers[-1]} of {Path(place).name})" if numbers else ""


def checksum(qualified_name: object) -> str | None:
    """Return the SHA-256 of the file of a system or a function and of the files beside it that it imports.

    The result is None if there is no file. To find a module, Python runs the packages that contain it.
    """
    place = qualified_name.rpartition(":")[0] if isinstance(qualified_name, str) else ""
    file: str | None = place
    if place and not place.endswith(".py"):
        try:
            with _importing_from(_import_folder(place)):
                spec = importlib.util.find_spec(place)
        except (Exception, SystemExit):  # `load_object` reports the error
            spec = None
        file = None if spec is None else spec.origin
    if not file or sha256(file) is None:
        return None
    files = list_imported_files(Path(file), Path(_import_folder(place)))
    if len(files) == 1:
        return sha256(file)
    checksums = sorted((source.name, str(sha256(str(source)))) for source in files)
    return hashlib.sha256(repr(checksums).encode()).hexdigest()


def list_imported_files(file: Path, folder: Path) -> list[Path]:
    """Return a Python file and the files of a folder that it imports, directly or not, according to their source."""
    files: list[Path] = []
    pending = [file]
    while pending:
        source = pending.pop()
        if source in files:
            continue
        files.append(source)
        with contextlib.suppress(OSError, ValueError, SyntaxError, RecursionError):
            for node in ast.walk(ast.parse(source.read_bytes())):
                names = [alias.name for alias in node.names] if isinstance(node, ast.Import) else []
                names += [node.module] if isinstance(node, ast.ImportFrom) and node.module else []
                packages = {name.partition(".")[0] for name in names} - set(OWN_PACKAGES)
                pending += [path for package in sorted(packages) for path in _module_files(folder / package)]
    return files


def _module_files(module: Path) -> list[Path]:
    """Return the files of a module or a package; none if there is no such module."""
    if module.is_dir():
        return sorted({module / "__init__.py", *module.rglob("*.py")})
    return [*filter(Path.is_file, [module.with_suffix(".py")])]


def _import_folder(place: str) -> str:
    """Return the folder that custom code can import from: the folder of the file, or the current folder."""
    return os.path.realpath(Path(place).parent if place.endswith(".py") else Path.cwd())


@contextlib.contextmanager
def _importing_from(folder: str) -> Iterator[None]:
    """Import first from this folder inside the context, without compiled copies."""
    previous, sys.dont_write_bytecode = sys.dont_write_bytecode, True  # a .pyc hides a change within a second
    sys.path.insert(0, folder)
    try:
        yield
    finally:
        sys.path.remove(folder)
        sys.dont_write_bytecode = previous


def _run_file(path: Path, content: bytes) -> ModuleType:
    """Run a file as a module with a unique name, and return the module.

    Files of the same name in different folders, and their helper modules, are kept apart. The source itself is run,
    never a compiled copy from a __pycache__ folder.
    """
    key = os.path.realpath(path), checksum(f"{path}:") or ""
    if key in _executed_files:
        return _executed_files[key]
    folder = _import_folder(str(path)) + os.sep
    if not all(file.startswith(folder) and sha256(file) == sha for file, sha in _helpers.values()):
        for name in _helpers:  # remove all helpers, since they may import each other
            sys.modules.pop(name, None)
        _helpers.clear()
        importlib.invalidate_caches()
    before = set(sys.modules)
    suffix = hashlib.sha256("".join(key).encode(errors="surrogateescape")).hexdigest()[:12]
    spec = importlib.util.spec_from_file_location(f"_ptsmc_jax_{path.stem}_{suffix}", path)
    assert spec is not None
    module = importlib.util.module_from_spec(spec)
    sys.modules[spec.name] = module  # dataclasses look up their module there
    configure.programs = None  # custom code may patch the package: disable the compile cache
    try:
        exec(compile(content, str(path), "exec", dont_inherit=True), module.__dict__)
    except BaseException:
        del sys.modules[spec.name]
        raise
    finally:
        for name in set(sys.modules) - before:
            package, file = name.partition(".")[0], os.path.realpath(getattr(sys.modules[name], "__file__", None) or "")
            if package not in before and package not in OWN_PACKAGES and file.startswith(folder + package):
                _helpers[name] = file, sha256(file)
    _executed_files[key] = module
    return module


def sha256(file: str) -> str | None:
    """Return the SHA-256 of a file, None if it cannot be read."""
    try:
        return hashlib.sha256(Path(file).read_bytes()).hexdigest()
    except (OSError, ValueError):
        return None
