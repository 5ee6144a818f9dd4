"""LAPACK is handed few small matrices at a time, or one: jaxlib 0.10 would wait for threads in one of these."""

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
from ptsmc_jax.theory import linear, rest, run_margins, solutions
from tests.helpers import equations
from tuning.search import design

pytestmark = pytest.mark.skipif(not lapack.CAN_DEADLOCK, reason="this jaxlib does not wait")


def handed(trace):
    """The most operations that a call of LAPACK in a trace is handed, and whether one of `SHARED` is given several."""
    found = [e for e in equations(trace) if e.primitive.name in lapack.COUNTED | lapack.SHARED]
    assert found  # it is looked at
    several = any(e.primitive.name in lapack.SHARED and e.invars[0].aval.ndim > 2 for e in found)
    return max(e.invars[-1].aval.size * e.invars[0].aval.shape[-1] for e in found), several


def eigenvalues(a):
    """Of a symmetric matrix."""
    return jnp.linalg.eigh(a)[0]


@pytest.mark.parametrize("function", [lambda a: jnp.linalg.solve(a, a[0]), jnp.linalg.cholesky, eigenvalues])
@pytest.mark.parametrize("n", [3, 12])
def test_lanes_hand_it_little(n, function):
    """What of 12 rows 128 trials at once make no end of."""
    root = np.random.default_rng(n).normal(size=(128, n, n))
    a = jnp.asarray(root @ root.swapaxes(1, 2) + np.eye(n))
    with pytest.warns(lanes.LanesWarning, match="have no rule"):
        flown = jax.jit(lanes.vmap(function)).trace(a)
    most, several = handed(flown.jaxpr)
    assert most <= lapack.MAX_BATCHED_OPERATIONS
    assert not several
    found = flown.lower().compile()(a)
    np.testing.assert_allclose(found, jnp.stack([function(one) for one in a]), rtol=1e-9, atol=1e-9)


def test_slopes_along_directions_are_no_exception():
    """128 trials along 2 directions."""
    a = jnp.broadcast_to(2.0 * jnp.eye(12), (128, 12, 12))
    with pytest.warns(lanes.LanesWarning, match="have no rule"):
        trace = jax.make_jaxpr(lanes.jvp(jnp.linalg.inv))((a,), (jnp.ones((2, 12, 12)),))
    most, several = handed(trace)
    assert most <= lapack.MAX_BATCHED_OPERATIONS
    assert not several


def test_what_has_none_goes_as_ever():
    """The same equations as `jax.vmap` makes of it."""
    x = jnp.ones((1000, 20, 20))
    traces = [jax.make_jaxpr(over(lambda a: jnp.sin(a) @ a))(x) for over in (lapack.vmap, jax.vmap)]
    assert [e.primitive.name for e in equations(traces[0])] == [e.primitive.name for e in equations(traces[1])]


def softened(v):
    """A vector as it is, by eigenvalues."""
    values, axes = jnp.linalg.eigh(jnp.diag(jnp.arange(1.0, v.size + 1.0)) + 0.1 * jnp.outer(v, v))
    return axes @ ((axes.T @ v) * values / values)


def moved(t, x_1, x_2):
    """x_1' where x_1 is off from what swings."""
    return softened(x_2 - jnp.sin(t))


class Pushed(ptsmc.Disturbance):
    """A swinging one with eigenvalues in it."""

    def __call__(self, t, x):
        """Of as many components as the plant has inputs."""
        return softened(0.01 * jnp.sin(t) * jnp.ones(3 if hasattr(x, "q") else 2))


class Held(ptsmc.Reference):
    """An attitude with eigenvalues in it."""

    def attitude(self, t):
        """The identity."""
        return softened(jnp.stack([0.0 * t, 0.0, 0.0, 1.0]))


@pytest.fixture
def shared(monkeypatch):
    """Calls of LAPACK in any trace that are handed several matrices and share them among the threads."""
    several = []
    for p in (p for p in vars(core.primitives).values() if getattr(p, "name", None) in lapack.SHARED):

        def bind(*args, p=p, bound=p.bind, **params):
            several.extend(f"{p.name} of {v.shape}" for v in args[:1] if v.ndim > 2)
            return bound(*args, **params)

        monkeypatch.setattr(p, "bind", bind)
    return several


OWN = {
    "disturbance": {"kind": "own", "code": Pushed},
    "controller": {"t_f": 3.0, "delta": 0.5},
    "loop": {"mode": "sampled", "period": 0.1, "t_end": 4.0},
}


def looked_at_before_and_after(parts, dispersion):
    """Where a loop is at rest, C's vectors, peaks by theory."""
    trials, seed, run = jnp.arange(4, dtype=jnp.uint32), jnp.uint32(0), jax.eval_shape(linear.nominal, parts)
    run_margins._moments.trace(parts, run, run_margins.judged_times(parts))
    rest._unexplained.trace(parts, run)
    vectors.fly_many.trace(parts, dispersion, seed, trials)
    design._predicted.trace(parts, dispersion, seed, trials, jnp.asarray(3.0))


def test_what_is_seen_of_a_system_is_looked_at_one_matrix_at_a_time(shared):
    """Bounds of its disturbance, states on its way, its law's start; its steps, its loop in many periods and trials."""
    plant = system(2, moved, lambda t, x_1, x_2: softened(-x_1), lambda t, x_1, x_2: jnp.eye(2))
    of_system = {
        "plant": {"kind": "system", "system": plant, "x0": [1.0, 0.5, 0.0, 0.0]},
        "observer": {"kind": "nonlinear", "gain": [2.0, 2.0]},
        "dispersion": {"x0": {"kind": "uniform", "half_width": [0.1, 0.1, 0.0, 0.0]}},
    }
    studied = scenario.study(scenario.from_tables(OWN | of_system))
    parts, dispersion = studied.parts, studied.dispersion
    visited = jax.eval_shape(solutions.visited, parts)
    timing._boundary_layer.trace(parts.controller, parts.observer, visited)
    looked_at_before_and_after(parts, dispersion)
    run = jax.eval_shape(linear.nominal, parts)
    some = jax.tree.map(lambda v: jnp.ones((4, *v.shape[1:]), v.dtype), run)
    trials = jnp.arange(margin_verdicts.CALL, dtype=jnp.uint32)
    of_periods = jax.tree.map(lambda v: jnp.ones(v.shape, v.dtype), run)
    traces = {
        "loops": linear._opened.trace(parts, some, None, late=True),
        "loops of traced parts": jax.make_jaxpr(lambda k: linear.loops_at(parts, of_periods, k))(jnp.arange(4)),
        "loops of trials": margin_verdicts._look.trace(parts, dispersion, jnp.uint32(0), trials, 1, True),
        "steps": timing._rates_of_system.trace(parts, (jnp.linspace(0.0, 1.0, 4), jnp.ones((4, 4)))),
    }
    assert not any(handed(trace.jaxpr)[1] for trace in traces.values())
    assert not shared


def test_what_is_seen_of_a_spacecraft_is_looked_at_one_matrix_at_a_time(shared):
    """Its disturbance and its reference have eigenvalues in them."""
    studied = scenario.study(scenario.from_tables(OWN | {"reference": {"kind": "own", "code": Held}}))
    looked_at_before_and_after(studied.parts, studied.dispersion)
    assert not shared
