"""What a mode that the law does not know does to the loop: linear theory."""

import jax
import numpy as np
import pytest

from ptsmc_jax import scenario
from ptsmc_jax.theory import covariance, linear, margins
from tests.helpers import fly

# one mode about x that a late loop of some bandwidth drives; no noise, no switching term, small angles: it is linear
SPILLS = {
    "flexible": {"frequency": [6.0], "damping": [0.02], "coupling": [[1.6, 0.0, 0.0]]},
    "controller": {
        "t_f": 6.0, "delta": 2.0, "k1": 2.0, "surface_rate": 1.0, "disturbance_bound": 0.0, "error": "multiplicative",
    },
    "initial": {"rotvec_deg": [0.2, 0.1, -0.1]},
    "disturbance": {"kind": "none"},
    "observer": {"kind": "none"},
    "loop": {"mode": "sampled", "period": 0.2, "t_end": 32.0},
    "hardware": {"delay": 1},
}  # fmt: skip


@pytest.fixture(autouse=True)
def few_together(monkeypatch):
    """Most loops here are opened in one period: the program is for few."""
    monkeypatch.setattr(linear, "TOGETHER", 8)


def test_margins_see_the_mode_and_sensors_see_the_body_alone():
    loop = in_hold(parts_of(controller={**SPILLS["controller"], "k1": 0.2, "surface_rate": 0.2}))
    assert loop.seen.shape[1] == 6
    assert jax.eval_shape(lambda loop: margins.of(loop, sensors=True), loop).gain_up.shape == (6,)
    found = margins.of_each(jax.tree.map(lambda v: v[None], loop))
    assert found.gain_up[0, 0] < found.gain_up[0, 1] - 3.0  # the mode rings about x


def test_noise_and_random_walk_by_linear_covariance_are_those_of_flown_trials():
    """Either of them is a good part of it, behind a delay of two periods."""
    from ptsmc_jax.campaigns import montecarlo

    tables = {
        **SPILLS,
        "controller": {**SPILLS["controller"], "k1": 0.2, "surface_rate": 0.2},
        "hardware": {"attitude_noise": 1e-4, "rate_noise": 1e-4, "delay": 2},
        "disturbance": {"kind": "random_walk", "density": [3e-4] * 3},
        "loop": {"mode": "sampled", "period": 0.2, "t_end": 12.0, "window": 4.0},
        "initial": {"quat_xyzw": [0.0, 0.0, 0.0, 1.0]},
    }
    ready = scenario.study(scenario.from_tables(tables))
    flown = montecarlo.run(ready.parts, ready.dispersion, 0, np.arange(512))
    measured = np.sqrt(np.mean(flown.metrics.window_error**2))
    np.testing.assert_allclose(covariance.noise(ready.parts).window_error, measured, rtol=0.1)


def parts_of(**changes):
    tables = {key: table for key, table in {**SPILLS, **changes}.items() if table is not None}
    return scenario.study(scenario.from_tables(tables)).parts


def in_hold(parts):
    """The loop of the last period."""
    run = linear.nominal_jit(parts)
    index = linear.full_periods(parts, run, hold=True)[-1:]
    return jax.tree.map(lambda v: np.asarray(v)[0], linear.loops_in(parts, run, index))


def slowest_pair(y):
    """Modulus of the pair of poles that a free oscillation y(k) ends in: y(k + 2) = 2 r cos(a) y(k + 1) - r^2 y(k)."""
    return np.sqrt(-np.linalg.lstsq(np.stack([y[1:-1], y[:-2]], axis=1), y[2:])[0][1])


@pytest.mark.parametrize(("damping", "grows"), [(0.02, True), (0.06, False)])
def test_a_flown_mode_grows_or_decays_as_the_poles_of_its_loop_say(damping, grows):
    """The last 70 periods of hold, in which faster motions are gone; the rigid design is stable either way."""
    assert linear.radius(in_hold(parts_of(flexible=None))) < 1.0 + margins.NEUTRAL
    parts = parts_of(flexible={**SPILLS["flexible"], "damping": [damping]})
    loop = in_hold(parts)
    poles = np.abs(np.linalg.eigvals(linear.at_input(loop, 0.0, np).closed()))
    radius = poles[np.abs(poles - 1.0) > margins.NEUTRAL].max()  # without an observer a memory stays as it is
    assert radius > 1.01 if grows else radius < 0.99
    log = fly(parts).log
    ringing = log.x.modes.e[log.has_length][-72:-1, 0]
    np.testing.assert_allclose(slowest_pair(ringing) ** 70, radius**70, rtol=2e-3)
