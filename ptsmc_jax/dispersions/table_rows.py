"""Trials of a run table. Quantities with a column have the values of the table; all others are random.

`trial_setup` combines a row of the table with the dispersion of the campaign.
"""

from typing import Any, NamedTuple

from ptsmc_jax.dispersions.quantities import QUANTITIES
from ptsmc_jax.dispersions.variation import Dispersion
from ptsmc_jax.numerics.draws import WholeNumber
from ptsmc_jax.simulation.rollout import Parts

TRIAL, SEED = "trial", "seed"  # columns of a run table that select the random numbers of a row
# names of these columns in result files, where `trial` is the number of the row
RESULT_COLUMNS = {TRIAL: "run_trial", SEED: "run_seed"}


class Row(NamedTuple):
    """A row of a run table, or several rows with a leading axis."""

    seed: Any  # integer that selects the random numbers, together with `trial`
    trial: Any  # integer
    given: dict[str, Any]  # given values (n,) by the name of the quantity, see `QUANTITIES`


class TrialSetup(NamedTuple):
    """Everything that determines the parts of a trial."""

    parts: Parts  # nominal parts, with the given values of the row
    dispersion: Dispersion  # of the quantities that are not given
    seed: WholeNumber
    trial: Any
    given: tuple[str, ...]  # names of the quantities with given values

    @property
    def dispersed_parts(self) -> Parts:
        """Parts of the trial, with random and given values."""
        return self.dispersion.apply(self.parts, self.seed, self.trial)


def trial_setup(parts: Parts, dispersion: Dispersion, seed: WholeNumber, trial: WholeNumber | Row) -> TrialSetup:
    """Write the given values of a row into the parts, and remove these quantities from the dispersion.

    Each quantity has its own random stream. Therefore the given values do not change the random quantities.

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
