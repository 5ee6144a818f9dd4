"""What figures of margins say, read back from their axes."""

from typing import Any

import numpy as np

from ptsmc_jax.figures import margin_plots
from ptsmc_jax.theory.margins import Margins


def margins(times):
    """The same ones at each of so many times, about three axes."""
    numbers = np.full((times, 3), 6.0)
    values: dict[str, Any] = dict.fromkeys(Margins._fields, numbers) | {"stable": np.full((times, 3), True)}
    return Margins(**values)


def test_the_time_to_go_is_in_plain_numbers():
    """Not in 3 x 10^1 and 6 x 10^0, beside each other."""
    figure = margin_plots.over_time(np.array([34.0, 25.0, 10.0, 5.0, 3.0]), margins(5), margins(1))
    figure.draw_without_rendering()
    labels = [label.get_text() for label in figure.axes[-1].get_xticklabels(which="both") if label.get_text()]
    assert {"5", "10", "20"} <= set(labels)
    assert not [label for label in labels if "$" in label]


def test_a_panel_says_that_there_is_no_limit():
    """As of the gain and the delay of a loop that a limit cuts: the panel was empty."""
    few, free = np.array([10.0, 5.0]), {name: np.full((2, 3), np.inf) for name in ("gain_up", "gain_down")}
    figure = margin_plots.over_time(few, margins(2)._replace(**free), margins(1)._replace(**free))
    assert [[text.get_text() for text in axes.texts] for axes in figure.axes] == [["without a limit"], [], []]
    one = margins(1)._replace(gain_up=np.array([[np.inf, 6.0, np.inf]]))
    assert not margin_plots.over_time(few, margins(2)._replace(**free), one).axes[0].texts


def test_a_loop_that_answers_nothing_is_drawn_without_a_warning():
    """As of a command that a limit cuts: L is zero about an axis, whose size has no decibels."""
    w = np.geomspace(1e-3, 1.0, 50)
    L = np.stack([np.zeros(50), 0.1 / (1j * w)], axis=1)
    for figure in (margin_plots.nichols(L, ["x", "y"]), margin_plots.sensitivity(w, L, ["x", "y"])):
        figure.draw_without_rendering()
        low, high = figure.axes[0].get_ylim()
        assert low == -40.0
        assert high <= 40.0


def test_the_contour_of_a_nichols_chart_is_where_the_sensitivity_is_six_decibels():
    """Read back as L, each point of it lies at 1 / |1 + L| = 6 dB, and goes once around -1."""
    figure = margin_plots.nichols(np.exp(-1j * np.linspace(0.1, 3.0, 50))[:, None], ["x"])
    (contour,) = [line for line in figure.axes[0].lines if line.get_label() == "sensitivity 6 dB"]
    phase, size = np.asarray(contour.get_xydata()).T
    away = 1.0 + 10.0 ** (size / 20.0) * np.exp(1j * np.deg2rad(phase))
    np.testing.assert_allclose(-20.0 * np.log10(np.abs(away)), 6.0, rtol=1e-9)
    assert phase.min() < -180.0 < phase.max()


def test_each_of_both_sensitivities_is_the_one_that_it_is_said_to_be():
    """Where L is large S is small, and T is 1."""
    w = np.geomspace(1e-2, 1.0, 50)
    L = 0.1 / (1j * w)[:, None]
    (axes,) = margin_plots.sensitivity(w, L, ["x"]).axes
    drawn = {str(line.get_label()): np.asarray(line.get_ydata()) for line in axes.lines}
    np.testing.assert_allclose(drawn["S x"], -20.0 * np.log10(np.abs(1.0 + L[:, 0])), rtol=1e-9)
    np.testing.assert_allclose(drawn["T x"], -20.0 * np.log10(np.abs(1.0 + 1.0 / L[:, 0])), rtol=1e-9, atol=1e-9)
