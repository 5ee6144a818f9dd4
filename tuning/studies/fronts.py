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
    return _front(pareto, scenario, seed, points)


def against_time(scenario: Scenario, seed: int, points: int, times: tuple[float, ...]) -> Front:
    """What a faster slew costs; times [s]: the usual ones if there are none. Raises ScenarioError if one cannot fly."""
    times = times or slew_times.usual_times(scenario)
    slew_times.check(scenario, times)
    return _front(slew_times, scenario, seed, times)


def _front(study: Any, scenario: Scenario, seed: int, asked: Any) -> Front:
    """The front that a module of a study looks for; asked: how many points, or which times."""
    known_by = study.identity(scenario, seed, asked)
    return Front(
        known_by,
        lambda tell, journal: study.trace(scenario, seed, asked, tell, journal),
        lambda found: study.summary(found, scenario),
        lambda folder, found, figures: study.write(folder, scenario, found, figures, known_by),
    )


KINDS: dict[str, Callable[..., Front]] = {"torque": against_torque, "t_f": against_time}
