"""The report of a Pareto front."""

import math
from collections.abc import Iterator, Sequence

from tuning.output import margins_report
from tuning.output.formats import digits, error, many, over_bound, ratio, valued
from tuning.output.report import Report, Section, Table, Text
from tuning.output.run_report import warnings
from tuning.studies.front import KINDS, Front, Point, titled, unit_of

USUAL = margins_report.ENOUGH["gain_margin"]  # limit on |S| that the summary states first [dB]


def build(front: Front) -> Report:
    """Return the report of a front."""
    if front.requirements:
        met, points = sum(point.meets for point in front.kept), len(front.kept)
        headline, mood = f"{met} of {many(points, 'point')} meet every requirement", "good" if met else "bad"
    else:
        headline, mood = heading(front), "calm"
    blocks = [results(front), Text(list(remarks(front))), gains(front)]
    lines = [*main_results(front), *([heading(front)] if front.requirements else []), *warnings(front.warnings)]
    return Report(headline, mood, lines, [Section(KINDS[front.against].title, blocks)])


def heading(front: Front) -> str:
    """Return the number of points and of held-out trials."""
    return f"{many(len(front.kept), 'point')}, each judged on {many(front.trials, 'held-out trial')}"


def results(front: Front) -> Table:
    """Return the table of errors and costs."""
    rows, plant = _rows(front), front.plant
    costs = list(rows[0][1].costs) if rows else []
    vector = [f"RMS error vector [{unit_of('window_error', plant)}]"] if plant == "spacecraft" else []
    bound = ["times the lower bound"] if front.lower_bound else []
    heads = [titled(name, plant) for name in costs]
    cells = [
        (
            label,
            error(point.rms, plant),
            spread(point),
            *(digits(point.rms, ".3e") for _ in vector),
            *(ratio(over_bound(point.rms, front.lower_bound)) for _ in bound),
            *(digits(point.costs[name], ".4g", "none" if name.endswith("margin") else "-") for name in costs),
            _marks(point),
        )
        for label, point in rows
    ]
    return Table((KINDS[front.against].label(plant), "RMS error", "+-", *vector, *bound, *heads, ""), cells)


def gains(front: Front) -> Table:
    """Return the table of gains."""
    from ptsmc_jax.simulation.gains import base

    rows = _rows(front)
    names = list(rows[0][1].gains) if rows else []
    units = [front.gain_units.get(base(name), "-") for name in names]
    heads = [name if unit == "-" else f"{name} [{unit}]" for name, unit in zip(names, units, strict=True)]
    cells = [
        (label, *(digits(point.gains.get(name, point.gains.get(base(name))), ".4g") for name in names))
        for label, point in rows
    ]
    return Table((KINDS[front.against].label(front.plant), *heads), cells)


def spread(point: Point) -> str:
    """Return half the interval of a point's RMS error in per cent of this error.

    >>> spread(Point(6.0, {}, rms=2e-6, interval=(1.9e-6, 2.1e-6))), spread(Point(6.0, {}, rms=2e-6))
    ('5.0 %', '-')
    """
    if not point.interval:
        return "-"
    low, high = point.interval
    return f"{50 * (high - low) / point.rms:.1f} %"


def main_results(front: Front) -> Iterator[str]:
    """Return lines with the main results: errors of a few points of the front, with their torque, margins or time."""
    yield from {"torque": _torque_results, "margins": _margin_results, "t_f": _time_results}[front.against](front)


def remarks(front: Front) -> Iterator[str]:
    """Return the lower bound, the missing points, and a warning if no point meets every requirement."""
    kind = KINDS[front.against]
    if front.lower_bound:
        least = error(front.lower_bound, front.plant)
        yield f"lower bound on the RMS error with these sensors: {least}, whatever the torque"
    if front.idle:
        yield f"no separate point for {kind.quantity}: {_listed(front, front.idle)}; another point has the same gains"
    if front.without:
        yield (
            f"no gains found keep all limits on the training trials for {kind.quantity}: "
            f"{_listed(front, front.without)}"
        )
    dominated = len(front.points) - len(front.kept)
    if dominated:
        yield f"omitted: {many(dominated, 'point')} with more torque and a larger error, beyond its interval"
    if front.requirements and front.status != "met":
        yield "no point meets every requirement on the held-out trials"
    if front.published_unavailable:
        yield f"the published gains cannot be simulated in this scenario: {front.published_unavailable}"


def _torque_results(front: Front) -> Iterator[str]:
    """Return lines on the most accurate point, the knee and the point with the least torque."""
    kept = sorted((point for point in front.kept if point.rms > 0.0), key=lambda point: point.peak)
    labelled = {id(point): "knee" for point in kept if point.knee}
    if len(kept) > 1:
        labelled |= {id(kept[0]): "least torque", id(kept[-1]): "most torque"}
    for point in reversed(kept):
        if id(point) in labelled:
            found, peak = error(point.rms, front.plant), valued(point.peak, "peak_torque", front.plant)
            yield f"RMS error {found} at a largest peak torque of {peak} ({labelled[id(point)]})"


def _margin_results(front: Front) -> Iterator[str]:
    """Return lines on the cost of the usual limit on |S|, and on limits that the held-out trials exceed."""
    loose = next((point for point in front.points if not math.isfinite(point.value)), None)
    limited = [point for point in front.points if math.isfinite(point.value)]
    keeping = [point for point in limited if point.rms > 0.0 and _keeps(point)]
    if keeping and loose is not None and loose.rms > 0.0:
        usual = min(keeping, key=lambda point: abs(point.value - USUAL))
        times = ratio(usual.rms / loose.rms)
        yield (
            f"RMS error {error(usual.rms, front.plant)} with |S| at most {usual.value:g} dB, "
            f"{times} times the error without a limit"
        )
    if loose is not None and loose.costs["gain_margin"] <= 0.0:
        yield "without a limit on |S| some loops of the held-out trials are unstable"
    for point in limited:
        if not _keeps(point):
            found = digits(point.costs["peak_sensitivity"], ".3g", "no value")
            yield f"the gains found for |S| at most {point.value:g} dB exceed it on the held-out trials: {found} dB"


def _time_results(front: Front) -> Iterator[str]:
    """Return lines on the shortest time that meets every requirement, and on the cost of the fastest slew."""
    shortest = min((point for point in front.points if point.meets), key=lambda point: point.value, default=None)
    if shortest is not None and front.requirements:
        found = error(shortest.rms, front.plant)
        yield f"RMS error {found} at t_f = {shortest.value:g} s, the shortest time that meets every requirement"
    if len(front.points) < 2:
        return
    fast, slow = front.points[0], front.points[-1]
    where, than = f"at t_f = {fast.value:g} s", f"times the value at {slow.value:g} s"
    if fast.rms > 0.0 and slow.rms > 0.0:
        yield f"RMS error {error(fast.rms, front.plant)} {where}, {ratio(fast.rms / slow.rms)} {than}"
    for name, cost in fast.costs.items():
        if cost > 0.0 and slow.costs[name] > 0.0:
            unit = unit_of(name, front.plant)
            yield f"{name.replace('_', ' ')} {cost:.4g} {unit} {where}, {cost / slow.costs[name]:.3g} {than}"


def _keeps(point: Point) -> bool:
    """Return whether the loops of the held-out trials keep the limit on |S| within 1 %."""
    return point.costs["peak_sensitivity"] <= 1.01 * point.value


def _rows(front: Front) -> list[tuple[str, Point]]:
    """Return the labels and points of the tables."""
    return [*((_value(point.value), point) for point in front.kept), *front.labelled().items()]


def _value(value: float) -> str:
    return f"{value:.4g}" if math.isfinite(value) else "none"


def _listed(front: Front, values: Sequence[float]) -> str:
    return f"{', '.join(map(_value, values))} {KINDS[front.against].unit_for(front.plant)}"


def _marks(point: Point) -> str:
    words = [word for word, is_so in (("knee", point.knee), ("meets", point.meets)) if is_so]
    return ", ".join([*words, *([f"{point.failures} failed or not converged"] if point.failures else [])])
