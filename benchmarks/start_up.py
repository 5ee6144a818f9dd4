"""Cold and warm start of the commands, each in a separate process, and the time to compile the sampled loop.

The table has seconds and CPU seconds, which other work on the machine hardly changes. Arguments select commands by
their printed names.
"""

import os
import resource
import subprocess
import sys
import tempfile
import time
from pathlib import Path

import numpy as np
from common import machine

PTSMC = Path(sys.executable).with_name("ptsmc")
SCENARIOS = Path(__file__).parent.parent / "scenarios"
FIRST_FLIGHT, HARD_FLIGHT = (str(SCENARIOS / f"{name}_flight.toml") for name in ("first", "hard"))
COMMANDS = {
    "--version": ["--version"],
    "--help": ["--help"],
    "simulate, refused": ["simulate", "refused.toml"],
    "simulate --no-figures": ["simulate", "--no-figures"],
    "simulate first_flight.toml --no-figures": ["simulate", FIRST_FLIGHT, "--trial", "0", "--no-figures"],
    "simulate": ["simulate"],
    "map (9 x 9) --no-figures": ["map", FIRST_FLIGHT, "--no-figures"],
    "reproduce": ["reproduce"],
    "tune first_flight.toml": ["tune", FIRST_FLIGHT],
}
WARM = 5


def run(arguments: list[str], cache: str) -> tuple[float, float]:
    """Return seconds and CPU seconds of one call with this compile cache."""
    with tempfile.TemporaryDirectory() as out:
        (Path(out) / "refused.toml").write_text("[controller]\neta = 1.0\n", encoding="utf-8")
        extra = [] if arguments[0].startswith("--") else ["--quiet", "--out", str(Path(out) / "made")]
        start, before = time.perf_counter(), resource.getrusage(resource.RUSAGE_CHILDREN)
        done = subprocess.run([str(PTSMC), *arguments, *extra], env=dict(os.environ, XDG_CACHE_HOME=cache), cwd=out,
                              capture_output=True, check=False)  # fmt: skip
        seconds, after = time.perf_counter() - start, resource.getrusage(resource.RUSAGE_CHILDREN)
        assert done.returncode in ((2,) if "refused.toml" in arguments else (0, 1)), done.stderr.decode()
        return seconds, after.ru_utime + after.ru_stime - before.ru_utime - before.ru_stime


def compiling() -> None:
    """Print seconds to trace, lower and compile the sampled loop for a batch and for one run."""
    from ptsmc_jax.configure import configure

    configure(cache=None)
    import jax.numpy as jnp
    from common import study

    from ptsmc_jax import scenario
    from ptsmc_jax.campaigns import montecarlo
    from ptsmc_jax.simulation import rollout
    from ptsmc_jax.simulation.computer import PYTHON_SOFTWARE

    devices = {f"torque_{name}": value for name, value in (("limit", 0.5), ("rate_limit", 5.0), ("lag", 0.1))}
    every = {f"hardware__{k}": v for k, v in {**devices, "delay": 1, "torque_step": 1e-4, "rate_bias": 1e-6}.items()}
    hard = scenario.study(scenario.read(HARD_FLIGHT))
    cases = {"noise off": study(), "noise on": study(True), "every device": study(True, **every), "hard flight": hard}
    for name, ready in cases.items():
        trials = jnp.arange(512, dtype=jnp.uint32).reshape(2, -1, montecarlo.BLOCK)
        batch = (ready.parts, ready.dispersion, jnp.uint32(0), trials, jnp.int32(2), 2, None, False, PYTHON_SOFTWARE)
        for what, function, args in (("batch", montecarlo._simulate_rows, batch), ("one run", rollout.simulate_parts,
                                                                         (ready.parts, 0, 0))):  # fmt: skip
            start = time.perf_counter()
            lowered = function.trace(*args).lower()
            traced = time.perf_counter()
            lowered.compile()
            print(f"  {name:14s} {what:8s} traced in {traced - start:.2f} s, compiled in "
                  f"{time.perf_counter() - traced:.2f} s")  # fmt: skip


if __name__ == "__main__":
    print(machine())
    wanted = sys.argv[1:] or list(COMMANDS)
    for name in wanted:
        with tempfile.TemporaryDirectory() as cache:
            cold = run(COMMANDS[name], cache)
            warm = np.median([run(COMMANDS[name], cache) for _ in range(WARM)], axis=0)
        told = "   ".join(
            f"{what} {wall:6.2f} s ({used:6.2f} s)" for what, (wall, used) in (("cold", cold), ("warm", warm))
        )
        print(f"  ptsmc {name:42s} {told}")
        sys.stdout.flush()
    if not sys.argv[1:]:
        compiling()
