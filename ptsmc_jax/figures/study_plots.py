"""Studies of many runs as matplotlib figures: tuning, trade-offs, maps; each function returns a Figure."""

from collections.abc import Mapping, Sequence
from typing import Any

import matplotlib
import matplotlib.colors
import matplotlib.lines
import matplotlib.ticker
import numpy as np
from matplotlib.figure import Figure
from numpy.typing import ArrayLike

from ptsmc_jax.figures.style import RC, STYLES, edges, figure_of, plain_ticks
from ptsmc_jax.simulation.catalogues import CATALOGUES

MARKERS = ("o", "^", "s", "D", "v")
BEYOND = ("x", "+", "1", "2")  # of points that break a limit, by the limit


def _looks(count: int) -> list[tuple[str, str]]:
    """A colour and a marker for each of many sets, no two alike up to 25."""
    size = len(STYLES)
    return [(STYLES[k % size][0], MARKERS[(k + k // size) % len(MARKERS)]) for k in range(count)]


def tuning_history(
    gains: Mapping[str, tuple[str, np.ndarray]],
    values: np.ndarray,
    admissible: np.ndarray,
    goal: str,
    found: tuple[float, Mapping[str, float]],
) -> Figure:
    """Search of all starts: the goal and the gains over the steps, and what came of it.

    gains: name -> (unit, (steps, starts)); values (steps, starts) of the goal, NaN from where a start was left behind;
    admissible (steps, starts) bool: every requirement met; goal: what the values are, with their unit; found: the goal
    and the gains, by name, that were judged.
    """
    with matplotlib.rc_context(RC):
        figure = Figure(figsize=(8.0, 2.2 * (len(gains) + 1)), layout="constrained")
        axes = figure.subplots(len(gains) + 1, 1, sharex=True)
        steps = np.arange(len(values))
        for start in range(values.shape[1]):
            axes[0].semilogy(steps, values[:, start], color="0.75", lw=1.0)
            met = np.where(admissible[:, start], values[:, start], np.nan)
            axes[0].semilogy(steps, met, color=STYLES[0][0])
        axes[0].plot([], [], color=STYLES[0][0], label="requirements met")
        axes[0].plot([], [], color="0.75", label="beyond a limit")
        for ax, value in zip(axes, (found[0], *(found[1][name] for name in gains)), strict=True):
            ax.axhline(value, color="black", lw=1.0, ls=":", zorder=3, label="found, and judged on fresh trials")
        axes[0].set(ylabel=goal, title="Tuning, all starts")
        axes[0].legend(ncols=3, fontsize=9)
        for k, (name, (unit, seen)) in enumerate(gains.items()):
            axes[k + 1].plot(steps, seen, color=STYLES[1][0], lw=1.0)
            axes[k + 1].set_ylabel(f"{name}\n[{unit}]")
            if np.nanmax(seen) > 10 * np.nanmin(seen):
                axes[k + 1].set_yscale("log")
        axes[-1].set_xlabel("step")
        axes[-1].xaxis.set_major_locator(matplotlib.ticker.MaxNLocator(integer=True))
    return figure


def tornado(sensitivities: Mapping[str, Mapping[str, float]]) -> Figure:
    """How much each metric moves with each gain: metric -> gain -> percent by percent, the largest on top."""
    with matplotlib.rc_context(RC):
        rows = sum(len(by_gain) + 1 for by_gain in sensitivities.values())
        figure = Figure(figsize=(8.0, 1.0 + 0.3 * rows), layout="constrained")
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


def profiles(
    gains: Mapping[str, tuple[str, np.ndarray, np.ndarray, np.ndarray, Sequence[str], float]], goal: str
) -> Figure:
    """The goal along each gain, the others as tuned.

    gains: name -> (unit, gain (points,), goal (points,), largest metric / limit (points,), whose that is (points,), the
    tuned gain).
    """
    marks = dict.fromkeys(of for _, _, _, over, nearest, _ in gains.values() for of in np.asarray(nearest)[over > 1.0])
    marks = {of: BEYOND[k % len(BEYOND)] for k, of in enumerate(marks)}
    with matplotlib.rc_context(RC):
        figure = Figure(figsize=(8.0, 2.7 * len(gains)), layout="constrained")
        axes = figure.subplots(len(gains), 1, sharey=True, squeeze=False)[:, 0]
        for ax, (name, (unit, at, value, over, nearest, tuned)) in zip(axes, gains.items(), strict=True):
            ax.semilogy(at, value, color="0.6", lw=1.2, label="goal")
            kept = over <= 1.0
            ax.semilogy(at[kept], value[kept], "o", color=STYLES[0][0], label="limits kept")
            for of, mark in marks.items():
                broken = ~kept & (np.asarray(nearest) == of)
                ax.semilogy(at[broken], value[broken], mark, color=STYLES[1][0], label=f"beyond the limit of {of}")
            ax.axvline(tuned, color="0.3", lw=0.9, ls=":", label="tuned")
            if at[-1] > 10 * at[0]:
                ax.set_xscale("log")
                plain_ticks(ax.xaxis)
            ax.set(xlabel=f"{name} [{unit}]", ylabel=goal)
        axes[0].legend(loc="lower left", bbox_to_anchor=(0.0, 1.0), ncols=3, fontsize=9)
    return figure


def tradeoff(
    sets: Mapping[str, tuple[ArrayLike, ArrayLike]],
    limit: float | None = None,
    kind: str = "spacecraft",
    floor: float | None = None,
) -> Figure:
    """Accuracy against torque, a point a trial, in the units of this kind of plant.

    sets: label -> (window errors (trials,) [-], peak torques (trials,) [N m]); limit: of the torque; floor: RMS error
    that no controller can beat.
    """
    error_unit, unit = (CATALOGUES[kind][name][0] for name in ("window_error", "peak_torque"))
    figure, axes = figure_of("Accuracy against torque, fresh trials", f"peak torque [{unit}]")
    arrays = {label: (np.asarray(e), np.asarray(u)) for label, (e, u) in sets.items()}
    for (label, (errors, torques)), (colour, marker) in zip(arrays.items(), _looks(len(arrays)), strict=True):
        rms, mean = np.sqrt(np.nanmean(errors**2)), np.nanmean(torques)
        axes.loglog(errors, torques, marker, ms=2.5, alpha=0.35, color=colour, mew=0)
        text = f"{label.replace('_', ' ')}: RMS {rms:.2e}, mean peak {mean:.3g} {unit}"
        axes.loglog(rms, mean, marker, ms=9, color=colour, mec="white", label=text)
    if limit is not None:
        axes.axhline(limit, color="0.3", lw=1.0, ls=(0, (6, 3)), label=f"limit {limit:g} {unit}")
    if floor:
        axes.axvline(floor, color="0.3", lw=1.0, ls=":", label=f"floor {floor:.2g}")
    axes.set_xlabel(f"window error [{error_unit}]")
    _legend_below(figure, len(arrays) + 2, columns=1)
    return figure


def _legend_below(figure: Figure, entries: int, columns: int) -> None:
    """A legend outside of the axes, and room for it."""
    rows = -(-entries // columns)
    figure.set_size_inches(8.0, 4.5 + 0.26 * rows)
    figure.legend(loc="outside lower left", ncols=columns, fontsize=9, markerscale=1.0)


def settling_by_angle(sets: Mapping[str, tuple[np.ndarray, np.ndarray]], t_f: float, unit: str = "s") -> Figure:
    """When each trial settles against where it starts; label -> (initial angles [deg], settling times, NaN: never)."""
    figure, axes = figure_of("When it settles, by where it starts", f"settling time [{unit}]")
    for (label, (angle, time)), (colour, marker) in zip(sets.items(), _looks(len(sets)), strict=True):
        known, name = np.isfinite(time), label.replace("_", " ")
        said = f"{name}: {int((~known).sum())} never" if np.any(~known) else name
        axes.plot(angle[known], time[known], marker, ms=3.5, alpha=0.5, color=colour, mew=0, label=said)
    axes.axhline(t_f, color="0.3", lw=0.9, ls=":")
    axes.annotate("$t_f$", (1.0, t_f), xycoords=("axes fraction", "data"), xytext=(4, 0), textcoords="offset points",
                  va="center")  # fmt: skip
    axes.set_xlabel("initial angle [deg]")
    _legend_below(figure, len(sets), columns=2)
    return figure


def front(
    points: Sequence[Any],
    others: Mapping[str, Any],
    limit: float | None,
    units: tuple[str, ...],
    name: str = "front",
    floor: float | None = None,
) -> Figure:
    """Window error against peak torque of the points of a front, with their intervals.

    Points have rms, interval, peak, dominated and knee; others, by label: such points that are no part of it; units: of
    error and torque; floor: the error that no controller can beat.
    """
    figure, axes = figure_of(f"Accuracy against torque: the {name}, fresh trials", f"RMS window error [{units[0]}]")
    kept = [point for point in points if not point.dominated]
    axes.loglog([p.peak for p in kept], [p.rms for p in kept], color=STYLES[0][0], lw=1.2)
    for chosen, colour, marker, label in ((kept, STYLES[0][0], "o", "front"),
                                          ([p for p in points if p.dominated], "0.6", "o", "dominated")):  # fmt: skip
        for k, p in enumerate(chosen):
            low, high = p.interval or (p.rms, p.rms)
            axes.errorbar(p.peak, p.rms, [[max(p.rms - low, 0.0)], [max(high - p.rms, 0.0)]], fmt=marker, ms=4,
                          color=colour, elinewidth=1.0, capsize=2, label=label if k == 0 else None)  # fmt: skip
    for p in kept:
        if p.knee:
            axes.loglog(p.peak, p.rms, "o", ms=13, mfc="none", mec=STYLES[3][0], mew=1.4, label="knee")
    for (label, p), marker, style in zip(others.items(), ("^", "s", "D"), STYLES[1:], strict=False):
        if np.isfinite(p.rms):
            axes.loglog(p.peak, p.rms, marker, ms=8, color=style[0], label=f"{label}: {p.rms:.2e}")
    if limit is not None:
        axes.axvline(limit, color="0.3", lw=1.0, ls=(0, (6, 3)), label=f"limit {limit:g} {units[1]}")
    if floor:
        axes.axhline(floor, color="0.3", lw=1.0, ls=":", label=f"floor {floor:.2g}")
    axes.set_xlabel(f"largest peak torque [{units[1]}]")
    plain_ticks(axes.xaxis)
    axes.legend(fontsize=9)
    return figure


def slew_times(slews: Sequence[Any], units: Mapping[str, str], limits: Mapping[str, float]) -> Figure:
    """Error and what it costs over the prescribed time, a panel each; dashed: what the scenario allows.

    Slews have t_f, rms, interval, costs by metric and meets; units and limits by metric.
    """
    names, columns = ["window_error", *slews[0].costs], 3
    rows, times = -(-len(names) // columns), [slew.t_f for slew in slews]
    with matplotlib.rc_context(RC):
        figure = Figure(figsize=(10.5, 3.0 * rows), layout="constrained")
        figure.suptitle("What a faster slew costs, fresh trials")
        for k, name in enumerate(names):
            axes, error = figure.add_subplot(rows, columns, k + 1), name == "window_error"
            values = [slew.rms if error else slew.costs[name] for slew in slews]
            axes.plot(times, values, "-", color=STYLES[0][0], lw=1.2)
            for met, fill, label in ((True, STYLES[0][0], "meets every requirement"), (False, "white", "does not")):
                some = [(t, v) for t, v, slew in zip(times, values, slews, strict=True) if slew.meets == met]
                at = zip(*some, strict=True) if some else ([], [])
                axes.plot(*at, "o", ms=5, mfc=fill, mec=STYLES[0][0], label=label)
            if error:
                low, high = zip(*(slew.interval or (slew.rms, slew.rms) for slew in slews), strict=True)
                axes.fill_between(times, low, high, color=STYLES[0][0], alpha=0.2, lw=0)
                axes.legend(fontsize=8)
            if np.all(np.asarray(values) > 0.0):
                axes.set_yscale("log")
                plain_ticks(axes.yaxis)
            if name in limits:
                axes.axhline(limits[name], color="0.3", lw=1.0, ls=(0, (6, 3)))
            title = "RMS window error" if error else f"largest {name.replace('_', ' ')}"
            axes.set_title(f"{title} [{units[name]}]", fontsize=10)
            axes.set_xlabel("prescribed time t_f [s]", fontsize=10)
    return figure


def accuracy_map(
    x: tuple[str, Sequence[float], bool],
    y: tuple[str, Sequence[float], bool],
    grids: Mapping[str, np.ndarray],
    lost: np.ndarray,
    borders: Mapping[str, tuple[np.ndarray, np.ndarray]],
    kind: str = "spacecraft",
) -> Figure:
    """Window error as flown and by linear theory, and peak torques, over two keys.

    x, y: key, values, whether on a log scale; grids: name -> (y, x); lost: (y, x) bool, a trial failed or missed t_f.
    """
    error_unit, unit = (CATALOGUES[kind][name][0] for name in ("window_error", "peak_torque"))
    titles = {
        "window_error": f"RMS window error [{error_unit}]",
        "linear_window_error": f"its share from noise, linear theory [{error_unit}]",
        "peak_torque": f"mean peak torque [{unit}]",
        "largest_peak_torque": f"largest peak torque [{unit}]",
    }
    drawn = [name for name in titles if np.any(np.isfinite(grids[name]))]
    with matplotlib.rc_context(RC):
        rows = (len(drawn) + 1) // 2
        figure = Figure(figsize=(10.0, 4.2 * rows), layout="constrained")
        many = np.atleast_1d(figure.subplots(rows, 2, sharex=True, sharey=True)).ravel()
        errors = np.concatenate([[], *(grids[name].ravel() for name in drawn if "error" in name)])
        torques = np.concatenate([[], *(grids[name].ravel() for name in drawn if "torque" in name)])
        for axes, name in zip(many, drawn, strict=False):
            seen = errors if "error" in name else torques
            seen = seen[np.isfinite(seen) & (seen > 0)]
            low, high = (seen.min(), min(seen.max(), seen.min() * 1e4)) if seen.size else (1e-12, 1.0)
            norm = matplotlib.colors.LogNorm(low, max(high, 1.01 * low))
            if x[2]:
                axes.set_xscale("log")
                plain_ticks(axes.xaxis)
            if y[2]:
                axes.set_yscale("log")
                plain_ticks(axes.yaxis)
            shown = np.ma.masked_invalid(grids[name])
            mesh = axes.pcolormesh(edges(*x[1:]), edges(*y[1:]), shown, norm=norm, cmap="cividis")
            figure.colorbar(mesh, ax=axes, extend="max" if seen.size and seen.max() > high else "neither")
            column, row = np.meshgrid(x[1], y[1])
            axes.plot(column[lost], row[lost], "x", color="white", ms=5, mew=1.2)
            limits = axes.get_xlim(), axes.get_ylim()
            for (label, line), style in zip(borders.items(), ("-", "--", ":"), strict=False):
                axes.plot(*line, color="white", lw=3.0, ls=style)
                axes.plot(*line, color="black", lw=1.4, ls=style, label=label)
            axes.set(xlim=limits[0], ylim=limits[1], title=titles[name])
            axes.grid(visible=False)
        for axes in many[len(drawn) :]:
            axes.remove()
        for k, axes in enumerate(many[: len(drawn)]):  # numbers on the outer axes, below a gap too
            axes.tick_params(labelbottom=k + 2 >= len(drawn), labelleft=k % 2 == 0)
        figure.supxlabel(x[0])
        figure.supylabel(y[0])
        handles, labels = many[0].get_legend_handles_labels()
        if np.any(lost):
            handles.append(matplotlib.lines.Line2D([], [], color="0.4", marker="x", ls=""))
            labels.append("a trial failed or missed t_f")
        if handles:
            figure.legend(handles, labels, loc="outside upper left", ncols=len(handles))
    return figure
