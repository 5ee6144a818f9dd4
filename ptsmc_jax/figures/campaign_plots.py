"""Campaigns as matplotlib figures: bands of the error, distributions, points by status."""

from collections.abc import Mapping
from typing import Any, NamedTuple

import numpy as np
from matplotlib.axes import Axes
from matplotlib.figure import Figure
from matplotlib.ticker import MaxNLocator

from ptsmc_jax.figures.run_plots import draw_error_limits, plant_kind
from ptsmc_jax.figures.style import (
    LIMIT,
    STYLES,
    error_display,
    legend_below,
    logarithmic,
    new_figure,
    styled,
    with_unit,
)
from ptsmc_jax.formulas import angle_unit
from ptsmc_jax.simulation.catalogues import percent
from ptsmc_jax.simulation.requirements import quantity
from ptsmc_jax.simulation.rollout import Parts

BANDS = ((99.7, "0.85"), (90.0, "0.68"), (50.0, "0.45"))  # central fraction of the trials [%], grey
# outcomes of complete runs, which have the status "ok": a limit on a fraction of the time may still be met
KEPT = "converged, every limit kept"
AT_TIMES = "beyond a limit that may be left at times"
BEYOND = "beyond a limit"
COMPLETE = (KEPT, AT_TIMES, BEYOND, "not_converged")  # outcomes of trials that reached the end
# outcome: colour, marker, size
MARKS = {
    KEPT: (STYLES[0][0], "o", 6.0),
    AT_TIMES: ("#E69F00", "v", 10.0),
    BEYOND: ("#CC79A7", "D", 8.0),
    "not_converged": (STYLES[1][0], "^", 16.0),
    "singular": (STYLES[3][0], "x", 18.0),
    "diverged": (STYLES[2][0], "s", 16.0),
    "incomplete": ("#000000", "+", 18.0),
}


class Column(NamedTuple):
    """A metric or a dispersed quantity of many trials."""

    unit: str  # empty: no unit
    values: np.ndarray  # (trials,), NaN if a trial has no value
    limit: float | None = None  # limit of the requirement on it; None: there is no requirement
    of_time: str = ""  # text with the required and observed fractions, if the requirement is on a fraction of the time

    def label(self, name: str) -> str:
        """Return the label of an axis: the name of the column with its unit."""
        return with_unit(name, self.unit)

    @property
    def shown(self) -> np.ndarray:
        """The finite values, and the limit if there is one."""
        known = self.values[np.isfinite(self.values)]
        return known if self.limit is None else np.append(known, self.limit)

    def within(self) -> str:
        """Return a text with the limit and the fraction of trials within."""
        assert self.limit is not None
        limit, within = f"limit {quantity(self.limit, self.unit, 6)}", np.mean(self.values <= self.limit)
        if not self.of_time:
            return f"{limit}: {percent(float(within))} % within"
        return f"{limit}: {percent(float(within))} % of the trials within at all times\n{self.of_time}"


def in_readable_units(columns: Mapping[str, Column]) -> dict[str, Column]:
    """Return columns with all angles [rad] in arcsec, or in degrees if one of them or a limit is one degree or more."""
    angles = [column for column in columns.values() if column.unit == "rad"]
    unit, factor = angle_unit(max((np.max(np.abs(column.shown), initial=0.0) for column in angles), default=0.0))

    def converted(column: Column) -> Column:
        limit = None if column.limit is None else factor * column.limit
        return column._replace(unit=unit, values=factor * column.values, limit=limit)

    return {name: converted(column) if column.unit == "rad" else column for name, column in columns.items()}


def fan(
    t: np.ndarray,
    errors: np.ndarray,
    worst: tuple[int, np.ndarray],
    parts: Parts,
    limits: Mapping[str, float],
    trials: str,
) -> Figure:
    """Plot the error of many trials over time: bands that contain `BANDS` percent of the trials, median, worst trial.

    Args:
        t: (time,) [s].
        errors: (trials, time) norms of the error, in the unit of this kind of plant.
        worst: the trial of the largest window error, and its errors (time,).
        parts: parts of the nominal run.
        limits: required limits by metric, in the unit of the metric.
        trials: the trials of `errors` in words, for the title.
    """
    t_f = float(parts.controller.t_f)
    convert, name, unit = error_display(plant_kind(parts))
    errors, largest = convert(errors), convert(worst[1])
    figure, axes = new_figure(f"{name.capitalize()} of {trials}, median in white", with_unit(name, unit))
    for central, grey in BANDS:
        low, high = np.percentile(errors, [50.0 - central / 2, 50.0 + central / 2], axis=0)
        axes.fill_between(t, low, high, color=grey, lw=0.0, label=f"{central:g} % of the trials")
    axes.semilogy(t, np.median(errors, axis=0), color="white", lw=1.6)
    axes.semilogy(t, largest, color=STYLES[1][0], lw=1.2, label=f"largest window error: trial {worst[0]}")
    axes.axvline(t_f, color="0.3", lw=0.9, ls=":")
    axes.annotate("$t_f$", (t_f, 1.0), xycoords=("data", "axes fraction"), ha="center", va="bottom")
    positive = errors[errors > 0.0]
    if positive.size:
        axes.set_ylim(bottom=max(np.percentile(positive, 0.1) / 3.0, positive.max() * 1e-15))
    draw_error_limits(axes, parts, limits, float(t[-1]))
    legend_below(figure, columns=2)
    return figure


@styled
def distributions(metrics: Mapping[str, Column]) -> Figure:
    """Plot the distribution function of each metric, with the limits.

    A trial without a value (NaN) counts as larger than all values. The scale is logit: 99.9 % is as far from 99 % as
    1 % from 10 %. All angles have the same unit.
    """
    metrics = in_readable_units(metrics)
    figure = Figure(figsize=(8.0, 0.5 + 3.0 * len(metrics)), layout="constrained")
    trials = next(iter(metrics.values())).values.size
    figure.suptitle(f"Distribution functions of {trials} trial{'s' if trials != 1 else ''}")
    rows = figure.subplots(len(metrics), 1, squeeze=False)[:, 0]
    for axes, (name, column) in zip(rows, metrics.items(), strict=True):
        ordered = np.sort(column.values)  # NaN last
        n, known = ordered.size, int(np.isfinite(ordered).sum())
        # all ranks near both ends, fewer between
        ranks = np.unique(np.concatenate([np.geomspace(1, n, 600), n + 1 - np.geomspace(1, n, 600)]).astype(int))
        ranks = ranks[ranks <= known]
        axes.step(
            ordered[ranks - 1], (ranks - 0.5) / n, where="post", color=STYLES[0][0], marker="." if known < 50 else None
        )
        axes.set_yscale("logit")
        edge = 0.3 / n
        axes.set_ylim(edge, 1.0 - edge)
        ticks = [q for k in range(1, 8) for q in (10.0**-k, 1.0 - 10.0**-k) if edge < q < 1.0 - edge]
        axes.set_yticks([0.5, *ticks], [f"{100 * q:.8g} %" for q in (0.5, *ticks)])
        axes.minorticks_off()
        if known and ordered[0] > 0.0 and column.shown.max() > 3.0 * column.shown.min() > 0.0:
            logarithmic(axes, "x")
        if column.limit is not None:
            axes.axvline(column.limit, **LIMIT, label=column.within())
            axes.legend(fontsize=9, loc="lower left", bbox_to_anchor=(0.0, 1.0))
        axes.set(xlabel=column.label(name), ylabel="fraction of the trials\nup to this value")
    return figure


def torque_by_angle(
    start: Column,
    torque: Column,
    outcome: np.ndarray,
    labels: Mapping[str, str],
    metric: str = "peak_torque",
) -> Figure:
    """Plot a peak torque against the initial error, a point a trial.

    Args:
        start: initial error of each trial.
        torque: peak torque of each trial.
        outcome: one of `MARKS` for each, (trials,).
        labels: label of each outcome in the legend.
        metric: name of the metric of `torque`.
    """
    (start,), name = in_readable_units({"": start}).values(), metric.replace("_", " ")
    figure, axes = new_figure(f"{name.capitalize()} by initial error", torque.label(name))
    _scatter_by_outcome(axes, start.values, torque.values, outcome, labels)
    axes.set_xlabel(start.label("initial angle" if start.unit in ("deg", "arcsec") else "initial error"))
    limit = torque.limit
    if limit is not None:
        axes.axhline(limit, **LIMIT, label=f"limit {limit:g} {torque.unit}")
    finished = torque.values[np.isin(outcome, COMPLETE) & np.isfinite(torque.values)]
    if finished.size and finished.min() > 0.0:
        shown = [*finished, limit] if limit else finished
        logarithmic(axes, "y")
        axes.set_ylim(min(shown) / 1.3, max(shown) * 1.3)
    legend_below(figure, columns=2)
    return figure


@styled
def inputs(
    drawn: Mapping[str, Column],
    metrics: Mapping[str, Column],
    outcome: np.ndarray,
    labels: Mapping[str, str],
) -> Figure:
    """Plot metrics against dispersed quantities, with a point for each trial.

    Args:
        drawn: dispersed quantities by name, a column of the figure each, the quantity that explains a metric best
            first.
        metrics: metrics by name, a row of the figure each.
        outcome: one of `MARKS` for each trial, (trials,).
        labels: label of each outcome in the legend.
    """
    drawn, metrics = in_readable_units(drawn), in_readable_units(metrics)
    rows, columns = len(metrics), len(drawn)
    figure = Figure(figsize=(2.9 * columns + 0.8, 2.4 * rows + 0.7), layout="constrained")
    grid = figure.subplots(rows, columns, sharex="col", sharey="row", squeeze=False)
    for line, (metric, column) in zip(grid, metrics.items(), strict=True):
        for axes, x in zip(line, drawn.values(), strict=True):
            _scatter_by_outcome(axes, x.values, column.values, outcome, labels)
            if column.limit is not None:
                axes.axhline(column.limit, **LIMIT, label="limit")
            if column.shown.size and column.shown.max() > 10.0 * column.shown.min() > 0.0:
                logarithmic(axes, "y")
        line[0].set_ylabel(column.label(metric).replace(" [", "\n["))  # too long for one line
    for axes, (name, x) in zip(grid[-1], drawn.items(), strict=True):
        axes.set_xlabel(x.label(name))
        axes.xaxis.set_major_locator(MaxNLocator(4))
    figure.suptitle("Inputs that explain a metric best")
    legend_below(figure, columns)
    return figure


def _scatter_by_outcome(
    axes: Axes, x: np.ndarray, y: np.ndarray, outcome: np.ndarray, labels: Mapping[str, str]
) -> None:
    """Draw a point (x, y) for each trial, with the marker of its outcome.

    Args:
        axes: where to draw.
        x: (trials,) horizontal positions.
        y: (trials,) vertical positions.
        outcome: (trials,) a key of `MARKS` for each trial.
        labels: text for the legend, by outcome.
    """
    for name, (colour, marker, size) in MARKS.items():
        has_outcome = outcome == name
        if np.any(has_outcome):
            width = 1.2 if marker in ("x", "+") else 0.0  # line markers are invisible without a width
            style: Any = {"s": size, "c": colour, "marker": marker, "alpha": 0.6, "linewidths": width}
            axes.scatter(x[has_outcome], y[has_outcome], label=labels[name], **style)
