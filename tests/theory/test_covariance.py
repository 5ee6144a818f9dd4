"""The covariance of the linearised loop, compared with simulated trials."""

from dataclasses import replace
from types import SimpleNamespace
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from ptsmc_jax import scenario
from ptsmc_jax.campaigns import montecarlo
from ptsmc_jax.devices.sensors import PerfectSensors
from ptsmc_jax.devices.ticks import Ticks
from ptsmc_jax.simulation import rollout
from ptsmc_jax.theory import covariance, linear
from tests.helpers import FIRST_FLIGHT
from tests.helpers import parts as a_body
from tests.theory.loops import ALL_AT_ONCE

FILTER = {"filter": {"kind": "steady_state", "bandwidth": 0.1}}
# no disturbance, and a small error without noise at t_f, so that noise dominates the error
QUIET = {"controller__delta": 1.0, "controller__eta": 4.0, "loop__clock": "flight", "disturbance": {"kind": "none"}}
CASES = {
    "slow observer": {},
    "another period": {"loop__period": 0.1},
    "narrow sign": {"observer__gain": [100.0] * 3, "controller__k1": 5.0, "controller__sign_width": 1e-6},
    "exact sign": {"observer__gain": [30.0] * 3, "controller__sign_width": 0.0},
    "delay": {"hardware__delay": 2},
    "filter": {**FILTER, "controller__delta": 0.5},  # with delta = 1 s the noise-free error would exceed the noise
    "filter, slow star tracker, lag": {**FILTER, "hardware__torque_lag": 0.1, "hardware__star_tracker_every": 4},
    "filter, bias": {**FILTER, "hardware__rate_bias": 1e-5, "hardware__rate_bias_walk": 1e-6},
    "filter, slow star tracker, wheels, lag": {
        **FILTER, "hardware__torque_lag": 0.1, "hardware__star_tracker_every": 4,
        "wheels": {"momentum": [0.5, 0.2, -0.1, 0.3]},
    },
    "wheels, lag": {"hardware__torque_lag": 0.1, "wheels": {"momentum": [0.5, 0.2, -0.1, 0.3]}},
    "delay, random walk": {"hardware__delay": 2, "disturbance": {"kind": "random_walk", "density": [3e-4] * 3}},
    "random walk": {"disturbance": {"kind": "random_walk", "density": [1e-3] * 3}},
}  # fmt: skip
NOISES = {"attitude_noise": 1e-13, "rate_noise": 1e-13, "rate_bias": 1e-16, "rate_bias_walk": 1e-16}


SHORT = ("filter, slow star tracker, wheels, lag",)
# for a small slew 15 s are sufficient
NEAR = {
    "dispersion": {"attitude": {"kind": "axis_angle", "min_deg": 0.1, "max_deg": 0.5}},
    "controller__t_f": 15.0, "loop__t_end": 18.0,
}  # fmt: skip


@pytest.mark.long  # short tests: test_spillover.py (noise, random walk) and below (delay, filter steady state)
@pytest.mark.parametrize(
    ("case", "trials", "start"),
    [(case, 500, NEAR) for case in SHORT] + [(case, 2000, {}) for case in CASES],
)
def test_covariance_predicts_the_error_of_simulated_trials(case, trials, start):
    """The sampling error of 500 trials is at most 3 %. The rest of the tolerance is for nonlinear effects.

    The test subtracts the error of the same trials without noise.
    """
    noisy = scenario.replace(scenario.read(FIRST_FLIGHT), tune=None, **{**QUIET, **CASES[case], **start})
    given = {f"hardware__{k}": v for k, v in NOISES.items() if getattr(noisy.hardware, k)}
    walk = noisy.disturbance.kind == "random_walk"  # tiny noise instead of none, so that the compiled program is reused
    quiet = {"kind": "random_walk", "density": [1e-16] * 3} if walk else {"kind": "none"}
    still = scenario.replace(noisy, **given, disturbance=quiet)
    rms = []
    for one in (noisy, still):
        ready = scenario.study(one)
        simulated = montecarlo.run(ready.parts, ready.dispersion, 0, np.arange(trials))
        assert np.all(simulated.finished)
        rms.append(float(np.sqrt(np.mean(simulated.metrics.window_error**2))))
    share = np.sqrt(rms[0] ** 2 - rms[1] ** 2)
    assert share > 0.4 * rms[0]  # noise is a large part of the error
    np.testing.assert_allclose(covariance.propagate_noise(scenario.study(noisy).parts).window_error, share, rtol=0.1)


def simulated_chain(**changes):
    """Return the parts of a chain of order 2 at rest on its target, and the RMS window error of 2 000 trials.

    changes: tables of the scenario; `loop` is required, with at most 40 periods.
    """
    tables = {
        "plant": {"kind": "chain", "x0": [0.0, 0.0]},
        "loop": {"mode": "sampled", "clock": "flight", **changes.pop("loop")},
        **changes,
    }
    parts = scenario.study(scenario.from_tables(tables)).parts
    parts = replace(parts, clock=replace(parts.clock, count=40))
    each = [_fly(parts, np.arange(200, dtype=np.uint32) + np.uint32(200 * k)) for k in range(10)]
    errors = np.concatenate([one.metrics.window_error for one in each])
    return parts, float(np.sqrt(np.mean(errors**2)))


_fly = jax.jit(jax.vmap(lambda parts, k: rollout.simulate(parts, np.uint32(1), k), (None, 0)))


@pytest.mark.parametrize(("rounds", "converged"), [(1, False), (covariance.ROUNDS, True)])
def test_noise_reports_whether_the_statistical_linearisation_converged(monkeypatch, rounds, converged):
    """The noise of s equals about the width of the sign, so that one iteration is not enough."""
    tables = {
        "plant": {"kind": "chain", "x0": [0.0, 0.0]},
        "controller": {"t_f": 4.0, "delta": 2.0, "k1": 0.5, "sign_width": 1e-3},
        "disturbance": {"kind": "none"},
        "loop": {"mode": "sampled", "clock": "flight", "period": 0.5, "t_end": 5.0, "window": 0.5},
        "hardware": {"state_noise": [1e-3, 1e-3]},
    }
    monkeypatch.setattr(covariance, "ROUNDS", rounds)
    assert covariance.propagate_noise(scenario.study(scenario.from_tables(tables)).parts).converged is converged


def test_predicted_window_error_includes_the_error_between_samples():
    """The window contains only one sample, 0.49 s after t_f."""
    parts, simulated = simulated_chain(
        controller={"t_f": 15.01, "delta": 0.9, "k1": 3.0, "sign_width": 0.01, "surface_rate": 1.5},
        observer={"kind": "nonlinear", "gain": [5.0]},
        disturbance={"kind": "random_walk", "density": [1e-16]},
        loop={"period": 0.5, "t_end": 18.0, "window": 0.6},
        hardware={"state_noise": [2e-5, 1e-6]},
    )
    np.testing.assert_allclose(covariance.propagate_noise(parts).window_error, simulated, rtol=0.05)


def test_predicted_effect_of_a_random_walk_begins_at_the_start_of_a_period():
    """The window has few periods of 1 s. A step that acts one period later would predict a much smaller error."""
    parts, simulated = simulated_chain(
        controller={"t_f": 4.0, "delta": 2.0, "k1": 0.5, "sign_width": 1e3},
        observer={"kind": "nonlinear", "gain": [0.3]},
        disturbance={"kind": "random_walk", "density": [1e-5]},
        loop={"period": 1.0, "t_end": 5.0},
        hardware={"state_noise": [1e-12, 1e-12]},
    )
    np.testing.assert_allclose(covariance.propagate_noise(parts).window_error, simulated, rtol=0.04)


def test_filter_covariance_stays_at_its_initial_steady_state():
    """It covers attitude and bias for six time constants. Averaged loops change the covariance by about a tenth."""
    parts = scenario.study(scenario.from_tables(ALL_AT_ONCE)).parts
    run, periods = linear.simulate_nominal_jit(parts), np.arange(linear.PERIODS_PER_CALL)
    opened = linear.linearise_periods(parts, run, periods)
    ticks = jax.tree.map(lambda v: np.asarray(v)[periods], run.period.now)
    state = covariance._StateSpace(parts, ticks, opened)
    _, moved = state.transition_maps(opened.loop)
    first = state.memory
    known = np.eye(state.size)[first : first + 6]  # the filter's attitude and bias
    known[:3, :3] -= np.eye(3)
    known[3:, state._sensor_states] -= np.eye(3)
    p = state.start()
    begun, sizes = np.sqrt(np.diag(known @ p @ known.T)), []
    np.testing.assert_allclose(np.sqrt(np.diag(p)[state._sensor_states]), 1e-5, rtol=1e-12)
    for j, length in enumerate((ticks.t_next - ticks.t)[:60]):
        p = moved.in_period(j).covariance(p) + np.diag((state.drift * length) ** 2)
        sizes.append(np.sqrt(np.diag(known @ p @ known.T)))
    np.testing.assert_allclose(np.asarray(sizes) / begun, 1.0, atol=0.15)


@pytest.mark.parametrize("delay", [0, 1, 2, 3])
def test_covariance_is_propagated_with_the_dynamics_of_the_closed_loop(delay):
    """The loop has random matrices and delayed commands. A constant torque is an additional state."""
    rng, (n, k, m) = np.random.default_rng(delay), (6, 4, 3)
    shapes = (n, n), (n, k), (1, n, m), (m, n), (m, k), (n, m)
    a, seen, push, command, direct, pushed = (jnp.asarray(rng.normal(size=(1, *shape))) for shape in shapes)
    loop = linear.Loop(a, seen, push, 0.0 * push, command, direct, pushed, jnp.ones(1), delay)
    opened: Any = SimpleNamespace(loop=jax.tree.map(np.asarray, loop), error=np.zeros((1, m, 5)))
    state = covariance._StateSpace(a_body(period=0.1), Ticks(*[jnp.zeros(1)] * 6), opened)
    commanded, moved = state.transition_maps(opened.loop)
    at_input = linear.open_at_input(jax.tree.map(lambda v: v[0], opened.loop), xp=np)
    closed, size = at_input.closed(), n + delay * m
    expected = np.block([[closed, np.eye(size, n) @ opened.loop.disturbed[0]], [np.zeros((m, size)), np.eye(m)]])
    np.testing.assert_allclose(moved.state[0], expected, rtol=0.0, atol=1e-14 * np.abs(closed).max())
    np.testing.assert_allclose(commanded.state[0], np.pad(at_input.c, ((0, 0), (0, m))), rtol=0.0, atol=1e-14)


def test_covariance_analysis_does_not_apply_to_implicit_sampling_or_perfect_sensors():
    """With implicit sampling and noise beyond the reach of the switching term, it would predict 13 times the torque."""
    parts = scenario.study(scenario.from_tables({"loop": {"mode": "sampled"}, "hardware": {"rate_noise": 1e-6}})).parts
    assert covariance.is_applicable(parts)
    assert not covariance.is_applicable(replace(parts, controller=replace(parts.controller, implicit=True)))
    assert not covariance.is_applicable(replace(parts, sensors=PerfectSensors()))


@pytest.mark.parametrize("width", [1e-4, 0.02, 0.1, 0.3, 2.0, 30.0])
def test_equivalent_width_of_a_sign_with_noise_matches_numerical_integration(width):
    """The trapezium rule integrates E[sech^2(n / width)] / width with at least 16 steps in a width."""
    reach, step = min(12.0, 40.0 * width), min(1.0, width) / 16.0  # the integrand is below 1e-31 beyond `reach`
    n = np.linspace(-reach, reach, 2 * round(reach / step) + 1)
    slope = np.trapezoid(np.exp(-(n**2) / 2.0) / np.cosh(n / width) ** 2, n) / np.sqrt(2.0 * np.pi) / width
    for sigma in (1.0, 2e-6):
        np.testing.assert_allclose(covariance._equivalent_width(width * sigma, sigma), sigma / slope, rtol=1e-10)
    assert covariance._equivalent_width(width, 0.0) == width
    assert covariance._equivalent_width(0.0, 1.0) == pytest.approx(np.sqrt(np.pi / 2.0), rel=1e-12)


def test_equivalent_width_of_the_sign_follows_the_noise_of_each_period():
    """Compare the deviations of command and s with 200 trials; s is 25 times as noisy in the approach phase.

    The trials determine each deviation to 5 % and the largest of 160 to about 20 %. A single equivalent width, that of
    the hold phase, would predict 0.26 instead of 0.11.
    """
    tables = {
        "plant": {"kind": "chain", "order": 3, "x0": [0.1, 0.0, 0.0]},
        "controller": {"t_f": 6.0, "delta": 1.5, "k1": 4.0, "sign_width": 0.01, "surface_rate": 2.0},
        "observer": {"kind": "nonlinear", "gain": [3.0]},
        "disturbance": {"kind": "random_walk", "density": [0.02]},
        "loop": {"mode": "sampled", "period": 0.05, "t_end": 8.0, "window": 2.0},
        "hardware": {"state_noise": [1e-3] * 3},
    }
    parts = scenario.study(scenario.from_tables(tables)).parts
    fly = jax.jit(jax.vmap(lambda k: rollout.simulate(parts, np.uint32(0), k, record=True)))
    simulated, expected = fly(np.arange(200, dtype=np.uint32)), covariance.propagate_noise(parts)
    command, s, t = (np.asarray(v) for v in (simulated.log.commanded, simulated.log.s, simulated.log.t))
    np.testing.assert_allclose(expected.torque, command.std(axis=0).max(), rtol=0.2)
    np.testing.assert_allclose(expected.s, np.sqrt(np.mean(s[:, t[0] >= 6.0].var(axis=0))), rtol=0.1)
    assert s.std(axis=0).max() > 10.0 * expected.s


@pytest.mark.long
def test_noise_that_stabilises_a_narrow_sign_is_predicted():
    """The window error of 100 simulated trials is 3.3e-6, including the noise-free error of the narrow sign."""
    given = {**QUIET, **CASES[SHORT[0]], "controller__sign_width": 1e-7, "controller__disturbance_rate_bound": 1e-3}
    parts = scenario.study(scenario.replace(scenario.read(FIRST_FLIGHT), tune=None, **given)).parts
    assert covariance.propagate_noise(parts).window_error == pytest.approx(3.3e-6, rel=0.2)
