"""Rows of a plan: the given quantities are simulated, all others are random as for the row's trial."""

from typing import Any, NamedTuple

from ptsmc_jax.dispersions.quantities import QUANTITIES
from ptsmc_jax.dispersions.variation import Dispersion
from ptsmc_jax.numerics.draws import WholeNumber
from ptsmc_jax.simulation.rollout import Parts

TRIAL, SEED = "trial", "seed"  # columns that say whose draws a row of a plan has
OF_ROWS = {TRIAL: "plan_trial", SEED: "plan_seed"}  # what rows call them, where `trial` is the row's own number


class Row(NamedTuple):
    """A row of a plan; many rows have a leading axis."""

    seed: Any  # whole number that names the random numbers, together with `trial`
    trial: Any
    given: dict[str, Any]  # numbers (n,) by the names of `QUANTITIES`


class About(NamedTuple):
    """The nominal parts, the dispersion and the random stream of a trial."""

    parts: Parts  # nominal
    dispersion: Dispersion
    seed: WholeNumber
    trial: Any
    given: tuple[str, ...]  # quantities that are not random

    @property
    def drawn(self) -> Parts:
        """The parts that the trial simulates."""
        return self.dispersion.apply(self.parts, self.seed, self.trial)


def about(parts: Parts, dispersion: Dispersion, seed: WholeNumber, trial: WholeNumber | Row) -> About:
    """Return the basis of a trial. Quantities [SI units] that its row gives are nominal and not random.

    Each quantity has its own stream of random numbers, so the others do not depend on the given ones.
    """
    if not isinstance(trial, Row):
        return About(parts, dispersion, seed, trial, ())
    for name, numbers in trial.given.items():
        parts = QUANTITIES[name].write(parts, numbers)
    return About(parts, dispersion.without(trial.given), trial.seed, trial.trial, tuple(trial.given))
