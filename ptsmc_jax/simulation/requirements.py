"""Requirements: "peak_torque at most 0.5 N m in 99 % of trials", one declaration for verdict and loss.

They limit metrics of runs from above, and margins of the loop mostly from below.
"""

import bisect
import math
from collections.abc import Callable, Iterable, Mapping
from dataclasses import asdict, dataclass, fields, replace
from typing import Any

import numpy as np

from ptsmc_jax.simulation.catalogues import CATALOGUE, MARGINS, WITHIN, percent


def must_keep(trials: int, quantile: float | None, confidence: float | None) -> int | None:
    """How many of so many trials must keep a limit; None: so few trials cannot show it.

    All of them where no quantile is asked for; with a confidence, the least number with which the one-sided lower bound
    on the share of all trials, `statistics.share_bound`, reaches the quantile.
    """
    if quantile is None:
        return trials
    if confidence is None:
        return max(1, math.ceil(quantile * trials - 1e-9))
    if trials < fewest_trials(quantile, confidence):
        return None
    from ptsmc_jax.numerics.statistics import share_bound  # imports SciPy, which takes a while

    def shown(within: int) -> bool:
        return share_bound(within, trials, confidence) >= quantile

    # the bound rises with the count, and `trials` are enough for all of them to show it, whatever rounding says
    return 1 + bisect.bisect_left(range(1, trials), True, key=shown)


def fewest_trials(quantile: float, confidence: float) -> int:
    """Trials with which a quantile can be shown at all: quantile^n <= 1 - confidence.

    >>> fewest_trials(quantile=0.9973, confidence=0.9)
    852
    """
    return math.ceil(math.log(1.0 - confidence) / math.log(quantile) - 1e-9)


def over(values: Any, limit: Any, *, at_least: bool) -> Any:
    """Arrays, NumPy's or JAX's, as shares of a limit: 1 is at the limit, less is within it, more is beyond it.

    Where values must be at least the limit, it is 2 - value / limit, and 0 for an infinite value. Of a limit of zero it
    is 0 where the limit is kept, and above 1 where it is not.
    """
    zero = limit == 0.0
    with np.errstate(over="ignore"):
        share = (values + zero * (values > 0.0)) / (limit + zero)
    return 2.0 - share.clip(max=2.0) if at_least else share


# interpretations of a probability (ECSS-E-ST-60-10C): that of ...
INTERPRETATIONS = {
    "ensemble": "runs that keep the limit at all times",
    "temporal": "the time, in every run",
    "mixed": "the time of all runs: a random run at a random time",
}


@dataclass(frozen=True)
class Verdict:
    """How a requirement fared over some trials."""

    metric: str
    limit: float
    unit: str
    worst: float  # largest value, NaN if a trial failed
    margin: float  # how near it comes to the limit, see `over`: met up to 1; NaN or infinite: never
    failures: int  # trials beyond the limit or without a value
    trials: int
    quantile: float | None = None  # share of trials that must keep the limit; None: every one
    confidence: float | None = None  # with which that is shown for all trials there could be
    at_least: bool = False  # the limit is the smallest value allowed, and `worst` the smallest there is
    interpretation: str = "ensemble"
    # share of the time within the limit: the least of a run, or, mixed, the mean over runs, and what is shown of it
    share_of_time: float | None = None
    shown: float | None = None

    @property
    def met(self) -> bool:
        """Whether as many trials keep the limit as are asked for, or for as much of the time."""
        if self.interpretation == "mixed" and self.shown is not None:
            return self.quantile is not None and self.shown >= self.quantile
        if self.interpretation == "temporal":
            return self.failures == 0
        least = must_keep(self.trials, self.quantile, self.confidence)
        return least is not None and self.trials - self.failures >= least

    @classmethod
    def read(cls, entry: Mapping[str, Any]) -> "Verdict":
        """A verdict from its entry in `summary.json`, where null stands for a number that is not finite."""
        present = {field.name: entry[field.name] for field in fields(cls) if entry.get(field.name) is not None}
        return cls(**{"worst": math.nan, "margin": math.nan, **present})

    def in_summary(self) -> dict[str, Any]:
        """The verdict as `summary.json` has it, see `read`."""
        return {**asdict(self), "met": self.met}

    def __str__(self) -> str:
        """The verdict in one line."""
        return self._of_trials() if self.share_of_time is None else self._of_time(self.share_of_time)

    def _of_time(self, share: float) -> str:
        assert self.quantile is not None
        most = f"{self.limit:g} {self.unit}{_in_degrees(self.limit, self.unit)}"
        wanted = f"{self.metric} at most {most} in {100 * self.quantile:g} % of {INTERPRETATIONS[self.interpretation]}"
        met = "met" if self.met else "NOT met"
        if self.interpretation == "temporal":
            beyond = "" if self.met or self.trials == 1 else f", {self.failures} of {self.trials} runs have less"
            return f"{wanted}: the least of a run is {percent(share)} %: {met}{beyond}"
        seen = f"{percent(share)} %"
        if self.confidence is not None and self.shown is not None:
            seen += f", at least {percent(self.shown)} % at {100 * self.confidence:g} % confidence"
        return f"{wanted}: {seen}: {met}"

    def _of_trials(self) -> str:
        failures, trials, worst = self.failures, self.trials, self.worst
        each = "loops" if self.metric in MARGINS else "trials"  # of which more may be looked at than are flown
        wanted = f"{self.metric} at {'least' if self.at_least else 'most'} {self.limit:g} {self.unit}".rstrip(" -")
        wanted += _in_degrees(self.limit, self.unit)
        if self.quantile is not None:
            wanted += f" in {100 * self.quantile:g} % of trials"
            wanted += f" with {100 * self.confidence:g} % confidence" if self.confidence is not None else ""
        if self.at_least and not failures and not math.isfinite(worst):
            seen = "unlimited"  # an infinite margin, which JSON has no number for
        elif math.isnan(worst):
            seen = "no value" if trials == 1 else "no worst value"
        else:
            of_loops = f"of {trials} dispersed loops " if each == "loops" else ""
            seen = (f"worst {of_loops}" if trials > 1 else "") + f"{worst:.4g}" + _in_degrees(worst, self.unit)
        least = must_keep(trials, self.quantile, self.confidence)
        if least is None and self.quantile is not None and self.confidence is not None:
            few = fewest_trials(self.quantile, self.confidence)
            return f"{wanted}: {seen}: NOT shown, which takes at least {few} trials"
        if self.met:
            return f"{wanted}: {seen}: met" + (f", beyond it {failures} of {trials} {each}" if failures else "")
        allowed = f", at most {trials - least} allowed" if least is not None and trials > least else ""
        return f"{wanted}: {seen}: NOT met" + (f" in {failures} of {trials} {each}{allowed}" if trials > 1 else "")


def _in_degrees(value: float, unit: str) -> str:
    """An angle or a rate in degrees, in parentheses; nothing for other units."""
    return f" ({math.degrees(value):.4g} {unit.replace('rad', 'deg')})" if unit in ("rad", "rad/s") else ""


@dataclass(frozen=True)
class Requirement:
    """metric <= limit in every trial, or in a share of them; or metric >= limit.

    >>> limit = Requirement("peak_torque", 0.5, quantile=0.75)
    >>> print(limit.verdict(np.array([0.3, 0.4, 0.45, 0.7]), np.array([True, True, True, True])))
    peak_torque at most 0.5 N m in 75 % of trials: worst 0.7: met, beyond it 1 of 4 trials
    """

    metric: str
    limit: float
    unit: str | None = None  # of the metric; None: as for a spacecraft
    quantile: float | None = None  # share of the runs, or of the time: see `INTERPRETATIONS`
    confidence: float | None = None
    at_least: bool = False
    interpretation: str = "ensemble"

    @property
    def stated_unit(self) -> str:
        """The metric's unit, as the requirement states it or as a spacecraft's is."""
        return CATALOGUE[self.metric].unit if self.unit is None else self.unit

    @property
    def timed(self) -> str | None:
        """The metric of the share of the time in which a run keeps the limit; None where no share is asked for."""
        return None if self.interpretation == "ensemble" else f"{WITHIN}{self.metric}"

    @property
    def implied_by(self) -> "Requirement":
        """The ensemble requirement that implies this one, for a search: shares of time have no slopes."""
        quantile = None if self.interpretation == "temporal" else self.quantile
        return replace(self, interpretation="ensemble", quantile=quantile)

    def verdict(self, values: np.ndarray, ok: np.ndarray, within: np.ndarray | None = None) -> Verdict:
        """Verdict from (trials,) values and status flags; a trial that failed or has no value breaks the limit.

        A single run, numbers (), is judged by the limit alone, or by its share of the time. within: shares of the time
        in which each run keeps the limit, needed where these are asked for.
        """
        single = np.ndim(values) == 0
        values, ok = np.atleast_1d(np.asarray(values)), np.atleast_1d(np.asarray(ok))
        if self.timed is not None and within is not None:
            return self._of_time(values, ok, np.atleast_1d(np.asarray(within)), single=single)
        keeps = ok & ((values >= self.limit) if self.at_least else (values <= self.limit))
        of_ended = np.where(ok, values, np.nan)
        worst = float(np.min(of_ended) if self.at_least else np.max(of_ended))
        quantile, confidence = (None, None) if single else (self.quantile, self.confidence)
        least = must_keep(values.size, quantile, confidence)
        ordered = np.sort(np.where(ok & ~np.isnan(values), values, np.inf))
        deciding = float(ordered[least - 1]) if least is not None else np.nan
        margin = over(np.asarray(worst if least == values.size else deciding), self.limit, at_least=self.at_least)
        return Verdict(
            self.metric, self.limit, self.stated_unit, worst, float(margin), int(np.sum(~keeps)), int(values.size),
            quantile, confidence, self.at_least,
        )  # fmt: skip

    def _of_time(self, values: np.ndarray, ok: np.ndarray, within: np.ndarray, *, single: bool) -> Verdict:
        """The verdict on a share of the time; a run that failed keeps the limit at no time."""
        assert self.quantile is not None
        beyond = np.where(ok & ~np.isnan(within), 1.0 - within, 1.0)
        confidence = None if single else self.confidence
        if self.interpretation == "temporal":
            least = shown = 1.0 - float(beyond.max())
            failures = int(np.sum(1.0 - beyond < self.quantile))
        else:
            from ptsmc_jax.numerics.statistics import mean_bound

            least = 1.0 - float(beyond.mean())
            shown = least if confidence is None else 1.0 - mean_bound(beyond, confidence)
            failures = int(np.sum(beyond > 0.0))
        worst, margin = float(np.max(np.where(ok, values, np.nan))), (1.0 - shown) / (1.0 - self.quantile)
        return Verdict(
            self.metric, self.limit, self.stated_unit, worst, margin, failures, int(values.size), self.quantile,
            confidence, interpretation=self.interpretation, share_of_time=least, shown=shown,
        )  # fmt: skip


def verdicts(requirements: Iterable[Requirement], values: Callable[[str], Any], finished: Any) -> list[Verdict]:
    """A verdict for each requirement on metrics.

    values: metric's name -> its values of one run, or of many (trials,); finished: which of these runs ended, likewise.
    """
    return [r.verdict(values(r.metric), finished, None if r.timed is None else values(r.timed)) for r in requirements]
