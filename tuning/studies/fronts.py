"""What accuracy is set against: a kind is a study of its own, and a row."""

from collections.abc import Callable
from pathlib import Path
from typing import Any

from ptsmc_jax.scenario.tables import Scenario
from tuning.search.journal import Journal
from tuning.search.progress import Report
from tuning.studies import pareto, slew_times


class AgainstTorque:
    """The front against the peak torque."""

    def __init__(self, scenario: Scenario, seed: int, points: int, times: tuple[float, ...]):
        """Raises ScenarioError where there is none to look for."""
        pareto.check(scenario)
        self._scenario, self._seed, self._points = scenario, seed, points
        self.known_by = pareto.identity(scenario, seed, points)

    def trace(self, tell: Report, journal: Journal) -> pareto.Front:
        """Look for the front."""
        return pareto.trace(self._scenario, self._seed, self._points, tell, journal)

    def summary(self, found: pareto.Front) -> dict[str, Any]:
        """What `summary.json` says."""
        return pareto.summary(found, self._scenario)

    def write(self, folder: Path, found: pareto.Front, figures: bool) -> None:
        """Fill a result folder."""
        pareto.write(folder, self._scenario, found, figures, self.known_by)


class AgainstTime:
    """What a faster slew costs."""

    def __init__(self, scenario: Scenario, seed: int, points: int, times: tuple[float, ...]):
        """Times [s], the usual ones if there are none; raises ScenarioError where one cannot be flown."""
        self._times = times or slew_times.usual_times(scenario)
        slew_times.check(scenario, self._times)
        self._scenario, self._seed = scenario, seed
        self.known_by = slew_times.identity(scenario, seed, self._times)

    def trace(self, tell: Report, journal: Journal) -> slew_times.Slews:
        """Look for the front."""
        return slew_times.trace(self._scenario, self._seed, self._times, tell, journal)

    def summary(self, found: slew_times.Slews) -> dict[str, Any]:
        """What `summary.json` says."""
        return slew_times.summary(found, self._scenario)

    def write(self, folder: Path, found: slew_times.Slews, figures: bool) -> None:
        """Fill a result folder."""
        slew_times.write(folder, self._scenario, found, figures, self.known_by)


KINDS: dict[str, Callable[..., Any]] = {"torque": AgainstTorque, "t_f": AgainstTime}
