"""The tables [[sensors]]: reading, errors, and the sensors that are built."""

import dataclasses

import jax.numpy as jnp
import jsonschema
import numpy as np
import pytest
from scipy.spatial.transform import Rotation

import ptsmc_jax as ptsmc
from ptsmc_jax import scenario
from ptsmc_jax.numerics import attitude
from ptsmc_jax.scenario import custom, parsing
from ptsmc_jax.scenario.errors import ScenarioError
from ptsmc_jax.scenario.json_schema import json_schema
from tests.helpers import refuses

ARCSEC = np.pi / 180 / 3600
TRACKER = {"kind": "star_tracker", "noise_across": "8 arcsec", "noise_about": "40 arcsec"}
GYRO = {"kind": "gyro", "rate_noise": 1e-6, "rate_bias": 1e-5, "rate_bias_walk": 1e-8}
SUN = {"kind": "vector_sensor", "direction": [0.0, 0.0, 1.0], "noise": 1e-3}
LOOP = {"mode": "sampled", "period": 0.1}


def read(*sensors, **tables):
    """Return the scenario with these tables [[sensors]] and other tables."""
    return scenario.from_tables({"loop": LOOP, "sensors": list(sensors), **tables})


def test_the_built_sensors_have_the_numbers_of_the_tables():
    made = read(
        {**TRACKER, "boresight": [1.0, 2.0, -2.0], "period": 0.25, "latency": 0.12},
        {**TRACKER, "rotvec_deg": [10.0, 20.0, 30.0]},
        SUN,
        GYRO,
    )
    suite = scenario.study(made).parts.sensors
    first, second, sun = suite.sensors
    assert [sensor.name for sensor in suite.sensors] == ["star_tracker_1", "star_tracker_2", "vector_sensor_1"]
    np.testing.assert_allclose(first.noise, np.array([8.0, 8.0, 40.0]) * ARCSEC, rtol=1e-15)
    np.testing.assert_allclose(first.axes()[2], np.array([1.0, 2.0, -2.0]) / 3.0, atol=1e-15)
    turned = Rotation.from_rotvec([10.0, 20.0, 30.0], degrees=True)
    np.testing.assert_allclose(second.axes(), turned.as_matrix().T, atol=1e-15)
    assert (float(first.times.interval), float(first.times.latency)) == (0.25, 0.12)
    assert (second.times.every, second.times.wait, sun.times.past_samples) == (1, 0, 0)
    np.testing.assert_allclose(suite.rate_noise, [1e-6] * 3, rtol=1e-15)
    np.testing.assert_allclose(suite.bias_rate, [1e-8 / np.sqrt(0.1)] * 3, rtol=1e-15)
    for known, true in zip(suite.filter.sensors, suite.sensors, strict=True):
        assert known == true or dataclasses.asdict(known).keys() == dataclasses.asdict(true).keys()


@pytest.mark.parametrize("boresight", [[0.0, 0.0, -2.0], [0.0, 0.0, 3.0], [1e-9, 0.0, -1.0]])
def test_a_star_tracker_can_have_any_boresight(boresight):
    suite = scenario.study(read({**TRACKER, "boresight": boresight}, GYRO)).parts.sensors
    np.testing.assert_allclose(suite.sensors[0].axes()[2], np.array(boresight) / np.linalg.norm(boresight), atol=1e-8)
    np.testing.assert_allclose(suite.sensors[0].axes() @ suite.sensors[0].axes().T, np.eye(3), atol=1e-14)


def test_several_gyros_are_averaged_with_information_weights():
    """Two equal gyros reduce every error by sqrt(2). A second gyro with far more noise changes little."""
    both = read(TRACKER, GYRO, GYRO).sensors.mean_gyro(0.1)
    np.testing.assert_allclose(both, np.array([1e-6, 1e-5, 1e-8]) / np.sqrt(2.0), rtol=1e-14)
    one = read(TRACKER, GYRO, {**GYRO, "rate_noise": 1e-3, "rate_bias": 1e-4}).sensors.mean_gyro(0.1)
    np.testing.assert_allclose(one, [1e-6, 1e-5, 1e-8], rtol=1e-5)


def test_written_sensors_read_back_to_the_same_tables():
    made = read({**TRACKER, "latency": 0.2}, SUN, GYRO)
    tables = parsing.dump(made)
    assert [table["kind"] for table in tables["sensors"]] == ["star_tracker", "vector_sensor", "gyro"]
    assert parsing.dump(scenario.from_tables(tables)) == tables


def test_the_json_schema_accepts_sensor_tables():
    valid = jsonschema.Draft202012Validator(json_schema()).is_valid
    assert valid({"loop": LOOP, "sensors": [TRACKER, SUN, GYRO]})
    assert not valid({"loop": LOOP, "sensors": [{**TRACKER, "noise_across": -1.0}, GYRO]})


def test_defaults_with_two_star_trackers_equal_those_of_one_equivalent_star_tracker():
    """Two equal star trackers are equivalent to one in [hardware] with the noise over sqrt(2)."""
    noise = 2e-5
    tracker = {"kind": "star_tracker", "noise_across": noise, "latency": 0.1}
    suite = read(tracker, {**tracker, "boresight": [0.0, 1.0, 0.0]}, {"kind": "gyro", "rate_noise": 1e-6})
    hardware = {"attitude_noise": noise / np.sqrt(2.0), "rate_noise": 1e-6}
    short = scenario.from_tables({"loop": LOOP, "hardware": hardware, "filter": {"kind": "steady_state"}})
    for name in ("controller", "observer", "loop"):
        ours, theirs = (parsing.dump(one)[name] for one in (suite, short))
        assert ours.keys() == theirs.keys()
        for key, value in ours.items():
            assert value == (pytest.approx(theirs[key], rel=1e-9) if not isinstance(value, str) else theirs[key]), key


class Level(ptsmc.AttitudeSensor):
    """A custom sensor with one component."""

    scale: float = ptsmc.number(1.0, above=0.0, meaning="of its reading", unit="-")

    def read(self, q):
        """Return the x component [-] of the sensor's z axis in inertial axes, times `scale`, as an array (1,)."""
        return self.scale * attitude.rotate(q, self.direction())[:1]

    def direction(self):
        """Return the sensor's z axis (3,) in body axes."""
        return attitude.rotate(self.mounting, jnp.array([0.0, 0.0, 1.0]))


def with_custom_sensor(**keys):
    """Return a complete scenario with a star tracker, a gyro and a custom sensor with these keys."""
    table = {"kind": "custom", "code": f"{__file__}:Level", "noise": [1e-3], **keys}
    return scenario.reading.complete(read(TRACKER, table, GYRO))


def test_a_custom_sensor_has_keys_and_a_checksum():
    made = with_custom_sensor(scale=3.0, latency=0.1)
    sensor = scenario.study(made).parts.sensors.sensors[1]
    assert (sensor.name, float(sensor.scale), sensor.times.wait) == ("custom_1", 3.0, 1)
    np.testing.assert_allclose(sensor.sensitivity(jnp.array([0.0, 0.0, 0.0, 1.0])), [[0.0, 3.0, 0.0]], atol=1e-15)
    assert list(custom.checksums(made)) == ["sensors_1_sha256"]
    tables = parsing.dump(made)
    assert parsing.dump(scenario.reading.complete(scenario.from_tables(tables))) == tables


@pytest.mark.parametrize(
    ("key", "keys"), [("scale", {"scale": -1.0}), ("noise", {"noise": [1e-3, 1e-3]}), ("size", {"size": 1.0})]
)
def test_a_custom_sensor_with_a_bad_key_is_refused(key, keys):
    with pytest.raises(ScenarioError, match=rf"sensors.*\.{key} is"):
        scenario.study(with_custom_sensor(**keys))


BAD = {
    "sensors": [[], [1], [{}], [GYRO], [TRACKER], [SUN, GYRO], [SUN, {**SUN, "direction": [0.0, 0.0, -2.0]}, GYRO]],
    "sensors[0].kind": [[{**TRACKER, "kind": "radar"}, GYRO]],
    "sensors[0].noise_across": [
        [{**TRACKER, "noise_across": value}, GYRO] for value in ("8 foo", 0.0, -1.0, 1e-300, float("inf"), None, True)
    ],
    "sensors[0].boresight": [[{**TRACKER, "boresight": value}, GYRO] for value in ([0.0] * 3, [1e200] * 3, [1.0])],
    "sensors[0].rotvec_deg": [[{**TRACKER, "boresight": [0.0, 0.0, 1.0], "rotvec_deg": [0.0, 0.0, 1.0]}, GYRO]],
    "sensors[0].period": [[{**TRACKER, "period": value}, GYRO] for value in (0.05, 1e6)],
    "sensors[0].latency": [[{**TRACKER, "latency": value}, GYRO] for value in (-1.0, 10.0)],
    "sensors[0].noise": [
        [{**TRACKER, "noise": 1.0}, GYRO],
        [{"kind": "vector_sensor", "direction": [1.0, 0, 0]}, GYRO],
    ],
    "sensors[0].direction": [[{**SUN, "direction": [0.0] * 3}, GYRO]],
    "sensors[1].rate_noise": [[TRACKER, {"kind": "gyro"}]],
    "sensors[1].rate_noise_density": [[TRACKER, {**GYRO, "rate_noise_density": 1e-6}]],
}


@pytest.mark.parametrize(("key", "sensors"), [(key, one) for key, many in BAD.items() for one in many])
def test_a_bad_sensor_is_refused_in_one_sentence_that_names_its_key(key, sensors):
    given = [{k: v for k, v in one.items() if v is not None} if isinstance(one, dict) else one for one in sensors]
    with refuses(ScenarioError, key):
        read(*given)


@pytest.mark.parametrize(
    "others",
    [
        {"filter": {"kind": "steady_state"}},
        {"hardware": {"attitude_noise": 1e-5}},
        {"loop": {"mode": "continuous"}},
        {"plant": {"kind": "chain", "x0": [1.0, 0.0]}},
        {"dispersion": {"attitude_noise": {"kind": "relative_normal", "std": 0.1}}},
    ],
    ids=str,
)
def test_tables_that_contradict_the_sensors_are_refused(others):
    with pytest.raises(ScenarioError, match="sensors"):
        read(TRACKER, GYRO, **others)
