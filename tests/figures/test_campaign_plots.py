"""Content of campaign figures, read from their legends and lines."""

import numpy as np
import pytest
from matplotlib.markers import MarkerStyle

from ptsmc_jax.figures import campaign_plots


@pytest.mark.parametrize(("of_time", "said"), [
    ("", "limit 143.239 deg: 50 % within"),
    ("required: 50 % of the time of all runs; seen: 80 %",
     "limit 143.239 deg: 50 % of the trials within at all times\nrequired: 50 % of the time of all runs; seen: 80 %"),
])  # fmt: skip
def test_a_limit_on_a_fraction_of_the_time_is_labelled(of_time, said):
    column = campaign_plots.Column("rad", np.array([1.0, 2.0, 3.0, np.nan]), 2.5, of_time)
    (axes,) = campaign_plots.distributions({"ape_z": column}).axes
    assert axes.get_legend_handles_labels()[1] == [said]


def test_the_distribution_places_a_value_at_the_middle_of_its_step():
    """Each of four trials is a quarter. A trial without a value lies beyond all values."""
    column = campaign_plots.Column("s", np.array([3.0, 1.0, np.nan, 2.0]))
    (axes,) = campaign_plots.distributions({"settling_time": column}).axes
    np.testing.assert_allclose(np.asarray(axes.lines[0].get_xydata()), [[1.0, 1 / 8], [2.0, 3 / 8], [3.0, 5 / 8]])


def test_the_legend_of_a_distribution_with_a_limit_is_above_the_axes():
    values = np.random.default_rng(0).lognormal(0.0, 1.0, 2000)
    figure = campaign_plots.distributions({"a": campaign_plots.Column("N m", values, 1.5)})
    figure.draw_without_rendering()
    (axes,) = figure.axes
    legend = axes.get_legend()
    assert legend is not None
    assert legend.get_window_extent().y0 >= axes.get_window_extent().y1


def test_each_outcome_of_a_trial_is_drawn_with_a_visible_marker():
    outcome = np.array(list(campaign_plots.MARKS), dtype=object)
    x, labels = 1.0 + np.arange(outcome.size), {name: f"{name}: 7" for name in campaign_plots.MARKS}
    start, torque = campaign_plots.Column("rad", x), campaign_plots.Column("N m", x)
    (axes,) = campaign_plots.torque_by_angle(start, torque, outcome, labels).axes
    assert axes.get_legend_handles_labels()[1] == list(labels.values())
    for points, marker in zip(
        axes.collections, (marker for _, marker, _ in campaign_plots.MARKS.values()), strict=True
    ):
        drawn = np.all(np.asarray(points.get_linewidth()) > 0.0)
        assert drawn or MarkerStyle(marker).is_filled(), marker  # otherwise it is invisible
    simulated = x[np.isin(outcome, campaign_plots.COMPLETE)]
    assert axes.get_ylim() == pytest.approx((simulated.min() / 1.3, simulated.max() * 1.3))


@pytest.mark.parametrize("count", [1, 4])
def test_legend_and_texts_of_the_figure_of_inputs_are_inside_it(count):
    outcome, x = np.full(3, campaign_plots.AT_TIMES, dtype=object), np.arange(1.0, 4.0)
    drawn = {f"initial_angle_{k}": campaign_plots.Column("rad", x) for k in range(count)}
    metrics = {"peak_torque": campaign_plots.Column("N m", x, 2.0)}
    figure = campaign_plots.inputs(drawn, metrics, outcome, {campaign_plots.AT_TIMES: "3"})
    figure.draw_without_rendering()
    for artist in (*figure.legends, *figure.texts):
        box = artist.get_window_extent()
        assert 0.0 <= box.x0 < box.x1 <= figure.bbox.x1


@pytest.mark.parametrize("limit", [1e-3, 1e3])
def test_a_limit_in_the_legend_is_on_the_axis(limit):
    """An earlier version lost the line of 0.5 N m on an axis of 10 kN m, the commanded torque."""
    x, outcome = np.arange(1.0, 4.0), np.full(3, "not_converged", dtype=object)
    start, torque = campaign_plots.Column("rad", x), campaign_plots.Column("N m", x, limit)
    (axes,) = campaign_plots.torque_by_angle(start, torque, outcome, {"not_converged": "3"}).axes
    low, high = axes.get_ylim()
    assert low < limit < high


@pytest.mark.parametrize(("unit", "shown", "factor"), [("rad", "[deg]", 180.0 / np.pi), ("x1", "[x1]", 1.0)])
def test_initial_angles_are_drawn_in_the_unit_of_their_axis(unit, shown, factor):
    angle, outcome = np.array([0.5, 1.0, 2.0]), np.full(3, campaign_plots.KEPT, dtype=object)
    start, torque = campaign_plots.Column(unit, angle), campaign_plots.Column("N m", angle)
    (axes,) = campaign_plots.torque_by_angle(start, torque, outcome, {campaign_plots.KEPT: "3"}).axes
    assert axes.get_xlabel().endswith(shown)
    np.testing.assert_allclose(np.asarray(axes.collections[0].get_offsets())[:, 0], factor * angle)


@pytest.mark.parametrize(("largest", "limit", "unit"), [(1e-4, 2e-4, "arcsec"), (1e-4, 0.1, "deg"), (0.1, 1e-4, "deg")])
def test_angles_of_a_figure_are_in_arcsec_below_one_degree(largest, limit, unit):
    """Values and required limits of all angles must be below 1 deg; otherwise all are in deg."""
    factor = {"deg": 180.0 / np.pi, "arcsec": 180.0 * 3600.0 / np.pi}[unit]
    angles = campaign_plots.Column("rad", np.array([1e-5, largest, np.nan]), limit)
    small, torque = campaign_plots.Column("rad", np.array([1e-9])), campaign_plots.Column("N m", np.array([7.0]))
    column, same_unit, unchanged = campaign_plots.in_readable_units({"a": angles, "b": small, "c": torque}).values()
    assert column.unit == same_unit.unit == unit
    assert unchanged == torque
    np.testing.assert_allclose(column.values, factor * np.array([1e-5, largest, np.nan]), rtol=1e-14)
    assert column.limit == pytest.approx(factor * limit, rel=1e-14)
