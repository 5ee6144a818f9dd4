"""Errors of single precision: metrics of the same trials with 32 and with 64 bits.

python benchmarks/precision.py [TRIALS]
"""

import sys

from ptsmc_jax.configure import configure

configure()

import jax  # noqa: E402
import numpy as np  # noqa: E402
from common import SCENARIO, machine, say  # noqa: E402

from ptsmc_jax import scenario  # noqa: E402
from ptsmc_jax.campaigns import montecarlo  # noqa: E402

FLIGHT = scenario.replace(scenario.read(SCENARIO), tune=None)
AWAY = {"quat_xyzw": [0.5, 0.5, 0.5, 0.5]}
CASES = {
    "first flight, paper's gains": FLIGHT,
    "first flight, tuned, exact sign, flight clock": scenario.replace(
        FLIGHT, controller__eta=2.857, controller__delta=0.384, observer__gain=[7.03] * 3, controller__sign_width=0.0,
        loop__clock="flight",
    ),
    "without noise": scenario.replace(FLIGHT, hardware=None),
    "without noise, to a reference 120 degrees from the inertial axes": scenario.replace(
        FLIGHT, hardware=None, reference=AWAY, controller__error="multiplicative"
    ),
}  # fmt: skip
SHOWN = "terminal_error window_error peak_torque settling_time".split()


def simulated(one: scenario.Scenario, trials: int) -> montecarlo.Trials:
    """Return the trials in the current precision."""
    ready = scenario.study(one)
    return montecarlo.run(ready.parts, ready.dispersion, 3, np.arange(trials))


if __name__ == "__main__":
    trials = int(sys.argv[1]) if len(sys.argv) > 1 else 1000
    say(machine())
    for name, one in CASES.items():
        double = simulated(one, trials)
        with jax.enable_x64(False):
            single = simulated(one, trials)
        same = int(np.sum(double.status == single.status))
        say(f"\n{name}: {same} of {trials} with the same status")
        for metric in SHOWN:
            a, b = (np.asarray(getattr(t.metrics, metric), dtype=float) for t in (double, single))
            known = np.isfinite(a) & np.isfinite(b)
            rms = [float(np.sqrt(np.mean(v[known] ** 2))) for v in (a, b)]
            say(f"  {metric:15} RMS {rms[0]:.4g}, off by {rms[1] / rms[0] - 1:+.1e}; "
                f"a trial off by {np.abs(a - b)[known].max():.1e} at most")  # fmt: skip
