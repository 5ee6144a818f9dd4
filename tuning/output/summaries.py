"""Typed views of `summary.json`: the fields that the terminal and the page show, by command.

A number that does not exist or is not finite is None, null in the file.
"""

from collections.abc import Mapping
from typing import Any, TypeVar

import msgspec

from ptsmc_jax.campaigns import store
from ptsmc_jax.simulation.catalogues import CATALOGUE, CATALOGUES, MARGINS
from ptsmc_jax.simulation.requirements import Verdict

Number = float | None
Numbers = dict[str, Number]
Interval = tuple[float, float] | None
Row = dict[str, Any]  # the fields of a dataclass in the module that wrote the summary
T = TypeVar("T")


class Entry(msgspec.Struct, frozen=True):
    """The verdict on a requirement over some trials, see `requirements.Verdict`."""

    metric: str
    limit: float
    unit: str
    worst: Number
    margin: Number
    failures: int
    trials: int
    met: bool
    quantile: Number = None
    confidence: Number = None
    at_least: bool = False
    interpretation: str = "ensemble"
    fraction_of_time: Number = None
    shown: Number = None
    reason: str = ""
    # only in a campaign: fraction of trials within the limit, its interval and lower bound, and enough trials
    fraction: Number = None
    fraction_interval: Interval = None
    fraction_bound: Number = None
    fewest_trials: int | None = None

    @property
    def word(self) -> str:
        """The verdict as one of the texts of `Verdict.word`."""
        return Verdict.read(msgspec.structs.asdict(self)).word

    def __str__(self) -> str:
        """Return the verdict in one line."""
        return str(Verdict.read(msgspec.structs.asdict(self)))


class Run(msgspec.Struct, frozen=True, kw_only=True):
    """The summary of `ptsmc simulate`."""

    status: str
    reason: str
    bad_time: Number
    lower_bound: Number
    metrics: Numbers
    verdicts: list[Entry]
    warnings: list[str]
    drawn: dict[str, Row] = {}  # value and unit of the initial state and of each dispersion, by column
    controller_statuses: dict[str, int] = {}


class Group(msgspec.Struct, frozen=True):
    """A set of gains, and the results of its trials."""

    trials: int
    counts: dict[str, int]
    metrics: dict[str, Row | None]  # statistics over the trials that reached their end
    gains: dict[str, float] = {}
    lower_bound: Number = None

    def number(self, metric: str, statistic: str) -> Number:
        """Return a statistic of a metric; None if no trial has the metric."""
        statistics = self.metrics.get(metric)
        return None if statistics is None else statistics[statistic]


class Search(msgspec.Struct, frozen=True, kw_only=True):
    """The course and the outcome of a search for gains."""

    largest_over_limit: Numbers
    conflict: Numbers | None
    searched_globally: bool
    margins: dict[str, float]
    earlier: list[Row]  # of `tuner.RejectedSearch`
    confirmed: list[Row]  # of `confirm.Count`
    hardest: Row | None  # of `worst.Hardest`
    worst_case: bool
    averaged: int
    rollouts: int
    gradients: int
    seconds: float


class Trust(msgspec.Struct, frozen=True):
    """The diagnostics of a tuning result."""

    influence: dict[str, str]
    margins: dict[str, Row] | None  # by phase, see `stability.worst_margins`
    gradient_error: Numbers | None
    without_gradients: str | None = None  # reason for a search without gradients; None also for a discontinuous sign


class Tune(msgspec.Struct, frozen=True, kw_only=True):
    """The summary of `ptsmc tune`."""

    status: str
    plant: str
    gain_units: dict[str, str]
    gains: dict[str, float]
    at_bound: dict[str, str]
    widened_bounds: dict[str, tuple[float, float]]  # default bounds that the search moved, by gain
    accuracy_gain_over_published: Number
    accuracy_gain_interval: Interval
    training: Group
    held_out: Group
    published: Group | None = None
    before: Group | None = None
    published_unavailable: str | None
    published_label: str
    shortest_t_f: Row | None  # of `design.ShortestTime`
    broken_by: dict[str, list[str]]
    verdicts: list[Entry]
    judged_on: str
    warnings: list[str]
    search: Search
    trust: Trust | None
    differential_evolution: Row | None  # of `global_check.Check`


class Law(msgspec.Struct, frozen=True, kw_only=True):
    """The gains and results of one law of a comparison."""

    gains: dict[str, float]
    gain_units: dict[str, str]
    at_bound: dict[str, str]
    widened_bounds: dict[str, tuple[float, float]]  # default bounds that the search moved, by gain
    met: bool
    counts: dict[str, int]
    window_error: Number
    window_error_interval: Interval
    lower_bound: Number
    peak_torque: Number
    largest_peak_torque: Number
    effort: Number
    chattering: Number
    unsettled: int
    settling_time: Numbers | None
    settling_near_far: tuple[Number, Number] | None
    margins: dict[str, Row] | None  # by phase, see `stability.worst_margins`
    model_errors: dict[str, Row]  # errors under an inertia or a delay that the law does not know
    verdicts: list[Entry]


class Compare(msgspec.Struct, frozen=True):
    """The summary of `ptsmc compare`."""

    status: str
    trials: int
    published_unavailable: str | None
    published_label: str | None
    judged_on: str
    settling_angle: float
    laws: dict[str, Law]
    warnings: list[str]


class Quantiles(msgspec.Struct, frozen=True):
    """Quantiles, their intervals and other statistics of a metric over the trials of a campaign."""

    without_value: int
    median: Numbers = msgspec.field(name="0.5")
    high: Numbers | None = msgspec.field(name="0.9973", default=None)
    low: Numbers | None = msgspec.field(name="0.0027", default=None)  # only for a metric that is better when larger
    rms: Number = None
    max: Number = None
    min: Number = None


class Campaign(msgspec.Struct, frozen=True, kw_only=True):
    """The summary of `ptsmc montecarlo`."""

    status: str
    plant: str
    seed: int
    run_table: str | None
    trials: int
    simulated: int
    unjudged: list[str]
    counts: dict[str, int]
    reasons: list[Row]  # status and reason of failure, number of trials, and time of the first failure
    lower_bound: Number
    verdicts: list[Entry]
    quantiles: dict[str, Quantiles]
    drivers: dict[str, dict[str, Numbers]]  # metric -> input -> sensitivities, see `statistics.drivers`
    driver_trials: dict[str, int]
    controller_samples: dict[str, dict[str, int]] = {}  # status -> number of samples, and of trials with such a sample
    pointing: Row | None = None  # the budget, and what it is made for
    warnings: list[str]


class Margins(msgspec.Struct, frozen=True, kw_only=True):
    """The summary of `ptsmc margins`."""

    stable: bool
    open: list[str]  # inputs with an open loop
    cut: list[str]  # inputs where a limit of the actuators opens the loop
    worst: Numbers
    hold: dict[str, Numbers]
    together: Numbers
    sensors: dict[str, Numbers]
    before: list[Row]  # stability at samples before the hand-over, with the gains frozen
    not_converged: bool = False
    dispersed: int | None = None
    note: str | None
    start_deg: Number = None
    limit_cycle: Row | None = None  # of `limit_cycles.LimitCycle`, with the unit of its size


def read(kind: type[T], summary: Mapping[str, object]) -> T:
    """Return a summary as this class. Raises msgspec.ValidationError if a field is missing or has another type."""
    return msgspec.convert(store.to_json_value(summary), kind)


def run(summary: Mapping[str, Any]) -> Run:
    """Return the summary of one run; see `read`."""
    return read(Run, _collect_metrics(summary))


def tune(summary: Mapping[str, Any]) -> Tune:
    """Return the summary of a tuning; see `read`."""
    names = ("training", "held_out", "published", "before")
    groups = {name: _collect_metrics(summary[name]) for name in names if summary.get(name)}
    return read(Tune, {**summary, **groups})


def _collect_metrics(entries: Mapping[str, object]) -> dict[str, object]:
    """Return the entries with all metrics in one table."""
    known = {**CATALOGUE, **CATALOGUES["chain"], **MARGINS}
    return {**entries, "metrics": {name: value for name, value in entries.items() if name in known}}
