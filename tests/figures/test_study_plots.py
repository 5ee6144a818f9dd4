"""Content of the figures of studies, read from their lines and axes."""

import warnings
from itertools import pairwise

import numpy as np
import pytest
from matplotlib.contour import ContourSet
from matplotlib.legend import Legend

from ptsmc_jax.figures import run_plots, study_plots
from ptsmc_jax.figures.style import new_figure

GRID = np.array([[1e-5, 2e-5], [3e-5, 4e-5]])
NAMES = ("window_error", "linear_window_error", "peak_torque", "largest_peak_torque")


def numbers_apart(axes):
    """Return the number of tick labels of the horizontal axis, after checking that they neither overlap nor touch."""
    axes.figure.draw_without_rendering()
    boxes = [label.get_window_extent() for label in axes.get_xticklabels() if label.get_text()]
    boxes = sorted((b for b in boxes if axes.bbox.x0 <= (b.x0 + b.x1) / 2 <= axes.bbox.x1), key=lambda b: b.x0)
    assert all(one.x1 + 0.3 * one.height < other.x0 for one, other in pairwise(boxes))
    return len(boxes)


def test_the_search_is_coloured_where_the_requirements_are_met():
    """All steps of a local search are grey, and the steps that meet the requirements are coloured."""
    values = np.array([[3.0, 5.0], [2.0, 4.0], [1.0, np.nan]])
    met = np.array([[False, True], [True, False], [True, False]])
    result = 0.9, {"eta": 3.1}
    stages = np.array([[1.0, 2.0], [1.0, 2.0], [3.0, np.nan]])
    gains = {"eta": ("-", np.full((3, 2), 3.0))}
    figure = study_plots.tuning_history(gains, values, met, stages, "window error", result)
    (begins,) = [line for line in figure.axes[0].lines if line.get_label() == "a stage begins"]
    assert np.asarray(begins.get_xydata()).tolist() == [[0.0, 3.0], [0.0, 5.0], [2.0, 1.0]]
    for axes, value in zip(figure.axes, (0.9, 3.1), strict=True):  # not the last step of a local search
        (line,) = [line for line in axes.lines if str(line.get_label()).startswith("result")]
        assert set(np.asarray(line.get_ydata()).tolist()) == {value}
    drawn = [np.asarray(line.get_ydata(), dtype=float) for line in figure.axes[0].lines[:4]]
    for start in range(2):
        np.testing.assert_array_equal(drawn[2 * start], values[:, start])
        np.testing.assert_array_equal(drawn[2 * start + 1], np.where(met[:, start], values[:, start], np.nan))


def test_a_tradeoff_figure_has_each_trial_and_their_rms():
    """Errors of 3e-6, 4e-6 and 12e-6 have an RMS of 13e-6 / sqrt(3), and small angles are twice as large."""
    errors, peaks = np.array([3e-6, 4e-6, 12e-6]), np.array([0.2, 0.4, 0.3])
    figure = study_plots.tradeoff(
        {"tuned": (errors, peaks)}, {"peak_wheel_torque": 0.5, "window_error": 1e-5}, lower_bound=1e-6
    )
    (axes,) = figure.axes
    trials, (whole,) = (np.asarray(line.get_xydata()) for line in axes.lines[:2])
    arcsec = 2.0 * np.degrees(1.0) * 3600.0
    np.testing.assert_allclose(trials, np.stack([arcsec * errors, peaks], axis=1), rtol=1e-10)
    np.testing.assert_allclose(whole, [arcsec * 13e-6 / np.sqrt(3.0), 0.3], rtol=1e-10)
    said = [text.get_text() for legend in figure.legends for text in legend.get_texts()]
    assert said == [
        "tuned: RMS 3.1 arcsec, mean peak wheel torque 0.3 N m",
        "limit of peak_wheel_torque 0.5 N m",
        "limit of window_error 4.125 arcsec",
        "lower bound 0.413 arcsec",
    ]
    assert axes.get_ylabel() == "peak wheel torque [N m]"
    assert axes.get_xlabel() == "RMS pointing error in the window [arcsec]"


def test_the_first_points_of_a_tradeoff_figure_are_drawn_above_later_points_at_the_same_place():
    same = np.array([3e-6, 4e-6]), np.array([0.2, 0.4])
    (axes,) = study_plots.tradeoff({"tuned": same, "before": same}, {}).axes
    tuned, before = (line for line in axes.lines if ": RMS" in str(line.get_label()))
    assert tuned.get_zorder() > before.get_zorder()
    assert axes.get_ylabel() == "peak commanded torque [N m]"


def test_sensitivities_of_an_error_and_its_pointing_angle_are_drawn_once():
    figure = study_plots.tornado({name: {"eta": -1.0} for name in ("window_error", "peak_torque", "window_angle")})
    assert [axes.get_title(loc="left") for axes in figure.axes] == ["peak_torque", "window_angle"]


@pytest.mark.parametrize(("low", "high", "least"), [(1e-6, 0.1, 5), (4.167e-5, 0.1188, 4)])  # second: long numbers
def test_profiles_name_the_violated_limit_and_their_numbers_do_not_overlap(low, high, least):
    """A profile shows the objective along one gain, with the largest violation at each value."""
    at = np.geomspace(low, high, 4)
    over, nearest = np.array([1.2, 0.5, 1.1, 1.5]), ["peak_torque", "peak_torque", "gain_margin", "peak_torque"]
    figure = study_plots.profiles({"sign_width": study_plots.Profile("-", at, at, over, nearest, 1e-3)}, "objective")
    (axes,) = figure.axes
    drawn = {line.get_label(): np.asarray(line.get_xdata()).tolist() for line in axes.lines}
    assert axes.get_title(loc="left")
    assert drawn["limits kept"] == [at[1]]
    assert drawn["beyond the limit of peak_torque"] == [at[0], at[3]]
    assert drawn["beyond the limit of gain_margin"] == [at[2]]
    assert numbers_apart(axes) >= least


@pytest.mark.parametrize(("count", "limits"), [(1, 0), (1, 6), (2, 3), (5, 4), (10, 6)])
def test_the_legend_of_profiles_is_inside_the_figure_and_above_the_axes(count, limits):
    """Drawing causes no warning. The legend has three entries and one for each limit."""
    metrics = (
        "peak_torque",
        "peak_torque_delivered",
        "gain_margin",
        "within_ape_boresight",
        "phase_margin",
        "saturated",
    )
    at, nearest = np.geomspace(1e-3, 1.0, 6), [metrics[k % max(limits, 1)] for k in range(6)]
    one = study_plots.Profile("1/s", at, at, np.full(6, 1.5 if limits else 0.5), nearest, 0.1)
    figure = study_plots.profiles({f"gain_{k}": one for k in range(count)}, "RMS of\nwindow error [-]")
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        figure.draw_without_rendering()
    (legend,) = figure.findobj(Legend)
    assert isinstance(legend, Legend)
    box, top = legend.get_window_extent(), figure.axes[0].get_window_extent().y1
    assert 0.0 <= box.x0 < box.x1 <= figure.bbox.x1
    assert top <= box.y0 < box.y1 <= figure.bbox.y1
    assert len(legend.get_texts()) == 3 + limits


@pytest.mark.parametrize("known", [0, 1])
def test_a_profile_with_few_values_shows_the_whole_interval_of_its_gain(known):
    at = np.geomspace(1e-3, 1.0, 4)
    goal = np.where(np.arange(4) < known, 1e-5, np.nan)
    one = study_plots.Profile("-", at, goal, np.full(4, 1e9), ["peak_torque"] * 4, 0.1)
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        figure = study_plots.profiles({"k1": one}, "objective")
        figure.draw_without_rendering()
    low, high = figure.axes[0].get_xlim()
    assert low < 1e-3
    assert high > 1.0
    assert [text.get_text() for text in figure.axes[0].texts] == ["no objective: no trial reaches its end"] * (
        not known
    )


@pytest.mark.parametrize(("limit", "drawn"), [(2.9, True), (3.1, False)])
def test_a_limit_far_above_the_curves_is_labelled_and_does_not_flatten_them(limit, drawn):
    _, axes = new_figure("torque", "u")
    axes.plot([0.0, 1.0], [-1.0, 0.5])
    run_plots._draw_limit(axes, limit, "limit of peak_torque", " N m")
    assert (max(axes.get_ylim()) > 2.0) == drawn
    (said,) = [line.get_label() for line in axes.lines if str(line.get_label()).startswith("limit")]
    assert said == f"limit of peak_torque {limit:g} N m" + ("" if drawn else ", beyond this axis")


def test_cells_of_a_map_meet_in_the_middle_between_grid_points():
    np.testing.assert_allclose(study_plots.MapAxis("x", [1.0, 2.0, 4.0], False).edges, [0.5, 1.5, 3.0, 5.0])
    powers = 2.0 ** np.array([-0.5, 0.5, 1.5, 2.5])  # the axis is logarithmic
    np.testing.assert_allclose(study_plots.MapAxis("x", [1.0, 2.0, 4.0], True).edges, powers)


@pytest.mark.parametrize("count", [1, 2, 3, 4])
def test_every_grid_with_numbers_has_a_map(count):
    grids = {name: GRID if k < count else np.full((2, 2), np.nan) for k, name in enumerate(NAMES)}
    axis = study_plots.MapAxis("delta [s]", [1.0, 2.0], False)
    figure = study_plots.accuracy_map(axis, axis, grids, np.zeros((2, 2), bool), {})
    titles = [axes.get_title() for axes in figure.axes if axes.get_title()]
    assert len(titles) == count
    assert len(figure.axes) == 2 * count  # each map has a colour bar


@pytest.mark.parametrize(("low", "high"), [(1e-3, 1e-1), (1e-2, 1.0), (0.05, 5.0), (1e-5, 1.0)])
def test_numbers_of_a_maps_logarithmic_axis_do_not_overlap(low, high):
    across = study_plots.MapAxis("sign_width", np.geomspace(low, high, 2), True)
    up = study_plots.MapAxis("delta [s]", [1.0, 2.0], False)
    figure = study_plots.accuracy_map(across, up, dict.fromkeys(NAMES, GRID), np.zeros((2, 2), bool), {})
    assert numbers_apart(figure.axes[2]) >= 2


def test_the_legend_of_a_map_names_what_the_map_shows():
    """An earlier version named lines outside of the map, drew at most three lines, and did not explain grey cells."""
    axis = study_plots.MapAxis("delta [s]", [1.0, 2.0], True)
    outside = {"outside": (np.array([3.0, 5.0]), np.array([1.0, 2.0])), "empty": (np.full(2, np.nan), np.ones(2))}
    across = {f"line {k}": (np.array([0.1, 9.0]), np.array([1.0 + 0.1 * k, 2.0])) for k in range(5)}
    grids: dict[str, np.ndarray] = dict.fromkeys(NAMES, np.where(np.eye(2), GRID, np.nan))
    figure = study_plots.accuracy_map(axis, axis, grids, np.zeros((2, 2), bool), outside | across)
    assert [text.get_text() for text in figure.legends[0].get_texts()] == [
        *across,
        "the panel has no value, see map.csv",
    ]


def test_panels_of_a_map_share_a_scale_for_the_same_quantity_only():
    """An earlier version had one scale for the mean and the largest torque, so that both panels were flat."""
    axis = study_plots.MapAxis("delta [s]", [1.0, 2.0], False)
    grids = {name: GRID * factor for name, factor in zip(NAMES, (1.0, 2.0, 1.0, 100.0), strict=True)}
    not_met = np.array([[True, False], [False, False]])
    figure = study_plots.accuracy_map(axis, axis, grids, ~not_met, {}, not_met=not_met, stability="all pairs stable")
    scales = [axes.collections[0].get_clim() for axes in figure.axes[:4]]
    assert scales[0] == scales[1]
    for limits, name in zip(scales[2:], NAMES[2:], strict=True):
        np.testing.assert_allclose(limits, (grids[name].min(), grids[name].max()))
    assert [text.get_text() for text in figure.legends[0].get_texts()] == [
        "a trial failed or did not converge at t_f",
        "a requirement is not met, see not_met in map.csv",
        "all pairs stable",
    ]


@pytest.mark.parametrize(("limit", "drawn"), [(2.5e-5, True), (1.0, False)])
def test_the_required_torque_is_drawn_on_the_largest_peak_torque(limit, drawn):
    axis = study_plots.MapAxis("delta [s]", [1.0, 2.0], True)
    grids: dict[str, np.ndarray] = dict.fromkeys(NAMES, GRID)
    figure = study_plots.accuracy_map(axis, axis, grids, np.zeros((2, 2), bool), {}, torque_limit=limit)
    contours = {
        axes.get_title(): [one for one in axes.collections if isinstance(one, ContourSet)] for axes in figure.axes
    }
    assert len(contours["largest peak torque [N m]"]) == sum(map(len, contours.values())) == int(drawn)
    (text,) = figure.legends[0].get_texts()
    assert text.get_text() == f"limit of peak_torque {limit:g} N m" + ("" if drawn else ", beyond this map")


def test_a_map_axis_of_whole_numbers_has_ticks_at_whole_numbers_only():
    delay = study_plots.MapAxis("hardware.delay", [0.0, 1.0], False)
    figure = study_plots.accuracy_map(delay, delay, dict.fromkeys(NAMES, GRID), np.zeros((2, 2), bool), {})
    for line in (figure.axes[0].xaxis, figure.axes[0].yaxis):
        low, high = line.get_view_interval()
        assert [tick for tick in line.get_majorticklocs() if low <= tick <= high] == [0.0, 1.0]
