"""Predefined-time sliding mode."""

from dataclasses import dataclass
from typing import ClassVar

import jax.numpy as jnp

from ptsmc_jax.laws.acceleration import AccelerationLaw
from ptsmc_jax.laws.base import Sample
from ptsmc_jax.numerics import guards
from ptsmc_jax.numerics.pytrees import Leaf, Scalar, Vector


def phi(x: Vector, q: Scalar, settling: Scalar) -> Vector:
    """Phi = pi/(2 q T) (sig^(1+q)(x) + sig^(1-q)(x)) [1/s]: x' = -Phi is at zero after T [s], wherever it starts."""
    return jnp.pi / (2.0 * q * settling) * (guards.signed_power(x, 1.0 + q) + guards.signed_power(x, 1.0 - q))


@dataclass(frozen=True)
class PredefinedTime(AccelerationLaw):
    """s = eps' + sig^(1/2)(sig^2(eps') + 2 sig^2(Phi_1(eps))), a = -Phi_2(s) - (K + 2 Phi_1 Phi_1'(eps)) sign(s).

    Phi_i is `phi` of q_i and T_i. On s = 0 the error obeys eps' = -Phi_1(eps): s is at zero within T_2, the error
    within T_1 after it, whatever the start and a disturbance |d| <= K. Sanchez-Torres, Gomez-Gutierrez, Lopez,
    Loukianov, A class of predefined-time stable dynamical systems, IMA J. Mathematical Control and Information 35,
    2018; of second order Jimenez-Rodriguez, Munoz-Vazquez, Sanchez-Torres, Defoort, Loukianov, A Lyapunov-like
    characterization of predefined-time stability, IEEE Trans. Automatic Control 65(11), 2020. Here T_1 = share t_f and
    T_2 = (1 - share) t_f.
    """

    share: Leaf  # of t_f that is T_1 [-]
    q1: Leaf  # 0 < q1 <= 1/2 [-]
    q2: Leaf  # 0 < q2 < 1 [-]
    sign_width: Leaf  # [1/s]
    tunable: ClassVar[tuple[str, ...]] = ("share", "q1", "q2", "sign_width", "t_f")

    def acceleration(self, now: Sample, error: Vector, error_rate: Vector, bound: Scalar) -> tuple[Vector, Vector]:
        """As the class says, (m,) each."""
        first, second = self.share * self.t_f, (1.0 - self.share) * self.t_f
        surface = phi(error, self.q1, first)
        squares = error_rate * jnp.abs(error_rate) + 2.0 * surface * jnp.abs(surface)
        s = error_rate + guards.signed_root(squares, jnp.zeros_like(bound))
        size = jnp.abs(error)
        # Phi_1 Phi_1' as a product without a negative power, which at zero would have no value; |x|^0 of q1 = 1/2 is 1
        power = guards.signed_power(size, 2.0 * self.q1)
        at_zero = (size == 0.0) & (self.q1 >= 0.5)
        quotient = size + jnp.where(at_zero, 1.0, guards.signed_power(size, 1.0 - 2.0 * self.q1))
        factor = (jnp.pi / (2.0 * self.q1 * first)) ** 2
        phi_slope = factor * ((1.0 + self.q1) * power + 1.0 - self.q1) * quotient
        switching = (bound + 2.0 * phi_slope) * guards.smooth_sign(s, self.sign_width)
        return -phi(s, self.q2, second) - switching, s
