"""Summaries with changes, as the commands write them."""

from typing import Any

from ptsmc_jax.simulation.requirements import Requirement, Verdict
from tuning.output import summaries


def entry(verdict: Verdict, **changes: Any) -> summaries.Entry:
    """Return a verdict in the form that a summary has; changes: other values of its fields."""
    return summaries.read(summaries.Entry, {**verdict.in_summary(), **changes})


def group(**changes: Any) -> dict[str, Any]:
    """Return a dict of gains and the statistics of their trials, as a summary of a tuning has it."""
    return {"gains": {}, "lower_bound": None, "trials": 64, "counts": {"ok": 64}, **changes}


def tune(search: dict[str, Any] | None = None, trust: dict[str, Any] | None = None, **changes: Any) -> summaries.Tune:
    """Return the summary of a tuning without requirements.

    search, trust: changes in these tables. changes: other values of its fields.
    """
    record = {
        "largest_over_limit": {}, "conflict": None, "searched_globally": False, "margins": {}, "earlier": [],
        "confirmed": [], "hardest": None, "worst_case": False, "averaged": 256, "rollouts": 1, "gradients": 1,
        "seconds": 1.0,
    }  # fmt: skip
    known = {"influence": {}, "margins": None, "gradient_error": {"start": 1e-9, "end": 1e-9}}
    summary = {
        "status": "met", "plant": "spacecraft", "gain_units": {}, "gains": {}, "at_bound": {},
        "widened_bounds": {}, "accuracy_gain_over_published": None, "accuracy_gain_interval": None,
        "training": group(), "held_out": group(),
        "published_unavailable": None, "published_label": "published gains", "shortest_t_f": None, "broken_by": {},
        "verdicts": [],
        "judged_on": "flight clock", "warnings": [], "differential_evolution": None,
    }  # fmt: skip
    trusted = None if trust is None else {**known, **trust}
    return summaries.tune({**summary, "search": {**record, **(search or {})}, "trust": trusted, **changes})


def torque(times: float | None, failures: int = 0, trials: int = 64) -> dict[str, Any]:
    """Return the verdict, as a summary has it, on a peak torque that reaches `times` its limit of 0.5 N m.

    times: None for a torque that is not known. failures: number of failed trials.
    """
    verdict = Requirement("peak_torque", 0.5).verdict
    import numpy as np

    peak = np.nan if times is None else 0.5 * times
    return verdict(np.full(trials, peak), np.arange(trials) >= failures).in_summary()


def law(**changes: Any) -> dict[str, Any]:
    """Return the entry of a law in the summary of a comparison; all its statistics are None, except `changes`."""
    numbers = ("window_error", "window_error_interval", "lower_bound", "peak_torque", "largest_peak_torque", "effort",
               "chattering", "settling_time", "settling_near_far", "margins")  # fmt: skip
    return {**dict.fromkeys(numbers), "gains": {}, "gain_units": {}, "at_bound": {}, "widened_bounds": {}, "met": True,
            "counts": {"ok": 8}, "unsettled": 0, "model_errors": {}, "verdicts": [], **changes}  # fmt: skip


def compare(laws: dict[str, Any], **changes: Any) -> summaries.Compare:
    """Return the summary of a comparison; laws: {name: entry of `law`}."""
    summary = {"status": "met", "trials": 8, "published_unavailable": None, "published_label": None,
               "judged_on": "flight clock",
               "settling_angle": 1e-3, "warnings": []}  # fmt: skip
    return summaries.read(summaries.Compare, {**summary, "laws": laws, **changes})


def campaign(**changes: Any) -> summaries.Campaign:
    """Return the summary of a campaign; changes: other values of its fields."""
    summary = {"status": "met", "plant": "spacecraft", "seed": 1, "run_table": None, "trials": 8, "simulated": 8,
               "unjudged": [], "counts": {"ok": 8}, "reasons": [], "lower_bound": None, "verdicts": [], "quantiles": {},
               "drivers": {}, "driver_trials": {}, "warnings": []}  # fmt: skip
    return summaries.read(summaries.Campaign, {**summary, **changes})
