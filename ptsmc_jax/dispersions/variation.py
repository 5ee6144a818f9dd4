"""What varies from trial to trial: parts of a trial = at(coordinates(seed, trial)), a pure function."""

from dataclasses import dataclass, field, replace
from typing import Any

import jax.numpy as jnp
from jaxtyping import Array

from ptsmc_jax.dispersions.attitudes import Attitudes
from ptsmc_jax.dispersions.base import (
    DISTURBANCE_AMPLITUDE,
    DISTURBANCE_BIAS,
    DISTURBANCE_PHASE,
    INERTIA,
    INITIAL_ATTITUDE,
    INITIAL_RATE,
    INITIAL_STATE,
    REFERENCE,
    Coordinates,
)
from ptsmc_jax.dispersions.inertias import RelativeInertia
from ptsmc_jax.dispersions.numbers import Factor, Normal, Uniform, UniformPhase
from ptsmc_jax.numerics import draws
from ptsmc_jax.numerics.draws import Whole
from ptsmc_jax.numerics.pytrees import pytree
from ptsmc_jax.plants.rigid_body import AttitudeState, Spacecraft
from ptsmc_jax.signals import disturbances
from ptsmc_jax.simulation.rollout import Parts

# of what a trial may have more or less, by one factor: name -> where in the parts it stands
LEVELS = {
    "attitude_noise": ("sensors", "attitude_noise"),
    "rate_noise": ("sensors", "rate_noise"),
    "state_noise": ("sensors", "sigma"),
    "torque_limit": ("actuators", "torque_limit"),
}


@pytree
@dataclass(frozen=True)
class Dispersion:
    """Everything that is drawn for a trial; what is None stays nominal.

    Coordinates are numbers (n,) [-] by the name of the stream that they are drawn from.
    """

    attitude: Attitudes | None = None
    state: Uniform | Normal | None = None  # of a chain or a system
    rate: Uniform | Normal | None = None  # of a spacecraft [rad/s]
    inertia: RelativeInertia | None = None
    phase: UniformPhase | None = None
    amplitude: Factor | None = None  # of every amplitude of the disturbance
    bias: Uniform | Normal | None = None  # a constant disturbance that is added, about zero [N m]
    reference: Attitudes | None = None
    levels: dict[str, Factor] = field(default_factory=dict)  # see `LEVELS`

    @property
    def varies(self) -> bool:
        """Whether anything differs from trial to trial."""
        return bool(self.kinds)

    @property
    def kinds(self) -> dict[str, Any]:
        """What is drawn, by the name of its stream."""
        kinds = {
            INITIAL_ATTITUDE: self.attitude,
            INITIAL_STATE: self.state,
            INITIAL_RATE: self.rate,
            INERTIA: self.inertia,
            DISTURBANCE_PHASE: self.phase,
            DISTURBANCE_AMPLITUDE: self.amplitude,
            DISTURBANCE_BIAS: self.bias,
            REFERENCE: self.reference,
            **{f"{name}_level": level for name, level in self.levels.items()},
        }
        return {name: kind for name, kind in kinds.items() if kind is not None}

    def coordinates(self, seed: Whole, trial: Whole) -> Coordinates:
        """Coordinates of a trial; each name has a stream of its own, so one more of them changes no other."""
        return {
            name: (draws.normals if kind.drawn == "normal" else draws.uniforms)(
                draws.stream(seed, trial, name), kind.count
            )
            for name, kind in self.kinds.items()
        }

    def at(self, parts: Parts, coordinates: Coordinates) -> Parts:
        """The parts of the trial that has these coordinates."""
        if not self.varies:
            return parts
        if self.reference is not None:
            q = parts.reference.q
            turned = self.reference.at(coordinates[REFERENCE], q, q)
            parts = replace(parts, reference=replace(parts.reference, q=turned))
        if self.state is not None:
            parts = replace(parts, initial=self.state.at(coordinates[INITIAL_STATE], parts.initial))
        if self.attitude is not None:
            reference = parts.reference(jnp.zeros_like(parts.t_end))
            q = self.attitude.at(coordinates[INITIAL_ATTITUDE], parts.initial.q, reference.q)
            parts = replace(parts, initial=AttitudeState(q, parts.initial.w))
        if self.rate is not None:
            w = self.rate.at(coordinates[INITIAL_RATE], parts.initial.w)
            parts = replace(parts, initial=AttitudeState(parts.initial.q, w))
        if self.inertia is not None:
            body = Spacecraft(*self.inertia.at(coordinates[INERTIA]))
            parts = replace(parts, plant=body, disturbance=disturbances.on_body(parts.disturbance, body.inertia))
        for name, level in self.levels.items():
            part, key = LEVELS[name]
            device = getattr(parts, part)
            nominal = getattr(device, key)
            factor = level.at(coordinates[f"{name}_level"], jnp.ones(level.count))
            parts = replace(parts, **{part: replace(device, **{key: nominal * factor[0]})})
        return replace(parts, disturbance=self._disturbance(parts.disturbance, coordinates))

    def _disturbance(self, nominal: Any, coordinates: Coordinates) -> Any:
        found = nominal
        if self.phase is not None:
            angles = self.phase.at(coordinates[DISTURBANCE_PHASE], disturbances.values(found, "phase"))
            found = disturbances.with_values(found, "phase", angles)
        if self.amplitude is not None:
            factor = self.amplitude.at(coordinates[DISTURBANCE_AMPLITUDE], jnp.ones(self.amplitude.count))
            found = disturbances.with_values(found, "amplitude", disturbances.values(found, "amplitude") * factor)
        if self.bias is not None:
            bias = disturbances.Constant(self.bias.at(coordinates[DISTURBANCE_BIAS], jnp.zeros(self.bias.count)))
            found = disturbances.Sum((*(found.terms if isinstance(found, disturbances.Sum) else (found,)), bias))
        return found

    def apply(self, parts: Parts, seed: Whole, trial: Whole) -> Parts:
        """The parts of one trial: a pure function of the nominal parts, the seed and the trial's number."""
        return self.at(parts, self.coordinates(seed, trial))

    def values(self, parts: Parts) -> dict[str, Array]:
        """What a trial flies, read from its parts: the initial state, and what else is drawn, by name, numbers each.

        Attitudes (q1 to q4) [-], rates [rad/s], inertia [kg m^2], phases [rad], torques [N m], noises [rad, rad/s].
        """
        initial, reference = parts.initial, parts.reference(jnp.zeros_like(parts.t_end))
        found: dict[str, Array] = {"initial_angle": parts.controller.angle(initial, reference)}
        if isinstance(initial, AttitudeState):
            found |= {f"initial_q{k + 1}": initial.q[k] for k in range(4)}
            found |= {f"initial_w{k + 1}": initial.w[k] for k in range(3)}
        else:
            found |= {f"initial_x{k + 1}": initial[k] for k in range(initial.shape[-1])}
        if self.reference is not None:
            found |= {f"reference_q{k + 1}": parts.reference.q[k] for k in range(4)}
        if self.inertia is not None:
            found |= {f"inertia_{i + 1}{j + 1}": parts.plant.inertia[i, j] for i in range(3) for j in range(i, 3)}
        if self.phase is not None:
            found |= _numbered(DISTURBANCE_PHASE, disturbances.values(parts.disturbance, "phase"), self.phase.count)
        if self.amplitude is not None:
            amplitudes = disturbances.values(parts.disturbance, "amplitude")
            found |= _numbered(DISTURBANCE_AMPLITUDE, amplitudes, self.amplitude.count)
        if self.bias is not None:
            found |= _numbered(DISTURBANCE_BIAS, parts.disturbance.terms[-1].value, self.bias.count)
        for name in self.levels:
            part, key = LEVELS[name]
            value = getattr(getattr(parts, part), key)
            found |= {name: value} if value.ndim == 0 else _numbered(name, value, value.shape[0])
        return found


def _numbered(name: str, values: Array, count: int) -> dict[str, Array]:
    """The first `count` of these numbers, by name and number."""
    return {f"{name}_{k + 1}": values[k] for k in range(count)}
