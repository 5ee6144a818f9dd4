"""Limits with units, limits of zero, and the ratio to the limit in a verdict."""

import math
import re

import jax
import numpy as np
import pytest

from ptsmc_jax import scenario
from ptsmc_jax.numerics.pytrees import vector
from ptsmc_jax.scenario import parsing
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
def test_a_limit_can_be_text_with_a_unit(metric, said, value):
    read = scenario.from_tables({"requirements": {metric: said}})
    assert read.requirements == {metric: pytest.approx(value, rel=1e-15)}
    share = scenario.from_tables({"requirements": {metric: {"limit": said, "quantile": 0.9}}}).requirements[metric]
    assert isinstance(share, Limit)
    assert (share.limit, share.quantile) == (pytest.approx(value, rel=1e-15), 0.9)
    assert scenario.from_tables(parsing.dump(read)) == read


def test_every_metric_unit_of_a_spacecraft_accepts_text():
    assert {entry.unit for entry in catalogues.CATALOGUE.values()} - {"-"} <= set(catalogues.UNITS)


def test_every_unit_has_an_example_for_error_messages():
    assert catalogues.EXAMPLES.keys() == catalogues.UNITS.keys()
    for unit, shown in catalogues.EXAMPLES.items():
        for number, name in re.findall(r'"(\S+) (.*?)"', shown):
            assert float(number) > 0.0
            assert name in catalogues.UNITS[unit]


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
