"""Delay, limits, lag, quantisation and wheels, each compared with a short independent model."""

import dataclasses
from itertools import pairwise

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from scipy.integrate import solve_ivp
from scipy.spatial.transform import Rotation

from ptsmc_jax import formulas, programs, scenario
from ptsmc_jax.campaigns import runs
from ptsmc_jax.devices import actuators, attitude_filter, sensors
from ptsmc_jax.numerics import draws
from ptsmc_jax.plants.rigid_body import AttitudeState
from ptsmc_jax.scenario.errors import ScenarioError
from ptsmc_jax.signals import disturbances
from ptsmc_jax.simulation import catalogues, control_period, rollout
from tests.helpers import FULL_INERTIA, fly, parts, short, ticks_of, vector, with_controller

PYRAMID = formulas.pyramid()


def drive_of(device, v, c):
    """Return the drive of channels with the torque v (m,) at the start of a period and the command c (m,) [N m]."""
    return actuators.Drive(vector(v), vector(c), None, jnp.asarray(False))


# the first channel's torque, its integral and its double integral at times (time,)
channels = jax.jit(
    jax.vmap(lambda device, drive, s: jnp.stack(device.channel_torques(drive, s))[:, 0], (None, None, 0))
)


@pytest.mark.parametrize("lag", [None, 0.03, 0.5])
@pytest.mark.parametrize("rate_limit", [None, 0.4, 20.0])
def test_torques_of_actuator_channels_follow_their_differential_equation(lag, rate_limit):
    """The equation is v' = clip((c - v)/lag, -R, R), or without a lag v' = R sign(c - v) until v = c."""
    device = actuators.Actuators(
        rate_limit=None if rate_limit is None else vector(rate_limit), lag=None if lag is None else vector(lag)
    )
    for start, target in ((0.2, -0.3), (-0.1, 0.4), (0.1, 0.1)):
        for s in (0.0, 0.01, 0.2, 1.5):
            times = np.linspace(0.0, s, 20_001)
            found, impulse, second = np.asarray(channels(device, drive_of(device, [start], [target]), times)).T
            if lag is None:
                gap = target - start
                step = gap if rate_limit is None else np.clip(gap, -rate_limit * s, rate_limit * s)
                expected = start + step
            else:
                limit = np.inf if rate_limit is None else rate_limit
                simulated = solve_ivp(
                    lambda _, v, target=target, limit=limit: np.clip((target - v) / lag, -limit, limit),
                    (0.0, s), [start], rtol=1e-10, atol=1e-12, max_step=0.01,
                )  # fmt: skip
                expected = simulated.y[0, -1]
            np.testing.assert_allclose(found[-1], expected, rtol=0, atol=1e-8)
            np.testing.assert_allclose(impulse[-1], np.trapezoid(found, times), rtol=0, atol=1e-6)
            np.testing.assert_allclose(second[-1], np.trapezoid(impulse, times), rtol=0, atol=1e-6)


def commanded(device, u, *, v=None, h=None, dt=0.1):
    """Return the `Drive` of a command u (3,) [N m] in one period from t = 0, and the actuator state at its end.

    v: torque of each channel at the start [N m]. h: momentum of each wheel [N m s]. If they are None, the device has no
    such state. dt: length of the period [s].
    """
    state = actuators.ActuatorState(None, None if v is None else vector(v), None if h is None else vector(h))
    t, dt, rest = vector(0.0), vector(dt), vector([0.0] * 3)
    drive, queue = device.command(state, vector(u), rest, t, dt, vector(1.0))
    return drive, device.end(state, drive, queue, dt)


@pytest.mark.parametrize("lag", [None, 0.05])
def test_a_command_counts_as_limited_if_one_axis_exceeds_its_rate_limit(lag):
    """The rate limit R does not act if |c - v| <= R (dt + lag)."""
    device = actuators.Actuators(rate_limit=vector(2.0), lag=None if lag is None else vector(lag))
    most = 2.0 * (0.1 + (lag or 0.0))
    for far, limited in ((0.99 * most, False), (1.01 * most, True)):
        assert bool(commanded(device, [far, 0.0, -0.1], v=[0.0] * 3)[0].limited) == limited


@pytest.mark.parametrize("lag", [None, 0.08])
@pytest.mark.parametrize("way", [1.0, -1.0])
def test_wheels_end_a_period_at_their_momentum_limit(lag, way):
    """A torque in either direction that would exceed the limit is reduced, so that the period ends at the limit."""
    wheels = actuators.wheels(np.eye(3), None, momentum_limit=0.5)
    device = actuators.Actuators(lag=None if lag is None else vector(lag), wheels=wheels)
    v = None if lag is None else [0.3 * way] * 3
    drive, end = commanded(device, [50.0 * way] * 3, v=v, h=[0.2, -0.3, 0.0])
    assert end.h is not None
    np.testing.assert_allclose(end.h, [-0.5 * way] * 3, rtol=1e-13)
    assert drive.limited


@pytest.mark.parametrize("share", [0.5, 2.0])
def test_effort_includes_the_lag_within_a_period(share):
    """The effort is the integral of c - (c - v) exp(-s/lag). Simpson's error is dt^5/2880 times the 4th derivative."""
    lag, v, c, u = 0.2, vector([0.1, -0.4, 0.0]), vector([0.5, -0.2, 0.3]), vector([0.0] * 3)
    dt = share * lag
    device = actuators.Actuators(lag=vector(lag))
    torques = control_period.period_torques(device, actuators.Drive(v, c, None, jnp.asarray(False)), u, vector(dt))
    got = dt * sum(w * np.sum(np.abs(at)) for w, at in zip(torques.weights, torques.delivered, strict=True))
    exact = float(np.sum(np.abs(c * dt + (c - v) * lag * np.expm1(-share))))
    assert 0.0 < abs(got - exact) < dt**5 / 2880 * float(np.sum(np.abs(c - v))) / lag**4


def test_quantisation_rounds_the_torque_and_has_derivative_one():
    u = vector([0.024, -0.036, 0.0])
    np.testing.assert_allclose(actuators.quantise(u, vector(0.01)), [0.02, -0.04, 0.0], atol=1e-17)
    np.testing.assert_array_equal(jax.jacfwd(lambda u: actuators.quantise(u, vector(0.01)))(u), np.eye(3))


def with_device(device, t_end=23.0, **changes):
    """Return the parts of a noisy slew of 20 s with these actuators; changes: of `helpers.parts`."""
    run = parts(20.0, 3.0, 1.0, period=0.1, noise=(2e-5, 1e-6), flight=True, t_end=t_end, **changes)
    return dataclasses.replace(run, actuators=device)


@pytest.mark.parametrize("step", [0.01, 0.03])
def test_limited_and_quantised_torque_is_delivered_after_the_delay(step):
    """The multiple of the step nearest to the limit of 0.11 N m may exceed the limit."""
    device = actuators.Actuators(torque_limit=vector(0.11), step=vector(step), delay=3)
    result = fly(with_device(device, t_end=120.0), 1, 2)
    log = result.log
    np.testing.assert_array_equal(log.u[:3], np.zeros((3, 3)))
    expected = np.clip(np.round(np.clip(log.commanded, -0.11, 0.11) / step) * step, -0.11, 0.11)
    np.testing.assert_allclose(log.u[3:-1], expected[:-4], atol=1e-15)
    assert float(result.metrics.peak_torque) > 0.11
    np.testing.assert_allclose(result.metrics.peak_torque_delivered, 0.11)
    beyond = np.any(np.abs(log.commanded[:-4]) > 0.11, axis=1)
    np.testing.assert_allclose(result.metrics.saturated, np.sum(np.diff(log.t)[3:][beyond]) / 120.0, rtol=1e-9)


def wheels_by_an_adaptive_integrator(inertia, axes, log, lag, limit, intervals):
    """Return attitude (4,) and wheel momenta (n,) after some periods, integrated from the first row of the log.

    The equations are J w' = A v - w x (J w + A h) and h' = -v. axes: A (3, n). lag: time constant [s] of the torque, or
    None. limit: largest rate of the torque [N m/s]. intervals: number of periods.
    """
    n, inverse = axes.shape[1], np.linalg.inv(inertia)
    y = np.concatenate([log.x.q[0], log.x.w[0], log.wheels[1][0], log.wheels[0][0]])

    def rate(t, y, c):
        q, w, v, h = y[:4], y[4:7], y[7 : 7 + n], y[7 + n :]
        v_dot = np.zeros(n) if lag is None else np.clip((c - v) / lag, -limit, limit)
        w_dot = inverse @ (axes @ v - np.cross(w, inertia @ w + axes @ h))
        return np.concatenate([0.5 * (q[3] * w + np.cross(q[:3], w)), [-0.5 * q[:3] @ w], w_dot, v_dot, -v])

    for k in range(intervals):
        c = np.linalg.pinv(axes) @ (log.commanded[k] + np.cross(log.x.w[k], axes @ log.wheels[0][k]))
        gap = c - log.wheels[1][k]
        ramps = [] if lag is None else np.abs(gap - np.clip(gap, -limit * lag, limit * lag)) / limit
        y[7 : 7 + n] = c if lag is None else y[7 : 7 + n]
        ends = [log.t[k], *np.sort([log.t[k] + r for r in ramps if 0 < r < log.t[k + 1] - log.t[k]]), log.t[k + 1]]
        for start, end in pairwise(ends):  # the torque is smooth in each interval
            y = solve_ivp(rate, (start, end), y, args=(c,), method="DOP853", rtol=1e-13, atol=1e-15).y[:, -1]
    return y[:4], y[7 + n :]


CHANNELS = [(None, np.inf), (0.2, np.inf), (0.05, np.inf), (0.1, 0.5)]


MOST, SAMPLES = 64, 160  # integration steps per period, and periods: equal, to share one compiled program


def with_equal_sizes(ready, substeps=MOST):
    """Return the study with SAMPLES periods of `substeps` integration steps, so that runs share one program."""
    timing = dataclasses.replace(ready.parts.clock, count=SAMPLES)
    return dataclasses.replace(ready, parts=dataclasses.replace(ready.parts, clock=timing, substeps=substeps))


MOMENTA = [[0.5, -0.2, 0.1, 0.3], [40.0, 0.0, 0.0, 0.0]]


@pytest.mark.parametrize("momentum", MOMENTA)
@pytest.mark.parametrize(("lag", "limit"), short(CHANNELS, CHANNELS[::3]))
def test_wheels_exchange_momentum_with_the_body(momentum, lag, limit):
    """Attitude and wheel momenta equal an independent integration.

    The history has momentum and torque of each wheel. The peak momentum includes the momentum at t = 0.
    """
    hardware_table = {"torque_lag": lag, "torque_rate_limit": limit if np.isfinite(limit) else None}
    tables = {
        "spacecraft": {"inertia": FULL_INERTIA},
        "initial": {"rotvec_deg": [60.0, -40.0, 70.0], "rate": [0.02, -0.01, 0.03]},
        "disturbance": {"kind": "none"},
        "controller": {"t_f": 15.0, "delta": 1.0},
        "loop": {"mode": "sampled", "period": 0.1, "clock": "flight", "t_end": 16.0},
        "hardware": {key: value for key, value in hardware_table.items() if value is not None},
    }
    ready = scenario.study(scenario.from_tables({**tables, "wheels": {"momentum": momentum}}))
    assert ready.parts.substeps <= MOST
    simulated = runs.simulate(with_equal_sizes(ready))
    log, axes, inertia = simulated.log, PYRAMID.T, np.asarray(FULL_INERTIA)
    assert log.wheels is not None
    q, h = wheels_by_an_adaptive_integrator(inertia, axes, log, lag, limit, intervals := 80)
    off = Rotation.from_quat(q).inv() * Rotation.from_quat(log.x.q[intervals])
    assert off.magnitude() < 1e-9
    np.testing.assert_allclose(log.wheels[0][intervals], h, rtol=0, atol=1e-12 * max(np.abs(momentum)) + 1e-13)
    wheel_columns = [name for name in simulated.columns() if name[0] in "hv"]  # of trajectory.csv
    assert wheel_columns == [f"{name}{k}" for name in "hv" for k in range(1, 5)]
    largest = simulated.metrics["peak_wheel_momentum"]
    assert largest >= np.abs(log.wheels[0]).max()  # t = 0 counts too
    np.testing.assert_allclose(largest, np.abs(log.wheels[0]).max(), rtol=2e-3)


CUBESAT = {
    "spacecraft": {"inertia": [0.05, 0.08, 0.11]},
    "initial": {"rotvec_deg": [60.0, -40.0, 70.0]},
    "disturbance": {"kind": "none"},
    "controller": {"t_f": 20.0, "delta": 2.0},
    "loop": {"mode": "sampled", "period": 0.2, "clock": "flight", "t_end": 22.0},
}


@pytest.mark.parametrize("device", [{"torque_lag": 0.02}, {"torque_lag": 0.2}, {"torque_rate_limit": 5e-3}], ids=str)
def test_chosen_integration_steps_are_accurate_if_the_torque_changes_within_a_period(device):
    """The attitude equals that of 64 steps a period to 2e-9 rad in a fast slew, and to 1e-11 rad at its end."""
    ready = scenario.study(scenario.from_tables({**CUBESAT, "wheels": {}, "hardware": device}))
    assert ready.parts.substeps < 8
    ours, fine = (runs.simulate(with_equal_sizes(ready, steps)).log.x.q for steps in (ready.parts.substeps, MOST))
    errors = (Rotation.from_quat(ours).inv() * Rotation.from_quat(fine)).magnitude()
    assert errors.max() < 2e-9
    assert errors[-1] < 1e-11


SPINNING = {**CUBESAT, "wheels": {"momentum": [0.4, 0.0, 0.0, 0.0]}}


def test_integration_steps_resolve_the_nutation():
    """A momentum of 0.4 N m s gives a CubeSat a nutation of 1.6 rad per period, so that |H|/J sets the steps."""
    steps = scenario.study(scenario.from_tables(SPINNING)).parts.substeps
    assert steps == MOST
    assert steps >= 0.4 / np.sqrt(0.05 * 0.08) * 0.2 / 0.025


def test_different_gains_have_the_same_number_of_integration_steps():
    """Another number of steps needs another compiled program."""
    frequency = {"flexible": {"frequency": [4.5], "damping": [0.005], "coupling": [[0.02, 0.0, 0.0]]}}
    tables = {**CUBESAT, **frequency, "loop": {**CUBESAT["loop"], "t_end": 60.0}}
    each = {
        scenario.study(
            scenario.from_tables({**tables, "controller": {"t_f": 50.0, "delta": 2.0, "eta": eta}})
        ).parts.substeps
        for eta in np.linspace(2.5, 8.0, 6)
    }
    assert len(each) == 1


def test_integration_steps_include_the_momentum_of_the_disturbance():
    """The wheels store the impulse of a constant disturbance until t_end."""
    drifting = {"disturbance": {"kind": "constant", "amplitude": [0.005, 0.0, 0.0]}, "wheels": {}}
    ready = scenario.study(scenario.from_tables({**CUBESAT, **drifting}))
    assert ready.parts.substeps >= 0.005 * 22.0 / np.sqrt(0.05 * 0.08) * 0.2 / 0.025


@pytest.mark.parametrize(
    ("changes", "said"),
    [
        ({"wheels": {"momentum": [4.0, 0.0, 0.0, 0.0]}}, r"^wheels\.momentum is \[4\.0.*must be lower: loop\.period"),
        ({"wheels": {}, "disturbance": {"kind": "constant", "amplitude": [0.5] * 3}}, r"^disturbance\.amplitude is"),
    ],
)
def test_wheel_momentum_that_is_too_large_for_the_control_period_is_a_configuration_error(changes, said):
    with pytest.raises(ScenarioError, match=said):
        scenario.study(scenario.from_tables({**CUBESAT, **changes}))


def with_spinning(wheels, **changes):
    """Return the parts of a slew with these wheels, without noise and disturbance; changes: of `helpers.parts`."""
    quiet = disturbances.Constant(vector([0.0] * 3))
    run = parts(20.0, 3.0, 1.0, period=0.1, flight=True, disturbance=quiet, **changes)
    return dataclasses.replace(run, actuators=actuators.Actuators(wheels=wheels))


def test_peak_wheel_momentum_includes_the_initial_momentum():
    """The wheel gives momentum to the body and takes back less, so that its momentum is largest at t = 0."""
    spinning = actuators.wheels(np.eye(3), [5.0, 0.0, 0.0])
    turned = {"q": Rotation.from_rotvec([-1.0, 0.0, 0.0]).as_quat(), "rate": (-0.1, 0.0, 0.0)}
    result = fly(with_spinning(spinning, **turned))
    assert np.all(np.abs(result.log.wheels[0][1:]) < 5.0)
    assert result.metrics.peak_wheel_momentum == 5.0


@pytest.mark.parametrize("early", [True, False])
def test_wheel_and_allocation_change_at_the_same_sample_on_failure(early):
    """At a sample exactly at the failure time the other wheels deliver the whole torque."""
    device = actuators.wheels(PYRAMID)
    failing = actuators.Actuators(
        wheels=device,
        failure_times=vector([3.0, np.inf, np.inf, np.inf]),
        spare_allocations=actuators.spare_allocations(device),
    )
    at, u, one = vector(np.nextafter(3.0, 0.0) if early else 3.0), vector([0.1, -0.2, 0.3]), vector(1.0)
    drive, _ = failing.command(failing.begin(3), u, vector(np.zeros(3)), at, one, one)
    assert drive.works is not None
    assert drive.works.tolist() == [early, True, True, True]
    np.testing.assert_allclose(failing.on_body(failing.torque_and_momentum(drive, vector(0.5))[0]), u, atol=1e-15)
    assert (abs(float(drive.c[0])) > 1e-3) is early


def test_wheel_allocation_gives_the_commanded_torque_for_any_wheel_axes():
    rng = np.random.default_rng(0)
    for axes in (PYRAMID, np.eye(3), rng.normal(size=(6, 3)), 7.0 * rng.normal(size=(3, 3))):
        found = actuators.wheels(axes)
        np.testing.assert_allclose(found.axes @ found.allocation, np.eye(3), atol=1e-12)
        np.testing.assert_allclose(np.linalg.norm(found.axes, axis=0), 1.0)
    flat = [[1, 0, 0], [0, 1, 0], [1, 1, 0]]
    for bad, said in ((flat, "span"), (flat[:2], "span"), ([1, 2, 3], "rows"), ([[0, 0, 0]] * 3, "rows")):
        with pytest.raises(ValueError, match=said):
            actuators.wheels(bad)
    strength = np.abs(PYRAMID).sum(axis=0)
    np.testing.assert_allclose(strength, strength[0])  # the default cant


def everything(delta=0.93, **changes):
    """Return the parts of a run with every device enabled; changes: of `helpers.parts`."""
    run = parts(
        15.0,
        3.2,
        delta,
        30.0,
        period=0.1,
        t_end=18.0,
        sign_width=0.05,
        inertia=FULL_INERTIA,
        **changes,
    )
    filtered = attitude_filter.attitude_filter(0.5, 2e-5, 1e-6, 1e-8, 0.1, 2)
    sensing = sensors.Sensors(vector(2e-5), vector(1e-6), vector(1e-5), vector(1e-8), filtered, 2)
    device = actuators.Actuators(
        torque_limit=vector(3.0), rate_limit=vector(4.0), lag=vector(0.03), step=vector(1e-13),
        wheels=actuators.wheels(PYRAMID, [0.1, 0.0, 0.0, 0.0], 2.0, 5.0), delay=1,
    )  # fmt: skip
    gravity = disturbances.GravityGradient(run.plant.inertia, vector([0.0, 0.0, 0.0, 1.0]), vector(1e-3), vector(0.4))
    total = disturbances.Sum((run.disturbance, gravity))
    return dataclasses.replace(run, sensors=sensing, actuators=device, disturbance=total, walk_rate=vector([1e-4] * 3))


def window_error_with_every_device(eta, delta, gain):
    """Return the window error, a scalar, of a noisy run with every device and these gains of law and observer."""
    run = with_controller(everything(), eta=eta, delta=delta)
    run = dataclasses.replace(run, observer=dataclasses.replace(run.observer, gain=jnp.full(3, gain)))
    return rollout.simulate(run, 3, 5).metrics.window_error


@programs.jit
def window_error_and_derivative(gains, along):
    """Return the window error and its derivative along a direction of the gains (3,).

    gains, along: values and direction of eta, delta and the observer's gain.
    """
    return jax.jvp(lambda gains: window_error_with_every_device(*gains), (gains,), (along,))


def test_gradients_with_every_device_equal_finite_differences():
    point = np.array([3.2, 0.93, 30.0])
    for k, along in enumerate(np.eye(3)):
        slope = window_error_and_derivative(point, along)[1]
        assert np.isfinite(slope)
        h = 2e-5 * point[k] * along  # large enough to average over the quantisation of 1e-13 N m
        up, down = (window_error_and_derivative(at, along)[0] for at in (point + h, point - h))
        np.testing.assert_allclose(slope, (up - down) / (2 * h[k]), rtol=1e-4)


def test_window_error_of_a_run_is_continuous_where_delta_is_a_multiple_of_the_period():
    """The run has delay, filter and random walk. A first period of length 0 has no weight."""
    gains = (np.array([3.2, 1.0 + shift, 30.0]) for shift in (-1e-7, 1e-7))
    below, above = (window_error_and_derivative(at, np.eye(3)[1])[0] for at in gains)
    np.testing.assert_allclose(below, above, rtol=1e-4)


def test_gravity_gradient_is_the_textbook_torque():
    inertia, rate = np.diag([10.0, 12.0, 14.0]), 1.1e-3
    whole = disturbances.GravityGradient(vector(inertia), vector([0.0, 0.0, 0.0, 1.0]), vector(rate), vector(0.0))
    for angle in (0.0, 0.3, 1.0):
        # pitched about z by an angle from the radial direction x
        q = Rotation.from_rotvec([0.0, 0.0, angle]).as_quat()
        found = whole(vector(0.0), AttitudeState(vector(q), vector([0.0] * 3)))
        expected = [0.0, 0.0, -1.5 * rate**2 * (12.0 - 10.0) * np.sin(2 * angle)]
        np.testing.assert_allclose(found, expected, atol=1e-18)
        # a quarter of the orbit later the angle from the radial direction differs by 90 deg
        later = whole(vector(np.pi / 2 / rate), AttitudeState(vector(q), vector([0.0] * 3)))
        np.testing.assert_allclose(later, [0.0, 0.0, 1.5 * rate**2 * 2.0 * np.sin(2 * angle)], atol=1e-18)


def walking():
    """Return the parts of a run whose disturbance is a random walk of 1e-3 N m / sqrt(s)."""
    run = parts(10.0, 3.0, 0.5, period=0.1, t_end=12.0, disturbance=disturbances.Constant(vector([0.0] * 3)))
    return dataclasses.replace(run, walk_rate=vector([1e-3 / np.sqrt(0.1)] * 3))


def test_random_walk_is_the_sum_of_its_random_steps():
    """The steps come from the documented random stream."""
    run = walking()
    d = fly(run, 4, 7).log.disturbance
    ticks, key = ticks_of(run.clock, run.controller.t_f, run.controller.delta), draws.stream(4, 7, "disturbance_walk")
    steps = jax.vmap(lambda now: run.walk_rate * (now.t_next - now.t) * draws.normals(key, 3, now.sample))(ticks)
    grown = jnp.cumsum(steps, axis=0)
    np.testing.assert_allclose(d[:-1], grown, rtol=0, atol=1e-13 * float(jnp.max(jnp.abs(grown))))
    assert np.ptp(grown, axis=0).min() > 1e-4


def test_gradients_of_actuators_are_finite_where_functions_are_not_differentiable():
    """These points are at a limit, at rest and at the target, where clip, sign and the end of a ramp have a kink."""
    device = actuators.Actuators(
        torque_limit=vector(0.3), rate_limit=vector(0.5), lag=vector(0.1), step=vector(0.1),
        wheels=actuators.wheels(PYRAMID, None, 0.2, 0.5), delay=1,
    )  # fmt: skip

    def outcome(u, v, h, dt):
        state = actuators.ActuatorState(u[None], v, h)
        drive, queue = device.command(state, u, vector([0.0] * 3), vector(0.0), dt, vector(1.0))
        end = device.end(state, drive, queue, dt)
        return (
            device.on_body(device.torque_and_momentum(drive, dt)[0]),
            device.torque_over(drive, 0.0 * dt, dt),
            end.v,
            end.h,
        )

    slopes_of = jax.jit(jax.jacfwd(outcome, (0, 1, 2, 3)))
    zero, full = vector([0.0] * 4), vector([0.5] * 4)
    for u in (vector([0.0] * 3), vector([0.3, -0.3, 0.3]), vector([0.05, 0.0, 0.0])):
        for v, h in ((zero, zero), (zero, full), (vector([0.2] * 4), -full)):
            for dt in (vector(0.0), vector(0.1)):
                slopes = slopes_of(u, v, h, dt)
                assert all(np.all(np.isfinite(leaf)) for leaf in jax.tree.leaves(slopes))


def test_a_saturated_slew_stays_finite_and_converges_after_t_f():
    """Its status is "not converged" at t_f, and all metrics are finite."""
    device = actuators.Actuators(torque_limit=vector(0.1), step=vector(1e-3), delay=3)
    result = fly(with_device(device, t_end=120.0))
    assert int(result.status) == rollout.NOT_CONVERGED
    assert result.bad_time == 20.0
    metrics = result.metrics
    always = [name for name, entry in catalogues.CATALOGUE.items() if entry.table is None]
    kept = {name: float(getattr(metrics, name)) for name in always}
    assert all(map(np.isfinite, kept.values()))
    assert float(metrics.terminal_angle) > 0.1
    assert float(metrics.settling_time) > 20.0  # the hold law converges after t_f
    assert float(metrics.saturated) > 0.1
    assert np.abs(result.log.u).max() <= 0.1


@pytest.mark.parametrize("lag", short([None, 0.08], [None]))
def test_momentum_limit_does_not_violate_the_torque_limit(lag):
    limits = actuators.wheels(PYRAMID, [0.4, 0.0, 0.0, -0.4], torque_limit=0.1, momentum_limit=0.45)
    device = actuators.Actuators(lag=None if lag is None else vector(lag), wheels=limits)
    run = dataclasses.replace(with_device(device), substeps=4)
    result = fly(run, 1, 2)
    assert np.all(np.abs(result.log.u) <= 0.1 * np.abs(PYRAMID).sum(axis=0) * (1 + 1e-9))
    # with a lag the momentum limit may be exceeded, because the torque limit has priority
    assert float(result.metrics.peak_wheel_momentum) <= 0.45 * (1 + 1e-9) + (0.0 if lag is None else 0.1 * 0.08)
    assert int(result.status) == rollout.NOT_CONVERGED


def test_observer_estimates_no_disturbance_from_wheel_momentum():
    """One wheel has 20 N m s, and there is no disturbance. The observer knows w x A h at both ends of the period."""
    spinning = actuators.wheels(np.eye(3), [20.0, 0.0, 0.0])
    log = fly(with_spinning(spinning)).log
    # the error of the trapezium rule is h^2/12 w'' H, with w'' = 0.05 rad/s^3 at the end of the slew
    assert np.abs(log.d_hat).max() < 1e-3


def test_wheel_momentum_compensation_has_the_delay_of_the_command():
    """The flight computer adds w x A h to the command of the same sample, so that both have the same delay."""
    momentum, rate = [0.3, -0.1, 0.2], vector([0.02, 0.05, -0.01])
    device = actuators.Actuators(wheels=actuators.wheels(np.eye(3), momentum), delay=2)
    state, applied = device.begin(3), []
    for k, w in enumerate((rate, 0.0 * rate, 0.0 * rate)):
        drive, queue = device.command(state, vector([0.0] * 3), w, vector(0.1 * k), vector(0.1), vector(1.0))
        applied.append(np.asarray(drive.c))
        state = device.end(state, drive, queue, vector(0.1))
    np.testing.assert_array_equal(applied[:2], np.zeros((2, 3)))
    np.testing.assert_allclose(applied[2], np.cross(rate, momentum), rtol=1e-14)
