"""Set up JAX before its backend starts: the command and the notebooks call `configure`, the library does not."""

import hashlib
import importlib.util
import os
import platform
import stat
import warnings
from importlib.metadata import version
from pathlib import Path
from typing import Any, Literal, NamedTuple

JAXLIB, MACHINE = ".".join(version("jaxlib").split(".")[:2]), platform.machine()
OLDER_EMITTERS = JAXLIB == "0.10"  # the older emitters of fused loops, gone in jaxlib 0.11
X86, ARM = ("x86_64", "AMD64"), ("aarch64", "arm64")


class _Option(NamedTuple):
    """A compiler option for loops on the CPU; XLA keeps no interface of these stable.

    Its text is a flag of XLA, or of its LLVM backend (`xla_backend_extra_options`) if it does not begin with "--".
    """

    text: str
    jaxlib: tuple[str, ...] = ("0.10", "0.11")
    machines: tuple[str, ...] = (*X86, *ARM)
    on_gpu: bool = True  # also set if a GPU may be used, whose compiler reads these flags too


# tests/test_configure.py checks that the installed XLA accepts these and that they change no result
OPTIONS = (
    # These make loops faster. Outputs of a loop's body share their common work. The whole loop is one kernel. Its loops
    # over the trials become vectors, however many arrays they touch. Vectors are as wide as the processor's.
    _Option("xla_cpu_use_multi_output_fusion=true"),
    _Option("xla_cpu_small_while_loop_byte_threshold=100000000"),
    _Option("-vectorize-memory-check-threshold=100000"),
    _Option("--xla_cpu_prefer_vector_width=512"),
    # The first option adds this pass, and this option disables it again. In every step the pass copies whole arrays
    # that a loop writes, as in reverse mode. It also aborts on some code. `programs.BATCHED` enables it
    _Option("--xla_disable_hlo_passes=cpu_multi_output_fusion"),
    # these compile in a quarter to a half less time, and run as fast
    _Option("-pre-RA-sched=fast", on_gpu=False),  # the default is quadratic in the length of a loop's body
    _Option("-unroll-runtime=false", on_gpu=False),
    _Option("-unroll-allow-partial=false", on_gpu=False),
    _Option("-post-RA-scheduler=false", on_gpu=False),
    _Option("-x86-machine-combiner=false", machines=X86, on_gpu=False),
    _Option("--xla_backend_optimization_level=1", on_gpu=False),
    _Option("--xla_cpu_use_fusion_emitters=false", jaxlib=("0.10",), on_gpu=False),
)
_EXCLUSIVE_FLAGS = (
    "--xla_backend_extra_options",
    "--xla_disable_hlo_passes",
)  # no options are set if the user sets one

programs: Path | None = None  # folder of stored programs, see `ptsmc_jax.programs`; None: do not store any
for_command = False  # argument `keep_programs` of the last call; custom code does not change it
_configured: tuple | None = None  # arguments of the last call of `configure`
_warned = False  # whether the warning about a missing call of `configure` was issued


class NoDeviceError(ValueError):
    """A device that JAX does not find here. Its text is one sentence."""


def configure(
    devices: int | None = None,
    cache: str | Path | None = "default",
    fast: bool = True,
    *,
    device: Literal["cpu", "gpu"] | None = None,
    bits: Literal[32, 64] = 64,
    keep_programs: bool = False,
) -> None:
    """Set 64 bit numbers, one host device per core, compiler options and a persistent compile cache.

    Call it before anything runs on JAX. A second call with the same arguments does nothing. A later call with other
    `bits` is allowed: parts must then be built again, because existing arrays do not change. If JAX was not imported
    before, it also silences XLA's own messages ("Very slow compile?"), unless TF_CPP_MIN_LOG_LEVEL is set.

    Args:
        devices: number of host devices; None: all cores that this process may use.
        cache: folder of the compile cache, "default" for one of this processor below the user's cache folder, None for
            none. If it belongs to another user, or other users may write it, `configure` warns and uses no cache.
        fast: set `OPTIONS`, which make loops 2 to 15 times as fast. Options in XLA_FLAGS take precedence. XLA_FLAGS is
            not changed if it names a file, or sets `xla_backend_extra_options` or `xla_disable_hlo_passes`.
        device: device of batches; None: the first that JAX finds.
        bits: of every number; docs/python.md lists what 32 bits cannot do.
        keep_programs: store traced programs too, see `ptsmc_jax.programs`, in a process that patches no code. JAX's
            checks for NaN, infinity, promotion and transfers, which stop runs, are off then.

    Raises:
        ValueError: bits, device or devices is not allowed.
        NoDeviceError: there is no device of that kind.
        RuntimeError: JAX has already run something with other compiler options or another number of devices.
    """
    if bits not in (32, 64):
        raise ValueError(f"bits is {bits!r}, but must be 32 or 64")
    if device not in (None, "cpu", "gpu"):
        raise ValueError(f'device is {device!r}, but must be "cpu", "gpu", or None for the first that JAX finds')
    if devices is not None and not (isinstance(devices, int) and devices >= 1):
        raise ValueError(f"devices is {devices!r}, but must be a whole number from 1 on, or None for all cores")
    global programs, for_command, _configured
    arguments = devices, cache, fast, device, bits, keep_programs
    if arguments == _configured:
        return
    os.environ.setdefault("TF_CPP_MIN_LOG_LEVEL", "3")  # read when jaxlib is loaded; fatal errors are still shown
    _set_compiler_options(fast, device)
    import jax

    jax.config.update("jax_enable_x64", bits == 64)
    # for several devices it takes a tenth to a quarter of compiling, and jaxlib 0.11.2 crashes in it if an operand of
    # shard_map is unused
    jax.config.update("jax_use_shardy_partitioner", False)
    if keep_programs:
        jax.config.update("jax_debug_nans", False)
        jax.config.update("jax_debug_infs", False)
        jax.config.update("jax_numpy_dtype_promotion", "standard")
        jax.config.update("jax_transfer_guard", "allow")
    if device is not None:  # "gpu" would require a GPU of every maker; JAX itself finds the GPU of this machine
        jax.config.update("jax_platforms", "cpu" if device == "cpu" else None)
    try:
        jax.config.update("jax_num_cpu_devices", devices or _count_cores())
    except RuntimeError:
        raise RuntimeError(
            "configure() comes too late: JAX has already run something in this process, on other devices; call it "
            "first, right after the imports"
        ) from None
    folder = _check_cache_folder(_default_cache_folder() if cache == "default" else cache)
    for_command = keep_programs
    programs = folder / "programs" if keep_programs and folder is not None else None
    if folder is not None:
        jax.config.update("jax_compilation_cache_dir", str(folder))
        jax.config.update("jax_persistent_cache_min_compile_time_secs", 0.0)
        jax.config.update("jax_persistent_cache_min_entry_size_bytes", 0)
    if device == "gpu" and jax.default_backend() != "gpu":  # starts it
        raise NoDeviceError("JAX finds no GPU here; allowed is cpu, or install jax[cuda12]")
    _configured = arguments


def _set_compiler_options(fast: bool, device: str | None) -> None:
    """Set XLA_FLAGS; raise RuntimeError if JAX has already started with others."""
    old_flags = os.environ.get("XLA_FLAGS", "")
    new_flags = _merge_flags(old_flags, _compiler_options(device) if fast else ())
    if sorted(new_flags.split()) == sorted(old_flags.split()):
        return
    if _has_started():
        raise RuntimeError(
            "configure() comes too late: JAX has already run something in this process, with other compiler options "
            f"than fast={fast} asks for; call it first, right after the imports"
        )
    os.environ["XLA_FLAGS"] = new_flags


def _compiler_options(device: str | None) -> tuple[str, ...]:
    """Return the options for this version, machine and device; None: a GPU may be used if a plug-in is installed."""
    options = _known_options(device == "cpu" or (device is None and importlib.util.find_spec("jax_plugins") is None))
    if not options:
        message = f"no compiler options are known for jaxlib {JAXLIB} on {MACHINE}: runs will be slower"
        warnings.warn(message, RuntimeWarning, stacklevel=4)
    return options


def _known_options(on_cpu: bool) -> tuple[str, ...]:
    """Return the options for this version and machine; on_cpu: only the CPU is used."""
    known = [option for option in OPTIONS if JAXLIB in option.jaxlib and MACHINE in option.machines]
    return tuple(option.text for option in known if on_cpu or option.on_gpu)


def _merge_flags(old_flags: str, options: tuple[str, ...]) -> str:
    """Return XLA_FLAGS with these options, and without those of an earlier call or of the process that began this one.

    The user's options take precedence. If XLA_FLAGS is the name of a file, it is returned unchanged.
    """
    if old_flags.strip() and not old_flags.lstrip().startswith("-"):
        return old_flags
    flags, our_flags = (
        old_flags.split(),
        {flag for on_cpu in (True, False) for flag in _format_flags(_known_options(on_cpu))},
    )
    if any(flag in our_flags for flag in flags if flag.startswith(_EXCLUSIVE_FLAGS[0])):  # unique: ours have been added
        flags = [flag for flag in flags if flag not in our_flags]
    names = {flag.split("=")[0] for flag in flags}
    if names.isdisjoint(_EXCLUSIVE_FLAGS):
        flags += [flag for flag in _format_flags(options) if flag.split("=")[0] not in names]
    return " ".join(flags)


def _format_flags(options: tuple[str, ...]) -> list[str]:
    """Return the options as flags of XLA."""
    backend_options = ",".join(option for option in options if not option.startswith("--"))
    xla_flags = [option for option in options if option.startswith("--")]
    return [f"{_EXCLUSIVE_FLAGS[0]}={backend_options}", *xla_flags] if backend_options else xla_flags


def _has_started() -> bool:
    """Return whether JAX has run something, so that the number of its devices cannot be changed any more."""
    import jax

    number = jax.config.jax_num_cpu_devices  # pyright: ignore[reportAttributeAccessIssue]
    try:
        for value in (number + 1, number):
            jax.config.update("jax_num_cpu_devices", value)
    except RuntimeError:
        return True
    return False


def _check_cache_folder(cache: str | Path | None) -> Path | None:
    """Return the folder of the compile cache, made if it is missing, or None with a warning if it is not safe.

    Loading an entry runs machine code, so the folder must belong to the user, and other users must not write it.
    """
    if cache is None:
        return None
    folder, is_own = Path(cache), False
    try:
        folder.mkdir(mode=0o700, parents=True, exist_ok=True)
        status = folder.lstat()
        owner = os.geteuid() if hasattr(os, "geteuid") else status.st_uid
        is_own = stat.S_ISDIR(status.st_mode) and status.st_uid == owner
        is_own = is_own and not status.st_mode & (stat.S_IWGRP | stat.S_IWOTH)
    except OSError:
        pass
    if not is_own:
        rule = "it must be a folder that belongs to you and that other users cannot write"
        warnings.warn(f"the compile cache {folder} is not used: {rule}", RuntimeWarning, stacklevel=3)
        return None
    if not os.access(folder, os.W_OK):
        warnings.warn(f"the compile cache {folder} takes no new entries", RuntimeWarning, stacklevel=3)
    # JAX warns of each entry that it cannot write, or that another process is writing, and compiles it again
    warnings.filterwarnings("ignore", "Error (reading|writing) persistent compilation cache")
    return folder


def default_device() -> Any:
    """Return JAX's default device in this thread: a device, the name of a kind, or None."""
    import jax

    return jax.config.jax_default_device  # pyright: ignore[reportAttributeAccessIssue]


def devices() -> list:
    """Return the devices of the kind of JAX's default device, which code that is called or traced here runs on."""
    import jax

    chosen = default_device()
    return jax.local_devices(backend=getattr(chosen, "platform", chosen))


def backend() -> str:
    """Return the kind of `devices`, "cpu" or "gpu"; `jax.default_backend()` ignores `jax.default_device`."""
    return devices()[0].platform


def processors() -> list:
    """Return the CPU's devices, or all others if JAX_PLATFORMS excludes the CPU."""
    import jax

    try:
        return jax.local_devices(backend="cpu")
    except RuntimeError:
        return jax.local_devices()


def warn_if_not_configured() -> None:
    """Warn once if numbers have 32 bits although `configure` was not called."""
    import jax

    global _warned
    if not (_configured or _warned or jax.config.read("jax_enable_x64")):
        _warned = True
        warnings.warn(
            "JAX computes with 32 bits here, too few for errors below 1e-7: call ptsmc_jax.configure.configure() "
            "first, right after the imports, or configure(bits=32) if that is meant",
            RuntimeWarning,
            stacklevel=3,
        )


def _count_cores() -> int:
    """Return the number of cores that this process may use."""
    return len(os.sched_getaffinity(0)) if hasattr(os, "sched_getaffinity") else os.cpu_count() or 1


def _default_cache_folder() -> Path | None:
    """Return the folder of this processor's compiled code, or None for a user without a home."""
    try:
        base = os.environ.get("XDG_CACHE_HOME") or Path.home() / ".cache"
    except RuntimeError:  # as in a container with an unknown user
        return None
    # code compiled for one processor must not be loaded on another
    try:
        lines = Path("/proc/cpuinfo").read_text(encoding="utf-8").splitlines()
        properties = sorted({line for line in lines if line.startswith(("model name", "flags", "Features"))})
    except OSError:
        properties = [platform.processor()]
    processor = "\n".join([platform.machine(), *properties])
    return Path(base) / "ptsmc-jax" / hashlib.sha256(processor.encode()).hexdigest()[:12]
