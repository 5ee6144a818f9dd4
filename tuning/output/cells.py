"""What is said of a result: its summary as it is read, tables of text, numbers as text."""

from collections.abc import Mapping
from dataclasses import dataclass
from typing import Any

from ptsmc_jax.simulation.catalogues import CATALOGUES

Summary = dict[str, Any]


@dataclass(frozen=True)
class Table:
    """Cells as text; the first column names the row."""

    head: tuple[str, ...]
    rows: list[tuple[str, ...]]


def valued(value: float, metric: str, kind: str) -> str:
    """A metric of this kind of plant to three digits, with its unit where it has one.

    >>> valued(0.2813, "peak_torque", "spacecraft"), valued(3.1e-5, "window_error", "spacecraft")
    ('0.281 N m', '3.1e-05')
    """
    unit = CATALOGUES[kind][metric].unit
    return f"{value:.3g}" if unit == "-" else f"{value:.3g} {unit}"


def digits(value: float | None, form: str, none: str = "-") -> str:
    """A number in this format; `none` where there is none, or NaN.

    >>> digits(0.12345, ".3g"), digits(None, ".3g"), digits(float("nan"), ".3g", "never")
    ('0.123', '-', 'never')
    """
    return none if value is None or value != value else f"{value:{form}}"


def lost(counts: Mapping[str, int]) -> tuple[int, str]:
    """How many trials did not end well, of counts by status, and in words how they ended.

    >>> lost({"ok": 5, "missed": 2, "singular": 0, "diverged": 1})
    (3, '2 missed, 1 diverged')
    """
    bad = {status: count for status, count in counts.items() if count and status != "ok"}
    return sum(bad.values()), ", ".join(f"{count} {status}" for status, count in bad.items())


def number(cell: str) -> Any:
    """The number of a cell of a CSV file, NaN of an empty one; its text where it is none."""
    try:
        return float(cell or "nan")
    except ValueError:
        return cell


def short(cell: str) -> str:
    """A cell of a CSV file, its number in four digits."""
    value = number(cell)
    return cell if isinstance(value, str) or not cell else f"{value:.4g}"


def many(count: int, thing: str) -> str:
    """Return a count and its noun.

    >>> many(1, "trial"), many(0, "trial")
    ('1 trial', '0 trials')
    """
    return f"{count} {thing}{'' if count == 1 else 's'}"
