"""`jax.jit`, with compiled programs that outlive the process: loading one takes a tenth of tracing and lowering it.

Kept beside the compile cache where `configure(keep_programs=True)` asks for it, as the `ptsmc` command does. A session
in which code may be patched should not ask: a program is told from another by the files of its code alone. Any doubt, a
file cut short among them, falls back to compiling.
"""

import contextlib
import functools
import hashlib
import inspect
import os
import pickle
import re
import secrets
import stat
import sys
import tempfile
from collections.abc import Callable
from concurrent.futures import Future, ThreadPoolExecutor
from dataclasses import fields, is_dataclass
from enum import Enum
from pathlib import Path
from typing import Any

import jax
import jax.numpy as jnp
import jaxlib.version
import numpy as np
import scipy
from jax.core import Tracer
from jax.experimental import serialize_executable

from ptsmc_jax import configure, provenance

KEPT = 400  # programs; those not used for longest make room
# for what runs for a moment: optimising would take longer. The older emitters of fused loops and one part of the code
# compile in half the time besides, and run faster, at this level
_OLDER = {"xla_cpu_use_fusion_emitters": False} if configure.OLDER_EMITTERS else {}
QUICKLY = {"xla_backend_optimization_level": 0, "xla_cpu_parallel_codegen_split_count": 1, **_OLDER}
# for batches in `lanes`: with the pass that `configure` leaves out they compile in 0.7 to 0.9 of the time, and fly in
# 0.88 to 0.97 of it. Loops in them write one array of each type of number, see `numerics.stacking`
BATCHED = {"xla_disable_hlo_passes": ""}
OURS = provenance.PACKAGES  # whose code is known by its files
PLAIN = (int, float, str, bool, bytes, type(None))


class _UnknownError(Exception):
    """What a program hangs on cannot be told from its name."""


class Program:
    """A function compiled once for each structure of its arguments, here or by an earlier process.

    It runs on a processor, also where JAX has a GPU, which knows no Schur decomposition and takes a single run in many
    launches; a batch runs where JAX would run it.
    """

    def __init__(
        self,
        function: Callable,
        static: tuple[str, ...] = (),
        options: dict[str, Any] | None = None,
        *,
        batch: bool = False,
    ):
        functools.update_wrapper(self, function)
        self._function, self._static, self._options, self._batch = function, static, options, batch
        self._jitted = jax.jit(function, static_argnames=static, compiler_options=options)
        self._signature = inspect.signature(function)
        self._ready: dict[Any, Any] = {}  # programs, or futures of them

    def __getattr__(self, name: str) -> Any:
        return getattr(self._jitted, name)  # lower, trace, clear_cache

    def __call__(self, *args: Any, **kwargs: Any) -> Any:
        """Call it as the jitted function is called."""
        return self._placed(self._called, args, kwargs)

    def _called(self, *args: Any, **kwargs: Any) -> Any:
        known = self._known(args, kwargs)
        if known is None:
            return self._jitted(*args, **kwargs)
        key, said, given = known
        ready = self._ready.get(key)
        if isinstance(ready, Future) and ready.cancelled():  # by `stop`
            ready = None
        if ready is None or isinstance(ready, Future):
            ready, loaded = (ready or _apart(self._begun, key, said, given)).result()
            if loaded:
                try:
                    result = jax.block_until_ready(ready(given))
                except Exception:  # it was whole, and yet does not run here
                    with contextlib.suppress(OSError):
                        _path(said).unlink(missing_ok=True)
                    ready = _apart(self._compiled, key, said, given).result()
                else:
                    self._ready[key] = ready
                    return result
            self._ready[key] = ready
        return ready(given)

    def prepare(self, *args: Any, **kwargs: Any) -> None:
        """Begin to load or compile what such a call will need, beside what is done; nothing where nothing is kept."""
        self._placed(self._prepared, args, kwargs)

    def _prepared(self, *args: Any, **kwargs: Any) -> None:
        known = self._known(args, kwargs)
        if known is not None and known[0] not in self._ready:
            self._ready[known[0]] = _beside().submit(_as_here(self._begun), *known)

    def _placed(self, method: Callable, args: tuple, kwargs: dict) -> Any:
        """What the method returns, on the processor, where JAX would run something else that is not a batch."""
        elsewhere = not self._batch and configure.backend() != "cpu"
        if not elsewhere or any(isinstance(leaf, Tracer) for leaf in jax.tree.leaves((args, kwargs))):
            return method(*args, **kwargs)
        args, kwargs = [jax.tree.map(_brought, given) for given in (args, kwargs)]
        with jax.default_device(configure.processors()[0]):
            return method(*args, **kwargs)

    def _begun(self, key: tuple, said: str, given: dict) -> tuple[Callable, bool]:
        """The program, and whether it was loaded."""
        found = _read(_path(said), said, jax.tree.structure(((given,), {})))
        return (self._compiled(key, said, given), False) if found is None else (found, True)

    def _known(self, args: tuple, kwargs: dict) -> tuple[tuple, str, dict] | None:
        """What a program is known by here, in words too until it is ready, and the arguments that are not static.

        None: it cannot be kept.
        """
        if configure.programs is None or jax.config.jax_disable_jit:  # pyright: ignore[reportAttributeAccessIssue]
            return None
        bound = self._signature.bind(*args, **kwargs)  # without defaults: they are constants of the function
        given = {name: v for name, v in bound.arguments.items() if name not in self._static}
        fixed = tuple((name, v) for name, v in bound.arguments.items() if name in self._static)
        leaves, structure = jax.tree.flatten(given)
        try:
            key = (structure, tuple(_shape(leaf) for leaf in leaves), fixed, _bits())
            known = self._ready.get(key)
            said = self._said(key) if known is None or isinstance(known, Future) else ""
        except (_UnknownError, TypeError):  # traced, spread over devices, of a user's own class, not hashable
            return None
        return key, said, given

    def _said(self, key: tuple) -> str:
        """All that the program hangs on, in words that mean the same in every process."""
        structure, shapes, fixed, _ = key  # bits are among the surroundings
        return repr((self._origin(), _structure(structure), shapes, _plain(fixed), self._options, _surroundings()))

    def _compiled(self, key: tuple, said: str, given: dict) -> Callable:
        fixed = dict(key[2])

        def function(given: dict) -> Any:
            return self._function(**given, **fixed)

        # a name that the compile cache does not know: what it gives back cannot be written again, its copy would lack
        # its functions
        function.__name__ = f"{self._function.__name__}_{secrets.token_hex(4)}"
        compiled = jax.jit(function, compiler_options=self._options).lower(given).compile()
        _write(_path(said), said, compiled)
        return compiled

    def _origin(self) -> tuple[str, str, str]:
        package = self._function.__module__.split(".")[0]
        if package not in OURS or "<locals>" in self._function.__qualname__ or not inspect.isfunction(self._function):
            raise _UnknownError
        return self._function.__module__, self._function.__qualname__, _code(package)


def jit(
    function: Callable | None = None,
    *,
    static_argnames: str | tuple[str, ...] = (),
    compiler_options: dict | None = None,
    batch: bool = False,
) -> Any:
    """`jax.jit` of a function at the top of a module of this project, see above; batch: see `Program`."""
    if function is None:
        options = {"static_argnames": static_argnames, "compiler_options": compiler_options, "batch": batch}
        return functools.partial(jit, **options)
    static = (static_argnames,) if isinstance(static_argnames, str) else static_argnames
    return Program(function, static, compiler_options, batch=batch)


def _brought(leaf: Any) -> Any:
    """An array of a device's as one that any other takes."""
    kept = not isinstance(leaf, jax.Array) or jnp.issubdtype(leaf.dtype, jax.dtypes.extended)
    return leaf if kept else np.asarray(leaf)


def _shape(leaf: Any) -> tuple:
    """What of an array a program is compiled for."""
    if isinstance(leaf, Tracer):
        raise _UnknownError
    if isinstance(leaf, jax.Array):
        if leaf.devices() != {configure.devices()[0]}:
            raise _UnknownError
        return leaf.shape, leaf.dtype.name, leaf.weak_type
    if isinstance(leaf, np.ndarray | np.generic):
        return leaf.shape, leaf.dtype.name, False
    if type(leaf) in (bool, int, float):
        return (), type(leaf).__name__, True
    raise _UnknownError


def _structure(structure: Any) -> Any:
    """A tree's structure in words that mean the same in every process."""
    data = structure.node_data()
    if data is None:  # a leaf
        return "*"
    kind, fixed = data
    return _plain(kind), _plain(fixed), [_structure(child) for child in structure.children()]


def _plain(value: Any) -> Any:
    """What is fixed in a program, in such words."""
    if type(value) in PLAIN:
        return value
    if isinstance(value, tuple | list):
        return [_plain(v) for v in value]
    if isinstance(value, dict):
        return [(_plain(k), _plain(v)) for k, v in value.items()]
    kind = value if isinstance(value, type) or inspect.isfunction(value) else type(value)
    where = str(kind.__module__), kind.__qualname__  # None: of code that was run by itself
    if where[0].split(".")[0] not in (*OURS, "builtins", "collections") or "<locals>" in where[1]:
        raise _UnknownError
    if inspect.isfunction(value) and not _stands(value):  # what functools.wraps has given its name
        raise _UnknownError
    if kind is value:
        return where
    if isinstance(value, Enum):
        return where, value.name
    if is_dataclass(value):
        return where, [(f.name, _plain(getattr(value, f.name))) for f in fields(value)]
    raise _UnknownError


def _stands(value: Any) -> bool:
    """Whether a function, or a type, is what its module has under its name."""
    module, names = sys.modules.get(value.__module__), value.__qualname__.split(".")
    return functools.reduce(lambda of, name: getattr(of, name, None), names, module) is value


@functools.cache
def _beside() -> ThreadPoolExecutor:
    """Threads that compile beside the one that goes on."""
    return ThreadPoolExecutor(max(1, len(configure.processors()) - 1), "compiling")


def _apart(function: Callable, *args: Any) -> Future:
    """What a function returns, called in a thread of its own, which no Ctrl-C interrupts.

    Where one ends the waiting for a program, XLA goes on compiling it, for a client that may be gone by then: a
    segmentation fault. An exit waits for threads.
    """
    alone = ThreadPoolExecutor(1, "compiling")
    future = alone.submit(_as_here(function), *args)
    alone.shutdown(wait=False)
    return future


def _as_here(function: Callable) -> Callable:
    """The function as it runs in another thread, with what this one has as default device and bits."""
    device, bits = configure.default_device(), _bits()

    def called(*args: Any) -> Any:
        with jax.default_device(device), jax.enable_x64(bits):
            return function(*args)

    return called


def _bits() -> bool:
    """Whether numbers have 64 of them, in this thread."""
    return bool(jax.config.jax_enable_x64)  # pyright: ignore[reportAttributeAccessIssue]


def stop() -> None:
    """Compile nothing more beside: what has not begun is not needed any more."""
    if _beside.cache_info().currsize:
        _beside().shutdown(wait=False, cancel_futures=True)
        _beside.cache_clear()


def _code(package: str) -> str:
    """Return the checksum of a package's files and of the library's."""
    return provenance.code_checksum(*sorted({package, OURS[0]}))


# settings that no program hangs on
_ELSEWHERE = ("cache", "log", "dump", "profil", "traceback", "compil", "distributed", "coordination", "explain")


def _surroundings() -> tuple:
    """What else a program hangs on; the cache's folder is one processor's own."""
    settings = {k: repr(v) for k, v in jax.config.values.items() if not any(word in k for word in _ELSEWHERE)}
    versions = jax.__version__, jaxlib.version.__version__, np.__version__, scipy.__version__
    devices = [f"{d.platform} {d.device_kind} {d.id}" for d in configure.devices()]
    return versions, devices, os.environ.get("XLA_FLAGS", ""), sorted(settings.items())


def _path(said: str) -> Path:
    assert configure.programs is not None
    return configure.programs / (hashlib.sha256(said.encode()).hexdigest() + ".program")


def _read(path: Path, said: str, inside: Any) -> Callable | None:
    """The program in a file, if it is ours, whole, and the one that is asked for."""
    try:
        for place in (path.parent, path):
            status = place.lstat()
            ours = status.st_uid == os.geteuid() and not status.st_mode & (stat.S_IWGRP | stat.S_IWOTH)
            if stat.S_ISLNK(status.st_mode) or not ours:
                return None
        content = path.read_bytes()
        digest, body = content[:32], content[32:]
        if digest != hashlib.sha256(said.encode() + body).digest():
            return None
        payload, skeleton, count = pickle.loads(body)
        if _LAPACK.search(payload):
            _lapack()
        program = serialize_executable.deserialize_and_load(
            payload, inside, jax.tree.structure(skeleton), execution_devices=configure.devices()[:count]
        )
        with contextlib.suppress(OSError):  # where nothing can be written, it stays as it is
            os.utime(path)  # used
    except Exception:  # whatever is wrong with it, it can be compiled again
        return None
    return program


def _write(path: Path, said: str, compiled: Any) -> None:
    """Keep a program; nothing is said where that does not work."""
    try:
        payload, _, outside = serialize_executable.serialize(compiled)
        devices = {device for way in jax.tree.leaves(compiled.output_shardings) for device in way.device_set}
        body = pickle.dumps((payload, jax.tree.unflatten(outside, range(outside.num_leaves)), len(devices)))
        path.parent.mkdir(mode=0o700, parents=True, exist_ok=True)
        handle, temporary = tempfile.mkstemp(dir=path.parent)
        try:
            with open(handle, "wb") as file:
                file.write(hashlib.sha256(said.encode() + body).digest() + body)
            os.replace(temporary, path)
        except BaseException:
            Path(temporary).unlink(missing_ok=True)
            raise
        programs = sorted(path.parent.glob("*.program"), key=lambda p: p.stat().st_mtime)
        for old in programs[:-KEPT]:
            old.unlink(missing_ok=True)
    except Exception:
        pass


# what jaxlib's own calls are named; a program has the names of files and functions in it, too, as of `batching.lapack`
_LAPACK = re.compile(rb"lapack_[a-z0-9]+_ffi")


@functools.cache
def _lapack() -> None:
    """A loaded program calls LAPACK through pointers that tracing would have set."""
    from jaxlib.cpu import _lapack

    _lapack.initialize()
