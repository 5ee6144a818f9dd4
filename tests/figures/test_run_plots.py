"""What figures of a run say, read back from their legends."""

import re

import pytest

import ptsmc_jax
from ptsmc_jax.scenario import from_tables
from tests.helpers import SHORT, untuned


@pytest.mark.parametrize(("delay", "said"), [(0, r"peak \d"), (1, r"peak of the command \d")])
def test_a_peak_that_is_not_on_the_curves_is_said_to_be_the_commands(delay, said):
    """Delivered torque is drawn, and the metric `peak_torque` is marked, which is what was asked for."""
    late = ptsmc_jax.replace(from_tables(untuned(SHORT)), hardware__delay=delay)
    (axes,) = ptsmc_jax.simulate(late).plot("torque")["torque"].axes
    assert any(re.match(said, label) for label in axes.get_legend_handles_labels()[1])


def test_the_time_to_go_has_plain_numbers():
    """It runs from t_f down to delta: 60 to 4 s stood there as 6x10^1, 4x10^1, 3x10^1."""
    figure = ptsmc_jax.simulate(from_tables(untuned(SHORT))).plot("convergence")["convergence"]
    (axes,) = figure.axes
    figure.draw_without_rendering()
    labels = [label.get_text() for label in axes.get_xticklabels(which="both") if label.get_text()]
    assert labels
    assert all(re.fullmatch(r"[\d.]+", label) for label in labels)
