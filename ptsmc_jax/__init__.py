"""Differentiable simulator of prescribed-time sliding mode control for spacecraft attitude.

The names below are loaded when first used: importing the package does not import JAX.
"""

import importlib
from typing import TYPE_CHECKING, Any

__version__ = "0.1.0"

# name: module
_EXPORTS = {
    "AttitudeState": "plants",
    "Spacecraft": "plants",
    "spacecraft": "plants",
    "Constant": "signals",
    "Fixed": "signals",
    "Sinusoid": "signals",
    "Slew": "signals",
    "Spin": "signals",
    "Swing": "signals",
    "Target": "signals",
    "Chain": "plants",
    "chain": "plants",
    "PrescribedTime": "controllers",
    "PrescribedTimeChain": "controllers",
    "NoObserver": "observers",
    "NonlinearObserver": "observers",
    "Sensors": "sensors",
    "Parts": "rollout",
    "Result": "rollout",
    "STATUS": "rollout",
    "simulate": "explore",
    "floor": "explore",
    "trials": "explore",
    "verdicts": "explore",
    "read": "scenario",
    "replace": "scenario",
    "simulate_jit": "rollout",
    "Metrics": "metrics",
    "Dispersion": "dispersions",
    "Requirement": "requirements",
    "Scenario": "tables",
    "ScenarioError": "schema",
    "PrescribedTimeMultiplicative": "controllers",
    "PrescribedTimeSystem": "controllers",
    "FiniteTimeObserver": "observers",
    "PrescribedTimeObserver": "observers",
    "System": "plants",
    "system": "plants",
    "Study": "scenario",
    "study": "scenario",
}

if TYPE_CHECKING:
    from ptsmc_jax.controllers import PrescribedTime as PrescribedTime
    from ptsmc_jax.controllers import PrescribedTimeChain as PrescribedTimeChain
    from ptsmc_jax.controllers import PrescribedTimeMultiplicative as PrescribedTimeMultiplicative
    from ptsmc_jax.controllers import PrescribedTimeSystem as PrescribedTimeSystem
    from ptsmc_jax.dispersions import Dispersion as Dispersion
    from ptsmc_jax.explore import floor as floor
    from ptsmc_jax.explore import simulate as simulate
    from ptsmc_jax.explore import trials as trials
    from ptsmc_jax.explore import verdicts as verdicts
    from ptsmc_jax.metrics import Metrics as Metrics
    from ptsmc_jax.observers import FiniteTimeObserver as FiniteTimeObserver
    from ptsmc_jax.observers import NonlinearObserver as NonlinearObserver
    from ptsmc_jax.observers import NoObserver as NoObserver
    from ptsmc_jax.observers import PrescribedTimeObserver as PrescribedTimeObserver
    from ptsmc_jax.plants import AttitudeState as AttitudeState
    from ptsmc_jax.plants import Chain as Chain
    from ptsmc_jax.plants import Spacecraft as Spacecraft
    from ptsmc_jax.plants import System as System
    from ptsmc_jax.plants import chain as chain
    from ptsmc_jax.plants import spacecraft as spacecraft
    from ptsmc_jax.plants import system as system
    from ptsmc_jax.requirements import Requirement as Requirement
    from ptsmc_jax.rollout import STATUS as STATUS
    from ptsmc_jax.rollout import Parts as Parts
    from ptsmc_jax.rollout import Result as Result
    from ptsmc_jax.rollout import simulate_jit as simulate_jit
    from ptsmc_jax.scenario import Study as Study
    from ptsmc_jax.scenario import read as read
    from ptsmc_jax.scenario import replace as replace
    from ptsmc_jax.scenario import study as study
    from ptsmc_jax.schema import ScenarioError as ScenarioError
    from ptsmc_jax.sensors import Sensors as Sensors
    from ptsmc_jax.signals import Constant as Constant
    from ptsmc_jax.signals import Fixed as Fixed
    from ptsmc_jax.signals import Sinusoid as Sinusoid
    from ptsmc_jax.signals import Slew as Slew
    from ptsmc_jax.signals import Spin as Spin
    from ptsmc_jax.signals import Swing as Swing
    from ptsmc_jax.signals import Target as Target
    from ptsmc_jax.tables import Scenario as Scenario


def __getattr__(name: str) -> Any:
    if name in _EXPORTS:
        value = getattr(importlib.import_module(f"ptsmc_jax.{_EXPORTS[name]}"), name)
        globals()[name] = value
        return value
    raise AttributeError(f"module 'ptsmc_jax' has no attribute {name!r}")


def __dir__() -> list[str]:
    return [*globals(), *_EXPORTS]
