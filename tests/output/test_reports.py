"""Reports of tunings, fronts, campaigns, maps and comparisons: their complete text, compared with `reports.txt`.

`python -m tests.output.test_reports` writes the file again. A change of it is a change of what users read.
"""

import json
import math
from collections.abc import Callable, Iterable
from pathlib import Path
from typing import Any

import numpy as np
import polars as pl
import pytest

from ptsmc_jax.campaigns.store import to_json_value
from ptsmc_jax.figures import style
from ptsmc_jax.numerics import statistics
from ptsmc_jax.scenario.tables import Tune, objective_name
from ptsmc_jax.simulation import catalogues
from ptsmc_jax.simulation.catalogues import MARGINS
from ptsmc_jax.simulation.requirements import Requirement
from tests.output import examples
from tuning.output import (
    campaign_report,
    compare_report,
    front_report,
    margins_report,
    page_charts,
    reports,
    summaries,
    tune_report,
)
from tuning.output.report import Report, Table
from tuning.search import optimise
from tuning.studies.front import Front, Point, read

EXPECTED = Path(__file__).with_name("reports.txt")


def text_of(value: Any) -> str:
    """Return a report, a table or lines as one text."""
    if isinstance(value, Report):
        parts = [text_of(block if isinstance(block, Table) else [title, *block]) for title, block in value.printed()]
        return "\n".join([f"[{value.mood}] {value.headline}", *value.lines, *parts])
    if isinstance(value, Table):
        return "\n".join(" | ".join(row).strip() for row in [value.head, *value.rows])
    return value if isinstance(value, str) else "\n".join(text_of(one) for one in value).rstrip()


# ---- tunings


def errors(rms: float, interval: Any = None, largest: float | None = None) -> dict[str, Any]:
    """Return the statistics of a metric over trials, as a summary has them.

    interval: of the RMS. largest: by default `rms`.
    """
    return {"mean": rms, "rms": rms, "max": largest or rms, "rms_interval": interval}


def broken(times: float | None, searched: float = 0.97) -> summaries.Tune:
    """Return the summary of a tuning whose trials reach multiples of the torque limit of 0.5 N m.

    times: the multiple of the held-out trials. searched: the multiple of the training trials.
    """
    return examples.tune({"largest_over_limit": {"peak_torque": searched}}, verdicts=[examples.torque(times)])


HELD_OUT = examples.group(window_error=errors(1e-6, (9e-7, 1.2e-6), 2e-6), lower_bound=5e-7, peak_torque=errors(0.25))
LOST = examples.group(window_error=errors(1e-4), lower_bound=5e-7, counts={"ok": 60, "not_converged": 4})
MARGIN = {"metric": "gain_margin", "limit": 6.0, "unit": "dB", "worst": 5.0, "margin": 1.1, "failures": 1, "trials": 1,
          "met": False, "at_least": True}  # fmt: skip


def earlier(metric: str) -> dict[str, Any]:
    """Return the record of an earlier search whose gains exceeded a limit by a tenth on held-out trials."""
    return {"margins": {metric: 0.03}, "over": {metric: 1.1}, "held_out_seed": 7}


def advice(verdict: dict[str, Any], **search: Any) -> Iterable[str]:
    """Return the lines of advice after a tuning with this verdict on held-out trials; search: changes of its record."""
    return tune_report.advice_lines(
        examples.tune({"largest_over_limit": {verdict["metric"]: 0.99}, **search}, verdicts=[verdict])
    )


def advice_on_time(interpretation: str) -> Iterable[Any]:
    """Return the lines of advice if a limit is exceeded by a tenth for 3 % of the time, and if a run fails.

    The limit may be exceeded for 0.1 % of the time.
    """
    asked = Requirement("ape_x", 0.5, quantile=0.999, interpretation=interpretation)
    verdict = asked.verdict(np.full(4, 0.55), np.ones(4, bool), np.full(4, 0.97)).in_summary()
    return advice(verdict), advice({**verdict, "worst": None})


def advice_on_margin(metric: str, limit: float, worst: float) -> Iterable[Any]:
    """Return the lines of advice if 38 of 256 loops break a limit of a margin, and if the nominal loop breaks it.

    worst: margin of the loops that break the limit.
    """
    asked = Requirement(metric, limit, at_least=metric != "peak_sensitivity", unit=MARGINS[metric].unit)
    verdict = asked.verdict(np.where(np.arange(256) < 38, worst, limit), np.ones(256, bool)).in_summary()
    return advice(verdict), advice({**verdict, "trials": 1})


def verified(count: int) -> Any:
    """Return the report of a search after `count` verifications of its gains, each at 95 % confidence."""
    asked = Requirement("peak_torque", 0.5, quantile=0.9, confidence=0.95)
    found = {"earlier": (count - 1) * [earlier("peak_torque")], "margins": {"peak_torque": 0.05}}
    verdict = asked.verdict(np.zeros(1000), np.ones(1000, bool)).in_summary()
    return tune_report.build(examples.tune(found, verdicts=[verdict]))


def conflict(changes: dict[str, Any] | None = None, /, **limits: float | None) -> Iterable[str]:
    """Return the lines on a search with limits that conflict.

    changes: of the summary. limits: ratio of the metric to each limit if this limit is ignored and all others are kept,
    or None.
    """
    found = {"largest_over_limit": {"peak_torque": 1.12, "gain_margin": 1.119}, "conflict": limits,
             "searched_globally": True}  # fmt: skip
    return tune_report.search_lines(examples.tune(found, verdicts=[examples.torque(1.1), MARGIN], **(changes or {})))


def skipped(reached: float, **changes: Any) -> Iterable[str]:
    """Return the lines on a search that does not confirm a quantile if it exceeds a limit by more than a tenth.

    reached: largest peak torque over its limit. changes: of the verdict on the quantile.
    """
    asked = Requirement("effort", 9.0, quantile=0.9).verdict(np.zeros(10), np.ones(10, bool)).in_summary()
    found = {"largest_over_limit": {"peak_torque": reached, "effort": 0.5}}
    return tune_report.search_lines(examples.tune(found, verdicts=[examples.torque(1.2), {**asked, **changes}]))


def accuracy(times: float | None, **changes: Any) -> Iterable[str]:
    """Return the lines that compare tuned with published gains.

    times: error of the published gains over the tuned error, or None.
    """
    return tune_report.accuracy_lines(examples.tune(accuracy_gain_over_published=times, **changes))


def searched(**search: Any) -> Iterable[str]:
    """Return the lines on a search with this record."""
    return tune_report.search_lines(examples.tune(search))


CONFIRMED = {"metric": "effort", "confirmed": True, "trials": 8192, "violations": 20, "allowed": 29,
             "probability": 0.999}  # fmt: skip
WORST_CASE = {"metric": "peak_torque", "ratio": 1.03, "unbounded": False, "breaks_limit": True, "status": "ok",
              "moved": ["initial_attitude"]}  # fmt: skip


def shortest(theory: float | None, simulated: float | None, quantile: float | None = None) -> Any:
    """Return the report of a tuning with the shortest t_f [s] for a torque limit, or None if it is not known.

    theory, simulated, quantile: the shortest t_f by each method.
    """
    times = {"limit": 0.5, "theory": theory, "simulated": simulated, "quantile": quantile, "unit": "N m"}
    return tune_report.build(examples.tune(shortest_t_f=times))


def diagnostics(at_bound: dict[str, str] | None = None, **trust: Any) -> Iterable[str]:
    """Return the lines on the checks of a tuning; at_bound: gains that ended at a bound, trust: their results."""
    return tune_report.diagnostic_lines(examples.tune(trust=trust, at_bound=at_bound or {}))


def gains_by_axis(**tuned: float) -> Table:
    """Return the table of gains of a chain with these tuned gains and one published gain of the observer."""
    paper = examples.group(gains={"observer_gain": 10.0})
    return tune_report.gain_table(examples.tune(plant="chain", published=paper, held_out=examples.group(gains=tuned)))


def fitted(least: float) -> Iterable[str]:
    """Return the lines of advice for a 95 % interval of the RMS of 1.49 to 2.01 in 16 training trials.

    least: lower end of the interval in held-out trials.
    """
    at = {"training": (1.49, 2.01), "held_out": (least, 2.48)}
    groups = {on: examples.group(window_error=errors(1.0, interval)) for on, interval in at.items()}
    return tune_report.advice_lines(examples.tune({"averaged": 16}, **groups))


def margins_of(required: bool = False, **ends: dict[str, Any]) -> Iterable[str]:
    """Return the lines on margins; ends: changes of the default margins in each phase, hold or before.

    required: whether the scenario limits margins.
    """
    known = {"stable": True, "gain_margin": 6.0, "phase_margin": 30.0, "delay_margin": 0.1, "peak_sensitivity": 5.0}
    loops = {name: {**known, **changes} for name, changes in ends.items()}
    return margins_report.tuned_margin_lines(loops, required=required)


FEW = {"gain_margin": 5.9, "phase_margin": 0.0, "peak_sensitivity": 7.0}
UNLIMITED = {"gain_margin": None, "phase_margin": 61.0, "delay_margin": None, "peak_sensitivity": 1.0}
HOLD = {"stable": True, "gain_margin": 9.0, "phase_margin": 40.0, "delay_margin": 0.1, "peak_sensitivity": 3.0}
SCALED = {"published_label": "published gains, scaled", "accuracy_gain_interval": [0.05, 0.1]}
TUNINGS: dict[str, Callable[[], Any]] = {
    "tuned": lambda: tune_report.build(
        examples.tune(held_out=HELD_OUT, published=LOST, verdicts=[examples.torque(0.9)])
    ),
    "tuned with required metrics": lambda: tune_report.gain_table(
        examples.tune(
            held_out={**HELD_OUT, "peak_wheel_torque": errors(5e-3), "ape_boresight": errors(1e-4)},
            published={**LOST, "peak_wheel_torque": errors(8e-3), "ape_boresight": errors(4e-4)},
            verdicts=[Requirement(name, 1.0).verdict(np.ones(2), np.ones(2, bool)).in_summary()
                      for name in ("window_angle", "peak_torque", "peak_wheel_torque", "ape_boresight", "effort")],
        )
    ),
    "tuned, a trial of a chain fails": lambda: tune_report.build(
        examples.tune(held_out=HELD_OUT, plant="chain", status="not met")
    ),
    "held-out trials break a limit": lambda: tune_report.advice_lines(broken(1.1)),
    "held-out trials fail": lambda: tune_report.advice_lines(broken(None)),
    "held-out trials keep the limit": lambda: tune_report.advice_lines(broken(0.9)),
    "the search broke the limit too": lambda: tune_report.advice_lines(broken(1.1, searched=1.2)),
    "a fraction of the time of each run": lambda: advice_on_time("temporal"),
    "a fraction of the time of all runs": lambda: advice_on_time("mixed"),
    "held-out loops break a gain margin": lambda: advice_on_margin("gain_margin", 6.0, 5.2),
    "held-out loops break a peak sensitivity": lambda: advice_on_margin("peak_sensitivity", 6.0, 7.5),
    "held-out loops have no phase margin": lambda: advice_on_margin("phase_margin", 30.0, 0.0),
    # 4.8 dB of 6 dB are 0.8 times the limit, although `violation_ratio` is 1.2
    "margins relative to their limits": lambda: tune_report.search_lines(
        examples.tune(
            {"largest_over_limit": {"gain_margin": 1.2}, "margins": {"gain_margin": 0.05},
             "earlier": [earlier("gain_margin")]},
            verdicts=[{**MARGIN, "worst": 4.8, "margin": 1.2}],
        )
    ),
    "one verification on held-out trials": lambda: verified(1),
    "three verifications on held-out trials": lambda: verified(3),  # 0.95^3 were reported as 95 %
    "one gain of the observer": lambda: gains_by_axis(observer_gain=50.0),
    "gains of the observer by axis": lambda: gains_by_axis(
        observer_gain=45.0, observer_gain_1=50.0, observer_gain_2=40.0
    ),
    "less accurate than the published gains": lambda: accuracy(0.08, **SCALED),
    "less accurate than gains that break limits": lambda: accuracy(
        0.08, **SCALED, broken_by={"published": ["gain_margin", "effort"]}
    ),
    "tuned gains with their units": lambda: accuracy(
        None, gains={"eta": 3.0, "observer_gain_2": 0.5}, gain_units={"eta": "-", "observer_gain": "N m s"}
    ),
    "more accurate than the published law": lambda: accuracy(
        40.0, published_label="published gains, prescribed-time law"
    ),
    "all held-out trials fail": lambda: accuracy(
        0.08, held_out=examples.group(counts={"ok": 0, "not_converged": 60, "diverged": 4})
    ),
    "all but two training trials fail": lambda: tune_report.search_lines(
        examples.tune({"largest_over_limit": {"peak_torque": None, "effort": None, "chattering": math.inf}},
                      training=examples.group(trials=16, counts={"ok": 2, "not_converged": 14}))
    ),
    "no gains meet a limit": lambda: tune_report.search_lines(broken(1.2, searched=1.234)),
    "a torque limit may give way": lambda: conflict(peak_torque=1.3),
    "a margin may give way": lambda: conflict(gain_margin=1.25),
    "a margin cannot give way": lambda: conflict(gain_margin=2.5),
    "a limit can be met by another": lambda: conflict(peak_torque=0.98),
    "trials fail besides a conflict": lambda: conflict(
        {"training": examples.group(trials=48, counts={"ok": 3, "not_converged": 45})}, peak_torque=1.3
    ),
    "two limits conflict": lambda: conflict(peak_torque=1.3, gain_margin=None),
    "shortest time by theory and simulation": lambda: shortest(20.1234, 20.5, 0.9),
    "no shortest time": lambda: shortest(None, None),
    "shortest time without simulation": lambda: shortest(20.1234, None),
    "no confirmation, out of reach": lambda: skipped(1.2),
    "a confirmation": lambda: skipped(1.05),
    "confirmations on other trials": lambda: searched(confirmed=[
        CONFIRMED, {**CONFIRMED, "confirmed": False, "violations": 40, "allowed": None, "probability": 0.5}
    ]),
    "a worst case with the inertia of a random trial": lambda: searched(
        hardest={**WORST_CASE, "coordinates": {"initial_attitude": [1.0], "inertia": [0.5]}}
    ),
    "a worst case of every dispersion": lambda: searched(
        hardest={**WORST_CASE, "coordinates": {"initial_attitude": [1.0]}}
    ),
    "no confirmation needed": lambda: skipped(1.2, quantile=None),
    "saturated actuators": lambda: accuracy(None, held_out=examples.group(
        saturated={"mean": 0.0059, "rms": 0.01, "max": 0.0633})),
    "actuators that do not saturate": lambda: accuracy(None, held_out=examples.group(
        saturated={"mean": 0.0, "rms": 0.0, "max": 0.0})),
    "margins without the discontinuous sign": lambda: diagnostics(margins={"hold": HOLD}, gradient_error=None),
    "margins and gradients": lambda: diagnostics(margins={"hold": HOLD}, gradient_error={"start": 1e-9, "end": 1e-9}),
    "no finite gradients": lambda: diagnostics(
        margins={"hold": HOLD}, gradient_error=None, without_gradients="no measured gains have finite gradients"
    ),
    "gradients are not checked": lambda: diagnostics(gradient_error={"start": None, "end": None}),
    "gradients are checked at the start": lambda: diagnostics(gradient_error={"start": 1e-9, "end": None}),
    "wrong gradients": lambda: diagnostics(gradient_error={"start": 3.0, "end": 2.0}),
    "wider bounds": lambda: tune_report.diagnostic_lines(examples.tune(widened_bounds={"k1": (0.1, 1234.56)})),
    "no trial ends": lambda: diagnostics({"eta": "upper"}, influence={"eta": "unknown", "delta": "unknown"}),
    "too few training trials": lambda: fitted(2.36),
    "enough training trials": lambda: fitted(2.0),
    "margins of the tuned gains": lambda: margins_of(hold={}, before=UNLIMITED),
    "small margins in the hold phase": lambda: margins_of(hold=FEW, before={}),
    "small margins in the approach phase": lambda: margins_of(hold={}, before=FEW),
    "an unstable loop": lambda: margins_of(hold={"gain_margin": -1.2, "stable": False}),
    "small margins that are required": lambda: margins_of(True, hold=FEW),
}  # fmt: skip

# ---- fronts


def front(*points: Point, **changes: Any) -> Front:
    """Return a Pareto front of these points, after a round trip through summary.json."""
    known: Any = {
        "against": "torque", "plant": "spacecraft", "points": list(points), "idle": [], "without": [], "trials": 1000,
        "seed": 1, "interval_confidence": 0.95, "lower_bound": None, "rollouts": 1, "gradients": 1, "requirements": [],
        "gain_units": {"eta": "-", "observer_gain": "kg m^2/s"}, "warnings": [], "published_label": "published gains",
    }  # fmt: skip
    return read(to_json_value(Front(**known | changes).summary()))


def torque(limit: float, peak: float, rms: float, gains: Any = (("eta", 3.0),), **changes: Any) -> Point:
    """Return a point of a Pareto front over limits of the torque [N m]; limit, peak: torques, rms: error."""
    return Point(limit, dict(gains), rms, costs={"peak_torque": peak, "mean_peak_torque": peak / 2}, **changes)


def robust(limit: float, rms: float, **margins: float) -> Point:
    """Return a point of a Pareto front over limits of the margins; margins: other values of the reached margins."""
    costs = {"gain_margin": 6.1, "phase_margin": 40.0, "delay_margin": math.inf, "peak_sensitivity": 5.8, **margins}
    interval = (0.95 * rms, 1.05 * rms)
    return Point(limit, {"eta": 3.0, "observer_gain_2": 25.0}, rms, interval, {"peak_torque": 0.2, **costs}, meets=True)


def slew(t_f: float, rms: float, peak: float, **changes: Any) -> Point:
    """Return a point of a Pareto front over the slew time t_f [s]; peak: torque [N m]."""
    costs = {"peak_torque": peak, "ape_boresight": 30 * rms, "gain_margin": 6.2}
    return Point(t_f, {"eta": 3.0}, rms, (0.9 * rms, 1.1 * rms), costs, **changes)


NO_TRIAL = torque(0.1, math.nan, math.nan, failures=9)
BY_AXIS = torque(0.3, 0.3, 1e-5, {"observer_gain_1": 5.0, "observer_gain_2": 6.0})
WITHOUT_AXES = {"published": torque(1.0, 1.0, 1e-5, {"observer_gain": 10.0}), "before": torque(1.0, 1.0, 1e-5, {})}
FRONTS: dict[str, Callable[[], Front]] = {
    "front over the torque": lambda: front(
        torque(0.1, 0.09, 1e-4), torque(0.2, 0.19, 1e-5, knee=True), torque(0.5, 0.49, 2e-6, meets=True),
        lower_bound=1e-6, requirements=["peak_torque"],
    ),
    "missing and dominated points": lambda: front(
        torque(0.1, 0.1, 1e-5), torque(0.2, 0.2, 2e-5, dominated=True), idle=[0.5], without=[0.01, 0.02],
        requirements=["effort"], published_unavailable="eta is 2",
    ),
    "a point without a completed trial": lambda: front(NO_TRIAL, others={"published": NO_TRIAL}),
    "gains by axis": lambda: front(BY_AXIS, others=WITHOUT_AXES, published_label="published gains, scaled"),
    "a limit exceeded on held-out trials": lambda: front(
        robust(math.inf, 1e-5), robust(6.0, 2e-5, gain_margin=-100.0, peak_sensitivity=100.0),
        robust(4.0, 3e-5, peak_sensitivity=4.02), against="margins", plant="chain",
    ),
    "unstable loops": lambda: front(
        robust(math.inf, 1e-5, gain_margin=-0.3, peak_sensitivity=100.0), robust(6.0, 2e-5), against="margins",
        idle=[60.0], without=[3.0], lower_bound=1e-6,
    ),
    "no gains for any limit": lambda: front(against="margins", without=[math.inf, 6.0], requirements=["effort"]),
    "front over the slew time": lambda: front(
        slew(8.0, 1e-5, 0.2, failures=2), slew(16.0, 4e-6, 0.05, meets=True), against="t_f", without=[4.0],
        requirements=["peak_torque", "ape_boresight", "gain_margin"],
    ),
    "no slew": lambda: front(against="t_f"),
    "a lower bound of zero": lambda: front(torque(0.2, 0.2, 1e-5), lower_bound=0.0),
}  # fmt: skip

# ---- campaigns, maps and comparisons

AT = {"value": 56.0, "low": 55.0, "high": 57.0}
ERROR = {"without_value": 0, "rms": 1e-5, "max": 1e-5, "0.5": {"value": 1e-5, "low": 1e-5, "high": 1e-5}}


def fractions() -> Iterable[str]:
    """Return the texts of two verdicts: on a fraction of the trials, 59 of 60 or 98.33 %, and on fractions of time."""
    asked = Requirement("peak_torque", 0.5, quantile=0.95)
    verdict = asked.verdict(np.r_[np.zeros(59), 1.0], np.ones(60, bool))
    found = examples.entry(verdict, fraction=59 / 60, fraction_interval=[0.91056, 0.99957], fraction_bound=0.92333)
    wide = Requirement("ape_x", 1.0, quantile=0.9, interpretation="mixed")
    seen = wide.verdict(np.ones(3), np.ones(3, bool), np.array([1.0, 0.95, 1.0]))
    return campaign_report.verdict_with_fraction(found), str(examples.entry(seen))


def settling(without: int) -> Iterable[Table]:
    """Return the tables of quantiles if `without` of 60 trials never settled. One of these trials failed."""
    times = {"without_value": without, "max": 57.2, "0.5": AT, "0.9973": AT}
    counts = {"ok": 58, "not_converged": 1, "diverged": 1}
    return campaign_report.quantile_tables(examples.campaign(counts=counts, quantiles={"settling_time": times}))


def campaign_gains(**tables: dict[str, Any]) -> Table:
    """Return the table of the gains of a campaign whose scenario has these tables."""
    return campaign_report.gain_table(tables, "spacecraft")


def pairs(count: int, meets: float = math.nan) -> Iterable[str]:
    """Return the lines on a map with `count` of five pairs.

    meets: 1 if the pairs keep every requirement, NaN without any.
    """
    pair = {"status": "simulated", "failures": 0.0, "not_converged": 0.0, "window_error": 2e-6, "peak_torque": 0.3,
            "meets": meets, "not_met": ""}  # fmt: skip
    every = [
        {**pair, "x": 1.0, "y": 1.0, "failures": 3.0, "window_error": 1e-6},
        {**pair, "x": 1.0, "y": 2.0},
        {**pair, "x": 2.0, "y": 1.0, "not_converged": 2.0, "window_error": 1e-6},
        {**pair, "x": 2.0, "y": 2.0, "status": "loop.period is 2", "window_error": math.nan},
        {
            **pair,
            "x": 3.0,
            "y": 1.0,
            "window_error": 1e-7,
            "meets": 0.0 * meets,
            "not_met": "" if math.isnan(meets) else "peak_torque gain_margin",
        },
    ]
    return reports.map_lines(every[:count], ("loop.period [s]", "controller.eta"), "spacecraft")


def map_of(plant: str) -> Report:
    """Return the report of a map with two pairs: one simulated, one refused for its delta; plant: its kind."""
    head = ["loop.period [s]", "controller.delta [s]", "status", "failures", "not_converged", "window_error",
            "peak_torque", "linear_window_error", "linear_torque", "hold_delay_margin",
            "gain_margin", "meets", "not_met"]  # fmt: skip
    pairs = [["0.1", "1.0", "simulated", "0", "0", "1e-05", "0.25", "5e-06", "0.01", "0.2", "2.0", "0", "gain_margin"],
             ["0.1", "0.05", "controller.delta is 0.05", *([""] * 10)]]  # fmt: skip
    return reports.map_report([head, *pairs], plant)


def compared() -> Table:
    """Return the table that compares two laws. 12 of 1000 trials of PD break a limit."""

    def law(failures: int, **changes: Any) -> dict[str, Any]:
        verdict = Requirement("peak_torque", 0.5).verdict(np.arange(1000) < failures, np.ones(1000, bool))
        return examples.law(window_error=1e-5, verdicts=[verdict.in_summary()], met=verdict.met, **changes)

    laws = examples.compare({"pd": law(12), "prescribed_time": law(0, lower_bound=6.6e-9)}).laws
    return compare_report.answer_table(compare_report.QUESTIONS[0], laws)


def compliance() -> Table:
    """Return the compliance table of too few runs without a failure, and of enough runs with a failure."""
    asked = Requirement("ape_x", 1e-4, quantile=0.99, confidence=0.9)
    seen = [asked.verdict(np.full(trials, peak), np.ones(trials, bool)) for trials, peak in ((9, 5e-5), (999, 2e-4))]
    few_in_time = Requirement("ape_y", 1e-4, quantile=0.99, confidence=0.9, interpretation="mixed")
    verdicts = [*seen, few_in_time.verdict(np.zeros(9), np.ones(9, bool), np.ones(9))]
    (section,) = campaign_report.pointing_sections(examples.campaign(verdicts=[one.in_summary() for one in verdicts]))
    (table,) = section.blocks
    assert isinstance(table, Table)
    return table


def budget(simulated: int, ok: int, not_converged: int = 0) -> str:
    """Return the line with the reason of an absent angle of a budget, for these numbers of trials.

    Runs that do not converge by t_f have angles.
    """
    told = {"after": 0.0, "boresight": [1.0, 0.0, 0.0], "probability": 0.9973, "confidence": 0.95, "window": 1.0,
            "budget": {"ape": {"x": None}}}  # fmt: skip
    counts = {"ok": ok, "not_converged": not_converged}
    campaign = examples.campaign(pointing=told, simulated=simulated, counts=counts)
    assert campaign.pointing is not None
    return [*campaign_report.budget_lines(campaign, campaign.pointing)][-1]


def most_accurate_law(pd_error: float) -> str:
    """Return the sentence on the most accurate law in a comparison with PD; pd_error: window error of PD."""
    errors = {"pd": pd_error, "prescribed_time": 4e-6}
    laws = examples.compare({name: examples.law(window_error=error) for name, error in errors.items()}).laws
    return compare_report.most_accurate_law(laws)


def run(lower_bound: float | None) -> Report:
    """Return the report of a single run with this lower bound of the window error, or None."""
    told = {"status": "ok", "reason": "", "bad_time": None, "window_error": 1e-5, "verdicts": [], "warnings": []}
    angles = {"window_angle": 2e-5, "hold_angle": 0.02, "peak_rate": 0.02}  # in arcsec, in deg, and no angle
    return reports.build("simulate", {**told, **angles, "lower_bound": lower_bound}, "spacecraft")


def quantiles_of_angles() -> list[Table]:
    """Return the tables of two metrics in rad: the largest value of one is above one degree."""
    tail = {"value": 4e-5, "low": 3e-5, "high": 6e-5}
    small = {"without_value": 0, "max": 7e-5, "0.5": {"value": 1e-5, "low": 9e-6, "high": 2e-5}, "0.9973": tail}
    quantiles = {"window_angle": small, "hold_angle": {**small, "max": 0.02}}
    return campaign_report.quantile_tables(examples.campaign(quantiles=quantiles))


def identified(**changes: Any) -> Report:
    """Return the report of an identification of a moment, an angle, a uniform phase and a time.

    The moment is accurate, and the time has no prior knowledge. changes: other entries of its summary.
    """
    moment = {"parameter": "inertia_22", "estimate": 11.999942, "std": 6e-5, "lower": 11.999824, "upper": 12.00006,
              "start": 14.4, "prior_std": 3.0, "unit": "kg m^2"}  # fmt: skip
    angle = {"parameter": "attitude_noise", "estimate": 5e-5, "std": 1e-6, "lower": 4.8e-5, "upper": 5.2e-5,
             "start": 4e-5, "prior_std": 2e-5, "unit": "rad"}  # fmt: skip
    lag = {"parameter": "torque_lag", "estimate": 0.05, "std": 0.01, "lower": 0.03, "upper": 0.07, "start": 0.04,
           "prior_std": math.inf, "unit": "s"}  # fmt: skip
    phase = {"parameter": "disturbance_phase_1", "estimate": 2.1, "std": 0.02, "lower": 2.06, "upper": 2.14,
             "start": 0.0, "prior_std": math.pi / math.sqrt(3.0), "unit": "rad"}  # fmt: skip
    results = {
        "parameters": [moment, angle, phase, lag],
        "gyro_bias": [],
        "logs": [],
        "validation": [],
        "verdict": [],
        **changes,
    }
    return reports.build("identify", {"status": "identified", **results, **changes}, "spacecraft")


def approach(judged: bool) -> Report:
    """Return the report of margins of a loop that is unstable at one sample of the approach phase.

    judged: whether the margins of this sample are judged.
    """
    left = dict.fromkeys(("gain_up", "gain_down", "phase", "delay", "peak_sensitivity"), 6.0)
    sample = {"time_to_go": 1.0, "judged": judged, "stable": False, "open": [], "cut": [], **left, "delay": None}
    summary = {
        "stable": True, "open": [], "cut": [], "note": None, "hold": {"u1": left}, "together": left, "sensors": {},
        "before": [sample],
        "worst": {"gain_margin": -1.9, "phase_margin": None, "delay_margin": None, "peak_sensitivity": None},
    }  # fmt: skip
    return margins_report.build(summaries.read(summaries.Margins, summary))


def worst_trials(by: str, **columns: list[Any]) -> Table:
    """Return the table of two trials, ordered by the metric `by`; columns: other columns of the rows.

    An error of 1e-5 is an angle of 4.13 arcsec.
    """
    known = {"trial": [7, 3], "status": ["diverged", "ok"], "window_error": [None, 1e-5], "window_angle": [None, 2e-5],
             "peak_torque": [0.2, 0.1], "initial_angle": [0.5, 1e-3], "initial_w2": [2e-3, 1e-3],
             **columns}  # fmt: skip
    units = {**catalogues.units("spacecraft"), "initial_w2": "rad/s"}
    return campaign_report.worst_trial_table(pl.DataFrame(known), by, units)


def why(*rows: dict[str, Any], **changes: Any) -> Iterable[str]:
    """Return the lines that explain a worst trial; each row is an unusual input.

    The `fraction` of a row is the fraction of trials with the same category.
    """
    alike = {"metric": "effort", "trial": 3, "value": None, "drawn": 2.0, "unit": "", "fraction": None, "median": 1.0,
             "percentile": None, "rank_correlation": None, "first_order": None, **changes}  # fmt: skip
    return campaign_report.explanation_lines([{**alike, **row} for row in rows], catalogues.units("spacecraft"))


OTHERS: dict[str, Callable[[], Any]] = {
    "fractions of the trials": fractions,
    "a trial that failed has no settling time": lambda: settling(1),
    "a trial that ended never settled": lambda: settling(2),
    "campaign without a lower bound": lambda: campaign_report.build(
        examples.campaign(quantiles={"window_error": {**ERROR, "0.9973": ERROR["0.5"]}}, lower_bound=0.0)
    ),
    "gains of a campaign": lambda: campaign_gains(
        controller={"kind": "prescribed_time", "eta": 3.0}, observer={"kind": "nonlinear", "gain": [1.0, 2.0, 3.0]}
    ),
    # the gain of the nonlinear observer is in N m s
    "gains of a finite-time observer": lambda: campaign_gains(
        controller={"kind": "pd", "disturbance_bound": 0.1}, observer={"kind": "finite_time", "gain": [0.02]}
    ),
    # its class may have another unit than a built-in k
    "gains of a custom law": lambda: campaign_gains(controller={"kind": "custom", "t_f": 30.0, "k": 2.0}),
    "how to replay a trial": lambda: campaign_report.replay_hint(
        pl.DataFrame({"trial": [7], "window_error": [0.1]}), Path("my out"), is_custom=True
    ),
    "worst trials by the error": lambda: worst_trials("window_error"),
    "worst trials by the angle": lambda: worst_trials("window_angle"),
    "worst trials by an input": lambda: worst_trials("initial_w2"),
    "worst trials by a custom metric": lambda: worst_trials("mine", mine=[2.0, 1.0], settling_time=[None, 3]),
    "best pair of a map": lambda: pairs(4),
    "map of a spacecraft": lambda: map_of("spacecraft"),
    "map of a chain": lambda: map_of("chain"),
    "one pair of a map": lambda: pairs(1),
    "best pair of a map that keeps every requirement": lambda: pairs(5, 1.0),
    "comparison of two laws": compared,  # 1.5e+03 times the lower bound are 1500
    "compliance of too few runs": compliance,
    # 1109 runs are needed for 95 % confidence, and all must reach their end
    "pointing budget without an angle": lambda: [
        budget(2000, 2000), budget(1108, 1098), budget(1109, 1099), budget(1109, 1049, 50),
    ],
    "most accurate law, also without an error": lambda: [most_accurate_law(error) for error in (2e-6, 3.999e-6, 0.0)],
    # the bound is 0 without noise, and None if no run reaches its end
    "angles of a campaign in arcsec and deg": quantiles_of_angles,
    "run without a lower bound": lambda: [text_of(run(None)), text_of(run(0.0))],
    "identified parameters": identified,
    "proposed manoeuvre": lambda: identified(status="designed", duration=300.0, undetermined=[], parameters=[
        {"parameter": "attitude_noise", "value": 5e-5, "expected_std": 1e-6, "plain_std": math.inf, "unit": "rad"},
    ]),
    "unstable sample of the approach phase": lambda: approach(judged=True),
    "unstable sample that is not judged": lambda: approach(judged=False),
    # a correlation of 0.15 is not significant in 200 trials, for example if only these settle
    "no reason of a worst trial": lambda: why(
        {"input": "initial_w1", "unit": "rad/s", "percentile": 70.0},
        metric="settling_time", value=1.0, rank_correlation=0.15, first_order=0.06, trials=200,
    ),
    "reasons of an error and of its angle": lambda: why(
        {"metric": "window_error", "value": 1e-5, "input": "initial_w1"},
        {"metric": "window_angle", "value": 2e-5, "input": "initial_w1"},
        percentile=70.0,
    ),
    # by the distance from the 50 % percentile: 49, 37.5, 20, 5 and 2; categories by half the fraction of other trials
    "the four most unusual inputs of a failed trial": lambda: why(
        {"input": "initial_angle", "unit": "rad", "percentile": 70.0},
        *({"input": f"initial_{name}", "unit": "rad/s", "percentile": at} for name, at in (("w1", 52.0), ("w2", 1.0))),
        *({"input": name, "fraction": at} for name, at in (("wheel_failure_wheel", 0.25), ("custom_1", 0.9))),
    ),
}  # fmt: skip


CASES = {**TUNINGS, **{name: lambda made=made: front_report.build(made()) for name, made in FRONTS.items()}, **OTHERS}


def expected() -> dict[str, str]:
    """Return the texts of the file `EXPECTED` by the names of their cases."""
    blocks = EXPECTED.read_text(encoding="utf-8").removeprefix("## ").split("\n\n## ")
    return {name: text.rstrip("\n") for name, _, text in (block.partition("\n") for block in blocks)}


@pytest.mark.parametrize("name", CASES)
def test_report_has_the_expected_text(name):
    assert text_of(CASES[name]()) == expected()[name]


def test_every_expected_text_of_a_report_has_a_case():
    assert expected().keys() == CASES.keys()


# ---- charts and drivers


def test_chart_of_a_front_has_intervals_knee_limit_and_no_point_without_an_error():
    """Errors are in arcsec, and a point without an interval has a bar of length 0."""

    def point(peak, rms, **changes):
        return torque(peak, peak, rms, **{"interval": (0.9 * rms, 1.2 * rms), **changes})

    others = {"published": point(5.0, 1e-4, interval=None), "before": torque(1.0, math.nan, math.nan)}
    points = [point(1.0, 4e-5, knee=True), point(2.0, 1e-5), point(3.0, 2e-5, dominated=True)]
    drawn = page_charts.front(front(*points, others=others), 1.5)
    named = {trace["name"]: trace for trace in drawn["data"]}
    assert {name: trace["x"] for name, trace in named.items()} == {
        "front": [1.0, 2.0], "knee": [1.0], "dominated": [3.0], "published gains": [5.0],
    }  # fmt: skip
    arcsec = 2.0 * np.degrees(1.0) * 3600.0  # of a small error |v|, to 1e-9
    np.testing.assert_allclose(named["front"]["error_y"]["array"], arcsec * np.array([0.8e-5, 0.2e-5]), rtol=1e-7)
    np.testing.assert_allclose(named["front"]["error_y"]["arrayminus"], arcsec * np.array([0.4e-5, 0.1e-5]), rtol=1e-7)
    assert named["published gains"]["error_y"]["array"] == [0.0]
    assert drawn["layout"]["shapes"][0]["x0"] == 1.5
    assert "peak torque [N m]" in json.dumps(drawn["layout"])


def test_comparison_chart_shows_the_smallest_lower_bound_of_the_error_and_a_required_limit():
    laws = [examples.law(lower_bound=lower_bound) for lower_bound in (2e-6, 1e-6, None)]
    asked = examples.law(verdicts=[examples.torque(0.9)])
    found = list(examples.compare({str(k): law for k, law in enumerate([*laws, asked])}).laws.values())
    accuracy, torque, *_ = compare_report.QUESTIONS
    (level,) = compare_report.reference_lines(accuracy, found).values()
    np.testing.assert_allclose(level, 2e-6 * 180 * 3600 / np.pi)  # arcsec
    assert compare_report.reference_lines(accuracy, found[2:]) == {}
    assert compare_report.reference_lines(torque, found[:3]) == {}
    assert compare_report.reference_lines(torque, found) == {"limit": 0.5}


NO_DRIVER = "no dispersed quantity alone explains 5 % of the variance of the ranks of window_error"


def driver_lines(drivers, trials):
    """Return a list of the sentences of a campaign report on the inputs that drive the window error.

    drivers: as in a summary. trials: number of trials of the analysis.
    """
    found = {"drivers": {"window_error": drivers}, "driver_trials": {"window_error": trials}}
    return list(campaign_report.driver_lines(examples.campaign(simulated=10_000, trials=10_000, **found)))


def test_inputs_that_correlate_by_chance_are_not_reported_as_drivers():
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
def test_an_input_is_a_driver_only_if_it_explains_a_significant_part_of_the_variance(correlation, trials, named):
    """A rank correlation of 0.22 explains 4.8 % of the variance. One of 0.3 is insignificant in 90 trials."""
    (line,) = driver_lines({"initial_angle": {"rank_correlation": correlation, "first_order": 0.0}}, trials)
    driven = "window_error is driven by initial_angle (rank correlation +0.30, 9 % of the variance of the ranks)"
    assert line == (driven if named else NO_DRIVER)


def test_driver_without_a_monotonic_influence_has_no_rank_correlation():
    """An earlier version printed `rank correlation -0.00, 19 % of the variance of the ranks`."""
    (line,) = driver_lines({"disturbance_phase_1": {"rank_correlation": -0.001, "first_order": 0.19}}, 1000)
    assert "disturbance_phase_1 (mostly not monotonic, 19 % of the variance of the ranks)" in line


def test_constants_of_the_tuning_report_equal_those_of_the_search():
    assert tune_report.HOPELESS == optimise.HOPELESS


def test_report_states_that_percentages_of_correlated_inputs_overlap():
    """The initial angle and a component of the initial attitude explain 68 % and 52 % of the same variance."""
    drivers = {"initial_angle": {"rank_correlation": 0.8, "first_order": 0.68}}
    assert "overlap" not in driver_lines(drivers, 1000)[0]
    (line,) = driver_lines(drivers | {"initial_q3": {"rank_correlation": -0.1, "first_order": 0.52}}, 1000)
    assert line.endswith("; these inputs are correlated, so their percentages overlap")


@pytest.mark.parametrize(
    ("plant", "objective", "shown", "title"),
    [
        ("spacecraft", "window_error", np.degrees(2.0 * np.arcsin(1e-5)) * 3600.0, "RMS pointing error [arcsec]"),
        ("spacecraft", "hold_angle", np.degrees(1e-5) * 3600.0, "RMS hold angle [arcsec]"),
        ("spacecraft", "peak_torque", 1e-5, "RMS peak torque [N m]"),
        ("chain", "window_error", 1e-5, "RMS error [x1]"),
        ("chain", "t_f", 1e-5, "RMS t f [s]"),
    ],
)
def test_chart_of_a_search_shows_the_objective_in_the_unit_of_the_figures(plant, objective, shown, title):
    rows = [{"step": "0", "start": "0", "objective": "1e-05", "eta": "3"}]
    display = style.objective_display(f"RMS {objective}".replace("_", " "), objective, plant)
    chart = page_charts.search(rows, "objective", *display)
    assert chart["data"][0]["y"] == pytest.approx([shown], rel=1e-5)  # with six digits
    assert chart["layout"]["yaxis"]["title"]["text"] == title


@pytest.mark.parametrize(("minimised", "label"), [("t_f", "t_f [s]"), ("effort", "RMS effort [N m s]")])
def test_label_of_an_objective_has_its_unit(minimised, label):
    assert style.objective_display(objective_name(Tune(minimise=minimised)), minimised, "spacecraft")[1] == label


if __name__ == "__main__":
    EXPECTED.write_text("\n\n".join(f"## {name}\n{text_of(case())}" for name, case in CASES.items()) + "\n")


def test_table_of_gains_does_not_change_with_a_list_of_sensors():
    law = {"controller": {"kind": "prescribed_time", "eta": 3.0}}
    sensors = {"sensors": [{"kind": "star_tracker"}, {"kind": "gyro"}]}
    assert campaign_report.gain_table({**law, **sensors}, "spacecraft") == campaign_report.gain_table(law, "spacecraft")
