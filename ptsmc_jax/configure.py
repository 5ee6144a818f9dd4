"""JAX set up before its backend starts: the command and the notebooks call it, the library never does."""

import hashlib
import importlib.util
import json
import os
import platform
import subprocess
import sys
import warnings
from importlib.metadata import version
from pathlib import Path
from typing import Any, Literal

# Compiler options for loops on a CPU, no stable interface. The first lets all outputs of a loop's body share their
# common work, the second compiles the whole loop into one kernel, the third lets that kernel's loops over the trials
# become vectors however many arrays they touch, the fourth lets the vectors be as wide as the processor's. The last
# leaves out a pass that the first brings in, but for `programs.BATCHED`: arrays that a loop writes into by one fusion
# of several outputs, as reverse mode does, it copies whole in every step, and on some code it aborts.
_FASTER = (
    "xla_cpu_use_multi_output_fusion=true",
    "xla_cpu_small_while_loop_byte_threshold=100000000",
    "-vectorize-memory-check-threshold=100000",
    "--xla_cpu_prefer_vector_width=512",
    "--xla_disable_hlo_passes=cpu_multi_output_fusion",
)
# What takes a part of compiling, and makes nothing faster: of a kernel a quarter, of what flies single runs, of slopes
# and of margins a third or two besides. A GPU's compiler would read these, too. The older emitters of fused loops are
# gone in jaxlib 0.11.
OLDER_EMITTERS = tuple(int(part) for part in version("jaxlib").split(".")[:2]) < (0, 11)
_SOONER = (
    "-unroll-runtime=false",
    "-unroll-allow-partial=false",
    "-post-RA-scheduler=false",
    *(["-x86-machine-combiner=false"] if platform.machine() in ("x86_64", "AMD64") else []),
    "--xla_backend_optimization_level=1",
    *(["--xla_cpu_use_fusion_emitters=false"] if OLDER_EMITTERS else []),
)
_OPTIONS = (*_FASTER, *_SOONER)


def _flags(options: tuple[str, ...]) -> str:
    """The options as XLA_FLAGS."""
    extra = ",".join(option for option in options if not option.startswith("--"))
    plain = [option for option in options if option.startswith("--")]
    return " ".join([*([f"--xla_backend_extra_options={extra}"] if extra else []), *plain])


# folder of whole compiled programs, see `ptsmc_jax.programs`; None: they are not kept
programs: Path | None = None


_called = _said = False  # whether `configure` was, and whether it was said that it was not
_added = _flags(_OPTIONS)  # to XLA_FLAGS by an earlier call, or by that of a process that began this one


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
    """64 bit numbers, one host device per core, compiler options and a persistent compile cache.

    devices: number of host devices, all cores that this process may use if None; cache: folder of the compile cache,
    None for none; by default a folder of this processor's own below the user's cache folder. fast: compiler options
    that make loops 2 to 15 times as fast. They are tried out in a process of its own, once for each version of JAX and
    processor where there is a cache; those that are refused, or give other numbers, are left out with a warning.
    XLA_FLAGS that set `xla_backend_extra_options` or `xla_disable_hlo_passes` are left as they are, and so is any other
    option that they set. device: what batches fly on, by default the first that JAX finds; raises NoDeviceError where
    there is none of that kind. bits: of every number; what 32 put out of reach stands in docs/python.md. keep_programs:
    keep whole compiled programs too, and load them, in a process in which no code is patched, see `ptsmc_jax.programs`,
    or looked for faults in: JAX's checks for NaN, infinity, promotion and transfers, which stop runs, are off there
    whatever the environment says. Called before JAX is imported, it also silences what XLA says to stderr by itself
    ("Very slow compile?" after two minutes), unless TF_CPP_MIN_LOG_LEVEL is set. Call it before anything runs on JAX;
    later it raises RuntimeError where the backend has already started with something else, and ValueError at any time
    for other bits and devices.
    """
    if bits not in (32, 64):
        raise ValueError(f"bits is {bits!r}, but must be 32 or 64")
    if device not in (None, "cpu", "gpu"):
        raise ValueError(f'device is {device!r}, but must be "cpu", "gpu", or None for the first that JAX finds')
    if devices is not None and not (isinstance(devices, int) and devices >= 1):
        raise ValueError(f"devices is {devices!r}, but must be a whole number from 1 on, or None for all cores")
    folder = None if cache is None else _cache_folder() if cache == "default" else Path(cache)
    os.environ.setdefault("TF_CPP_MIN_LOG_LEVEL", "3")  # read when jaxlib is loaded; what is fatal is still said
    _set_compiler_options(fast, folder, device)
    global programs, _called
    _called = True
    programs = folder / "programs" if keep_programs and folder is not None else None
    import jax

    jax.config.update("jax_enable_x64", bits == 64)
    # of programs for several devices it takes a tenth to a quarter of compiling, and jaxlib 0.11.2 crashes in it where
    # an operand of shard_map turns out unused
    jax.config.update("jax_use_shardy_partitioner", False)
    if keep_programs:
        jax.config.update("jax_debug_nans", False)
        jax.config.update("jax_debug_infs", False)
        jax.config.update("jax_numpy_dtype_promotion", "standard")
        jax.config.update("jax_transfer_guard", "allow")
    if device is not None:  # "gpu" would ask for every maker's: what JAX finds by itself is one, if there is one
        jax.config.update("jax_platforms", "cpu" if device == "cpu" else None)
    try:
        jax.config.update("jax_num_cpu_devices", devices or _cores())
    except RuntimeError:
        raise RuntimeError(
            "configure() comes too late: JAX has already run something in this process, on other devices; call it "
            "first, right after the imports"
        ) from None
    if folder is not None:
        jax.config.update("jax_compilation_cache_dir", str(folder))
        jax.config.update("jax_persistent_cache_min_compile_time_secs", 0.0)
        jax.config.update("jax_persistent_cache_min_entry_size_bytes", 0)
        _tell_of_rejected_once(folder)
    if device == "gpu" and jax.default_backend() != "gpu":  # starts it
        raise NoDeviceError("JAX finds no GPU here; allowed is cpu, or install jax[cuda12]")


def _set_compiler_options(fast: bool, folder: Path | None, device: str | None) -> None:
    """XLA_FLAGS with our options or without; raises RuntimeError where JAX has already started with others."""
    global _added
    before = _given(os.environ.get("XLA_FLAGS", ""))
    flags = _without_ours(before)
    given = {flag.split("=")[0] for flag in flags.split()}
    theirs = given & {"--xla_backend_extra_options", "--xla_disable_hlo_passes"}
    options = _options(folder, device) if fast and not theirs else ()
    ours = _flags(tuple(option for option in options if option.split("=")[0] not in given))
    wanted = f"{flags} {ours}".strip()
    if sorted(wanted.split()) == sorted(before.split()):
        return
    if _has_started():
        raise RuntimeError(
            "configure() comes too late: JAX has already run something in this process, with other compiler options "
            f"than fast={fast} asks for; call it first, right after the imports"
        )
    os.environ["XLA_FLAGS"], _added = wanted, ours or _added


def _given(flags: str) -> str:
    """XLA_FLAGS, which may be the name of a file instead: XLA would look for one that is named as ours besides."""
    if not flags.strip() or flags.lstrip().startswith("-"):
        return flags
    try:
        lines = Path(flags).read_text(encoding="utf-8").splitlines()
    except (OSError, ValueError):
        return flags  # XLA says so, and ends the process
    return " ".join(line.strip() for line in lines if not line.lstrip().startswith("#")).strip()


def _without_ours(flags: str) -> str:
    """XLA_FLAGS without what an earlier call added, or a process that began this one, beside options of the user's."""
    given, ours = flags.split(), _added.split()
    return " ".join(flag for flag in given if flag not in ours) if ours[0] in given else flags


def _has_started() -> bool:
    """Whether JAX has run something: the number of its devices cannot be changed any more."""
    import jax

    number = jax.config.values["jax_num_cpu_devices"]
    try:
        jax.config.update("jax_num_cpu_devices", number + 1)
    except RuntimeError:
        return True
    jax.config.update("jax_num_cpu_devices", number)
    return False


_REJECTED, _REFUSED = (f"Error {does} persistent compilation cache" for does in ("reading", "writing"))
SEVERAL = 3  # entries


def _tell_of_rejected_once(folder: Path) -> None:
    """JAX warns of every entry of its cache that it cannot read, or write; say it once, when there are several.

    One or two may be entries that another process is still writing, which appear byte by byte. Some processors' caches
    reject all of their own; some folders are not to be written.
    """
    cache = f"the compile cache {folder}"
    texts = {
        _REJECTED: f"{cache} rejects its own entries, so programs are compiled anew in every process",
        _REFUSED: f"{cache} takes no new entries, so those that it lacks are compiled in every process",
    }
    told, show = {kind: list[str]() for kind in texts}, warnings.showwarning

    def showing(message: Any, category: Any, *where: Any, **more: Any) -> None:
        kind = next((kind for kind in texts if str(message).startswith(kind)), None)
        if kind is None:
            show(message, category, *where, **more)
            return
        told[kind].append(str(message))
        if len(told[kind]) == SEVERAL:
            show(f"{texts[kind]}: {told[kind][0]}", RuntimeWarning, *where, **more)

    warnings.showwarning = showing
    for kind in texts:
        warnings.filterwarnings("always", kind)


def default_device() -> Any:
    """What `jax.default_device` says in this thread: a device, the name of a kind, or None."""
    import jax

    return jax.config.jax_default_device  # pyright: ignore[reportAttributeAccessIssue]


def devices() -> list:
    """The devices that code runs on that is called, or traced, here: of the kind that `jax.default_device` says."""
    import jax

    chosen = default_device()
    return jax.local_devices(backend=getattr(chosen, "platform", chosen))


def backend() -> str:
    """Their kind, "cpu" or "gpu": `jax.default_backend()`, which does not know of `jax.default_device`."""
    return devices()[0].platform


def processors() -> list:
    """The processor's devices; where JAX is kept from it (JAX_PLATFORMS), the others."""
    import jax

    try:
        return jax.local_devices(backend="cpu")
    except RuntimeError:
        return jax.local_devices()


def warn_if_forgotten() -> None:
    """Say once that numbers have 32 bits where nobody asked for that."""
    import jax

    global _said
    if not (_called or _said or jax.config.read("jax_enable_x64")):
        _said = True
        warnings.warn(
            "JAX computes with 32 bits here, too few for errors below 1e-7: call ptsmc_jax.configure.configure() "
            "first, right after the imports, or configure(bits=32) if that is meant",
            RuntimeWarning,
            stacklevel=3,
        )


def _cores() -> int:
    """Cores that this process may use."""
    return len(os.sched_getaffinity(0)) if hasattr(os, "sched_getaffinity") else os.cpu_count() or 1


def _options(folder: Path | None, device: str | None) -> tuple[str, ...]:
    """The options for what runs are flown on; None: what JAX finds, a GPU where a plug-in for one is installed."""
    processor = device == "cpu" or (device is None and importlib.util.find_spec("jax_plugins") is None)
    return tuple(option for option in _accepted(folder) if processor or option not in _SOONER)


def _accepted(folder: Path | None) -> tuple[str, ...]:
    """The options that this machine's compiler takes and that leave the numbers as they are; kept in the cache."""
    file = None if folder is None else folder / f"options-{version('jaxlib')}.json"
    if file is not None:
        try:
            answer = json.loads(file.read_text(encoding="utf-8"))
            if answer["tried"] == list(_OPTIONS):
                return tuple(answer["accepted"])
        except (OSError, ValueError, KeyError, TypeError):
            pass  # none, not to be read, not ours, or cut short: try
    accepted: tuple[str, ...] = _OPTIONS
    if not _tried(_OPTIONS):
        accepted = tuple(option for option in _OPTIONS if _tried((option,)))
        accepted = accepted if _tried(accepted) else ()
        refused = ", ".join(option for option in _OPTIONS if option not in accepted)
        warnings.warn(f"this version of XLA refuses {refused}: runs will be slower", RuntimeWarning, stacklevel=3)
    if file is not None:
        try:
            file.parent.mkdir(parents=True, exist_ok=True)
            file.write_text(json.dumps({"tried": _OPTIONS, "accepted": accepted}), encoding="utf-8")
        except OSError:
            pass  # a cache that cannot be written is none
    return accepted


def _tried(options: tuple[str, ...]) -> bool:
    """Whether a loop compiled with these options gives the numbers that NumPy gives, in a process of its own."""
    plain = {name: value for name, value in os.environ.items() if not name.startswith("JAX_")}
    environment = plain | {"JAX_PLATFORMS": "cpu", "XLA_FLAGS": _flags(options)}
    call = [sys.executable, "-c", _TRIAL]
    try:
        return subprocess.run(call, env=environment, capture_output=True, timeout=120, check=False).returncode == 0
    except subprocess.TimeoutExpired:
        return False


# 64 damped pendulums side by side, with a branch and a scalar clock: what a rollout is made of.
_TRIAL = """
import sys
import jax
import numpy as np
jax.config.update("jax_enable_x64", True)
import jax.numpy as jnp

def run(module, cond, loop, x, steps):
    def step(carry, k):
        x, v, most = carry
        d = module.sin(0.1 * k)
        a = d - module.sin(x) - 0.1 * v * module.sqrt(1.0 + v * v)
        v = v + 0.05 * a
        x = x + 0.05 * v
        late = cond(k > 50, lambda: module.maximum(most, module.abs(a)), lambda: most)
        return (x, v, late), None
    return loop(step, (x, 0.0 * x, 0.0 * x), module.arange(steps) * 1.0)[0]

def plain(step, carry, ks):
    for k in ks:
        carry, _ = step(carry, k)
    return carry, None

x = np.linspace(-3.0, 3.0, 64)
expected = run(np, lambda test, yes, no: yes() if test else no(), plain, x, 100)
for options in (None, {"xla_disable_hlo_passes": ""}):
    flown = jax.jit(lambda x: run(jnp, jax.lax.cond, jax.lax.scan, x, 100), compiler_options=options)
    if any(np.max(np.abs(np.asarray(a) - b)) > 1e-12 for a, b in zip(flown(jnp.asarray(x)), expected)):
        sys.exit(1)
"""


def _cache_folder() -> Path | None:
    try:
        base = os.environ.get("XDG_CACHE_HOME") or Path.home() / ".cache"
    except RuntimeError:  # a user whom the machine does not know, in a container
        return None
    return Path(base) / "ptsmc-jax" / hashlib.sha256(_processor().encode()).hexdigest()[:12]


def _processor() -> str:
    """What compiled code depends on: programs for one processor must not be loaded on another."""
    try:
        lines = Path("/proc/cpuinfo").read_text(encoding="utf-8").splitlines()
        described = sorted({line for line in lines if line.startswith(("model name", "flags", "Features"))})
    except OSError:
        described = [platform.processor()]
    return "\n".join([platform.machine(), *described])
