"""The report of a tuning: error, requirements, gains, and how far the result can be trusted."""

import math
from collections.abc import Callable, Iterator
from functools import partial

from ptsmc_jax.simulation.catalogues import CATALOGUES, MARGINS, NO_SIGN, TORQUES, percent
from ptsmc_jax.simulation.requirements import quantity
from tuning.output import formats, margins_report, report
from tuning.output.formats import (
    failed_counts,
    format_count,
    format_error,
    format_interval,
    format_number,
    format_ratio,
    in_readable_unit,
    list_counts,
    ratio_to_bound,
    widened_lines,
)
from tuning.output.report import Report, Section, Table, Text
from tuning.output.summaries import Entry, Group, Row, Search, Tune
from tuning.studies.front import LABELS

GRADIENT_TOLERANCE = 0.01  # largest relative difference of gradients from finite differences
HOPELESS = 1.1  # equal to `optimise.HOPELESS`, whose import takes a second: no confirmation above this metric / limit
THEORY = "without noise, disturbance, sampling and actuator dynamics"  # assumptions of `solutions.exact_peak`
PUBLISHED = {  # the published gains in words, by the heading of their column
    "published gains": "the published gains",
    "published gains, scaled": "the published gains, scaled to this body and period",
    "published gains, prescribed-time law": "the prescribed-time law with the published gains",
}


def build(summary: Tune) -> Report:
    """Return the report of a tuning."""
    error_text = formats.format_named_error(summary.held_out.number("window_error", "rms"), summary.plant, "RMS ")
    headline, mood = report.headline(summary.status, summary.verdicts, error_text)
    trust_lines = [
        *advice_lines(summary),
        *search_lines(summary),
        *diagnostic_lines(summary),
        *_shortest_time_lines(summary),
    ]
    sections = [
        *report.requirement_sections(
            summary.verdicts, partial(_describe_verdict, verifications=1 + len(summary.search.earlier))
        ),
        Section("Gains", [gain_table(summary)]),
        Section("Can the result be trusted?", [Text(trust_lines)]),
    ]
    return Report(headline, mood, [*accuracy_lines(summary), *report.warning_lines(summary.warnings)], sections)


def gain_table(summary: Tune) -> Table:
    """Return the table of the gains that differ, and of the results of all of them on the held-out trials."""
    from ptsmc_jax.simulation.gains import base

    groups = {
        summary.published_label: summary.published,
        LABELS["before"]: summary.before,
        LABELS["tuned"]: summary.held_out,
    }
    columns, plant = {name: group for name, group in groups.items() if group is not None}, summary.plant
    quantity, rows = formats.error_name(plant), list[tuple[str, ...]]()
    for gain in dict.fromkeys(name for group in columns.values() for name in group.gains):
        values = [group.gains.get(gain, group.gains.get(base(gain))) for group in columns.values()]
        by_axis = gain == "observer_gain" and "observer_gain_1" in summary.held_out.gains
        if len(set(values)) > 1 and not by_axis:
            rows.append((gain, *(format_number(v, ".6g") for v in values), summary.gain_units.get(base(gain), "-")))

    def add_row(label: str, text: Callable[[Group], str]) -> None:
        rows.append((label, *map(text, columns.values()), ""))

    add_row(f"RMS {quantity}", lambda group: format_error(group.number("window_error", "rms"), plant))
    if summary.held_out.lower_bound:
        add_row(
            "ratio to the lower bound",
            lambda group: format_ratio(ratio_to_bound(group.number("window_error", "rms"), group.lower_bound)),
        )
    add_row("largest RMS error of a trial", lambda group: format_error(group.number("window_error", "max"), plant))
    statistics = [("mean", "mean", "peak_torque"), ("largest", "max", "peak_torque"), ("mean", "mean", "effort")]
    shown_errors = ("window_error", "window_angle")
    required = [v.metric for v in summary.verdicts if v.metric in CATALOGUES[plant] and v.metric not in shown_errors]
    statistics += [("largest", "max", metric) for metric in required]
    for word, statistic, metric in dict.fromkeys(statistics):
        values = [group.number(metric, statistic) for group in columns.values()]
        unit, values = in_readable_unit(metric, CATALOGUES[plant][metric].unit, *values)
        rows.append((f"{word} {TORQUES.get(metric, metric)}", *(format_number(v, ".4g") for v in values), unit))
    add_row("failed or not converged", lambda group: str(summary.held_out.trials - group.counts["ok"]))
    note = f"Results on {format_count(summary.held_out.trials, 'held-out trial')} ({summary.judged_on})."
    return Table(("", *columns, "unit"), rows, note)


def accuracy_lines(summary: Tune) -> Iterator[str]:
    """Return lines that compare the error with the lower bound and with the error of the published gains."""
    held_out, plant = summary.held_out, summary.plant
    if summary.status == "interrupted":
        yield "these are the best gains so far; the same command resumes the search"
    failures = failed_counts(held_out.counts)
    if failures:
        count = sum(failures.values())
        yield f"{count} of {held_out.trials} held-out trials fail with the tuned gains: {list_counts(failures)}"
    for name, group in (("held-out", held_out), ("training", summary.training)):
        statistics = group.metrics.get("window_error")
        if statistics is not None and statistics["rms"] is not None:
            ratio, bound = ratio_to_bound(statistics["rms"], group.lower_bound), format_error(group.lower_bound, plant)
            compared = "" if ratio is None else f", {format_ratio(ratio)} times the lower bound of {bound}"
            spread = format_interval(statistics.get("rms_interval"), lambda value: format_error(value, plant))
            yield f"{name} trials: {format_error(statistics['rms'], plant)}{spread}{compared}"
    yield from _published_comparison(summary)
    if summary.gains:
        yield f"tuned gains: {formats.list_gains(summary.gains, summary.gain_units, '.6g')}"
    saturated = held_out.metrics.get("saturated")
    if saturated and saturated["max"] and saturated["mean"] is not None:
        saturation = f"{percent(saturated['mean'])} % of a trial on average, {percent(saturated['max'])} % at most"
        yield f"the actuators saturate with the tuned gains: {saturation}"
    before = None if summary.before is None else summary.before.number("window_error", "rms")
    after = held_out.number("window_error", "rms")
    if before is not None and after is not None and before < after:
        broken_limits = summary.broken_by.get("before")
        reason = (
            f"they break {' and '.join(broken_limits)}" if broken_limits else "see tune.bounds and the requirements"
        )
        yield f"the gains of the scenario are more accurate than the tuned gains; {reason}"


def _published_comparison(summary: Tune) -> Iterator[str]:
    """Yield the lines that compare the tuned with the published gains."""
    accuracy_ratio, bounds = summary.accuracy_gain_over_published, summary.accuracy_gain_interval
    published = PUBLISHED[summary.published_label]
    if summary.published_unavailable:
        yield f"the published gains cannot be simulated in this scenario: {summary.published_unavailable}"
    if accuracy_ratio is None or not summary.held_out.counts.get("ok", 0):
        return
    if accuracy_ratio >= 1.0:
        yield f"{format_ratio(accuracy_ratio)} times as accurate as {published}{format_interval(bounds, format_ratio)}"
        return
    inverse_bounds = None if bounds is None else (1.0 / bounds[1], 1.0 / bounds[0])
    spread = format_interval(inverse_bounds, format_ratio)
    broken_limits = summary.broken_by.get("published")
    caveat = f"; the published gains break {' and '.join(broken_limits)}" if broken_limits else ""
    yield f"less accurate than {published}: {format_ratio(1.0 / accuracy_ratio)} times the error{spread}{caveat}"


def search_lines(summary: Tune) -> Iterator[str]:
    """Return lines on the limits that the search broke, its confirmations, the worst case and the simulations."""
    record = summary.search
    violated = {
        metric: violation
        for metric, violation in record.largest_over_limit.items()
        if violation is None or violation > 1.0
    }
    if violated:
        addition = ", nor did a global search" if record.searched_globally else ""
        yield f"the search found no gains that meet every requirement{addition}"
    # failed trials violate all requirements with the same text, which is printed once
    for text in dict.fromkeys(
        _describe_violation(summary, metric, violation) for metric, violation in violated.items()
    ):
        yield f"best compromise: {text}"
    yield from _conflict_lines(summary)
    yield from _continuation_lines(record)
    for count in record.confirmed:
        most = count["allowed"]
        allowed = "too few trials to confirm the requirement" if most is None else f"at most {most} allowed"
        yield (
            f"{count['metric']} {'confirmed' if count['confirmed'] else 'NOT confirmed'} before the held-out trials: "
            f"{count['violations']} of {count['trials']} other trials are beyond the limit, {allowed}"
        )
    hopeless = [metric for metric, violation in violated.items() if violation is None or violation > HOPELESS]
    if hopeless and not record.confirmed and any(v.quantile is not None for v in summary.verdicts):
        yield (
            "no requirement on a fraction of the trials was confirmed, because the best gains break "
            f"{' and '.join(hopeless)} by more than 10 %"
        )
    if record.hardest is not None:
        yield _describe_worst_case(record.hardest, tuned_for=record.worst_case)
    yield (
        f"the search took {record.seconds:.0f} s with compiling, not counting earlier interrupted runs; it simulated "
        f"{record.rollouts} trials, and {record.gradients} with gradients"
    )
    if summary.differential_evolution is not None:
        yield _evolution_comparison(summary.differential_evolution, record)


def _conflict_lines(summary: Tune) -> Iterator[str]:
    """Return the requirements that conflict, and the limits that resolve the conflict."""
    conflict, worst = summary.search.conflict or {}, summary.search.largest_over_limit
    verdicts = {verdict.metric: verdict for verdict in summary.verdicts}
    if len(conflict) > 1:
        yield f"{' and '.join(conflict)} conflict: the gains that improve one of them worsen another"
    for metric, ratio_alone in conflict.items():
        verdict = verdicts.get(metric)
        if verdict is None or ratio_alone is None:
            yield f"the search found no gains that meet all other requirements, even without {metric}"
            continue
        needed = verdict.limit * (2.0 - ratio_alone if verdict.at_least else ratio_alone)
        if ratio_alone <= 1.0:
            yield f"{metric} can be met, but only if another requirement gives way"
        elif verdict.at_least and needed <= 0.0:
            yield f"{metric} alone cannot give way far enough: the loop would be unstable"
        else:
            new, old = quantity(needed, verdict.unit, 4, metric), quantity(verdict.limit, verdict.unit, 6, metric)
            yield f"if {metric} alone gives way, its limit must be {new} instead of {old}"
    failures = failed_counts(summary.training.counts)
    if conflict and failures:
        count = f"{sum(failures.values())} of {summary.training.trials} training trials"
        yield f"{count} fail with the best compromise, whatever the limits are: {list_counts(failures)}"
    ratios = [ratio for metric in conflict if (ratio := worst[metric]) is not None]
    if len(conflict) > 1 and len(ratios) == len(conflict):
        yield f"if all of them give way together, each must by {100.0 * (max(ratios) - 1.0):.2g} % of its limit"


def _continuation_lines(record: Search) -> Iterator[str]:
    """Return the earlier searches, whose gains broke a limit on held-out trials."""
    next_margins = [*(earlier["margins"] for earlier in record.earlier[1:]), record.margins]
    for earlier, margins in zip(record.earlier, next_margins, strict=False):
        for metric, reached in earlier["over"].items():
            yield (
                f"earlier gains reached {_relative_to_limit(metric, reached):.4g} times the limit of {metric} on "
                f"held-out trials (seed {earlier['held_out_seed']}); the search continued with a reserve of "
                f"{100 * margins[metric]:.2g} % instead of {100 * earlier['margins'][metric]:.2g} %"
            )


def _describe_verdict(verdict: Entry, verifications: int) -> str:
    """Return a verdict in words, with its joint confidence after several verifications, each on other trials.

    Each verification accepts gains that miss the requirement with a probability of at most 1 - c, so k verifications do
    with at most 1 - c^k.
    """
    if verifications == 1 or verdict.confidence is None or not verdict.met:
        return str(verdict)
    joint = percent(verdict.confidence**verifications)
    return f"{verdict}, but with a joint confidence of {joint} % after {verifications} verifications on other trials"


def _describe_worst_case(hardest: Row, *, tuned_for: bool) -> str:
    """Return the worst case inside the dispersions in words."""
    where = "in the worst case inside the dispersions"
    if hardest["unbounded"]:
        dispersions = " and ".join(name.replace("_", " ") for name in hardest["moved"]) or "the dispersions"
        failure = {"singular": "reaches a singularity of the law"}.get(hardest["status"], "diverges")
        return (
            f"{where}, over {dispersions}, a trial {failure}: {hardest['metric']} has no bound; require it for a "
            f"fraction of the trials instead, {hardest['metric']} = {{ limit = .., quantile = 0.99 }}"
        )
    ratio_text = "has no value" if hardest["ratio"] is None else f"is {hardest['ratio']:.4g} times its limit"
    advice = ""
    if hardest["breaks_limit"] and not tuned_for:
        advice = ". This check is additional to the requirements; to tune for it, set tune.worst_case = true"
    fixed = [name.replace("_", " ") for name in hardest["coordinates"] if name not in hardest["moved"]]
    return f"{where}, {hardest['metric']} {ratio_text}, with random {' and '.join([*fixed, 'noise'])}{advice}"


def _evolution_comparison(check: Row, record: Search) -> str:
    """Return the comparison of the tuned gains with the result of differential evolution in words."""
    keeps_limits = all(one is not None and one <= 1.0 for one in record.largest_over_limit.values())
    log_ratio = check["distance"]  # difference of the logarithms of the objectives
    difference = (
        f"{math.exp(log_ratio):.3g} times"
        if log_ratio > math.log(2.0)
        else f"{100 * math.expm1(log_ratio):+.2f} % from"
    )
    comparison = {
        (True, True): f"the tuned gains are {difference} that",
        (True, False): "with gains that break a limit; the tuned gains keep every limit",
        (False, True): "with gains that keep every limit; the tuned gains break one",
        (False, False): "with gains that break a limit, as the tuned gains do",
    }[keeps_limits, check["kept"]]
    return (
        f"differential evolution found an objective of {check['value']:.4e} in {check['rollouts']} trials: {comparison}"
    )


def _describe_violation(summary: Tune, metric: str, ratio: float | None) -> str:
    """Return the violation of a limit by the training trials, or the number of these that fail."""
    if ratio is not None and math.isfinite(ratio):
        limit = next(
            (f" of {quantity(v.limit, v.unit, 6, metric)}" for v in summary.verdicts if v.metric == metric), ""
        )
        return f"{metric} reaches {_relative_to_limit(metric, ratio):.3g} times its limit{limit} on the training trials"
    failures = failed_counts(summary.training.counts)
    if not failures:
        return f"a training trial has no {metric}"
    count = sum(failures.values())
    return f"{count} of {summary.training.trials} training trials fail ({list_counts(failures)}) and keep no limit"


def _relative_to_limit(metric: str, violation_ratio: float) -> float:
    """Return the value of a metric relative to its limit from `requirements.violation_ratio`."""
    return 2.0 - violation_ratio if metric in MARGINS and MARGINS[metric].at_least else violation_ratio


def advice_lines(summary: Tune) -> Iterator[str]:
    """Return what to change if the held-out trials break a requirement that the search kept."""
    record = summary.search
    more_trials = f"tune.trials = {4 * record.averaged}"
    for verdict in summary.verdicts:
        search_ratio, held_out_ratio = record.largest_over_limit.get(verdict.metric), _held_out_ratio(verdict)
        kept_in_search = search_ratio is not None and search_ratio <= 1.0
        if verdict.met or not kept_in_search or not verdict.limit:
            continue
        if verdict.metric in MARGINS:
            yield from _loop_advice(verdict)
        elif held_out_ratio is None or not math.isfinite(held_out_ratio):
            yield f"{verdict.metric}: kept in the search, but held-out trials fail: tune with {more_trials}"
        elif held_out_ratio > 1.0:
            stricter = f"requirements.{verdict.metric} = {verdict.limit / (1.02 * held_out_ratio):.3g}"
            yield (
                f"{verdict.metric}: kept in the search, but held-out trials reach {held_out_ratio:.3g} times the "
                f"limit: tune with {more_trials} or {stricter}"
            )
    trained, held_out = (
        one.get("rms_interval") if one else None
        for one in (summary.training.metrics.get("window_error"), summary.held_out.metrics.get("window_error"))
    )
    if trained and held_out and trained[1] < held_out[0]:
        yield f"the gains fit the training trials too closely: tune with {more_trials}"


def _held_out_ratio(verdict: Entry) -> float | None:
    """Return the value on the held-out trials relative to the limit; None without a value."""
    if verdict.fraction_of_time is None:
        return verdict.margin
    return None if verdict.worst is None else verdict.worst / verdict.limit


def _loop_advice(verdict: Entry) -> Iterator[str]:
    """Return what to change if held-out loops break a margin that the loops of the search kept."""
    if verdict.trials == 1:  # the diagnostics report the nominal loop
        return
    broken = f"{verdict.metric}: {verdict.failures} of {verdict.trials} held-out loops break it"
    if verdict.margin is None or verdict.worst is None or verdict.worst == 0.0:
        yield f"{broken}, some without any margin: tune with a larger one, or reduce [dispersion]"
        return
    factor = 1.02 * verdict.margin
    stricter = f"{verdict.limit * factor if verdict.at_least else verdict.limit / factor:.3g}"
    worst = f"{verdict.worst:.3g} {verdict.unit}"
    yield f"{broken}, the worst with {worst}: tune with requirements.{verdict.metric} = {stricter}"


def diagnostic_lines(summary: Tune) -> Iterator[str]:
    """Return the influence of the gains, the margins, and the check of the gradients."""
    trust = summary.trust
    influence = {} if trust is None else trust.influence
    for gain, side in summary.at_bound.items():
        if influence.get(gain) not in ("none", "unknown"):
            yield f"{gain} ended on its {side} bound" + (f": {influence[gain]}" if gain in influence else "")
    for gain, influence_text in influence.items():
        if influence_text == "none":
            yield f"{gain} has no influence: objective and limits change by less than 1 % between its bounds"
    yield from widened_lines(summary.widened_bounds)
    unknown = ", ".join(gain for gain, influence_text in influence.items() if influence_text == "unknown")
    if unknown:
        yield f"the influence of {unknown} is unknown: no training trial reaches its end between the bounds"
    if trust is None:
        return
    gradients = trust.gradient_error
    # a discontinuous sign has no margins to require
    required = gradients is None or any(v.metric in MARGINS for v in summary.verdicts)
    yield from margins_report.tuned_margin_lines(trust.margins, required=required)
    if gradients is None:
        if trust.margins and trust.without_gradients is None:
            yield NO_SIGN
        reason = trust.without_gradients or "the discontinuous sign has no gradients; tune.free may name sign_width"
        yield f"differential evolution found the gains, because {reason}"
        return
    known_errors = {place: value for place, value in gradients.items() if value is not None}
    error_texts = " and ".join(f"{value:.0e} at the {place}" for place, value in known_errors.items())
    if not known_errors:
        yield "the gradients are not checked: the error is zero, no trial reaches its end, or a gradient is not finite"
    elif max(known_errors.values()) <= GRADIENT_TOLERANCE:
        yield f"gradients agree with finite differences to {error_texts}"
    else:
        yield (
            f"gradients differ from finite differences by {error_texts}: the loop chatters or fails there, or the "
            "steps of hardware.torque_step matter; check the result with --global-check"
        )


def _shortest_time_lines(summary: Tune) -> Iterator[str]:
    """Return the shortest t_f that the limit on the torque allows."""
    shortest = summary.shortest_t_f
    # the theory ignores noise: without a simulation that keeps the limit its t_f would contradict the verdict
    if shortest is None or (shortest["simulated"] is None and shortest["theory"] is not None):
        return
    fraction = "" if shortest["quantile"] is None else f" in {100 * shortest['quantile']:g} % of trials"
    limit = f"peak_torque below {shortest['limit']:g} {shortest['unit'] or ''}".rstrip() + fraction
    if shortest["theory"] is None:
        yield f"the tuned gains keep {limit} at no t_f in theory, {THEORY}"
    else:
        yield (
            f"the tuned gains keep {limit} from t_f = {format_number(shortest['simulated'], '.4g')} s on "
            f"({shortest['theory']:.4g} s in theory, {THEORY})"
        )
