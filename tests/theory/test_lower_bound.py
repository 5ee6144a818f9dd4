"""The lower bound: closed forms, a batch least-squares estimator."""

import dataclasses
import math
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from scipy.linalg import expm

from ptsmc_jax.devices import actuators, attitude_sensors, sensors
from ptsmc_jax.signals import disturbances
from ptsmc_jax.simulation import clock, rollout
from ptsmc_jax.theory import lower_bound
from ptsmc_jax.theory.lower_bound import Model
from tests.helpers import chain_parts, parts, vector

PERIOD = 0.125  # a power of two, so that t_f and the ends of the window are exactly at samples


def still(made):
    """Return a history at rest with the duration of the scenario; made: its parts.

    Only the fields that `lower_bound` reads have values.
    """
    periods = int(np.ceil(float(made.t_end) / PERIOD))

    def kept(v):
        return np.tile(np.asarray(v), (periods + 1, *[1] * np.ndim(v)))

    x = made.initial
    held = jax.tree.map(kept, x)
    none, t = np.zeros((periods + 1, made.plant.inputs)), np.arange(periods + 1) * PERIOD
    log: Any = rollout.Log
    return log(t, held, none, none, none, none, none, None, none, None, np.ones(periods + 1, bool))


def simulated_at(made, **changes):
    """Return the parts with the flight clock and changed devices; changes: fields of the parts."""
    return dataclasses.replace(made, clock=clock.flight_clock(PERIOD, float(made.t_end)), **changes)


def delayed(periods):
    """Return actuators with a delay of whole periods."""
    return actuators.Actuators(delay=periods)


def by_least_squares(move, push, rows, noise, prior, output, delay):
    """Return variances (periods, outputs) by least squares over all samples at once.

    The model is z_{k+1} = move z_k + push v_k with standard normal v_k.

    Args:
        move: transition matrix (n, n).
        push: effect of v_k (n, v).
        rows: measurement matrix (m, n), or (periods, m, n).
        noise: 1 sigma of the samples (periods, m); infinite for a missing sample.
        prior: information matrix (n, n) of z_0.
        output: rows of the outputs by (z_k, v_k), (outputs, n + v).
        delay: number of newest samples that are not used.
    """
    periods, n, v = len(noise), len(move), push.shape[1]
    rows = np.broadcast_to(rows, (periods, noise.shape[1], n))
    total = n + v * periods  # (z_0, v_0, v_1, ..)
    state = [np.eye(n, total)]
    for k in range(periods - 1):
        drawn = np.eye(v, total, n + v * k)
        state.append(move @ state[k] + push @ drawn)
    scale = np.concatenate([np.min(noise[np.isfinite(noise)]) * np.ones(n), np.ones(v * periods)])  # for conditioning
    start = np.zeros((total, total))
    start[:n, :n] = prior
    start[n:, n:] = np.eye(v * periods)
    found = np.full((periods, len(output)), np.nan)
    for k in range(delay, periods):
        information = start.copy()
        for j in range(k - delay + 1):
            there = np.isfinite(noise[j])
            read = (rows[j] @ state[j])[there] / noise[j][there, None]
            information += read.T @ read
        asked = output @ np.vstack([state[k], np.eye(v, total, n + v * k)])
        covariance = np.linalg.inv(information * np.outer(scale, scale))
        found[k] = np.einsum("ij,jk,ik->i", asked * scale, covariance, asked * scale)
    return found


def rms_in_window(parts, squares):
    """Return the root of the mean of squares over the window of the run, by Simpson's rule, a number.

    squares: values at the start, middle and end of each period, (periods, 3).
    """
    t_f, window = float(parts.controller.t_f), float(parts.window)
    inside = slice(round(t_f / PERIOD), round((t_f + window) / PERIOD))
    return np.sqrt(np.sum(squares[inside] @ np.array([1, 4, 1]) / 6) * PERIOD / window)


def test_deviations_of_attitude_and_gyro_bias_attain_farrenkopfs_steady_state():
    """The closed form for attitude and gyro bias is from Markley and Reynolds (2000)."""
    interval, star, gyro, walk = 0.25, 2e-5, 1e-5, 3e-6
    s_v, s_u = gyro * math.sqrt(interval) / star, walk * interval**1.5 / star
    g = math.sqrt(1 + s_v**2 / 4 + s_u**2 / 48)
    z = g + s_u / 4 + 0.5 * math.sqrt(2 * g * s_u + s_v**2 + s_u**2 / 3)
    before, after = star * math.sqrt(z**2 - 1), star * math.sqrt(1 - z**-2)
    move = np.array([[1.0, -interval], [0.0, 1.0]])
    grown = walk**2 * interval
    noise = np.array([[gyro**2 * interval + grown * interval**2 / 3, -grown * interval / 2],
                      [-grown * interval / 2, grown]])  # fmt: skip
    periods = 2000  # the slower error decays by a factor e in 40 periods
    moves, kicks = (
        np.tile(move, (periods, 1, 1)),
        np.tile(np.linalg.solve(move, np.linalg.cholesky(noise)), (periods, 1, 1)),
    )
    moves[-1], kicks[-1] = np.eye(2), 0.0
    first, last = np.array([[1.0, 0.0]]), move[:1]
    output = np.stack([np.vstack([first, last])] * periods)
    model = Model(np.diag([1.0, 1e-3]), first, np.full((periods, 1), star), kicks, moves, output)
    found = lower_bound.deviations(model)
    np.testing.assert_allclose(found[-2, 1], before, rtol=1e-9)
    np.testing.assert_allclose(found[-1, 0], after, rtol=1e-9)  # nothing moves in this last period


@pytest.mark.parametrize("order", [2, 3])
@pytest.mark.parametrize("delay", [0, 2])
def test_lower_bound_of_a_chain_equals_least_squares(order, delay):
    """RK4 and the metric's cubic are exact up to order 3, because the motion under a held input is a polynomial."""
    made = chain_parts([0.5, -0.2, 0.1][:order], t_f=2.0, period=PERIOD, noise=[1e-3, 5e-2, 2e-4][:order])
    density = 3e-3
    made = simulated_at(made, walk_rate=vector([density]), actuators=delayed(delay))
    found = lower_bound.bound_along_run(made, still(made))
    periods, n = len(found.t), order

    def motion(t):
        """Transition matrix of (x, walk) over a time t."""
        a = np.diag(np.ones(n), 1)
        return expm(a * t)

    move = motion(PERIOD)
    push = move[:, -1:] * density * PERIOD  # the step of the walk acts from the start of the period
    output = np.stack([motion(t)[0] for t in (0.0, PERIOD / 2, PERIOD)])
    output = np.hstack([output, output[:, -1:] * density * PERIOD])
    noise = np.tile(np.asarray(made.sensors.sigma), (periods, 1))
    prior = np.diag([0.0] * n + [1e30])  # the walk starts at zero
    squares = by_least_squares(move, push, np.eye(n, n + 1), noise, prior, output, delay)
    # 1e-9: the initial deviation of 1e5 sigma changes the variance after one sample by 1e-10
    np.testing.assert_allclose(found.error[delay:], np.sqrt(squares[delay:, 2]), rtol=1e-9)
    np.testing.assert_allclose(found.window_error, rms_in_window(made, squares), rtol=1e-9)


def test_lower_bound_uses_the_actual_sample_times():
    """A chain has early and late samples. Least squares moves all samples to the time of the last one."""
    made = simulated_at(chain_parts([0.5, -0.2], t_f=2.0, period=PERIOD, noise=[1e-3, 5e-3]))
    log = still(made)
    late = 0.4 * PERIOD * np.sin(7.0 * np.arange(len(log.t)))
    late[[0, -1]] = 0.0
    log = log._replace(t=log.t + late)
    found = lower_bound.bound_along_run(made, log)
    np.testing.assert_allclose(found.t, log.t[1:], rtol=1e-15)
    for k, wanted in enumerate(found.error):
        since = log.t[: k + 1] - log.t[k + 1]
        reads = np.array([[[1.0, t], [0.0, 1.0]] for t in since]) / np.array([[1e-3], [5e-3]])
        np.testing.assert_allclose(
            wanted, np.sqrt(np.linalg.inv(np.einsum("kij,kil->jl", reads, reads))[0, 0]), rtol=1e-8
        )


AT_REST = {"q": [0.0, 0.0, 0.0, 1.0], "t_f": 3.0, "t_end": 5.0, "period": PERIOD}


# with a filter: own clock, first reading after the first sample, outage of the star tracker, gyro scale factor
KINDS = ["raw", "bias", "filter", "own times", "later", "outage", "scale"]


@pytest.mark.parametrize("kind", KINDS)
def test_lower_bound_of_a_spacecraft_at_rest_equals_least_squares(kind):
    """Each axis is independent, with angle, rate, gyro bias and torque as states."""
    star, gyro, bias, drift, every = 2e-5, 1e-6, 3e-6, 4e-7, 4
    walk = np.array([1e-5, 2e-5, 0.0])
    own: tuple[Any, Any] = vector(bias), vector(drift)
    if kind in ("raw", "bias"):
        every = 1
    if kind == "raw":
        bias, drift, own = 0.0, 0.0, (None, None)
    if kind == "own times":
        every, walk = 1, 1e3 * walk  # large enough to have an effect within a period
    sensor = sensors.Sensors(vector(star), vector(gyro), *own, None, every)
    if kind == "own times":
        sensor = dataclasses.replace(sensor, own_times=attitude_sensors.sample_times(2.5 * PERIOD, 0.0, PERIOD))
    if kind not in ("raw", "bias"):
        sensor = sensor.with_bandwidth(0.2, vector(PERIOD))
    outage, scale = (0.4, 2.2) if kind == "outage" else (0.0, 0.0), 1.1 if kind == "scale" else 1.0
    misfits = {"outage": {"outage": vector(outage)}, "scale": {"rate_scale": vector([scale] * 3)}}
    sensor = dataclasses.replace(sensor, **misfits.get(kind, {}))
    made = simulated_at(
        parts(**AT_REST, delta=2 * PERIOD), sensors=sensor, walk_rate=vector(walk), actuators=delayed(1)
    )
    first = 0
    if kind == "later":
        made, first = dataclasses.replace(made, clock=parts(**AT_REST, delta=2 * PERIOD).clock), -22
    found = lower_bound.bound_along_run(made, still(made))
    periods = len(found.t)
    squares = np.zeros((periods, 3))
    numbers = first + np.arange(periods)
    due, age = numbers % every == 0, np.zeros(periods)
    if kind == "own times":
        age = 0.5 * PERIOD * (numbers % 5 == 3)
        due = np.isin(numbers % 5, (0, 3))
    due &= ~((numbers * PERIOD >= outage[0]) & (numbers * PERIOD < outage[1]))
    noise = np.where(due[:, None] & [True, False], star, np.array([np.inf, gyro]))
    for axis, inertia in enumerate(np.diag(np.asarray(made.plant.inertia))):
        # angle, rate, bias, torque
        a = np.zeros((4, 4))
        a[0, 1], a[1, 3] = 1.0, 1.0 / inertia
        move = expm(a * PERIOD)
        steps = np.zeros((4, 2))
        steps[2, 0], steps[3, 1] = drift * PERIOD, walk[axis] * PERIOD
        rows = np.stack([[expm(-a * late)[0], [0.0, scale, 1.0, 0.0]] for late in age])
        prior = np.diag([0.0, 0.0, 1.0 / max(bias, 1e-20) ** 2, 1e40])
        if sensor.filter is not None:
            root = np.asarray(sensor.filter.spread[(first - 1) % len(sensor.filter.spread)])
            prior[np.ix_([0, 2], [0, 2])] += np.linalg.inv(root @ root.T)
        output = np.stack([expm(a * t)[0] / 2 for t in (0.0, PERIOD / 2, PERIOD)])
        squares += by_least_squares(move, move @ steps, rows, noise, prior, np.hstack([output, output @ steps]), 1)
    np.testing.assert_allclose(found.error[1:], np.sqrt(squares[1:, 2]), rtol=1e-8)  # numbers differ by 1e10
    np.testing.assert_allclose(found.window_error, rms_in_window(made, squares), rtol=1e-8)


def test_bounds_on_the_error_of_several_runs_equal_separate_calls():
    """The bound of a run without uncertainty is 0. The runs differ in noise, delay and duration."""

    def chain(t_f=2.0, noise: Any = (1e-3, 5e-2), delay=0):
        made = chain_parts([0.5, -0.2], t_f=t_f, period=PERIOD, noise=noise)
        return simulated_at(made, actuators=delayed(delay))

    runs = [chain(), chain(noise=(2e-3, 1e-2)), chain(delay=2), chain(t_f=2.2), chain(noise=None), chain(delay=2)]
    simulated = [(made, still(made)) for made in runs]
    for (made, log), found in zip(simulated, lower_bound.bounds_along_runs(simulated), strict=True):
        alone = lower_bound.bound_along_run(made, log)
        # QR of the same matrices, batched or one after the other
        np.testing.assert_allclose(found.error, alone.error, rtol=1e-13)
        np.testing.assert_allclose(found.window_error, alone.window_error, rtol=1e-13)
        np.testing.assert_array_equal(found.t, alone.t)
    lower_bounds = [found.window_error for found in lower_bound.bounds_along_runs(simulated)]
    assert len(set(lower_bounds)) == 5  # two of the six runs are equal
    assert lower_bounds[4] == 0.0
    assert lower_bound.bounds_along_runs([]) == []


def test_lower_bound_with_an_exact_rate_is_the_noise_of_the_mean_position():
    """The rate is known to be zero, so that the best estimate of the position is the mean of all samples."""
    made = simulated_at(chain_parts([1.0, 0.0], t_f=2.0, period=PERIOD, noise=[1e-3, 0.0]))
    found = lower_bound.bound_along_run(made, still(made))
    np.testing.assert_allclose(found.error, 1e-3 / np.sqrt(1.0 + np.arange(len(found.t))), rtol=1e-9)


def test_lower_bound_without_noise_is_the_effect_of_the_random_walk_in_a_period():
    """All states are measured exactly. Only the effect of the walk's step within a period remains."""
    density = 0.2
    made = simulated_at(chain_parts([1.0, 0.0], t_f=2.0, period=PERIOD), walk_rate=vector([density]))
    found = lower_bound.bound_along_run(made, still(made))
    np.testing.assert_allclose(found.error, density * PERIOD * PERIOD**2 / 2, rtol=1e-6)  # EXACT, over one period


@pytest.mark.parametrize("delay", [0, 2])
def test_lower_bound_is_zero_if_exact_positions_determine_the_rate(delay):
    """It is zero from the second sample on for any noise of the rate. Rounding of 1e-14 must not appear as a bound."""
    made = simulated_at(chain_parts([1.0, 0.0], t_f=2.0, period=PERIOD, noise=[0.0, 1e-3]), actuators=delayed(delay))
    found = lower_bound.bound_along_run(made, still(made))
    np.testing.assert_allclose(found.error[delay], (1 + delay) * PERIOD * 1e-3, rtol=1e-9)  # by its only sample
    np.testing.assert_array_equal(found.error[delay + 1 :], 0.0)
    assert found.window_error == 0.0


def test_lower_bound_is_zero_without_noise():
    continuous = parts(t_f=3.0)
    assert lower_bound.bound_along_run(continuous, still(continuous)).window_error == 0.0
    for noise in (None, [0.0, 0.0]):
        made = simulated_at(chain_parts([1.0, 0.0], t_f=2.0, period=PERIOD, noise=noise))
        found = lower_bound.bound_along_run(made, still(made))
        assert found.window_error == 0.0
        np.testing.assert_array_equal(found.error, 0.0)


def test_wheel_momentum_couples_the_axes_in_the_linearised_run():
    """At rest with wheel momentum h a small rate obeys J dw' = h x dw."""
    momentum = np.array([3.0, -2.0, 1.0])
    device = actuators.wheels(np.eye(3), momentum)
    calm = parts(**AT_REST, noise=(2e-5, 1e-6), disturbance=disturbances.Constant(jnp.zeros(3)))
    made = simulated_at(calm, actuators=actuators.Actuators(wheels=device))
    ticks, log = lower_bound._nonzero_periods(made, still(made))
    linear = lower_bound._linearise_run(made, log, ticks)
    coupled = np.asarray(made.plant.inertia_inverse) @ np.cross(momentum, np.eye(3)).T
    # the error of RK4 is 0.04^5 / 120 for 0.3 rad/s over a period
    np.testing.assert_allclose(linear.transition[0][3:, 3:], expm(coupled * PERIOD), rtol=0, atol=1e-9)
