"""Attitudes from CSV, Parquet and attitude ephemeris messages: equal samples in all forms, errors with their place."""

from typing import Any

import numpy as np
import polars as pl
import pytest
from scipy.spatial.transform import Rotation

from ptsmc_jax import scenario
from ptsmc_jax.scenario import aem, attitude_files, epochs
from ptsmc_jax.scenario.errors import ScenarioError
from tests.helpers import refuses

TIMES = np.array([0.0, 1.0, 2.5, 4.0, 6.0])
TURNS = Rotation.from_rotvec(np.outer(np.sin(0.2 * TIMES), [0.5, 0.2, -0.4]) + np.array([0.0, 0.0, 2.5]))
Q = TURNS.as_quat()
AXIS = np.array([0.0, 0.6, 0.8])
SPIN = Rotation.from_rotvec(np.outer(0.05 * TIMES, AXIS))  # its rate is constant in body axes and in inertial axes
DATES = [str(epochs.parse("2026-03-20T23:59:58").after(t)) for t in TIMES]
INVERSE = np.array([-1.0, -1.0, -1.0, 1.0])
HEAD = "CCSDS_AEM_VERS = {version}\nCREATION_DATE = 2026-01-01T00:00:00\nORIGINATOR = TEST\n"
META = {
    "OBJECT_NAME": "SAT", "OBJECT_ID": "2026-001A", "CENTER_NAME": "EARTH", "REF_FRAME_A": "EME2000",
    "REF_FRAME_B": "SC_BODY_1", "ATTITUDE_DIR": "A2B", "TIME_SYSTEM": "UTC", "START_TIME": DATES[0],
    "STOP_TIME": DATES[-1], "ATTITUDE_TYPE": "QUATERNION", "QUATERNION_TYPE": "LAST",
}  # fmt: skip


def message(rows, version="1.0", dates=DATES, marks=True, **changed):
    """Return the text of an attitude ephemeris message.

    rows: quaternions. dates: of the rows. marks: whether to write DATA_START and DATA_STOP. changed: values of its
    keywords, None removes one.
    """
    meta = {name: value for name, value in (META | changed).items() if value is not None}
    lines = [f"{name} = {value}" for name, value in meta.items()]
    data = [f"{date} {' '.join(f'{number:.15f}' for number in row)}" for date, row in zip(dates, rows, strict=True)]
    data = ["DATA_START", *data, "DATA_STOP"] if marks else data
    return HEAD.format(version=version) + "\n".join(["META_START", *lines, "META_STOP", *data, ""])


def write_and_read(path, content, order=None, direction=None, interpolation="file", epoch=None):
    """Write text or a data frame to a file, and return the samples of attitude that the program reads from it.

    order, direction, interpolation, epoch: as in the table [reference].
    """
    if isinstance(content, str):
        path.write_text(content)
    elif path.suffix == ".parquet":
        content.write_parquet(path)
    else:
        content.write_csv(path)
    return attitude_files.read(str(path), order, direction, interpolation, epoch)


def check(samples, quaternions=Q):
    """Assert that samples of an attitude file have the times `TIMES` and these quaternions (n, 4), scalar last."""
    np.testing.assert_allclose(samples.times, TIMES, atol=1e-9)
    off = Rotation.from_quat(quaternions).inv() * Rotation.from_quat(samples.quaternions)
    assert off.magnitude().max() < 1e-12


def columns(names, values):
    """Return {name: column} from the columns of an array (rows, names)."""
    return dict(zip(names, values.T, strict=True))


SCALAR_FIRST = np.roll(Q, 1, axis=1)
TABLES = {
    "numbered": (pl.DataFrame({"t": TIMES, **columns(["q1", "q2", "q3", "q4"], Q)}), {}),
    "numbered, scalar first": (
        pl.DataFrame({"time": TIMES, **columns(["q1", "q2", "q3", "q4"], SCALAR_FIRST)}), {"order": "wxyz"},
    ),
    "labelled, in another order": (
        pl.DataFrame({"qw": Q[:, 3], **columns(["qx", "qy", "qz"], Q[:, :3]), "t": TIMES, "note": 1}), {},
    ),
    "scalar 0": (pl.DataFrame({"t": TIMES, **columns(["q0", "q1", "q2", "q3"], SCALAR_FIRST)}), {}),
    "inertial to body": (
        pl.DataFrame({"t": TIMES, **columns(["q1", "q2", "q3", "q4"], Q * INVERSE)}), {"direction": "inertial_to_body"},
    ),
    "dates": (pl.DataFrame({"utc": DATES, **columns(["qx", "qy", "qz", "qw"], Q)}), {}),
    "signs": (pl.DataFrame({"t": TIMES, **columns(["qx", "qy", "qz", "qw"], Q * [[1], [-1], [1], [-1], [1]])}), {}),
}  # fmt: skip


@pytest.mark.parametrize(("frame", "options"), TABLES.values(), ids=TABLES)
@pytest.mark.parametrize("suffix", ["csv", "parquet"])
def test_attitude_tables_with_any_names_and_order_of_columns_give_the_same_attitudes(tmp_path, suffix, frame, options):
    check(write_and_read(tmp_path / f"attitude.{suffix}", frame, **options))


def test_epoch_is_the_time_0_of_calendar_times_in_an_attitude_file(tmp_path):
    frame = TABLES["dates"][0]
    assert write_and_read(tmp_path / "a.csv", frame, epoch="2026-03-21T00:00:00").times[0] == pytest.approx(
        -2.0, abs=1e-12
    )


RATE = np.rad2deg(np.tile(0.05 * AXIS, (5, 1)))  # [deg/s]
S = SPIN.as_quat()
SLOPE = 0.025 * np.column_stack([S[:, 3:] * AXIS + np.cross(S[:, :3], AXIS), -S[:, :3] @ AXIS])
MESSAGES = {
    "issue 1": (message(Q), Q),
    "scalar first": (message(SCALAR_FIRST, QUATERNION_TYPE="FIRST"), Q),
    "no DATA_START, day of the year": (
        message(Q, marks=False, dates=[date.replace("03-20", "079").replace("03-21", "080") for date in DATES]), Q,
    ),
    "issue 2": (message(Q, "2.0", ATTITUDE_DIR=None, QUATERNION_TYPE=None), Q),
    "from the body": (message(Q * INVERSE, ATTITUDE_DIR="B2A"), Q),
    "body first": (message(Q * INVERSE, REF_FRAME_A="SC_BODY_1", REF_FRAME_B="ICRF"), Q),
    "body first, from the inertial frame": (
        message(Q, REF_FRAME_A="SC_BODY_1", REF_FRAME_B="ICRF", ATTITUDE_DIR="B2A"), Q,
    ),
    "rates": (
        message(np.hstack([S, RATE]), ATTITUDE_TYPE="QUATERNION/RATE", RATE_FRAME="REF_FRAME_B"), S,
    ),
    "angular velocity, issue 2": (
        message(np.hstack([S, RATE]), "2.0", ATTITUDE_TYPE="QUATERNION/ANGVEL", ANGVEL_FRAME="SC_BODY_1"), S,
    ),
    "inertial rates": (
        message(np.hstack([S, RATE]), "2.0", ATTITUDE_TYPE="QUATERNION/ANGVEL", ANGVEL_FRAME="REF_FRAME_A"), S,
    ),
    "derivative": (message(np.hstack([S, SLOPE]), ATTITUDE_TYPE="QUATERNION/DERIVATIVE"), S),
    "derivative, scalar first, from the body": (
        message(
            np.hstack([np.roll(S * INVERSE, 1, axis=1), np.roll(SLOPE * INVERSE, 1, axis=1)]),
            ATTITUDE_TYPE="QUATERNION/DERIVATIVE", QUATERNION_TYPE="FIRST", ATTITUDE_DIR="B2A",
        ), S,
    ),
    "comments": (message(Q).replace("DATA_START", "COMMENT a\nDATA_START\nCOMMENT b"), Q),
    "spline": (message(Q, INTERPOLATION_METHOD="CUBIC_SPLINE", INTERPOLATION_DEGREE="3"), Q),
}  # fmt: skip


@pytest.mark.parametrize(("text", "quaternions"), MESSAGES.values(), ids=MESSAGES)
def test_attitude_messages_in_every_style_give_the_same_attitudes(tmp_path, text, quaternions):
    samples = write_and_read(tmp_path / "attitude.aem", text)
    check(samples, quaternions)
    if samples.end_rates is not None:
        np.testing.assert_allclose(samples.end_rates, np.deg2rad(RATE[:2]), atol=1e-12)


def test_the_epoch_selects_one_segment_of_an_attitude_message(tmp_path):
    later = [date.replace("03-20", "03-25").replace("03-21", "03-26") for date in DATES]
    second = message(S, dates=later, START_TIME=later[0], STOP_TIME=later[-1], USEABLE_STOP_TIME=later[-2])
    both = message(Q) + second[second.index("META_START") :]
    check(write_and_read(tmp_path / "a.aem", both))
    samples = write_and_read(tmp_path / "a.aem", both, epoch=later[0])
    check(samples, S)
    assert samples.usable_until == pytest.approx(TIMES[-2])
    with pytest.raises(ValueError, match="no segment contains"):
        write_and_read(tmp_path / "a.aem", both, epoch="2026-03-23T00:00:00")


REFUSED = {
    "euler": (message(Q, ATTITUDE_TYPE="EULER_ANGLE"), "ATTITUDE_TYPE is EULER_ANGLE"),
    "rotating frame": (message(Q, REF_FRAME_A="ITRF-97"), "REF_FRAME_A is ITRF-97"),
    "two inertial frames": (message(Q, REF_FRAME_B="ICRF"), "one must be inertial"),
    "interpolation": (message(Q, INTERPOLATION_METHOD="LINEAR"), "INTERPOLATION_METHOD is LINEAR"),
    "version": (message(Q, "3.0"), 'line 1: it is "CCSDS_AEM_VERS = 3.0"'),
    "another message": ("CIC_AEM_VERS = 1.0\n", "line 1"),
    "a line of data": (message(Q).replace(DATES[2], DATES[2] + " 0.1"), 'line 20: it is "'),
    "a number": (message(Q).replace(f" {Q[1, 1]:.15f}", " 0.x1"), "must be a time and 4 numbers"),
    "a time": (message(Q).replace(DATES[2], "2026-03-20T24:01:60"), "line 20: its time"),
    "no rate frame": (message(np.hstack([S, RATE]), ATTITUDE_TYPE="QUATERNION/RATE"), "RATE_FRAME"),
    "rates in rad/s": (
        message(np.hstack([S, np.deg2rad(RATE)]), ATTITUDE_TYPE="QUATERNION/RATE", RATE_FRAME="REF_FRAME_B"),
        "rate differs",
    ),
    "half a segment": (message(Q).split("META_STOP")[0], "no complete segment"),
    "one attitude": (message(Q[:1], dates=DATES[:1]), "1 samples"),
    "no data": (message(Q[:0], dates=[]), "0 samples"),
}  # fmt: skip


@pytest.mark.parametrize(("text", "named"), REFUSED.values(), ids=REFUSED)
def test_unsupported_or_damaged_attitude_messages_are_refused_with_the_reason(tmp_path, text, named):
    with refuses(ValueError, named):
        write_and_read(tmp_path / "attitude.aem", text)


def test_a_key_replaces_the_unsupported_interpolation_of_an_attitude_message(tmp_path):
    check(write_and_read(tmp_path / "a.aem", message(Q, INTERPOLATION_METHOD="LINEAR"), interpolation="spline"))


GOOD = TABLES["numbered"][0]
BROKEN = {
    "an empty cell": (GOOD.with_columns(pl.when(pl.col("t") == 2.5).then(None).otherwise("q2").alias("q2")), "row"),
    "no column": (GOOD.drop("q3"), "no quaternion"),
    "no time": (GOOD.drop("t"), "no column of times"),
    "no rows": (GOOD.clear(), "0 samples"),
    "repeated time": (GOOD.with_columns(t=pl.Series([0.0, 1.0, 1.0, 2.0, 3.0])), "sample 3"),
    "norm": (GOOD.with_columns(q4=pl.col("q4") * 1.1), "norm"),
    "large turns": (
        pl.DataFrame({"t": [0.0, 1.0], "qx": [0.0, 0.0], "qy": [0.0, 0.8], "qz": [0.0, 0.0], "qw": [1.0, 0.6]}),
        "at most 90 deg",
    ),
    "one rate": (GOOD.with_columns(w1=pl.lit(0.0)), "no column w2"),
}  # fmt: skip


@pytest.mark.parametrize(("frame", "named"), BROKEN.values(), ids=BROKEN)
def test_broken_attitude_tables_are_configuration_errors_of_the_key_of_the_file(tmp_path, frame, named):
    path = tmp_path / "attitude.csv"
    frame.write_csv(path)
    with refuses(ScenarioError, named) as caught:
        scenario.from_tables({"reference": {"kind": "table", "file": str(path)}, "controller": {"t_f": 4.0}})
    assert caught.value.key == "reference.file"


def test_runs_beyond_the_end_of_an_attitude_file_are_configuration_errors(tmp_path):
    path = tmp_path / "attitude.csv"
    GOOD.write_csv(path)
    tables = {"reference": {"kind": "table", "file": str(path)}, "controller": {"t_f": 4.0, "error": "multiplicative"}}
    scenario.from_tables(tables | {"loop": {"t_end": 6.0}})
    with pytest.raises(ScenarioError) as error:
        scenario.from_tables(tables | {"loop": {"t_end": 6.1}})
    assert error.value.key == "loop.t_end"


def test_relative_paths_of_attitude_files_start_at_the_scenario_file(tmp_path):
    GOOD.write_csv(tmp_path / "attitude.csv")
    (tmp_path / "s.toml").write_text('[reference]\nkind = "table"\nfile = "attitude.csv"\n[controller]\nt_f = 4.0\n')
    read: Any = scenario.read(tmp_path / "s.toml")
    assert read.reference.file == str((tmp_path / "attitude.csv").resolve())


def test_written_attitude_messages_are_read_back_with_equal_numbers(tmp_path):
    rates = np.deg2rad(RATE)
    text = aem.format_message("SAT", TIMES, S, rates, "2026-03-20T12:00:00")
    found = aem.read_segment(text)
    assert found.rates is not None
    np.testing.assert_array_equal(found.quaternions, S)
    np.testing.assert_allclose(found.rates, rates, rtol=0, atol=1e-16)
    np.testing.assert_allclose(found.times, TIMES, atol=1e-12)
    assert "QUATERNION_TYPE = LAST" in text
    assert found.usable_until == TIMES[-1]


def test_an_independent_package_reads_the_same_numbers_of_written_attitude_messages():
    """CCSDS-NDM reads quaternions, their derivatives and times."""
    ndm_io = pytest.importorskip("ccsds_ndm.ndm_io")
    text = aem.format_message("SAT", TIMES, S, np.deg2rad(RATE), "2026-03-20T23:59:58")
    states = [row.quaternion_derivative for row in ndm_io.NdmIo().from_string(text).body.segment[0].data.attitude_state]
    q = np.array([[row.quaternion.q1, row.quaternion.q2, row.quaternion.q3, row.quaternion.qc] for row in states])
    slopes = (row.quaternion_rate for row in states)
    q_dot = [[one.q1_dot.value, one.q2_dot.value, one.q3_dot.value, one.qc_dot.value] for one in slopes]
    np.testing.assert_array_equal(q, S)
    np.testing.assert_allclose(q_dot, SLOPE, rtol=0, atol=1e-16)
    assert [row.epoch for row in states] == DATES


@pytest.mark.parametrize("text", ["2026-03-20T12:00:00", "2026-03-20T12:00:00.000000000125Z", "2024-366T23:59:59.5"])
def test_epochs_are_read_and_written(text):
    epoch = epochs.parse(text)
    assert epochs.parse(str(epoch)).since(epoch) == 0.0
    assert epoch.after(86_400.25).since(epoch) == 86_400.25
