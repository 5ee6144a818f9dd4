"""Single trials of a campaign in words: the worst ones, the reasons, and a replay."""

import itertools
import shlex
from collections.abc import Iterator
from pathlib import Path
from typing import TYPE_CHECKING, Any

from tuning.output.formats import add_unit
from tuning.output.report import Table

if TYPE_CHECKING:
    import polars as pl

ROUND_OFF = 1e-9  # relative difference by rounding between the programs of a campaign and of a run with its history


def worst_trial_table(frame: "pl.DataFrame", by: str, plant: str) -> Table:
    """Return the table of the worst trials by a metric, the worst first; plant: kind of the plant."""
    columns = ("trial", "status", by, "window_error", "peak_torque", "settling_time", "initial_angle")
    names = [name for name in dict.fromkeys(columns) if name in frame.columns]
    rows = [
        tuple("-" if v is None else f"{v:.5g}" if isinstance(v, float) else str(v) for v in row)
        for row in frame.select(names).iter_rows()
    ]
    return Table(tuple(add_unit(name, plant) for name in names), rows)


def replay_hint(frame: "pl.DataFrame", folder: Path, *, is_custom: bool) -> str:
    """Return the command that replays the worst trial; is_custom: simulating it runs custom code."""
    call = f"ptsmc replay {shlex.quote(str(folder))} --trial {frame['trial'][0]}" + (" --trust" if is_custom else "")
    return f"all columns are in {folder / 'worst.csv'}; replay one trial with {call}"


def explanation_lines(inputs: list[dict[str, Any]], plant: str) -> Iterator[str]:
    """Return the inputs that explain a metric in each of the worst trials, as percentiles of all trials.

    If the trial failed, or too few trials show an influence, the inputs farthest from their medians are named.

    Args:
        inputs: rows of `reasons.explain_worst_trials`.
        plant: kind of the plant.
    """
    from ptsmc_jax.numerics import statistics
    from ptsmc_jax.simulation import catalogues  # imports JAX

    for (metric, trial), group in itertools.groupby(inputs, lambda row: (row["metric"], row["trial"])):
        rows = list(group)
        value = rows[0]["value"]
        measured = [row for row in rows if row["first_order"] is not None]
        if measured and value is not None:
            explained = [(statistics.explained_variance(row, row["trials"]), row) for row in measured]
            explained.sort(key=lambda pair: pair[0], reverse=True)
            rows = [row for fraction, row in explained if fraction >= statistics.MIN_EXPLAINED]
        else:
            rows.sort(key=_distance_from_median, reverse=True)
        texts = [
            f"{row['input']} {_format_with_unit(row['drawn'], row['unit'])} {_describe_percentile(row)}"
            for row in rows[:4]
        ]
        unit = catalogues.units(plant).get(metric, "")  # a custom metric has no unit
        reached = f"no {metric}" if value is None else f"{metric} {_format_with_unit(value, unit)}"
        nothing_found = "no sampled input explains it; sensor noise remains"
        yield f"{reached} in trial {trial}: {', '.join(texts) or nothing_found}"


def _describe_percentile(row: dict[str, Any]) -> str:
    """Return the percentile of an input among all trials."""
    from ptsmc_jax.simulation.catalogues import percent  # imports JAX

    if row["fraction"] is not None:
        return f"as in {percent(row['fraction'])} % of the trials"
    return f"at {row['percentile']:.1f} % (median {row['median']:.3g})"


def _distance_from_median(row: dict[str, Any]) -> float:
    """Return the distance of an input from the median in per cent, or how few trials have the same value."""
    return 50.0 * (1.0 - row["fraction"]) if row["fraction"] is not None else abs(row["percentile"] - 50.0)


def _format_with_unit(value: float, unit: str) -> str:
    return f"{value:.4g} {unit}".rstrip(" -")


def replay_lines(difference: float | None, history_difference: float, tolerance: float) -> Iterator[str]:
    """Return how a replayed trial agrees with its row.

    Args:
        difference: largest relative difference from the row; None: the campaign has no row of this trial.
        history_difference: largest relative difference between the replayed row and the run with its history.
        tolerance: the largest difference that counts as equal.
    """
    if difference is None:
        yield "the campaign has no row of this trial yet"
    elif difference == 0.0:
        yield "the replayed trial equals its row to the last digit"
    elif difference <= tolerance:
        yield f"the replayed trial equals its row up to round-off: largest relative difference {difference:.1e}"
    else:
        found = _describe_difference(difference)
        yield f"the replayed trial does NOT equal its row: {found}; see versions and machine in versions.json"
    if history_difference <= ROUND_OFF:
        yield f"the history is of the same run up to round-off: largest relative difference {history_difference:.0e}"
    else:
        yield (
            f"another program simulates the history, and its metrics differ: "
            f"{_describe_difference(history_difference)}; a loop that chatters or diverges magnifies round-off"
        )


def _describe_difference(difference: float) -> str:
    if difference == float("inf"):
        return "it ends with another status, or other values are missing"
    return f"largest relative difference {difference:.1e}"
