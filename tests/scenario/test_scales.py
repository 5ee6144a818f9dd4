"""Compare the ranges of useful and stable gains with random samples and with loops computed by hand."""

import math

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from ptsmc_jax import scenario
from ptsmc_jax.numerics import attitude
from ptsmc_jax.observers import nonlinear
from ptsmc_jax.plants import rigid_body, second_order
from ptsmc_jax.plants.rigid_body import AttitudeState
from ptsmc_jax.scenario import scales
from ptsmc_jax.signals.references import Target
from ptsmc_jax.theory import stability_limits
from tests.helpers import FIRST_FLIGHT, FULL_INERTIA, commanded, parts, vector

ARM = {"plant": {"kind": "system", "system": second_order.system(
    1, F=lambda t, x, v: v, H=lambda t, x, v: 0.0 * x, G=lambda t, x, v: jnp.eye(1)), "x0": [1.0, 0.0]}}  # fmt: skip


def noise_of_s(known):
    """Return the predicted noise of s, 1 sigma, in a scenario, in the units of s."""
    return known.devices.noise_of_s(known)


def flight(**changes):
    """Return the scenario first_flight.toml with changes and without its table [tune].

    changes: as for `scenario.replace`.
    """
    return scenario.replace(scenario.read(FIRST_FLIGHT), tune=None, **changes)


@pytest.mark.parametrize("inertia", [[10.0, 12.0, 14.0], [list(row) for row in FULL_INERTIA]])
def test_the_deadbeat_gain_leaves_the_documented_fraction_of_the_slowest_error(inertia):
    """The largest eigenvalue of the digital observer's E is the documented fraction."""
    gain = scales.dead_beat_gain(flight(spacecraft__inertia=inertia))
    body = rigid_body.spacecraft(inertia)
    observer = nonlinear.NonlinearObserver(body, vector([gain] * 3), vector(1e-3), vector(0.0))
    kept = np.abs(np.linalg.eigvals(np.eye(3) - 0.05 * np.asarray(observer.update_matrix(vector(0.05)))))  # of E
    np.testing.assert_allclose(kept.max(), 5e-5, rtol=1e-8)  # rounding of 1 - 5e-5


def growth(c, k, late, keep=0.6, period=1.0):
    """Return the logarithm of the growth per period of one axis under the sampled law in the hold phase.

    c: coefficient of the surface s = v' + c v. k: reaching rate. late: delay in whole periods. keep: pole of the
    digital observer.
    """
    state, estimate = np.array([1.0, 0.3]), 0.0
    commands, sizes = [0.0] * late, []
    for _ in range(3000):
        s = state[1] + c * state[0]
        commands.append(-c * state[1] - k * s - estimate)
        acts, before = commands.pop(0), state[1]
        a = acts + 0.2  # a constant disturbance for the observer
        state = np.array([state[0] + period * state[1] + period**2 / 2 * a, state[1] + period * a])
        estimate = keep * estimate + (1 - keep) * ((state[1] - before) / period - acts)
        sizes.append(np.abs(state).sum())
    late_on = np.log(np.array(sizes[-1500:]) + 1e-300)
    return np.polyfit(np.arange(1500), late_on, 1)[0]


@pytest.mark.parametrize("late", [0, 1, 2])
@pytest.mark.parametrize("surface", [0.02, 0.1, 0.25])
def test_the_stability_limit_of_the_hold_phase_matches_a_loop_computed_by_hand(surface, late):
    """The observer in the loop, which the limit ignores, changes nothing: its residual error is constant."""
    border = stability_limits.largest_reaching(surface, float(late))
    inside, outside = growth(surface, 0.98 * border, late), growth(surface, 1.02 * border, late)
    assert inside < 1e-6 < 1e-3 < outside
    # the two rates can be exchanged
    np.testing.assert_allclose(stability_limits.largest_reaching(border, float(late)), surface, rtol=1e-6)
    if late == 0:
        np.testing.assert_allclose(border, 2.0 - surface, rtol=1e-9)


def test_the_largest_k1_of_a_spacecraft_is_twice_the_stability_limit():
    np.testing.assert_allclose(scales.largest_k1(flight(), 1.0), 2.0 * (2.0 / 0.05 - 1.0), rtol=1e-9)
    late = flight(hardware__delay=1)
    np.testing.assert_allclose(scales.largest_k1(late, 3.0), 2.0 * stability_limits.largest_reaching(0.15, 1.0) / 0.05)
    assert scales.largest_k1(flight(), 41.0) == 0.0
    loop = {"mode": "sampled", "period": 0.05}
    for plant in ({"kind": "chain", "order": 2}, ARM["plant"]):
        other = scenario.from_tables({"plant": plant, "loop": loop})
        np.testing.assert_allclose(scales.largest_k1(other, 1.0), 2.0 / 0.05 - 1.0, rtol=1e-9)


@pytest.mark.parametrize("rate", [0.3, 1.0, 6.0])
def test_the_predicted_noise_of_s_matches_random_samples(rate):
    """20 000 samples of a body on its reference give sigma to 0.5 % (1 sigma); three times this error is allowed."""
    table = flight(controller__surface_rate=rate, hardware__attitude_noise=2e-5, hardware__rate_noise=1e-5)
    law, normals = parts(20.0, surface_rate=rate).controller, np.random.default_rng(1).normal(size=(20_000, 6))
    rest = Target(vector(0.0, 0.0, 0.0, 1.0), jnp.zeros(3), jnp.zeros(3))

    def s(n):
        q = attitude.multiply(rest.q, attitude.from_rotation_vector(2e-5 * n[:3]))
        seen = AttitudeState(q, 1e-5 * n[3:])
        return commanded(law, vector(25.0), jnp.asarray(True), seen, rest, jnp.zeros(3), vector(0.0))[1]

    found = np.std(np.asarray(jax.jit(jax.vmap(s))(vector(normals))), axis=0)
    np.testing.assert_allclose(found, noise_of_s(table), rtol=0.015)


def test_the_noise_of_s_of_a_chain_has_the_weights_of_the_surface():
    """The surface is s = x_3 + 2 c x_2 + c^2 x_1 with c = 3."""
    tables = {
        "plant": {"kind": "chain", "order": 3},
        "controller": {"surface_rate": 3.0},
        "loop": {"mode": "sampled"},
        "hardware": {"state_noise": [4e-4, 3e-4, 1e-3]},
    }
    expected = math.sqrt(3.6e-3**2 + 1.8e-3**2 + 1e-3**2)
    np.testing.assert_allclose(noise_of_s(scenario.from_tables(tables)), expected)
    assert noise_of_s(scenario.from_tables({})) == 0.0


def test_noise_hides_a_boundary_layer_below_the_smallest_useful_width():
    """The mean derivative of tanh((s + n) / width) at s = 0 is E[sech^2(n / width)] / width, here by quadrature."""
    noise = 3e-6
    width = scales.narrowest_useful_width(noise)
    z = np.linspace(-30.0, 30.0, 20001)  # n in units of the width
    density = np.exp(-0.5 * (z * width / noise) ** 2) / math.sqrt(2 * math.pi) / noise
    slope = np.trapezoid(density / np.cosh(z) ** 2, z)
    # the next term of the series is proportional to (width / noise)^4, a seventh of the first term at 5 %
    np.testing.assert_allclose(1.0 - slope / (math.sqrt(2 / math.pi) / noise), 0.05, rtol=0.2)


def test_useful_boundary_layers_scale_with_the_noise():
    """Without noise, they scale with 1 / t_f."""
    noise = 0.5 * math.hypot(1e-6, 2e-5)
    low, high = scales.width_range(flight())
    np.testing.assert_allclose([low, high], [math.sqrt(1.2) / math.pi * noise, 1e4 * noise])
    assert scales.width_range(flight(hardware__attitude_noise=0.0, hardware__rate_noise=0.0)) == pytest.approx(
        (1e-5, 1e-1)
    )
    slow = scenario.from_tables({"controller": {"t_f": 120.0}, "loop": {"mode": "sampled"}})
    assert scales.width_range(slow) == pytest.approx((2.5e-6, 2.5e-2))  # four times the published t_f: a quarter of s
    arm = {**ARM, "loop": {"mode": "sampled"}, "hardware": {"state_noise": [3e-4, 4e-4]},
           "controller": {"surface_rate": 2.0}}  # fmt: skip
    np.testing.assert_allclose(noise_of_s(scenario.from_tables(arm)), math.hypot(6e-4, 4e-4))
