"""The report of a map over two keys of a scenario."""

from collections.abc import Iterator, Mapping, Sequence
from typing import Any

from tuning.output.formats import add_unit, format_error, format_metric, format_number, parse_cell
from tuning.output.report import Report, Section, Table

NOTE = (
    "linear_window_error and linear_torque are predictions of linear theory for the noise alone, with explicit "
    "sampling. radius, gain_margin and delay_margin belong to the loop at the hand-over with frozen gains, hold_radius "
    "and the others with hold_ to the hold phase. The loop is stable up to a radius of 1. gain_margin is the largest "
    "factor on the gain with a stable loop; below 1 the loop is unstable."
)


def build(head: Sequence[str], rows: Sequence[Sequence[str]], plant: str) -> Report:
    """Return the report of a map.csv for this kind of plant; the first two columns are the keys."""
    pairs = [dict(zip(("x", "y", *head[2:]), map(parse_cell, row), strict=True)) for row in rows]
    headline, *lines = summary_lines(pairs, (head[0], head[1]), plant)
    cells = [tuple(_shorten_cell(cell) for cell in row) for row in rows]
    table = Table(tuple(add_unit(name, plant) for name in head), cells, NOTE)
    return Report(headline[0].upper() + headline[1:], "calm", lines, [Section("Pairs", [table])])


def summary_lines(pairs: Sequence[Mapping[str, Any]], keys: tuple[str, str], plant: str) -> Iterator[str]:
    """Return the best pair and the number of pairs that were simulated.

    Args:
        pairs: the rows of a map by column; x and y are the values of the keys.
        keys: keys of the horizontal and of the vertical axis.
        plant: kind of the plant.
    """
    simulated = [pair for pair in pairs if pair["status"] == "simulated"]
    with_error = [pair for pair in simulated if pair["window_error"] == pair["window_error"]]  # is not NaN
    if with_error:
        best = min(with_error, key=lambda pair: (_count_failures(pair), pair["window_error"]))
        failed = (
            f"; {_count_failures(best):.0f} of its trials failed or did not converge at t_f"
            if _count_failures(best)
            else ""
        )
        peak = format_metric(best["peak_torque"], "peak_torque", plant)
        yield (
            f"the smallest RMS error is {format_error(best['window_error'], plant)} at {keys[0]} = {best['x']:.4g} and "
            f"{keys[1]} = {best['y']:.4g}, with a mean peak torque of {peak}{failed}"
        )
    failed = sum(_count_failures(pair) > 0 for pair in simulated)
    yield (
        f"{len(simulated)} of {len(pairs)} pairs simulated, {failed} of them with trials that failed or "
        "did not converge at t_f"
    )


def _count_failures(pair: Mapping[str, Any]) -> float:
    """Return how many trials of a pair failed or did not converge at t_f, as a float like all cells of map.csv."""
    return pair["failures"] + pair["not_converged"]


def _shorten_cell(cell: str) -> str:
    value = parse_cell(cell)
    return cell if isinstance(value, str) or not cell else format_number(value, ".4g", "")
