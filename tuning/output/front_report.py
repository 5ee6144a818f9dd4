"""The report of a Pareto front."""

import math
from collections.abc import Iterator, Sequence

from ptsmc_jax.simulation.catalogues import MARGINS
from tuning.output import margins_report
from tuning.output.formats import (
    format_count,
    format_error,
    format_metric,
    format_number,
    format_ratio,
    in_readable_unit,
    ratio_to_bound,
)
from tuning.output.report import Report, Section, Table, Text, warning_lines
from tuning.studies.front import KINDS, Front, Point, metric_heading, unit_of

USUAL_LIMIT = margins_report.USUAL_MARGINS["gain_margin"]  # limit on |S| that the summary states first [dB]


def build(front: Front) -> Report:
    """Return the report of a front."""
    if front.requirements:
        met, points = sum(point.meets for point in front.non_dominated), len(front.non_dominated)
        headline, mood = f"{met} of {format_count(points, 'point')} meet every requirement", "good" if met else "bad"
    else:
        headline, mood = count_line(front), "calm"
    blocks = [result_table(front), Text(list(remark_lines(front))), gain_table(front)]
    main_results = {"torque": _torque_results, "margins": _margin_results, "t_f": _time_results}[front.against]
    lines = [*main_results(front), *([count_line(front)] if front.requirements else []), *warning_lines(front.warnings)]
    return Report(headline, mood, lines, [Section(KINDS[front.against].title, blocks)])


def count_line(front: Front) -> str:
    """Return the number of points and of held-out trials."""
    points = format_count(len(front.non_dominated), "point")
    return f"{points}, each judged on {format_count(front.trials, 'held-out trial')}"


def result_table(front: Front) -> Table:
    """Return the table of errors and costs."""
    rows, plant = _labelled_points(front), front.plant
    costs = list(rows[0][1].costs) if rows else []
    bound_heading = ["times the lower bound"] if front.lower_bound else []
    columns = {
        name: in_readable_unit(name, unit_of(name, plant), *(point.costs[name] for _, point in rows)) for name in costs
    }
    heads = [metric_heading(name, unit) for name, (unit, _) in columns.items()]
    cells = [
        (
            label,
            format_error(point.rms, plant),
            relative_spread(point),
            *(format_ratio(ratio_to_bound(point.rms, front.lower_bound)) for _ in bound_heading),
            *(
                format_number(values[row], ".4g", _describe_no_value(name, point))
                for name, (_, values) in columns.items()
            ),
            _describe_marks(point),
        )
        for row, (label, point) in enumerate(rows)
    ]
    return Table((KINDS[front.against].label(plant), "RMS error", "+-", *bound_heading, *heads, ""), cells)


def _describe_no_value(cost: str, point: Point) -> str:
    """Return the text for a missing cost: "none" for an unlimited margin of a closed loop, and "-" otherwise."""
    return "none" if cost.endswith("margin") and math.isfinite(point.costs.get("peak_sensitivity", math.nan)) else "-"


def gain_table(front: Front) -> Table:
    """Return the table of gains, with a row for each point of the Pareto front and for each set of reference gains."""
    from ptsmc_jax.simulation.gains import base

    rows = _labelled_points(front)
    names = list(rows[0][1].gains) if rows else []
    units = [front.gain_units.get(base(name), "-") for name in names]
    heads = [name if unit == "-" else f"{name} [{unit}]" for name, unit in zip(names, units, strict=True)]
    cells = [
        (label, *(format_number(point.gains.get(name, point.gains.get(base(name))), ".4g") for name in names))
        for label, point in rows
    ]
    return Table((KINDS[front.against].label(front.plant), *heads), cells)


def relative_spread(point: Point) -> str:
    """Return half the interval of a point's RMS error in per cent of this error.

    >>> interval = (1.9e-6, 2.1e-6)
    >>> relative_spread(Point(6.0, {}, rms=2e-6, interval=interval)), relative_spread(Point(6.0, {}, rms=2e-6))
    ('5.0 %', '-')
    """
    if not point.interval:
        return "-"
    low, high = point.interval
    return f"{50 * (high - low) / point.rms:.1f} %"


def remark_lines(front: Front) -> Iterator[str]:
    """Yield remarks on the front, a sentence each, as far as they apply.

    They concern the lower bound, missing and omitted points, requirements that no point meets, and published gains
    that cannot be simulated.
    """
    kind = KINDS[front.against]
    if front.lower_bound:
        lower_bound = format_error(front.lower_bound, front.plant)
        yield f"lower bound on the RMS error with these sensors: {lower_bound}, whatever the torque"
    if front.idle:
        idle = _list_values(front, front.idle)
        yield f"no separate point for {kind.quantity}: {idle}; another point has the same gains"
    if front.without:
        yield (
            f"no gains found keep all limits on the training trials for {kind.quantity}: "
            f"{_list_values(front, front.without)}"
        )
    dominated = len(front.points) - len(front.non_dominated)
    if dominated:
        yield f"omitted: {format_count(dominated, 'point')} with more torque and a larger error, beyond its interval"
    if front.requirements and front.status != "met":
        yield "no point meets every requirement on the held-out trials"
    if front.published_unavailable:
        yield f"the published gains cannot be simulated in this scenario: {front.published_unavailable}"


def _torque_results(front: Front) -> Iterator[str]:
    """Return lines on the most accurate point, the knee and the point with the least torque."""
    kept = sorted((point for point in front.non_dominated if point.rms > 0.0), key=lambda point: point.peak)
    labelled = {id(point): "knee" for point in kept if point.knee}
    if len(kept) > 1:
        labelled |= {id(kept[0]): "least torque", id(kept[-1]): "most torque"}
    for point in reversed(kept):
        if id(point) in labelled:
            rms, peak = format_error(point.rms, front.plant), format_metric(point.peak, "peak_torque", front.plant)
            yield f"RMS error {rms} at a largest peak torque of {peak} ({labelled[id(point)]})"


def _margin_results(front: Front) -> Iterator[str]:
    """Return lines on the cost of the usual limit on |S|, and on limits that the held-out trials exceed."""
    unlimited = next((point for point in front.points if not math.isfinite(point.value)), None)
    limited = [point for point in front.points if math.isfinite(point.value)]
    within_limit = [point for point in limited if point.rms > 0.0 and _keeps_limit(point)]
    if within_limit and unlimited is not None and unlimited.rms > 0.0:
        usual = min(within_limit, key=lambda point: abs(point.value - USUAL_LIMIT))
        error_ratio = format_ratio(usual.rms / unlimited.rms)
        yield (
            f"RMS error {format_error(usual.rms, front.plant)} with |S| at most {usual.value:g} dB, "
            f"{error_ratio} times the error without a limit"
        )
    if unlimited is not None and unlimited.costs["gain_margin"] <= 0.0:
        yield "without a limit on |S| some loops of the held-out trials are unstable"
    for point in limited:
        if not _keeps_limit(point):
            reached = format_number(point.costs["peak_sensitivity"], ".3g", "no value")
            yield f"the gains found for |S| at most {point.value:g} dB exceed it on the held-out trials: {reached} dB"


def _time_results(front: Front) -> Iterator[str]:
    """Return lines on the shortest tuned time that meets every requirement, and on the cost of the fastest slew."""
    shortest = min((point for point in front.points if point.meets), key=lambda point: point.value, default=None)
    if shortest is not None and front.requirements:
        rms = format_error(shortest.rms, front.plant)
        yield f"RMS error {rms} at t_f = {shortest.value:g} s, the shortest in the list that meets every requirement"
    if len(front.points) < 2:
        return
    fastest, slowest = front.points[0], front.points[-1]
    at_fastest, than_slowest = f"at t_f = {fastest.value:g} s", f"times the value at {slowest.value:g} s"
    if fastest.rms > 0.0 and slowest.rms > 0.0:
        error_ratio = format_ratio(fastest.rms / slowest.rms)
        yield f"RMS error {format_error(fastest.rms, front.plant)} {at_fastest}, {error_ratio} {than_slowest}"
    for name, cost in fastest.costs.items():
        if name not in MARGINS and cost > 0.0 and slowest.costs[name] > 0.0:
            cost_ratio = cost / slowest.costs[name]
            value = format_metric(cost, name, front.plant)
            yield f"{name.replace('_', ' ')} {value} {at_fastest}, {cost_ratio:.3g} {than_slowest}"


def _keeps_limit(point: Point) -> bool:
    """Return whether the loops of the held-out trials keep the limit on |S| within 1 %."""
    return point.costs["peak_sensitivity"] <= 1.01 * point.value


def _labelled_points(front: Front) -> list[tuple[str, Point]]:
    """Return the labels and points of the tables."""
    return [*((_format_value(point.value), point) for point in front.non_dominated), *front.labelled().items()]


def _format_value(value: float) -> str:
    """Return a number as text with four digits, or "none" if it is not finite."""
    return f"{value:.4g}" if math.isfinite(value) else "none"


def _list_values(front: Front, values: Sequence[float]) -> str:
    """Return values of the traded quantity in one text, separated by commas, with their unit."""
    return f"{', '.join(map(_format_value, values))} {KINDS[front.against].unit_for(front.plant)}"


def _describe_marks(point: Point) -> str:
    """Return the marks of a point in words: knee, meets, number of failed trials; empty without marks."""
    words = [word for word, is_so in (("knee", point.knee), ("meets", point.meets)) if is_so]
    return ", ".join([*words, *([f"{point.failures} failed or not converged"] if point.failures else [])])
