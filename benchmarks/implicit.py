"""Compare implicit with explicit sampling of the paper's law: the first flight with published and with tuned gains.

`ptsmc tune` finds the tuned gains for the first flight with explicit and with implicit sampling.
"""

from ptsmc_jax.configure import configure

configure()

import numpy as np  # noqa: E402
from common import SCENARIO, say  # noqa: E402

from ptsmc_jax import scenario  # noqa: E402
from tuning.search import gains, trust  # noqa: E402
from tuning.studies import judging  # noqa: E402

EXPLICIT = {"eta": 2.86123, "delta": 0.65, "observer_gain": 902.528, "k1": 6.6261, "sign_width": 6.59698e-5}
IMPLICIT = {"eta": 2.86403, "delta": 0.6, "observer_gain": 1144.06, "k1": 8.19207}


def main() -> None:
    """Print the results on 1 000 held-out trials."""
    flight = scenario.read(SCENARIO)
    sets = {"paper's gains": gains.published_scenario(flight)}
    for name, found in (("explicit", EXPLICIT), ("implicit", IMPLICIT)):
        sets[f"tuned for {name} sampling"] = gains.in_scenario(flight, found)
    for name, one in sets.items():
        for sampling in ("explicit", "implicit"):
            simulated = scenario.replace(one, controller__sampling=sampling)
            trials = judging.judge(simulated, judging.derive_held_out_seed(0))
            errors, peaks, chattering = (
                np.asarray(getattr(trials.metrics, key)) for key in ("window_error", "peak_torque", "chattering")
            )
            interval = trust.interval(errors, trust.rms)
            assert interval is not None  # there are enough trials
            low, high = interval
            say(
                f"{name}, {sampling} sampling: RMS {trust.rms(errors):.3e} (95 %: {low:.3e} to {high:.3e}), mean peak "
                f"{peaks.mean():.3f} N m, largest {peaks.max():.3f} N m, chattering {chattering.mean():.4f} N m/s"
            )


if __name__ == "__main__":
    main()
