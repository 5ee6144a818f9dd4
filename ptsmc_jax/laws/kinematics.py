"""Error kinematics: the error eps that a law drives to zero, and how the plant's input moves it.

A law has one of them as its field `kinematics`. It turns the acceleration eps'' of the law into the plant's input.
"""

from dataclasses import dataclass
from typing import Any, ClassVar, NamedTuple

import jax
import jax.numpy as jnp
from jaxtyping import Array, Float

from ptsmc_jax.numerics import attitude, guards, integrators, matrices
from ptsmc_jax.numerics.pytrees import Scalar, Vector, pytree
from ptsmc_jax.plants.integrator_chain import Chain
from ptsmc_jax.plants.rigid_body import AttitudeState, Spacecraft
from ptsmc_jax.plants.second_order import System
from ptsmc_jax.signals.references import Target

State = Float[Array, " states"]


@dataclass(frozen=True)
class Kinematics:
    """The error eps of a plant that a law drives to zero, and how the input moves it: eps'' = .. + (gain) u + .. d.

    Errors, inputs and disturbances are (m,): of a spacecraft [-], [N m], [N m]; of chains and systems in their states'
    and inputs' own units. The kinematics are singular where the input does not act on the error: T(q) in (57) or
    dF/dx2 G in (29) has no inverse there.
    """

    model: Any  # the nominal plant
    additive: ClassVar[bool] = False  # the paper's q_1 - q_1f, singular where the body is, wherever the reference is
    reaching_factor: ClassVar[float] = 1.0  # rate of s after the hand-over, in units of K1: 1 in (29)

    @property
    def order(self) -> int:
        """Order n of the error's differential equation: 2, or the order of a chain."""
        return 2

    def align(self, x: Any, target: Any) -> Any:
        """The initial state in the form that the law can bring to the target, such as the sign of a quaternion."""
        return x

    def clearance(self, x: Any, target: Any) -> Scalar:
        """Distance to the singularity, 0 on it. The sign differs on its two sides. 1: there is no singularity."""
        return jnp.ones(())

    def clearance_unit(self, first: Scalar) -> Scalar:
        """Return the divisor of a run's clearances that makes them start positive; first: clearance at t = 0."""
        return jnp.where(first < 0.0, -1.0, 1.0)

    def errors(self, x: Any, target: Any) -> tuple[Vector, Vector]:
        """The error that is driven to zero, (m,), and its derivative [1/s]."""
        raise NotImplementedError

    def derivatives(self, x: Any, target: Any) -> Float[Array, "m n"]:
        """Each component of the error and its derivatives, n the order of its motion."""
        return jnp.stack(self.errors(x, target), axis=1)

    def angle(self, x: Any, target: Any) -> Scalar:
        """The scalar that settles: the angle to the reference [rad], for other plants |x_1|."""
        raise NotImplementedError

    def middle_angle(self, start: tuple[Any, Any], end: tuple[Any, Any], dt: Scalar) -> Scalar:
        """`angle` in the middle of dt [s] between two (state, target), by the error's cubic (Hermite)."""
        return guards.norm(integrators.hermite_middle(*self.errors(*start), *self.errors(*end), dt))

    def influence(self, x: Any, target: Any) -> Scalar:
        """Largest change of eps'' by a unit of disturbance, half of the paper's factor N."""
        raise NotImplementedError

    def invert(self, x: Any, target: Any, acceleration: Vector, d_hat: Vector) -> Vector:
        """Input (m,) that gives eps'' = acceleration, (m,), if the disturbance is d_hat, (m,)."""
        raise NotImplementedError

    def straight_coordinates(self, error: Vector) -> Vector:
        """The error (m,) in coordinates in which the shortest path to zero is a straight line; they vanish with it."""
        return error

    def from_straight_coordinates(self, straight: Vector) -> Vector:
        """Return the error (m,) for these straight coordinates, the inverse of `straight_coordinates`."""
        return straight


@dataclass(frozen=True)
class AttitudeKinematics(Kinematics):
    """Base of the attitude errors of a spacecraft: their angle."""

    model: Spacecraft
    reaching_factor: ClassVar[float] = 0.5  # (60)

    def angle(self, x: AttitudeState, target: Target) -> Scalar:
        """Angle between the attitude and its reference [rad]."""
        return attitude.angle(x.q, target.q)

    def middle_angle(self, start: tuple[Any, Any], end: tuple[Any, Any], dt: Scalar) -> Scalar:
        """`angle` in the middle [rad], by the cubic of the quaternion q_f* q, which is smooth where the angle is 0."""

        def turned(x: AttitudeState, target: Target) -> tuple[Array, Array]:
            rates = attitude.derivative(target.q, target.w), attitude.derivative(x.q, x.w)
            return jax.jvp(lambda q_f, q: attitude.multiply(attitude.conjugate(q_f), q), (target.q, x.q), rates)

        return attitude.rotation_angle(integrators.hermite_middle(*turned(*start), *turned(*end), dt))


@pytree
@dataclass(frozen=True)
class AdditiveKinematics(AttitudeKinematics):
    """The paper's eps_1 = q_1 - q_1f (4), singular at q4 = 0.

    That is 180 degrees from the inertial frame's identity, wherever the reference is. A law that inverts the kinematics
    cannot cross it: `align` chooses the sign of q, `clearance` is the distance to the singularity. So "bounded control"
    is not global: the bound grows like 1/q4. Between attitudes on either side of the identity the path may be the long
    way round. From 150 to -150 degrees about an axis the body turns by 300 degrees.
    """

    additive: ClassVar[bool] = True

    def align(self, x: AttitudeState, target: Target) -> AttitudeState:
        """The same attitude with the sign of q for which q4 q_f4 >= 0: the law cannot cross q4 = 0."""
        opposite = x.q[3] * target.q[3] < 0.0
        return x._replace(q=jnp.where(opposite, -x.q, x.q))

    def clearance(self, x: AttitudeState, target: Target) -> Scalar:
        """q4 counted positive on the reference's side [-]: at 0 the law is singular, beyond it cannot come back."""
        return jnp.where(target.q[3] < 0.0, -x.q[3], x.q[3])

    def errors(self, x: AttitudeState, target: Target) -> tuple[Vector, Vector]:
        """eps_1 [-] and its derivative [1/s], (4)."""
        reference_rate, _ = target.vector_rates()
        v_dot, _ = attitude.vector_rates(x.q, x.w, jnp.zeros(3))
        return x.q[:3] - target.q[:3], v_dot - reference_rate

    def influence(self, x: AttitudeState, target: Target) -> Scalar:
        """|T J^-1| / 2 with the norm of (57) [1/(kg m^2)]."""
        return 0.5 * guards.norm(attitude.t_matrix(x.q) @ self.model.inertia_inverse)

    def invert(self, x: AttitudeState, target: Target, acceleration: Vector, d_hat: Vector) -> Vector:
        """Torque [N m] for this eps_1'': w x J w - d_hat + J T^-1 (2 eps_1'' + 2 q_1f'' - T' w)."""
        _, reference_acceleration = target.vector_rates()
        t_dot_w = -0.5 * jnp.dot(x.w, x.w) * x.q[:3]  # T'(q) w of (58)
        w_dot = attitude.t_inverse_times(x.q, 2.0 * acceleration + 2.0 * reference_acceleration - t_dot_w)
        return self.model.gyroscopic(x.w) - d_hat + self.model.inertia @ w_dot


class RelativeMotion(NamedTuple):
    """Motion of the body relative to its reference; R rotates from the reference's axes to the body's."""

    q_e: Array  # (4,) error quaternion q_f* q [-]
    w_e: Array  # (3,) w - R w_f [rad/s]
    feedforward: Array  # (3,) (R w_f)' = R w_f' - w_e x R w_f [rad/s^2]


@pytree
@dataclass(frozen=True)
class MultiplicativeKinematics(AttitudeKinematics):
    """The vector part v of the error quaternion q_e = q_f* q, whatever the inertial frame.

    With R the rotation from the reference's axes to the body's and w_e = w - R w_f: v' = T(q_e) w_e / 2, and

        u = w x J w - d_hat + J (R w_f' - w_e x R w_f) + J T(q_e)^-1 (2 v'' + |w_e|^2 v / 2).

    Singular only at q_e4 = 0, a true error of 180 degrees. Under the prescribed-time law a run from rest below that
    never meets it; with an initial rate |v(0)| + t_f |v'(0)| / (e eta) < 1 is enough. `align` makes q_e4 positive at
    t = 0, and it stays so: v and -v lead along the same path, the short way round.
    """

    def align(self, x: AttitudeState, target: Target) -> AttitudeState:
        """The same attitude with the sign of q for which q_e4 >= 0."""
        opposite = jnp.dot(x.q, target.q) < 0.0
        return x._replace(q=jnp.where(opposite, -x.q, x.q))

    def clearance(self, x: AttitudeState, target: Target) -> Scalar:
        """q_e4 [-]: at 0, a true error of 180 degrees, the law is singular."""
        return jnp.dot(x.q, target.q)

    def relative(self, x: AttitudeState, target: Target) -> RelativeMotion:
        """The motion of the body relative to its reference."""
        q_e = attitude.multiply(attitude.conjugate(target.q), x.q)
        to_body = attitude.conjugate(q_e)
        w_f = attitude.rotate(to_body, target.w)
        w_e = x.w - w_f
        return RelativeMotion(q_e, w_e, attitude.rotate(to_body, target.w_dot) - attitude.cross(w_e, w_f))

    def errors(self, x: AttitudeState, target: Target) -> tuple[Vector, Vector]:
        """The vector part v [-] and its derivative [1/s]."""
        q_e, w_e, _ = self.relative(x, target)
        v_dot, _ = attitude.vector_rates(q_e, w_e, jnp.zeros(3))
        return q_e[:3], v_dot

    def influence(self, x: AttitudeState, target: Target) -> Scalar:
        """|T(q_e) J^-1| / 2 [1/(kg m^2)]."""
        q_e, *_ = self.relative(x, target)
        return 0.5 * guards.norm(attitude.t_matrix(q_e) @ self.model.inertia_inverse)

    def invert(self, x: AttitudeState, target: Target, acceleration: Vector, d_hat: Vector) -> Vector:
        """Torque [N m] for this v'' [1/s^2], by the equation above."""
        q_e, w_e, feedforward = self.relative(x, target)
        w_e_dot = attitude.t_inverse_times(q_e, 2.0 * acceleration + 0.5 * jnp.dot(w_e, w_e) * q_e[:3])
        return self.model.gyroscopic(x.w) - d_hat + self.model.inertia @ (feedforward + w_e_dot)

    def straight_coordinates(self, error: Vector) -> Vector:
        """The rotation vector of q_e [rad]: a straight line is a rotation about the eigenaxis."""
        return attitude.rotation_vector(error)

    def from_straight_coordinates(self, straight: Vector) -> Vector:
        """The vector part of the rotation's quaternion [-]."""
        return attitude.from_rotation_vector(straight)[:3]


@pytree
@dataclass(frozen=True)
class SecondOrderKinematics(Kinematics):
    """x_1 of a custom second-order system (25); the Jacobians of F and dF/dt by automatic differentiation.

    F may depend on time: a moving reference is part of it. dF/dx2 G must be invertible along the run. F(t, 0, x_2) = 0
    must hold for one x_2 only. The state x_2 goes there.
    """

    model: System

    def clearance(self, x: State, target: Scalar) -> Scalar:
        """Det of dF/dx2 G: at 0 the law is singular."""
        slope, gain = self.model.slope(target, x), self.model.input_gain(target, x)
        return matrices.determinant(slope @ gain)

    def clearance_unit(self, first: Scalar) -> Scalar:
        """The determinant at the start: the ratio does not depend on units."""
        return first

    def errors(self, x: State, target: Scalar) -> tuple[Vector, Vector]:
        """x_1 and F(t, x), (n,) each."""
        return self.model.position(x), self.model.position_rate(target, x)

    def angle(self, x: State, target: Scalar) -> Scalar:
        """|x_1|."""
        return guards.norm(self.model.position(x))

    def influence(self, x: State, target: Scalar) -> Scalar:
        """|dF/dx2 D|."""
        return guards.norm(self.model.slope(target, x) @ self.model.disturbance_gain(target, x))

    def invert(self, x: State, target: Scalar, acceleration: Vector, d_hat: Vector) -> Vector:
        """Input (n,) for this x_1'': (dF/dx2 G)^-1 (x_1'' - dF/dt - dF/dx1 F - dF/dx2 (H + D d_hat))."""
        slope, gain = self.model.slope(target, x), self.model.input_gain(target, x)
        without_input = self.model.drift(target, x) + self.model.disturbance_gain(target, x) @ d_hat
        return matrices.solve(
            slope @ gain,
            acceleration - self.model.coasting_acceleration(target, x) - slope @ without_input,
        )


@pytree
@dataclass(frozen=True)
class ChainKinematics(Kinematics):
    """x_1 of the integrator chain (35)."""

    model: Chain

    @property
    def order(self) -> int:
        """Order n of the chain."""
        return self.model.order

    def errors(self, x: State, target: Any) -> tuple[Float[Array, "1"], Float[Array, "1"]]:
        """x_1 and x_2, (1,) each: the origin is the target."""
        return x[:1], x[1:2]

    def derivatives(self, x: State, target: Any) -> Float[Array, "1 n"]:
        """The state: x_1 and its derivatives."""
        return x[None]

    def angle(self, x: State, target: Any) -> Scalar:
        """|x_1|."""
        return jnp.abs(x[0])

    def influence(self, x: State, target: Any) -> Scalar:
        """1."""
        return jnp.ones(())

    def invert(self, x: State, target: Any, acceleration: Vector, d_hat: Vector) -> Vector:
        """Input (1,) that gives x_n' = acceleration: (x_n' - f(x) - d_hat) / g(x)."""
        return (acceleration - self.model.drift(x) - d_hat) / self.model.input_gain(x)
