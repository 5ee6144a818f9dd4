"""Histories of runs as matplotlib figures, axes labelled with units; each function returns a Figure."""

from collections.abc import Sequence
from typing import Any

import jax
import numpy as np
from matplotlib.axes import Axes
from matplotlib.figure import Figure
from numpy.typing import ArrayLike

from ptsmc_jax.figures.style import LIMIT, STYLES, TIME, figure_of, plain_ticks, styled
from ptsmc_jax.paper.remark_2 import Measured
from ptsmc_jax.simulation.rollout import Log, Parts
from ptsmc_jax.theory import envelopes, solutions
from ptsmc_jax.theory.error_floor import Floor

FAR_OFF = 3.0  # times what is drawn, from which on a limit, or a command that is not delivered, is not drawn
SMALLEST, LARGEST = 1e-16, 1e100  # of errors and s that are shown; of all that a run that diverges leaves
MANY_POINTS = 200_000  # of curves, from which on a place for the legend takes as long to find as they take to draw
EXACT: Any = {"color": "0.25", "lw": 0.9, "ls": (0, (1, 1.5))}  # how the exact motion is drawn, and a bound
BOUND: Any = {"color": "0.35", "lw": 1.0, "ls": "--", "label": "bound, no noise"}


def run_figures(parts: Parts, log: Log, limit: float | None, floor: Floor | None) -> dict[str, Figure]:
    """Figures of one run by name; log with numpy arrays (time, component); limit: largest torque allowed [N m]."""
    log = jax.tree.map(lambda v: np.where(np.abs(v) < LARGEST, v, np.nan), log)
    figures = {"torque": torque(parts, log, limit)}
    if np.any(log.error):  # else there is nothing that log axes show
        figures = {"error": error(parts, log, floor), "sliding": sliding(parts, log), **figures}
        if parts.controller.prescribed and any(map(np.any, solutions.exact_sizes(parts, log.t[:1]))):
            figures["convergence"] = convergence(parts, log)
    if np.any(log.d_hat):
        figures["disturbance"] = disturbance(parts, log)
    if log.wheels is not None:
        figures["wheels"] = wheels(parts, log)
        figures["wheel_torque"] = wheel_torque(parts, log)
    if parts.plant.attitude:
        return {"attitude": attitude(parts, log), "rate": rate(parts, log), **figures}
    return {"states": states(parts, log), **figures}


def attitude(parts: Parts, log: Log, title: str = "Attitude") -> Figure:
    """Quaternion and its reference over time."""
    figure, axes = figure_of(title, "quaternion component [-]")
    _components(axes, log.t, log.x.q, "q")
    axes.plot(log.t, log.reference.q, color="0.6", lw=1.0, zorder=1)
    axes.plot([], [], color="0.6", lw=1.0, label="reference")
    _mark(axes, parts)
    _legend(axes, ncols=3)
    return figure


def states(parts: Parts, log: Log, title: str = "States") -> Figure:
    """States of a chain or a system over time."""
    figure, axes = figure_of(title, "state")
    _components(axes, log.t, log.x, "x")
    _mark(axes, parts)
    _legend(axes, ncols=2)
    return figure


def error(parts: Parts, log: Log, floor: Floor | None = None) -> Figure:
    """2-norm of the error on a log scale with its bound and floor, and the window in which it is judged."""
    symbol, _, _ = _names(parts)
    figure, axes = figure_of("Error", symbol)
    size = np.linalg.norm(log.error, axis=1)
    axes.semilogy(log.t, _positive(size), color=STYLES[0][0], label="flown")
    if parts.controller.prescribed:
        before = log.t[log.t < float(parts.controller.hand_over)]
        axes.plot(before, envelopes.error_bound(parts, before), **BOUND)
    if floor is not None and floor.window_error > 0.0:
        known = (floor.error > 0.0) & (floor.error < size.max())  # before the first samples nothing is
        axes.plot(floor.t[known], floor.error[known], color=STYLES[2][0], lw=1.2, label="floor: no controller beats it")
    t_f = float(parts.controller.t_f)
    axes.axvspan(t_f, t_f + float(parts.window), color="0.85", label="window of window_error")
    _above_smallest(axes)
    _mark(axes, parts)
    _legend(axes)
    return figure


def rate(parts: Parts, log: Log) -> Figure:
    """Body rate over time."""
    figure, axes = figure_of("Body rate", "rate [rad/s]")
    _components(axes, log.t, log.x.w, "w")
    _mark(axes, parts)
    _legend(axes)
    return figure


def torque(parts: Parts, log: Log, limit: float | None = None, title: str | None = None) -> Figure:
    """Delivered torque or input over time, its largest value marked, the limit drawn where one is given."""
    _, ylabel, unit = _names(parts)
    figure, axes = figure_of(title or ("Control torque" if unit else "Control"), ylabel)
    _components(axes, log.t, log.u, "u", drawstyle="steps-post" if parts.clock.sampled else "default")
    reach = FAR_OFF * np.nanmax(np.abs(log.u)) or np.inf  # what is asked for beyond it would make the curves flat
    if parts.controller.prescribed:
        t, u, _ = (np.asarray(v) for v in solutions.exact_path(parts))
        axes.plot(t, u, **EXACT)
        axes.plot([], [], **EXACT, label="exact, perfect estimate")
        if np.nanmax(np.abs(u)) > reach:
            axes.set_ylim(-reach, reach)
    row, column = np.unravel_index(np.argmax(np.nan_to_num(np.abs(log.commanded))), log.commanded.shape)
    peak = log.commanded[row, column]
    delivered = np.array_equal(log.u, log.commanded, equal_nan=True)  # else it lies off the curves
    of = "peak" if delivered else "peak of the command"
    label = f"{of} {abs(peak):.3g}{unit} at {log.t[row]:.4g} s"
    if abs(peak) > reach:
        axes.plot([], [], color="none", label=f"{label}, beyond this axis")
    else:
        axes.plot(log.t[row], peak, "o", mfc="none", color="black", label=label)
    if limit is not None:
        _limit(axes, limit, unit)
    _mark(axes, parts)
    _legend(axes)
    return figure


def wheels(parts: Parts, log: Log) -> Figure:
    """Momentum of the reaction wheels over time, and its limit."""
    return _of_wheels(parts, log, 0, "Reaction wheels", "momentum", "N m s")


def wheel_torque(parts: Parts, log: Log) -> Figure:
    """Torque of the reaction wheels over time, and its limit."""
    return _of_wheels(parts, log, 1, "Torque of the reaction wheels", "torque", "N m")


def _of_wheels(parts: Parts, log: Log, which: int, title: str, quantity: str, unit: str) -> Figure:
    """A quantity of each wheel over time, the first or second of `log.wheels`, with its limit, a field of `Wheels`."""
    assert log.wheels is not None
    figure, axes = figure_of(title, f"{quantity} [{unit}]")
    _components(axes, log.t, log.wheels[which], "hv"[which])
    limit = getattr(parts.actuators.wheels, f"{quantity}_limit", None)
    if limit is not None:
        _limit(axes, float(limit), f" {unit}")
    _mark(axes, parts)
    _legend(axes, ncols=2)
    return figure


def sliding(parts: Parts, log: Log) -> Figure:
    """Sliding variable on a log scale with its envelope before the hand-over (continuous loop, no noise)."""
    figure, axes = figure_of("Sliding variable", "|s|" + (" [-]" if _names(parts)[2] else ""))
    _components(axes, log.t, _positive(np.abs(log.s)), "s")
    if parts.controller.prescribed:
        before = log.t[log.t < float(parts.controller.hand_over)]
        axes.plot(before, envelopes.sliding_bound(parts, before), **BOUND)
    axes.set_yscale("log")
    _above_smallest(axes)
    _mark(axes, parts)
    _legend(axes)
    return figure


def convergence(parts: Parts, log: Log, title: str = "Convergence as theory sees it") -> Figure:
    """Error and s against the time to go, both on log axes, with the exact motion and the slopes of theory."""
    symbol, _, unit = _names(parts)
    law, n = parts.controller, parts.controller.order
    t_f, eta, delta = float(law.t_f), float(law.eta), float(law.delta)
    figure, axes = figure_of(title, f"{symbol} and |s|" if unit else "$|x_1|$ and |s|")
    before = log.t < float(law.hand_over) * (1 - 1e-12)
    t = np.asarray(log.t)[before]
    tau = t_f - t
    flown = {
        symbol.split(" [")[0]: (np.linalg.norm(log.error, axis=1)[before], eta, STYLES[0]),
        "|s|": (np.linalg.norm(log.s, axis=1)[before], eta + n - 2, STYLES[1]),
    }
    exact = solutions.exact_sizes(parts, t)
    bottom = min(np.min(size[size > 0], initial=1.0) for size, _, _ in flown.values())
    for (name, (size, _, (colour, style))), ideal in zip(flown.items(), exact, strict=True):
        axes.loglog(tau, size, color=colour, ls=style, label=f"{name}, flown")
        axes.loglog(tau, ideal, **EXACT)
    # slopes of theory as short lines over the error and, where it differs, under s
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
    axes.plot([], [], **EXACT, label="exact, perfect estimate")
    axes.set_xlabel("time to go $t_f - t$ [s]")
    axes.set_ylim(bottom=bottom / 3)
    plain_ticks(axes.xaxis)
    axes.invert_xaxis()
    axes.legend(loc="lower left")
    return figure


def disturbance(parts: Parts, log: Log) -> Figure:
    """Estimated and true disturbance over time; the true one lies on top, where a noisy estimate would cover it."""
    figure, axes = figure_of("Disturbance and its estimate", _names(parts)[1].replace("input", "disturbance"))
    _components(axes, log.t, log.d_hat, "\\hat d", alpha=0.7)
    axes.plot(log.t, log.disturbance, color="white", lw=2.6, zorder=4)
    axes.plot(log.t, log.disturbance, color="black", lw=1.2, ls=(0, (5, 2)), zorder=5)
    axes.plot([], [], color="black", lw=1.2, ls=(0, (5, 2)), label="true $d_i$")
    _mark(axes, parts)
    _legend(axes, ncols=2)
    return figure


@styled
def observers(measured: Sequence[Measured]) -> Figure:
    """What each observer makes of the disturbance, and the chattering it leaves under both signs (Remark 2)."""
    runs = {(run.observer, run.sign): run for run in measured}
    kinds = list(dict.fromkeys(run.observer for run in measured))
    figure = Figure(figsize=(10.0, 4.5), layout="constrained")
    left, right = figure.subplots(1, 2)
    for kind, (colour, style) in zip(kinds, STYLES, strict=False):
        run = runs[kind, "smooth"]
        left.semilogy(run.t, np.maximum(run.off, 1e-6), color=colour, ls=style, label=kind)
    left.set(xlabel=TIME, ylabel="estimation error $|\\hat d - d|$ [N m]", xlim=(0.0, 10.0), ylim=(1e-5, 1.0))
    left.legend(ncols=2)
    for k, sign in enumerate(dict.fromkeys(run.sign for run in measured)):
        heights = [runs[kind, sign].chattering for kind in kinds]
        colour, hatch = STYLES[k][0], ("", "//")[k % 2]
        at = np.arange(len(kinds)) + 0.38 * (k - 0.5)
        bars = right.bar(at, heights, 0.36, color=colour, hatch=hatch, ec="white", label=f"{sign} sign")
        right.bar_label(bars, fmt="%.0e", fontsize=8)
    right.set_yscale("log")
    right.set_axisbelow(True)
    right.set_xticks(range(len(kinds)), [kind.replace("_", "\n") for kind in kinds])
    right.set(ylabel="chattering after $t_f$ [N m/s]")
    right.set_ylim(top=8.0 * right.get_ylim()[1])
    right.legend(ncols=2)
    return figure


def _names(parts: Parts) -> tuple[str, str, str]:
    """Labels of the error and the input, and the input's unit behind a number."""
    if not parts.plant.attitude:
        return "$|x_1|$", "input u", ""
    return "|$\\varepsilon_1$| [-]" if parts.controller.kinematics.additive else "|v| [-]", "torque [N m]", " N m"


def _components(axes: Axes, t: ArrayLike, values: ArrayLike, symbol: str, **kwargs: Any) -> None:
    values = np.asarray(values)
    for k in range(values.shape[1]):  # beyond as many as there are styles, the same in thin lines, then both paler
        colour, style = STYLES[k % len(STYLES)]
        turn = k // len(STYLES)
        width = {"lw": 0.8} if turn % 2 else {}
        paler = {"alpha": 0.45 * kwargs.get("alpha", 1.0)} if turn >= 2 else {}
        label = f"${symbol}_{{{k + 1}}}$"
        axes.plot(np.asarray(t), values[:, k], color=colour, ls=style, label=label, **width, **{**kwargs, **paler})


def _positive(sizes: np.ndarray) -> np.ndarray:
    """Sizes as a log axis shows them: none where they are 0."""
    return np.where(sizes > 0.0, sizes, np.nan)


def _above_smallest(axes: Axes) -> None:
    """What is below `SMALLEST`, of whatever is drawn, leaves the axis."""
    low, high = axes.get_ylim()
    axes.set_ylim(bottom=SMALLEST if low < SMALLEST < high else low)


def _legend(axes: Axes, ncols: int = 1) -> None:
    """The legend where it covers least of the curves; at a corner where these have too many points to look for that."""
    points = sum(np.size(line.get_xdata()) for line in axes.lines)
    axes.legend(ncols=ncols, loc="best" if points < MANY_POINTS else "upper right")


def _limit(axes: Axes, limit: float, unit: str) -> None:
    """Lines at plus and minus a limit; where the curves would be flat beside it, its number alone."""
    largest = max((np.nanmax(np.abs(line.get_ydata()), initial=0.0) for line in axes.lines), default=0.0)
    if limit > FAR_OFF * largest > 0.0:
        axes.plot([], [], color="none", label=f"limit {limit:g}{unit}, beyond this axis")
        return
    for sign in (-1.0, 1.0):
        axes.axhline(sign * limit, **LIMIT)
    axes.plot([], [], **LIMIT, label=f"limit {limit:g}{unit}")


def _mark(axes: Axes, parts: Parts) -> None:
    """A line at the prescribed time."""
    t_f = float(parts.controller.t_f)
    axes.axvline(t_f, color="0.3", lw=0.9, ls=":")
    axes.annotate(
        f"$t_f$ = {t_f:g} s", (t_f, 1.0), xycoords=("data", "axes fraction"), xytext=(0, 3),
        textcoords="offset points", ha="center", va="bottom", fontsize=9, color="0.3",
    )  # fmt: skip
    axes.margins(x=0.01)
