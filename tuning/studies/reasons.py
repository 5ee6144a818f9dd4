"""Why trials of a campaign are the worst: what was drawn in them, beside all trials."""

from collections.abc import Sequence
from typing import Any

import numpy as np

from ptsmc_jax.campaigns import campaign as flying
from ptsmc_jax.campaigns import rows
from ptsmc_jax.dispersions.quantities import CATEGORIES
from ptsmc_jax.numerics import statistics
from tuning.studies import campaign_summary
from tuning.studies.campaign_folder import Folder


def why(folder: Folder, metrics: Sequence[str], count: int) -> list[dict[str, Any]]:
    """What was drawn in the worst trials by each metric: each input as a percentile of all trials, and their median.

    Failed trials first, as in `campaign_summary.worst`; of inputs that rank the trials alike only the first. For one
    that says which of several things, such as a wheel, there is instead the share of the trials that have the same.
    Beside each stands how the metric goes with it over all trials that end with a value, how many "trials" these are,
    see `statistics.drivers`; None where so few do not show it.
    """
    parts, unit_of = folder.whole_parts(), folder.units
    drawn = campaign_summary.drawn_columns(folder, parts)
    frame = rows.read(parts, ["trial", "status", *dict.fromkeys((*metrics, *drawn))]).head(folder.trials)
    inputs = {name: frame[name].to_numpy().astype(float) for name in drawn}
    varied = {name: values for name, values in inputs.items() if statistics.vary(values)}
    distinct = statistics.distinct({name: values for name, values in varied.items() if name not in CATEGORIES})
    names = [name for name in varied if name in distinct or name in CATEGORIES]
    failed = ~flying.finished(frame)
    explained: list[dict[str, Any]] = []
    for metric in metrics:
        values = frame[metric].fill_null(float("nan")).to_numpy()
        known = np.isfinite(values) & ~failed
        of = {name: inputs[name][known] for name in names}
        drivers = statistics.drivers(of, values[known], categories=CATEGORIES) if known.any() else {}
        for at in campaign_summary.most_extreme(metric, values, failed, count):
            explained += [
                {
                    "metric": metric,
                    "trial": int(frame["trial"][int(at)]),
                    "value": float(values[at]) if np.isfinite(values[at]) else None,
                    "input": name,
                    "drawn": float(inputs[name][at]),
                    "unit": unit_of.get(name, ""),
                    **_among(name, inputs[name], float(inputs[name][at])),
                    **drivers.get(name, {"rank_correlation": None, "first_order": None}),
                    "trials": int(known.sum()),
                }
                for name in names
            ]
    return explained


def _among(name: str, values: np.ndarray, drawn: float) -> dict[str, float | None]:
    """Where what was drawn stands among all trials (trials,), or how many of them have the same."""
    if name in CATEGORIES:
        return {"percentile": None, "median": None, "share": float(np.mean(values == drawn))}
    return {"percentile": statistics.percentile(values, drawn), "median": float(np.median(values)), "share": None}
