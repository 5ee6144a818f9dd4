"""The report of a tuning: error, requirements, gains, and how far the result can be trusted."""

import math
from collections.abc import Callable, Iterator

from ptsmc_jax.simulation.catalogues import CATALOGUES, MARGINS, NO_SIGN, percent
from ptsmc_jax.simulation.requirements import quantity
from tuning.output import formats, margins_report, report
from tuning.output.formats import digits, error, failed, interval, listed, many, over_bound, ratio
from tuning.output.report import Report, Section, Table, Text
from tuning.output.run_report import warnings
from tuning.output.summaries import Check, Entry, Group, Hardest, Search, Tune

AGREE = 0.01  # largest relative difference of gradients from finite differences
HOPELESS = 1.1  # see `optimise.HOPELESS`, whose import takes a second
PUBLISHED = {  # columns of the published gains in words
    "published": "the published gains",
    "published, scaled": "the published gains, scaled to this body and period",
    "paper's law": "the paper's law with the published gains",
}


def build(summary: Tune) -> Report:
    """Return the report of a tuning."""
    first = formats.named_error(summary.held_out.number("window_error", "rms"), summary.plant, "RMS ")
    headline, mood = report.headline(summary.status, summary.verdicts, first)
    trust = [*advice(summary), *search(summary), *diagnostics(summary), *_shortest_time(summary)]
    sections = [
        *report.requirements(summary.verdicts),
        Section("Gains", [gains(summary)]),
        Section("Can the result be trusted?", [Text(trust)]),
    ]
    return Report(headline, mood, [*accuracy(summary), *warnings(summary.warnings)], sections)


def _groups(summary: Tune) -> dict[str, Group]:
    """Return the gains side by side, by the headings of their columns."""
    groups = {summary.published_label: summary.published, "before": summary.before, "tuned": summary.held_out}
    return {name: group for name, group in groups.items() if group is not None}


def gains(summary: Tune) -> Table:
    """Return the table of the gains that differ, and of the results of all of them on the held-out trials."""
    from ptsmc_jax.simulation.gains import base

    groups, plant = _groups(summary), summary.plant
    quantity, rows = formats.error_name(plant), list[tuple[str, ...]]()
    for gain in dict.fromkeys(name for group in groups.values() for name in group.gains):
        values = [group.gains.get(gain, group.gains.get(base(gain))) for group in groups.values()]
        by_axis = gain == "observer_gain" and "observer_gain_1" in summary.held_out.gains
        if len(set(values)) > 1 and not by_axis:
            rows.append((gain, *(digits(v, ".6g") for v in values), summary.gain_units.get(base(gain), "-")))

    def row(label: str, text: Callable[[Group], str], unit: str = "") -> None:
        rows.append((label, *map(text, groups.values()), unit))

    row(f"RMS {quantity}", lambda group: error(group.number("window_error", "rms"), plant))
    if summary.held_out.lower_bound:
        row(
            "ratio to the lower bound",
            lambda group: ratio(over_bound(group.number("window_error", "rms"), group.lower_bound)),
        )
    row(f"largest {quantity}", lambda group: error(group.number("window_error", "max"), plant))
    for label, metric, statistic in (
        ("mean peak torque", "peak_torque", "mean"),
        ("largest peak torque", "peak_torque", "max"),
        ("mean effort", "effort", "mean"),
    ):
        unit = CATALOGUES[plant][metric].unit
        row(label, lambda group, m=metric, s=statistic: digits(group.number(m, s), ".4g"), unit)
    row("failed or not converged", lambda group: str(summary.held_out.trials - group.counts["ok"]))
    note = f"Results on {many(summary.held_out.trials, 'held-out trial')} ({summary.judged_on})."
    return Table(("", *groups, "unit"), rows, note)


def accuracy(summary: Tune) -> Iterator[str]:
    """Return the error next to the lower bound and to the published gains."""
    held_out, plant = summary.held_out, summary.plant

    def text(value: float) -> str:
        return error(value, plant)

    if summary.status == "interrupted":
        yield "these are the best gains so far; the same command resumes the search"
    failures = failed(held_out.counts)
    if failures:
        count = sum(failures.values())
        yield f"{count} of {held_out.trials} held-out trials fail with the tuned gains: {listed(failures)}"
    on_held_out, on_training = held_out.metrics.get("window_error"), summary.training.metrics.get("window_error")
    if on_held_out is not None and on_held_out.rms is not None:
        times = over_bound(on_held_out.rms, held_out.lower_bound)
        least = error(held_out.lower_bound, plant)
        bound = "" if times is None else f", {ratio(times)} times the lower bound of {least}"
        spread = interval(on_held_out.rms_interval, text)
        yield f"held-out trials: {text(on_held_out.rms)}{spread}{bound}"
    if on_training is not None and on_training.rms is not None:
        spread = interval(on_training.rms_interval, text)
        yield f"training trials: {text(on_training.rms)}{spread}"
    yield from _compared_with_published(summary)
    if summary.gains:
        yield f"tuned gains: {', '.join(f'{name} {value:.6g}' for name, value in summary.gains.items())}"
    saturated = held_out.metrics.get("saturated")
    if saturated and saturated.max and saturated.mean is not None:
        often = f"{percent(saturated.mean)} % of a trial on average, {percent(saturated.max)} % at most"
        yield f"the actuators saturate with the tuned gains: {often}"
    before = None if summary.before is None else summary.before.number("window_error", "rms")
    after = held_out.number("window_error", "rms")
    if before is not None and after is not None and before < after:
        theirs = summary.broken_by.get("before")
        why = f"they break {' and '.join(theirs)}" if theirs else "see tune.bounds and the requirements"
        yield f"the scenario's own gains are more accurate than the tuned ones; {why}"


def _compared_with_published(summary: Tune) -> Iterator[str]:
    """Return the comparison with the published gains."""
    times, bounds = summary.accuracy_gain_over_published, summary.accuracy_gain_interval
    published = PUBLISHED[summary.published_label]
    if summary.published_unavailable:
        yield f"the published gains cannot be simulated in this scenario: {summary.published_unavailable}"
    if times is None or not summary.held_out.counts.get("ok", 0):
        return
    if times >= 1.0:
        yield f"{ratio(times)} times as accurate as {published}{interval(bounds, ratio)}"
        return
    turned = None if bounds is None else (1.0 / bounds[1], 1.0 / bounds[0])
    theirs = summary.broken_by.get("published")
    but = f"; these break {' and '.join(theirs)}" if theirs else ""
    yield f"less accurate than {published}: {ratio(1.0 / times)} times the error{interval(turned, ratio)}{but}"


def search(summary: Tune) -> Iterator[str]:
    """Return the course of the search."""
    record = summary.search
    over = {metric: one for metric, one in record.largest_over_limit.items() if one is None or one > 1.0}
    if over:
        globally = ", nor did a global search" if record.searched_globally else ""
        yield f"the search found no gains that meet every requirement{globally}"
    # failed trials violate all requirements with the same text, which is printed once
    for text in dict.fromkeys(_violation(summary, metric, one) for metric, one in over.items()):
        yield f"best compromise: {text}"
    yield from _conflict(summary)
    yield from _continued(record)
    yield from _confidences(summary)
    for count in record.confirmed:
        most = "none allowed" if count.allowed is None else f"at most {count.allowed} allowed"
        yield (
            f"{count.metric} {'confirmed' if count.confirmed else 'NOT confirmed'} on {count.trials} other trials: "
            f"{count.violations} beyond the limit, {most}; probability that the held-out trials meet it: "
            f"{percent(count.probability)} %"
        )
    hopeless = [metric for metric, one in over.items() if one is None or one > HOPELESS]
    if hopeless and not record.confirmed and any(v.quantile is not None for v in summary.verdicts):
        names = " and ".join(hopeless)
        yield f"no requirement on a fraction of the trials was confirmed, because {names} is out of reach"
    if record.hardest is not None:
        yield _worst_case(record.hardest, tuned_for=record.worst_case)
    yield (
        f"the search took {record.seconds:.0f} s with compiling, and simulated {record.rollouts} trials, and "
        f"{record.gradients} with gradients"
    )
    if summary.differential_evolution is not None:
        yield _compared_with_evolution(summary.differential_evolution, record)


def _conflict(summary: Tune) -> Iterator[str]:
    """Return the requirements that conflict, and the limits that resolve the conflict."""
    conflict, worst = summary.search.conflict or {}, summary.search.largest_over_limit
    verdicts = {one.metric: one for one in summary.verdicts}
    if len(conflict) > 1:
        yield f"{' and '.join(conflict)} conflict: the gains that improve one of them worsen another"
    for metric, alone in conflict.items():
        one = verdicts.get(metric)
        if one is None or alone is None:
            yield f"no value of {metric} alone resolves the conflict: the other requirements cannot be met either"
            continue
        needed = one.limit * (2.0 - alone if one.at_least else alone)
        if alone <= 1.0:
            yield f"{metric} can be met, but only if another requirement gives way"
        elif one.at_least and needed <= 0.0:
            yield f"{metric} alone cannot give way far enough: the loop would be unstable"
        else:
            limits = f"{quantity(needed, one.unit, 4)} instead of {quantity(one.limit, one.unit, 6)}"
            yield f"if {metric} alone gives way, its limit must be {limits}"
    ratios = [one for metric in conflict if (one := worst[metric]) is not None]
    if len(conflict) > 1 and len(ratios) == len(conflict):
        yield f"if all of them give way together, each must by {100.0 * (max(ratios) - 1.0):.2g} % of its limit"


def _continued(record: Search) -> Iterator[str]:
    """Return the earlier searches, whose gains broke a limit on held-out trials."""
    next_margins = [*(one.margins for one in record.earlier[1:]), record.margins]
    for one, margins in zip(record.earlier, next_margins, strict=False):
        for metric, reached in one.over.items():
            yield (
                f"earlier gains reached {_of_limit(metric, reached):.4g} times the limit of {metric} on held-out "
                f"trials (seed {one.held_out_seed}); the search continued with a reserve of "
                f"{100 * margins[metric]:.2g} % instead of {100 * one.margins[metric]:.2g} %"
            )


def _confidences(summary: Tune) -> Iterator[str]:
    """Return the confidence of verdicts after several looks at held-out trials, each on other trials.

    Each look accepts gains that miss the requirement with a probability of at most 1 - c, so k looks do with at most
    1 - c^k.
    """
    looks = 1 + len(summary.search.earlier)
    for one in summary.verdicts if looks > 1 else ():
        if one.confidence is not None and one.met:
            yield (
                f"{one.metric}: the confidence is {percent(one.confidence**looks)} % instead of "
                f"{percent(one.confidence)} %, because these are the gains of look {looks} at held-out trials"
            )


def _worst_case(hardest: Hardest, *, tuned_for: bool) -> str:
    """Return the worst case inside the dispersions."""
    where = "in the worst case inside the dispersions"
    if hardest.unbounded:
        moved = " and ".join(name.replace("_", " ") for name in hardest.moved) or "the dispersions"
        end = {"singular": "reaches a singularity of the law"}.get(hardest.status, "diverges")
        return (
            f"{where}, over {moved}, a trial {end}: {hardest.metric} has no bound; require it for a fraction of the "
            f"trials instead, {hardest.metric} = {{ limit = .., quantile = 0.99 }}"
        )
    far = "has no value" if hardest.ratio is None else f"is {hardest.ratio:.4g} times its limit"
    tip = "" if tuned_for or not hardest.breaks_limit else "; tune.worst_case = true tunes for it"
    return f"{where}, {hardest.metric} {far}{tip}"


def _compared_with_evolution(check: Check, record: Search) -> str:
    """Return the comparison with differential evolution."""
    keeps = all(one is not None and one <= 1.0 for one in record.largest_over_limit.values())
    far = check.distance  # difference of the logarithms of the objectives
    off = f"{math.exp(far):.3g} times" if far > math.log(2.0) else f"{100 * math.expm1(far):+.2f} % from"
    compared = {
        (True, True): f"the tuned gains are {off} that",
        (True, False): "with gains that break a limit; the tuned gains keep every limit",
        (False, True): "with gains that keep every limit; the tuned gains break one",
        (False, False): "with gains that break a limit, as the tuned gains do",
    }[keeps, check.kept]
    return f"differential evolution found an objective of {check.value:.4e} in {check.rollouts} trials: {compared}"


def _violation(summary: Tune, metric: str, reached: float | None) -> str:
    """Return the violation of a limit by the training trials, or the number of these that fail."""
    if reached is not None and math.isfinite(reached):
        limit = next((f" of {quantity(v.limit, v.unit, 6)}" for v in summary.verdicts if v.metric == metric), "")
        return f"{metric} reaches {_of_limit(metric, reached):.3g} times its limit{limit} on the training trials"
    failures = failed(summary.training.counts)
    if not failures:
        return f"a training trial has no {metric}"
    count = sum(failures.values())
    return f"{count} of {summary.training.trials} training trials fail ({listed(failures)}) and keep no limit"


def _of_limit(metric: str, over: float) -> float:
    """Return the value of a metric relative to its limit from `requirements.violation_ratio`."""
    return 2.0 - over if metric in MARGINS and MARGINS[metric].at_least else over


def advice(summary: Tune) -> Iterator[str]:
    """Return what to change if the held-out trials break a requirement that the search kept."""
    record = summary.search
    larger = f"tune.trials = {4 * record.averaged}"
    for verdict in summary.verdicts:
        searched, over = record.largest_over_limit.get(verdict.metric), _reached(verdict)
        kept_in_search = searched is not None and searched <= 1.0
        if verdict.met or not kept_in_search or not verdict.limit:
            continue
        if verdict.metric in MARGINS:
            yield from _of_loops(verdict)
        elif over is None or not math.isfinite(over):
            yield f"{verdict.metric}: kept in the search, but held-out trials fail: tune with {larger}"
        elif over > 1.0:
            stricter = f"requirements.{verdict.metric} = {verdict.limit / (1.02 * over):.3g}"
            yield (
                f"{verdict.metric}: kept in the search, but held-out trials reach {over:.3g} times the limit: tune "
                f"with {larger} or {stricter}"
            )
    trained, held_out = (
        one.rms_interval if one else None
        for one in (summary.training.metrics.get("window_error"), summary.held_out.metrics.get("window_error"))
    )
    if trained and held_out and trained[1] < held_out[0]:
        yield f"the gains fit the training trials too closely: tune with {larger}"


def _reached(verdict: Entry) -> float | None:
    """Return the value on the held-out trials relative to the limit; None without a value."""
    if verdict.fraction_of_time is None:
        return verdict.margin
    return None if verdict.worst is None else verdict.worst / verdict.limit


def _of_loops(verdict: Entry) -> Iterator[str]:
    """Return what to change if held-out loops break a margin that the loops of the search kept."""
    if verdict.trials == 1:  # the diagnostics report the nominal loop
        return
    broken = f"{verdict.metric}: {verdict.failures} of {verdict.trials} held-out loops break it"
    if verdict.margin is None or verdict.worst is None or verdict.worst == 0.0:
        yield f"{broken}, some without any margin: tune with a larger one, or reduce [dispersion]"
        return
    farther = 1.02 * verdict.margin
    stricter = f"{verdict.limit * farther if verdict.at_least else verdict.limit / farther:.3g}"
    worst = f"{verdict.worst:.3g} {verdict.unit}"
    yield f"{broken}, the worst with {worst}: tune with requirements.{verdict.metric} = {stricter}"


def diagnostics(summary: Tune) -> Iterator[str]:
    """Return the influence of the gains, the margins, and the check of the gradients."""
    found = summary.trust
    influence = {} if found is None else found.influence
    for gain, side in summary.at_bound.items():
        if influence.get(gain) not in ("none", "unknown"):
            yield f"{gain} ended on its {side} bound" + (f": {influence[gain]}" if gain in influence else "")
    for gain, how in influence.items():
        if how == "none":
            yield f"{gain} has no influence: objective and limits change by less than 1 % between its bounds"
    unknown = ", ".join(gain for gain, how in influence.items() if how == "unknown")
    if unknown:
        yield f"the influence of {unknown} is unknown: no training trial reaches its end between the bounds"
    if found is None:
        return
    gradients = found.gradient_error
    # a discontinuous sign has no margins to require
    required = gradients is None or any(v.metric in MARGINS for v in summary.verdicts)
    yield from margins_report.tuned(found.margins, required=required)
    if gradients is None:
        if found.margins:
            yield NO_SIGN
        yield (
            "differential evolution found the gains, because the discontinuous sign has no gradients; tune.free may "
            "name sign_width"
        )
        return
    off = {place: value for place, value in gradients.items() if value is not None}
    shown = " and ".join(f"{value:.0e} at the {place}" for place, value in off.items())
    if not off:
        yield "the gradients are not checked: the error is zero, or no trial reaches its end"
    elif max(off.values()) <= AGREE:
        yield f"gradients agree with finite differences to {shown}"
    else:
        yield (
            f"gradients differ from finite differences by {shown}: the loop chatters or fails there, or the steps of "
            "hardware.torque_step matter; check the result with --global-check"
        )


def _shortest_time(summary: Tune) -> Iterator[str]:
    """Return the shortest t_f that the limit on the torque allows."""
    found = summary.shortest_t_f
    # the theory ignores noise: without a simulation that keeps the limit its t_f would contradict the verdict
    if found is None or (found.simulated is None and found.theory is not None):
        return
    fraction = "" if found.quantile is None else f" in {100 * found.quantile:g} % of trials"
    limit = f"peak_torque below {found.limit:g} {found.unit or ''}".rstrip() + fraction
    if found.theory is None:
        yield f"the tuned gains keep {limit} at no t_f, by theory"
    else:
        yield (
            f"the tuned gains keep {limit} from t_f = {digits(found.simulated, '.4g')} s on ({found.theory:.4g} s by "
            "theory)"
        )
