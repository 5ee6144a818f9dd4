"""Laws for comparison against closed forms, bounds of their papers, and an independent implementation in NumPy."""

import math
from dataclasses import replace
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from jax.flatten_util import ravel_pytree
from scipy.integrate import quad, solve_ivp
from scipy.optimize import brentq
from scipy.spatial.transform import Rotation

from ptsmc_jax.laws import baselines, time_base
from ptsmc_jax.laws.base import Sample
from ptsmc_jax.laws.kinematics import ChainKinematics, MultiplicativeKinematics, SecondOrderKinematics
from ptsmc_jax.numerics import attitude
from ptsmc_jax.observers.base import NoObserver
from ptsmc_jax.plants import integrator_chain, rigid_body
from ptsmc_jax.scenario import systems
from ptsmc_jax.signals import disturbances, references
from ptsmc_jax.simulation import clock, rollout
from tests import helpers
from tests.helpers import FULL_INERTIA, ROOT, ticks_of, vector

T_F, DELTA = 5.0, 0.5
GAINS: dict[str, dict[str, float]] = {
    "pd": {"k_p": 0.7, "k_d": 1.3},
    "terminal": {"p": 1.3, "b": 0.6, "k": 1.5, "sign_width": 0.02},
    "fixed_time": {"a1": 0.3, "b1": 0.5, "a2": 1.2, "b2": 0.7, "p": 1.25, "gamma": 2.0, "m": 1.5, "n": 0.5,
                   "sign_width": 0.02},
    "time_base_pd": {"k_p": 1.7, "k_d": 2.3},
    "time_base_sliding": {"surface_rate": 1.4, "k": 0.9, "sign_width": 0.02},
    "scaling": {"m": 1.3, "k1": 0.7, "k": 0.02},
    "predefined_time": {"share": 0.6, "q1": 0.3, "q2": 0.4, "sign_width": 1.0},
    "super_twisting": {"surface_rate": 0.8, "lipschitz": 0.3, "sign_width": 0.02},
}  # fmt: skip
CLASSES: dict[str, Any] = {
    "pd": baselines.PD,
    "terminal": baselines.Terminal,
    "fixed_time": baselines.FixedTime,
    "time_base_pd": time_base.TimeBasePD,
    "time_base_sliding": time_base.TimeBaseSliding,
    "scaling": baselines.Scaling,
    "predefined_time": baselines.PredefinedTime,
    "super_twisting": baselines.SuperTwisting,
}
BODY, CHAIN = rigid_body.spacecraft(FULL_INERTIA), integrator_chain.chain(2)
APPROACH = jnp.asarray(False)  # value of `Sample.hold`


def build_law(name, error: Any = ChainKinematics, model: Any = CHAIN, t_f=T_F, delta=DELTA, **changes) -> Any:
    """Return a law by its name in scenario files, with the gains above.

    error, model: classes of its error and its design model. changes: other values of its gains.
    """
    gains = {key: vector(value) for key, value in {**GAINS[name], **changes}.items()}
    return CLASSES[name](kinematics=error(model), t_f=vector(t_f), delta=vector(delta), **gains)


@jax.jit
def evaluate(law, memory, now, error, rate, bound):
    """Return acceleration, sliding variable and the next memory of a law; bound: on the disturbance."""
    a, s, *memories = law.acceleration(now._replace(memory=memory), error, rate, bound)
    return a, s, memories[0] if memories else memory


# ---- the laws in NumPy, from their papers


def sig(x, power):
    """Return sign(x) |x|^power for each element."""
    return np.sign(x) * np.abs(x) ** power


def powers_of(x):
    """Return (3, 6): the first row is 1, x .. x^5, the other rows are its first and second derivatives."""
    return np.array([[math.perm(k, n) * x ** max(k - n, 0) for k in range(6)] for n in range(3)])


ENDS = np.concatenate([powers_of(0.0), powers_of(1.0)])


def quintic(start, rate, t, t_f=T_F):
    """Return value, rate and acceleration at t of the quintic with this start that is at rest at zero at t_f.

    start, rate, and each result: (m,). After t_f, all results are zero.
    """
    if t >= t_f:
        return 0.0 * start, 0.0 * start, 0.0 * start
    coefficients = np.linalg.solve(ENDS, np.stack([start, t_f * rate, *(0.0 * start for _ in range(4))]))
    return tuple(row @ coefficients / t_f**n for n, row in enumerate(powers_of(t / t_f)))


def phi(x, q, settling):
    """Return Phi of the predefined-time law. From any start, x' = -Phi(x) reaches 0 within `settling` [s]."""
    return np.pi / (2.0 * q * settling) * (sig(x, 1.0 + q) + sig(x, 1.0 - q))


def phi_derivative(x, q, settling):
    """Return the derivative of `phi` with respect to x."""
    return np.pi / (2.0 * q * settling) * ((1.0 + q) * np.abs(x) ** q + (1.0 - q) * np.abs(x) ** -q)


def law_in_numpy(name, gains, now, e, w, bound, memory=None, profile=None):
    """Return acceleration, sliding variable and next memory of a law.

    name, gains: of the law. now: time, whether in the hold phase, length of the period. e, w: error and its rate.
    bound: on the disturbance. profile: value, rate and acceleration of the time base, by default `quintic`.
    """
    (t, hold, dt), g = now, gains

    def sign(s):
        return np.sign(s) if g["sign_width"] == 0.0 else np.tanh(s / g["sign_width"])

    if name == "pd":
        return -g["k_p"] * e - g["k_d"] * w, e + g["k_d"] / g["k_p"] * w, None
    if name == "terminal":
        s = e + sig(w, g["p"]) / g["b"]
        return -g["b"] / g["p"] * sig(w, 2.0 - g["p"]) - g["k"] * s - bound * sign(s), s, None
    if name == "fixed_time":
        power = g["gamma"] - 1.0 / g["p"]
        kappa = g["a1"] * np.abs(e) ** power + g["b1"]
        kappa_dot = g["a1"] * power * sig(e, power - 1.0) * w
        s = e + sig(w / kappa, g["p"])
        reaching = sig(w, 2.0 - g["p"]) + g["a2"] * sig(s, g["m"]) + g["b2"] * sig(s, g["n"])
        return kappa_dot * w / kappa - kappa ** g["p"] / g["p"] * reaching - bound * sign(s), s, None
    if name.startswith("time_base"):
        memory = (e, w) if memory is None else memory
        r, r_dot, r_ddot = quintic(memory[0], memory[1], t) if profile is None else profile
        if name == "time_base_pd":
            return (
                r_ddot - g["k_p"] * (e - r) - g["k_d"] * (w - r_dot),
                w - r_dot + g["k_p"] / g["k_d"] * (e - r),
                memory,
            )
        s = w - r_dot + g["surface_rate"] * (e - r)
        return r_ddot - g["surface_rate"] * (w - r_dot) - g["k"] * s - bound * sign(s), s, memory
    if name == "scaling":  # xi = mu eps, z = xi' + k1 xi, z' = -k mu z
        r, p = DELTA if hold else T_F - t, 2.0 + g["m"]
        mu, mu_dot, mu_ddot = (T_F / r) ** p, p / r * (T_F / r) ** p, p * (p + 1.0) / r**2 * (T_F / r) ** p
        z = mu_dot * e + mu * w + g["k1"] * mu * e
        a = -(mu_ddot * e + 2.0 * mu_dot * w + g["k1"] * (mu_dot * e + mu * w)) / mu - g["k"] * z
        return a, z / mu, None
    if name == "predefined_time":
        first, second = g["share"] * T_F, (1.0 - g["share"]) * T_F
        surface = phi(e, g["q1"], first)
        s = w + sig(sig(w, 2.0) + 2.0 * sig(surface, 2.0), 0.5)
        coupling = 2.0 * np.abs(surface) * phi_derivative(e, g["q1"], first)
        return -phi(s, g["q2"], second) - (bound + coupling) * sign(s), s, None
    s = w + g["surface_rate"] * e
    root = s / (s**2 + g["sign_width"] ** 2) ** 0.25 if g["sign_width"] else sig(s, 0.5)  # smooth root
    v = 0.0 * e if memory is None else memory
    return -g["surface_rate"] * w - 1.5 * np.sqrt(g["lipschitz"]) * root + v, s, v - dt * 1.1 * g["lipschitz"] * sign(s)


# ---- eps'' of each plant under each law, by the equations of the plant

T = 1.3
NOW = Sample(vector(T), APPROACH, vector(0.1))
SPIN = references.Spin(vector(Rotation.from_rotvec([0.3, -0.2, 0.5]).as_quat()), vector([0.02, -0.01, 0.03]))
ARM: Any = systems.load(str(ROOT / "scenarios" / "two_link_arm.py") + ":arm")
K2 = 0.06
# kinematics, plant, reference, state, disturbance, initial error of a profile in straight coordinates, and its rate
PLANTS: dict[str, Any] = {
    "attitude": (
        MultiplicativeKinematics, BODY, SPIN,
        rigid_body.AttitudeState(vector(Rotation.from_rotvec([1.1, 0.4, -0.8]).as_quat()), vector([0.05, -0.11, 0.07])),
        vector([0.02, -0.01, 0.015]), np.array([1.2, 0.9, -1.4]), np.array([0.1, -0.2, 0.05]),
    ),
    "chain": (ChainKinematics, integrator_chain.chain(2, lambda x: -0.8 * jnp.sin(x[0]), lambda x: 2.0 + x[0] ** 2),
              references.Origin(), vector([0.7, -0.4]), vector([0.1]), np.array([1.1]), np.array([-0.3])),
    "arm": (SecondOrderKinematics, ARM, references.CurrentTime(), vector([0.4, -0.3, 0.5, -0.2]), vector([0.2, -0.1]),
            np.array([0.8, -0.5]), np.array([0.3, 0.1])),
}  # fmt: skip


@jax.jit
def error_of_plant(law, reference, t, x, u, d):
    """Return eps, eps', eps' by differentiation, and eps'' of the plant with this input and disturbance."""
    motion = law.model.rate(t, x, u, d)

    def at(passed):  # after a small time, to first order for the plant
        return law.kinematics.errors(jax.tree.map(lambda x, rate: x + passed * rate, x, motion), reference(t + passed))

    (error, rate), (differentiated_rate, acceleration) = jax.jvp(at, (vector(0.0),), (vector(1.0),))
    return error, rate, differentiated_rate, acceleration


def independent_error(plant, x, d):
    """Return eps (m,) and eps' (m,) without the code under test, and a bound on the effect of d.

    The bound is the largest change of |eps''| by a disturbance of norm K2.
    """
    if plant == "chain":
        return np.array(x[:1]), np.array(x[1:]), K2
    if plant == "arm":
        rate = [0.6 * 0.8 * np.cos(0.8 * T), -0.5 * np.sin(T)]
        return np.array(x[:2]), np.array(x[2:]) - rate, K2 * np.linalg.norm(ARM.G(vector(T), x[:2], x[2:]))
    target = SPIN(vector(T))
    q_e = Rotation.from_quat(np.array(target.q)).inv() * Rotation.from_quat(np.array(x.q))
    w_e = np.array(x.w) - q_e.inv().apply(np.array(target.w))
    v, s = np.split(q_e.as_quat(canonical=True), [3])
    t_matrix = s * np.eye(3) + np.cross(np.eye(3), v)
    return v, 0.5 * t_matrix @ w_e, 0.5 * K2 * np.linalg.norm(t_matrix @ np.linalg.inv(np.array(FULL_INERTIA)))


def attitude_profile(start, rate, t, h=5e-3):
    """Return v, v' and v'', (3,) each, of the rotation by the quintic rotation vector.

    The derivatives are finite differences of order 4 with the step h [s].
    """
    at = [Rotation.from_rotvec(quintic(start, rate, t + k * h)[0]).as_quat()[:3] for k in (-2, -1, 0, 1, 2)]
    first = (at[0] - 8 * at[1] + 8 * at[3] - at[4]) / (12 * h)
    return at[2], first, (-at[0] + 16 * at[1] - 30 * at[2] + 16 * at[3] - at[4]) / (12 * h**2)


# the short tests have every law on one plant, and every plant under one law
PAIRS = [(plant, name) for plant in PLANTS for name in CLASSES]
SHORT_PAIRS = [case for case in PAIRS if case[0] == "attitude" or case[1] == "time_base_sliding"]


@pytest.mark.parametrize(("plant", "name"), helpers.short(PAIRS, SHORT_PAIRS))
def test_input_of_a_law_gives_the_acceleration_of_the_error_that_its_paper_states(plant, name):
    """Error, rate, sliding variable and next memory are compared too."""
    error, model, reference, x, d, start, rate = PLANTS[plant]
    law = build_law(name, error, model)
    e, w, bound = independent_error(plant, x, d)
    memory, numpy_memory, profile = law.begin(), None, None
    if name.startswith("time_base"):
        memory, numpy_memory = time_base.ProfileStart(jnp.ones(()), vector(start), vector(rate)), (start, rate)
        profile = attitude_profile(start, rate, T) if plant == "attitude" else None
    elif name == "super_twisting":
        memory = numpy_memory = vector(start)
    u, s, next_memory = law(NOW._replace(memory=memory), x, reference(vector(T)), d, vector(K2))
    error_found, rate_found, differentiated_rate, acceleration = error_of_plant(law, reference, vector(T), x, u, d)
    a, surface, numpy_next = law_in_numpy(name, GAINS[name], (T, False, 0.1), e, w, bound, numpy_memory, profile)
    # rounding; finite differences of the profile have errors of h^4 and 1e-16 / h^2, times gains and 1 / sign_width
    tolerance = 1e-7 if profile is not None else 1e-11
    for one, other in ((error_found, e), (rate_found, w), (differentiated_rate, w)):
        np.testing.assert_allclose(one, other, rtol=1e-12, atol=1e-14)
    np.testing.assert_allclose(acceleration, a, rtol=tolerance, atol=tolerance)
    np.testing.assert_allclose(s, surface, rtol=tolerance, atol=tolerance)
    if numpy_next is not None:
        next_memory = next_memory[1:] if name.startswith("time_base") else next_memory
        np.testing.assert_allclose(jnp.stack(next_memory), np.stack(numpy_next), rtol=1e-14)


# ---- derivatives, and points with zero error or rate

POINTS = [(vector([0.4]), vector([-0.2])), (vector([0.0]), vector([0.0])), (vector([0.0]), vector([0.3])),
          (vector([-0.5]), vector([0.0]))]  # fmt: skip
TIMES = ((0.0, False), (1.3, False), (T_F - DELTA, True), (T_F, True), (T_F + 1.0, True))


@pytest.mark.parametrize("name", CLASSES)
def test_derivatives_of_laws_by_gains_errors_and_memory_equal_finite_differences(name):
    law, now = build_law(name), Sample(vector(1.3), APPROACH, vector(0.1))
    first = evaluate(law, law.begin(), NOW, *(vector([v]) for v in (0.9, -0.1)), vector(0.05))[2]
    inputs = ({key: getattr(law, key) for key in (*GAINS[name], "t_f")}, first, *POINTS[0])

    @jax.jit
    def value(gains, memory, e, w):
        a, s, memory = evaluate(replace(law, **gains), memory, now, e, w, vector(0.05))
        return jnp.concatenate([a, s]), memory

    flat, unravel = ravel_pytree(inputs)
    exact = jax.jit(jax.jacfwd(lambda v: ravel_pytree(value(*unravel(v)))[0]))(flat)
    for k in range(flat.size):  # truncation: h^2 times third derivatives of 10 to 1e4; rounding: 1e-16 / h
        step = 1e-5 * np.eye(flat.size)[k]
        ends = [ravel_pytree(value(*unravel(flat + sign * step)))[0] for sign in (1.0, -1.0)]
        np.testing.assert_allclose(exact[:, k], (ends[0] - ends[1]) / 2e-5, rtol=1e-6, atol=1e-6)


@pytest.mark.parametrize("name", CLASSES)
def test_values_and_gradients_of_laws_are_finite_at_zero_norms_roots_and_remaining_times(name):
    @jax.jit
    def gradients_and_values(law, t, hold, e, w):
        return jax.jacrev(
            lambda law, t, e, w: evaluate(law, law.begin(), Sample(t, hold, vector(0.1)), e, w, vector(0.05)),
            argnums=(0, 1, 2, 3),
        )(law, t, e, w), evaluate(law, law.begin(), Sample(t, hold, vector(0.1)), e, w, vector(0.05))

    widths = ({"sign_width": 0.0}, {"sign_width": 0.02}) if "sign_width" in GAINS[name] else ({},)
    for changes in widths:
        for delta in (DELTA, 0.1):  # one period
            law = build_law(name, delta=delta, **changes)
            for t, hold in TIMES:
                for e, w in POINTS:
                    found = jax.tree.leaves(gradients_and_values(law, vector(t), np.asarray(hold), e, w))
                    assert all(np.isfinite(leaf).all() for leaf in found), (changes, delta, t, e, w)


# ---- a simulated chain against a loop in NumPy


def chain_run(law, x0, period=0.01, noise=0.0, disturbance=(0.0, 1.0, 0.0, 0.0), bound=0.0) -> Any:
    """Return the parts of a sampled chain under this law.

    disturbance: amplitude, frequency, phase and bias. noise: 1 sigma of both states.
    """
    a, w, p, b = (vector([v]) for v in disturbance)
    run = helpers.chain_parts(x0, T_F, delta=DELTA, period=period, noise=(noise, noise), bound=bound,
                              disturbance=disturbances.Sinusoid(a, w, p, b))  # fmt: skip
    timing = clock.Sampled(vector(period), run.t_end, vector(1.0), 1520)
    return replace(run, controller=law, clock=timing)


def simulate(run, trial=0, status=rollout.OK) -> Any:
    """Return the history of a run as NumPy arrays, without the periods of no length; status: the expected one."""
    found = rollout.simulate_parts(run, trial=np.uint32(trial), record=True)
    assert found.status == status
    log = jax.tree.map(np.asarray, found.log)
    return jax.tree.map(lambda v: v[log.has_length] if v.ndim else v, log)


def simulate_in_numpy(name, law, x0, times, disturbance=(0.0, 1.0, 0.0, 0.0), bound=0.0):
    """Return states (times, 2) and commands (times - 1, 1) of the chain, by `law_in_numpy` and the closed-form motion.

    name, law: of the same law. disturbance: amplitude, frequency, phase and bias.
    """
    gains = {key: float(getattr(law, key)) for key in GAINS[name]}
    amplitude, w, phase, bias = disturbance
    x, memory, states, commands = np.array(x0, dtype=float), None, [], []
    for t, h in zip(times[:-1], np.diff(times), strict=True):
        a, _, memory = law_in_numpy(name, gains, (t, t >= T_F - DELTA - 1e-9, h), x[:1], x[1:], bound, memory)
        states.append(x)
        commands.append(a)
        turn, end = w * t + phase, w * (t + h) + phase
        impulse = amplitude / w * (np.cos(turn) - np.cos(end)) + bias * h
        moved = amplitude / w * (h * np.cos(turn) - (np.sin(end) - np.sin(turn)) / w) + bias * h**2 / 2
        x = np.array([x[0] + h * x[1] + h**2 / 2 * a[0] + moved, x[1] + h * a[0] + impulse])
    return np.array([*states, x]), np.array(commands)


START = (1.0, -0.2)
DISTURBANCE = (0.2, 1.3, 0.4, 0.05)


@pytest.mark.parametrize("name", CLASSES)
def test_simulated_chain_equals_the_loop_in_numpy(name):
    """The run includes both phases and the memory of the law."""
    law = build_law(name)
    log = simulate(chain_run(law, START, disturbance=DISTURBANCE, bound=0.3))
    states, commands = simulate_in_numpy(name, law, START, log.t, DISTURBANCE, bound=0.3)
    # rounding, and the error of RK4 for a sinusoid, h^5 0.2 1.3^4 / 2880 a step, amplified by powers below 1 near zero
    tolerance = 1e-8 if name == "predefined_time" else 1e-11
    np.testing.assert_allclose(log.x, states, rtol=0, atol=tolerance)
    np.testing.assert_allclose(log.u[:-1], commands, rtol=100 * tolerance, atol=100 * tolerance)


@pytest.mark.parametrize("name", ["time_base_pd", "super_twisting"])
def test_derivatives_of_a_run_include_the_memory_of_the_law(name):
    """The error after t_f is differentiated by every gain, with noise in all samples."""
    law = build_law(name, delta=0.49)  # the first period is half as long; at length 0 the derivative by t_f would jump
    run = chain_run(law, START, period=0.02, noise=0.01, disturbance=DISTURBANCE)
    names = (*GAINS[name], "t_f")

    def window_error(values):
        gains = dict(zip(names, values, strict=True))
        return rollout.simulate(replace(run, controller=replace(law, **gains))).metrics.window_error

    @jax.jit
    def value_and_derivative(at, along):
        return jax.jvp(window_error, (at,), (along,))

    at = np.array([getattr(law, key) for key in names])
    for value, along in zip(at, np.eye(len(names)), strict=True):
        step = 1e-5 * value
        up, down = (value_and_derivative(at + sign * step * along, along)[0] for sign in (1, -1))
        # truncation: the square of the step; rounding: 1e-16 / step times the number of periods
        np.testing.assert_allclose(value_and_derivative(at, along)[1], (up - down) / (2 * step), rtol=1e-5, atol=1e-9)


# ---- time base generators


def test_time_base_profile_is_the_quintic_from_the_measured_error_to_rest():
    """The largest acceleration from rest equals its closed form."""
    law, start = build_law("time_base_pd"), time_base.ProfileStart(jnp.ones(()), vector([1.4]), vector([-0.3]))
    profile = jax.jit(law.profile)
    for t in (0.0, 0.4, 2.5, 4.9, T_F, T_F + 1.0):
        for found, exact in zip(
            profile(start, vector(t)), quintic(np.array(start.error), np.array(start.rate), t), strict=True
        ):
            np.testing.assert_allclose(found, exact, rtol=1e-11, atol=1e-14)  # rounding of powers up to x^5
    first, last = profile(start, vector(0.0)), profile(start, vector(T_F))
    np.testing.assert_allclose(jnp.stack(first)[:, 0], [1.4, -0.3, 0.0], atol=1e-15)
    np.testing.assert_allclose(jnp.stack(last)[:, 0], 0.0, atol=1e-14)
    # from rest, the largest acceleration is 10 / sqrt(3) e0 / t_f^2, at the fractions (1 -+ 1 / sqrt(3)) / 2 of t_f
    at_rest = start._replace(rate=vector([0.0]))
    times = T_F * np.array([0.5 - 0.5 / np.sqrt(3.0), 0.5 + 0.5 / np.sqrt(3.0), *np.linspace(0.0, 1.0, 101)])
    accelerations = np.array([profile(at_rest, vector(t)).acceleration[0] for t in times]) * T_F**2 / 1.4
    np.testing.assert_allclose(accelerations[:2], [-10.0 / np.sqrt(3.0), 10.0 / np.sqrt(3.0)], rtol=1e-12)
    assert np.abs(accelerations).max() <= 10.0 / np.sqrt(3.0) * (1 + 1e-12)


def test_attitude_profile_rotates_about_the_eigenaxis():
    axis = np.array([0.6, 0.0, -0.8])
    profile = jax.jit(build_law("time_base_pd", MultiplicativeKinematics, BODY).profile)
    for turn, rate in ((2.4, 0.0), (1.0, 0.3), (0.0, 0.0)):
        start = time_base.ProfileStart(jnp.ones(()), vector(turn * axis), vector(rate * axis))
        for t in (0.0, 1.7, 4.6, T_F, 5.5):
            angle, speed, change = quintic(np.array(turn), np.array(rate), t)
            v, v_dot, v_ddot = profile(start, vector(t))
            sin, cos = np.sin(angle / 2), np.cos(angle / 2)
            np.testing.assert_allclose(v, sin * axis, atol=1e-14)
            np.testing.assert_allclose(v_dot, speed / 2 * cos * axis, atol=1e-13)
            np.testing.assert_allclose(v_ddot, (change / 2 * cos - speed**2 / 4 * sin) * axis, atol=1e-12)


def test_rotation_vector_equals_twice_the_arc_sine():
    sizes = np.array(  # on both sides of the change from series to arctan2
        [0.0, 1e-9, 3e-4, 9.99e-4, 1.001e-3, 0.02, 0.5, 0.97]
    )
    axis = np.array([0.48, -0.6, 0.64])
    found = jax.jit(jax.vmap(attitude.rotation_vector))(vector(sizes[:, None] * axis))
    np.testing.assert_allclose(found, 2.0 * np.arcsin(sizes)[:, None] * axis, rtol=1e-14)


@pytest.mark.parametrize("no_feedback", [False, True])
def test_time_base_profile_starts_at_the_first_measured_error_and_does_not_change(no_feedback):
    """The first period is half as long. Without feedback, the command is the acceleration of the profile."""
    gains = {"k_p": 1e-13, "k_d": 1e-13} if no_feedback else {}
    law = build_law("time_base_pd", delta=0.495, **gains)  # the first period is half as long
    run = chain_run(law, START, noise=0.05)
    log = simulate(run, 3, rollout.NOT_CONVERGED if no_feedback else rollout.OK)
    ticks = ticks_of(run.clock, law.t_f, law.delta)
    first = int(np.argmax(np.asarray(ticks.t_next > ticks.t)))
    assert 0.4 < float(ticks.noise_weight[first]) < 0.6
    key = run.sensors.key(np.uint32(0), np.uint32(3))
    now, then = (run.sensors.noise(key, ticks.sample[first] + k) for k in (0, 1))
    measured = START + np.asarray(then + ticks.noise_weight[first] * (now - then))
    assert np.abs(measured - START).min() > 1e-3
    assert abs(log.u[0, 0]) < 1e-13  # no deviation at the start
    if no_feedback:  # the command is the acceleration of the profile: fit the initial error and rate to it
        basis = np.array([[quintic(np.array(e), np.array(1.0 - e), t)[2] for e in (1.0, 0.0)] for t in log.t[:-1]])
        found, *_ = np.linalg.lstsq(basis, log.u[:-1, 0], rcond=None)
        np.testing.assert_allclose(found, measured, rtol=1e-10)
        np.testing.assert_allclose(log.u[:-1, 0], basis @ found, atol=1e-11)  # during the whole run


def test_body_at_rest_rotates_about_its_eigenaxis_by_the_quintic():
    axis, turn = np.array([2.0, -1.0, 2.0]) / 3.0, 2.2
    q = Rotation.from_rotvec(turn * axis).as_quat()
    law = build_law("time_base_pd", MultiplicativeKinematics, BODY)
    deviations = []
    for period in (0.02, 0.01):
        run = helpers.parts(T_F, 3.0, DELTA, inertia=FULL_INERTIA, q=q, period=0.01, t_end=T_F + 1.0,
                            disturbance=disturbances.Constant(jnp.zeros(3)))  # fmt: skip
        timing = replace(run.clock, period=vector(period))
        log = simulate(replace(run, controller=law, clock=timing, observer=NoObserver(BODY, vector(0.0))))
        turned = Rotation.from_quat(log.x.q).as_rotvec()
        angle = np.array([float(quintic(np.array(turn), np.array(0.0), t)[0]) for t in log.t])
        along = turned @ axis
        deviations.append((np.abs(along - angle).max(), np.linalg.norm(turned - along[:, None] * axis, axis=1).max()))
        # the torque lags by half a period, and the body axes rotate within a period
        assert max(deviations[-1]) < 1.5 * 0.5 * period * 60.0 * turn / T_F**3 / GAINS["time_base_pd"]["k_p"]
    assert np.all(np.array(deviations[1]) < 0.55 * np.array(deviations[0]))  # proportional to the period


# ---- scaling


def closed_loop(law, start, t_end, d=0.0, event=None, bound=0.0):
    """Integrate a double integrator under the law in continuous time; return SciPy's solution.

    start: error and rate. d: constant disturbance. event: whether to stop when s becomes zero; otherwise the solution
    is dense.
    """
    memory, bound = law.begin(), vector(bound)
    approach: Any = np.array(False)  # NumPy arrays have the smallest call overhead
    period: Any = np.array(0.1)

    def command(t, y):
        now: Any = np.array(t)
        return evaluate(law, memory, Sample(now, approach, period), *np.split(np.array(y), 2), bound)

    def surface(t, y):
        return float(command(t, y)[1][0])

    surface.terminal, surface.direction = True, -1  # pyright: ignore[reportFunctionMemberAccess]
    return solve_ivp(lambda t, y: (y[1], float(command(t, y)[0][0]) + d), (0.0, t_end), start, method="DOP853",
                     rtol=1e-10, atol=1e-14, dense_output=not event, events=surface if event else None)  # fmt: skip


@pytest.mark.parametrize("d", [0.0, -0.4])
def test_scaling_law_follows_its_closed_form(d):
    """With z' = mu (d - k z), z - d/k decays by exp(-k t_f/(p-1) ((t_f/r)^(p-1) - 1))."""
    k1, k, p = 0.7, 0.02, 3.3
    for start in (START, (1.0, -p / T_F - k1)):  # the second start has z = 0
        z_0 = start[1] + (p / T_F + k1) * start[0]
        run = closed_loop(build_law("scaling"), start, T_F - DELTA, d)

        def z(t, z_0=z_0):
            passed = T_F / (p - 1.0) * ((T_F / (T_F - t)) ** (p - 1.0) - 1.0)
            return d / k + (z_0 - d / k) * np.exp(-k * passed)

        for t in (1.0, 3.0, T_F - DELTA):
            mu = (T_F / (T_F - t)) ** p
            xi = start[0] * np.exp(-k1 * t) + quad(lambda s, t=t: np.exp(-k1 * (t - s)) * z(s), 0.0, t, epsabs=1e-12)[0]
            e, w = run.sol(t)
            np.testing.assert_allclose(e * mu, xi, rtol=1e-7, atol=1e-8)  # the integration error of 1e-10 times mu
            np.testing.assert_allclose(mu * (w + (p / (T_F - t) + k1) * e), z(t), rtol=1e-6, atol=1e-6)
            if z_0 == 0.0:
                assert abs(z(t)) <= abs(d) / k


def test_scaling_law_has_constant_gains_in_the_hold_phase():
    law, hold = build_law("scaling"), jnp.asarray(True)
    e, w, zero = vector([0.3]), vector([-0.2]), vector(0.0)
    commands = [evaluate(law, None, Sample(vector(t), hold, vector(0.1)), e, w, zero)[:2] for t in (4.5, 4.7, T_F, 6.0)]
    before = evaluate(law, None, Sample(vector(T_F - DELTA), APPROACH, vector(0.1)), e, w, zero)[:2]
    for found in commands:
        np.testing.assert_allclose(jnp.stack(found), jnp.stack(before), rtol=1e-12)


# ---- predefined time

# settling time from rest as a fraction of T_1 + T_2, by initial error, as in docs/theory/comparison_laws.md
MEASURED = {1e-3: 0.051, 1.0: 0.308, 1e3: 0.553}


@pytest.mark.parametrize("x", [1e-3, 0.5, 1e3])
def test_settling_time_of_phi_equals_its_closed_form(x):
    """It is T 2/pi atan(|x|^q) < T. The integral over y = x^q has no singularity at zero."""
    q, settling = 0.3, 4.0
    phi = jax.jit(lambda x: baselines.phi(x, vector(q), vector(settling)))

    def time_density(y):
        return y ** (1.0 / q - 1.0) / q / float(phi(vector([y ** (1.0 / q)]))[0])

    arrival = quad(time_density, 0.0, x**q, epsrel=1e-10)[0]
    np.testing.assert_allclose(arrival, settling * 2.0 / np.pi * np.arctan(x**q), rtol=1e-9)


STARTS = [(start, d) for start in (1e-3, 1e-2, 0.1, 1.0, 10.0, 100.0, 1e3) for d in (0.0, 0.3)]


@pytest.mark.parametrize(
    ("start", "d"), helpers.short(STARTS, [(1e-3, 0.0), (1.0, 0.0), (1e3, 0.0), (1e-3, 0.3), (10.0, 0.3)])
)
def test_predefined_time_law_settles_long_before_its_bound(start, d):
    """The time to s = 0 is integrated, also for d = K. The time on s = 0 has a closed form.

    From rest and without d, the speed w grows by at least 2 Phi Phi', so that w^2 >= 2 (Phi(start)^2 - Phi^2). So
    s = 0, where w^2 = Phi^2, is reached before Phi has decreased to sqrt(2/3) of its initial value. The growth of w
    slows down, so that its mean is more than half of its last value.
    """
    first, second, q = 0.6 * T_F, 0.4 * T_F, 0.3
    run = closed_loop(build_law("predefined_time", sign_width=0.0), (start, 0.0), T_F, d, event=True, bound=d)
    assert run.status == 1
    reached, e, w = run.t[-1], *run.y[:, -1]
    np.testing.assert_allclose(w, -phi(e, q, first), rtol=1e-8)  # on s = 0
    assert reached < second
    sliding = first * 2.0 / np.pi * np.arctan(e**q)
    assert reached + sliding < T_F
    if d == 0.0:  # lower and upper bounds of the settling time
        least = brentq(lambda x: phi(x, q, first) - np.sqrt(2.0 / 3.0) * phi(start, q, first), 0.0, start)
        assert least <= e <= start
        assert reached <= 2.0 * (start - least) / phi(least, q, first)
        fraction = 0.6 * 2.0 / np.pi * np.arctan(np.array([least, start]) ** q)
        assert (
            fraction[0] <= (reached + sliding) / T_F <= fraction[1] + 2.0 * (start - least) / phi(least, q, first) / T_F
        )
        assert abs((reached + sliding) / T_F - MEASURED.get(start, (reached + sliding) / T_F)) < 1e-3


def test_predefined_time_switching_gain_at_zero_error_is_its_limit():
    """For q1 = 1/2 the switching gain at zero is (pi / (2 q1 T_1))^2 (1 - q1), for smaller q1 it is 0."""
    zero, rate = vector([0.0]), vector([0.2])
    for q1, coupling in ((0.5, 0.5 * (np.pi / (0.6 * T_F)) ** 2), (0.4, 0.0)):
        law = build_law("predefined_time", q1=q1, sign_width=0.0)
        a, s, _ = evaluate(law, None, NOW, zero, rate, vector(0.3))
        np.testing.assert_allclose(a, -phi(np.array(s), 0.4, 0.4 * T_F) - 0.3 - 2.0 * coupling, rtol=1e-12)


# ---- super-twisting


def test_super_twisting_estimates_the_disturbance_after_a_finite_time():
    """The disturbance has |d'| <= 0.26 < L = 0.3. s and v + d oscillate about zero with decreasing half-periods."""
    c, lipschitz = GAINS["super_twisting"]["surface_rate"], 0.3
    law = build_law("super_twisting", sign_width=0.0)
    a, w, p, b = DISTURBANCE

    def crossing(t, y):
        return y[0]

    crossing.terminal = True  # pyright: ignore[reportFunctionMemberAccess]
    t, y, crossings = 0.0, (START[1] + c * START[0], 0.0), []
    for side in (1.0, -1.0, 1.0, -1.0):  # integrate s and v with a constant sign up to each zero crossing
        run = solve_ivp(
            lambda t, y, side=side: (-1.5 * np.sqrt(lipschitz) * sig(y[0], 0.5) + y[1] + a * np.sin(w * t + p) + b,
                                     -1.1 * lipschitz * side),
            (t, t + 5.0), (y[0] if not crossings else side * 1e-12, y[1]), rtol=1e-9, atol=1e-13, events=crossing,
            first_step=1e-6, method="DOP853",
        )  # fmt: skip
        t, y = run.t[-1], run.y[:, -1]
        crossings.append((t, y[1] + a * np.sin(w * t + p) + b))
    times, off = np.array(crossings).T
    ratio = np.abs(off[1:] / off[:-1])
    assert np.all(ratio[:3] < 0.6)
    assert np.all(np.diff(times)[1:] < 0.6 * np.diff(times)[:-1])  # so the sum of half-periods is finite
    arrived = times[-1] + 1.5 * (times[-1] - times[-2])  # the remaining half-periods sum to 0.6 / (1 - 0.6) of the last
    for period in (0.01, 0.005):
        log = simulate(chain_run(law, START, period, disturbance=DISTURBANCE))
        s = log.x[:, 1] + c * log.x[:, 0]
        v = log.u[:, 0] + c * log.x[:, 1] + 1.5 * np.sqrt(lipschitz) * sig(s, 0.5)
        d = a * np.sin(w * log.t + p) + b
        changes = log.t[1:][np.diff(np.sign(s)) != 0.0]
        np.testing.assert_allclose(changes[:2], times[:2], atol=3.0 * period)  # sampling and hold delay them
        # v changes by 1.1 L h and d by 0.87 L h in a period, for a few periods until s changes its sign
        late = np.append(log.t[:-1] > arrived + 10.0 * period, False)
        assert np.abs(v + d)[late].max() < 5.0 * lipschitz * period
        assert np.abs(s[late]).max() < 5.0 * lipschitz * period**2
