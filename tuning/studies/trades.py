"""The quantities that the window error is traded against: peak torque, stability margins and t_f.

A trade states the tuning problem for each value of its quantity. `pareto` solves these problems.
"""

from abc import ABC, abstractmethod
from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from functools import cached_property
from typing import Any, ClassVar

import numpy as np

from ptsmc_jax import scenario as scenarios
from ptsmc_jax.campaigns import margin_verdicts
from ptsmc_jax.campaigns.montecarlo import Trials
from ptsmc_jax.scenario import custom, free_gains, parsing, study, tables
from ptsmc_jax.scenario.errors import ScenarioError, wrong
from ptsmc_jax.scenario.tables import Scenario
from ptsmc_jax.simulation.catalogues import MARGINS
from ptsmc_jax.simulation.requirements import Verdict
from tuning.search import gains
from tuning.search.margin_rows import RequiredMargins
from tuning.search.objective import T_F, Problem, replace_entries
from tuning.search.optimise import Search
from tuning.search.progress import Report, headed
from tuning.search.rounds import MARGIN
from tuning.studies import judging
from tuning.studies.posing import TuningSetup

TORQUE, SENSITIVITY = "peak_torque", "peak_sensitivity"
POINTS = 20  # default number of limits on the peak torque
INACTIVE_LIMIT = 1e9  # limit on the peak torque that is never active
SMALLEST_LIMIT = 0.05  # fraction of the largest useful peak torque; hardly any gains keep such a limit
MOST_SEARCHES = 3  # largest number of searches for the least peak torque
FEWER_STARTS = 4  # number of starting points of a search whose gains are refined later
LIMITS = (3.0, 4.0, 5.0, 6.0, 8.0, 12.0)  # default limits on the peak sensitivity [dB]
BOUNDED = ("gain_margin", "phase_margin", SENSITIVITY)  # margins that a limit on the peak sensitivity bounds
SPAN = (0.5, 0.7, 1.0, 1.4, 2.0)  # default prescribed times, relative to the scenario's t_f
# metrics that usually grow if t_f gets shorter; a front against t_f reports them as its costs
SLEW_COSTS = ("peak_torque", "peak_momentum", "peak_wheel_torque", "peak_wheel_momentum", "peak_rate", "effort")


@dataclass(frozen=True)
class Target:
    """A value of the traded quantity, and the tuning problem for it."""

    value: float
    name: str  # name of the target in progress reports
    problem: Problem


@dataclass(frozen=True)
class Trade(ABC):
    """A scenario whose window error is traded against a quantity."""

    scenario: Scenario

    against: ClassVar[str]  # value of the option --against
    purpose: ClassVar[str]  # end of error messages, such as "for a front against t_f"
    merges_points: ClassVar[bool] = True  # whether values with the same gains share a point
    # whether to mark dominated points and the knee, and to judge the published gains
    compares_points: ClassVar[bool] = False

    def check(self) -> None:
        """Raise ScenarioError if the study does not apply to the scenario."""
        search = self.scenario.search
        if search.minimise != "window_error":
            raise wrong("tune.minimise", search.minimise, f'"window_error" {self.purpose}')
        if search.worst_case:
            raise wrong("tune.worst_case", True, f"false {self.purpose}")

    @cached_property
    def base(self) -> Scenario:
        """Return the scenario of the tuning problem, which has the traded quantity among its requirements."""
        return self.scenario

    @property
    def reach_overrides(self) -> dict[str, float]:
        """Return the fields of `Reach` that the targets need beyond the bounds of the free gains."""
        return {}

    @abstractmethod
    def targets(self, setup: TuningSetup, report: Report) -> tuple[list[Target], list[np.ndarray]]:
        """Search from the scenario's gains, without known gains. Raises KeyboardInterrupt on Ctrl-C.

        Args:
            setup: the tuning problem of `base`.
            report: called with the progress.

        Returns:
            The targets, and the gains that these searches found, (gains,) each, as fractions of the bounds' intervals.
            Order and number of the gains may differ from those of the targets.
        """

    def tuned_scenario(self, value: float, found: dict[str, float]) -> Scenario:
        """Return the scenario with the gains found for a value of the traded quantity."""
        return gains.in_scenario(self.scenario, found)

    @abstractmethod
    def costs(self, tuned: Scenario, trials: Trials, verdicts: Sequence[Verdict], seed: int) -> dict[str, float]:
        """Return the costs of gains by name, in the units of the metrics and margins.

        Args:
            tuned: the scenario with the gains.
            trials: the held-out trials of the gains.
            verdicts: verdicts on the requirements and the required margins.
            seed: seed of these trials.
        """

    @abstractmethod
    def options(self) -> dict[str, object]:
        """Return the options of `ptsmc pareto` that select these values."""

    def identity(self, seed: int) -> dict[str, object]:
        """Return the entries of `versions.json` that identify a finished or interrupted front."""
        return {"command": "pareto", "seed": seed, **self.options(), **custom.checksums(self.scenario)}


@dataclass(frozen=True)
class Torque(Trade):
    """Limits on the peak torque, from the least that any gains need to the most that improves the accuracy.

    The limits are spaced evenly in their logarithms (epsilon-constraint method: Haimes, Lasdon and Wismer, IEEE Trans.
    SMC 1(3), 1971).
    """

    points: int = POINTS

    against = "torque"
    purpose = "for a front of the window error"
    compares_points = True

    def check(self) -> None:
        """Raise ScenarioError if the study does not apply to the scenario."""
        super().check()
        weight = self.scenario.search.torque_weight
        if weight:
            raise wrong("tune.torque_weight", weight, f"absent {self.purpose} against the torque")

    @cached_property
    def base(self) -> Scenario:
        """Return the scenario with a requirement on the peak torque."""
        limited = tables.limit_of(self.scenario, TORQUE) is not None
        return self.scenario if limited else _with_requirements(self.scenario, {TORQUE: INACTIVE_LIMIT})

    def targets(self, setup: TuningSetup, report: Report) -> tuple[list[Target], list[np.ndarray]]:
        """Search without a torque limit, for the least torque, and with a limit in between; see `Trade.targets`."""
        index = setup.problem.metrics.index(TORQUE)

        def limited_problem(limit: float, base: Problem = setup.problem) -> Problem:
            return replace(base, limits=replace_entries(setup.problem.limits, index, limit))

        loose = [replace(r, limit=INACTIVE_LIMIT) if r.metric == TORQUE else r for r in setup.constraints]
        unlimited = _search(setup, limited_problem(INACTIVE_LIMIT), headed(report, "most torque"), constraints=loose)
        highest = unlimited.worst_completed[index] * INACTIVE_LIMIT

        def search(limit: float) -> tuple[Search, float]:
            search_report = headed(report, "least torque")
            outcome = _search(
                setup, limited_problem(limit, unlimited.problem), search_report, FEWER_STARTS, constraints=()
            )
            return outcome, outcome.worst_completed[index] * limit

        least, lowest = least_torque(search, highest)
        scenario_limit = tables.limit_of(self.scenario, TORQUE)
        limits, k = limits_between(lowest / (1.0 - MARGIN), highest / (1.0 - MARGIN), self.points, scenario_limit)
        targets = [
            Target(float(limit), f"peak torque {limit:.3g}", limited_problem(limit, unlimited.problem))
            for limit in limits
        ]
        # the best local minimum between the ends may differ from those at the ends
        middle = _search(setup, targets[k].problem, headed(report, targets[k].name), constraints=())
        return targets, [
            normalised for outcome in (unlimited, least, middle) for normalised in (outcome.normalised, *outcome.ends)
        ]

    def costs(self, tuned: Scenario, trials: Trials, verdicts: Sequence[Verdict], seed: int) -> dict[str, float]:
        """Return the largest and the mean peak torque [N m]."""
        peaks = np.asarray(trials.metrics.peak_torque)[trials.finished]
        mean = float(np.mean(peaks)) if peaks.size else np.nan
        return {TORQUE: judging.required_quantile(TORQUE, tuned, trials), "mean_peak_torque": mean}

    def options(self) -> dict[str, object]:
        """Return the option --points of `ptsmc pareto`, by name."""
        return {"points": self.points}


@dataclass(frozen=True)
class Margins(Trade):
    """Limits on the peak sensitivity M_s = max |S|, which bounds the other margins.

    The loop tolerates gain factors between M_s / (M_s + 1) and M_s / (M_s - 1), and a phase error up to
    2 asin(1 / (2 M_s)).
    Source: Skogestad and Postlethwaite, Multivariable Feedback Control, 2005, 2.4.3.
    """

    limits: tuple[float, ...] = ()  # limits on M_s [dB]; empty: `LIMITS`, and the scenario's limit

    against = "margins"
    purpose = "for a front against margins"

    def check(self) -> None:
        """Raise ScenarioError if the study does not apply to the scenario."""
        if not self.scenario.sampled:
            raise wrong("loop.mode", self.scenario.loop.mode, f'"sampled" {self.purpose}')
        super().check()

    @cached_property
    def values(self) -> list[float]:
        """Return the limits, loosest first [dB]; infinite: no limit."""
        scenario_limit = tables.limit_of(self.scenario, SENSITIVITY)
        defaults = {*LIMITS, *([] if scenario_limit is None else [scenario_limit])}
        return [np.inf, *sorted(self.limits or defaults, reverse=True)]

    @cached_property
    def base(self) -> Scenario:
        """Return the scenario that requires the tightest limit on M_s, instead of the margins in `BOUNDED`."""
        return _with_requirements(self.scenario, {SENSITIVITY: self.values[-1]}, without=BOUNDED)

    def targets(self, setup: TuningSetup, report: Report) -> tuple[list[Target], list[np.ndarray]]:
        """Search for the best gains under each limit; see `Trade.targets`."""
        required_margins = setup.problem.margins
        assert required_margins is not None
        index, targets, known = required_margins.metrics.index(SENSITIVITY), [], []
        for value in self.values:
            name = f"|S| at most {value:g} dB" if value < np.inf else "no limit on |S|"
            limits = replace(required_margins, required=replace_entries(required_margins.required, index, value))
            limited = replace(setup.problem, margins=limits)
            outcome = _search(setup, limited, headed(report, name), FEWER_STARTS if targets else None)
            targets.append(Target(value, name, outcome.problem))
            known.append(outcome.normalised)
        return targets, known

    def costs(self, tuned: Scenario, trials: Trials, verdicts: Sequence[Verdict], seed: int) -> dict[str, float]:
        """Return the largest peak torque [N m], and the worst margins of the held-out trials' loops.

        Loops of trials that fail count, too: a margin without a value would look like an unlimited one.
        """
        with_margins = scenarios.replace(tuned, requirements=dict.fromkeys(MARGINS, 1.0))
        by_margin = margin_verdicts.judge_trials(study(judging.on_flight_clock(with_margins)), seed)
        return {TORQUE: judging.required_quantile(TORQUE, tuned, trials)} | {v.metric: v.worst for v in by_margin}

    def options(self) -> dict[str, object]:
        """Return the options --against and --limits of `ptsmc pareto`, by name."""
        return {"against": self.against, "limits": _join_values(self.values[1:])}


@dataclass(frozen=True)
class SlewTime(Trade):
    """Prescribed times t_f. One compiled program simulates all of them."""

    times: tuple[float, ...] = ()  # prescribed times [s]; empty: from half to twice the scenario's t_f

    against = "t_f"
    purpose = "for a front against t_f"
    merges_points = False

    def check(self) -> None:
        """Raise ScenarioError if the study does not apply to the scenario, or a time cannot be simulated."""
        scenario = self.scenario
        if not scenario.controller.law.prescribed:
            raise wrong("controller.kind", scenario.controller.kind, f"prescribed_time {self.purpose}")
        super().check()
        if T_F in scenario.search.gains:
            raise wrong("tune.free", list(scenario.search.gains), f"without t_f {self.purpose}")
        if free_gains.is_observer_time_default(scenario):
            raise ScenarioError(f"observer.t_o is absent, but must be set {self.purpose}; its default depends on t_f")
        for t_f in self.values:
            self._with_t_f(t_f)

    @cached_property
    def values(self) -> list[float]:
        """Return the prescribed times in ascending order [s]."""
        defaults = (float(f"{fraction * self.scenario.controller.t_f:.3g}") for fraction in SPAN)
        return sorted(self.times or defaults)

    @cached_property
    def base(self) -> Scenario:
        """Return the scenario with the shortest time."""
        return self._with_t_f(self.values[0])

    @property
    def reach_overrides(self) -> dict[str, float]:
        """Return the longest time as t_f [s]."""
        return {"t_f": self.values[-1]}

    def _with_t_f(self, t_f: float) -> Scenario:
        """Return the scenario with this prescribed time [s], and default bounds of delta that follow it."""
        tune = self.scenario.search
        bounds = {name: both for name, both in tune.bounds.items() if name != "delta"}
        if tune.bounds.get("delta") not in (None, free_gains.default_bounds(self.scenario, "delta")):
            bounds["delta"] = tune.bounds["delta"]
        timed = gains.in_scenario(scenarios.replace(self.scenario, tune=None), {"t_f": t_f})
        return scenarios.replace(timed, tune={**parsing.to_dict(tune), "bounds": bounds})

    def targets(self, setup: TuningSetup, report: Report) -> tuple[list[Target], list[np.ndarray]]:
        """Search for the best gains at the longest time, the shortest, and the others; see `Trade.targets`.

        Hard trials that the first two searches add to the training trials are used for all other times, too. Required
        margins are margins of the loop with the same t_f, and each time selects its own loops among the trials.
        """
        problem, last, known = setup.problem, len(self.values) - 1, []
        margins = dict[int, RequiredMargins | None]()
        for k in (last, 0, *range(last - 1, 0, -1)):
            starts, constraints = None if k == last else FEWER_STARTS, None if k in (0, last) else ()
            time_report = headed(report, self._name(self.values[k]))
            outcome = _search(setup, _at_time(problem, self.values[k]), time_report, starts, constraints)
            known.append(outcome.normalised)
            margins[k] = outcome.problem.margins
            problem = outcome.problem if k in (0, last) else problem
        targets = [
            Target(t_f, self._name(t_f), replace(_at_time(problem, t_f), margins=margins[k]))
            for k, t_f in enumerate(self.values)
        ]
        return targets, known

    def _name(self, t_f: float) -> str:
        """Return the name of a prescribed time in progress reports."""
        return f"t_f = {t_f:g} s"

    def tuned_scenario(self, value: float, found: dict[str, float]) -> Scenario:
        """Return the scenario with this prescribed time [s] and these gains."""
        return gains.in_scenario(self._with_t_f(value), found)

    def costs(self, tuned: Scenario, trials: Trials, verdicts: Sequence[Verdict], seed: int) -> dict[str, float]:
        """Return the metrics in `SLEW_COSTS` that runs of the scenario have, other required metrics and margins.

        A metric is its `judging.required_quantile`, and a margin is its worst value.
        """
        needed = {name: tuned.metrics[name].table for name in SLEW_COSTS if name in tuned.metrics}
        has = [name for name, table in needed.items() if table is None or getattr(tuned, table, None) is not None]
        metrics = dict.fromkeys([*has, *(v.metric for v in verdicts if v.metric not in (*MARGINS, "window_error"))])
        margins = {v.metric: v.worst for v in verdicts if v.metric in MARGINS}
        return {name: judging.required_quantile(name, tuned, trials) for name in metrics} | margins

    def options(self) -> dict[str, object]:
        """Return the options --against and --times of `ptsmc pareto`, by name."""
        return {"against": self.against, "times": _join_values(self.values)}


def build(against: str, scenario: Scenario, points: int | None, values: tuple[float, ...]) -> Trade:
    """Return the trade that the options of `ptsmc pareto` ask for.

    Args:
        against: "torque", "margins" or "t_f".
        scenario: a scenario with free gains.
        points: number of limits on the torque; None: `POINTS`.
        values: prescribed times [s], or limits on the peak sensitivity [dB]; empty: the defaults.

    Raises:
        ScenarioError: the study does not apply to the scenario, or a time cannot be simulated.
    """
    choices: tuple[Trade, ...] = (
        Torque(scenario, points or POINTS),
        Margins(scenario, values),
        SlewTime(scenario, values),
    )
    trade = next(choice for choice in choices if choice.against == against)
    trade.check()
    return trade


def limits_between(lowest: float, highest: float, points: int, scenario_limit: float | None) -> tuple[np.ndarray, int]:
    """Return limits on the peak torque, evenly spaced in their logarithms, and the index of the scenario's limit.

    Args:
        lowest: first limit [N m].
        highest: last limit [N m].
        points: number of limits.
        scenario_limit: the scenario's limit [N m]. It replaces the nearest limit if it is between the ends.

    Returns:
        The limits (points,) [N m], and the index of the scenario's limit, or of the middle one.
    """
    limits, middle = np.geomspace(lowest, highest, points), points // 2
    if scenario_limit is not None and lowest < scenario_limit < highest:
        middle = 1 + int(np.argmin(np.abs(np.log(limits[1:-1] / scenario_limit))))
        limits[middle] = scenario_limit
    return limits, middle


def _at_time(problem: Problem, t_f: float) -> Problem:
    """Return the problem with this prescribed time [s], in its simulations and in the loops of its margins."""
    parts, margins = gains.with_gains(problem.parts, {"t_f": t_f}), problem.margins
    return replace(problem, parts=parts, margins=None if margins is None else replace(margins, parts=parts))


def least_torque(
    search: Callable[[float], tuple[Any, float]], highest: float, searches: int = MOST_SEARCHES
) -> tuple[Any, float]:
    """Search for the gains that need the least peak torque.

    A search returns the most accurate gains that keep a limit. The limit is therefore lowered until no gains keep it.

    Args:
        search: returns the outcome for a limit [N m], and its peak torque [N m].
        highest: the largest peak torque that improves the accuracy [N m].
        searches: largest number of searches, each with a lower limit.

    Returns:
        The last outcome, and its peak torque [N m].
    """
    limit = SMALLEST_LIMIT * highest
    outcome, peak = search(limit)
    return (outcome, peak) if peak > limit or searches == 1 else least_torque(search, limit, searches - 1)


def _search(
    setup: TuningSetup,
    problem: Problem,
    report: Report,
    starts: int | None = None,
    constraints: Sequence[Any] | None = None,
) -> Search:
    """Search from the scenario's gains. Raises KeyboardInterrupt if the search was interrupted.

    Args:
        setup: the tuning problem of the scenario.
        problem: the problem with a limit, or another value of the traded quantity.
        report: called with the progress.
        starts: number of starting points; None: as in the scenario.
        constraints: requirements that the search keeps; None: those of the scenario.
    """
    starts = setup.settings.starts if starts is None else starts
    outcome = setup.search(problem, setup.scenario_gains, starts, constraints, judged=False, report=report)
    if outcome.interrupted:
        raise KeyboardInterrupt
    return outcome


def _with_requirements(scenario: Scenario, limits: dict[str, float], without: Sequence[str] = ()) -> Scenario:
    """Return the scenario with further requirements, and without some of its own."""
    stated = parsing.dump(scenario).get("requirements", {})
    kept = {name: limit for name, limit in stated.items() if name not in without}
    return scenarios.replace(scenario, requirements={**kept, **limits})


def _join_values(values: Sequence[float]) -> str:
    """Return values in one text, separated by commas, whole numbers without decimals."""
    return ",".join(str(float(value)).removesuffix(".0") for value in values)
