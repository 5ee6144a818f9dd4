"""Super-twisting."""

from dataclasses import dataclass
from typing import ClassVar

import jax.numpy as jnp

from ptsmc_jax.laws.acceleration import AccelerationLaw
from ptsmc_jax.laws.base import Sample
from ptsmc_jax.numerics import guards
from ptsmc_jax.numerics.pytrees import Leaf, Scalar, Vector


@dataclass(frozen=True)
class SuperTwisting(AccelerationLaw):
    """s = eps' + c eps, a = -c eps' - 1.5 sqrt(L) sig^(1/2)(s) + v, v' = -1.1 L sign(s).

    Levant, Robust exact differentiation via sliding mode technique, Automatica 34(3), 1998, whose gains these are;
    Moreno, Osorio, Strict Lyapunov functions for the super-twisting algorithm, IEEE Trans. Automatic Control 57(4),
    2012. Where |d'| <= L for each component s is at zero after a finite time, without a switching input; v then is -d.
    The error follows at the rate c: no time is prescribed. v is summed up sample by sample.
    """

    surface_rate: Leaf  # c [1/s]
    lipschitz: Leaf  # bound L on each component of d' [1/s^3]
    sign_width: Leaf  # [1/s]
    tunable: ClassVar[tuple[str, ...]] = ("surface_rate", "lipschitz", "sign_width", "t_f")

    def begin(self) -> Vector:
        """V = 0 [1/s^2], (m,)."""
        return jnp.zeros(self.model.inputs)

    def step(
        self, memory: Vector, now: Sample, error: Vector, error_rate: Vector, bound: Scalar
    ) -> tuple[Vector, Vector, Vector]:
        """As the class says, (m,) each; `bound` is not used: v finds the disturbance."""
        s = error_rate + self.surface_rate * error
        root = 1.5 * jnp.sqrt(self.lipschitz) * guards.signed_root(s, self.sign_width)
        a = memory - self.surface_rate * error_rate - root
        return a, s, memory - now.dt * 1.1 * self.lipschitz * guards.smooth_sign(s, self.sign_width)
