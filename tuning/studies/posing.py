"""Turn a scenario into a tuning problem: training trials, limits, bounds of the gains, starting points.

`set_up_tuning` builds the problem, and `TuningSetup.search` solves it. Read `set_up_tuning` first.
"""

import dataclasses
import math
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass

import msgspec
import numpy as np

from ptsmc_jax.scenario import Study, free_gains, replace, study, tables
from ptsmc_jax.scenario.tables import Scenario
from ptsmc_jax.scenario.timing import Reach, reach_of
from ptsmc_jax.simulation.requirements import Requirement
from tuning.search import confirm, gains, margin_rows, objective, simulations
from tuning.search import normalisation as gain_bounds
from tuning.search.evaluate import Evaluator
from tuning.search.journal import Journal
from tuning.search.objective import Problem
from tuning.search.optimise import Search, Settings, search
from tuning.studies import judging

DIGITS = 10  # significant digits of reported gains; the rounded gains are judged


@dataclass(frozen=True)
class TuningSetup:
    """A scenario's tuning problem over its training trials, and the evaluator of gains."""

    ready: Study
    problem: Problem
    evaluate: Evaluator
    scenario_gains: np.ndarray  # (gains,) gains of the scenario
    settings: Settings  # options of the search; F has no useful gradients if the law has no derivative
    constraints: list[Requirement]  # constraints of the search

    def search(
        self,
        problem: Problem,
        gains: np.ndarray,
        starts: int,
        constraints: Sequence[Requirement] | None = None,
        *,
        judged: bool = True,
        margins: Mapping[str, float] | None = None,
        **callbacks: Callable,
    ) -> Search:
        """Search for the best gains of a problem.

        Args:
            problem: the objective and its constraints.
            gains: first starting point (gains,), in the units of the gains.
            starts: number of starting points.
            constraints: requirements that the search keeps; None: `self.constraints`.
            judged: see `Settings`.
            margins: distance from the limit of each metric as a fraction of the limit, see `Settings`.
            callbacks: `report` and `prepare` of `search`.
        """
        constraints = self.constraints if constraints is None else constraints
        settings = dataclasses.replace(self.settings, starts=starts, judged=judged, margins=margins or {})
        return search(self.evaluate, problem, constraints, gains, settings, **callbacks)

    def rounded_gains(self, normalised: np.ndarray) -> dict[str, float]:
        """Return rounded gains by name from normalised gains, (gains,)."""
        return self.evaluate.bounds.rounded(self.evaluate.bounds.gains(normalised), DIGITS)


def with_tune(scenario: Scenario) -> Scenario:
    """Return the scenario with a table `tune`. Raises ScenarioError without a free gain."""
    scenario = scenario if scenario.tune is not None else replace(scenario, tune={})
    free_gains.require_free_gains(scenario)
    return scenario


def with_bounds(scenario: Scenario, new_bounds: Mapping[str, tuple[float, float]]) -> Scenario:
    """Return the scenario with other bounds of some gains. These bounds still count as default bounds."""
    tune = msgspec.structs.replace(scenario.search, bounds={**scenario.search.bounds, **new_bounds})
    return msgspec.structs.replace(scenario, tune=tune)


def set_up_tuning(scenario: Scenario, seed: int, journal: Journal | None = None, **overrides: float) -> TuningSetup:
    """Return the tuning problem of a scenario.

    Args:
        scenario: scenario with free gains.
        seed: seed of the training trials and the search.
        journal: stored evaluations, which are not simulated again.
        overrides: see `tuning_reach`.
    """
    scenario, tune = on_training_clock(scenario), scenario.search
    ready = study(scenario, reach=tuning_reach(scenario, **overrides))
    bounds = gain_bounds.bounds_of_scenario(scenario, ready.parts)
    requirements = [r.implied_by for r in ready.requirements]
    training_trials = judging.count_needed_trials(ready, tune.trials)
    may_break = [confirm.allowed_in_training(r, requirements, training_trials) for r in requirements]
    problem = objective.problem(
        ready.parts,
        ready.dispersion,
        seed,
        np.arange(training_trials),
        bounds.names,
        requirements,
        may_break=tuple(count for count, _ in may_break),
        banded=tuple(banded for _, banded in may_break),
        objective=tune.minimise,
        tail=_count_tail_trials(tune, training_trials),
        statistic=tune.statistic,
        torque_weight=tune.torque_weight,
    )
    is_discontinuous = scenario.has_discontinuous_sign and "sign_width" not in bounds.names
    has_derivative = not is_discontinuous and ready.missing_derivative is None
    if has_derivative:  # start before the margins, so that these programs compile meanwhile
        simulations.prepare(problem.batch, objective.needed_metrics(problem))
    problem = dataclasses.replace(problem, margins=margin_rows.build_required_margins(ready, bounds, seed))
    scenario_gains = np.asarray(gains.present_values(ready.parts, bounds.names))
    designs = np.asarray(gains.design_gains(scenario, ready.parts, bounds.names))
    settings = Settings(tune.starts, tune.steps, seed, has_derivative, tune.worst_case, designs=designs)
    return TuningSetup(ready, problem, Evaluator(bounds, journal), scenario_gains, settings, requirements)


def on_training_clock(scenario: Scenario) -> Scenario:
    """Return the scenario on the anchored clock, which has a sample at t_f - delta, if delta or t_f is tuned.

    A flight computer hands over at its first sample at or after t_f - delta. On the flight clock, small changes of
    delta therefore have no effect, and the gradient is zero.
    """
    has_free_time = scenario.sampled and any(name in gain_bounds.TIMES for name in gains.free_gain_names(scenario))
    return replace(scenario, loop__clock="anchored") if has_free_time else scenario


def tuning_reach(scenario: Scenario, **overrides: float) -> Reach:
    """Return the ranges of the free gains that one compiled program must cover.

    Args:
        scenario: scenario whose gains and bounds the ranges include.
        overrides: fields of `Reach` that get other values.
    """
    scenario_reach = reach_of(scenario)

    def covering_range(name: str, value: float, largest: float | None = None) -> tuple[float, float]:
        """Return the smallest range that includes the bounds of a gain and its values in the scenario."""
        low, high = scenario.search.bounds.get(name, (value, value))
        return min(low, value), max(high, value if largest is None else largest)

    smallest_t_f, t_f = covering_range("t_f", scenario_reach.t_f)
    gain, largest_gain = covering_range("observer_gain", scenario_reach.gain, scenario_reach.largest_gain)
    covered = dataclasses.replace(
        scenario_reach,
        smallest_t_f=smallest_t_f,
        t_f=t_f,
        smallest_delta=covering_range("delta", scenario_reach.smallest_delta)[0],
        gain=gain,
        largest_gain=largest_gain,
        k1=covering_range("k1", scenario_reach.k1)[1],
        sign_width=covering_range("sign_width", scenario_reach.sign_width)[0],
        surface_rate=covering_range("surface_rate", scenario_reach.surface_rate)[1],
    )
    return dataclasses.replace(covered, **overrides)


def _count_tail_trials(table: tables.Tune, trials: int) -> int | None:
    """Return the number of worst training trials that define the objective, or None if all trials do."""
    if table.statistic in ("rms", "mean"):
        return None
    if table.statistic == "worst":
        return 1
    assert table.level is not None
    beyond = (1.0 - table.level) * trials
    return max(1, round(beyond) if table.statistic == "cvar" else math.floor(beyond + 1e-9) + 1)
