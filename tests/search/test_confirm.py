"""Tests of quantile requirements: gains must keep them on trials that the search has not used."""

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
from tuning.search import confirm, gains, normalisation, objective, optimise, rounds
from tuning.search.evaluate import Evaluator

SHOWN = Requirement("window_error", 1e-4, None, 0.99, 0.95)
SEEN = Requirement("window_error", 1e-4, None, 0.9, None)


@pytest.mark.parametrize("requirement", [SHOWN, SEEN])
@pytest.mark.parametrize("beyond", [0, 3, 30])
def test_probability_of_a_met_verdict_agrees_with_bayes_rule_on_a_grid(requirement, beyond):
    """The reference integrates over the fraction on a grid, with a uniform prior and the binomial of the verdict."""
    fraction = (np.arange(20_000) + 0.5) / 20_000
    weight = binom.pmf(beyond, 4096, fraction)
    least = must_keep(1000, requirement.quantile, requirement.confidence)
    assert least is not None
    most = 1000 - least
    expected = np.sum(weight * binom.cdf(most, 1000, fraction)) / np.sum(weight)
    # the fraction is known to 2e-4, so the midpoint rule with a step of 5e-5 has a relative error of about 1e-3
    np.testing.assert_allclose(confirm.verdict_probability(requirement, 1000, 4096, beyond), expected, rtol=2e-3)


@pytest.mark.parametrize("requirement", [SHOWN, SEEN, replace(SHOWN, quantile=0.9973, confidence=0.9)])
def test_allowed_violations_are_the_most_with_a_sure_verdict_on_held_out_trials(requirement):
    held_out = confirm.held_out_trials([requirement])
    trials = max(confirm.FEWEST_TRIALS, confirm.FEWEST_RATIO * held_out)
    most = confirm.allowed_violations(requirement, held_out, trials)
    assert most is not None
    assert confirm.verdict_probability(requirement, held_out, trials, most) >= confirm.CONFIDENT
    assert confirm.verdict_probability(requirement, held_out, trials, most + 1) < confirm.CONFIDENT
    assert most < (1.0 - requirement.quantile) * trials  # fewer than the fraction itself, because the verdict is random


def test_a_quantile_limit_applies_to_a_band_if_there_are_too_few_training_trials():
    """99 % of the trials with 95 % confidence allow no violation in 299 trials. A search needs twice as many trials.

    With fewer training trials the limit applies to a band: the confirmation trials that are closest to the limit.
    """
    every = Requirement("peak_torque", 0.5)
    assert confirm.allowed_in_training(every, [every], 64) == (None, False)
    assert confirm.allowed_in_training(SEEN, [SEEN], 64) == (6, False)  # ceil(0.9 * 64) = 58 trials must keep it
    kept = must_keep(598, 0.99, 0.95)
    assert kept is not None
    assert confirm.allowed_in_training(SHOWN, [SHOWN], 598) == (598 - kept, False)
    most = confirm.allowed_violations(SHOWN, 1000, 8000)
    assert confirm.allowed_in_training(SHOWN, [SHOWN], 597) == (most, True)
    assert most is not None
    assert 0 < most < confirm.BAND_MAY_BREAK
    loose = replace(SHOWN, quantile=0.9)
    assert confirm.allowed_in_training(loose, [loose], 8) == (confirm.BAND_MAY_BREAK, True)  # of 8000 trials


def test_a_band_contains_the_trials_ranked_around_the_last_that_may_break_the_limit(monkeypatch):
    """Trial n has the error n. The band begins 16 trials before the last trial that may break the limit."""
    loose = replace(SHOWN, quantile=0.9)
    count = confirm.confirmation_trials([loose])
    simulated = SimpleNamespace(finished=np.arange(count) != 5)  # a failed trial is the worst one

    def fly(numbers, gains):
        simulated.metrics = SimpleNamespace(window_error=numbers.astype(float))
        return simulated

    monkeypatch.setattr(confirm.simulations, "simulate_trials", fly)
    some: Any = SimpleNamespace(batch_of=lambda numbers: numbers)
    (found,) = confirm.count_violations(some, [loose], np.zeros(2), 100, 2)
    assert found.allowed is not None
    first = 100 + 2 * count
    order = [first + 5, *range(first + count - 1, first + count // 2, -1)]
    assert found.violations == count
    assert found.band.tolist() == order[found.allowed - confirm.BAND_MAY_BREAK : found.allowed + confirm.BAND_MUST_KEEP]
    assert found.surplus_violators[:8].tolist() == order[found.allowed : found.allowed + 8]


def test_a_band_replaces_the_training_trials_in_a_quantile_limit():
    """The band has the confirmation trials closest to the limit. All but its two worst trials must keep the limit.

    Single training trials need not keep it.
    """
    wanted = [replace(SHOWN, metric="peak_torque", limit=0.7), Requirement("effort", 5.0)]
    some = problem(peak_torque=0.7)
    banded = objective.problem(
        some.parts, SPREAD, 3, np.arange(8), some.names, wanted, may_break=(2, None), banded=(True, False)
    )
    at = helpers.vector([3.0, 0.7])
    ratios = montecarlo.run(gains.with_gains(some.parts, {"eta": 3.0, "delta": 0.7}), SPREAD, 3, np.arange(11))
    torque, effort = (np.asarray(v) for v in (ratios.metrics.peak_torque / 0.7 - 1, ratios.metrics.effort / 5.0 - 1))
    search = rounds.Rounds(
        Evaluator(normalisation.Bounds(some.names, (2.05, 0.2), (6.0, 4.0))), banded, wanted, robust=False
    )
    before = np.asarray(measure(objective.fewer_trials(search.problem, 8), at)[1])
    np.testing.assert_allclose(before[0, :8], torque[:8], rtol=1e-10)  # before the band joins
    assert before[0, 8:].max() == -1.0
    joined = rounds._with_bands(search.problem, {0: np.array([8, 9, 10, 0, 1])})
    after = np.asarray(measure(joined, at)[1])
    band = torque[[8, 9, 10, 0, 1]]
    np.testing.assert_allclose(np.sort(after[0])[-5:], np.sort(np.minimum(band, np.sort(band)[-3])), rtol=1e-10)
    assert np.sort(after[0])[-6] == -1.0
    np.testing.assert_allclose(after[1, :8], effort[:8], rtol=1e-10)


def test_confirmation_uses_trials_that_the_search_has_not_simulated(monkeypatch):
    """They differ from the averaged and the screened trials, and each count uses new ones."""
    some, wanted, seen = problem(peak_torque=0.7), [replace(SHOWN, metric="peak_torque", limit=0.7)], list[range]()
    posed = objective.problem(some.parts, SPREAD, 3, np.arange(8), some.names, wanted, may_break=(2,), banded=(True,))
    limits, at = normalisation.Bounds(some.names, (2.05, 0.2), (6.0, 4.0)), np.array([3.0, 0.7])
    many = confirm.confirmation_trials(wanted)

    def count(posed, asked, gains, first, turn):
        seen.append(range(first + turn * many, first + (turn + 1) * many))  # as in `confirm.count_violations`
        return [SimpleNamespace(trials=many)]

    def trials(numbers, gains):
        seen.append(range(int(numbers[0]), int(numbers[-1]) + 1))
        return SimpleNamespace(finished=np.ones(numbers.size, bool), metrics=SimpleNamespace(peak_torque=0.0 * numbers))

    monkeypatch.setattr(rounds.confirm, "count_violations", count)
    monkeypatch.setattr(rounds.worst_case.simulations, "simulate_trials", trials)
    evaluate = Evaluator(limits)
    search = rounds.Rounds(evaluate, posed, wanted, robust=False)
    told: Any = SimpleNamespace(averaged=search.problem.averaged, batch_of=lambda numbers: numbers)
    rounds.worst_case.screen(told, wanted, at)
    for _ in range(2):
        search._count_violations(at)
    seen.append(range(search.problem.averaged))
    ordered = sorted(seen, key=lambda one: one.start)
    assert all(one.stop <= other.start for one, other in itertools.pairwise(ordered))
    assert evaluate.rollouts == 2 * many


def test_too_few_trials_cannot_confirm_a_requirement():
    assert confirm.allowed_violations(SHOWN, 1000, 20) is None


@pytest.mark.long
@pytest.mark.parametrize(("quantile", "confidence"), [(0.9, None), (0.99, 0.95)])
def test_gains_keep_a_quantile_limit_on_held_out_trials(monkeypatch, quantile, confidence):
    """The eight training trials are easy: gains that keep a limit in them break it in more than 10 % of other trials.

    Eight trials cannot represent a quantile of 99 % with 95 % confidence, so a band replaces them.
    """
    helpers.small_search(monkeypatch, held_out=200)
    limits = normalisation.Bounds(("eta", "delta"), (2.05, 0.2), (6.0, 4.0))
    limit, seed = 0.7, 2  # with this seed, the first eight trials are easy
    wanted = [Requirement("peak_torque", limit, None, quantile, confidence)]
    parts = problem(peak_torque=limit).parts
    allowed, banded = confirm.allowed_in_training(wanted[0], wanted, 8)
    some = objective.problem(
        parts, SPREAD, seed, np.arange(8), limits.names, wanted, may_break=(allowed,), banded=(banded,)
    )
    found = optimise.search(Evaluator(limits), some, wanted, np.array([3.0, 0.5]), optimise.Settings(2, 20, 1))
    (last,) = found.counts
    assert last.confirmed
    assert banded or found.rounds >= 1  # the gains of the first search were not confirmed
    at = gains.with_gains(parts, dict(zip(some.names, found.gains, strict=True)))
    others = montecarlo.run(at, SPREAD, 99, np.arange(2000))
    assert np.mean(others.metrics.peak_torque <= limit) >= quantile
    # each trial that joined must keep this limit by itself
    assert np.asarray(found.problem.counted)[0, 8:].any() == (found.rounds > 0)
    _, c, _ = objective.measure(found.problem, helpers.vector(found.gains))
    assert np.asarray(c)[0].max() <= 0.0
