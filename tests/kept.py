"""Whole compiled programs kept between runs of the tests, as the command keeps them.

Until a line of the code changes, no test traces again what an earlier run has traced. What a test patches, programs may
hang on: numbers and words have a folder of their own, and with anything else in its place nothing is written or read.
What the compile cache knows after a change comes from there, and cannot be written again.
Programs that were made without looking at shapes lie apart; before a test that looks takes one, it is traced.
Functions of the tests are kept too, by `programs.jit` and as parts of what flies, until a line of any test changes:
they are known by where they stand and by what they remember.
"""

import functools
import hashlib
import os
import secrets
import sys
import threading
import time
from contextlib import suppress
from functools import partial
from pathlib import Path
from types import FunctionType, MethodType, ModuleType, SimpleNamespace
from typing import Any

import jax
import jaxtyping
import numpy as np
import pytest

from ptsmc_jax import configure, programs
from ptsmc_jax.scenario import systems
from tests.tree import PACKAGES, QUICKLY, ROOT, modules

STARTED, SOURCES = time.time(), modules(*PACKAGES, "tests").values()
programs.KEPT = 1500
programs.secrets = SimpleNamespace(token_hex=lambda count: secrets.token_hex(count) if _of_a_test() else "kept")
_seen = threading.local()  # by this thread: whether the last program that it compiled was in the compile cache


@jax.monitoring.register_event_listener
def _listen(event: str, **_: Any) -> None:
    if event.startswith("/jax/compilation_cache/"):
        _seen.read = event.endswith("cache_hits")


# rooms that compile nothing, and what else no program hangs on: sizes of searches and campaigns, what is called between
# programs
HOST = ("tuning.cli", "tuning.output", "tuning.studies", "ptsmc_jax.figures")
OUTSIDE = set(
    """
    configure.configure programs.KEPT programs.prepare campaign.PART montecarlo.CAPACITY montecarlo.run
    montecarlo.prepare montecarlo.block_size rest.swing solutions.visited margin_rows.hardest margin_verdicts.prepare
    margin_verdicts.TRIALS margin_verdicts.JUDGED margin_verdicts.OFF margin_verdicts.over_trials evaluate._fly
    worst.SCREENED worst.STEPS starts.SWEPT descents.MANY descents.again descents.explore descents.descend
    cma_es.GENERATIONS global_check.GENERATIONS global_check.POPULATION flights.ROW flights.fly flights.trials
    confirm.FRESH confirm.FEWEST confirm.count rounds.harder evaluate.slopes journal.get posing.search
    systems._ran systems._files ptsmc_jax.read
    """.split()
)
NOWHERE = Path(os.devnull, "none")  # can be neither written nor read
_begun, _write, _known_by = programs.Program._begun, programs._write, programs.Program._origin
_plainly, _run = programs._plain, systems._run
_setattr, _undo = pytest.MonkeyPatch.setattr, pytest.MonkeyPatch.undo
_patched: dict[int, dict[str, Any]] = {}  # by whom, and what is in the place of what


def keep() -> None:
    """In the folder that goes with what is patched now, and whether shapes are looked at."""
    if _of_a_test():
        return
    patches = {name: value for by in _patched.values() for name, value in by.items()}
    cache = jax.config.values["jax_compilation_cache_dir"]
    if cache is None or not all(isinstance(value, int | float | str) for value in patches.values()):
        configure.programs = NOWHERE
        return
    made = repr((QUICKLY, sorted(patches.items()))).encode()
    folder = Path(cache, "programs-of-tests", hashlib.sha256(made).hexdigest()[:8])
    configure.programs = folder / ("unchecked" if jaxtyping.config.jaxtyping_disable else "checked")


def _of_a_test() -> bool:
    """Whether a test says by itself where programs are kept."""
    return any("ptsmc_jax.configure.programs" in by for by in _patched.values())


def forget() -> None:
    """The programs that this process has ready."""
    for name, module in list(sys.modules.items()):
        if name.split(".")[0] in (*PACKAGES, "tests"):
            for program in vars(module).values():
                if isinstance(program, programs.Program):
                    program._ready.clear()


def _begin(self: programs.Program, key: tuple, said: str, given: dict) -> tuple:
    """The program, the one made in the other way of looking at shapes if there is no other."""
    if not _of_a_test() and _edited(STARTED):
        configure.programs = NOWHERE  # what was imported is not what the digest is of
    path = programs._path(said)
    looked = path.parent.name
    other = path.parents[1] / {"checked": "unchecked", "unchecked": "checked"}.get(looked, "none") / path.name
    if other.is_file() and not path.exists():
        if looked == "checked":
            jax.eval_shape(partial(self._function, **dict(key[2])), **given)
        with suppress(OSError):
            path.parent.mkdir(mode=0o700, exist_ok=True)
            os.link(other, path)
    return _begun(self, key, said, given)


def _origin(self: programs.Program) -> Any:
    """Of our code as ever, and of the tests'."""
    return _known_by(self) if _ours(self._function, *PACKAGES) else _told(self._function)


def _told(value: Any) -> Any:
    """What is fixed in a program, in words: functions, types, arrays and data of the tests, too."""
    if _of_a_test():
        return _plainly(value)
    if isinstance(value, np.ndarray | np.generic | jax.Array):
        array = np.asarray(value)
        return array.shape, array.dtype.str, hashlib.sha256(array.tobytes()).hexdigest()
    if isinstance(value, FunctionType) and _ours(value, "tests"):
        code, cells = value.__code__, [cell.cell_contents for cell in value.__closure__ or ()]
        remembered = [_told(one) for one in (*cells, value.__defaults__, value.__kwdefaults__)]
        return value.__module__, value.__qualname__, repr((*code.co_positions(),)), remembered, _code()
    if isinstance(value, MethodType):
        return _told(value.__func__), _told(value.__self__)
    if isinstance(value, ModuleType):
        return value.__name__
    if _ours(value, *PACKAGES, "jax", "numpy") and hasattr(value, "__qualname__") and programs._stands(value):
        return value.__module__, value.__qualname__
    kind: Any = value if isinstance(value, type) else type(value)
    if not _ours(kind, "tests") or not programs._stands(kind):
        return _plainly(value)
    fixed = [] if kind is value else [(name, _told(getattr(value, name))) for name in kind.__dataclass_fields__]
    return kind.__module__, kind.__qualname__, fixed, _code()


def _ours(value: Any, *packages: str) -> bool:
    """Whether it comes from one of these packages; among the tests are the scenarios' files, named by their digest."""
    module = getattr(value, "__module__", None) or ""
    ran = "tests" in packages and module.startswith("_ptsmc_jax_") and _of_scenarios(sys.modules[module].__file__)
    return ran or module.split(".")[0] in packages


def _of_scenarios(path: Any) -> bool:
    return Path(path).resolve().parent == ROOT / "scenarios"


def _run_own(path: Path, content: bytes) -> ModuleType:
    """One's own code may patch anything; that of the scenarios does not."""
    module = _run(path, content)
    if _of_scenarios(path):
        keep()
    return module


@functools.cache
def _code() -> str:
    """Digest of all files, of packages too that are not imported yet."""
    digest = hashlib.sha256()
    for name, path in modules(*PACKAGES, "tests").items():
        digest.update(f"{name} {path.stat().st_size}".encode())
        digest.update(path.read_bytes())
    return digest.hexdigest()


def _edited(since: float) -> bool:
    """Whether a file of the code is newer than this, or gone."""
    return any(not source.exists() or source.stat().st_mtime > since for source in SOURCES)


def _write_new(path: Path, said: str, compiled: Any) -> None:
    if _of_a_test() or not (getattr(_seen, "read", False) or path.parent == NOWHERE):
        _write(path, said, compiled)


def _set(self: pytest.MonkeyPatch, target: Any, name: Any, *value: Any, **how: Any) -> None:
    if isinstance(target, str):
        (owner, _, attribute), to = target.rpartition("."), name
    else:
        owner, attribute, to = _module(target), name, value[0]
    named = f"{owner.rpartition('.')[2]}.{attribute}"
    if owner.split(".")[0] in (*PACKAGES, "jax", "numpy") and not owner.startswith(HOST) and named not in OUTSIDE:
        _patched.setdefault(id(self), {})[f"{owner}.{attribute}"] = to
        keep()
    _setattr(self, target, name, *value, **how)


def _module(target: Any) -> str:
    if isinstance(target, ModuleType):
        return target.__name__
    return (target if isinstance(target, type) else type(target)).__module__


def _undone(self: pytest.MonkeyPatch) -> None:
    _undo(self)
    _patched.pop(id(self), None)
    keep()


programs.Program._begun, programs._write, programs.Program._origin = _begin, _write_new, _origin
programs._plain, systems._run = _told, _run_own
pytest.MonkeyPatch.setattr, pytest.MonkeyPatch.undo = _set, _undone
