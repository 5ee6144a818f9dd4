"""The disturbances of a scenario file: each a table with its keys, its pace, and what it is made into.

A disturbance is its physics in `signals.disturbances`, a table here, and a row in `DISTURBANCES`.
"""

import dataclasses
from collections.abc import Mapping
from typing import Annotated, Any, ClassVar, Literal

import numpy as np
from msgspec import Meta

from ptsmc_jax.scenario import attitude_keys, disturbance_bounds
from ptsmc_jax.scenario.attitude_keys import Attitude
from ptsmc_jax.scenario.disturbance_bounds import Bounds
from ptsmc_jax.scenario.errors import ScenarioError, brief
from ptsmc_jax.scenario.own import Code, Own, build, fastest
from ptsmc_jax.scenario.values import (
    ABSENT,
    Each,
    EachNotNegative,
    Kind,
    Kinds,
    Number,
    ResolvedThree,
    Scaled,
    Three,
    ThreeNotNegative,
)


class DisturbanceTable(Kind, frozen=True):
    """A disturbance, alone or one of several."""

    sampled_only: ClassVar[bool] = False

    def placed(self, name: str) -> dict[str, Any]:
        """The disturbances that act at once, by where a file has them; name: of this table."""
        return {name: self}

    def quickest(self) -> float:
        """How fast it changes [rad/s]."""
        return 0.0

    def impulse(self, end: float) -> float:
        """What it adds up to at most until `end` [s], in N m s; nothing of what stays small however long it acts."""
        return 0.0

    def bounds(self, scenario: Any) -> Bounds | None:
        """Largest size and rate of each component, also where it is drawn; None: not known before its code is run."""
        return Bounds(np.zeros(scenario.inputs), np.zeros(scenario.inputs))

    def check(self, name: str) -> None:
        """Raise ScenarioError where its keys contradict each other; name: of its table."""

    def build(self, inertia: Any) -> Any:
        """What acts, a part of `signals.disturbances`; None: nothing. inertia: the true body's; None without one."""

    def walk(self, period: float) -> Any:
        """1 sigma a second of its random walk, a number for each input; None: none."""


class NoDisturbance(DisturbanceTable, frozen=True):
    """Nothing disturbs."""

    kind: Literal["none"] = "none"


class ConstantDisturbance(DisturbanceTable, frozen=True):
    """A constant torque.

    Attributes:
        amplitude: the torque, per body axis; default: 0.01 each, scaled to the mission [N m]
    """

    kind: Literal["constant"] = "constant"
    amplitude: ResolvedThree = ABSENT
    scaled: ClassVar[Mapping[str, Scaled]] = {"amplitude": Scaled((0.01, 0.01, 0.01), inertia=1, time=-2)}

    def impulse(self, end: float) -> float:
        """It acts all the time."""
        return float(np.linalg.norm(np.abs(self.amplitude) * end))

    def bounds(self, scenario: Any) -> Bounds:
        """Its size; it does not change."""
        size = np.abs(self.amplitude) * disturbance_bounds.drawn_factor(scenario)
        return Bounds(size, np.zeros_like(size))

    def build(self, inertia: Any) -> Any:
        """`disturbances.Constant`."""
        from ptsmc_jax.numerics.pytrees import vector
        from ptsmc_jax.signals.disturbances import Constant

        return Constant(vector(self.amplitude))


class SinusoidDisturbance(DisturbanceTable, frozen=True):
    """The torque bias + amplitude sin(frequency t + phase), axis by axis.

    Attributes:
        amplitude: per body axis; default: 0.01 each, scaled to the mission [N m]
        frequency: per axis; default: 0.1 each, scaled to the mission [rad/s]
        phase: per axis [rad]
        bias: constant part, per axis [N m]
    """

    kind: Literal["sinusoid"] = "sinusoid"
    amplitude: ResolvedThree = ABSENT
    frequency: ResolvedThree = ABSENT
    phase: Three = (0.0, 0.0, 0.0)
    bias: Three = (0.0, 0.0, 0.0)
    scaled: ClassVar[Mapping[str, Scaled]] = {
        "amplitude": Scaled((0.01, 0.01, 0.01), inertia=1, time=-2),
        "frequency": Scaled((0.1, 0.1, 0.1), time=-1),
    }

    def quickest(self) -> float:
        """Its fastest axis."""
        return float(np.max(np.abs(self.frequency)))

    def impulse(self, end: float) -> float:
        """Half a period at most, and the constant part."""
        lasting = np.minimum(end, 2.0 / np.maximum(np.abs(self.frequency), 1e-12))
        return float(np.linalg.norm(np.abs(self.amplitude) * lasting) + np.linalg.norm(self.bias) * end)

    def bounds(self, scenario: Any) -> Bounds:
        """|bias| + |amplitude|, and |amplitude frequency|: of any phase."""
        swing = np.abs(self.amplitude) * disturbance_bounds.drawn_factor(scenario)
        if not len(swing) == len(self.frequency) == len(self.bias):
            return Bounds(np.zeros(0), np.zeros(0))  # which `checks` refuses
        return Bounds(np.abs(self.bias) + swing, swing * np.abs(self.frequency))

    def build(self, inertia: Any) -> Any:
        """`disturbances.Sinusoid`."""
        from ptsmc_jax.numerics.pytrees import vector
        from ptsmc_jax.signals.disturbances import Sinusoid

        return Sinusoid(*(vector(value) for value in (self.amplitude, self.frequency, self.phase, self.bias)))


class GravityGradient(Attitude, DisturbanceTable, frozen=True):
    """The gravity gradient of a circular orbit, on the body that flies; the attitude key is that of the orbit's frame.

    The frame's z is along the orbit's normal, its x points to where the phase counts from.

    Attributes:
        orbit_rate: mean motion [rad/s]
        phase: where on the orbit the run starts [rad]
    """

    kind: Literal["gravity_gradient"] = "gravity_gradient"
    orbit_rate: Annotated[float, Meta(gt=0, le=1, description="a number greater than 0 and at most 1")] = 1.1e-3
    phase: Number = 0.0

    def check(self, name: str) -> None:
        """One attitude at most."""
        attitude_keys.at_most_one(name, self)
        if attitude_keys.has_attitude(self):
            attitude_keys.quaternion(self, name)
        elif self.sequence is not None:
            raise ScenarioError(f"{name}.sequence is {brief(self.sequence)}, but goes with euler_deg only")

    def bounds(self, scenario: Any) -> Bounds | None:
        """See `disturbance_bounds.gravity_gradient`."""
        if disturbance_bounds.target_waits(scenario):
            return None
        return disturbance_bounds.gravity_gradient(scenario, self.orbit_rate)

    def build(self, inertia: Any) -> Any:
        """`disturbances.GravityGradient`; the orbit's frame is the inertial one where no attitude is given."""
        from ptsmc_jax.numerics.pytrees import vector
        from ptsmc_jax.signals import disturbances

        turned = attitude_keys.has_attitude(self)
        orbit = attitude_keys.quaternion(self, "disturbance") if turned else np.array([0.0, 0.0, 0.0, 1.0])
        return disturbances.GravityGradient(inertia, *(vector(value) for value in (orbit, self.orbit_rate, self.phase)))


class RandomWalk(DisturbanceTable, frozen=True):
    """A torque that wanders from zero, a new step each period; sampled loop only.

    Attributes:
        density: of the walk's white noise, per axis; default: 1e-4 each, scaled to the mission [N m/sqrt(s)]
    """

    kind: Literal["random_walk"] = "random_walk"
    density: ThreeNotNegative | None = None
    scaled: ClassVar[Mapping[str, Scaled]] = {"density": Scaled((1e-4, 1e-4, 1e-4), inertia=1, time=-2.5)}
    sampled_only: ClassVar[bool] = True

    def bounds(self, scenario: Any) -> Bounds:
        """Three sigma at the end of the run, and `disturbance_bounds.walk_rate`."""
        density = np.asarray(self.density)
        wandered = disturbance_bounds.SIGMAS * density * np.sqrt(scenario.loop.t_end)
        return Bounds(wandered, disturbance_bounds.walk_rate(scenario, density))

    def walk(self, period: float) -> Any:
        """Steps of white noise, held over a period."""
        from ptsmc_jax.numerics.pytrees import vector

        return vector(self.density) / np.sqrt(period)


TERMS = 'a list of tables such as [{ kind = "constant" }]'


class SumDisturbance(Kind, frozen=True):
    """Several disturbances at once.

    Attributes:
        terms: the disturbances, each an inline table with a kind of its own; needed
    """

    kind: Literal["sum"] = "sum"
    terms: Annotated[tuple[Any, ...], Meta(description=TERMS)] = ()

    def placed(self, name: str) -> dict[str, Any]:
        """The terms of the sum."""
        return {f"{name}.terms[{k}]": term for k, term in enumerate(self.terms)}


class EachRandomWalk(RandomWalk, frozen=True):
    """A disturbance that wanders from zero, a new step each period; sampled loop only.

    Attributes:
        density: of the walk's white noise, one number for each input; default: 1e-4 each, scaled to the mission
            [unit of d/sqrt(s)]
    """

    density: EachNotNegative | None = None  # pyright: ignore[reportIncompatibleVariableOverride]
    scaled: ClassVar[Mapping[str, Scaled]] = {"density": Scaled(1e-4, time=-0.5, order=-1, each=True)}


class EachConstant(ConstantDisturbance, frozen=True):
    """A constant disturbance.

    Attributes:
        amplitude: one number for each input; default: 0.01 each, scaled to the mission [unit of d]
    """

    amplitude: Each | None = None  # pyright: ignore[reportIncompatibleVariableOverride]
    scaled: ClassVar[Mapping[str, Scaled]] = {"amplitude": Scaled(0.01, order=-1, each=True)}


class EachSinusoid(SinusoidDisturbance, frozen=True):
    """The disturbance bias + amplitude sin(frequency t + phase), input by input.

    Attributes:
        amplitude: one number for each input; default: 0.01 each, scaled to the mission [unit of d]
        frequency: one for each; default: 1 each, scaled to the mission [rad/s]
        phase: one for each; default: 0 each [rad]
        bias: constant part, one for each; default: 0 each [unit of d]
    """

    amplitude: Each | None = None  # pyright: ignore[reportIncompatibleVariableOverride]
    frequency: Each | None = None  # pyright: ignore[reportIncompatibleVariableOverride]
    phase: Each | None = None  # pyright: ignore[reportIncompatibleVariableOverride]
    bias: Each | None = None  # pyright: ignore[reportIncompatibleVariableOverride]
    scaled: ClassVar[Mapping[str, Scaled]] = {
        "amplitude": Scaled(0.01, order=-1, each=True),
        "frequency": Scaled(1.0, time=-1, each=True),
        "phase": Scaled(0.0, each=True),
        "bias": Scaled(0.0, each=True),
    }


class OwnDisturbance(Own, DisturbanceTable, kw_only=True, frozen=True):
    """A disturbance of one's own, a class derived from ptsmc_jax.Disturbance; its fields are further keys."""

    kind: Literal["own"] = "own"
    code: Code
    needs: ClassVar[tuple[str, ...]] = ("__call__",)

    @classmethod
    def base(cls) -> type:
        """`signals.disturbances.Disturbance`."""
        from ptsmc_jax.signals.disturbances import Disturbance

        return Disturbance

    def quickest(self) -> float:
        """What its method `fastest` says; 0 before its code is run."""
        return 0.0 if self.waits else fastest(self, "disturbance", build(self))

    def bounds(self, scenario: Any) -> Bounds | None:
        """See `disturbance_bounds.along_the_run`."""
        if self.waits or disturbance_bounds.target_waits(scenario):
            return None
        return disturbance_bounds.along_the_run(scenario, self.build(None), self.quickest())

    def build(self, inertia: Any) -> Any:
        """What the code names; raises ScenarioError where it says of no field of its own that it is drawn."""
        made = build(self)
        fields = tuple(field.name for field in dataclasses.fields(made))
        known = isinstance(made.drawn, Mapping) and all(
            what in ("phase", "amplitude") and name in fields for what, name in made.drawn.items()
        )
        if not known:
            raise ScenarioError(
                f"disturbance.code names a class {type(made).__name__} whose drawn is {brief(made.drawn)}, but must "
                'name fields of it by "phase" and "amplitude"'
            )
        return made


_EACH: Kinds = {
    "sinusoid": EachSinusoid,
    "constant": EachConstant,
    "random_walk": EachRandomWalk,
    "own": OwnDisturbance,
    "sum": SumDisturbance,
}
# by the kind of the plant and the kind of the disturbance, the default first
DISTURBANCES: dict[str, Mapping[str, type[Kind]]] = {
    "spacecraft": {
        "sinusoid": SinusoidDisturbance,
        "none": NoDisturbance,
        "constant": ConstantDisturbance,
        "gravity_gradient": GravityGradient,
        "random_walk": RandomWalk,
        "own": OwnDisturbance,
        "sum": SumDisturbance,
    },
    "chain": {"sinusoid": EachSinusoid, "none": NoDisturbance, **_EACH},
    "system": {"none": NoDisturbance, **_EACH},
}
