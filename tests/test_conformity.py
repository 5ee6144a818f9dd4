"""Every part through `lanes`, strict, against `jax.vmap`: values and tangents of a batch of short runs.

Each row is a scenario; together they hold every part that a scenario or Python can name. A new part joins a row here.
"""

from dataclasses import replace

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from ptsmc_jax import lanes, montecarlo, plants, scenario
from tests.helpers import FULL_INERTIA
from tuning.bounds import with_gains

TRIALS = 4
SLEW = {"t_f": 6.0, "delta": 0.3, "eta": 2.6}
SHORT = {"t_end": 7.5, "window": 1.0}
SAMPLED = {"mode": "sampled", "period": 0.25, **SHORT}
SPREAD = {"attitude": {"kind": "axis_angle", "min_deg": 5.0, "max_deg": 60.0}}
NOISE = {"attitude_noise": 2e-4, "rate_noise": 1e-5}

ROWS: dict[str, dict] = {
    "continuous": {"controller": SLEW, "loop": SHORT, "dispersion": SPREAD},
    "continuous, spin, no observer": {
        "controller": {**SLEW, "sign_width": 0.05},
        "observer": {"kind": "none"},
        "reference": {"kind": "spin", "rate": [0.01, -0.02, 0.03]},
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
        "hardware": {
            "attitude_noise": 2e-4, "rate_noise_density": 1e-6, "rate_bias": 1e-5, "rate_bias_walk": 1e-6,
            "star_tracker_every": 3, "torque_limit": 2.0, "torque_rate_limit": 8.0, "torque_lag": 0.05,
            "torque_step": 1e-3, "delay": 1,
        },
        "disturbance": {
            "kind": "sum",
            "terms": [
                {"kind": "random_walk", "density": [1e-4, 1e-4, 2e-4]},
                {"kind": "sinusoid", "amplitude": [0.01, 0.0, 0.02], "bias": [0.0, 0.01, 0.0]},
            ],
        },
        "dispersion": SPREAD,
    },
    "wheels, flight clock, uniform attitudes": {
        "controller": SLEW,
        "reference": {"kind": "slew", "to_quat_xyzw": [0.28, 0.0, 0.0, 0.96], "duration": 5.0},
        "loop": {**SAMPLED, "clock": "flight"},
        "hardware": {**NOISE, "torque_lag": 0.05},
        "wheels": {"torque_limit": 1.5, "momentum_limit": 4.0},
        "dispersion": {"attitude": {"kind": "uniform"}},
    },
    "chain of order 3": {
        "plant": {"kind": "chain", "order": 3, "x0": [1.0, 0.0, 0.0]},
        "controller": {**SLEW, "eta": 3.6, "a": [1.0, 2.0]},
        "loop": SHORT,
        "dispersion": {"x0": {"kind": "uniform", "half_width": [0.2, 0.1, 0.0]}},
    },
    "sampled chain with noise": {
        "plant": {"kind": "chain", "order": 2, "x0": [1.0, 0.0]},
        "controller": SLEW,
        "loop": SAMPLED,
        "hardware": {"state_noise": [1e-4, 1e-5], "torque_limit": 0.4, "torque_rate_limit": 1.0},
        "dispersion": {"x0": {"kind": "normal", "std": [0.1, 0.02]}},
    },
}  # fmt: skip


def compare(parts, dispersion, name):
    gains = {"eta": parts.controller.eta, "delta": parts.controller.delta}

    def moved(vmap):
        def batch(gains):
            run = with_gains(parts, gains)
            return vmap(lambda trial: montecarlo.one(run, dispersion, np.uint32(3), trial)[:3])(
                jnp.arange(TRIALS, dtype=jnp.uint32)
            )

        (metrics, status, bad), slopes = jax.jvp(batch, (gains,), (jax.tree.map(jnp.ones_like, gains),))
        return metrics._asdict(), status, bad, slopes[0]._asdict()

    def strict(function):
        return lanes.vmap(function, strict=True)

    got, expected = (jax.jit(moved, static_argnums=0)(vmap) for vmap in (strict, jax.vmap))
    np.testing.assert_array_equal(got[1], expected[1])
    np.testing.assert_array_equal(got[2], expected[2])
    assert np.any(np.isin(expected[1], [0, 4])), "some trial must fly to the end"
    for values, wanted, unit in ((got[0], expected[0], 1e-12), (got[3], expected[3], 1e-9)):
        for metric in wanted:
            if metric == "chattering" and unit > 1e-12:
                continue  # a sum of magnitudes: where a difference is 0 but for rounding, either slope is right
            a, b = np.asarray(values[metric]), np.asarray(wanted[metric])
            np.testing.assert_array_equal(np.isfinite(a), np.isfinite(b), err_msg=metric)
            scale = np.abs(b[np.isfinite(b)]).max(initial=0.0)
            off = np.abs(a - b)[np.isfinite(b)].max(initial=0.0)
            assert off <= unit * max(scale, 1e-3), (name, metric, off, scale)


@pytest.mark.parametrize("name", ROWS)
def test_lanes_equal_vmap_for_every_part(name):
    ready = scenario.study(scenario.from_tables(ROWS[name]))
    compare(ready.parts, ready.dispersion, name)


def test_lanes_equal_vmap_for_a_plant_from_python():
    """Branches, loops, powers and tables in f and g: what users write."""

    def f(x):
        drag = jax.lax.cond(x[1] > 0, lambda v: v * v, lambda v: -v * v, x[1])
        table = jnp.interp(x[0], jnp.linspace(-2.0, 2.0, 5), jnp.asarray([0.0, 0.2, -0.1, 0.3, 0.1]))
        wave = jax.lax.fori_loop(0, 3, lambda k, total: total + jnp.sin(k * x[0]) / (1 + k), 0.0)
        return -0.1 * drag + table + 0.05 * wave

    def g(x):
        return 1.0 + 0.2 * jnp.cos(x[0]) ** 2

    ready = scenario.study(scenario.from_tables(ROWS["sampled chain with noise"]))
    model = plants.chain(2, f, g)
    parts = replace(ready.parts, plant=model, controller=replace(ready.parts.controller, model=model))
    compare(parts, ready.dispersion, "own plant")
