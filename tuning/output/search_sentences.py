"""What the `summary.json` of a tuning run says of its search, in sentences."""

import math
from collections.abc import Iterator

from ptsmc_jax.simulation.catalogues import MARGINS, NO_SIGN, percent
from tuning.output import margin_sentences
from tuning.output.cells import Summary, lost

AGREE = 0.01  # slopes off from differences by more than this share say little


def search(summary: Summary) -> Iterator[str]:
    """How the search went."""
    record = summary["search"]
    over = {metric: r for metric, r in record.get("largest_over_limit", {}).items() if r is None or r > 1.0}
    if over:
        globally = ", nor did a global search" if record.get("searched_globally") else ""
        yield f"the search found no gains that meet every requirement{globally}"
    # once of trials that do not arrive, which keep no limit
    for how_far in dict.fromkeys(_how_far(summary, metric, ratio) for metric, ratio in over.items()):
        yield f"with the best compromise {how_far}"
    yield from _conflict(summary)
    yield from _went_on(record)
    for count in record.get("confirmed", []):
        most = "none would have to be" if count["allowed"] is None else f"at most {count['allowed']} allowed"
        yield (
            f"{count['metric']} {'confirmed' if count['held'] else 'NOT confirmed'} on {count['trials']} trials that "
            f"the search did not see: {count['beyond']} beyond the limit, {most}; the verdict on fresh trials is met "
            f"with a probability of {percent(count['probability'])} %"
        )
    if record.get("hardest") is not None:
        yield _worst_case(record["hardest"], tuned_for=record.get("worst_case", False))
    if "rollouts" in record:
        steps = record.get("seconds_by_step", {}).items()
        yield (
            f"the search flew {record['rollouts']} trials without and {record['gradients']} with gradients in "
            f"{record['seconds']:.0f} s" + "".join(f", {what} {spent:.0f} s" for what, spent in steps if spent >= 1.0)
        )
    if summary.get("differential_evolution") is not None:
        yield _beside_evolution(summary["differential_evolution"], record)


def _conflict(summary: Summary) -> Iterator[str]:
    """Which requirements conflict, and by how much each of them would have to give way."""
    conflict, worst = summary["search"].get("conflict") or {}, summary["search"]["largest_over_limit"]
    verdicts = {one["metric"]: one for one in summary["verdicts"]}
    if len(conflict) > 1:
        yield f"{' and '.join(conflict)} conflict: the gains that improve one of them worsen another"
    for metric, alone in conflict.items():
        one = verdicts.get(metric)
        if one is None or alone is None:
            yield f"no value of {metric} alone resolves the conflict: the other requirements cannot be met either"
            continue
        needed = one["limit"] * (2.0 - alone if one.get("at_least") else alone)
        if alone <= 1.0:
            yield f"{metric} can be met, but only if another requirement gives way"
        elif one.get("at_least") and needed <= 0.0:
            yield f"{metric} alone cannot give way far enough: the loop would be unstable"
        else:
            unit = "" if one["unit"] == "-" else f" {one['unit']}"
            instead = f"{needed:.3g}{unit} instead of {one['limit']:g}"
            yield f"if {metric} alone gives way, its limit must be {instead}"
    ratios = [worst[metric] for metric in conflict]
    if len(conflict) > 1 and all(ratios):
        yield f"if all of them give way together, each must by {100.0 * (max(ratios) - 1.0):.2g} % of its limit"


def _went_on(record: Summary) -> Iterator[str]:
    """That gains broke a limit on fresh trials, and the search went on."""
    earlier = record.get("earlier", [])
    next_margins = [*(search["margins"] for search in earlier[1:]), record.get("margins", {})]
    for search, margins in zip(earlier, next_margins, strict=False):
        kept = " and ".join(
            f"{100 * margins[metric]:.2g} % instead of {100 * search['margins'][metric]:.2g} % of the limit of {metric}"
            for metric in search["over"]
        )
        over = " and ".join(
            f"{_of_limit(metric, ratio):.4g} times the limit of {metric}" for metric, ratio in search["over"].items()
        )
        yield (
            f"gains that kept every limit in the search reached {over} on fresh trials (seed {search['fresh_seed']}): "
            f"the search continued from them with {kept} in reserve; its result is verified on other trials"
        )


def _worst_case(hardest: Summary, *, tuned_for: bool) -> str:
    """How far the worst case inside the dispersions goes; tuned_for: whether the search tuned for it."""
    if hardest["unbounded"]:
        moved = " and ".join(name.replace("_", " ") for name in hardest["moved"]) or "what is drawn"
        reach = {"singular": "reaches a singularity of the law"}.get(hardest["status"], "makes the loop diverge")
        return (
            f"the worst case of {hardest['metric']} inside the dispersions has no bound: over {moved} some trial "
            f"{reach}; ask for a share of the trials instead, {hardest['metric']} = {{ limit = .., quantile = 0.99 }}"
        )
    far = "without a value" if hardest["ratio"] is None else f"{hardest['ratio']:.4g} times its limit"
    advice = "" if tuned_for or not hardest["beyond"] else "; tune.worst_case = true tunes for it"
    return f"in the worst case inside the dispersions, {hardest['metric']} is {far}{advice}"


def _beside_evolution(check: Summary, record: Summary) -> str:
    """What differential evolution found, beside the search."""
    search_keeps = all(ratio is not None and ratio <= 1.0 for ratio in record["largest_over_limit"].values())
    far = check["distance"]  # of logarithms: a share only where it is small
    off = f"{math.exp(far):.3g} times that" if far > math.log(2.0) else f"{100 * math.expm1(far):+.2f} % off that"
    beside = {
        (True, True): f"and the goal of the tuned gains is {off}",
        (True, False): "with gains that break a limit, which the tuned gains keep",
        (False, True): "with gains that keep every limit, unlike the tuned ones",
        (False, False): "with gains that do not keep every limit, as the tuned ones do not",
    }[search_keeps, check["kept"]]
    return (
        f"differential evolution, a global search with {check['rollouts']} rollouts, found {check['value']:.4e}, "
        f"{beside}"
    )


def _how_far(summary: Summary, metric: str, ratio: float | None) -> str:
    """How far the training trials are beyond a limit, or how many of them do not arrive, in words."""
    if ratio is not None and math.isfinite(ratio):
        limit = next((f", {v['limit']:g} {v['unit']}," for v in summary["verdicts"] if v["metric"] == metric), "")
        return f"{metric} reaches {_of_limit(metric, ratio):.3g} times its limit{limit} on the training trials"
    training = summary.get("training", {})
    bad, ended = lost(training.get("counts", {}))
    if not bad:
        return f"a training trial has no {metric}"
    return f"{bad} of {training['trials']} training trials do not arrive ({ended}), and so keep no limit"


def _of_limit(metric: str, over: float) -> float:
    """A metric's value as a share of its limit, from how near it comes, see `requirements.over`."""
    return 2.0 - over if metric in MARGINS and MARGINS[metric].at_least else over


def advice(summary: Summary) -> Iterator[str]:
    """What to change where fresh trials break a requirement that the search kept, or are less accurate than its own."""
    record = summary["search"]
    larger = f"tune.trials = {4 * record.get('averaged', 256)}"
    for verdict in summary["verdicts"]:
        searched, over = record["largest_over_limit"].get(verdict["metric"]), _reached(verdict)
        kept_in_search = searched is not None and searched <= 1.0
        if verdict["met"] or not kept_in_search or not verdict["limit"]:
            continue
        if verdict["metric"] in MARGINS:
            yield from _of_loops(verdict)
        elif over is None or not math.isfinite(over):
            yield f"{verdict['metric']}: kept in the search, but fresh trials fail or lack it: tune with {larger}"
        elif over > 1.0:
            limit = f"{verdict['limit'] / (1.02 * over):.3g}"
            yield (
                f"{verdict['metric']}: kept in the search, but fresh trials reach {over:.3g} times the limit: tune "
                f"with {larger}, or with requirements.{verdict['metric']} = {limit}, by which these gains would keep it"
            )
    trained, fresh = ((summary[on]["window_error"] or {}).get("rms_interval") for on in ("training", "fresh"))
    if trained and fresh and trained[1] < fresh[0]:
        yield (
            "fresh trials are less accurate than training ones by more than chance explains: the gains fit those too "
            f"closely; tune with {larger}"
        )


def _reached(verdict: Summary) -> float | None:
    """How many times its limit fresh trials reach: what is asked for a share of the time is searched for as a limit."""
    if verdict.get("share_of_time") is None:
        return verdict["margin"]
    return None if verdict["worst"] is None else verdict["worst"] / verdict["limit"]


def _of_loops(verdict: Summary) -> Iterator[str]:
    """What to change where a margin is kept by the loops that a search looked at, and not by all that are judged."""
    name, worst, limit, over = (verdict[key] for key in ("metric", "worst", "limit", "margin"))
    if verdict["trials"] == 1:  # it is said of the tuned gains why
        return
    many = f"{verdict['failures']} of {verdict['trials']}"
    broken = f"{name}: kept by the loops that the search looked at, but {many} fresh ones break it"
    if over is None or not math.isfinite(over) or worst == 0.0:
        yield f"{broken}, some with none left: tune with a stricter requirements.{name}, or draw less in [dispersion]"
        return
    farther = 1.02 * over
    stricter = f"{limit * farther if verdict['at_least'] else limit / farther:.3g}"
    yield f"{broken}, the worst with {worst:.3g} {verdict['unit']}: tune with requirements.{name} = {stricter}"


def trust(summary: Summary) -> Iterator[str]:
    """What the gains do, and whether the slopes are right."""
    record = summary.get("trust")
    influence = {} if record is None else record["influence"]
    for gain, side in summary["at_bound"].items():
        if influence.get(gain) in ("none", "unknown"):
            continue
        yield f"{gain} ended on its {side} bound" + (f": {influence[gain]}" if gain in influence else "")
    for gain, how in influence.items():
        if how == "none":
            yield f"{gain} has no influence: goal and limits change by less than 1 % between its bounds"
    unknown = ", ".join(gain for gain, how in influence.items() if how == "unknown")
    if unknown:
        yield f"what {unknown} does is unknown: no training trial ends, wherever between the bounds"
    if record is None:
        return
    # where no gain is flown with the exact sign, whose loop has no margins to ask for
    asked = record["slopes_off_central_differences"] is None or any(v["metric"] in MARGINS for v in summary["verdicts"])
    yield from margin_sentences.tuned(record.get("margins"), asked=asked)
    if record["slopes_off_central_differences"] is None:
        if record.get("margins"):
            yield NO_SIGN
        yield (
            "the gains were found by evolution, since the exact sign has no slopes to go by; with sign_width free, its "
            "width is a gain too"
        )
        return
    off = {place: value for place, value in record["slopes_off_central_differences"].items() if value is not None}
    shown = " and ".join(f"{value:.0e} at the {place}" for place, value in off.items())
    if not off:
        yield (
            "slopes by automatic differentiation are not checked: differences of the goal's logarithm are no numbers, "
            "as where the error is zero or no trial ends"
        )
    elif max(off.values(), default=0.0) <= AGREE:
        yield f"slopes by automatic differentiation agree with differences to {shown}"
    else:
        yield (
            f"slopes by automatic differentiation are off from differences by {shown}: the loop chatters or breaks off "
            "there, or the steps of hardware.torque_step, which slopes leave out, are felt; the descent had little to "
            "go by: trust the global check (--global-check) instead"
        )


def shortest(summary: Summary) -> Iterator[str]:
    """The t_f that the limit on the torque would allow."""
    from tuning.search import design

    times = summary.get("shortest_t_f")
    # the theory knows no noise: without a simulation that keeps the limit its t_f would contradict the verdict
    if times is not None and (times["simulated"] is not None or times["theory"] is None):
        yield str(design.ShortestTime(**times))
