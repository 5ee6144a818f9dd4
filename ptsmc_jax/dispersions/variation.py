"""What varies from trial to trial: parts of a trial = at(coordinates(seed, trial)), a pure function."""

from collections.abc import Iterable
from dataclasses import dataclass, field, replace
from typing import Any

import jax.numpy as jnp
from jaxtyping import Array

from ptsmc_jax.dispersions import quantities
from ptsmc_jax.dispersions.attitudes import Attitudes
from ptsmc_jax.dispersions.base import (
    DISTURBANCE_AMPLITUDE,
    DISTURBANCE_BIAS,
    DISTURBANCE_PHASE,
    INERTIA,
    INITIAL_ATTITUDE,
    INITIAL_RATE,
    INITIAL_STATE,
    OWN,
    REFERENCE,
    Coordinates,
    Draw,
)
from ptsmc_jax.dispersions.inertias import RelativeInertia
from ptsmc_jax.dispersions.misfits import Misfit
from ptsmc_jax.dispersions.numbers import Factor, Normal, Uniform, UniformPhase
from ptsmc_jax.dispersions.quantities import LEVELS, QUANTITIES
from ptsmc_jax.numerics import draws
from ptsmc_jax.numerics.draws import WholeNumber
from ptsmc_jax.numerics.pytrees import pytree
from ptsmc_jax.signals import disturbances
from ptsmc_jax.simulation.rollout import Parts

# stream -> what of `Dispersion` it is drawn by
FIELDS = {
    INITIAL_ATTITUDE: "attitude",
    INITIAL_STATE: "state",
    INITIAL_RATE: "rate",
    INERTIA: "inertia",
    DISTURBANCE_PHASE: "phase",
    DISTURBANCE_AMPLITUDE: "amplitude",
    DISTURBANCE_BIAS: "bias",
    REFERENCE: "reference",
    OWN: "own",
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
    misfits: dict[str, Misfit] = field(default_factory=dict)  # see `misfits.MISFITS`
    own: Draw | None = None  # anything of one's own, drawn after all else

    @property
    def varies(self) -> bool:
        """Whether anything differs from trial to trial."""
        return bool(self.kinds)

    @property
    def kinds(self) -> dict[str, Any]:
        """What is drawn, by the name of its stream."""
        kinds = {name: getattr(self, field) for name, field in FIELDS.items()}
        kinds |= {quantities.level(name): level for name, level in self.levels.items()}
        kinds |= self.misfits
        return {name: kind for name, kind in kinds.items() if kind is not None}

    def coordinates(self, seed: WholeNumber, trial: WholeNumber) -> Coordinates:
        """Coordinates of a trial; each name has a stream of its own, so one more of them changes no other."""
        kinds, found = self.kinds, {}
        for law in draws.DISTRIBUTIONS:
            counts = {name: kind.count for name, kind in kinds.items() if kind.drawn == law}
            found |= draws.several(seed, trial, law, counts) if counts else {}
        return {name: found[name] for name in kinds}

    def at(self, parts: Parts, coordinates: Coordinates) -> Parts:
        """The parts of the trial that has these coordinates."""
        if not self.varies:
            return parts
        if self.reference is not None:
            q = parts.reference.q
            turned = self.reference.at(coordinates[REFERENCE], q, q)
            parts = replace(parts, reference=replace(parts.reference, q=turned))
        if self.state is not None:
            seen = self.state.at(coordinates[INITIAL_STATE], parts.plant.visible(parts.initial))
            parts = replace(parts, initial=parts.plant.with_hidden_at_rest(seen))
        if self.attitude is not None:
            reference = parts.reference(jnp.zeros_like(parts.t_end))
            q = self.attitude.at(coordinates[INITIAL_ATTITUDE], parts.initial.q, reference.q)
            parts = replace(parts, initial=parts.initial._replace(q=q))
        if self.rate is not None:
            w = self.rate.at(coordinates[INITIAL_RATE], parts.initial.w)
            parts = replace(parts, initial=parts.initial._replace(w=w))
        if self.inertia is not None:
            plant: Any = parts.plant
            parts = quantities.with_body(parts, plant.with_inertia(*self.inertia.at(coordinates[INERTIA])))
        for name, level in self.levels.items():
            part, key = LEVELS[name]
            device = getattr(parts, part)
            nominal = getattr(device, key)
            factor = level.at(coordinates[quantities.level(name)], jnp.ones(level.count))
            parts = replace(parts, **{part: replace(device, **{key: nominal * factor[0]})})
        for name, misfit in self.misfits.items():
            parts = QUANTITIES[name].write(parts, misfit.at(coordinates[name], parts))
        parts = replace(parts, disturbance=self._disturbance(parts.disturbance, coordinates))
        return parts if self.own is None else self.own.at(coordinates[OWN], parts)

    def _disturbance(self, nominal: Any, coordinates: Coordinates) -> Any:
        found = nominal
        if self.phase is not None:
            angles = self.phase.at(coordinates[DISTURBANCE_PHASE], disturbances.values(found, "phase"))
            found = disturbances.with_values(found, "phase", angles)
        if self.amplitude is not None:
            factor = self.amplitude.at(coordinates[DISTURBANCE_AMPLITUDE], jnp.ones(self.amplitude.count))
            found = disturbances.with_values(found, "amplitude", disturbances.values(found, "amplitude") * factor)
        if self.bias is not None:
            bias = self.bias.at(coordinates[DISTURBANCE_BIAS], jnp.zeros(self.bias.count))
            found = disturbances.with_bias(found, bias)
        return found

    def apply(self, parts: Parts, seed: WholeNumber, trial: WholeNumber) -> Parts:
        """The parts of one trial: a pure function of the nominal parts, the seed and the trial's number."""
        return self.at(parts, self.coordinates(seed, trial))

    def values(self, parts: Parts, given: Iterable[str] = ()) -> dict[str, Array]:
        """What a trial flies, read from its parts: the initial state, what else is drawn and what is given.

        By the columns of `quantities`, numbers each: attitudes (q1 to q4) [-], rates [rad/s], inertia [kg m^2], phases
        [rad], torques [N m], noises [rad, rad/s].
        """
        angle = parts.controller.angle(parts.initial, parts.reference(jnp.zeros_like(parts.t_end)))
        names = {INITIAL_ATTITUDE, INITIAL_RATE, INITIAL_STATE, *self.kinds, *given}
        return {"initial_angle": angle, **quantities.read_columns(parts, names)}

    def without(self, names: Iterable[str]) -> "Dispersion":
        """The dispersion without these streams; every other stream draws what it drew before."""
        none = {field: None for name, field in FIELDS.items() if name in names}
        kept = {name: level for name, level in self.levels.items() if quantities.level(name) not in names}
        misfits = {name: misfit for name, misfit in self.misfits.items() if name not in names}
        return replace(self, **none, levels=kept, misfits=misfits)
