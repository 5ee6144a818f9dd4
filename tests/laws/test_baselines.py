"""The laws to compare with, against the identities and closed forms that they are made for."""

from dataclasses import replace
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from scipy.integrate import quad, solve_ivp
from scipy.optimize import brentq
from scipy.spatial.transform import Rotation

from ptsmc_jax.laws import baselines
from ptsmc_jax.laws.base import Sample
from ptsmc_jax.laws.kinematics import MultiplicativeKinematics
from ptsmc_jax.numerics import attitude, guards
from ptsmc_jax.plants import rigid_body
from ptsmc_jax.scenario import baseline_tables
from ptsmc_jax.signals import disturbances, references
from ptsmc_jax.simulation import clock
from tests import helpers
from tests.helpers import FULL_INERTIA, fly, short, vector

BODY = rigid_body.spacecraft(FULL_INERTIA)
COMMON: dict[str, Any] = {"kinematics": MultiplicativeKinematics(BODY), "t_f": vector(10.0), "delta": vector(0.01)}

LAWS: dict[str, Any] = {
    "pd": baselines.QuaternionPD(**COMMON, k_p=vector(0.4), k_d=vector(0.9)),
    "terminal": baselines.Terminal(
        **COMMON, p=vector(1.3), b=vector(0.6), k=vector(0.5), sign_width=vector(1e-3)
    ),
    "fixed_time": baselines.FixedTime(
        **COMMON, a1=vector(0.3), b1=vector(0.5), a2=vector(1.2), b2=vector(0.7), p=vector(1.25), gamma=vector(2.0),
        m=vector(1.5), n=vector(0.5), sign_width=vector(1e-3),
    ),
}  # fmt: skip
SLIDING = ("terminal", "fixed_time")
T = vector(1.3)
TARGET = references.Spin(vector(Rotation.from_rotvec([0.3, -0.2, 0.5]).as_quat()), vector([0.02, -0.01, 0.03]))(T)
X = rigid_body.AttitudeState(vector(Rotation.from_rotvec([1.1, 0.4, -0.8]).as_quat()), vector([0.05, -0.11, 0.07]))
D = vector([0.02, -0.01, 0.015])
NOW = Sample(T, jnp.asarray(False), vector(0.1))


def surface(law, v, v_dot):
    """The sliding variable at an error and its rate."""
    return law.acceleration(NOW, v, v_dot, vector(0.0))[1]


def accelerated(law, k2=0.0):
    """V'' of the error quaternion under the law, with d known exactly, by the plant's own equations."""
    u, s, _ = law(NOW, X, TARGET, D, vector(k2))
    motion = BODY.rate(T, X, u, D)

    def v_dot(t):  # along the motion, to first order in t; the reference moves on too
        later = jax.tree.map(lambda x, rate: x + t * rate, X, motion)
        rate = TARGET.w
        q = TARGET.q + t * 0.5 * attitude.multiply(TARGET.q, jnp.concatenate([rate, jnp.zeros(1)]))
        return law.kinematics.errors(later, references.Target(q, rate + t * TARGET.w_dot, TARGET.w_dot))[1]

    return jax.jvp(v_dot, (vector(0.0),), (vector(1.0),))[1], s


@pytest.mark.parametrize("name", SLIDING)
def test_the_torque_gives_the_error_the_acceleration_that_the_law_asks_for(name):
    law = LAWS[name]
    v, v_dot = law.kinematics.errors(X, TARGET)
    wanted, _ = law.acceleration(NOW, v, v_dot, vector(0.0))
    np.testing.assert_allclose(accelerated(law)[0], wanted, rtol=1e-12, atol=1e-14)
    # with a bound on the estimation error it also switches, by |T J^-1| K2 / 2
    got, s = accelerated(law, k2=0.03)
    switching = law.kinematics.influence(X, TARGET) * 0.03 * np.tanh(s / 1e-3)
    np.testing.assert_allclose(got, wanted - switching, rtol=1e-9)


def test_pd_turns_the_body_as_its_formula_says():
    """w_e' = -k_p v - k_d w_e, whatever the inertia, the reference's motion and a known disturbance."""
    law = LAWS["pd"]
    u, _ = helpers.commanded(law, T, jnp.asarray(False), X, TARGET, D, vector(0.7))
    w_dot = BODY.rate(T, X, u, D).w
    q_e = Rotation.from_quat(np.array(TARGET.q)).inv() * Rotation.from_quat(np.array(X.q))
    v = np.asarray(q_e.as_quat(canonical=True))[:3]
    carried = q_e.inv().apply(np.array(TARGET.w))
    w_e = np.asarray(X.w) - carried
    wanted = -0.4 * v - 0.9 * w_e + q_e.inv().apply(np.array(TARGET.w_dot)) - np.cross(w_e, carried)
    np.testing.assert_allclose(w_dot, wanted, rtol=1e-12, atol=1e-15)


@pytest.mark.parametrize("name", SLIDING)
@pytest.mark.parametrize("trial", range(5))
def test_the_surfaces_draw_near_as_their_papers_say(name, trial):
    """s' by automatic differentiation along v'' = alpha: what the law was solved for."""
    law = LAWS[name]
    rng = np.random.default_rng(trial)
    v, v_dot = vector(rng.uniform(-0.8, 0.8, 3)), vector(rng.uniform(-0.3, 0.3, 3))
    alpha, s = law.acceleration(NOW, v, v_dot, vector(0.0))
    s_dot = jax.jvp(lambda v, v_dot: surface(law, v, v_dot), (v, v_dot), (v_dot, alpha))[1]
    if name == "terminal":
        wanted = -(1.3 / 0.6) * np.abs(v_dot) ** 0.3 * 0.5 * np.asarray(s)
    else:
        power = {a: np.sign(s) * np.abs(s) ** a for a in (1.5, 0.5)}
        wanted = -(np.abs(v_dot) ** 0.25) * (1.2 * power[1.5] + 0.7 * power[0.5])
    np.testing.assert_allclose(s_dot, wanted, rtol=1e-10, atol=1e-13)


def flown(law, angle, rate, t_end, period=0.005):
    """History of the angle about the z axis of a body with no disturbance, sampled quickly."""
    q = Rotation.from_rotvec([0.0, 0.0, angle]).as_quat()
    body = rigid_body.spacecraft((10.0, 12.0, 14.0))
    law = replace(law, kinematics=MultiplicativeKinematics(body), t_f=vector(t_end - 1.0), delta=vector(period))
    run = helpers.parts(t_end - 1.0, 3.0, period, inertia=(10.0, 12.0, 14.0), q=q, rate=(0.0, 0.0, rate), period=period,
                        t_end=t_end, disturbance=disturbances.Constant(jnp.zeros(3)))  # fmt: skip
    log = fly(replace(run, controller=law, clock=clock.anchored(period, t_end, t_end - 1.0, 1.0 + period))).log
    return log.t[log.has_length], log.error[log.has_length, 2]


@pytest.mark.long  # its torque at a state: `test_pd_turns_the_body_as_its_formula_says`
def test_pd_flies_its_eigenaxis_equation():
    """theta'' + k_d theta' + k_p sin(theta/2) = 0; held over 5 ms, which is what the two differ by."""
    t, v = flown(LAWS["pd"], 2.0, 0.0, 15.0)
    exact = solve_ivp(lambda _, y: (y[1], -0.9 * y[1] - 0.4 * np.sin(y[0] / 2)), (0.0, 15.0), (2.0, 0.0), t_eval=t,
                      rtol=1e-10, atol=1e-12)  # fmt: skip
    np.testing.assert_allclose(v, np.sin(exact.y[0] / 2), atol=2e-3)
    halved = flown(LAWS["pd"], 2.0, 0.0, 15.0, period=0.0025)
    late = [np.abs(np.interp(12.0, *run) - np.sin(np.interp(12.0, t, exact.y[0]) / 2)) for run in ((t, v), halved)]
    assert late[1] < 0.6 * late[0]  # and it halves with the period


def sliding(name, v):
    """V' on the surface s = 0."""
    return -((0.6 * v) ** (1 / 1.3)) if name == "terminal" else -(0.3 * v**2.0 + 0.5 * v**0.8)


# how a surface is drawn near to at a state is tested of both
@pytest.mark.parametrize(("name", "v"), short([(n, v) for n in SLIDING for v in (0.1, 0.4, 0.8)], [("terminal", 0.4)]))
def test_on_their_surfaces_they_arrive_when_their_papers_say(name, v):
    law = replace(LAWS[name], k=vector(5.0)) if name == "terminal" else LAWS[name]
    arrival = quad(lambda v: -1.0 / sliding(name, v), 0.0, v)[0]
    if name == "terminal":
        np.testing.assert_allclose(arrival, v ** (1 - 1 / 1.3) * 1.3 / (0.3 * 0.6 ** (1 / 1.3)), rtol=1e-6)
    else:
        assert arrival < 1 / (0.3 * 1.0) + 1.25 / (0.5 * 0.25)  # the bound, wherever it starts
    rate = 2.0 * sliding(name, v) / np.sqrt(1.0 - v * v)
    t, error = flown(law, 2.0 * np.arcsin(v), rate, arrival + 3.0)
    before = t < 0.95 * arrival
    exact = solve_ivp(lambda _, y: sliding(name, np.maximum(y, 0.0)), (0.0, 0.95 * arrival), (v,), t_eval=t[before],
                      rtol=1e-10, atol=1e-13)  # fmt: skip
    np.testing.assert_allclose(error[before], exact.y[0], atol=4e-3 * v)  # held over 5 ms
    assert np.abs(error[t > arrival]).max() < 1e-3 * v


def test_signed_powers():
    x = vector([-2.0, -1e-9, 0.0, 0.5, 3.0])
    for a in (0.3, 1.0, 1.7):
        np.testing.assert_allclose(guards.signed_power(x, vector(a)), np.sign(x) * np.abs(x) ** a, rtol=1e-14)
        slope = jax.vmap(jax.grad(lambda v, a=a: guards.signed_power(v, vector(a))))(x)
        known = np.asarray(x) != 0.0
        np.testing.assert_allclose(slope[known], a * np.abs(x[known]) ** (a - 1.0), rtol=1e-12)
        assert slope[~known] == 0.0
    by_power = jax.jvp(lambda a: guards.signed_power(x, a), (vector(0.7),), (vector(1.0),))[1]
    assert np.all(np.isfinite(by_power))


def test_pd_tells_what_it_drives_to_zero_and_knows_no_singularity():
    law, half = LAWS["pd"], attitude.multiply(TARGET.q, vector([0.0, 0.0, 1.0, 0.0]))
    q_e, w_e, *_ = law.kinematics.relative(X, TARGET)
    s = helpers.commanded(law, T, jnp.asarray(False), X, TARGET, D, vector(0.7))[1]
    np.testing.assert_allclose(s, q_e[:3] + 0.9 / 0.4 * w_e, rtol=1e-12)
    turned = rigid_body.AttitudeState(half, X.w)
    assert law.clearance(turned, TARGET) == 1.0
    for name in SLIDING:
        np.testing.assert_allclose(LAWS[name].clearance(turned, TARGET), 0.0, atol=1e-15)


@pytest.mark.parametrize("name", SLIDING)
def test_the_sign_is_as_wide_as_it_is_told_and_exact_at_zero(name):
    law, v, v_dot = LAWS[name], vector([0.1, -0.2, 0.0]), vector([0.05, -0.1, 0.0])
    quiet, s = law.acceleration(NOW, v, v_dot, vector(0.0))
    for width, sign in ((0.0, np.sign(s)), (0.5, np.tanh(np.asarray(s) / 0.5))):
        switched, _ = replace(law, sign_width=vector(width)).acceleration(NOW, v, v_dot, vector(0.3))
        np.testing.assert_allclose(quiet - switched, 0.3 * sign, rtol=1e-12)
    assert s[2] == 0.0


@pytest.mark.parametrize("name", SLIDING)
def test_how_fast_a_law_turns_the_body_is_what_its_surface_asks_for_at_half_a_turn(name):
    """Of |v| = 1, where the body turns by twice |v'|."""
    law = LAWS[name]
    tables = {"terminal": baseline_tables.TerminalController, "fixed_time": baseline_tables.FixedTimeController}
    gains = {gain: float(getattr(law, gain)) for gain in law.tunable if gain != "t_f"}
    rate: Any = brentq(lambda v_dot: float(surface(law, vector([1.0]), vector([v_dot]))[0]), -10.0, -1e-3, xtol=1e-12)
    assert tables[name](**gains).turning(10.0)[1] == pytest.approx(-2.0 * rate, rel=1e-9)


def test_how_fast_pd_and_a_profile_turn_the_body_from_half_a_turn():
    """By the spring's energy, theta'^2 / 2 = k_p (integral of sin(theta / 2)); and the quintic at its steepest."""
    energy = 0.4 * quad(lambda angle: np.sin(angle / 2.0), 0.0, np.pi)[0]
    assert baseline_tables.PDController(k_p=0.4).turning(7.0)[1] == pytest.approx(np.sqrt(2.0 * energy), rel=1e-12)
    slope = np.polynomial.Polynomial([0.0, 0.0, 0.0, 10.0, -15.0, 6.0]).deriv()(np.linspace(0.0, 1.0, 1001)).max()
    for table in (baseline_tables.TimeBasePDController(), baseline_tables.TimeBaseSlidingController()):
        assert table.turning(7.0) == ("controller.t_f", pytest.approx(slope * np.pi / 7.0, rel=1e-12))
