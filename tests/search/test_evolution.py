"""Refinement without slopes, against optima known in closed form."""

import numpy as np
import pytest

from ptsmc_jax.simulation.requirements import Requirement
from tests.helpers import parts
from tests.search.test_tuning import TURNED
from tuning.search import evolution, objective
from tuning.search.descent import Best
from tuning.search.descents import Descents
from tuning.search.evaluate import Evaluator, Measured
from tuning.search.shares import Bounds


class Valley(Evaluator):
    """F = x'A x, x a share of the bounds less 0.5, with a'x >= b; no numbers beyond `wall` in the first gain.

    Short of `lost` in it a trial fails that does not count in F.
    """

    def __init__(self, matrix, along=None, least=0.0, wall=1.0, lost=-1.0):
        one = (1.0,) * len(matrix)
        super().__init__(Bounds(("eta", "delta", "observer_gain")[: len(matrix)], one, one))
        self.matrix, self.along, self.least, self.wall, self.lost = matrix, along, least, wall, lost
        self.seen = []

    def fly(self, problem, share):
        x = share - 0.5
        self.seen.append(x)
        f = np.where(x[:, 0] > self.wall, np.nan, np.einsum("pi,ij,pj->p", x, self.matrix, x))
        over = np.zeros(len(share)) - 1.0 if self.along is None else self.least - x @ self.along
        over = np.where(x[:, 0] < self.lost, objective.FAILED - 1.0, over)
        return Measured(share, f, over[:, None, None], f)


def refined(valley, start, seed=3, size=evolution.WIDELY):
    names = valley.bounds.names
    some = objective.problem(parts(20.0, 3.0, 1.0), TURNED, 0, np.arange(1), names, [Requirement("peak_torque", 1.0)])
    share = 0.5 + np.asarray(start)
    best, told = Best(share, 1, 0.0), []
    best.offer(share[None], valley.fly(some, share[None]))
    path = []
    evolution.evolve(valley, some, best, share, seed, lambda *at: told.append(at), path.append, size)
    assert len(path) == len(told)
    return best, told


def narrow(count):
    """Axes from 1 to 1/400 of each other's curvature, turned."""
    turn, _ = np.linalg.qr(np.random.default_rng(7).normal(size=(count, count)))
    return turn @ np.diag(np.geomspace(1.0, 400.0, count)) @ turn.T


@pytest.mark.parametrize("seed", [0, 1, 2])
def test_the_bottom_of_a_narrow_turned_valley_with_a_wall_is_found(seed):
    best, told = refined(Valley(narrow(3), wall=0.2), [-0.35, 0.3, -0.3], seed)
    # it ends where twelve generations have gained less than GAINED: some times that is left
    assert best.f < 5.0 * evolution.GAINED
    assert np.isfinite(best.f)
    assert [done for done, _ in told] == list(range(len(told)))


@pytest.mark.parametrize("seed", [0, 1, 2])
def test_a_limit_is_followed_to_the_optimum_on_it(seed):
    matrix, along, least = narrow(3), np.array([1.0, 0.5, -0.4]), 0.2
    inverse = along @ np.linalg.solve(matrix, along)
    optimum = least**2 / inverse  # at x = A^-1 a b / (a' A^-1 a)
    best, _ = refined(Valley(matrix, along, least), [0.35, 0.3, -0.3], seed)
    assert best.over == 0.0
    assert optimum - 2.0 * (2.0 * least / inverse) * 1e-4 <= best.f  # SLACK beyond the limit is allowed
    assert best.f <= optimum + 5.0 * evolution.GAINED


def test_what_evolution_sets_out_from_is_the_first_of_the_history():
    """All that there is to tell where it is interrupted then."""
    valley = Valley(np.eye(2))
    names = valley.bounds.names
    valley.bounds = Bounds(names, (1.0, 1.0), (2.0, 2.0))
    some = objective.problem(parts(20.0, 3.0, 1.0), TURNED, 0, np.arange(1), names, [Requirement("peak_torque", 1.0)])
    search = Descents(valley, 0.0, 4, np.random.default_rng(0))
    search.sweep(some, np.full(2, 1.9))
    (first,) = search.history
    assert first.value == search.best.value
    assert search.best.f < 0.01  # of 512 points spread over the square


@pytest.mark.parametrize("seed", [0, 1, 2])
def test_gains_with_a_trial_that_fails_lead_nowhere(seed):
    """F falls on where one that is no part of it fails."""
    best, _ = refined(Valley(np.eye(2), lost=0.2), [0.4, 0.1], seed)
    assert not best.failed
    assert 0.2**2 <= best.f <= 0.2**2 + 5.0 * evolution.GAINED


def test_a_single_gain_is_refined_too():
    best, _ = refined(Valley(np.array([[4.0]])), [0.4])
    assert best.f < 1e-6


def test_it_ends_early_where_nothing_is_gained():
    _, told = refined(Valley(np.zeros((2, 2))), [0.1, 0.1])
    assert len(told) <= evolution.PATIENCE + 1


@pytest.mark.parametrize("size", [evolution.NEARBY, evolution.WIDELY])
def test_first_points_are_around_the_start_or_in_the_whole_box(size):
    valley = Valley(np.eye(2))
    refined(valley, [0.1, -0.2], size=size)
    first = valley.seen[1]  # after the start itself
    assert first.shape == (size[0], 2)
    np.testing.assert_allclose(first[0], [0.1, -0.2])
    if size is evolution.NEARBY:
        np.testing.assert_allclose(first.mean(axis=0), [0.1, -0.2], atol=5.0 * size[1] / np.sqrt(len(first)))
        assert np.all(np.abs(first.std(axis=0) / size[1] - 1.0) < 0.3)
    else:
        np.testing.assert_allclose(first.mean(axis=0), 0.0, atol=0.02)


def test_where_nothing_keeps_the_limit_it_goes_on_toward_it():
    best, told = refined(Valley(np.eye(2), np.array([1.0, 1.0]), least=3.0), [-0.3, -0.3])
    assert len(told) == evolution.GENERATIONS
    assert best.over < 2.01  # x is 0.5 at most


def test_nothing_but_failures_keeps_the_start():
    best, _ = refined(Valley(np.eye(2), wall=-1.0), [0.1, 0.2])
    assert not np.isfinite(best.f)
    np.testing.assert_allclose(best.share, [0.6, 0.7])


def test_of_many_points_one_that_keeps_the_limits_is_better_than_one_of_a_better_goal():
    share, f, over = np.asarray([[0.2], [0.7]]), np.asarray([1.0, 2.0]), np.asarray([0.5, -0.1])
    best = Best(np.zeros(1), 1, 0.0)
    best.offer(share, Measured(share, f, over[:, None, None], f))
    assert (best.share[0], best.f, best.over) == (0.7, 2.0, 0.0)
