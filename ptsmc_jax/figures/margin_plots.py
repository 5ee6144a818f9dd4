"""The open loop as figures: Nichols chart, sensitivity, margins against time to go."""

from collections.abc import Mapping, Sequence
from typing import Any

import numpy as np
from matplotlib.figure import Figure
from matplotlib.ticker import MaxNLocator

from ptsmc_jax.figures.style import LIMIT, NO_LIMITS, STYLES, legend_below, logarithmic, plain_ticks, styled
from ptsmc_jax.simulation.catalogues import MARGINS
from ptsmc_jax.theory.margins import Margins

CONTOUR = 6.0  # sensitivity of the contour without a required limit [dB]
LARGEST_SHOWN = 40.0  # |L| is drawn from minus this value to this value [dB]


def _sensitivity_line(limits: Mapping[str, float], style: str) -> dict[str, Any]:
    """Return the keywords of the line at the largest allowed sensitivity, or at `CONTOUR` if no limit is required."""
    limit = limits.get("peak_sensitivity")
    if limit is None:
        return {"color": "0.35", "lw": 1.0, "ls": style, "label": f"sensitivity {CONTOUR:g} dB"}
    return {**LIMIT, "label": f"limit of peak_sensitivity {limit:g} dB"}


def _decibels(values: np.ndarray) -> np.ndarray:
    """Return magnitudes [dB]. Zero, as when a saturated command ignores the state, is put far below the axis."""
    return 20.0 * np.log10(np.maximum(np.abs(values), 1e-9))


@styled
def nichols(L: np.ndarray, names: Sequence[str], limits: Mapping[str, float] = NO_LIMITS) -> Figure:
    """Plot |L| over its phase, with the point -1 and a contour of the sensitivity.

    Args:
        L: open-loop transfer function of each axis, complex (frequencies, axes) [-].
        names: names of the axes.
        limits: required margins by name, in dB and deg. The curves must not cross the lines of the gain and phase
            margins.
    """
    figure = Figure(figsize=(8.0, 5.5), layout="constrained")
    axes = figure.subplots()
    for k, name in enumerate(names):
        size, phase = _decibels(L[:, k]), np.rad2deg(np.unwrap(np.angle(L[:, k])))
        crossing = np.argmin(np.abs(size))  # choose the branch with the crossing of 0 dB nearest to -180 degrees
        phase = phase - 360.0 * np.round((phase[crossing] + 180.0) / 360.0)
        colour, style = STYLES[k % len(STYLES)]
        axes.plot(phase, size, color=colour, ls=style, label=name)
    largest = limits.get("peak_sensitivity", CONTOUR)
    contour = np.exp(1j * np.linspace(0.0, 2.0 * np.pi, 721)) * 10.0 ** (-largest / 20.0) - 1.0
    angle = np.rad2deg(np.angle(contour)) % 360.0 - 360.0
    axes.plot(angle, _decibels(contour), **_sensitivity_line(limits, "-"))
    shown = ("gain_margin", "phase_margin")
    gain, phase = (limits.get(name, np.nan) for name in shown)
    axes.plot([-180.0, -180.0], [-gain, gain], **LIMIT)
    axes.plot([-180.0 - phase, -180.0 + phase], [0.0, 0.0], **LIMIT)
    required = [f"{name} {limits[name]:g} {MARGINS[name].unit}" for name in shown if name in limits]
    if required:
        axes.plot([], [], **LIMIT, label=f"limits of {', '.join(required)}")
    axes.plot(-180.0, 0.0, "+", color="0.0", ms=12, mew=1.6)
    axes.xaxis.set_major_locator(MaxNLocator(9, steps=[1, 4.5, 9, 10]))  # multiples of 45 or 90 deg
    axes.set(xlabel="phase of L [deg]", ylabel="|L| [dB]", ylim=(-LARGEST_SHOWN, LARGEST_SHOWN))
    axes.set_title("Nominal loop, opened at the plant's input, hold phase", loc="left")
    legend_below(figure, columns=3)
    return figure


@styled
def sensitivity(w: np.ndarray, L: np.ndarray, names: Sequence[str], limits: Mapping[str, float] = NO_LIMITS) -> Figure:
    """Plot |S| = |1 / (1 + L)| and |T| = |L / (1 + L)| over the frequency.

    Args:
        w: frequencies in ascending order, (frequencies,) [rad/s].
        L: open-loop transfer function of each axis, complex (frequencies, axes) [-].
        names: names of the axes.
        limits: required margins by name. The limit of `peak_sensitivity` [dB] is drawn.
    """
    figure = Figure(figsize=(8.0, 4.5), layout="constrained")
    axes = figure.subplots()
    is_shown, largest = w > w[-1] * 1e-4, 0.0
    for k, name in enumerate(names):
        colour, _ = STYLES[k % len(STYLES)]
        for letter, transfer, style in (("S", 1.0 / (1.0 + L[:, k]), "-"), ("T", L[:, k] / (1.0 + L[:, k]), "--")):
            size = _decibels(transfer)
            axes.semilogx(w[is_shown], size[is_shown], color=colour, ls=style, label=f"{letter} {name}")
            largest = max(largest, size[is_shown].max())
    axes.axhline(limits.get("peak_sensitivity", CONTOUR), **_sensitivity_line(limits, ":"))
    axes.set(xlabel="frequency [rad/s]", ylabel="magnitude [dB]", ylim=(-LARGEST_SHOWN, largest + 15.0))
    axes.set_title("Sensitivity S and complementary sensitivity T, nominal loop, hold phase", loc="left")
    axes.legend(ncols=len(names) + 1)
    return figure


@styled
def margins_over_time(
    time_to_go: np.ndarray,
    judged: np.ndarray,
    before: Margins,
    hold: Margins,
    limits: Mapping[str, float] = NO_LIMITS,
) -> Figure:
    """Plot the margins of the worst axis against time to go, and of the hold phase as lines.

    Times of samples that no requirement judges are grey, before the first judged sample and after the last one.

    Args:
        time_to_go: times to go (times,) [s], longest first.
        judged: whether a requirement judges the margins at each time, bool (times,).
        before: margins at these times (times, axes).
        hold: margins in the hold phase (axes,).
        limits: required margins by name.
    """
    figure = Figure(figsize=(9.5, 6.5), layout="constrained")
    rows = figure.subplots(3, 1, sharex=True)
    panels = (("gain", "dB", "gain_up", "gain_down"), ("phase", "deg", "phase"), ("delay", "s", "delay"))
    for axes, (label, unit, *names) in zip(rows, panels, strict=True):
        for name, (colour, style) in zip(names, STYLES, strict=False):
            values = np.where(before.stable[:, 0], getattr(before, name).min(axis=1), np.nan)
            axes.semilogx(time_to_go, values, color=colour, ls=style, marker=".", label=name.replace("_", " "))
            worst = float(getattr(hold, name).min())
            if np.isfinite(worst):
                axes.axhline(worst, color=colour, lw=1.0, ls=":", label=f"hold phase: {worst:.3g} {unit}")
        limited = any(np.isfinite(getattr(margins, name)).any() for margins in (before, hold) for name in names)
        if not limited:
            axes.text(0.5, 0.5, "without a limit", transform=axes.transAxes, ha="center", va="center")
        unstable_times = time_to_go[~before.stable[:, 0]]
        if unstable_times.size:
            bottom = np.full_like(unstable_times, 0.03)
            axes.plot(
                unstable_times, bottom, "x", color="0.3", label="frozen loop unstable",
                transform=axes.get_xaxis_transform(),
            )  # fmt: skip
        limit = limits.get(f"{label}_margin")
        if limit is not None:
            axes.axhline(limit, **LIMIT, label=f"limit {limit:g} {unit}")
        axes.set(ylabel=f"{label} [{unit}]")
        if label == "delay" and limited:  # delays span several powers of ten, as they shrink with the time to go
            logarithmic(axes, "y")
        else:
            axes.set_ylim(bottom=0.0)
    if judged.any():
        near, far = rows[0].get_xlim()
        for axes in rows:
            axes.axvspan(far, time_to_go[judged][0], color="0.93", zorder=0, label="not judged\nby requirements")
            if not judged[-1]:  # otherwise the rest of the axis has no sample
                axes.axvspan(time_to_go[judged][-1], near, color="0.93", zorder=0)
            axes.set_xlim(far, near)
    for axes in rows:
        axes.legend(fontsize=9, loc="center left", bbox_to_anchor=(1.0, 0.5))
    rows[-1].set_xlabel("time to go $t_f - t$ [s], until the hand-over")
    plain_ticks(rows[-1].xaxis)
    rows[0].set_title("Margins of the nominal loop with frozen gains, worst axis", loc="left")
    return figure
