"""Three ways to second derivatives of a metric in three gains: seconds to compile and to run, and differences.

python benchmarks/second_derivatives.py
"""

import time
from collections.abc import Callable

from ptsmc_jax.configure import configure

configure(cache=None)  # measure the compilation too

import jax  # noqa: E402
import jax.numpy as jnp  # noqa: E402
import numpy as np  # noqa: E402
from common import machine, say, study  # noqa: E402

import ptsmc_jax as ptsmc  # noqa: E402

GAINS = {"eta": 3.1, "delta": 1.02, "observer_gain": 5.0}  # delta off a whole period, where derivatives are one-sided
STEP = 1e-4  # relative, of the differences


def main() -> None:
    """Print a row for each way."""
    parts, at = study(noise=True).parts, jnp.array(list(GAINS.values()))

    def loss(values: jax.Array) -> jax.Array:
        simulated = ptsmc.with_gains(parts, dict(zip(GAINS, values, strict=True)))
        return jnp.log(ptsmc.simulate_parts(simulated, np.uint32(0), np.uint32(0)).metrics.window_error)

    def ready(function: Callable) -> tuple[Callable, float]:
        start = time.perf_counter()
        return jax.jit(function).lower(at).compile(), time.perf_counter() - start

    say(machine())
    found, waited = {}, {}
    for name, function in {"jax.hessian": jax.hessian(loss), "jacfwd of jacfwd": jax.jacfwd(jax.jacfwd(loss))}.items():
        program, waited[name] = ready(function)
        found[name] = np.asarray(program(at))
    slope, waited["differences of jacfwd"] = ready(jax.jacfwd(loss))
    rows = [(slope(at + v) - slope(at - v)) / (2.0 * np.sum(v)) for v in np.diag(STEP * np.asarray(at))]
    found["differences of jacfwd"] = np.array(rows)
    for name, hessian in found.items():
        off = np.abs(hessian - found["jax.hessian"]).max() / np.abs(found["jax.hessian"]).max()
        say(f"{name}: compiled in {waited[name]:.1f} s, off by {off:.1e} of the largest")


main()
