"""References of missions against orbits, frames and rates that NumPy computes from vectors."""

import json
from dataclasses import replace
from pathlib import Path
from typing import Any

import jax.numpy as jnp
import numpy as np
import pytest
from scipy.optimize import brentq
from scipy.spatial.transform import Rotation

from ptsmc_jax import scenario
from ptsmc_jax.batching import lanes, lapack
from ptsmc_jax.plants.rigid_body import AttitudeState
from ptsmc_jax.scenario import epochs, plausibility
from ptsmc_jax.scenario.errors import ScenarioError
from ptsmc_jax.signals import orbits
from tests.helpers import refuses

MU, EARTH_RATE = 3.986004418e14, 7.292115e-5
ORBIT = {"semi_major_axis": 7.2e6, "eccentricity": 0.08, "inclination": 1.7, "ascending_node": 0.6, "perigee": -1.1,
         "true_anomaly": 2.0, "earth_angle": 0.9}  # fmt: skip
AXES = {"primary_axis": [0.2, -0.1, 1.0], "secondary_axis": [1.0, 0.3, 0.1]}
TARGET = {"latitude": "12 deg", "longitude": "-25 deg", "height": 250.0}
MULTIPLICATIVE = {"controller": {"error": "multiplicative"}}
SUN = {"loop": {"epoch": "2026-06-01T06:00:00"}}
TOLERANCE = 1e-9  # rad, rad/s; rounding of angles that grow to 10 rad is 1e-14


def build_reference(table, orbit=ORBIT, **others):
    """Return the reference of a scenario with this table [reference] and orbit; others: other tables."""
    read: Any = scenario.from_tables({"orbit": orbit, "reference": table, **MULTIPLICATIVE, **others})
    return read.reference.build(read)


def state(t, orbit=ORBIT):
    """Return position [m], velocity and acceleration, (3,) each, on an orbit in inertial axes, computed by NumPy."""
    a, e, f_0 = orbit["semi_major_axis"], orbit["eccentricity"], orbit["true_anomaly"]
    e_0 = 2.0 * np.arctan(np.sqrt((1.0 - e) / (1.0 + e)) * np.tan(f_0 / 2.0))
    mean = e_0 - e * np.sin(e_0) + np.sqrt(MU / a**3) * t
    eccentric = brentq(lambda x: x - e * np.sin(x) - mean, mean - 1.0, mean + 1.0, xtol=1e-15, rtol=1e-15)
    plane = Rotation.from_euler("ZXZ", [orbit["ascending_node"], orbit["inclination"], orbit["perigee"]])
    radius, b = a * (1.0 - e * np.cos(eccentric)), np.sqrt(1.0 - e * e)
    r = plane.apply([a * (np.cos(eccentric) - e), a * b * np.sin(eccentric), 0.0])
    v = plane.apply(np.array([-np.sin(eccentric), b * np.cos(eccentric), 0.0]) * np.sqrt(MU * a) / radius)
    return r, v, -MU * r / radius**3


def unit_rate(p, p_dot):
    """Return the unit vector along p (3,), and its time derivative; p_dot: derivative of p."""
    size = np.linalg.norm(p)
    return p / size, p_dot / size - p * (p @ p_dot) / size**3


def frame(first, second):
    """Return the rotation matrix of a body whose axes `AXES` follow two directions, and its rate in body axes [rad/s].

    first, second: each a vector and its derivative.
    """
    (p, p_dot), (s, s_dot) = unit_rate(*first), second
    n, n_dot = unit_rate(np.cross(p, s), np.cross(p_dot, s) + np.cross(p, s_dot))
    moving = np.stack([p, n, np.cross(p, n)], axis=1)
    moving_dot = np.stack([p_dot, n_dot, np.cross(p_dot, n) + np.cross(p, n_dot)], axis=1)
    b = np.array(AXES["primary_axis"]) / np.linalg.norm(AXES["primary_axis"])
    across = np.cross(b, AXES["secondary_axis"])
    across /= np.linalg.norm(across)
    body = np.stack([b, across, np.cross(b, across)])
    matrix, change = moving @ body, moving_dot @ body
    skew = matrix.T @ change
    return matrix, np.array([skew[2, 1], skew[0, 2], skew[1, 0]])


def ground(t):
    """Return the vector (3,) from the spacecraft to the ground target [m], and its derivative; t [s]."""
    a, f = 6378137.0, 1.0 / 298.257223563
    latitude, longitude, h = np.deg2rad(12.0), np.deg2rad(-25.0), 250.0
    n = a / np.sqrt(1.0 - f * (2.0 - f) * np.sin(latitude) ** 2)
    fixed = np.array([(n + h) * np.cos(latitude) * np.cos(longitude), (n + h) * np.cos(latitude) * np.sin(longitude),
                      (n * (1.0 - f) ** 2 + h) * np.sin(latitude)])  # fmt: skip
    turned = Rotation.from_euler("z", 0.9 + EARTH_RATE * t).apply(fixed)
    r, v, _ = state(t)
    return turned - r, np.cross([0.0, 0.0, EARTH_RATE], turned) - v


def nadir(t):
    """Return the vector (3,) from the spacecraft to the centre of the Earth [m], and its derivative; t [s]."""
    r, v, _ = state(t)
    return -r, -v


def velocity(t):
    """Return the velocity (3,) of the spacecraft [m/s], and its derivative; t [s]."""
    _, v, a = state(t)
    return v, a


CASES = {
    "nadir": ({"kind": "nadir"}, nadir, velocity),
    "ground target": ({"kind": "ground_target", **TARGET}, ground, velocity),
    "inertial and nadir": (
        {"kind": "two_vector", "primary": [0.1, 0.7, -0.4], "secondary": "nadir"},
        lambda t: (np.array([0.1, 0.7, -0.4]), np.zeros(3)), nadir,
    ),
    "velocity and orbit normal": (
        {"kind": "two_vector", "primary": "velocity", "secondary": "orbit_normal"},
        velocity, lambda t: (np.cross(*state(t)[:2]), np.zeros(3)),
    ),
}  # fmt: skip


@pytest.mark.parametrize(("table", "first", "second"), CASES.values(), ids=CASES)
def test_attitude_and_rate_of_mission_references_equal_those_from_direction_vectors(table, first, second):
    reference = build_reference({**table, **AXES}, loop={"t_end": 7000.0})
    times = np.linspace(0.0, 7000.0, 57)  # more than one revolution
    targets = lapack.vmap(reference)(jnp.asarray(times))
    for t, q, w in zip(times, np.asarray(targets.q), np.asarray(targets.w), strict=True):
        matrix, rate = frame(first(t), second(t))
        off = (Rotation.from_matrix(matrix).inv() * Rotation.from_quat(q)).magnitude()
        assert off < TOLERANCE
        np.testing.assert_allclose(w, rate, rtol=0, atol=TOLERANCE)


@pytest.mark.parametrize("table", [case[0] for case in CASES.values()], ids=CASES)
def test_quaternion_of_mission_references_is_continuous_and_consistent_with_its_rates(table):
    reference = build_reference({**table, **AXES}, loop={"t_end": 7000.0})
    step = 1.0
    times = np.arange(0.0, 7000.0, step)
    targets = lapack.vmap(reference)(jnp.asarray(times))
    q, w, w_dot = map(np.asarray, targets)
    assert np.einsum("ij,ij->i", q[1:], q[:-1]).min() > 0.99  # no jump of the sign

    def derivative(y):  # six-point differences, whose error is y^(7) h^6 / 140
        return (45 * (y[4:-2] - y[2:-4]) - 9 * (y[5:-1] - y[1:-5]) + (y[6:] - y[:-6])) / (60.0 * step)

    v, s = q[3:-3, :3], q[3:-3, 3:]
    rate = w[3:-3]
    expected = 0.5 * np.concatenate([s * rate + np.cross(v, rate), -np.sum(v * rate, axis=1)[:, None]], axis=1)
    np.testing.assert_allclose(derivative(q), expected, rtol=0, atol=1e-9)
    np.testing.assert_allclose(derivative(w), w_dot[3:-3], rtol=0, atol=1e-9)


def test_nadir_reference_turns_with_the_orbit_and_points_down():
    circle = {"semi_major_axis": 6.9e6, "inclination": 0.5}
    reference = build_reference({"kind": "nadir"}, circle)
    target, place = reference(jnp.asarray(321.0)), reference.orbit(jnp.asarray(321.0))
    np.testing.assert_allclose(target.w, [0.0, -np.sqrt(MU / 6.9e6**3), 0.0], atol=1e-15)
    np.testing.assert_allclose(target.w_dot, np.zeros(3), atol=1e-15)
    down = Rotation.from_quat(np.asarray(target.q)).apply([0.0, 0.0, 1.0])
    np.testing.assert_allclose(down, -np.asarray(place.radial), atol=1e-15)


def test_nadir_and_ground_target_references_equal_those_of_basilisk():
    recorded = json.loads((Path(__file__).parent / "basilisk_references.json").read_text())
    orbit, times = recorded["orbit"] | {"earth_angle": 0.0}, jnp.asarray(recorded["times"])
    hill = {"kind": "nadir", "primary_axis": [-1, 0, 0], "secondary_axis": [0, 1, 0]}  # axes of the Hill frame
    target = lapack.vmap(build_reference(hill, orbit))(times)
    x, y, z = recorded["point"]
    place = {"latitude": np.arctan2(z, np.hypot(x, y)), "longitude": np.arctan2(y, x), "height": 0.0}
    ground = build_reference(
        {"kind": "ground_target", "primary_axis": [0, 0.6, 0.8], **place}, orbit, loop={"t_end": 6000.0}
    )
    ground = replace(ground, primary=orbits.GroundPoint(jnp.asarray(recorded["point"])))
    pointed = lapack.vmap(ground)(times)
    for k, row in enumerate(recorded["rows"]):
        matrix = Rotation.from_quat(np.asarray(target.q[k])).as_matrix().T
        np.testing.assert_allclose(matrix, row["hill_from_inertial"], rtol=0, atol=TOLERANCE)
        np.testing.assert_allclose(target.w[k], matrix @ row["rate"], rtol=0, atol=TOLERANCE)
        np.testing.assert_allclose(target.w_dot[k], matrix @ row["acceleration"], rtol=0, atol=1e-3 * TOLERANCE)
        axis = Rotation.from_quat(np.asarray(pointed.q[k])).apply([0.0, 0.6, 0.8])
        np.testing.assert_allclose(axis, row["target_direction"], rtol=0, atol=TOLERANCE)


def test_a_ground_target_below_the_horizon_causes_a_warning():
    orbit = {"inclination": 0.0, "earth_angle": 0.0}  # over longitude 0 at t = 0
    for longitude, hidden in ((0.05, False), (0.6, True)):
        table = {"kind": "ground_target", "longitude": longitude, "secondary": "orbit_normal"}
        read = scenario.from_tables({"orbit": orbit, "reference": table, **MULTIPLICATIVE})
        assert any("horizon" in text for text in plausibility.warnings(read)) == hidden


def test_gravity_gradient_is_that_of_the_orbit_and_within_its_bounds():
    read = scenario.from_tables({"orbit": ORBIT, "disturbance": {"kind": "gravity_gradient"}})
    inertia = np.diag([10.0, 12.0, 14.0])
    torque, bounds = read.disturbance.build(jnp.asarray(inertia), read), read.disturbance.bounds(read)
    turns = Rotation.random(9, random_state=1)
    for t, turn in zip(np.linspace(0.0, 6000.0, 9), turns, strict=True):
        r, _, _ = state(t)
        c = turn.inv().apply(-r / np.linalg.norm(r))
        found = torque(jnp.asarray(t), AttitudeState(jnp.asarray(turn.as_quat()), jnp.zeros(3)))
        np.testing.assert_allclose(
            found, 3.0 * MU / np.linalg.norm(r) ** 3 * np.cross(c, inertia @ c), rtol=0, atol=1e-16
        )
        assert np.all(np.abs(found) <= bounds.size)
    with pytest.raises(ScenarioError, match="orbit_rate"):
        scenario.from_tables({"orbit": ORBIT, "disturbance": {"kind": "gravity_gradient", "orbit_rate": 1e-3}})


@pytest.mark.parametrize("eccentricity", [0.0, 0.3, 0.9])
def test_radius_and_anomaly_of_an_orbit_obey_keplers_laws(eccentricity):
    orbit = build_reference({"kind": "nadir"}, ORBIT | {"eccentricity": eccentricity}).orbit
    times = np.linspace(0.0, 20_000.0, 401)
    e, p = eccentricity, 7.2e6 * (1.0 - eccentricity**2)
    places = lapack.vmap(orbit)(jnp.asarray(times))
    f, radius = np.asarray(places.anomaly), np.asarray(places.radius)
    np.testing.assert_allclose(radius, p / (1.0 + e * np.cos(f)), rtol=1e-11)
    assert np.all(np.diff(f) > 0.0)
    # Kepler's second law and its derivative: f' = h / r^2, f'' = -2 r' h / r^3
    targets = lapack.vmap(orbits.NadirReference(
        jnp.array([0.0, 0.0, 0.0, 1.0]), jnp.array([0.0, 0.0, 0.0, 1.0]), orbit))(jnp.asarray(times))  # fmt: skip
    h = np.sqrt(MU * p)
    np.testing.assert_allclose(targets.w[:, 2], h / radius**2, rtol=1e-11)
    np.testing.assert_allclose(targets.w_dot[:, 2], -2.0 * MU * e * np.sin(f) / radius**3, rtol=1e-9, atol=1e-16)


@pytest.mark.parametrize(
    ("date", "ascension"),
    [("2000-03-20T07:35:00", 0.0), ("2026-06-21T08:24:00", 90.0), ("2024-09-22T12:44:00", 180.0)],
)
def test_sun_direction_is_right_at_equinoxes_and_solstices(date, ascension):
    x, y, z = np.asarray(orbits.sun_direction(epochs.parse(date).days)(np.asarray(0.0), None, None, np))
    off = np.rad2deg(np.arctan2(y, x)) % 360.0 - ascension
    assert (off + 180.0) % 360.0 - 180.0 == pytest.approx(0.0, abs=0.02)  # half an hour
    assert np.rad2deg(np.arcsin(z)) == pytest.approx(23.44 * np.sin(np.deg2rad(ascension)), abs=0.02)


def test_earth_rotation_angle_has_the_standard_value_and_rate():
    assert orbits.earth_angle(0.0) == pytest.approx(2.0 * np.pi * 0.7790572732640, abs=1e-12)
    days = 9000.25
    rate = orbits.earth_angle(days + 1e-3) - orbits.earth_angle(days)
    assert rate / 86.4 == pytest.approx(EARTH_RATE, rel=1e-6)


def test_a_batch_of_a_ground_target_reference_equals_single_evaluations():
    """`lanes.vmap` evaluates the batch with batched components."""
    reference = build_reference({"kind": "ground_target", **TARGET}, loop={"t_end": 900.0})
    times = jnp.asarray(np.linspace(0.0, 900.0, 7))
    batched, single = lanes.vmap(reference)(times), [reference(t) for t in times]
    for name in ("q", "w", "w_dot"):
        np.testing.assert_allclose(
            getattr(batched, name), np.stack([getattr(one, name) for one in single]), rtol=0, atol=1e-14
        )


@pytest.mark.parametrize(
    ("table", "others", "named"),
    [
        ({"kind": "nadir"}, {}, "[orbit]"),
        ({"kind": "two_vector", "primary": "sun"}, {}, "loop.epoch"),
        ({"kind": "two_vector", "primary": [1, 0, 0], "secondary": [2, 0, 0]}, {}, "reference.secondary"),
        ({"kind": "two_vector", "primary": "north"}, {}, "reference.primary"),
        ({"kind": "nadir", "secondary_axis": [0, 0, 2]}, {"orbit": {}}, "reference.secondary_axis"),
        ({"kind": "ground_target", "latitude": 48.0}, {"orbit": {}}, "reference.latitude"),
        ({"kind": "nadir", "quat_xyzw": [0, 0, 0, 1]}, {"orbit": {}}, "reference.quat_xyzw"),
        ({"kind": "two_vector", "primary": "sun"}, {"loop": {"epoch": "2026-02-30T00:00:00"}}, "loop.epoch"),
        ({"kind": "fixed"}, {"loop": {"epoch": "yesterday"}}, "loop.epoch"),
    ],
)
def test_configuration_errors_of_mission_references_name_the_key(table, others, named):
    with refuses(ScenarioError, named):
        scenario.from_tables({"reference": table, **MULTIPLICATIVE, **others})
