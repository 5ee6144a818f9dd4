"""PD, terminal and fixed-time laws against the closed forms and convergence times of their papers.

`test_family.py` compares them with an implementation in NumPy.
"""

from dataclasses import replace
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from scipy.integrate import quad, solve_ivp
from scipy.optimize import brentq
from scipy.spatial.transform import Rotation

from ptsmc_jax.laws import baselines, time_base
from ptsmc_jax.laws.base import Sample
from ptsmc_jax.laws.kinematics import MultiplicativeKinematics
from ptsmc_jax.numerics import attitude, guards
from ptsmc_jax.plants import rigid_body
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
    """Return the sliding variable s (m,) of a law for an error v (m,) and its rate."""
    return law.acceleration(NOW, v, v_dot, vector(0.0))[1]


def test_pd_torque_gives_the_relative_acceleration_of_its_formula():
    """w_e' = -k_p v - k_d w_e holds for any inertia, motion of the reference and known disturbance."""
    law = LAWS["pd"]
    u, _ = helpers.commanded(law, T, jnp.asarray(False), X, TARGET, D, vector(0.7))
    w_dot = BODY.rate(T, X, u, D).w
    q_e = Rotation.from_quat(np.array(TARGET.q)).inv() * Rotation.from_quat(np.array(X.q))
    v = np.asarray(q_e.as_quat(canonical=True))[:3]
    reference_rate = q_e.inv().apply(np.array(TARGET.w))  # in body axes
    w_e = np.asarray(X.w) - reference_rate
    expected = -0.4 * v - 0.9 * w_e + q_e.inv().apply(np.array(TARGET.w_dot)) - np.cross(w_e, reference_rate)
    np.testing.assert_allclose(w_dot, expected, rtol=1e-12, atol=1e-15)


@pytest.mark.parametrize("name", SLIDING)
@pytest.mark.parametrize("trial", range(5))
def test_sliding_variable_obeys_the_reaching_law_of_its_paper(name, trial):
    """s' is computed by automatic differentiation along v'' = a."""
    law = LAWS[name]
    rng = np.random.default_rng(trial)
    v, v_dot = vector(rng.uniform(-0.8, 0.8, 3)), vector(rng.uniform(-0.3, 0.3, 3))
    a, s = law.acceleration(NOW, v, v_dot, vector(0.0))
    s_dot = jax.jvp(lambda v, v_dot: surface(law, v, v_dot), (v, v_dot), (v_dot, a))[1]
    if name == "terminal":
        expected = -(1.3 / 0.6) * np.abs(v_dot) ** 0.3 * 0.5 * np.asarray(s)
    else:
        power = {k: np.sign(s) * np.abs(s) ** k for k in (1.5, 0.5)}
        expected = -(np.abs(v_dot) ** 0.25) * (1.2 * power[1.5] + 0.7 * power[0.5])
    np.testing.assert_allclose(s_dot, expected, rtol=1e-10, atol=1e-13)


def simulate_rotation(law, angle, rate, t_end, period=0.005):
    """Return times and errors v_3, both (samples,), of a body that rotates about its z axis without a disturbance.

    angle, rate: at t = 0 [rad, rad/s]. t_end, period [s].
    """
    q = Rotation.from_rotvec([0.0, 0.0, angle]).as_quat()
    body = rigid_body.spacecraft((10.0, 12.0, 14.0))
    law = replace(law, kinematics=MultiplicativeKinematics(body), t_f=vector(t_end - 1.0), delta=vector(period))
    run = helpers.parts(t_end - 1.0, 3.0, period, inertia=(10.0, 12.0, 14.0), q=q, rate=(0.0, 0.0, rate), period=period,
                        t_end=t_end, disturbance=disturbances.Constant(jnp.zeros(3)))  # fmt: skip
    log = fly(replace(run, controller=law, clock=clock.anchored_clock(period, t_end))).log
    return log.t[log.has_length], log.error[log.has_length, 2]


def sliding_rate(name, v):
    """Return v' on the surface s = 0 for v > 0; name: of the law."""
    return -((0.6 * v) ** (1 / 1.3)) if name == "terminal" else -(0.3 * v**2.0 + 0.5 * v**0.8)


# both laws have a short test of the reaching law above
@pytest.mark.parametrize(("name", "v"), short([(n, v) for n in SLIDING for v in (0.1, 0.4, 0.8)], [("terminal", 0.4)]))
def test_error_on_the_surface_reaches_zero_at_the_published_time(name, v):
    law = replace(LAWS[name], k=vector(5.0)) if name == "terminal" else LAWS[name]
    arrival = quad(lambda v: -1.0 / sliding_rate(name, v), 0.0, v)[0]
    if name == "terminal":
        np.testing.assert_allclose(arrival, v ** (1 - 1 / 1.3) * 1.3 / (0.3 * 0.6 ** (1 / 1.3)), rtol=1e-6)
    else:
        assert arrival < 1 / (0.3 * 1.0) + 1.25 / (0.5 * 0.25)  # the bound for any initial error
    rate = 2.0 * sliding_rate(name, v) / np.sqrt(1.0 - v * v)
    t, error = simulate_rotation(law, 2.0 * np.arcsin(v), rate, arrival + 3.0)
    before = t < 0.95 * arrival
    exact = solve_ivp(
        lambda _, y: sliding_rate(name, np.maximum(y, 0.0)), (0.0, 0.95 * arrival), (v,), t_eval=t[before],
        rtol=1e-10, atol=1e-13,
    )  # fmt: skip
    np.testing.assert_allclose(error[before], exact.y[0], atol=4e-3 * v)  # zero-order hold of 5 ms
    assert np.abs(error[t > arrival]).max() < 1e-3 * v


def test_signed_power_and_its_derivatives_equal_closed_forms():
    """At x = 0, the derivative by x is 0 and the derivative by the exponent is finite."""
    x = vector([-2.0, -1e-9, 0.0, 0.5, 3.0])
    for a in (0.3, 1.0, 1.7):
        np.testing.assert_allclose(guards.signed_power(x, vector(a)), np.sign(x) * np.abs(x) ** a, rtol=1e-14)
        derivative = jax.vmap(jax.grad(lambda v, a=a: guards.signed_power(v, vector(a))))(x)
        nonzero = np.asarray(x) != 0.0
        np.testing.assert_allclose(derivative[nonzero], a * np.abs(x[nonzero]) ** (a - 1.0), rtol=1e-12)
        assert derivative[~nonzero] == 0.0
    by_power = jax.jvp(lambda a: guards.signed_power(x, a), (vector(0.7),), (vector(1.0),))[1]
    assert np.all(np.isfinite(by_power))


def test_pd_returns_its_sliding_variable_and_has_no_singularity():
    """At a rotation error of 180 deg its singularity distance is 1, and the distance of the sliding laws is 0."""
    law, half = LAWS["pd"], attitude.multiply(TARGET.q, vector([0.0, 0.0, 1.0, 0.0]))
    q_e, w_e, *_ = law.kinematics.relative(X, TARGET)
    s = helpers.commanded(law, T, jnp.asarray(False), X, TARGET, D, vector(0.7))[1]
    np.testing.assert_allclose(s, q_e[:3] + 0.9 / 0.4 * w_e, rtol=1e-12)
    turned = rigid_body.AttitudeState(half, X.w)
    assert law.singularity_distance(turned, TARGET) == 1.0
    for name in SLIDING:
        np.testing.assert_allclose(LAWS[name].singularity_distance(turned, TARGET), 0.0, atol=1e-15)


@pytest.mark.parametrize("name", SLIDING)
def test_largest_body_rate_of_a_sliding_law_is_its_surface_rate_at_180_degrees(name):
    """At |v| = 1 the body rotates at the rate 2 |v'|."""
    law = LAWS[name]
    rate: Any = brentq(lambda v_dot: float(surface(law, vector([1.0]), vector([v_dot]))[0]), -10.0, -1e-3, xtol=1e-12)
    assert law.half_turn_rate(10.0)[1] == pytest.approx(-2.0 * rate, rel=1e-9)


def test_largest_body_rates_of_pd_and_time_base_laws_equal_closed_forms():
    """For PD by energy, theta'^2 / 2 = k_p (integral of sin(theta / 2)); for a time base by the rate of the quintic."""
    energy = 0.4 * quad(lambda angle: np.sin(angle / 2.0), 0.0, np.pi)[0]
    assert baselines.PD(**COMMON, k_p=vector(0.4)).half_turn_rate(7.0)[1] == pytest.approx(
        np.sqrt(2.0 * energy), rel=1e-12
    )
    slope = np.polynomial.Polynomial([0.0, 0.0, 0.0, 10.0, -15.0, 6.0]).deriv()(np.linspace(0.0, 1.0, 1001)).max()
    for law in (time_base.TimeBasePD(**COMMON), time_base.TimeBaseSliding(**COMMON)):
        assert law.half_turn_rate(7.0) == ("t_f", pytest.approx(slope * np.pi / 7.0, rel=1e-12))
