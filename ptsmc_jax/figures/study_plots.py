"""Studies of many runs as matplotlib figures: tuning, trade-offs, maps. Each function returns a Figure."""

from collections.abc import Mapping, Sequence
from typing import Any, NamedTuple

import matplotlib
import matplotlib.colors
import matplotlib.lines
import matplotlib.patches
import matplotlib.ticker
import numpy as np
from matplotlib.axes import Axes
from matplotlib.figure import Figure
from matplotlib.path import Path
from matplotlib.transforms import Bbox
from numpy.typing import ArrayLike

from ptsmc_jax.figures.style import (
    LIMIT,
    LOWER_BOUND,
    STYLES,
    error_display,
    legend_below,
    logarithmic,
    metric_display,
    new_figure,
    plain_ticks,
    styled,
    torque_metric,
)
from ptsmc_jax.scenario.gain_bounds import is_log_scaled
from ptsmc_jax.simulation.catalogues import CATALOGUES, TORQUES, without_norms

MARKERS = ("o", "^", "s", "D", "v")
BEYOND = ("x", "+", "1", "2", "3", "4")  # markers of points that violate a limit, one for each limit
# marker of a pair with a failed trial, visible on any colour
FAILED: Any = {"marker": "X", "color": "white", "mec": "black", "mew": 0.6, "ms": 6}
# marker of a pair that does not meet a requirement
NOT_MET: Any = {"marker": "o", "color": "white", "mec": "black", "mew": 0.6, "ms": 3.5}
TORQUE_LIMIT = STYLES[1][0]  # colour of the required torque; grey as of `LIMIT` is a colour of the map
NO_NUMBER = "0.9"  # grey of pairs without a number, which is not a colour of the map
WIDEST = 1e4  # largest ratio of the values that the colours of a map span


class Profile(NamedTuple):
    """The objective along one gain; the other gains are the tuned ones."""

    unit: str
    gain: np.ndarray  # (points,) values of the gain
    goal: np.ndarray  # (points,) objective, NaN if there is none
    over: np.ndarray  # (points,) largest ratio of a metric to its limit
    nearest: Sequence[str]  # (points,) name of the metric with the largest ratio
    tuned: float  # the tuned gain


class MapAxis(NamedTuple):
    """One of the two keys of a map, with its values."""

    label: str  # label of the axis: the key and its unit
    values: Sequence[float]
    logarithmic: bool  # whether the axis has a log scale

    @property
    def edges(self) -> np.ndarray:
        """Edges of the cells, in the middle between neighbouring values on the drawn axis."""
        middle = np.log(self.values) if self.logarithmic else np.asarray(self.values)
        between = (middle[:-1] + middle[1:]) / 2
        edges = np.concatenate([[2 * middle[0] - between[0]], between, [2 * middle[-1] - between[-1]]])
        return np.exp(edges) if self.logarithmic else edges


class Sweep(NamedTuple):
    """The values at which the points of a front were searched."""

    title: str
    label: str  # label of the axis, with the unit
    values: Sequence[float]
    ticks: Sequence[str] | None = None  # tick labels at `values`; None: the values as numbers


def _colours_and_markers(count: int) -> list[tuple[str, str]]:
    """Return a colour and a marker for each set, all different up to 25."""
    size = len(STYLES)
    return [(STYLES[k % size][0], MARKERS[(k + k // size) % len(MARKERS)]) for k in range(count)]


@styled
def tuning_history(
    gains: Mapping[str, tuple[str, np.ndarray]],
    values: np.ndarray,
    admissible: np.ndarray,
    stages: np.ndarray,
    goal: str,
    result: tuple[float, Mapping[str, float]],
) -> Figure:
    """Plot the objective and the gains of all starting points over the steps, and the final result.

    Args:
        gains: unit and values (steps, starts) by name.
        values: (steps, starts) of the objective; NaN after a starting point was given up.
        admissible: (steps, starts) bool, every requirement is met.
        stages: (steps, starts) number of the stage; NaN after a starting point was given up.
        goal: name and unit of the objective.
        result: objective on the training trials, and gains.
    """
    figure = Figure(figsize=(8.0, 2.2 * (len(gains) + 1)), layout="constrained")
    axes = figure.subplots(len(gains) + 1, 1, sharex=True)
    steps = np.arange(len(values))
    for start in range(values.shape[1]):
        axes[0].semilogy(steps, values[:, start], color="0.75", lw=1.0)
        met = np.where(admissible[:, start], values[:, start], np.nan)
        axes[0].semilogy(steps, met, color=STYLES[0][0])
    begins = np.isfinite(stages) & (np.diff(stages, axis=0, prepend=np.nan) != 0)
    axes[0].semilogy(np.nonzero(begins)[0], values[begins], "k.", ms=4, label="a stage begins")
    plain_ticks(axes[0].yaxis)
    axes[0].plot([], [], color=STYLES[0][0], label="requirements met")
    axes[0].plot([], [], color="0.75", label="beyond a limit")
    final_goal, final_gains = result
    for ax, value in zip(axes, (final_goal, *(final_gains[name] for name in gains)), strict=True):
        ax.axhline(value, color="black", lw=1.0, ls=":", zorder=3, label="result")
    axes[0].set_ylabel(goal)
    figure.suptitle("Local searches on the training trials")
    axes[0].legend(loc="lower left", bbox_to_anchor=(0.0, 1.0), ncols=4, fontsize=9)
    for ax, (name, (unit, courses)) in zip(axes[1:], gains.items(), strict=True):
        ax.plot(steps, courses, color=STYLES[1][0], lw=1.0)
        ax.set_ylabel(f"{name}\n[{unit}]")
        if is_log_scaled(np.nanmin(courses), np.nanmax(courses)):
            logarithmic(ax, "y")
    axes[-1].set_xlabel("step of the local search, all stages")
    axes[-1].xaxis.set_major_locator(matplotlib.ticker.MaxNLocator(integer=True))
    return figure


@styled
def tornado(sensitivities: Mapping[str, Mapping[str, float]]) -> Figure:
    """Plot the sensitivity of each metric to each gain [% per %], the largest on top.

    An error that has a metric for its norm and one for its angle is plotted once, as an angle.

    Args:
        sensitivities: sensitivities by metric and gain [-].
    """
    sensitivities = {metric: sensitivities[metric] for metric in without_norms(sensitivities)}
    rows = sum(len(by_gain) + 1 for by_gain in sensitivities.values())
    figure = Figure(figsize=(8.0, 1.0 + 0.3 * rows), layout="constrained")
    figure.suptitle("Sensitivity of the metrics to the gains")
    axes = figure.subplots(len(sensitivities), 1, sharex=True, squeeze=False)[:, 0]
    for ax, (metric, by_gain) in zip(axes, sensitivities.items(), strict=True):
        order = sorted(by_gain, key=lambda gain: abs(by_gain[gain]))
        values = [by_gain[gain] for gain in order]
        ax.barh(order, values, color=[STYLES[0][0] if v < 0 else STYLES[1][0] for v in values], height=0.65)
        ax.axvline(0.0, color="0.3", lw=0.9)
        ax.set_title(metric, loc="left", fontsize=11)
        for k, value in enumerate(values):
            ax.annotate(f"{value:+.2g}", (value, k), xytext=(4 if value >= 0 else -4, 0), fontsize=9,
                        textcoords="offset points", va="center", ha="left" if value >= 0 else "right")  # fmt: skip
        ax.margins(x=0.15)
    axes[-1].set_xlabel("change of the metric for + 1 % of the gain [%]")
    return figure


@styled
def profiles(gains: Mapping[str, Profile], goal: str) -> Figure:
    """Plot the objective along each gain, by name; goal: name and unit of the objective."""
    broken_limits = dict.fromkeys(
        metric for profile in gains.values() for metric in np.asarray(profile.nearest)[profile.over > 1.0]
    )
    marks = {metric: BEYOND[k % len(BEYOND)] for k, metric in enumerate(broken_limits)}
    legend_rows = -(-(3 + len(marks)) // 2)
    figure = Figure(figsize=(8.0, 2.7 * len(gains) + 0.26 * legend_rows), layout="constrained")
    axes = figure.subplots(len(gains), 1, sharey=True, squeeze=False)[:, 0]
    for ax, (name, profile) in zip(axes, gains.items(), strict=True):
        points = np.stack([profile.gain, profile.gain], axis=1)
        ax.update_datalim(points, updatey=False)  # the axis includes gains at which no trial has an objective
        ax.semilogy(profile.gain, profile.goal, color="0.6", lw=1.2, label="objective")
        within = profile.over <= 1.0
        ax.semilogy(profile.gain[within], profile.goal[within], "o", color=STYLES[0][0], label="limits kept")
        for metric, mark in marks.items():
            beyond = ~within & (np.asarray(profile.nearest) == metric)
            label = f"beyond the limit of {metric}"
            ax.semilogy(profile.gain[beyond], profile.goal[beyond], mark, color=STYLES[1][0], label=label)
        if not np.any(np.isfinite(profile.goal)):
            ax.text(
                0.5, 0.5, "no objective: no trial reaches its end", transform=ax.transAxes, ha="center", va="center"
            )
        ax.axvline(profile.tuned, color="0.3", lw=0.9, ls=":", label="tuned")
        if is_log_scaled(profile.gain[0], profile.gain[-1]):
            logarithmic(ax, "x")
        ax.set(xlabel=f"{name} [{profile.unit}]", ylabel=goal)
    axes[0].set_title("Objective along each gain, the other gains as tuned", loc="left")
    plain_ticks(axes[0].yaxis)
    figure.legend(*axes[0].get_legend_handles_labels(), loc="outside upper left", ncols=2, fontsize=9)
    return figure


def tradeoff(
    sets: Mapping[str, tuple[ArrayLike, ArrayLike]],
    limits: Mapping[str, float],
    kind: str = "spacecraft",
    lower_bound: float | None = None,
) -> Figure:
    """Plot accuracy against torque, with one point for each trial.

    Args:
        sets: window errors (trials,) [-] and torques (trials,) [N m] by label; the torque is `torque_metric(limits)`.
        limits: required limits by metric, in the unit of the metric.
        kind: kind of the plant, which determines the units.
        lower_bound: lower bound of the RMS error.
    """
    torque = torque_metric(limits)
    (convert, name, error_unit), unit = error_display(kind), CATALOGUES[kind][torque].unit
    torque_name = TORQUES[torque]
    figure, axes = new_figure("Accuracy against torque, held-out trials", f"{torque_name} [{unit}]")
    arrays = {label: (np.asarray(e), np.asarray(u)) for label, (e, u) in sets.items()}
    looks = zip(arrays.items(), _colours_and_markers(len(arrays)), range(len(arrays), 0, -1), strict=True)
    for (label, (errors, torques)), (colour, marker), above in looks:  # the first set is drawn above the others
        rms, mean = convert(np.sqrt(np.nanmean(errors**2))), np.nanmean(torques)
        axes.loglog(convert(errors), torques, marker, ms=2.5, alpha=0.35, color=colour, mew=0, zorder=2)
        label = label.replace("_", " ")
        text = f"{label}: RMS {float(f'{rms:.3g}'):g} {error_unit}, mean {torque_name} {mean:.3g} {unit}"
        axes.loglog(rms, mean, marker, ms=9, color=colour, mec="white", label=text, zorder=2 + above)
    if torque in limits:
        axes.axhline(limits[torque], **LIMIT, label=f"limit of {torque} {limits[torque]:g} {unit}")
    for metric in ("window_error", "window_angle"):
        if metric in limits:
            limit = float(metric_display(metric, kind)[0](limits[metric]))
            axes.axvline(limit, **LIMIT, label=f"limit of {metric} {limit:.4g} {error_unit}")
    if lower_bound:
        least = float(convert(lower_bound))
        axes.axvline(least, **LOWER_BOUND, label=f"lower bound {least:.3g} {error_unit}")
    axes.set_xlabel(f"RMS {name} in the window [{error_unit}]")
    for line in (axes.xaxis, axes.yaxis):
        plain_ticks(line)
    legend_below(figure, columns=1)
    return figure


def settling_by_angle(sets: Mapping[str, tuple[np.ndarray, np.ndarray]], t_f: float) -> Figure:
    """Plot settling time [s] against initial angle [deg]; `sets`: label -> (angles, times), NaN: never settles."""
    figure, axes = new_figure("Settling time by initial angle", "settling time [s]")
    looks = zip(sets.items(), _colours_and_markers(len(sets)), range(len(sets), 0, -1), strict=True)
    for (label, (angle, time)), (colour, marker), above in looks:  # the first set is drawn above the others
        settled, name = np.isfinite(time), label.replace("_", " ")
        name = name if np.all(settled) else f"{name}: {np.count_nonzero(~settled)} never"
        # markers are not filled, so that laws with equal times stay visible
        axes.plot(
            angle[settled],
            time[settled],
            marker,
            ms=3.5,
            mew=0.7,
            mfc="none",
            color=colour,
            label=name,
            zorder=2 + above,
        )
    axes.axhline(t_f, color="0.3", lw=0.9, ls=":")
    axes.annotate("$t_f$", (1.0, t_f), xycoords=("axes fraction", "data"), xytext=(4, 0), textcoords="offset points",
                  va="center")  # fmt: skip
    axes.set_xlabel("initial angle [deg]")
    legend_below(figure, columns=2)
    return figure


def front(
    points: Sequence[Any],
    others: Mapping[str, Any],
    limit: float | None,
    kind: str,
    lower_bound: float | None = None,
) -> Figure:
    """Plot window error against peak torque of a Pareto front, with intervals.

    Args:
        points: points of a `front.Front`, with rms, interval, peak, dominated and knee.
        others: further points by label.
        limit: required limit of the torque, if any.
        kind: kind of the plant, which determines the units.
        lower_bound: lower bound of the error.
    """
    (convert, name, error_unit), unit = error_display(kind), CATALOGUES[kind]["peak_torque"].unit
    title = "Accuracy against torque: Pareto front, held-out trials"
    figure, axes = new_figure(title, f"RMS {name} in the window [{error_unit}]")
    on_front, dominated = ([p for p in points if p.dominated == is_so] for is_so in (False, True))
    axes.loglog([p.peak for p in on_front], convert([p.rms for p in on_front]), color=STYLES[0][0], lw=1.2)
    for group, colour, label in ((on_front, STYLES[0][0], "front"), (dominated, "0.6", "dominated")):
        for k, p in enumerate(group):
            rms, (low, high) = convert(p.rms), convert(p.interval or (p.rms, p.rms))
            axes.errorbar(p.peak, rms, [[max(rms - low, 0.0)], [max(high - rms, 0.0)]], fmt="o", ms=4,
                          color=colour, elinewidth=1.0, capsize=2, label=label if k == 0 else None)  # fmt: skip
    for p in on_front:
        if p.knee:
            axes.loglog(p.peak, convert(p.rms), "o", ms=13, mfc="none", mec=STYLES[3][0], mew=1.4, label="knee")
    for (label, p), marker, style in zip(others.items(), ("^", "s", "D"), STYLES[1:], strict=False):
        if np.isfinite(p.rms):
            rms = convert(p.rms)
            axes.loglog(p.peak, rms, marker, ms=8, color=style[0], label=f"{label}: {rms:.3g} {error_unit}")
    if limit is not None:
        axes.axvline(limit, **LIMIT, label=f"limit {limit:g} {unit}")
    if lower_bound:
        least = float(convert(lower_bound))
        axes.axhline(least, **LOWER_BOUND, label=f"lower bound {least:.3g} {error_unit}")
    axes.set_xlabel(f"largest peak torque [{unit}]")
    for line in (axes.xaxis, axes.yaxis):
        plain_ticks(line)
    legend_below(figure, columns=3)
    return figure


@styled
def costs(
    points: Sequence[Any], sweep: Sweep, panels: Mapping[str, tuple[np.ndarray, float | None]], kind: str
) -> Figure:
    """Plot the error and other metrics along a sweep, a panel each; dashed lines are the scenario's limits.

    Args:
        points: points of the sweep, with rms, interval and meets.
        sweep: the values of the points.
        panels: values of each point, NaN if it has none, and the limit if there is one, by title; the error first.
        kind: kind of the plant, which determines how the intervals of the error are shown.
    """
    columns = 3
    figure = Figure(figsize=(10.5, 3.0 * -(-len(panels) // columns)), layout="constrained")
    figure.suptitle(sweep.title)
    for k, (title, (values, limit)) in enumerate(panels.items()):
        axes = figure.add_subplot(-(-len(panels) // columns), columns, k + 1)
        axes.plot(sweep.values, values, "-", color=STYLES[0][0], lw=1.2)
        for met, fill, label in ((True, STYLES[0][0], "meets every requirement"), (False, "white", "does not")):
            selected = [k for k, point in enumerate(points) if point.meets == met]
            if selected:
                x, y = ([numbers[k] for k in selected] for numbers in (sweep.values, values))
                axes.plot(x, y, "o", ms=5, mfc=fill, mec=STYLES[0][0], label=label)
        if not k:
            low, high = error_display(kind)[0]([point.interval or (point.rms, point.rms) for point in points]).T
            axes.fill_between(sweep.values, low, high, color=STYLES[0][0], alpha=0.2, lw=0)
        known = values[np.isfinite(values)]
        if known.size and np.all(known > 0.0):
            logarithmic(axes, "y")
        if limit is not None:
            axes.axhline(limit, **LIMIT, label="limit of the scenario")
        if sweep.ticks is not None:
            axes.set_xticks(sweep.values, sweep.ticks)
        axes.set_title(title, fontsize=10, loc="center")
        axes.set_xlabel(sweep.label, fontsize=10)
    legends = [axes.get_legend_handles_labels() for axes in figure.axes]
    by_label = {label: handle for pair in legends for handle, label in zip(*pair, strict=True)}
    figure.legend(by_label.values(), by_label.keys(), loc="outside lower left", ncols=3, fontsize=9, frameon=False)
    return figure


def _draw_colour_map(axes: Axes, x: MapAxis, y: MapAxis, grid: np.ndarray, same_scale: Sequence[np.ndarray]) -> None:
    """Draw a grid (y, x) as colours; same_scale: all grids with this scale."""
    known = np.concatenate([map_axis.ravel() for map_axis in same_scale])
    known = known[np.isfinite(known) & (known > 0)]
    low, high = (known.min(), min(known.max(), known.min() * WIDEST)) if known.size else (1e-12, 1.0)
    norm = matplotlib.colors.LogNorm(low, max(high, 1.01 * low))
    if x.logarithmic:
        logarithmic(axes, "x")
    if y.logarithmic:
        logarithmic(axes, "y")
    for line, map_axis in ((axes.xaxis, x), (axes.yaxis, y)):
        if not map_axis.logarithmic and all(float(value).is_integer() for value in map_axis.values):
            line.set_major_locator(matplotlib.ticker.MaxNLocator(integer=True))  # a delay is a whole number of periods
    axes.set_facecolor(NO_NUMBER)
    mesh = axes.pcolormesh(x.edges, y.edges, np.ma.masked_invalid(grid), norm=norm, cmap="cividis")
    bar = axes.figure.colorbar(mesh, ax=axes, extend="max" if known.size and known.max() > high else "neither")
    plain_ticks(bar.ax.yaxis)


@styled
def accuracy_map(
    x: MapAxis,
    y: MapAxis,
    grids: Mapping[str, np.ndarray],
    failed: np.ndarray,
    limit_lines: Mapping[str, tuple[np.ndarray, np.ndarray]],
    kind: str = "spacecraft",
    torque_limit: float | None = None,
    not_met: np.ndarray | None = None,
    stability: str = "",
) -> Figure:
    """Plot simulated window error, window error by linear theory, and peak torques over two keys.

    The errors have one scale of colours, so that simulation and linear theory can be compared.

    Args:
        x: the horizontal key.
        y: the vertical key.
        grids: (y, x) by name; grids without finite numbers are not drawn.
        failed: (y, x) bool, a trial failed or did not converge at t_f.
        limit_lines: lines (x, y) by label.
        kind: kind of the plant, which determines the units.
        torque_limit: required limit of the largest peak torque; None: no line.
        not_met: (y, x) bool, a requirement is not met, although no trial failed; None: no requirement.
        stability: text of the legend about the stability of the pairs.
    """
    (convert, error, error_unit), unit = error_display(kind), CATALOGUES[kind]["peak_torque"].unit
    grids = {name: convert(grid) if "error" in name else grid for name, grid in grids.items()}
    titles = {
        "window_error": f"RMS {error} in the window [{error_unit}]",
        "linear_window_error": f"RMS error from noise, linear theory [{error_unit}]",
        "peak_torque": f"mean peak torque [{unit}]",
        "largest_peak_torque": f"largest peak torque [{unit}]",
    }
    drawn = [name for name in titles if np.any(np.isfinite(grids[name]))]
    rows = (len(drawn) + 1) // 2
    figure = Figure(figsize=(10.0, 4.2 * rows), layout="constrained")
    panels = np.atleast_1d(figure.subplots(rows, 2, sharex=True, sharey=True)).ravel()
    column, row = np.meshgrid(x.values, y.values)
    largest = grids["largest_peak_torque"]
    is_crossed = torque_limit is not None and bool(np.any(largest < torque_limit) and np.any(largest > torque_limit))
    for axes, name in zip(panels, drawn, strict=False):
        same_scale = [other for other in drawn if "error" in other] if "error" in name else [name]
        _draw_colour_map(axes, x, y, grids[name], [grids[other] for other in same_scale])
        axes.plot(column[failed], row[failed], ls="", **FAILED)
        if not_met is not None:
            axes.plot(column[not_met], row[not_met], ls="", **NOT_MET)
        limits = axes.get_xlim(), axes.get_ylim()
        lines = {label: line for label, line in limit_lines.items() if _is_inside(axes, line)}
        for (label, line), (_, style) in zip(lines.items(), STYLES, strict=False):
            axes.plot(*line, color="white", lw=3.0, ls=style)
            axes.plot(*line, color="black", lw=1.4, ls=style, label=label)
        if name == "largest_peak_torque" and is_crossed:
            axes.contour(x.values, y.values, grids[name], [torque_limit], colors=TORQUE_LIMIT, linewidths=2.0)
        axes.set(xlim=limits[0], ylim=limits[1])
        axes.set_title(titles[name], loc="center")
        axes.grid(visible=False)
    for axes in panels[len(drawn) :]:
        axes.remove()
    for k, axes in enumerate(panels[: len(drawn)]):  # numbers on the outer axes, below a gap too
        axes.tick_params(labelbottom=k + 2 >= len(drawn), labelleft=k % 2 == 0)
    figure.supxlabel(x.label)
    figure.supylabel(y.label)
    handles, labels = panels[0].get_legend_handles_labels()
    if np.any(failed):
        handles.append(matplotlib.lines.Line2D([], [], ls="", **FAILED))
        labels.append("a trial failed or did not converge at t_f")
    if not_met is not None and np.any(not_met):
        handles.append(matplotlib.lines.Line2D([], [], ls="", **NOT_MET))
        labels.append("a requirement is not met, see not_met in map.csv")
    if not all(np.all(np.isfinite(grids[name])) for name in drawn):
        handles.append(matplotlib.patches.Patch(color=NO_NUMBER))
        labels.append("the panel has no value, see map.csv")
    if torque_limit is not None and "largest_peak_torque" in drawn:
        handles.append(matplotlib.lines.Line2D([], [], color=TORQUE_LIMIT if is_crossed else "none", lw=2.0))
        beyond = "" if is_crossed else ", beyond this map"
        labels.append(f"limit of peak_torque {torque_limit:g} {unit}{beyond}")
    if stability:
        handles.append(matplotlib.lines.Line2D([], [], ls=""))
        labels.append(stability)
    if handles:
        figure.legend(handles, labels, loc="outside upper left", ncols=2)
    return figure


def _is_inside(axes: Any, line: tuple[np.ndarray, np.ndarray]) -> bool:
    """Return whether a part of a line (x, y) is inside the axes."""
    points = (axes.transScale + axes.transLimits).transform(np.stack(line, axis=1))  # 0 to 1 inside the axes
    points = points[np.all(np.isfinite(points), axis=1)]
    return len(points) > 0 and Path(points).intersects_bbox(Bbox.unit(), filled=False)
