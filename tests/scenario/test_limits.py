"""Limits with units, limits of zero, and the ratio to the limit in a verdict."""

import math
import re
from collections.abc import Mapping

import jax
import numpy as np
import pytest

from ptsmc_jax import scenario, units
from ptsmc_jax.numerics.pytrees import vector
from ptsmc_jax.scenario import keys, layouts, parsing, sensor_tables
from ptsmc_jax.scenario.errors import ScenarioError
from ptsmc_jax.scenario.tables import Limit
from ptsmc_jax.simulation import catalogues
from ptsmc_jax.simulation.requirements import Requirement, violation_ratio
from tests.output import examples
from tuning.output import report
from tuning.search import objective

SAMPLED = {"mode": "sampled"}


@pytest.mark.parametrize(
    ("metric", "said", "value"),
    [
        ("hold_angle", "0.05 deg", 0.05 * math.pi / 180),
        ("window_angle", "5 arcsec", 5 / 3600 * math.pi / 180),
        ("terminal_angle", " 2  arcmin ", 2 / 60 * math.pi / 180),
        ("peak_torque", "5 mN m", 5e-3),
        ("peak_torque", "5 mNm", 5e-3),
        ("peak_rate", "1e0 deg/s", math.pi / 180),
        ("settling_time", "0.5 min", 30.0),
        ("effort", 2, 2.0),
    ],
)
def test_a_required_limit_can_be_text_with_a_unit(metric, said, value):
    read = scenario.from_tables({"requirements": {metric: said}})
    assert read.requirements == {metric: pytest.approx(value, rel=1e-15)}
    share = scenario.from_tables({"requirements": {metric: {"limit": said, "quantile": 0.9}}}).requirements[metric]
    assert isinstance(share, Limit)
    assert (share.limit, share.quantile) == (pytest.approx(value, rel=1e-15), 0.9)
    assert scenario.from_tables(parsing.dump(read)) == read


def test_every_unit_of_a_metric_has_an_example_for_error_messages():
    assert {entry.unit for entry in catalogues.CATALOGUE.values()} - {"-"} <= set(units.EXAMPLES)


def test_every_unit_of_a_key_has_an_example_for_error_messages():
    tables = [*layouts.TABLES["spacecraft"].values(), *layouts.DISPERSIONS.values(), sensor_tables.SENSORS]
    structs = [struct for one in tables for struct in (one.values() if isinstance(one, Mapping) else [one])]
    declared = {key.unit for struct in structs for key in keys.list_keys(struct, "N m")}
    assert {unit for unit in declared if units.parse(unit)} <= set(units.EXAMPLES)
    for unit, shown in units.EXAMPLES.items():
        for example in re.findall(r'"(.*?)"', shown):
            assert units.to_number(example, unit) > 0.0


@pytest.mark.parametrize(
    ("text", "unit", "value"),
    [
        ("800 mHz", "rad/s", 1.6 * math.pi),
        ("15 rev/day", "rad/s", 30 * math.pi / 86_400),
        ("3 rpm", "rad/s", math.pi / 10),
        ("3 mdeg/s", "rad/s", np.deg2rad(3e-3)),
        ("0.3 °/hr", "rad/s", np.deg2rad(0.3) / 3600),
        ("50 mas", "rad", np.deg2rad(0.05 / 3600)),
        ("50 marcsec", "rad", np.deg2rad(0.05 / 3600)),
        ("3 µrad", "rad", 3e-6),
        ("200 nrad", "rad", 2e-7),
        ("2 arcmin", "rad", np.deg2rad(2 / 60)),
        ("3 deg/h/sqrt(Hz)", "rad/s/sqrt(Hz)", np.deg2rad(3.0) / 3600),
        ("3 arcsec/sqrt(s)", "rad/s/sqrt(Hz)", np.deg2rad(3 / 3600)),
        ("0.02 °/√h", "rad/s/sqrt(Hz)", np.deg2rad(0.02) / 60),
        ("2 deg/h/sqrt(s)", "rad/s/sqrt(s)", np.deg2rad(2.0) / 3600),
        ("2 urad/s^1.5", "rad/s/sqrt(s)", 2e-6),
        ("3 lb in^2", "kg m^2", 3 * 0.45359237 * 0.0254**2),
        ("3 kg·m²", "kg m^2", 3.0),
        ("4 g mm^2", "kg m^2", 4e-9),
        ("6 mN-m", "N m", 6e-3),
        ("6 N cm", "N m", 6e-2),
        ("6 nN m", "N m", 6e-9),
        ("2 mNm s", "N m s", 2e-3),
        ("2 uNms", "N m s", 2e-6),
        ("3 uN m/sqrt(s)", "N m/sqrt(s)", 3e-6),
        ("0.5 1/min", "1/s", 0.5 / 60),
        ("398600.44 km^3/s^2", "m^3/s^2", 3.9860044e14),
        ("398600.44 km³ s⁻²", "m^3/s^2", 3.9860044e14),
        ("2 deg s^-1", "rad/s", np.deg2rad(2.0)),
        ("20 us", "s", 2e-5),
        ("2 msec", "s", 2e-3),
    ],
)
def test_units_in_texts_can_be_products_of_symbols_with_prefixes(text, unit, value):
    assert units.to_number(text, unit) == pytest.approx(value, rel=1e-15)


@pytest.mark.parametrize(
    ("text", "unit"),
    [
        ("1 kkg m^2", "kg m^2"), ("1 mmin", "s"), ("1 mh", "s"), ("1 s-1", "1/s"), ("1 Hz", "1/s"), ("1 1/s", "rad/s"),
        ("1 lb in", "N m"), ("1 arcsec/sqrt(Hz)", "rad"), ("1 sqrt(s", "s"), ("1 m/", "m"), ("1 x1", "x1"),
        ("1 s^--1", "1/s"), ("1 s^", "s"), ("1 s-²", "1/s^2"),
    ],
)  # fmt: skip
def test_texts_with_an_unknown_or_incompatible_unit_are_refused(text, unit):
    with pytest.raises(ValueError, match="could not convert"):
        units.to_number(text, unit)


def test_a_period_can_be_a_frequency_and_a_frequency_a_period():
    tracker = {"loop": SAMPLED, "hardware": {"attitude_noise": 1e-5, "star_tracker_period": "2.5 Hz"},
               "filter": {"kind": "steady_state", "bandwidth": 0.1}}  # fmt: skip
    assert scenario.from_tables(tracker).hardware.star_tracker_period == 0.4
    assert scenario.from_tables({"loop": {**SAMPLED, "period": "20 Hz"}}).loop.period == 0.05
    orbit = scenario.from_tables({"disturbance": {"kind": "gravity_gradient", "orbit_rate": "95 min"}})
    assert orbit.disturbance.orbit_rate == pytest.approx(2.0 * math.pi / 5700.0)
    with pytest.raises(ScenarioError, match=r'loop\.period is "0 Hz", but must be .* inf is no finite number'):
        scenario.from_tables({"loop": {**SAMPLED, "period": "0 Hz"}})
    with pytest.raises(ScenarioError, match=r'star_tracker_period is "2\.5 Hz" \(0\.4 s\), but without a filter'):
        scenario.from_tables({**tracker, "filter": None})


@pytest.mark.parametrize(
    ("table", "key", "said", "value"),
    [
        ("hardware", "attitude_noise", "10 arcsec", np.deg2rad(10 / 3600)),
        ("hardware", "rate_noise_density", "0.02 deg/sqrt(h)", np.deg2rad(0.02) / 60.0),  # per root of 3 600 s
        ("hardware", "rate_bias", "1 deg/h", np.deg2rad(1.0) / 3600.0),
        ("hardware", "rate_bias_walk", "3deg/h/sqrt(h)", np.deg2rad(3.0) / 3600.0**1.5),
        ("controller", "t_f", "1 min", 60.0),
        ("loop", "period", "50 ms", 0.05),
        ("disturbance", "amplitude", ["1 mN m", 0.0, "20 uN m"], (1e-3, 0.0, 2e-5)),
        ("disturbance", "amplitude", ("1 mN m", 0.0, "20 uNm"), (1e-3, 0.0, 2e-5)),
        ("disturbance", "frequency", ["0.5 Hz", "3 rpm", 1.0], (np.pi, np.pi / 10.0, 1.0)),
        ("spacecraft", "inertia", ["300 kg cm^2", "2e5 g cm^2", "40 g m^2"], (0.03, 0.02, 0.04)),
        ("spacecraft", "inertia", [["30 kg m^2", 0, 0], [0, 3e1, 0], [0, 0, "5e4 g m^2"]], np.diag([30, 30, 50])),
    ],
)
def test_a_number_can_be_text_with_a_unit(table, key, said, value):
    kind = {"kind": "sinusoid"} if table == "disturbance" else {}
    read = scenario.from_tables(
        {"loop": SAMPLED, table: {**({"mode": "sampled"} if table == "loop" else kind), key: said}}
    )
    np.testing.assert_allclose(getattr(getattr(read, table), key), value, rtol=1e-15)
    assert scenario.from_tables(parsing.dump(read)) == read
    other = scenario.replace(scenario.from_tables({"loop": SAMPLED}), **{f"{table}__{key}": said})
    assert getattr(getattr(other, table), key) == getattr(getattr(read, table), key)


@pytest.mark.parametrize(
    ("text", "value"), [("20 uN m", 2e-5), ("0.3 uN m", 3e-7), ("7.2 mN m", 7.2e-3), ("9e3 uNm", 9e-3)]
)
def test_a_number_with_a_unit_is_the_nearest_number_in_si_units(text, value):
    read = scenario.from_tables({"requirements": {"peak_torque": text}})
    assert parsing.dump(read)["requirements"] == {"peak_torque": value}


@pytest.mark.parametrize("exponent", ["400", "9" * 30])
def test_a_number_with_a_unit_that_overflows_is_refused(exponent):
    with pytest.raises(ScenarioError, match="inf is no finite number"):
        scenario.from_tables({"requirements": {"peak_torque": f"1e{exponent} uN m"}})


@pytest.mark.parametrize(
    ("metric", "said", "value"),
    [("gain_margin", "6 dB", 6.0), ("phase_margin", "30 deg", 30.0), ("phase_margin", "0.5 rad", 28.6478897565)],
)
def test_a_required_margin_can_be_text_with_a_unit(metric, said, value):
    read = scenario.from_tables({"loop": SAMPLED, "requirements": {metric: said}})
    assert read.requirements == {metric: pytest.approx(value, rel=1e-11)}


@pytest.mark.parametrize(("kind", "key"), [("normal", "std"), ("uniform", "half_width")])
def test_the_spread_of_the_disturbance_can_have_a_torque_unit(kind, key):
    read = scenario.from_tables({"dispersion": {"disturbance_bias": {"kind": kind, key: "2 mN m"}}})
    assert getattr(read.dispersion.disturbance_bias, key) == 2e-3


def test_only_zero_meets_a_limit_of_zero():
    """The margin is 0 if all values are 0, and above 1 otherwise. The constraint of a search is -1."""
    tables = {"plant": {"kind": "chain"}, "requirements": {"saturated": 0}, "loop": SAMPLED}
    ready = scenario.study(scenario.from_tables(tables))
    (requirement,) = ready.requirements
    kept = requirement.verdict(np.zeros(3), np.ones(3, bool))
    assert (kept.met, kept.margin) == (True, 0.0)
    broken = requirement.verdict(np.array([0.0, 1e-6, 0.0]), np.ones(3, bool))
    assert (broken.met, broken.failures) == (False, 1)
    assert broken.margin > 1.0
    np.testing.assert_array_equal(violation_ratio(np.array([0.0, 0.2]), 0.0, at_least=False), [0.0, 1.2])
    trials = objective.problem(ready.parts, ready.dispersion, 0, np.arange(2), ("eta",), ready.requirements)
    c = np.asarray(jax.jit(objective.measure)(trials, vector([3.0]))[1])
    np.testing.assert_array_equal(c, [[-1.0, -1.0]])  # without a torque limit nothing saturates


def test_report_states_the_deciding_value_relative_to_the_limit():
    """For a fraction of the trials the deciding value is not the largest one, here the third of four values."""
    values = np.array([0.3, 0.4, 0.45, 0.7])

    def told(quantile):
        one = Requirement("peak_torque", 0.5, quantile=quantile).verdict(values, np.ones(4, bool))
        return report.per_cent_of_limit(examples.entry(one))

    assert told(0.75) == "; the deciding trial is at 90 % of the limit"
    assert told(None) == "; 140 % of the limit"
    timed = Requirement("ape_x", 0.02, quantile=0.9, interpretation="temporal")
    of_time = timed.verdict(np.full(50, 0.03), np.ones(50, bool), np.full(50, 0.98))
    assert report.per_cent_of_limit(examples.entry(of_time)) == "; 20 % of the time allowed beyond the limit"
