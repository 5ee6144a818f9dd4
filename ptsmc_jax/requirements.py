"""Requirements on metrics: "peak_torque at most 0.5 N m", one declaration for verdict and loss."""

from dataclasses import dataclass

import numpy as np

from ptsmc_jax.metrics import CATALOGUE


@dataclass(frozen=True)
class Verdict:
    """How a requirement fared over some trials."""

    metric: str
    limit: float
    unit: str
    worst: float  # largest value, NaN if a trial failed
    margin: float  # worst / limit: met up to 1
    failures: int  # trials beyond the limit or without a value
    trials: int

    @property
    def met(self) -> bool:
        """Every trial within the limit."""
        return self.failures == 0

    def __str__(self) -> str:
        word = "met" if self.met else f"NOT met, {self.failures} of {self.trials} trials beyond it"
        return f"{self.metric} at most {self.limit:g} {self.unit}: worst {self.worst:.4g}: {word}"


@dataclass(frozen=True)
class Requirement:
    """metric <= limit in every trial; limit in the metric's unit."""

    metric: str
    limit: float

    def verdict(self, values: np.ndarray, ok: np.ndarray) -> Verdict:
        """Verdict from (trials,) values and status flags; a trial that failed or has no value breaks it."""
        values, ok = np.atleast_1d(np.asarray(values)), np.atleast_1d(np.asarray(ok))
        within = ok & (values <= self.limit)
        worst = float(np.max(np.where(ok, values, np.nan)))
        unit = CATALOGUE[self.metric][0]
        failures = int(np.sum(~within))
        return Verdict(self.metric, self.limit, unit, worst, worst / self.limit, failures, int(values.size))
