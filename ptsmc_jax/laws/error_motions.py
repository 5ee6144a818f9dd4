"""The errors that laws drive to zero, each with how inputs and disturbances move it: eps'' = .. + (gain) u + .. d.

A law has one of them as a base, which turns the eps'' that it asks for into the plant's input.
"""

from typing import Any, ClassVar, NamedTuple

import jax
import jax.numpy as jnp
from jaxtyping import Array, Float

from ptsmc_jax.numerics import attitude, guards, integrators, matrices
from ptsmc_jax.numerics.pytrees import Scalar, Vector
from ptsmc_jax.plants.integrator_chain import Chain
from ptsmc_jax.plants.rigid_body import AttitudeState, Spacecraft
from ptsmc_jax.plants.second_order import System
from ptsmc_jax.signals.references import Target

State = Float[Array, " states"]


class ErrorMotion:
    """The error eps of a plant that a law drives to zero, and how the input moves it.

    Errors, inputs and disturbances are (m,): of a spacecraft [-], [N m], [N m]; of chains and systems in their states'
    and inputs' own units. It is singular where the input has no say in the error, T(q) in (57) or dF/dx2 G in (29).
    """

    model: Any  # the nominal plant
    additive: ClassVar[bool] = False  # the paper's q_1 - q_1f, singular where the body is, wherever the reference is

    def align(self, x: Any, target: Any) -> Any:
        """The initial state in the form that the law can bring to the target, such as the sign of a quaternion."""
        return x

    def clearance(self, x: Any, target: Any) -> Scalar:
        """How far the law is from a singularity of its own: 0 on it, of either sign beside it; 1 where it has none."""
        return jnp.ones(())

    def clearance_unit(self, first: Scalar) -> Scalar:
        """The unit of a run's clearances, from that of its initial state: its sign, so that they begin above 0."""
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
        """The factor N: how much a unit of disturbance changes 2 eps'' at most."""
        raise NotImplementedError

    def invert(self, x: Any, target: Any, twice_acceleration: Vector, d_hat: Vector) -> Vector:
        """Input (m,) for which 2 eps'' is `twice_acceleration`, (m,), if the disturbance is d_hat, (m,)."""
        raise NotImplementedError

    def straight_coordinates(self, error: Vector) -> Vector:
        """The error (m,) in coordinates in which the shortest path to zero is a straight line; they vanish with it."""
        return error

    def from_straight_coordinates(self, straight: Vector) -> Vector:
        """The error (m,) where those coordinates are these."""
        return straight


class AttitudeMotion(ErrorMotion):
    """Base of a spacecraft's errors: their angle."""

    model: Spacecraft

    def angle(self, x: AttitudeState, target: Target) -> Scalar:
        """Angle between the attitude and its reference [rad]."""
        return attitude.angle(x.q, target.q)

    def middle_angle(self, start: tuple[Any, Any], end: tuple[Any, Any], dt: Scalar) -> Scalar:
        """`angle` in the middle [rad], by the cubic of the quaternion q_f* q, which is smooth where the angle is 0."""

        def turned(x: AttitudeState, target: Target) -> tuple[Array, Array]:
            rates = attitude.derivative(target.q, target.w), attitude.derivative(x.q, x.w)
            return jax.jvp(lambda q_f, q: attitude.multiply(attitude.conjugate(q_f), q), (target.q, x.q), rates)

        return attitude.rotation_angle(integrators.hermite_middle(*turned(*start), *turned(*end), dt))


class ErrorVector(AttitudeMotion):
    """The paper's eps_1 = q_1 - q_1f (4); singular at q4 = 0, see `prescribed_time.PrescribedTime`."""

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
        """|T J^-1| of (57) [1/(kg m^2)]."""
        return guards.norm(attitude.t_matrix(x.q) @ self.model.inertia_inverse)

    def invert(self, x: AttitudeState, target: Target, twice_acceleration: Vector, d_hat: Vector) -> Vector:
        """Torque [N m] for 2 eps_1'' = `twice_acceleration`: w x J w - d_hat + J T^-1 (2 eps_1'' + 2 q_1f'' - T' w)."""
        _, reference_acceleration = target.vector_rates()
        t_dot_w = -0.5 * jnp.dot(x.w, x.w) * x.q[:3]  # T'(q) w of (58)
        w_dot = attitude.t_inverse_times(x.q, twice_acceleration + 2.0 * reference_acceleration - t_dot_w)
        return self.model.gyroscopic(x.w) - d_hat + self.model.inertia @ w_dot


class RelativeMotion(NamedTuple):
    """Motion of the body relative to its reference; R rotates from the reference's axes to the body's."""

    q_e: Array  # (4,) error quaternion q_f* q [-]
    w_e: Array  # (3,) w - R w_f [rad/s]
    feedforward: Array  # (3,) (R w_f)' = R w_f' - w_e x R w_f [rad/s^2]


class ErrorQuaternion(AttitudeMotion):
    """The vector part v of the error quaternion q_e = q_f* q, whatever the inertial frame.

    With R the rotation from the reference's axes to the body's and w_e = w - R w_f: v' = T(q_e) w_e / 2.
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
        """|T(q_e) J^-1| [1/(kg m^2)]."""
        q_e, *_ = self.relative(x, target)
        return guards.norm(attitude.t_matrix(q_e) @ self.model.inertia_inverse)

    def invert(self, x: AttitudeState, target: Target, twice_acceleration: Vector, d_hat: Vector) -> Vector:
        """Torque [N m] for 2 v'' = `twice_acceleration` [1/s^2]; see `PrescribedTimeMultiplicative`."""
        q_e, w_e, feedforward = self.relative(x, target)
        w_e_dot = attitude.t_inverse_times(q_e, twice_acceleration + 0.5 * jnp.dot(w_e, w_e) * q_e[:3])
        return self.model.gyroscopic(x.w) - d_hat + self.model.inertia @ (feedforward + w_e_dot)

    def straight_coordinates(self, error: Vector) -> Vector:
        """The rotation vector of q_e [rad]: a straight line is a rotation about the eigenaxis."""
        return attitude.rotation_vector(error)

    def from_straight_coordinates(self, straight: Vector) -> Vector:
        """The vector part of the rotation's quaternion [-]."""
        return attitude.from_rotation_vector(straight)[:3]


class ErrorOfSystem(ErrorMotion):
    """x_1 of a second-order system (25) of one's own; the Jacobians of F and dF/dt by automatic differentiation."""

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
        """2 |dF/dx2 D|."""
        return 2.0 * guards.norm(self.model.slope(target, x) @ self.model.disturbance_gain(target, x))

    def invert(self, x: State, target: Scalar, twice_acceleration: Vector, d_hat: Vector) -> Vector:
        """Input (n,) for this x_1'': (dF/dx2 G)^-1 (x_1'' - dF/dt - dF/dx1 F - dF/dx2 (H + D d_hat))."""
        slope, gain = self.model.slope(target, x), self.model.input_gain(target, x)
        without_input = self.model.drift(target, x) + self.model.disturbance_gain(target, x) @ d_hat
        return matrices.solve(
            slope @ gain,
            0.5 * twice_acceleration - self.model.coasting_acceleration(target, x) - slope @ without_input,
        )


class ErrorOfChain(ErrorMotion):
    """x_1 of the integrator chain (35); it can be inverted for order 2, (6)."""

    model: Chain

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
        """2."""
        return 2.0 * jnp.ones(())

    def invert(self, x: State, target: Any, twice_acceleration: Vector, d_hat: Vector) -> Vector:
        """Input (1,) for this x_1'': (x_1'' - f(x) - d_hat) / g(x)."""
        return (0.5 * twice_acceleration - self.model.drift(x) - d_hat) / self.model.input_gain(x)
