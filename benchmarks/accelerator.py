"""Batches on an accelerator: the scan and the whole-run kernel, in both precisions, beside the arithmetic floor.

    python benchmarks/accelerator.py [LARGEST]

Prints trajectory-steps a second of the first flight, without noise and with it, all metrics, from 1e3 to LARGEST (1e6)
trials. Needs a GPU that JAX finds (`pip install 'jax[cuda12]'`); without one it says so and ends.
"""

import sys

from ptsmc_jax.configure import NoDeviceError, configure

try:
    configure(device="gpu")
except NoDeviceError as error:
    sys.exit(f"nothing to measure: {error}")

import jax
import numpy as np
from common import medians, say, steps, study

from ptsmc_jax import montecarlo


def rates(noise: bool, trials: int) -> dict[str, float]:
    """Million trajectory-steps a second of scan and kernel."""
    ready = study(noise)
    numbers = np.arange(trials)

    def flight(kernel: bool):
        return lambda: (
            montecarlo.run(
                ready.parts, ready.dispersion, 0, numbers, block=min(trials, montecarlo.ABREAST), kernel=kernel
            ).metrics
        )

    seconds = medians({"scan": flight(False), "kernel": flight(True)}, repeats=5)
    return {name: trials * steps(ready.parts) / s / 1e6 for name, s in seconds.items()}


if __name__ == "__main__":
    largest = int(float(sys.argv[1])) if len(sys.argv) > 1 else 1_000_000
    say(f"{jax.devices()[0].device_kind}, jax {jax.__version__}")
    for bits in (32, 64):
        with jax.enable_x64(bits == 64):
            for noise in (False, True):
                for trials in (n for n in (1_000, 10_000, 100_000, 1_000_000, 10_000_000) if n <= largest):
                    found = rates(noise, trials)
                    ratio = found["kernel"] / found["scan"]
                    told = f"{bits} bits, {'noise' if noise else 'quiet'}, {trials:9,d} trials"
                    say(f"{told}: scan {found['scan']:.1f} M, kernel {found['kernel']:.1f} M, {ratio:.1f} times")
