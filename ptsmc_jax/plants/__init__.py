"""Plants: rigid and flexible spacecraft, chains of integrators, custom second-order systems."""

from ptsmc_jax.plants.flexible_body import FlexibleSpacecraft, Modes, flexible
from ptsmc_jax.plants.integrator_chain import Chain, chain
from ptsmc_jax.plants.rigid_body import AttitudeState, Spacecraft, spacecraft
from ptsmc_jax.plants.second_order import HiddenSystem, System, system

__all__ = [
    "AttitudeState",
    "Chain",
    "FlexibleSpacecraft",
    "HiddenSystem",
    "Modes",
    "Spacecraft",
    "System",
    "chain",
    "flexible",
    "spacecraft",
    "system",
]
