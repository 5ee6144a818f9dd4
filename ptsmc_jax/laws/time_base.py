"""Time-base generators: a profile from the first error to zero at t_f, and a law that follows it."""

from dataclasses import dataclass
from typing import ClassVar, NamedTuple

import jax
import jax.numpy as jnp

from ptsmc_jax.laws.base import AccelerationLaw, Sample
from ptsmc_jax.numerics import guards
from ptsmc_jax.numerics.pytrees import Leaf, Scalar, Vector, pytree


class Start(NamedTuple):
    """Where a profile begins."""

    measured: Scalar  # 1.0 from the first sample on, before it 0.0
    error: Vector  # the first error, in its `Kinematics.straight_coordinates`
    rate: Vector  # and its derivative [1/s]


class Profile(NamedTuple):
    """The error that is to be followed, with its derivatives, (m,) each."""

    error: Vector
    rate: Vector
    acceleration: Vector


@dataclass(frozen=True)
class TimeBase(AccelerationLaw):
    """Follows r(x) = e0 (1 - 10 x^3 + 15 x^4 - 6 x^5) + e0' t_f (x - 6 x^3 + 8 x^4 - 3 x^5), x = t/t_f, then 0.

    The quintic that begins with the first error and its rate, as they are measured, and is at rest at zero at t_f, in
    coordinates in which straight lines are plain: a spacecraft at rest turns about the eigenaxis. Becerra, Vazquez,
    Arechavaleta, Delfin, Predefined-time convergence control for high-order integrator systems using time base
    generators, IEEE Trans. Control Systems Technology 26(5), 2018. From rest it asks for 10/sqrt(3) e0/t_f^2 at most,
    the paper's law at the start for eta^2 e0/t_f^2, bang-bang for 4.
    """

    def begin(self) -> Start:
        """Before the first sample the profile is not known."""
        zero = jnp.zeros(self.model.inputs)
        return Start(jnp.zeros(()), zero, zero)

    def profile(self, start: Start, t: Scalar) -> Profile:
        """The profile at t [s]."""

        def error(t: Scalar) -> Vector:
            x = jnp.minimum(t / self.t_f, 1.0)
            of_error = 1.0 + x**3 * (-10.0 + x * (15.0 - 6.0 * x))
            of_rate = x * (1.0 + x**2 * (-6.0 + x * (8.0 - 3.0 * x)))
            return self.kinematics.from_straight_coordinates(of_error * start.error + self.t_f * of_rate * start.rate)

        def rates(t: Scalar) -> tuple[Vector, Vector]:
            return jax.jvp(error, (t,), (jnp.ones_like(t),))

        (r, rate), (_, acceleration) = jax.jvp(rates, (t,), (jnp.ones_like(t),))
        return Profile(r, rate, acceleration)

    def feedback(self, deviation: Vector, rate: Vector, bound: Scalar) -> tuple[Vector, Vector]:
        """Acceleration that brings the deviation E from the profile to zero, and the sliding variable, (m,) each.

        rate: E' [1/s], (m,); bound: as in `Law.acceleration`.
        """
        raise NotImplementedError

    def acceleration(
        self, now: Sample, error: Vector, error_rate: Vector, bound: Scalar
    ) -> tuple[Vector, Vector, Start]:
        """Return the acceleration of the profile with the feedback, s, (m,) each, and where the profile began."""
        straight, rate = jax.jvp(self.kinematics.straight_coordinates, (error,), (error_rate,))
        start = guards.select(now.memory.measured > 0.5, now.memory, Start(jnp.ones_like(now.t), straight, rate))
        profile = self.profile(start, now.t)
        a, s = self.feedback(error - profile.error, error_rate - profile.rate, bound)
        return profile.acceleration + a, s, start


@pytree
@dataclass(frozen=True)
class TimeBasePD(TimeBase):
    """a = r'' - k_d E' - k_p E with E = eps - r; its s is E' + (k_p/k_d) E."""

    k_p: Leaf  # [1/s^2]
    k_d: Leaf  # [1/s]
    tunable: ClassVar[tuple[str, ...]] = ("k_p", "k_d", "t_f")

    def feedback(self, deviation: Vector, rate: Vector, bound: Scalar) -> tuple[Vector, Vector]:
        """Return a - r'' and s, (m,) each."""
        return -self.k_d * rate - self.k_p * deviation, rate + self.k_p / self.k_d * deviation


@pytree
@dataclass(frozen=True)
class TimeBaseSliding(TimeBase):
    """s = E' + c E with E = eps - r, a = r'' - c E' - k s - K sign(s)."""

    surface_rate: Leaf  # c [1/s]
    k: Leaf  # [1/s]
    sign_width: Leaf  # in the units of s
    tunable: ClassVar[tuple[str, ...]] = ("surface_rate", "k", "sign_width", "t_f")

    def feedback(self, deviation: Vector, rate: Vector, bound: Scalar) -> tuple[Vector, Vector]:
        """Return a - r'' and s, (m,) each."""
        s = rate + self.surface_rate * deviation
        return -self.surface_rate * rate - self.k * s - bound * guards.smooth_sign(s, self.sign_width), s
