"""The second-order system (6) and the integrator chain (35): laws (10), (24), (40), (52), surfaces (37), (39)."""

import math
from dataclasses import replace

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from hypothesis import strategies as st
from scipy.integrate import solve_ivp

from ptsmc_jax import formulas
from ptsmc_jax.batching import lanes
from ptsmc_jax.laws.prescribed_time import expansion
from ptsmc_jax.observers import nonlinear
from ptsmc_jax.plants import integrator_chain
from ptsmc_jax.signals import disturbances
from ptsmc_jax.simulation import rollout
from ptsmc_jax.theory import envelopes, hold, solutions
from tests.helpers import chain_parts, commanded, drawn, fly, short, vector, with_controller

torque = jax.jit(commanded)
HOLD, BEFORE = jnp.asarray(True), jnp.asarray(False)


@pytest.mark.parametrize(("eta", "t"), [(2.5, 0.0), (3.0, 3.1), (6.0, 4.9)])
def test_order_two_is_the_law_of_the_second_order_system(eta, t):
    """(7), (9), (10), (24) by hand, with f and g."""
    x = np.array([1.3, -0.4])

    def f(x):
        return jnp.sin(x[0]) - 0.3 * x[1]

    def g(x):
        return 2.0 + x[1] ** 2

    run = chain_parts([5.0, 3.0], eta=eta, k1=1.7, surface_rate=1.3, bound=0.2, sign_width=0.1, f=f, g=g)
    drift, gain, tau = np.sin(1.3) + 0.12, 2.16, 5.0 - t
    d_hat = jnp.zeros(1)

    s = tau * x[1] + eta * x[0]
    expected = (-(eta - 1) / tau * x[1] - drift - 0.2 * np.tanh(s / 0.1) - eta * s / tau**2) / gain
    u, found = torque(run.controller, vector(t), BEFORE, vector(x), None, d_hat, vector(0.2))
    np.testing.assert_allclose((u[0], found[0]), (expected, s), rtol=1e-13)

    s = 1.3 * x[0] + x[1]
    expected = (-drift - 0.2 * np.tanh(s / 0.1) - 1.7 * s - 1.3 * x[1]) / gain
    u, found = torque(run.controller, vector(t), HOLD, vector(x), None, d_hat, vector(0.2))
    np.testing.assert_allclose((u[0], found[0]), (expected, s), rtol=1e-13)


@pytest.mark.parametrize("n", short([2, 3, 4, 5, 6], [2, 5]))
def test_surface_is_the_derivative_that_defines_it(n):
    """(37) with the c_i against (36) by nested automatic differentiation."""
    t_f, eta, t = 4.0, n + 0.7, 1.3

    def x(time):
        return jnp.exp(-0.4 * time) * (2.0 + jnp.sin(time))

    def scaled(time):
        return x(time) / (t_f - time) ** eta

    states, derivative = [x], scaled
    for _ in range(n - 1):
        states.append(jax.grad(states[-1]))
        derivative = jax.grad(derivative)
    law = chain_parts([1.0] * n, t_f, eta).controller
    at = jnp.stack([state(t) for state in states])
    _, s = torque(law, vector(t), BEFORE, at, None, jnp.zeros(1), vector(0.0))
    np.testing.assert_allclose(s[0], derivative(t) * (t_f - t) ** (eta + n - 1), rtol=1e-11)
    assert [float(c) for c in expansion(vector(3.0), 2)] == [3.0, 1.0]  # (7)
    assert [float(c) for c in expansion(vector(4.0), 3)] == [20.0, 8.0, 1.0]


@pytest.mark.parametrize("n", [2, 3, 4, 5])
@pytest.mark.parametrize("hold", [False, True])
def test_sliding_variable_obeys_the_equation_that_the_law_is_made_from(n, hold):
    """s' along the true motion, by automatic differentiation, against (42) and (51) by hand."""
    eta, tau = n + 0.6, 2.2
    a = [0.7, 2.1, 3.0, 2.5][: n - 1]
    run = chain_parts([1.0] * n, 5.0, eta, k1=1.4, surface_rate=1.3, a=a, sign_width=0.5)
    law, t, phase = run.controller, vector(5.0 - tau), jnp.asarray(hold)
    x = vector(np.random.default_rng(n).normal(size=n))
    d, d_hat, k2 = vector([0.3]), vector([0.1]), vector(0.4)
    u, s = torque(law, t, phase, x, None, d_hat, k2)

    def surface(time, state):
        return torque(law, time, phase, state, None, d_hat, k2)[1]

    _, s_dot = jax.jvp(surface, (t, x), (jnp.ones_like(t), run.plant.rate(t, x, u, d)))
    push = 0.2 - 0.4 * np.tanh(np.asarray(s) / 0.5)
    expected = push - 1.4 * np.asarray(s) if hold else tau ** (n - 1) * push - (eta + n - 2) / tau * np.asarray(s)
    np.testing.assert_allclose(s_dot, expected, rtol=1e-11)


@pytest.mark.parametrize("n", [2, 3, 4, 5])
def test_motion_on_the_surface_is_stable_as_its_matrix_is(n):
    rng = np.random.default_rng(n)
    for _ in range(50):
        a = rng.normal(size=n - 1) + 1.0
        matrix = np.diag(np.ones(n - 2), 1)
        matrix[-1] = -a
        assert formulas.hurwitz(a) == bool(np.all(np.linalg.eigvals(matrix).real < 0.0))
    assert not formulas.hurwitz([0.0] * (n - 1))
    assert formulas.hurwitz([math.comb(n - 1, i) for i in range(n - 1)])  # the default


EXACT = [(2, 5.0), (3, 30.0), (5, 0.7), (3, 5.0), (4, 5.0), (5, 5.0)]


@pytest.mark.parametrize(("n", "t_f"), short(EXACT, EXACT[2:3]))
def test_chain_meets_the_exact_solution(n, t_f):
    """Exact solution 2 to 1e-9 of the largest state: what the default grid promises."""
    rng = np.random.default_rng(n)
    for eta in (n + 0.1, n + 1.0, n + 3.5):
        x0 = rng.normal(size=n)
        run = chain_parts(x0, t_f, eta, 0.01 * t_f)
        log = fly(run).log
        before = log.t < 0.99 * t_f * (1 - 1e-12)
        exact = motion(run, log.t[before])
        largest = np.abs(exact.x).max()
        np.testing.assert_allclose(log.x[before], exact.x, rtol=0, atol=1e-9 * largest)
        np.testing.assert_allclose(log.s[before, 0], exact.s, rtol=0, atol=1e-9 * np.abs(exact.s).max())


@jax.jit
def motion(run, t):
    law = run.controller
    return jax.vmap(lambda time: solutions.exact_chain(time, law.t_f, law.eta, run.initial))(t)


@pytest.mark.parametrize("n", short([2, 3, 4], [3]))
def test_slopes_are_those_of_theory(n):
    """Noise-free: s falls with slope eta + n - 2 in the time to go, the error with eta, its logarithm taken out."""
    eta, t_f, delta = n + 1.2, 5.0, 5e-4
    run = chain_parts([2.0, -1.0, 0.5, 0.3][:n], t_f, eta, delta)
    log = fly(run).log
    before = (log.t > 0.0) & (log.t < t_f - delta * 1.0001)
    tau = t_f - log.t[before]

    def slope(values, some):
        return np.polyfit(np.log(tau[some]), np.log(np.abs(values[some])), 1)[0]

    everywhere, late = np.full(tau.size, True), tau < 0.02 * t_f
    # s is r^(n-2) of what it is summed from: below r = 0.02 that is what integration leaves
    np.testing.assert_allclose(slope(log.s[before, 0], ~late), eta + n - 2, rtol=1e-2)
    x = log.x[before, 0]
    if n == 2:  # x_1 = r^eta (x(0) + s(0) L): the factor in brackets is known
        s0 = t_f * -1.0 + eta * 2.0
        np.testing.assert_allclose(slope(x / (2.0 + s0 * np.log(t_f / tau)), everywhere), eta, rtol=1e-2)
    else:  # y = x_1 / r^eta goes to a constant
        np.testing.assert_allclose(slope(x, late), eta, rtol=1e-2)


SCENARIO = st.fixed_dictionaries(
    {
        "x0": st.lists(st.floats(-5.0, 5.0), min_size=4, max_size=4),
        "above": st.floats(0.1, 4.0),
        "t_f": st.floats(1.0, 20.0),
        "delta": st.floats(0.005, 0.2),
        "bound": st.floats(0.0, 1.0),
        "layer": st.floats(0.01, 1.0),
        "share": st.floats(-1.0, 1.0),
        "frequency": st.floats(0.0, 3.0),
        "phase": st.floats(-3.0, 3.0),
        "k1": st.floats(0.2, 4.0),
        "surface_rate": st.floats(0.1, 3.0),
        "damping": st.floats(0.2, 1.0),
    }
)


# a_1 .. a_(n-1) for a pair of poles of this damping at 1 1/s, and a third one at -1
SURFACES = {2: lambda z: [1.0], 3: lambda z: [1.0, 2 * z], 4: lambda z: [1.0, 1 + 2 * z, 1 + 2 * z]}


def stays_inside_the_corrected_envelopes(n, case):
    """|s| and every state, for disturbances up to K and a smooth sign as sharp as 800 steps can follow."""
    t_f, bound = case["t_f"], case["bound"]
    # the boundary layer's rate, tau^(n-1) K / width, times the largest step stays below 1.2
    width = max(bound * t_f ** (n - 1) * 1.5 * t_f / 800 / 1.2 / case["layer"], 1e-9)
    sine = (case["share"] * bound, case["frequency"] / t_f, case["phase"], 0.0)
    wave = disturbances.Sinusoid(*(vector([v]) for v in sine))
    run = chain_parts(
        case["x0"][:n], t_f, n + case["above"], case["delta"] * t_f, bound=bound, sign_width=width, disturbance=wave,
        k1=case["k1"], surface_rate=case["surface_rate"], a=SURFACES[n](case["damping"]), steps=(800, 1200),
    )  # fmt: skip
    result = fly(run)
    assert int(result.status) in rollout.FINISHED  # pushed off the origin it started from: missed
    log = result.log
    before = np.flatnonzero(log.t < float(run.controller.hand_over))
    t = log.t[: before[-1] + 1]
    rounding = 1e-9 * max(1.0, np.abs(log.s).max())
    assert np.all(np.abs(log.s[: t.size, 0]) <= envelopes.sliding_bound(run, t) * (1 + 1e-6) + rounding)
    found = envelope(run, vector(t), *(vector(v) for v in envelopes.sliding_envelope(run)))
    centre, half = (np.asarray(v) for v in found)
    largest = 1e-7 * np.abs(log.x).max(axis=0) + 1e-12
    assert np.all(np.abs(log.x[: t.size] - centre) <= half * (1 + 1e-6) + largest)
    t = log.t[t.size :]
    assert np.all(np.abs(log.s[-t.size :, 0]) <= hold.sliding_bound(run, t) * (1 + 1e-6) + rounding)
    assert np.all(np.abs(log.x[-t.size :, 0]) <= hold.error_bound(run, t) * (1 + 1e-6) + largest[0])


test_chain_stays_inside = drawn(stays_inside_the_corrected_envelopes, 15, n=st.just(3), case=SCENARIO)
test_many_stay_inside = pytest.mark.long(
    drawn(stays_inside_the_corrected_envelopes, 400, n=st.integers(2, 4), case=SCENARIO)
)


@jax.jit
def envelope(run, t, s0, floor):
    law = run.controller
    return jax.vmap(lambda time: solutions.state_envelope(time, law.t_f, law.eta, run.initial, s0, floor))(t)


def test_envelopes_are_not_empty():
    """Without a residual |s| is its envelope, and x_1 comes near its own."""
    run = chain_parts([1.0, 0.5, 0.0], 5.0, 4.0, bound=0.0)
    log = fly(run).log
    before = log.t < 4.9
    t = log.t[before]
    np.testing.assert_allclose(np.abs(log.s[before, 0]), envelopes.sliding_bound(run, t), rtol=1e-5)
    flown = envelopes.error_bound(run, t)
    assert np.all(np.abs(log.x[before, 0]) <= flown * (1 + 1e-6))
    assert np.max(np.abs(log.x[before, 0]) / flown) > 0.99


def test_the_bound_on_s_is_a_number_where_its_square_is_none():
    """Without a residual it is |s(0)| (tau / t_f)^(eta + n - 2), and s(0) is linear in the start."""
    t = np.linspace(0.0, 5.0, 6)
    one, far = (envelopes.sliding_bound(chain_parts([x, 0.0, 0.0], eta=4.0), t) for x in (1.0, 1e153))
    assert far[0] > np.sqrt(np.finfo(float).max)
    np.testing.assert_allclose(far, 1e153 * one, rtol=1e-12)


def test_exact_chain_of_order_two_is_the_exact_error():
    for t in (0.0, 1.0, 6.9):
        both = solutions.exact_error(vector(t), vector(7.0), vector(2.7), vector([0.7]), vector([-0.3]))
        chain = solutions.exact_chain(vector(t), vector(7.0), vector(2.7), vector([0.7, -0.3]))
        np.testing.assert_allclose(chain.x, [both.error[0], both.error_rate[0]], rtol=1e-12)
        np.testing.assert_allclose((chain.s, chain.acceleration), (both.s[0], both.acceleration[0]), rtol=1e-11)


@pytest.mark.parametrize("n", [2, 3, 4, 5])
def test_exact_chain_is_a_motion_of_the_chain(n):
    """Its derivative is the next state, and the input that the law gives there."""
    run = chain_parts(np.random.default_rng(n).normal(size=n), 7.0, n + 0.8)
    law = run.controller
    for t in (0.0, 2.0, 6.5):
        at, slope = jax.jvp(
            lambda time: solutions.exact_chain(time, law.t_f, law.eta, run.initial), (vector(t),), (vector(1.0),)
        )
        size = np.abs(np.append(at.x, at.acceleration)).max()
        np.testing.assert_allclose(slope.x, np.append(at.x[1:], at.acceleration), rtol=0, atol=1e-11 * size)
        u, s = torque(law, vector(t), BEFORE, at.x, None, jnp.zeros(1), vector(0.0))
        np.testing.assert_allclose((u[0], s[0]), (at.acceleration, at.s), rtol=1e-8, atol=1e-11 * size)


def test_exact_chain_of_order_three_against_an_adaptive_integrator():
    eta, t_f = 3.4, 6.0
    c = (eta * (eta + 1), 2 * eta)

    def rate(t, x):
        tau = t_f - t
        s = c[0] * x[0] + c[1] * tau * x[1] + tau**2 * x[2]
        u = -((c[0] - c[1]) * x[1] + (c[1] - 2.0) * tau * x[2]) / tau**2 - (eta + 1) * s / tau**3
        return [x[1], x[2], u]

    times = np.array([0.5, 3.0, 5.9])
    truth = solve_ivp(rate, (0.0, 5.9), [1.0, -0.5, 2.0], t_eval=times, rtol=1e-12, atol=1e-13).y
    for k, t in enumerate(times):
        found = solutions.exact_chain(vector(t), vector(t_f), vector(eta), vector([1.0, -0.5, 2.0]))
        np.testing.assert_allclose(found.x, truth[:, k], rtol=0, atol=1e-9)


@pytest.mark.parametrize("x0", short([[5.0, 3.0], [5.0, 3.0, 2.0]], [[5.0, 3.0, 2.0]]))
def test_sampled_chain_converges_to_the_continuous_one(x0):
    wave = disturbances.Sinusoid(*(vector([v]) for v in (0.01, 1.0, 0.0, 0.0)))
    changes = {"bound": 0.01, "disturbance": wave, "delta": 0.5, "sign_width": 0.05}
    truth = fly(chain_parts(x0, **changes, steps=(4000, 200))).metrics.window_error
    sampled = [chain_parts(x0, **changes, period=h) for h in (0.01, 0.005, 0.0025)]
    clocks = [run.clock for run in sampled]
    sampled = [replace(run, clock=run.clock.long_enough_for(clocks)) for run in sampled]
    gaps = [abs(float(fly(run).metrics.window_error / truth) - 1.0) for run in sampled]
    ratios = np.array(gaps[:-1]) / np.array(gaps[1:])
    assert np.all((ratios > 1.7) & (ratios < 2.3))  # zero-order hold: first order


def test_observer_on_a_chain_finds_the_disturbance_within_its_bound():
    wave = disturbances.Sinusoid(*(vector([v]) for v in (0.05, 1.0, 0.0, 0.02)))
    model = integrator_chain.chain(3)
    observer = nonlinear.NonlinearObserver(model, vector([20.0]), vector(0.05), vector(0.02))
    for period in (None, 0.02):
        seen = chain_parts([1.0, 0.0, 0.0], disturbance=wave, observer=observer, period=period, delta=0.3)
        log = fly(seen).log
        off = np.abs(log.d_hat - log.disturbance)[:, 0]
        bound = np.asarray(jax.vmap(observer.error_bound())(log.t))
        # sampled: the estimate is that of the period before
        assert np.all(off <= bound * (1 + 1e-6) + (0.0 if period is None else 0.05 * period))


def test_plant_with_drift_and_gain_is_linearised_exactly():
    """A perfect model cancels f and g: the motion is that of the bare chain."""

    def f(x):
        return -jnp.sin(x[0]) + x[1] * x[2]

    def g(x):
        return 1.5 + 0.5 * jnp.cos(x[0])

    bare = fly(chain_parts([0.5, -0.2, 0.1])).log
    bent = fly(chain_parts([0.5, -0.2, 0.1], f=f, g=g)).log
    np.testing.assert_allclose(bent.x, bare.x, rtol=0, atol=1e-10)
    assert np.abs(bent.u - bare.u).max() > 0.1


@pytest.mark.parametrize("hold", [False, True])
def test_input_and_surface_have_slopes_in_every_gain(hold):
    run = chain_parts([0.1, -0.02, 0.03])
    gains = ("t_f", "eta", "k1", "surface_rate", "sign_width")
    point = vector([5.0, 4.5, 1.2, 1.7, 0.5])

    @jax.jit
    def given(point):
        law = with_controller(run, **dict(zip(gains, point, strict=True))).controller
        return jnp.stack(commanded(law, vector(3.1), jnp.asarray(hold), run.initial, None, jnp.zeros(1), vector(0.4)))

    steps = 1e-6 * np.eye(5)
    differences = np.stack([(given(point + h) - given(point - h)) / 2e-6 for h in steps], axis=-1)
    np.testing.assert_allclose(jax.jacfwd(given)(point), differences, rtol=1e-6, atol=1e-6)
    assert np.count_nonzero(np.abs(differences[0]) > 1e-4) == 3  # each phase has gains of its own, and the sign's width


# lanes: `test_conformity.py`; slopes of the law: the test above; of sampled flights: `test_implicit.py`
@pytest.mark.long
def test_batches_of_chains_and_their_gradients():
    run = chain_parts([5.0, 3.0, 2.0], delta=0.5, period=0.05, noise=[1e-4, 1e-4, 1e-4], bound=0.01)

    def error(gains, trial):
        law = dict(zip(("eta", "delta", "k1", "surface_rate"), gains, strict=True))
        return rollout.simulate(with_controller(run, **law), 3, trial).metrics.window_error

    trials = jnp.arange(6, dtype=jnp.uint32)
    point = vector([4.5, 0.53, 1.2, 1.7])
    one = jax.jit(jax.vmap(lambda trial: error(point, trial)))(trials)
    np.testing.assert_allclose(jax.jit(lanes.vmap(lambda trial: error(point, trial)))(trials), one, rtol=1e-12)
    assert np.std(one) > 0.0

    @jax.jit
    def sloped(gains, along):
        return jax.jvp(lambda gains: error(gains, trials[0]), (gains,), (along,))

    for along in np.eye(4):
        h = 1e-6
        up, down = (sloped(point + s * h * along, along)[0] for s in (1, -1))
        np.testing.assert_allclose(sloped(point, along)[1], (up - down) / (2 * h), rtol=1e-4)


def test_chain_is_built_with_an_order_and_functions():
    with pytest.raises(ValueError, match="order is 1, but must be a whole number of at least 2"):
        integrator_chain.chain(1)
    with pytest.raises(ValueError, match=r"^g\(x\) fails for x of shape \(3,\): index 3 is out of bounds"):
        integrator_chain.chain(3, g=lambda x: 1.0 + x[3] ** 2)
    stiff = jax.tree_util.Partial(lambda k, x: -k * x[0], vector(2.0))
    found = integrator_chain.chain(3, stiff)
    assert found.f is stiff
    assert len(jax.tree.leaves(found)) == 1  # its parameter is a leaf: it can be traced
    x = vector([0.5, 0.0, 1.0])
    np.testing.assert_array_equal(found.rate(vector(0.0), x, vector([3.0]), vector([0.5])), [0.0, 1.0, 2.5])


def test_what_a_chain_lacks_has_no_value():
    result = fly(chain_parts([1.0, 0.0]))
    assert np.isnan(float(result.metrics.peak_momentum))
    assert float(result.metrics.peak_rate) == pytest.approx(np.abs(result.log.x[:, 1]).max())
    assert float(result.metrics.terminal_angle) == float(result.metrics.terminal_error)


def test_the_rate_of_a_chain_is_that_of_its_first_state_whatever_its_order():
    assert float(integrator_chain.chain(3).speed(vector([0.5, -2.0, 7.0]))) == 2.0
