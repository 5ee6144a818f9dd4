"""Loops in one kernel: interpreted, they equal a scan, and they can be lowered for a GPU on a machine without one."""

import contextlib
import dataclasses
import itertools
from functools import partial

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from ptsmc_jax import configure, scenario
from ptsmc_jax.batching import kernel, lanes
from ptsmc_jax.campaigns import montecarlo
from ptsmc_jax.dispersions import variation
from ptsmc_jax.simulation import catalogues
from tests.helpers import equations, gpus, short
from tuning.search.gains import with_gains

SEED = 3
NUMBERS = np.arange(6, dtype=np.uint32)
KEY = jax.random.key(0)
SPACECRAFT = {
    "plant": {"kind": "spacecraft"},
    "controller": {"t_f": 5.0, "delta": 0.5},
    "loop": {"mode": "sampled", "period": 0.25, "t_end": 6.5},
    "hardware": {"attitude_noise": 2e-5, "rate_noise": 1e-6, "torque_limit": 40.0},
    "dispersion": {
        "attitude": {"kind": "axis_angle", "min_deg": 20.0, "max_deg": 140.0},
        "disturbance_phase": {"kind": "uniform"},
    },
}
CHAIN = {
    "plant": {"kind": "chain", "order": 2},
    "controller": {"t_f": 5.0, "delta": 0.5},
    "loop": {"mode": "sampled", "period": 0.25, "t_end": 6.5},
    "hardware": {"state_noise": [1e-4, 1e-4]},
    "dispersion": {"x0": {"kind": "uniform"}},
}
CONTINUOUS = {
    **CHAIN,
    "loop": {"t_end": 6.5},
    "hardware": {},
    "controller": {"t_f": 5.0, "delta": 0.5, "sign_width": 0.1},
}


def metrics_of_trial(tables):
    """Return a function from a trial number to the `Simulated` of that trial; tables: of the scenario."""
    ready = scenario.study(scenario.from_tables(tables))
    return lambda trial: montecarlo.one(ready.parts, ready.dispersion, jnp.uint32(SEED), trial)


def metrics_and_derivatives(tables):
    """Return a function from a trial number to (metrics, their derivatives by eta); tables: of the scenario."""
    ready = scenario.study(scenario.from_tables(tables))

    def metrics(eta, trial):
        parts = with_gains(ready.parts, {"eta": eta})
        return montecarlo.one(parts, ready.dispersion, jnp.uint32(SEED), trial).metrics

    eta = ready.parts.controller.eta
    return lambda trial: jax.jvp(partial(metrics, trial=trial), (eta,), (jnp.ones_like(eta),))


# the optimisation level of normal runs, for one test; `conftest` sets a lower level, which halves compile times
FULL_OPTIMISATION = {"xla_backend_optimization_level": 3}


@pytest.fixture(autouse=True)
def small_blocks(monkeypatch):
    """Set the block size of the kernel to 4 trials, so that six trials need two blocks."""
    monkeypatch.setattr(kernel, "BLOCK", 4)


@pytest.fixture
def kernels(monkeypatch):
    """Return a list, which receives the number of steps of each loop that runs as a kernel."""
    lengths, scan = [], kernel.scan

    def recorded(params, *rest):
        results = scan(params, *rest)
        lengths.extend([] if results is None else [params["length"]])
        return results

    monkeypatch.setattr(kernel, "scan", recorded)
    return lengths


def with_and_without_kernel(function, options=None):
    """Return a list of two results for the trials `NUMBERS`: of a kernel and of a scan.

    function: of a trial number. options: of the compiler.
    """
    mapped = lanes.vmap(function, kernel=True), lanes.vmap(function)
    return [jax.jit(one, compiler_options=options)(NUMBERS) for one in mapped]


def check_kernel(function, tolerance, options=None):
    """Check that kernel and scan agree within a tolerance relative to the largest value of each result.

    The arguments `function` and `options` are those of `with_and_without_kernel`.
    """
    got, expected = with_and_without_kernel(function, options)
    checked = 0
    for a, b in zip(jax.tree.leaves(got), jax.tree.leaves(expected), strict=True):
        assert a.dtype == b.dtype
        a, b = np.asarray(a), np.asarray(b)
        np.testing.assert_array_equal(np.isfinite(a), np.isfinite(b))
        finite = np.isfinite(b)
        if finite.any():
            checked += 1
            scale = np.abs(b[finite]).max()
            assert np.abs(a - b)[finite].max() <= tolerance * max(scale, 1e-3)
    assert checked > 10


@pytest.mark.long  # short test with a chain: `test_trials_simulated_with_a_kernel_equal_trials_without`
@pytest.mark.parametrize("name", ["spacecraft", "chain", "continuous"])
def test_simulation_in_an_interpreted_kernel_equals_a_scan(name, kernels):
    tables = {"spacecraft": SPACECRAFT, "chain": CHAIN, "continuous": CONTINUOUS}[name]
    check_kernel(metrics_of_trial(tables), 1e-12, FULL_OPTIMISATION)
    assert len(kernels) == 1


def test_derivatives_in_a_kernel_along_several_directions_equal_a_scan(kernels):
    """delta changes the sample times, eta a parameter of the loop, and the initial state differs by trial."""
    ready = scenario.study(scenario.from_tables({**CHAIN, "hardware": {}}))
    law = ready.parts.controller

    def metrics(gains, trial, x0):
        parts = with_gains(ready.parts, dict(zip(("eta", "delta"), gains, strict=True)))
        parts = dataclasses.replace(parts, initial=x0)
        return montecarlo.one(parts, variation.Dispersion(), jnp.uint32(SEED), trial).metrics

    gains, x0 = jnp.array([law.eta, law.delta]), jnp.linspace(0.5, 1.0, 12).reshape(6, 2)
    along = jnp.eye(3, 2), None, jnp.stack([0.0 * x0, 0.0 * x0, x0])
    got, expected = (
        jax.jit(lanes.jvp(metrics, (None, 0, 0), kernel=kernel))((gains, NUMBERS, x0), along)
        for kernel in (True, False)
    )
    assert len(kernels) == 1
    for name, value in expected[1].items():
        finite = np.isfinite(value)
        found = np.asarray(getattr(got[1], name))
        np.testing.assert_array_equal(np.isfinite(found), finite, err_msg=name)
        for k in range(3):
            size = np.abs(value[k][finite[k]]).max(initial=1e-3)
            assert np.abs(found - value)[k][finite[k]].max(initial=0.0) <= 1e-11 * size, (name, k)
    assert all(np.abs(np.asarray(expected[1].window_error[k])).min() > 1e-9 for k in range(3))


def test_kernel_equals_scan_in_single_precision():
    """The tolerance is relative to the rounded numbers, states of 5 and the largest input."""
    with jax.enable_x64(False):
        got, expected = (run.metrics for run in with_and_without_kernel(metrics_of_trial(CHAIN)))
    peak = float(expected["peak_torque"].max())
    for name in catalogues.STATE_CATALOGUE:
        assert got[name].dtype == jnp.float32
        size = peak if name in ("peak_torque", "peak_torque_delivered", "effort", "chattering") else 5.0
        np.testing.assert_allclose(got[name], expected[name], rtol=0.0, atol=1e-6 * size, err_msg=name)


def lower_for_cuda(function, arguments, monkeypatch):
    """Return the trace of a batch with kernels, and its text after lowering for CUDA.

    function: of one trial. arguments: of all trials, along the first axis.
    """
    monkeypatch.setattr(configure, "devices", gpus)
    monkeypatch.setattr(kernel, "BLOCK", 128)
    with abstract_gpu():
        trace = jax.jit(lanes.vmap(function, kernel=True)).trace(arguments)
        return trace, trace.lower(lowering_platforms=("cuda",)).as_text()


LOWERED = list(itertools.product((32, 64), (metrics_of_trial, metrics_and_derivatives)))


@pytest.mark.parametrize(("bits", "make"), short(LOWERED, LOWERED[3:4]))
@pytest.mark.filterwarnings("ignore:The Pallas Triton backend is deprecated:DeprecationWarning")
def test_kernel_is_lowered_for_cuda_with_few_loads_and_stores(bits, make, monkeypatch):
    """Compile time grows with each load and store of components. The test needs no GPU."""
    with jax.enable_x64(bits == 64):
        trace, text = lower_for_cuda(make(SPACECRAFT), jnp.arange(256, dtype=jnp.uint32), monkeypatch)
    assert "triton" in text
    (call,) = (eqn for eqn in equations(trace) if eqn.primitive.name == "pallas_call")
    moved = [eqn for eqn in equations(call.params["jaxpr"]) if eqn.primitive.name in ("get", "swap")]
    vectors = [eqn.primitive.name for eqn in moved if eqn.outvars[0].aval.shape]
    assert 1 <= vectors.count("get") <= 3
    assert 1 <= vectors.count("swap") <= 3


def test_trials_simulated_with_a_kernel_equal_trials_without():
    ready = scenario.study(scenario.from_tables(CHAIN))
    without, with_kernel = (
        montecarlo.run(ready.parts, ready.dispersion, SEED, np.arange(10), kernel=k) for k in (False, True)
    )
    np.testing.assert_array_equal(without.status, with_kernel.status)
    for name, values in without.metrics.items():
        np.testing.assert_allclose(getattr(with_kernel.metrics, name), values, rtol=1e-9, atol=1e-15, err_msg=name)
    for name, values in without.drawn.items():
        np.testing.assert_array_equal(with_kernel.drawn[name], values)


def extremes(c, n):
    """Return maxima, minima and clipped values (7,) of booleans and of numbers that may be NaN; c, n: scalars."""
    wild, none = jnp.stack([c, 1.0 / (n - 3.0) * 0.0, 0.5 * c]), jnp.where(c > -9.0, jnp.nan, c)
    pairs = jnp.maximum(wild[1], c) + jnp.minimum(none, c), jnp.clip(wild[1], -1.0, 1.0) + jnp.max(wild)
    folds = jnp.min(wild), jax.lax.cummax(wild)[2], jax.lax.cummin(wild, reverse=True)[0], jax.lax.clamp(0.0, c, 9.0)
    booleans = jnp.maximum(c > 2.0, n > 3) & ~jnp.minimum(c > 2.0, n > 3)
    return jnp.stack([*pairs, *folds, booleans + jnp.max(jnp.stack([0.1 * c, n.astype(float)]))])


@pytest.mark.filterwarnings("ignore:The Pallas Triton backend is deprecated:DeprecationWarning")
def test_maxima_and_minima_in_a_kernel_propagate_nan(kernels, monkeypatch):
    """The maximum of NaN and 1 is 1 in Triton, but NaN in XLA."""

    def function(n):
        start = jnp.ones(7) * n
        return jax.lax.scan(
            lambda c, k: (jnp.where(k < 8.0, 0.5 * c, extremes(c[0], n)), None), start, jnp.arange(9.0)
        )[0]

    check_equal(jax.jit(lanes.vmap(function, kernel=True))(NUMBERS), jax.jit(jax.vmap(function))(NUMBERS))
    trace, text = lower_for_cuda(function, NUMBERS, monkeypatch)
    (call,) = (eqn for eqn in equations(trace) if eqn.primitive.name == "pallas_call")
    used = {eqn.primitive.name for eqn in equations(call.params["jaxpr"])}
    assert "triton" in text
    assert not used & {"max", "min", "clamp"}


def abstract_gpu():
    """Return a context manager with an abstract GPU, which jax needs from 0.11 on to lower for a GPU."""
    if not hasattr(jax.sharding, "AbstractDevice"):
        return contextlib.nullcontext()
    device = jax.sharding.AbstractDevice(device_kind="NVIDIA H200", num_cores=None, platform="gpu")
    kind = jax.sharding.AxisType.Auto
    return jax.sharding.use_abstract_mesh(jax.sharding.AbstractMesh((1,), ("x",), (kind,), abstract_device=device))


def test_kernel_supports_nested_loops_branches_and_shared_values(kernels):
    """Short loops are unrolled and may stack results. Long loops iterate over tables. Branches are by trial or step.

    A loop over a table that differs by trial does not run as a kernel.
    """
    table = jnp.linspace(0.0, 1.0, 100)

    def function(trial, weight):
        x = trial.astype(float)
        _, few = jax.lax.scan(lambda c, k: (c + k, c * x), jnp.zeros(()), jnp.arange(3.0))

        def step(carry, row):
            early = jax.lax.cond(row < 0.5, lambda: carry + row * weight, lambda: carry - x)
            late = jax.lax.cond(x > 2.0, lambda: early, lambda: 0.5 * early)
            return late, None

        last, _ = jax.lax.scan(step, x, table)
        pairs, _ = jax.lax.scan(lambda c, row: (0.9 * c + row[1] * x - row[0], None), x, table.reshape(50, 2))
        # not run as a kernel
        batched_rows, _ = jax.lax.scan(lambda c, row: (c * 0.5 + row, None), jnp.zeros(()), x * table[:20])

        def outer(carry, row):
            within = jax.lax.scan(lambda c, r: (c + jnp.sin(r * x) * row, None), carry, table[:12])[0]
            return 0.5 * within + jax.lax.map(lambda r: r * x, table[:9])[3], row > 0.5

        nested = jax.lax.scan(lambda c, r: (outer(c, r)[0], None), x, table[:20])[0]
        flags = jax.lax.scan(lambda c, r: ((~c[0] | (c[1] > x), c[1] + 1), None), (x > 2.0, 0 * trial), table[:15])[0]
        each = jax.lax.map(lambda row: jnp.abs(row - x / 6.0), table)  # no carry: unrolled as well
        single = {"few": jnp.sum(few), "nearest": jnp.min(each), "same": table[3] * 2.0, "number": trial}
        return {**single, "last": last, "pairs": pairs, "batched rows": batched_rows, "nested": nested, "flags": flags}

    arguments = NUMBERS, np.linspace(0.5, 1.5, 6)
    got = jax.jit(lanes.vmap(function, kernel=True))(*arguments)
    expected = jax.jit(jax.vmap(function))(*arguments)
    assert sorted(kernels) == [15, 20, 50, 100]
    check_equal(got, expected)


def check_equal(got, expected):
    """Assert that two pytrees have equal shapes and dtypes, and numbers equal to a relative 1e-14."""
    for (path, a), b in zip(jax.tree.leaves_with_path(got), jax.tree.leaves(expected), strict=True):
        assert (a.shape, a.dtype) == (b.shape, b.dtype)
        np.testing.assert_allclose(a, b, rtol=1e-14, err_msg=jax.tree_util.keystr(path))


def loop(step, length=9):
    """Return a function of a trial number n: the last carry of `length` calls of step(carry, n), which start at n."""
    return lambda n: jax.lax.scan(lambda c, k: (step(c, n), None), n.astype(float), None, length)[0]


def loops_with_carries(*values):
    """Return a function of a trial number that returns the last carries (value, number) of two loops for each value.

    The first loop keeps the value. The second loop adds the trial number to it in each step.
    """

    def function(n):
        def run(value, by_trial):
            def step(carry, _):
                return (carry[0] + n.astype(value.dtype) if by_trial else carry[0], 0.5 * carry[1] + n), None

            return jax.lax.scan(step, (value, n.astype(float)), None, 9)[0]

        return [run(value, by_trial) for value in values for by_trial in (False, True)]

    return function


@pytest.mark.parametrize(
    "function",
    [
        loops_with_carries(jnp.zeros(0), jnp.zeros((3, 0), jnp.int32)),
        loop(lambda c, n: c + jnp.sum(jnp.zeros((2, 0)) * n) + jnp.prod(jnp.zeros(0, bool))),
        loop(lambda c, n: c + jnp.sum(jax.lax.map(lambda x: x * n, jnp.zeros(0)))),
    ],
    ids="carried reduced mapped".split(),
)
def test_kernel_supports_empty_arrays(function, kernels):
    check_equal(jax.jit(lanes.vmap(function, kernel=True))(NUMBERS), jax.jit(jax.vmap(function))(NUMBERS))
    assert set(kernels) == {9}


@pytest.mark.parametrize(
    "function",
    [
        loop(lambda c, n: c + 1.0, 8),
        lambda n: jnp.sum(jax.lax.scan(lambda c, _: (c + n, c), n, None, 100)[1]),
        lambda n: jax.lax.scan(lambda c, k: (c + k, None), n, jnp.arange(9, dtype=n.dtype), reverse=True)[0],
        lambda n: jax.lax.scan(lambda c, k: (c + k, None), 0.0, n * jnp.arange(9.0))[0],
        lambda n: jax.lax.scan(lambda c, k: (c + k, None), 0.0, jnp.arange(9.0))[0] + n,
    ],
    ids="short stacked backward through alike".split(),
)
def test_loops_that_are_unsuitable_for_a_kernel_run_as_scans(function, kernels):
    """They are short or backward, stack many results, have rows that differ by trial, or are alike in all trials."""
    np.testing.assert_allclose(lanes.vmap(function, kernel=True)(NUMBERS), jax.vmap(function)(NUMBERS), rtol=1e-14)
    assert kernels == []


def test_loop_over_no_trials_runs_as_a_scan_and_not_as_a_kernel(kernels):
    function = loop(lambda c, n: 0.5 * c + n)
    check_equal(lanes.vmap(function, kernel=True)(NUMBERS[:0]), jax.vmap(function)(NUMBERS[:0]))
    assert kernels == []


@pytest.mark.parametrize(
    "step",
    [
        lambda c, n: jax.lax.switch(n.astype(jnp.int32), [lambda: c, lambda: 0.5 * c, lambda: -c]),
        lambda c, n: jax.lax.select_n(n.astype(jnp.int32) % 3, c, 0.5 * c, -c),
        lambda c, n: (
            c
            + n * jax.lax.scan(lambda v, k: (jax.lax.cond(k > 2, lambda: v, lambda: 0.5), None), 1.0, jnp.arange(9))[0]
        ),
        lambda c, n: c + jax.lax.scan(lambda v, k: ((0.5, v[0], v[1] * n), None), (1.0, 2.0, c), None, 9)[0][2],
        lambda c, n: 0.5 * c + n * jnp.square(0.3) + jnp.sum(-jnp.arange(3.0)),
    ],
    ids="switch choice known carried constant".split(),
)
@pytest.mark.filterwarnings("ignore:The Pallas Triton backend is deprecated:DeprecationWarning")
def test_kernel_replaces_constructs_that_triton_lacks(step, kernels, monkeypatch):
    """They are switch, selection among three values, and nested loops with known or constant carries."""
    function = loop(step)
    check_equal(jax.jit(lanes.vmap(function, kernel=True))(NUMBERS), jax.jit(jax.vmap(function))(NUMBERS))
    assert "triton" in lower_for_cuda(function, NUMBERS, monkeypatch)[1]
    assert kernels == [9, 9]


@pytest.mark.parametrize(
    ("step", "message"),
    [
        (lambda c, n: jax.lax.while_loop(lambda v: v < 9.0, lambda v: v + 1.0, c), "no rule for the primitive `while`"),
        (lambda c, n: jnp.sum(jax.lax.scan(lambda v, _: (v + n, v), c, None, 300)[1]), "results of 300 steps"),
        (lambda c, n: jax.lax.scan(lambda v, k: (v + k, None), c, jnp.arange(9.0), reverse=True)[0], "backward"),
        (lambda c, n: jax.lax.erf(c), "compiler lacks the primitive `erf`"),
        (lambda c, n: c + jax.lax.erf_inv(0.1 * n), "compiler lacks the primitive `erf_inv`"),
        (lambda c, n: (jax.debug.callback(lambda: None), 0.5 * c + n)[1], "no rule for the primitive `debug_callback`"),
        (lambda c, n: 0.5 * c + n.astype(jnp.float16), "values of the type float16"),
        (lambda c, n: 0.5 * c + jax.random.uniform(KEY) + n, "values of the type key<fry>"),
        (lambda c, n: jnp.sort(jnp.stack([c, 1.0 - c]))[0], "no rule for the primitive `sort`"),
        (lambda c, n: c + jnp.sum(jnp.ones((33, 33)) * n, axis=(0, 1)), "no rule for the primitive"),
    ],
    ids="while stacked backward erf inverse callback type key sort large".split(),
)
def test_loops_that_a_kernel_does_not_support_warn_and_run_as_scans(step, message, kernels, monkeypatch):
    monkeypatch.setattr(configure, "devices", gpus)  # an interpreted kernel would support erf
    function = loop(step)
    with pytest.warns(lanes.LanesWarning, match=f"step by step, which may be slow: .*{message}"):
        got = lanes.vmap(function, kernel=True)(NUMBERS)
    np.testing.assert_allclose(got, jax.vmap(function)(NUMBERS), rtol=1e-14)
    assert kernels == []
