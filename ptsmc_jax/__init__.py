"""Differentiable simulator of prescribed-time sliding mode control for spacecraft attitude.

Start with `read` and `simulate`. The names below are imported at their first use, so that importing the package does
not import JAX.
"""

import importlib
from typing import TYPE_CHECKING, Any

__version__ = "0.1.0"

# module: names
_NAMES = {
    "campaigns.montecarlo": "one run",
    "declare": "gain number",
    "devices.attitude_sensors": "AttitudeSensor",
    "devices.custom_sensors": "SampledSensor",
    "devices.sensors": "Sensors",
    "dispersions.base": "Draw",
    "dispersions.variation": "Dispersion",
    "explore": "identify lower_bound simulate trials verdicts write",
    "identification.estimation": "Identification",
    "laws.base": "AccelerationLaw",
    "laws.kinematics": "AdditiveKinematics ChainKinematics MultiplicativeKinematics SecondOrderKinematics",
    "laws.prescribed_time": "PrescribedTime PrescribedTimeChain",
    "observers.base": "NoObserver SampledObserver",
    "observers.finite_time": "FiniteTimeObserver",
    "observers.nonlinear": "NonlinearObserver",
    "observers.prescribed_time": "PrescribedTimeObserver",
    "onboard.folder": "export",
    "plants.integrator_chain": "Chain chain",
    "plants.rigid_body": "AttitudeState Spacecraft spacecraft",
    "plants.second_order": "System system",
    "scenario": "Study from_tables read replace study",
    "scenario.errors": "ScenarioError",
    "scenario.reading": "in_scenario",
    "scenario.tables": "Scenario",
    "scenario.timing": "Reach reach_of",
    "signals.disturbances": "Constant Disturbance Sinusoid",
    "signals.references": "Fixed Reference Slew Spin Swing Target",
    "simulation.gains": "gains_of with_gains",
    "simulation.metrics": "Metrics",
    "simulation.requirements": "Requirement",
    "simulation.rollout": "Parts Result STATUS simulate_parts",
}
_EXPORTS = {name: module for module, names in _NAMES.items() for name in names.split()}

if TYPE_CHECKING:
    from ptsmc_jax.campaigns.montecarlo import one as one
    from ptsmc_jax.campaigns.montecarlo import run as run
    from ptsmc_jax.declare import gain as gain
    from ptsmc_jax.declare import number as number
    from ptsmc_jax.devices.attitude_sensors import AttitudeSensor as AttitudeSensor
    from ptsmc_jax.devices.custom_sensors import SampledSensor as SampledSensor
    from ptsmc_jax.devices.sensors import Sensors as Sensors
    from ptsmc_jax.dispersions.base import Draw as Draw
    from ptsmc_jax.dispersions.variation import Dispersion as Dispersion
    from ptsmc_jax.explore import identify as identify
    from ptsmc_jax.explore import lower_bound as lower_bound
    from ptsmc_jax.explore import simulate as simulate
    from ptsmc_jax.explore import trials as trials
    from ptsmc_jax.explore import verdicts as verdicts
    from ptsmc_jax.explore import write as write
    from ptsmc_jax.identification.estimation import Identification as Identification
    from ptsmc_jax.laws.base import AccelerationLaw as AccelerationLaw
    from ptsmc_jax.laws.kinematics import AdditiveKinematics as AdditiveKinematics
    from ptsmc_jax.laws.kinematics import ChainKinematics as ChainKinematics
    from ptsmc_jax.laws.kinematics import MultiplicativeKinematics as MultiplicativeKinematics
    from ptsmc_jax.laws.kinematics import SecondOrderKinematics as SecondOrderKinematics
    from ptsmc_jax.laws.prescribed_time import PrescribedTime as PrescribedTime
    from ptsmc_jax.laws.prescribed_time import PrescribedTimeChain as PrescribedTimeChain
    from ptsmc_jax.observers.base import NoObserver as NoObserver
    from ptsmc_jax.observers.base import SampledObserver as SampledObserver
    from ptsmc_jax.observers.finite_time import FiniteTimeObserver as FiniteTimeObserver
    from ptsmc_jax.observers.nonlinear import NonlinearObserver as NonlinearObserver
    from ptsmc_jax.observers.prescribed_time import PrescribedTimeObserver as PrescribedTimeObserver
    from ptsmc_jax.onboard.folder import export as export
    from ptsmc_jax.plants.integrator_chain import Chain as Chain
    from ptsmc_jax.plants.integrator_chain import chain as chain
    from ptsmc_jax.plants.rigid_body import AttitudeState as AttitudeState
    from ptsmc_jax.plants.rigid_body import Spacecraft as Spacecraft
    from ptsmc_jax.plants.rigid_body import spacecraft as spacecraft
    from ptsmc_jax.plants.second_order import System as System
    from ptsmc_jax.plants.second_order import system as system
    from ptsmc_jax.scenario import Study as Study
    from ptsmc_jax.scenario import from_tables as from_tables
    from ptsmc_jax.scenario import read as read
    from ptsmc_jax.scenario import replace as replace
    from ptsmc_jax.scenario import study as study
    from ptsmc_jax.scenario.errors import ScenarioError as ScenarioError
    from ptsmc_jax.scenario.reading import in_scenario as in_scenario
    from ptsmc_jax.scenario.tables import Scenario as Scenario
    from ptsmc_jax.scenario.timing import Reach as Reach
    from ptsmc_jax.scenario.timing import reach_of as reach_of
    from ptsmc_jax.signals.disturbances import Constant as Constant
    from ptsmc_jax.signals.disturbances import Disturbance as Disturbance
    from ptsmc_jax.signals.disturbances import Sinusoid as Sinusoid
    from ptsmc_jax.signals.references import Fixed as Fixed
    from ptsmc_jax.signals.references import Reference as Reference
    from ptsmc_jax.signals.references import Slew as Slew
    from ptsmc_jax.signals.references import Spin as Spin
    from ptsmc_jax.signals.references import Swing as Swing
    from ptsmc_jax.signals.references import Target as Target
    from ptsmc_jax.simulation.gains import gains_of as gains_of
    from ptsmc_jax.simulation.gains import with_gains as with_gains
    from ptsmc_jax.simulation.metrics import Metrics as Metrics
    from ptsmc_jax.simulation.requirements import Requirement as Requirement
    from ptsmc_jax.simulation.rollout import STATUS as STATUS
    from ptsmc_jax.simulation.rollout import Parts as Parts
    from ptsmc_jax.simulation.rollout import Result as Result
    from ptsmc_jax.simulation.rollout import simulate_parts as simulate_parts


def __getattr__(name: str) -> Any:
    if name in _EXPORTS:
        value = getattr(importlib.import_module(f"ptsmc_jax.{_EXPORTS[name]}"), name)
        globals()[name] = value
        return value
    raise AttributeError(f"module 'ptsmc_jax' has no attribute {name!r}")


def __dir__() -> list[str]:
    return sorted({*globals(), *_EXPORTS})
