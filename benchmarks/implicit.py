"""Implicit beside explicit sampling of the paper's law: the first flight with the paper's gains and with tuned ones."""

from ptsmc_jax.configure import configure

configure()

import numpy as np  # noqa: E402
from common import SCENARIO, say  # noqa: E402

from ptsmc_jax import scenario  # noqa: E402
from tuning.search import gains  # noqa: E402
from tuning.studies import judging  # noqa: E402

TUNED = {"eta": 2.861, "delta": 0.65, "observer_gain": 902.0, "k1": 6.63}  # for explicit sampling, as in the README


def main() -> None:
    """Judged on 1 000 fresh trials."""
    flight = scenario.read(SCENARIO)
    for name, one in (("paper's gains", gains.papers(flight)), ("tuned", gains.in_scenario(flight, TUNED))):
        for sampling in ("explicit", "implicit"):
            flown = scenario.replace(one, controller__sampling=sampling)
            trials = judging.judge(flown, judging.seed_of_judge(0), scenario.study(flown).requirements)
            errors, peaks, chattering = (
                np.asarray(getattr(trials.metrics, key)) for key in ("window_error", "peak_torque", "chattering")
            )
            say(
                f"{name}, {sampling}: RMS {np.sqrt(np.mean(errors**2)):.3e}, mean peak {peaks.mean():.3f} N m, "
                f"largest {peaks.max():.3f} N m, chattering {chattering.mean():.4f} N m/s"
            )


if __name__ == "__main__":
    main()
