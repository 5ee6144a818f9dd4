"""`ptsmc worst --why`: compare the inputs of the worst trials of a campaign with the inputs of all trials."""

from collections.abc import Sequence
from typing import Any

import numpy as np

from ptsmc_jax.campaigns import campaign as running
from ptsmc_jax.campaigns import rows
from ptsmc_jax.dispersions.quantities import CATEGORIES
from ptsmc_jax.numerics import statistics
from tuning.studies import campaign_summary
from tuning.studies.campaign_folder import Folder


def explain_worst_trials(folder: Folder, metrics: Sequence[str], count: int) -> list[dict[str, Any]]:
    """Return the inputs of the worst trials by each metric, compared with the inputs of all trials.

    Failed trials come first, as in `campaign_summary.worst_trials`. If several inputs order the trials equally, only
    the first of them is listed.

    Args:
        folder: the campaign.
        metrics: names of metrics.
        count: number of worst trials for each metric.

    Returns:
        An entry for each metric, trial and input. It has the percentile rank of the input [%] and the median of all
        trials. A categorical input, such as the number of a failed wheel, has the fraction of equal trials instead.
        "rank_correlation" and "first_order" are the sensitivities of the metric, see `statistics.drivers`. They are
        None if too few trials have a value. "trials" is the number of trials with a value.
    """
    parts, unit_of = folder.intact_parts(), folder.units
    input_names = campaign_summary.input_columns(folder, parts)
    frame = rows.read(parts, ["trial", "status", *dict.fromkeys((*metrics, *input_names))]).head(folder.trials)
    inputs = {name: frame[name].to_numpy().astype(float) for name in input_names}
    varied = {name: values for name, values in inputs.items() if statistics.has_variation(values)}
    distinct = statistics.distinct_inputs({name: values for name, values in varied.items() if name not in CATEGORIES})
    names = [name for name in varied if name in distinct or name in CATEGORIES]
    failed = ~running.has_finished(frame)
    entries: list[dict[str, Any]] = []
    for metric in metrics:
        values = frame[metric].fill_null(float("nan")).to_numpy()
        has_value = np.isfinite(values) & ~failed
        known_inputs = {name: inputs[name][has_value] for name in names}
        drivers = statistics.drivers(known_inputs, values[has_value], categories=CATEGORIES) if has_value.any() else {}
        for index in campaign_summary.most_extreme(metric, values, failed, count):
            entries += [
                {
                    "metric": metric,
                    "trial": int(frame["trial"][int(index)]),
                    "value": float(values[index]) if np.isfinite(values[index]) else None,
                    "input": name,
                    "drawn": float(inputs[name][index]),
                    "unit": unit_of.get(name, ""),
                    **_rank_input(name, inputs[name], float(inputs[name][index])),
                    **drivers.get(name, {"rank_correlation": None, "first_order": None}),
                    "trials": int(has_value.sum()),
                }
                for name in names
            ]
    return entries


def _rank_input(name: str, values: np.ndarray, value: float) -> dict[str, float | None]:
    """Return the percentile rank of an input among all trials, or the fraction of equal trials for a category."""
    if name in CATEGORIES:
        return {"percentile": None, "median": None, "fraction": float(np.mean(values == value))}
    return {"percentile": statistics.percentile(values, value), "median": float(np.median(values)), "fraction": None}
