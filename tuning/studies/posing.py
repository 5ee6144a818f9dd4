"""Turn a scenario into a tuning problem: training trials, limits, bounds of the gains, starting points.

`tuning_problem` builds the problem, and `Posed.search` solves it. Read `tuning_problem` first.
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
class Posed:
    """A scenario's tuning problem over its training trials, and the evaluator of gains."""

    ready: Study
    problem: Problem
    evaluate: Evaluator
    scenario_gains: np.ndarray  # (gains,) gains of the scenario
    with_gradients: bool  # whether F has useful gradients; it has none with the discontinuous sign
    asked: list[Requirement]  # constraints of the search
    seed: int
    designs: np.ndarray  # (designs, gains) starting points that follow from the mission

    def search(
        self,
        problem: Problem,
        gains: np.ndarray,
        starts: int,
        asked: Sequence[Requirement] | None = None,
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
            asked: requirements that the search keeps; None: `self.asked`.
            judged: see `Settings`.
            margins: distance from the limit of each metric as a fraction of the limit, see `Settings`.
            callbacks: `report` and `prepare` of `search`.
        """
        table, asked = self.ready.scenario.search, self.asked if asked is None else asked
        settings = Settings(
            starts, table.steps, self.seed, self.with_gradients, table.worst_case, judged, margins or {}, self.designs
        )
        return search(self.evaluate, problem, asked, gains, settings, **callbacks)

    def named(self, normalised: np.ndarray) -> dict[str, float]:
        """Return rounded gains by name from normalised gains, (gains,)."""
        return self.evaluate.bounds.rounded(self.evaluate.bounds.gains(normalised), DIGITS)


def with_tune(scenario: Scenario) -> Scenario:
    """Return the scenario with a table `tune`. Raises ScenarioError without a free gain."""
    scenario = scenario if scenario.tune is not None else replace(scenario, tune={})
    free_gains.need_some(scenario)
    return scenario


def with_bounds(scenario: Scenario, moved: Mapping[str, tuple[float, float]]) -> Scenario:
    """Return the scenario with other bounds of some gains. These bounds still count as default bounds."""
    tune = msgspec.structs.replace(scenario.search, bounds={**scenario.search.bounds, **moved})
    return msgspec.structs.replace(scenario, tune=tune)


def tuning_problem(scenario: Scenario, seed: int, journal: Journal | None = None, **farther: float) -> Posed:
    """Return the tuning problem of a scenario.

    Args:
        scenario: scenario with free gains.
        seed: seed of the training trials and the search.
        journal: stored evaluations, which are not simulated again.
        farther: see `reach`.
    """
    scenario, table = as_trained(scenario), scenario.search
    ready = study(scenario, reach=reach(scenario, table, **farther))
    bounds = gain_bounds.of_scenario(scenario, ready.parts)
    asked = [r.implied_by for r in ready.requirements]
    trained = judging.trials_of(ready, table.trials)
    may_break = [confirm.may_break(r, asked, trained) for r in asked]
    problem = objective.problem(
        ready.parts,
        ready.dispersion,
        seed,
        np.arange(trained),
        bounds.names,
        asked,
        may_break=tuple(allowed for allowed, _ in may_break),
        banded=tuple(banded for _, banded in may_break),
        objective=table.minimise,
        tail=_tail(table, trained),
        statistic=table.statistic,
        torque_weight=table.torque_weight,
    )
    exact = scenario.exact_sign and "sign_width" not in bounds.names
    if not exact:  # start before the margins, so that these programs compile meanwhile
        simulations.prepare(problem.batch, objective.watched(problem))
    problem = dataclasses.replace(problem, margins=margin_rows.ask(ready, bounds, seed))
    scenario_gains = np.asarray(gains.present_values(ready.parts, bounds.names))
    designs = np.asarray(gains.design_gains(scenario, ready.parts, bounds.names))
    return Posed(ready, problem, Evaluator(bounds, journal), scenario_gains, not exact, asked, seed, designs)


def as_trained(scenario: Scenario) -> Scenario:
    """Return the scenario on the anchored clock, which has a sample at t_f - delta, if delta or t_f is tuned.

    A flight computer hands over at its first sample at or after t_f - delta. On the flight clock, small changes of
    delta therefore have no effect, and the gradient is zero.
    """
    moved = scenario.sampled and any(name in gain_bounds.TIMES for name in gains.named(scenario))
    return replace(scenario, loop__clock="anchored") if moved else scenario


def reach(scenario: Scenario, table: tables.Tune, **farther: float) -> Reach:
    """Return the ranges of the free gains that one compiled program must cover.

    Args:
        scenario: its gains are in the ranges.
        table: its bounds are in the ranges.
        farther: fields of `Reach` that get other values.
    """
    present = reach_of(scenario)

    def interval(name: str, lower: float, upper: float | None = None) -> tuple[float, float]:
        low, high = table.bounds.get(name, (lower, lower))
        return min(low, lower), max(high, lower if upper is None else upper)

    smallest_delta, delta = interval("delta", present.delta)
    smallest_t_f, t_f = interval("t_f", present.t_f)
    gain, largest_gain = interval("observer_gain", present.gain, present.largest_gain)
    by_gains = dataclasses.replace(
        present,
        smallest_t_f=smallest_t_f,
        t_f=t_f,
        delta=delta,
        smallest_delta=smallest_delta,
        gain=gain,
        largest_gain=largest_gain,
        k1=interval("k1", present.k1)[1],
        sign_width=interval("sign_width", present.sign_width)[0],
        surface_rate=interval("surface_rate", present.surface_rate)[1],
    )
    return dataclasses.replace(by_gains, **farther)


def _tail(table: tables.Tune, trials: int) -> int | None:
    """Return the number of worst training trials that define the objective, or None if all trials do."""
    if table.statistic in ("rms", "mean"):
        return None
    if table.statistic == "worst":
        return 1
    assert table.level is not None
    beyond = (1.0 - table.level) * trials
    return max(1, round(beyond) if table.statistic == "cvar" else math.floor(beyond + 1e-9) + 1)
