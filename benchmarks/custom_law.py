"""Compare the paper's law, written as a custom law, with the built-in law: equal bits, and both times."""

from ptsmc_jax.configure import configure

configure()

import jax  # noqa: E402
import jax.numpy as jnp  # noqa: E402
import numpy as np  # noqa: E402
from common import machine, medians, say, study  # noqa: E402

import ptsmc_jax as ptsmc  # noqa: E402
from ptsmc_jax.campaigns import montecarlo  # noqa: E402

TRIALS = 16_384


class Papers(ptsmc.AccelerationLaw):
    """(56) to (60) for eps'' = a + d."""

    eta: float = ptsmc.gain(3.0, (2.1, 6.0), above=2.0)
    k1: float = ptsmc.gain(1.0, (0.03, 20.0), unit="1/s")
    sign_width: float = ptsmc.gain(1e-3, (1e-5, 1e-1))

    def acceleration(self, now, error, error_rate, bound):
        """Half of what (57) and (60) want of 2 eps''."""
        left = jnp.where(now.hold, 1.0, self.t_f - now.t)
        s = left * error_rate + jnp.where(now.hold, 1.0, self.eta) * error
        a = jnp.where(now.hold, 2.0, 2.0 * (self.eta - 1.0) / left)
        b = jnp.where(now.hold, self.k1, 2.0 * self.eta / left**2)
        return 0.5 * (-2.0 * bound * jnp.tanh(s * (1.0 / self.sign_width)) - a * error_rate - b * s), s


def main() -> None:
    """Simulate the same trials with both laws, with noise."""
    law = {"kind": "custom", "code": Papers, "error": "additive", "t_f": 35.0, "delta": 0.5}
    both = {
        "built in": study(noise=True, controller__delta=0.5),
        "custom": study(noise=True, tune=None, controller=law),
    }
    trials = np.arange(TRIALS)
    simulated = {name: montecarlo.run(one.parts, one.dispersion, 0, trials) for name, one in both.items()}
    apart = [
        float(np.nanmax(np.abs(np.asarray(mine) - np.asarray(other)) / np.maximum(np.abs(np.asarray(other)), 1e-300)))
        for mine, other in zip(*(jax.tree.leaves(one.metrics) for one in simulated.values()), strict=True)
        if np.isfinite(other).any()
    ]
    times = medians(
        {name: lambda one=one: montecarlo.run(one.parts, one.dispersion, 0, trials) for name, one in both.items()}
    )
    say(machine())
    say(f"{TRIALS} trials: largest relative difference of any metric {max(apart):.1e}")
    custom, built_in = times["custom"], times["built in"]
    say(f"custom over built in: {custom / built_in:.3f}  ({custom:.3f} s, {built_in:.3f} s)")


if __name__ == "__main__":
    main()
