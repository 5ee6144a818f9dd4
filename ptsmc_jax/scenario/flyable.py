"""Checked scenarios turned into what flies: parts, dispersion, requirements."""

import typing
from dataclasses import dataclass
from pathlib import Path

from ptsmc_jax import configure
from ptsmc_jax.dispersions import variation
from ptsmc_jax.numerics.pytrees import listing
from ptsmc_jax.scenario import build, own_checks, reading, start_checks, timing
from ptsmc_jax.scenario import tables as t
from ptsmc_jax.scenario.tables import Scenario
from ptsmc_jax.simulation import catalogues
from ptsmc_jax.simulation.assembly import Parts
from ptsmc_jax.simulation.requirements import Requirement


@dataclass(frozen=True)
class Study:
    """A scenario ready to run."""

    scenario: Scenario
    parts: Parts
    dispersion: variation.Dispersion
    requirements: tuple[Requirement, ...]  # of its runs
    margins: tuple[Requirement, ...]  # of its loop

    __repr__ = listing

    @property
    def drawn(self) -> bool:
        """Whether anything differs from trial to trial."""
        return self.dispersion.varies or not self.parts.sensors.perfect or self.parts.walk_rate is not None

    @property
    def catalogue(self) -> dict[str, catalogues.Entry]:
        """The metrics that this scenario's runs have, by name."""
        return catalogue(self.scenario)


def catalogue(scenario: Scenario) -> dict[str, catalogues.Entry]:
    """The metrics that a scenario's runs have, by name."""
    timed = {r.timed for r in requirements(scenario)}

    def there(name: str, entry: catalogues.Entry) -> bool:
        if name.startswith(catalogues.WITHIN) and name not in timed:
            return False
        if name.startswith(catalogues.KNOWLEDGE) and not scenario.measured:
            return False
        return entry.table is None or getattr(scenario, entry.table, None) is not None

    return {name: entry for name, entry in scenario.metrics.items() if there(name, entry)}


def requirements(scenario: Scenario) -> tuple[Requirement, ...]:
    """What a scenario asks of its runs."""
    units = scenario.metrics
    return tuple(
        Requirement(
            name,
            value.limit,
            units[name].unit,
            value.share,
            value.confidence,
            interpretation=value.interpretation or "ensemble",
        )
        if isinstance(value, t.Limit)
        else Requirement(name, float(value), units[name].unit)
        for name, value in scenario.requirements.items()
        if name in units
    )


def margin_requirements(scenario: Scenario) -> tuple[Requirement, ...]:
    """What a scenario asks of its loop."""
    return tuple(
        Requirement(name, float(typing.cast(float, value)), margin.unit, at_least=margin.at_least)
        for name, value in scenario.requirements.items()
        if (margin := catalogues.MARGINS.get(name)) is not None
    )


def study(
    scenario: Scenario | str | Path, saves: object = (), reach: timing.Reach | None = None, *, drawn: bool = True
) -> Study:
    """The parts of a checked scenario, or of its file; `saves`: times [s] at which a continuous run must have nodes.

    drawn: the initial attitude is drawn where a dispersion says so; False: the nominal one is flown, and looked at.
    Runs the file of a system that the scenario names, which is then a program: read it before. Raises ScenarioError
    where the law meets its singularity on the way from the initial state to the reference, TypeError where what is
    given is no scenario, or no reach.
    """
    if not isinstance(reach, timing.Reach | None):
        raise TypeError(f"a reach is needed, as reach_of(scenario) returns it, but this is a {type(reach).__name__}")
    configure.warn_if_forgotten()
    scenario = reading.complete(reading.of(scenario))
    setup = build.setup(scenario)
    parts = setup.timed(*timing.timing(scenario, setup, reach or timing.reach_of(scenario), saves))
    dispersion = build.dispersion(scenario, parts)
    own_checks.check(parts, dispersion, scenario)
    start_checks.check(scenario, parts, dispersion, drawn=drawn)
    return Study(scenario, parts, dispersion, requirements(scenario), margin_requirements(scenario))
