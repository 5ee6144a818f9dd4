"""Reading telemetry: units, orders, gaps, times, and one sentence for each broken table."""

from contextlib import nullcontext

import numpy as np
import polars as pl
import pytest
from scipy.spatial.transform import Rotation

from ptsmc_jax import scenario
from ptsmc_jax.campaigns.store import RefusedError
from ptsmc_jax.identification import telemetry
from ptsmc_jax.scenario.errors import ScenarioError
from tests.helpers import refuses
from tests.identification import synthetic

ROWS = 40
T = 0.5 * np.arange(ROWS)
RATE = np.stack([0.05 * np.sin(0.4 * T), 0.04 * np.cos(0.3 * T), 0.03 + 0.0 * T], axis=1)


def attitudes():
    """Return attitudes (ROWS, 4), scalar last, at the times T, integrated from the body rate in fine steps."""
    turned = [Rotation.from_rotvec([0.1, -0.2, 0.3])]
    for k in range(ROWS - 1):
        fine = np.linspace(T[k], T[k + 1], 20)
        rates = np.stack([0.05 * np.sin(0.4 * fine), 0.04 * np.cos(0.3 * fine), 0.03 + 0.0 * fine], axis=1)
        last = turned[-1]
        for rate in rates[:-1]:
            last = last * Rotation.from_rotvec(rate * (fine[1] - fine[0]))
        turned.append(last)
    return np.stack([one.as_quat() for one in turned])


Q = attitudes()


def frame(**changes):
    """Return a valid log as a data frame; changes: columns to replace, or to remove if None."""
    columns = {"t": T}
    columns |= {f"measured_q{k + 1}": Q[:, k] for k in range(4)}
    columns |= {f"measured_w{k + 1}": RATE[:, k] for k in range(3)}
    columns |= {f"sent{k + 1}": 0.01 * np.cos(T + k) for k in range(3)}
    return pl.DataFrame({name: value for name, value in {**columns, **changes}.items() if value is not None})


def loaded(**table):
    """Return a scenario with this [telemetry] table, and with wheels if the table names their speed or torque."""
    wheels = {} if "wheel_speed" not in table and "wheel_torque" not in table else {"wheels": {"kind": "axes"}}
    sampled = {"loop": {"mode": "sampled"}, **wheels}
    return scenario.from_tables({**sampled, **({"telemetry": table} if table else {})})


def with_value(column, row, value):
    """Return the valid log with another value in one cell; row: its number."""
    values = list(frame()[column])
    values[row] = value
    return frame(**{column: pl.Series(values, dtype=pl.String if isinstance(value, str) else pl.Float64, strict=False)})


def test_logs_with_other_quaternion_orders_signs_units_and_dates_are_read_alike():
    plain = telemetry.measurements(loaded(), frame())
    signs = np.where(np.arange(ROWS) % 3 == 0, -1.0, 1.0)
    other = frame(
        **{
            f"measured_q{k + 1}": (signs[:, None] * np.roll(Q, 1, axis=1) * [1.0, -1.0, -1.0, -1.0])[:, k]
            for k in range(4)
        },
        **{f"measured_w{k + 1}": np.rad2deg(RATE[:, k]) for k in range(3)},
        **{f"sent{k + 1}": 1e3 * frame()[f"sent{k + 1}"].to_numpy() for k in range(3)},
        t=[f"2026-03-01T12:00:{time:09.6f}Z" for time in T],
    )
    table = {"quaternion_order": "wxyz", "rotation": "inertial_to_body", "rate_unit": "deg/s", "torque_unit": "mN m"}
    again = telemetry.measurements(loaded(**table), other)
    np.testing.assert_allclose(again.t, plain.t, atol=1e-6)
    np.testing.assert_allclose(again.command, plain.command, rtol=1e-12)
    np.testing.assert_allclose(again.readings["rate"], plain.readings["rate"], rtol=1e-12)
    sign = np.sign(again.readings["attitude"][0, 3] * plain.readings["attitude"][0, 3])
    np.testing.assert_allclose(sign * again.readings["attitude"], plain.readings["attitude"], atol=1e-12)


def test_blank_commands_of_a_log_repeat_the_last_one_and_blank_readings_are_missing():
    q, u = [list(Q[:, k]) for k in range(4)], list(0.01 * np.cos(T))
    u[3] = None
    for column in q:
        column[1], column[2] = None, float("nan")
    columns = {f"measured_q{k + 1}": pl.Series(q[k], dtype=pl.Float64) for k in range(4)}
    log = telemetry.measurements(loaded(), frame(**columns, sent1=pl.Series(u, dtype=pl.Float64)))
    assert np.isnan(log.readings["attitude"][1:3]).all()
    assert log.command[3, 0] == log.command[2, 0]


def test_an_attitude_with_an_age_gets_a_separate_row_at_the_time_of_its_measurement():
    log = telemetry.measurements(loaded(), frame(measured_age=np.full(ROWS, 0.2)))
    assert log.t[0] == 0.0
    there = ~np.isnan(log.readings["attitude"][:, 0])
    np.testing.assert_allclose(np.diff(log.t[there]), 0.5, atol=1e-12)
    rates = ~np.isnan(log.readings["rate"][:, 0])
    assert not np.any(there & rates)
    np.testing.assert_allclose(log.t[rates][0] - log.t[there][0], 0.2, atol=1e-12)


def test_wheel_speeds_in_rpm_are_converted_to_rad_per_second():
    speeds = {f"n{k}": 100.0 * np.sin(0.1 * T + k) for k in range(3)}
    table = {"wheel_speed": ["n0", "n1", "n2"], "speed_unit": "rpm", "wheel_inertia": 1e-4}
    log = telemetry.measurements(loaded(**table), frame(**speeds))
    assert log.wheel_inertia == 1e-4
    np.testing.assert_allclose(log.command[:, 0], speeds["n0"] * np.pi / 30.0)


BROKEN = [
    ({}, frame()[:5], "has 5 rows, but must have at least"),
    ({}, frame(t=None), "has no column t"),
    ({"time": "seconds"}, frame(), "has no column seconds"),
    ({"attitude": ["a", "b", "c", "d"]}, frame(), "has no column a"),
    ({"rate": ["measured_w1", "measured_w2", "gyro"]}, frame(), "has no column gyro"),
    ({}, frame(sent2=None), "has no column sent2"),
    (
        {},
        frame(**dict.fromkeys((*(f"measured_q{k}" for k in range(1, 5)), *(f"measured_w{k}" for k in range(1, 4))))),
        "has no attitude and no rate",
    ),
    ({}, frame(measured_q4=None), "has no column measured_q4"),
    ({}, frame(measured_w2=None), "has no column measured_w2"),
    ({}, with_value("t", 7, None), "has t empty in row 7"),
    ({}, with_value("t", 7, "noon"), "has t noon in row 7, but must have a number of seconds, or a date"),
    ({}, with_value("t", 7, T[6]), "in row 7, but must have a time after that of row 6"),
    ({}, with_value("t", 7, 0.1), "has t 0.1 in row 7, but must have a time after"),
    ({}, with_value("measured_q2", 9, 0.9), "in row 9, but must have a unit quaternion"),
    ({}, with_value("measured_q2", 9, None), "has measured_q2 empty in row 9, but must have a number there"),
    ({}, with_value("measured_w3", 4, None), "has measured_w3 empty in row 4"),
    ({}, with_value("measured_w3", 4, "fast"), "has measured_w3 fast in row 4, but must have a finite number"),
    ({}, with_value("measured_w3", 4, np.inf), "in row 4, but must have a finite number"),
    ({}, with_value("sent1", 0, None), "has sent1 empty in row 0, but must have a number in the first row"),
    ({"rate_unit": "deg/s"}, frame(), "has rates that do not fit its attitudes"),
    ({"quaternion_order": "wxyz"}, frame(), "has rates that do not fit its attitudes"),
    ({"rotation": "inertial_to_body"}, frame(), "has rates that do not fit its attitudes"),
    ({"wheel_torque": ["sent1", "sent2"]}, frame(), "telemetry.wheel_torque has 2 columns, but must have 3"),
    (
        {"wheel_speed": ["sent1", "sent2", "n"], "wheel_inertia": 1.0},
        frame(n=pl.Series([None] * ROWS, dtype=pl.Float64)),
        "has no number in the column n",
    ),
    ({}, frame(measured_age=np.full(ROWS, -1.0)), "has measured_age -1 in row 0, but must have an age of at least 0"),
]


@pytest.mark.parametrize(("table", "rows", "words"), BROKEN, ids=[words[:40] for _, _, words in BROKEN])
def test_a_log_with_invalid_cells_or_columns_is_refused_in_one_sentence(table, rows, words):
    with refuses(RefusedError, words):
        telemetry.measurements(loaded(**table), rows)


@pytest.mark.parametrize(("unit", "is_right"), [("rad/s", True), ("deg/s", False)])
def test_rates_of_a_long_log_of_a_spinning_spacecraft_fit_its_attitudes(unit, is_right):
    """The log is compared in parts, and the body turns by about one revolution in each of them."""
    t = np.arange(20_000) / 10.0
    rate = np.tile([0.0, 0.0, 1.3], (t.size, 1))
    attitude = Rotation.from_rotvec(rate * t[:, None] + 1e-3 * np.random.default_rng(0).standard_normal(rate.shape))
    columns = {"t": t} | {f"measured_q{k + 1}": attitude.as_quat()[:, k] for k in range(4)}
    columns |= {f"measured_w{k + 1}": rate[:, k] for k in range(3)} | {f"sent{k + 1}": 0.0 * t for k in range(3)}
    with nullcontext() if is_right else refuses(RefusedError, "has rates that do not fit its attitudes"):
        telemetry.measurements(loaded(rate_unit=unit), pl.DataFrame(columns))


def slow_log(noise, outliers):
    """Return a log (a data frame) of a slow slew; noise: 1 sigma of the attitude [rad].

    outliers: number of rows with a wrong attitude, and of other rows with a wrong rate.
    """
    rng, t = np.random.default_rng(0), np.arange(400) / 2.0
    axis = np.array([0.01, 0.005, -0.003])
    angle, rate = 0.3 * t - 0.3 * np.sin(t / 10.0), 0.3 - 0.03 * np.cos(t / 10.0)
    attitude = Rotation.from_rotvec(angle[:, None] * axis) * Rotation.from_rotvec(noise * rng.standard_normal((400, 3)))
    rates, q = rate[:, None] * axis + 1e-4 * rng.standard_normal((400, 3)), attitude.as_quat()
    wrong, also_wrong = np.split(rng.choice(400, 2 * outliers, replace=False), 2)
    q[wrong] = (attitude[wrong] * Rotation.from_rotvec(0.1 * rng.standard_normal((outliers, 3)))).as_quat()
    rates[also_wrong] += 0.1 * rng.standard_normal((outliers, 3))
    columns = {"t": t} | {f"measured_q{k + 1}": q[:, k] for k in range(4)}
    columns |= {f"measured_w{k + 1}": rates[:, k] for k in range(3)} | {f"sent{k + 1}": 0.0 * t for k in range(3)}
    return pl.DataFrame(columns)


@pytest.mark.parametrize(("noise", "outliers"), [(1e-4, 9), (0.01, 0)])
def test_a_log_of_a_slow_slew_with_outliers_or_coarse_attitudes_is_accepted(noise, outliers):
    """Only errors of the attitude turn by more than 0.02 rad from sample to sample."""
    log = telemetry.measurements(loaded(), slow_log(noise, outliers))
    assert len(log.t) >= 390


def test_rates_of_a_slow_slew_in_another_unit_are_refused_with_that_unit():
    """Regression: parts of fixed length turned by less than 0.02 rad, and no part of the log was compared."""
    rows = slow_log(1e-4, 0).with_columns(pl.col(f"measured_w{k}") * 180.0 / np.pi for k in (1, 2, 3))
    with refuses(RefusedError, 'times the rotation; set telemetry.rate_unit = "deg/s"'):
        telemetry.measurements(loaded(), rows)
    assert len(telemetry.measurements(loaded(rate_unit="deg/s"), rows).t) >= 390


@pytest.mark.parametrize(
    ("unit", "right", "factor"),
    [
        ("rad/s", "deg/s", 180.0 / np.pi),
        ("deg/s", "rad/s", 1.0),
        ("rad/s", "mrad/s", 1e3),
        ("deg/s", "rpm", 30.0 / np.pi),
    ],
)
def test_rates_of_a_slow_slew_at_a_constant_rate_in_another_unit_are_refused(unit, right, factor):
    """Regression: a rotation of 15 deg in 25 parts was too small to be compared."""
    t, rng = np.arange(750) / 5.0, np.random.default_rng(0)
    rate = np.tile([1.4e-3, 9e-4, -6e-4], (t.size, 1))  # 0.1 deg/s
    attitude = Rotation.from_rotvec(rate * t[:, None]) * Rotation.from_rotvec(7e-5 * rng.standard_normal(rate.shape))
    logged = factor * (rate + 1e-4 * rng.standard_normal(rate.shape))
    columns = {"t": t} | {f"measured_q{k + 1}": attitude.as_quat()[:, k] for k in range(4)}
    columns |= {f"measured_w{k + 1}": logged[:, k] for k in range(3)} | {f"sent{k + 1}": 0.0 * t for k in range(3)}
    with refuses(RefusedError, f'set telemetry.rate_unit = "{right}"'):
        telemetry.measurements(loaded(rate_unit=unit), pl.DataFrame(columns))
    assert telemetry.measurements(loaded(rate_unit=right), pl.DataFrame(columns)).t.size > 700


def test_a_large_gyro_bias_is_no_error_of_the_unit():
    rows = slow_log(1e-4, 0).with_columns(pl.col(f"measured_w{k}") + 0.02 for k in (1, 2, 3))
    assert len(telemetry.measurements(loaded(), rows).t) >= 390


@pytest.mark.parametrize(
    ("kind", "factor", "words"),
    [
        ("sent", 1.0, None),
        ("sent", 1e3, 'columns sent1, sent2, sent3; set telemetry.torque_unit = "mN m"'),
        ("sent", 1e-3, "check telemetry.torque_unit"),
        ("sent", -1.0, "check the signs"),
        ("speed", 1.0, None),
        ("speed", 30.0 / np.pi, 'set telemetry.speed_unit = "rpm", which fits, or check telemetry.wheel_inertia'),
        ("speed", 1e4, "telemetry.wheel_inertia and spacecraft.inertia"),
    ],
)
@pytest.mark.parametrize("reading", ["measured_q", "measured_w"])
def test_torques_and_wheel_speeds_in_another_unit_are_refused_with_that_unit(reading, kind, factor, words):
    names = [f"{kind}{k}" for k in (1, 2, 3)]
    tables = {
        "spacecraft": {"inertia": [0.05, 0.09, 0.11]}, "loop": {"mode": "sampled"}, "wheels": {"kind": "axes"},
        "disturbance": {"kind": "none"},
        "telemetry": {"wheel_speed": names, "wheel_inertia": synthetic.SPIN_INERTIA} if kind == "speed" else {},
    }  # fmt: skip
    (rows,), _ = synthetic.logs(np.random.default_rng(0), np.diag([0.06, 0.08, 0.12]), wheels=True)
    rows = rows.select("t", *names, pl.col(f"^{reading}.$")).with_columns(pl.col(name) * factor for name in names)
    with refuses(RefusedError, words) if words else nullcontext():
        telemetry.measurements(scenario.from_tables(tables), rows)


def test_rates_without_attitudes_in_another_unit_are_refused_with_the_key_of_their_unit():
    (rows,), _ = synthetic.logs(np.random.default_rng(0), np.diag([0.06, 0.08, 0.12]))
    rows = rows.select("t", "^sent.$", pl.col("^measured_w.$") * 180.0 / np.pi)
    tables = {
        "spacecraft": {"inertia": [0.05, 0.09, 0.11]}, "loop": {"mode": "sampled"}, "disturbance": {"kind": "none"},
    }  # fmt: skip
    with refuses(RefusedError, "check telemetry.torque_unit, telemetry.rate_unit and spacecraft.inertia"):
        telemetry.measurements(scenario.from_tables(tables), rows)


def test_torques_that_compensate_a_disturbance_are_accepted():
    """A hold: the body moves by a thousandth of what the torque alone would cause."""
    t = np.arange(600) / 10.0
    torque = 5e-3 * np.sin(t[:, None] / 3.0 + np.arange(3.0))
    rate = np.cumsum(1e-3 * torque / 10.0, axis=0) / 10.0
    columns = {"t": t} | {f"measured_w{k + 1}": rate[:, k] for k in range(3)}
    columns |= {f"sent{k + 1}": torque[:, k] for k in range(3)}
    assert telemetry.measurements(loaded(), pl.DataFrame(columns)).t.size > 500


@pytest.mark.parametrize(
    ("table", "words"),
    [
        ({"torque": ["a", "b", "c"], "wheel_torque": ["d", "e", "f"]}, "has torque and wheel_torque"),
        ({"wheel_speed": ["a", "b", "c"]}, "telemetry.wheel_inertia is absent"),
        ({"rate_unit": "rev/day"}, "telemetry.rate_unit is"),
        ({"attitude": ["a", "b"]}, "telemetry.attitude is"),
        ({"attitud": ["a"]}, "telemetry.attitud is not a known key"),
    ],
)
def test_an_invalid_telemetry_table_is_a_configuration_error(table, words):
    with pytest.raises(ScenarioError, match=words.replace("[", r"\[")):
        scenario.from_tables({"loop": {"mode": "sampled"}, "wheels": {"kind": "axes"}, "telemetry": table})


def test_logs_are_read_from_csv_and_parquet_files_and_other_files_are_refused(tmp_path):
    frame().write_csv(tmp_path / "log.csv")
    frame().write_parquet(tmp_path / "log.parquet")
    both = [telemetry.measurements(loaded(), telemetry.read(tmp_path / f"log.{end}")) for end in ("csv", "parquet")]
    np.testing.assert_allclose(both[0].readings["attitude"], both[1].readings["attitude"], rtol=1e-12)
    (tmp_path / "log.txt").write_text("t\n1\n")
    (tmp_path / "twice.csv").write_text("t,t\n1,2\n")
    for name in ("log.txt", "absent.csv", "twice.csv"):
        with pytest.raises(RefusedError, match=name):
            telemetry.read(tmp_path / name)
