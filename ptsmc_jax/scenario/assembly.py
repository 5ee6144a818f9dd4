"""Build everything that a run needs from a validated scenario: parts, dispersions, requirements. Start with `study`."""

import typing
from dataclasses import dataclass
from pathlib import Path

from ptsmc_jax import configure
from ptsmc_jax.dispersions import variation
from ptsmc_jax.numerics.pytrees import listing
from ptsmc_jax.scenario import build, custom_checks, reading, start_checks, timing
from ptsmc_jax.scenario import tables as t
from ptsmc_jax.scenario.tables import Scenario
from ptsmc_jax.simulation import catalogues
from ptsmc_jax.simulation.assembly import Parts
from ptsmc_jax.simulation.requirements import Requirement


@dataclass(frozen=True)
class Study:
    """A scenario with the parts, dispersions and requirements that are built from it."""

    scenario: Scenario
    parts: Parts
    dispersion: variation.Dispersion
    requirements: tuple[Requirement, ...]  # on metrics of runs
    margins: tuple[Requirement, ...]  # on stability margins of the loop

    __repr__ = listing

    @property
    def drawn(self) -> bool:
        """Whether trials differ from each other."""
        return self.dispersion.varies or not self.parts.sensors.perfect or self.parts.walk_rate is not None

    @property
    def catalogue(self) -> dict[str, catalogues.Entry]:
        """The metrics of this scenario's runs, by name."""
        return catalogue(self.scenario)


def catalogue(scenario: Scenario) -> dict[str, catalogues.Entry]:
    """Return the metrics of a scenario's runs, by name."""
    timed_metrics = {r.timed for r in requirements(scenario)}

    def is_available(name: str, entry: catalogues.Entry) -> bool:
        if name.startswith(catalogues.WITHIN) and name not in timed_metrics:
            return False
        if name.startswith(catalogues.KNOWLEDGE) and not scenario.uses_measurements:
            return False
        return entry.table is None or getattr(scenario, entry.table, None) is not None

    return {name: entry for name, entry in scenario.metrics.items() if is_available(name, entry)}


def requirements(scenario: Scenario) -> tuple[Requirement, ...]:
    """Return the requirements on the metrics of a scenario's runs."""
    metrics = scenario.metrics
    return tuple(
        Requirement(
            name,
            value.limit,
            metrics[name].unit,
            value.fraction,
            value.confidence,
            interpretation=value.interpretation or "ensemble",
        )
        if isinstance(value, t.Limit)
        else Requirement(name, float(value), metrics[name].unit)
        for name, value in scenario.requirements.items()
        if name in metrics
    )


def margin_requirements(scenario: Scenario) -> tuple[Requirement, ...]:
    """Return the requirements on the stability margins of a scenario's loop."""
    return tuple(
        Requirement(name, float(typing.cast(float, value)), margin.unit, at_least=margin.at_least)
        for name, value in scenario.requirements.items()
        if (margin := catalogues.MARGINS.get(name)) is not None
    )


def study(
    scenario: Scenario | str | Path, saves: object = (), reach: timing.Reach | None = None, *, drawn: bool = True
) -> Study:
    """Build the parts, dispersions and requirements of a scenario.

    The function runs Python files that the scenario names. Read such a file before you run a scenario of somebody else.

    Args:
        scenario: a validated scenario, or the path of a scenario file.
        saves: times [s] at which the grid of the continuous loop must have nodes.
        reach: ranges of gains and control period that the compiled program must cover; by default the scenario's
            values only, see `timing.reach_of`.
        drawn: whether the dispersed initial attitude is simulated. If False, the nominal path is checked for the
            singularity of the law even if the attitude is dispersed.

    Returns:
        The study, whose `parts` are the arguments of the simulation.

    Raises:
        ScenarioError: the law meets its singularity between the initial state and the reference, custom code fails, or
            the run needs too many steps.
        TypeError: `scenario` is not a scenario, or `reach` is not a `Reach`.
    """
    if not isinstance(reach, timing.Reach | None):
        raise TypeError(f"a reach is needed, as reach_of(scenario) returns it, but this is a {type(reach).__name__}")
    configure.warn_if_not_configured()
    scenario = reading.complete(reading.to_scenario(scenario))
    setup = build.setup(scenario)
    parts = setup.with_clock(*timing.choose_timing(scenario, setup, reach or timing.reach_of(scenario), saves))
    dispersion = build.dispersion(scenario, parts)
    custom_checks.check(parts, dispersion, scenario)
    start_checks.check(scenario, parts, dispersion, dispersed=drawn)
    return Study(scenario, parts, dispersion, requirements(scenario), margin_requirements(scenario))
