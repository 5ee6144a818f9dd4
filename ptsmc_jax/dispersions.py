"""What varies from trial to trial, and the draws: parts of a trial as a pure function of (seed, trial)."""

from dataclasses import dataclass, replace

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float

from ptsmc_jax import attitude, draws
from ptsmc_jax.draws import Whole
from ptsmc_jax.numerics import Leaf
from ptsmc_jax.plants import AttitudeState
from ptsmc_jax.rollout import Parts

INITIAL_ATTITUDE, INITIAL_STATE = "initial_attitude", "initial_state"


@jax.tree_util.register_dataclass
@dataclass(frozen=True)
class UniformAttitude:
    """Initial attitude uniform on SO(3): a normal 4-vector, normalised (Muller, 1959)."""

    def draw(self, key: draws.Key, nominal: Float[Array, "4"], reference: Float[Array, "4"]) -> Float[Array, "4"]:
        """Initial attitude, (4,); nominal: that of [initial]; reference: the reference at t = 0."""
        del nominal, reference
        return attitude.normalise(draws.normals(key, 4))


@jax.tree_util.register_dataclass
@dataclass(frozen=True)
class AxisAngle:
    """Initial attitude turned away from the reference at t = 0: axis uniform on the sphere, angle uniform."""

    smallest: Leaf  # [rad]
    largest: Leaf  # [rad]

    def draw(self, key: draws.Key, nominal: Float[Array, "4"], reference: Float[Array, "4"]) -> Float[Array, "4"]:
        """Initial attitude, (4,); nominal: that of [initial]; reference: the reference at t = 0."""
        del nominal
        u = draws.uniforms(key, 3)
        height, azimuth = 2.0 * u[0] - 1.0, 2.0 * np.pi * u[1]
        radius = jnp.sqrt(1.0 - height * height)
        axis = jnp.stack([radius * jnp.cos(azimuth), radius * jnp.sin(azimuth), height])
        angle = self.smallest + (self.largest - self.smallest) * u[2]
        return attitude.multiply(reference, attitude.from_rotation_vector(angle * axis))


@jax.tree_util.register_dataclass
@dataclass(frozen=True)
class NormalAttitude:
    """Initial attitude turned from the nominal one by a normal rotation vector."""

    std: Leaf  # per axis [rad]

    def draw(self, key: draws.Key, nominal: Float[Array, "4"], reference: Float[Array, "4"]) -> Float[Array, "4"]:
        """Initial attitude, (4,); nominal: that of [initial]; reference: the reference at t = 0."""
        del reference
        return attitude.multiply(nominal, attitude.from_rotation_vector(self.std * draws.normals(key, 3)))


@jax.tree_util.register_dataclass
@dataclass(frozen=True)
class UniformState:
    """Initial state of a chain, uniform about the nominal one."""

    half_width: Leaf  # (n,)

    def draw(self, key: draws.Key, nominal: Float[Array, " n"]) -> Float[Array, " n"]:
        """Initial state, (n,)."""
        return nominal + self.half_width * (2.0 * draws.uniforms(key, nominal.shape[-1]) - 1.0)


@jax.tree_util.register_dataclass
@dataclass(frozen=True)
class NormalState:
    """Initial state of a chain, normal about the nominal one."""

    std: Leaf  # (n,)

    def draw(self, key: draws.Key, nominal: Float[Array, " n"]) -> Float[Array, " n"]:
        """Initial state, (n,)."""
        return nominal + self.std * draws.normals(key, nominal.shape[-1])


@jax.tree_util.register_dataclass
@dataclass(frozen=True)
class Dispersion:
    """Everything that is drawn for a trial; what is None stays nominal."""

    attitude: UniformAttitude | AxisAngle | NormalAttitude | None = None
    state: UniformState | NormalState | None = None  # of a chain

    @property
    def varies(self) -> bool:
        """Whether anything differs from trial to trial."""
        return self.attitude is not None or self.state is not None

    def apply(self, parts: Parts, seed: Whole, trial: Whole) -> Parts:
        """The parts of one trial: a pure function of the nominal parts, the seed and the trial's number."""
        if self.state is not None:
            key = draws.stream(seed, trial, INITIAL_STATE)
            return replace(parts, initial=self.state.draw(key, parts.initial))
        if self.attitude is None:
            return parts
        key = draws.stream(seed, trial, INITIAL_ATTITUDE)
        reference = parts.reference(jnp.zeros_like(parts.t_end))
        q = self.attitude.draw(key, parts.initial.q, reference.q)
        return replace(parts, initial=AttitudeState(q, parts.initial.w))
