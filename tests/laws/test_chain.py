"""The law for the integrator chain (35) and the second-order system (6): law (52), surfaces (37) and (39)."""

import math
from dataclasses import replace

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from hypothesis import strategies as st

from ptsmc_jax import formulas
from ptsmc_jax.laws.prescribed_time import surface_coefficients
from ptsmc_jax.plants import integrator_chain
from ptsmc_jax.signals import disturbances
from ptsmc_jax.simulation import rollout
from ptsmc_jax.theory import envelopes, solutions
from tests.helpers import chain_parts, commanded, drawn, fly, short, vector, with_controller
from tests.theory import hold_phase

torque = jax.jit(commanded)
HOLD, BEFORE = jnp.asarray(True), jnp.asarray(False)


@pytest.mark.parametrize(("eta", "t"), [(2.5, 0.0), (3.0, 3.1), (6.0, 4.9)])
def test_chain_of_order_2_has_the_law_of_the_second_order_system(eta, t):
    """The expected values are (7), (9), (10) and (24), written out for given f and g."""
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
def test_surface_37_equals_its_definition_36(n):
    """The numbers are equations of the paper. (36) is computed by nested automatic differentiation."""
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
    assert [float(c) for c in surface_coefficients(vector(3.0), 2)] == [3.0, 1.0]  # (7)
    assert [float(c) for c in surface_coefficients(vector(4.0), 3)] == [20.0, 8.0, 1.0]


@pytest.mark.parametrize("n", [2, 3, 4, 5])
@pytest.mark.parametrize("hold", [False, True])
def test_sliding_variable_obeys_its_reaching_law(n, hold):
    """s' along the motion of the plant, by automatic differentiation, equals (42) or (51)."""
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
    disturbance = 0.2 - 0.4 * np.tanh(np.asarray(s) / 0.5)
    expected = (
        disturbance - 1.4 * np.asarray(s)
        if hold
        else tau ** (n - 1) * disturbance - (eta + n - 2) / tau * np.asarray(s)
    )
    np.testing.assert_allclose(s_dot, expected, rtol=1e-11)


@pytest.mark.parametrize("n", [2, 3, 4, 5])
def test_hurwitz_check_agrees_with_eigenvalues(n):
    """The polynomial of a chain of order n has the degree n - 1."""
    rng = np.random.default_rng(n)
    for _ in range(50):
        a = rng.normal(size=n - 1) + 1.0
        matrix = np.diag(np.ones(n - 2), 1)
        matrix[-1] = -a
        assert formulas.is_hurwitz(a) == bool(np.all(np.linalg.eigvals(matrix).real < 0.0))
    assert not formulas.is_hurwitz([0.0] * (n - 1))
    assert formulas.is_hurwitz([math.comb(n - 1, i) for i in range(n - 1)])  # the default


EXACT = [(2, 5.0), (3, 30.0), (5, 0.7), (3, 5.0), (4, 5.0), (5, 5.0)]


@pytest.mark.parametrize(("n", "t_f"), short(EXACT, EXACT[2:3]))
def test_simulated_continuous_chain_equals_its_exact_solution(n, t_f):
    """The tolerance, 1e-9 of the largest state, is the accuracy of the default time grid."""
    rng = np.random.default_rng(n)
    for eta in (n + 0.1, n + 1.0, n + 3.5):
        x0 = rng.normal(size=n)
        run = chain_parts(x0, t_f, eta, 0.01 * t_f)
        log = fly(run).log
        before = log.t < 0.99 * t_f * (1 - 1e-12)
        exact = exact_chain_motion(run, log.t[before])
        largest = np.abs(exact.x).max()
        np.testing.assert_allclose(log.x[before], exact.x, rtol=0, atol=1e-9 * largest)
        np.testing.assert_allclose(log.s[before, 0], exact.s, rtol=0, atol=1e-9 * np.abs(exact.s).max())


@jax.jit
def exact_chain_motion(run, t):
    """Return the exact `ChainMotion` of a chain without disturbance at times t (times,) before t_f."""
    law = run.controller
    return jax.vmap(lambda time: solutions.exact_chain(time, law.t_f, law.eta, run.initial))(t)


@pytest.mark.parametrize("n", short([2, 3, 4], [3]))
def test_s_and_error_decay_with_the_powers_of_theory(n):
    """Without noise, s decays with the power eta + n - 2 of the time to t_f, and the error with eta and a logarithm."""
    eta, t_f, delta = n + 1.2, 5.0, 5e-4
    run = chain_parts([2.0, -1.0, 0.5, 0.3][:n], t_f, eta, delta)
    log = fly(run).log
    before = (log.t > 0.0) & (log.t < t_f - delta * 1.0001)
    tau = t_f - log.t[before]

    def exponent(values, some):
        return np.polyfit(np.log(tau[some]), np.log(np.abs(values[some])), 1)[0]

    everywhere, late = np.full(tau.size, True), tau < 0.02 * t_f
    # s is smaller than its terms by r^(n-2): below r = 0.02 the integration error dominates
    np.testing.assert_allclose(exponent(log.s[before, 0], ~late), eta + n - 2, rtol=1e-2)
    x = log.x[before, 0]
    if n == 2:  # x_1 = r^eta (x(0) + s(0) L), and the factor in brackets is known
        s0 = t_f * -1.0 + eta * 2.0
        np.testing.assert_allclose(exponent(x / (2.0 + s0 * np.log(t_f / tau)), everywhere), eta, rtol=1e-2)
    else:  # x_1 / r^eta approaches a constant
        np.testing.assert_allclose(exponent(x, late), eta, rtol=1e-2)


SCENARIO = st.fixed_dictionaries(
    {
        "x0": st.lists(st.floats(-5.0, 5.0), min_size=4, max_size=4),
        "above": st.floats(0.1, 4.0),
        "t_f": st.floats(1.0, 20.0),
        "delta": st.floats(0.005, 0.2),
        "bound": st.floats(0.0, 1.0),
        "layer": st.floats(0.01, 1.0),
        "fraction": st.floats(-1.0, 1.0),
        "frequency": st.floats(0.0, 3.0),
        "phase": st.floats(-3.0, 3.0),
        "k1": st.floats(0.2, 4.0),
        "surface_rate": st.floats(0.1, 3.0),
        "damping": st.floats(0.2, 1.0),
    }
)


# a_1 .. a_(n-1) for a pair of poles with the damping z and the frequency 1 rad/s, and for n = 4 a third pole at -1
SURFACES = {2: lambda z: [1.0], 3: lambda z: [1.0, 2 * z], 4: lambda z: [1.0, 1 + 2 * z, 1 + 2 * z]}


def check_envelopes(n, case):
    """Check that |s| and all states are inside the corrected envelopes, for disturbances up to K.

    n: order of the chain. case: random values of gains, states and disturbance by name. The boundary layer is as thin
    as 800 steps can resolve.
    """
    t_f, bound = case["t_f"], case["bound"]
    # the rate tau^(n-1) K / width of the boundary layer times the largest step is below 1.2
    width = max(bound * t_f ** (n - 1) * 1.5 * t_f / 800 / 1.2 / case["layer"], 1e-9)
    sine = (case["fraction"] * bound, case["frequency"] / t_f, case["phase"], 0.0)
    wave = disturbances.Sinusoid(*(vector([v]) for v in sine))
    run = chain_parts(
        case["x0"][:n], t_f, n + case["above"], case["delta"] * t_f, bound=bound, sign_width=width, disturbance=wave,
        k1=case["k1"], surface_rate=case["surface_rate"], a=SURFACES[n](case["damping"]), steps=(800, 1200),
    )  # fmt: skip
    result = fly(run)
    assert int(result.status) in rollout.FINISHED  # the disturbance may move it away from the origin
    log = result.log
    before = np.flatnonzero(log.t < float(run.controller.hand_over))
    t = log.t[: before[-1] + 1]
    rounding = 1e-9 * max(1.0, np.abs(log.s).max())
    assert np.all(np.abs(log.s[: t.size, 0]) <= envelopes.sliding_bound(run, t) * (1 + 1e-6) + rounding)
    found = envelope(run, vector(t), *(vector(v) for v in envelopes.sliding_envelope(run)))
    centre, half = (np.asarray(v) for v in found)
    largest = 1e-7 * np.abs(log.x).max(axis=0) + 1e-12
    assert np.all(np.abs(log.x[: t.size] - centre) <= half * (1 + 1e-6) + largest)
    later = jax.tree.map(lambda v: v[t.size :], log)
    assert np.all(np.abs(later.s[:, 0]) <= hold_phase.sliding_bound(run, later) * (1 + 1e-6) + rounding)


test_chain_of_order_3_is_inside_its_envelopes = drawn(check_envelopes, 15, n=st.just(3), case=SCENARIO)
test_many_chains_are_inside_their_envelopes = pytest.mark.long(
    drawn(check_envelopes, 400, n=st.integers(2, 4), case=SCENARIO)
)


@jax.jit
def envelope(run, t, s0, floor):
    """Return centre and half width (times, n) of the envelopes of all states at times t.

    s0, floor: constants of the envelope of s.
    """
    law = run.controller
    return jax.vmap(lambda time: solutions.state_envelope(time, law.t_f, law.eta, run.initial, s0, floor))(t)


def test_envelopes_of_a_chain_are_tight():
    """Without an estimation error |s| equals its envelope, and x_1 comes within 1 % of its envelope."""
    run = chain_parts([1.0, 0.5, 0.0], 5.0, 4.0, bound=0.0)
    log = fly(run).log
    before = log.t < 4.9
    t = log.t[before]
    np.testing.assert_allclose(np.abs(log.s[before, 0]), envelopes.sliding_bound(run, t), rtol=1e-5)
    bound = envelopes.error_bound(run, t)
    assert np.all(np.abs(log.x[before, 0]) <= bound * (1 + 1e-6))
    assert np.max(np.abs(log.x[before, 0]) / bound) > 0.99


def test_bound_on_s_does_not_overflow_if_its_square_would():
    """Without an estimation error it is |s(0)| (tau / t_f)^(eta + n - 2), and s(0) is linear in the initial state."""
    t = np.linspace(0.0, 5.0, 6)
    one, far = (envelopes.sliding_bound(chain_parts([x, 0.0, 0.0], eta=4.0), t) for x in (1.0, 1e153))
    assert far[0] > np.sqrt(np.finfo(float).max)
    np.testing.assert_allclose(far, 1e153 * one, rtol=1e-12)


def test_exact_solution_of_a_chain_of_order_2_equals_that_of_the_second_order_system():
    for t in (0.0, 1.0, 6.9):
        both = solutions.exact_error(vector(t), vector(7.0), vector(2.7), vector([0.7]), vector([-0.3]))
        chain = solutions.exact_chain(vector(t), vector(7.0), vector(2.7), vector([0.7, -0.3]))
        np.testing.assert_allclose(chain.x, [both.error[0], both.error_rate[0]], rtol=1e-12)
        np.testing.assert_allclose((chain.s, chain.acceleration), (both.s[0], both.acceleration[0]), rtol=1e-11)


@pytest.mark.parametrize("n", [2, 3, 4, 5])
def test_exact_solution_of_a_chain_solves_the_equations_of_chain_and_law(n):
    """The derivative of each state is the next state, and the last one is the input of the law."""
    run = chain_parts(np.random.default_rng(n).normal(size=n), 7.0, n + 0.8)
    law = run.controller
    for t in (0.0, 2.0, 6.5):
        at, tangent = jax.jvp(
            lambda time: solutions.exact_chain(time, law.t_f, law.eta, run.initial), (vector(t),), (vector(1.0),)
        )
        size = np.abs(np.append(at.x, at.acceleration)).max()
        np.testing.assert_allclose(tangent.x, np.append(at.x[1:], at.acceleration), rtol=0, atol=1e-11 * size)
        u, s = torque(law, vector(t), BEFORE, at.x, None, jnp.zeros(1), vector(0.0))
        np.testing.assert_allclose((u[0], s[0]), (at.acceleration, at.s), rtol=1e-8, atol=1e-11 * size)


@pytest.mark.parametrize("x0", short([[5.0, 3.0], [5.0, 3.0, 2.0]], [[5.0, 3.0, 2.0]]))
def test_window_error_of_a_sampled_chain_converges_with_order_1_in_the_period(x0):
    wave = disturbances.Sinusoid(*(vector([v]) for v in (0.01, 1.0, 0.0, 0.0)))
    changes = {"bound": 0.01, "disturbance": wave, "delta": 0.5, "sign_width": 0.05}
    truth = fly(chain_parts(x0, **changes, steps=(4000, 200))).metrics.window_error
    sampled = [chain_parts(x0, **changes, period=h) for h in (0.01, 0.005, 0.0025)]
    clocks = [run.clock for run in sampled]
    sampled = [replace(run, clock=run.clock.long_enough_for(clocks)) for run in sampled]
    gaps = [abs(float(fly(run).metrics.window_error / truth) - 1.0) for run in sampled]
    ratios = np.array(gaps[:-1]) / np.array(gaps[1:])
    assert np.all((ratios > 1.7) & (ratios < 2.3))  # a zero-order hold has an error of order 1


def test_law_cancels_known_drift_and_gain_exactly():
    """With a perfect model of f and g the motion equals the motion of the chain without them."""

    def f(x):
        return -jnp.sin(x[0]) + x[1] * x[2]

    def g(x):
        return 1.5 + 0.5 * jnp.cos(x[0])

    bare = fly(chain_parts([0.5, -0.2, 0.1])).log
    nonlinear_chain = fly(chain_parts([0.5, -0.2, 0.1], f=f, g=g)).log
    np.testing.assert_allclose(nonlinear_chain.x, bare.x, rtol=0, atol=1e-10)
    assert np.abs(nonlinear_chain.u - bare.u).max() > 0.1


@pytest.mark.parametrize("hold", [False, True])
def test_derivatives_of_input_and_s_by_gains_equal_finite_differences(hold):
    run = chain_parts([0.1, -0.02, 0.03])
    gains = ("t_f", "eta", "k1", "surface_rate", "sign_width")
    point = vector([5.0, 4.5, 1.2, 1.7, 0.5])

    @jax.jit
    def input_and_s(point):
        law = with_controller(run, **dict(zip(gains, point, strict=True))).controller
        return jnp.stack(commanded(law, vector(3.1), jnp.asarray(hold), run.initial, None, jnp.zeros(1), vector(0.4)))

    steps = 1e-6 * np.eye(5)
    differences = np.stack([(input_and_s(point + h) - input_and_s(point - h)) / 2e-6 for h in steps], axis=-1)
    np.testing.assert_allclose(jax.jacfwd(input_and_s)(point), differences, rtol=1e-6, atol=1e-6)
    assert np.count_nonzero(np.abs(differences[0]) > 1e-4) == 3  # two gains of the phase, and sign_width


def test_chain_validates_its_order_and_functions():
    with pytest.raises(ValueError, match="order is 1, but must be a whole number of at least 2"):
        integrator_chain.chain(1)
    with pytest.raises(ValueError, match=r"^g\(x\) fails for x of shape \(3,\): index 3 is out of bounds"):
        integrator_chain.chain(3, g=lambda x: 1.0 + x[3] ** 2)
    stiff = jax.tree_util.Partial(lambda k, x: -k * x[0], vector(2.0))
    found = integrator_chain.chain(3, stiff)
    assert found.f is stiff
    assert len(jax.tree.leaves(found)) == 1  # the parameter of a Partial is a leaf
    x = vector([0.5, 0.0, 1.0])
    np.testing.assert_array_equal(found.rate(vector(0.0), x, vector([3.0]), vector([0.5])), [0.0, 1.0, 2.5])


def test_metrics_that_a_chain_lacks_are_nan():
    result = fly(chain_parts([1.0, 0.0]))
    assert np.isnan(float(result.metrics.peak_momentum))
    assert float(result.metrics.peak_rate) == pytest.approx(np.abs(result.log.x[:, 1]).max())
    assert float(result.metrics.terminal_angle) == float(result.metrics.terminal_error)
