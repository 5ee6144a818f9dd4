"""The report of a Pareto front."""

import json
import math

import numpy as np
import pytest

from ptsmc_jax.campaigns.store import plain
from tuning.output import front_report, page_charts
from tuning.studies.front import Front, Point, read


def front(*points, **changes):
    """A front after a round trip through summary.json."""
    made = Front(
        **{
            "against": "torque", "plant": "spacecraft", "points": list(points), "idle": [], "without": [],
            "trials": 1000, "seed": 1, "interval_confidence": 0.95, "lower_bound": None, "rollouts": 1, "gradients": 1,
            "requirements": [], "gain_units": {"eta": "-", "observer_gain": "kg m^2/s"}, "warnings": [],
            "published_label": "published", **changes,
        }
    )  # fmt: skip
    return read(plain(made.summary()))


def torque(limit, peak, rms, gains=(("eta", 3.0),), **changes):
    return Point(limit, dict(gains), rms, costs={"peak_torque": peak, "mean_peak_torque": peak / 2}, **changes)


def robust(limit, rms, **margins):
    costs = {"gain_margin": 6.1, "phase_margin": 40.0, "delay_margin": math.inf, "peak_sensitivity": 5.8, **margins}
    interval = (0.95 * rms, 1.05 * rms)
    return Point(limit, {"eta": 3.0, "observer_gain_2": 25.0}, rms, interval, {"peak_torque": 0.2, **costs}, meets=True)


def slew(t_f, rms, peak, **changes):
    return Point(t_f, {"eta": 3.0}, rms, (0.9 * rms, 1.1 * rms), {"peak_torque": peak}, **changes)


def test_torque_front_states_pointing_error_at_each_end_and_the_knee():
    points = [torque(0.1, 0.09, 1e-4), torque(0.2, 0.19, 1e-5, knee=True), torque(0.5, 0.49, 2e-6, meets=True)]
    made = front(*points, lower_bound=1e-6, requirements=["peak_torque"])
    assert list(front_report.answers(made)) == [
        "RMS error 0.825 arcsec at a largest peak torque of 0.49 N m (most torque)",
        "RMS error 4.13 arcsec at a largest peak torque of 0.19 N m (knee)",
        "RMS error 41.3 arcsec at a largest peak torque of 0.09 N m (least torque)",
    ]
    assert list(front_report.remarks(made)) == [
        "lower bound on the RMS error with these sensors: 0.413 arcsec, whatever the torque"
    ]
    assert front_report.heading(made) == "3 points, each judged on 1000 held-out trials"
    table = front_report.results(made)
    assert table.rows[1] == ("0.2", "4.13 arcsec", "-", "1.000e-05", "10", "0.19", "0.095", "knee")
    assert len(table.head) == len(table.rows[1])


def test_missing_and_dominated_points_and_missed_requirements_are_reported():
    points = [torque(0.1, 0.1, 1e-5), torque(0.2, 0.2, 2e-5, dominated=True)]
    made = front(*points, idle=[0.5], without=[0.01, 0.02], requirements=["effort"], published_unavailable="eta is 2")
    assert list(front_report.remarks(made)) == [
        "no separate point for limit on the peak torque: 0.5 N m; another point has the same gains",
        "no gains found keep all limits on the training trials for limit on the peak torque: 0.01, 0.02 N m",
        "omitted: 1 point with more torque and a larger error, beyond its interval",
        "no point meets every requirement on the held-out trials",
        "the published gains cannot be simulated in this scenario: eta is 2",
    ]
    assert [row[0] for row in front_report.results(made).rows] == ["0.1"]


def test_points_without_a_completed_trial_have_no_numbers():
    lost = torque(0.1, math.nan, math.nan, failures=9)
    made = front(lost, others={"published": lost})
    row = ("-", "-", "-", "-", "-", "9 failed or not converged")
    assert front_report.results(made).rows == [("0.1", *row), ("published", *row)]
    assert list(front_report.answers(made)) == []
    assert page_charts.front(made, None)["data"] == []


def test_gains_of_each_axis_next_to_one_gain_for_all_axes_or_none():
    each = torque(0.3, 0.3, 1e-5, {"observer_gain_1": 5.0, "observer_gain_2": 6.0})
    others = {"published": torque(1.0, 1.0, 1e-5, {"observer_gain": 10.0}), "before": torque(1.0, 1.0, 1e-5, {})}
    table = front_report.gains(front(each, others=others, published_label="published, scaled"))
    assert table.rows == [("0.3", "5", "6"), ("published, scaled", "10", "10"), ("before", "-", "-")]
    assert table.head[1:] == ("observer_gain_1 [kg m^2/s]", "observer_gain_2 [kg m^2/s]")


def test_limit_exceeded_on_held_out_trials_is_not_compared_with_no_limit():
    points = [robust(math.inf, 1e-5), robust(6.0, 2e-5, gain_margin=-100.0, peak_sensitivity=100.0),
              robust(4.0, 3e-5, peak_sensitivity=4.02)]  # fmt: skip
    assert list(front_report.answers(front(*points, against="margins", plant="chain"))) == [
        "RMS error 3e-05 x1 with |S| at most 4 dB, 3 times the error without a limit",
        "the gains found for |S| at most 6 dB exceed it on the held-out trials: 100 dB",
    ]


def test_unstable_loops_and_limits_without_gains_are_reported():
    loose = robust(math.inf, 1e-5, gain_margin=-0.3, peak_sensitivity=100.0)
    made = front(loose, robust(6.0, 2e-5), against="margins", idle=[60.0], without=[3.0], lower_bound=1e-6)
    assert list(front_report.answers(made)) == [
        "RMS error 8.25 arcsec with |S| at most 6 dB, 2 times the error without a limit",
        "without a limit on |S| some loops of the held-out trials are unstable",
    ]
    assert [row[:1] + row[4:] for row in front_report.results(made).rows] == [
        ("none", "10", "0.2", "-0.3", "40", "none", "100", "meets"),
        ("6", "20", "0.2", "6.1", "40", "none", "5.8", "meets"),
    ]
    none = front(against="margins", without=[math.inf, 6.0], requirements=["effort"])
    assert list(front_report.remarks(none)) == [
        "no gains found keep all limits on the training trials for limit on |S|: none, 6 dB",
        "no point meets every requirement on the held-out trials",
    ]
    assert front_report.results(none).rows == front_report.gains(none).rows == []


def test_slew_times_state_the_shortest_time_and_the_cost_of_the_fastest_slew():
    fast, slow = slew(8.0, 1e-5, 0.2, failures=2), slew(16.0, 4e-6, 0.05, meets=True)
    made = front(fast, slow, against="t_f", without=[4.0], requirements=["peak_torque"])
    assert list(front_report.answers(made)) == [
        "RMS error 1.65 arcsec at t_f = 16 s, the shortest time that meets every requirement",
        "RMS error 4.13 arcsec at t_f = 8 s, 2.5 times the value at 16 s",
        "peak torque 0.2 N m at t_f = 8 s, 4 times the value at 16 s",
    ]
    assert list(front_report.remarks(made)) == ["no gains found keep all limits on the training trials for t_f: 4 s"]
    rows = front_report.results(made).rows
    assert rows[0] == ("8", "4.13 arcsec", "10.0 %", "1.000e-05", "0.2", "2 failed or not converged")
    assert list(front_report.answers(front(against="t_f"))) == []


@pytest.mark.parametrize("lower_bound", [None, 0.0])
def test_no_lower_bound_without_noise(lower_bound):
    made = front(torque(0.2, 0.2, 1e-5), lower_bound=lower_bound)
    assert list(front_report.remarks(made)) == []
    assert "times the lower bound" not in front_report.results(made).head


def test_summary_round_trip_keeps_missing_numbers():
    made = front(robust(math.inf, math.nan), robust(6.0, 1e-5), against="margins", without=[3.0])
    assert math.isnan(made.points[0].rms)
    assert made.points[1].costs["gain_margin"] == 6.1
    assert (made.without, made.status) == ([3.0], "met")


def test_chart_of_a_front_has_intervals_knee_limit_and_no_point_without_an_error():
    def point(peak, rms, **changes):
        return torque(peak, peak, rms, **{"interval": (0.9 * rms, 1.2 * rms), **changes})

    others = {"published": point(5.0, 1e-4, interval=None), "before": torque(1.0, math.nan, math.nan)}
    points = [point(1.0, 4e-5, knee=True), point(2.0, 1e-5), point(3.0, 2e-5, dominated=True)]
    drawn = page_charts.front(front(*points, others=others), 1.5)
    named = {trace["name"]: trace for trace in drawn["data"]}
    assert {name: trace["x"] for name, trace in named.items()} == {
        "front": [1.0, 2.0], "knee": [1.0], "dominated": [3.0], "published": [5.0],
    }  # fmt: skip
    np.testing.assert_allclose(named["front"]["error_y"]["array"], [0.8e-5, 0.2e-5])
    np.testing.assert_allclose(named["front"]["error_y"]["arrayminus"], [0.4e-5, 0.1e-5])
    assert named["published"]["error_y"]["array"] == [0.0]
    assert drawn["layout"]["shapes"][0]["x0"] == 1.5
    assert "peak torque [N m]" in json.dumps(drawn["layout"])
