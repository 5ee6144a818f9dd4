"""Custom sensors: user-defined classes that return the measured state for the true state x, and may have a memory.

The interface is measured, memory = see(memory, x, n, t, dt), where n are standard normal numbers of the trial and the
sample. Read `SampledSensor` first.
"""

from dataclasses import dataclass, replace
from typing import Any, ClassVar

import jax.numpy as jnp
from jaxtyping import Array, Float, Int, PyTree

from ptsmc_jax import declare
from ptsmc_jax.devices.sensors import Sensor
from ptsmc_jax.devices.ticks import Ticks
from ptsmc_jax.numerics import draws, guards
from ptsmc_jax.numerics.draws import WholeNumber
from ptsmc_jax.numerics.pytrees import Leaf, Scalar, pytree

CUSTOM_NOISE = "own_noise"  # name of the random stream; another name would give other random numbers


@dataclass(frozen=True)
class SampledSensor(declare.Tunable):
    """Base class of custom sensors, which need a sampled loop.

    The simulator passes `draws` standard normal numbers [-] for each sample. The memory is any pytree of arrays; by
    default there is none.
    """

    draws: ClassVar[int] = 0
    model: Any  # design model of the plant, as law and observer know it

    def begin(self, x: PyTree) -> PyTree:
        """Return the memory before the first sample; x: true state at the first sample."""
        return None

    def see(
        self, memory: PyTree, x: PyTree, noise: Float[Array, " draws"], t: Scalar, dt: Scalar
    ) -> tuple[PyTree, PyTree]:
        """Return the measured state and the new memory.

        Args:
            memory: from `begin` or from the last sample.
            x: true state: (q, w) of a spacecraft, or (n,) of another plant.
            noise: standard normal numbers of the sample (draws,) [-].
            t: time of the sample [s].
            dt: time since the last sample [s]; 0 at the first sample.

        Returns:
            The measured state, in the form of x, and the memory with unchanged shapes and types.
        """
        raise NotImplementedError


@pytree
@dataclass(frozen=True)
class CustomSensors(Sensor):
    """Adapter of custom sensors to the `Sensor` interface. The noise depends on (seed, trial, sample)."""

    custom: SampledSensor
    noise_scale: Leaf  # factor of the noise: 1, or 0 for no noise [-]

    def noise(self, key: draws.Key, sample: Int[Array, ""]) -> Float[Array, " draws"]:
        """Return the noise of one sample, (draws,) [-]."""
        return self.noise_scale * draws.normals(key, self.custom.draws, sample) if self.custom.draws else jnp.zeros(0)

    def begin(self, seed: WholeNumber, trial: WholeNumber, x0: PyTree, now: Ticks) -> tuple:
        """Return the memory before the first sample; see `Sensor.begin`."""
        key = draws.stream(seed, trial, CUSTOM_NOISE)
        return key, self.noise(key, now.sample), self.custom.begin(x0)

    def measure(self, memory: tuple, x: PyTree, now: Ticks, dt: Scalar, star_x: None = None) -> tuple[PyTree, tuple]:
        """Return the measured state and the memory. A period of length 0 does not change the memory."""
        key, noise, sensor_memory = memory
        noise_next = self.noise(key, now.sample + 1)
        measured, new = self.custom.see(sensor_memory, x, guards.lerp(now.noise_weight, noise, noise_next), now.t, dt)
        return measured, (key, noise_next, guards.select(now.t_next > now.t, new, sensor_memory))

    def without_noise(self) -> "CustomSensors":
        """Return the sensors with all standard normal numbers set to zero."""
        return replace(self, noise_scale=0.0 * self.noise_scale)
