import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from ptsmc_jax.metrics import CATALOGUE
from ptsmc_jax.requirements import Requirement

LIMIT = 0.5
BEYOND = np.nextafter(LIMIT, 1.0)


def verdict(values, ok=None, metric="peak_torque"):
    values = np.asarray(values, dtype=float)
    return Requirement(metric, LIMIT).verdict(values, np.ones(values.shape, bool) if ok is None else np.asarray(ok))


@pytest.mark.parametrize(
    ("values", "ok", "failures", "worst"),
    [
        ([0.1, 0.4, 0.2], [True, True, True], 0, 0.4),
        ([0.1, LIMIT], [True, True], 0, LIMIT),  # at the limit is within it
        ([0.1, BEYOND], [True, True], 1, BEYOND),
        ([0.6, 0.1, 0.9], [True, True, True], 2, 0.9),
        ([0.0], [True], 0, 0.0),
        ([0.1, np.inf], [True, True], 1, np.inf),
        ([0.1, np.nan], [True, True], 1, np.nan),  # a trial without a value cannot have kept the limit
        ([0.1, 0.2], [True, False], 1, np.nan),  # nor one that failed, whatever its value
        ([0.9, np.nan, 0.1, 0.2], [True, True, False, True], 3, np.nan),
        ([np.nan, np.nan], [False, False], 2, np.nan),
    ],
)
def test_verdict(values, ok, failures, worst):
    told = verdict(values, ok)
    assert (told.failures, told.trials, told.met) == (failures, len(values), failures == 0)
    np.testing.assert_equal((told.worst, told.margin), (worst, worst / LIMIT))
    assert (told.metric, told.limit) == ("peak_torque", LIMIT)


@pytest.mark.parametrize(("value", "ok", "met"), [(LIMIT, True, True), (BEYOND, True, False), (0.1, False, False)])
def test_verdict_on_a_single_run(value, ok, met):
    told = Requirement("peak_torque", LIMIT).verdict(np.asarray(value), np.asarray(ok))
    assert (told.met, told.failures, told.trials) == (met, int(not met), 1)


@settings(max_examples=100, deadline=None, derandomize=True, database=None)
@given(st.lists(st.tuples(st.floats(), st.booleans()), min_size=1, max_size=20))
def test_a_verdict_is_what_each_trial_says(trials):
    told = verdict([value for value, _ in trials], [ok for _, ok in trials])
    assert told.failures == sum(not (ok and value <= LIMIT) for value, ok in trials)
    assert told.met == all(ok and value <= LIMIT for value, ok in trials)
    assert not told.met or told.worst == max(value for value, _ in trials)


@pytest.mark.parametrize("metric", CATALOGUE)
def test_a_verdict_carries_the_unit_of_its_metric(metric):
    assert verdict([0.1], metric=metric).unit == CATALOGUE[metric][0]


def test_a_verdict_in_words():
    assert str(verdict([0.1, 0.25])) == "peak_torque at most 0.5 N m: worst 0.25: met"
    said = str(verdict([0.1, 0.75, 0.9]))
    assert said == "peak_torque at most 0.5 N m: worst 0.9: NOT met in 2 of 3 trials"
    assert str(verdict([0.75])) == "peak_torque at most 0.5 N m: 0.75: NOT met"
    assert str(verdict([0.1], [False])) == "peak_torque at most 0.5 N m: no value: NOT met"
    lost = str(verdict([0.1, 0.2], [False, True]))
    assert lost == "peak_torque at most 0.5 N m: no worst value: NOT met in 1 of 2 trials"
    assert str(verdict([0.1], metric="saturated")) == "saturated at most 0.5: 0.1: met"
