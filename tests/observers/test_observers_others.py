"""Prescribed-time and finite-time observers against closed forms and bounds, and all observers on all plants."""

import itertools
from dataclasses import replace

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from scipy.integrate import quad, solve_ivp
from scipy.linalg import expm

from ptsmc_jax import scenario
from ptsmc_jax.observers import finite_time, prescribed_time
from ptsmc_jax.plants import base, integrator_chain, rigid_body, second_order
from ptsmc_jax.signals import disturbances
from ptsmc_jax.simulation import rollout
from tests.helpers import FULL_INERTIA, chain_parts, fly, short, vector

MASS: base.Plant = integrator_chain.chain(2)  # one input, M = 1
GAIN, T_O, DELTA_O, MU = 0.7, 4.0, 0.2, 2.5


def prescribed_time_observer(model: base.Plant = MASS, gain=GAIN, c=0.0, start=0.0, mu=MU, t_o=T_O, delta_o=DELTA_O):
    """Return a prescribed-time observer of a plant with the same gain for every input.

    c: bound on the rate of d. start: bound on the initial estimation error. mu, t_o, delta_o: as in the observer.
    """
    values = (vector([gain] * model.inputs), *map(vector, (c, start, mu)))
    return prescribed_time.PrescribedTimeObserver(model, *values, t_o=vector(t_o), delta_o=vector(delta_o))


def finite_time_observer(model: base.Plant = MASS, gain=1.0, c=0.0, start=0.0, width=0.0):
    """Return a finite-time observer of a plant with the same gain for every input.

    c: bound on the rate of d. start: bound on the initial estimation error. width: boundary layer.
    """
    return finite_time.FiniteTimeObserver(model, vector([gain] * model.inputs), vector(c), vector(start), vector(width))


def remaining_fraction(t, gain=GAIN, mu=MU):
    """Return e(t) / e(0) for a constant disturbance: e^(-l t) rho^mu.

    Here rho is (T_o - t) / T_o, which is constant after T_o - delta_o.
    """
    return np.exp(-gain * t) * (max(T_O - t, DELTA_O) / T_O) ** mu


@pytest.mark.parametrize("h", [0.05, 0.3])
def test_digital_prescribed_time_observer_error_equals_closed_form(h):
    found, d = prescribed_time_observer(), 0.4
    matrix, memory = found.update_matrix(vector(h)), found.begin()
    for k in range(1, 30):
        memory = found.update(matrix, memory, vector([d * h]), vector(k * h), vector(h))  # the impulse of a constant d
        np.testing.assert_allclose(found.estimate(memory) - d, [-d * remaining_fraction(k * h)], rtol=1e-12, atol=1e-16)


def test_prescribed_time_update_for_a_full_inertia_equals_matrix_exponential():
    found = prescribed_time_observer(rigid_body.spacecraft(FULL_INERTIA), gain=10.0)
    t, h = 3.0, 0.5
    a = 10.0 * np.linalg.inv(FULL_INERTIA)
    factor = expm(-a * h) * ((T_O - t) / (T_O - t + h)) ** MU
    d_hat, impulse = np.array([0.1, -0.2, 0.3]), np.array([0.03, 0.02, -0.01])
    got = found.update(found.update_matrix(vector(h)), vector(d_hat), vector(impulse), vector(t), vector(h))
    np.testing.assert_allclose(got, factor @ d_hat + (np.eye(3) - factor) @ impulse / h, rtol=1e-12)


def test_observer_update_over_a_period_of_length_zero_has_finite_derivatives():
    """It also leaves the estimate of the prescribed-time observer unchanged."""
    for found in (prescribed_time_observer(), finite_time_observer()):

        def updated(dt, found=found):
            memory = found.begin() + 0.1
            return found.update(found.update_matrix(dt), memory, vector([0.02]) * dt, vector(1.0), dt)

        derivative = jax.jit(jax.jacfwd(updated))(vector(0.0))
        assert np.all(np.isfinite(derivative))
        if isinstance(found, prescribed_time.PrescribedTimeObserver):
            np.testing.assert_allclose(updated(vector(0.0)), 0.1)


def simulate_continuous(observer, disturbance, t_f=6.0, steps=400):
    """Return the history of a chain with this observer in the continuous loop; steps: before and after t_s each."""
    run = chain_parts([0.3, 0.0], t_f, 3.0, 0.1, observer=observer, disturbance=disturbance, bound=0.0)
    nodes = vector(observer.nodes())
    timing = replace(run.clock, saves=nodes, before=steps, after=steps, max_step=vector(3.0 * t_f / steps))
    return fly(replace(run, clock=timing)).log


def test_continuous_prescribed_time_observer_error_equals_closed_form():
    d = 0.4
    log = simulate_continuous(prescribed_time_observer(), disturbances.Constant(vector([d])))
    expected = np.array([-d * remaining_fraction(t) for t in log.t])
    # integration error of order 4 with the nodes of the observer: 1e-7
    np.testing.assert_allclose(log.d_hat[:, 0] - d, expected, rtol=0, atol=1e-6 * d)


@pytest.mark.parametrize("gain", [0.05, 0.7, 5.0])
def test_prescribed_time_bound_is_between_1_and_2_times_the_worst_error(gain):
    """For l = 0, the bound is the exact solution. `largest` is not exceeded at any time."""
    c, start = 0.3, 0.4
    bound = prescribed_time_observer(gain=gain, c=c, start=start).error_bound()
    for t in (0.0, 0.5, 2.0, 3.5, 3.8, 4.5, 9.0):
        # e' = -(l + mu/(T_o - t)) e + c from the largest start: the integral of its propagator
        integral = quad(
            lambda u, t=t: remaining_fraction(t, gain) / remaining_fraction(u, gain),
            0.0,
            t,
            points=[3.8] if t > 3.8 else None,
        )[0]
        worst = start * remaining_fraction(t, gain) + c * integral
        assert worst <= float(bound(vector(t))) * (1 + 1e-9)
        assert float(bound(vector(t))) < 2.0 * worst
    assert float(jax.vmap(bound)(jnp.linspace(0.0, 20.0, 500)).max()) <= float(bound.largest)
    # for l = 0 the bound is the exact solution
    without_gain = prescribed_time_observer(gain=1e-9, c=c, start=start).error_bound()
    rho = (T_O - 2.0) / T_O
    exact = rho**MU * start + c * 2.0 * (1 - rho ** (MU - 1)) / (MU - 1)
    np.testing.assert_allclose(without_gain(vector(2.0)), exact, rtol=1e-6)


def super_twisting(gain, d, seconds, start=0.0):
    """Return times and errors d_hat - d of the observer with a discontinuous sign, integrated by SciPy.

    d: the disturbance as a function of time. start: d_hat at t = 0.
    """
    width = 1e-9

    def rate(t, y):
        e0, d_hat = y
        sign = np.tanh(e0 / width)
        return [d_hat - d(t) - 1.5 * np.sqrt(gain * abs(e0)) * sign, -1.1 * gain * sign]

    found = solve_ivp(
        rate, (0.0, seconds), [0.0, start], method="LSODA", rtol=1e-9, atol=1e-12, max_step=seconds / 2000
    )
    return found.t, found.y[1] - np.array([d(t) for t in found.t])


@pytest.mark.parametrize(("ratio", "constant"), [(0.0, 1.2519), (0.5, 3.1), (1.0, 33.3)])
def test_settling_time_of_the_finite_time_bound_equals_its_geometric_series(ratio, constant):
    bound = finite_time_observer(gain=2.0, c=2.0 * ratio, start=0.6).error_bound()
    np.testing.assert_allclose(bound.settled, constant * 0.6 / 2.0, rtol=0.01)
    assert float(bound(bound.settled * 0.99)) == pytest.approx(0.6)
    assert float(bound(bound.settled * 1.01)) == 0.0


@pytest.mark.parametrize("ratio", [0.0, 0.3, 0.6, 0.9])
def test_no_disturbance_within_its_rate_bound_exceeds_the_overshoot_of_the_finite_time_bound(ratio):
    """e0 moves from 0 to 0 while d' = +-ratio c changes its sign on a line e = k sqrt(e0); the worst of several k."""
    limit = np.interp(ratio, np.linspace(0, 1, 11), finite_time._OVERSHOOT)
    worst, h = 0.0, 5e-4
    for switch in (-9.0, 0.0, 0.5, 1.0, 1.5, 2.0, 9.0):
        root, error = 1e-6, 1.0  # root = sqrt(e0), which is smooth at the start
        while root > 0.0 and root + abs(error) > 1e-4:  # a small e settles without another cycle
            rate = 1.1 - ratio if error > switch * root else 1.1 + ratio
            # e0' = e - 1.5 root; with a new time s, dt = 2 root ds, both equations are smooth
            root, error = root + h * (error - 1.5 * root), error - 2.0 * root * h * rate
        worst = max(worst, -error)
    assert limit - 0.01 < worst <= limit + 0.002


@pytest.mark.parametrize("h", short([0.002, 0.02], [0.02]))
def test_digital_finite_time_observer_is_exact_after_its_settling_time(h):
    found, d = finite_time_observer(gain=0.5, start=0.4), 0.4
    memory, settled = found.begin(), None
    for k in range(1, int(4.0 / h)):
        memory = found.update(found.update_matrix(vector(h)), memory, vector([d * h]), vector(k * h), vector(h))
        if k * h > float(found.error_bound().settled) + 3 * h:
            np.testing.assert_allclose(found.estimate(memory), [d], atol=1e-12)  # exact, without chattering
            settled = k * h
    assert settled is not None


def test_digital_finite_time_observer_converges_to_the_continuous_one_with_order_1():
    found, amplitude = finite_time_observer(gain=0.5), 0.3
    t, expected = super_twisting(0.5, lambda t: 0.4 + amplitude * np.sin(t), 3.0)
    update, deviations = jax.jit(lambda memory, *now: found.update(found.update_matrix(now[-1]), memory, *now)), []
    for h in (0.02, 0.01, 0.005):
        memory, errors = found.begin(), []
        for k in range(1, round(3.0 / h) + 1):
            impulse = 0.4 * h + amplitude * (np.cos((k - 1) * h) - np.cos(k * h))
            memory = update(memory, np.array([impulse]), np.array(k * h), np.array(h))
            errors.append(float(memory[0]) - 0.4 - amplitude * np.sin(k * h))
        deviations.append(np.abs(errors - np.interp(h * np.arange(1, len(errors) + 1), t, expected)).max())
    assert deviations[0] < 0.02
    assert deviations[2] < 0.5 * deviations[0]


def test_continuous_finite_time_observer_settles_within_its_time():
    d = 0.4
    log = simulate_continuous(
        finite_time_observer(gain=0.5, start=d, width=1e-5), disturbances.Constant(vector([d])), steps=3000
    )
    settled = 1.2519 * d / 0.5
    assert np.abs(log.d_hat[log.t < 0.5 * settled, 0] - d).max() == pytest.approx(d)
    # inside the boundary layer |e0| <= width, so that the error is at most 1.5 sqrt(c width)
    assert np.abs(log.d_hat[log.t > settled + 0.05, 0] - d).max() < 1.5 * np.sqrt(0.5 * 1e-5)


KINDS = ("none", "nonlinear", "finite_time", "prescribed_time")
COMBINATIONS = list(itertools.product(("spacecraft", "chain", "system"), ("continuous", "sampled"), KINDS))
# each plant and each kind of observer at least once
SHORT_COMBINATIONS = [
    ("spacecraft", "sampled", "nonlinear"),
    ("chain", "continuous", "finite_time"),
    ("system", "sampled", "prescribed_time"),
]


@pytest.mark.parametrize(("plant", "mode", "kind"), short(COMBINATIONS, SHORT_COMBINATIONS))
def test_every_observer_is_within_its_bound_on_every_plant(plant, mode, kind):
    """The simulation has a disturbance within its bounds."""
    controller = {"t_f": 8.0, "delta": 0.4, "disturbance_rate_bound": 0.011, "disturbance_bound": 0.0101}
    tables = {
        "spacecraft": {"spacecraft": {"inertia": [1.0, 1.2, 1.4]}},
        "chain": {"plant": {"kind": "chain", "order": 3, "x0": [0.4, 0.0, 0.0]}},
        "system": {"plant": {"kind": "system", "system": PENDULUMS, "x0": [0.4, -0.3, 0.0, 0.1]}},
    }[plant]
    inputs = {"spacecraft": 3, "chain": 1, "system": 2}[plant]
    wave = {"kind": "sinusoid", "amplitude": [0.01] * inputs, "frequency": [1.0] * inputs, "phase": [1.0] * inputs}
    start = 0.01 * np.sin(1.0) * np.sqrt(inputs)
    tables |= {
        "controller": {**controller, "initial_estimate_error": float(start)},
        "observer": {
            "kind": kind,
            **({} if kind == "none" else {"gain": [0.05 if kind == "finite_time" else 3.0] * inputs}),
        },
        "disturbance": wave,
        "loop": {"mode": mode, "period": 0.02},
    }
    ready = scenario.study(scenario.from_tables(tables))
    result = fly(ready.parts)
    assert result.status == rollout.OK
    log, bound = result.log, ready.parts.observer.error_bound()
    limit = np.asarray(jax.vmap(bound)(vector(log.t)))
    size = np.linalg.norm(log.d_hat - log.disturbance, axis=1)
    # a sampled estimate is up to 1.5 periods old, 1.5 h |d'|; the boundary layer of the continuous finite-time observer
    # has an error of 1.5 sqrt(c width) in each component
    tolerance = (
        1.5 * 0.02 * 0.01 if mode == "sampled" else 1.5 * np.sqrt(0.05 * 1e-5) if kind == "finite_time" else 1e-9
    )
    assert np.all(size <= limit + np.sqrt(inputs) * tolerance), (size - limit).max()
    assert size[-1] < 2.0 * limit.max()


def _pendulums():
    """Return a custom system of two coupled pendulums, whose input gains depend on their angles."""

    def G(t, x_1, x_2):  # noqa: N802
        return jnp.diag(1.0 / (1.0 + 0.2 * jnp.cos(x_1)))

    def F(t, x_1, x_2):  # noqa: N802
        return x_2

    def H(t, x_1, x_2):  # noqa: N802
        return -jnp.sin(x_1) + 0.1 * (x_1[::-1] - x_1)

    return second_order.system(2, F, H, G, D=G)


PENDULUMS = _pendulums()


def test_gradients_by_observer_gain_are_finite_and_not_zero_without_a_rate_bound():
    """The window error of a run is differentiated by the gain of a prescribed-time and of a finite-time observer."""
    wave = disturbances.Sinusoid(*(vector([v]) for v in (0.01, 0.1, 0.0, 0.0)))
    run = chain_parts([1.0, 0.0], 6.0, 3.0, 0.3, period=0.25, disturbance=wave)
    for found in (prescribed_time_observer(run.plant, gain=10.0), finite_time_observer(run.plant, gain=0.1)):

        def error(gain, found=found):
            changed = replace(run, observer=replace(found, gain=gain[None]))
            return rollout.simulate(changed).metrics.window_error

        _, derivative = jax.jit(lambda gain: jax.jvp(error, (gain,), (jnp.ones_like(gain),)))(found.gain[0])
        assert np.isfinite(derivative)
        assert derivative != 0.0
