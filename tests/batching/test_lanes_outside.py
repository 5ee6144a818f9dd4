"""`lanes.vmap` under outer transformations, with all forms of in_axes, and the shapes inside its loops."""

from functools import partial

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from jax import lax
from jax.extend.core import jaxprs_in_params

from ptsmc_jax.batching import lanes
from ptsmc_jax.plants.rigid_body import AttitudeState
from tests.batching.test_lanes import (
    FIXED,
    SYMMETRIC,
    TABLE,
    TRIALS,
    M,
    Q,
    S,
    X,
    Y,
    agree,
    check,
    cubed,
    draw,
    in_loop,
    squared,
    time_and_state,
)
from tests.helpers import equations

# outer transformations


def law(x, m, s):
    """Return two numbers of a loop with the kinds of operations of a simulation; x: (3,), m: (3, 3), s: scalar."""

    def step(c, k):
        force = jnp.cross(c, m @ c) - s * jnp.where(jnp.abs(c) > 0.5, jnp.sign(c), 2 * c)
        return c + 0.1 * jnp.tanh(force) * jnp.sin(0.1 * k), jnp.max(jnp.abs(force))

    end, peaks = lax.scan(step, x, jnp.arange(6))
    return jnp.linalg.norm(end), jnp.max(peaks) + jnp.sum(cubed(end))


def short_law(x, m, s):
    """Return the last vector of a smaller loop and three numbers, for tests that compile many programs."""
    return lax.scan(lambda c, _: (jnp.tanh(s * c + m @ x), c[0]), x, None, 3)


ARGS = (X, M, S)


def loss(vmap, x, m, s, function=law):
    """Return a scalar of the batched results, for derivatives; vmap: of lanes or JAX."""
    end, peaks = vmap(function)(x, m, s)
    return jnp.sqrt(jnp.mean(end**2)) + jnp.mean(peaks)


def derivative_along_cosines(vmap, *args):
    """Return the batched results of `law` and their tangents along the cosines of `args`; vmap: of lanes or JAX."""
    return jax.jvp(vmap(law), args, tuple(jnp.cos(a) for a in args))


def gradients(vmap, *args):
    """Return the gradients of `loss` by all three arguments, as a tuple; vmap: of lanes or JAX."""
    return jax.grad(partial(loss, vmap), argnums=(0, 1, 2))(*args)


GAIN = jnp.asarray(0.3)
PAIR = draw(TRIALS, 3, trials=2, seed=3)

# name: transformation of a vmap, called with (x, m, s) of TRIALS trials
OUTSIDE = {
    "jit": lambda vmap, *args: vmap(law)(*args),
    "jvp": derivative_along_cosines,
    "grad": gradients,
    "jacfwd": lambda vmap, x, m, s: jax.jacfwd(lambda s: loss(vmap, x, m, s, short_law))(s),
    "jacfwd of a shared gain": lambda vmap, x, m, _: jax.jacfwd(lambda g: vmap(short_law, (0, 0, None))(x, m, g))(GAIN),
    "jacrev of a shared gain": lambda vmap, x, m, _: jax.jacrev(lambda g: vmap(short_law, (0, 0, None))(x, m, g))(GAIN),
    "captured gain": lambda vmap, x, m, _: jax.jacrev(lambda g: vmap(lambda x: jnp.sin(g * x) @ x)(x))(GAIN),
    "second derivative": lambda vmap, x, m, _: jax.hessian(lambda g: vmap(lambda x: jnp.sin(g * x) @ x)(x))(GAIN),
    "vmap": lambda vmap, x, m, s: jax.vmap(vmap(short_law), (0, None, None))(PAIR, m, s),
    "vmap of a shared gain": lambda vmap, x, m, _: jax.vmap(lambda g: vmap(short_law, (0, 0, None))(x, m, g))(FIXED),
    "scan": lambda vmap, x, m, s: lax.scan(lambda c, g: (vmap(short_law, (0, 0, None))(c, m, g)[0], c), x, FIXED),
    "map over blocks": lambda vmap, x, m, s: lax.map(lambda x: vmap(short_law, (0, None, None))(x, m[0], s[0]), PAIR),
    "itself": lambda vmap, *args: vmap(lambda x, m, g: vmap(short_law, (None, 0, None))(x, m, g), (0, None, 0))(*args),
    "itself, both mapped": lambda vmap, x, m, s: vmap(vmap(lambda a: (jnp.cumsum(a), a @ a)))(m),
    "jax.vmap inside": lambda vmap, x, m, s: vmap(jax.vmap(lambda a: a * jnp.sum(a)))(m),
    "checkpoint": lambda vmap, *args: jax.grad(jax.checkpoint(partial(loss, vmap, function=short_law)))(*args),
    "custom_vjp": lambda vmap, x, m, s: jax.grad(lambda x: vmap(squared)(x).sum())(x),
    "primitive without a rule": lambda vmap, x, m, s: jax.grad(
        lambda m: vmap(lambda m: jnp.sum(jnp.linalg.inv(SYMMETRIC(m)) ** 2))(m).sum()
    )(m),
}  # fmt: skip


@pytest.mark.filterwarnings("ignore::ptsmc_jax.batching.lanes.LanesWarning")
@pytest.mark.parametrize("name", OUTSIDE)
def test_lanes_vmap_equals_jax_vmap_inside_other_transformations(name):
    got, expected = (jax.jit(partial(OUTSIDE[name], vmap))(*ARGS) for vmap in (lanes.vmap, jax.vmap))
    agree(got, expected)


def test_lanes_work_without_jit():
    agree(lanes.vmap(law)(*ARGS), jax.vmap(law)(*ARGS))
    agree(
        *(jax.grad(partial(loss, vmap, function=short_law), argnums=(0, 1))(*ARGS) for vmap in (lanes.vmap, jax.vmap))
    )


def test_lanes_vmap_uses_custom_derivatives():
    derivative = jax.jvp(lanes.vmap(cubed), (X,), (jnp.ones_like(X),))[1]
    np.testing.assert_allclose(derivative, 100 * X, rtol=1e-15)


# arguments

ROWS = [
    ("all mapped", lambda x, s: x * s, (X, S), 0),
    ("one shared", lambda x, y: (x * y, y.sum()), (X, FIXED), (0, None)),
    ("a list of axes", lambda x, y: x * y, (X, FIXED), [0, None]),
    ("shared matrix", lambda m, x: m @ x, (TABLE.T, X), (None, 0)),
    ("shared pytree", lambda p, x: p["a"] * x + p["b"][0], ({"a": FIXED, "b": (FIXED,)}, X), (None, 0)),
    ("mapped pytree", lambda p, x: p["a"] * x + p["b"][0], ({"a": S, "b": (X,)}, FIXED), (0, None)),
    ("axes in a pytree", lambda p: p[0] * p[1][1] + p[1][2], ((S, {1: X, 2: FIXED}),), ((0, {1: 0, 2: None}),)),
    ("None among the leaves", lambda p, q: p[0] + q["x"], ((X, None), {"x": FIXED, "y": None}), (0, None)),
    ("Python numbers", lambda x, a, n: x * a + n, (X, 2.0, 3), (0, None, None)),
    ("Python numbers are weakly typed", lambda x, a: x * a, (X.astype(jnp.float32), 2.0), (0, None)),
    ("NumPy arrays", lambda x, a: x * a, (np.asarray(X), np.ones(3)), (0, None)),
    ("one trial", law, (X[:1], M[:1], S[:1]), 0),
    ("many trials", law, (jnp.tile(X, (40, 1)), M[0], jnp.arange(200.0)), (0, None, 0)),
    ("no trial", lambda x, s: (x * s, x @ x), (X[:0], S[:0]), 0),
    ("keys", lambda key: jax.random.normal(key, (3,)), (jax.random.split(jax.random.key(1), TRIALS),), 0),
]  # fmt: skip


@pytest.mark.filterwarnings("ignore::ptsmc_jax.batching.lanes.LanesWarning")
@pytest.mark.parametrize(("function", "args", "in_axes"), [row[1:] for row in ROWS], ids=[row[0] for row in ROWS])
def test_lanes_with_mapped_and_shared_arguments_equal_jax_vmap(function, args, in_axes):
    check(function, *args, in_axes=in_axes)


def test_lanes_map_all_arguments_by_default():
    agree(lanes.vmap(jnp.multiply)(X, Y), X * Y)


def test_in_axes_of_lanes_may_be_a_named_tuple():
    state = AttitudeState(Q, FIXED)
    check(lambda x: x.q[:3] * x.w, state, in_axes=(AttitudeState(0, None),))  # pyright: ignore[reportArgumentType]


def test_lanes_equal_jax_vmap_in_single_precision():
    with jax.enable_x64(False):
        args = [jnp.asarray(np.asarray(a), jnp.float32) for a in ARGS]
        got, expected = (jax.jit(vmap(law))(*args) for vmap in (lanes.vmap, jax.vmap))
        assert {a.dtype for a in got} == {jnp.dtype("float32")}
        for a, b in zip(got, expected, strict=True):
            np.testing.assert_allclose(a, b, rtol=0, atol=1e-5)  # a hundred rounding errors of 1e-7


ERRORS = [
    ("unequal numbers of trials", (X, S[:3]), 0),
    ("nothing mapped", (X, S), None),
    ("nothing mapped, by a tuple", (X, S), (None, None)),
    ("no leaves to map", (None, FIXED), (0, None)),
    ("another axis", (X, S), 1),
    ("a negative axis", (X, S), (0, -1)),
    ("a wrong number of axes", (X, S), (0,)),
    ("axes of another structure", ({"a": X}, S), ({"b": 0}, 0)),
    ("a number mapped", (X, 2.0), (0, 0)),
]


@pytest.mark.parametrize(("args", "in_axes"), [row[1:] for row in ERRORS], ids=[row[0] for row in ERRORS])
def test_invalid_in_axes_of_lanes_raise_an_error(args, in_axes):
    with pytest.raises(ValueError):  # noqa: PT011
        lanes.vmap(lambda *a: a, in_axes)(*args)


def test_errors_of_lanes_name_the_invalid_axis_or_numbers_of_trials():
    with pytest.raises(ValueError, match=r"one number of trials, found \[3, 5\]"):
        lanes.vmap(jnp.multiply)(X, Y[:3])
    with pytest.raises(ValueError, match="0 and None only, found 1"):
        lanes.vmap(jnp.multiply, (0, 1))(X, Y)


@pytest.mark.parametrize(
    ("directions", "message"),
    [
        ((None,), "directions must be of some of the 1 arguments, found 0"),
        ((X[None], X[None]), "directions must be of some of the 1 arguments, found 2"),
        ((X[0],), r"3 directions of \(3,\) in 5 trials cannot be of shape \(3,\)"),
        ((X[None, :4],), r"1 directions of \(3,\) in 5 trials cannot be of shape \(1, 4, 3\)"),
    ],
    ids=["none", "too many", "without direction axis", "fewer trials"],
)
def test_directions_of_lanes_jvp_with_a_wrong_shape_raise_an_error(directions, message):
    """Regression: a vector was treated as several directions of a scalar."""
    with pytest.raises(ValueError, match=message):
        lanes.jvp(lambda x: x**2)((X,), directions)


# structure of the result


def shapes_in_loops(jaxpr, inside=False):
    """Yield the shapes of all values that are computed in the scans of a jaxpr, nested jaxprs included."""
    for eqn in jaxpr.eqns:
        loop = inside or eqn.primitive.name == "scan"
        if inside:
            yield from (v.aval.shape for v in eqn.outvars)
        for inner in jaxprs_in_params(eqn.params):
            yield from shapes_in_loops(inner, loop)


def test_loops_in_lanes_carry_vectors_over_the_trials():
    """Lanes split the state into components. Each is an array (TRIALS,)."""
    traced = jax.make_jaxpr(lanes.vmap(lambda x, m, s: law(x, m, s)[0]))(*ARGS)
    assert set(shapes_in_loops(traced.jaxpr)) == {(), (TRIALS,)}


def time_and_state_in_a_call(s):
    """Scan with a jitted step of a time, which does not depend on the trial, and a state, which does.

    Return the last time and state, and both before each step.
    """
    step = jax.jit(lambda t, x: (t + 0.1, x + jnp.exp(-t) * x))
    return lax.scan(lambda c, _: (step(*c), c), (0.0, s), None, 6)


@pytest.mark.parametrize("run", [time_and_state, time_and_state_in_a_call])
def test_lanes_compute_values_that_do_not_depend_on_the_trial_once(run):
    traced = jax.make_jaxpr(lanes.vmap(run))(S)
    (scan,) = [eqn for eqn in traced.jaxpr.eqns if eqn.primitive.name == "scan"]
    exponentials = [eqn for eqn in scan.params["jaxpr"].jaxpr.eqns if eqn.primitive.name == "exp"]
    assert [eqn.outvars[0].aval.shape for eqn in exponentials] == [()]
    (times, states) = jax.eval_shape(lanes.vmap(run), S)[1]
    assert (times.shape, states.shape) == ((TRIALS, 6), (TRIALS, 6))


def test_lanes_keep_a_branch_whose_condition_all_trials_share():
    """A condition that differs by trial becomes a selection between the results of both branches."""

    def run(s):
        step = lambda c, k: lax.cond(k > 3, lambda: jnp.exp(c), lambda: c)  # noqa: E731
        return lax.scan(lambda c, k: (step(c, k), None), s, jnp.arange(6))[0]

    def by_trial(s):
        return lax.cond(s > 0, lambda: jnp.exp(s), lambda: s)

    branches, selected = (list(equations(jax.make_jaxpr(lanes.vmap(f))(S))) for f in (run, by_trial))
    (cond,) = [eqn for eqn in branches if eqn.primitive.name == "cond"]
    assert [v.aval.shape for v in cond.outvars] == [(TRIALS,)]
    assert not [eqn for eqn in selected if eqn.primitive.name == "cond"]


def test_lanes_test_a_scalar_in_a_while_loop_whose_condition_all_trials_share():
    def run(s):
        return lax.while_loop(lambda c: c[0] < 3, lambda c: (c[0] + 1, jnp.sin(c[1])), (0, s))

    (loop,) = [e for e in equations(jax.make_jaxpr(lanes.vmap(run))(S)) if e.primitive.name == "while"]
    assert sorted(v.aval.shape for v in loop.outvars) == [(), (TRIALS,)]


def test_lanes_evaluate_custom_derivatives_on_components():
    """Each multiplication of the derivative has the shape (TRIALS,)."""
    traced = jax.make_jaxpr(lambda x: jax.jvp(lanes.vmap(in_loop(cubed)), (x,), (x,)))(X)
    shapes = {v.aval.shape for eqn in equations(traced) for v in eqn.outvars if eqn.primitive.name == "mul"}
    assert shapes == {(TRIALS,)}


@jax.custom_jvp
def scaled(n, x):
    """Return n x^2 with a wrong custom derivative, see `_scaled_jvp`."""
    return n * x**2


@scaled.defjvp
def _scaled_jvp(primals, tangents):
    """Return n x^2 and a wrong tangent, 7 n dx; primals: (n, x), tangents: (dn, dx)."""
    return scaled(*primals), 7.0 * primals[0] * tangents[1]  # a wrong derivative on purpose, to detect its use


@pytest.mark.parametrize("in_axes", [(0, 0), (None, 0), (0, None)])
def test_lanes_vmap_uses_custom_derivatives_with_integer_arguments(in_axes):
    n, x = (jnp.arange(TRIALS), jnp.arange(TRIALS) * 0.5)
    n, x = (v if axis == 0 else v[3] for v, axis in zip((n, x), in_axes, strict=True))
    got, expected = (
        jax.jit(lambda x, vmap=vmap: jax.jvp(lambda x: vmap(scaled, in_axes)(n, x), (x,), (jnp.ones_like(x),)))(x)
        for vmap in (lanes.vmap, jax.vmap)
    )
    agree(got, expected)


def test_lanes_do_not_split_a_large_carry_into_components():
    big = draw(70)
    traced = jax.make_jaxpr(lanes.vmap(lambda t: lax.scan(lambda c, _: (2 * c, None), t, None, 3)[0]))(big)
    (loop,) = [eqn for eqn in equations(traced) if eqn.primitive.name == "scan"]
    assert [v.aval.shape for v in loop.outvars] == [(TRIALS, 70)]


def test_warnings_of_lanes_name_the_primitive_and_the_source_line():
    matrices = jnp.stack([jnp.eye(3), 2 * jnp.eye(3)])
    message = r"`cholesky` \(.*test_lanes_outside\.py:\d+\): jax.vmap evaluates it, which may be slow"
    with pytest.warns(lanes.LanesWarning, match=message):
        lanes.vmap(in_loop(lambda m: lax.linalg.cholesky(m)))(matrices)


def test_lanes_replace_small_contractions_outside_loops_by_sums_of_products():
    """XLA aborts the process for some batches of contractions, for example of derivatives."""
    traced = jax.make_jaxpr(lanes.vmap(lambda m, x: m @ (m @ x)))(draw(3, 3), X)
    assert not [eqn for eqn in equations(traced) if eqn.primitive.name == "dot_general"]


def test_lanes_do_not_split_large_arrays_into_components():
    function = lanes.vmap(in_loop(lambda t: 2 * t + 1))
    few, many = (len(list(equations(jax.make_jaxpr(function)(draw(n))))) for n in (65, 64))
    assert few < 10
    assert many >= 2 * 64


def test_integer_and_boolean_outputs_of_lanes_jvp_have_float0_tangents():
    """Regression: NumPy arrays of float0 raised an error in a comparison."""

    def function(x):
        return jnp.argsort(x), x > 0.5, x**2

    values, tangents = lanes.jvp(function)((X,), (jnp.ones((2, *X.shape)),))
    expected, expected_tangents = jax.jvp(jax.vmap(function), (X,), (jnp.ones_like(X),))
    agree(values, expected)
    agree(tangents[2][0], expected_tangents[2])
    assert [(t.shape, t.dtype) for t in tangents[:2]] == [((2, *X.shape), jax.dtypes.float0)] * 2


@pytest.mark.parametrize("values", [jnp.array([-1.0, 0.0, 4.0]), jnp.array([[-1.0, -0.0], [1.0, 4.0], [0.0, 2.0]])])
def test_reverse_mode_of_lanes_ignores_branches_that_a_trial_does_not_take(values):
    """Regression: an infinite derivative of the other branch times zero gave NaN."""

    def root(v, factor):
        return lax.cond(jnp.sum(v) > 0.0, lambda: jnp.sum(jnp.sqrt(factor * jnp.abs(v))), lambda: jnp.sum(factor * v))

    def gradients(batched):
        return jax.grad(lambda v, a: jnp.sum(batched(root, (0, None))(v, a)), argnums=(0, 1))(
            values, 0.0 * values[0] + 1.0
        )

    for found, expected in zip(gradients(lanes.vmap), gradients(jax.vmap), strict=True):
        np.testing.assert_allclose(found, expected, rtol=1e-14)
