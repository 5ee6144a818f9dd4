"""JAX set up before its backend starts: the command and the notebooks call it, the library never does."""

import hashlib
import os
import platform
from pathlib import Path

# Lets outputs of a fused loop share their common work: several times less arithmetic in `lanes` on a CPU.
_XLA_OPTIONS = "--xla_backend_extra_options=xla_cpu_use_multi_output_fusion=true"


def configure(devices: int | None = None, cache: str | Path | None = "default", fusion: bool = True) -> None:
    """64 bit numbers, one host device per core, compiler options and a persistent compile cache.

    devices: number of host devices, all cores that this process may use if None; cache: folder of the compile cache,
    None for none; by default a folder of this processor's own below the user's cache folder. fusion: let the
    compiler share work between outputs, about twice as fast; but the compiler of jax 0.10.2 aborts with it on some
    code of one's own that scatters into several arrays under vmap. Call it before anything runs on JAX; later it
    raises RuntimeError where the backend has already started with something else.
    """
    flags = os.environ.get("XLA_FLAGS", "")
    if fusion and "xla_backend_extra_options" not in flags:
        os.environ["XLA_FLAGS"] = f"{flags} {_XLA_OPTIONS}".strip()
    import jax

    jax.config.update("jax_enable_x64", True)
    jax.config.update("jax_num_cpu_devices", devices or len(os.sched_getaffinity(0)))
    if cache is not None:
        folder = _cache_folder() if cache == "default" else Path(cache)
        jax.config.update("jax_compilation_cache_dir", str(folder))
        jax.config.update("jax_persistent_cache_min_compile_time_secs", 0.0)
        jax.config.update("jax_persistent_cache_min_entry_size_bytes", 0)


def _cache_folder() -> Path:
    base = os.environ.get("XDG_CACHE_HOME") or Path.home() / ".cache"
    return Path(base) / "ptsmc-jax" / hashlib.sha256(_processor().encode()).hexdigest()[:12]


def _processor() -> str:
    """What compiled code depends on: programs for one processor must not be loaded on another."""
    try:
        lines = Path("/proc/cpuinfo").read_text(encoding="utf-8").splitlines()
        told = sorted({line for line in lines if line.startswith(("model name", "flags", "Features"))})
    except OSError:
        told = [platform.processor()]
    return "\n".join([platform.machine(), *told])
