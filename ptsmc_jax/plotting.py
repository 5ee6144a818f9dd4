"""Histories and tuning runs as matplotlib figures, axes labelled with units; each function returns a Figure."""

from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

import matplotlib
import matplotlib.colors
import matplotlib.lines
import matplotlib.ticker
import numpy as np
from matplotlib.axes import Axes
from matplotlib.figure import Figure
from numpy.typing import ArrayLike

from ptsmc_jax import theory
from ptsmc_jax.controllers import PrescribedTime
from ptsmc_jax.metrics import CATALOGUES
from ptsmc_jax.plants import Spacecraft
from ptsmc_jax.remark_2 import Measured
from ptsmc_jax.rollout import Log, Parts

# Okabe and Ito's colours, told apart by the colour-blind; line styles tell them apart in grey
_STYLES = (("#0072B2", "-"), ("#D55E00", "--"), ("#009E73", "-."), ("#000000", ":"))
_TIME = "time [s]"
_RC: Any = {
    "font.size": 11,
    "axes.grid": True,
    "grid.alpha": 0.3,
    "axes.spines.top": False,
    "axes.spines.right": False,
    "lines.linewidth": 1.6,
    "legend.frameon": False,
    "savefig.dpi": 130,
}


def run_figures(parts: Parts, log: Log, limit: float | None = None) -> dict[str, Figure]:
    """Figures of one run by name; log with numpy arrays (time, component); limit: largest torque allowed [N m]."""
    figures = {
        "error": error(parts, log),
        "sliding": sliding(parts, log),
        "convergence": convergence(parts, log),
        "torque": torque(parts, log, limit),
    }
    if np.any(log.d_hat):
        figures["disturbance"] = disturbance(parts, log)
    if isinstance(parts.plant, Spacecraft):
        return {"attitude": attitude(parts, log), "rate": rate(parts, log), **figures}
    return {"states": states(parts, log), **figures}


def save(figures: Mapping[str, Figure], folder: Path) -> list[Path]:
    """Write NAME.png for each figure into a folder."""
    folder.mkdir(parents=True, exist_ok=True)
    for name, figure in figures.items():
        figure.savefig(folder / f"{name}.png")
    return [folder / f"{name}.png" for name in figures]


def attitude(parts: Parts, log: Log, title: str = "Attitude") -> Figure:
    """Quaternion and its reference over time."""
    figure, axes = _figure(title, "quaternion component [-]")
    _components(axes, log.t, log.x.q, "q")
    axes.plot(log.t, log.reference.q, color="0.6", lw=1.0, zorder=1)
    axes.plot([], [], color="0.6", lw=1.0, label="reference")
    _mark(axes, parts)
    axes.legend(ncols=3, loc="best")
    return figure


def states(parts: Parts, log: Log, title: str = "States") -> Figure:
    """States of a chain or a system over time."""
    figure, axes = _figure(title, "state")
    _components(axes, log.t, log.x, "x")
    _mark(axes, parts)
    axes.legend(ncols=2)
    return figure


def error(parts: Parts, log: Log) -> Figure:
    """2-norm of the error on a log scale with its bound, and the window in which it is judged."""
    symbol, _, _ = _names(parts)
    figure, axes = _figure("Error", symbol)
    size = np.linalg.norm(log.error, axis=1)
    axes.semilogy(log.t, np.maximum(size, 1e-16), color=_STYLES[0][0], label="flown")
    before = log.t[log.t < float(parts.controller.hand_over)]
    axes.plot(before, theory.error_bound(parts, before), color="0.35", lw=1.0, ls="--", label="bound, no noise")
    t_f = float(parts.controller.t_f)
    axes.axvspan(t_f, t_f + float(parts.window), color="0.85", label="window of window_error")
    _mark(axes, parts)
    axes.legend()
    return figure


def rate(parts: Parts, log: Log) -> Figure:
    """Body rate over time."""
    figure, axes = _figure("Body rate", "rate [rad/s]")
    _components(axes, log.t, log.x.w, "w")
    _mark(axes, parts)
    axes.legend()
    return figure


def torque(parts: Parts, log: Log, limit: float | None = None, title: str | None = None) -> Figure:
    """Delivered torque or input over time, its largest value marked, the limit drawn where one is given."""
    _, label, unit = _names(parts)
    figure, axes = _figure(title or ("Control torque" if unit else "Control"), label)
    held = not hasattr(parts.clock, "max_step")
    _components(axes, log.t, log.u, "u", drawstyle="steps-post" if held else "default")
    t, u, _ = (np.asarray(v) for v in theory.exact_path(parts))
    axes.plot(t, u, color="0.25", lw=0.9, ls=(0, (1, 1.5)))
    axes.plot([], [], color="0.25", lw=0.9, ls=(0, (1, 1.5)), label="exact, perfect estimate")
    row, column = np.unravel_index(np.argmax(np.abs(log.commanded)), log.commanded.shape)
    peak = log.commanded[row, column]
    marked = f"peak {abs(peak):.3g}{unit} at {log.t[row]:.4g} s"
    axes.plot(log.t[row], peak, "o", mfc="none", color="black", label=marked)
    if limit is not None:
        for sign in (-1.0, 1.0):
            axes.axhline(sign * limit, color="0.3", lw=1.0, ls=(0, (6, 3)))
        axes.plot([], [], color="0.3", lw=1.0, ls=(0, (6, 3)), label=f"limit {limit:g}{unit}")
    _mark(axes, parts)
    axes.legend()
    return figure


def sliding(parts: Parts, log: Log) -> Figure:
    """Sliding variable on a log scale with its envelope before the hand-over (continuous loop, no noise)."""
    figure, axes = _figure("Sliding variable", "|s|" + (" [-]" if _names(parts)[2] else ""))
    _components(axes, log.t, np.maximum(np.abs(log.s), 1e-16), "s")
    before = log.t[log.t < float(parts.controller.hand_over)]
    axes.plot(before, theory.sliding_bound(parts, before), color="0.35", lw=1.0, ls="--", label="bound, no noise")
    axes.set_yscale("log")
    _mark(axes, parts)
    axes.legend()
    return figure


def convergence(parts: Parts, log: Log, title: str = "Convergence as theory sees it") -> Figure:
    """Error and s against the time to go, both on log axes, with the exact motion and the slopes of theory."""
    symbol, _, unit = _names(parts)
    law, n = parts.controller, parts.controller.order
    t_f, eta, delta = float(law.t_f), float(law.eta), float(law.delta)
    figure, axes = _figure(title, f"{symbol} and |s|" if unit else "$|x_1|$ and |s|")
    before = log.t < float(law.hand_over) * (1 - 1e-12)
    t = np.asarray(log.t)[before]
    tau = t_f - t
    flown = {
        symbol.split(" [")[0]: (np.linalg.norm(log.error, axis=1)[before], eta, _STYLES[0]),
        "|s|": (np.linalg.norm(log.s, axis=1)[before], eta + n - 2, _STYLES[1]),
    }
    exact = theory.exact_sizes(parts, t)
    bottom = min(np.min(size[size > 0], initial=1.0) for size, _, _ in flown.values())
    for (name, (size, _, (colour, style))), ideal in zip(flown.items(), exact, strict=True):
        axes.loglog(tau, size, color=colour, ls=style, label=f"{name}, flown")
        axes.loglog(tau, ideal, color="0.25", lw=0.9, ls=(0, (1, 1.5)))
    # slopes of theory as short lines over the error and, where it differs, under s
    span = t_f * np.array([0.3, max(0.03, delta / t_f)])
    above = 6.0 * float(np.interp(-span[0], -tau, np.maximum(*exact)))
    guides = [(above, eta, "$\\eta$", 6)]
    if n > 2:
        guides.append((float(np.interp(-span[0], -tau, np.minimum(*exact))) / 30.0, eta + n - 2, "$\\eta+n-2$", -14))
    for start, slope, name, shift in guides:
        line = start * (span / span[0]) ** slope
        axes.loglog(span, line, color="black", lw=1.0)
        axes.annotate(f"slope {name} = {slope:g}", (np.sqrt(span[0] * span[1]), np.sqrt(line[0] * line[1])),
                      fontsize=10, xytext=(6, shift), textcoords="offset points",
                      ha="left" if shift > 0 else "right")  # fmt: skip
    axes.plot([], [], color="0.25", lw=0.9, ls=(0, (1, 1.5)), label="exact, perfect estimate")
    axes.set_xlabel("time to go $t_f - t$ [s]")
    axes.set_ylim(bottom=bottom / 3)
    axes.invert_xaxis()
    axes.legend(loc="lower left")
    return figure


def disturbance(parts: Parts, log: Log) -> Figure:
    """Estimated and true disturbance over time."""
    figure, axes = _figure("Disturbance and its estimate", _names(parts)[1].replace("input", "disturbance"))
    _components(axes, log.t, log.d_hat, "\\hat d")
    axes.plot(log.t, log.disturbance, color="0.6", lw=1.0, zorder=1)
    axes.plot([], [], color="0.6", lw=1.0, label="true $d_i$")
    _mark(axes, parts)
    axes.legend(ncols=2)
    return figure


def observers(found: Sequence[Measured]) -> Figure:
    """What each observer makes of the disturbance, and the chattering it leaves under both signs (Remark 2)."""
    kinds = list(dict.fromkeys(one.observer for one in found))
    with matplotlib.rc_context(_RC):
        figure = Figure(figsize=(10.0, 4.5), layout="constrained")
        left, right = figure.subplots(1, 2)
        for kind, (colour, style) in zip(kinds, _STYLES, strict=False):
            one = next(one for one in found if one.observer == kind and one.sign == "smooth")
            left.semilogy(one.t, np.maximum(one.off, 1e-6), color=colour, ls=style, label=kind)
        left.set(xlabel=_TIME, ylabel="estimation error $|\\hat d - d|$ [N m]", xlim=(0.0, 10.0), ylim=(1e-5, 1.0))
        left.legend(ncols=2)
        signs = list(dict.fromkeys(one.sign for one in found))
        for k, sign in enumerate(signs):
            heights = [next(o.chattering for o in found if (o.observer, o.sign) == (kind, sign)) for kind in kinds]
            colour, hatch = _STYLES[k][0], ("", "//")[k % 2]
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
    if not isinstance(parts.plant, Spacecraft):
        return "$|x_1|$", "input u", ""
    additive = isinstance(parts.controller, PrescribedTime)
    return "|$\\varepsilon_1$| [-]" if additive else "|v| [-]", "torque [N m]", " N m"


def tuning_history(
    names: Sequence[str],
    units: Sequence[str],
    gains: np.ndarray,
    rms: np.ndarray,
    admissible: np.ndarray,
    objective: str = "RMS",
) -> Figure:
    """Search of all starts: window error and gains over the steps.

    gains (steps, starts, gains), rms (steps, starts), admissible (steps, starts) bool: every requirement met.
    """
    with matplotlib.rc_context(_RC):
        figure = Figure(figsize=(8.0, 2.2 * (len(names) + 1)), layout="constrained")
        axes = figure.subplots(len(names) + 1, 1, sharex=True)
        steps = np.arange(len(rms))
        for start in range(rms.shape[1]):
            axes[0].semilogy(steps, rms[:, start], color="0.75", lw=1.0)
            met = np.where(admissible[:, start], rms[:, start], np.nan)
            axes[0].semilogy(steps, met, color=_STYLES[0][0])
        axes[0].plot([], [], color=_STYLES[0][0], label="requirements met")
        axes[0].plot([], [], color="0.75", label="beyond a limit")
        axes[0].set(ylabel=f"{objective} window\nerror [-]", title="Tuning, all starts")
        axes[0].legend(ncols=2)
        for k, (name, unit) in enumerate(zip(names, units, strict=True)):
            for start in range(rms.shape[1]):
                axes[k + 1].plot(steps, gains[:, start, k], color=_STYLES[1][0], lw=1.0)
            axes[k + 1].set_ylabel(f"{name}\n[{unit}]")
            if np.nanmax(gains[..., k]) > 10 * np.nanmin(gains[..., k]):
                axes[k + 1].set_yscale("log")
        axes[-1].set_xlabel("step")
    return figure


def tradeoff(
    sets: Mapping[str, tuple[ArrayLike, ArrayLike]], limit: float | None = None, kind: str = "spacecraft"
) -> Figure:
    """Accuracy against torque, a point a trial, in the units of this kind of plant.

    sets: label -> (window errors (trials,) [-], peak torques (trials,) [N m]).
    """
    error_unit, unit = (CATALOGUES[kind][name][0] for name in ("window_error", "peak_torque"))
    figure, axes = _figure("Accuracy against torque, fresh trials", f"peak torque [{unit}]")
    markers = ("o", "^", "s", "D")
    arrays = {label: (np.asarray(e), np.asarray(u)) for label, (e, u) in sets.items()}
    for (label, (errors, torques)), (colour, _), marker in zip(arrays.items(), _STYLES, markers, strict=False):
        rms, mean = np.sqrt(np.nanmean(errors**2)), np.nanmean(torques)
        axes.loglog(errors, torques, marker, ms=2.5, alpha=0.35, color=colour, mew=0)
        text = f"{label}: RMS {rms:.2e}, mean peak {mean:.3g} {unit}"
        axes.loglog(rms, mean, marker, ms=9, color=colour, mec="white", label=text)
    if limit is not None:
        axes.axhline(limit, color="0.3", lw=1.0, ls=(0, (6, 3)), label=f"limit {limit:g} {unit}")
    axes.set_xlabel(f"window error [{error_unit}]")
    axes.legend(loc="upper left", bbox_to_anchor=(0.0, -0.19))
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
    with matplotlib.rc_context(_RC):
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
                _plain_ticks(axes.xaxis)
            if y[2]:
                axes.set_yscale("log")
                _plain_ticks(axes.yaxis)
            shown = np.ma.masked_invalid(grids[name])
            mesh = axes.pcolormesh(_edges(*x[1:]), _edges(*y[1:]), shown, norm=norm, cmap="cividis")
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


def _edges(values: Sequence[float], logarithmic: bool) -> np.ndarray:
    """Borders of the cells around these values, half way to the next one on the axis as it is drawn."""
    middle = np.log(values) if logarithmic else np.asarray(values)
    between = (middle[:-1] + middle[1:]) / 2
    edges = np.concatenate([[2 * middle[0] - between[0]], between, [2 * middle[-1] - between[-1]]])
    return np.exp(edges) if logarithmic else edges


def _plain_ticks(line: Any) -> None:
    """Numbers such as 0.05 on a log axis."""
    line.set_major_locator(matplotlib.ticker.LogLocator(subs=(1.0, 2.0, 5.0)))
    line.set_major_formatter(matplotlib.ticker.FormatStrFormatter("%g"))
    line.set_minor_formatter(matplotlib.ticker.NullFormatter())


def _figure(title: str, ylabel: str) -> tuple[Figure, Axes]:
    with matplotlib.rc_context(_RC):
        figure = Figure(figsize=(8.0, 4.5), layout="constrained")
        axes = figure.subplots()
        axes.set(xlabel=_TIME, ylabel=ylabel)
        axes.set_title(title, loc="left", pad=19)
    return figure, axes


def _components(axes: Axes, t: ArrayLike, values: ArrayLike, symbol: str, **kwargs: Any) -> None:
    values = np.asarray(values)
    for k in range(values.shape[1]):  # beyond as many as there are styles, the same in thin lines
        colour, style = _STYLES[k % len(_STYLES)]
        width = {"lw": 0.8} if k >= len(_STYLES) else {}
        label = f"${symbol}_{{{k + 1}}}$"
        axes.plot(np.asarray(t), values[:, k], color=colour, ls=style, label=label, **width, **kwargs)


def _mark(axes: Axes, parts: Parts) -> None:
    """A line at the prescribed time."""
    t_f = float(parts.controller.t_f)
    axes.axvline(t_f, color="0.3", lw=0.9, ls=":")
    axes.annotate(
        f"$t_f$ = {t_f:g} s", (t_f, 1.0), xycoords=("data", "axes fraction"), xytext=(0, 3),
        textcoords="offset points", ha="center", va="bottom", fontsize=9, color="0.3",
    )  # fmt: skip
    axes.margins(x=0.01)
