"""Systems of one's own by where they stand, "FILE.py:NAME" or "package.module:NAME"."""

import functools
import importlib
import importlib.util
from pathlib import Path

from ptsmc_jax.plants import System

ALLOWED = '"FILE.py:NAME" or "package.module:NAME", a system made with plants.system'


@functools.cache
def load(where: str) -> System:
    """The system that stands there; one program for all its runs, since it is made once.

    Runs the file, as Python does with any import. Raises ValueError that says what is wrong.
    """
    place, _, name = where.rpartition(":")
    if not place or not name:
        raise ValueError(f"it names no system; allowed is {ALLOWED}")
    if place.endswith(".py"):
        path = Path(place)
        if not path.is_file():
            raise ValueError(f"the file {path} is not there")
        spec = importlib.util.spec_from_file_location(f"ptsmc_jax_system_{path.stem}", path)
        assert spec is not None
        assert spec.loader is not None
        module = importlib.util.module_from_spec(spec)
        run = functools.partial(spec.loader.exec_module, module)
    else:
        module = None
        run = functools.partial(importlib.import_module, place)
    try:
        module = run() or module
    except Exception as error:
        raise ValueError(f"running {place} fails: {type(error).__name__}: {error}") from error
    found = getattr(module, name, None)
    if not isinstance(found, System):
        said = "has no such name" if found is None else f"has a {type(found).__name__} of that name"
        raise ValueError(f"{place} {said}; allowed is {ALLOWED}")
    return found
