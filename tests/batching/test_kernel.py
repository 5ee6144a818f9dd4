"""Loops in one kernel: interpreted they are those of the scan, and they can be compiled for a GPU from here."""

import contextlib
import dataclasses
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
FLIGHT = {
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


def primal(tables):
    ready = scenario.study(scenario.from_tables(tables))
    return lambda trial: montecarlo.one(ready.parts, ready.dispersion, jnp.uint32(SEED), trial)


def derivative(tables):
    """Metrics and their slopes along eta."""
    ready = scenario.study(scenario.from_tables(tables))

    def of(eta, trial):
        parts = with_gains(ready.parts, {"eta": eta})
        return montecarlo.one(parts, ready.dispersion, jnp.uint32(SEED), trial).metrics

    eta = ready.parts.controller.eta
    return lambda trial: jax.jvp(partial(of, trial=trial), (eta,), (jnp.ones_like(eta),))


# the level that is flown with, for one of the tests; `conftest` lowers it, and programs compile in half the time
AS_FLOWN = {"xla_backend_optimization_level": 3}


@pytest.fixture(autouse=True)
def small_blocks(monkeypatch):
    monkeypatch.setattr(kernel, "BLOCK", 4)


@pytest.fixture
def kernels(monkeypatch):
    """How many steps each loop has that is flown as a kernel."""
    made, scan = [], kernel.scan

    def counted(params, *rest):
        results = scan(params, *rest)
        made.extend([] if results is None else [params["length"]])
        return results

    monkeypatch.setattr(kernel, "scan", counted)
    return made


def both(function, options=None):
    """A kernel's results and those of the scan."""
    mapped = lanes.vmap(function, kernel=True), lanes.vmap(function)
    return [jax.jit(one, compiler_options=options)(NUMBERS) for one in mapped]


def agree(function, unit, options=None):
    """A kernel's results within `unit` of the largest of each."""
    got, wanted = both(function, options)
    checked = 0
    for a, b in zip(jax.tree.leaves(got), jax.tree.leaves(wanted), strict=True):
        assert a.dtype == b.dtype
        a, b = np.asarray(a), np.asarray(b)
        np.testing.assert_array_equal(np.isfinite(a), np.isfinite(b))
        known = np.isfinite(b)
        if known.any():
            checked += 1
            scale = np.abs(b[known]).max()
            assert np.abs(a - b)[known].max() <= unit * max(scale, 1e-3)
    assert checked > 10


@pytest.mark.long  # the scan of a chain: `test_a_batch_flown_by_kernel_is_the_batch`
@pytest.mark.parametrize("name", ["flight", "chain", "continuous"])
def test_interpreted_it_is_the_scan(name, kernels):
    tables = {"flight": FLIGHT, "chain": CHAIN, "continuous": CONTINUOUS}[name]
    agree(primal(tables), 1e-12, AS_FLOWN)
    assert len(kernels) == 1


@pytest.mark.long  # slopes along one direction are those along several, below
def test_values_and_slopes_taken_inside_are_those_of_the_scan(kernels):
    agree(derivative(CHAIN), 1e-12)
    assert len(kernels) == 1


def test_slopes_along_several_directions_are_those_of_the_scan(kernels):
    """delta moves the times that the loop goes through, eta what it is given, the initial state each trial its own."""
    ready = scenario.study(scenario.from_tables({**CHAIN, "hardware": {}}))
    law = ready.parts.controller

    def of(gains, trial, x0):
        parts = with_gains(ready.parts, dict(zip(("eta", "delta"), gains, strict=True)))
        parts = dataclasses.replace(parts, initial=x0)
        return montecarlo.one(parts, variation.Dispersion(), jnp.uint32(SEED), trial).metrics

    gains, x0 = jnp.array([law.eta, law.delta]), jnp.linspace(0.5, 1.0, 12).reshape(6, 2)
    along = jnp.eye(3, 2), None, jnp.stack([0.0 * x0, 0.0 * x0, x0])
    got, wanted = (
        jax.jit(lanes.jvp(of, (None, 0, 0), kernel=whole))((gains, NUMBERS, x0), along) for whole in (True, False)
    )
    assert len(kernels) == 1
    for name, value in wanted[1].items():
        known = np.isfinite(value)
        found = np.asarray(getattr(got[1], name))
        np.testing.assert_array_equal(np.isfinite(found), known, err_msg=name)
        for k in range(3):
            size = np.abs(value[k][known[k]]).max(initial=1e-3)
            assert np.abs(found - value)[k][known[k]].max(initial=0.0) <= 1e-11 * size, (name, k)
    assert all(np.abs(np.asarray(wanted[1].window_error[k])).min() > 1e-9 for k in range(3))


def test_in_single_precision_it_is_the_scan_of_single_precision():
    """To 1e-6 of what is rounded, states of 5 and the largest input; errors are small differences of these."""
    with jax.enable_x64(False):
        got, wanted = (flown.metrics for flown in both(primal(CHAIN)))
    peak = float(wanted["peak_torque"].max())
    for name in catalogues.STATE_CATALOGUE:
        assert got[name].dtype == jnp.float32
        size = peak if name in ("peak_torque", "peak_torque_delivered", "effort", "chattering") else 5.0
        np.testing.assert_allclose(got[name], wanted[name], rtol=0.0, atol=1e-6 * size, err_msg=name)


def lowered(function, arguments, monkeypatch):
    """Its trace, and the text of what it becomes for CUDA."""
    monkeypatch.setattr(configure, "devices", gpus)
    monkeypatch.setattr(kernel, "BLOCK", 128)
    with on_a_gpu():
        trace = jax.jit(lanes.vmap(function, kernel=True)).trace(arguments)
        return trace, trace.lower(lowering_platforms=("cuda",)).as_text()


LOWERED = [(32, primal), (32, derivative), (64, primal), (64, derivative)]


@pytest.mark.parametrize(("bits", "make"), short(LOWERED, LOWERED[3:4]))
@pytest.mark.filterwarnings("ignore:The Pallas Triton backend is deprecated:DeprecationWarning")
def test_it_is_lowered_for_cuda_on_a_machine_without(bits, make, monkeypatch):
    """Components are read and written by few loads and stores: each takes its compiler through the whole kernel."""
    with jax.enable_x64(bits == 64):
        trace, text = lowered(make(FLIGHT), jnp.arange(256, dtype=jnp.uint32), monkeypatch)
    assert "triton" in text
    (flown,) = (eqn for eqn in equations(trace) if eqn.primitive.name == "pallas_call")
    moved = [eqn for eqn in equations(flown.params["jaxpr"]) if eqn.primitive.name in ("get", "swap")]
    vectors = [eqn.primitive.name for eqn in moved if eqn.outvars[0].aval.shape]
    assert 1 <= vectors.count("get") <= 3
    assert 1 <= vectors.count("swap") <= 3


def test_a_batch_flown_by_kernel_is_the_batch():
    ready = scenario.study(scenario.from_tables(CHAIN))
    usual, own = (montecarlo.run(ready.parts, ready.dispersion, SEED, np.arange(10), kernel=k) for k in (False, True))
    np.testing.assert_array_equal(usual.status, own.status)
    for name, values in usual.metrics.items():
        np.testing.assert_allclose(getattr(own.metrics, name), values, rtol=1e-9, atol=1e-15, err_msg=name)
    for name, values in usual.drawn.items():
        np.testing.assert_array_equal(own.drawn[name], values)


def limited(c, n):
    """Of numbers that are NaN in one trial, in none, and in all; and of truths."""
    wild, none = jnp.stack([c, 1.0 / (n - 3.0) * 0.0, 0.5 * c]), jnp.where(c > -9.0, jnp.nan, c)
    pairs = jnp.maximum(wild[1], c) + jnp.minimum(none, c), jnp.clip(wild[1], -1.0, 1.0) + jnp.max(wild)
    folds = jnp.min(wild), jax.lax.cummax(wild)[2], jax.lax.cummin(wild, reverse=True)[0], jax.lax.clamp(0.0, c, 9.0)
    truths = jnp.maximum(c > 2.0, n > 3) & ~jnp.minimum(c > 2.0, n > 3)
    return jnp.stack([*pairs, *folds, truths + jnp.max(jnp.stack([0.1 * c, n.astype(float)]))])


@pytest.mark.filterwarnings("ignore:The Pallas Triton backend is deprecated:DeprecationWarning")
def test_extremes_keep_what_is_not_a_number(kernels, monkeypatch):
    """Triton's own maximum of NaN and 1 is 1, where this machine's is NaN."""

    def function(n):
        start = jnp.ones(7) * n
        return jax.lax.scan(lambda c, k: (jnp.where(k < 8.0, 0.5 * c, limited(c[0], n)), None), start, jnp.arange(9.0))[
            0
        ]

    same(jax.jit(lanes.vmap(function, kernel=True))(NUMBERS), jax.jit(jax.vmap(function))(NUMBERS))
    trace, text = lowered(function, NUMBERS, monkeypatch)
    (flown,) = (eqn for eqn in equations(trace) if eqn.primitive.name == "pallas_call")
    used = {eqn.primitive.name for eqn in equations(flown.params["jaxpr"])}
    assert "triton" in text
    assert not used & {"max", "min", "clamp"}


def on_a_gpu():
    """Lowering from jax 0.11 on asks for which one."""
    if not hasattr(jax.sharding, "AbstractDevice"):
        return contextlib.nullcontext()
    device = jax.sharding.AbstractDevice(device_kind="NVIDIA H200", num_cores=None, platform="gpu")
    kind = jax.sharding.AxisType.Auto
    return jax.sharding.use_abstract_mesh(jax.sharding.AbstractMesh((1,), ("x",), (kind,), abstract_device=device))


def test_what_is_written_out_and_what_is_looped(kernels):
    """Short loops that stack, long ones that go through a table, branches by trial and by step, what all share."""
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
        own, _ = jax.lax.scan(lambda c, row: (c * 0.5 + row, None), jnp.zeros(()), x * table[:20])  # no kernel's

        def around(carry, row):
            within = jax.lax.scan(lambda c, r: (c + jnp.sin(r * x) * row, None), carry, table[:12])[0]
            return 0.5 * within + jax.lax.map(lambda r: r * x, table[:9])[3], row > 0.5

        nested = jax.lax.scan(lambda c, r: (around(c, r)[0], None), x, table[:20])[0]
        flags = jax.lax.scan(lambda c, r: ((~c[0] | (c[1] > x), c[1] + 1), None), (x > 2.0, 0 * trial), table[:15])[0]
        each = jax.lax.map(lambda row: jnp.abs(row - x / 6.0), table)  # carries nothing: written out too
        single = {"few": jnp.sum(few), "nearest": jnp.min(each), "same": table[3] * 2.0, "number": trial}
        return {**single, "last": last, "pairs": pairs, "own": own, "nested": nested, "flags": flags}

    arguments = NUMBERS, np.linspace(0.5, 1.5, 6)
    got = jax.jit(lanes.vmap(function, kernel=True))(*arguments)
    wanted = jax.jit(jax.vmap(function))(*arguments)
    assert sorted(kernels) == [15, 20, 50, 100]
    same(got, wanted)


def same(got, wanted):
    for (where, a), b in zip(jax.tree.leaves_with_path(got), jax.tree.leaves(wanted), strict=True):
        assert (a.shape, a.dtype) == (b.shape, b.dtype)
        np.testing.assert_allclose(a, b, rtol=1e-14, err_msg=jax.tree_util.keystr(where))


def forward(step, length=9):
    return lambda n: jax.lax.scan(lambda c, k: (step(c, n), None), n.astype(float), None, length)[0]


def beside(*values):
    """Loops that carry one of these beside a number, and let it differ from trial to trial or not."""

    def function(n):
        def of(value, own):
            def step(carry, _):
                return (carry[0] + n.astype(value.dtype) if own else carry[0], 0.5 * carry[1] + n), None

            return jax.lax.scan(step, (value, n.astype(float)), None, 9)[0]

        return [of(value, own) for value in values for own in (False, True)]

    return function


@pytest.mark.parametrize(
    "function",
    [
        beside(jnp.zeros(0), jnp.zeros((3, 0), jnp.int32)),
        forward(lambda c, n: c + jnp.sum(jnp.zeros((2, 0)) * n) + jnp.prod(jnp.zeros(0, bool))),
        forward(lambda c, n: c + jnp.sum(jax.lax.map(lambda x: x * n, jnp.zeros(0)))),
    ],
    ids="carried reduced mapped".split(),
)
def test_arrays_without_entries_are_carried_and_summed(function, kernels):
    same(jax.jit(lanes.vmap(function, kernel=True))(NUMBERS), jax.jit(jax.vmap(function))(NUMBERS))
    assert set(kernels) == {9}


@pytest.mark.parametrize(
    "function",
    [
        forward(lambda c, n: c + 1.0, 8),
        lambda n: jnp.sum(jax.lax.scan(lambda c, _: (c + n, c), n, None, 100)[1]),
        lambda n: jax.lax.scan(lambda c, k: (c + k, None), n, jnp.arange(9, dtype=n.dtype), reverse=True)[0],
        lambda n: jax.lax.scan(lambda c, k: (c + k, None), 0.0, n * jnp.arange(9.0))[0],
        lambda n: jax.lax.scan(lambda c, k: (c + k, None), 0.0, jnp.arange(9.0))[0] + n,
    ],
    ids="short stacked backward through alike".split(),
)
def test_what_is_no_work_for_a_kernel_stays_a_scan(function, kernels):
    np.testing.assert_allclose(lanes.vmap(function, kernel=True)(NUMBERS), jax.vmap(function)(NUMBERS), rtol=1e-14)
    assert kernels == []


def test_a_loop_of_no_trials_stays_a_scan(kernels):
    function = forward(lambda c, n: 0.5 * c + n)
    same(lanes.vmap(function, kernel=True)(NUMBERS[:0]), jax.vmap(function)(NUMBERS[:0]))
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
def test_what_has_another_form_for_its_compiler(step, kernels, monkeypatch):
    function = forward(step)
    same(jax.jit(lanes.vmap(function, kernel=True))(NUMBERS), jax.jit(jax.vmap(function))(NUMBERS))
    assert "triton" in lowered(function, NUMBERS, monkeypatch)[1]
    assert kernels == [9, 9]


@pytest.mark.parametrize(
    ("step", "said"),
    [
        (lambda c, n: jax.lax.while_loop(lambda v: v < 9.0, lambda v: v + 1.0, c), "no rule for the primitive `while`"),
        (lambda c, n: jnp.sum(jax.lax.scan(lambda v, _: (v + n, v), c, None, 300)[1]), "no results of 300 steps"),
        (lambda c, n: jax.lax.scan(lambda v, k: (v + k, None), c, jnp.arange(9.0), reverse=True)[0], "run forward"),
        (lambda c, n: jax.lax.erf(c), "compiler lacks the primitive `erf`"),
        (lambda c, n: c + jax.lax.erf_inv(0.1 * n), "compiler lacks the primitive `erf_inv`"),
        (lambda c, n: (jax.debug.callback(lambda: None), 0.5 * c + n)[1], "no rule for the primitive `debug_callback`"),
        (lambda c, n: 0.5 * c + n.astype(jnp.float16), "nothing of the type float16"),
        (lambda c, n: 0.5 * c + jax.random.uniform(KEY) + n, "nothing of the type key<fry>"),
        (lambda c, n: jnp.sort(jnp.stack([c, 1.0 - c]))[0], "no rule for the primitive `sort`"),
        (lambda c, n: c + jnp.sum(jnp.ones((33, 33)) * n, axis=(0, 1)), "no rule for the primitive"),
    ],
    ids="while stacked backward erf inverse told type key sort large".split(),
)
def test_what_a_kernel_cannot_do_is_told_and_flown_step_by_step(step, said, kernels, monkeypatch):
    monkeypatch.setattr(configure, "devices", gpus)  # interpreted there would be an error function
    function = forward(step)
    with pytest.warns(lanes.LanesWarning, match=f"step by step, which may be slow: .*{said}"):
        got = lanes.vmap(function, kernel=True)(NUMBERS)
    np.testing.assert_allclose(got, jax.vmap(function)(NUMBERS), rtol=1e-14)
    assert kernels == []
