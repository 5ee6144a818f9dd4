"""Fixed-time sliding mode."""

from dataclasses import dataclass
from typing import ClassVar

import jax.numpy as jnp

from ptsmc_jax.laws.acceleration import SlidingLaw
from ptsmc_jax.numerics import guards
from ptsmc_jax.numerics.pytrees import Leaf, Vector


@dataclass(frozen=True)
class FixedTime(SlidingLaw):
    """s = v + sig^p(v'/kappa), kappa = a1 |v|^(gamma-1/p) + b1; 1 < p < 2, gamma - 1/p > 1, m > 1 > n > 0.

    alpha = kappa' v'^2/kappa - (kappa^p/p) (sig^(2-p)(v') + a2 sig^m(s) + b2 sig^n(s)) - K sign(s). Surface: Zuo,
    Non-singular fixed-time terminal sliding mode control of non-linear systems, IET Control Theory and Applications
    9(4), 2015; for attitudes Jiang, Hu, Friswell, IEEE Trans. Control Systems Technology 24(5), 2016. On s = 0 a
    component obeys v' = -a1 sig^gamma(v) - b1 sig^(1/p)(v): at zero before 1/(a1 (gamma-1)) + p/(b1 (p-1)), wherever it
    starts.
    """

    a1: Leaf  # [1/s]
    b1: Leaf  # [1/s]
    a2: Leaf  # [1/s^(2-p)]
    b2: Leaf  # [1/s^(2-p)]
    p: Leaf
    gamma: Leaf
    m: Leaf
    n: Leaf
    sign_width: Leaf
    tunable: ClassVar[tuple[str, ...]] = ("a1", "b1", "a2", "b2", "p", "gamma", "m", "n", "sign_width", "t_f")

    def surface(self, error: Vector, error_rate: Vector) -> tuple[Vector, Vector]:
        """As the class says, without K sign(s)."""
        bend = self.gamma - 1.0 / self.p
        kappa = self.a1 * guards.signed_power(jnp.abs(error), bend) + self.b1
        kappa_slope = self.a1 * bend * guards.signed_power(error, bend - 1.0)
        s = error + guards.signed_power(error_rate / kappa, self.p)
        reaching = guards.signed_power(error_rate, 2.0 - self.p)
        reaching = reaching + self.a2 * guards.signed_power(s, self.m) + self.b2 * guards.signed_power(s, self.n)
        return s, kappa_slope * error_rate * error_rate / kappa - guards.signed_power(kappa, self.p) / self.p * reaching
