"""Sensors of one's own: at a sample they turn the true state x into the measured one, and may remember something.

measured, memory = see(memory, x, n, t, dt), with n standard normal numbers of the trial and the sample.
"""

from dataclasses import dataclass, replace
from typing import Any, ClassVar

import jax.numpy as jnp
from jaxtyping import Array, Float, Int

from ptsmc_jax import declare
from ptsmc_jax.devices.sensors import Sensor
from ptsmc_jax.devices.ticks import Ticks
from ptsmc_jax.numerics import draws, guards
from ptsmc_jax.numerics.draws import WholeNumber
from ptsmc_jax.numerics.pytrees import Leaf, Scalar, pytree

OWN_NOISE = "own_noise"


@dataclass(frozen=True)
class SampledSensor(declare.Tunable):
    """The base of sensors of one's own; they fly in the sampled loop.

    `draws` standard normal numbers are drawn for each sample, [-]. Their memory is any pytree of arrays; `begin`'s
    default is none.
    """

    draws: ClassVar[int] = 0
    model: Any  # the plant as law and observer know it

    def begin(self, x: Any) -> Any:
        """The memory before the first sample, at which the true state is x."""
        return None

    def see(self, memory: Any, x: Any, noise: Float[Array, " draws"], t: Scalar, dt: Scalar) -> tuple[Any, Any]:
        """The state as the law sees it, and the memory, from the true state x at t [s]; noise: (draws,) [-].

        dt: time since the sample before [s], 0 at the first. What is seen has the form of x: (q, w) of a spacecraft,
        (n,) of another plant; the memory keeps its shapes and types.
        """
        raise NotImplementedError


@pytree
@dataclass(frozen=True)
class OwnSensors(Sensor):
    """Sensors of one's own as the rollout asks for them: with noise that belongs to (seed, trial, sample)."""

    own: Any  # `SampledSensor`
    noise_scale: Leaf  # 1, or 0 without noise [-]

    def noise(self, key: draws.Key, sample: Int[Array, ""]) -> Float[Array, " draws"]:
        """Noise of one sample, (draws,) [-]."""
        return self.noise_scale * draws.normals(key, self.own.draws, sample) if self.own.draws else jnp.zeros(0)

    def begin(self, seed: WholeNumber, trial: WholeNumber, x0: Any, now: Ticks) -> tuple:
        """Memory before the first sample of positive length [s], which is now."""
        key = draws.stream(seed, trial, OWN_NOISE)
        return key, self.noise(key, now.sample), self.own.begin(x0)

    def measure(self, memory: tuple, x: Any, now: Ticks, dt: Scalar, star_x: None = None) -> tuple[Any, tuple]:
        """The measured state, and the memory; a period without a length [s] does not change the memory."""
        key, noise, own_memory = memory
        noise_next = self.noise(key, now.sample + 1)
        measured, new = self.own.see(own_memory, x, guards.lerp(now.noise_weight, noise, noise_next), now.t, dt)
        return measured, (key, noise_next, guards.select(now.t_next > now.t, new, own_memory))

    def quiet(self) -> "OwnSensors":
        """The sensors with all their standard normal numbers zero."""
        return replace(self, noise_scale=0.0 * self.noise_scale)
