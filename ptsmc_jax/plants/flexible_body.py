"""A true plant with flexible appendages or sloshing liquid; law and observer know the rigid body only."""

from dataclasses import dataclass, replace
from typing import NamedTuple

import jax.numpy as jnp
import numpy as np
from jax.typing import ArrayLike
from jaxtyping import Array, Float

from ptsmc_jax import formulas
from ptsmc_jax.numerics import attitude, guards, matrices
from ptsmc_jax.numerics.pytrees import Leaf, Scalar, pytree, vector
from ptsmc_jax.plants.rigid_body import AttitudeState, Spacecraft


class Modes(NamedTuple):
    """Modal coordinates of a flexible body, normalised to a modal mass of 1."""

    e: Array  # (n,) modal coordinates [sqrt(kg) m]
    rate: Array  # (n,) time derivatives e' [sqrt(kg) m/s]


@pytree
@dataclass(frozen=True)
class FlexibleSpacecraft(Spacecraft):
    """Spacecraft with n modes e, `coupling` D (n, 3); build it with `flexible`, which checks that J - D'D > 0.

        J w' + D' e'' = -w x (J w + D' e') + u + d,    e'' + 2 z W e' + W^2 e = -D w'

    J is the inertia of the whole body with its modes at rest. Solved for w': (J - D'D) w' = -w x (J w + D' e') + u + d
    + D' (2 z W e' + W^2 e). Gennaro, Output stabilization of flexible spacecraft with active vibration suppression,
    IEEE Trans. Aerospace and Electronic Systems 39(3), 2003. A pendulum or a mass on a spring, as which liquid sloshes,
    is such a mode. Without damping a free mode rings at W / sqrt(1 - D'D / J) about a principal axis of its own.
    `input_for` neglects the motion of the modes.
    """

    frequency: Leaf  # (n,) W, angular frequencies of the modes while the body is held [rad/s]
    damping: Leaf  # (n,) z, damping ratios of the modes [-]
    coupling: Leaf  # (n, 3) D, coupling of modes and rotation [sqrt(kg) m]
    rest_inverse: Leaf  # (3, 3) inverse of `rest_inertia`, (J - D'D)^-1 [1/(kg m^2)]

    def force(self, modes: Modes) -> Float[Array, " n"]:
        """Return the force of springs and dampers on the modes, 2 z W e' + W^2 e [sqrt(kg) m/s^2]."""
        return self.frequency * (2.0 * self.damping * modes.rate + self.frequency * modes.e)

    @property
    def rest_inertia(self) -> Float[Array, "3 3"]:
        """The inertia J - D'D [kg m^2] that multiplies w' if e'' is eliminated."""
        return self.inertia - self.coupling.T @ self.coupling

    def mass(self, t: Scalar, x: AttitudeState) -> Float[Array, "3 3"]:
        """Return J - D'D [kg m^2]."""
        return self.rest_inertia

    def generalised_force(self, t: Scalar, x: AttitudeState, u: Float[Array, "3"]) -> Float[Array, "3"]:
        """Return (J - D'D) w' without the disturbance [N m]."""
        return u - attitude.cross(x.w, self.momentum(x)) + self.coupling.T @ self.force(x.modes)

    def rate(self, t: Scalar, x: AttitudeState, u: Float[Array, "3"], disturbance: Float[Array, "3"]) -> AttitudeState:
        """Return the time derivative of the state under torque and disturbance [N m]."""
        w_dot = self.rest_inverse @ (self.generalised_force(t, x, u) + disturbance)
        e_ddot = -self.force(x.modes) - self.coupling @ w_dot
        return AttitudeState(attitude.derivative(x.q, x.w), w_dot, Modes(x.modes.rate, e_ddot))

    def visible(self, x: AttitudeState) -> AttitudeState:
        """Return attitude and rate, without the modes."""
        return x._replace(modes=None)

    def with_hidden_at_rest(self, visible: AttitudeState) -> AttitudeState:
        """Return the state with this attitude and rate, and with the modes at rest, e = e' = 0."""
        return visible._replace(modes=Modes(jnp.zeros_like(self.frequency), jnp.zeros_like(self.frequency)))

    def retract(self, x: AttitudeState, by: Float[Array, " n"]) -> AttitudeState:
        """Return the state near x, at six coordinates of a rigid body, then e [sqrt(kg) m] and e' [sqrt(kg) m/s]."""
        n = self.frequency.shape[-1]
        near = super().retract(x, by[:6])
        return near._replace(modes=Modes(x.modes.e + by[6 : 6 + n], x.modes.rate + by[6 + n :]))

    def local_coordinates(self, x: AttitudeState, other: AttitudeState) -> Float[Array, " n"]:
        """Return the local coordinates of another state: rigid body, then e [sqrt(kg) m] and e' [sqrt(kg) m/s]."""
        return jnp.concatenate(
            [super().local_coordinates(x, other), other.modes.e - x.modes.e, other.modes.rate - x.modes.rate]
        )

    def momentum(self, x: AttitudeState) -> Float[Array, "3"]:
        """Return the angular momentum in body axes, J w + D' e' [N m s]."""
        return self.inertia @ x.w + self.coupling.T @ x.modes.rate

    def modal_amplitude(self, x: AttitudeState) -> Scalar:
        """Return the amplitude of the modes, the square root of the sum of e^2 + (e'/W)^2 [sqrt(kg) m]."""
        e, rate = x.modes
        return guards.norm(jnp.concatenate([e, rate / self.frequency]))

    def with_inertia(self, inertia: Float[Array, "3 3"], inverse: Float[Array, "3 3"]) -> "FlexibleSpacecraft":
        """Return the body with another J [kg m^2], (3, 3). Its runs diverge if J - D'D is not positive definite."""
        return replace(self, inertia=inertia, inertia_inverse=inverse).with_rest_inverse()

    def with_rest_inverse(self) -> "FlexibleSpacecraft":
        """Return the body with (J - D'D)^-1 computed from J and D, or NaN if J - D'D is not positive definite."""
        inertia = self.rest_inertia
        leading_minors = (
            inertia[0, 0],
            inertia[0, 0] * inertia[1, 1] - inertia[0, 1] * inertia[1, 0],
            matrices.determinant(inertia),
        )
        is_positive_definite = jnp.all(jnp.stack(leading_minors) > 0.0)
        return replace(self, rest_inverse=jnp.where(is_positive_definite, matrices.solve(inertia, jnp.eye(3)), jnp.nan))

    def hidden_columns(self, x: AttitudeState) -> dict[str, ArrayLike]:
        """Return modal coordinates e1.. [sqrt(kg) m] and their rates e_dot1.. [sqrt(kg) m/s]."""
        return {"e": x.modes.e, "e_dot": x.modes.rate}


def flexible(inertia: object, frequency: object, damping: object, coupling: object) -> FlexibleSpacecraft:
    """Return a flexible spacecraft from its inertia and its modes.

    Args:
        inertia: inertia of the whole body with its modes at rest, in the form of `rigid_body.spacecraft` [kg m^2].
        frequency: frequency of each mode with the body held, (n,) [rad/s].
        damping: damping ratio of each mode, (n,) [-].
        coupling: coupling of each mode to the rotation, (n, 3) [sqrt(kg) m].

    Returns:
        The spacecraft.

    Raises:
        ValueError: no body can have this inertia and coupling.
    """
    tensor = formulas.check_inertia(inertia)
    rest = formulas.rest_inertia(tensor, coupling)
    inverse, rest_inverse = vector(np.linalg.inv(tensor)), vector(np.linalg.inv(rest))
    modes = vector(frequency), vector(damping), vector(coupling)
    return FlexibleSpacecraft(vector(tensor), inverse, *modes, rest_inverse)
