"""Draw the diagrams of the documentation: `python docs/diagrams.py` writes docs/images/*.png.

The numbers of `natural_frequency` and `timeline` come from the packaged scenario of the first flight.
"""

from collections.abc import Sequence
from pathlib import Path

from ptsmc_jax.configure import configure

configure()

import numpy as np  # noqa: E402
from matplotlib.axes import Axes  # noqa: E402
from matplotlib.figure import Figure  # noqa: E402
from matplotlib.patches import FancyBboxPatch  # noqa: E402

import ptsmc_jax as ptsmc  # noqa: E402
from ptsmc_jax.figures import style  # noqa: E402

ROOT = Path(__file__).parent.parent
FOLDER = ROOT / "docs" / "images"
SOFTWARE, TRUE = "#cfe3f3", "#f7dfc9"  # colours of flight software and of the simulated hardware
BOX = (1.7, 0.95)  # width and height of a block


def block(axes: Axes, at: tuple[float, float], text: str, color: str, width: float = BOX[0]) -> None:
    """Draw a block with its centre at a point."""
    x, y = at
    patch = FancyBboxPatch(
        (x - width / 2, y - BOX[1] / 2), width, BOX[1], boxstyle="round,pad=0.02,rounding_size=0.08", fc=color, ec="0.3"
    )
    axes.add_patch(patch)
    axes.text(x, y, text, ha="center", va="center", fontsize=9)


def arrow(axes: Axes, points: Sequence[tuple[float, float]], text: str = "", at: tuple[float, float] = (0, 0)) -> None:
    """Draw a line through points with an arrow at its end, and a text at a point."""
    x, y = zip(*points, strict=True)
    axes.plot(x[:-1], y[:-1], color="0.3", lw=1.2)
    axes.annotate("", points[-1], points[-2], arrowprops={"arrowstyle": "-|>", "color": "0.3", "lw": 1.2})
    if text:
        axes.text(*at, text, ha="center", va="center", fontsize=8.5, bbox={"fc": "white", "ec": "none", "pad": 1})


@style.styled
def loop() -> Figure:
    """Return the block diagram of the sampled loop."""
    figure = Figure(figsize=(9.6, 4.3), layout="constrained")
    axes = figure.subplots()
    axes.set(xlim=(-0.2, 13.0), ylim=(-0.75, 5.0), aspect="equal")
    axes.axis("off")
    top, middle, low = 3.9, 2.1, 0.3
    block(axes, (0.9, top), "reference", SOFTWARE)
    block(axes, (3.2, top), "control law", SOFTWARE)
    block(axes, (5.5, top), "command\nfilter", SOFTWARE)
    block(axes, (7.8, top), "torque limit,\ndelay,\nallocation", TRUE)
    block(axes, (10.1, top), "actuators,\nwheels", TRUE)
    block(axes, (11.9, middle), "true plant,\nflexible modes", TRUE, 2.0)
    block(axes, (9.1, low), "star tracker,\ngyro", TRUE)
    block(axes, (5.5, low), "attitude filter", SOFTWARE)
    block(axes, (3.2, middle), "disturbance\nobserver", SOFTWARE)
    half = BOX[0] / 2
    for left in (0.9, 3.2, 5.5, 7.8):
        arrow(axes, [(left + half, top), (left + 2.3 - half, top)])
    arrow(axes, [(10.1 + half, top), (11.9, top), (11.9, middle + 0.48)], "torque", (11.6, top + 0.25))
    axes.text(12.95, top - 0.55, "disturbance", ha="right", va="center", fontsize=8.5)
    arrow(axes, [(12.5, top - 0.75), (12.5, middle + 0.48)])
    arrow(axes, [(11.9, middle - 0.48), (11.9, low), (9.1 + half, low)], "attitude, rate", (11.0, low + 0.25))
    arrow(axes, [(9.1 - half, low), (5.5 + half, low)], "samples with noise", (7.3, low + 0.25))
    arrow(axes, [(5.5 - half, low), (1.5, low), (1.5, top - 0.75), (2.6, top - 0.75), (2.6, top - 0.48)])
    axes.text(1.45, 1.2, "estimated\nstate", ha="right", va="center", fontsize=8.5)
    arrow(axes, [(3.2, low), (3.2, middle - 0.48)])
    arrow(axes, [(3.2, middle + 0.48), (3.2, top - 0.48)], r"$\hat d$", (3.42, 3.0))
    arrow(
        axes,
        [(8.95, top - 0.5), (8.95, middle), (3.2 + half, middle)],
        "torque that the software assumes",
        (6.4, middle),
    )
    axes.plot([8.95], [top], "o", color="0.3", ms=3)
    axes.plot([8.95, 8.95], [top, top - 0.5], color="0.3", lw=1.2)
    for x, color, text in ((3.6, SOFTWARE, "flight software"), (6.4, TRUE, "simulated hardware and plant")):
        axes.add_patch(FancyBboxPatch((x - 0.25, -0.68), 0.3, 0.22, boxstyle="round,pad=0.02", fc=color, ec="0.3"))
        axes.text(x + 0.2, -0.57, text, va="center", fontsize=8.5)
    return figure


@style.styled
def timeline() -> Figure:
    """Return the times of a run on an axis: approach, hand-over, hold phase, window, control periods."""
    parts = ptsmc.study(ptsmc.read(ROOT / "scenarios/first_flight.toml")).parts
    figure = Figure(figsize=(8.6, 2.7), layout="constrained")
    axes = figure.subplots()
    t_f, delta, window, t_end = 5.0, 1.15, 1.6, 8.2  # not to scale: the real times differ by orders of magnitude
    axes.axvspan(0, t_f - delta, ymin=0.35, ymax=0.62, color=style.STYLES[0][0], alpha=0.25, lw=0)
    axes.axvspan(t_f - delta, t_end, ymin=0.35, ymax=0.62, color=style.STYLES[2][0], alpha=0.25, lw=0)
    text = "approach phase:\ngains grow like $1/\\tau$ and $1/\\tau^2$"
    axes.text((t_f - delta) / 2, 0.485, text, ha="center", va="center")
    axes.text(7.4, 0.485, "hold phase:\nconstant gains", ha="center", va="center")
    axes.annotate("", (t_f, 0.72), (t_f + window, 0.72), arrowprops={"arrowstyle": "<->", "color": "0.2"})
    axes.text(t_f + window / 2, 0.78, "window: RMS error", ha="center", va="bottom")
    axes.annotate("", (t_f - delta, 0.72), (t_f, 0.72), arrowprops={"arrowstyle": "<->", "color": "0.2"})
    axes.text(t_f - delta / 2, 0.78, r"$\delta$", ha="center", va="bottom")
    for x in (t_f - delta, t_f, t_f + window):
        axes.plot([x, x], [0.3, 0.76], **style.LIMIT)
    samples = t_f - delta + 0.23 * np.arange(-16, 19)
    axes.plot(samples, np.full(samples.size, 0.3), "|", color="0.2", ms=7)
    axes.text(0.05, 0.2, "samples of the anchored clock: one is at the hand-over", va="center", fontsize=9)
    axes.set(xlim=(0, t_end), ylim=(0.12, 0.95), yticks=[])
    axes.set_xticks(
        [0, t_f - delta, t_f, t_f + window, t_end], ["0", r"$t_f-\delta$", "$t_f$", "$t_f+$window", r"$t_{end}$"]
    )
    axes.spines["left"].set_visible(False)
    axes.grid(visible=False)
    length = f"$t_f$ = {float(parts.controller.t_f):g} s, period {1e3 * float(parts.period):g} ms in the first flight"
    axes.set_title(f"The phases of a run, not to scale ({length})", loc="left")
    return figure


@style.styled
def natural_frequency() -> Figure:
    """Return the natural frequency of the approach over the time to go, beside the Nyquist frequency."""
    parts = ptsmc.study(ptsmc.read(ROOT / "scenarios/first_flight.toml")).parts
    law, h = parts.controller, float(parts.period)
    eta, delta, t_f = (float(v) for v in (law.eta, law.delta, law.t_f))
    stable = (eta - 0.5) * h  # smallest time to go with a stable frozen loop
    tau = np.geomspace(delta, t_f, 400)
    figure = Figure(figsize=(8.0, 4.2), layout="constrained")
    axes = figure.subplots()
    axes.loglog(tau, eta / tau, color=style.STYLES[0][0], label=rf"natural frequency $\eta/\tau$, $\eta={eta:g}$")
    axes.axhline(np.pi / h, **style.LIMIT, label=f"Nyquist frequency, h = {1e3 * h:g} ms")
    axes.axvspan(delta, stable, color=style.STYLES[1][0], alpha=0.2, lw=0, label="frozen loop unstable")
    axes.plot(
        [delta], [eta / delta], "o", color=style.STYLES[1][0], label=rf"published hand-over, $\delta={delta:g}$ s"
    )
    for line in (axes.xaxis, axes.yaxis):
        style.plain_ticks(line)
    axes.set(xlabel=r"time to go $\tau$ [s]", ylabel="frequency [rad/s]", xlim=(t_f, 0.8 * delta))
    axes.set_title("The natural frequency of the published gains reaches the Nyquist frequency", loc="left", pad=12)
    axes.legend(loc="upper left", bbox_to_anchor=(0.02, 0.86))
    return figure


def main() -> None:
    """Write the diagrams."""
    FOLDER.mkdir(exist_ok=True)
    for name, figure in {"loop": loop(), "timeline": timeline(), "natural_frequency": natural_frequency()}.items():
        figure.savefig(FOLDER / f"{name}.png", dpi=120)


if __name__ == "__main__":
    main()
