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
        return verdict_text(self.metric, self.limit, self.unit, self.worst, self.failures, self.trials)


def verdict_text(metric: str, limit: float, unit: str, worst: float | None, failures: int, trials: int) -> str:
    """A verdict in one line; worst: None or NaN where a trial failed or has no value."""
    wanted = f"{metric} at most {limit:g} {unit}".rstrip(" -")
    if worst is None or worst != worst:
        seen = "no value" if trials == 1 else "no worst value"
    else:
        seen = f"worst {worst:.4g}" if trials > 1 else f"{worst:.4g}"
    if failures == 0:
        return f"{wanted}: {seen}: met"
    return f"{wanted}: {seen}: NOT met" + (f" in {failures} of {trials} trials" if trials > 1 else "")


@dataclass(frozen=True)
class Requirement:
    """metric <= limit in every trial."""

    metric: str
    limit: float
    unit: str | None = None  # of the metric; None: as for a spacecraft

    def verdict(self, values: np.ndarray, ok: np.ndarray) -> Verdict:
        """Verdict from (trials,) values and status flags; a trial that failed or has no value breaks it."""
        values, ok = np.atleast_1d(np.asarray(values)), np.atleast_1d(np.asarray(ok))
        within = ok & (values <= self.limit)
        worst = float(np.max(np.where(ok, values, np.nan)))
        failures = int(np.sum(~within))
        unit = CATALOGUE[self.metric][0] if self.unit is None else self.unit
        return Verdict(self.metric, self.limit, unit, worst, worst / self.limit, failures, int(values.size))
