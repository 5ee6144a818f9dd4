"""The width of the smooth sign that training flies: as wide as the exact one allows."""

from dataclasses import replace

import numpy as np
import pytest

from ptsmc_jax import clock, dispersions
from ptsmc_jax.requirements import Requirement
from tests.helpers import parts, vector
from tuning import objective, smoothing
from tuning.bounds import Bounds
from tuning.evaluate import Evaluator

SPREAD = dispersions.Dispersion(dispersions.AxisAngle(vector(np.deg2rad(20.0)), vector(np.deg2rad(140.0))))
BOUNDS = Bounds(("eta", "delta", "observer_gain"), (2.1, 0.2, 0.5), (4.0, 3.0, 20.0))
OWN = np.array([3.0, 0.5, 10.0])


def posed(**others):
    run = parts(20.0, 3.0, 0.5, period=0.1, noise=(2e-5, 1e-6), t_end=21.0, **others)
    run = replace(run, clock=clock.anchored(0.1, 21.0, 20.0, 4.0))
    return objective.problem(run, SPREAD, 3, np.arange(8), BOUNDS.names, [Requirement("peak_torque", 2.0)])


def test_a_sign_that_switches_nothing_stays_as_wide_as_it_is():
    """With K2 = 0 the law has no switching term, and F no width."""
    problem, chosen = smoothing.narrowed(Evaluator(BOUNDS), posed(rate_bound=0.0), OWN, 0)
    assert chosen == smoothing.Smoothing(1e-3, 1e-3, 0.0, 0.0)
    assert float(problem.parts.controller.sign_width) == 1e-3


@pytest.mark.parametrize("width", [1e-2, 0.0])
def test_a_sign_that_does_the_work_is_narrowed_until_it_does_as_the_exact_one(width):
    evaluate, problem = Evaluator(BOUNDS), posed(sign_width=width)
    narrow, chosen = smoothing.narrowed(evaluate, problem, OWN, 0)
    assert chosen.own == width
    assert chosen.own_difference > smoothing.CLOSE >= chosen.difference
    assert chosen.width < (width or smoothing.WIDEST)
    steps = np.log10((width or smoothing.WIDEST) / chosen.width)
    np.testing.assert_allclose(steps, round(steps), atol=1e-9)  # decades, and not one more than it takes
    wider, exact = (smoothing.with_width(problem, v) for v in (10 * chosen.width, 0.0))
    z = BOUNDS.free(np.array([2.6, 0.3, 0.6]))[None]  # where the observer does little
    values = [float(evaluate.fly(one, z).f[0]) for one in (wider, narrow, exact)]
    assert abs(values[1] - values[2]) < abs(values[0] - values[2])
    assert float(narrow.parts.controller.sign_width) == chosen.width
    # the scenario's own parts are left as they are
    assert float(problem.parts.controller.sign_width) == width
