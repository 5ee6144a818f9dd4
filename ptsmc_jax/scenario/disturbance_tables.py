"""The table [disturbance] of scenario files: bounds of each kind, and the classes by kind in `DISTURBANCES`.

The numbers of a disturbance are declared in `signals.disturbances`. Start with `DisturbanceTable`.
"""

import dataclasses
from collections.abc import Mapping
from typing import Annotated, Any, ClassVar, Literal

import jax
import msgspec
import numpy as np
from msgspec import Meta

from ptsmc_jax.declare import Scaled
from ptsmc_jax.numerics.pytrees import vector
from ptsmc_jax.scenario import attitude_keys, disturbance_bounds
from ptsmc_jax.scenario.attitude_keys import Attitude
from ptsmc_jax.scenario.custom import Custom, custom_kind, fastest_rate
from ptsmc_jax.scenario.disturbance_bounds import Bounds
from ptsmc_jax.scenario.errors import ScenarioError, brief, wrong
from ptsmc_jax.scenario.schema import PartTable, make_table
from ptsmc_jax.scenario.values import Meaning, Table
from ptsmc_jax.signals import disturbances

CIRCULAR_RATE = 1.1e-3  # mean motion of an orbit of 550 km [rad/s]


class DisturbanceTable(PartTable, frozen=True):
    """A disturbance, alone or one of several."""

    sampled_only: ClassVar[bool] = False

    def tables_by_name(self, name: str) -> dict[str, Any]:
        """Return the disturbances of this table by their names in a file; `name`: name of this table."""
        return {name: self}

    def largest_frequency(self) -> float:
        """Return the largest angular frequency of the disturbance [rad/s], 0 if its custom code has not run yet."""
        if self.part_class is None:
            return 0.0
        return fastest_rate(self, "disturbance", self.part() if isinstance(self, Custom) else self)

    def impulse(self, end: float) -> float:
        """Return a bound on the integral of the disturbance until `end` [s], in N m s.

        It is 0 if the integral is neglected.
        """
        return 0.0 if self.part_class is None else self.part_class.impulse(self, end)

    def bounds(self, scenario: Any) -> Bounds | None:
        """Return the largest magnitude and rate of each component, dispersions included.

        The result is None if custom code that determines it has not run yet.
        """
        if self.part_class is None or disturbance_bounds.has_unloaded_reference(scenario):
            return None
        if isinstance(self, Custom):
            return disturbance_bounds.path_bounds(scenario, self.build(None, scenario), self.largest_frequency())
        numbers: Any = self
        largest = np.abs(numbers.amplitude) * disturbance_bounds.largest_factor(scenario)
        return Bounds(*self.part_class.bounds(msgspec.structs.replace(numbers, amplitude=largest)))

    def check(self, name: str, scenario: Any) -> None:
        """Raise ScenarioError if keys contradict each other; `name`: the table's name, for errors."""

    def build(self, inertia: Any, scenario: Any) -> Any:
        """Return the part of `signals.disturbances`, None if nothing acts.

        `inertia` is the inertia of the true body (3, 3) [kg m^2], None for a plant without a body. ScenarioError is
        raised if a custom class declares random numbers that are not fields.
        """
        part = self.part()
        fields = tuple(field.name for field in dataclasses.fields(part))
        is_valid = isinstance(part.drawn, Mapping) and all(
            quantity in ("phase", "amplitude") and name in fields for quantity, name in part.drawn.items()
        )
        if not is_valid:
            raise ScenarioError(
                f"disturbance.code names a class {type(part).__name__} whose drawn is {brief(part.drawn)}, but must "
                'name fields of it by "phase" and "amplitude"'
            )
        return part

    def walk(self, period: float) -> Any:
        """Return the rate of the random walk, 1 sigma per second for each input (m,), None if there is none.

        `period` is the control period [s].
        """


class NoDisturbance(DisturbanceTable, frozen=True):
    """No disturbance."""

    kind: Literal["none"] = "none"

    def bounds(self, scenario: Any) -> Bounds:
        """Return zeros."""
        return Bounds(np.zeros(scenario.inputs), np.zeros(scenario.inputs))

    def build(self, inertia: Any, scenario: Any) -> Any:
        """Return None."""


class GravityTable(Attitude, DisturbanceTable, frozen=True):
    """The gravity gradient of the orbit of [orbit], or of a circular orbit."""

    @property
    def rate(self) -> float:
        """Mean motion of the circular orbit without [orbit] [rad/s]."""
        orbit_rate: float | None = self.orbit_rate  # pyright: ignore[reportAttributeAccessIssue]
        return CIRCULAR_RATE if orbit_rate is None else orbit_rate

    def check(self, name: str, scenario: Any) -> None:
        """Raise ScenarioError for two attitudes, an invalid attitude, and a second orbit beside [orbit]."""
        attitude_keys.check_single_attitude(name, self)
        if scenario.orbit is not None:
            numbers: Any = self
            replaced = {key: getattr(self, key) for key in (*attitude_keys.ATTITUDE_KEYS, "orbit_rate")}
            replaced |= {"phase": numbers.phase or None}
            for key, value in replaced.items():
                if value is not None:
                    raise wrong(f"{name}.{key}", value, "absent: [orbit] determines the gravity gradient")
        if attitude_keys.stated_keys(self):
            attitude_keys.quaternion(self, name)
        elif self.sequence is not None:
            raise ScenarioError(
                f"{name}.sequence is {brief(self.sequence)}, but is allowed only together with euler_deg"
            )

    def largest_frequency(self) -> float:
        """Return 0, since an orbit is slow compared with the loop."""
        return 0.0

    def impulse(self, end: float) -> float:
        """Return 0: the integral of the torque is neglected."""
        return 0.0

    def bounds(self, scenario: Any) -> Bounds | None:
        """Return the bounds of `disturbance_bounds.gravity_gradient`."""
        if disturbance_bounds.has_unloaded_reference(scenario):
            return None
        if scenario.orbit is None:
            return disturbance_bounds.gravity_gradient(scenario, self.rate)
        orbit = scenario.orbit.build(scenario.loop.epoch)
        return disturbance_bounds.gravity_gradient(scenario, float(orbit.rate()), float(orbit.eccentricity))

    def build(self, inertia: Any, scenario: Any) -> Any:
        """Return the gravity gradient.

        Without [orbit], the frame of the circular orbit is the inertial frame if no attitude is given.
        """
        if scenario.orbit is not None:
            orbit = jax.tree.map(vector, scenario.orbit.build(scenario.loop.epoch))
            return disturbances.KeplerGravityGradient(inertia, orbit)
        has_attitude = attitude_keys.stated_keys(self)
        orbit = attitude_keys.quaternion(self, "disturbance") if has_attitude else np.array([0.0, 0.0, 0.0, 1.0])
        return self.part(inertia=inertia, orbit=vector(orbit), orbit_rate=vector(self.rate))


class RandomWalkTable(DisturbanceTable, frozen=True):
    """A disturbance that wanders from zero."""

    sampled_only: ClassVar[bool] = True

    def bounds(self, scenario: Any) -> Bounds:
        """Return three sigma at the end of the run, and a bound on the rate of the walk, which has no exact bound.

        It is three sigma of the change of the walk over the time constant J / l of the default observer, divided by
        that time constant. With this c, K2 = c J / l covers three sigma of the estimate's error.
        """
        density = disturbance_bounds.SIGMAS * np.asarray(self.density)  # pyright: ignore[reportAttributeAccessIssue]
        time_constant = 1.0 / disturbance_bounds.observer_rate(scenario)
        return Bounds(density * np.sqrt(scenario.loop.t_end), density / np.sqrt(time_constant))

    def build(self, inertia: Any, scenario: Any) -> Any:
        """Return None: the rollout adds the steps of the walk."""

    def walk(self, period: float) -> Any:
        """Return the density over the square root of the period: white noise that is held over a period."""
        return vector(self.density) / np.sqrt(period)  # pyright: ignore[reportAttributeAccessIssue]


TERMS_TEXT = 'a list of tables such as [{ kind = "constant" }]'


class SumDisturbance(Table, frozen=True):
    """Several disturbances at once."""

    kind: Literal["sum"] = "sum"
    terms: Annotated[
        Annotated[tuple[Any, ...], Meta(description=TERMS_TEXT)],
        Meaning("the disturbances, each an inline table with its kind; required"),
    ] = ()

    def fill_defaults(self, scenario: Any) -> Any:
        """Return the table itself."""
        return self

    def tables_by_name(self, name: str) -> dict[str, Any]:
        """Return the terms of the sum by their names in a file, such as disturbance.terms[0]."""
        return {f"{name}.terms[{k}]": term for k, term in enumerate(self.terms)}


def without_sums(kinds: Mapping[str, type[Table]]) -> dict[str, type[Table]]:
    """Return the kinds of disturbances that a sum may contain."""
    return {kind: struct for kind, struct in kinds.items() if struct is not SumDisturbance}


def _disturbance_kinds(default_kind: str, body: bool) -> Mapping[str, type[Table]]:
    """Return the disturbances by kind; `body`: whether the plant is a spacecraft."""
    changes = () if body else (("frequency", Scaled(1.0, time=-1, each=True)),)  # as in the paper's Figs. 1 and 2
    kinds: dict[str, Any] = {
        "sinusoid": make_table(DisturbanceTable, disturbances.Sinusoid, "sinusoid", body, changes),
        "none": NoDisturbance,
        "constant": make_table(DisturbanceTable, disturbances.Constant, "constant", body),
        "gravity_gradient": make_table(GravityTable, disturbances.GravityGradient, "gravity_gradient"),
        "random_walk": make_table(RandomWalkTable, disturbances.RandomWalk, "random_walk", body),
        "custom": custom_kind(
            DisturbanceTable, disturbances.Disturbance, ("__call__",),
            "A custom disturbance, a class derived from ptsmc_jax.Disturbance; its fields are further keys.",
        ),
        "sum": SumDisturbance,
    }  # fmt: skip
    return {kind: kinds[kind] for kind in (default_kind, *kinds) if body or kind != "gravity_gradient"}


# by the kind of the plant and the kind of the disturbance, the default first
DISTURBANCES = {
    "spacecraft": _disturbance_kinds("sinusoid", body=True),
    "chain": _disturbance_kinds("sinusoid", body=False),
    "system": _disturbance_kinds("none", body=False),
}
