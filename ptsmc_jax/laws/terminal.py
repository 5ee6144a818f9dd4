"""Nonsingular terminal sliding mode."""

from dataclasses import dataclass
from typing import ClassVar

from ptsmc_jax.laws.acceleration import SlidingLaw
from ptsmc_jax.numerics import guards
from ptsmc_jax.numerics.pytrees import Leaf, Vector


@dataclass(frozen=True)
class Terminal(SlidingLaw):
    """s = v + sig^p(v')/b, alpha = -(b/p) sig^(2-p)(v') - k s - K sign(s), with sig^a(x) = sign(x) |x|^a, 1 < p < 2.

    Feng, Yu, Man, Non-singular terminal sliding mode control of rigid manipulators, Automatica 38(12), 2002. On s = 0 a
    component is at zero after |v|^(1 - 1/p) p / ((p - 1) b^(1/p)), the later the farther it starts.
    """

    p: Leaf  # [-]
    b: Leaf  # [1/s^p]
    k: Leaf  # [1/s^2]
    sign_width: Leaf
    tunable: ClassVar[tuple[str, ...]] = ("p", "b", "k", "sign_width", "t_f")

    def surface(self, error: Vector, error_rate: Vector) -> tuple[Vector, Vector]:
        """As the class says, without K sign(s)."""
        s = error + guards.signed_power(error_rate, self.p) / self.b
        return s, -self.b / self.p * guards.signed_power(error_rate, 2.0 - self.p) - self.k * s
