"""Tests of gradients of the noisy objective, bounds, the search, and the reported gains."""

from dataclasses import replace

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from ptsmc_jax import programs, scenario
from ptsmc_jax.batching import lanes
from ptsmc_jax.campaigns import montecarlo
from ptsmc_jax.dispersions import variation
from ptsmc_jax.dispersions.numbers import RandomNumbers
from ptsmc_jax.observers import nonlinear
from ptsmc_jax.plants import integrator_chain
from ptsmc_jax.signals import disturbances
from ptsmc_jax.simulation import catalogues, clock, rollout
from ptsmc_jax.simulation.requirements import Requirement
from ptsmc_jax.theory import envelopes
from tests import helpers
from tests.helpers import chain_parts, parts, random_turns, vector
from tuning.search import (
    confirm,
    evolution,
    gains,
    hand_overs,
    local_search,
    local_searches,
    normalisation,
    objective,
    optimise,
    rounds,
    simulations,
    starts,
    worst,
)
from tuning.search.evaluate import Evaluator, Measurement, MeasurementWithGradients
from tuning.studies import posing, tune_files

TURNED = random_turns(np.deg2rad(20.0), np.deg2rad(140.0))
SPREAD = variation.Dispersion({"initial_state": RandomNumbers("uniform", vector([20.0, 0.0]))})


@pytest.fixture(autouse=True)
def short_rows(monkeypatch):
    """Simulate 10 trials together, as `small_search` does, also in tests without it."""
    monkeypatch.setattr(simulations, "ROW", 10)


@pytest.fixture(scope="module", params=helpers.short(["chain", "spacecraft"], ["chain"]))
def loss(request):
    """Return two functions of (eta, delta, observer gain, t_f).

    They return ln RMS window error of 6 noisy trials, and its derivative (4,).
    """
    if request.param == "chain":
        model, wave = integrator_chain.chain(2), disturbances.Sinusoid(*(vector([v]) for v in (0.01, 0.1, 0.0, 0.0)))
        observer = nonlinear.NonlinearObserver(model, vector([10.0]), vector(1e-3), vector(0.0))
        run = chain_parts([1.0, 0.0], noise=[2e-5, 1e-6], disturbance=wave, observer=observer)
        run = replace(run, clock=clock.anchored_clock(0.1, 23.0), t_end=vector(23.0))
    else:
        run = parts(20.0, 3.0, 0.5, period=0.1, noise=(2e-5, 1e-6), t_end=23.0)
    drawn = {"chain": SPREAD, "spacecraft": TURNED}[request.param]

    def value(at):
        eta, delta, gain, t_f = at
        moved = gains.with_gains(run, {"eta": eta, "delta": delta, "observer_gain": gain, "t_f": t_f})

        def fly(trial):
            return montecarlo.one(moved, drawn, np.uint32(2), trial)[0].window_error

        return 0.5 * jnp.log(jnp.mean(lanes.vmap(fly)(jnp.arange(6, dtype=jnp.uint32)) ** 2))

    both = jax.jit(jax.jacfwd(lambda at: (value(at),) * 2, has_aux=True))
    return lambda at: both(at)[1], lambda at: both(at)[0]


def central(value, at, k, h):
    """Return the fourth-order central finite difference of `value` along gain k; h: step."""
    steps = np.eye(at.size)[k] * h
    f = [float(value(jnp.asarray(at + n * steps))) for n in (-2, -1, 1, 2)]
    return (f[0] - 8 * f[1] + 8 * f[2] - f[3]) / (12 * h)


def test_gradients_of_the_noisy_loss_agree_with_central_differences(loss):
    value, slope = loss
    rng = np.random.default_rng(11)
    for _ in range(4):
        at = np.array([rng.uniform(2.3, 5.0), rng.uniform(0.3, 2.5), rng.uniform(2.0, 80.0), rng.uniform(18.0, 21.0)])
        exact = np.asarray(slope(jnp.asarray(at)))
        numeric = np.array([central(value, at, k, 1e-4 * at[k]) for k in range(4)])
        np.testing.assert_allclose(exact, numeric, rtol=1e-4, atol=1e-4 * np.abs(exact).max())


@pytest.mark.parametrize("delta", [0.5, 1.0, 2.0])
def test_loss_is_continuous_and_gradient_is_finite_if_delta_is_a_multiple_of_the_period(loss, delta):
    """The derivative equals one of the one-sided derivatives."""
    value, slope = loss
    points = [jnp.asarray([3.2, delta + nudge, 12.0, 20.0]) for nudge in (-1e-7, 0.0, 1e-7)]
    values, slopes = np.array([value(p) for p in points]), np.array([slope(p) for p in points])
    assert np.all(np.isfinite(slopes))
    # continuous: the change of the value is the derivative times the step
    np.testing.assert_allclose(values, values[1], atol=2e-7 * np.abs(slopes).max() + 1e-12)
    # the first period and its noise vanish there, so the derivative equals one of the one-sided derivatives
    sides = [np.abs(slopes[1] - slopes[k]).max() for k in (0, 2)]
    assert min(sides) < 1e-4 * np.abs(slopes).max()
    assert max(sides) < 0.05 * np.abs(slopes).max()


def test_bounds_map_normalised_gains_to_gains_and_back():
    """The scale of delta and of the observer gain is logarithmic. Values beyond a bound are clipped."""
    some = normalisation.Bounds(("eta", "delta", "observer_gain"), (2.05, 0.05, 0.5), (8.0, 5.0, 300.0))
    assert list(some.scale.log) == [False, True, True]
    rng = np.random.default_rng(0)
    for normalised in rng.random((20, 3)):
        gains = np.asarray(some.gains(jnp.asarray(normalised)))
        np.testing.assert_allclose(
            gains, [2.05 + 5.95 * normalised[0], 0.05 * 100 ** normalised[1], 0.5 * 600 ** normalised[2]]
        )
        np.testing.assert_allclose(some.normalise(gains), normalised, rtol=1e-12)
    np.testing.assert_allclose(some.gains(jnp.zeros(3)), some.lower, rtol=1e-14)
    np.testing.assert_allclose(some.gains(jnp.ones(3)), some.upper, rtol=1e-14)
    np.testing.assert_array_equal(some.normalise(np.array([1.0, 9.0, 0.0])), [0.0, 1.0, 0.0])
    assert some.at_bound(np.array([2.051, 0.5, 299.9])) == {"eta": "lower", "observer_gain": "upper"}


def test_a_gain_that_may_be_negative_is_searched_on_a_linear_scale():
    some = normalisation.Bounds(("k", "lead"), (0.1, -1.0), (10.0, 3.0))
    assert list(some.scale.log) == [True, False]
    np.testing.assert_allclose(some.gains(jnp.asarray([0.5, 0.5])), [1.0, 1.0], rtol=1e-14)
    np.testing.assert_allclose(some.normalise(np.array([1.0, 0.0])), [0.5, 0.25], rtol=1e-14)
    assert some.at_bound(np.array([1.0, -1.0])) == {"lead": "lower"}


def test_the_lower_bound_of_sign_width_depends_on_the_observer_gain():
    """K2 is inversely proportional to the observer gain.

    The sampled switching term overshoots if sign_width is at most half of the change of s by K2 in one period.
    """
    tune = {"free": ["eta", "delta", "observer_gain", "k1", "sign_width"]}
    table = {"loop": {"mode": "sampled", "period": 0.05}, "hardware": {"rate_noise": 1e-6}, "tune": tune}
    made = scenario.from_tables(table)
    ready = scenario.study(made)
    some = normalisation.bounds_of_scenario(made, ready.parts)
    for l_gain in (10.0, 100.0):
        moved = gains.with_gains(ready.parts, {"observer_gain": l_gain})
        normalised = some.normalise(np.array([3.0, 0.5, l_gain, 1.0, 1e-9]))
        assert normalised[4] == 0.0
        width = some.gains(jnp.asarray(normalised))[4]
        np.testing.assert_allclose(width, envelopes.smallest_sign_width(moved, 0.05) / 2, rtol=1e-12)
        inside = np.append(normalised[:4], 0.3)
        np.testing.assert_allclose(some.normalise(np.asarray(some.gains(jnp.asarray(inside)))), inside, rtol=1e-9)
    # bounds from the scenario file do not change
    given = scenario.replace(made, tune=tune | {"bounds": {"sign_width": [1e-7, 1e-2]}})
    assert normalisation.bounds_of_scenario(given, ready.parts).jump == 0.0


def test_the_lower_bound_of_sign_width_depends_on_the_slowest_observer_axis():
    """If each axis has its own observer gain, K2 depends on the smallest one."""
    names = ("observer_gain_1", "sign_width", "observer_gain_2")
    some = normalisation.Bounds(names, (5.0, 1e-6, 5.0), (80.0, 1.0, 80.0), jump=0.2)
    for slow in (0, 2):
        normalised = np.where(np.arange(3) == slow, 0.25, 0.75)
        normalised[1] = 0.0
        at = np.asarray(some.gains(jnp.asarray(normalised)))
        np.testing.assert_allclose(np.sort(at), [0.2 / 10.0, 10.0, 40.0], rtol=1e-12)  # shares 0.25, 0.75 of 5 to 80
        np.testing.assert_allclose(some.normalise(at), normalised, atol=1e-12)


def test_reported_gains_are_rounded_within_their_bounds():
    some = normalisation.Bounds(("eta", "k1"), (2.123456789, 0.1), (5.0, 1.23456789))
    found = some.rounded(np.array([2.123456789, 1.23456789]), 6)
    assert found == {"eta": 2.12346, "k1": 1.23456789}
    assert some.rounded(np.array([2.5012345678, 0.1]), 6) == {"eta": 2.50123, "k1": 0.1}
    times = normalisation.Bounds(("delta",), (0.1,), (5.0,))  # the hand-over stays on its sample
    assert times.rounded(np.array([7 * 0.123456789]), 6)["delta"] == pytest.approx(7 * 0.123456789, rel=1e-11)


measure = programs.jit(objective.measure)
WITHIN = normalisation.Bounds(("eta", "delta"), (2.05, 0.2), (6.0, 5.0))
FAR_OFF = dict.fromkeys(("peak_torque", "effort", "window_error"), 1e9)  # limits far out of reach


def problem(count=8, dispersion=SPREAD, may_break=None, **limits):
    """Return a tuning problem of a double integrator, or of the spacecraft if initial attitudes are dispersed.

    count: number of trials. may_break: number of trials that may break the first limit. limits: of metrics; limits that
    are not given are out of reach, so that one program serves all tests.
    """
    if "initial_attitude" not in dispersion.kinds:
        run = chain_parts([25.0, 0.0], 20.0, 3.0, 0.5, period=0.2, noise=[5e-4, 2.5e-5])
    else:
        run = parts(20.0, 3.0, 0.5, period=0.2, noise=(2e-5, 1e-6), t_end=21.0)
    run = replace(run, clock=clock.anchored_clock(0.2, 21.0), t_end=vector(21.0))
    wanted = [Requirement(metric, limit) for metric, limit in (FAR_OFF | limits).items()]
    may_break = None if may_break is None else (may_break, None, None)
    return objective.problem(run, dispersion, 3, np.arange(count), WITHIN.names, wanted, may_break)


def evaluated_at(some, *gains):
    """Return F, c (rows, trials) and the logarithm of the objective at these gains, as `Evaluator` computes them."""
    found = Evaluator(WITHIN).measure(some, WITHIN.normalise(np.asarray(gains))[None])
    return found.f[0], found.c[0], found.value[0]


def test_repeated_trials_are_simulated_and_counted_once():
    """Slots repeat the first trial. The same trial with other random numbers is another trial."""
    once = problem(3)
    last = {name: np.concatenate([v, v[:1], 1.1 * v[:1]]) for name, v in once.coordinates.items()}
    repeated = replace(objective.with_trials(once, np.array([0, 0])), coordinates=last)
    batch, places = repeated.batch.distinct()
    assert (batch.trials.tolist(), places.tolist()) == ([0, 1, 2, 0], [0, 1, 2, 0, 3])
    normalised = WITHIN.normalise(np.asarray([3.1, 0.6]))[None]
    evaluate, alone = Evaluator(WITHIN), Evaluator(WITHIN)
    many, few = (each.measure_with_gradients(some, normalised) for each, some in ((evaluate, repeated), (alone, once)))
    for name in ("c", "c_gradient"):
        values, expected = getattr(many, name), getattr(few, name)
        np.testing.assert_array_equal(values[:, :, :3], expected)
        np.testing.assert_array_equal(values[:, :, 3], values[:, :, 0])
        assert np.any(values[:, :, 4] != values[:, :, 0])
    np.testing.assert_array_equal(evaluate.measure(repeated, normalised).c, many.c)
    assert (evaluate.gradients, evaluate.rollouts, alone.gradients) == (4, 4, 3)


def simulated_at(some, trials, *gains):
    """Return the metrics of these trials of a problem with these gains."""
    return simulations.simulate_trials(some.batch_of(np.asarray(trials)), np.asarray(gains)).metrics


def test_measure_returns_the_rms_of_the_worst_trials_weighted_by_the_torque_and_the_ratios_to_the_limits():
    some = replace(problem(peak_torque=0.7, effort=5.0), tail=3, torque_weight=0.3)
    simulated = simulated_at(some, np.arange(8), 3.0, 0.7)
    error, torque = (np.sqrt(np.mean(np.sort(v)[-3:] ** 2)) for v in (simulated.window_error, simulated.peak_torque))
    for f, c, value in (measure(some, vector([3.0, 0.7])), evaluated_at(some, 3.0, 0.7)):
        np.testing.assert_allclose(np.exp(value), error, rtol=1e-10)
        np.testing.assert_allclose(np.exp(f), error * torque**0.3, rtol=1e-10)
        np.testing.assert_allclose(c[0] + 1, simulated.peak_torque / 0.7, rtol=1e-10)
        np.testing.assert_allclose(c[1] + 1, simulated.effort / 5.0, rtol=1e-10)


@pytest.mark.parametrize(
    ("statistic", "tail", "value"),
    [
        ("rms", None, 10.0**0.5), ("rms", 1, 4.0), ("rms", 2, 10.0**0.5), ("rms", 3, 10.0**0.5),
        ("mean", None, 3.0), ("quantile", 1, 4.0), ("quantile", 2, 2.0),
    ],
)  # fmt: skip
def test_a_statistic_ignores_failed_trials(statistic, tail, value):
    """Two of four trials complete, with the values 2 and 4. A tail can be longer than the completed trials."""
    values = jnp.array([2.0, objective.FAILED, 4.0, objective.FAILED])
    np.testing.assert_allclose(np.exp(objective._log_statistic(values, tail, statistic)), value, rtol=1e-12)


@pytest.mark.parametrize("least", helpers.short([1, 5, 8], [5]))
def test_a_quantile_limit_is_a_limit_on_an_order_statistic(least):
    """The largest c is an order statistic of the averaged trials. Added trials do not count in the quantile."""
    some = problem(may_break=8 - least, peak_torque=0.7, effort=5.0)
    some = objective.with_trials(some, np.arange(8, 11))  # they must keep the limits on every trial
    f, c, _ = evaluated_at(some, 3.0, 0.7)
    simulated = simulated_at(some, np.arange(11), 3.0, 0.7)
    np.testing.assert_allclose(np.exp(f), np.sqrt(np.mean(simulated.window_error[:8] ** 2)), rtol=1e-10)
    expected = np.sort(simulated.peak_torque[:8])[least - 1] / 0.7 - 1
    np.testing.assert_allclose(c[0].max(), expected, rtol=1e-10)
    np.testing.assert_allclose(c[1] + 1, simulated.effort / 5.0, rtol=1e-10)


@programs.jit
def backwards(some, at):
    """Return the gradients of F and of the largest c with respect to the gains (2, gains), in reverse mode."""

    def value(at):
        f, c, _ = objective.measure(some, at)
        return jnp.stack([f, c.max()])

    return jax.jacrev(value)(at)


def test_gradients_of_tail_and_quantile_agree_in_both_modes_and_with_finite_differences():
    some, evaluate = replace(problem(may_break=2, peak_torque=0.7), tail=2), Evaluator(WITHIN)
    at, h = np.array([3.1, 0.73]), 1e-4
    normalised = WITHIN.normalise(at)
    found = evaluate.measure_with_gradients(some, normalised[None])
    last = np.unravel_index(found.c[0].argmax(), found.c[0].shape)
    exact = np.stack([found.f_gradient[0], found.c_gradient[0][last]])
    np.testing.assert_allclose(exact, backwards(some, at) @ jax.jacfwd(WITHIN.gains)(normalised), rtol=1e-9)
    for k in range(2):
        seen = evaluate.measure(some, np.stack([normalised + n * h * np.eye(2)[k] for n in (-2, -1, 1, 2)]))
        for slope, f in zip(exact[:, k], (seen.f, seen.c.reshape(4, -1).max(axis=1)), strict=True):
            numeric = (f[0] - 8 * f[1] + 8 * f[2] - f[3]) / (12 * h)
            np.testing.assert_allclose(slope, numeric, rtol=1e-4, atol=1e-6)


@pytest.mark.long
def test_minimising_the_worst_case_gives_a_smaller_worst_case_than_minimising_the_rms(monkeypatch):
    helpers.small_search(monkeypatch)
    largest = {}
    for tail in (None, 1):
        some = replace(problem(), tail=tail)
        found = optimise.search(Evaluator(WITHIN), some, (), np.array([3.0, 0.5]), optimise.Settings(2, 25, 1))
        f, _, _ = measure(replace(some, tail=1), jnp.asarray(found.gains))
        largest[tail] = float(np.exp(f))
    assert largest[1] <= largest[None] * (1 + 1e-6)


def test_statistic_of_a_scenario_sets_the_tail_and_requirements_set_the_held_out_trials():
    """Of 64 trials the worst 6 are the tail for CVaR at 90 %; the 7th worst is the 90 % quantile."""
    normalised = Requirement("peak_torque", 0.5, None, 0.9, None)
    sure = Requirement("peak_torque", 0.5, None, 0.9973, 0.9)
    assert confirm.held_out_trials([normalised]) == confirm.HELD_OUT
    assert confirm.held_out_trials([normalised, sure]) == 2 * 852
    tables = {"rms": None, "mean": None, "worst": 1, "quantile": 7, "cvar": 6}
    for kind, tail in tables.items():
        table = scenario.from_tables({"tune": {"statistic": kind}}).tune
        assert table is not None
        assert posing._count_tail_trials(table, 64) == tail


NEAR = random_turns(np.pi - 1e-5, np.pi)  # next to the law's singularity
FAR = variation.Dispersion(
    {"initial_state": RandomNumbers("uniform", vector([1e308, 0.0]))}
)  # its square is infinite in double precision


@pytest.mark.parametrize("lost", helpers.short([FAR, NEAR], [FAR]), ids=["far", "near"])
def test_failed_trials_increase_f_and_gradients_stay_finite(lost):
    some = problem(dispersion=lost, peak_torque=0.7)
    evaluate = Evaluator(WITHIN)
    found = evaluate.measure_with_gradients(some, evaluate.bounds.normalise(np.array([3.0, 0.7]))[None])
    np.testing.assert_allclose(found.f, (1 + 8) * np.log(objective.FAILED))
    assert np.all(found.c == objective.FAILED - 1)
    assert np.all(np.isfinite(found.f_gradient))
    assert np.all(np.isfinite(found.c_gradient))


def test_a_large_violation_does_not_count_as_a_failed_trial(monkeypatch):
    """All trials complete. One limit is exceeded more than a thousandfold, and the others are kept."""
    helpers.small_search(monkeypatch)
    monkeypatch.setattr(worst, "SCREENED", 16)
    some, wanted = (
        problem(window_error=1e-9),
        [Requirement(m, v) for m, v in (FAR_OFF | {"window_error": 1e-9}).items()],
    )
    evaluate, settings = Evaluator(WITHIN), optimise.Settings(1, 2, 1)
    found = optimise.search(evaluate, some, wanted, np.array([3.0, 0.5]), settings)
    assert found.worst[2] > local_search.FAILURE_PENALTY
    assert found.worst[:2].max() < 1.0
    np.testing.assert_array_equal(found.worst, found.worst_completed)
    assert list(found.conflict) == ["window_error"]


@pytest.mark.parametrize("count", [1, 2])
def test_a_search_whose_limit_is_out_of_reach_adds_no_trials(monkeypatch, count):
    """Harder trials cannot help. A search from several starting points continues with a global search."""
    helpers.small_search(monkeypatch)
    monkeypatch.setattr(worst, "SCREENED", 16)
    monkeypatch.setattr(rounds.Rounds, "add_harder_trials", lambda *_: pytest.fail("harder"))
    seeds = []

    def search_globally(run, some, count, seed):
        seeds.append((count, seed))

    monkeypatch.setattr(local_searches.LocalSearches, "search_globally", search_globally)
    wanted = [Requirement("window_error", 1e-9)]
    settings = optimise.Settings(count, 2, 1, judged=False)
    found = optimise.search(Evaluator(WITHIN), problem(window_error=1e-9), wanted, np.array([3.0, 0.5]), settings)
    assert found.worst[2] > optimise.HOPELESS
    assert found.rounds == 0
    assert seeds == [(count, 2)] * (count > 1)


@pytest.mark.parametrize("far", [0.5, 1e7])
def test_a_failed_trial_is_worse_than_any_violation(far):
    """At the first of two points, one of two trials fails. At the second point, both violations are larger."""
    c = np.asarray([[[0.4 * far, objective.FAILED - 1.0]], [[far, far]]])
    seen = Measurement(np.zeros((2, 1)), np.asarray([1.0, 2.0]), c, np.zeros(2))
    normalised = np.asarray([[0.2], [0.8]])
    for order in ([0, 1], [1, 0]):
        best = local_search.Best(np.zeros(1), 1, 0.0)
        for k in order:
            best.offer(normalised[k : k + 1], seen.at(k))
        assert best.normalised == normalised[1]
        assert not best.failed
    best.offer(normalised, seen)
    assert best.normalised == normalised[1]


def test_search_agrees_with_a_brute_force_scan(monkeypatch):
    """The scan simulates the trials of the search on a grid of both gains.

    The search ends with a hand-over on a sample and an active limit. Its progress reports, its history and its numbers
    of simulations and gradients are checked too. The search screens 16 other trials for harder ones instead of 4096.
    """
    helpers.small_search(monkeypatch)
    monkeypatch.setattr(worst, "SCREENED", 16)
    monkeypatch.setattr(starts, "CANDIDATES", 64)
    some = problem(peak_torque=1.4)
    wanted = (Requirement("peak_torque", 1.4),)
    seen = []
    evaluate = Evaluator(WITHIN)
    started, settings = np.array([3.0, 0.5]), optimise.Settings(3, 40, 1)
    found = optimise.search(evaluate, some, wanted, started, settings, report=lambda *told: seen.append(told))
    assert found.worst[0] <= 1.0
    assert [step.start for step in found.history] == sorted(step.start for step in found.history)
    assert {step.start for step in found.history} == set(range(3))
    assert sum(told[0] == "searching" for told in seen) == 2 * 3  # three starting points in two stages
    assert not any(np.isinf(told[3:]).any() for told in seen)  # NaN before the first point
    alone = [told for told in seen if told[0].endswith(" local search")]  # one search, so there is nothing to count
    assert {told[:3] for told in alone} == {("first local search", 0, 0), ("last local search", 0, 0)}
    # 64 Sobol points, two screenings of 16 trials, and at least one attempt with other hand-overs
    swept = (evaluate.rollouts - 2 * 16) / len(found.problem.batch.distinct()[0].trials)
    assert 64 < swept <= 64 + local_searches.HAND_OVER_ATTEMPTS * hand_overs.OTHER_HAND_OVERS
    # Upper limit of the gradients. The scenario's gains: half of the steps twice, and one point for active limits. Each
    # starting point: half of the steps twice. The best one: all steps. Then other hand-overs, the final search, two
    # hand-overs on samples, and the reset of eta.
    most = 2 * 20 + 1 + 2 * 3 * 20 + 20 + local_searches.HAND_OVER_ATTEMPTS * 40 + 3 * 40 + 2
    assert evaluate.gradients <= most * found.problem.trials.size
    np.testing.assert_allclose(found.gains[1] / 0.2, np.round(found.gains[1] / 0.2), rtol=1e-9)
    # grid with hand-overs on samples
    grid = np.stack(np.meshgrid(np.linspace(2.1, 4.5, 49), 0.2 * np.arange(1, 26)), axis=-1).reshape(-1, 2)
    scan = evaluate.measure(found.problem, np.asarray([WITHIN.normalise(at) for at in grid]))
    margin = max(found.margins.values())
    best = np.exp(scan.f[scan.largest_c <= -margin].min())  # with the tightened limit
    assert found.value <= best * 1.01
    assert found.worst[0] > 1.0 - 1.5 * margin  # the limit is active
    f, c, _ = evaluated_at(found.problem, *found.gains)
    np.testing.assert_allclose(np.exp(f), found.value, rtol=1e-9)
    assert c.max() <= 0.0


@pytest.mark.parametrize("second", ["better", "worse", "better, then Ctrl-C"])
def test_a_global_search_follows_if_harder_trials_lead_beyond_a_limit(monkeypatch, second):
    """The search with harder trials is made to end at gains that break the limit.

    The global search may find better gains. If it finds worse ones, the search keeps those that it had.
    """
    helpers.small_search(monkeypatch)
    monkeypatch.setattr(worst, "SCREENED", 16)
    some, wanted = problem(peak_torque=1.4), [Requirement("peak_torque", 1.4)]
    evaluate = Evaluator(WITHIN)
    lost = np.array([[1.0, 0.0]])
    seeds = []

    def end_lost(run, harder):
        bad = local_search.Best(lost[0], 1, run._margin)
        bad.offer(lost, evaluate.measure(run.tightened(harder), lost))
        run._update_best(bad, run.tightened(harder), 0, replace_best=True)

    def search_globally(run, harder, starts, seed, original=local_searches.LocalSearches.search_globally):
        seeds.append(seed)
        original(run, harder, starts, seed)

    def search_locally(run, harder, shares, original=local_searches.LocalSearches.search_locally):
        original(run, harder, shares)
        if second == "worse" and seeds:
            run._best.violation = np.inf
        if "Ctrl-C" in second and seeds:
            raise KeyboardInterrupt

    joins = iter([True])  # once, without adding a trial
    monkeypatch.setattr(
        rounds.Rounds, "add_harder_trials", lambda self, *_: next(joins, False) and not vars(self).update(count=1)
    )
    monkeypatch.setattr(local_searches.LocalSearches, "continue_best", end_lost)
    monkeypatch.setattr(local_searches.LocalSearches, "search_globally", search_globally)
    monkeypatch.setattr(local_searches.LocalSearches, "search_locally", search_locally)
    found = optimise.search(evaluate, some, wanted, np.array([3.0, 0.5]), optimise.Settings(2, 10, 1))
    assert seeds == [2]
    assert found.interrupted is ("Ctrl-C" in second)
    assert bool(found.worst[0] <= 1.0) is (second != "worse")
    assert np.array_equal(found.normalised, lost[0]) is (second == "worse")


@pytest.mark.parametrize(
    ("rows", "held"),
    [
        ([(0.0, [3.0, -9.0, 1.0, 2.0])], [1]),
        ([(0.3, [3.0, -9.0, 1.0, 2.0])], [1]),  # violated
        ([(-0.1, [3.0, -9.0, 1.0, 2.0])], []),  # not nearly active
        ([(-0.01, [3.0, -9.0, 1.0, 2.0]), (0.0, [1.0, -7.0, 5.0, 0.0])], [1, 0]),  # the largest c first
        ([(0.0, [0.0, 0.0, 0.0, 0.0])], []),
        ([(0.0, [4.0, 1.0, 0.0, 0.0]), (0.0, [4.0, 1.0, 0.0, 0.0]), (0.0, [1.0, 1.0, 1.0, 9.0])], [0, 1]),
    ],
)
def test_gains_with_the_largest_effect_on_active_limits_are_decisive_except_for_two(rows, held):
    """Decisive gains are constant in the choice of starting points. At least two gains stay free."""
    c = np.array([[[violation - 0.5, violation] for violation, _ in rows]])  # the second of two trials has the larger c
    slope = np.array([[[np.full(4, 1e3), np.asarray(by)] for _, by in rows]])
    seen = MeasurementWithGradients(np.zeros((1, 4)), np.zeros(1), c, np.zeros(1), np.zeros((1, 4)), slope)
    assert starts.find_decisive_gains(seen) == held


def test_a_problem_with_fewer_trials_keeps_added_trials_and_fractions():
    """The fraction of trials that may break a limit, and the fraction in the tail, stay the same."""
    some = replace(problem(may_break=2, peak_torque=0.7, effort=5.0), tail=2)
    some = objective.with_trials(some, np.arange(8, 11))
    fewer = objective.fewer_trials(some, 4)
    assert np.asarray(fewer.trials).tolist() == [0, 1, 2, 3, 8, 9, 10]
    assert (fewer.averaged, fewer.may_break, fewer.tail) == (4, (1, None, None), 1)
    _, c, _ = evaluated_at(fewer, 3.0, 0.7)
    simulated = simulated_at(some, np.r_[:4, 8:11], 3.0, 0.7)
    np.testing.assert_allclose(c[1] + 1, simulated.effort / 5.0, rtol=1e-10)
    np.testing.assert_allclose(c[0].max(), np.sort(simulated.peak_torque[:4])[2] / 0.7 - 1, rtol=1e-10)
    assert objective.fewer_trials(some, 8) is some
    assert objective.fewer_trials(replace(some, may_break=(1,) * 3), 4).may_break[0] == 0


@pytest.mark.parametrize(("width", "free", "with_gradients"), [
    (0.0, ["eta", "delta"], False), (1e-3, ["eta", "delta"], True), (0.0, ["eta", "sign_width"], True),
])  # fmt: skip
def test_only_a_discontinuous_sign_leads_to_a_search_without_gradients(width, free, with_gradients):
    tables = {"loop": {"mode": "sampled"}, "controller": {"sign_width": width}, "tune": {"free": free, "trials": 4}}
    posed = posing.set_up_tuning(scenario.from_tables(tables), 0)
    assert posed.settings.with_gradients == with_gradients
    assert float(posed.problem.parts.controller.sign_width) == width


def test_a_search_without_gradients_finds_the_same_optimum(monkeypatch):
    """Both kinds of search minimise the same objective, for a law with useful gradients."""
    helpers.small_search(monkeypatch)
    monkeypatch.setattr(local_searches, "SOBOL_POINTS", 64)
    monkeypatch.setattr(evolution, "GENERATIONS", 25)
    found, evaluates = {}, {with_gradients: Evaluator(WITHIN) for with_gradients in (True, False)}
    for with_gradients, evaluate in evaluates.items():
        settings = optimise.Settings(3, 40, 1, with_gradients=with_gradients)
        found[with_gradients] = optimise.search(evaluate, problem(), (), np.array([3.0, 0.5]), settings)
    assert evaluates[False].gradients == 0
    np.testing.assert_allclose(found[False].value, found[True].value, rtol=1e-3)


def test_differential_evolution_finds_the_gains_if_no_gradients_are_finite(monkeypatch):
    """An earlier search stopped at the first gains and reported that no gains meet the requirements."""
    helpers.small_search(monkeypatch)
    monkeypatch.setattr(local_searches, "SOBOL_POINTS", 64)

    class WithoutGradients(Evaluator):
        def measure_with_gradients(self, problem, normalised):
            measured = super().measure_with_gradients(problem, normalised)
            return replace(measured, f_gradient=np.full_like(measured.f_gradient, np.nan))

    start = np.array([3.0, 0.5])
    found = optimise.search(WithoutGradients(WITHIN), problem(), (), start, optimise.Settings(3, 40, 1))
    assert not found.with_gradients
    assert found.value < 0.9 * np.exp(evaluated_at(problem(), *start)[2])


def test_statistics_of_a_tuning_count_failed_trials_and_cover_the_others(monkeypatch):
    """A metric whose larger values are better has a minimum and a quantile of 1 % instead of 99 %."""
    trials = simulations.simulate_trials(problem().batch_of(np.arange(8)), np.array([3.0, 0.5]))
    lost = np.array([1, 4, 6])
    trials.status[lost] = rollout.SINGULAR
    for values in trials.metrics.values():
        values[lost] = np.nan
    told = tune_files.statistics(trials, "chain")
    assert told["trials"] == 8
    assert told["counts"]["singular"] == 3
    errors = trials.metrics.window_error[trials.ok]
    np.testing.assert_allclose(told["window_error"]["rms"], np.sqrt(np.mean(errors**2)))
    np.testing.assert_allclose(told["peak_torque"]["max"], trials.metrics.peak_torque[trials.ok].max())
    second, last = np.sort(errors)[-2:]  # the 99 % quantile of five values lies between these
    np.testing.assert_allclose(told["window_error"]["q99"], second + 0.96 * (last - second), rtol=1e-12)
    assert told["window_error"]["median"] == np.sort(errors)[2]
    assert "min" not in told["window_error"]
    monkeypatch.setattr(catalogues, "LARGER_IS_BETTER", ("window_error",))  # as for fractions of time
    told = tune_files.statistics(trials, "chain")
    first, second = np.sort(errors)[:2]
    assert told["window_error"]["min"] == first
    np.testing.assert_allclose(told["window_error"]["q01"], first + 0.04 * (second - first), rtol=1e-12)


def test_the_objective_can_be_t_f_or_another_metric():
    some = problem()
    f, _, value = evaluated_at(replace(some, objective="peak_torque", tail=1), 3.0, 0.7)
    largest = simulated_at(some, np.arange(8), 3.0, 0.7).peak_torque.max()
    np.testing.assert_allclose(np.exp([f, value]), largest, rtol=1e-10)
    rules = replace(some, names=("eta", "t_f"), objective="t_f").rules
    f, _, value = objective.judge(rules, vector([3.0, 19.0]), jnp.ones((8, 5)), jnp.zeros(8, int))
    np.testing.assert_allclose([f, value], np.log(19.0), rtol=1e-15)


@pytest.mark.parametrize("plant", helpers.short(["chain", "spacecraft"], ["chain"]))
def test_shortest_t_f_for_a_torque_limit_agrees_with_theory(plant, monkeypatch):
    """From rest, without noise or disturbance: t_f = eta sqrt(2 max |J n| tan(theta/2) / limit) (theory 3.5).

    A chain of order two has t_f = eta sqrt(|x| / limit), because x'' = -eta^2 x / t_f^2 at t = 0.
    """
    helpers.small_search(monkeypatch)
    eta, limit, theta = 3.0, 0.9, np.deg2rad(100.0)
    if plant == "chain":
        run, moved = chain_parts([30.0, 0.0], 20.0, eta, 1.0, period=0.2), 30.0
    else:
        q = [0.0, 0.0, np.sin(theta / 2), np.cos(theta / 2)]
        run = parts(20.0, eta, 1.0, q=q, period=0.2, t_end=21.0, disturbance=disturbances.Constant(jnp.zeros(3)))
        moved = 2 * 14.0 * np.tan(theta / 2)
    run = replace(run, clock=clock.anchored_clock(0.2, 21.0), t_end=vector(21.0))
    wanted = [Requirement("peak_torque", limit)]
    some = objective.problem(run, variation.Dispersion(), 3, np.arange(1), ("t_f", "delta"), wanted, objective="t_f")
    evaluate = Evaluator(normalisation.Bounds(("t_f", "delta"), (8.0, 0.4), (40.0, 4.0)))
    found = optimise.search(evaluate, some, wanted, np.array([20.0, 1.0]), optimise.Settings(2, 20, 0))
    expected = eta * np.sqrt(moved / limit)
    # the limit is tightened by SURE_MARGIN, which increases t_f by half of it
    np.testing.assert_allclose(found.gains[0], expected * (1 + rounds.SURE_MARGIN / 2), rtol=2e-4)
    np.testing.assert_allclose(found.value, found.gains[0], rtol=1e-9)
    assert found.worst[0] <= 1.0
