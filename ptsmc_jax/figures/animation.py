"""Animation of a turning body: frames with controls in one HTML page that works offline."""

import re
from itertools import combinations, product
from pathlib import Path

import matplotlib
import numpy as np
from matplotlib.animation import FuncAnimation
from matplotlib.figure import Figure

from ptsmc_jax.figures.style import STYLES, styled
from ptsmc_jax.simulation.rollout import Log, Parts

SIDES = (0.5, 0.35, 0.25)  # half edges of the drawn box, independent of the inertia
_CORNERS = np.array(list(product((-1.0, 1.0), repeat=3))) * SIDES
_EDGES = np.array([(i, j) for i, j in combinations(range(8), 2) if np.sum(_CORNERS[i] != _CORNERS[j]) == 1])


class Animation:
    """An animation that notebooks show; `save` writes it as a page."""

    def __init__(self, content: str):
        self._content = content

    def _repr_html_(self) -> str:
        return self._content

    def save(self, path: str | Path) -> None:
        """Write a self-contained HTML page."""
        page = f'<!doctype html><html><head><meta charset="utf-8"></head><body>{self._content}</body></html>'
        Path(path).write_text(page, encoding="utf-8")


def rotate_to_inertial(q: np.ndarray, vectors: np.ndarray) -> np.ndarray:
    """Return vectors (n, 3) of the body in inertial axes; q (4,) scalar last, body relative to inertial."""
    v, scalar = q[:3], q[3]
    return vectors + 2.0 * np.cross(v, np.cross(v, vectors) + scalar * vectors)


def body_edges_and_axes(q: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Return the edges of the box (12, 2, 3) and the body axes (3, 2, 3), both ends, in inertial axes; q (4,)."""
    tips = rotate_to_inertial(q, np.eye(3))
    return rotate_to_inertial(q, _CORNERS)[_EDGES], np.stack([np.zeros_like(tips), tips], axis=1)


@styled
def animate_run(parts: Parts, log: Log, frames: int = 40) -> Animation:
    """Animate the body of a run with its axes; the axes of the reference are dashed.

    Args:
        parts: parts of the run.
        log: history of the run, NumPy arrays (time, component).
        frames: number of frames, evenly spread over the run.

    Returns:
        The animation.

    Raises:
        ValueError: the plant has no attitude, or there are fewer than two frames.
    """
    if not hasattr(log.x, "q"):
        raise ValueError("only a spacecraft can be animated; look at a run's plot() instead")
    if frames < 2:
        raise ValueError(f"frames is {frames}, but must be at least 2")
    t = np.asarray(log.t)
    samples = np.searchsorted(t, np.linspace(0.0, t[-1], frames) * (1.0 - 1e-12))
    q, q_f = np.asarray(log.x.q)[samples], np.broadcast_to(np.asarray(log.reference.q), (len(t), 4))[samples]
    with matplotlib.rc_context({"animation.embed_limit": 1e4}):  # MB; beyond it frames would be dropped
        figure = Figure(figsize=(4.6, 4.6), dpi=70)
        axes = figure.add_subplot(projection="3d")
        box = [axes.plot([], [], [], color="0.45", lw=1.0)[0] for _ in _EDGES]
        body_axes = [axes.plot([], [], [], color=STYLES[k][0], lw=2.6)[0] for k in range(3)]
        reference_axes = [axes.plot([], [], [], color=STYLES[k][0], lw=1.4, ls="--")[0] for k in range(3)]
        axes.set(xlim=(-1, 1), ylim=(-1, 1), zlim=(-1, 1), xticks=[], yticks=[], zticks=[])
        axes.set_box_aspect((1, 1, 1))
        title = axes.set_title("", loc="center")

        def draw(k: int) -> list:
            edges, axes_of_body = body_edges_and_axes(q[k])
            for lines, ends in (
                (box, edges),
                (body_axes, axes_of_body),
                (reference_axes, body_edges_and_axes(q_f[k])[1]),
            ):
                for line, endpoints in zip(lines, ends, strict=True):
                    line.set_data_3d(*endpoints.T)
            title.set_text(f"t = {t[samples[k]]:.1f} s; dashed: reference")
            return [*box, *body_axes, *reference_axes, title]

        content = FuncAnimation(figure, draw, frames=frames, interval=120).to_jshtml(default_mode="once")
    return Animation(_remove_links(content))


# matplotlib's icons come from a font on the internet; these characters replace them
_ICONS = {
    "fa-minus": "&minus;", "fa-fast-backward": "&#124;&#9664;", "fa-step-backward": "&#9664;&#124;",
    "fa-play fa-flip-horizontal": "&#9664;", "fa-pause": "&#10073;&#10073;", "fa-play": "&#9654;",
    "fa-step-forward": "&#124;&#9654;", "fa-fast-forward": "&#9654;&#124;", "fa-plus": "+",
}  # fmt: skip


def _remove_links(content: str) -> str:
    """Return the page without parts that are loaded from the internet."""
    for name, icon in _ICONS.items():
        content = content.replace(f'<i class="fa {name}"></i>', icon)
    return re.sub(r"<link[^>]*>", "", content)
