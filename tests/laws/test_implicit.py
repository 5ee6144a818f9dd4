"""Implicit sampling of the law of the paper: s reaches its commanded value at the end of each period, for any delta."""

from dataclasses import replace

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from ptsmc_jax import scenario
from ptsmc_jax.laws.base import Sample
from ptsmc_jax.laws.kinematics import ChainKinematics, MultiplicativeKinematics, SecondOrderKinematics
from ptsmc_jax.laws.prescribed_time import PrescribedTime, PrescribedTimeChain, surface_coefficients
from ptsmc_jax.numerics import integrators
from ptsmc_jax.plants import integrator_chain, rigid_body, system
from ptsmc_jax.scenario.errors import ScenarioError
from ptsmc_jax.signals import references
from ptsmc_jax.simulation import clock, rollout
from ptsmc_jax.theory import linear, margins, stability_limits
from tests.helpers import FULL_INERTIA, fly, short, vector
from tuning.search.gains import with_gains

H, T_F = 0.1, 5.0
X0 = {2: [1.0, 0.3], 3: [1.0, 0.3, -0.2]}


def chain_parts(order=2, bound=0.0, disturbance=0.0, x0=None, clock="anchored", **controller):
    """Return the parts of a sampled chain with a constant disturbance and its known bound.

    controller: other keys of its table.
    """
    law = {
        "t_f": T_F,
        "eta": order + 0.7,
        "delta": 0.4,
        "sampling": "implicit",
        "disturbance_bound": bound,
        **controller,
    }
    tables = {
        "plant": {"kind": "chain", "order": order, "x0": x0 or X0[order]},
        "controller": law,
        "disturbance": {"kind": "constant", "amplitude": [disturbance]},
        "loop": {"mode": "sampled", "period": H, "t_end": 7.0, "clock": clock},
    }
    return scenario.study(scenario.from_tables(tables)).parts


def simulate(parts):
    """Return times (samples,), states (samples, n), s and inputs, (samples,) each, at the samples."""
    log = fly(parts).log
    return tuple(v[log.has_length][:-1] for v in (log.t, log.x, log.s[:, 0], log.u[:, 0]))


@pytest.mark.parametrize("order", short([2, 3], [3]))
def test_s_at_the_samples_equals_the_continuous_law(order):
    """s = s(0) (1 - t/t_f)^(eta + n - 2) in the approach phase, and s decays like e^(-K1 t) in the hold phase.

    RK4 is exact for this plant.
    """
    t, x, s, _ = simulate(chain_parts(order, k1=1.3))
    left, power = T_F - t, 2 * order - 1.3
    before, hold = t < T_F - 0.4 - 1e-9, t > T_F - 0.4 - 1e-9
    np.testing.assert_allclose(s[before], s[0] * (left[before] / T_F) ** power, rtol=1e-10, atol=1e-15)
    np.testing.assert_allclose(s[hold], s[hold][0] * np.exp(-1.3 * (t[hold] - t[hold][0])), rtol=1e-10, atol=1e-15)
    # at the hand-over s is (39) with all poles at -1, for the states x_i that decay on s = 0 like r^(eta + 1 - i)
    last = np.flatnonzero(before)[-1]
    fraction = (0.4 / left[last]) ** (order + 0.7 - np.arange(order))
    weights = {2: [1.0, 1.0], 3: [1.0, 2.0, 1.0]}[order]
    np.testing.assert_allclose(s[last + 1], weights @ (fraction * x[last]), rtol=1e-10)
    c = np.array([float(v) for v in surface_coefficients(vector(order + 0.7), order)])
    np.testing.assert_allclose(s[0], c @ (T_F ** np.arange(order) * x[0]), rtol=1e-14)


def test_error_on_the_surface_decays_by_a_closed_form():
    """The factor for a period is (1 - eta h/(2 r)) / (1 + eta h/(2 (r - h))), with the time r to t_f."""
    t, x, s, _ = simulate(chain_parts(x0=[1.0, -2.7 / T_F]))
    assert np.abs(s[t < 4.6]).max() < 1e-14
    r = (T_F - t)[t < 4.6 - H - 1e-9]
    factor = (1 - 2.7 * H / (2 * r)) / (1 + 2.7 * H / (2 * (r - H)))
    ratio = x[1 : r.size + 1, 0] / x[: r.size, 0]
    np.testing.assert_allclose(ratio, factor, rtol=1e-9)


def test_last_command_does_not_depend_on_the_end_of_the_run():
    """A run that ends inside a period has the same commands as a longer run, as on a flight computer."""
    parts = chain_parts(k1=1.3)
    end = vector(6.97)
    shortened = replace(parts, t_end=end, clock=replace(parts.clock, t_end=end))
    (t, *_, u), (t_short, *_, u_short) = simulate(parts), simulate(shortened)
    assert t_short[-1] == t[-1] == pytest.approx(6.9)
    np.testing.assert_array_equal(u_short, u)


def test_residual_s_equals_the_effect_of_the_disturbance_in_one_period():
    """With |d| <= K, s+ = g d without chattering; g is the change of s by a unit input in a period."""
    t, _, s, u = simulate(chain_parts(bound=0.2, disturbance=0.15, k1=2.0))
    hold = t > 5.0  # s is inside the dead zone
    np.testing.assert_allclose(s[hold], 0.15 * (H + H**2 / 2), rtol=1e-9)
    np.testing.assert_allclose(u[hold], -0.15, atol=0.15 * H)  # the tolerance is the input for the decay on the surface


def test_implicit_sampling_has_50_times_less_chattering_than_the_discontinuous_sign():
    """The discontinuous sign changes the input by 2 K every one or two periods."""
    values = {}
    for sampling in ("explicit", "implicit"):
        run = fly(chain_parts(bound=0.2, disturbance=0.15, sampling=sampling, sign_width=0.0))
        values[sampling] = float(run.metrics.chattering), float(run.metrics.hold_error)
    assert values["implicit"][0] < values["explicit"][0] / 50.0
    assert values["implicit"][1] < values["explicit"][1]


@pytest.mark.parametrize("order", [2, 3])
def test_derivatives_of_the_window_error_equal_finite_differences(order):
    """Central differences with a step of 1e-6 have a truncation error of 1e-12 and a rounding error of 1e-10."""
    parts, step = with_longer_clock(chain_parts(order, bound=0.01, disturbance=0.005)), 1e-6
    at, names = np.array([order + 0.7, 0.43, 1.3, T_F]), ("eta", "delta", "k1", "t_f")
    for name, along in zip(names, np.eye(4), strict=True):
        derivative = _value_and_derivative(parts, at, along)[1]
        up, down = (_value_and_derivative(parts, at + sign * step * along, along)[0] for sign in (1, -1))
        np.testing.assert_allclose(derivative, (up - down) / (2 * step), rtol=1e-4, atol=1e-9, err_msg=name)


@jax.jit
def _value_and_derivative(parts, at, along):
    """Return the window error and its derivative along a direction of the gains.

    at, along: values and direction of eta, delta, k1 and t_f.
    """

    def error(at):
        moved = with_gains(parts, dict(zip(("eta", "delta", "k1", "t_f"), at, strict=True)))
        return rollout.simulate(moved).metrics.window_error

    return jax.jvp(error, (at,), (along,))


def with_longer_clock(parts):
    """Return the parts with a clock that has enough periods for other values of t_f and delta."""
    return replace(parts, clock=replace(parts.clock, count=parts.clock.count + 4))


@pytest.mark.parametrize("eta", [2.2, 3.0, 5.0])
def test_implicit_gains_equal_the_jacobian_of_the_law_and_are_stable_for_any_delta(eta):
    """With a delay, the smallest delta is positive, but smaller than that of explicit sampling."""
    parts = chain_parts(eta=eta, delta=H)
    law = parts.controller
    for tau in (2.1, 3.5, 20.0):
        now = Sample(vector(T_F - tau * H), jnp.asarray(False), vector(H))
        jacobian = jax.jit(jax.jacfwd(lambda x, now=now: law(now, x, None, jnp.zeros(1), vector(0.0))[0]))(jnp.zeros(2))
        kp, kd = stability_limits.implicit_gains(eta, tau)
        np.testing.assert_allclose(jacobian, [[-kp / H**2, -kd / H]], rtol=1e-12)
        assert stability_limits.spectral_radius(kp, kd, 1.0) < 1.0
    assert stability_limits.smallest_delta(eta, H, implicit=True) == 0.0
    delayed = [stability_limits.smallest_delta(eta, H, 1.0, implicit=implicit) for implicit in (True, False)]
    assert 0.0 < delayed[0] < delayed[1]


def test_implicit_sampling_has_no_largest_k1_without_delay():
    assert stability_limits.largest_reaching(0.05, implicit=True) == np.inf
    delayed = [stability_limits.largest_reaching(0.05, 1.0, implicit=implicit) for implicit in (True, False)]
    assert delayed[0] > delayed[1]


def test_hand_over_one_period_before_t_f_does_not_amplify_position_noise():
    """A hand-over target from the s of the approach phase would turn position noise into a rate of eta / h times it.

    With K1 = 1 1/s the rate causes an error of about 0.4 s times the rate in the second after t_f, 0.4 * 30 times the
    noise. The actual error is less than a third of that. Explicit sampling, which is unstable here, has a larger error.
    """
    noise, error = 1e-5, {}
    for sampling in ("explicit", "implicit"):
        tables = {
            "plant": {"kind": "chain", "order": 2, "x0": [0.02, 0.0]},
            "controller": {"t_f": T_F, "eta": 3.0, "delta": H, "sampling": sampling, "disturbance_bound": 0.0},
            "disturbance": {"kind": "none"},
            "hardware": {"state_noise": [noise, 1e-7]},
            "loop": {"mode": "sampled", "period": H, "t_end": 7.0},
        }
        parts = scenario.study(scenario.from_tables(tables)).parts
        trials = jax.vmap(lambda trial, parts=parts: rollout.simulate(parts, 0, trial).metrics.window_error)
        error[sampling] = np.sqrt(np.mean(jax.jit(trials)(np.arange(256, dtype=np.uint32)) ** 2))
    assert error["implicit"] < 0.4 * 3.0 / H * noise / 3.0 < error["explicit"]


@pytest.mark.parametrize("hold", [False, True])
def test_s_of_a_second_order_system_with_constant_gain_is_exact_after_a_period(hold):
    plant = system(1, lambda t, a, b: b, lambda t, a, b: 0.0 * a, lambda t, a, b: 2.0 * jnp.eye(1))
    gains = (vector(v) for v in (30.0, 3.0, 2.0, 1.5, 1e-3, 1.2))
    law = PrescribedTime(SecondOrderKinematics(plant), *gains, implicit=True)
    e, rate, h, left = 0.3, -0.04, 0.2, 2.0 if hold else 18.0
    now = Sample(vector(30.0 - left), jnp.asarray(hold), vector(h))
    u, s, _ = law(now, vector([e, rate]), now.t, jnp.zeros(1), vector(0.0))
    e, rate = e + h * rate + h**2 * float(u[0]), rate + 2.0 * h * float(u[0])
    after = rate + 1.2 * e if hold else (left - h) * rate + 3.0 * e
    fraction = np.exp(-1.5 * h) if hold else ((left - h) / left) ** 3
    np.testing.assert_allclose(after, fraction * s[0], rtol=1e-12)


@pytest.mark.parametrize("clock", short(["anchored", "flight"], ["flight"]))
def test_implicit_loop_is_stable_beyond_the_stability_limit_of_explicit_sampling(clock):
    """With eta = 4 and delta of one period, explicit sampling is unstable.

    The poles of the loop linearised along a run equal the closed form.
    """
    radius = {}
    for sampling in ("explicit", "implicit"):
        parts = chain_parts(eta=4.0, delta=H, sampling=sampling, clock=clock)
        law, run = parts.controller, linear.simulate_nominal_jit(parts)
        last = linear.full_periods(parts, run, hold=False)[-1:]
        loop = jax.tree.map(lambda v: np.asarray(v)[0], linear.open_loops(parts, run, last))
        radius[sampling] = linear.spectral_radius(loop)
        tau = float(law.t_f - run.period.now.t[last[0]]) / H
        kp, kd = stability_limits.implicit_gains(4.0, tau) if law.implicit else (16.0 / tau**2, 7.0 / tau)
        # without an observer its memory is constant, which is a pole at 1
        np.testing.assert_allclose(radius[sampling], max(1.0, stability_limits.spectral_radius(kp, kd, 1.0)), rtol=1e-6)
    assert radius["implicit"] < 1.0 + margins.CIRCLE_TOLERANCE < 1.1 < radius["explicit"]


@pytest.mark.parametrize("hold", [False, True])
def test_s_of_a_spacecraft_is_accurate_to_second_order_in_the_period(hold):
    """The torque is exact for a constant eps'', but T(q) changes within the period."""
    body = rigid_body.spacecraft(FULL_INERTIA)
    gains = (vector(v) for v in (30.0, 3.0, 2.0, 1.5, 1e-3, 1.2))
    law = PrescribedTime(MultiplicativeKinematics(body), *gains, implicit=True)
    q = np.array([0.3, -0.2, 0.4, 0.0])
    x = rigid_body.AttitudeState(vector(np.append(q[:3], np.sqrt(1 - q @ q))), vector([0.05, -0.02, 0.04]))
    target = references.Fixed(vector([0.0, 0.0, 0.0, 1.0]))(vector(0.0))
    t = vector(29.0 if hold else 12.0)
    off = []
    for h in (0.04, 0.02, 0.01):
        u, s, _ = law(Sample(t, jnp.asarray(hold), vector(h)), x, target, jnp.zeros(3), vector(0.0))
        end = x
        for k in range(8):
            end = integrators.rk4(lambda t, y, u=u: body.rate(t, y, u, jnp.zeros(3)), t + k * h / 8, end, vector(h / 8))
        e, rate = law.kinematics.errors(end, target)
        after = rate + 1.2 * e if hold else (18.0 - h) * rate + 3.0 * e
        expected = np.exp(-0.5 * 1.5 * h) * s if hold else ((18.0 - h) / 18.0) ** 3 * s
        off.append(float(jnp.abs(after - expected).max()))
    ratios = np.array(off[:-1]) / np.array(off[1:])
    assert np.all(np.abs(ratios - 4.0) < 0.5), (off, ratios)


def test_implicit_sampling_needs_the_sampled_loop_and_excludes_sign_width_from_tuning():
    with pytest.raises(ScenarioError, match='sampling = "implicit" needs the sampled loop'):
        scenario.from_tables({"controller": {"sampling": "implicit"}})
    tables = {"controller": {"sampling": "implicit"}, "loop": {"mode": "sampled"}, "tune": {}}
    tune = scenario.from_tables(tables).tune
    assert tune is not None
    assert tune.free == ("eta", "delta", "observer_gain", "k1", "surface_rate")


@pytest.mark.parametrize("bits", [64, 32])
def test_rounding_errors_do_not_delay_the_surface_of_the_hold_phase(bits):
    """Regression: with 32 bits nine of ten of these runs used the surface one period late."""
    count, before = 1200, np.arange(1, 40)
    period = np.array([0.01, 0.02, 0.05, 0.1, 0.25, 0.3])[:, None]
    t_f, delta = np.broadcast_arrays((count - 100) * period, before * period)
    law = chain_parts(clock="flight").controller

    def first_hold_period(period, t_f, delta):
        ticks = clock.Sampled(period, count * period, vector(0.0), count).ticks(t_f, delta)
        return jnp.argmax(replace(law, t_f=t_f, delta=delta).in_hold(ticks.t, ticks.t + period, ticks.hold))

    with jax.enable_x64(bits == 64):
        many = jax.jit(jax.vmap(jax.vmap(first_hold_period)))
        first = many(*(vector(np.broadcast_to(v, t_f.shape)) for v in (period, t_f, delta)))
    np.testing.assert_array_equal(first, np.broadcast_to(count - 101 - before, t_f.shape))


@pytest.mark.parametrize("left", [1.0, 0.5, 0.45, 0.3])
def test_double_integrator_has_the_same_input_as_a_system_and_as_a_chain(left):
    """In some cases a period ends at the hand-over, and in others the hand-over is inside a period."""
    double = system(1, lambda t, x, v: v, lambda t, x, v: 0.0 * v, lambda t, x, v: jnp.eye(1))
    gains = {
        "t_f": vector(T_F), "eta": vector(2.7), "delta": vector(0.4), "k1": vector(1.3), "sign_width": vector(1e-3),
        "surface_rate": vector(1.7),
    }  # fmt: skip
    chain = PrescribedTimeChain(ChainKinematics(integrator_chain.chain(2)), a=vector([1.0]), **gains, implicit=True)
    now = Sample(vector(T_F - left), jnp.asarray(left < 0.4), vector(H))
    (u, s, _), (other, other_s, _) = (
        law(now, vector([0.3, -0.4]), now.t, jnp.zeros(1), vector(0.0))
        for law in (PrescribedTime(SecondOrderKinematics(double), **gains, implicit=True), chain)
    )
    np.testing.assert_allclose(u, other, rtol=1e-12)
    np.testing.assert_allclose(s, other_s, rtol=1e-12)
