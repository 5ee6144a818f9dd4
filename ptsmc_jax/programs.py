"""A `jax.jit` that stores traced programs on disk, so that later processes need not trace and lower them again.

Tracing and lowering a large program takes 2 to 18 s. If `configure(keep_programs=True)` was called, as the `ptsmc`
command does, the first process stores the StableHLO of a program by `jax.export`. Later processes read it, and find its
executable in JAX's compile cache. The name of a file is a checksum of all that the program depends on. Source code
counts by its files, so a process that patches code must not store programs. A program that cannot be identified with
certainty, for example because a class of the user takes part, is traced in every process.
"""

import ast
import contextlib
import functools
import hashlib
import inspect
import itertools
import logging
import os
import sys
import threading
from collections.abc import Callable, Iterator
from concurrent.futures import CancelledError, Future, ThreadPoolExecutor
from dataclasses import fields, is_dataclass
from pathlib import Path
from typing import Any

import jax
import jax.numpy as jnp
import jaxlib.version
import numpy as np
import scipy
from jax import export
from jax.core import Tracer
from jax.sharding import Mesh, NamedSharding, PartitionSpec

from ptsmc_jax import configure, provenance

MOST_STORED = 400  # stored programs; the least recently used are deleted
# compiler options of programs with a short run time: optimising them takes longer than it saves
_OLDER = {"xla_cpu_use_fusion_emitters": False} if configure.OLDER_EMITTERS else {}
FAST_COMPILE = {"xla_backend_optimization_level": 0, "xla_cpu_parallel_codegen_split_count": 1, **_OLDER}
# compiler options of batches in `lanes`: with the pass that `configure` disables they compile in 0.7 to 0.9 of the time
# and run in 0.88 to 0.97 of it. Loops in them write one array of each type of number, see `numerics.stacking`
BATCHED = {"xla_disable_hlo_passes": ""}
OURS = provenance.PACKAGES  # packages whose code is identified by its files
LITERAL_TYPES = (int, float, str, bool, bytes, type(None))
VERSIONS = (sys.version, jax.__version__, jaxlib.version.__version__, np.__version__, scipy.__version__)
# settings of JAX that change a traced program: `jax.NAME` sets one in a thread, `jax.config.jax_NAME` reads it
SETTINGS = """default_device enable_x64 debug_nans debug_infs default_matmul_precision default_prng_impl
    numpy_dtype_promotion numpy_rank_promotion threefry_partitionable""".split()
GLOBAL_SETTINGS = ["random_seed_offset", "use_shardy_partitioner"]  # the same in all threads
# a stored program runs with the version of JAX that made it, so its custom calls need not be stable
_CHECKS = [export.DisabledSafetyCheck.custom_call("__gpu$xla.gpu.triton")]
BACKGROUND_THREAD = "compiling"  # prefix of the names of threads that compile prepared programs
_logger = logging.getLogger(__name__)
_compiled: dict[str, bool] = {}  # whether each titled program that this process has begun or prepared is compiled
_awaited: dict[str, None] = {}  # titles of the programs that callers wait for, in the order of their calls


def compiling() -> str:
    """Return "compiling TITLE, k of n" if a caller waits for a titled program to be compiled, and "" otherwise.

    n is the number of titled programs that this process has begun or prepared so far.
    """
    title = next(iter(tuple(_awaited)), "")
    return title and f"compiling {title}, {min(sum(_compiled.values()) + 1, len(_compiled))} of {len(_compiled)}"


class NotStorableError(Exception):
    """A program that another process could not identify with certainty."""


class Program:
    """A jitted function whose programs are stored if `configure` asks for it.

    It runs on the CPU even if JAX has a GPU: a GPU has no Schur decomposition, and takes many launches for a single
    run. A batch runs on JAX's default device.

    Args:
        function: a function at the top of a module of this project; others are compiled, but never stored.
        static_argnames: names of the arguments that are constants of the program.
        compiler_options: as of `jax.jit`; None: `BATCHED` for a batch, otherwise the defaults.
        batch: run on JAX's default device instead of the CPU.
        title: plural noun for progress reports; programs without a title are not reported, see `compiling`.
    """

    def __init__(
        self,
        function: Callable,
        static_argnames: str | tuple[str, ...] = (),
        compiler_options: dict[str, Any] | None = None,
        *,
        batch: bool = False,
        title: str = "",
    ):
        functools.update_wrapper(self, function)
        static = (static_argnames,) if isinstance(static_argnames, str) else static_argnames
        self._function, self._static, self._signature = function, static, inspect.signature(function)
        self._batch, self._title = batch, title
        options = compiler_options or (BATCHED if batch else None)
        self._jitted = jax.jit(function, static_argnames=static, compiler_options=options)
        self._stored = jax.jit(self._restored(), static_argnames=static, compiler_options=options)
        self._prepared: list[Future] = []

    def __getattr__(self, name: str) -> Any:
        return getattr(self._jitted, name)  # lower, trace, clear_cache

    def __call__(self, *args: Any, **kwargs: Any) -> Any:
        """Call it as the jitted function is called."""
        return self._on_device(self._run, *args, **kwargs)

    def prepare(self, *args: Any, **kwargs: Any) -> None:
        """Start to compile the program of such a call in a background thread; do nothing if programs are not stored."""
        if _is_storing():
            self._on_device(self._prepare, *args, **kwargs)

    def _on_device(self, method: Callable, *args: Any, **kwargs: Any) -> Any:
        """Call a method on the CPU, even if JAX's default device is a GPU, unless this is a batch or is traced."""
        if self._batch or configure.backend() == "cpu" or _is_traced(args, kwargs):
            return method(*args, **kwargs)
        args, kwargs = jax.tree.map(_to_host, (args, kwargs))
        with jax.default_device(configure.processors()[0]):
            return method(*args, **kwargs)

    def _run(self, *args: Any, **kwargs: Any) -> Any:
        """Call the program: jitted inside a trace or if nothing is stored, otherwise from the store."""
        if _is_traced(args, kwargs):
            return self._jitted(*args, **kwargs)
        if not _is_storing():
            return (
                _call_uninterrupted(self._jitted, *args, **kwargs)
                if configure.for_command
                else self._jitted(*args, **kwargs)
            )
        thread = threading.current_thread()
        # a background thread must not wait for prepared programs: it would occupy the thread that compiles them
        if not thread.name.startswith(BACKGROUND_THREAD):
            if not all(future.done() for future in self._prepared):
                self._begin(awaited=True)
            for future in self._prepared:
                if not future.cancel():  # a program that has not begun is compiled here instead
                    with contextlib.suppress(CancelledError):  # by `cancel_prepared`
                        future.exception()  # an error comes again from the call itself
        return _call_uninterrupted(self._call_stored, *args, **kwargs)

    def _call_stored(self, *args: Any, **kwargs: Any) -> Any:
        """Call the stored program with arguments that are bound to no device, and report that it is compiled."""
        args, kwargs = _detach_from_device(args, kwargs)
        try:
            return self._stored(*args, **kwargs)
        finally:
            self._end()

    def _begin(self, *, awaited: bool) -> None:
        """Report the compilation of this program in `compiling`; awaited: a caller waits for it."""
        if self._title:
            _compiled.setdefault(self._title, False)
        if self._title and awaited:
            _awaited[self._title] = None

    def _end(self) -> None:
        """Report that this program is compiled, unless it has not been traced at all."""
        if self._title in _compiled:
            _compiled[self._title] = True
            _awaited.pop(self._title, None)

    def _prepare(self, *args: Any, **kwargs: Any) -> None:
        """Submit the compilation of the program of this call to a background thread."""
        args, kwargs = _detach_from_device(args, kwargs)

        def compile_program() -> None:
            self._stored.lower(*args, **kwargs).compile()
            _compiled.update({self._title: True} if self._title else {})

        self._begin(awaited=False)
        self._prepared.append(_background_threads().submit(_with_settings(compile_program)))

    def _restored(self) -> Callable:
        """Return the function that JAX traces instead of ours: it calls the stored program, or stores it first."""

        @functools.wraps(self._function)
        def call_stored_program(*args: Any, **kwargs: Any) -> Any:
            self._begin(awaited=not threading.current_thread().name.startswith(BACKGROUND_THREAD))
            try:
                path = self.path(*args, **kwargs)
                content = _read(path)
                if content is None:
                    content = self._export(*args, **kwargs)
                    _write(path, content)
            except (NotStorableError, TypeError, ValueError, NotImplementedError) as error:
                _logger.info("%s is not stored: %r", self._function.__qualname__, error)
                return self._function(*args, **kwargs)  # raises what is wrong with the function itself
            described, _, program = content.partition(b"\n")
            exported = export.deserialize(bytearray(program))
            leaves = [jnp.atleast_1d(leaf) for leaf in jax.tree.leaves(self._split(args, kwargs)[0])]
            if exported.nr_devices > 1:
                mesh = Mesh(np.asarray(configure.devices()[: exported.nr_devices]), ("device",))
                leaves = jax.lax.with_sharding_constraint(leaves, NamedSharding(mesh, PartitionSpec()))
            return _build_tree(ast.literal_eval(described.decode()), iter(exported.call(*leaves)))

        return call_stored_program

    def _split(self, args: tuple, kwargs: dict) -> tuple[dict, dict]:
        """Return the traced and the static arguments by name, without defaults: these are part of the code."""
        arguments = self._signature.bind(*args, **kwargs).arguments
        traced = {name: value for name, value in arguments.items() if name not in self._static}
        return traced, {name: value for name, value in arguments.items() if name in self._static}

    def _export(self, *args: Any, **kwargs: Any) -> bytes:
        """Return a line that describes the structure of the results, then the serialised program of flat arrays."""
        traced, static = self._split(args, kwargs)
        leaves, structure = jax.tree.flatten(traced)
        output_structures = []

        def call_flat(*rows: Any) -> list:
            leaves = [jnp.reshape(row, t.shape) for row, t in zip(rows, types, strict=True)]
            outputs, output_structure = jax.tree.flatten(
                self._function(**jax.tree.unflatten(structure, leaves), **static)
            )
            output_structures.append(output_structure)
            return outputs

        types: list[Any] = [jax.typeof(leaf) for leaf in leaves]
        # JAX gives scalars of programs for several devices a sharding that only its Shardy partitioner can lower
        shapes = [jax.ShapeDtypeStruct(t.shape or (1,), t.dtype, weak_type=t.weak_type) for t in types]
        platforms = ["cpu"] if configure.backend() == "cpu" else None
        exported = export.export(jax.jit(call_flat), platforms=platforms, disabled_checks=_CHECKS)(*shapes)
        described = _describe_tree(output_structures[0])
        if jax.tree.structure(_build_tree(described, itertools.repeat(0))) != output_structures[0]:
            raise NotStorableError(output_structures[0])
        return repr(described).encode() + b"\n" + exported.serialize()

    def path(self, *args: Any, **kwargs: Any) -> Path:
        """Return the file of the program for such a call, named by a checksum that is the same in every process.

        Raises:
            NotStorableError: the program cannot be identified with certainty.
        """
        module, name = self._function.__module__, self._function.__qualname__
        package = module.split(".")[0]
        if package not in OURS or "<locals>" in name or not inspect.isfunction(self._function):
            raise NotStorableError(name)
        traced, static = self._split(args, kwargs)
        leaves, structure = jax.tree.flatten(traced)
        devices = [f"{device.platform} {device.device_kind}" for device in configure.devices()]  # of the default device
        settings = _thread_settings()[1:] + [getattr(jax.config, f"jax_{name}") for name in GLOBAL_SETTINGS]
        code, arguments = provenance.code_checksum(*sorted({package, OURS[0]})), _describe_value(static)
        identity = module, name, code, arguments, _describe_tree(structure), [_argument_type(leaf) for leaf in leaves]
        checksum = hashlib.sha256(repr((identity, VERSIONS, devices, settings)).encode()).hexdigest()
        assert configure.programs is not None
        return configure.programs / f"{checksum}.stablehlo"


def jit(function: Callable | None = None, **options: Any) -> Any:
    """Return the `Program` of a function with these options of `Program`, or a decorator that does."""
    return functools.partial(Program, **options) if function is None else Program(function, **options)


def _to_host(leaf: Any) -> Any:
    """Return an array of a device as a NumPy array, which every device accepts."""
    unchanged = not isinstance(leaf, jax.Array) or jnp.issubdtype(leaf.dtype, jax.dtypes.extended)
    return leaf if unchanged else np.asarray(leaf)


def _is_storing() -> bool:
    """Return whether programs are stored; a function that is not to be compiled has none."""
    return configure.programs is not None and not jax.config.jax_disable_jit  # pyright: ignore[reportAttributeAccessIssue]


def _is_traced(args: tuple, kwargs: dict) -> bool:
    """Return whether an argument is traced by JAX."""
    return any(isinstance(leaf, Tracer) for leaf in jax.tree.leaves((args, kwargs)))


def _detach_from_device(args: tuple, kwargs: dict) -> tuple[tuple, dict]:
    """Return the arguments without arrays that are tied to the first device, as results of stored programs are.

    A program for several devices would refuse them.
    """
    devices = configure.devices()
    if len(devices) == 1:
        return args, kwargs

    def detach(leaf: Any) -> Any:
        is_tied = isinstance(leaf, jax.Array) and leaf.committed and leaf.devices() == {devices[0]}
        return _to_host(leaf) if is_tied else leaf

    return jax.tree.map(detach, (args, kwargs))


def _argument_type(leaf: Any) -> tuple:
    """Return what determines the program for an argument: shape, name of the dtype, and whether the dtype is weak."""
    array_type: Any = jax.typeof(leaf)
    if jnp.issubdtype(array_type.dtype, jax.dtypes.extended):  # as of keys
        raise NotStorableError(array_type.dtype)
    return array_type.shape, array_type.dtype.name, array_type.weak_type


def _describe_tree(structure: Any) -> Any:
    """Return the structure of a tree as literals that mean the same in every process; see `_build_tree`."""
    data = structure.node_data()
    if data is None:
        return "leaf"
    if data[0] is type(None):
        return None
    return _describe_value(data[0]), _describe_value(data[1]), [_describe_tree(child) for child in structure.children()]


def _build_tree(described: Any, leaves: Iterator) -> Any:
    """Return the tree whose structure `_describe_tree` described, with these leaves."""
    if not isinstance(described, tuple):
        return next(leaves) if described == "leaf" else None
    (_, module, name), fixed, children = described
    kind: Any = _find_object(module, name)
    values = [_build_tree(child, leaves) for child in children]
    if kind in (tuple, list):
        return kind(values)
    if issubclass(kind, dict):
        return kind(zip(fixed[2], values, strict=True))
    if not hasattr(kind, "__dataclass_fields__"):
        return kind(*values)  # a named tuple
    names = sorted(fields(kind), key=lambda f: bool(f.metadata.get("static")))
    return kind(**{f.name: value for f, value in zip(names, [*values, *fixed[2]], strict=True)})  # `pytrees.pytree`


def _describe_value(value: Any) -> Any:
    """Return a static value as literals that mean the same in every process."""
    if type(value) in LITERAL_TYPES:
        return value
    if isinstance(value, type) or inspect.isfunction(value):
        module, name = str(value.__module__), value.__qualname__
        is_identifiable = module.split(".")[0] in (*OURS, "builtins", "collections") and "<locals>" not in name
        # a type's name may be set by the function that makes it, a function's by `functools.wraps` on another
        if not is_identifiable or (inspect.isfunction(value) and _find_object(module, name) is not value):
            raise NotStorableError(value)
        return "name", module, name
    if isinstance(value, tuple | list):
        parts = list(value)
    elif isinstance(value, dict):
        parts = list(value.items())
    elif is_dataclass(value):
        parts = [(f.name, getattr(value, f.name)) for f in fields(value)]
    else:
        raise NotStorableError(value)
    return "value", _describe_value(type(value)), [_describe_value(part) for part in parts]


def _find_object(module: str, name: str) -> Any:
    """Return the object with this dotted name in a module, or None."""
    return functools.reduce(lambda owner, part: getattr(owner, part, None), name.split("."), sys.modules.get(module))


@functools.cache
def _background_threads() -> ThreadPoolExecutor:
    """Return the pool of threads that compile prepared programs."""
    return ThreadPoolExecutor(max(1, len(configure.processors()) - 1), BACKGROUND_THREAD)


@functools.cache
def _caller_thread() -> ThreadPoolExecutor:
    """Return the thread that runs the main thread's calls, which no Ctrl-C interrupts.

    If an interrupt ended the waiting for XLA, it would go on compiling for a client that the exit deletes, and the
    process would end by a segmentation fault. An exit waits for threads.
    """
    return ThreadPoolExecutor(1, "running")


def _call_uninterrupted(function: Callable, *args: Any, **kwargs: Any) -> Any:
    """Call a function in the thread `_caller_thread` if this is the main thread."""
    if threading.current_thread() is not threading.main_thread():
        return function(*args, **kwargs)
    return _caller_thread().submit(_with_settings(function), *args, **kwargs).result()


def _with_settings(function: Callable) -> Callable:
    """Return a function that applies this thread's settings of JAX when another thread calls it."""
    settings = _thread_settings()

    def call_with_settings(*args: Any, **kwargs: Any) -> Any:
        with contextlib.ExitStack() as stack:
            for name, value in zip(SETTINGS, settings, strict=True):
                stack.enter_context(getattr(jax, name)(value))
            return function(*args, **kwargs)

    return call_with_settings


def _thread_settings() -> list:
    """Return JAX's settings of this thread, in the order of `SETTINGS`."""
    return [getattr(jax.config, f"jax_{name}") for name in SETTINGS]


def cancel_prepared() -> None:
    """Cancel the prepared programs whose compilation has not begun."""
    if _background_threads.cache_info().currsize:
        _background_threads().shutdown(wait=False, cancel_futures=True)
        _background_threads.cache_clear()


def _read(path: Path) -> bytes | None:
    """Return the content of a stored program, or None if it is missing or damaged."""
    try:
        content = path.read_bytes()
    except OSError:
        return None
    with contextlib.suppress(OSError):  # a folder that cannot be written
        os.utime(path)  # see LIMIT
    return content[32:] if content[:32] == _checksum(path, content[32:]) else None


def _checksum(path: Path, content: bytes) -> bytes:
    """Return the SHA-256 (32 bytes) of the file name and the content of a stored program."""
    return hashlib.sha256(path.name.encode() + content).digest()


def _write(path: Path, content: bytes) -> None:
    """Store a program; other processes see none or all of it."""
    temporary = path.with_suffix(f".{os.getpid()}-{threading.get_ident()}")
    try:
        path.parent.mkdir(mode=0o700, parents=True, exist_ok=True)
        temporary.write_bytes(_checksum(path, content) + content)
        os.replace(temporary, path)
        for old in sorted(path.parent.iterdir(), key=lambda p: p.stat().st_mtime)[:-MOST_STORED]:
            old.unlink(missing_ok=True)
    except OSError as error:  # a full disk, a folder that cannot be written
        _logger.info("%s is not stored: %s", path, error)
