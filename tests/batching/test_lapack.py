"""Batched LAPACK calls are small enough that jaxlib 0.10 cannot deadlock."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from jax.extend import core

import ptsmc_jax as ptsmc
from ptsmc_jax import scenario
from ptsmc_jax.batching import lanes, lapack
from ptsmc_jax.campaigns import margin_verdicts
from ptsmc_jax.onboard import vectors
from ptsmc_jax.plants import system
from ptsmc_jax.scenario import timing
from ptsmc_jax.theory import limit_cycles, linear, run_margins, solutions
from tests.helpers import equations
from tuning.search import design

pytestmark = pytest.mark.skipif(not lapack.CAN_DEADLOCK, reason="this jaxlib cannot deadlock")


def lapack_calls(trace):
    """Return the size of the largest LAPACK call in a trace, and whether one of `NEVER_BATCHED` is batched.

    The size is the number of elements of the last operand times the number of columns of the first one.
    """
    found = [e for e in equations(trace) if e.primitive.name in lapack.SIZE_LIMITED | lapack.NEVER_BATCHED]
    assert found
    is_batched = any(e.primitive.name in lapack.NEVER_BATCHED and e.invars[0].aval.ndim > 2 for e in found)
    return max(e.invars[-1].aval.size * e.invars[0].aval.shape[-1] for e in found), is_batched


def eigenvalues(a):
    """Return the eigenvalues (n,) of a symmetric matrix (n, n)."""
    return jnp.linalg.eigh(a)[0]


@pytest.mark.parametrize("function", [lambda a: jnp.linalg.solve(a, a[0]), jnp.linalg.cholesky, eigenvalues])
@pytest.mark.parametrize("n", [3, 12])
def test_lanes_split_large_lapack_batches(n, function):
    """A batch of 128 matrices of order 12 can deadlock."""
    root = np.random.default_rng(n).normal(size=(128, n, n))
    a = jnp.asarray(root @ root.swapaxes(1, 2) + np.eye(n))
    trace = jax.jit(lanes.vmap(function)).trace(a)
    operations, is_batched = lapack_calls(trace.jaxpr)
    assert operations <= lapack.MAX_BATCHED_OPERATIONS
    assert not is_batched
    found = trace.lower().compile()(a)
    np.testing.assert_allclose(found, jnp.stack([function(one) for one in a]), rtol=1e-9, atol=1e-9)


def test_lanes_jvp_splits_large_lapack_batches():
    """The batch has 128 trials and 2 directions."""
    a = jnp.broadcast_to(2.0 * jnp.eye(12), (128, 12, 12))
    trace = jax.make_jaxpr(lanes.jvp(jnp.linalg.inv))((a,), (jnp.ones((2, 12, 12)),))
    operations, is_batched = lapack_calls(trace)
    assert operations <= lapack.MAX_BATCHED_OPERATIONS
    assert not is_batched


def test_functions_without_lapack_use_jax_vmap():
    x = jnp.ones((1000, 20, 20))
    traces = [jax.make_jaxpr(vmap(lambda a: jnp.sin(a) @ a))(x) for vmap in (lapack.vmap, jax.vmap)]
    assert [e.primitive.name for e in equations(traces[0])] == [e.primitive.name for e in equations(traces[1])]


def identity_by_eigh(v):
    """Return the vector v (n,) itself, after a call of `eigh`."""
    values, axes = jnp.linalg.eigh(jnp.diag(jnp.arange(1.0, v.size + 1.0)) + 0.1 * jnp.outer(v, v))
    return axes @ ((axes.T @ v) * values / values)


def rate_of_x_1(t, x_1, x_2):
    """Return x_1' = x_2 - sin t (m,) of a system, after a call of `eigh`."""
    return identity_by_eigh(x_2 - jnp.sin(t))


class EighDisturbance(ptsmc.Disturbance):
    """A sinusoidal disturbance that calls `eigh`."""

    def __call__(self, t, x):
        """Return the disturbance, (3,) for a spacecraft and (2,) for other plants."""
        return identity_by_eigh(0.01 * jnp.sin(t) * jnp.ones(3 if hasattr(x, "q") else 2))


class EighReference(ptsmc.Reference):
    """A constant attitude that calls `eigh`."""

    def attitude(self, t):
        """Return the identity quaternion (4,)."""
        return identity_by_eigh(jnp.stack([0.0 * t, 0.0, 0.0, 1.0]))


@pytest.fixture
def batched_calls(monkeypatch):
    """Return a list, which receives a text such as "eigh of (4, 3, 3)" for each batched call of `NEVER_BATCHED`."""
    calls = []
    for p in (p for p in vars(core.primitives).values() if getattr(p, "name", None) in lapack.NEVER_BATCHED):

        def bind(*args, p=p, bound=p.bind, **params):
            calls.extend(f"{p.name} of {v.shape}" for v in args[:1] if v.ndim > 2)
            return bound(*args, **params)

        monkeypatch.setattr(p, "bind", bind)
    return calls


CUSTOM = {
    "disturbance": {"kind": "custom", "code": EighDisturbance},
    "controller": {"t_f": 3.0, "delta": 0.5},
    "loop": {"mode": "sampled", "period": 0.1, "t_end": 4.0},
}


def trace_analyses(parts, dispersion):
    """Trace the moments and the rest point of the loop, the test vectors of the C export, and predicted peaks.

    The function returns nothing: it only calls the primitives that `batched_calls` records.
    """
    trials, seed, run = jnp.arange(4, dtype=jnp.uint32), jnp.uint32(0), jax.eval_shape(linear.simulate_nominal, parts)
    run_margins._find_period_indices_jit.trace(parts, run, run_margins.judged_times(parts))
    limit_cycles._nonlinear_residual.trace(parts, run)
    vectors.simulate_many.trace(parts, dispersion, seed, trials)
    design._predict_peaks.trace(parts, dispersion, seed, trials, jnp.asarray(3.0))


@pytest.mark.filterwarnings("ignore::ptsmc_jax.batching.lanes.LanesWarning")  # `jax.vmap` evaluates eigh
def test_analyses_of_a_system_never_batch_eigh(batched_calls):
    """This includes bounds of the disturbance, integration steps, and linearised loops of many periods and trials."""
    plant = system(2, rate_of_x_1, lambda t, x_1, x_2: identity_by_eigh(-x_1), lambda t, x_1, x_2: jnp.eye(2))
    of_system = {
        "plant": {"kind": "system", "system": plant, "x0": [1.0, 0.5, 0.0, 0.0]},
        "observer": {"kind": "nonlinear", "gain": [2.0, 2.0]},
        "dispersion": {"x0": {"kind": "uniform", "half_width": [0.1, 0.1, 0.0, 0.0]}},
    }
    studied = scenario.study(scenario.from_tables(CUSTOM | of_system))
    parts, dispersion = studied.parts, studied.dispersion
    visited = jax.eval_shape(solutions.visited_states, parts)
    timing._layer_rates.trace(parts.controller, parts.observer, visited)
    trace_analyses(parts, dispersion)
    run = jax.eval_shape(linear.simulate_nominal, parts)
    some = jax.tree.map(lambda v: jnp.ones((4, *v.shape[1:]), v.dtype), run)
    trials = jnp.arange(margin_verdicts.LOOPS_PER_CALL, dtype=jnp.uint32)
    of_periods = jax.tree.map(lambda v: jnp.ones(v.shape, v.dtype), run)
    traces = {
        "loops": linear._linearise_batch.trace(parts, some, None, fractional_delays=True),
        "loops of traced parts": jax.make_jaxpr(lambda k: linear.open_loops(parts, of_periods, k))(jnp.arange(4)),
        "loops of trials": margin_verdicts._loops_and_margins.trace(parts, dispersion, jnp.uint32(0), trials, 1, True),
        "steps": timing._system_rates.trace(parts, (jnp.linspace(0.0, 1.0, 4), jnp.ones((4, 4)))),
    }
    assert not any(lapack_calls(trace.jaxpr)[1] for trace in traces.values())
    assert not batched_calls


def test_analyses_of_a_spacecraft_never_batch_eigh(batched_calls):
    studied = scenario.study(scenario.from_tables(CUSTOM | {"reference": {"kind": "custom", "code": EighReference}}))
    trace_analyses(studied.parts, studied.dispersion)
    assert not batched_calls
