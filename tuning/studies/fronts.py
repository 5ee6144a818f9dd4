"""What accuracy is set against: each kind of front is a study of its own."""

from typing import Any

from ptsmc_jax.scenario.tables import Scenario
from tuning.studies import pareto, robustness, slew_times

POINTS = 20  # limits on the torque, where nobody says how many


def study_of(against: str, scenario: Scenario, points: int | None, listed: tuple[float, ...]) -> tuple[Any, Any]:
    """The module that looks for a front, and what is asked of it.

    Such a module has `identity`, `trace`, `summary` and `write`.

    Args:
        against: what accuracy is set against, "torque", "margins" or "t_f".
        scenario: of which.
        points: limits on the torque to tune for; None: `POINTS`.
        listed: prescribed times [s], or limits on the largest sensitivity [dB], to tune for; empty: the usual ones.

    Raises ScenarioError where there is no front to look for, or a time cannot be flown.
    """
    if against == "torque":
        pareto.check(scenario)
        return pareto, points or POINTS
    if against == "margins":
        robustness.check(scenario)
        return robustness, listed or robustness.usual_limits(scenario)
    times = listed or slew_times.usual_times(scenario)
    slew_times.check(scenario, times)
    return slew_times, times
