"""`ptsmc convert-attitude`: all printed representations are the same attitude, and valid in a scenario."""

import tomllib
from typing import Any

import numpy as np
import pytest

from ptsmc_jax import scenario
from ptsmc_jax.scenario import attitude_keys
from ptsmc_jax.scenario.attitude_keys import ATTITUDE_KEYS
from tests.helpers import refused
from tuning.cli import convert


def pasted(line, sequence):
    """Return the quaternion (4,), scalar last, of a printed line, which is read as a part of a scenario.

    sequence: of the Euler angles, used if the line has Euler angles.
    """
    table = tomllib.loads(line)
    if "euler_deg" in table:
        table["sequence"] = sequence
    known: Any = scenario.from_tables({"initial": table})
    return attitude_keys.quaternion(known.initial, "initial")


def closed_forms(q):
    """Return MRP (3,), rotation vector (3,) [deg] and rotation matrix (3, 3) of a quaternion from their definitions."""
    v, scalar = q[:3], q[3]
    angle = 2.0 * np.arctan2(np.linalg.norm(v), scalar)
    x, y, z = v
    cross = np.array([[0, -z, y], [z, 0, -x], [-y, x, 0]])
    matrix = (scalar**2 - v @ v) * np.eye(3) + 2.0 * np.outer(v, v) + 2.0 * scalar * cross
    return v / (1.0 + scalar), np.degrees(angle) * v / np.linalg.norm(v), matrix


@pytest.mark.parametrize("sequence", [None, "zyx", "XYZ", "ZXZ"])
def test_all_representations_are_the_same_attitude(sequence):
    rng = np.random.default_rng(4)
    for _ in range(20):
        q = rng.normal(size=4)
        q *= np.sign(q[3]) / np.linalg.norm(q)
        if 2.0 * np.arccos(q[3]) > np.deg2rad(170.0):  # near the singularity of the law in Case I
            continue
        said = convert.attitude_lines(q, sequence)
        assert [line.split(" = ")[0] for line in said] == list(ATTITUDE_KEYS)
        for line in said:
            again = pasted(line, sequence or "ZYX")
            np.testing.assert_allclose(again * np.sign(again[3]), q, atol=1e-10)  # 12 digits of degrees
        values = {key: np.array(tomllib.loads(line)[key]) for key, line in zip(ATTITUDE_KEYS, said, strict=True)}
        mrp, vector, matrix = closed_forms(q)
        np.testing.assert_allclose(values["mrp"], mrp, atol=1e-11)
        np.testing.assert_allclose(values["rotvec_deg"], vector, atol=1e-9)
        np.testing.assert_allclose(values["dcm_body_to_inertial"], matrix, atol=1e-11)
        np.testing.assert_allclose(values["quat_wxyz"], np.roll(q, 1), atol=1e-11)


@pytest.mark.parametrize(("options", "angle"), [
    (("--quat-wxyz", "0.5 0.5 0.5 0.5"), "120 degrees about [0.57735026919, 0.57735026919, 0.57735026919]"),
    (("--mrp", "[0, 0, 0.41421356237309503]"), "90 degrees about [0, 0, 1]"),  # tan(90 deg / 4)
    (("--dcm-body-to-inertial", "0,-1,0,1,0,0,0,0,1"), "90 degrees about [0, 0, 1]"),
    (("--euler-deg", "90,0,0"), "90 degrees about [0, 0, 1]"),
    (("--rotvec-deg", "0,0,180"), "180 degrees about [0, 0, 1]"),
    (("--rotvec-deg", "0,0,200"), "160 degrees about [0, 0, -1]"),
    (("--euler-deg", "90,0,0", "--sequence", "XYZ"), "90 degrees about [1, 0, 0]"),
    (("--rotvec-deg", "0,0,0"), "0 degrees"),
    (("--rotvec-deg", "-90,0,0"), "90 degrees about [-1, 0, 0]"),
    (("--dcm-body-to-inertial", "-1 0 0 0 -1 0 0 0 1"), "180 degrees about [0, 0, 1]"),
])  # fmt: skip
def test_convert_attitude_accepts_every_representation(command, options, angle):
    code, said, error = command("convert-attitude", *options)
    assert (code, error) == (0, "")
    assert f"# {angle}\n" in said


def test_convert_attitude_converts_euler_angles_in_gimbal_lock_with_a_note(command):
    code, said, error = command("convert-attitude", "--euler-deg", "10,90,20")
    assert (code, error) == (0, "")
    assert "gimbal lock" in said
    assert np.abs(tomllib.loads(said)["dcm_body_to_inertial"][2][0] + 1.0) < 1e-12


@pytest.mark.parametrize(("options", "said"), [
    ((), "no attitude is given, but must be exactly one of --quat-xyzw, "),
    (("--mrp", "0,0,0", "--rotvec-deg", "0,0,0"), "--rotvec-deg and --mrp are given, but must be exactly one of "),
    (("1", "2"), "convert-attitude does not take 1 2; its arguments: ptsmc convert-attitude --help"),
    (("--mrp", "0,0"), "--mrp is [0.0, 0.0], but must be three numbers"),
    (("--mrp", "a,b,c"), "--mrp is a,b,c, but must be numbers such as 0.1,0.2,0.3"),
    (("--mrp", ""), "--mrp is , but must be numbers such as"),
    (("--rotvec-deg", "0,0,nan"), "--rotvec-deg is [0.0, 0.0, nan], but must be three numbers, and nan is no finite"),
    (("--quat-wxyz", "0,0,0,0"), "--quat-wxyz is [0.0, 0.0, 0.0, 0.0], but must be a unit quaternion (its norm is 0"),
    (("--dcm-body-to-inertial", "1,0,0,0,1,0,0,0,-1"), "--dcm-body-to-inertial is [[1.0, 0.0, 0.0], "),
    (("--dcm-body-to-inertial", "1,0,0"), "--dcm-body-to-inertial is [1.0, 0.0, 0.0], but must be three rows"),
    (("--euler-deg", "1,2,3", "--sequence", "abc"), '--sequence is "abc", but must be three axes'),
    (("--euler-deg", "1,2,3", "--sequence", ""), '--sequence is "", but must be three axes'),
    (("--mrp", "0,0,0", "--sequence", "abc"), "--sequence is abc, but must be three axes"),
])  # fmt: skip
def test_convert_attitude_refuses_invalid_attitudes(command, tmp_path, options, said):
    assert refused(command, tmp_path, "convert-attitude", *options).startswith(f"ptsmc: {said}")


def test_zero_rotation_is_printed_without_rounding_errors():
    said = convert.attitude_lines(np.array([0.0, 0.0, -1.2246e-16, 1.0]))
    assert "rotvec_deg = [0, 0, 0]  # 0 degrees" in said
    assert 'euler_deg = [0, 0, 0]  # with sequence = "ZYX"' in said
