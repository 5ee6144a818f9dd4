"""Limits for a share of the trials: what training calls met must be met on trials that it never saw."""

import itertools
from dataclasses import replace
from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest
from scipy.stats import binom

from ptsmc_jax.campaigns import montecarlo
from ptsmc_jax.simulation.requirements import Requirement, must_keep
from tests import helpers
from tests.search.test_tuning import SPREAD, measure, problem
from tuning.search import confirm, gains, objective, optimise, rounds, shares
from tuning.search.evaluate import Evaluator

SHOWN = Requirement("window_error", 1e-4, None, 0.99, 0.95)
SEEN = Requirement("window_error", 1e-4, None, 0.9, None)


@pytest.mark.parametrize("requirement", [SHOWN, SEEN])
@pytest.mark.parametrize("beyond", [0, 3, 30])
def test_probability_is_the_verdicts_over_shares_that_the_count_allows(requirement, beyond):
    """The share integrated out by brute force: Bayes with a uniform prior on a grid, then the verdict's binomial."""
    share = (np.arange(20_000) + 0.5) / 20_000
    weight = binom.pmf(beyond, 4096, share)
    least = must_keep(1000, requirement.quantile, requirement.confidence)
    assert least is not None
    most = 1000 - least
    expected = np.sum(weight * binom.cdf(most, 1000, share)) / np.sum(weight)
    # the grid's step of 5e-5 beside a share that is known to 2e-4: the midpoint rule leaves some 1e-3 of that
    np.testing.assert_allclose(confirm.probability(requirement, 1000, 4096, beyond), expected, rtol=2e-3)


@pytest.mark.parametrize("requirement", [SHOWN, SEEN, replace(SHOWN, quantile=0.9973, confidence=0.9)])
def test_what_is_allowed_is_the_most_that_is_sure(requirement):
    fresh = confirm.fresh_trials([requirement])
    trials = max(confirm.FEWEST, confirm.TIMES * fresh)
    most = confirm.allowed(requirement, fresh, trials)
    assert most is not None
    assert confirm.probability(requirement, fresh, trials, most) >= confirm.SURE
    assert confirm.probability(requirement, fresh, trials, most + 1) < confirm.SURE
    assert most < (1.0 - requirement.quantile) * trials  # fewer than the share itself: the verdict is a sample


def test_a_limit_on_a_share_is_kept_among_the_training_trials_or_a_band():
    """With 299 trials 99 % at 95 % allows none beyond the limit: a search on them would ask for every one."""
    every = Requirement("peak_torque", 0.5)
    assert confirm.may_break(every, [every], 64) == (None, False)
    assert confirm.may_break(SEEN, [SEEN], 64) == (6, False)  # ceil(0.9 * 64) = 58 keep it
    kept = must_keep(598, 0.99, 0.95)
    assert kept is not None
    assert confirm.may_break(SHOWN, [SHOWN], 598) == (598 - kept, False)
    most = confirm.allowed(SHOWN, 1000, 8000)
    assert confirm.may_break(SHOWN, [SHOWN], 597) == (most, True)
    assert most is not None
    assert 0 < most < confirm.FARTHER
    loose = replace(SHOWN, quantile=0.9)
    assert confirm.may_break(loose, [loose], 8) == (confirm.FARTHER, True)  # of 8 000 hundreds may


def test_a_band_holds_the_last_that_may_break_the_limit_and_those_next_to_it(monkeypatch):
    """Trial n has the error n: of those counted on, the band begins 16 before the last that may break the limit."""
    loose = replace(SHOWN, quantile=0.9)
    count = confirm.counted_on([loose])
    flown = SimpleNamespace(finished=np.arange(count) != 5)  # one that fails is the farthest beyond

    def fly(numbers, gains):
        flown.metrics = SimpleNamespace(window_error=numbers.astype(float))
        return flown

    monkeypatch.setattr(confirm.flights, "trials", fly)
    some: Any = SimpleNamespace(others=lambda numbers: numbers)
    (found,) = confirm.count(some, [loose], np.zeros(2), 100, 2)
    assert found.allowed is not None
    first = 100 + 2 * count
    order = [first + 5, *range(first + count - 1, first + count // 2, -1)]
    assert found.beyond == count
    assert found.band.tolist() == order[found.allowed - confirm.FARTHER : found.allowed + confirm.NEARER]
    assert found.harder[:8].tolist() == order[found.allowed : found.allowed + 8]


def test_a_band_stands_for_the_training_trials():
    """What is asked of c is what all but the two farthest of the band keep, and of no training trial by itself."""
    wanted = [replace(SHOWN, metric="peak_torque", limit=0.7), Requirement("effort", 5.0)]
    some = problem(peak_torque=0.7)
    banded = objective.problem(
        some.parts, SPREAD, 3, np.arange(8), some.names, wanted, may_break=(2, None), banded=(True, False)
    )
    at = helpers.vector([3.0, 0.7])
    ratios = montecarlo.run(gains.with_gains(some.parts, {"eta": 3.0, "delta": 0.7}), SPREAD, 3, np.arange(11))
    torque, effort = (np.asarray(v) for v in (ratios.metrics.peak_torque / 0.7 - 1, ratios.metrics.effort / 5.0 - 1))
    search = rounds.Rounds(Evaluator(shares.Bounds(some.names, (2.05, 0.2), (6.0, 4.0))), banded, wanted, robust=False)
    before = np.asarray(measure(objective.fewer_trials(search.problem, 8), at)[1])
    np.testing.assert_allclose(before[0, :8], torque[:8], rtol=1e-10)  # at first each training trial must keep it
    assert before[0, 8:].max() == -1.0
    joined = rounds._with_bands(search.problem, {0: np.array([8, 9, 10, 0, 1])})
    after = np.asarray(measure(joined, at)[1])
    band = torque[[8, 9, 10, 0, 1]]
    np.testing.assert_allclose(np.sort(after[0])[-5:], np.sort(np.minimum(band, np.sort(band)[-3])), rtol=1e-10)
    assert np.sort(after[0])[-6] == -1.0
    np.testing.assert_allclose(after[1, :8], effort[:8], rtol=1e-10)


def test_trials_that_are_counted_are_none_that_the_search_has_seen(monkeypatch):
    """Neither those averaged nor those screened, and others each time."""
    some, wanted, seen = problem(peak_torque=0.7), [replace(SHOWN, metric="peak_torque", limit=0.7)], list[range]()
    posed = objective.problem(some.parts, SPREAD, 3, np.arange(8), some.names, wanted, may_break=(2,), banded=(True,))
    limits, at = shares.Bounds(some.names, (2.05, 0.2), (6.0, 4.0)), np.array([3.0, 0.7])
    many = confirm.counted_on(wanted)

    def count(posed, asked, gains, first, turn):
        seen.append(range(first + turn * many, first + (turn + 1) * many))  # see the test of a band
        return [SimpleNamespace(trials=many)]

    def trials(numbers, gains):
        seen.append(range(int(numbers[0]), int(numbers[-1]) + 1))
        return SimpleNamespace(finished=np.ones(numbers.size, bool), metrics=SimpleNamespace(peak_torque=0.0 * numbers))

    monkeypatch.setattr(rounds.confirm, "count", count)
    monkeypatch.setattr(rounds.worst_case.flights, "trials", trials)
    evaluate = Evaluator(limits)
    search = rounds.Rounds(evaluate, posed, wanted, robust=False)
    told: Any = SimpleNamespace(averaged=search.problem.averaged, others=lambda numbers: numbers)
    rounds.worst_case.screen(told, wanted, at)
    for _ in range(2):
        search._count(at)
    seen.append(range(search.problem.averaged))
    ordered = sorted(seen, key=lambda one: one.start)
    assert all(one.stop <= other.start for one, other in itertools.pairwise(ordered))
    assert evaluate.rollouts == 2 * many


def test_too_few_trials_are_never_sure():
    assert confirm.allowed(SHOWN, 1000, 20) is None


@pytest.mark.long
@pytest.mark.parametrize(("quantile", "confidence"), [(0.9, None), (0.99, 0.95)])
def test_a_share_that_training_keeps_is_kept_by_others(monkeypatch, quantile, confidence):
    """Eight easy training trials: gains that keep a limit in all of them break it in more than a tenth of others.

    They show nothing of 99 % with 95 %: a band stands for them.
    """
    helpers.small_search(monkeypatch, fresh=200)
    limits = shares.Bounds(("eta", "delta"), (2.05, 0.2), (6.0, 4.0))
    limit, seed = 0.7, 2  # whose first eight angles lie within 100 degrees; others go up to 140
    wanted = [Requirement("peak_torque", limit, None, quantile, confidence)]
    parts = problem(peak_torque=limit).parts
    allowed, banded = confirm.may_break(wanted[0], wanted, 8)
    some = objective.problem(
        parts, SPREAD, seed, np.arange(8), limits.names, wanted, may_break=(allowed,), banded=(banded,)
    )
    found = optimise.search(Evaluator(limits), some, wanted, np.array([3.0, 0.5]), optimise.Settings(2, 20, 1))
    (last,) = found.counts
    assert last.held
    assert banded or found.rounds >= 1  # the first gains found were not confirmed
    at = gains.with_gains(parts, dict(zip(some.names, found.gains, strict=True)))
    others = montecarlo.run(at, SPREAD, 99, np.arange(2000))
    assert np.mean(others.metrics.peak_torque <= limit) >= quantile
    # what joined must keep this limit, and is let off by no cut
    assert np.asarray(found.problem.counted)[0, 8:].any() == (found.rounds > 0)
    _, c, _ = objective.measure(found.problem, helpers.vector(found.gains))
    assert np.asarray(c)[0].max() <= 0.0
