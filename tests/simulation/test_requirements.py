import numpy as np
import pytest
from hypothesis import example, given, settings
from hypothesis import strategies as st
from scipy.stats import binom

from ptsmc_jax.simulation.catalogues import CATALOGUE
from ptsmc_jax.simulation.requirements import Requirement, fewest_trials, must_keep

LIMIT = 0.5
BEYOND = np.nextafter(LIMIT, 1.0)


def verdict(values, ok=None, metric="peak_torque"):
    """Return the verdict on the values of trials by a limit of 0.5; ok: (trials,), False for a failed trial."""
    values = np.asarray(values, dtype=float)
    return Requirement(metric, LIMIT).verdict(values, np.ones(values.shape, bool) if ok is None else np.asarray(ok))


@pytest.mark.parametrize(("value", "ok", "met"), [(LIMIT, True, True), (BEYOND, True, False), (0.1, False, False)])
def test_a_single_run_meets_a_limit_if_it_completes_and_does_not_exceed_it(value, ok, met):
    told = Requirement("peak_torque", LIMIT).verdict(np.asarray(value), np.asarray(ok))
    assert (told.met, told.failures, told.trials) == (met, int(not met), 1)


def test_a_verdict_over_many_loops_says_that_they_are_dispersed():
    """The verdict of a single loop prints the value alone."""
    required = Requirement("gain_margin", 6.0, "dB", at_least=True)
    many, one = (required.verdict(np.asarray(v), np.ones(np.shape(v), bool)) for v in ([7.0, 6.2, 9.0], 6.2))
    assert str(many) == "gain_margin at least 6 dB: worst of 3 dispersed loops 6.2 dB: met"
    assert str(one) == "gain_margin at least 6 dB: 6.2 dB: met"


@settings(max_examples=100, deadline=None, derandomize=True, database=None)
@given(st.lists(st.tuples(st.floats() | st.floats(0.0, 1.0), st.booleans()), min_size=1, max_size=20))
@example([(9e307, True)])  # the ratio to the limit overflows
@example([(0.1, True), (LIMIT, True)])  # a value at the limit meets it
@example([(0.1, True), (BEYOND, True)])
@example([(0.6, True), (0.1, True), (0.9, True)])
@example([(0.1, True), (np.inf, True)])
@example([(0.1, True), (np.nan, True)])  # a trial without a value violates the limit
@example([(0.1, True), (0.2, False)])  # a failed trial violates the limit with any value
@example([(np.nan, False), (np.nan, False)])
def test_a_verdict_over_trials_combines_the_verdicts_of_each_trial(trials):
    told = verdict([value for value, _ in trials], [ok for _, ok in trials])
    assert told.failures == sum(not (ok and value <= LIMIT) for value, ok in trials)
    assert (told.trials, told.met) == (len(trials), told.failures == 0)
    assert (told.metric, told.limit) == ("peak_torque", LIMIT)
    worst = float(np.max([value if ok else np.nan for value, ok in trials]))  # NaN if a trial failed or has no value
    np.testing.assert_equal((told.worst, told.margin), (worst, worst / LIMIT))


@pytest.mark.parametrize("metric", CATALOGUE)
def test_a_verdict_carries_the_unit_of_its_metric(metric):
    assert verdict([0.1], metric=metric).unit == CATALOGUE[metric][0]


def test_a_verdict_prints_one_sentence():
    assert str(verdict([0.1, 0.25])) == "peak_torque at most 0.5 N m: worst 0.25 N m: met"
    said = str(verdict([0.1, 0.75, 0.9]))
    assert said == "peak_torque at most 0.5 N m: worst 0.9 N m: NOT met in 2 of 3 trials"
    assert str(verdict([0.75])) == "peak_torque at most 0.5 N m: 0.75 N m: NOT met"
    assert str(verdict([0.1], [False])) == "peak_torque at most 0.5 N m: no value: NOT met"
    lost = str(verdict([0.1, 0.2], [False, True]))
    assert lost == "peak_torque at most 0.5 N m: no worst value: NOT met in 1 of 2 trials"
    assert str(verdict([0.1], metric="saturated")) == "saturated at most 0.5: 0.1: met"


def test_verdicts_print_angles_in_arcsec_and_rates_in_degrees_too():
    turned = Requirement("hold_angle", np.deg2rad(0.1)).verdict(np.deg2rad([0.05, 0.02]), np.array([True, True]))
    assert str(turned) == "hold_angle at most 360 arcsec: worst 180 arcsec: met"
    error = Requirement("window_error", 1e-5).verdict(np.asarray(5e-6), np.array(True))  # the sine of half the angle
    assert str(error) == "window_error at most 4.1253 arcsec: 2.063 arcsec: met"
    of_state = Requirement("window_error", 1e-5, "x1").verdict(np.asarray(5e-6), np.array(True))
    assert str(of_state) == "window_error at most 1e-05 x1: 5e-06 x1: met"
    turning = Requirement("peak_rate", np.deg2rad(2.0)).verdict(np.deg2rad(3.0), np.array(True))
    assert str(turning) == "peak_rate at most 0.0349066 rad/s (2 deg/s): 0.05236 rad/s (3 deg/s): NOT met"


@pytest.mark.parametrize("quantile", [0.5, 0.9, 0.99, 0.9973])
@pytest.mark.parametrize("confidence", [0.5, 0.9, 0.99])
@pytest.mark.parametrize("trials", [10, 100, 1000, 5000])
def test_a_fraction_is_demonstrated_by_the_exact_binomial_bound(quantile, confidence, trials):
    """The test checks `must_keep`, the number of a campaign's trials that must keep a limit.

    If the true fraction were equal to the quantile, at least this number of trials would keep the limit in at most
    1 - confidence of all campaigns. For one trial fewer, this fraction of campaigns would be larger.
    """
    least = must_keep(trials, quantile, confidence)
    if least is None:
        assert trials < fewest_trials(quantile, confidence)
        assert quantile**trials > 1 - confidence  # even all trials would not suffice
        return
    assert binom.sf(least - 1, trials, quantile) <= (1 - confidence) * (1 + 1e-9)
    assert binom.sf(least - 2, trials, quantile) > 1 - confidence
    assert trials >= fewest_trials(quantile, confidence)


def test_a_three_sigma_requirement_needs_852_trials():
    assert fewest_trials(0.9973, 0.9) == 852
    assert must_keep(852, 0.9973, 0.9) == 852
    assert must_keep(851, 0.9973, 0.9) is None
    assert must_keep(1000, 0.9973, None) == 998  # the observed fraction, without a confidence
    assert must_keep(1000, None, None) == 1000


@pytest.mark.parametrize(("beyond", "quantile", "confidence", "met"), [
    (0, None, None, True), (1, None, None, False),
    (10, 0.99, None, True), (11, 0.99, None, False),
    (5, 0.99, 0.9, True), (6, 0.99, 0.9, False),
    (0, 0.9999, 0.9, False),
])  # fmt: skip
def test_a_requirement_on_a_fraction_of_the_trials_allows_some_violations(beyond, quantile, confidence, met):
    """Its margin is the factor on the limit at which the requirement is just met."""
    values = np.linspace(0.1, LIMIT, 1000)
    values[:beyond] = BEYOND + np.arange(beyond) * 0.01
    told = Requirement("peak_torque", LIMIT, None, quantile, confidence).verdict(values, np.ones(1000, bool))
    assert (told.met, told.failures) == (met, beyond)
    if np.isfinite(told.margin):  # the margin is the factor on the limit at which the requirement is just met
        for factor, does in ((1.0, True), (1.0 - 1e-9, False)):
            moved = Requirement("peak_torque", LIMIT * told.margin * factor, None, quantile, confidence)
            assert moved.verdict(values, np.ones(1000, bool)).met == does
        assert (told.margin <= 1.0) == met
    else:
        assert must_keep(1000, quantile, confidence) is None


def test_failed_trials_count_as_violations():
    values, ok = np.full(100, 0.1), np.ones(100, bool)
    ok[:11] = False
    told = Requirement("peak_torque", LIMIT, None, 0.9).verdict(values, ok)
    assert (told.met, told.failures, told.margin) == (False, 11, np.inf)


def test_a_single_run_is_judged_by_the_limit_alone():
    told = Requirement("peak_torque", LIMIT, None, 0.99, 0.9).verdict(np.asarray(0.4), np.asarray(True))
    assert told.met
    assert str(told) == "peak_torque at most 0.5 N m: 0.4 N m: met"


def test_a_campaign_of_one_trial_demonstrates_no_fraction():
    told = Requirement("peak_torque", LIMIT, None, 0.99, 0.9).verdict(np.array([0.4]), np.array([True]))
    assert not told.met
    assert str(told).endswith("0.4 N m: NOT shown, which takes at least 230 trials with no failure")
    assert told.word == "NOT shown"


@pytest.mark.parametrize("trials", [2, 3, 10])
@pytest.mark.parametrize("quantile", [0.05, 0.3, 0.5])
def test_rounding_does_not_change_the_required_number_of_trials(trials, quantile):
    """For such a confidence, quantile^n equals 1 - confidence except for rounding."""
    for digits in (-2, -1, 0, 1, 2):
        confidence = float(1.0 - quantile**trials * (1.0 + digits * 2.0**-52))
        needed = fewest_trials(quantile, confidence)
        assert needed in (trials, trials + 1)
        assert must_keep(needed, quantile, confidence) == needed


def test_a_verdict_on_a_fraction_of_the_trials_is_printed_in_words():
    """NOT met: too many trials violate the limit. NOT shown: there are too few trials for the confidence."""
    values = np.linspace(0.1, 0.4, 1000)
    share = Requirement("peak_torque", LIMIT, None, 0.99, 0.9)
    said = "peak_torque at most 0.5 N m in 99 % of trials with 90 % confidence: worst"
    ok = np.ones(1000, bool)
    assert str(share.verdict(values, ok)) == f"{said} 0.4 N m: met"
    values[:3] = 0.6
    assert str(share.verdict(values, ok)) == f"{said} 0.6 N m: met, beyond it 3 of 1000 trials"
    values[:9] = 0.6
    assert str(share.verdict(values, ok)) == f"{said} 0.6 N m: NOT met in 9 of 1000 trials, at most 5 allowed"
    assert str(share.verdict(values[:50], ok[:50])) == f"{said} 0.6 N m: NOT met in 9 of 50 trials"
    some = str(share.verdict(values[8:150], ok[8:150]))
    assert some.endswith("N m: NOT shown, which takes at least 388 trials with as many failures")
    few = str(share.verdict(values[9:50], ok[9:50]))
    assert few.endswith("N m: NOT shown, which takes at least 230 trials with no failure")


RUNS = 1000
INDEX = "ape_boresight"


def of_time(interpretation, within, probability=0.9973, confidence=None, ok=None, values=None):
    """Return the verdict on a fraction of time.

    within: fraction of the time that each run keeps the limit. probability, confidence: of the requirement. ok: False
    for a failed run. values: the index of each run.
    """
    within = np.asarray(within, dtype=float)
    asked = Requirement(INDEX, 1e-3, "rad", probability, confidence, interpretation=interpretation)
    assert asked.timed == f"within_{INDEX}"
    values = np.full(within.shape, 2e-3) if values is None else values
    return asked.verdict(values, np.ones(within.shape, bool) if ok is None else ok, within)


def test_temporal_interpretation_requires_a_fraction_of_the_time_in_every_run():
    """A failed run counts as 0. The margin is the time beyond the limit over the allowed time."""
    kept = np.full(RUNS, 1.0)
    kept[7] = 0.998
    told = of_time("temporal", kept)
    assert (told.met, told.failures, told.shown) == (True, 0, pytest.approx(0.998))
    assert told.margin == pytest.approx(0.002 / 0.0027)
    kept[7] = 0.9973
    assert of_time("temporal", kept).met  # exactly the required fraction
    kept[8] = 0.99
    told = of_time("temporal", kept)
    assert (told.met, told.failures) == (False, 1)
    assert "in 99.73 % of the time, in every run: the least of a run is 99 %: NOT met, 1 of 1000 runs have less" in str(
        told
    )
    assert not of_time("temporal", np.ones(RUNS), ok=np.arange(RUNS) > 0).met  # a failed run counts as 0


def test_mixed_interpretation_requires_a_fraction_of_the_time_of_all_runs():
    """The confidence depends on the number of runs, because only runs are independent. A failed run counts as 0."""
    never = of_time("mixed", np.ones(852), confidence=0.9)
    assert never.met  # as many runs without a violation as for an ensemble
    assert never.shown == pytest.approx(0.1 ** (1 / 852))
    told = of_time("mixed", np.ones(851), confidence=0.9)
    assert told.word == "NOT shown"
    assert str(told).endswith("NOT shown, which takes at least 852 runs with no failure")
    # half of the runs exceed the limit for 1/200 of the time, which would violate an ensemble requirement
    kept = np.where(np.arange(RUNS) % 2, 1.0, 0.995)
    told = of_time("mixed", kept)
    assert (told.met, told.fraction_of_time) == (True, pytest.approx(0.9975))
    assert "99.73 % of the time of all runs: a random run at a random time: 99.75 %: met" in str(told)
    many = np.tile(kept, 20)
    sure = of_time("mixed", many, confidence=0.9)
    assert sure.shown is not None
    assert 0.9973 < sure.shown < 0.9975
    assert sure.met
    assert of_time("mixed", many, confidence=0.999).word == "NOT met"
    assert of_time("mixed", [0.9], confidence=0.9).word == "NOT met"
    assert of_time("temporal", [0.9], confidence=0.9).word == "NOT met"
    # only runs are independent: with n runs, a fraction 1 - 0.1^(1/n), about 2.3/n, may fail without being observed
    fewer = of_time("mixed", kept, confidence=0.9)
    assert fewer.shown == pytest.approx(0.9975 - 2.3 / RUNS, abs=1e-4)
    assert not fewer.met
    assert fewer.shown is not None
    assert sure.margin <= 1.0 < fewer.margin == pytest.approx((1.0 - fewer.shown) / (1.0 - 0.9973))
    failed = of_time("mixed", kept, ok=np.arange(RUNS) > 0)
    assert failed.fraction_of_time == pytest.approx(0.9975 - 0.995 / RUNS)


def test_a_single_run_is_judged_by_its_fraction_of_the_time():
    for interpretation in ("temporal", "mixed"):
        asked = Requirement(INDEX, 1e-3, "rad", 0.9, 0.95 if interpretation == "mixed" else None,
                            interpretation=interpretation)  # fmt: skip
        for share, met in ((0.95, True), (0.85, False)):
            assert asked.verdict(np.asarray(2e-3), np.asarray(True), np.asarray(share)).met is met


def test_ensemble_interpretation_is_the_same_as_a_quantile():
    asked = Requirement(INDEX, 1e-3, "rad", 0.9973, 0.9)
    assert asked.timed is None
    assert asked.implied_by == asked
    assert Requirement(INDEX, 1e-3, "rad", 0.9973, 0.9, interpretation="mixed").implied_by == asked
    every = Requirement(INDEX, 1e-3, "rad", 0.9973, interpretation="temporal").implied_by
    assert (every.quantile, every.interpretation) == (None, "ensemble")
