"""Compare metrics with plain NumPy on the history of the same run, and with intervals made by hand."""

import pickle

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from scipy.interpolate import CubicHermiteSpline

from ptsmc_jax.laws.kinematics import AdditiveKinematics, MultiplicativeKinematics
from ptsmc_jax.numerics import attitude
from ptsmc_jax.plants.rigid_body import AttitudeState
from ptsmc_jax.signals import disturbances, references
from ptsmc_jax.simulation import metrics
from ptsmc_jax.simulation.metrics import (
    Arrival,
    Criteria,
    Errors,
    Interval,
    Snapshot,
    Start,
    Torques,
    integral_in_window,
)
from tests.helpers import chain_flight, chain_parts, fly, parts, short, vector


def simulated(**changes):
    """Return the parts of a run, its metrics, and its history without periods of length zero.

    changes: arguments of `helpers.parts`.
    """
    run = parts(20.0, 3.0, 0.5, **changes)
    result = fly(run, 1, 4)
    log = result.log
    return run, result.metrics, jax.tree.map(lambda rows: rows[log.has_length], log)


@pytest.fixture(scope="module", params=short(["continuous", "sampled", "flight"], ["continuous", "sampled"]))
def run(request):
    """Return parts, metrics and history of a continuous or a sampled run, see `simulated`."""
    noisy = {"period": 0.05, "noise": (2e-4, 1e-5)}
    return simulated(**{"continuous": {}, "sampled": noisy, "flight": {**noisy, "flight": True}}[request.param])


def test_window_metrics_match_integrals_of_squared_error_and_angle(run):
    parts, found, log = run
    rates = jax.jit(jax.vmap(lambda t, x: parts.controller.kinematics.errors(x, parts.reference(t))[1]))
    slope = rates(jnp.asarray(log.t), jax.tree.map(jnp.asarray, log.x))
    spline = CubicHermiteSpline(log.t, log.error, slope)
    t = np.linspace(20.0, 21.0, 20001)
    squares = np.sum(spline(t) ** 2, axis=1)
    angles = 2.0 * np.arcsin(np.sqrt(squares))  # the reference is the identity
    expected = np.sqrt([np.trapezoid(squares, t), np.trapezoid(angles**2, t)])
    # error of Simpson's rule in a step: 0.1^4 with rates of 1/s
    np.testing.assert_allclose([found.window_error, found.window_angle], expected, rtol=1e-5)


@pytest.mark.parametrize("kinematics", [AdditiveKinematics, MultiplicativeKinematics])
def test_the_angle_at_mid_step_is_right_for_a_rotation_past_the_reference(kinematics):
    """For a rotation from -0.1 to 0.3 rad about a moving reference it is 0.1 rad, and not the mean of 0.2 rad."""
    axis = np.array([0.6, 0.0, 0.8])
    first = attitude.from_rotation_vector(vector([0.2, -0.3, 0.1]))

    def state(t, angle):
        turned, beyond = (attitude.from_rotation_vector(vector(a * axis)) for a in (0.7 * t, angle))
        q_f = attitude.multiply(first, turned)
        body = AttitudeState(attitude.multiply(q_f, beyond), vector((0.7 + 4.0) * axis))
        return body, references.Target(q_f, vector(0.7 * axis), jnp.zeros(3))

    middle = parts(kinematics=kinematics).controller.kinematics.middle_angle(
        state(0.0, -0.1), state(0.1, 0.3), vector(0.1)
    )
    np.testing.assert_allclose(middle, 0.1, rtol=1e-4)


def test_torque_metrics_match_the_history(run):
    parts, found, log = run
    held = not parts.sensors.perfect
    size = np.abs(log.commanded)
    # the continuous run includes the ends of steps, where the torque changes by 3 % per step
    np.testing.assert_allclose(found.peak_torque, size.max(), rtol=1e-15 if held else 0.03)
    np.testing.assert_allclose(found.peak_torque_delivered, found.peak_torque)
    total = np.sum(np.abs(log.u), axis=1)
    if held:
        effort = np.sum(total[:-1] * np.diff(log.t))
        jumps = np.abs(np.diff(log.u[:-1], axis=0))[log.t[1:-1] > 20.0]
        np.testing.assert_allclose(found.effort, effort, rtol=1e-12)
        np.testing.assert_allclose(found.chattering, jumps.sum(axis=0).max() / 10.0, rtol=1e-12)
    else:
        # the trapezoidal rule over the rows has an error of 0.2 % at these steps
        np.testing.assert_allclose(found.effort, np.trapezoid(total, log.t), rtol=5e-3)
        late = log.u[log.t >= 20.0]
        np.testing.assert_allclose(found.chattering, np.abs(np.diff(late, axis=0)).sum(axis=0).max() / 10.0, rtol=1e-6)
    assert float(found.saturated) == 0.0


def test_effort_of_the_continuous_loop_uses_torques_at_ends_of_steps():
    """The torque of a stage at mid step oscillates in a thin boundary layer, here by 1 % of the effort."""
    wave = disturbances.Sinusoid(*(vector([v]) for v in (0.2, 2.0, 0.0, 0.0)))
    flight = fly(chain_parts([1.0, 0.2], delta=0.5, bound=0.3, disturbance=wave, steps=(800, 800)))
    total = np.sum(np.abs(flight.log.u), axis=1)
    np.testing.assert_allclose(flight.metrics.effort, np.trapezoid(total, flight.log.t), rtol=1e-3)


def test_error_rate_and_momentum_metrics_match_the_history(run):
    parts, found, log = run
    late = log.t >= 20.0
    hold = np.linalg.norm(log.error[late], axis=1).max()
    np.testing.assert_allclose(found.hold_error, max(hold, float(found.terminal_error)), rtol=1e-12)
    np.testing.assert_allclose(found.peak_rate, np.linalg.norm(log.x.w, axis=1).max(), rtol=1e-12)
    inertia = np.asarray(parts.plant.inertia)
    np.testing.assert_allclose(found.peak_momentum, np.linalg.norm(log.x.w @ inertia, axis=1).max(), rtol=1e-12)
    np.testing.assert_allclose(found.terminal_angle, 2 * np.arcsin(found.terminal_error), rtol=1e-6)


def test_settling_time_matches_the_history(run):
    _, found, log = run
    angle = 2 * np.arcsin(np.minimum(np.linalg.norm(log.error, axis=1), 1.0))  # the reference is the identity
    last = np.flatnonzero(angle >= 1e-3)[-1]
    assert log.t[last] <= float(found.settling_time) <= log.t[last + 1]


def interval(t, t_next, angles, torque=0.0, delivered=None):
    """Return an interval of a run with the angles [rad] at both ends, and torques about x [N m].

    t, t_next: its ends [s]. delivered: by default the commanded torque.
    """
    start, end = (Snapshot(vector(a), vector(a), vector(a)) for a in angles)
    u = vector([torque, 0.0, 0.0])
    got = u if delivered is None else vector([delivered, 0.0, 0.0])
    first, last = ((vector([a / 2, 0, 0]), jnp.zeros(3)) for a in angles)
    return Interval(
        t=vector(t),
        t_next=vector(t_next),
        start=start,
        end=end,
        errors=lambda: Errors(*first, *last),
        middle_angle=lambda: (start.angle + end.angle) / 2,
        arrival=lambda: Arrival(last[0], end.angle),
        last_torque=jnp.zeros(3),
        torques=Torques((u,), (got,), (1.0,), jnp.asarray(delivered is not None), None),
    )


def judge(intervals, t_end=4.0):
    """Return the metrics of a run with these intervals, see `interval`.

    t_f and the window are 1 s, and the settling angle is 0.1 rad.
    """
    criteria = Criteria(vector(1.0), vector(t_end), vector(1.0), vector(0.1))
    running, torque = metrics.begin(Start(intervals[0].start, 3, None), criteria), jnp.zeros(3)
    for one in intervals:
        running = metrics.update(running, one._replace(last_torque=torque), criteria)
        torque = one.torques.delivered[-1] if one.t_next > one.t else torque
    return metrics.finish(running, criteria)


def test_settling_time_interpolates_restarts_and_can_be_nan():
    """It is the last time at which the angle falls below the limit, interpolated in its interval.

    It is NaN if the angle is larger at the end of the run.
    """
    falls = judge([interval(0, 1, (1.0, 0.5)), interval(1, 2, (0.5, 0.3)), interval(2, 4, (0.3, 0.05))])
    np.testing.assert_allclose(falls.settling_time, 2.0 + 2.0 * 0.2 / 0.25)
    again = judge([interval(0, 1, (0.05, 0.05)), interval(1, 2, (0.05, 0.3)), interval(2, 4, (0.3, 0.05))])
    assert float(again.settling_time) > 2.0
    assert float(judge([interval(0, 1, (0.05, 0.05)), interval(1, 4, (0.05, 0.01))]).settling_time) == 0.0
    assert np.isnan(float(judge([interval(0, 1, (1.0, 0.05)), interval(1, 4, (0.05, 0.2))]).settling_time))
    assert np.isnan(float(judge([interval(0, 1, (1.0, 0.05)), interval(1, 4, (0.05, np.nan))]).settling_time))


def test_saturated_is_a_fraction_of_time_and_peaks_distinguish_commanded_from_delivered_torque():
    found = judge([interval(0, 1, (1, 1), 3.0, 2.0), interval(1, 3, (1, 1), 1.0), interval(3, 4, (1, 1), -1.0)])
    np.testing.assert_allclose(found.saturated, 0.25)
    np.testing.assert_allclose([found.peak_torque, found.peak_torque_delivered], [3.0, 2.0])
    np.testing.assert_allclose(found.effort, 2.0 + 2.0 + 1.0)
    np.testing.assert_allclose(found.chattering, 2.0 / 3.0)  # the jump at t_f itself does not count
    for late in (1.0 - 1e-15, 1.0 + 1e-15):  # 53 periods of 0.1 s are more than 5.3 s, 52 are 5.2 s
        found = judge(
            [interval(0, late, (1, 1), 3.0, 2.0), interval(late, 3, (1, 1), 1.0), interval(3, 4, (1, 1), -1.0)]
        )
        np.testing.assert_allclose(found.chattering, 2.0 / 3.0)


def test_angles_after_t_f_use_a_parabola_through_their_squares():
    """From t_f = 1 s on, over a window of 1 s, the angle falls linearly from 0.3 to 0.1 rad."""
    found = judge([interval(0, 1, (1.0, 0.3)), interval(1, 2, (0.3, 0.1)), interval(2, 4, (0.1, 0.25))])
    np.testing.assert_allclose(found.hold_angle, 0.3)
    np.testing.assert_allclose(found.window_angle, np.sqrt((0.09 + 0.03 + 0.01) / 3), rtol=1e-14)
    later = judge([interval(0, 1, (1.0, 0.1)), interval(1, 2, (0.1, 0.2)), interval(2, 4, (0.2, 0.4))])
    np.testing.assert_allclose(later.hold_angle, 0.4)  # until the end of the run, not of the window


def part(squares, begin, end):
    """Return the integral over part of an interval from 2 to 2.5 s, between the fractions `begin` and `end` of it.

    squares: squared error at the start, in the middle and at the end of the interval.
    """
    times = (2.0 + 0.5 * begin, 9.0, 0.5 * (end - begin), 0.1)
    return integral_in_window(vector(2.0), vector(2.5), squares, Criteria(*map(vector, times)))


def test_part_of_an_interval_has_a_positive_integral_of_the_squared_error():
    """For a linear error the integral is exact. Otherwise the parabola can be negative, and an RMS was NaN earlier."""
    rng = np.random.default_rng(0)
    for _ in range(20):
        zero, (begin, end) = rng.uniform(-0.2, 1.2), np.sort(rng.uniform(0.0, 1.0, 2))
        exact = 0.5 * ((end - zero) ** 3 - (begin - zero) ** 3) / 3.0
        along = [(x - zero) ** 2 for x in (0.0, 0.5, 1.0)]
        np.testing.assert_allclose(part(along, begin, end), exact, rtol=1e-9)
    bent = (1.0, 0.01, 4.0)  # a nonlinear error that is nearly zero at mid step
    np.testing.assert_allclose(part(bent, 0.0, 1.0), 0.5 * 5.04 / 6.0, rtol=1e-14)  # Simpson's rule
    np.testing.assert_allclose(part(bent, 0.3, 0.5), 0.5 * 0.2**3 / 4.0 * 5.04 / 6.0, rtol=1e-9)
    wider = [float(part(bent, 0.3, end)) for end in np.linspace(0.31, 1.0, 70)]
    assert np.all(np.diff(wider) > 0.0)


def test_wheel_torque_is_the_largest_of_all_wheels():
    wheels = jnp.asarray([[0.1, -0.2], [0.05, 0.3]])
    one = interval(0, 4, (1.0, 1.0))
    one = one._replace(torques=one.torques._replace(wheel_momentum=wheels, wheel_torque=-2.0 * wheels))
    criteria = Criteria(vector(1.0), vector(4.0), vector(1.0), vector(0.1))
    running = metrics.begin(Start(one.start, 3, jnp.zeros(2)), criteria)
    found = metrics.finish(metrics.update(running, one, criteria), criteria)
    assert (float(found.peak_wheel_momentum), float(found.peak_wheel_torque)) == (0.3, 0.6)
    assert np.isnan(judge([interval(0, 4, (1.0, 1.0))]).peak_wheel_torque)


def test_an_interval_of_length_zero_changes_no_metric():
    plain = [interval(0, 1, (1.0, 0.5), 1.0), interval(1, 4, (0.5, 0.2), 0.5)]
    with_empty = [plain[0], interval(1, 1, (9.0, 9.0), 99.0), plain[1]]
    wanted, found = judge(plain), judge(with_empty)
    for name, value in wanted.items():
        np.testing.assert_array_equal(found[name], value, err_msg=name)


def test_a_metric_that_the_run_lacks_is_nan_and_not_listed():
    found = judge([interval(0, 4, (1.0, 1.0))])
    for name in ("peak_wheel_torque", "peak_modal", "ape_x", "within_rke_boresight"):
        assert name not in found
        assert np.isnan(getattr(found, name))
    with pytest.raises(AttributeError, match="ape_w"):
        _ = found.ape_w


def test_metrics_of_many_runs_survive_jax_transformations():
    def squares(x):
        return metrics.Metrics({"window_error": x**2, "effort": 2.0 * x})

    values, slopes = jax.jvp(jax.vmap(squares), (jnp.arange(3.0),), (jnp.ones(3),))
    np.testing.assert_array_equal(values.window_error, [0.0, 1.0, 4.0])
    np.testing.assert_array_equal(slopes.window_error, [0.0, 2.0, 4.0])
    np.testing.assert_array_equal(values.peak_modal, [np.nan] * 3)
    assert list(pickle.loads(pickle.dumps(jax.device_get(values)))) == ["window_error", "effort"]


@pytest.mark.parametrize("flight", [False, True])
def test_the_last_row_of_a_history_has_the_torque_of_the_last_period(flight):
    """Periods of length zero beyond t_end, and the period before t = 0, have no effect."""
    body = parts(20.0, 3.0, 0.53, period=0.05, noise=(2e-4, 1e-5))
    run = chain_flight() if flight else body  # with the compiled programs of other tests
    log = fly(run, 1, 4).log
    rows = np.flatnonzero(np.asarray(log.has_length))
    np.testing.assert_array_equal(log.u[rows[-1]], log.u[rows[-2]])
