"""Requirements such as "peak_torque at most 0.5 N m in 99 % of trials", and verdicts on them. Start with `Requirement`.

They limit metrics of runs from above, and most margins of the loop from below.
"""

import bisect
import math
from collections.abc import Callable, Iterable, Mapping
from dataclasses import asdict, dataclass, fields, replace
from typing import Any

import numpy as np

from ptsmc_jax.formulas import angle_unit
from ptsmc_jax.simulation.catalogues import CATALOGUE, MARGINS, WITHIN, as_angle, percent


def must_keep(trials: int, quantile: float | None, confidence: float | None) -> int | None:
    """Return the number of trials that must keep a limit, or None if there are too few trials to verify it.

    Without a quantile all trials must keep it. With a confidence, the one-sided lower bound on
    the probability (`statistics.fraction_bound`) must reach the quantile.

    Args:
        trials: number of trials.
        quantile: fraction of all possible trials that must keep the limit, or None.
        confidence: confidence of the statement, or None.
    """
    if quantile is None:
        return trials
    if confidence is None:
        return max(1, math.ceil(quantile * trials - 1e-9))
    if trials < fewest_trials(quantile, confidence):
        return None
    from ptsmc_jax.numerics.statistics import fraction_bound  # imports SciPy, which takes a while

    def is_verified(within: int) -> bool:
        return fraction_bound(within, trials, confidence) >= quantile

    # the bound increases with the count, and reaches the quantile if all `trials` keep the limit
    return 1 + bisect.bisect_left(range(1, trials), True, key=is_verified)


def fewest_trials(quantile: float, confidence: float) -> int:
    """Return the smallest number n of trials that can verify a quantile: quantile^n <= 1 - confidence.

    >>> fewest_trials(quantile=0.9973, confidence=0.9)
    852
    """
    return math.ceil(math.log(1.0 - confidence) / math.log(quantile) - 1e-9)


def violation_ratio(values: Any, limit: Any, *, at_least: bool) -> Any:
    """Return the ratio of values to a limit, as NumPy or JAX arrays. It is 1 at the limit and larger beyond it.

    If values must be at least the limit, the ratio is 2 - value / limit, and 0 for an infinite value. For a limit of
    zero it is 0 if the limit is kept, and above 1 otherwise.

    Args:
        values: values of the metric or margin, in any shape.
        limit: limit of the requirement, in the same unit.
        at_least: whether the limit is the smallest allowed value; otherwise it is the largest.

    Returns:
        The ratios [-], in the shape of `values`.
    """
    zero = limit == 0.0
    with np.errstate(over="ignore"):
        ratio = (values + zero * (values > 0.0)) / (limit + zero)
    return 2.0 - ratio.clip(max=2.0) if at_least else ratio


# interpretations of a probability (ECSS-E-ST-60-10C): the quantile is a fraction of ...
INTERPRETATIONS = {
    "ensemble": "runs that keep the limit at all times",
    "temporal": "the time, in every run",
    "mixed": "the time of all runs: a random run at a random time",
}


@dataclass(frozen=True)
class Verdict:
    """The result of checking a requirement on some trials."""

    metric: str
    limit: float
    unit: str
    worst: float  # largest value over the trials (smallest with `at_least`), NaN if a trial failed
    margin: float  # `violation_ratio` of the quantile or the worst value: met up to 1; NaN or infinite: not met
    failures: int  # trials beyond the limit or without a value
    trials: int
    quantile: float | None = None  # fraction of trials that must keep the limit; None: all of them
    confidence: float | None = None  # confidence that the fraction of all possible trials is at least the quantile
    at_least: bool = False  # whether the limit is the smallest allowed value; otherwise the largest
    interpretation: str = "ensemble"
    # fraction of the time within the limit: the smallest of all runs, or, mixed, the mean over the runs
    fraction_of_time: float | None = None
    shown: float | None = None  # lower bound on `fraction_of_time` at the confidence level `confidence`
    reason: str = ""  # why a margin has no value, in words

    @property
    def met(self) -> bool:
        """Whether the requirement is met, in its `interpretation` of the probability."""
        if self.interpretation == "mixed" and self.shown is not None:
            return self.quantile is not None and self.shown >= self.quantile
        if self.interpretation == "temporal":
            return self.failures == 0
        least = must_keep(self.trials, self.quantile, self.confidence)
        return least is not None and self.trials - self.failures >= least

    @property
    def word(self) -> str:
        """The verdict as text: "met", "NOT met" or "NOT shown".

        "NOT shown": the required fraction of the trials keeps the limit, but there are too few trials for the
        confidence.
        """
        if self.met:
            return "met"
        too_few = must_keep(self.trials, self.quantile, self.confidence) is None
        is_kept = replace(self, confidence=None, shown=self.fraction_of_time).met
        return "NOT shown" if too_few and is_kept else "NOT met"

    @property
    def fewest_trials(self) -> int | None:
        """The smallest number of trials that verifies the quantile, with as many failures; None without a confidence.

        If the requirement is on the time, it is the number without any failure.
        """
        if self.quantile is None or self.confidence is None:
            return None
        from ptsmc_jax.numerics import statistics  # imports SciPy, which takes a while

        failures = self.failures if self.fraction_of_time is None else 0
        return statistics.fewest_trials(failures, self.quantile, self.confidence)

    @classmethod
    def read(cls, entry: Mapping[str, Any]) -> "Verdict":
        """Return the verdict of an entry in `summary.json`. A null there is a number that is not finite."""
        present = {field.name: entry[field.name] for field in fields(cls) if entry.get(field.name) is not None}
        return cls(**{"worst": math.nan, "margin": math.nan, **present})

    def in_summary(self) -> dict[str, Any]:
        """Return the entry of the verdict in `summary.json`, see `read`."""
        return {**asdict(self), "met": self.met}

    def __str__(self) -> str:
        """The verdict in one line."""
        if self.fraction_of_time is None or self.quantile is None:
            return self._describe_trials()
        return self._describe_time(self.fraction_of_time, self.quantile)

    def _describe_time(self, fraction: float, quantile: float) -> str:
        """Return the verdict on a fraction of the time in words.

        Args:
            fraction: observed fraction of the time within the limit.
            quantile: required fraction.
        """
        limit = quantity(self.limit, self.unit, 6, self.metric)
        population = INTERPRETATIONS[self.interpretation]
        requirement = f"{self.metric} at most {limit} in {100 * quantile:g} % of {population}"
        if self.interpretation == "temporal":
            beyond = "" if self.met or self.trials == 1 else f", {self.failures} of {self.trials} runs have less"
            return f"{requirement}: the least of a run is {percent(fraction)} %: {self.word}{beyond}"
        result = f"{percent(fraction)} %"
        if self.confidence is not None and self.shown is not None:
            result += f", at least {percent(self.shown)} % at {100 * self.confidence:g} % confidence"
        return f"{requirement}: {result}: {self.word}{self._describe_missing_trials('runs')}"

    def _describe_trials(self) -> str:
        """Return the verdict on the trials in words: requirement, worst value and reason."""
        failures, trials, worst = self.failures, self.trials, self.worst
        noun = "loops" if self.metric in MARGINS else "trials"  # margins may be computed for more loops than trials
        limit = quantity(self.limit, self.unit, 6, self.metric)
        requirement = f"{self.metric} at {'least' if self.at_least else 'most'} {limit}"
        if self.quantile is not None:
            requirement += f" in {100 * self.quantile:g} % of trials"
            requirement += f" with {100 * self.confidence:g} % confidence" if self.confidence is not None else ""
        if self.at_least and not failures and not math.isfinite(worst):
            result = "unlimited"  # an infinite margin, which JSON cannot store
        elif math.isnan(worst):
            result = "no value" if trials == 1 else "no worst value"
            result += f", as {self.reason}" if self.reason else ""
        else:
            loop_count = f"of {trials} dispersed loops " if noun == "loops" else ""
            result = (f"worst {loop_count}" if trials > 1 else "") + quantity(worst, self.unit, 4, self.metric)
        least = must_keep(trials, self.quantile, self.confidence)
        if self.met:
            reason = f", beyond it {failures} of {trials} {noun}" if failures else ""
        elif self.word == "NOT shown":
            reason = self._describe_missing_trials(noun)
        else:
            allowed = f", at most {trials - least} allowed" if least is not None and trials > least else ""
            reason = f" in {failures} of {trials} {noun}{allowed}" if trials > 1 else ""
        return f"{requirement}: {result}: {self.word}{reason}"

    def _describe_missing_trials(self, noun: str) -> str:
        """Return how many trials a verdict "met" needs, in words; empty unless the verdict is "NOT shown"."""
        if self.word != "NOT shown":
            return ""
        failures = "as many failures" if self.failures and self.fraction_of_time is None else "no failure"
        return f", which takes at least {self.fewest_trials} {noun} with {failures}"


def quantity(value: float, unit: str, digits: int, metric: str = "") -> str:
    """Return a number with its unit: angles in arcsec, from one degree on in degrees, and rates also in degrees.

    Args:
        value: the number, in its unit.
        unit: the unit.
        digits: number of significant digits.
        metric: name of the metric. The norm of an attitude error is returned as an angle, see `as_angle`.
    """
    unit, value = as_angle(metric, unit, value)
    if unit == "rad/s":
        return f"{value:.{digits}g} {unit} ({math.degrees(value):.4g} deg/s)"
    if unit == "rad":
        unit, factor = angle_unit(abs(value))
        value *= factor
    return f"{value:.{digits}g} {unit}".rstrip(" -")


@dataclass(frozen=True)
class Requirement:
    """A limit on a metric in every trial, or in a fraction of the trials or of the time.

    >>> limit = Requirement("peak_torque", 0.5, quantile=0.75)
    >>> print(limit.verdict(np.array([0.3, 0.4, 0.45, 0.7]), np.array([True, True, True, True])))
    peak_torque at most 0.5 N m in 75 % of trials: worst 0.7 N m: met, beyond it 1 of 4 trials
    """

    metric: str
    limit: float
    unit: str | None = None  # unit of the metric; None: its unit for a spacecraft
    quantile: float | None = None  # fraction of the runs or of the time, see `INTERPRETATIONS`
    confidence: float | None = None
    at_least: bool = False
    interpretation: str = "ensemble"

    @property
    def stated_unit(self) -> str:
        """The unit of the limit."""
        return CATALOGUE[self.metric].unit if self.unit is None else self.unit

    @property
    def timed(self) -> str | None:
        """The metric that is the fraction of the time within the limit; None if the requirement is on runs."""
        return None if self.interpretation == "ensemble" else f"{WITHIN}{self.metric}"

    @property
    def implied_by(self) -> "Requirement":
        """The ensemble requirement that implies this one. A search uses it, as fractions of time have no gradients."""
        quantile = None if self.interpretation == "temporal" else self.quantile
        return replace(self, interpretation="ensemble", quantile=quantile)

    def verdict(self, values: np.ndarray, ok: np.ndarray, within: np.ndarray | None = None) -> Verdict:
        """Return the verdict on trials. A trial that failed or has no value breaks the limit.

        Args:
            values: values of the metric, (trials,) in its unit, or () for a single run. A single run has no quantile.
            ok: whether each trial has finished, bool of the same shape.
            within: fraction of the time within the limit, same shape; needed if the requirement is on the time.
        """
        is_single = np.ndim(values) == 0
        values, ok = np.atleast_1d(np.asarray(values)), np.atleast_1d(np.asarray(ok))
        if self.timed is not None and within is not None:
            return self._verdict_on_time(values, ok, np.atleast_1d(np.asarray(within)), single=is_single)
        is_within = ok & ((values >= self.limit) if self.at_least else (values <= self.limit))
        finished_values = np.where(ok, values, np.nan)
        worst = float(np.min(finished_values) if self.at_least else np.max(finished_values))
        quantile, confidence = (None, None) if is_single else (self.quantile, self.confidence)
        needed = must_keep(values.size, quantile, confidence)
        ordered = np.sort(np.where(ok & ~np.isnan(values), values, np.inf))
        quantile_value = float(ordered[needed - 1]) if needed is not None else np.nan
        margin = violation_ratio(
            np.asarray(worst if needed == values.size else quantile_value), self.limit, at_least=self.at_least
        )
        return Verdict(
            self.metric, self.limit, self.stated_unit, worst, float(margin), int(np.sum(~is_within)), int(values.size),
            quantile, confidence, self.at_least,
        )  # fmt: skip

    def _verdict_on_time(self, values: np.ndarray, ok: np.ndarray, within: np.ndarray, *, single: bool) -> Verdict:
        """Return the verdict on a fraction of the time. A run that failed never keeps the limit."""
        assert self.quantile is not None
        beyond = np.where(ok & ~np.isnan(within), 1.0 - within, 1.0)
        confidence = None if single else self.confidence
        if self.interpretation == "temporal":
            fraction = shown = 1.0 - float(beyond.max())
            failures = int(np.sum(1.0 - beyond < self.quantile))
        else:
            from ptsmc_jax.numerics.statistics import mean_bound

            fraction = 1.0 - float(beyond.mean())
            shown = fraction if confidence is None else 1.0 - mean_bound(beyond, confidence)
            failures = int(np.sum(beyond > 0.0))
        worst, margin = float(np.max(np.where(ok, values, np.nan))), (1.0 - shown) / (1.0 - self.quantile)
        return Verdict(
            self.metric, self.limit, self.stated_unit, worst, margin, failures, int(values.size), self.quantile,
            confidence, interpretation=self.interpretation, fraction_of_time=fraction, shown=shown,
        )  # fmt: skip


def verdicts(requirements: Iterable[Requirement], values: Callable[[str], Any], finished: Any) -> list[Verdict]:
    """Return a verdict for each requirement.

    Args:
        requirements: requirements on metrics.
        values: function from the name of a metric to its values, (trials,), or () for a single run.
        finished: whether each run has finished, bool of the same shape.
    """
    return [r.verdict(values(r.metric), finished, None if r.timed is None else values(r.timed)) for r in requirements]
