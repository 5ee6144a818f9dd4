"""Every part in short runs: equal results in lanes, vmap and loop, constant shapes, finite gradients at special points.

Each row is a scenario. Together the rows contain every part that a scenario or Python can name. A new law gets its own
row, and another new part joins a row.
"""

import contextlib
import itertools
from dataclasses import replace
from functools import partial
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from ptsmc_jax import configure, programs, scenario
from ptsmc_jax.batching import lanes
from ptsmc_jax.campaigns import montecarlo, runs
from ptsmc_jax.dispersions import variation
from ptsmc_jax.laws.kinematics import ChainKinematics
from ptsmc_jax.plants import integrator_chain, rigid_body
from ptsmc_jax.scenario.disturbance_tables import DISTURBANCES
from ptsmc_jax.scenario.law_tables import BASELINES, LAWS, OBSERVERS
from ptsmc_jax.scenario.reference_tables import REFERENCES
from ptsmc_jax.signals import references
from ptsmc_jax.simulation import rollout
from tests.helpers import FULL_INERTIA, ROOT, short
from tests.onboard.flights import MOVING
from tuning.search.gains import with_gains

SEED, NUMBERS = np.uint32(3), np.arange(4, dtype=np.uint32)
ARM = str(ROOT / "scenarios" / "two_link_arm.py") + ":arm"
CUSTOM = str(ROOT / "scenarios" / "own_parts.py")
SLEW = {"t_f": 6.0, "delta": 0.3, "eta": 2.6}
SHORT = {"t_end": 7.5, "window": 1.0}
SAMPLED = {"mode": "sampled", "period": 0.25, **SHORT}
SPREAD = {"attitude": {"kind": "axis_angle", "min_deg": 5.0, "max_deg": 60.0}}
NOISE = {"attitude_noise": 2e-4, "rate_noise": 1e-5}
EVERY_DEVICE = {
    "attitude_noise": 2e-4, "rate_noise_density": 1e-6, "rate_bias": 1e-5, "rate_bias_walk": 1e-6,
    "star_tracker_every": 3, "torque_limit": 2.0, "torque_rate_limit": 8.0, "torque_lag": 0.05,
    "torque_step": 1e-3, "delay": 1, "command_filter": {"kind": "second_order", "corner": 6.0},
}  # fmt: skip
TURN_ON_WHEELS = {
    "controller": {"kind": "time_base_sliding", "t_f": 6.0},
    "reference": {"kind": "slew", "to_quat_xyzw": [0.28, 0.0, 0.0, 0.96], "duration": 5.0},
    "loop": {**SAMPLED, "clock": "flight"},
    "wheels": {"torque_limit": 1.5, "momentum_limit": 4.0},
}
SPIN = {"reference": {"kind": "spin", "rate": [0.01, -0.02, 0.03]}}

QUICK = {  # gains that reach the target in such a short run; other laws have their defaults
    "pd": {"k_p": 2.0, "k_d": 2.5},
    "terminal": {"p": 1.3, "b": 1.0, "k": 1.0},
    "fixed_time": {"a1": 0.5, "b1": 0.8},
    "super_twisting": {"surface_rate": 1.5, "lipschitz": 0.5},
    "predefined_time": {"q1": 0.5, "q2": 0.5},
}
ROWS: dict[str, dict] = {
    "continuous": {"controller": SLEW, "loop": SHORT, "dispersion": SPREAD},
    "continuous, spin, no observer": {
        "controller": {**SLEW, "sign_width": 0.05},
        "observer": {"kind": "none"},
        **SPIN,
        "disturbance": {"kind": "constant", "amplitude": [0.01, -0.02, 0.0]},
        "loop": SHORT,
        "dispersion": {"attitude": {"kind": "normal", "std_deg": 5.0}},
    },
    "raw samples, full inertia, other truth": {
        "spacecraft": {"inertia": FULL_INERTIA, "true_inertia": [10.0, 9.0, 13.0]},
        "controller": SLEW,
        "loop": SAMPLED,
        "hardware": {**NOISE, "rate_bias": 1e-5, "rate_bias_walk": 1e-6},
        "disturbance": {"kind": "gravity_gradient", "orbit_rate": 1e-3, "phase": 0.3},
        "reference": {"kind": "sinusoid", "amplitude": [0.1, 0.0, 0.05]},
        "dispersion": SPREAD,
    },
    "filter, every axis device, random walk": {
        "controller": SLEW,
        "loop": SAMPLED,
        "filter": {"kind": "steady_state"},
        "hardware": EVERY_DEVICE,
        "disturbance": {
            "kind": "sum",
            "terms": [
                {"kind": "random_walk", "density": [1e-4, 1e-4, 2e-4]},
                {"kind": "sinusoid", "amplitude": [0.01, 0.0, 0.02], "bias": [0.0, 0.01, 0.0]},
            ],
        },
        "dispersion": SPREAD,
    },
    "wheels, a law that remembers, flight clock, uniform attitudes": {
        **TURN_ON_WHEELS,
        "hardware": {**NOISE, "torque_lag": 0.05},
        "dispersion": {"attitude": {"kind": "uniform"}},
    },
    "wheels, filter, every device, a law that remembers, prescribed-time observer, random walk": {
        **TURN_ON_WHEELS,
        "observer": {"kind": "prescribed_time", "t_o": 3.0, "delta_o": 0.5},
        "filter": {"kind": "steady_state"},
        "hardware": EVERY_DEVICE,
        "disturbance": {
            "kind": "sum",
            "terms": [{"kind": "random_walk", "density": [1e-4, 1e-4, 2e-4]}, {"kind": "sinusoid"}],
        },
        "dispersion": SPREAD,
    },
    "multiplicative error, prescribed-time observer": {
        "spacecraft": {"inertia": FULL_INERTIA},
        "controller": {**SLEW, "error": "multiplicative"},
        "observer": {"kind": "prescribed_time", "t_o": 3.0},
        "reference": {"kind": "slew", "rotvec_deg": [170, 0, 0], "to_quat_xyzw": [0.0, 0.6, 0.8, 0.0], "way": "long"},
        "loop": SHORT,
        "dispersion": SPREAD,
    },
    "multiplicative error, finite-time observer, sampled": {
        "controller": {**SLEW, "error": "multiplicative"},
        "observer": {"kind": "finite_time"},
        "loop": SAMPLED,
        "hardware": NOISE,
        "dispersion": {"attitude": {"kind": "uniform"}},
    },
    **{
        f"baseline {kind}": {
            "spacecraft": {"inertia": FULL_INERTIA},
            "controller": {"kind": kind, "t_f": 6.0, **QUICK.get(kind, {})},
            "hardware": NOISE,
            "dispersion": SPREAD,
            **moving,
            "loop": {**SAMPLED, **moving.get("loop", {})},
        }
        for kind, moving in zip(BASELINES, itertools.cycle((SPIN, *MOVING.values())), strict=False)
    },
    "system": {
        "plant": {"kind": "system", "system": ARM, "x0": [0.4, -0.3, 0.0, 0.0]},
        "controller": SLEW,
        "observer": {"kind": "nonlinear"},
        "disturbance": {"kind": "sinusoid"},
        "loop": SHORT,
        "dispersion": {"x0": {"kind": "normal", "std": [0.1, 0.1, 0.0, 0.1]}},
    },
    "parts of one's own": {
        "controller": {"kind": "custom", "code": f"{CUSTOM}:Scaling", "t_f": 6.0, "delta": 1.0},
        "observer": {"kind": "custom", "code": f"{CUSTOM}:LowPass"},
        "reference": {"kind": "custom", "code": f"{CUSTOM}:Nodding"},
        "disturbance": {"kind": "custom", "code": f"{CUSTOM}:SolarPressure"},
        "loop": SAMPLED,
        "hardware": NOISE,
        "dispersion": SPREAD,
    },
    "flexible body, sampled": {
        "flexible": {"frequency": [3.0, 9.0], "damping": [0.005, 0.0], "coupling": [[1.2, 0.0, 0.3], [0.1, 0.9, 0.0]]},
        "controller": {**SLEW, "error": "multiplicative"},
        "loop": SAMPLED,
        "hardware": NOISE,
        "dispersion": {**SPREAD, "inertia": {"kind": "relative_normal"}, "rate": {"kind": "normal"}},
    },
    "implicit sampling": {
        "controller": {**SLEW, "error": "multiplicative", "sampling": "implicit"},
        "loop": SAMPLED,
        "hardware": NOISE,
        "dispersion": SPREAD,
    },
    "sampled system with noise": {
        "plant": {"kind": "system", "system": ARM, "x0": [0.4, -0.3, 0.0, 0.0]},
        "controller": SLEW,
        "observer": {"kind": "prescribed_time", "t_o": 3.0, "delta_o": 0.5},
        "disturbance": {"kind": "random_walk"},
        "loop": SAMPLED,
        "hardware": {"state_noise": [1e-4, 1e-4, 1e-3, 1e-3], "torque_lag": 0.05},
        "dispersion": {"x0": {"kind": "uniform", "half_width": [0.2, 0.2, 0.0, 0.1]}},
    },
    "chain of order 3": {
        "plant": {"kind": "chain", "order": 3, "x0": [1.0, 0.0, 0.0]},
        "controller": {**SLEW, "eta": 3.6, "a": [1.0, 2.0]},
        "loop": SHORT,
        "dispersion": {"x0": {"kind": "uniform", "half_width": [0.2, 0.1, 0.0]}},
    },
    "chain, finite-time observer": {
        "plant": {"kind": "chain", "order": 2, "x0": [1.0, 0.0]},
        "controller": SLEW,
        "observer": {"kind": "finite_time", "sign_width": 1e-3},
        "loop": SHORT,
        "dispersion": {"x0": {"kind": "uniform", "half_width": [0.2, 0.1]}},
    },
    "sampled chain with noise": {
        "plant": {"kind": "chain", "order": 2, "x0": [1.0, 0.0]},
        "controller": SLEW,
        "loop": SAMPLED,
        "hardware": {"state_noise": [1e-4, 1e-5], "torque_limit": 0.4, "torque_rate_limit": 1.0},
        "dispersion": {"x0": {"kind": "normal", "std": [0.1, 0.02]}},
    },
}  # fmt: skip


# one of each kind of loop and device; the others are `long`
KINDS = (
    "wheels, filter, every device, a law that remembers, prescribed-time observer, random walk",
    "chain, finite-time observer",
)


IN_FULL = KINDS[-1:]  # with gradients, vmap and loop; the others in lanes and loop
CASES = [pytest.param(name, name in IN_FULL, id=name) for name in KINDS] + [
    pytest.param(name, True, id=f"{name}, in full", marks=pytest.mark.long) for name in ROWS if name not in IN_FULL
]


@pytest.mark.parametrize(
    ("name", "known"),
    [
        ("controller", LAWS["spacecraft"]),
        ("observer", OBSERVERS["spacecraft"]),
        ("reference", REFERENCES),
        ("disturbance", DISTURBANCES["spacecraft"]),
    ],
)
def test_every_kind_of_law_observer_reference_and_disturbance_is_in_a_tested_scenario(name, known):
    asked = [row.get(name, {}) for row in ROWS.values()]
    asked += [term for table in asked for term in table.get("terms", ())]
    assert {table.get("kind", next(iter(known))) for table in asked} >= set(known) - {"none"}


@programs.jit(static_argnames=("in_lanes", "sloped"))
def batch(parts, still, dispersion, in_lanes, sloped):
    """Return metrics, statuses and failure times of some trials, and derivatives of the metrics along all gains.

    The last trial has the initial state and boundary layer of `still`. in_lanes: lanes or JAX. sloped: whether to
    return derivatives; otherwise they are an empty dict.
    """
    vmap = lanes.vmap if in_lanes else jax.vmap  # pytest raises the warning of a primitive without a rule
    names = [name for name in parts.controller.tunable if name not in ("sign_width", "t_f", "k1")]
    gains = {name: getattr(parts.controller, name) for name in names}

    def fly(gains):
        def one(trial):
            run = dispersion.apply(with_gains(parts, gains), SEED, trial)

            def at_last(value, at):
                return jax.tree.map(lambda v, at: jnp.where(trial == NUMBERS.size, at, v), value, at)

            run = replace(run, initial=at_last(run.initial, still.initial))
            if hasattr(run.controller, "sign_width"):
                width = at_last(run.controller.sign_width, still.controller.sign_width)
                run = replace(run, controller=replace(run.controller, sign_width=width))
            return montecarlo.one(run, variation.Dispersion(), SEED, trial)[:3]

        return vmap(one)(jnp.append(NUMBERS, np.uint32(NUMBERS.size)))

    if not sloped:
        metrics, status, bad = fly(gains)
        return dict(metrics), status, bad, {}
    (metrics, status, bad), slopes = jax.jvp(fly, (gains,), (jax.tree.map(jnp.ones_like, gains),))
    return dict(metrics), status, bad, dict(slopes[0])


def at_rest_on_the_target(parts):
    """Return parts at rest on the target with the discontinuous sign: every norm, root and sign is at 0."""
    target = parts.reference(jnp.zeros(()))
    if isinstance(target, references.Target):
        initial = parts.plant.with_hidden_at_rest(rigid_body.AttitudeState(target.q, target.w))
    else:
        initial = jnp.zeros_like(parts.initial)
    exact = {"sign_width": jnp.zeros(())} if hasattr(parts.controller, "sign_width") else {}
    return replace(parts, initial=initial, controller=replace(parts.controller, **exact))


def agree(values, wanted, unit, name, skip=()):
    """Assert that metrics, {name: (trials,)}, agree within `unit` times the largest value of each.

    name: of the case, for the message. skip: metrics that may differ.
    """
    for metric in wanted:
        a, b = np.asarray(values[metric]), np.asarray(wanted[metric])
        np.testing.assert_array_equal(np.isfinite(a), np.isfinite(b), err_msg=metric)
        scale = np.abs(b[np.isfinite(b)]).max(initial=0.0)
        off = np.abs(a - b)[np.isfinite(b)].max(initial=0.0)
        assert metric in skip or off <= unit * max(scale, 1e-3), (name, metric, off, scale)


def one_by_one(parts, still, dispersion, sloped):
    """Return the results of `batch` from single simulations, without derivatives.

    These programs compile in half the time.
    """
    assert not sloped
    begun = [drawn(dispersion, parts, trial) for trial in (*NUMBERS, np.uint32(NUMBERS.size))]
    begun[-1] = replace(begun[-1], initial=still.initial)
    if hasattr(still.controller, "sign_width"):
        width = still.controller.sign_width
        begun[-1] = replace(begun[-1], controller=replace(begun[-1].controller, sign_width=width))
    simulated = [rollout.simulate_parts(run, SEED, np.uint32(trial)) for trial, run in enumerate(begun)]
    each = [(dict(one.metrics), one.status, one.bad_time, {}) for one in simulated]
    return jax.tree.map(lambda *v: np.stack(v), *each)


drawn = jax.jit(lambda dispersion, parts, trial: dispersion.apply(parts, SEED, trial))


under_vmap = partial(batch, in_lanes=False)


def compare(parts, dispersion, name, sloped, reference: Any = under_vmap):
    """Assert that lanes and a reference give equal results of all trials; the last trial is at rest on the target.

    The function returns metrics of the other trials, and (status, metrics, derivatives) of the last trial, all from the
    reference. name: of the case. reference: like `batch`.
    """
    still, by_lanes = at_rest_on_the_target(parts), partial(batch, in_lanes=True)
    both = [jax.tree.map(np.asarray, of(parts, still, dispersion, sloped=sloped)) for of in (by_lanes, reference)]
    got, expected = (jax.tree.map(lambda v: v[:-1], one) for one in both)
    last = jax.tree.map(lambda v: v[-1], both[1])
    np.testing.assert_array_equal(got[1], expected[1])
    np.testing.assert_array_equal(got[2], expected[2])
    assert np.any(np.isin(expected[1], [0, 4])), "some trial must fly to the end"
    agree(got[0], expected[0], 1e-12, name)
    # chattering is a sum of magnitudes: for a difference of 0 except for rounding, both derivatives are right
    agree(got[3], expected[3], 1e-9, name, skip=("chattering",))
    return expected[0], (last[1], last[0], last[3])


@pytest.mark.parametrize(("name", "in_full"), CASES)
def test_every_part_gives_equal_results_in_lanes_vmap_and_loop_with_finite_gradients(name, in_full):
    ready = scenario.study(scenario.from_tables(ROWS[name]))
    reference = under_vmap if in_full else one_by_one
    metrics, (status, values, slopes) = compare(ready.parts, ready.dispersion, name, in_full, reference)
    assert status in (0, 4)
    for metric, slope in slopes.items():
        assert np.isfinite(slope) or not np.isfinite(values[metric]), metric
    if in_full:
        alone = one_by_one(ready.parts, at_rest_on_the_target(ready.parts), ready.dispersion, sloped=False)[0]
        agree({metric: values[:-1] for metric, values in alone.items()}, metrics, 1e-12, name)


@pytest.mark.parametrize("name", short(ROWS, KINDS))
def test_results_have_the_same_shapes_alone_and_in_a_batch(name):
    """The result of a run has the same shapes and types alone and in a batch of one, so nothing is broadcast.

    Integers are not promoted implicitly, which users may have forbidden.
    """
    ready = scenario.study(scenario.from_tables(ROWS[name]))
    with jax.numpy_dtype_promotion("strict"):
        one = jax.eval_shape(lambda parts: rollout.simulate(parts, SEED, NUMBERS[0], record=True), ready.parts)
        many = jax.eval_shape(
            jax.vmap(lambda trial: rollout.simulate(ready.parts, SEED, trial, record=True)), NUMBERS[:1]
        )
    for single, batched in zip(jax.tree.leaves(one), jax.tree.leaves(many), strict=True):
        assert batched.shape == (1, *single.shape)
        assert batched.dtype == single.dtype
    assert all(leaf.shape == () for leaf in jax.tree.leaves((one.metrics, one.status, one.bad_time)))
    rows = one.log.t.shape[0]
    assert all(leaf.shape[0] == rows for leaf in jax.tree.leaves(one.log))
    assert one.log.u.shape == (rows, ready.parts.plant.inputs)


@pytest.mark.parametrize("name", ROWS)
def test_programs_of_built_in_parts_are_stored(name, tmp_path, monkeypatch):
    """All static values can be identified, flight software included, but never custom code.

    A program that cannot be identified would be traced in every process, which only takes time.
    """
    monkeypatch.setattr(configure, "programs", tmp_path)
    stored: list[Any] = []

    def prepare(program, *args, **kwargs):
        with contextlib.suppress(programs.NotStorableError):
            stored.append(program.path(*args, **kwargs))

    monkeypatch.setattr(programs.Program, "prepare", prepare)
    ready = scenario.study(scenario.from_tables(ROWS[name]))
    runs.prepare(ready)
    montecarlo.prepare(ready.parts, ready.dispersion, len(NUMBERS))
    assert len(stored) == (0 if ARM in str(ROWS[name]) or CUSTOM in str(ROWS[name]) else 2)


def test_lanes_equal_vmap_for_a_plant_from_python():
    """The plant has branches, loops, powers and tables in f and g, like plants of users."""

    def f(x):
        drag = jax.lax.cond(x[1] > 0, lambda v: v * v, lambda v: -v * v, x[1])
        table = jnp.interp(x[0], jnp.linspace(-2.0, 2.0, 5), jnp.asarray([0.0, 0.2, -0.1, 0.3, 0.1]))
        wave = jax.lax.fori_loop(0, 3, lambda k, total: total + jnp.sin(k * x[0]) / (1 + k), 0.0)
        return -0.1 * drag + table + 0.05 * wave

    def g(x):
        return 1.0 + 0.2 * jnp.cos(x[0]) ** 2

    row = {name: table for name, table in ROWS["sampled chain with noise"].items() if name != "hardware"}
    ready = scenario.study(scenario.from_tables(row))
    model = integrator_chain.chain(2, f, g)
    law = replace(ready.parts.controller, kinematics=ChainKinematics(model))
    parts = replace(ready.parts, plant=model, controller=law)
    compare(parts, ready.dispersion, "own plant", False)
