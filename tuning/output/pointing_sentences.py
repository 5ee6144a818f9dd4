"""Pointing error indices of a campaign as tables: the budget, and what was shown of each requirement."""

import math
from collections.abc import Iterator

from ptsmc_jax.simulation.catalogues import AXES, INDICES, percent
from tuning.output.cells import Summary, Table, valued

USUAL = (0.9, 0.95)  # confidences that reviews ask for


def angle(value: float | None) -> str:
    """An angle [rad] in arcsec, from a degree on in degrees.

    >>> angle(1e-4), angle(0.1), angle(None)
    ('20.6 arcsec', '5.73 deg', '-')
    """
    if value is None or not math.isfinite(value):
        return "-"
    degrees = math.degrees(value)
    if abs(degrees) >= 1.0:
        return f"{degrees:.3g} deg"
    seconds = 3600.0 * degrees
    return f"{seconds:.0f} arcsec" if abs(seconds) >= 999.5 else f"{seconds:.3g} arcsec"


def error(rms: float, plant: str) -> str:
    """Return an RMS window error as a pointing angle, or in the unit of the state of a plant that is no spacecraft.

    >>> error(1e-6, "spacecraft"), error(1e-6, "chain"), error(float("nan"), "chain")
    ('0.413 arcsec', '1e-06 x1', '-')
    """
    if math.isnan(rms):
        return "-"
    return angle(2.0 * math.asin(min(rms, 1.0))) if plant == "spacecraft" else valued(rms, "window_error", plant)


def tables(summary: Summary) -> list[Table]:
    """The budget and the compliance, as far as there are such."""
    return [table for table in (budget(summary), compliance(summary)) if table is not None]


def is_index(metric: str) -> bool:
    """Whether a metric is one of the indices, which the budget tells."""
    index, _, axis = metric.rpartition("_")
    return index in INDICES and axis in AXES


def budget(summary: Summary) -> Table | None:
    """What the indices keep to, each about the axes and as a half-cone; None: no pointing is observed."""
    pointing = summary.get("pointing")
    if not pointing:
        return None
    rows = []
    for index, what in INDICES.items():
        if index in pointing["budget"]:
            name, _, meaning = what.partition(", ")
            over = f"{meaning} ({pointing['window']:g} s)" if "window" in meaning else meaning
            rows.append((name, *(angle(pointing["budget"][index].get(axis)) for axis in AXES), over))
    return Table(("index", "x", "y", "z", "half-cone", "largest in the observation of"), rows)


def heading(summary: Summary) -> Iterator[str]:
    """What the numbers of the budget mean."""
    from ptsmc_jax.simulation.requirements import fewest_trials

    pointing = summary.get("pointing")
    if not pointing:
        return
    boresight = ", ".join(f"{v:g}" for v in pointing["boresight"])
    begins = f"{pointing['after']:g} s after t_f" if pointing["after"] else "t_f"
    yield (
        f"pointing from {begins} to t_end, boresight {boresight}: {100 * pointing['probability']:g} % of the runs keep "
        f"to the angles of this budget, with {100 * pointing['confidence']:g} % confidence"
    )
    if any(value is None for axes in pointing["budget"].values() for value in axes.values()):
        few, more = (fewest_trials(pointing["probability"], confidence) for confidence in USUAL)
        least = f"{more} runs without a failure show a value, and {few} with 90 % confidence"
        lost = summary["flown"] - summary["counts"]["ok"] - summary["counts"].get("missed", 0)  # which have angles
        beyond = f"{lost} runs that were not flown to the end are beyond every angle"
        why = beyond if summary["flown"] >= more and lost else least
        yield f"where the budget has -, {why}"


def compliance(summary: Summary) -> Table | None:
    """Requirements on pointing as a review takes them over; None: there are none."""
    rows = [_row(verdict) for verdict in summary["verdicts"] if is_index(verdict["metric"])]
    if not rows:
        return None
    head = ("index", "about", "at most", "probability", "interpretation", "confidence", "shown", "runs", "beyond")
    return Table((*head, "enough if none", "verdict"), rows)


def _row(verdict: Summary) -> tuple[str, ...]:
    index, _, axis = verdict["metric"].rpartition("_")
    kind = verdict.get("interpretation") or "ensemble"
    probability, confidence, margin = verdict["quantile"], verdict["confidence"], verdict["margin"]
    if kind == "ensemble":
        shown = angle(None if margin is None else margin * verdict["limit"])
    else:
        shown = f"{percent(verdict['shown'])} % of the time"
    return (
        INDICES[index].partition(",")[0],
        "half-cone" if axis == "boresight" else axis,
        angle(verdict["limit"]),
        "all flown" if probability is None else f"{100 * probability:g} %",
        kind,
        "none asked" if confidence is None else f"{100 * confidence:g} %",
        shown,
        str(verdict["trials"]),
        str(verdict["failures"]),
        _needed(kind, probability, confidence),
        "met" if verdict["met"] else "NOT met",
    )


def _needed(kind: str, probability: float | None, confidence: float | None) -> str:
    """Runs without a failure that would show it."""
    from ptsmc_jax.simulation.requirements import fewest_trials

    if probability is None or kind == "temporal":
        return "every run flown"
    if confidence is not None:
        return str(fewest_trials(probability, confidence))
    return ", ".join(f"{fewest_trials(probability, c)} ({100 * c:g} %)" for c in USUAL)
