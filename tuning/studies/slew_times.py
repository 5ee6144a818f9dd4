"""What a faster slew costs: the best gains for each of some prescribed times, judged on fresh trials.

One program flies every time: the shortest and the longest are searched from scratch, and each other one starts from
what its neighbours found, down the ladder of times and up again, as the front against the torque does.
"""

from collections.abc import Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np

from ptsmc_jax.campaigns import montecarlo, store
from ptsmc_jax.figures import study_plots, style
from ptsmc_jax.scenario import cautions, own, parsing, study
from ptsmc_jax.scenario.errors import ScenarioError, wrong
from ptsmc_jax.scenario.tables import Limit, Scenario
from ptsmc_jax.simulation import catalogues
from tuning.search import confirm, gains, trust
from tuning.search.journal import Journal
from tuning.search.objective import T_F
from tuning.search.progress import Report
from tuning.studies import judging, pareto, posing

# what a faster slew may cost: of those metrics that a scenario has, the largest of the fresh trials
COSTS = ("peak_torque", "peak_momentum", "peak_wheel_torque", "peak_wheel_momentum", "peak_rate", "effort")
SPAN = (0.5, 0.7, 1.0, 1.4, 2.0)  # of the scenario's t_f, where no times are given


@dataclass(frozen=True)
class Slew:
    """The best gains for a prescribed time."""

    t_f: float  # [s]
    gains: dict[str, float]
    rms: float  # window error over the fresh trials
    interval: tuple[float, float] | None  # of it
    costs: dict[str, float]  # each metric of `COSTS`: what the share of trials asked for stays below, or all of them
    failures: int  # fresh trials that failed or missed t_f
    meets: bool  # every requirement, on the fresh trials


@dataclass(frozen=True)
class Slews:
    """What was found for each time, the shortest first."""

    slews: list[Slew]
    without: list[float]  # times for which no gains keep the limits [s]
    fresh_seed: int
    trials: int
    rollouts: int
    gradients: int

    @property
    def status(self) -> str:
        """Whether the gains for some time meet every requirement on the fresh trials."""
        return "met" if any(slew.meets for slew in self.slews) else "not met"


def usual_times(scenario: Scenario) -> tuple[float, ...]:
    """Prescribed times from half to twice the scenario's own [s]."""
    return tuple(float(f"{share * scenario.controller.t_f:.3g}") for share in SPAN)


def check(scenario: Scenario, times: Sequence[float]) -> None:
    """Raise ScenarioError where there is nothing to ask, or a time that cannot be flown [s]."""
    against, tune = "to ask what a faster slew costs", scenario.search
    if not scenario.controller.prescribed:
        raise wrong("controller.kind", scenario.controller.kind, f"prescribed_time {against}")
    if tune.objective == T_F:
        raise wrong("tune.objective", T_F, f'"rms", "worst" or "cvar" {against}')
    if T_F in tune.gains:
        raise wrong("tune.free", list(tune.gains), f"without t_f {against}")
    if tune.worst_case:
        raise wrong("tune.worst_case", True, f"false {against}")
    for key in scenario.requirements:
        if key in catalogues.MARGINS:
            raise ScenarioError(
                f"requirements.{key} is asked of one loop, not of several times; allowed is none {against}"
            )
    for t_f in times:
        _at(scenario, t_f)


def _at(scenario: Scenario, t_f: float) -> Scenario:
    """The scenario with another prescribed time [s]."""
    return gains.in_scenario(scenario, {"t_f": t_f})


def trace(
    scenario: Scenario,
    seed: int,
    times: Sequence[float],
    tell: Report = lambda *told: None,
    journal: Journal | None = None,
) -> Slews:
    """The best gains for each of these times [s]. Raises KeyboardInterrupt on Ctrl-C."""
    times = sorted(times)
    base = _at(scenario, times[0])
    table = base.search
    posed = posing.pose(base, seed, journal, t_f=times[-1])
    ladder = [replace(posed.problem, parts=gains.with_gains(posed.problem.parts, {"t_f": t_f})) for t_f in times]
    shares = []
    for k, what, starts in ((-1, "longest", table.starts), (0, "shortest", pareto.FEWER)):

        def told(doing: str, *numbers: Any, what: str = what) -> None:
            tell(f"{what} time: {doing}", *numbers)

        outcome = posed.search(ladder[k], posed.own, starts, judged=False, report=told)
        if outcome.interrupted:
            raise KeyboardInterrupt
        shares.append(outcome.share)
        # the hardest trials that joined are asked for at every time
        ladder = [replace(outcome.problem, parts=one.parts) for one in ladder]
    best = pareto.climbed(ladder, shares, posed, tell)
    fresh_seed, slews, count = judging.seed_of_judge(seed), [], 0
    ready = study(judging.as_flown(base), reach=posing.reach(base, table, t_f=times[-1]))
    for done, k in enumerate(sorted(best)):
        tell("judging on fresh trials", done, len(best), np.nan, 0.0)
        named = posed.named(best[k].share)
        parts = gains.with_gains(ready.parts, {**named, "t_f": times[k]})
        count = judging.trials_of(ready, confirm.fresh_trials(ready.requirements))
        trials = montecarlo.run(parts, ready.dispersion, fresh_seed, np.arange(count))
        tuned = gains.in_scenario(scenario, {**named, "t_f": times[k]})
        costs = {name: judging.largest(name, tuned, trials) for name in _costs(tuned)}
        slews.append(Slew(times[k], dict(named), costs=costs, **judging.figures(tuned, trials, fresh_seed)))
    without = [t_f for k, t_f in enumerate(times) if k not in best]
    return Slews(slews, without, fresh_seed, count, posed.evaluate.rollouts, posed.evaluate.gradients)


def _costs(scenario: Scenario) -> list[str]:
    """Those of `COSTS` that the scenario's runs have."""
    known = scenario.metrics
    tables = {name: known[name].table for name in COSTS if name in known}
    return [name for name, table in tables.items() if table is None or getattr(scenario, table, None) is not None]


def identity(scenario: Scenario, seed: int, times: Sequence[float]) -> dict[str, Any]:
    """What `versions.json` knows a finished or interrupted study by; times in [s]."""
    listed = ",".join(f"{t_f:g}" for t_f in sorted(times))
    return {"command": "pareto", "seed": seed, "against": T_F, "times": listed, **own.digests(scenario)}


def summary(found: Slews, scenario: Scenario) -> dict[str, Any]:
    """What `summary.json` says."""
    return {
        "status": found.status,
        "against": T_F,
        "plant": scenario.plant.kind,
        "requirements": list(scenario.requirements),
        "trials": found.trials,
        "seed": found.fresh_seed,
        "interval_confidence": trust.CONFIDENCE,
        "rollouts": found.rollouts,
        "gradients": found.gradients,
        "slews": [{name: getattr(slew, name) for name in slew.__dataclass_fields__} for slew in found.slews],
        "without": found.without,
        "cautions": cautions.of(scenario),
    }


def write(folder: Path, scenario: Scenario, found: Slews, figures: bool, known_by: dict[str, Any]) -> None:
    """Fill a result folder."""
    store.record(folder, parsing.dump(scenario), known_by, summary(found, scenario))
    names, costs = gains.named(scenario), _costs(scenario)
    header = ["t_f", *names, "rms_window_error", "rms_low", "rms_high", *costs, "failures", "meets"]
    rows = [
        [slew.t_f, *(slew.gains[name] for name in names), slew.rms, *(slew.interval or ("", "")),
         *(slew.costs[name] for name in costs), slew.failures, int(slew.meets)]
        for slew in found.slews
    ]  # fmt: skip
    store.write_csv(folder / "slew_times.csv", header, rows)
    if figures and found.slews:
        entries = catalogues.CATALOGUES[scenario.plant.kind]
        limits = {name: value.limit if isinstance(value, Limit) else float(value)
                  for name, value in scenario.requirements.items() if name in (*costs, "window_error")}  # fmt: skip
        units = {name: entries[name].unit for name in ("window_error", *costs)}
        style.save({"slew_times": study_plots.slew_times(found.slews, units, limits)}, folder / "figures")
