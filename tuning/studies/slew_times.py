"""What a faster slew costs: the best gains for each of some prescribed times, judged on fresh trials.

One program flies every time: each is searched from scratch, since the gains found for others may lie in another valley
than its best ones, and then starts from what its neighbours found, down the ladder of times and up again, as the front
against the torque does.
"""

from collections.abc import Sequence
from dataclasses import asdict, dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np
from matplotlib.figure import Figure

from ptsmc_jax import scenario as scenarios
from ptsmc_jax.campaigns import montecarlo, store
from ptsmc_jax.figures import study_plots, style
from ptsmc_jax.scenario import cautions, free_gains, own, parsing, study, tables
from ptsmc_jax.scenario.errors import ScenarioError, wrong
from ptsmc_jax.scenario.tables import Scenario
from ptsmc_jax.simulation import catalogues
from tuning.search import gains, trust
from tuning.search.journal import Journal
from tuning.search.objective import T_F
from tuning.search.progress import Report, headed
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
    against = "to ask what a faster slew costs"
    if not scenario.controller.prescribed:
        raise wrong("controller.kind", scenario.controller.kind, f"prescribed_time {against}")
    pareto.check_search(scenario, against)
    if T_F in scenario.search.gains:
        raise wrong("tune.free", list(scenario.search.gains), f"without t_f {against}")
    if free_gains.observer_follows(scenario):
        raise ScenarioError(f"observer.t_o is absent and would follow t_f; allowed is one that is given {against}")
    for key in scenario.requirements:
        if key in catalogues.MARGINS:
            raise ScenarioError(
                f"requirements.{key} is asked of one loop, not of several times; allowed is none {against}"
            )
    for t_f in times:
        _at(scenario, t_f)


def _at(scenario: Scenario, t_f: float) -> Scenario:
    """The scenario with another prescribed time [s], below which the usual bounds of delta lie anew."""
    tune = scenario.search
    own_bounds = {name: both for name, both in tune.bounds.items() if name != "delta"}
    if tune.bounds.get("delta") not in (None, free_gains.by_default(scenario, "delta")):
        own_bounds["delta"] = tune.bounds["delta"]
    at = gains.in_scenario(scenarios.replace(scenario, tune=None), {"t_f": t_f})
    return scenarios.replace(at, tune={**parsing.plain(tune), "bounds": own_bounds})


def trace(
    scenario: Scenario,
    seed: int,
    times: Sequence[float],
    tell: Report = lambda *_: None,
    journal: Journal | None = None,
) -> Slews:
    """The best gains for each of these times [s]. Raises KeyboardInterrupt on Ctrl-C."""
    times = sorted(times)
    base = _at(scenario, times[0])
    posed = posing.pose(base, seed, journal, t_f=times[-1])
    ladder = [replace(posed.problem, parts=gains.with_gains(posed.problem.parts, {"t_f": t_f})) for t_f in times]
    shares = []
    for k, heading, starts in ((-1, "longest time", base.search.starts), (0, "shortest time", pareto.FEWER)):
        report = headed(tell, heading)
        outcome = pareto.uninterrupted(posed.search(ladder[k], posed.own, starts, judged=False, report=report))
        shares.append(outcome.share)
        # the hardest trials that joined are asked for at every time
        ladder = [replace(outcome.problem, parts=one.parts) for one in ladder]
    for k in range(len(times) - 2, 0, -1):
        report = headed(tell, f"{times[k]:g} s")
        outcome = posed.search(ladder[k], posed.own, pareto.FEWER, (), judged=False, report=report)
        shares.append(pareto.uninterrupted(outcome).share)
    rungs = [(f"{t_f:g} s", problem) for t_f, problem in zip(times, ladder, strict=True)]
    best = pareto.climbed(rungs, shares, posed, tell)
    fresh_seed, slews = judging.seed_of_judge(seed), []
    ready = study(judging.as_flown(base), reach=posing.reach(base, base.search, t_f=times[-1]))
    count = judging.fresh_trials(ready) if best else 0
    for done, k in enumerate(sorted(best)):
        tell("judging on fresh trials", done, len(best), np.nan, 0.0)
        named = posed.named(best[k].share)
        with_time = {**named, "t_f": times[k]}
        parts = gains.with_gains(ready.parts, with_time)
        trials = montecarlo.run(parts, ready.dispersion, fresh_seed, np.arange(count))
        tuned = gains.in_scenario(_at(scenario, times[k]), named)  # whose bounds are those of that time
        costs = {name: judging.largest(name, tuned, trials) for name in _costs(tuned)}
        slews.append(Slew(times[k], named, costs=costs, **judging.figures(tuned, trials, fresh_seed)))
    without = [t_f for k, t_f in enumerate(times) if k not in best]
    return Slews(slews, without, fresh_seed, count, posed.evaluate.rollouts, posed.evaluate.gradients)


def _costs(scenario: Scenario) -> list[str]:
    """Those of `COSTS` that the scenario's runs have."""
    known = scenario.metrics
    tables = {name: known[name].table for name in COSTS if name in known}
    return [name for name, table in tables.items() if table is None or getattr(scenario, table, None) is not None]


def identity(scenario: Scenario, seed: int, times: Sequence[float]) -> dict[str, Any]:
    """What `versions.json` knows a finished or interrupted study by; times in [s]."""
    listed = ",".join(str(float(t_f)).removesuffix(".0") for t_f in sorted(times))  # every digit
    return {"command": "pareto", "seed": seed, "against": T_F, "times": listed, **own.digests(scenario)}


def summary(traced: Slews, scenario: Scenario) -> dict[str, Any]:
    """What `summary.json` says."""
    return {
        "status": traced.status,
        "against": T_F,
        "plant": scenario.plant.kind,
        "requirements": list(scenario.requirements),
        "trials": traced.trials,
        "seed": traced.fresh_seed,
        "interval_confidence": trust.CONFIDENCE,
        "rollouts": traced.rollouts,
        "gradients": traced.gradients,
        "gain_units": gains.units_of(scenario),
        "slews": [asdict(slew) for slew in traced.slews],
        "without": traced.without,
        "cautions": cautions.of(scenario),
    }


def write(folder: Path, scenario: Scenario, traced: Slews, figures: bool, known_by: dict[str, Any]) -> None:
    """Fill a result folder."""
    store.record(folder, parsing.dump(scenario), known_by, summary(traced, scenario))
    names, costs = gains.named(scenario), _costs(scenario)
    header = ["t_f", *names, "rms_window_error", "rms_low", "rms_high", *costs, "failures", "meets"]
    rows = [
        [slew.t_f, *(slew.gains[name] for name in names), slew.rms, *(slew.interval or ("", "")),
         *(slew.costs[name] for name in costs), slew.failures, int(slew.meets)]
        for slew in traced.slews
    ]  # fmt: skip
    store.write_csv(folder / "slew_times.csv", header, rows)
    if figures and traced.slews:
        style.save({"slew_times": _figure(scenario, traced.slews, costs)}, folder / "figures")


def _figure(scenario: Scenario, slews: Sequence[Slew], costs: Sequence[str]) -> Figure:
    units = catalogues.units(scenario.plant.kind)
    error = f"RMS window error [{units['window_error']}]"
    panels = {error: (np.asarray([slew.rms for slew in slews]), tables.limit_of(scenario, "window_error"))} | {
        f"largest {name.replace('_', ' ')} [{units[name]}]": (
            np.asarray([slew.costs[name] for slew in slews]), tables.limit_of(scenario, name)
        )
        for name in costs
    }  # fmt: skip
    along = study_plots.Ladder(
        "What a faster slew costs, fresh trials", "prescribed time t_f [s]", [slew.t_f for slew in slews]
    )
    return study_plots.costs(slews, along, panels)
