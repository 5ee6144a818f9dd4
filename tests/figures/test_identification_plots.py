"""Content of identification figures, read from their axes."""

from typing import Any

import numpy as np
import polars as pl

from ptsmc_jax.figures import identification_plots


def test_signals_show_every_component_and_a_legend_below_them():
    """Earlier versions drew five components, their legend covered the title, and plots had hardly any height."""
    t, values = np.arange(5.0), np.ones((5, 7))
    figure = identification_plots.signals(t, [("state", values, values, values > 1.0)] * 2)
    figure.draw_without_rendering()  # warns if the layout leaves no height for the plots
    (_, axes), (legend,) = figure.axes, figure.legends
    assert len(legend.get_texts()) == 7
    assert legend.get_window_extent().y1 < axes.get_window_extent().y0


def test_rejected_readings_are_drawn_as_crosses():
    """A reading far beyond the others is drawn at the edge, and its predicted value is missing."""
    t, measured = np.arange(6.0), np.stack([np.arange(6.0), np.zeros(6)], axis=1)
    measured[3, 0] = 1e6
    rejected = measured > 10.0
    predicted = np.where(rejected, np.nan, measured)
    figure = identification_plots.signals(t, [("rate [rad/s]", measured, predicted, rejected)])
    (axes,) = figure.axes
    crosses = [np.asarray(line.get_xydata()) for line in axes.lines if line.get_marker() == "x"]
    np.testing.assert_allclose(crosses[0], [[3.0, max(axes.get_ylim())]])
    assert max(axes.get_ylim()) < 10.0
    assert [text.get_text() for text in figure.legends[0].get_texts()] == ["component 1", "component 2", "rejected"]


def test_the_figure_of_a_proposed_manoeuvre_names_its_components():
    figure = identification_plots.profile(np.arange(5.0), [("command [N m]", np.ones((5, 3)))])
    assert [text.get_text() for text in figure.legends[0].get_texts()] == [f"component {k}" for k in (1, 2, 3)]


def test_the_prior_interval_of_a_uniform_phase_is_drawn_as_a_full_turn():
    row = {
        "parameter": "disturbance_phase",
        "estimate": 2.0,
        "start": 0.0,
        "std": 0.1,
        "prior_std": np.pi / np.sqrt(3.0),
    }
    axes: Any = identification_plots.estimates(pl.DataFrame([row])).axes[0]
    bars = [container.lines[2][0].get_segments()[0][:, 0] for container in axes.containers]
    np.testing.assert_allclose(bars, [[-50.0 * np.pi, 50.0 * np.pi], [90.2, 109.8]])
