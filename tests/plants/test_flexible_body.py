"""The flexible body: an independent integration, energy and momentum, mode frequencies, and metrics of the modes."""

from dataclasses import replace

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from scipy.integrate import solve_ivp

from ptsmc_jax import formulas, scenario
from ptsmc_jax.campaigns import runs
from ptsmc_jax.plants import flexible_body, rigid_body
from ptsmc_jax.simulation import control_period
from tests.helpers import undocumented, vector

FINE = 40  # steps per control period
EPS = np.finfo(float).eps
# the satellite of Di Gennaro: four modes, full tensor
INERTIA = np.array([[350.0, 3.0, 4.0], [3.0, 270.0, 10.0], [4.0, 10.0, 190.0]])
FREQUENCY, DAMPING = [0.7681, 1.1038, 1.8733, 2.5496], [0.0056, 0.0086, 0.013, 0.025]
COUPLING = [
    [6.45637, 1.27814, 2.15629],
    [-1.25619, 0.91756, -1.67264],
    [1.11687, 2.48901, -0.83674],
    [1.23637, -2.6581, -1.12503],
]
SATELLITE = {
    "spacecraft": {"inertia": INERTIA.tolist()},
    "flexible": {"frequency": FREQUENCY, "damping": DAMPING, "coupling": COUPLING},
    "initial": {"rotvec_deg": [30.0, -20.0, 40.0], "rate": [0.01, -0.02, 0.015]},
    "controller": {
        "t_f": 12.0, "delta": 1.0, "eta": 3.0, "k1": 1.0, "surface_rate": 1.0, "sign_width": 1e-3,
        "error": "multiplicative",
    },
    "disturbance": {"amplitude": [0.01] * 3, "frequency": [0.1] * 3},
    "observer": {"gain": [200.0, 200.0, 200.0]},
    "loop": {"mode": "sampled", "period": 0.25, "t_end": 16.0, "window": 1.0},
}  # fmt: skip


def body(damping=DAMPING):
    """Return the plant of a flexible body with four modes; damping: ratio of each mode."""
    return flexible_body.flexible(INERTIA, FREQUENCY, damping, COUPLING)


def state(seed):
    """Return a random attitude, rate and state of the modes as an `AttitudeState`."""
    rng = np.random.default_rng(seed)
    q = rng.normal(size=4)
    modes = flexible_body.Modes(vector(rng.normal(size=4)), vector(rng.normal(size=4)))
    return rigid_body.AttitudeState(vector(q / np.linalg.norm(q)), vector(0.1 * rng.normal(size=3)), modes)


def independent(t, y, torque):
    """Return the rates (15,) of q, w, e and psi = e' + D w, written out in NumPy; y: (15,), torque: (3,)."""
    q, w, e, psi = y[:4], y[4:7], y[7:11], y[11:]
    D, W, z = np.array(COUPLING), np.array(FREQUENCY), np.array(DAMPING)
    moved = 2 * z * W * psi + W**2 * e - 2 * z * W * (D @ w)
    J0 = INERTIA - D.T @ D
    d = 0.01 * np.sin(0.1 * t) * np.ones(3)
    w_dot = np.linalg.solve(J0, -np.cross(w, J0 @ w + D.T @ psi) + D.T @ moved + torque + d)
    q_dot = 0.5 * np.append(q[3] * w + np.cross(q[:3], w), -q[:3] @ w)
    return np.concatenate([q_dot, w_dot, psi - D @ w, -moved])


@pytest.fixture(scope="module")
def simulated():
    """Return a sampled run of the satellite with steps of 0.025 rad of the fastest mode.

    The error of these steps is about 1e-11.
    """
    ready = scenario.study(scenario.from_tables(SATELLITE))
    return runs.simulate(replace(ready, parts=replace(ready.parts, substeps=FINE)))


def test_run_of_a_flexible_body_matches_an_independent_integration(simulated):
    log, D = simulated.log, np.array(COUPLING)
    modes = log.x.modes
    y = np.concatenate([log.x.q[0], log.x.w[0], np.zeros(4), D @ log.x.w[0]])
    for k in range(len(log.t) - 1):
        y = solve_ivp(independent, log.t[k : k + 2], y, method="DOP853", rtol=1e-12, atol=1e-14, args=(log.u[k],)).y[
            :, -1
        ]
        np.testing.assert_allclose(log.x.q[k + 1], y[:4], rtol=0, atol=1e-9)
        np.testing.assert_allclose(log.x.w[k + 1], y[4:7], rtol=0, atol=1e-9)
        np.testing.assert_allclose(modes.e[k + 1], y[7:11], rtol=0, atol=1e-9)
        np.testing.assert_allclose(modes.rate[k + 1], y[11:] - D @ y[4:7], rtol=0, atol=1e-9)
    assert np.abs(modes.e).max() > 1e-3  # the modes were excited


def test_default_steps_keep_modes_accurate_to_a_millionth_for_given_torques(simulated):
    """The torques of the run are applied with the default steps. The test below includes the loop."""
    made, log = scenario.study(scenario.from_tables(SATELLITE)).parts, simulated.log
    actuators = made.actuators
    assert 1 < made.substeps < 20

    @jax.jit
    def moved(x, t, u):
        def simulate_period(x, now):
            t, t_next, u = now
            drive, _ = actuators.command(actuators.begin(3), u, x.w, t, t_next - t, jnp.ones(()))
            x = control_period.state_after(made, t, x, drive, None, t_next - t)
            return x, x

        return jax.lax.scan(simulate_period, x, (t[:-1], t[1:], u[:-1]))[1]

    found = moved(jax.tree.map(lambda v: jnp.asarray(v[0]), log.x), *map(jnp.asarray, (log.t, log.u)))
    np.testing.assert_allclose(found.modes.e, log.x.modes.e[1:], rtol=0, atol=1e-5)
    np.testing.assert_allclose(found.q, log.x.q[1:], rtol=0, atol=1e-7)


def test_metrics_and_columns_of_the_modes_match_the_history(simulated):
    """The peak momentum includes the momentum of the modes."""
    log, metrics = simulated.log, simulated.metrics
    size = np.sqrt(np.sum(log.x.modes.e**2 + (log.x.modes.rate / FREQUENCY) ** 2, axis=1))
    np.testing.assert_allclose(metrics["peak_modal"], size.max(), rtol=1e-13)
    np.testing.assert_allclose(metrics["residual_modal"], size[log.t >= 12.0].max(), rtol=1e-13)
    assert metrics["residual_modal"] < metrics["peak_modal"]
    columns = simulated.columns()
    assert undocumented(columns) == set()
    modes = [*(f"e{k}" for k in range(1, 5)), *(f"e_dot{k}" for k in range(1, 5))]
    assert [name for name in columns if name in modes] == modes
    np.testing.assert_array_equal(columns["e_dot2"], log.x.modes.rate[:, 1])
    D = np.array(COUPLING)
    np.testing.assert_allclose(
        metrics["peak_momentum"], np.linalg.norm(log.x.w @ INERTIA + log.x.modes.rate @ D, axis=1).max(), rtol=1e-13
    )


def test_a_rigid_body_has_no_metrics_of_modes():
    ready = scenario.study(scenario.from_tables({}))
    assert not any("modal" in name for name in ready.catalogue)
    assert ready.parts.initial.modes is None


def energy_of(plant, x):
    """Return the kinetic and elastic energy [J], (w'J w + 2 w'D'e' + |e'|^2 + |W e|^2) / 2, of a body."""
    e, rate = x.modes
    kinetic = x.w @ plant.inertia @ x.w + 2.0 * x.w @ (plant.coupling.T @ rate) + rate @ rate
    return (kinetic + jnp.sum((plant.frequency * e) ** 2)) / 2.0


@pytest.mark.parametrize("seed", range(3))
def test_free_motion_loses_the_damped_energy_and_conserves_momentum(seed):
    plant, x = body(), state(seed)
    x_dot = plant.rate(vector(0.0), x, jnp.zeros(3), jnp.zeros(3))
    momentum, turned = jax.jvp(plant.momentum, (x,), (x_dot,))
    scale = float(jnp.linalg.norm(momentum)) * np.linalg.norm(x.w) + float(jnp.linalg.norm(plant.force(x.modes))) * 10
    # the momentum is constant in inertial axes: h' = -w x h in body axes
    np.testing.assert_allclose(turned, -np.cross(x.w, momentum), rtol=0, atol=50 * EPS * scale)
    energy, falls = jax.jvp(lambda x: energy_of(plant, x), (x,), (x_dot,))
    taken = 2.0 * np.sum(np.array(DAMPING) * FREQUENCY * np.asarray(x.modes.rate) ** 2)
    np.testing.assert_allclose(falls, -taken, rtol=0, atol=200 * EPS * scale)
    assert taken > 1e-3 * float(energy) > 0.0


def test_a_free_undamped_mode_has_the_frequency_of_the_formula():
    J, d, W = np.array([12.0, 9.0, 11.0]), 1.7, 3.0
    plant = flexible_body.flexible(J, [W], [0.0], [[d, 0.0, 0.0]])
    rest = plant.with_hidden_at_rest(rigid_body.AttitudeState(vector([0.0, 0.0, 0.0, 1.0]), jnp.zeros(3)))
    start = rest._replace(modes=flexible_body.Modes(vector([0.1]), vector([0.0])))
    (omega,) = formulas.free_mode_frequencies(np.diag(J), [W], [[d, 0.0, 0.0]])
    np.testing.assert_allclose(omega, W / np.sqrt(1 - d**2 / J[0]), rtol=1e-12)
    rates = plant.rate(vector(0.0), start, jnp.zeros(3), jnp.zeros(3)).modes
    np.testing.assert_allclose(rates.rate, -(omega**2) * start.modes.e, rtol=1e-12)


def test_a_random_inertia_changes_the_inertia_without_modes_and_an_impossible_body_diverges():
    """A body with less inertia than its modes is impossible."""
    plant = body()
    drawn = plant.with_inertia(*(vector(v) for v in (1.1 * INERTIA, np.linalg.inv(1.1 * INERTIA))))
    rest = 1.1 * INERTIA - np.array(COUPLING).T @ np.array(COUPLING)
    np.testing.assert_allclose(drawn.rest_inverse, np.linalg.inv(rest), rtol=1e-12)
    np.testing.assert_allclose(plant.with_rest_inverse().rest_inverse, plant.rest_inverse, rtol=1e-12)
    light = plant.with_inertia(*(vector(v) for v in (0.1 * INERTIA, np.linalg.inv(0.1 * INERTIA))))
    ready = scenario.study(scenario.from_tables(SATELLITE))
    run = runs.simulate(replace(ready, parts=replace(ready.parts, plant=light, substeps=FINE)))
    assert run.status == "diverged"


@pytest.mark.parametrize("too_far", [(0,), (1,), (2,), (0, 1), (0, 2), (1, 2), (0, 1, 2)])
def test_inverse_inertia_is_nan_if_the_modes_have_more_inertia_than_the_body(too_far):
    """With two such axes, the determinant of J - D'D is positive again."""
    coupling = np.diag([1.5 if axis in too_far else 0.5 for axis in range(3)])
    plain = flexible_body.flexible(4.0 * np.eye(3), [1.0] * 3, [0.01] * 3, coupling)
    one = vector(np.eye(3))
    assert np.all(np.isnan(plain.with_inertia(one, one).rest_inverse))


def test_retract_and_local_coordinates_of_a_flexible_body_are_inverse_functions():
    plant, x = body(), state(2)
    by = vector(1e-7 * np.random.default_rng(0).normal(size=14))
    np.testing.assert_allclose(plant.local_coordinates(x, plant.retract(x, by)), by, rtol=0, atol=1e-14)
