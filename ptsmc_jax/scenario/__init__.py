"""Read, validate and change scenarios (`reading`), and build the parts of a run from them (`assembly`).

Start with `read`, which returns a `Scenario`, and `study`, which builds its parts. The exports are imported at their
first use, so that `scenario.errors` does not load JAX, and reading a scenario does not load the rollout.
"""

import importlib
from typing import TYPE_CHECKING, Any

if TYPE_CHECKING:
    from ptsmc_jax.scenario.assembly import Study as Study
    from ptsmc_jax.scenario.assembly import catalogue as catalogue
    from ptsmc_jax.scenario.assembly import margin_requirements as margin_requirements
    from ptsmc_jax.scenario.assembly import requirements as requirements
    from ptsmc_jax.scenario.assembly import study as study
    from ptsmc_jax.scenario.errors import ScenarioError as ScenarioError
    from ptsmc_jax.scenario.reading import from_tables as from_tables
    from ptsmc_jax.scenario.reading import read as read
    from ptsmc_jax.scenario.reading import replace as replace
    from ptsmc_jax.scenario.tables import Scenario as Scenario

_EXPORTS = {
    **dict.fromkeys(("Study", "catalogue", "margin_requirements", "requirements", "study"), "assembly"),
    **dict.fromkeys(("from_tables", "read", "replace"), "reading"),
    "ScenarioError": "errors",
    "Scenario": "tables",
}


def __getattr__(name: str) -> Any:
    """Import an export at its first use."""
    if name in _EXPORTS:
        return getattr(importlib.import_module(f"ptsmc_jax.scenario.{_EXPORTS[name]}"), name)
    raise AttributeError(f"module 'ptsmc_jax.scenario' has no attribute {name!r}")


def __dir__() -> list[str]:
    return [*globals(), *_EXPORTS]
