"""Laws that track a time-base generator: a profile of the error from its first value to zero at t_f.

`TimeBase` defines the profile. `TimeBasePD` and `TimeBaseSliding` differ in the feedback of the deviation from it.
"""

import math
from collections.abc import Mapping
from dataclasses import dataclass
from typing import Any, ClassVar, NamedTuple

import jax
import jax.numpy as jnp

from ptsmc_jax.declare import Rates, Scaled, gain
from ptsmc_jax.laws.base import ComparisonLaw, Sample, boundary_layer
from ptsmc_jax.numerics import guards
from ptsmc_jax.numerics.pytrees import Leaf, Scalar, Vector, pytree


class ProfileStart(NamedTuple):
    """Initial values of a profile, the memory of the law."""

    measured: Scalar  # whether the profile is defined: 0.0 before the first sample, then 1.0
    error: Vector  # error at the first sample, in `Kinematics.straight_coordinates`
    rate: Vector  # time derivative of `error` [1/s]


class Profile(NamedTuple):
    """Desired error and its time derivatives, (m,) each."""

    error: Vector
    rate: Vector  # [1/s]
    acceleration: Vector  # [1/s^2]


@dataclass(frozen=True)
class TimeBase(ComparisonLaw):
    """Follow a quintic profile from the first measured error to zero at t_f.

    The profile is the quintic that starts at the measured error e0 with its rate e0' and is at rest at zero at t_f:

        r(x) = e0 (1 - 10 x^3 + 15 x^4 - 6 x^5) + e0' t_f (x - 6 x^3 + 8 x^4 - 3 x^5),  x = t/t_f,

    and zero after t_f. It is computed in `Kinematics.straight_coordinates`, so that a spacecraft at rest rotates about
    the eigenaxis. Becerra, Vazquez, Arechavaleta, Delfin, Predefined-time convergence control for high-order integrator
    systems using time base generators, IEEE Trans. Control Systems Technology 26(5), 2018. From rest, the largest
    acceleration is 10/sqrt(3) e0/t_f^2. For comparison, the law of the paper starts with eta^2 e0/t_f^2, and bang-bang
    control needs 4 e0/t_f^2.
    """

    def begin(self) -> ProfileStart:
        """Return the memory before the first sample, when the profile is not defined yet."""
        zero = jnp.zeros(self.model.inputs)
        return ProfileStart(jnp.zeros(()), zero, zero)

    def profile(self, start: ProfileStart, t: Scalar) -> Profile:
        """Return the desired error at the time t [s] and its derivatives, for a profile that begins at `start`."""

        def desired_error(t: Scalar) -> Vector:
            x = jnp.minimum(t / self.t_f, 1.0)
            from_error = 1.0 + x**3 * (-10.0 + x * (15.0 - 6.0 * x))
            from_rate = x * (1.0 + x**2 * (-6.0 + x * (8.0 - 3.0 * x)))
            straight = from_error * start.error + self.t_f * from_rate * start.rate
            return self.kinematics.from_straight_coordinates(straight)

        def rates(t: Scalar) -> tuple[Vector, Vector]:
            return jax.jvp(desired_error, (t,), (jnp.ones_like(t),))

        (r, rate), (_, acceleration) = jax.jvp(rates, (t,), (jnp.ones_like(t),))
        return Profile(r, rate, acceleration)

    def feedback(self, deviation: Vector, rate: Vector, bound: Scalar) -> tuple[Vector, Vector]:
        """Return the acceleration that drives the deviation from the profile to zero, and the sliding variable.

        Args:
            deviation: E = eps - r, (m,).
            rate: E' [1/s], (m,).
            bound: bound on the 2-norm of the disturbance that is not estimated, in the units of the acceleration.

        Returns:
            a - r'' and s, (m,) each.
        """
        raise NotImplementedError

    def acceleration(
        self, now: Sample, error: Vector, error_rate: Vector, bound: Scalar
    ) -> tuple[Vector, Vector, ProfileStart]:
        """Return a, s, (m,) each, and the initial values of the profile; see `Law.acceleration`."""
        straight, rate = jax.jvp(self.kinematics.straight_coordinates, (error,), (error_rate,))
        start = guards.select(now.memory.measured > 0.5, now.memory, ProfileStart(jnp.ones_like(now.t), straight, rate))
        profile = self.profile(start, now.t)
        a, s = self.feedback(error - profile.error, error_rate - profile.rate, bound)
        return profile.acceleration + a, s, start

    def half_turn_rate(self, t_f: float) -> tuple[str, Scalar | float]:
        """Return "t_f", and the body rate in the middle of half a turn [rad/s]."""
        return "t_f", 15.0 / 8.0 * math.pi / t_f


@pytree
@dataclass(frozen=True)
class TimeBasePD(TimeBase):
    """PD tracking of a quintic profile of the error that ends at zero at t_f (Becerra and others 2018).

    a = r'' - k_d E' - k_p E with E = eps - r; its s is E' + (k_p/k_d) E. r is the profile of `TimeBase`.
    """

    k_p: Leaf = gain(
        Scaled(1.0, time=-2), Rates(2.0, 0.25, 2, sampled=True), unit="1/s^2",
        meaning="gain on the deviation of the error from its profile",
    )  # fmt: skip
    k_d: Leaf = gain(
        Scaled(2.0, time=-1), Rates(0.3, 1.0, sampled=True), unit="1/s", meaning="gain on the rate of that deviation"
    )
    switches: ClassVar[bool] = False

    def feedback(self, deviation: Vector, rate: Vector, bound: Scalar) -> tuple[Vector, Vector]:
        """Return -k_d E' - k_p E, and the sliding variable E' + k_p / k_d E, (m,) each."""
        return -self.k_d * rate - self.k_p * deviation, rate + self.k_p / self.k_d * deviation

    @staticmethod
    def designed(design: Any, published: Mapping[str, float]) -> Mapping[str, float]:
        """Return gains that put both poles of the tracking loop at the designed pole."""
        return {"k_p": design.pole**2, "k_d": 2.0 * design.pole}


@pytree
@dataclass(frozen=True)
class TimeBaseSliding(TimeBase):
    """Sliding mode tracking of a quintic profile of the error that ends at zero at t_f (Becerra and others 2018).

    s = E' + c E with E = eps - r, a = r'' - c E' - k s - K sign(s). r is the profile of `TimeBase`.
    """

    surface_rate: Leaf = gain(
        Scaled(1.0, time=-1), Rates(0.3, 1.0, sampled=True), unit="1/s", meaning="c, rate on the surface"
    )
    k: Leaf = gain(Scaled(1.0, time=-1), Rates(0.3, 1.0, sampled=True), unit="1/s", meaning="rate of s")
    sign_width: Leaf = boundary_layer(Scaled(1e-3, time=-1), "1/s")

    def feedback(self, deviation: Vector, rate: Vector, bound: Scalar) -> tuple[Vector, Vector]:
        """Return -c E' - k s - K sign(s), and the sliding variable s = E' + c E, (m,) each."""
        s = rate + self.surface_rate * deviation
        return -self.surface_rate * rate - self.k * s - bound * guards.smooth_sign(s, self.sign_width), s

    @staticmethod
    def designed(design: Any, published: Mapping[str, float]) -> Mapping[str, float]:
        """Return gains that put both poles of the tracking loop at the designed pole."""
        return {"surface_rate": design.pole, "k": design.pole, "sign_width": design.width}
