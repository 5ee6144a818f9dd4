"""The floor: closed forms, a brute-force estimator, the filter that attains it, and who says it."""

import dataclasses
import math
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from scipy.linalg import expm

from ptsmc_jax.devices import actuators, attitude_filter, reaction_wheels, sensors, star_times
from ptsmc_jax.signals import disturbances
from ptsmc_jax.simulation import clock, rollout
from ptsmc_jax.theory import error_floor
from ptsmc_jax.theory.error_floor import Model
from tests.helpers import chain_parts, parts, vector
from tuning.output import run_report, summaries

PERIOD = 0.125  # a power of two: t_f and the window lie on samples exactly


def still(made):
    """A history in which nothing moves, as long as the run of these parts; only what `estimation` reads."""
    periods = int(np.ceil(float(made.t_end) / PERIOD))

    def kept(v):
        return np.tile(np.asarray(v), (periods + 1, *[1] * np.ndim(v)))

    x = made.initial
    held = jax.tree.map(kept, x)
    none, t = np.zeros((periods + 1, made.plant.inputs)), np.arange(periods + 1) * PERIOD
    log: Any = rollout.Log
    return log(t, held, none, none, none, none, none, None, none, None, np.ones(periods + 1, bool))


def flown_at(made, **changes):
    """The parts on the flight clock, with other devices."""
    return dataclasses.replace(made, clock=clock.flight(PERIOD, float(made.t_end)), **changes)


def delayed(periods):
    return actuators.Actuators(delay=periods)


def by_least_squares(move, push, rows, noise, prior, output, delay):
    """Variances (periods, outputs) by conditioning on all samples at once.

    z_{k+1} = move z_k + push v_k, v_k standard normal; samples rows z_k, those of all periods or of each, with noise
    (periods, m), infinite where there is none; prior: information (n, n) on z_0; output: rows of (z_k, v_k) that are
    asked for, (outputs, n + v).
    """
    periods, n, v = len(noise), len(move), push.shape[1]
    rows = np.broadcast_to(rows, (periods, noise.shape[1], n))
    total = n + v * periods  # (z_0, v_0, v_1, ..)
    state = [np.eye(n, total)]
    for k in range(periods - 1):
        drawn = np.eye(v, total, n + v * k)
        state.append(move @ state[k] + push @ drawn)
    scale = np.concatenate([np.min(noise[np.isfinite(noise)]) * np.ones(n), np.ones(v * periods)])  # well conditioned
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


def pooled_in_window(made, squares):
    """RMS over the window of squares at the start, the middle and the end of each period (periods, 3), by Simpson."""
    t_f, window = float(made.controller.t_f), float(made.window)
    inside = slice(round(t_f / PERIOD), round((t_f + window) / PERIOD))
    return np.sqrt(np.sum(squares[inside] @ np.array([1, 4, 1]) / 6) * PERIOD / window)


def test_farrenkopfs_steady_state():
    """His two states, attitude and the gyro's bias, by the closed form of theory (Markley and Reynolds, 2000)."""
    interval, star, gyro, walk = 0.25, 2e-5, 1e-5, 3e-6
    s_v, s_u = gyro * math.sqrt(interval) / star, walk * interval**1.5 / star
    g = math.sqrt(1 + s_v**2 / 4 + s_u**2 / 48)
    z = g + s_u / 4 + 0.5 * math.sqrt(2 * g * s_u + s_v**2 + s_u**2 / 3)
    before, after = star * math.sqrt(z**2 - 1), star * math.sqrt(1 - z**-2)
    move = np.array([[1.0, -interval], [0.0, 1.0]])
    grown = walk**2 * interval
    noise = np.array([[gyro**2 * interval + grown * interval**2 / 3, -grown * interval / 2],
                      [-grown * interval / 2, grown]])  # fmt: skip
    periods = 2000  # the slower of both errors falls by e each 40
    moves, kicks = (
        np.tile(move, (periods, 1, 1)),
        np.tile(np.linalg.solve(move, np.linalg.cholesky(noise)), (periods, 1, 1)),
    )
    moves[-1], kicks[-1] = np.eye(2), 0.0
    first, last = np.array([[1.0, 0.0]]), move[:1]
    output = np.stack([np.vstack([first, last])] * periods)
    model = Model(np.diag([1.0, 1e-3]), first, np.full((periods, 1), star), kicks, moves, output)
    found = error_floor.deviations(model)
    np.testing.assert_allclose(found[-2, 1], before, rtol=1e-9)
    np.testing.assert_allclose(found[-1, 0], after, rtol=1e-9)  # nothing moves in this last period


@pytest.mark.parametrize("order", [2, 3])
@pytest.mark.parametrize("delay", [0, 2])
def test_a_chain_as_by_a_brute_force_estimator(order, delay):
    """Its motion under a held input is a polynomial, which RK4 and the metric's cubic follow exactly up to order 3."""
    made = chain_parts([0.5, -0.2, 0.1][:order], t_f=2.0, period=PERIOD, noise=[1e-3, 5e-2, 2e-4][:order])
    density = 3e-3
    made = flown_at(made, walk_rate=vector([density]), actuators=delayed(delay))
    found = error_floor.along(made, still(made))
    periods, n = len(found.t), order

    def motion(t):
        """Transition by t of (x, walk)."""
        a = np.diag(np.ones(n), 1)
        return expm(a * t)

    move = motion(PERIOD)
    push = move[:, -1:] * density * PERIOD  # the step of the walk acts from the start of the period
    output = np.stack([motion(t)[0] for t in (0.0, PERIOD / 2, PERIOD)])
    output = np.hstack([output, output[:, -1:] * density * PERIOD])
    noise = np.tile(np.asarray(made.sensors.sigma), (periods, 1))
    prior = np.diag([0.0] * n + [1e30])  # the walk starts at zero
    squares = by_least_squares(move, push, np.eye(n, n + 1), noise, prior, output, delay)
    # 1e-9: the start is "unknown" by 1e5 sigma, which is 1e-10 of the variance after one sample
    np.testing.assert_allclose(found.error[delay:], np.sqrt(squares[delay:, 2]), rtol=1e-9)
    np.testing.assert_allclose(found.window_error, pooled_in_window(made, squares), rtol=1e-9)


def test_samples_say_what_they_do_at_the_times_when_they_came():
    """Of a chain whose samples are early or late: all of them at once, moved to the last one's time."""
    made = flown_at(chain_parts([0.5, -0.2], t_f=2.0, period=PERIOD, noise=[1e-3, 5e-3]))
    log = still(made)
    late = 0.4 * PERIOD * np.sin(7.0 * np.arange(len(log.t)))
    late[[0, -1]] = 0.0
    log = log._replace(t=log.t + late)
    found = error_floor.along(made, log)
    np.testing.assert_allclose(found.t, log.t[1:], rtol=1e-15)
    for k, wanted in enumerate(found.error):
        since = log.t[: k + 1] - log.t[k + 1]
        reads = np.array([[[1.0, t], [0.0, 1.0]] for t in since]) / np.array([[1e-3], [5e-3]])
        np.testing.assert_allclose(
            wanted, np.sqrt(np.linalg.inv(np.einsum("kij,kil->jl", reads, reads))[0, 0]), rtol=1e-8
        )


AT_REST = {"q": [0.0, 0.0, 0.0, 1.0], "t_f": 3.0, "t_end": 5.0, "period": PERIOD}


# of the filter: a star tracker by its own clock, one that is not due at the first sample, one that pauses; a wrong gyro
KINDS = ["raw", "bias", "filter", "own times", "later", "outage", "scale"]


@pytest.mark.parametrize("kind", KINDS)
def test_a_body_at_rest_as_by_a_brute_force_estimator(kind):
    """Each axis on its own: angle, rate, the gyro's bias and its walk, the torque's walk."""
    star, gyro, bias, drift, every = 2e-5, 1e-6, 3e-6, 4e-7, 4
    walk = np.array([1e-5, 2e-5, 0.0])
    own: tuple[Any, Any] = vector(bias), vector(drift)
    if kind in ("raw", "bias"):
        every = 1
    if kind == "raw":
        bias, drift, own = 0.0, 0.0, (None, None)
    if kind == "own times":
        every, walk = 1, 1e3 * walk  # so large that it tells within a period
    sensor = sensors.Sensors(vector(star), vector(gyro), *own, None, every)
    if kind == "own times":
        sensor = dataclasses.replace(sensor, own_times=star_times.star_times(2.5 * PERIOD, PERIOD))
    if kind not in ("raw", "bias"):
        sensor = sensor.with_bandwidth(0.2, vector(PERIOD))
    outage, scale = (0.4, 2.2) if kind == "outage" else (0.0, 0.0), 1.1 if kind == "scale" else 1.0
    misfits = {"outage": {"outage": vector(outage)}, "scale": {"rate_scale": vector([scale] * 3)}}
    sensor = dataclasses.replace(sensor, **misfits.get(kind, {}))
    made = flown_at(parts(**AT_REST, delta=2 * PERIOD), sensors=sensor, walk_rate=vector(walk), actuators=delayed(1))
    first = 0
    if kind == "later":
        made, first = dataclasses.replace(made, clock=parts(**AT_REST, delta=2 * PERIOD).clock), -22
    found = error_floor.along(made, still(made))
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
    np.testing.assert_allclose(found.error[1:], np.sqrt(squares[1:, 2]), rtol=1e-8)  # of numbers 1e10 apart
    np.testing.assert_allclose(found.window_error, pooled_in_window(made, squares), rtol=1e-8)


def test_side_by_side_each_run_has_its_own_floor():
    """Runs alike but for their noise, one that acts later, a longer one, and one without anything unknown."""

    def chain(t_f=2.0, noise: Any = (1e-3, 5e-2), delay=0):
        made = chain_parts([0.5, -0.2], t_f=t_f, period=PERIOD, noise=noise)
        return flown_at(made, actuators=delayed(delay))

    runs = [chain(), chain(noise=(2e-3, 1e-2)), chain(delay=2), chain(t_f=2.2), chain(noise=None), chain(delay=2)]
    flown = [(made, still(made)) for made in runs]
    for (made, log), found in zip(flown, error_floor.along_each(flown), strict=True):
        alone = error_floor.along(made, log)
        # QR of the same matrices, one after the other
        np.testing.assert_allclose(found.error, alone.error, rtol=1e-13)
        np.testing.assert_allclose(found.window_error, alone.window_error, rtol=1e-13)
        np.testing.assert_array_equal(found.t, alone.t)
    floors = [found.window_error for found in error_floor.along_each(flown)]
    assert len(set(floors)) == 5  # of six, two of which are the same
    assert floors[4] == 0.0
    assert error_floor.along_each([]) == []


def test_a_state_that_is_measured_without_noise_is_known():
    """With the rate known the position does not move: it is known as the mean of all samples."""
    made = flown_at(chain_parts([1.0, 0.0], t_f=2.0, period=PERIOD, noise=[1e-3, 0.0]))
    found = error_floor.along(made, still(made))
    np.testing.assert_allclose(found.error, 1e-3 / np.sqrt(1.0 + np.arange(len(found.t))), rtol=1e-9)


def test_without_noise_only_what_pushes_is_unknown():
    """Every state is seen exactly: what a step of the walk does within a period is all that is left."""
    density = 0.2
    made = flown_at(chain_parts([1.0, 0.0], t_f=2.0, period=PERIOD), walk_rate=vector([density]))
    found = error_floor.along(made, still(made))
    np.testing.assert_allclose(found.error, density * PERIOD * PERIOD**2 / 2, rtol=1e-6)  # EXACT, over one period


@pytest.mark.parametrize("delay", [0, 2])
def test_where_positions_without_noise_tell_the_rate_there_is_no_floor(delay):
    """From the second sample on, however noisy the rate is; 1e-14 of rounding would be told as a floor."""
    made = flown_at(chain_parts([1.0, 0.0], t_f=2.0, period=PERIOD, noise=[0.0, 1e-3]), actuators=delayed(delay))
    found = error_floor.along(made, still(made))
    np.testing.assert_allclose(found.error[delay], (1 + delay) * PERIOD * 1e-3, rtol=1e-9)  # by its only sample
    np.testing.assert_array_equal(found.error[delay + 1 :], 0.0)
    assert found.window_error == 0.0


def test_without_noise_there_is_no_floor():
    continuous = parts(t_f=3.0)
    assert error_floor.along(continuous, still(continuous)).window_error == 0.0
    for noise in (None, [0.0, 0.0]):
        made = flown_at(chain_parts([1.0, 0.0], t_f=2.0, period=PERIOD, noise=noise))
        found = error_floor.along(made, still(made))
        assert found.window_error == 0.0
        np.testing.assert_array_equal(found.error, 0.0)


def test_momentum_stored_in_wheels_couples_the_axes():
    """At rest with momentum h in the wheels the rate moves by J dw' = h x dw."""
    momentum = np.array([3.0, -2.0, 1.0])
    device = reaction_wheels.wheels(np.eye(3), momentum)
    calm = parts(**AT_REST, noise=(2e-5, 1e-6), disturbance=disturbances.Constant(jnp.zeros(3)))
    made = flown_at(calm, actuators=actuators.Actuators(wheels=device))
    ticks, log = error_floor._lasting(made, still(made))
    linear = error_floor._linear(made, log, ticks)
    coupled = np.asarray(made.plant.inertia_inverse) @ np.cross(momentum, np.eye(3)).T
    # RK4: 0.3 rad/s over a period, 0.04^5 / 120
    np.testing.assert_allclose(linear.move[0][3:, 3:], expm(coupled * PERIOD), rtol=0, atol=1e-9)


def test_a_filter_with_the_kalman_filters_gains_is_at_the_floor():
    """A body pushed about so much that its motion tells nothing: what is left is the gyro, Farrenkopf's case.

    The floor is 0.9 % below: his model has the gyro's mean over an interval, the floor each of its samples.
    """
    star, gyro, drift, every = 2e-5, 4e-5, 2e-6, 4
    interval, walk = PERIOD * every, drift * math.sqrt(PERIOD)
    # gains of Farrenkopf's steady state, by his recursion
    move, read = np.array([[1.0, -interval], [0.0, 1.0]]), np.array([[1.0, 0.0]])
    grown = walk**2 * interval
    spread = np.array([[gyro**2 * PERIOD * interval + grown * interval**2 / 3, -grown * interval / 2],
                       [-grown * interval / 2, grown]])  # fmt: skip
    p, gain = np.diag([1e-8, 1e-8]), np.zeros((2, 1))
    for _ in range(2000):
        gain = p @ read.T / (read @ p @ read.T + star**2)
        p = move @ (p - gain @ read @ p) @ move.T + spread
    k1, k2 = float(gain[0, 0]), -float(gain[1, 0])
    own = p - gain @ read @ p
    held = attitude_filter.AttitudeFilter(vector(k1), vector(k2), vector(np.tile(np.linalg.cholesky(p), (every, 1, 1))))
    sensor = sensors.Sensors(vector(star), vector(gyro), vector(1e-3), vector(drift), held, every)
    made = parts(**{**AT_REST, "t_end": 40.0})
    made = flown_at(made, sensors=sensor, walk_rate=vector([1e3] * 3))
    ticks, log = error_floor._lasting(made, still(made))
    at_start = error_floor.deviations(error_floor._model(made, log, ticks))[:, :3]
    after_star = at_start[::every]
    assert len(after_star) > 50
    # the error is half an angle
    np.testing.assert_allclose(after_star[-1], math.sqrt(own[0, 0]) / 2, rtol=0.02)


@pytest.mark.parametrize("least", [None, 0.0])
def test_run_without_a_lower_bound_has_no_ratio_to_it(least):
    """Without noise, and if no run reaches its end."""
    run = {"status": "ok", "reason": "", "bad_time": None, "window_error": 1e-5, "verdicts": {}, "cautions": []}
    report = run_report.of(summaries.run({**run, "floor": least}, "spacecraft"), "spacecraft")
    assert report.headline == "pointing error 4.13 arcsec: the run reached its end"
    assert report.lines == []


def test_a_floor_is_shown_by_its_number_and_not_by_its_course():
    course = np.arange(900.0)
    assert repr(error_floor.Floor(8e-7, course, course)) == "Floor(window_error=8e-07)"
