"""The common look of all figures, and how they are written."""

import math
from collections.abc import Mapping
from pathlib import Path
from typing import Any, Literal

import matplotlib
import matplotlib.ticker
from matplotlib.axes import Axes
from matplotlib.axis import Axis, XAxis
from matplotlib.figure import Figure

# Okabe and Ito's colours, told apart by the colour-blind; line styles tell them apart in grey
STYLES = (("#0072B2", "-"), ("#D55E00", "--"), ("#009E73", "-."), ("#000000", ":"), ("#CC79A7", (0, (5, 1, 1, 1))))
TIME = "time [s]"
RC: Any = {
    "font.size": 11,
    "axes.grid": True,
    "grid.alpha": 0.3,
    "axes.spines.top": False,
    "axes.spines.right": False,
    "lines.linewidth": 1.6,
    "legend.frameon": False,
}
styled = matplotlib.rc_context(RC)  # decorates functions that draw in this look
LIMIT: Any = {"color": "0.3", "lw": 1.0, "ls": (0, (6, 3))}  # how the line of a limit is drawn, and of the floor
FLOOR: Any = {"color": "0.3", "lw": 1.0, "ls": ":"}
MANY = 1e4  # times, that an axis spans, from which on the numbers between its powers of ten would overlap


def save(figures: Mapping[str, Figure], folder: Path) -> list[Path]:
    """Write NAME.png for each figure into a folder, known as ours, see `store.forget`."""
    folder.mkdir(parents=True, exist_ok=True)
    for name, figure in figures.items():
        figure.savefig(folder / f"{name}.png", metadata={"Creator": "ptsmc"})
    return [folder / f"{name}.png" for name in figures]


@styled
def figure_of(title: str, ylabel: str) -> tuple[Figure, Axes]:
    """A figure of one plot over time."""
    figure = Figure(figsize=(8.0, 4.5), layout="constrained")
    axes = figure.subplots()
    axes.set(xlabel=TIME, ylabel=ylabel)
    axes.set_title(title, loc="left", pad=19)
    return figure, axes


class _Decades(matplotlib.ticker.LogLocator):
    """1, 2 and 5 times each power of ten; the powers alone where there are more than four, or too little room."""

    def tick_values(self, vmin: float, vmax: float) -> Any:
        vmin, vmax = sorted((vmin, vmax))  # of an axis that runs the other way, too
        room = MANY if self.axis is None else 10.0 ** (self.axis.get_tick_space() / self._space(vmin, vmax))
        self.set_params(subs=(1.0,) if vmax > min(MANY, room) * vmin else (1.0, 2.0, 5.0))
        return super().tick_values(vmin, vmax)

    def _space(self, vmin: float, vmax: float) -> float:
        """Of a power of ten with its three numbers, in what Matplotlib counts as a tick's: the longer, the more."""
        if vmin <= 0.0 or not isinstance(self.axis, XAxis):
            return 3.0
        powers = range(math.floor(math.log10(vmin)), math.ceil(math.log10(vmax)) + 1)
        return max(3.0, 0.3 + 0.7 * max(len(f"{10.0**power:g}") for power in powers))


def plain_ticks(line: Axis) -> None:
    """Numbers such as 0.05 on a log axis."""
    line.set_major_locator(_Decades())
    line.set_major_formatter(matplotlib.ticker.FormatStrFormatter("%g"))
    line.set_minor_formatter(matplotlib.ticker.NullFormatter())


def logarithmic(axes: Axes, which: Literal["x", "y"]) -> None:
    """One of the axes on a log scale, with plain numbers."""
    axes.set(**{f"{which}scale": "log"})
    plain_ticks(getattr(axes, f"{which}axis"))
