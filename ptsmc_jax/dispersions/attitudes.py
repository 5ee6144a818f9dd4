"""Attitudes that are drawn."""

from dataclasses import dataclass
from typing import ClassVar

import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float

from ptsmc_jax.dispersions.base import Drawn
from ptsmc_jax.numerics import attitude
from ptsmc_jax.numerics.pytrees import Leaf, pytree


@pytree
@dataclass(frozen=True)
class UniformAttitude:
    """An attitude uniform on SO(3): a normal 4-vector, normalised (Muller, 1959)."""

    drawn: ClassVar[Drawn] = "normal"
    count: ClassVar[int] = 4

    def at(self, c: Float[Array, "4"], nominal: Float[Array, "4"], reference: Float[Array, "4"]) -> Float[Array, "4"]:
        """Attitude [-] (4,) of the body or the reference; nominal: its own; reference: the reference's at t = 0."""
        del nominal, reference
        return attitude.normalise(c)


@pytree
@dataclass(frozen=True)
class AxisAngle:
    """An attitude turned away from the reference at t = 0: axis uniform on the sphere, angle uniform."""

    smallest: Leaf  # [rad]
    largest: Leaf  # [rad]
    drawn: ClassVar[Drawn] = "uniform"
    count: ClassVar[int] = 3

    def at(self, c: Float[Array, "3"], nominal: Float[Array, "4"], reference: Float[Array, "4"]) -> Float[Array, "4"]:
        """Attitude [-] (4,) of the body or the reference; nominal: its own; reference: the reference's at t = 0."""
        del nominal
        height, azimuth = 2.0 * c[0] - 1.0, 2.0 * np.pi * c[1]
        radius = jnp.sqrt(1.0 - height * height)
        axis = jnp.stack([radius * jnp.cos(azimuth), radius * jnp.sin(azimuth), height])
        angle = self.smallest + (self.largest - self.smallest) * c[2]
        return attitude.multiply(reference, attitude.from_rotation_vector(angle * axis))


@pytree
@dataclass(frozen=True)
class NormalAttitude:
    """An attitude turned from the nominal one by a normal rotation vector."""

    std: Leaf  # per axis [rad]
    drawn: ClassVar[Drawn] = "normal"
    count: ClassVar[int] = 3

    def at(self, c: Float[Array, "3"], nominal: Float[Array, "4"], reference: Float[Array, "4"]) -> Float[Array, "4"]:
        """Attitude [-] (4,) of the body or the reference; nominal: its own; reference: the reference's at t = 0."""
        del reference
        return attitude.multiply(nominal, attitude.from_rotation_vector(self.std * c))


Attitudes = UniformAttitude | AxisAngle | NormalAttitude
