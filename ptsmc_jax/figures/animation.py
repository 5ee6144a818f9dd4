"""A body turning in three dimensions, as frames with controls in one piece of HTML: works offline."""

import re
from itertools import combinations, product
from pathlib import Path

import matplotlib
import numpy as np
from matplotlib.animation import FuncAnimation
from matplotlib.figure import Figure

from ptsmc_jax.figures.style import RC, STYLES
from ptsmc_jax.simulation.rollout import Log, Parts

SIDES = (0.5, 0.35, 0.25)  # half edges of the box that is drawn; shapes say nothing of the inertia
_CORNERS = np.array(list(product((-1.0, 1.0), repeat=3))) * SIDES
_EDGES = np.array([(i, j) for i, j in combinations(range(8), 2) if np.sum(_CORNERS[i] != _CORNERS[j]) == 1])


class Animation:
    """Shown in a notebook; `save` writes it as a page of its own."""

    def __init__(self, content: str):
        self._content = content

    def _repr_html_(self) -> str:
        return self._content

    def save(self, path: str | Path) -> None:
        """Write an HTML page that needs nothing else."""
        page = f'<!doctype html><html><head><meta charset="utf-8"></head><body>{self._content}</body></html>'
        Path(path).write_text(page, encoding="utf-8")


def turned(q: np.ndarray, vectors: np.ndarray) -> np.ndarray:
    """Vectors (n, 3) in body axes, in inertial axes; q (4,) scalar last, body relative to inertial."""
    v, scalar = q[:3], q[3]
    return vectors + 2.0 * np.cross(v, np.cross(v, vectors) + scalar * vectors)


def body(q: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """The edges of the box (12, 2, 3) and the body's axes (3, 2, 3), from end to end in inertial axes; q (4,)."""
    tips = turned(q, np.eye(3))
    return turned(q, _CORNERS)[_EDGES], np.stack([np.zeros_like(tips), tips], axis=1)


def of_run(parts: Parts, log: Log, frames: int = 40) -> Animation:
    """The body of a run with its axes, and the reference's axes dashed; log with numpy arrays (time, component).

    Frames are evenly spread over the run. Raises ValueError where the plant is no spacecraft, or for fewer than two.
    """
    if not parts.plant.attitude:
        raise ValueError("only a spacecraft can be animated; look at a run's plot() instead")
    if frames < 2:
        raise ValueError(f"frames is {frames}, but must be at least 2")
    t = np.asarray(log.t)
    shown = np.searchsorted(t, np.linspace(0.0, t[-1], frames) * (1.0 - 1e-12))
    q, q_f = np.asarray(log.x.q)[shown], np.broadcast_to(np.asarray(log.reference.q), (len(t), 4))[shown]
    with matplotlib.rc_context({**RC, "animation.embed_limit": 1e4}):  # MB; beyond it frames would be dropped
        figure = Figure(figsize=(4.6, 4.6), dpi=70)
        axes = figure.add_subplot(projection="3d")
        box = [axes.plot([], [], [], color="0.45", lw=1.0)[0] for _ in _EDGES]
        own = [axes.plot([], [], [], color=STYLES[k][0], lw=2.6)[0] for k in range(3)]
        wanted = [axes.plot([], [], [], color=STYLES[k][0], lw=1.4, ls="--")[0] for k in range(3)]
        axes.set(xlim=(-1, 1), ylim=(-1, 1), zlim=(-1, 1), xticks=[], yticks=[], zticks=[])
        axes.set_box_aspect((1, 1, 1))
        title = axes.set_title("")

        def draw(k: int) -> list:
            edges, axes_of_body = body(q[k])
            for lines, ends in ((box, edges), (own, axes_of_body), (wanted, body(q_f[k])[1])):
                for line, both in zip(lines, ends, strict=True):
                    line.set_data_3d(*both.T)
            title.set_text(f"t = {t[shown[k]]:.1f} s; dashed: reference")
            return [*box, *own, *wanted, title]

        content = FuncAnimation(figure, draw, frames=frames, interval=120).to_jshtml(default_mode="once")
    return Animation(_alone(content))


# the controls' icons come from a font on the internet; these are characters
_ICONS = {
    "fa-minus": "&minus;", "fa-fast-backward": "&#124;&#9664;", "fa-step-backward": "&#9664;&#124;",
    "fa-play fa-flip-horizontal": "&#9664;", "fa-pause": "&#10073;&#10073;", "fa-play": "&#9654;",
    "fa-step-forward": "&#124;&#9654;", "fa-fast-forward": "&#9654;&#124;", "fa-plus": "+",
}  # fmt: skip


def _alone(content: str) -> str:
    """The page without anything that is fetched from elsewhere."""
    for name, icon in _ICONS.items():
        content = content.replace(f'<i class="fa {name}"></i>', icon)
    return re.sub(r"<link[^>]*>", "", content)
