"""Hardware errors that the flight software does not know: simulated trials against independently built parts."""

from dataclasses import replace

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from ptsmc_jax import formulas, scenario
from ptsmc_jax.campaigns import runs
from ptsmc_jax.devices import actuators
from ptsmc_jax.dispersions.numbers import TRUNCATION_SIGMAS
from ptsmc_jax.dispersions.quantities import QUANTITIES, read_columns
from ptsmc_jax.numerics import draws, paths
from ptsmc_jax.plants import flexible_body
from ptsmc_jax.simulation import control_period
from tests.helpers import fly, short, vector

FLIGHT = {
    "flexible": {"frequency": [3.0, 5.0], "damping": [0.01, 0.01], "coupling": [[1.2, 0.0, 0.3], [0.1, 0.9, 0.0]]},
    "controller": {"t_f": 5.0, "delta": 0.5, "error": "multiplicative"},
    "initial": {"rotvec_deg": [20.0, -10.0, 5.0]},
    "loop": {"mode": "sampled", "period": 0.25, "t_end": 7.0},
    "hardware": {"attitude_noise": 1e-5, "rate_noise": 1e-6},
}
DISPERSION = {
    "actuator_scale": {"kind": "relative_normal", "std": 0.05},
    "actuator_misalignment": {"kind": "normal", "std_deg": 1.0},
    "star_tracker_misalignment": {"kind": "uniform", "half_width_deg": 0.5},
    "gyro_scale": {"kind": "relative_uniform", "half_width": 0.02},
    "mode_frequency": {"kind": "relative_normal", "std": 0.1},
    "mode_coupling": {"kind": "relative_uniform", "half_width": 0.2},
}


def enlarged(parts):
    """Return the parts with 84 periods of 30 integration steps, so that several runs use one compiled program."""
    return replace(parts, clock=replace(parts.clock, count=84), substeps=30)


@pytest.fixture(scope="module")
def dispersed():
    """Return the study of a flexible spacecraft with dispersed hardware errors, without outage, failure and jitter."""
    ready = scenario.study(scenario.from_tables({**FLIGHT, "dispersion": DISPERSION}))
    hardware = {name for name, quantity in QUANTITIES.items() if quantity.hardware}
    assert set(ready.dispersion.kinds) == hardware - {"star_tracker_outage", "wheel_failure", "timing_jitter"}
    return replace(ready, parts=enlarged(ready.parts))


def numbers(row, name, *shape):
    """Return the values of a quantity as an array of this shape; row: {column: value} of a trial."""
    values = [v for key, v in row.items() if key.rpartition("_")[0] == name]
    return vector(np.array(values).reshape(shape))


def with_hardware_errors(parts, frequency, coupling, device, sensors):
    """Return the parts of the flexible spacecraft with these hardware errors.

    frequency: of the modes [rad/s]. coupling: (modes, 3). device: arguments of `Actuators`. sensors: changed fields of
    the sensors.
    """
    body = parts.plant
    plant = flexible_body.flexible(body.inertia, frequency, body.damping, coupling).with_rest_inverse()
    device, sensors = actuators.Actuators(**device), replace(parts.sensors, **sensors)
    return replace(parts, plant=plant, actuators=device, sensors=sensors)


METRICS = ("window_error", "peak_torque", "effort", "residual_modal", "peak_torque_delivered")


def test_every_trial_equals_a_run_that_is_built_from_its_row_of_hardware_errors(dispersed):
    trials = [runs.simulate(dispersed, 5, trial) for trial in range(3)]
    for trial, run in enumerate(trials):
        row = dispersed.dispersion.values(run.parts)
        rebuilt = with_hardware_errors(
            dispersed.parts,
            numbers(row, "mode_frequency", 2),
            numbers(row, "mode_coupling", 2, 3),
            {"scale": numbers(row, "actuator_scale", 3),
             "directions": numbers(row, "actuator_misalignment", 3, 3).T},
            {"misalignment": numbers(row, "star_tracker_misalignment", 3),
             "rate_scale": numbers(row, "gyro_scale", 3)},
        )  # fmt: skip
        found = fly(rebuilt, 5, trial).metrics
        for name in METRICS:
            np.testing.assert_allclose(run.metrics[name], getattr(found, name), rtol=1e-11, err_msg=name)
    assert np.ptp([run.metrics["window_error"] for run in trials]) > 1e-5


def test_torque_on_the_body_has_scale_and_misalignment_that_the_flight_software_does_not_know(dispersed):
    """The misaligned directions are unit vectors."""
    run = runs.simulate(dispersed, 5, 1)
    device = run.parts.actuators
    assert device is not None
    delivered = run.log.commanded[:-1] * np.asarray(device.scale)
    np.testing.assert_allclose(run.log.u[:-1], delivered @ np.asarray(device.directions).T, rtol=0, atol=1e-14)
    directions = np.asarray(device.directions)
    np.testing.assert_allclose(np.linalg.norm(directions, axis=0), 1.0, rtol=1e-14)
    assert 1e-3 < np.abs(directions - np.eye(3)).max() < 0.1
    assert device.nominal == actuators.Actuators()


def test_dispersions_of_width_zero_do_not_change_the_parts():
    none = {key: {"kind": v["kind"], **{k: 0.0 for k in v if k != "kind"}} for key, v in DISPERSION.items()}
    plain = scenario.study(scenario.from_tables(FLIGHT))
    zero = scenario.study(scenario.from_tables({**FLIGHT, "dispersion": none}))
    assert not zero.dispersion.varies
    assert jax.tree.structure(zero.parts) == jax.tree.structure(plain.parts)
    for one, other in zip(jax.tree.leaves(zero.parts), jax.tree.leaves(plain.parts), strict=True):
        np.testing.assert_array_equal(one, other)


def test_star_tracker_misalignment_rotates_the_final_attitude_by_its_opposite():
    """Without noise, disturbance and flexible modes, the law brings the measured attitude to the target."""
    tables = {
        **FLIGHT,
        "controller": {"t_f": 5.0, "delta": 0.5, "error": "multiplicative", "k1": 4.0, "surface_rate": 2.0},
        "initial": {"rotvec_deg": [2.0, 0.0, 0.0]},
        "disturbance": {"amplitude": [0.0, 0.0, 0.0]},
        "loop": {"mode": "sampled", "period": 0.25, "t_end": 20.0},
        "hardware": {"attitude_noise": 0.0, "rate_noise": 0.0},
    }
    parts = scenario.study(scenario.from_tables(tables)).parts
    turn, rigid = np.array([1e-3, -2e-3, 5e-4]), vector(np.zeros((2, 3)))
    device = {"scale": vector(np.ones(3)), "directions": vector(np.eye(3))}
    sensors = {"misalignment": vector(turn), "rate_scale": vector(np.ones(3))}
    log = fly(with_hardware_errors(enlarged(parts), vector([3.0, 5.0]), rigid, device, sensors)).log
    np.testing.assert_allclose(Rotation.from_quat(log.x.q[-1]).as_rotvec(), -turn, rtol=0, atol=1e-9)


def test_wheels_with_scale_and_misalignment_deliver_and_store_momentum_along_their_true_axes():
    """A failed wheel delivers no torque and keeps its momentum."""
    wheels = actuators.wheels(formulas.pyramid(), [0.5, -0.2, 0.1, 0.3])
    turned = np.array(wheels.axes) + 0.02 * np.random.default_rng(0).normal(size=(3, 4))
    scale, command = np.array([1.1, 0.9, 1.05, 0.95]), vector([0.13, -0.2, 0.25])
    device = actuators.Actuators(wheels=wheels, scale=vector(scale), directions=vector(turned))
    start, dt = device.begin(3), vector(0.5)
    drive, queue = device.command(start, command, vector(np.zeros(3)), vector(0.0), dt, vector(1.0))
    torque = scale * (np.linalg.pinv(np.array(wheels.axes)) @ np.array(command))
    assert np.abs(torque).min() > 1e-2
    stored = np.array([0.5, -0.2, 0.1, 0.3])
    applied = device.torque_over(drive, vector(0.2), vector(0.1))
    np.testing.assert_allclose(applied.mean, turned @ torque, rtol=1e-13)
    np.testing.assert_allclose(np.asarray(applied.stored), turned @ (stored - 0.2 * torque), rtol=1e-13)
    np.testing.assert_allclose(device.on_body(device.torque_and_momentum(drive, dt)[0]), turned @ torque, rtol=1e-13)
    np.testing.assert_allclose(np.asarray(device.end(start, drive, queue, dt).h), stored - 0.5 * torque, rtol=1e-13)
    failing = replace(device, failure_times=vector([np.inf, 0.0, np.inf, np.inf]))  # unknown to the flight software
    drive, queue = failing.command(start, command, vector(np.zeros(3)), vector(0.0), dt, vector(1.0))
    torque[1] = 0.0
    np.testing.assert_allclose(failing.on_body(failing.torque_and_momentum(drive, dt)[0]), turned @ torque, rtol=1e-13)
    np.testing.assert_allclose(np.asarray(failing.end(start, drive, queue, dt).h), stored - 0.5 * torque, rtol=1e-13)


WHEELED = {
    **{key: FLIGHT[key] for key in ("controller", "initial", "loop", "hardware")},
    "wheels": {"momentum": [0.5, -0.2, 0.1, 0.3]},
    "filter": {"kind": "steady_state"},
}


@pytest.mark.parametrize("known", short([False, True], [True]))
def test_other_wheels_take_over_a_failure_if_it_is_known(known):
    """The failed wheel has no torque and constant momentum. If it is not known, the delivered torque is wrong."""
    failure = {"kind": "uniform", "earliest": 1.0, "latest": 3.0, "known": known}
    dispersion = {"wheel_failure": failure, "star_tracker_outage": {"kind": "uniform", "duration": 0.5, "latest": 3.0}}
    ready = scenario.study(scenario.from_tables({**WHEELED, "dispersion": dispersion}))
    run = runs.simulate(ready, 0, 2)
    row = {key: float(v) for key, v in ready.dispersion.values(run.parts).items() if key.startswith("wheel_")}
    when, wheel = row["wheel_failure_time"], round(row["wheel_failure_wheel"]) - 1
    assert 1.0 <= when <= 3.0
    log = run.log
    assert log.wheels is not None
    after = log.t >= when
    assert np.all(log.wheels[1][after][:-1, wheel] == 0.0)
    assert np.all(np.abs(log.wheels[1][~after][:, wheel]) > 0.0)
    assert np.ptp(log.wheels[0][after][:, wheel]) == 0.0
    # the torque on the body equals the command plus w x A h as long as all wheels work or the failure is known
    wheels = run.parts.actuators.wheels
    assert wheels is not None
    stored = log.wheels[0] @ np.asarray(wheels.axes).T
    expected = log.commanded + np.cross(log.x.w, stored)  # at the true rate; the flight software uses the gyro rate
    deviation = np.linalg.norm(log.u - expected, axis=1)[:-1]
    assert np.all(deviation[~after[:-1]] < 1e-5)
    assert np.all(deviation[after[:-1]] < 1e-5) == known


def test_all_wheels_fail_with_equal_probability_and_default_times_extend_to_the_end_of_the_run():
    dispersion = {"wheel_failure": {"kind": "uniform"}, "star_tracker_outage": {"kind": "uniform", "duration": 0.5}}
    known = {"wheel_failure": {"kind": "uniform", "known": True}}
    parts = scenario.study(scenario.from_tables({**WHEELED, "dispersion": known})).parts
    assert parts.actuators.spare_allocations is not None
    ready = scenario.study(scenario.from_tables({**WHEELED, "dispersion": dispersion}))
    assert ready.parts.actuators.spare_allocations is None  # the other wheels do not take over
    for k in range(4):
        for fraction in (0.01, 0.99):
            c = {"wheel_failure": vector([1.0, (k + fraction) / 4]), "star_tracker_outage": vector([1.0])}
            row = read_columns(ready.dispersion.at(ready.parts, c), dispersion)
            assert {name: float(v) for name, v in row.items()} == {
                "star_tracker_outage_begin": 7.0, "star_tracker_outage_end": 7.5,
                "wheel_failure_time": 7.0, "wheel_failure_wheel": k + 1.0,
            }  # fmt: skip


def test_star_tracker_outage_of_the_whole_run_equals_a_filter_without_corrections():
    """One wheel would fail after the end of the run, so that the program includes wheel failures."""
    lasting = {"kind": "uniform", "duration": 100.0, "latest": 0.0}
    after_end = {"kind": "uniform", "earliest": 50.0, "latest": 60.0, "known": True}
    dispersion = {"star_tracker_outage": lasting, "wheel_failure": after_end}
    ready = scenario.study(scenario.from_tables({**WHEELED, "dispersion": dispersion}))
    run = runs.simulate(ready, 0, 0)
    assert {key: float(v) for key, v in ready.dispersion.values(run.parts).items()}["star_tracker_outage_begin"] == 0.0
    no_outage = replace(run.parts.sensors, outage=vector([50.0, 60.0]))  # after the end
    assert no_outage.filter is not None
    idle = replace(no_outage.filter, attitude_gain=0.0 * no_outage.filter.attitude_gain,
                   bias_gain=0.0 * no_outage.filter.bias_gain)  # fmt: skip
    other = fly(replace(run.parts, sensors=replace(no_outage, filter=idle)))
    np.testing.assert_allclose(run.metrics["window_error"], other.metrics.window_error, rtol=1e-12)
    corrected = fly(replace(run.parts, sensors=no_outage))
    assert abs(float(corrected.metrics.window_error) / run.metrics["window_error"] - 1.0) > 1e-6


CHAIN = {
    "plant": {"kind": "chain", "order": 2, "x0": [1.0, -0.3]},
    "controller": {"t_f": 5.0, "delta": 0.45, "disturbance_bound": 0.0},
    "disturbance": {"kind": "constant", "amplitude": [0.01]},
    "loop": {"mode": "sampled", "period": 0.1, "t_end": 7.0},
    "hardware": {"state_noise": [0.0, 0.0]},
    "dispersion": {"timing_jitter": {"kind": "uniform", "largest": 0.4, "smallest": 0.2}},
}


def test_timing_jitter_equals_an_independent_loop():
    """The motion of the double integrator is exact over periods of any length. The law assumes nominal periods."""
    ready = scenario.study(scenario.from_tables(CHAIN))
    run = runs.simulate(ready, 3, 2)
    jitter = float(ready.dispersion.values(run.parts)["timing_jitter"])
    assert 0.2 <= jitter <= 0.4
    key, h, x = draws.stream(3, 2, control_period.SAMPLE_TIMES), 0.1, np.array([1.0, -0.3])
    nodes = np.maximum(4.55 + h * np.arange(-46, 26), 0.0).clip(max=7.0)
    largest = np.minimum(jitter * h, np.minimum(nodes, 7.0 - nodes) / 2.0)
    number = np.arange(-46, 26)
    uniform = np.array([float(draws.uniforms(key, 1, int(k))[0]) for k in number])
    true = nodes + largest * (2.0 * uniform - 1.0)
    kept = np.flatnonzero(np.diff(nodes) > 0.0)
    times, states = [], []
    for k in kept:
        times.append(true[k])
        states.append(x)
        tau, hold = 5.0 - nodes[k], number[k] >= 0
        u = -x[1] - (x[1] + x[0]) if hold else -(2.0 * x[1] / tau + 3.0 * (tau * x[1] + 3.0 * x[0]) / tau**2)
        dt = true[k + 1] - true[k]
        x = np.array([x[0] + dt * x[1] + dt**2 / 2 * (u + 0.01), x[1] + dt * (u + 0.01)])
    log = run.log
    np.testing.assert_allclose(log.t[:-1], times, rtol=1e-14, atol=1e-14)
    np.testing.assert_allclose(log.x[:-1], states, rtol=1e-12, atol=1e-12)
    assert np.abs(np.diff(times) / h - 1.0).max() > 0.2


def test_error_with_timing_jitter_is_relative_to_the_reference_at_the_true_time():
    """The flight software uses the reference at the nominal time."""
    tables = {key: FLIGHT[key] for key in ("controller", "initial", "loop")}
    spin = {"kind": "spin", "rate": [0.0, 0.0, 0.2]}
    tables |= {"reference": spin, "dispersion": CHAIN["dispersion"]}
    run = runs.simulate(scenario.study(scenario.from_tables(tables)), 3, 2)
    log = run.log
    np.testing.assert_allclose(log.reference.q[:, 2], np.sin(0.1 * log.t), rtol=0, atol=1e-14)
    later = max(np.linalg.norm(log.error[log.t > 5.0], axis=1))
    np.testing.assert_allclose(run.metrics["hold_error"], max(later, run.metrics["terminal_error"]), rtol=1e-12)


JITTER_CASES = [
    pytest.param({**CHAIN, "hardware": {"state_noise": [1e-4, 1e-4]}}, id="chain with noise"),
    pytest.param(FLIGHT, id="flexible spacecraft with noise", marks=pytest.mark.long),
]


@pytest.mark.parametrize("tables", JITTER_CASES)
def test_timing_jitter_of_zero_changes_no_digit_of_the_metrics(tables):
    parts = scenario.study(scenario.from_tables({**tables, "dispersion": {}})).parts
    one, other = (fly(p, 5, 1) for p in (parts, replace(parts, jitter=vector(0.0))))
    for name, value in one.metrics.items():
        np.testing.assert_array_equal(value, getattr(other.metrics, name), err_msg=name)


@pytest.mark.parametrize(
    ("coupling", "inertia"),
    [
        ({"kind": "relative_uniform", "half_width": 0.054}, {}),  # 10 kg m^2 = (1.0541 * 3)^2
        ({"kind": "relative_normal", "std": 0.018}, {}),
        ({"kind": "relative_uniform", "half_width": 0.021}, {"kind": "relative_normal", "std": 0.02}),
    ],
)
def test_widest_allowed_modal_coupling_is_physical_and_a_wider_one_is_refused(coupling, inertia):
    """The extreme has the longest coupling rows and the smallest moments. A width larger by a tenth is refused."""
    dispersion = {"mode_coupling": coupling, **({"inertia": inertia} if inertia else {})}
    tables = {**FLIGHT, "spacecraft": {"inertia": [10.0, 12.0, 14.0]},
              "flexible": {"frequency": [6.0], "coupling": [[3.0, 0.0, 0.0]]}, "dispersion": dispersion}  # fmt: skip
    ready = scenario.study(scenario.from_tables(tables))
    ends = {"mode_coupling": vector([1.0]), "inertia": jnp.zeros(67).at[:3].set(-TRUNCATION_SIGMAS)}
    plant = paths.get(ready.dispersion.at(ready.parts, ends), "plant")
    smallest = np.linalg.eigvalsh(plant.rest_inertia)[0]
    assert 0.0 < smallest < 0.05
    np.testing.assert_allclose(plant.rest_inertia @ plant.rest_inverse, np.eye(3), rtol=0, atol=1e-9)
    wider = {key: value * 1.1 if key != "kind" else value for key, value in coupling.items()}
    with pytest.raises(scenario.ScenarioError, match="must be positive definite"):
        scenario.from_tables({**tables, "dispersion": {**dispersion, "mode_coupling": wider}})


@pytest.mark.parametrize(
    ("frequency", "largest"),
    [({"kind": "relative_uniform", "half_width": 0.4}, 1.4), ({"kind": "relative_normal", "std": 0.1}, 1.3)],
)
def test_integration_steps_resolve_the_fastest_dispersed_mode(frequency, largest):
    found = []
    for dispersion in ({}, {"mode_frequency": frequency}):
        known = scenario.from_tables({**FLIGHT, "dispersion": dispersion})
        found.append(known.frequencies(scenario.study(known).parts, 5.0)["flexible.frequency"])
    assert found[1] / found[0] == pytest.approx(largest)
