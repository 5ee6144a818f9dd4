"""The result folder of `ptsmc tune`: summary, history, tuned scenario and figures. Read `write` first."""

import itertools
import textwrap
from collections.abc import Callable, Iterable, Mapping, Sequence
from dataclasses import asdict
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np

from ptsmc_jax.campaigns import store
from ptsmc_jax.campaigns.montecarlo import Trials
from ptsmc_jax.scenario import custom, free_gains, parsing, plausibility, requirements
from ptsmc_jax.scenario.tables import LIMITS, T_F, Scenario, objective_name
from ptsmc_jax.simulation import catalogues
from tuning.search import custom_parts, trust
from tuning.search import gains as gain_names
from tuning.search.local_searches import Step
from tuning.studies import front, judging
from tuning.studies.tuner import BeyondBound, Trust, Tuning

if TYPE_CHECKING:
    from matplotlib.figure import Figure

# statistics with a confidence interval
INTERVAL_STATISTICS = {
    "window_error": ("rms", trust.rms),
    "peak_torque": ("mean", np.mean),
    "effort": ("mean", np.mean),
}


def statistics(trials: Trials, kind: str) -> dict[str, Any]:
    """Return counts by status, and statistics of each metric over the trials that reached their end.

    kind: kind of the plant, which defines the metrics.
    """
    results: dict[str, Any] = {"trials": int(trials.status.size), "counts": trials.counts()}
    for name, entry in catalogues.CATALOGUES[kind].items():
        values = getattr(trials.metrics, name)[trials.finished]
        known_values = values[np.isfinite(values)]
        if known_values.size == 0:
            if entry.table is None:  # a metric that needs a table of the scenario is left out, since it may be absent
                results[name] = None
            continue
        results[name] = {
            "mean": known_values.mean(),
            "rms": trust.rms(known_values),
            "median": np.median(known_values),
            "q99": np.quantile(known_values, 0.99),
            "max": known_values.max(),
        }
        if name in catalogues.LARGER_IS_BETTER:  # report the smallest values, which are the worst
            results[name] |= {"q01": np.quantile(known_values, 0.01), "min": known_values.min()}
        if known_values.size < values.size:
            results[name]["without_value"] = int(values.size - known_values.size)
        if name in INTERVAL_STATISTICS:
            label, statistic = INTERVAL_STATISTICS[name]
            results[name][f"{label}_interval"] = trust.interval(known_values, statistic)
    return results


def summary(tuning: Tuning) -> dict[str, object]:
    """Return the content of `summary.json`."""
    kind, search = tuning.tuned.plant.kind, tuning.search
    groups = {
        name: {
            "seed": tuning.held_out_seed,
            "gains": tuning.judged_gains[name],
            "lower_bound": tuning.lower_bounds[name],
            **statistics(trials, kind),
        }
        for name, trials in tuning.held_out.items()
    }
    hardest = None
    if search.hardest is not None:
        hardest = asdict(search.hardest) | {
            "unbounded": search.hardest.unbounded,
            "breaks_limit": search.hardest.breaks_limit,
        }
    return {
        "status": tuning.status,
        "plant": kind,
        "gain_units": gain_names.units_of(tuning.tuned, itertools.chain(*tuning.judged_gains.values())),
        "gains": tuning.gains,
        "at_bound": tuning.at_bound,
        "widened_bounds": tuning.widened_bounds,
        **_accuracy_gain(tuning.held_out),
        "interval_confidence": trust.CONFIDENCE,
        "training": {"seed": tuning.seed, **statistics(tuning.training, kind)},
        "held_out": groups["tuned"],
        **{name: group for name, group in groups.items() if name != "tuned"},
        "published_unavailable": tuning.published_unavailable,
        "published_label": gain_names.published_label(tuning.tuned),
        "shortest_t_f": None if tuning.shortest is None else asdict(tuning.shortest),
        "broken_by": tuning.broken_by,
        "verdicts": [verdict.in_summary() for verdict in tuning.verdicts],
        "judged_on": judging.describe_simulation(tuning.tuned),
        "warnings": plausibility.warnings(tuning.tuned, tuned=True),
        "search": {
            "objective": objective_name(tuning.tuned.search),
            "minimise": tuning.tuned.search.minimise,
            "objective_value": search.value,
            "starts": len({step.start for step in search.history}),
            "history_points": len(search.history),
            "rounds_with_harder_trials": search.rounds,
            "margins": search.margins,
            "earlier": [asdict(earlier) for earlier in tuning.earlier],
            "largest_over_limit": dict(zip(search.problem.rows, search.worst.tolist(), strict=True)),
            "conflict": search.conflict,
            "searched_globally": search.searched_globally,
            "confirmed": [
                {**{k: v for k, v in asdict(one).items() if k != "surplus_violators"}, "confirmed": one.confirmed}
                for one in search.counts
            ],
            "worst_case": tuning.tuned.search.worst_case,
            "hardest": hardest,
            "trials": np.asarray(search.problem.trials).tolist(),
            "averaged": search.problem.averaged,
            "rollouts": tuning.rollouts,
            "gradients": tuning.gradients,
            "seconds": tuning.seconds,
        },
        "trust": None if tuning.trust is None else _trust_entry(tuning.trust, tuning),
        "differential_evolution": None if tuning.check is None else asdict(tuning.check),
    }


def _accuracy_gain(held_out: Mapping[str, Trials]) -> dict[str, object]:
    """Return the ratio of the published gains' RMS window error to the tuned gains' error, and its interval.

    The ratio is over the trials that reach their end with both sets of gains. The result has the keys of
    `summary.json`, with None if there are no such trials.
    """
    both = held_out["tuned"].finished & held_out["published"].finished if "published" in held_out else np.zeros(0, bool)
    if not both.any():
        return {"accuracy_gain_over_published": None, "accuracy_gain_interval": None}
    published, tuned = (np.asarray(held_out[name].metrics.window_error)[both] for name in ("published", "tuned"))
    return {
        "accuracy_gain_over_published": trust.rms(published) / trust.rms(tuned),
        "accuracy_gain_interval": trust.ratio_interval(published, tuned),
    }


def _trust_entry(trust_results: Trust, tuning: Tuning) -> dict[str, object]:
    """Return the entry "trust" of `summary.json`: gradient check, influence of each gain, sensitivities and margins."""
    is_ideal = not tuning.tuned.sampled and tuning.tuned.hardware is None
    influence = {}
    for name, profile in trust_results.profiles.items():
        if not profile.has_value:
            influence[name] = "unknown"
        elif profile.is_flat:
            influence[name] = "none"
        elif name not in tuning.at_bound:
            influence[name] = "optimum inside its bounds"
        elif is_ideal and gain_names.base(name) in ("delta", "observer_gain"):
            influence[name] = "no trade-off: without sampling and noise, values beyond its bound are only better"
        else:
            gain, side = gain_names.base(name), tuning.at_bound[name]
            bound = tuning.tuned.search.bounds[gain][side == "upper"]
            reason = free_gains.reason_of_bound(tuning.tuned, gain, side, bound)
            influence[name] = reason or _influence_beyond(tuning.beyond.get(name), bound)
    errors = trust_results.gradient_error
    return {
        "gradient_error": None if errors is None else dict(zip(("start", "end"), errors, strict=True)),
        "without_gradients": trust_results.without_gradients,
        "influence": influence,
        "sensitivities": trust_results.sensitivities,
        "margins": trust_results.margins,
        "profiles": {name: asdict(profile) for name, profile in trust_results.profiles.items()},
    }


def _influence_beyond(beyond: BeyondBound | None, bound: float) -> str:
    """Return the results beyond a bound in words."""
    if beyond is None:
        return f"values beyond {bound:g} were not simulated"
    if beyond.is_better:
        times = f"{beyond.error_ratio:.3g}"
        return f"{beyond.value:g} beyond it is better, with {times} times the error and every requirement met"
    if beyond.broken is not None:
        return f"{beyond.value:g} beyond it is not better ({beyond.broken})"
    if beyond.error_ratio is None:  # no trial reaches its end with the tuned gains, or their error is zero
        return f"{beyond.value:g} beyond it meets every requirement, but the errors cannot be compared"
    times = f"{beyond.error_ratio:.3g}"
    error = "the same error" if times == "1" else f"{times} times the error"
    return f"{beyond.value:g} beyond it is not better, with {error}"


def write(folder: Path, scenario: Scenario, tuning: Tuning, figures: bool, identity: Mapping[str, object]) -> None:
    """Write a result folder: `summary.json`, `tuned.toml`, `history.csv` and figures.

    Args:
        folder: an empty folder.
        scenario: the scenario before tuning.
        tuning: the results.
        figures: write figures too.
        identity: entries of `versions.json`, from the function `identity`.
    """
    store.write_run_files(folder, parsing.dump(scenario), identity, summary(tuning))
    store.write_toml(folder / "tuned.toml", custom_parts.copy_custom_files(parsing.dump(tuning.tuned), folder))
    rows = [
        [step, point.start, point.stage, point.value, *point.gains, *point.worst]
        for path in _points_by_start(tuning.search.history)
        for step, point in enumerate(path)
    ]
    store.write_csv(folder / "history.csv", history_columns(scenario, tuning.search.problem.rows), rows)
    if figures:
        from ptsmc_jax.figures import style

        style.save(figures_of(scenario, tuning), folder / "figures")


def history_columns(scenario: Scenario, limited: Iterable[str]) -> list[str]:
    """Return the column names of `history.csv`; limited: metrics with a column for the ratio of value to limit."""
    tune = scenario.search
    objective = f"objective_{tune.minimise}" if tune.minimise in (T_F, LIMITS) else f"{tune.statistic}_{tune.minimise}"
    return [
        "step",
        "start",
        "stage",
        objective,
        *gain_names.free_gain_names(scenario),
        *(f"{metric}_over_limit" for metric in limited),
    ]


def _points_by_start(history: Sequence[Step]) -> list[list[Step]]:
    """Return a list of evaluated points for each starting point.

    The history must have the points of a starting point together.
    """
    return [list(path) for _, path in itertools.groupby(history, lambda step: step.start)]


def identity(scenario: Scenario, seed: int, *, with_global_check: bool) -> dict[str, object]:
    """Return the entries of `versions.json` that identify a tuning run.

    Args:
        scenario: the scenario before tuning.
        seed: seed of the search.
        with_global_check: the run includes a global search for comparison.
    """
    return {
        "command": "tune",
        "seed": seed,
        **({"global_check": True} if with_global_check else {}),
        **custom.checksums(scenario),
    }


def figures_of(scenario: Scenario, tuning: Tuning) -> dict[str, "Figure"]:
    """Return the figures of a tuning run by name."""
    from ptsmc_jax.figures import study_plots, style  # slow import, not needed before the search ends

    kind, names = scenario.plant.kind, gain_names.free_gain_names(scenario)
    unit_of = gain_names.units_of(scenario, names)
    units = [unit_of[gain_names.base(name)] for name in names]
    paths = _points_by_start(tuning.search.history)
    longest = max(map(len, paths))

    def over_steps(value: Callable[[Step], Any], missing: float = np.nan) -> np.ndarray:  # result: (steps, starts, ...)
        padding = np.full_like(np.asarray(value(paths[0][0])), missing)
        return np.stack([[value(path[k]) if k < len(path) else padding for path in paths] for k in range(longest)])

    to_unit, objective = style.objective_display(objective_name(scenario.search), scenario.search.minimise, kind)
    objective = "\n[".join(textwrap.fill(part, 24) for part in objective.split(" ["))  # longer than an axis
    gains = over_steps(lambda step: step.gains)
    figures: dict[str, Figure] = {
        "history": study_plots.tuning_history(
            {name: (units[k], gains[:, :, k]) for k, name in enumerate(names)},
            to_unit(over_steps(lambda step: step.value)),
            over_steps(lambda step: np.all(step.worst <= 1.0), missing=False),
            over_steps(lambda step: float(step.stage)),
            objective,
            (float(to_unit(tuning.search.value)), dict(zip(names, map(float, tuning.search.gains), strict=True))),
        ),
    }
    limits = {requirement.metric: requirement.limit for requirement in requirements(scenario)}
    torque = style.torque_metric(limits)
    labels = {**front.LABELS, "published": gain_names.published_label(scenario)}
    finished_results = {
        labels[name]: (
            trials.metrics.window_error[trials.finished], getattr(trials.metrics, torque)[trials.finished]
        )
        for name, trials in tuning.held_out.items()
        if trials.finished.any()
    }  # fmt: skip
    if finished_results:
        figures["tradeoff"] = study_plots.tradeoff(finished_results, limits, kind, tuning.lower_bounds["tuned"])
    if tuning.trust is not None and tuning.trust.sensitivities:  # the table is empty if no trial reaches its end
        figures["sensitivities"] = study_plots.tornado(tuning.trust.sensitivities)
    if tuning.trust is not None:
        figures["profiles"] = study_plots.profiles(
            {
                name: study_plots.Profile(
                    units[k], p.gain, to_unit(p.value), p.violation_ratio, p.nearest, float(tuning.search.gains[k])
                )
                for k, (name, p) in enumerate(tuning.trust.profiles.items())
            },
            objective,
        )
    return figures
