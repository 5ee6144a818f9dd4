"""What stands between the law and the plant: here the sensors."""

from dataclasses import dataclass
from typing import Any, Protocol

import jax
import jax.numpy as jnp
from jaxtyping import Array, Float, Int

from ptsmc_jax import attitude, draws
from ptsmc_jax.draws import Whole
from ptsmc_jax.numerics import Leaf
from ptsmc_jax.plants import AttitudeState

ATTITUDE_NOISE, RATE_NOISE, STATE_NOISE = "attitude_noise", "rate_noise", "state_noise"


class Sensor(Protocol):
    """What the rollout asks of a sensor; its noise belongs to (seed, trial, sample)."""

    def keys(self, seed: Whole, trial: Whole) -> Any:
        """Streams of a trial's noise."""
        ...

    def noise(self, keys: Any, sample: Int[Array, ""]) -> Any:
        """Noise of one sample."""
        ...

    def measure(self, x: Any, noise: Any) -> Any:
        """The state as measured."""
        ...


@jax.tree_util.register_dataclass
@dataclass(frozen=True)
class Sensors:
    """Star tracker and gyro sampled once a period, white noise, independent per axis and sample."""

    attitude_noise: Leaf  # 1 sigma of the small rotation about each body axis [rad]
    rate_noise: Leaf  # 1 sigma [rad/s]

    def keys(self, seed: Whole, trial: Whole) -> tuple[draws.Key, draws.Key]:
        """Streams of a trial's noise, one for each sensor."""
        return draws.stream(seed, trial, ATTITUDE_NOISE), draws.stream(seed, trial, RATE_NOISE)

    def noise(
        self, keys: tuple[draws.Key, draws.Key], sample: Int[Array, ""]
    ) -> tuple[Float[Array, "3"], Float[Array, "3"]]:
        """Attitude [rad] and rate [rad/s] noise of one sample, (3,) each."""
        return (
            self.attitude_noise * draws.normals(keys[0], 3, sample),
            self.rate_noise * draws.normals(keys[1], 3, sample),
        )

    def measure(self, x: AttitudeState, noise: tuple[Float[Array, "3"], Float[Array, "3"]]) -> AttitudeState:
        """The state as measured: attitude turned by a small rotation in body axes, rate with noise added."""
        turned = attitude.multiply(x.q, attitude.from_rotation_vector(noise[0]))
        return AttitudeState(turned, jnp.add(x.w, noise[1]))


@jax.tree_util.register_dataclass
@dataclass(frozen=True)
class StateSensor:
    """All states of a chain sampled once a period, white noise, independent per state and sample."""

    sigma: Leaf  # (n,) 1 sigma of each state

    def keys(self, seed: Whole, trial: Whole) -> draws.Key:
        """Stream of a trial's noise."""
        return draws.stream(seed, trial, STATE_NOISE)

    def noise(self, keys: draws.Key, sample: Int[Array, ""]) -> Float[Array, " n"]:
        """Noise of one sample, (n,)."""
        return self.sigma * draws.normals(keys, self.sigma.shape[-1], sample)

    def measure(self, x: Float[Array, " n"], noise: Float[Array, " n"]) -> Float[Array, " n"]:
        """The states as measured."""
        return x + noise
