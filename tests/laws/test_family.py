"""The family of laws for eps'' = a + d: against closed forms, their papers' claims and loops written in NumPy."""

import copy
import math
import pickle
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
from ptsmc_jax.observers import none
from ptsmc_jax.plants import integrator_chain, rigid_body
from ptsmc_jax.scenario import systems
from ptsmc_jax.signals import disturbances, references
from ptsmc_jax.simulation import clock, rollout
from tests import helpers
from tests.helpers import FULL_INERTIA, ROOT, ticks_of, vector

T_F, DELTA = 5.0, 0.5
GAINS: dict[str, dict[str, float]] = {
    "pd": {"k_p": 0.7, "k_d": 1.3},
    "time_base_pd": {"k_p": 1.7, "k_d": 2.3},
    "time_base_sliding": {"surface_rate": 1.4, "k": 0.9, "sign_width": 0.02},
    "scaling": {"m": 1.3, "k1": 0.7, "k": 0.02},
    "predefined_time": {"share": 0.6, "q1": 0.3, "q2": 0.4, "sign_width": 1.0},
    "super_twisting": {"surface_rate": 0.8, "lipschitz": 0.3, "sign_width": 0.02},
}
CLASSES: dict[str, Any] = {
    "pd": baselines.PD,
    "time_base_pd": time_base.TimeBasePD,
    "time_base_sliding": time_base.TimeBaseSliding,
    "scaling": baselines.Scaling,
    "predefined_time": baselines.PredefinedTime,
    "super_twisting": baselines.SuperTwisting,
}
BODY, CHAIN = rigid_body.spacecraft(FULL_INERTIA), integrator_chain.chain(2)
NEVER = jnp.asarray(False)


def made(name, error: Any = ChainKinematics, model: Any = CHAIN, t_f=T_F, delta=DELTA, **changes) -> Any:
    """The law by its name in scenario files, with the gains above."""
    gains = {key: vector(value) for key, value in {**GAINS[name], **changes}.items()}
    return CLASSES[name](kinematics=error(model), t_f=vector(t_f), delta=vector(delta), **gains)


@jax.jit
def stepped(law, memory, now, error, rate, bound):
    """Acceleration, sliding variable and the next memory."""
    a, s, *memories = law.acceleration(now._replace(memory=memory), error, rate, bound)
    return a, s, memories[0] if memories else memory


@pytest.mark.parametrize("name", CLASSES)
def test_a_law_is_pickled_and_copied(name):
    law = made(name, MultiplicativeKinematics, BODY)
    for other in (pickle.loads(pickle.dumps(law)), copy.deepcopy(law)):
        assert jax.tree.structure(other) == jax.tree.structure(law)
        assert jax.tree.leaves(jax.tree.map(np.array_equal, other, law)) == [True] * len(jax.tree.leaves(law))


# ---- the laws once more, in NumPy and from their papers


def sig(x, power):
    return np.sign(x) * np.abs(x) ** power


def powers_of(x):
    """1, x .. x^5 and their first two derivatives, a row each."""
    return np.array([[math.perm(k, n) * x ** max(k - n, 0) for k in range(6)] for n in range(3)])


ENDS = np.concatenate([powers_of(0.0), powers_of(1.0)])


def quintic(start, rate, t, t_f=T_F):
    """Value, rate and acceleration at t of the only quintic with this start, no acceleration there, at rest at t_f."""
    if t >= t_f:
        return 0.0 * start, 0.0 * start, 0.0 * start
    found = np.linalg.solve(ENDS, np.stack([start, t_f * rate, *(0.0 * start for _ in range(4))]))
    return tuple(row @ found / t_f**n for n, row in enumerate(powers_of(t / t_f)))


def phi(x, q, settling):
    return np.pi / (2.0 * q * settling) * (sig(x, 1.0 + q) + sig(x, 1.0 - q))


def phi_slope(x, q, settling):
    return np.pi / (2.0 * q * settling) * ((1.0 + q) * np.abs(x) ** q + (1.0 - q) * np.abs(x) ** -q)


def wanted(name, gains, now, e, w, bound, memory=None, profile=None):
    """Acceleration, sliding variable and the memory after it; now: time, hold, length of the period."""
    (t, hold, dt), g = now, gains

    def sign(s):
        return np.sign(s) if g["sign_width"] == 0.0 else np.tanh(s / g["sign_width"])

    if name == "pd":
        return -g["k_p"] * e - g["k_d"] * w, e + g["k_d"] / g["k_p"] * w, None
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
        turning = 2.0 * np.abs(surface) * phi_slope(e, g["q1"], first)
        return -phi(s, g["q2"], second) - (bound + turning) * sign(s), s, None
    s = w + g["surface_rate"] * e
    root = s / (s**2 + g["sign_width"] ** 2) ** 0.25 if g["sign_width"] else sig(s, 0.5)  # smooth as the sign is
    v = 0.0 * e if memory is None else memory
    return -g["surface_rate"] * w - 1.5 * np.sqrt(g["lipschitz"]) * root + v, s, v - dt * 1.1 * g["lipschitz"] * sign(s)


# ---- what eps'' becomes on each plant, by the plant's own equations

T = 1.3
NOW = Sample(vector(T), NEVER, vector(0.1))
SPIN = references.Spin(vector(Rotation.from_rotvec([0.3, -0.2, 0.5]).as_quat()), vector([0.02, -0.01, 0.03]))
ARM: Any = systems.load(str(ROOT / "scenarios" / "two_link_arm.py") + ":arm")
K2 = 0.06
# error, plant, reference, state, disturbance, where a profile began: in straight coordinates, and its rate
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
def becomes(law, reference, t, x, u, d):
    """Eps, eps' and eps'' of the plant at t with this input and disturbance."""
    motion = law.model.rate(t, x, u, d)

    def at(passed):  # along the motion, to first order; the reference moves on by itself
        return law.kinematics.errors(jax.tree.map(lambda x, rate: x + passed * rate, x, motion), reference(t + passed))

    (error, rate), (also, acceleration) = jax.jvp(at, (vector(0.0),), (vector(1.0),))
    return error, rate, also, acceleration


def seen(plant, x, d):
    """Eps and eps' without the code under test, and what a disturbance of size K2 does to eps'' at most."""
    if plant == "chain":
        return np.array(x[:1]), np.array(x[1:]), K2
    if plant == "arm":
        rate = [0.6 * 0.8 * np.cos(0.8 * T), -0.5 * np.sin(T)]
        return np.array(x[:2]), np.array(x[2:]) - rate, K2 * np.linalg.norm(ARM.G(vector(T), x[:2], x[2:]))
    target = SPIN(vector(T))
    q_e = Rotation.from_quat(np.array(target.q)).inv() * Rotation.from_quat(np.array(x.q))
    w_e = np.array(x.w) - q_e.inv().apply(np.array(target.w))
    v, s = np.split(q_e.as_quat(canonical=True), [3])
    turning = s * np.eye(3) + np.cross(np.eye(3), v)
    return v, 0.5 * turning @ w_e, 0.5 * K2 * np.linalg.norm(turning @ np.linalg.inv(np.array(FULL_INERTIA)))


def swung(start, rate, t, h=5e-3):
    """Vector part of the rotation by the quintic rotation vector, and its derivatives by differences of 4th order."""
    at = [Rotation.from_rotvec(quintic(start, rate, t + k * h)[0]).as_quat()[:3] for k in (-2, -1, 0, 1, 2)]
    first = (at[0] - 8 * at[1] + 8 * at[3] - at[4]) / (12 * h)
    return at[2], first, (-at[0] + 16 * at[1] - 30 * at[2] + 16 * at[3] - at[4]) / (12 * h**2)


# every law on one plant, and every plant under one law: `on` joins any two
JOINED = [(plant, name) for plant in PLANTS for name in CLASSES]
KEPT = [case for case in JOINED if case[0] == "attitude" or case[1] == "time_base_sliding"]


@pytest.mark.parametrize(("plant", "name"), helpers.short(JOINED, KEPT))
def test_the_input_gives_the_error_the_acceleration_that_the_paper_asks_for(plant, name):
    error, model, reference, x, d, start, rate = PLANTS[plant]
    law = made(name, error, model)
    e, w, bound = seen(plant, x, d)
    memory, known, profile = law.begin(), None, None
    if name.startswith("time_base"):
        memory, known = time_base.Start(jnp.ones(()), vector(start), vector(rate)), (start, rate)
        profile = swung(start, rate, T) if plant == "attitude" else None
    elif name == "super_twisting":
        memory = known = vector(start)
    u, s, kept = law(NOW._replace(memory=memory), x, reference(vector(T)), d, vector(K2))
    found, found_rate, also, acceleration = becomes(law, reference, vector(T), x, u, d)
    a, surface, remembered = wanted(name, GAINS[name], (T, False, 0.1), e, w, bound, known, profile)
    # rounding; differences of the profile leave h^4 and 1e-16 / h^2, times gains and the sign's 1 / sign_width
    near = 1e-7 if profile is not None else 1e-11
    for one, other in ((found, e), (found_rate, w), (also, w)):
        np.testing.assert_allclose(one, other, rtol=1e-12, atol=1e-14)
    np.testing.assert_allclose(acceleration, a, rtol=near, atol=near)
    np.testing.assert_allclose(s, surface, rtol=near, atol=near)
    if remembered is not None:
        kept = kept[1:] if name.startswith("time_base") else kept
        np.testing.assert_allclose(jnp.stack(kept), np.stack(remembered), rtol=1e-14)


# ---- slopes and awkward points

POINTS = [(vector([0.4]), vector([-0.2])), (vector([0.0]), vector([0.0])), (vector([0.0]), vector([0.3])),
          (vector([-0.5]), vector([0.0]))]  # fmt: skip
TIMES = ((0.0, False), (1.3, False), (T_F - DELTA, True), (T_F, True), (T_F + 1.0, True))


@pytest.mark.parametrize("name", CLASSES)
def test_slopes_by_gains_errors_and_memory_are_those_of_differences(name):
    law, now = made(name), Sample(vector(1.3), NEVER, vector(0.1))
    first = stepped(law, law.begin(), NOW, *(vector([v]) for v in (0.9, -0.1)), vector(0.05))[2]
    inputs = ({key: getattr(law, key) for key in (*GAINS[name], "t_f")}, first, *POINTS[0])

    @jax.jit
    def value(gains, memory, e, w):
        a, s, memory = stepped(replace(law, **gains), memory, now, e, w, vector(0.05))
        return jnp.concatenate([a, s]), memory

    flat, unravel = ravel_pytree(inputs)
    exact = jax.jit(jax.jacfwd(lambda v: ravel_pytree(value(*unravel(v)))[0]))(flat)
    for k in range(flat.size):  # differences: h^2 of third derivatives of some 10 to 1e4, and 1e-16 / h
        step = 1e-5 * np.eye(flat.size)[k]
        ends = [ravel_pytree(value(*unravel(flat + sign * step)))[0] for sign in (1.0, -1.0)]
        np.testing.assert_allclose(exact[:, k], (ends[0] - ends[1]) / 2e-5, rtol=1e-6, atol=1e-6)


@pytest.mark.parametrize("name", CLASSES)
def test_values_and_slopes_are_finite_wherever_a_norm_a_root_or_a_time_to_go_vanishes(name):
    @jax.jit
    def all_of(law, t, hold, e, w):
        return jax.jacrev(
            lambda law, t, e, w: stepped(law, law.begin(), Sample(t, hold, vector(0.1)), e, w, vector(0.05)),
            argnums=(0, 1, 2, 3),
        )(law, t, e, w), stepped(law, law.begin(), Sample(t, hold, vector(0.1)), e, w, vector(0.05))

    widths = ({"sign_width": 0.0}, {"sign_width": 0.02}) if "sign_width" in GAINS[name] else ({},)
    for changes in widths:
        for delta in (DELTA, 0.1):  # one period
            law = made(name, delta=delta, **changes)
            for t, hold in TIMES:
                for e, w in POINTS:
                    found = jax.tree.leaves(all_of(law, vector(t), np.asarray(hold), e, w))
                    assert all(np.isfinite(leaf).all() for leaf in found), (changes, delta, t, e, w)


# ---- a chain flown, beside a loop of its own


def chain_run(law, x0, period=0.01, noise=0.0, disturbance=(0.0, 1.0, 0.0, 0.0), bound=0.0) -> Any:
    """Amplitude, frequency, phase and bias of the disturbance; some periods before the first have no length."""
    a, w, p, b = (vector([v]) for v in disturbance)
    run = helpers.chain_parts(x0, T_F, delta=DELTA, period=period, noise=(noise, noise), bound=bound,
                              disturbance=disturbances.Sinusoid(a, w, p, b))  # fmt: skip
    timing = clock.Anchored(vector(period), run.t_end, 1000, 520)
    return replace(run, controller=law, clock=timing)


def flown(run, trial=0, status=rollout.OK) -> Any:
    """Histories of a run, without its periods of no length."""
    found = rollout.simulate_parts(run, trial=np.uint32(trial), record=True)
    assert found.status == status
    log = jax.tree.map(np.asarray, found.log)
    return jax.tree.map(lambda v: v[log.has_length] if v.ndim else v, log)


def looped(name, law, x0, times, disturbance=(0.0, 1.0, 0.0, 0.0), bound=0.0):
    """The states of the chain at these times by the formulas above, and v'' held; the plant's motion in closed form."""
    gains = {key: float(getattr(law, key)) for key in GAINS[name]}
    amplitude, w, phase, bias = disturbance
    x, memory, states, asked = np.array(x0, dtype=float), None, [], []
    for t, h in zip(times[:-1], np.diff(times), strict=True):
        a, _, memory = wanted(name, gains, (t, t >= T_F - DELTA - 1e-9, h), x[:1], x[1:], bound, memory)
        states.append(x)
        asked.append(a)
        turn, end = w * t + phase, w * (t + h) + phase
        push = amplitude / w * (np.cos(turn) - np.cos(end)) + bias * h
        moved = amplitude / w * (h * np.cos(turn) - (np.sin(end) - np.sin(turn)) / w) + bias * h**2 / 2
        x = np.array([x[0] + h * x[1] + h**2 / 2 * a[0] + moved, x[1] + h * a[0] + push])
    return np.array([*states, x]), np.array(asked)


START = (1.0, -0.2)
WIND = (0.2, 1.3, 0.4, 0.05)


@pytest.mark.parametrize("name", CLASSES)
def test_a_chain_flies_as_its_loop_in_numpy(name):
    """Through the hand-over and beyond t_f: also what is remembered from sample to sample."""
    law = made(name)
    log = flown(chain_run(law, START, disturbance=WIND, bound=0.3))
    states, asked = looped(name, law, START, log.t, WIND, bound=0.3)
    # rounding, and RK4 on a sinusoid, h^5 0.2 1.3^4 / 2880 a step; powers below 1 make more of it near zero
    near = 1e-8 if name == "predefined_time" else 1e-11
    np.testing.assert_allclose(log.x, states, rtol=0, atol=near)
    np.testing.assert_allclose(log.u[:-1], asked, rtol=100 * near, atol=100 * near)


@pytest.mark.parametrize("name", ["time_base_pd", "super_twisting"])
def test_slopes_of_a_flight_go_through_what_a_law_remembers(name):
    """The error after t_f by every gain, with noise in the first sample too."""
    law = made(name, delta=0.49)  # half a first period: where that vanishes the slope by t_f has a kink
    run = chain_run(law, START, period=0.02, noise=0.01, disturbance=WIND)
    names = (*GAINS[name], "t_f")

    def judged(values):
        gains = dict(zip(names, values, strict=True))
        return rollout.simulate(replace(run, controller=replace(law, **gains))).metrics.window_error

    @jax.jit
    def sloped(at, along):
        return jax.jvp(judged, (at,), (along,))

    at = np.array([getattr(law, key) for key in names])
    for value, along in zip(at, np.eye(len(names)), strict=True):
        step = 1e-5 * value
        up, down = (sloped(at + sign * step * along, along)[0] for sign in (1, -1))
        # differences: the square of the step, and 1e-16 over it times the periods' number
        np.testing.assert_allclose(sloped(at, along)[1], (up - down) / (2 * step), rtol=1e-5, atol=1e-9)


# ---- time base generators


def test_the_profile_is_the_quintic_that_begins_as_measured_and_ends_at_rest():
    law, start = made("time_base_pd"), time_base.Start(jnp.ones(()), vector([1.4]), vector([-0.3]))
    profile = jax.jit(law.profile)
    for t in (0.0, 0.4, 2.5, 4.9, T_F, T_F + 1.0):
        for found, known in zip(
            profile(start, vector(t)), quintic(np.array(start.error), np.array(start.rate), t), strict=True
        ):
            np.testing.assert_allclose(found, known, rtol=1e-11, atol=1e-14)  # rounding in powers up to x^5
    first, last = profile(start, vector(0.0)), profile(start, vector(T_F))
    np.testing.assert_allclose(jnp.stack(first)[:, 0], [1.4, -0.3, 0.0], atol=1e-15)
    np.testing.assert_allclose(jnp.stack(last)[:, 0], 0.0, atol=1e-14)
    # from rest it asks for 10 / sqrt(3) e0 / t_f^2 at most: at (1 -+ 1 / sqrt(3)) / 2 of the time
    still = start._replace(rate=vector([0.0]))
    times = T_F * np.array([0.5 - 0.5 / np.sqrt(3.0), 0.5 + 0.5 / np.sqrt(3.0), *np.linspace(0.0, 1.0, 101)])
    asked = np.array([profile(still, vector(t)).acceleration[0] for t in times]) * T_F**2 / 1.4
    np.testing.assert_allclose(asked[:2], [-10.0 / np.sqrt(3.0), 10.0 / np.sqrt(3.0)], rtol=1e-12)
    assert np.abs(asked).max() <= 10.0 / np.sqrt(3.0) * (1 + 1e-12)


def test_a_profile_of_attitudes_turns_about_the_eigenaxis():
    axis = np.array([0.6, 0.0, -0.8])
    profile = jax.jit(made("time_base_pd", MultiplicativeKinematics, BODY).profile)
    for turn, rate in ((2.4, 0.0), (1.0, 0.3), (0.0, 0.0)):
        start = time_base.Start(jnp.ones(()), vector(turn * axis), vector(rate * axis))
        for t in (0.0, 1.7, 4.6, T_F, 5.5):
            angle, speed, change = quintic(np.array(turn), np.array(rate), t)
            v, v_dot, v_ddot = profile(start, vector(t))
            sin, cos = np.sin(angle / 2), np.cos(angle / 2)
            np.testing.assert_allclose(v, sin * axis, atol=1e-14)
            np.testing.assert_allclose(v_dot, speed / 2 * cos * axis, atol=1e-13)
            np.testing.assert_allclose(v_ddot, (change / 2 * cos - speed**2 / 4 * sin) * axis, atol=1e-12)


def test_rotation_vectors_are_twice_the_arc_sine():
    sizes = np.array([0.0, 1e-9, 3e-4, 9.99e-4, 1.001e-3, 0.02, 0.5, 0.97])  # on both sides of where the series ends
    axis = np.array([0.48, -0.6, 0.64])
    found = jax.jit(jax.vmap(attitude.rotation_vector))(vector(sizes[:, None] * axis))
    np.testing.assert_allclose(found, 2.0 * np.arcsin(sizes)[:, None] * axis, rtol=1e-14)  # some roundings


def test_a_chain_follows_its_profile():
    """Held over a period the profile's acceleration lags by half of it: h/2 times its slope is what PD has to bear."""
    apart = []
    for period in (0.01, 0.005):
        log = flown(chain_run(made("time_base_pd"), START, period))
        profile = np.array([quintic(np.array(START[0]), np.array(START[1]), t)[0] for t in log.t])
        lag = 0.5 * period * (60.0 * START[0] / T_F**3 + 36.0 * abs(START[1]) / T_F**2)
        apart.append(np.abs(log.x[:, 0] - profile).max())
        assert apart[-1] < 1.2 * lag / GAINS["time_base_pd"]["k_p"]  # a well damped spring, which hardly overshoots
    assert 0.45 < apart[1] / apart[0] < 0.55


@pytest.mark.parametrize("soft", [False, True])
def test_a_profile_begins_with_the_first_measured_error_and_stays(soft):
    law = made("time_base_pd", delta=0.495, **({"k_p": 1e-13, "k_d": 1e-13} if soft else {}))  # half a first period
    run = chain_run(law, START, noise=0.05)
    log = flown(run, 3, rollout.MISSED if soft else rollout.OK)
    ticks = ticks_of(run.clock, law.t_f, law.delta)
    first = int(np.argmax(np.asarray(ticks.t_next > ticks.t)))
    assert first > 500  # periods of no length come before, each with a measurement of its own
    assert 0.4 < float(ticks.noise_weight[first]) < 0.6
    key = run.sensors.key(np.uint32(0), np.uint32(3))
    now, then = (run.sensors.noise(key, ticks.sample[first] + k) for k in (0, 1))
    measured = START + np.asarray(then + ticks.noise_weight[first] * (now - then))
    assert np.abs(measured - START).min() > 1e-3
    assert abs(log.u[0, 0]) < 1e-13  # where it begins nothing is apart from it
    if soft:  # nothing but the profile's acceleration is left: which two numbers does it begin with?
        basis = np.array([[quintic(np.array(e), np.array(1.0 - e), t)[2] for e in (1.0, 0.0)] for t in log.t[:-1]])
        found, *_ = np.linalg.lstsq(basis, log.u[:-1, 0], rcond=None)
        np.testing.assert_allclose(found, measured, rtol=1e-10)
        np.testing.assert_allclose(log.u[:-1, 0], basis @ found, atol=1e-11)  # to the end: it stays


def test_a_body_at_rest_turns_about_its_eigenaxis_by_the_quintic():
    axis, turn = np.array([2.0, -1.0, 2.0]) / 3.0, 2.2
    q = Rotation.from_rotvec(turn * axis).as_quat()
    law = made("time_base_pd", MultiplicativeKinematics, BODY)
    apart = []
    for period in (0.02, 0.01):
        run = helpers.parts(T_F, 3.0, DELTA, inertia=FULL_INERTIA, q=q, period=0.01, t_end=T_F + 1.0,
                            disturbance=disturbances.Constant(jnp.zeros(3)))  # fmt: skip
        timing = replace(run.clock, period=vector(period))
        log = flown(replace(run, controller=law, clock=timing, observer=none.NoObserver(BODY, vector(0.0))))
        turned = Rotation.from_quat(log.x.q).as_rotvec()
        angle = np.array([float(quintic(np.array(turn), np.array(0.0), t)[0]) for t in log.t])
        along = turned @ axis
        apart.append((np.abs(along - angle).max(), np.linalg.norm(turned - along[:, None] * axis, axis=1).max()))
        # the torque lags by half a period, as a chain's does; the body's axes turn meanwhile
        assert max(apart[-1]) < 1.5 * 0.5 * period * 60.0 * turn / T_F**3 / GAINS["time_base_pd"]["k_p"]
    assert np.all(np.array(apart[1]) < 0.55 * np.array(apart[0]))  # which is all that the two differ by


# ---- scaling


def closed_loop(law, start, t_end, d=0.0, event=None, bound=0.0):
    """The law as the package computes it, in continuous time on a double integrator; events: of the law's s."""
    memory, bound = law.begin(), vector(bound)
    never: Any = np.array(False)  # NumPy's, which a compiled program is handed quickest
    period: Any = np.array(0.1)

    def asked(t, y):
        now: Any = np.array(t)
        return stepped(law, memory, Sample(now, never, period), *np.split(np.array(y), 2), bound)

    def surface(t, y):
        return float(asked(t, y)[1][0])

    surface.terminal, surface.direction = True, -1  # pyright: ignore[reportFunctionMemberAccess]
    return solve_ivp(lambda t, y: (y[1], float(asked(t, y)[0][0]) + d), (0.0, t_end), start, method="DOP853",
                     rtol=1e-10, atol=1e-14, dense_output=not event, events=surface if event else None)  # fmt: skip


@pytest.mark.parametrize("d", [0.0, -0.4])
def test_scaling_moves_by_its_closed_form(d):
    """xi = mu eps, z = xi' + k1 xi, z' = mu (d - k z): z - d/k falls by exp(-k t_f/(p-1) ((t_f/r)^(p-1) - 1))."""
    k1, k, p = 0.7, 0.02, 3.3
    for start in (START, (1.0, -p / T_F - k1)):  # the second one with z = 0
        z_0 = start[1] + (p / T_F + k1) * start[0]
        run = closed_loop(made("scaling"), start, T_F - DELTA, d)

        def z(t, z_0=z_0):
            passed = T_F / (p - 1.0) * ((T_F / (T_F - t)) ** (p - 1.0) - 1.0)
            return d / k + (z_0 - d / k) * np.exp(-k * passed)

        for t in (1.0, 3.0, T_F - DELTA):
            mu = (T_F / (T_F - t)) ** p
            xi = start[0] * np.exp(-k1 * t) + quad(lambda s, t=t: np.exp(-k1 * (t - s)) * z(s), 0.0, t, epsabs=1e-12)[0]
            e, w = run.sol(t)
            np.testing.assert_allclose(e * mu, xi, rtol=1e-7, atol=1e-8)  # the integration's 1e-10, times mu
            np.testing.assert_allclose(mu * (w + (p / (T_F - t) + k1) * e), z(t), rtol=1e-6, atol=1e-6)
            if z_0 == 0.0:
                assert abs(z(t)) <= abs(d) / k


def test_scaling_holds_its_gains_from_the_hand_over_on():
    law, hold = made("scaling"), jnp.asarray(True)
    e, w, zero = vector([0.3]), vector([-0.2]), vector(0.0)
    asked = [stepped(law, None, Sample(vector(t), hold, vector(0.1)), e, w, zero)[:2] for t in (4.5, 4.7, T_F, 6.0)]
    before = stepped(law, None, Sample(vector(T_F - DELTA), NEVER, vector(0.1)), e, w, zero)[:2]
    for found in asked:
        np.testing.assert_allclose(jnp.stack(found), jnp.stack(before), rtol=1e-12)


# ---- predefined time

MEASURED = {1e-3: 0.051, 1.0: 0.308, 1e3: 0.553}  # share of T_1 + T_2 that it needs from rest, as the method says


@pytest.mark.parametrize("x", [1e-3, 0.5, 1e3])
def test_what_pulls_is_at_zero_when_its_closed_form_says(x):
    """T 2/pi atan(|x|^q), below T wherever it starts; integrated over y = x^q, without the singularity at zero."""
    q, settling = 0.3, 4.0
    phi = jax.jit(lambda x: baselines.phi(x, vector(q), vector(settling)))

    def passing(y):
        return y ** (1.0 / q - 1.0) / q / float(phi(vector([y ** (1.0 / q)]))[0])

    arrival = quad(passing, 0.0, x**q, epsrel=1e-10)[0]
    np.testing.assert_allclose(arrival, settling * 2.0 / np.pi * np.arctan(x**q), rtol=1e-9)


STARTS = [(start, d) for start in (1e-3, 1e-2, 0.1, 1.0, 10.0, 100.0, 1e3) for d in (0.0, 0.3)]


@pytest.mark.parametrize(
    ("start", "d"), helpers.short(STARTS, [(1e-3, 0.0), (1.0, 0.0), (1e3, 0.0), (1e-3, 0.3), (10.0, 0.3)])
)
def test_predefined_time_settles_in_time_and_long_before(start, d):
    """To s = 0 by integration, against d = K too; on it by the closed form.

    From rest and without d the speed w grows by 2 Phi Phi' at least, so w^2 >= 2 (Phi(start)^2 - Phi^2): it is on
    s = 0, where w^2 = Phi^2, before Phi has fallen to sqrt(2/3) of where it began. And w grows ever more slowly, so
    that its mean is more than half of its last value.
    """
    first, second, q = 0.6 * T_F, 0.4 * T_F, 0.3
    run = closed_loop(made("predefined_time", sign_width=0.0), (start, 0.0), T_F, d, event=True, bound=d)
    assert run.status == 1
    reached, e, w = run.t[-1], *run.y[:, -1]
    np.testing.assert_allclose(w, -phi(e, q, first), rtol=1e-8)  # on s = 0
    assert reached < second
    sliding = first * 2.0 / np.pi * np.arctan(e**q)
    assert reached + sliding < T_F
    if d == 0.0:  # how much of the time that it is given it needs: 5 % from 1e-3, 56 % from 1e3
        least = brentq(lambda x: phi(x, q, first) - np.sqrt(2.0 / 3.0) * phi(start, q, first), 0.0, start)
        assert least <= e <= start
        assert reached <= 2.0 * (start - least) / phi(least, q, first)
        share = 0.6 * 2.0 / np.pi * np.arctan(np.array([least, start]) ** q)
        assert share[0] <= (reached + sliding) / T_F <= share[1] + 2.0 * (start - least) / phi(least, q, first) / T_F
        assert abs((reached + sliding) / T_F - MEASURED.get(start, (reached + sliding) / T_F)) < 1e-3


def test_predefined_time_switches_at_zero_error_as_beside_it():
    """At q1 = 1/2 the switching gain is (pi / (2 q1 T_1))^2 (1 - q1) at zero, at others 0."""
    still, rate = vector([0.0]), vector([0.2])
    for q1, turning in ((0.5, 0.5 * (np.pi / (0.6 * T_F)) ** 2), (0.4, 0.0)):
        law = made("predefined_time", q1=q1, sign_width=0.0)
        a, s, _ = stepped(law, None, NOW, still, rate, vector(0.3))
        np.testing.assert_allclose(a, -phi(np.array(s), 0.4, 0.4 * T_F) - 0.3 - 2.0 * turning, rtol=1e-12)


def test_a_chain_in_predefined_time_is_a_hold_apart_from_the_continuous_loop():
    law, gains = made("predefined_time"), GAINS["predefined_time"]
    exact = solve_ivp(
        lambda t, y: (y[1], wanted("predefined_time", gains, (t, False, 0.0), y[0], y[1], 0.0)[0]),
        (0.0, 1.5), START, rtol=1e-10, atol=1e-12, dense_output=True,
    )  # fmt: skip
    apart = []
    for period in (0.01, 0.005):
        log = flown(chain_run(law, START, period))
        early = log.t < 1.5
        e, w = exact.sol(log.t[early])
        apart.append(np.abs(log.x[early, 0] - e).max())
        assert apart[-1] < period * np.abs(w).max()
    assert 0.4 < apart[1] / apart[0] < 0.6


# ---- super-twisting


def test_super_twisting_finds_the_disturbance_after_a_finite_time():
    """A disturbance of slope 0.26 < L = 0.3: s and v + d wind about zero, ever faster."""
    c, lipschitz = GAINS["super_twisting"]["surface_rate"], 0.3
    law = made("super_twisting", sign_width=0.0)
    a, w, p, b = WIND

    def crossing(t, y):
        return y[0]

    crossing.terminal = True  # pyright: ignore[reportFunctionMemberAccess]
    t, y, crossings = 0.0, (START[1] + c * START[0], 0.0), []
    for side in (1.0, -1.0, 1.0, -1.0):  # s and v in continuous time, the sign given: nothing to chatter
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
    assert np.all(np.diff(times)[1:] < 0.6 * np.diff(times)[:-1])  # so their sum is finite
    arrived = times[-1] + 1.5 * (times[-1] - times[-2])  # 0.6 / (1 - 0.6) of the last one for all to come
    for period in (0.01, 0.005):
        log = flown(chain_run(law, START, period, disturbance=WIND))
        s = log.x[:, 1] + c * log.x[:, 0]
        v = log.u[:, 0] + c * log.x[:, 1] + 1.5 * np.sqrt(lipschitz) * sig(s, 0.5)
        d = a * np.sin(w * log.t + p) + b
        seen = log.t[1:][np.diff(np.sign(s)) != 0.0]
        np.testing.assert_allclose(seen[:2], times[:2], atol=3.0 * period)  # seen a period late, held over each
        # a period moves v by 1.1 L h and d by 0.87 L h, and s by what v + d is then: a few of these till s turns
        late = np.append(log.t[:-1] > arrived + 10.0 * period, False)
        assert np.abs(v + d)[late].max() < 5.0 * lipschitz * period
        assert np.abs(s[late]).max() < 5.0 * lipschitz * period**2
