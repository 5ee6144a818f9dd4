"""What accuracy is set against: a kind is a study of its own, and a row."""

from collections.abc import Callable
from pathlib import Path
from typing import Any, NamedTuple

from ptsmc_jax.scenario.tables import Scenario
from tuning.search.journal import Journal
from tuning.search.progress import Report
from tuning.studies import pareto, slew_times


class Front(NamedTuple):
    """A front to be looked for."""

    known_by: dict[str, Any]  # see `store.begin`
    trace: Callable[[Report, Journal], Any]  # looks for it
    summary: Callable[[Any], dict[str, Any]]  # what `summary.json` says of what was found
    write: Callable[[Path, Any, bool], None]  # fills a result folder with it, and with figures or not


def against_torque(scenario: Scenario, seed: int, points: int, times: tuple[float, ...]) -> Front:
    """The front against the peak torque; raises ScenarioError where there is none to look for."""
    pareto.check(scenario)
    known_by = pareto.identity(scenario, seed, points)
    return Front(
        known_by,
        lambda tell, journal: pareto.trace(scenario, seed, points, tell, journal),
        lambda found: pareto.summary(found, scenario),
        lambda folder, found, figures: pareto.write(folder, scenario, found, figures, known_by),
    )


def against_time(scenario: Scenario, seed: int, points: int, times: tuple[float, ...]) -> Front:
    """What a faster slew costs; times [s]: the usual ones if there are none. Raises ScenarioError if one cannot fly."""
    times = times or slew_times.usual_times(scenario)
    slew_times.check(scenario, times)
    known_by = slew_times.identity(scenario, seed, times)
    return Front(
        known_by,
        lambda tell, journal: slew_times.trace(scenario, seed, times, tell, journal),
        lambda found: slew_times.summary(found, scenario),
        lambda folder, found, figures: slew_times.write(folder, scenario, found, figures, known_by),
    )


KINDS: dict[str, Callable[..., Front]] = {"torque": against_torque, "t_f": against_time}
