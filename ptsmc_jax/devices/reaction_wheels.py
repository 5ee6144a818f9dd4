"""Reaction wheels: axes, torque allocation, limits and momentum. Read `wheels` first, which builds the set."""

from dataclasses import dataclass
from typing import Any

import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float

from ptsmc_jax.formulas import wheel_axes
from ptsmc_jax.numerics.pytrees import Leaf, pytree, vector


@pytree
@dataclass(frozen=True)
class Wheels:
    """Reaction wheels: torque A v on the body, stored momentum h' = -v, allocation by the pseudo-inverse of A.

    The momentum h is absolute: spin inertia times (wheel speed + a . w). The inertia J of the body therefore excludes
    the spin inertia of each wheel, J = J_total - sum I a a' (Hughes, Spacecraft Attitude Dynamics, 1986).
    """

    axes: Leaf  # (3, n) A: spin axes in body axes, unit columns
    allocation: Leaf  # (n, 3) pseudo-inverse of A
    initial: Leaf  # (n,) momentum at t = 0 [N m s]
    torque_limit: Leaf | None = None  # limit of each wheel's torque [N m]
    momentum_limit: Leaf | None = None  # limit of each wheel's momentum [N m s]


def wheels(axes: Any, initial: Any = None, torque_limit: Any = None, momentum_limit: Any = None) -> Wheels:
    """Return reaction wheels.

    Args:
        axes: spin axes (n, 3) in body axes, of any length.
        initial: momenta at t = 0 (n,) [N m s]; default 0.
        torque_limit: limit of each wheel [N m], or None.
        momentum_limit: limit of each wheel [N m s], or None.

    Raises:
        ValueError: if the axes do not span all directions.
    """
    unit = wheel_axes(axes)
    start = np.zeros(len(unit)) if initial is None else np.asarray(initial, dtype=float)
    limits = (None if v is None else vector(v) for v in (torque_limit, momentum_limit))
    return Wheels(vector(unit.T), vector(np.linalg.pinv(unit.T)), vector(start), *limits)


def spare_allocations(device: Wheels) -> Float[Array, "n n 3"]:
    """Return the allocation matrices (n, n, 3) without each of the wheels [-].

    Entry k is the pseudo-inverse of A with column k set to 0.
    """
    axes, numbers = np.asarray(device.axes), np.arange(device.axes.shape[1])
    return jnp.stack([jnp.asarray(np.linalg.pinv(axes * (numbers != k), rcond=1e-6)) for k in numbers])
