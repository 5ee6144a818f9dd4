"""Tests of differential evolution against optima in closed form."""

import numpy as np
import pytest

from ptsmc_jax.simulation.requirements import Requirement
from tests.helpers import parts
from tests.search.test_tuning import TURNED
from tuning.search import evolution, objective
from tuning.search.evaluate import Evaluator, Measurement
from tuning.search.local_search import Best
from tuning.search.local_searches import LocalSearches
from tuning.search.normalisation import Bounds


class Quadratic(Evaluator):
    """F = x'A x subject to a'x >= b, with x the normalised gains less 0.5.

    matrix, along, least: A, a and b; without a, there is no limit. F is NaN if the first element of x exceeds `wall`.
    If it is below `lost`, a trial fails that does not count in F.
    """

    def __init__(self, matrix, along=None, least=0.0, wall=1.0, lost=-1.0):
        one = (1.0,) * len(matrix)
        super().__init__(Bounds(("eta", "delta", "observer_gain")[: len(matrix)], one, one))
        self.matrix, self.along, self.least, self.wall, self.lost = matrix, along, least, wall, lost
        self.seen = []

    def measure(self, problem, normalised):
        """Return the `Measurement` of F and the constraint at normalised gains (points, gains); record x in `seen`."""
        x = normalised - 0.5
        self.seen.append(x)
        f = np.where(x[:, 0] > self.wall, np.nan, np.einsum("pi,ij,pj->p", x, self.matrix, x))
        violation = np.zeros(len(normalised)) - 1.0 if self.along is None else self.least - x @ self.along
        violation = np.where(x[:, 0] < self.lost, objective.FAILED - 1.0, violation)
        return Measurement(normalised, f, violation[:, None, None], f)


def refined(evaluator, start, seed=3, size=evolution.WHOLE_BOX):
    """Run differential evolution from a point x; return the best point and the calls of the progress report.

    size: number of points and their standard deviation (inf: whole box).
    """
    names = evaluator.bounds.names
    some = objective.problem(parts(20.0, 3.0, 1.0), TURNED, 0, np.arange(1), names, [Requirement("peak_torque", 1.0)])
    normalised = 0.5 + np.asarray(start)
    best, told = Best(normalised, 1, 0.0), []
    best.offer(normalised[None], evaluator.measure(some, normalised[None]))
    path = []
    evolution.evolve(evaluator, some, best, normalised, seed, lambda *at: told.append(at), path.append, size)
    assert len(path) == len(told)
    return best, told


def ill_conditioned(count):
    """Return a rotated symmetric matrix (count, count) with eigenvalues from 1 to 400."""
    turn, _ = np.linalg.qr(np.random.default_rng(7).normal(size=(count, count)))
    return turn @ np.diag(np.geomspace(1.0, 400.0, count)) @ turn.T


@pytest.mark.parametrize("seed", [0, 1, 2])
def test_minimum_of_an_ill_conditioned_quadratic_is_found_despite_undefined_values(seed):
    best, told = refined(Quadratic(ill_conditioned(3), wall=0.2), [-0.35, 0.3, -0.3], seed)
    # the search ends if `PATIENCE` generations reduce F by less than `LEAST_DECREASE`, so a few times that can remain
    assert best.f < 5.0 * evolution.LEAST_DECREASE
    assert np.isfinite(best.f)
    assert [done for done, _ in told] == list(range(len(told)))


@pytest.mark.parametrize("seed", [0, 1, 2])
def test_constrained_optimum_on_an_active_limit_is_found(seed):
    matrix, along, least = ill_conditioned(3), np.array([1.0, 0.5, -0.4]), 0.2
    inverse = along @ np.linalg.solve(matrix, along)
    optimum = least**2 / inverse  # at x = A^-1 a b / (a' A^-1 a)
    best, _ = refined(Quadratic(matrix, along, least), [0.35, 0.3, -0.3], seed)
    assert best.violation == 0.0
    assert optimum - 2.0 * (2.0 * least / inverse) * 1e-4 <= best.f  # points may exceed the limit by SLACK
    assert best.f <= optimum + 5.0 * evolution.LEAST_DECREASE


def test_the_first_point_of_the_history_is_the_best_of_the_sobol_points():
    """It is the only result if the search is interrupted then."""
    evaluator = Quadratic(np.eye(2))
    names = evaluator.bounds.names
    evaluator.bounds = Bounds(names, (1.0, 1.0), (2.0, 2.0))
    some = objective.problem(parts(20.0, 3.0, 1.0), TURNED, 0, np.arange(1), names, [Requirement("peak_torque", 1.0)])
    search = LocalSearches(evaluator, 0.0, 4, np.random.default_rng(0))
    search.measure_sobol_points(some, np.full(2, 1.9))
    (first,) = search.history
    assert first.value == search.best.value
    assert search.best.f < 0.01  # of 512 points spread over the square


@pytest.mark.parametrize("seed", [0, 1, 2])
def test_gains_with_a_failed_trial_are_not_accepted(seed):
    """F decreases towards points with a failed trial that does not count in F."""
    best, _ = refined(Quadratic(np.eye(2), lost=0.2), [0.4, 0.1], seed)
    assert not best.failed
    assert 0.2**2 <= best.f <= 0.2**2 + 5.0 * evolution.LEAST_DECREASE


def test_differential_evolution_optimises_a_single_gain():
    best, _ = refined(Quadratic(np.array([[4.0]])), [0.4])
    assert best.f < 1e-6


def test_differential_evolution_ends_early_without_progress():
    _, told = refined(Quadratic(np.zeros((2, 2))), [0.1, 0.1])
    assert len(told) <= evolution.PATIENCE + 1


@pytest.mark.parametrize("size", [evolution.NEAR_BEST, evolution.WHOLE_BOX])
def test_first_generation_is_around_the_starting_point_or_in_the_whole_box(size):
    """The starting point itself is the first point.

    size: number of points and their standard deviation (inf: whole box).
    """
    evaluator = Quadratic(np.eye(2))
    refined(evaluator, [0.1, -0.2], size=size)
    first = evaluator.seen[1]  # after the starting point itself
    assert first.shape == (size[0], 2)
    np.testing.assert_allclose(first[0], [0.1, -0.2])
    if size is evolution.NEAR_BEST:
        np.testing.assert_allclose(first.mean(axis=0), [0.1, -0.2], atol=5.0 * size[1] / np.sqrt(len(first)))
        assert np.all(np.abs(first.std(axis=0) / size[1] - 1.0) < 0.3)
    else:
        np.testing.assert_allclose(first.mean(axis=0), 0.0, atol=0.02)


def test_differential_evolution_approaches_a_limit_that_no_point_can_keep():
    best, told = refined(Quadratic(np.eye(2), np.array([1.0, 1.0]), least=3.0), [-0.3, -0.3])
    assert len(told) == evolution.GENERATIONS
    assert best.violation < 2.01  # x is 0.5 at most


def test_differential_evolution_returns_the_starting_point_if_all_points_fail():
    best, _ = refined(Quadratic(np.eye(2), wall=-1.0), [0.1, 0.2])
    assert not np.isfinite(best.f)
    np.testing.assert_allclose(best.normalised, [0.6, 0.7])


def test_a_feasible_point_is_better_than_an_infeasible_one_with_a_smaller_objective():
    normalised, f, violation = np.asarray([[0.2], [0.7]]), np.asarray([1.0, 2.0]), np.asarray([0.5, -0.1])
    best = Best(np.zeros(1), 1, 0.0)
    best.offer(normalised, Measurement(normalised, f, violation[:, None, None], f))
    assert (best.normalised[0], best.f, best.violation) == (0.7, 2.0, 0.0)
