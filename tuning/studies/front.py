"""A Pareto front as data: the window error against peak torque, stability margins or t_f.

`pareto` finds a front. The terminal, the page and `summary.json` show it.
"""

import math
from collections.abc import Mapping
from dataclasses import asdict, dataclass, field, fields
from typing import Any, NamedTuple

from ptsmc_jax.simulation.catalogues import CATALOGUES, MARGINS

LABELS = {"before": "gains of the scenario", "tuned": "tuned gains"}  # of sets of gains in tables and figures


class Kind(NamedTuple):
    """Names and unit of the traded quantity of a front, for files and texts."""

    title: str
    quantity: str
    unit: str  # a unit, or the metric that has the unit
    file: str  # name of the CSV file and the figure
    column: str  # name of the quantity's column in the CSV file

    def label(self, plant: str) -> str:
        """Return the quantity with its unit for this kind of plant."""
        return f"{self.quantity} [{self.unit_for(plant)}]"

    def unit_for(self, plant: str) -> str:
        """Return the unit of the quantity for this kind of plant."""
        return unit_of(self.unit, plant) if self.unit in CATALOGUES[plant] else self.unit


KINDS = {
    "torque": Kind("Accuracy against peak torque", "limit on the peak torque", "peak_torque", "front", "limit"),
    "margins": Kind("Cost of stability margins", "limit on |S|", "dB", "robustness", "limit"),
    "t_f": Kind("Cost of a faster slew", "t_f", "s", "slew_times", "t_f"),
}


def unit_of(name: str, plant: str) -> str:
    """Return the unit of a metric, a margin or "mean_peak_torque" for this kind of plant."""
    return {**MARGINS, **CATALOGUES[plant]}[name.removeprefix("mean_")].unit


def metric_heading(name: str, unit: str) -> str:
    """Return the heading of a metric or margin over trials, with the unit of the column.

    >>> (
    ...     metric_heading("peak_torque", "u"),
    ...     metric_heading("delay_margin", "s"),
    ...     metric_heading("peak_sensitivity", "dB"),
    ... )
    ('largest peak torque [u]', 'delay margin [s]', 'largest |S| [dB]')
    """
    words = name.replace("_", " ")
    if name == "peak_sensitivity":
        words = "largest |S|"
    elif name == "window_error":
        words = f"RMS {words}"
    elif name not in MARGINS and not name.startswith("mean_"):
        words = f"largest {words}"
    return f"{words} [{unit}]"


@dataclass(frozen=True)
class Point:
    """Gains of a front, judged on held-out trials. A number that does not exist is NaN, null in `summary.json`."""

    value: float  # largest peak torque [N m], largest |S| [dB] (infinite: no limit) or t_f [s] that they are tuned for
    gains: dict[str, float]
    rms: float = math.nan  # RMS window error
    interval: tuple[float, float] | None = None  # confidence interval of `rms`
    costs: dict[str, float] = field(default_factory=dict)  # other metrics by name, see `trades`
    failures: int = 0  # trials that failed or did not converge at t_f
    meets: bool = False  # whether the gains meet every requirement
    trained: float = math.nan  # objective over the training trials
    dominated: bool = False  # whether another point dominates this one, see `pareto.mark_points`
    knee: bool = False  # whether the point is the knee of the front

    @property
    def peak(self) -> float:
        """Return the peak torque that the required fraction of the trials stays below [N m]."""
        return self.costs["peak_torque"]


@dataclass(frozen=True)
class Front:
    """The points of a front in the order of the traded quantity, as `summary.json` has them."""

    against: str  # the traded quantity, a key of `KINDS`
    plant: str  # kind of the plant
    points: list[Point]
    idle: list[float]  # values that have the same gains as another value
    without: list[float]  # values without feasible gains
    trials: int  # number of held-out trials
    seed: int  # seed of the held-out trials
    interval_confidence: float
    lower_bound: float | None  # lower bound on the RMS window error
    rollouts: int
    gradients: int
    requirements: list[str]
    gain_units: dict[str, str]
    warnings: list[str]
    published_label: str  # label of the published gains
    published_unavailable: str | None = None  # reason why the published gains cannot be simulated
    # judged reference gains, by the names of `judging.reference_scenarios`
    others: dict[str, Point] = field(default_factory=dict)

    @property
    def non_dominated(self) -> list[Point]:
        """Return the points that no other point dominates."""
        return [point for point in self.points if not point.dominated]

    @property
    def status(self) -> str:
        """Return "met" if some gains of the front meet every requirement on the held-out trials, else "not met"."""
        return "met" if any(point.meets for point in self.non_dominated) else "not met"

    def labelled(self) -> dict[str, Point]:
        """Return the points of `others` by the labels that tables and figures show."""
        labels = {**LABELS, "published": self.published_label}
        return {labels[name]: point for name, point in self.others.items()}

    def summary(self) -> dict[str, object]:
        """Return the content of `summary.json`."""
        return {"status": self.status, **asdict(self)}


def read(summary: Mapping[str, Any]) -> Front:
    """Return the front of a `summary.json`. Raises KeyError if a field is missing."""
    stored = {entry.name: summary[entry.name] for entry in fields(Front)}
    points = [_read_point(entry) for entry in stored["points"]]
    others = {name: _read_point(entry) for name, entry in stored["others"].items()}
    values = {name: [_nan_if_missing(value) for value in stored[name]] for name in ("idle", "without")}
    return Front(**{**stored, **values, "points": points, "others": others})


def _read_point(stored: Mapping[str, Any]) -> Point:
    """Return a point of a front from its entry in `summary.json`."""
    entries = {field_.name: stored[field_.name] for field_ in fields(Point)}
    numbers = {name: _nan_if_missing(entries[name]) for name in ("value", "rms", "trained")}
    costs = {name: _nan_if_missing(value) for name, value in entries["costs"].items()}
    return Point(**{**entries, **numbers, "costs": costs})


def _nan_if_missing(value: float | None) -> float:
    """Return the number, or NaN for None."""
    return math.nan if value is None else value
