"""Interactive charts of a result, as Plotly's JSON: histories, a turning body, a front, a search."""

from collections.abc import Callable, Mapping, Sequence
from typing import Any

import numpy as np

from ptsmc_jax.figures import animation
from ptsmc_jax.figures.style import STYLES, error_display
from tuning.studies.front import Front, Point, unit_of

Chart = dict[str, Any]

COLOURS = [colour for colour, _ in STYLES]
DASHES = ("solid", "dash", "dashdot", "dot", "longdashdot")
SYMBOLS = ("circle", "diamond", "triangle-up", "square")
POINTS = 3000  # largest number of points of a history in a chart
FRAMES = 60  # number of frames of the animated body
_LOGARITHMIC = {"type": "log", "tickformat": "~g", "automargin": True}
_DECADES = {**_LOGARITHMIC, "dtick": "D2"}
# title and unit of each panel of a spacecraft's history; states of other plants have no units
PANELS = {
    "q": ("attitude quaternion", "-"), "w": ("body rate", "rad/s"), "x": ("state", ""),
    "d_hat": ("disturbance estimate", "N m"), "u": ("delivered torque", "N m"), "s": ("sliding variable", "-"),
}  # fmt: skip


def _layout(**others: object) -> Chart:
    """Return the Plotly layout of all charts; others: further or other entries."""
    return {
        "template": {"layout": {"font": {"family": "system-ui, sans-serif", "size": 13}, "colorway": COLOURS}},
        "margin": {"l": 70, "r": 50, "t": 40, "b": 50},
        "hovermode": "closest",
        "modebar": {"orientation": "v"},
        "legend": {"orientation": "h", "y": 1.02, "yanchor": "bottom"},
        **others,
    }


LOG_COLUMNS = ("measured", "sent")  # columns for `ptsmc identify`, which have gaps


def history(columns: Mapping[str, np.ndarray], spacecraft: bool, marks: Mapping[str, float]) -> Chart:
    """Return the chart of a `trajectory.csv` over time: panels for state, estimate, input and sliding variable.

    Args:
        columns: the columns by name, (time,) each.
        spacecraft: whether the plant is a spacecraft.
        marks: times of vertical lines [s], by their labels.
    """
    t = columns["t"]
    samples = np.unique(np.linspace(0, t.size - 1, min(POINTS, t.size)).round().astype(int))
    blocks: dict[str, list[str]] = {}
    for name in columns:
        if name != "t" and not name.startswith(LOG_COLUMNS):
            blocks.setdefault(name.rstrip("0123456789"), []).append(name)
    above = {"yref": "paper", "yanchor": "bottom", "showarrow": False}
    annotations = [{**above, "x": time_of_mark, "y": 1.0, "text": what} for what, time_of_mark in marks.items()]
    data, axes = [], {}
    for row, (block, names) in enumerate(blocks.items()):
        number = "" if row == 0 else str(row + 1)
        for k, name in enumerate(names):
            data.append({
                "type": "scatter", "mode": "lines", "name": name, "yaxis": f"y{number}", "showlegend": False,
                "x": to_json_numbers(t[samples]), "y": to_json_numbers(columns[name][samples]),
                "hovertemplate": f"{name} %{{y:.5g}} at %{{x:.4g}} s<extra></extra>",
                "line": {"color": COLOURS[k % len(COLOURS)], "dash": DASHES[k % len(DASHES)], "width": 1.6},
            })  # fmt: skip
        what, unit = PANELS.get(block, (block, "")) if spacecraft else (block, "")
        top = 1.0 - (row + 0.18) / len(blocks)
        domain = [1.0 - (row + 0.94) / len(blocks), top]
        axes[f"yaxis{number}"] = {"domain": domain, "exponentformat": "e"}
        text = f"{what} [{unit}]: {', '.join(names)}" if unit else ", ".join(names)
        annotations.append({**above, "x": 0.0, "xref": "paper", "xanchor": "left", "y": top, "text": text})
    shapes = [_vertical_line(time_of_mark, color="#777", dash="dot", width=1) for time_of_mark in marks.values()]
    time = {"title": {"text": "time [s]"}, "anchor": "y" if len(blocks) == 1 else f"y{len(blocks)}"}
    return {"data": data, "layout": _layout(**axes, xaxis=time, shapes=shapes, annotations=annotations)}


def _vertical_line(x: float, **line: object) -> Chart:
    """Return a vertical line over the whole height of a chart; line: its style."""
    return {"type": "line", "x0": x, "x1": x, "yref": "paper", "y0": 0, "y1": 1, "line": line}


def attitude(t: np.ndarray, q: np.ndarray) -> Chart:
    """Return an animation of the body as a box with axes, from its quaternions q (time, 4), scalar last."""
    samples = np.unique(np.searchsorted(t, np.linspace(t[0], t[-1], FRAMES) * (1.0 - 1e-12)))

    def body_lines(quaternion: np.ndarray) -> list[Chart]:
        edges, axes = animation.body_edges_and_axes(quaternion)
        box = np.pad(edges, ((0, 0), (0, 1), (0, 0)), constant_values=np.nan).reshape(-1, 3)  # a gap after each edge
        return [
            _line_3d(box, "body", "#888", 3),
            *(_line_3d(axis, f"body axis {k + 1}", COLOURS[k], 7) for k, axis in enumerate(axes)),
        ]

    inertial_axes = [
        _line_3d(np.stack([np.zeros(3), 1.2 * axis]), f"inertial axis {k + 1}", COLOURS[k], 2, "dash")
        for k, axis in enumerate(np.eye(3))
    ]
    frames = [{"name": f"{t[k]:.4g}", "data": body_lines(q[k]), "traces": [0, 1, 2, 3]} for k in samples]
    still = {"mode": "immediate", "transition": {"duration": 0}, "frame": {"duration": 60, "redraw": True}}
    at_once = {**still, "frame": {"duration": 0, "redraw": True}}
    steps = [{"method": "animate", "label": f["name"], "args": [[f["name"]], at_once]} for f in frames]
    play = {"type": "buttons", "direction": "left", "x": 0, "y": -0.02, "xanchor": "left", "yanchor": "top",
            "buttons": [{"method": "animate", "label": "play", "args": [None, {**still, "fromcurrent": True}]},
                        {"method": "animate", "label": "pause", "args": [[None], still]}]}  # fmt: skip
    slider = {"steps": steps, "x": 0.25, "len": 0.75, "y": -0.02, "currentvalue": {"prefix": "t = ", "suffix": " s"}}
    axis = {"range": [-1.25, 1.25], "showticklabels": False, "title": {"text": ""}}
    camera = {"eye": {"x": 1.0, "y": 1.0, "z": 0.7}, "center": {"x": 0.0, "y": 0.0, "z": -0.1}}
    scene = {"xaxis": axis, "yaxis": axis, "zaxis": axis, "aspectmode": "cube", "camera": camera}
    layout = _layout(scene=scene, updatemenus=[play], sliders=[slider])
    return {"data": [*body_lines(q[samples[0]]), *inertial_axes], "layout": layout, "frames": frames}


def _line_3d(points: np.ndarray, name: str, colour: str, width: int, dash: str = "solid") -> Chart:
    """Return the Plotly trace of a line in three dimensions.

    Args:
        points: (n, 3) points of the line.
        name: name in the legend.
        colour: colour of the line.
        width: width of the line [pixels].
        dash: style of the line.
    """
    x, y, z = (to_json_numbers(points[:, k]) for k in range(3))
    return {"type": "scatter3d", "mode": "lines", "name": name, "x": x, "y": y, "z": z, "hoverinfo": "name",
            "line": {"color": colour, "width": width, "dash": dash}}  # fmt: skip


def front(pareto: Front, torque_limit: float | None) -> Chart:
    """Return the chart of error over peak torque: the front, dominated points, reference gains and torque limit.

    Args:
        pareto: the front of error against torque.
        torque_limit: required limit on the peak torque [N m]; None: no limit.
    """
    # the colours of `study_plots.front`
    colours = (COLOURS[0], COLOURS[3], "#999", *COLOURS[1:3])
    groups: list[tuple[str, list[Point], Chart]] = [
        ("front", pareto.non_dominated, {"mode": "lines+markers", "marker": {"size": 8}, "line": {"shape": "hv"}}),
        ("knee", [p for p in pareto.non_dominated if p.knee],
         {"mode": "markers", "marker": {"size": 15, "symbol": "star"}}),
        ("dominated", [p for p in pareto.points if p.dominated], {"mode": "markers", "marker": {"symbol": "x"}}),
        *((label, [point], {"mode": "markers", "marker": {"size": 12, "symbol": "diamond"}})
          for label, point in pareto.labelled().items()),
    ]  # fmt: skip
    data, (convert, error, unit) = [], error_display(pareto.plant)
    for k, (name, points, style) in enumerate(groups):
        group = [p for p in points if p.rms >= 0.0]  # NaN if no trial was simulated to its end
        if group:
            rms = convert([p.rms for p in group])
            low, high = convert([p.interval or (p.rms, p.rms) for p in group]).T
            bars = {
                "type": "data", "symmetric": False, "visible": True, "thickness": 1,
                "array": (high - rms).tolist(), "arrayminus": (rms - low).tolist(),
            }  # fmt: skip
            data.append({
                "type": "scatter", "name": name, "x": [p.peak for p in group], "y": rms.tolist(),
                "text": [", ".join(f"{g} {v:.4g}" for g, v in p.gains.items()) for p in group],
                "hovertemplate": "%{text}<br>error %{y:.3g} " + unit + ", peak %{x:.4g}<extra>" + name + "</extra>",
                "error_y": bars, **style, "marker": {**style["marker"], "color": colours[k]},
            })  # fmt: skip
    x_axis = {"title": {"text": f"peak torque [{unit_of('peak_torque', pareto.plant)}]"}, **_DECADES}
    y_axis = {"title": {"text": f"RMS {error} in the window [{unit}]"}, **_DECADES}
    shapes = [] if torque_limit is None else [_vertical_line(torque_limit, dash="dash")]
    notes = []
    if pareto.lower_bound:
        least = float(convert(pareto.lower_bound))
        level = {"y0": least, "y1": least, "xref": "paper", "x0": 0, "x1": 1}
        shapes.append({"type": "line", **level, "line": {"dash": "dot"}})
        notes.append({"text": "lower bound", "xref": "paper", "x": 1, "xanchor": "right", "y": np.log10(least),
                      "yanchor": "bottom", "showarrow": False})  # fmt: skip
    return {"data": data, "layout": _layout(xaxis=x_axis, yaxis=y_axis, shapes=shapes, annotations=notes)}


def laws(
    names: Sequence[str],
    series: Mapping[str, tuple[Sequence[float | None], Sequence[Any]]],
    axis: str,
    marks: Mapping[str, float],
    logarithmic: bool,
) -> Chart:
    """Return the chart of numbers of several laws with their intervals, one law below the other.

    Args:
        names: names of the laws.
        series: by label, a number for each law and its interval.
        axis: label of the axis.
        marks: positions of vertical lines by label.
        logarithmic: use a logarithmic axis if the numbers span a decade or more.
    """
    finite = {label: [None if v is None or not np.isfinite(v) else v for v in values]
              for label, (values, _) in series.items()}  # fmt: skip
    all_values = [v for values in finite.values() for v in values if v is not None]
    logarithmic = (
        logarithmic and bool(all_values) and min(all_values) > 0.0 and max(all_values) >= 10.0 * min(all_values)
    )
    data = []
    for k, (label, (_, intervals)) in enumerate(series.items()):
        error_bars = [(0.0, 0.0) if v is None or not bounds else (bounds[1] - v, v - bounds[0])
                for v, bounds in zip(finite[label], intervals, strict=True)]  # fmt: skip
        data.append({
            "type": "scatter", "mode": "markers", "name": label, "x": finite[label], "y": list(names),
            "hovertemplate": "%{y}: %{x:.4g}<extra>" + label + "</extra>", "showlegend": len(series) > 1,
            "marker": {"size": 10, "color": COLOURS[k % len(COLOURS)], "symbol": SYMBOLS[k % len(SYMBOLS)]},
            "error_x": {"type": "data", "symmetric": False, "thickness": 1.5, "visible": any(intervals),
                        "array": [one for one, _ in error_bars], "arrayminus": [one for _, one in error_bars]},
        })  # fmt: skip
    x_axis = {"title": {"text": axis}, **({**_DECADES, "dtick": 1} if logarithmic else {})}
    y_axis = {"autorange": "reversed", "automargin": True, "type": "category"}
    lines = [_vertical_line(position, dash="dot") for position in marks.values()]
    notes = [{"text": label, "x": np.log10(position) if logarithmic else position, "yref": "paper", "y": 0,
              "yanchor": "bottom", "xanchor": "left", "showarrow": False}
             for label, position in marks.items()]  # fmt: skip
    return {"data": data, "layout": _layout(xaxis=x_axis, yaxis=y_axis, shapes=lines, annotations=notes)}


def search(
    rows: Sequence[Mapping[str, str]], objective: str, convert: Callable[[np.ndarray], np.ndarray], title: str
) -> Chart:
    """Return the chart of the objective over the steps of every local search; hollow points break a limit.

    Args:
        rows: the rows of `history.csv`, by column.
        objective: column of the objective.
        convert: function of the objective that returns the shown value, see `style.objective_display`.
        title: name of the objective and the unit of the shown value.
    """
    starts: dict[str, list[Mapping[str, str]]] = {}
    for row in rows:
        starts.setdefault(row["start"], []).append(row)
    ratio_columns = [name for name in rows[0] if name.endswith("_over_limit")]
    gains = [name for name in rows[0] if name not in ("step", "start", "stage", objective, *ratio_columns)]
    data = []
    for k, (start, steps) in enumerate(starts.items()):
        values = np.array([float(row[objective] or "nan") for row in steps])
        met = [all(float(row[name] or "nan") <= 1.0 for name in ratio_columns) for row in steps]
        data.append({
            "type": "scatter", "mode": "lines+markers", "name": f"start {start}",
            "x": [int(row["step"]) for row in steps],
            "y": to_json_numbers(convert(values)),
            "text": [", ".join(f"{name} {float(row[name]):.4g}" for name in gains) for row in steps],
            "hovertemplate": "step %{x}: %{y:.4g}<br>%{text}<extra></extra>",
            "marker": {"size": 6, "symbol": ["circle" if one else "circle-open" for one in met]},
            "line": {"width": 1, "color": COLOURS[k % len(COLOURS)]},
        })  # fmt: skip
    y_axis = {"title": {"text": title}, **_LOGARITHMIC}  # its values may be within a factor of 2
    x_axis = {"title": {"text": "step of the local search, all stages"}}
    return {"data": data, "layout": _layout(xaxis=x_axis, yaxis=y_axis)}


def to_json_numbers(values: np.ndarray) -> list[float | None]:
    """Return the values with None in place of NaN and infinity, which JSON does not have."""
    return [float(f"{v:.6g}") if np.isfinite(v) else None for v in values]
