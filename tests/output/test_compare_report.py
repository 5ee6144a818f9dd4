"""The report of a comparison of laws."""

import numpy as np

from ptsmc_jax.simulation.requirements import Requirement
from tests.output import examples
from tuning.output import compare_report


def test_each_law_has_the_number_of_trials_that_break_each_requirement():
    def law(failures):
        verdict = Requirement("peak_torque", 0.5).verdict(np.arange(1000) < failures, np.ones(1000, bool))
        return examples.law(window_error=1e-5, verdicts=[verdict.in_summary()], met=verdict.met)

    found = examples.compare({"pd": law(12), "prescribed_time": law(0)})
    table = compare_report.table(compare_report.QUESTIONS[0], found.laws)
    assert table.head[-2:] == ("trials beyond peak_torque", "all limits met")
    assert [row[-2:] for row in table.rows] == [("12 of 1000: NOT met", "no"), ("0 of 1000", "yes")]
    assert [row[1] for row in table.rows] == ["4.13", "4.13"]  # arcsec


def test_numbers_of_laws_have_no_exponents_below_a_million():
    """1500 times the lower bound was printed as 1.5e+03."""
    first, second = examples.law(window_error=1.5e-3, lower_bound=1e-6), examples.law(lower_bound=1e-6)
    laws = examples.compare({"a": first, "b": second}).laws
    assert [compare_report.cell(compare_report.BOUND, law) for law in laws.values()] == ["1500", "-"]


def test_chart_shows_the_smallest_lower_bound_and_a_required_limit():
    laws = [examples.law(lower_bound=lower_bound) for lower_bound in (2e-6, 1e-6, None)]
    asked = examples.law(verdicts=[examples.torque(0.9)])
    found = list(examples.compare({str(k): law for k, law in enumerate([*laws, asked])}).laws.values())
    accuracy, torque, *_ = compare_report.QUESTIONS
    (level,) = compare_report.marks(accuracy, found).values()
    np.testing.assert_allclose(level, 2e-6 * 180 * 3600 / np.pi)  # arcsec
    assert compare_report.marks(accuracy, found[2:]) == {}
    assert compare_report.marks(torque, found[:3]) == {}
    assert compare_report.marks(torque, found) == {"limit": 0.5}
