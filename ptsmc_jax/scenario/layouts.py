"""The tables of scenario files by the kind of their plant, and the kinds of each dispersion.

A new kind of plant needs a row in `SCENARIOS`.
"""

from collections.abc import Mapping

import msgspec

from ptsmc_jax.scenario.device_tables import COMMAND_FILTERS
from ptsmc_jax.scenario.dispersion_tables import DISPERSIONS as DISPERSIONS
from ptsmc_jax.scenario.spacecraft_scenario import SpacecraftScenario
from ptsmc_jax.scenario.state_scenario import ChainScenario, SystemScenario
from ptsmc_jax.scenario.tables import Scenario
from ptsmc_jax.scenario.values import Kinds, Table

# scenario classes by the kind of the plant, the default first
SCENARIOS: dict[str, type[Scenario]] = {
    "spacecraft": SpacecraftScenario,
    "chain": ChainScenario,
    "system": SystemScenario,
}
TABLES: dict[str, Mapping[str, type[Table] | Kinds]] = {
    kind: scenario_class.TABLES for kind, scenario_class in SCENARIOS.items()
}
# tables that are off if they are absent
OPTIONAL = {one.name for made in SCENARIOS.values() for one in msgspec.structs.fields(made) if not one.required}
KINDS: dict[str, Kinds] = {  # keys that are an inline table with a kind
    "hardware.command_filter": COMMAND_FILTERS,
    **{f"dispersion.{key}": kinds for key, kinds in DISPERSIONS.items()},
}
