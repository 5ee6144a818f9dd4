"""Whole runs in one kernel: interpreted they are those of the scan, and they can be compiled for a GPU from here."""

from functools import partial

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from ptsmc_jax import scenario
from ptsmc_jax.batching import kernel, lanes
from ptsmc_jax.campaigns import montecarlo
from ptsmc_jax.simulation import catalogues
from tests.helpers import short
from tuning.search.gains import with_gains

SEED = 3
NUMBERS = np.arange(6, dtype=np.uint32)
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


# the level that is flown with, which `conftest` lowers: the last digits are that compiler's
AS_FLOWN = {"xla_backend_optimization_level": 3}


def both(function):
    """A kernel's results and those of the scan."""
    mapped = kernel.vmap(function, block=4, interpret=True), lanes.vmap(function)
    return [jax.jit(one, compiler_options=AS_FLOWN)(NUMBERS) for one in mapped]


def agree(function, unit):
    """A kernel's results within `unit` of the largest of each."""
    got, wanted = both(function)
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


@pytest.mark.parametrize("name", short(["flight", "chain", "continuous"], ["continuous"]))
def test_interpreted_it_is_the_scan(name):
    tables = {"flight": FLIGHT, "chain": CHAIN, "continuous": CONTINUOUS}[name]
    agree(primal(tables), 1e-12)


def test_values_and_slopes_taken_inside_are_those_of_the_scan():
    agree(derivative(CHAIN), 1e-12)


def test_in_single_precision_it_is_the_scan_of_single_precision():
    """To 1e-6 of what is rounded, states of 5 and the largest input; errors are small differences of these."""
    with jax.enable_x64(False):
        got, wanted = (flown.metrics._asdict() for flown in both(primal(CHAIN)))
    peak = float(wanted["peak_torque"].max())
    for name in catalogues.STATE_CATALOGUE:
        assert got[name].dtype == jnp.float32
        size = peak if name in ("peak_torque", "peak_torque_delivered", "effort", "chattering") else 5.0
        np.testing.assert_allclose(got[name], wanted[name], rtol=0.0, atol=1e-6 * size, err_msg=name)


LOWERED = [(32, primal), (32, derivative), (64, primal), (64, derivative)]


@pytest.mark.parametrize(("bits", "make"), short(LOWERED, LOWERED[3:4]))
def test_it_is_lowered_for_cuda_on_a_machine_without(bits, make):
    with jax.enable_x64(bits == 64):
        mapped = jax.jit(kernel.vmap(make(FLIGHT)))
        lowered = mapped.trace(jnp.arange(256, dtype=jnp.uint32)).lower(lowering_platforms=("cuda",)).as_text()
        assert "triton" in lowered


def test_a_batch_flown_by_kernel_is_the_batch():
    ready = scenario.study(scenario.from_tables(CHAIN))
    usual, own = (montecarlo.run(ready.parts, ready.dispersion, SEED, np.arange(10), kernel=k) for k in (False, True))
    np.testing.assert_array_equal(usual.status, own.status)
    for name, values in usual.metrics._asdict().items():
        np.testing.assert_allclose(getattr(own.metrics, name), values, rtol=1e-9, atol=1e-15, err_msg=name)
    for name, values in usual.drawn.items():
        np.testing.assert_array_equal(own.drawn[name], values)


def test_what_is_written_out_and_what_is_looped():
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
        own, _ = jax.lax.scan(lambda c, row: (c * 0.5 + row, None), jnp.zeros(()), x * table[:20])
        each = jax.lax.map(lambda row: jnp.abs(row - x / 6.0), table)  # carries nothing: written out too
        single = {"few": jnp.sum(few), "nearest": jnp.min(each), "same": table[3] * 2.0, "number": trial}
        return {**single, "last": last, "pairs": pairs, "own": own}

    arguments = NUMBERS, np.linspace(0.5, 1.5, 6)
    got = kernel.vmap(function, block=4, interpret=True)(*arguments)
    wanted = jax.vmap(function)(*arguments)
    for name, value in wanted.items():
        np.testing.assert_allclose(got[name], value, rtol=1e-15, err_msg=name)


NINE = np.arange(9, dtype=np.uint32)


@pytest.mark.parametrize(
    ("function", "said"),
    [
        (lambda n: jnp.stack([n, n]), "returns numbers for each trial"),
        (lambda n: jax.lax.while_loop(lambda v: v < 9, lambda v: v + 1, n), "no rule for the primitive `while`"),
        (lambda n: jnp.sum(jax.lax.scan(lambda c, _: (c + n, c), n, None, 100)[1]), "stacks no results of 100 steps"),
        (
            lambda n: jax.lax.scan(lambda c, k: (c + k, None), n, jnp.arange(9, dtype=n.dtype), reverse=True)[0],
            "forward",
        ),
    ],
)
def test_what_a_kernel_cannot_do_is_refused_by_name(function, said):
    with pytest.raises(NotImplementedError, match=said):
        kernel.vmap(function, block=4, interpret=True)(NUMBERS)
