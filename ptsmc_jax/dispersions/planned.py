"""A row of a plan in place of a trial's number: what it gives is flown, and the rest is drawn as for its trial."""

from typing import Any, NamedTuple

from ptsmc_jax.dispersions.quantities import QUANTITIES
from ptsmc_jax.dispersions.variation import Dispersion
from ptsmc_jax.numerics.draws import WholeNumber
from ptsmc_jax.simulation.rollout import Parts

TRIAL, SEED = "trial", "seed"  # columns that say whose draws a row of a plan has
OF_ROWS = {TRIAL: "plan_trial", SEED: "plan_seed"}  # what rows call them, where `trial` is the row's own number


class Row(NamedTuple):
    """What a plan says of a trial; of many, with a leading axis over them."""

    seed: Any  # whole number: whose draws and noise it has, together with the trial's
    trial: Any
    given: dict[str, Any]  # numbers (n,) by the names of `QUANTITIES`


class About(NamedTuple):
    """What a trial is drawn from."""

    parts: Parts  # about which it is drawn
    dispersion: Dispersion  # what is drawn
    seed: WholeNumber
    trial: Any
    given: tuple[str, ...]  # quantities that are not drawn

    @property
    def drawn(self) -> Parts:
        """The parts that the trial flies with."""
        return self.dispersion.apply(self.parts, self.seed, self.trial)


def about(parts: Parts, dispersion: Dispersion, seed: WholeNumber, trial: WholeNumber | Row) -> About:
    """What a trial is drawn from: given quantities [SI units] = the nominal ones of its row, which are not drawn.

    A stream of draws is one quantity's own, so that the others are what they would be without it.
    """
    if not isinstance(trial, Row):
        return About(parts, dispersion, seed, trial, ())
    for name, numbers in trial.given.items():
        parts = QUANTITIES[name].write(parts, numbers)
    return About(parts, dispersion.without(trial.given), trial.seed, trial.trial, tuple(trial.given))
