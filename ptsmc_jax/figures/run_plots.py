"""Histories of runs as matplotlib figures with units. Each function returns a Figure."""

from collections.abc import Mapping
from typing import Any

import jax
import numpy as np
from matplotlib.axes import Axes
from matplotlib.figure import Figure
from numpy.typing import ArrayLike

from ptsmc_jax.figures.style import (
    ACTUATOR_LIMIT,
    LIMIT,
    NO_LIMITS,
    STYLES,
    error_display,
    legend_below,
    metric_display,
    new_figure,
    plain_ticks,
    with_unit,
)
from ptsmc_jax.plants.base import Chart
from ptsmc_jax.simulation.catalogues import CATALOGUE
from ptsmc_jax.simulation.rollout import Log, Parts
from ptsmc_jax.theory import envelopes, solutions
from ptsmc_jax.theory.lower_bound import LowerBound

FAR_OFF = 3.0  # a limit or command beyond this multiple of the curves is only named in the legend
SMALLEST, LARGEST = 1e-16, 1e100  # log axes end at SMALLEST; larger numbers than LARGEST are left out
EXACT_LINE: Any = {"color": "0.25", "lw": 0.9, "ls": (0, (1, 1.5))}  # style of the line of the exact motion
BOUND_LINE: Any = {"color": "0.35", "lw": 1.0, "ls": "--", "label": "bound, no noise"}


def run_figures(
    parts: Parts, log: Log, limits: Mapping[str, float], lower_bound: LowerBound | None
) -> dict[str, Figure]:
    """Return the figures of one run by name.

    Args:
        parts: parts of the run.
        log: history of the run, NumPy arrays (time, component).
        limits: required limits by metric, in the unit of the metric.
        lower_bound: lower bound of the error.
    """
    log = jax.tree.map(lambda v: np.where(np.abs(v) < LARGEST, v, np.nan), log)
    figures = {"torque": torque(parts, log, limits)}
    if np.any(log.error):  # log axes cannot show zeros
        figures = {"error": error(parts, log, limits, lower_bound), "sliding": sliding(parts, log), **figures}
        if parts.controller.prescribed and any(map(np.any, solutions.exact_sizes(parts, log.t[:1]))):
            figures["convergence"] = convergence(parts, log)
    if np.any(log.d_hat):
        figures["disturbance"] = disturbance(parts, log)
    if log.wheels is not None:
        momentum, wheel_torque = log.wheels
        figures["wheels"] = wheels(parts, log, limits, "momentum", momentum, "h")
        figures["wheel_torque"] = wheels(parts, log, limits, "torque", wheel_torque, "v")
    return {**{chart.name: state(parts, log, chart) for chart in parts.plant.charts}, **figures}


def state(parts: Parts, log: Log, chart: Chart, title: str | None = None) -> Figure:
    """Plot components of the plant's state over time, and the reference if the chart has one.

    Args:
        parts: parts of the run.
        log: history of the run, NumPy arrays (time, component).
        chart: the components to plot, one of `parts.plant.charts`.
        title: title of the figure; None: the title of the chart.
    """
    figure, axes = new_figure(title or chart.title, chart.label)
    _plot_components(axes, log.t, parts.plant.columns(log.x)[chart.column], chart.column)
    if chart.with_reference:
        axes.plot(log.t, getattr(log.reference, chart.column), color="0.6", lw=1.0, zorder=1)
        axes.plot([], [], color="0.6", lw=1.0, label="reference")
    _mark_t_f_and_add_legend(figure, parts)
    return figure


def error(
    parts: Parts, log: Log, limits: Mapping[str, float] = NO_LIMITS, lower_bound: LowerBound | None = None
) -> Figure:
    """Plot the error's 2-norm on a log scale, with its bounds, its limits and the window of window_error.

    Args:
        parts: parts of the run.
        log: history of the run, NumPy arrays (time, component).
        limits: required limits by metric, in the unit of the metric.
        lower_bound: lower bound of the error over time; None: it is not drawn.
    """
    if plant_kind(parts) == "spacecraft":
        convert, name, unit = error_display("spacecraft")
        figure, axes = new_figure(name.capitalize(), with_unit(name, unit))
    else:
        convert, (figure, axes) = np.asarray, new_figure("Error", _error_label(parts))
    size = convert(np.linalg.norm(log.error, axis=1))
    axes.semilogy(log.t, _zeros_to_nan(size), color=STYLES[0][0], label="simulated")
    if parts.controller.prescribed:
        before = log.t[log.t < float(parts.controller.hand_over)]
        axes.plot(before, convert(envelopes.error_bound(parts, before)), **BOUND_LINE)
    if lower_bound is not None and lower_bound.window_error > 0.0:
        lower_bound_values = convert(lower_bound.error)
        # without the values before the first samples, when nothing is known of the state
        known = (lower_bound_values > 0.0) & (lower_bound_values < size.max())
        axes.plot(lower_bound.t[known], lower_bound_values[known], color=STYLES[2][0], lw=1.2, label="lower bound")
    t_f = float(parts.controller.t_f)
    axes.axvspan(t_f, t_f + float(parts.window), color="0.85", label="window of window_error")
    draw_error_limits(axes, parts, limits, float(log.t[-1]))
    _cut_axis(axes)
    _mark_t_f_and_add_legend(figure, parts)
    return figure


def plant_kind(parts: Parts) -> str:
    """Return a kind of plant with the same unit of the error, see `style.error_display`."""
    return "spacecraft" if parts.controller.kinematics.angle_unit == "rad" else "chain"


def draw_error_limits(axes: Axes, parts: Parts, limits: Mapping[str, float], t_end: float) -> None:
    """Draw the required limits of the error, each over the interval that it limits.

    Limits of pointing indices are not drawn: they limit the error about one axis or of the boresight.

    Args:
        axes: axes with the time [s] and the error in the unit of `metric_display`.
        parts: parts of the run.
        limits: required limits by metric, in the unit of the metric.
        t_end: end of the last interval [s].
    """
    t_f = float(parts.controller.t_f)
    intervals = {"terminal": (t_f, t_f), "window": (t_f, t_f + float(parts.window)), "hold": (t_f, t_end)}
    for metric, limit in limits.items():
        interval = intervals.get(metric.split("_")[0])
        if interval is not None:
            convert, unit = metric_display(metric, plant_kind(parts))
            shown = float(convert(limit))
            label = f"limit of {metric} {shown:.4g} {unit}".rstrip()
            axes.plot(interval, (shown, shown), marker="_", ms=8, **LIMIT, label=label)


def torque(parts: Parts, log: Log, limits: Mapping[str, float] = NO_LIMITS, title: str | None = None) -> Figure:
    """Plot the delivered input over time, with its largest value and its limits.

    Args:
        parts: parts of the run.
        log: history of the run, NumPy arrays (time, component).
        limits: required limits by metric, in the unit of the metric.
        title: title of the figure; None: "Control".
    """
    unit = f" {parts.plant.input_unit}".rstrip()
    figure, axes = new_figure(title or "Control", with_unit(parts.plant.input_name, parts.plant.input_unit))
    _plot_components(axes, log.t, log.u, "u", drawstyle="steps-post" if parts.clock.sampled else "default")
    largest_shown = FAR_OFF * np.nanmax(np.abs(log.u)) or np.inf  # larger commands would flatten the curves
    if parts.controller.prescribed:
        t, u, _ = (np.asarray(v) for v in solutions.exact_path(parts))
        axes.plot(t, u, **EXACT_LINE)
        axes.plot([], [], **EXACT_LINE, label="exact, perfect estimate")
        if np.nanmax(np.abs(u)) > largest_shown:
            axes.set_ylim(-largest_shown, largest_shown)
    row, column = np.unravel_index(np.argmax(np.nan_to_num(np.abs(log.commanded))), log.commanded.shape)
    peak = log.commanded[row, column]
    delivered = np.array_equal(log.u, log.commanded, equal_nan=True)  # otherwise the peak is not on the curves
    peak_name = "peak" if delivered else "peak of the command"
    label = f"{peak_name} {abs(peak):.3g}{unit} at {log.t[row]:.4g} s"
    if abs(peak) > largest_shown:
        axes.plot([], [], color="none", label=f"{label}, beyond this axis")
    else:
        axes.plot(log.t[row], peak, "o", mfc="none", color="black", label=label)
    for metric in ("peak_torque", "peak_torque_delivered"):
        _draw_limit(axes, limits.get(metric), f"limit of {metric}", unit)
    _mark_t_f_and_add_legend(figure, parts)
    return figure


def wheels(
    parts: Parts, log: Log, limits: Mapping[str, float], quantity: str, values: ArrayLike, symbol: str
) -> Figure:
    """Plot a quantity of each reaction wheel over time, with the required limit and the limit of the wheels.

    Args:
        parts: parts of the run.
        log: history of the run.
        limits: required limits by metric, in the unit of the metric.
        quantity: "momentum" or "torque".
        values: the quantity (time, wheel) in the unit of its metric.
        symbol: symbol of the quantity.
    """
    metric, key = f"peak_wheel_{quantity}", f"{quantity}_limit"
    unit = CATALOGUE[metric].unit
    figure, axes = new_figure(f"{quantity.capitalize()} of the reaction wheels", f"{quantity} [{unit}]")
    _plot_components(axes, log.t, values, symbol)
    _draw_limit(axes, limits.get(metric), f"limit of {metric}", f" {unit}")
    _draw_limit(axes, getattr(parts.actuators.wheels, key, None), f"wheels.{key}", f" {unit}", ACTUATOR_LIMIT)
    _mark_t_f_and_add_legend(figure, parts)
    return figure


def sliding(parts: Parts, log: Log) -> Figure:
    """Plot the sliding variable on a log scale, with its envelope before the hand-over (continuous loop, no noise)."""
    unit = parts.controller.kinematics.error_unit
    # other laws define s differently, with other units
    label = f"|s| [{unit}], after the hand-over [1/s]" if unit and parts.controller.prescribed else "|s|"
    figure, axes = new_figure("Sliding variable", label)
    _plot_components(axes, log.t, _zeros_to_nan(np.abs(log.s)), "s")
    if parts.controller.prescribed:
        before = log.t[log.t < float(parts.controller.hand_over)]
        axes.plot(before, envelopes.sliding_bound(parts, before), **BOUND_LINE)
    axes.set_yscale("log")
    _cut_axis(axes)
    _mark_t_f_and_add_legend(figure, parts)
    return figure


def convergence(parts: Parts, log: Log, title: str = "Convergence") -> Figure:
    """Plot error and s against time to go on log axes, with the exact motion and the theoretical slopes.

    Args:
        parts: parts of the run.
        log: history of the run, NumPy arrays (time, component).
        title: title of the figure.
    """
    symbol = parts.controller.kinematics.symbol
    law, n = parts.controller, parts.controller.order
    t_f, eta, delta = float(law.t_f), float(law.eta), float(law.delta)
    figure, axes = new_figure(title, with_unit(f"{symbol} and |s|", law.kinematics.error_unit))
    before = log.t < float(law.hand_over) * (1 - 1e-12)
    t = np.asarray(log.t)[before]
    tau = t_f - t
    simulated = {
        symbol: (np.linalg.norm(log.error, axis=1)[before], eta, STYLES[0]),
        "|s|": (np.linalg.norm(log.s, axis=1)[before], eta + n - 2, STYLES[1]),
    }
    exact = solutions.exact_sizes(parts, t)
    bottom = min(np.min(size[size > 0], initial=1.0) for size, _, _ in simulated.values())
    for (name, (size, _, (colour, style))), ideal in zip(simulated.items(), exact, strict=True):
        axes.loglog(tau, size, color=colour, ls=style, label=f"{name}, simulated")
        axes.loglog(tau, ideal, **EXACT_LINE)
    # short lines with the slopes of the theory, above the error and, if it differs, below s
    span = t_f * np.array([0.3, max(0.03, delta / t_f)])
    above = 6.0 * float(np.interp(-span[0], -tau, np.maximum(*exact)))
    guides = [(above, eta, "$\\eta$", 6)]
    if n > 2:
        guides.append((float(np.interp(-span[0], -tau, np.minimum(*exact))) / 30.0, eta + n - 2, "$\\eta+n-2$", -14))
    for start, slope, name, shift in guides if span[1] < span[0] else ():
        line = start * (span / span[0]) ** slope
        bottom = min(bottom, line[1])
        axes.loglog(span, line, color="black", lw=1.0)
        axes.annotate(f"slope {name} = {slope:g}", (np.sqrt(span[0] * span[1]), np.sqrt(line[0] * line[1])),
                      fontsize=10, xytext=(6, shift), textcoords="offset points",
                      ha="left" if shift > 0 else "right")  # fmt: skip
    axes.plot([], [], **EXACT_LINE, label="exact, perfect estimate")
    axes.set_xlabel("time to go $t_f - t$ [s], until the hand-over")
    axes.set_ylim(bottom=bottom / 3)
    plain_ticks(axes.xaxis)
    axes.invert_xaxis()
    axes.legend(loc="lower left")
    return figure


def disturbance(parts: Parts, log: Log) -> Figure:
    """Plot estimated and true disturbance over time; the true one on top, so that noise does not cover it."""
    figure, axes = new_figure("Disturbance and its estimate", with_unit("disturbance", parts.plant.input_unit))
    _plot_components(axes, log.t, log.d_hat, "\\hat d", alpha=0.7)
    axes.plot(log.t, log.disturbance, color="white", lw=2.6, zorder=4)
    for k, true in enumerate(np.asarray(log.disturbance).T):
        axes.plot(
            log.t, true, color="black", lw=1.2, ls=STYLES[k % len(STYLES)][1], zorder=5, label=f"true $d_{{{k + 1}}}$"
        )
    _mark_t_f_and_add_legend(figure, parts)
    return figure


def _error_label(parts: Parts) -> str:
    """Return the symbol of the law's error with its unit."""
    return with_unit(parts.controller.kinematics.symbol, parts.controller.kinematics.error_unit)


def _plot_components(axes: Axes, t: ArrayLike, values: ArrayLike, symbol: str, **kwargs: Any) -> None:
    """Plot values (time, components) over the times t (time,), a labelled line for each component."""
    values = np.asarray(values)
    for k in range(values.shape[1]):  # more components than styles: thin lines, then pale lines
        colour, style = STYLES[k % len(STYLES)]
        style_cycle = k // len(STYLES)
        width = {"lw": 0.8} if style_cycle % 2 else {}
        paler = {"alpha": 0.45 * kwargs.get("alpha", 1.0)} if style_cycle >= 2 else {}
        label = f"${symbol}_{{{k + 1}}}$"
        axes.plot(np.asarray(t), values[:, k], color=colour, ls=style, label=label, **width, **{**kwargs, **paler})


def _zeros_to_nan(sizes: np.ndarray) -> np.ndarray:
    """Return sizes for a log axis, NaN for 0."""
    return np.where(sizes > 0.0, sizes, np.nan)


def _cut_axis(axes: Axes) -> None:
    """Cut the axis at `SMALLEST`."""
    low, high = axes.get_ylim()
    axes.set_ylim(bottom=SMALLEST if low < SMALLEST < high else low)


def _draw_limit(axes: Axes, limit: float | None, name: str, unit: str, style: Any = LIMIT) -> None:
    """Draw lines at plus and minus a limit; only name it in the legend if it would flatten the curves."""
    if limit is None:
        return
    label = f"{name} {float(limit):.4g}{unit}"
    largest = max((np.nanmax(np.abs(line.get_ydata()), initial=0.0) for line in axes.lines), default=0.0)
    if limit > FAR_OFF * largest > 0.0:
        axes.plot([], [], color="none", label=f"{label}, beyond this axis")
        return
    for sign in (-1.0, 1.0):
        axes.axhline(sign * limit, **style)
    axes.plot([], [], **style, label=label)


def _mark_t_f_and_add_legend(figure: Figure, parts: Parts) -> None:
    """Draw lines at the prescribed time and at an earlier hand-over, and add a legend."""
    (axes,), t_f = figure.axes, float(parts.controller.t_f)
    times = {t_f: f"$t_f$ = {t_f:g} s"}
    if parts.controller.prescribed and t_f - float(parts.controller.hand_over) > 0.15 * np.ptp(axes.get_xlim()):
        times[float(parts.controller.hand_over)] = "hand-over"
    for time, name in times.items():
        axes.axvline(time, color="0.3", lw=0.9, ls=":")
        axes.annotate(
            name, (time, 1.0), xycoords=("data", "axes fraction"), xytext=(0, 3),
            textcoords="offset points", ha="center", va="bottom", fontsize=9, color="0.3",
        )  # fmt: skip
    axes.margins(x=0.01)
    legend_below(figure, columns=3)
