"""What figures of studies draw, read back from their lines and axes."""

import numpy as np
import pytest

from ptsmc_jax.figures import study_plots

GRID = np.array([[1e-5, 2e-5], [3e-5, 4e-5]])
NAMES = ("window_error", "linear_window_error", "peak_torque", "largest_peak_torque")


def test_the_search_is_coloured_where_the_requirements_are_met():
    """Grey: all steps of a start; coloured above it: those that are admissible."""
    values = np.array([[3.0, 5.0], [2.0, 4.0], [1.0, np.nan]])
    met = np.array([[False, True], [True, False], [True, False]])
    figure = study_plots.tuning_history({"eta": ("-", np.full((3, 2), 3.0))}, values, met, "window error")
    drawn = [np.asarray(line.get_ydata(), dtype=float) for line in figure.axes[0].lines[:4]]
    for start in range(2):
        np.testing.assert_array_equal(drawn[2 * start], values[:, start])
        np.testing.assert_array_equal(drawn[2 * start + 1], np.where(met[:, start], values[:, start], np.nan))


@pytest.mark.parametrize("count", [1, 2, 3, 4])
def test_every_grid_that_has_numbers_has_its_map(count):
    grids = {name: GRID if k < count else np.full((2, 2), np.nan) for k, name in enumerate(NAMES)}
    axis = ("delta [s]", [1.0, 2.0], False)
    figure = study_plots.accuracy_map(axis, axis, grids, np.zeros((2, 2), bool), {})
    titles = [axes.get_title() for axes in figure.axes if axes.get_title()]
    assert len(titles) == count
    assert len(figure.axes) == 2 * count  # and its bar of colours
