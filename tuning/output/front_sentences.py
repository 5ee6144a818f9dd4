"""What the fronts of `ptsmc pareto` say: accuracy against torque, against margins, and against the prescribed time."""

from collections.abc import Iterator

from ptsmc_jax.simulation.catalogues import CATALOGUES, MARGINS
from tuning.output import margin_sentences, sentences
from tuning.output.cells import Summary, Table, digits, valued

HEADS = {
    "gain_margin": "gain margin", "phase_margin": "phase margin", "delay_margin": "delay margin",
    "modulus_margin": "largest |S|",
}  # fmt: skip


def front(summary: Summary) -> Table:
    """Points that no other one beats, and the paper's and the scenario's own gains."""
    from tuning.search.gains import base

    units = CATALOGUES[summary["plant"]]
    points = [("", point) for point in summary["points"] if not point["dominated"]]
    names = list(points[0][1]["gains"]) if points else []
    others = {"paper": summary.get("paper_is", "paper"), "before": "before"}
    points += [(label, summary[name]) for name, label in others.items() if name in summary]
    rows: list[tuple[str, ...]] = []
    for name, point in points:
        gains = [point["gains"].get(gain, point["gains"].get(base(gain))) for gain in names]
        cells = [digits(value, ".4g") for value in gains]
        if summary.get("floor"):
            cells.insert(0, sentences.ratio(sentences.over_floor(point["rms"], summary["floor"])))
        numbers = (digits(point["peak"], ".4g"), digits(point["mean_peak"], ".4g"), digits(point["rms"], ".3e"))
        rows.append((name, *numbers, _spread(point), *cells, _marks(point)))
    torque, beside = units["peak_torque"].unit, ("times the floor",) if summary.get("floor") else ()
    head = f"largest peak [{torque}]", f"mean peak [{torque}]", f"RMS error [{units['window_error'].unit}]", "+-"
    return Table(("", *head, *beside, *_in_units(summary, names), ""), rows)


def _in_units(summary: Summary, names: list[str]) -> list[str]:
    """Headings of columns of gains."""
    from tuning.search.gains import base

    known = summary.get("gain_units", {})  # not yet said in earlier results
    unit_of = {name: known.get(base(name), "-") for name in names}
    return [name if unit == "-" else f"{name} [{unit}]" for name, unit in unit_of.items()]


def _spread(point: Summary) -> str:
    """Half the interval of a point's RMS error, as a share of that error."""
    if not point["interval"]:
        return "-"
    low, high = point["interval"]
    return f"{50 * (high - low) / point['rms']:.1f} %"


def _marks(point: Summary) -> str:
    """What is worth knowing of a point besides its numbers."""
    marks = [word for word in ("knee", "meets") if point.get(word)]
    return ", ".join(marks + ([f"{point['failures']} failed or missed"] if point["failures"] else []))


def front_lines(summary: Summary) -> Iterator[str]:
    """What is left out of a front, and whether anything on it will do."""
    yield from sentences.paper_refused(summary)
    if summary.get("floor"):
        yield f"the floor is {summary['floor']:.2e}: no controller can be more accurate, whatever its torque"
    kept = [point for point in summary["points"] if not point["dominated"]]
    found = len(summary["points"])
    without = summary.get("steps", found) - found
    if without:
        yield f"limits without a point of their own: {without}, which no gains keep, or the same gains as at another"
    lost = found - len(kept)
    if lost:
        yield f"points left out: {lost}, each beaten by another in error and torque by more than its interval"
    if summary["requirements"] and not any(point["meets"] for point in kept):
        yield "no gains on the front meet every requirement"


def front_heading(summary: Summary) -> str:
    """How many points, and on what they were judged."""
    kept = sum(not point["dominated"] for point in summary["points"])
    return f"{kept} points, each judged on {sentences.fresh_trials(summary['trials'])}"


def slew_times(summary: Summary) -> Table:
    """Each prescribed time: the error, what it costs, its gains."""
    units, slews = CATALOGUES[summary["plant"]], summary["slews"]
    costs, names = (list(slews[0][key]) if slews else [] for key in ("costs", "gains"))
    rows: list[tuple[str, ...]] = []
    for slew in slews:
        numbers = (f"{slew['t_f']:g}", digits(slew["rms"], ".3e"), _spread(slew))
        cells = [digits(slew["costs"][name], ".4g") for name in costs] + [f"{slew['gains'][n]:.4g}" for n in names]
        rows.append((*numbers, *cells, _marks(slew)))
    head = [f"{name.replace('_', ' ')} [{units[name].unit}]" for name in costs] + _in_units(summary, names)
    return Table(("t_f [s]", f"RMS error [{units['window_error'].unit}]", "+-", *head, ""), rows)


def slew_times_lines(summary: Summary) -> Iterator[str]:
    """What the fastest slew costs beside the slowest, and which times have no gains."""
    units, slews = CATALOGUES[summary["plant"]], summary["slews"]
    if len(slews) > 1:
        fast, slow = slews[0], slews[-1]
        for name in fast["costs"]:
            one, other = fast["costs"][name], slow["costs"][name]
            if one and other:
                yield (f"{name.replace('_', ' ')}: {one:.4g} {units[name].unit} at t_f = {fast['t_f']:g} s, "
                       f"{one / other:.3g} times that at {slow['t_f']:g} s")  # fmt: skip
        if fast["rms"] and slow["rms"]:
            error = valued(fast["rms"], "window_error", summary["plant"])
            times = sentences.ratio(fast["rms"] / slow["rms"])
            yield f"RMS window error: {error} at t_f = {fast['t_f']:g} s, {times} times that at {slow['t_f']:g} s"
    for t_f in summary["without"]:
        yield f"no gains keep the limits on the training trials at t_f = {t_f:g} s"
    if summary["requirements"] and not any(slew["meets"] for slew in slews):
        yield "at none of these times do gains meet every requirement on the fresh trials"


def slew_times_heading(summary: Summary) -> str:
    """How many times, and on what they were judged."""
    return _tuned_for(summary, "slews", "prescribed time")


def _tuned_for(summary: Summary, points: str, what: str, of: str = "") -> str:
    """How many points of such a name there are, what each is tuned for, and on what they were judged."""
    count = len(summary[points])
    many, each = ("s", "each ") if count != 1 else ("", "")
    return f"gains tuned for {count} {what}{many}{of}, {each}judged on {sentences.fresh_trials(summary['trials'])}"


def robust(summary: Summary) -> Table:
    """Each limit on the largest sensitivity: the error, the torque, the margins that are left."""
    units, floor = CATALOGUES[summary["plant"]], summary["floor"]
    rows: list[tuple[str, ...]] = []
    for one in summary["robust"]:
        over = [sentences.ratio(sentences.over_floor(one["rms"], floor))] if floor else []
        margins = [digits(one["margins"][name], ".3g", "none") for name in MARGINS]
        rows.append((_limit(one), digits(one["rms"], ".3e"), _spread(one), *over, *margins, digits(one["peak"], ".4g"),
                     _marks(one)))  # fmt: skip
    beside = ("times the floor",) if floor else ()
    head = "|S| at most [dB]", f"RMS error [{units['window_error'].unit}]", "+-", *beside
    left = (f"{HEADS[name]} [{margin.unit}]" for name, margin in MARGINS.items())
    return Table((*head, *left, f"largest peak [{units['peak_torque'].unit}]", ""), rows)


def robust_gains(summary: Summary) -> Table:
    """The gains of each of them."""
    names = list(summary["robust"][0]["gains"]) if summary["robust"] else []
    rows = [(_limit(one), *(f"{one['gains'][name]:.4g}" for name in names)) for one in summary["robust"]]
    return Table(("|S| at most [dB]", *_in_units(summary, names)), rows)


def _limit(one: Summary) -> str:
    """A limit on the largest sensitivity, null for none."""
    return digits(one["limit"], "g", "none")


def robust_lines(summary: Summary) -> Iterator[str]:
    """What margins cost beside none, and which limits have no gains of their own."""
    found = summary["robust"]
    loose = next((one for one in found if one["limit"] is None), None)
    if loose is not None and loose["margins"]["gain_margin"] is not None and loose["margins"]["gain_margin"] <= 0.0:
        yield "without a limit on |S| not every loop is stable: the best error lies beyond the border of stability"
    limits = [one for one in found if one["limit"] is not None]
    limited = [one for one in limits if one["rms"] and _keeps(one)]
    if limited and loose is not None and loose["rms"]:
        usual = min(limited, key=lambda one: abs(one["limit"] - margin_sentences.ENOUGH["gain_margin"]))
        error = valued(usual["rms"], "window_error", summary["plant"])
        yield (
            f"with |S| at most {usual['limit']:g} dB the RMS window error is {error}, "
            f"{sentences.ratio(usual['rms'] / loose['rms'])} times that without a limit"
        )
    for one in limits:
        if not _keeps(one):
            yield (
                f"the gains found for |S| at most {one['limit']:g} dB do not keep it on the fresh trials: "
                f"{digits(one['margins']['modulus_margin'], '.3g', 'no value')} dB"
            )
    if summary["idle"]:
        yield f"the gains found for a looser limit keep {_listed(summary['idle'])} dB too"
    if None in summary["without"]:
        yield "no gains found keep the limits on the training trials, whatever margins they leave"
    elif summary["without"]:
        yield f"no gains found keep |S| at most {_listed(summary['without'])} dB on the training trials"
    if summary["requirements"] and not any(one["meets"] for one in found):
        yield "for none of these limits do gains meet every requirement on the fresh trials"


def _keeps(one: Summary) -> bool:
    """Whether the fresh trials' loops keep the limit that gains were found for, within 1 %."""
    left = one["margins"]["modulus_margin"]
    return left is not None and left <= 1.01 * one["limit"]


def _listed(limits: list[float]) -> str:
    *first, last = (f"{limit:g}" for limit in limits)
    return f"{', '.join(first)} and {last}" if first else last


def robust_heading(summary: Summary) -> str:
    """How many limits, and on what they were judged."""
    return _tuned_for(summary, "robust", "limit", " on |S|")
