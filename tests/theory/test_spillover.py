"""Spillover: linear theory of a loop with a flexible mode that the law does not model."""

from dataclasses import replace

import jax
import numpy as np
import pytest

from ptsmc_jax import scenario
from ptsmc_jax.simulation import rollout
from ptsmc_jax.theory import covariance, linear, margins
from tests.helpers import fly, roomy

# a delayed loop excites one mode about x; without noise and switching term, and for small angles, the loop is linear
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


NOISY = {
    "hardware": {"attitude_noise": 1e-4, "rate_noise": 1e-4, "delay": 1},
    "disturbance": {"kind": "random_walk", "density": [3e-4] * 3},
}
CALM = {**SPILLS["controller"], "k1": 0.2, "surface_rate": 0.2}  # a bandwidth that does not excite the mode


@pytest.fixture(autouse=True)
def few_together(monkeypatch):
    """Compile the program for fewer periods, because most tests here linearise one period."""
    monkeypatch.setattr(linear, "PERIODS_PER_CALL", 8)


def parts_of(**changes):
    """Return the parts of a spacecraft with one flexible mode and these tables."""
    return scenario.study(scenario.from_tables({**SPILLS, **changes})).parts


def in_theory(**changes):
    """Return parts with noise and padded time grids, to share compiled programs; noise does not affect loops."""
    parts = parts_of(**NOISY, **changes)
    return replace(parts, clock=roomy(parts.clock), substeps=25)


def in_hold(parts):
    """Return the linearised loop of the last full period in the hold phase."""
    run = linear.simulate_nominal_jit(parts)
    index = linear.full_periods(parts, run, hold=True)[-1:]
    width = np.asarray(parts.controller.sign_width)[None]  # as in `covariance`, to share its compiled program
    opened = linear.linearise_periods(parts, run, index, width, fractional_delays=False)
    return jax.tree.map(lambda v: np.asarray(v)[0], opened.loop)


def test_margins_include_the_mode_and_sensors_see_only_the_body():
    """The gain margin about x, the axis of the mode, is smaller than that about y."""
    loop = in_hold(in_theory(controller=CALM))
    assert loop.seen.shape[1] == 6
    assert jax.eval_shape(lambda loop: margins.compute(loop, sensors=True), loop).gain_up.shape == (6,)

    def bears(axis, decibels):
        return (
            linear.spectral_radius(loop, np.diag(10.0 ** (decibels * (np.arange(3) == axis) / 20.0)))
            < 1.0 + margins.CIRCLE_TOLERANCE
        )

    assert bears(0, 0.0)
    border = next(decibels for decibels in np.arange(0.0, 60.0, 0.1) if not bears(0, decibels))
    assert all(bears(1, decibels) for decibels in np.arange(0.0, border + 3.0, 0.1))  # the mode is about x


def test_covariance_of_noise_and_random_walk_equals_simulated_trials():
    """Noise and random walk both contribute considerably. The loop has a delay."""
    changes = {
        "controller": CALM,
        "loop": {"mode": "sampled", "period": 0.2, "t_end": 12.0, "window": 4.0},
        "initial": {"quat_xyzw": [0.0, 0.0, 0.0, 1.0]},
    }
    fly_each = jax.jit(jax.vmap(lambda parts, k: rollout.simulate(parts, np.uint32(0), k), (None, 0)))
    simulated = fly_each(parts_of(**NOISY, **changes), np.arange(512, dtype=np.uint32))
    measured = np.sqrt(np.mean(np.asarray(simulated.metrics.window_error) ** 2))
    np.testing.assert_allclose(covariance.propagate_noise(in_theory(**changes)).window_error, measured, rtol=0.1)


def slowest_pair(y):
    """Return the modulus r of the dominant pole pair of an oscillation y (samples,).

    Its samples obey y(k + 2) = 2 r cos(a) y(k + 1) - r^2 y(k).
    """
    return np.sqrt(-np.linalg.lstsq(np.stack([y[1:-1], y[:-2]], axis=1), y[2:])[0][1])


@pytest.mark.parametrize(("damping", "grows"), [(0.02, True), (0.06, False)])
def test_simulated_mode_grows_or_decays_like_the_dominant_poles(damping, grows):
    """Only the last 70 periods count, after faster motions have decayed. The loop without the mode is stable."""
    stiff = {**SPILLS["flexible"], "coupling": [[1e-6, 0.0, 0.0]]}
    assert linear.spectral_radius(in_hold(in_theory(flexible=stiff))) < 1.0 + margins.CIRCLE_TOLERANCE
    flexible = {**SPILLS["flexible"], "damping": [damping]}
    poles = np.abs(np.linalg.eigvals(linear.open_at_input(in_hold(in_theory(flexible=flexible)), 0.0, np).closed()))
    radius = poles[np.abs(poles - 1.0) > margins.CIRCLE_TOLERANCE].max()  # constant memories have poles at 1
    assert radius > 1.01 if grows else radius < 0.99
    log = fly(parts_of(flexible=flexible)).log
    ringing = log.x.modes.e[log.has_length][-72:-1, 0]
    np.testing.assert_allclose(slowest_pair(ringing) ** 70, radius**70, rtol=2e-3)
