"""The parts of a run."""

from dataclasses import dataclass, field, replace
from typing import Any

import jax.numpy as jnp
from jax.tree_util import Partial
from jaxtyping import PyTree

from ptsmc_jax.devices.actuators import Actuators
from ptsmc_jax.devices.command_filter import CommandFilter
from ptsmc_jax.devices.sensors import PerfectSensors
from ptsmc_jax.numerics.pytrees import Function, Leaf, is_function, pytree
from ptsmc_jax.plants.base import Plant
from ptsmc_jax.plants.rigid_body import spacecraft
from ptsmc_jax.signals import disturbances
from ptsmc_jax.simulation.pointing import Pointing


@pytree
@dataclass(frozen=True, kw_only=True)
class Parts:
    """All parts of a run. `plant` is the true plant; law and observer have the design model."""

    plant: Plant
    disturbance: Any  # function: t [s], true state -> (m,) [N m]
    reference: Any  # function: t [s] -> target of the law, a `references.Target` for spacecraft
    controller: Any  # laws.base.Law
    observer: Any  # observers.base.Observer
    sensors: Any = field(default_factory=PerfectSensors)  # sensors.Sensor
    initial: PyTree  # state of the plant
    t_end: Leaf  # [s]
    window: Leaf  # length of the window after t_f, for window_error [s]
    settling_angle: Leaf  # a run has settled when its angle stays below this limit, for `settling_time` [rad]
    actuators: Actuators = field(default_factory=Actuators)  # by default they hold the commanded torque over a period
    walk_rate: Leaf | None = None  # (m,) 1 sigma of the disturbance's random-walk step, divided by the period [N m/s]
    command_filter: CommandFilter | None = None  # filter between the law and the actuators
    jitter: Leaf | None = None  # largest error of a sample time, as a fraction of the control period [-]
    pointing: Pointing | None = None  # observation of pointing errors; None: the run has no pointing metrics
    clock: Any = None  # `clock.Sampled`, or `Graded` for the continuous loop; None: not chosen yet
    substeps: int = field(default=1, metadata={"static": True})  # RK4 steps of the plant in a control period

    def __post_init__(self) -> None:
        """Wrap functions of time as pytrees."""
        if isinstance(self.reference, Partial) or is_function(self.reference):
            object.__setattr__(self, "reference", self.controller.kinematics.reference_from(self.reference))
        if is_function(self.disturbance):
            object.__setattr__(self, "disturbance", Function(self.disturbance))

    @property
    def aligned_initial(self) -> PyTree:
        """The initial state as the law needs it, for example with the other sign of q, see `Kinematics.align`."""
        return self.controller.kinematics.align(self.initial, self.reference(jnp.zeros_like(self.t_end)))

    @property
    def period(self) -> Leaf:
        """The control period of a sampled loop [s]."""
        return self.clock.period

    def with_t_f(self, t_f: Leaf) -> "Parts":
        """Return the parts with another prescribed time [s]; t_end moves with it."""
        t_end = t_f + (self.t_end - self.controller.t_f)
        clock = None if self.clock is None else replace(self.clock, t_end=t_end)
        return replace(self, controller=replace(self.controller, t_f=t_f), t_end=t_end, clock=clock)

    def with_inertia(self, inertia: Any, *, known: bool = True) -> "Parts":
        """Return the parts of a spacecraft with another inertia, for the true body and its gravity gradient.

        Args:
            inertia: [kg m^2], see `spacecraft`; it may be traced.
            known: whether the design model of the law and the observer gets the inertia, too.

        Raises:
            ValueError: a plant has no inertia.
        """
        body = spacecraft(inertia)

        def with_new_inertia(plant: Any, name: str) -> Any:
            if not hasattr(plant, "with_inertia"):
                raise ValueError(f"the {name} is a {type(plant).__name__}, but with_inertia needs a spacecraft")
            return plant.with_inertia(body.inertia, body.inertia_inverse)

        disturbance_on_body = disturbances.on_body(self.disturbance, body.inertia)
        changes = {"plant": with_new_inertia(self.plant, "plant"), "disturbance": disturbance_on_body}
        if known:
            law, observer = self.controller, self.observer
            kinematics = replace(law.kinematics, model=with_new_inertia(law.model, "model of the controller"))
            changes["controller"] = replace(law, kinematics=kinematics)
            if hasattr(observer, "model"):
                changes["observer"] = replace(observer, model=with_new_inertia(observer.model, "model of the observer"))
        return replace(self, **changes)


def check_parts(value: object) -> None:
    """Raise TypeError if the argument is not the parts of a run."""
    if not isinstance(value, Parts):
        raise TypeError(f"parts are needed, such as study(scenario).parts, but this is a {type(value).__name__}")
