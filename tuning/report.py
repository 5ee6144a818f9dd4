"""What a tuning run hands its user: gains judged on fresh trials beside the paper's and the scenario's own."""

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import jax.numpy as jnp
import msgspec
import numpy as np

from ptsmc_jax import draws, metrics, montecarlo, plotting, schema, store, systems, tables
from ptsmc_jax.montecarlo import Trials
from ptsmc_jax.pace import Reach, reach_of
from ptsmc_jax.requirements import Requirement, Verdict, fewest_trials, least_within
from ptsmc_jax.scenario import Study, replace, study
from ptsmc_jax.tables import Scenario
from tuning import bounds as gain_bounds
from tuning.bounds import Bounds
from tuning.design import ShortestTime, shortest_time
from tuning.objective import Problem
from tuning.optimise import Search, search

FRESH = 1000  # trials on which gains are judged
OBJECTIVES = {"rms": "RMS", "worst": "largest", "cvar": "CVaR of"}  # window error, in words
DIGITS = 6  # of the gains handed over; what is judged is what is handed over


@dataclass(frozen=True)
class Tuning:
    """A finished tuning run."""

    tuned: Scenario
    gains: dict[str, float]
    search: Search
    at_bound: dict[str, str]
    training: Trials  # tuned gains on the training trials as they were trained on
    fresh: dict[str, Trials]  # by whose gains: "tuned", "paper" and, where they differ from it, "before"
    fresh_seed: int
    judged_gains: dict[str, dict[str, float]]  # the gains of each of them
    limits: tuple[str, ...]  # metrics with a requirement, in the order of the search's
    verdicts: list[Verdict]  # of the tuned gains on the fresh trials
    shortest: ShortestTime | None  # t_f that the limit on the torque would allow; None without one

    @property
    def met(self) -> bool:
        """Every requirement met on the fresh trials, and no fresh trial failed."""
        return all(v.met for v in self.verdicts) and bool(np.all(self.fresh["tuned"].ok))


def tune(scenario: Scenario, seed: int, report: Callable[[int, int, float, bool], None]) -> Tuning:
    """Tune the scenario's free gains (`tune` table) and judge them on trials the search never saw."""
    table = scenario.tune
    assert table is not None
    assert table.free is not None  # a checked scenario names them
    limits = Bounds(table.free, *(tuple(table.bounds[name][k] for name in table.free) for k in (0, 1)))
    ready = study(scenario, reach=_reach(scenario, table))
    own = gain_bounds.gains_of(ready.parts)
    trained = _trials(ready, table.trials)
    problem = Problem(
        parts=ready.parts,
        dispersion=ready.dispersion,
        seed=jnp.uint32(seed),
        trials=jnp.arange(trained, dtype=jnp.uint32),
        limits=jnp.asarray([r.limit for r in ready.requirements]),
        averaged=trained,
        names=table.free,
        metrics=tuple(r.metric for r in ready.requirements),
        least=tuple(_least(r, trained) for r in ready.requirements),
        tail=_tail(table, trained),
    )
    start = np.asarray([own[name] for name in table.free])
    found = search(problem, limits, ready.requirements, start, table.starts, table.steps, seed, report)
    gains = {name: _rounded(value) for name, value in zip(table.free, found.gains, strict=True)}
    tuned = with_gains(scenario, gains)
    training = montecarlo.run(
        gain_bounds.with_gains(ready.parts, gains), ready.dispersion, seed, np.asarray(problem.trials)
    )

    fresh_seed = draws.derive(seed, "fresh trials")
    paper = paper_gains(scenario)
    candidates = {"tuned": tuned, "paper": with_gains(scenario, paper)}
    if any(own[name] != paper.get(name, own[name]) for name in own):
        candidates["before"] = scenario
    fresh, judged_gains = {}, {}
    for name, candidate in candidates.items():
        flown = study(as_flown(candidate))
        trials = np.arange(_trials(flown, _fresh_trials(ready.requirements)))
        fresh[name] = montecarlo.run(flown.parts, flown.dispersion, fresh_seed, trials)
        judged_gains[name] = gain_bounds.gains_of(study(candidate).parts)
    verdicts = [
        r.verdict(getattr(fresh["tuned"].metrics, r.metric), fresh["tuned"].finished) for r in ready.requirements
    ]
    at_bound = limits.at_bound(found.gains)
    limit = next((r.limit for r in ready.requirements if r.metric == "peak_torque"), None)
    shortest = None if limit is None else shortest_time(as_flown(tuned), limit, fresh_seed, fresh["tuned"].trial)
    limited = problem.metrics
    return Tuning(tuned, gains, found, at_bound, training, fresh, fresh_seed, judged_gains, limited, verdicts, shortest)


def paper_gains(scenario: Scenario) -> dict[str, float]:
    """The paper's gains for this plant: its Case I, or eta = n + 1 as in Figs. 1 and 2; delta at least a period."""
    shortest = scenario.loop.period if scenario.loop.mode == "sampled" else 0.0
    gains = {"eta": 3.0, "delta": max(0.05, shortest), "k1": 1.0}
    if isinstance(scenario.plant, tables.ChainPlant):
        gains["eta"] = scenario.plant.order + 1.0
    papers = isinstance(scenario.observer, tables.NonlinearObserver | tables.EachNonlinearObserver)
    return {**gains, "observer_gain": 10.0} if papers else gains


def as_flown(scenario: Scenario) -> Scenario:
    """The scenario on the flight clock with the exact sign; a continuous loop, or a tuned sign width, as it is."""
    if scenario.loop.mode != "sampled":
        return scenario
    flown = replace(scenario, loop__clock="flight")
    if scenario.tune is not None and "sign_width" in _free(scenario):
        return flown
    return replace(flown, controller__sign_width=0.0)


def with_gains(scenario: Scenario, gains: dict[str, float]) -> Scenario:
    """The scenario with other gains."""
    changes: dict[str, Any] = {f"controller__{k}": v for k, v in gains.items() if k != "observer_gain"}
    if "observer_gain" in gains:
        axes = len(getattr(scenario.observer, "gain", ()))
        changes["observer__gain"] = [gains["observer_gain"]] * axes
    return replace(scenario, **changes)


def statistics(trials: Trials, kind: str) -> dict[str, Any]:
    """Counts by status and statistics of each metric of this kind of plant over the trials that ended well."""
    summary: dict[str, Any] = {"trials": int(trials.status.size), "counts": trials.counts()}
    for name in metrics.CATALOGUES[kind]:
        values = getattr(trials.metrics, name)[trials.finished]
        known = values[np.isfinite(values)]
        if known.size == 0:
            summary[name] = None
            continue
        summary[name] = {
            "mean": known.mean(),
            "rms": np.sqrt(np.mean(known**2)),
            "median": np.median(known),
            "q99": np.quantile(known, 0.99),
            "max": known.max(),
        }
        if known.size < values.size:
            summary[name]["without_value"] = int(values.size - known.size)
    return summary


def summary(tuning: Tuning, seed: int) -> dict[str, Any]:
    """What `summary.json` says."""
    kind = tuning.tuned.plant.kind
    groups = {
        name: {"gains": tuning.judged_gains[name], **statistics(trials, kind)} for name, trials in tuning.fresh.items()
    }
    tuned, paper = (groups[name]["window_error"] for name in ("tuned", "paper"))
    return {
        "status": "met" if tuning.met else "not met",
        "plant": tuning.tuned.plant.kind,
        "gains": tuning.gains,
        "at_bound": tuning.at_bound,
        "accuracy_gain_over_paper": paper["rms"] / tuned["rms"] if tuned and paper else None,
        "training": {"seed": seed, **statistics(tuning.training, kind)},
        "fresh": {"seed": tuning.fresh_seed, **groups["tuned"]},
        "paper": {"seed": tuning.fresh_seed, **groups["paper"]},
        **({"before": {"seed": tuning.fresh_seed, **groups["before"]}} if "before" in groups else {}),
        "shortest_t_f": None if tuning.shortest is None else msgspec.to_builtins(tuning.shortest),
        "verdicts": [{**msgspec.to_builtins(v), "met": v.met} for v in tuning.verdicts],
        "judged_on": "flight clock, exact sign" if tuning.tuned.loop.mode == "sampled" else "the continuous loop",
        "search": {
            "objective": _objective(tuning.tuned),
            "starts": int(tuning.search.history[0].rms.size),
            "steps": len(tuning.search.history) - 1,
            "rounds_with_harder_trials": tuning.search.rounds,
            "dropped_starts": tuning.search.dropped,
            "largest_over_limit": dict(zip(tuning.limits, tuning.search.worst.tolist(), strict=True)),
            "slopes_off_central_differences": dict(zip(("start", "end"), tuning.search.slope_error, strict=True)),
            "trials": tuning.search.trials.tolist(),
        },
    }


def write(folder: Path, scenario: Scenario, tuning: Tuning, seed: int, figures: bool) -> None:
    """Fill a result folder."""
    names, source = _free(scenario), systems.source(getattr(scenario.plant, "system", None))
    store.write_toml(folder / "scenario.toml", schema.dump(scenario))
    store.write_toml(folder / "tuned.toml", schema.dump(tuning.tuned))
    store.write_json(folder / "versions.json", store.versions("tune", seed, **source))
    store.write_json(folder / "summary.json", summary(tuning, seed))
    over = [f"{m}_over_limit" for m in scenario.requirements]
    rows = [
        [step, start, row.rms[start], *row.gains[start], *row.worst[start]]
        for step, row in enumerate(tuning.search.history)
        for start in range(row.rms.size)
    ]
    store.write_csv(
        folder / "history.csv", ["step", "start", f"{_objective(scenario)}_window_error", *names, *over], rows
    )
    if figures:
        plotting.save(_figures(scenario, tuning), folder / "figures")


def _figures(scenario: Scenario, tuning: Tuning) -> dict[str, Any]:
    names, first = _free(scenario), tuning.search.history[0].rms.size
    history = [step for step in tuning.search.history if step.rms.size == first]
    limit = next((v.limit for v in tuning.verdicts if v.metric == "peak_torque"), None)
    return {
        "history": plotting.tuning_history(
            names,
            [gain_bounds.UNITS[scenario.plant.kind][name] for name in names],
            np.stack([step.gains for step in history]),
            np.stack([step.rms for step in history]),
            np.stack([np.all(step.worst <= 1.0, axis=1) for step in history]),
            OBJECTIVES[_objective(scenario)],
        ),
        "tradeoff": plotting.tradeoff(
            {
                name: (trials.metrics.window_error[trials.finished], trials.metrics.peak_torque[trials.finished])
                for name, trials in tuning.fresh.items()
            },
            limit,
            scenario.plant.kind,
        ),
    }


def _free(scenario: Scenario) -> tuple[str, ...]:
    assert scenario.tune is not None
    assert scenario.tune.free is not None  # a checked scenario names them
    return scenario.tune.free


def _objective(scenario: Scenario) -> str:
    assert scenario.tune is not None
    return scenario.tune.objective


def _reach(scenario: Scenario, table: tables.Tune) -> Reach:
    own = reach_of(scenario)

    def interval(name: str, value: float) -> tuple[float, float]:
        lower, upper = table.bounds.get(name, (value, value))
        return min(lower, value), max(upper, value)

    smallest_delta, delta = interval("delta", own.delta)
    return Reach(
        t_f=own.t_f,
        delta=delta,
        smallest_delta=smallest_delta,
        gain=interval("observer_gain", own.gain)[0],
        largest_gain=interval("observer_gain", own.largest_gain)[1],
        k1=interval("k1", own.k1)[1],
        sign_width=interval("sign_width", own.sign_width)[0],
    )


def _least(requirement: Requirement, trials: int) -> int | None:
    """How many training trials must keep a limit: too few to show a quantile, all of them."""
    if requirement.quantile is None:
        return None
    return least_within(trials, requirement.quantile, requirement.confidence) or trials


def _tail(table: tables.Tune, trials: int) -> int | None:
    """How many of the worst training trials are averaged."""
    if table.objective == "rms":
        return None
    assert table.level is not None or table.objective == "worst"
    return 1 if table.level is None else max(1, round((1.0 - table.level) * trials))


def _fresh_trials(requirements: Sequence[Requirement]) -> int:
    """Fresh trials: enough to show every quantile that is asked for, with some beyond the limit."""
    needed = [fewest_trials(r.quantile, r.confidence) for r in requirements if r.quantile and r.confidence]
    return max([FRESH, *(2 * count for count in needed)])


def _trials(ready: Study, wanted: int) -> int:
    """How many trials differ at all: one where nothing is drawn."""
    return wanted if ready.drawn else 1


def _rounded(value: float) -> float:
    return float(f"{value:.{DIGITS}g}")
