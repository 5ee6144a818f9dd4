"""What the `summary.json` of a tuning run says of its search, in sentences."""

import math
from collections.abc import Iterator

from tuning.output import margin_sentences
from tuning.output.cells import Summary

AGREE = 0.01  # slopes off from differences by more than this share say little


def search(summary: Summary) -> Iterator[str]:
    """How the search went."""
    record = summary["search"]
    for metric, ratio in record.get("largest_over_limit", {}).items():
        if ratio is None or ratio > 1.0:
            far = _far(summary, metric, ratio)
            yield f"no gains found within the bounds keep every limit: with the best ones {far}"
    yield from _went_on(record)
    for one in record.get("confirmed", []):
        most = "none would have to be" if one["allowed"] is None else f"at most {one['allowed']} allowed"
        yield (
            f"{one['metric']} {'confirmed' if one['held'] else 'NOT confirmed'} on {one['trials']} trials that the "
            f"search did not see: {one['beyond']} beyond the limit, {most}; the verdict on fresh trials is met with a "
            f"probability of {100 * one['probability']:.3g} %"
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
        yield _globally(summary["differential_evolution"], record)


def _went_on(record: Summary) -> Iterator[str]:
    """That gains broke a limit on fresh trials, and the search went on."""
    earlier = record.get("earlier", [])
    margins = [*(one["margin"] for one in earlier[1:]), record.get("margin", 0.0)]
    for one, margin in zip(earlier, margins, strict=False):
        reached = " and ".join(f"{ratio:.4g} times the limit of {metric}" for metric, ratio in one["over"].items())
        yield (
            f"gains that kept every limit in the search reached {reached} on fresh trials (seed {one['fresh_seed']}): "
            f"the search went on from them with {100 * margin:.2g} % kept from every limit instead of "
            f"{100 * one['margin']:.2g} %, and what it found is judged on other trials"
        )


def _worst_case(hardest: Summary, *, tuned_for: bool) -> str:
    """How far the worst case inside the dispersions goes."""
    if hardest["unbounded"]:
        moved = " and ".join(name.replace("_", " ") for name in hardest["moved"]) or "what is drawn"
        reach = {"singular": "reaches a singularity of the law"}.get(hardest["status"], "makes the loop diverge")
        return (
            f"the worst case of {hardest['metric']} inside the dispersions has no bound: over {moved} some trial "
            f"{reach}; ask for a share of the trials instead, {hardest['metric']} = {{ limit = .., quantile = 0.99 }}"
        )
    far = "without a value" if hardest["ratio"] is None else f"{hardest['ratio']:.3f} times its limit"
    advice = "" if tuned_for or not hardest["beyond"] else "; tune.worst_case = true tunes for it"
    return f"in the worst case inside the dispersions, {hardest['metric']} is {far}{advice}"


def _globally(checked: Summary, record: Summary) -> str:
    """What differential evolution found, beside the search."""
    kept = all(ratio is not None and ratio <= 1.0 for ratio in record["largest_over_limit"].values())
    beside = {
        (True, True): f"and the goal of the tuned gains is {100 * checked['distance']:+.2f} % off that",
        (True, False): "with gains that break a limit, which the tuned gains keep",
        (False, True): "with gains that keep every limit, unlike the tuned ones",
        (False, False): "with gains that do not keep every limit, as the tuned ones do not",
    }[kept, checked["kept"]]
    return (
        f"differential evolution, a global search with {checked['rollouts']} rollouts, found {checked['value']:.4e}, "
        f"{beside}"
    )


def _far(summary: Summary, metric: str, ratio: float | None) -> str:
    """How far the training trials are beyond a limit, or how many of them do not arrive, in words."""
    if ratio is not None and math.isfinite(ratio):
        limit = next((f", {v['limit']:g} {v['unit']}," for v in summary["verdicts"] if v["metric"] == metric), "")
        return f"{metric} reaches {ratio:.3g} times its limit{limit} on the training trials"
    training = summary.get("training", {})
    lost = {status: n for status, n in training.get("counts", {}).items() if n and status != "ok"}
    if not lost:
        return f"a training trial has no {metric}"
    ended = ", ".join(f"{n} {status}" for status, n in lost.items())
    return f"{sum(lost.values())} of {training['trials']} training trials do not arrive ({ended}), and so keep no limit"


def advice(summary: Summary) -> Iterator[str]:
    """What to change where fresh trials break a requirement that the search kept."""
    record = summary["search"]
    kept = {metric for metric, ratio in record["largest_over_limit"].items() if ratio is not None and ratio <= 1.0}
    for verdict in summary["verdicts"]:
        over = verdict["margin"]
        if verdict["met"] or verdict["metric"] not in kept or verdict.get("at_least") or not verdict["limit"]:
            continue
        larger = f"tune.trials = {4 * record.get('averaged', 256)}"
        if over is None or not math.isfinite(over):
            yield f"{verdict['metric']}: kept in the search, but fresh trials fail or lack it: tune with {larger}"
        else:
            limit = f"{verdict['limit'] / (1.02 * over):.3g}"
            yield (
                f"{verdict['metric']}: kept in the search, but fresh trials reach {over:.3g} times the limit: tune "
                f"with {larger}, or with requirements.{verdict['metric']} = {limit}, by which these gains would keep it"
            )


def trust(summary: Summary) -> Iterator[str]:
    """What the gains do, and whether the slopes are right."""
    believed = summary.get("trust")
    influence = {} if believed is None else believed["influence"]
    for gain, side in summary["at_bound"].items():
        if influence.get(gain) == "none":
            continue
        yield f"{gain} ended on its {side} bound" + (f": {influence[gain]}" if gain in influence else "")
    for gain, how in influence.items():
        if how == "none":
            yield f"{gain} has no influence: goal and limits change by less than 1 % between its bounds"
    if believed is None:
        return
    yield from margin_sentences.tuned(believed.get("margins"))
    if believed["slopes_off_central_differences"] is None:
        yield (
            "the gains were found by evolution, since the exact sign has no slopes to go by; with sign_width free, its "
            "width is a gain too"
        )
        return
    off = {place: value for place, value in believed["slopes_off_central_differences"].items() if value is not None}
    shown = " and ".join(f"{value:.0e} at the {place}" for place, value in off.items())
    if max(off.values(), default=0.0) <= AGREE:
        yield f"slopes by automatic differentiation agree with differences to {shown}"
    else:
        yield (
            f"slopes by automatic differentiation are off from differences by {shown}: the loop chatters or breaks off "
            "there, and the descent had little to go by; trust the global check (--global-check) instead"
        )


def shortest(summary: Summary) -> Iterator[str]:
    """The t_f that the limit on the torque would allow."""
    from tuning.search import design

    times = summary.get("shortest_t_f")
    if times is not None:
        yield design.text(times["limit"], times["theory"], times["simulated"])


def along_the_front(summary: Summary) -> Iterator[str]:
    """What the least torque, the most, and the knee give."""
    kept = sorted((p for p in summary["points"] if not p["dominated"] and p["rms"]), key=lambda p: p["peak"])
    if len(kept) > 1:
        ends = (f"{p['rms']:.3g} at {p['peak']:.3g}" for p in (kept[0], kept[-1]))
        knee = next((f"; the knee is {p['rms']:.3g} at {p['peak']:.3g}" for p in kept if p["knee"]), "")
        yield f"from an RMS window error of {' to '.join(ends)} of largest peak torque{knee}"


def fastest(summary: Summary) -> Iterator[str]:
    """The shortest of the prescribed times whose gains meet every requirement."""
    found = min((slew for slew in summary["slews"] if slew["meets"]), key=lambda slew: slew["t_f"], default=None)
    if found is not None and summary["requirements"]:
        yield f"the shortest of them is t_f = {found['t_f']:g} s, with an RMS window error of {found['rms']:.3g}"
