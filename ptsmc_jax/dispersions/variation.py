"""What varies from trial to trial: parts of a trial = at(coordinates(seed, trial)), a pure function."""

from collections.abc import Iterable
from dataclasses import dataclass, field, replace
from typing import Any

import jax
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
    plant_of,
)
from ptsmc_jax.dispersions.inertias import RelativeInertia
from ptsmc_jax.dispersions.misfits import Misfit
from ptsmc_jax.dispersions.numbers import Factor, Normal, Uniform, UniformPhase
from ptsmc_jax.dispersions.quantities import QUANTITIES
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


def check_dispersion(what: object) -> None:
    """Raise TypeError, with one sentence, where something else is in the place of a dispersion."""
    if not isinstance(what, Dispersion):
        found = type(what).__name__
        raise TypeError(f"a dispersion is needed, such as study(scenario).dispersion, but this is a {found}")


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

    def own_names(self) -> tuple[str, ...]:
        """Names of the numbers that draws of one's own say of a trial."""
        if self.own is None:
            return ()
        numbers = jax.ShapeDtypeStruct((self.own.count,), jnp.result_type(float))
        return tuple(jax.eval_shape(self.own.values, numbers))

    @property
    def kinds(self) -> dict[str, Any]:
        """What is drawn, by the name of its stream."""
        kinds = {name: getattr(self, field) for name, field in FIELDS.items()}
        kinds |= {quantities.level(name): level for name, level in self.levels.items()}
        kinds |= self.misfits
        return {name: kind for name, kind in kinds.items() if kind is not None}

    def coordinates(self, seed: WholeNumber, trial: WholeNumber) -> Coordinates:
        """Coordinates of a trial; each name has a stream of its own, so one more of them changes no other."""
        kinds, coordinates = self.kinds, {}
        for distribution in draws.DISTRIBUTIONS:
            counts = {name: kind.count for name, kind in kinds.items() if kind.drawn == distribution}
            coordinates |= draws.several(seed, trial, distribution, counts) if counts else {}
        return {name: coordinates[name] for name in kinds}

    def at(self, parts: Parts, coordinates: Coordinates) -> Parts:
        """The parts of the trial that has these coordinates."""
        if not self.varies:
            return parts

        def drawn(name: str, kind: Any, *about: Any) -> Parts:
            """The parts with the quantity of this name drawn about these nominal values."""
            return QUANTITIES[name].write(parts, kind.at(coordinates[name], *about))

        def scaled(name: str, factor: Factor) -> Parts:
            """The parts with the quantity of this name times what is drawn about 1."""
            quantity = QUANTITIES[name]
            return quantity.write(parts, quantity.read(parts) * factor.at(coordinates[name], jnp.ones(factor.count)))

        if self.reference is not None:
            parts = drawn(REFERENCE, self.reference, parts.reference.q, parts.reference.q)
        if self.state is not None:
            parts = drawn(INITIAL_STATE, self.state, parts.plant.visible(parts.initial))
        if self.attitude is not None:
            at_start = parts.reference(jnp.zeros_like(parts.t_end))
            parts = drawn(INITIAL_ATTITUDE, self.attitude, parts.initial.q, at_start.q)
        if self.rate is not None:
            parts = drawn(INITIAL_RATE, self.rate, parts.initial.w)
        if self.inertia is not None:  # with its inverse, which `write` would have to solve for
            body = plant_of(parts).with_inertia(*self.inertia.at(coordinates[INERTIA]))
            parts = quantities.with_body(parts, body)
        for name, factor in self.levels.items():
            parts = scaled(quantities.level(name), factor)
        for name, misfit in self.misfits.items():
            parts = drawn(name, misfit, parts)
        if self.phase is not None:
            parts = drawn(DISTURBANCE_PHASE, self.phase, disturbances.values(parts.disturbance, "phase"))
        if self.amplitude is not None:
            parts = scaled(DISTURBANCE_AMPLITUDE, self.amplitude)
        if self.bias is not None:
            parts = drawn(DISTURBANCE_BIAS, self.bias, jnp.zeros(self.bias.count))
        return parts if self.own is None else self.own.at(coordinates[OWN], parts)

    def apply(self, parts: Parts, seed: WholeNumber, trial: WholeNumber) -> Parts:
        """The parts of one trial: a pure function of the nominal parts, the seed and the trial's number."""
        return self.at(parts, self.coordinates(seed, trial))

    def values(self, parts: Parts, given: Iterable[str] = ()) -> dict[str, Array]:
        """What a trial flies, read from its parts: the initial state, what else is drawn and what is given.

        By the columns of `quantities`, numbers each: attitudes (q1 to q4) [-], rates [rad/s], inertia [kg m^2], phases
        [rad], torques [N m], noises [rad, rad/s].
        """
        angle = parts.controller.kinematics.angle(parts.initial, parts.reference(jnp.zeros_like(parts.t_end)))
        names = {INITIAL_ATTITUDE, INITIAL_RATE, INITIAL_STATE, *self.kinds, *given}
        return {"initial_angle": angle, **quantities.read_columns(parts, names)}

    def without(self, names: Iterable[str]) -> "Dispersion":
        """The dispersion without these streams; every other stream draws what it drew before."""
        none = {field: None for name, field in FIELDS.items() if name in names}
        levels = {name: level for name, level in self.levels.items() if quantities.level(name) not in names}
        misfits = {name: misfit for name, misfit in self.misfits.items() if name not in names}
        return replace(self, **none, levels=levels, misfits=misfits)
