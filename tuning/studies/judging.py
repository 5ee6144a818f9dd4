"""Gains judged as they are flown: on fresh trials and the flight clock, beside the paper's and those before."""

from collections.abc import Sequence
from typing import Any

import numpy as np

from ptsmc_jax.campaigns import margin_verdicts, montecarlo, runs
from ptsmc_jax.campaigns.montecarlo import Trials
from ptsmc_jax.numerics import draws, statistics
from ptsmc_jax.scenario import Study, replace, study
from ptsmc_jax.scenario.errors import ScenarioError
from ptsmc_jax.scenario.tables import Limit, Scenario
from ptsmc_jax.scenario.timing import Reach
from ptsmc_jax.simulation import requirements
from ptsmc_jax.simulation.requirements import Verdict
from tuning.search import confirm, gains, trust


def seed_of_judge(seed: int, turn: int = 0) -> int:
    """The seed of the fresh trials; of others each turn, where gains that had broken a limit on some were tuned on.

    Never the search's own, nor that of another turn. A hash of 2^32 seeds has fixed points: that of seed 654735429 is
    itself, and of two later turns one each is (all were tried).
    """
    taken = [seed]
    for k in range(turn + 1):
        name = f"fresh trials {k}" if k else "fresh trials"
        fresh = draws.derive(seed, name)
        while fresh in taken:
            name += ", others"
            fresh = draws.derive(seed, name)
        taken.append(fresh)
    return taken[-1]


def beside(scenario: Scenario) -> tuple[dict[str, Scenario], str | None]:
    """What tuned gains are set beside: "paper", the paper's, and "before", the scenario's own where they differ.

    And why the scenario cannot be flown with the paper's, which are then not among them.
    """
    try:
        paper = gains.papers(scenario)
        study(as_flown(paper))
    except ScenarioError as error:
        return {"before": scenario}, str(error)
    return {"paper": paper} | ({"before": scenario} if gains.differ(scenario, paper) else {}), None


def judge(scenario: Scenario, fresh_seed: int, reach: Reach | None = None) -> Trials:
    """Simulate a scenario on its held-out trials, on the flight clock.

    Args:
        scenario: with the gains.
        fresh_seed: of the held-out trials.
        reach: ranges of the gains that share a compiled program; None: those of the scenario.
    """
    flown = study(as_flown(scenario), reach=reach)
    return montecarlo.run(flown.parts, flown.dispersion, fresh_seed, np.arange(fresh_trials(flown)))


def floor_of(scenario: Scenario, fresh_seed: int) -> float | None:
    """RMS window error that no controller can beat where a scenario is judged, see `runs.floor`."""
    return runs.floor(study(as_flown(scenario)), fresh_seed)


def verdicts_of(scenario: Scenario, trials: Trials, fresh_seed: int) -> list[Verdict]:
    """One for each of the scenario's requirements over these trials, and for each margin asked of its loop."""
    ready = study(as_flown(scenario))
    one = 0 if trials.status.size == 1 else slice(None)  # nothing is drawn: no share of the trials to speak of

    def values(name: str) -> np.ndarray:
        return getattr(trials.metrics, name)[one]

    flown = requirements.verdicts(ready.requirements, values, trials.finished[one])
    return [*flown, *margin_verdicts.over_trials(ready, fresh_seed)]


def met(verdicts: Sequence[Verdict], trials: Trials) -> bool:
    """Whether every requirement is met, and no trial failed or missed t_f."""
    return all(v.met for v in verdicts) and bool(np.all(trials.ok))


def window_error(trials: Trials) -> tuple[float | None, tuple[float, float] | None]:
    """RMS window error of the trials that were flown to the end, None if none was, and its interval."""
    errors = np.asarray(trials.metrics.window_error)[trials.finished]
    return float(trust.rms(errors)) if errors.size else None, trust.interval(errors, trust.rms)


def figures(scenario: Scenario, trials: Trials, fresh_seed: int) -> dict[str, Any]:
    """What fresh trials say of gains: RMS window error with its interval, failures, and whether all limits are met."""
    rms, interval = window_error(trials)
    return {
        "rms": np.nan if rms is None else rms,
        "interval": interval,
        "failures": int(np.sum(~trials.ok)),
        "meets": met(verdicts_of(scenario, trials, fresh_seed), trials),
    }


def largest(name: str, scenario: Scenario, trials: Trials) -> float:
    """What a metric stays below in the share of trials that its requirement asks for, or in all; NaN: none ended.

    A trial that failed is beyond all others, as in the verdict; where so many are, it is the largest of those that end.
    """
    values = np.sort(np.asarray(getattr(trials.metrics, name))[trials.finished])
    asked = scenario.requirements.get(name)
    share = (asked.share if isinstance(asked, Limit) else None) or 1.0
    return statistics.value_at(values, min(1.0, share * trials.status.size / values.size)) if values.size else np.nan


def as_flown(scenario: Scenario) -> Scenario:
    """The scenario on the flight clock; a continuous loop as it is."""
    return replace(scenario, loop__clock="flight") if scenario.sampled else scenario


def judged_on(flown: Scenario) -> str:
    """What a scenario was flown on to be judged, in words."""
    if not flown.sampled:
        return "the continuous loop"
    if getattr(flown.controller, "implicit", False):
        return "flight clock, the sign solved for"
    width = getattr(flown.controller, "sign_width", None)
    if width is None:
        return "flight clock"
    return "flight clock, " + (f"sign {width:g} wide" if width else "exact sign")


def trials_of(ready: Study, wanted: int) -> int:
    """How many trials differ at all: one where nothing is drawn."""
    return wanted if ready.drawn else 1


def fresh_trials(ready: Study) -> int:
    """On how many fresh trials gains are judged."""
    return trials_of(ready, confirm.fresh_trials(ready.requirements))
