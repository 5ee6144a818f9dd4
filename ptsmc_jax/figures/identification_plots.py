"""Figures of an identification: measured and predicted signals, innovations, their autocorrelation, estimates."""

from collections.abc import Sequence
from typing import TYPE_CHECKING, Any

import numpy as np
from matplotlib.figure import Figure
from scipy.spatial.transform import Rotation

from ptsmc_jax.figures import style
from ptsmc_jax.formulas import ARCSEC
from ptsmc_jax.identification import parameters, results
from ptsmc_jax.identification.estimation import Fit, Identification

if TYPE_CHECKING:
    from polars import DataFrame

Panel = tuple[str, np.ndarray, np.ndarray, np.ndarray]  # label, measured, predicted and rejected, see `signals`
REJECTED: Any = {"marker": "x", "ms": 4, "color": "0.3", "mew": 0.8, "ls": ""}  # style of rejected readings
POINTS = 4000  # largest number of points of a line
UNITS = {"attitude": ("arcsec", ARCSEC), "rate": ("rad/s", 1.0)}  # drawn units of innovations, and their factors


def identification_figures(identification: Identification) -> dict[str, Figure]:
    """Return the figures by name; those of the second log and of later ones have its number."""
    figures: dict[str, Figure] = {"estimates": estimates(identification.table())}
    for k, fit in enumerate([*identification.fits, *identification.validation]):
        suffix = "" if k == 0 else f"_{k + 1}"
        names, t = results.component_names(fit), fit.log.t[1:]
        values, sigma = results.innovations(fit)
        units, factors = zip(*(UNITS.get(name.split("_")[0], ("", 1.0)) for name in names), strict=True)
        labels = [style.with_unit(name, unit) for name, unit in zip(names, units, strict=True)]
        figures[f"innovations{suffix}"] = innovations(t, labels, values * factors, sigma * factors)
        limits = fit.autocorrelation_limits
        figures[f"autocorrelation{suffix}"] = autocorrelation(names, fit.autocorrelation(), limits)
        figures[f"prediction{suffix}"] = signals(t, _predictions(fit, values))
    return figures


def _predictions(fit: Fit, values: np.ndarray) -> list[Panel]:
    """Return the panel of each signal; the attitude is the rotation from the first row."""
    panels, first_column = [], 0
    is_rejected = (fit.rows.valid[1:] & ~fit.innovations.accepted)[fit.rows.log_row[1:] >= 0]
    for name, readings in fit.log.readings.items():
        measured = readings[1:]
        size = 3 if name == "attitude" else readings.shape[1]
        columns = slice(first_column, first_column + size)
        errors, rejected = values[:, columns], is_rejected[:, columns]
        first_column += size
        if name == "attitude":
            has_reading = ~np.isnan(measured[:, 0])
            angles, predicted = np.full((len(measured), 3), np.nan), np.full((len(measured), 3), np.nan)
            first_attitude, attitudes = Rotation.from_quat(readings[0]), Rotation.from_quat(measured[has_reading])
            angles[has_reading] = np.rad2deg((first_attitude.inv() * attitudes).as_rotvec())
            predicted_attitudes = attitudes * Rotation.from_rotvec(-np.nan_to_num(errors[has_reading]))
            predicted[has_reading] = np.rad2deg((first_attitude.inv() * predicted_attitudes).as_rotvec())
            panels.append(("rotation [deg]", angles, np.where(np.isnan(errors), np.nan, predicted), rejected))
        else:
            label = "rate [rad/s]" if name == "rate" else "state"
            panels.append((label, measured, measured - errors, rejected))
    return panels


def _panels(labels: Sequence[str], title: str, xlabel: str = style.TIME) -> tuple[Figure, np.ndarray]:
    """Return a figure with a plot for each label, and the plots."""
    figure = Figure(figsize=(8.0, 1.0 + 1.5 * len(labels)), layout="constrained")
    axes = np.ravel(figure.subplots(len(labels), 1, sharex=True))
    for panel, label in zip(axes, labels, strict=True):
        panel.set_ylabel(label)
    axes[0].set_title(title, loc="left")
    axes[-1].set_xlabel(xlabel)
    return figure, axes


def _select_rows(count: int) -> np.ndarray:
    """Return the rows of a log that are drawn, at most `POINTS`."""
    return np.unique(np.linspace(0, count - 1, min(POINTS, count)).round().astype(int))


@style.styled
def signals(t: np.ndarray, panels: list[Panel]) -> Figure:
    """Draw measured and predicted signals over time; crosses at the edge are rejected readings beyond it.

    Args:
        t: times (rows,) [s].
        panels: of each signal the label, the measured and the predicted values (rows, components), and whether the
            filter rejected each value as an outlier.
    """
    figure, axes = _panels([label for label, *_ in panels], "Measured (dots) and predicted (lines)")
    drawn = _select_rows(len(t))
    for panel, (_, measured, predicted, rejected) in zip(axes, panels, strict=True):
        for k in range(measured.shape[1]):
            colour, _ = style.STYLES[k % len(style.STYLES)]
            accepted = np.where(rejected[:, k], np.nan, measured[:, k])
            panel.plot(t[drawn], accepted[drawn], ".", ms=2, color=colour, alpha=0.4)
            panel.plot(t[drawn], predicted[drawn, k], "-", lw=0.9, color=colour, label=f"component {k + 1}")
        low, high = panel.get_ylim()
        row, column = np.nonzero(rejected)
        if row.size:
            panel.plot(t[row], np.clip(measured[row, column], low, high), clip_on=False, **REJECTED)
            panel.set_ylim(low, high)
    if any(np.any(rejected) for *_, rejected in panels):
        axes[0].plot([], [], **REJECTED, label="rejected")
    style.legend_below(figure, columns=6)
    return figure


@style.styled
def innovations(t: np.ndarray, names: list[str], values: np.ndarray, sigma: np.ndarray) -> Figure:
    """Draw the innovations of each component with their 3 sigma bands.

    Args:
        t: times (rows,) [s].
        names: names of the components, with units.
        values: innovations (rows, components), NaN without a reading.
        sigma: 1 sigma of the innovations (rows, components).
    """
    figure, axes = _panels(names, "Innovations and their 3 sigma bands")
    selected = _select_rows(len(t))
    for k, panel in enumerate(axes):
        band = np.where(np.isfinite(values[:, k]), 3.0 * sigma[:, k], np.nan)
        drawn = selected[np.isfinite(band[selected])]
        panel.fill_between(t[drawn], -band[drawn], band[drawn], color="0.9")
        panel.plot(t[drawn], values[drawn, k], ".", ms=2, color=style.STYLES[0][0])
        if drawn.size:  # quantiles set the height: the first bands are wide, as the state is hardly known at the start
            half_height = 1.5 * max(np.nanquantile(band, 0.9), np.nanquantile(np.abs(values[:, k]), 0.99))
            panel.set_ylim(-half_height, half_height)
    return figure


@style.styled
def autocorrelation(names: list[str], values: np.ndarray, limits: np.ndarray) -> Figure:
    """Draw the autocorrelation of the whitened innovations with the band inside which they count as white.

    Args:
        names: names of the components.
        values: (lags, components) [-].
        limits: largest autocorrelation of each component that counts as white, (components,) [-].
    """
    labels = [f"{name} [-]" for name in names]
    title = "Autocorrelation of the innovations; white innovations are inside the band"
    figure, axes = _panels(labels, title, "lag [readings]")
    lags = np.arange(1, len(values) + 1)
    for k, panel in enumerate(axes):
        panel.axhspan(-limits[k], limits[k], color="0.9")
        panel.vlines(lags, 0.0, values[:, k], color=style.STYLES[0][0])
    return figure


@style.styled
def estimates(table: "DataFrame") -> Figure:
    """Draw the change of each number, relative to the largest number of its parameter, with its 95 % interval.

    The prior interval is drawn beside it in grey. A phase is uniform over the circle in the prior knowledge. `table` is
    the result of `Identification.table`.
    """
    rows = list(table.iter_rows(named=True))
    figure = Figure(figsize=(8.0, 1.2 + 0.4 * len(rows)), layout="constrained")
    axes = figure.subplots()
    for k, row in enumerate(rows):
        same_parameter = [
            other
            for other in rows
            if other["parameter"].rstrip("0123456789ab") == row["parameter"].rstrip("0123456789ab")
        ]
        size = max(max(abs(other["start"]), abs(other["estimate"])) for other in same_parameter) or 1.0
        change, half_width = 100.0 * (row["estimate"] - row["start"]) / size, 196.0 * row["std"] / size
        if np.isfinite(row["prior_std"]):
            is_phase = row["parameter"].startswith(parameters.PHASE)
            prior_half_width = 100.0 * (np.pi if is_phase else 1.96 * row["prior_std"]) / size
            axes.errorbar(0.0, k + 0.2, xerr=prior_half_width, color="0.6", capsize=3, fmt="o", ms=3)
        axes.errorbar(change, k, xerr=half_width, color=style.STYLES[0][0], capsize=3, fmt="o", ms=4)
    axes.set_yticks(range(len(rows)), [row["parameter"] for row in rows])
    axes.invert_yaxis()
    axes.set_title("Estimates with 95 % intervals; grey: prior knowledge", loc="left")
    axes.set_xlabel("change [% of the largest number of the parameter]")
    return figure


@style.styled
def profile(t: np.ndarray, panels: list[tuple[str, np.ndarray]]) -> Figure:
    """Draw a proposed manoeuvre over time; panels: label and values (rows, components) of each signal, t: in s."""
    figure, axes = _panels([label for label, _ in panels], "Proposed manoeuvre")
    for panel, (_, values) in zip(axes, panels, strict=True):
        for k, column in enumerate(values.T):
            colour, line = style.STYLES[k % len(style.STYLES)]
            panel.plot(t, column, color=colour, ls=line, label=f"component {k + 1}")
    style.legend_below(figure, columns=6)
    return figure
