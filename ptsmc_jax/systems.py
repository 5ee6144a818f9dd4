"""Systems and functions of one's own by where they stand, "FILE.py:NAME" or "package.module:NAME"."""

import functools
import hashlib
import importlib
import importlib.util
import sys
from pathlib import Path
from types import ModuleType

from ptsmc_jax.plants import System

WHERE = '"FILE.py:NAME" or "package.module:NAME"'

ALLOWED = f"{WHERE}, a system made with plants.system"


@functools.cache
def load(where: str) -> System:
    """The system that stands there; one program for all its runs, since it is made once; see `item`."""
    found = item(where, ALLOWED)
    if not isinstance(found, System):
        name = where.rpartition(":")
        raise ValueError(f"{name[0]} has a {type(found).__name__} of that name; allowed is {ALLOWED}")
    return found


@functools.cache
def item(where: str, allowed: str) -> object:
    """What stands there under its name.

    Runs the file, as Python does with any import; it may import from its own folder, a module from where the command
    was called. Raises ValueError that says what is wrong in one line.
    """
    place, _, name = where.rpartition(":")
    if not place or not name:
        raise ValueError(f"it names nothing; allowed is {allowed}")
    path = Path(place)
    if place.endswith(".py") and not path.is_file():
        raise ValueError(f"the file {path} is not there")
    folder = str(path.parent.resolve() if place.endswith(".py") else Path.cwd())
    sys.path.insert(0, folder)
    try:
        module = _run(path) if place.endswith(".py") else importlib.import_module(place)
    except (Exception, SystemExit) as error:
        said = (str(error).splitlines() or [""])[0]
        raise ValueError(f"running {place} fails: {type(error).__name__}: {said}") from error
    finally:
        sys.path.remove(folder)
    if not hasattr(module, name):
        raise ValueError(f"{place} has no such name; allowed is {allowed}")
    return getattr(module, name)


def _run(path: Path) -> ModuleType:
    """The file as a module of a name of its own; two files with one name do not meet."""
    unique = hashlib.sha256(str(path.resolve()).encode()).hexdigest()[:12]
    spec = importlib.util.spec_from_file_location(f"_ptsmc_jax_{path.stem}_{unique}", path)
    assert spec is not None
    assert spec.loader is not None
    module = importlib.util.module_from_spec(spec)
    sys.modules[spec.name] = module  # dataclasses look their module up there
    try:
        spec.loader.exec_module(module)
    except BaseException:
        del sys.modules[spec.name]
        raise
    return module


def source(where: object, key: str = "system_sha256") -> dict[str, str]:
    """What a result depends on besides its scenario: the SHA-256 of the file in which a system or a function stands."""
    place = where.rpartition(":")[0] if isinstance(where, str) else ""
    if place and not place.endswith(".py"):
        spec = importlib.util.find_spec(place)
        place = "" if spec is None or spec.origin is None else spec.origin
    return {key: hashlib.sha256(Path(place).read_bytes()).hexdigest()} if Path(place).is_file() else {}
