"""Tests of the worst case within the dispersions against closed forms."""

from dataclasses import replace

import jax
import numpy as np
import pytest

from ptsmc_jax.campaigns import montecarlo
from ptsmc_jax.dispersions import numbers, variation
from ptsmc_jax.dispersions.numbers import RandomNumbers
from ptsmc_jax.signals import disturbances
from ptsmc_jax.simulation import clock, pointing
from ptsmc_jax.simulation.requirements import Requirement
from tests.helpers import chain_parts, parts, random_turns, short, small_search, vector
from tuning.search import objective, optimise, rounds, simulations, worst
from tuning.search.evaluate import Evaluator
from tuning.search.normalisation import Bounds

T_F, ETA = 20.0, 3.0
LIMIT = 0.5


FAR = dict.fromkeys(("peak_torque", "peak_rate", "effort", "settling_time"), 1e9)  # limits far out of reach


def posed(dispersion, requirement=None, settling_angle=4.0, **others):
    """Return a problem without noise or disturbance, from rest to the identity attitude, and its requirements.

    All limits of `FAR` are added, so that the tests share programs. By default, the run counts as settled from the
    start.
    """
    run = parts(T_F, ETA, 1.0, period=0.2, t_end=21.0, disturbance=sine(0.0), **others)
    run = replace(run, clock=clock.anchored_clock(0.2, 21.0), settling_angle=vector(settling_angle))
    asked = requirement or Requirement("peak_torque", LIMIT)
    wanted = [asked if asked.metric == name else Requirement(name, limit) for name, limit in FAR.items()]
    wanted += [asked] if asked.metric not in FAR else []
    return objective.problem(run, dispersion, 5, np.arange(8), ("eta", "delta"), wanted), wanted


def sine(amplitude):
    """Return a sinusoidal disturbance torque with this amplitude [N m] on each axis."""
    zero = [0.0] * 3
    return disturbances.Sinusoid(*(vector(v) for v in ([amplitude] * 3, [0.1] * 3, zero, zero)))


def first_torque(inertia, theta, eta=ETA):
    """Return the largest torque at t = 0 from rest, by theory.md 3.3.

    The torque is 2 eta^2 max |J n| tan(theta/2) / t_f^2; the maximum is over components and axes n. inertia: J (3, 3).
    theta: initial angle [rad].
    """
    return 2 * eta**2 * np.linalg.norm(inertia, axis=1).max() * np.tan(theta / 2) / T_F**2


def test_a_search_computes_only_the_pointing_metrics_that_its_problem_needs():
    observed = pointing.Pointing(vector(*pointing.boresight_frame([0.0, 0.0, 1.0])), vector(0.1), vector(0.4))
    spread = random_turns(0.1, 2.0)
    problem, _ = posed(spread, Requirement("ape_z", 1e-3))
    problem = replace(problem, parts=replace(problem.parts, pointing=observed))
    gains = np.array([ETA, 1.0])
    found = simulations.simulate_trials(problem.batch_of(np.arange(8)), gains).metrics
    every = montecarlo.run(problem.parts, spread, 5, np.arange(8)).metrics
    np.testing.assert_allclose(found.ape_z, every.ape_z, rtol=1e-12)
    np.testing.assert_allclose(found.hold_error, every.hold_error, rtol=1e-12)
    assert np.all(np.isnan(found.rpe_z) & np.isfinite(every.rpe_z))


@pytest.fixture(autouse=True)
def few_screened(monkeypatch):
    """Screen 64 trials for the worst case, and simulate 10 trials together."""
    monkeypatch.setattr(worst, "SCREENED", 64)
    monkeypatch.setattr(simulations, "ROW", 10)


@pytest.mark.long  # shorter tests below cover the ascent for a chain, and gradients of attitudes
@pytest.mark.parametrize("inertia", [(10.0, 12.0, 14.0), ((11.0, 1.5, -0.7), (1.5, 9.0, 0.4), (-0.7, 0.4, 14.0))])
def test_the_worst_attitude_agrees_with_theory(inertia):
    """For torque component i, |(J n)_i| is largest along row i of J. The worst axis is along the longest row."""
    smallest, largest = np.deg2rad(20.0), np.deg2rad(140.0)
    spread = random_turns(smallest, largest)
    problem, wanted = posed(spread, inertia=inertia)
    found = worst.find_hardest(problem, wanted, np.array([ETA, 1.0]))
    tensor = np.diag(inertia) if np.ndim(inertia) == 1 else np.asarray(inertia)
    expected = first_torque(tensor, largest) / LIMIT
    # the error of a maximum is of second order in the last steps of 1e-2
    np.testing.assert_allclose(found.ratio, expected, rtol=2e-3)
    assert found.ratio <= expected * (1 + 1e-9)
    assert found.screened < found.ratio
    assert not found.unbounded
    row = tensor[np.argmax(np.linalg.norm(tensor, axis=1))]
    q = np.asarray([found.start[f"initial_q{k}"] for k in range(1, 5)])
    np.testing.assert_allclose(2 * np.arccos(abs(q[3])), largest, rtol=1e-3)
    axis = q[:3] / np.linalg.norm(q[:3])
    assert abs(axis @ row) / np.linalg.norm(row) > 0.999
    assert found.moved == ("initial_attitude",)


def test_random_attitudes_are_differentiable_with_respect_to_their_coordinates():
    """The derivatives by the variables of the ascent agree with finite differences, also at the largest angle."""
    name, spread, step = "initial_attitude", random_turns(0.4, 2.0), 1e-6
    problem, _ = posed(spread)
    y = np.array([[0.3, 0.6, 0.2], [0.7, 0.9, 1.0]])

    def moved(y):
        return worst._to_coordinates(spread, {name: y}, y, (name,))

    def turns(y):
        drawn = [spread.at(problem.parts, {name: one}).initial.q for one in moved(y)[0][name]]
        return np.stack(drawn)

    c, by = moved(y)
    np.testing.assert_allclose(worst._to_variables(problem, name, c[name]), y, rtol=1e-7)
    for k, to in enumerate(step * np.eye(3)):
        along = [
            jax.jvp(lambda c: spread.at(problem.parts, {name: c}).initial.q, (one,), (each[k],))[1]
            for one, each in zip(c[name], by[name], strict=True)
        ]
        np.testing.assert_allclose(along, (turns(y + to) - turns(y - to)) / (2.0 * step), rtol=1e-6, atol=1e-8)
    longest = 2.0 * np.arccos(np.abs(turns(y)[1, 3]))
    np.testing.assert_allclose(longest, 2.0, rtol=1e-12)


EDGE = 0.02  # largest actuator scale factor error


def swinging(x0, std, amplitude, settling_angle=1e9, **limits):
    """Return a problem of a chain with dispersions, and its requirements.

    The dispersions are the initial state, the disturbance phase and two hardware errors. The initial state is normal
    about (x0, 0) with the standard deviations `std` (2,). Limits that are not given are out of reach. By default, the
    run counts as settled from the start. amplitude: of the disturbance.
    """
    acting = disturbances.Sinusoid(*(vector([v]) for v in (amplitude, 0.1, 0.0, 0.0)))
    run = chain_parts([x0, 0.0], T_F, ETA, 1.0, period=0.2, disturbance=acting)
    run = replace(run, clock=clock.anchored_clock(0.2, 21.0), t_end=vector(21.0))
    run = replace(run, settling_angle=vector(settling_angle))
    spread = variation.Dispersion({
        "initial_state": RandomNumbers("normal", vector(std)),
        "disturbance_phase": numbers.interval([0.0], [2.0 * np.pi]),
        "actuator_scale": RandomNumbers("uniform", vector([EDGE])),
        "timing_jitter": numbers.interval([0.0], [0.3]),
    })  # fmt: skip
    asked = dict.fromkeys(("peak_rate", "effort", "peak_torque_delivered", "settling_time"), 1e9) | limits
    wanted = [Requirement(metric, limit) for metric, limit in asked.items()]
    return objective.problem(run, spread, 5, np.arange(8), ("eta", "delta"), wanted), wanted


def test_worst_case_of_normal_dispersions_is_on_a_sphere_of_high_probability():
    from scipy.stats import chi2

    problem, wanted = swinging(0.0, [1e-9, 1e-3], 0.0, peak_rate=0.05)
    found = worst.find_hardest(problem, wanted, np.array([ETA, 1.0]))
    size = np.linalg.norm(found.coordinates["initial_state"])
    np.testing.assert_allclose(size, np.sqrt(chi2.ppf(worst.PROBABILITY, 2)), rtol=1e-8)  # on the surface of the ball
    # the first number has a millionth of the effect of the second one, and a corresponding part of the radius
    np.testing.assert_allclose(abs(found.start["initial_x2"]), 1e-3 * size, rtol=1e-8)
    np.testing.assert_allclose(found.ratio, 1e-3 * size / 0.05, rtol=1e-8)  # the initial rate is the peak rate


def test_search_for_the_worst_case_keeps_normal_numbers_inside_their_ball():
    """Gradients are cut off at the surface of the ball. Uniform numbers do not change.

    With a gradient, the normal numbers move to the point of the sphere in its direction.
    """
    y, normal = np.array([[9.0, 0.6, 0.8], [9.0, 3.0, 4.0]]), [(slice(1, 3), 2.0)]
    inside = worst._move_into_balls(y, normal)
    np.testing.assert_allclose(inside, [y[0], [9.0, 1.2, 1.6]], rtol=1e-8)
    assert np.linalg.norm(inside[1, 1:]) < 2.0
    turned = worst._move_into_balls(y, normal, np.array([[5.0, 3.0, -4.0], [5.0, 0.0, 0.0]]))
    np.testing.assert_allclose(turned, [[9.0, 1.2, -1.6], [9.0, 1.2, 1.6]], rtol=1e-8)  # zero gradient: no change
    assert np.all(np.linalg.norm(turned[:, 1:], axis=1) < 2.0)
    assert y[1, 1] == 3.0


def test_the_worst_actuator_scale_is_found_by_gradients():
    """The first delivered torque of a chain is eta^2 x / t_f^2 times the scale factor. Jitter has no effect on it."""
    limit = 0.01
    problem, wanted = swinging(1.0, [0.0, 0.0], 0.0, peak_torque_delivered=limit)
    found = worst.find_hardest(problem, wanted, np.array([ETA, 1.0]))
    assert set(found.moved) == set(problem.dispersion.kinds)
    np.testing.assert_allclose(found.ratio, (1.0 + EDGE) * ETA**2 / T_F**2 / limit, rtol=1e-6)
    assert found.screened < found.ratio
    np.testing.assert_allclose(found.start["actuator_scale_1"], 1.0 + EDGE, rtol=1e-6)


MOVED = ["attitudes", "normal starts, a phase and misfits"]


@pytest.mark.parametrize("what", short(MOVED, MOVED[1:]))
def test_gradients_of_the_search_for_the_worst_case_agree_with_finite_differences(what):
    if what == "attitudes":
        problem, _ = posed(random_turns(0.4, 2.0))
        limits = {"peak_torque": 0.5, "effort": 3.0}
    else:
        limits = {"effort": 3.0, "peak_rate": 0.05}
        problem, _ = swinging(0.0, [1.0, 0.1], 0.01, **limits)
    batch = problem.batch_of(np.arange(4, 7))
    y = np.concatenate([worst._to_variables(problem, name, v) for name, v in batch.coordinates.items()], axis=1)
    at = np.array([ETA, 1.0])

    def ratio_with_gradient(y):
        return worst.ratio_with_gradient(batch, at, y, objective.needed_metrics(problem), limits)

    slope = ratio_with_gradient(y)[1]
    assert slope.shape == y.shape == (3, 3 if what == "attitudes" else 5)
    assert np.all(np.abs(slope).max(axis=0) > 0.0) or what == "attitudes"
    for k, step in enumerate(1e-5 * np.eye(y.shape[1])):
        numeric = (ratio_with_gradient(y + step)[0] - ratio_with_gradient(y - step)[0]) / 2e-5
        np.testing.assert_allclose(slope[:, k], numeric, rtol=1e-5, atol=1e-6 * np.abs(slope).max())


@pytest.mark.parametrize("plant", short(["chain", "spacecraft"], ["chain"]))
def test_a_robust_search_keeps_the_limit_in_the_worst_case(monkeypatch, plant):
    """The expected eta just keeps the limit at the worst attitude (140 deg), or at the largest scale factor error."""
    steps = worst.STEPS
    small_search(monkeypatch)
    monkeypatch.setattr(worst, "STEPS", steps)  # all steps, because the ascent finds the worst case
    if plant == "spacecraft":
        largest, limit = np.deg2rad(140.0), 1.9
        spread = random_turns(np.deg2rad(20.0), largest)
        problem, wanted = posed(spread, Requirement("peak_torque", limit))
        eta = np.sqrt(limit / first_torque(np.diag([10.0, 12.0, 14.0]), largest, 1.0))
    else:
        limit = 0.04
        problem, wanted = swinging(1.0, [0.0, 0.0], 0.0, peak_torque_delivered=limit)
        eta = np.sqrt(limit / (1.0 + EDGE)) * T_F
    evaluate = Evaluator(Bounds(("eta", "delta"), (2.5, 0.3), (6.0, 4.0)))
    robust, plain = (
        optimise.search(evaluate, problem, wanted, np.array([3.0, 1.0]), optimise.Settings(2, 20, 0, robust=robust))
        for robust in (True, False)
    )
    assert robust.hardest is not None
    assert plain.hardest is not None
    assert robust.hardest.ratio <= 1.0 + worst.LIMIT_TOLERANCE
    assert robust.gains[0] <= eta * (1 + worst.LIMIT_TOLERANCE)
    np.testing.assert_allclose(robust.gains[0], eta, rtol=0.01)  # it loses only the margin
    np.testing.assert_allclose(plain.hardest.ratio, (plain.gains[0] / eta) ** 2, rtol=5e-3)


@pytest.mark.parametrize(
    ("quantile", "options"),
    [(0.9, {"robust": True}), (None, {"margins": {"peak_rate": 0.3}})],
    ids=["robust", "broken"],
)
def test_a_limit_keeps_the_default_margin_if_only_others_are_robust_or_were_broken(monkeypatch, quantile, options):
    """A quantile limit does not depend on a single trial, so the option `robust` has no effect."""
    problem, wanted = swinging(1.0, [0.2, 0.1], 0.01)
    wanted = [replace(one, quantile=quantile) for one in wanted]
    small_search(monkeypatch)
    evaluate = Evaluator(Bounds(("eta", "delta"), (2.5, 0.3), (6.0, 4.0)))
    found = optimise.search(evaluate, problem, wanted, np.array([3.0, 1.0]), optimise.Settings(1, 1, 0, **options))
    assert found.margins == {**dict.fromkeys(problem.rows, rounds.MARGIN), **options.get("margins", {})}
    kept = np.asarray([*found.margins.values()])
    np.testing.assert_allclose(problem.tightened(1.0 - kept).limits, problem.limits * (1.0 - kept), rtol=1e-15)


def test_a_trial_with_given_random_numbers_equals_the_trial_that_draws_them():
    """The random numbers of a trial are its coordinates. Trials that join a search may have given coordinates."""
    problem, _ = swinging(1.0, [0.2, 0.1], 0.01, peak_rate=0.05)
    more = objective.with_trials(problem, np.asarray([40]))
    drawn_ones = objective.coordinates_of(problem.dispersion, 5, np.asarray([40]))
    drawn = {name: np.asarray(v)[0].tolist() for name, v in drawn_ones.items()}
    roomy = rounds._add_slots(problem, rounds.SPARE_SLOTS)
    assert roomy.trials.size == 8 + rounds.SPARE_SLOTS
    given = rounds._fill_slots(roomy, np.array([8]), rounds.Joining(np.asarray([7]), np.array([True]), drawn))
    assert roomy.trials[8] == roomy.trials[0]  # the original is not changed
    evaluate = Evaluator(Bounds(problem.names, (2.5, 0.3), (6.0, 4.0)))
    normalised = evaluate.bounds.normalise(np.array([3.2, 0.9]))[None]
    one, other = evaluate.measure(more, normalised), evaluate.measure(given, normalised)
    np.testing.assert_allclose(one.f, other.f, rtol=1e-12)
    np.testing.assert_allclose(other.c[0, 0, 8], one.c[0, 0, 8], rtol=1e-12)
    np.testing.assert_allclose(other.c[0, 0, 9:], one.c[0, 0, 0], rtol=1e-12)


def test_hard_trials_that_join_a_search_fill_free_slots_and_then_replace_the_oldest():
    problem, wanted = posed(random_turns(0.4, 2.0))
    evaluate = Evaluator(Bounds(("eta", "delta"), (2.5, 0.3), (6.0, 4.0)))
    search, joined = rounds.Rounds(evaluate, problem, wanted, robust=False), 0
    for count in (8, 8, 3, 8, 1):
        new = np.arange(200 + joined, 200 + joined + count)
        search._join(rounds.Joining(new, np.array([True])))
        problem, joined = search.problem, joined + count
        # the last 16 trials that joined, in any order, and the first trial in free slots
        kept = [0] * max(0, 16 - joined) + [*range(200, 200 + joined)][-16:]
        assert sorted(np.asarray(problem.trials)[8:].tolist()) == sorted(kept)
        np.testing.assert_array_equal(problem.trials[:8], np.arange(8))
    expected = objective.coordinates_of(problem.dispersion, 5, np.asarray(problem.trials))
    np.testing.assert_array_equal(problem.coordinates["initial_attitude"], expected["initial_attitude"])


def test_a_second_search_of_a_problem_keeps_the_trials_that_joined_in_the_first():
    """Otherwise gains of `ptsmc pareto --against t_f` break a limit: the second search replaced the hardest trials."""
    problem, wanted = posed(random_turns(0.4, 2.0))
    evaluate = Evaluator(Bounds(("eta", "delta"), (2.5, 0.3), (6.0, 4.0)))
    for first in (200, 300):
        search = rounds.Rounds(evaluate, problem, wanted, robust=False)
        search._join(rounds.Joining(first + np.arange(rounds.HARDEST), np.array([True])))
        problem = search.problem
    counted = np.asarray(problem.trials)[np.asarray(problem.counted)[0]]
    assert {*range(200, 200 + rounds.HARDEST), *range(300, 300 + rounds.HARDEST)} <= {*counted.tolist()}


def test_critical_trials_of_several_quantile_limits_are_all_kept():
    """The trials of one limit must not replace the trials of another limit in the same round."""
    problem, wanted = posed(random_turns(0.4, 2.0))
    wanted = [replace(wanted[0], quantile=0.9), replace(wanted[0], metric="effort", quantile=0.9)]
    problem = objective.problem(
        problem.parts, problem.dispersion, 5, np.arange(8), problem.names, wanted, may_break=(0, 0)
    )
    evaluate = Evaluator(Bounds(("eta", "delta"), (2.5, 0.3), (6.0, 4.0)))
    search = rounds.Rounds(evaluate, problem, wanted, robust=False)
    for row, first in enumerate((200, 300)):
        search._join(rounds.Joining(first + np.arange(rounds.HARDEST), np.arange(2) == row))
    trials = np.asarray(search.problem.trials)
    for row, first in enumerate((200, 300)):
        counted = trials[np.asarray(search.problem.counted)[row]]
        assert {*range(first, first + rounds.HARDEST)} <= {*counted.tolist()}


def test_the_hardest_screened_trial_is_the_worst_case_if_nothing_can_be_moved():
    """The true inertia cannot be moved, and neither can noise.

    The screened trials are no training trials, and their results keep the order of the trials.
    """
    body = vector([10.0, 12.0, 14.0]), vector(np.eye(3)), vector(0.05), vector(0.0)
    spread = variation.Dispersion(
        {"initial_attitude": numbers.any_attitude(), "inertia": numbers.RelativeInertia(*body)}
    )
    assert simulations.differentiable_dispersions(spread) == ("initial_attitude",)
    run = chain_parts([1.0, 0.0], T_F, ETA, 1.0, period=0.2, noise=[1e-2, 1e-3])
    run = replace(run, clock=clock.anchored_clock(0.2, 21.0), t_end=vector(21.0))
    wanted = [Requirement("peak_rate", 0.1)]
    problem = objective.problem(run, variation.Dispersion(), 5, np.arange(8), ("eta", "delta"), wanted)
    at = np.array([ETA, 1.0])
    found = worst.find_hardest(problem, wanted, at)
    trials, ratio = worst.screen(problem, wanted, at)
    assert trials[0] == problem.averaged  # no training trial
    assert found.moved == ()
    assert found.trial == trials[np.argmax(ratio)]
    np.testing.assert_allclose([found.ratio, found.screened], ratio.max(), rtol=1e-9)
    assert np.ptp(ratio) > 0.0
    # with more trials than a row, the results keep the order of the trials
    assert trials.size > simulations.ROW
    some = trials[[3, -1, -2]]
    alone = simulations.simulate_trials(problem.batch_of(some), at)
    np.testing.assert_allclose(alone.metrics.peak_rate / 0.1, ratio[[3, -1, -2]], rtol=1e-12)


@pytest.mark.parametrize("plant", short(["chain", "spacecraft"], ["chain"]))
def test_a_trial_without_a_value_of_the_required_metric_is_the_hardest(plant):
    """Trials near the target settle, and trials farther away do not settle before the end."""
    if plant == "spacecraft":
        spread = random_turns(0.01, 2.0)
        problem, wanted = posed(spread, Requirement("settling_time", 19.0), settling_angle=1e-4)
    else:
        problem, wanted = swinging(1.0, [2.0, 0.0], 0.0, settling_angle=1e-4, settling_time=19.0)
    at = np.array([ETA, 1.0])
    _, ratio = worst.screen(problem, wanted, at)
    assert 0 < np.isinf(ratio).sum() < ratio.size
    assert not np.isnan(ratio).any()
    found = worst.find_hardest(problem, wanted, at)
    assert found.status in ("ok", "not_converged")
    assert (found.ratio, found.breaks_limit, found.unbounded) == (np.inf, True, False)
    evaluate = Evaluator(Bounds(problem.names, (2.5, 0.3), (6.0, 4.0)))
    found = evaluate.measure_with_gradients(problem, evaluate.bounds.normalise(at)[None])
    assert all(np.isfinite(v).all() for v in vars(found).values())
    assert (found.c == objective.FAILED - 1.0).any()


def test_the_hardest_trial_is_unbounded_if_it_is_singular_or_diverges():
    """A hardest trial that has not converged is not unbounded. Here the squares of the initial states overflow."""
    problem, wanted = swinging(1.0, [1e160, 0.0], 0.0)
    found = worst.find_hardest(problem, wanted, np.array([ETA, 1.0]))
    assert found.unbounded
    told = {
        status: replace(found, status=status).unbounded for status in ("ok", "not_converged", "singular", "diverged")
    }
    assert told == {"ok": False, "not_converged": False, "singular": True, "diverged": True}
