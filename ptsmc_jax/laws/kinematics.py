"""Error kinematics: the error eps that a law drives to zero, and the inverse dynamics from eps'' to the input.

Every law has kinematics as its field `kinematics`. Read `Kinematics` first, then `AdditiveKinematics`, the attitude
error of the paper.
"""

from dataclasses import dataclass
from typing import Any, ClassVar, NamedTuple

import jax
import jax.numpy as jnp
from jax.tree_util import Partial
from jaxtyping import Array, Float, PyTree

from ptsmc_jax.numerics import attitude, guards, integrators, matrices
from ptsmc_jax.numerics.pytrees import Function, Scalar, Vector, is_function, pytree
from ptsmc_jax.plants.base import Plant
from ptsmc_jax.plants.integrator_chain import Chain
from ptsmc_jax.plants.rigid_body import AttitudeState, Spacecraft
from ptsmc_jax.plants.second_order import System
from ptsmc_jax.signals.references import Target, TurningFunction

State = Float[Array, " states"]


@dataclass(frozen=True)
class Kinematics:
    """Base of the error kinematics: the error eps, its derivatives, and the input for a commanded eps''.

    Errors, inputs and disturbances are (m,). Their units are [-], [N m] and [N m] for a spacecraft; for chains and
    systems they are in the states' and inputs' own units. At a singularity the input does not act on the error, because
    T(q) in (57) or dF/dx2 G in (29) has no inverse.
    """

    model: Plant  # design model
    # whether the error is q_1 - q_1f, as in the paper, which is singular at body attitudes of 180 deg
    additive: ClassVar[bool] = False
    symbol: ClassVar[str] = "$|x_1|$"  # symbol of the error's norm in figures
    error_unit: ClassVar[str] = ""  # unit of error and sliding variable; empty if it depends on the plant
    angle_unit: ClassVar[str] = "x1"  # unit of `angle`
    reaching_factor: ClassVar[float] = 1.0  # ratio of the decay rate of s in the hold phase to the gain K1; 1 in (29)

    @property
    def order(self) -> int:
        """Order n of the error's differential equation: 2, or the order of a chain."""
        return 2

    def reference_from(self, function: Any) -> Any:
        """Return a reference, a pytree, from a function of time. A reference is returned unchanged."""
        return Function(function) if is_function(function) else function

    def align(self, x: PyTree, target: PyTree) -> PyTree:
        """Return the same initial state in the representation that the law needs, such as the other sign of q."""
        return x

    def singularity_distance(self, x: PyTree, target: PyTree) -> Scalar:
        """Return the signed distance to the singularity: 0 on it, and 1 everywhere if there is none."""
        return jnp.ones(())

    def singularity_distance_unit(self, first: Scalar) -> Scalar:
        """Return the number that divides the distances to the singularity of a run, so that the first is positive.

        Args:
            first: distance to the singularity at t = 0.
        """
        return jnp.where(first < 0.0, -1.0, 1.0)

    def errors(self, x: PyTree, target: PyTree) -> tuple[Vector, Vector]:
        """Return the error eps and its time derivative [1/s], (m,) each."""
        raise NotImplementedError

    def derivatives(self, x: PyTree, target: PyTree) -> Float[Array, "m n"]:
        """Return the error and its time derivatives up to order n - 1, (m, n)."""
        return jnp.stack(self.errors(x, target), axis=1)

    def angle(self, x: PyTree, target: PyTree) -> Scalar:
        """Return the size of the error: the angle to the reference [rad], or |x_1| for other plants in their unit."""
        raise NotImplementedError

    def middle_angle(self, start: tuple[PyTree, PyTree], end: tuple[PyTree, PyTree], dt: Scalar) -> Scalar:
        """Return `angle` in the middle of an interval, from the cubic Hermite polynomial of the error.

        Args:
            start: state and target at the start.
            end: state and target at the end.
            dt: length of the interval [s].

        Returns:
            The angle [rad], or |x_1| for other plants in their unit.
        """
        return guards.norm(integrators.hermite_middle(*self.errors(*start), *self.errors(*end), dt))

    def influence(self, x: PyTree, target: PyTree) -> Scalar:
        """Return the largest change of eps'' for a disturbance of norm 1, half of the paper's factor |T J^-1|."""
        raise NotImplementedError

    def invert(self, x: PyTree, target: PyTree, acceleration: Vector, d_hat: Vector) -> Vector:
        """Return the input (m,) that makes eps'' equal to a commanded acceleration.

        Args:
            x: state.
            target: target of the reference.
            acceleration: commanded eps'', (m,).
            d_hat: estimated disturbance, (m,).
        """
        raise NotImplementedError

    def straight_coordinates(self, error: Vector) -> Vector:
        """Map an error (m,) to coordinates where a straight line to 0 is the shortest path to zero error."""
        return error

    def from_straight_coordinates(self, straight: Vector) -> Vector:
        """Map straight coordinates (m,) to the error (m,); the inverse of `straight_coordinates`."""
        return straight


@dataclass(frozen=True)
class AttitudeKinematics(Kinematics):
    """Base of the attitude errors of a spacecraft."""

    model: Spacecraft
    reaching_factor: ClassVar[float] = 0.5  # K1/2 in (60)
    symbol: ClassVar[str] = "|v|"
    error_unit: ClassVar[str] = "-"
    angle_unit: ClassVar[str] = "rad"

    def reference_from(self, function: Any) -> Any:
        """Return a reference from a function of time that gives a quaternion or a `Target`."""
        return TurningFunction(function if isinstance(function, Partial) else Partial(function))

    def angle(self, x: AttitudeState, target: Target) -> Scalar:
        """Return the angle between the attitude and the reference [rad]."""
        return attitude.angle(x.q, target.q)

    def middle_angle(self, start: tuple[PyTree, PyTree], end: tuple[PyTree, PyTree], dt: Scalar) -> Scalar:
        """Return `angle` in the middle [rad], from the cubic Hermite polynomial of q_f* q; smooth at angle 0."""

        def error_quaternion_and_rate(x: AttitudeState, target: Target) -> tuple[Array, Array]:
            rates = attitude.derivative(target.q, target.w), attitude.derivative(x.q, x.w)
            return jax.jvp(lambda q_f, q: attitude.multiply(attitude.conjugate(q_f), q), (target.q, x.q), rates)

        return attitude.rotation_angle(
            integrators.hermite_middle(*error_quaternion_and_rate(*start), *error_quaternion_and_rate(*end), dt)
        )


@pytree
@dataclass(frozen=True)
class AdditiveKinematics(AttitudeKinematics):
    """The additive error eps_1 = q_1 - q_1f of the paper (4), which is singular at q4 = 0.

    At q4 = 0 the body is 180 degrees away from the inertial frame, for any reference. A law that inverts the kinematics
    cannot cross the singularity. So `align` chooses the sign of q, and `singularity_distance` measures the
    distance.
    The paper's bounded control is not global, because the bound grows like 1/q4. The body does not always take the
    shorter path: from 150 to -150 degrees about an axis it rotates by 300 degrees.
    """

    additive: ClassVar[bool] = True
    symbol: ClassVar[str] = r"|$\varepsilon_1$|"

    def align(self, x: AttitudeState, target: Target) -> AttitudeState:
        """Return the same attitude with the sign of q that makes q4 q_f4 >= 0, since the law cannot cross q4 = 0."""
        opposite = x.q[3] * target.q[3] < 0.0
        return x._replace(q=jnp.where(opposite, -x.q, x.q))

    def singularity_distance(self, x: AttitudeState, target: Target) -> Scalar:
        """Return q4 [-] with the sign that is positive on the reference's side. At 0 the law is singular."""
        return jnp.where(target.q[3] < 0.0, -x.q[3], x.q[3])

    def errors(self, x: AttitudeState, target: Target) -> tuple[Vector, Vector]:
        """Return eps_1 [-] and its time derivative [1/s] by (4), (3,) each."""
        reference_rate, _ = attitude.vector_rates(*target)
        v_dot, _ = attitude.vector_rates(x.q, x.w, jnp.zeros(3))
        return x.q[:3] - target.q[:3], v_dot - reference_rate

    def influence(self, x: AttitudeState, target: Target) -> Scalar:
        """Return |T(q) J^-1| / 2 of (57), a bound on the change of eps'' per torque; Frobenius norm [1/(kg m^2)]."""
        return 0.5 * guards.norm(attitude.t_matrix(x.q) @ self.model.inertia_inverse)

    def invert(self, x: AttitudeState, target: Target, acceleration: Vector, d_hat: Vector) -> Vector:
        """Return the torque w x J w - d_hat + J T^-1 (2 eps_1'' + 2 q_1f'' - T' w) (3,) [N m], by (4)."""
        _, reference_acceleration = attitude.vector_rates(*target)  # q_1f''
        t_dot_w = -0.5 * jnp.dot(x.w, x.w) * x.q[:3]  # T'(q) w of (58)
        w_dot = attitude.t_inverse_times(x.q, 2.0 * acceleration + 2.0 * reference_acceleration - t_dot_w)
        return self.model.gyroscopic(x.w) - d_hat + self.model.inertia @ w_dot


class RelativeMotion(NamedTuple):
    """Motion of the body relative to the reference. R rotates vectors from reference axes to body axes."""

    q_e: Array  # (4,) error quaternion q_f* q [-]
    w_e: Array  # (3,) w - R w_f [rad/s]
    feedforward: Array  # (3,) (R w_f)' = R w_f' - w_e x R w_f [rad/s^2]


@pytree
@dataclass(frozen=True)
class MultiplicativeKinematics(AttitudeKinematics):
    """The multiplicative error: the vector part v of q_e = q_f* q. It does not depend on the inertial frame.

    With R the rotation from reference axes to body axes and w_e = w - R w_f, v' = T(q_e) w_e / 2 and

        u = w x J w - d_hat + J (R w_f' - w_e x R w_f) + J T(q_e)^-1 (2 v'' + |w_e|^2 v / 2).

    The only singularity is q_e4 = 0, an error angle of 180 degrees. Under the prescribed-time law a run from rest with
    a smaller angle never reaches it. With an initial rate, |v(0)| + t_f |v'(0)| / (e eta) < 1 is sufficient. `align`
    makes q_e4 positive at t = 0, and it remains positive. So the body takes the shorter path for either sign of q.
    """

    def align(self, x: AttitudeState, target: Target) -> AttitudeState:
        """Return the same attitude with the sign of q that makes q_e4 >= 0."""
        opposite = jnp.dot(x.q, target.q) < 0.0
        return x._replace(q=jnp.where(opposite, -x.q, x.q))

    def singularity_distance(self, x: AttitudeState, target: Target) -> Scalar:
        """Return q_e4 [-], which is 0 at an error angle of 180 degrees."""
        return jnp.dot(x.q, target.q)

    def relative(self, x: AttitudeState, target: Target) -> RelativeMotion:
        """Return the motion of the body relative to the reference."""
        q_e = attitude.multiply(attitude.conjugate(target.q), x.q)
        to_body = attitude.conjugate(q_e)
        w_f = attitude.rotate(to_body, target.w)
        w_e = x.w - w_f
        return RelativeMotion(q_e, w_e, attitude.rotate(to_body, target.w_dot) - attitude.cross(w_e, w_f))

    def errors(self, x: AttitudeState, target: Target) -> tuple[Vector, Vector]:
        """Return the vector part v [-] and its time derivative [1/s], (3,) each."""
        q_e, w_e, _ = self.relative(x, target)
        v_dot, _ = attitude.vector_rates(q_e, w_e, jnp.zeros(3))
        return q_e[:3], v_dot

    def influence(self, x: AttitudeState, target: Target) -> Scalar:
        """Return |T(q_e) J^-1| / 2, with the Frobenius norm [1/(kg m^2)]."""
        q_e, *_ = self.relative(x, target)
        return 0.5 * guards.norm(attitude.t_matrix(q_e) @ self.model.inertia_inverse)

    def invert(self, x: AttitudeState, target: Target, acceleration: Vector, d_hat: Vector) -> Vector:
        """Return the torque (3,) [N m] for a commanded v'' [1/s^2], by the equation of the class."""
        q_e, w_e, feedforward = self.relative(x, target)
        w_e_dot = attitude.t_inverse_times(q_e, 2.0 * acceleration + 0.5 * jnp.dot(w_e, w_e) * q_e[:3])
        return self.model.gyroscopic(x.w) - d_hat + self.model.inertia @ (feedforward + w_e_dot)

    def straight_coordinates(self, error: Vector) -> Vector:
        """Return the rotation vector of q_e [rad]. A straight line is a rotation about the eigenaxis."""
        return attitude.rotation_vector(error)

    def from_straight_coordinates(self, straight: Vector) -> Vector:
        """Return the vector part [-] of the quaternion of a rotation vector [rad]."""
        return attitude.from_rotation_vector(straight)[:3]


@pytree
@dataclass(frozen=True)
class SecondOrderKinematics(Kinematics):
    """The error x_1 of a custom second-order system (25). Jacobians of F are computed by automatic differentiation.

    F may depend on time, for example through a moving reference. dF/dx2 G must be invertible during the whole run. The
    equation F(t, 0, x_2) = 0 must have a single solution x_2; the state x_2 converges to it.
    """

    model: System

    def singularity_distance(self, x: State, target: Scalar) -> Scalar:
        """Return the determinant of dF/dx2 G, which is 0 at a singularity."""
        jacobian, gain = self.model.rate_jacobian(target, x), self.model.input_gain(target, x)
        return matrices.determinant(jacobian @ gain)

    def singularity_distance_unit(self, first: Scalar) -> Scalar:
        """Return the determinant at t = 0. The distances of a run, divided by it, do not depend on units."""
        return first

    def errors(self, x: State, target: Scalar) -> tuple[Vector, Vector]:
        """Return x_1 and its time derivative F(t, x), (m,) each."""
        return self.model.position(x), self.model.position_rate(target, x)

    def angle(self, x: State, target: Scalar) -> Scalar:
        """Return the norm of x_1."""
        return guards.norm(self.model.position(x))

    def influence(self, x: State, target: Scalar) -> Scalar:
        """Return |dF/dx2 D|, with the Frobenius norm."""
        return guards.norm(self.model.rate_jacobian(target, x) @ self.model.disturbance_gain(target, x))

    def invert(self, x: State, target: Scalar, acceleration: Vector, d_hat: Vector) -> Vector:
        """Return the input (dF/dx2 G)^-1 (x_1'' - dF/dt - dF/dx1 F - dF/dx2 (H + D d_hat)), (m,)."""
        jacobian, gain = self.model.rate_jacobian(target, x), self.model.input_gain(target, x)
        without_input = self.model.drift(target, x) + self.model.disturbance_gain(target, x) @ d_hat
        return matrices.solve(
            jacobian @ gain,
            acceleration - self.model.coasting_acceleration(target, x) - jacobian @ without_input,
        )


@pytree
@dataclass(frozen=True)
class ChainKinematics(Kinematics):
    """The error x_1 of the integrator chain (35), whose target is the origin."""

    model: Chain

    @property
    def order(self) -> int:
        """Order n of the chain."""
        return self.model.order

    def errors(self, x: State, target: PyTree) -> tuple[Float[Array, "1"], Float[Array, "1"]]:
        """Return x_1 and x_2, (1,) each."""
        return x[:1], x[1:2]

    def derivatives(self, x: State, target: PyTree) -> Float[Array, "1 n"]:
        """Return the state, x_1 and its time derivatives, as a row (1, n)."""
        return x[None]

    def angle(self, x: State, target: PyTree) -> Scalar:
        """Return |x_1|."""
        return jnp.abs(x[0])

    def influence(self, x: State, target: PyTree) -> Scalar:
        """Return 1: d is a term of the n-th derivative of x_1."""
        return jnp.ones(())

    def invert(self, x: State, target: PyTree, acceleration: Vector, d_hat: Vector) -> Vector:
        """Return the input (x_n' - f(x) - d_hat) / g(x) (1,) for a commanded x_n', the n-th derivative of x_1."""
        return (acceleration - self.model.drift(x) - d_hat) / self.model.input_gain(x)
