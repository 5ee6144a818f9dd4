"""Expectations of JAX users: plain functions as parts, and the main names in the top-level package."""

import re
from dataclasses import replace
from functools import partial
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
import pytest

import ptsmc_jax as ptsmc
from ptsmc_jax import explore, scenario
from ptsmc_jax.dispersions.numbers import RandomNumbers
from ptsmc_jax.dispersions.variation import Dispersion
from ptsmc_jax.numerics import draws
from ptsmc_jax.numerics.pytrees import vector
from ptsmc_jax.plants import system
from ptsmc_jax.signals.disturbances import Sinusoid
from ptsmc_jax.signals.references import Fixed, Spin
from ptsmc_jax.simulation import catalogues
from tests.helpers import chain_parts, parts

WAVE = Sinusoid(*(vector(v) for v in ([0.01] * 3, [0.1] * 3, [0.0] * 3, [0.0] * 3)))


def test_plain_functions_can_be_disturbance_and_reference_under_jit():
    """The results equal those of the library's parts except for rounding."""
    still = Fixed(vector([0.0, 0.0, 0.0, 1.0]))

    def reference(t):
        return still(t)

    wave = parts(8.0, 3.0, 0.5, disturbance=WAVE, period=0.1, flight=True)
    plain = parts(8.0, 3.0, 0.5, disturbance=lambda t, x: 0.01 * jnp.sin(0.1 * t) * jnp.ones(3), reference=reference,
                  period=0.1, flight=True)  # fmt: skip
    expected, found = (ptsmc.simulate_parts(run, np.uint32(0), np.uint32(0)).metrics for run in (wave, plain))
    np.testing.assert_allclose(found.window_error, expected.window_error, rtol=1e-9)


class Push:
    """A callable that is not a pytree."""

    def __call__(self, t, x):
        """Return the wave of amplitude 0.1 for a chain (1,)."""
        return self.wave(0.1, t, x)

    def wave(self, size, t, x):
        """Return a wave (1,) of the amplitude `size`."""
        return size * jnp.sin(t) * jnp.ones(1)


def test_every_callable_can_be_a_disturbance():
    """An earlier version passed other callables to JAX as arrays, which ended in an error inside JAX."""
    push = Push()
    for called in (jax.jit(push), partial(push.wave, 0.1), push, push.__call__):
        run = chain_parts([1.0, 0.0], period=0.5, disturbance=called)
        assert jax.tree.leaves(run.disturbance) == []
        again = jax.tree.unflatten(jax.tree.structure(run), jax.tree.leaves(run))
        np.testing.assert_allclose(
            jax.jit(lambda run: run.disturbance(jnp.asarray(2.0), run.initial))(again), 0.1 * np.sin(2.0)
        )
    turning = jax.jit(lambda t: jnp.stack([0.0 * t, 0.0 * t, jnp.sin(0.01 * t), jnp.cos(0.01 * t)]))
    turned = jax.jit(lambda run: run.reference(jnp.asarray(7.0)).w)(parts(8.0, 3.0, 0.5, reference=turning))
    np.testing.assert_allclose(turned, [0.0, 0.0, 0.02], atol=1e-15)


def test_a_function_that_returns_a_quaternion_can_be_a_reference():
    """The quaternion can have any norm. A rotation about z at 0.02 rad/s equals `Spin`, whose rates are analytic."""
    turn = Spin(vector([0.0, 0.0, 0.0, 1.0]), vector([0.0, 0.0, 0.02]))

    def reference(t):
        return 2.0 * jnp.stack([0.0 * t, 0.0 * t, jnp.sin(0.01 * t), jnp.cos(0.01 * t)])

    plain = parts(8.0, 3.0, 0.5, reference=reference)
    for t in (0.0, 7.0):
        for found, expected in zip(plain.reference(jnp.asarray(t)), turn(jnp.asarray(t)), strict=True):
            np.testing.assert_allclose(found, expected, atol=1e-16)  # rounding of 0.02


def test_numbers_of_a_reference_function_are_leaves_of_the_parts():
    """docs/python.md allows this for any function. An earlier version took the quaternion for a Target."""

    def turning(rate, t):
        return jnp.stack([0.0 * t, 0.0 * t, jnp.sin(rate * t / 2.0), jnp.cos(rate * t / 2.0)])

    run = parts(8.0, 3.0, 0.5, reference=jax.tree_util.Partial(turning, vector(0.02)), period=0.1, flight=True)
    spin = Spin(vector([0.0, 0.0, 0.0, 1.0]), vector([0.0, 0.0, 0.02]))
    for found, expected in zip(run.reference(jnp.asarray(7.0)), spin(jnp.asarray(7.0)), strict=True):
        np.testing.assert_allclose(found, expected, atol=1e-16)
    slopes = jax.jacfwd(lambda run: run.reference(jnp.asarray(7.0)).w)(run).reference
    np.testing.assert_allclose(jax.tree.leaves(slopes), [[0.0, 0.0, 1.0]], atol=1e-15)


def test_invalid_attitudes_and_inertias_are_refused_in_one_sentence():
    wrong = parts(8.0, 3.0, 0.5, reference=lambda t: jnp.zeros(3))
    with pytest.raises(TypeError, match=r"must return a quaternion \(4,\), scalar last, or a Target"):
        wrong.reference(jnp.asarray(0.0))
    with pytest.raises(ValueError, match="the plant is a Chain, but with_inertia needs a spacecraft"):
        chain_parts([1.0, 0.0]).with_inertia([1.0, 1.0, 1.0])


def test_a_reference_function_can_return_a_list():
    plain = parts(8.0, 3.0, 0.5, reference=lambda t: [0.0, 0.0, jnp.sin(t), jnp.cos(t)])
    np.testing.assert_allclose(jax.jit(plain.reference)(jnp.asarray(1.0)).w, [0.0, 0.0, 2.0], atol=1e-15)


RUN = parts(8.0, 3.0, 0.5, disturbance=WAVE, period=0.1, flight=True)
CHAIN = chain_parts([1.0, 0.0])
LATE = system(1, lambda t, p, v: v, lambda t, p, v, z: z, lambda t, p, v: jnp.zeros((1, 1)),
              Z=lambda t, p, v, z, u: u - z, z0=[0.0])  # fmt: skip
FLIGHT = scenario.from_tables({})
API: Any = ptsmc  # hides the types, which forbid these arguments already
SPREAD = Dispersion({"initial_rate": RandomNumbers("normal", vector([0.1] * 3))})
PARTS, READ, DISPERSION = (
    "parts are needed, such as study",
    "a scenario is needed, as read",
    "a dispersion is needed, such as",
)
WHOLE = "but must be a whole number from"
# calls with invalid arguments, and the text of their errors
REFUSED = [
    (lambda: ptsmc.simulate_parts(replace(RUN, initial=RUN.initial._replace(w=jnp.zeros(4)))),
     r"initial.w must be an array \(3,\), but is one of shape \(4,\)"),
    (lambda: ptsmc.simulate_parts(replace(RUN, initial=RUN.initial._replace(q=[0.0, 0.0, 0.0, 1.0]))),
     r"initial.q must be an array \(4,\), but is of type list"),
    (lambda: ptsmc.simulate_parts(replace(RUN, initial=RUN.initial.q)),
     r"initial must be a state with q, w, such as parts.initial._replace\(q=...\)"),
    (lambda: ptsmc.simulate_parts(replace(CHAIN, plant=LATE)), r"initial must be an array \(3,\), .* of shape \(2,\)"),
    (lambda: ptsmc.simulate_parts(replace(RUN, disturbance=lambda t, x: jnp.zeros(4))),
     r"the disturbance.s value must be an array \(3,\), but is one of shape \(4,\)"),
    (lambda: ptsmc.simulate_parts(replace(RUN, disturbance=None)), r"must be a function of \(t, x\), but is None"),
    # an earlier version ran trial 0
    (lambda: ptsmc.simulate_parts(RUN, 0, trial=2**40), f"trial is 1099511627776, {WHOLE} 0 to"),
    (lambda: ptsmc.simulate_parts(RUN, 2**70), f"seed is 11805916207.*, {WHOLE} 0 to"),
    (lambda: ptsmc.simulate_parts(RUN, 0, trial=-1), f"trial is -1, {WHOLE} 0 to"),
    (lambda: API.one(RUN, SPREAD, 0, -1), f"is -1, {WHOLE} 0 to"),
    (lambda: draws.stream(0, np.int64(2**32), "rate"), f"a seed, trial or sample is 4294967296, {WHOLE} 0 to"),
    (lambda: ptsmc.simulate_parts(FLIGHT), PARTS),
    (lambda: API.gains_of(FLIGHT), PARTS),
    (lambda: API.with_gains(FLIGHT, {"eta": 3.0}), PARTS),
    (lambda: API.run(FLIGHT, None, 0, [1]), PARTS),
    (lambda: API.one(FLIGHT, None, 0, 1), PARTS),
    (lambda: API.write(RUN, "never.toml"), READ),
    (lambda: API.simulate(RUN), READ),
    (lambda: API.study({}), READ),
    (lambda: API.reach_of("file"), "a scenario is needed, as read .* but this is a str"),
    (lambda: API.from_tables([1]), r'tables are needed, such as \{"controller": \{"t_f": 35.0\}\}, but this is a list'),
    (lambda: API.study(FLIGHT, reach=2.0), r"a reach is needed, as reach_of\(scenario\) .* but this is a float"),
    (lambda: API.one(RUN, None, 0, 1), DISPERSION),
    (lambda: API.run(RUN, scenario.study(FLIGHT), 0, [1]), DISPERSION),
    (lambda: API.run(RUN, Dispersion(), 0, [1], block=0), f"block is 0, {WHOLE} 1 to"),
    (lambda: API.trials(FLIGHT, {"trial": [0, 1]}), "count is a dict, but must be a whole number, or a polars table"),
    (lambda: API.verdicts(FLIGHT, {}), "rows are needed in a polars DataFrame"),
    (lambda: API.export(FLIGHT, "never", trials=0), f"trials is 0, {WHOLE} 1 to"),
    (lambda: API.export(FLIGHT, "never", seed=-1), f"seed is -1, {WHOLE} 0 to"),
    (lambda: API.with_gains(RUN, {"eta": [3.0, 3.5, 4.0]}), r"eta must be a number, but has shape \(3,\)"),
    (lambda: API.with_gains(RUN, {"eta": "3"}), "eta is '3', but must be a number"),
    (lambda: API.with_gains(RUN, {"eta": None}), "eta is None, but must be a number"),
    (lambda: API.with_gains(RUN, {"eta": 3j}), "eta is 3j, but must be a number"),
    (lambda: API.with_gains(RUN, {"eta": jnp.nan}), "eta is nan, but must be a finite number"),
    (lambda: API.with_gains(RUN, [0.1]), r"gains are needed by name, such as \{'eta': 3.0\}, but this is a list"),
    (lambda: API.with_gains(RUN, {"layer_time": 1.0}),
     "layer_time is no gain of these parts, because it is declared by ptsmc_jax.number; allowed are delta, eta"),
    (lambda: API.chain(True), "order is True, but must be a whole number of at least 2"),
    (lambda: API.reach_of(FLIGHT, dlta=2.0), "there is no dlta in a reach; allowed are smallest_t_f, t_f, small"),
    (lambda: jax.eval_shape(lambda seed: draws.stream(seed, 0, "noise"), 0.5), "of type float64, but must be a whole"),
    (lambda: jax.eval_shape(lambda trial: draws.stream(0, trial, "noise"), jnp.arange(2)),
     r"a seed or trial is of shape \(2,\), but must be one number; use jax.vmap for several"),
    (lambda: API.one(RUN, SPREAD, 0, jnp.arange(3)), r"a seed or trial is of shape \(3,\), but must be one number"),
    (lambda: API.run(RUN, None, 0.5, [1]), f"seed is 0.5, {WHOLE} 0"),
    (lambda: API.run(RUN, None, -1, [1]), f"seed is -1, {WHOLE} 0 to"),
    (lambda: jax.eval_shape(lambda eta: ptsmc.replace(FLIGHT, controller__eta=eta).loop.t_end, 3.0),
     "controller.eta is traced by JAX, but must be known here; with_gains takes traced gains"),
]  # fmt: skip


@pytest.mark.parametrize(("call", "said"), REFUSED, ids=[said[:40] for _, said in REFUSED])
def test_invalid_arguments_are_refused_in_one_sentence(call, said):
    """Earlier, JAX raised an error inside, or a run had three different values of eta on the three axes."""
    with pytest.raises((TypeError, ValueError), match=said):
        call()


def test_an_initial_state_of_integers_or_single_precision_is_simulated():
    """Gains and weights of these types work too. An earlier version ended in an error about the carry of a scan."""
    q, w = jnp.asarray([0, 0, 1, 0]), RUN.initial.w.astype(jnp.float32)
    run = replace(RUN, initial=RUN.initial._replace(q=q, w=w))
    for record in (False, True):
        shapes = jax.eval_shape(lambda run, record=record: ptsmc.simulate_parts(run, record=record), run)
        assert shapes.metrics.window_error.dtype == float
    assert shapes.log.x.q.dtype == float


def test_study_and_replace_accept_the_path_of_a_scenario_file(tmp_path):
    (tmp_path / "s.toml").write_text("controller = { eta = 3.5 }")
    assert float(ptsmc.study(tmp_path / "s.toml").parts.controller.eta) == 3.5
    assert ptsmc.replace(str(tmp_path / "s.toml"), controller__eta=4.0).controller.eta == 4.0


def test_metrics_print_only_metrics_that_the_run_has():
    """An error names the existing metrics. A batch prints its shapes."""
    run = parts(8.0, 3.0, 0.5, disturbance=WAVE, period=0.1, flight=True)
    found = ptsmc.simulate_parts(run, np.uint32(0), np.uint32(0)).metrics
    shown = dict(line.split() for line in repr(found).splitlines())
    assert set(shown) == set(catalogues.CATALOGUES["spacecraft"]) & set(shown)
    assert {"window_error", "settling_time", "peak_momentum"} <= set(shown)
    assert not {"peak_wheel_torque", "ape_x", "peak_modal"} & set(shown)
    assert float(shown["window_error"]) == pytest.approx(float(found.window_error), rel=1e-5)
    never = repr(ptsmc.Metrics({**found, "settling_time": jnp.asarray(jnp.nan)}))
    assert re.search("settling_time +nan", never)  # a run that never settles
    with pytest.raises(AttributeError, match=r"there is no metric 'final_error'; this run has .*terminal_error"):
        found.final_error  # noqa: B018
    for named in (found, explore.Quantities(found, catalogues.CATALOGUE)):
        with pytest.raises(KeyError, match=r"no metric 'final_error', but it has .*terminal_error"):
            named["final_error"]
    many = jax.tree.map(lambda v: jnp.stack([v, v]), found)
    assert re.search(r"window_error +ArrayImpl \(2,\)", repr(many))
    jax.jit(lambda metrics: repr(metrics) and metrics)(found)


def test_parts_and_results_print_short_lines():
    """A history prints its shapes, since its numbers would fill hundreds of lines. Batches of metrics do the same."""
    shown = repr(RUN).splitlines()
    assert {"  disturbance: Sinusoid", "    amplitude: [0.01, 0.01, 0.01]", "    delta: 0.5"} <= set(shown)
    assert not any(": None" in line for line in shown)
    many = repr(jax.tree.map(lambda v: jnp.stack([v] * 4), RUN)).splitlines()
    assert {"    inertia: float64 (4, 3, 3)", "    delta: [0.5, 0.5, 0.5, 0.5]"} <= set(many)
    shapes = jax.eval_shape(lambda run: ptsmc.simulate_parts(run, record=True), RUN)
    assert re.search(r"    window_error +ShapeDtypeStruct\(shape=\(\), dtype=float64\)\n", repr(shapes))
    assert "  metrics:\n    terminal_error " in repr(shapes)
    log = jax.tree.map(lambda v: np.zeros(v.shape, v.dtype), shapes.log)
    assert {"  u: float64 (182, 3)", "    q: float64 (182, 4)"} <= set(repr(log).splitlines())
    jax.jit(lambda run: repr(run) and run.t_end)(RUN)
    given = replace(RUN, t_end=RUN.t_end + 0.0, window=jax.random.key(0))
    given.t_end.delete()  # like a donated argument
    assert {"  t_end: float64 ()", "  window: key<fry> ()"} <= set(repr(given).splitlines())


def test_repr_of_scenarios_and_studies_lists_their_tables():
    shown = repr(FLIGHT).splitlines()
    assert shown[0] == "SpacecraftScenario"
    assert any(line.startswith("  controller: PrescribedTime(t_f=30.0, ") for line in shown)
    assert not any("defaulted" in line or "=None" in line or line.startswith("  hardware") for line in shown)
    assert f"    {shown[1]}" in repr(scenario.study(FLIGHT))
