"""Content of the figures of a run, read from their legends and lines."""

import re
import warnings

import numpy as np
import pytest
from matplotlib.figure import Figure

import ptsmc_jax
from ptsmc_jax.figures import run_plots
from ptsmc_jax.scenario import from_tables
from tests.helpers import SHORT, SHORT_CHAIN, untuned

PEAKS = [(SHORT, 0, " N m", r"peak \d"), (SHORT_CHAIN, 1, "", r"peak of the command \d")]


@pytest.mark.parametrize(("text", "delay", "unit", "said"), PEAKS, ids=["0", "1"])
def test_a_peak_of_the_command_is_labelled_as_commanded(text, delay, unit, said):
    """The figure shows the delivered torque and marks the metric `peak_torque`, which is the commanded torque."""
    late = ptsmc_jax.replace(from_tables(untuned(text)), hardware__delay=delay)
    flight = ptsmc_jax.simulate(late)
    log = flight.run.log._replace(commanded=flight.run.log.commanded.copy())
    log.commanded[17, -1] = -50.0  # the peak, at a known time and axis
    (axes,) = run_plots.torque(flight.run.parts, log).axes
    (label,) = [label for label in axes.get_legend_handles_labels()[1] if label.startswith("peak")]
    assert label.startswith(f"peak of the command 50{unit} at {log.t[17]:.4g} s")
    (axes,) = flight.plot("torque")["torque"].axes
    assert any(re.match(said, label) for label in axes.get_legend_handles_labels()[1])


def test_no_two_of_twenty_states_look_alike():
    """An earlier version drew x6, x11 and x16 with the same colour, style and width."""
    axes = Figure().subplots()
    run_plots._plot_components(axes, np.arange(3.0), np.zeros((3, 20)), "x")
    looks = {(one.get_color(), one.get_linestyle(), one.get_linewidth(), one.get_alpha()) for one in axes.lines}
    assert len(looks) == 20


@pytest.mark.parametrize("order", [2, 3])
def test_theoretical_decay_lines_have_the_labelled_powers(order):
    """The error falls like r^eta, and s of a chain of order 3 falls like r^(eta + 1)."""
    tables = {"plant": {"kind": "chain", "order": order}, "controller": {"t_f": 5.0, "eta": 4.5, "delta": 0.5}}
    chain = from_tables({**tables, "loop": {"mode": "sampled", "period": 0.1}})
    (axes,) = ptsmc_jax.simulate(chain).plot("convergence")["convergence"].axes
    guides = [np.asarray(line.get_xydata()) for line in axes.lines if line.get_color() == "black"]
    powers = [np.log(y[1] / y[0]) / np.log(x[1] / x[0]) for x, y in (guide.T for guide in guides)]
    np.testing.assert_allclose(powers, [4.5, 5.5][: order - 1], rtol=1e-12)
    said = [text.get_text() for text in axes.texts]
    assert said == ["slope $\\eta$ = 4.5", "slope $\\eta+n-2$ = 5.5"][: order - 1]


def test_the_window_of_the_window_error_is_shaded():
    short = ptsmc_jax.replace(from_tables(untuned(SHORT_CHAIN)), loop__window=0.75)
    (axes,) = ptsmc_jax.simulate(short).plot("error")["error"].axes
    (window,) = [patch for patch in axes.patches if str(patch.get_label()).startswith("window")]
    placed = window.get_window_extent().transformed(axes.transData.inverted())
    np.testing.assert_allclose([placed.x0, placed.x1], [5.0, 5.75], rtol=1e-9)


def test_the_sliding_variable_has_its_unit_in_both_phases():
    """s is (t_f - t) v' + eta v in the approach phase, and v' + c v in the hold phase."""
    early = ptsmc_jax.replace(from_tables(untuned(SHORT)), controller__delta=1.5)
    figures = ptsmc_jax.simulate(early).plot("sliding", "convergence")
    assert [text.get_text() for text in figures["sliding"].axes[0].texts] == ["$t_f$ = 5 s", "hand-over"]
    assert figures["sliding"].axes[0].get_ylabel() == "|s| [-], after the hand-over [1/s]"
    assert figures["convergence"].axes[0].get_ylabel().endswith("and |s| [-]")


def test_required_limits_are_drawn_in_the_intervals_in_which_they_apply():
    """A limit of the error about one axis is not drawn. Earlier, it was drawn beside the error about all axes."""
    required = {"peak_torque": 3.0, "terminal_angle": 0.01, "window_error": 1e-3, "hold_angle": 0.1, "ape_x": 1e-4}
    tables = untuned(SHORT) | {"requirements": required, "pointing": {"boresight": [0, 0, 1], "after": 0.5}}
    figures = ptsmc_jax.simulate(from_tables(tables)).plot("error", "torque")
    lines = {str(line.get_label()): np.asarray(line.get_xydata()) for line in figures["error"].axes[0].lines}
    limits = {label: line for label, line in lines.items() if label.startswith("limit")}
    arcsec = 180.0 * 3600.0 / np.pi
    for (label, line), name, interval, limit in zip(
        limits.items(),
        ("terminal_angle", "window_error", "hold_angle"),
        ([5.0, 5.0], [5.0, 6.0], [5.0, 6.5]),
        (0.01, 2.0 * np.arcsin(1e-3), 0.1),
        strict=True,
    ):
        assert label == f"limit of {name} {arcsec * limit:.4g} arcsec"
        np.testing.assert_allclose(line, np.transpose([interval, [arcsec * limit] * 2]))
    labels = figures["torque"].axes[0].get_legend_handles_labels()[1]
    assert [label for label in labels if label.startswith("limit")] == ["limit of peak_torque 3 N m"]


def test_figures_of_wheels_show_the_required_limit_and_the_limit_of_the_wheels():
    wheels = {"kind": "pyramid", "torque_limit": 2.0, "momentum_limit": 500.0}
    tables = untuned(SHORT) | {"wheels": wheels, "requirements": {"peak_wheel_torque": 1.5}}
    figures = ptsmc_jax.simulate(from_tables(tables)).plot("wheels", "wheel_torque")
    for figure in figures.values():
        figure.draw_without_rendering()
        assert figure.legends[0].get_window_extent().x1 <= figure.bbox.x1
    drawn = {name: figure.axes[0].get_legend_handles_labels()[1][4:] for name, figure in figures.items()}
    assert drawn["wheel_torque"] == ["limit of peak_wheel_torque 1.5 N m", "wheels.torque_limit 2 N m"]
    assert drawn["wheels"] == ["wheels.momentum_limit 500 N m s, beyond this axis"]


@pytest.mark.parametrize(("disturbance", "drawn"), [("none", set()), ("sinusoid", {"error", "sliding"})])
def test_zeros_are_not_drawn_on_log_axes(disturbance, drawn):
    """A run that begins on its target has zero errors, or errors without an exact solution."""
    tables = untuned(SHORT_CHAIN) | {"disturbance": {"kind": disturbance}, "hardware": {}}
    figures = ptsmc_jax.simulate(ptsmc_jax.replace(from_tables(tables), plant__x0=[0.0, 0.0])).plot()
    assert {"error", "sliding", "convergence"} & set(figures) == drawn
    for name in drawn:
        (axes,) = figures[name].axes
        assert np.isnan(np.asarray(axes.lines[0].get_ydata())[0])  # the zero of the first sample is not drawn as 1e-16
        assert axes.get_ylim()[0] >= run_plots.SMALLEST


def test_a_command_far_beyond_the_delivered_torque_is_cut_by_the_axis():
    """An earlier version drew the wheels' torque as a line at zero beside a command of 970 N m."""
    weak = ptsmc_jax.replace(from_tables(untuned(SHORT_CHAIN)), hardware__torque_limit=1e-3)
    flight = ptsmc_jax.simulate(weak)
    (axes,) = flight.plot("torque")["torque"].axes
    assert flight.metrics["peak_torque"] > 100 * 1e-3
    assert max(map(abs, axes.get_ylim())) == pytest.approx(run_plots.FAR_OFF * 1e-3)
    assert any(label.endswith("beyond this axis") for label in axes.get_legend_handles_labels()[1])


def test_a_run_that_diverges_is_drawn_without_warnings():
    """Squares of numbers beyond 1e154 overflow. Earlier, the axis of s ended at 10 and the peak was "nan"."""
    tables = untuned(SHORT_CHAIN) | {"loop": {"mode": "sampled", "period": 0.3, "t_end": 400.0}}
    flight = ptsmc_jax.simulate(ptsmc_jax.replace(from_tables(tables), controller__k1=100.0))
    assert flight.status == "diverged"
    with warnings.catch_warnings(action="error"):
        figures = flight.plot("torque", "sliding", "error", "convergence")
        for figure in figures.values():
            figure.draw_without_rendering()
    (torque,), (sliding,) = figures["torque"].axes, figures["sliding"].axes
    assert not any("nan" in label for label in torque.get_legend_handles_labels()[1])
    assert sliding.get_ylim()[1] > 1e90
