"""`stacking.scan` has the results of `lax.scan` and writes one array for each dtype."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from ptsmc_jax.batching import lanes
from ptsmc_jax.batching.dependence import split_scan_operands
from ptsmc_jax.numerics import stacking
from ptsmc_jax.simulation import rollout
from ptsmc_jax.theory import linear
from tests.helpers import equations, parts

X0, TIMES = jnp.asarray([0.3, -0.2, 0.1]), jnp.arange(7.0)
OUTER = {"state": (X0, jnp.asarray(0.5))}


def pendulum(carry, t):
    """Return the next state of a pendulum, and its outputs.

    The outputs have several dtypes and shapes, None and an empty array. carry: {"state": (x, v)}.
    """
    x, v = carry["state"]
    v = v - 0.1 * jnp.sin(x[0]) + 0.01 * t
    count = t.astype(jnp.int32)
    outputs = {
        "x": x,
        "outer": jnp.outer(x, x),
        "late": t > 3.0,
        "count": (count, count.astype(jnp.uint32) + 4_000_000_000),
    }
    return {"state": (x + 0.1 * v, v)}, (outputs, None, jnp.zeros((2, 0)), 2.5)


@pytest.mark.parametrize("options", [{}, {"reverse": True}, {"length": 7, "unroll": 2}])
def test_outputs_of_stacking_scan_equal_lax_scan(options):
    ours, theirs = stacking.scan(pendulum, OUTER, TIMES, **options), jax.lax.scan(pendulum, OUTER, TIMES, **options)
    assert jax.tree.structure(ours) == jax.tree.structure(theirs)
    for one, other in zip(jax.tree.leaves(ours), jax.tree.leaves(theirs), strict=True):
        assert (one.shape, one.dtype, one.weak_type) == (other.shape, other.dtype, other.weak_type)
        np.testing.assert_array_equal(one, other)


def test_stacking_scan_works_without_steps_and_without_outputs():
    (outputs, *_), length = stacking.scan(pendulum, OUTER, TIMES[:0])[1], len(TIMES)
    assert outputs["outer"].shape == (0, 3, 3)
    last, nothing = stacking.scan(lambda x, _: (2.0 * x, None), 1.0, None, length=length)
    assert (last, nothing) == (2.0**length, None)


def test_stacking_scan_falls_back_to_lax_scan_if_jit_is_disabled():
    """Regression: outputs whose weak type changes after the first step, and random keys, raised errors."""

    def step(c, t):
        return c + t, (c, jax.random.key(0), t > 1.0, 2.0 * t)

    with jax.disable_jit():
        ours, theirs = (scan(step, 1.0, TIMES) for scan in (stacking.scan, jax.lax.scan))
    assert jax.tree.map(jnp.shape, ours) == jax.tree.map(jnp.shape, theirs)
    np.testing.assert_array_equal(ours[1][0], theirs[1][0])


def gradients_of(scan):
    """Return derivatives and batched values (9,) of a function that uses this scan; scan: like `jax.lax.scan`."""

    def error(gain):
        (_, (outputs, *_)) = scan(lambda c, t: pendulum(c, gain * t), OUTER, TIMES)
        return jnp.sum(outputs["outer"] ** 2)

    return jnp.stack([jax.grad(error)(1.3), jax.jacfwd(error)(1.3), *jax.vmap(error)(TIMES)])


def test_stacking_scan_composes_with_grad_jacfwd_and_vmap():
    found, expected = jax.jit(lambda: (gradients_of(stacking.scan), gradients_of(jax.lax.scan)))()
    np.testing.assert_allclose(found, expected, rtol=1e-12)
    with jax.checking_leaks():
        jax.jit(stacking.scan, static_argnums=0)(pendulum, OUTER, TIMES)


def output_dtypes(trace):
    """Yield, for each scan in a trace, the list of the dtypes of its output arrays."""
    for eqn in equations(trace):
        if eqn.primitive.name == "scan":
            _, carried, _ = split_scan_operands(eqn.params, eqn.invars)
            yield [v.aval.dtype for v in eqn.outvars[len(carried) :]]


SAMPLED = parts(t_f=2.0, t_end=2.5, period=0.1)
RUNS = {
    "nominal run": lambda: jax.make_jaxpr(linear.simulate_nominal)(SAMPLED),
    "sampled": lambda: jax.make_jaxpr(lambda run: rollout.simulate(run, record=True))(SAMPLED),
    "continuous": lambda: jax.make_jaxpr(lambda run: rollout.simulate(run, record=True))(parts()),
    "batch": lambda: jax.make_jaxpr(
        lanes.vmap(lambda trial: rollout.simulate(SAMPLED, 0, trial, record=True))
    )(np.arange(3, dtype=np.uint32)),
}  # fmt: skip


@pytest.mark.parametrize("name", RUNS)
def test_loops_of_a_simulation_write_one_array_for_each_dtype(name):
    """XLA would copy several output arrays in every step, and the run time would grow with the square of the length."""
    dtypes_of_loops = list(output_dtypes(RUNS[name]()))
    assert any(dtypes_of_loops)
    for dtypes in dtypes_of_loops:
        assert len(dtypes) == len(set(dtypes))
