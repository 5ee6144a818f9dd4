"""The parts of a trial = at(nominal parts, coordinates(seed, trial)), a pure function."""

from collections.abc import Iterable, Mapping
from dataclasses import dataclass, field, replace

import jax
import jax.numpy as jnp
from jaxtyping import Array

from ptsmc_jax.dispersions import quantities
from ptsmc_jax.dispersions.base import INITIAL_ATTITUDE, INITIAL_RATE, INITIAL_STATE, OWN, REFERENCE, Coordinates, Draw
from ptsmc_jax.dispersions.inertias import RelativeInertia
from ptsmc_jax.dispersions.numbers import RandomNumbers
from ptsmc_jax.dispersions.quantities import QUANTITIES
from ptsmc_jax.numerics import draws, paths
from ptsmc_jax.numerics.draws import WholeNumber
from ptsmc_jax.numerics.pytrees import pytree
from ptsmc_jax.simulation.rollout import Parts


def check_dispersion(what: object) -> None:
    """Raise TypeError, with one sentence, if this is no dispersion."""
    if not isinstance(what, Dispersion):
        found = type(what).__name__
        raise TypeError(f"a dispersion is needed, such as study(scenario).dispersion, but this is a {found}")


@pytree
@dataclass(frozen=True)
class Dispersion:
    """All random quantities of a trial; every other quantity is nominal.

    Attributes:
        numbers: random numbers by the name of their quantity, see `quantities.QUANTITIES`.
        own: a custom draw, which is applied after all others.
    """

    numbers: dict[str, RandomNumbers | RelativeInertia] = field(default_factory=dict)
    own: Draw | None = None

    @property
    def varies(self) -> bool:
        """Whether anything differs from trial to trial."""
        return bool(self.kinds)

    def own_names(self) -> tuple[str, ...]:
        """Return the names of the numbers that a custom draw adds to the row of a trial."""
        if self.own is None:
            return ()
        numbers = jax.ShapeDtypeStruct((self.own.count,), jnp.result_type(float))
        return tuple(jax.eval_shape(self.own.values, numbers))

    @property
    def kinds(self) -> Mapping[str, RandomNumbers | RelativeInertia | Draw]:
        """All random quantities by the names of their streams, in the order of `QUANTITIES`, the custom draw last."""
        kinds = {name: self.numbers[name] for name in QUANTITIES if name in self.numbers}
        return kinds if self.own is None else {**kinds, OWN: self.own}

    def coordinates(self, seed: WholeNumber, trial: WholeNumber) -> Coordinates:
        """Return the coordinates [-] of a trial; the stream of each quantity is independent of all other quantities."""
        kinds, coordinates = self.kinds, {}
        for distribution in draws.DISTRIBUTIONS:
            counts = {name: kind.count for name, kind in kinds.items() if kind.drawn == distribution}
            coordinates |= draws.draw_streams(seed, trial, distribution, counts) if counts else {}
        return {name: coordinates[name] for name in kinds}

    def at(self, parts: Parts, coordinates: Coordinates) -> Parts:
        """Return the parts of the trial that has these coordinates [-]."""
        # the reference first: initial attitudes may be turned away from it
        for name, kind in sorted(self.kinds.items(), key=lambda item: item[0] != REFERENCE):
            c = coordinates[name]
            if isinstance(kind, RandomNumbers):
                parts = QUANTITIES[name].dispersed(parts, kind.at(c), kind.distribution)
            elif isinstance(kind, RelativeInertia):  # with its inverse, which `write` would have to solve for
                body = paths.get(parts, "plant").with_inertia(*kind.at(c))
                parts = quantities.with_body(parts, body)
            else:
                parts = kind.at(c, parts)
        return parts

    def apply(self, parts: Parts, seed: WholeNumber, trial: WholeNumber) -> Parts:
        """Return the parts of one trial: a pure function of the nominal parts, the seed and the trial's number [-]."""
        return self.at(parts, self.coordinates(seed, trial))

    def values(self, parts: Parts, given: Iterable[str] = ()) -> dict[str, Array]:
        """Return the initial state, and every quantity that is random or given, of the parts of a trial.

        By the columns of `quantities`, numbers each: attitudes (q1 to q4) [-], rates [rad/s], inertia [kg m^2], phases
        [rad], torques [N m], noises [rad, rad/s].
        """
        angle = parts.controller.kinematics.angle(parts.initial, parts.reference(jnp.zeros_like(parts.t_end)))
        names = {INITIAL_ATTITUDE, INITIAL_RATE, INITIAL_STATE, *self.kinds, *given}
        return {"initial_angle": angle, **quantities.read_columns(parts, names)}

    def without(self, names: Iterable[str]) -> "Dispersion":
        """Return the dispersion without these quantities; the random numbers of all others stay the same."""
        return replace(self, numbers={name: kind for name, kind in self.numbers.items() if name not in names})
