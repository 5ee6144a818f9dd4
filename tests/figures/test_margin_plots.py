"""Content of margin figures, read from their axes."""

from typing import Any

import numpy as np

from ptsmc_jax.figures import margin_plots
from ptsmc_jax.theory.margins import Margins


def margins(times):
    """Return margins (times, 3) of stable loops: every margin is 6 at each time and about each axis."""
    numbers = np.full((times, 3), 6.0)
    values: dict[str, Any] = dict.fromkeys(Margins._fields, numbers) | {"stable": np.full((times, 3), True)}
    return Margins(**values)


def test_the_axis_of_the_time_to_go_has_plain_numbers():
    """The numbers have no powers of ten such as 3 x 10^1."""
    time_to_go, judged = np.array([34.0, 25.0, 10.0, 5.0, 3.0]), np.full(5, True)
    figure = margin_plots.margins_over_time(time_to_go, judged, margins(5), margins(1))
    figure.draw_without_rendering()
    labels = [label.get_text() for label in figure.axes[-1].get_xticklabels(which="both") if label.get_text()]
    assert {"5", "10", "20"} <= set(labels)
    assert not [label for label in labels if "$" in label]


def test_a_panel_of_infinite_margins_states_that_there_is_no_limit():
    """A saturated loop tolerates any gain and delay. An earlier version left the panel empty."""
    few = np.array([10.0, 5.0]), np.full(2, True)
    free = {name: np.full((2, 3), np.inf) for name in ("gain_up", "gain_down")}
    figure = margin_plots.margins_over_time(*few, margins(2)._replace(**free), margins(1)._replace(**free))
    assert [[text.get_text() for text in axes.texts] for axes in figure.axes] == [["without a limit"], [], []]
    one = margins(1)._replace(gain_up=np.array([[np.inf, 6.0, np.inf]]))
    assert not margin_plots.margins_over_time(*few, margins(2)._replace(**free), one).axes[0].texts


def test_times_whose_margins_are_not_judged_are_grey():
    """Frozen gains give small margins at the start, which no requirement judges."""
    time_to_go, judged = np.array([40.0, 20.0, 10.0, 5.0, 2.0, 1.0]), np.array([False, False, True, False, True, False])
    figure = margin_plots.margins_over_time(time_to_go, judged, margins(6), margins(1))
    for axes in figure.axes:
        far, near = axes.get_xlim()
        grey = [area.get_extents().transformed(axes.transData.inverted()).intervalx for area in axes.patches]
        np.testing.assert_allclose(np.sort(grey), [[10.0, far], [near, 2.0]])
        assert far > 40.0
        assert near < 1.0
        assert axes.get_legend_handles_labels()[1].count("not judged\nby requirements") == 1
    # earlier, the strip after the last sample was grey even if requirements judge this sample
    cut = margin_plots.margins_over_time(time_to_go[:5], judged[:5], margins(5), margins(1))
    assert [len(axes.patches) for axes in cut.axes] == [1, 1, 1]


def test_required_margins_are_drawn():
    """In the Nichols chart the gain and phase margins are lines through -180 deg, 0 dB.

    Peak sensitivity and margins over time have a dashed line at the limit.
    """
    limits = {"gain_margin": 6.0, "phase_margin": 30.0, "delay_margin": 0.2, "peak_sensitivity": 5.0}
    w = np.geomspace(1e-2, 1.0, 50)
    L = 0.1 / (1j * w)[:, None]
    nichols, sensitivity = margin_plots.nichols(L, ["x"], limits), margin_plots.sensitivity(w, L, ["x"], limits)
    times, judged = np.array([10.0, 1.0]), np.full(2, True)
    over_time = margin_plots.margins_over_time(times, judged, margins(2), margins(1), limits)

    def drawn(axes):
        return [(line.get_label(), np.asarray(line.get_xydata()).tolist()) for line in axes.lines
                if line.get_linestyle() == "--" and str(line.get_color()) == "0.3"]  # fmt: skip

    _, gain, phase, (label, _) = drawn(nichols.axes[0])
    assert gain[1] == [[-180.0, -6.0], [-180.0, 6.0]]
    assert phase[1] == [[-210.0, 0.0], [-150.0, 0.0]]
    assert label == "limits of gain_margin 6 dB, phase_margin 30 deg"
    assert drawn(sensitivity.axes[0]) == [("limit of peak_sensitivity 5 dB", [[0.0, 5.0], [1.0, 5.0]])]
    labels = [[label for label, _ in drawn(axes)] for axes in over_time.axes]
    assert labels == [["limit 6 dB"], ["limit 30 deg"], ["limit 0.2 s"]]
    assert [axes.get_yscale() for axes in over_time.axes] == ["linear", "linear", "log"]


def test_a_peak_of_the_sensitivity_is_inside_the_figure():
    """An earlier version cut the figure at 15 dB."""
    w = np.geomspace(1e-2, 1.0, 500)
    L = 0.25 / (1j * w * (1j * w + 0.01))[:, None]  # a phase margin of 1 degree
    (axes,) = margin_plots.sensitivity(w, L, ["x"]).axes
    assert axes.get_ylim()[1] > max(np.max(np.asarray(line.get_ydata())) for line in axes.lines) > 20.0


def test_a_loop_gain_of_zero_is_drawn_without_a_warning():
    """A saturated command gives L = 0 about an axis, and the magnitude 0 has no value in dB."""
    w = np.geomspace(1e-3, 1.0, 50)
    L = np.stack([np.zeros(50), 0.1 / (1j * w)], axis=1)
    for figure in (margin_plots.nichols(L, ["x", "y"]), margin_plots.sensitivity(w, L, ["x", "y"])):
        figure.draw_without_rendering()
        low, high = figure.axes[0].get_ylim()
        assert low == -40.0
        assert high <= 40.0


def test_the_contour_of_a_nichols_chart_has_a_sensitivity_of_six_decibels():
    """Each point L of the contour has 1 / |1 + L| = 6 dB, and the contour encircles -1 once."""
    figure = margin_plots.nichols(np.exp(-1j * np.linspace(0.1, 3.0, 50))[:, None], ["x"])
    (contour,) = [line for line in figure.axes[0].lines if line.get_label() == "sensitivity 6 dB"]
    phase, size = np.asarray(contour.get_xydata()).T
    away = 1.0 + 10.0 ** (size / 20.0) * np.exp(1j * np.deg2rad(phase))
    np.testing.assert_allclose(-20.0 * np.log10(np.abs(away)), 6.0, rtol=1e-9)
    assert phase.min() < -180.0 < phase.max()


def test_the_curves_of_sensitivity_and_complementary_sensitivity_have_the_right_labels():
    """If L is large, S is small and T is 1."""
    w = np.geomspace(1e-2, 1.0, 50)
    L = 0.1 / (1j * w)[:, None]
    (axes,) = margin_plots.sensitivity(w, L, ["x"]).axes
    drawn = {str(line.get_label()): np.asarray(line.get_ydata()) for line in axes.lines}
    np.testing.assert_allclose(drawn["S x"], -20.0 * np.log10(np.abs(1.0 + L[:, 0])), rtol=1e-9)
    np.testing.assert_allclose(drawn["T x"], -20.0 * np.log10(np.abs(1.0 + 1.0 / L[:, 0])), rtol=1e-9, atol=1e-9)
