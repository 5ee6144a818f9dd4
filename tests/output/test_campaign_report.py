"""The report of a campaign, and single trials in words."""

from pathlib import Path

import numpy as np
import polars as pl
import pytest

from ptsmc_jax.numerics import statistics
from ptsmc_jax.simulation.requirements import Requirement
from tests.output import examples
from tuning.output import campaign_report, map_report, trials_report


def test_fractions_have_the_digits_that_matter():
    """59 of 60 trials were 98.3333 %; near all of them the missing ones count."""
    asked = Requirement("peak_torque", 0.5, quantile=0.95)
    verdict = asked.verdict(np.r_[np.zeros(59), 1.0], np.ones(60, bool))
    found = examples.entry(verdict, fraction=59 / 60, fraction_interval=[0.91056, 0.99957], fraction_bound=0.92333)
    text = campaign_report.verdict(found)
    assert "98.33 % of trials keep the limit (95 %: 91.06 to 99.957 %)" in text
    wide = Requirement("ape_x", 1.0, quantile=0.9, interpretation="mixed")
    seen = wide.verdict(np.ones(3), np.ones(3, bool), np.array([1.0, 0.95, 1.0]))
    assert str(examples.entry(seen)).endswith("98.33 %: met")


@pytest.mark.parametrize(("without", "largest"), [(1, "57.2"), (2, "none")])
def test_no_largest_settling_time_if_a_run_that_ended_never_settled(without, largest):
    """Trials that failed have none either, but they are counted above the table."""
    at = {"value": 56.0, "low": 55.0, "high": 57.0}
    settling = {"without_value": without, "max": 57.2, "0.5": at, "0.9973": at}
    found = examples.campaign(
        counts={"ok": 58, "not_converged": 1, "diverged": 1}, quantiles={"settling_time": settling}
    )
    (table,) = campaign_report.quantiles(found)
    assert table.rows == [("settling_time", "56", "56", "55..57", largest, "s")]


@pytest.mark.parametrize("lower_bound", [None, 0.0])
def test_no_lower_bound_without_noise(lower_bound):
    at = {"value": 1e-5, "low": 1e-5, "high": 1e-5}
    error = {"without_value": 0, "rms": 1e-5, "max": 1e-5, "0.5": at, "0.9973": at}
    report = campaign_report.of(examples.campaign(quantiles={"window_error": error}, lower_bound=lower_bound))
    assert report.headline == "RMS pointing error 4.13 arcsec: every trial reached its end"
    assert report.lines == ["8 trials of seed 1: 8 ok"]


def test_gains_of_a_campaign_have_their_units():
    tables = {
        "controller": {"kind": "prescribed_time", "eta": 3.0},
        "observer": {"kind": "nonlinear", "gain": [1.0, 2.0, 3.0]},
    }
    assert campaign_report.gains(tables, "spacecraft").rows == [
        ("controller.kind", "prescribed_time", ""),
        ("controller.eta", "3", ""),
        ("observer.kind", "nonlinear", ""),
        ("observer.gain", "1, 2, 3", "N m s"),
    ]
    bounds = {
        "controller": {"kind": "pd", "disturbance_bound": 0.1},
        "observer": {"kind": "finite_time", "gain": [0.02]},
    }
    assert campaign_report.gains(bounds, "spacecraft").rows[1::2] == [
        ("controller.disturbance_bound", "0.1", "N m"),
        ("observer.gain", "0.02", "N m/s"),  # the nonlinear observer's is in N m s
    ]
    custom = {
        "controller": {"kind": "custom", "t_f": 30.0, "k": 2.0}
    }  # its class may have another unit than a built-in k
    assert campaign_report.gains(custom, "spacecraft").rows[1:] == [
        ("controller.t_f", "30", "s"),
        ("controller.k", "2", ""),
    ]


def test_inputs_that_rank_the_trials_alike_are_one_driver():
    rng = np.random.default_rng(0)
    angle, other = rng.uniform(0.3, 2.4, 1000), rng.normal(size=1000)
    inputs = {"initial_angle": angle, "initial_q4": np.cos(angle / 2), "other": other}
    assert list(statistics.drivers(inputs, angle + other)) == ["initial_angle", "other"]


NO_DRIVER = "no dispersed quantity alone explains 5 % of the variance of the ranks of window_error"


def driver_lines(drivers, trials):
    found = {"drivers": {"window_error": drivers}, "driver_trials": {"window_error": trials}}
    return list(campaign_report.drivers(examples.campaign(simulated=10_000, trials=10_000, **found)))


def test_chance_is_no_driver():
    """In an earlier version, some of twenty inputs without influence were named, with correlations of 0.1."""
    rng = np.random.default_rng(0)
    inputs, metric = {f"x{k}": rng.normal(size=300) for k in range(20)}, rng.normal(size=300)
    drivers = statistics.drivers(inputs, metric)
    assert max(abs(one["rank_correlation"]) for one in drivers.values()) > 0.1
    assert driver_lines(drivers, 300) == [NO_DRIVER]
    assert driver_lines({}, 300) == []
    (line,) = driver_lines(statistics.drivers({"y": metric + rng.normal(size=300)}, metric), 300)
    assert line.startswith("window_error is driven by y (rank correlation +0.")


@pytest.mark.parametrize(("correlation", "trials", "named"), [(0.22, 1000, False), (0.3, 1000, True), (0.3, 90, False)])
def test_driver_explains_a_significant_part_of_the_variance(correlation, trials, named):
    """A rank correlation of 0.22 explains 4.8 % of the variance. One of 0.3 is insignificant in 90 trials."""
    (line,) = driver_lines({"initial_angle": {"rank_correlation": correlation, "first_order": 0.0}}, trials)
    driven = "window_error is driven by initial_angle (rank correlation +0.30, 9 % of the variance of the ranks)"
    assert line == (driven if named else NO_DRIVER)


def test_command_that_replays_the_worst_trial_can_be_pasted_into_a_shell():
    rows = pl.DataFrame({"trial": [7], "window_error": [0.1]})
    text = trials_report.how_to_replay(rows, Path("my out"), custom=True)
    assert text.endswith("ptsmc replay 'my out' --trial 7 --trust")


def test_best_pair_of_a_map_has_the_fewest_failed_trials():
    pair = {"status": "simulated", "failures": 0.0, "not_converged": 0.0, "window_error": 2e-6, "peak_torque": 0.3}
    pairs = [
        {**pair, "x": 1.0, "y": 1.0, "failures": 3.0, "window_error": 1e-6},
        {**pair, "x": 1.0, "y": 2.0},
        {**pair, "x": 2.0, "y": 1.0, "not_converged": 2.0, "window_error": 1e-6},
        {**pair, "x": 2.0, "y": 2.0, "status": "not allowed", "window_error": float("nan")},
    ]
    keys = "loop.period", "controller.delta"
    assert list(map_report.lines(pairs, keys, "spacecraft")) == [
        "the smallest RMS error is 0.825 arcsec at loop.period = 1 and controller.delta = 2, with a mean peak torque "
        "of 0.3 N m",
        "3 of 4 pairs simulated, 2 of them with trials that failed or did not converge at t_f",
    ]
    best, _ = map_report.lines(pairs[:1], keys, "spacecraft")
    assert best.endswith("of 0.3 N m; 3 of its trials failed or did not converge at t_f")
