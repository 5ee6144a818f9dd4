"""The common style of all figures, and their files."""

import math
from collections.abc import Callable, Container, Mapping, Sequence
from pathlib import Path
from types import MappingProxyType
from typing import Any, Literal

import matplotlib.style
import matplotlib.ticker
import numpy as np
from matplotlib.axes import Axes
from matplotlib.axis import Axis, XAxis
from matplotlib.figure import Figure
from numpy.typing import ArrayLike

from ptsmc_jax.formulas import ARCSEC
from ptsmc_jax.scenario.tables import LIMITS, T_F
from ptsmc_jax.simulation.catalogues import CATALOGUES, TORQUES, as_angle

# colours of Okabe and Ito, distinct for the colour-blind; line styles are distinct in grey
STYLES = (("#0072B2", "-"), ("#D55E00", "--"), ("#009E73", "-."), ("#000000", ":"), ("#CC79A7", (0, (5, 1, 1, 1))))
TIME = "time [s]"
# decorator of functions that draw in the style of ptsmc.mplstyle, which notebooks use too
styled = matplotlib.style.context("ptsmc_jax.figures.ptsmc")
LIMIT: Any = {"color": "0.3", "lw": 1.0, "ls": (0, (6, 3))}  # style of the line of a required limit
ACTUATOR_LIMIT: Any = {"color": "0.3", "lw": 1.0, "ls": (0, (6, 2, 1, 2))}  # style of the line of an actuator's limit
LOWER_BOUND: Any = {"color": "0.3", "lw": 1.0, "ls": ":"}  # style of the line of a lower bound
NO_LIMITS: Mapping[str, float] = MappingProxyType({})
LEGEND_WIDTH = 110  # largest width of a legend below the axes, in characters
WIDE_RATIO = 1e4  # ratio of an axis's ends above which numbers between powers of ten would overlap


def save(figures: Mapping[str, Figure], folder: Path) -> None:
    """Write NAME.png for each figure into a folder, with a mark for `store.remove_summary`."""
    folder.mkdir(parents=True, exist_ok=True)
    for name, figure in figures.items():
        figure.savefig(folder / f"{name}.png", metadata={"Creator": "ptsmc"})


@styled
def new_figure(title: str, ylabel: str) -> tuple[Figure, Axes]:
    """Return a figure with one plot; its horizontal axis is labelled as time."""
    figure = Figure(figsize=(8.0, 4.5), layout="constrained")
    axes = figure.subplots()
    axes.set(xlabel=TIME, ylabel=ylabel)
    axes.set_title(title, loc="left", pad=19)
    return figure, axes


def legend_below(figure: Figure, columns: int) -> None:
    """Add the legend of the first plot below the axes of a figure, and enlarge the figure for it.

    Long labels reduce the number of columns.
    """
    handles, labels = figure.axes[0].get_legend_handles_labels()
    while columns > 1 and _legend_width(labels, columns) > LEGEND_WIDTH:
        columns -= 1
    rows = -(-len(labels) // columns)
    width, height = figure.get_size_inches()
    figure.set_size_inches(width, height + 0.26 * rows)
    figure.legend(handles, labels, loc="outside lower left", ncols=columns, fontsize=9, frameon=False)


def _legend_width(labels: Sequence[str], columns: int) -> int:
    """Return the width of a legend with this number of columns in characters, its lines included."""
    return sum(8 + max(map(len, column), default=0) for column in np.array_split(labels, columns))


def with_unit(name: str, unit: str) -> str:
    """Return a label; the unit is empty if the plant has units of its own."""
    return f"{name} [{unit}]" if unit else name


class _DecadeLocator(matplotlib.ticker.LogLocator):
    """Ticks of a log axis at 1, 2 and 5 times powers of ten; at powers only if numbers would overlap or be too many."""

    def tick_values(self, vmin: float, vmax: float) -> Sequence[float]:
        """Return the ticks of an axis from vmin to vmax."""
        vmin, vmax = sorted((vmin, vmax))  # the axis may be inverted
        room = WIDE_RATIO if self.axis is None else 10.0 ** (self.axis.get_tick_space() / self._space(vmin, vmax))
        self.set_params(subs=(1.0,) if vmax > min(WIDE_RATIO, room) * vmin else (1.0, 2.0, 5.0))
        return super().tick_values(vmin, vmax)

    def _space(self, vmin: float, vmax: float) -> float:
        """Return the space of a power of ten with its three numbers, in units of Matplotlib's space of a tick."""
        if vmin <= 0.0 or not isinstance(self.axis, XAxis):
            return 3.0
        powers = range(math.floor(math.log10(vmin)), math.ceil(math.log10(vmax)) + 1)
        return max(3.0, 0.3 + 0.7 * max(len(f"{10.0**power:g}") for power in powers))


def error_display(plant: str) -> tuple[Callable[[ArrayLike], np.ndarray], str, str]:
    """Return how figures show the error of a kind of plant: a function of its norm, its name and the unit."""
    convert, unit = metric_display("window_error", plant)
    return convert, "pointing error" if plant == "spacecraft" else "error", unit


def metric_display(metric: str, plant: str) -> tuple[Callable[[ArrayLike], np.ndarray], str]:
    """Return how figures show a metric of a kind of plant: a function of its values, and the unit."""
    stated_unit = CATALOGUES[plant][metric].unit
    unit, _ = as_angle(metric, stated_unit, 0.0)
    if unit == "rad":
        return lambda values: ARCSEC * np.asarray(as_angle(metric, stated_unit, values)[1]), "arcsec"
    return np.asarray, unit


def torque_metric(limits: Container[str]) -> str:
    """Return the torque metric that figures of many trials show: the first required one, or the commanded torque."""
    return next((name for name in TORQUES if name in limits), "peak_torque")


def objective_display(name: str, minimised: str, plant: str) -> tuple[Callable[[ArrayLike], np.ndarray], str]:
    """Return how figures show the objective of a search: a function of its value, and its label with the unit.

    Args:
        name: the objective in words, see `tables.objective_name`.
        minimised: the minimised metric, or `T_F` or `LIMITS` of `scenario.tables`.
        plant: kind of the plant.
    """
    if minimised in (T_F, LIMITS):
        return np.asarray, with_unit(name, "s" if minimised == T_F else "-")
    convert, unit = metric_display(minimised, plant)
    if minimised == "window_error":
        name = name.replace("window error", error_display(plant)[1])
    return convert, with_unit(name, unit)


def plain_ticks(line: Axis) -> None:
    """Use numbers such as 0.05 on a log axis."""
    line.set_major_locator(_DecadeLocator())
    line.set_major_formatter(matplotlib.ticker.FormatStrFormatter("%g"))
    line.set_minor_formatter(matplotlib.ticker.NullFormatter())


def logarithmic(axes: Axes, which: Literal["x", "y"]) -> None:
    """Set one of the axes to a log scale with plain numbers."""
    axes.set(**{f"{which}scale": "log"})
    plain_ticks(getattr(axes, f"{which}axis"))
