"""Content of identification figures, read from their axes."""

import numpy as np

from ptsmc_jax.figures import identification_plots


def test_signals_show_every_component_and_a_legend_below_them():
    """An earlier version drew five components, and its legend covered the title."""
    t, values = np.arange(5.0), np.ones((5, 7))
    figure = identification_plots.signals(t, [("state", values, values)])
    figure.draw_without_rendering()
    (axes,), (legend,) = figure.axes, figure.legends
    assert len(legend.get_texts()) == 7
    assert legend.get_window_extent().y1 < axes.get_window_extent().y0
