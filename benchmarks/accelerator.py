"""Batches on an accelerator: the scan and the whole-run kernel, in both precisions, and the arithmetic limit.

    python benchmarks/accelerator.py [LARGEST]

Print trial-steps per second of the first flight with all metrics, without and with noise, for 1e3 to LARGEST (1e6)
trials. Further rows have derivatives along eta. The limit is the time of a step's arithmetic alone, at 40 % of the
measured rate of a kernel of multiply-adds. The program needs a GPU that JAX finds (`pip install 'jax[cuda12]'`).
"""

import sys

from ptsmc_jax.configure import NoDeviceError, configure

try:
    configure(device="gpu")
except NoDeviceError as error:
    sys.exit(f"nothing to measure: {error}")

import jax
import jax.numpy as jnp
import numpy as np
from common import medians, peak_rate, row, say, step_operations, steps, study

from ptsmc_jax.batching import lanes
from ptsmc_jax.campaigns import montecarlo
from tuning.search.gains import with_gains

ATTAINABLE = 0.4  # of the rate of multiply-adds


def primal(ready, trials: int):
    """Return functions that simulate this number of trials like a campaign, by scan and by kernel."""

    def flight(whole: bool):
        block = min(trials, montecarlo.BLOCK_ON_GPU)
        return lambda: (
            montecarlo.run(ready.parts, ready.dispersion, 0, np.arange(trials), block=block, kernel=whole).metrics
        )

    return {"scan": flight(False), "kernel": flight(True)}


def slopes(ready, trials: int):
    """Return functions for metrics and their derivatives along eta, by scan and by kernel."""

    def one(eta, trial):
        return montecarlo.one(with_gains(ready.parts, {"eta": eta}), ready.dispersion, jnp.uint32(0), trial).metrics

    def flight(whole: bool):
        both = jax.jit(lanes.jvp(one, (None, 0), kernel=whole))
        return lambda: both((ready.parts.controller.eta, jnp.arange(trials, dtype=jnp.uint32)), (jnp.ones(1), None))

    return {"scan": flight(False), "kernel": flight(True)}


def main(largest: int) -> None:
    """Print the rates."""
    device = jax.devices()[0].device_kind
    say(f"{device}, jax {jax.__version__}")
    for bits in (32, 64):
        with jax.enable_x64(bits == 64):
            peak = peak_rate()
            say(f"{bits} bits: {peak / 1e12:.2f} T operations a second of multiply-adds")
            for noise in (False, True):
                ready = study(noise)
                floor = ATTAINABLE * peak / step_operations(ready)
                for what, fly in (("metrics", primal), ("slopes", slopes)):
                    for trials in (n for n in (1_000, 10_000, 100_000, 1_000_000, 10_000_000) if n <= largest):
                        seconds = medians(fly(ready, trials), repeats=5)
                        rate = {name: trials * steps(ready.parts) / s for name, s in seconds.items()}
                        told = f"{bits} bits, {what}, {'noise' if noise else 'quiet'}, {trials:,d} trials"
                        if what == "metrics":
                            told += f", kernel at {rate['kernel'] / floor:.0%} of the floor"
                        row(f"{device}: {told}: scan, kernel", rate["scan"] / 1e6, rate["kernel"] / 1e6)


if __name__ == "__main__":
    main(int(float(sys.argv[1])) if len(sys.argv) > 1 else 1_000_000)
