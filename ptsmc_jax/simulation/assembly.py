"""What a run is made of."""

from dataclasses import dataclass, field, replace
from typing import Any

from ptsmc_jax.devices.actuators import Actuators
from ptsmc_jax.numerics.pytrees import Leaf, pytree
from ptsmc_jax.plants.base import Plant
from ptsmc_jax.simulation.clock import Anchored, Flight, Graded


@pytree
@dataclass(frozen=True)
class Parts:
    """Everything a run is made of. `plant` is the truth; controller and observer hold their own, nominal model."""

    plant: Plant
    disturbance: Any  # callable: t [s], true state -> (m,) [N m]
    reference: Any  # callable: t [s] -> what the law is to reach, a Target for spacecraft
    controller: Any  # laws.Law
    observer: Any  # observers.Observer
    sensors: Any  # sensors.Sensor, or None: the law sees the true state
    clock: Anchored | Flight | Graded  # Graded: continuous loop; the others: sampled
    initial: Any  # state of the plant
    t_end: Leaf  # [s]
    window: Leaf  # after t_f, for window_error [s]
    settling_angle: Leaf  # [rad]
    actuators: Actuators | None = None  # None: the torque is the commanded one, held over a period
    walk_rate: Leaf | None = None  # (m,) 1 sigma of a random walk's change per second of a period [N m/s]
    substeps: int = field(default=1, metadata={"static": True})  # RK4 steps of the plant a control period

    def with_t_f(self, t_f: Leaf) -> "Parts":
        """The parts with another prescribed time [s]; the time after it is kept."""
        t_end = t_f + (self.t_end - self.controller.t_f)
        law, timing = replace(self.controller, t_f=t_f), replace(self.clock, t_end=t_end)
        return replace(self, controller=law, clock=timing, t_end=t_end)
