"""What is controlled: the rigid spacecraft of (1) and (2)."""

from dataclasses import dataclass
from typing import NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float

from ptsmc_jax import attitude
from ptsmc_jax.numerics import Leaf


class AttitudeState(NamedTuple):
    """State of a rigid spacecraft."""

    q: Array  # (4,) unit quaternion, scalar last, body relative to inertial [-]
    w: Array  # (3,) body rate in body axes [rad/s]


@jax.tree_util.register_dataclass
@dataclass(frozen=True)
class Spacecraft:
    """Rigid spacecraft, J w' = -w x J w + u + d (2); build it with `spacecraft`, which checks the inertia."""

    inertia: Leaf  # (3, 3) J [kg m^2]
    inertia_inverse: Leaf  # (3, 3) [1/(kg m^2)], factored once: no solve in the loop

    def gyroscopic(self, w: Float[Array, "3"]) -> Float[Array, "3"]:
        """W x J w [N m]."""
        return jnp.cross(w, self.inertia @ w)

    def rate(self, x: AttitudeState, torque: Float[Array, "3"], disturbance: Float[Array, "3"]) -> AttitudeState:
        """Time derivative of the state under torque and disturbance [N m], (1) and (2)."""
        w_dot = self.inertia_inverse @ (torque + disturbance - self.gyroscopic(x.w))
        return AttitudeState(attitude.derivative(x.q, x.w), w_dot)

    def normalise(self, x: AttitudeState) -> AttitudeState:
        """The state with |q| = 1 again."""
        return AttitudeState(attitude.normalise(x.q), x.w)

    def momentum(self, x: AttitudeState) -> Float[Array, "3"]:
        """Angular momentum in body axes, J w [N m s]."""
        return self.inertia @ x.w


def spacecraft(inertia: object) -> Spacecraft:
    """Spacecraft from three principal moments or a symmetric (3, 3) tensor [kg m^2].

    Raises ValueError where no rigid body can have it: not symmetric, not positive definite, or one principal moment
    larger than the sum of the other two.
    """
    tensor = check_inertia(inertia)
    return Spacecraft(jnp.asarray(tensor), jnp.asarray(np.linalg.inv(tensor)))


def check_inertia(inertia: object) -> np.ndarray:
    """The (3, 3) inertia tensor [kg m^2] that `spacecraft` would use; raises ValueError as it does."""
    try:
        tensor = np.asarray(inertia)
        if not np.issubdtype(tensor.dtype, np.number):
            raise TypeError
        tensor = tensor.astype(float)
    except (ValueError, TypeError):  # rows of different lengths, or no numbers
        tensor = np.zeros(0)
    if tensor.shape == (3,):
        tensor = np.diag(tensor)
    if tensor.shape != (3, 3):
        raise ValueError("allowed are three principal moments or a symmetric 3x3 tensor [kg m^2]")
    if not np.all(np.isfinite(tensor)):
        raise ValueError("every entry must be a finite number")
    scale = np.abs(tensor).max()
    if np.abs(tensor - tensor.T).max() > 1e-9 * scale:
        raise ValueError("the tensor must be symmetric")
    tensor = (tensor + tensor.T) / 2
    moments = np.linalg.eigvalsh(tensor)
    if moments[0] <= 1e-12 * scale:
        raise ValueError(f"the tensor must be positive definite (its smallest principal moment is {moments[0]:.6g})")
    if moments[2] > (moments[0] + moments[1]) * (1 + 1e-9):
        raise ValueError(
            "no rigid body has these principal moments: the largest, "
            f"{moments[2]:.6g}, must not exceed the sum of the other two, {moments[0] + moments[1]:.6g}"
        )
    return tensor
