"""The dispersion of a campaign: parts of a trial as a pure function of nominal parts, seed and trial number.

Read `Dispersion.apply` first. In trials of a run table, quantities with a column have the values of the table. All
others are random. `trial_setup` combines a row of the table with the dispersion of the campaign.
"""

from collections.abc import Iterable, Mapping
from dataclasses import dataclass, field, replace
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
from jaxtyping import Array

from ptsmc_jax.dispersions import quantities
from ptsmc_jax.dispersions.base import (
    CUSTOM,
    INITIAL_ATTITUDE,
    INITIAL_RATE,
    INITIAL_STATE,
    REFERENCE,
    Coordinates,
    Draw,
)
from ptsmc_jax.dispersions.numbers import CorrelatedInertia, RandomNumbers, RelativeInertia
from ptsmc_jax.dispersions.quantities import QUANTITIES
from ptsmc_jax.numerics import draws, paths
from ptsmc_jax.numerics.draws import WholeNumber
from ptsmc_jax.numerics.pytrees import pytree
from ptsmc_jax.simulation.rollout import Parts

TRIAL, SEED = "trial", "seed"  # columns of a run table that select the random numbers of a row
# names of these columns in result files, where `trial` is the number of the row
RESULT_COLUMNS = {TRIAL: "run_trial", SEED: "run_seed"}


def check_dispersion(value: object) -> None:
    """Raise TypeError if a value is no `Dispersion`."""
    if not isinstance(value, Dispersion):
        found = type(value).__name__
        raise TypeError(f"a dispersion is needed, such as study(scenario).dispersion, but this is a {found}")


@pytree
@dataclass(frozen=True)
class Dispersion:
    """The random quantities of a campaign. All other quantities are nominal.

    Attributes:
        numbers: random numbers by the name of the quantity, see `quantities.QUANTITIES`.
        custom: a custom dispersion, which is applied last.
    """

    numbers: dict[str, RandomNumbers | RelativeInertia | CorrelatedInertia] = field(default_factory=dict)
    custom: Draw | None = None

    @property
    def varies(self) -> bool:
        """Whether any quantity is random."""
        return bool(self.kinds)

    def custom_names(self) -> tuple[str, ...]:
        """Return the names of the columns that a custom dispersion adds to result files."""
        if self.custom is None:
            return ()
        numbers = jax.ShapeDtypeStruct((self.custom.count,), jnp.result_type(float))
        return tuple(jax.eval_shape(self.custom.values, numbers))

    @property
    def kinds(self) -> Mapping[str, RandomNumbers | RelativeInertia | CorrelatedInertia | Draw]:
        """Random quantities by the name of their stream, in the order of `QUANTITIES`, the custom dispersion last."""
        kinds = {name: self.numbers[name] for name in QUANTITIES if name in self.numbers}
        return kinds if self.custom is None else {**kinds, CUSTOM: self.custom}

    def coordinates(self, seed: WholeNumber, trial: WholeNumber) -> Coordinates:
        """Return the coordinates [-] of a trial by quantity. The random streams of the quantities are independent.

        Args:
            seed: seed of the campaign [-].
            trial: number of the trial [-].
        """
        kinds, coordinates = self.kinds, {}
        for distribution in draws.DISTRIBUTIONS:
            counts = {name: kind.count for name, kind in kinds.items() if kind.drawn == distribution}
            coordinates |= draws.draw_streams(seed, trial, distribution, counts) if counts else {}
        return {name: coordinates[name] for name in kinds}

    def at(self, parts: Parts, coordinates: Coordinates) -> Parts:
        """Return the parts of the trial that has these coordinates [-]."""
        # the reference first, because initial attitudes may be relative to it
        for name, kind in sorted(self.kinds.items(), key=lambda item: item[0] != REFERENCE):
            c = coordinates[name]
            if isinstance(kind, RandomNumbers):
                parts = QUANTITIES[name].disperse(parts, kind.at(c), kind.distribution)
            elif isinstance(
                kind, RelativeInertia | CorrelatedInertia
            ):  # it returns the inverse as well, which `write` would have to compute
                body = paths.get(parts, "plant").with_inertia(*kind.at(c))
                parts = quantities.with_body(parts, body)
            else:
                parts = kind.at(c, parts)
        return parts

    def apply(self, parts: Parts, seed: WholeNumber, trial: WholeNumber) -> Parts:
        """Return the parts of a trial, a pure function of its arguments.

        Args:
            parts: nominal parts.
            seed: seed of the campaign [-].
            trial: number of the trial [-].
        """
        return self.at(parts, self.coordinates(seed, trial))

    def values(self, parts: Parts, given: Iterable[str] = ()) -> dict[str, Array]:
        """Return the initial state and all random or given quantities of a trial, by column, in SI units.

        The angle between initial attitude and reference is the column `initial_angle` [rad].

        Args:
            parts: parts of the trial.
            given: names of the quantities with given values.
        """
        angle = parts.controller.kinematics.angle(parts.initial, parts.reference(jnp.zeros_like(parts.t_end)))
        names = {INITIAL_ATTITUDE, INITIAL_RATE, INITIAL_STATE, *self.kinds, *given}
        return {"initial_angle": angle, **quantities.read_columns(parts, names)}

    def without(self, names: Iterable[str]) -> "Dispersion":
        """Return the dispersion without these quantities. The random numbers of all others do not change."""
        return replace(self, numbers={name: kind for name, kind in self.numbers.items() if name not in names})


class Row(NamedTuple):
    """A row of a run table, or several rows with a leading axis."""

    seed: Any  # integer that selects the random numbers, together with `trial`
    trial: Any  # integer
    given: dict[str, Any]  # given values (n,) by the name of the quantity, see `QUANTITIES`


class TrialSetup(NamedTuple):
    """Nominal parts, dispersion, seed and number of one trial. They determine the parts of the trial."""

    parts: Parts  # nominal parts, with the given values of the row
    dispersion: Dispersion  # of the quantities that are not given
    seed: WholeNumber
    trial: WholeNumber
    given: tuple[str, ...]  # names of the quantities with given values

    @property
    def dispersed_parts(self) -> Parts:
        """Parts of the trial, with random and given values."""
        return self.dispersion.apply(self.parts, self.seed, self.trial)


def trial_setup(parts: Parts, dispersion: Dispersion, seed: WholeNumber, trial: WholeNumber | Row) -> TrialSetup:
    """Return parts, dispersion, seed and number of a trial, which may be a row of a run table.

    The given values of a row are written into the parts, and these quantities are removed from the dispersion. Each
    quantity has its own random stream. Therefore the given values do not change the random quantities.

    Args:
        parts: nominal parts.
        dispersion: dispersion of the campaign.
        seed: seed of the campaign [-]; a row has its own seed.
        trial: number of the trial [-], or a row of a run table with values in SI units.
    """
    if not isinstance(trial, Row):
        return TrialSetup(parts, dispersion, seed, trial, ())
    for name, numbers in trial.given.items():
        parts = QUANTITIES[name].write(parts, numbers)
    return TrialSetup(parts, dispersion.without(trial.given), trial.seed, trial.trial, tuple(trial.given))
