"""The table [disturbance] of scenario files: bounds of each kind, and the classes by kind in `DISTURBANCES`.

The numbers of a disturbance are declared in `signals.disturbances`. Start with `DisturbanceTable`.

The bounds of Assumption 1 follow from the disturbance and its dispersions, see `largest_disturbance`. K bounds each
component of d, and c bounds each component of d'. The published bounds, 0.01 N m and 1e-3 N m/s, belong to the
disturbance 0.01 sin(0.1 t) of Case I. The bounds of a sum add up.
"""

import dataclasses
import math
from collections.abc import Mapping
from typing import TYPE_CHECKING, Annotated, Any, ClassVar, Literal, NamedTuple

import jax
import jax.numpy as jnp
import msgspec
import numpy as np
from msgspec import Meta

from ptsmc_jax.declare import Scaled
from ptsmc_jax.numerics import attitude
from ptsmc_jax.numerics.pytrees import vector
from ptsmc_jax.plants.rigid_body import AttitudeState
from ptsmc_jax.scenario import attitude_keys, mission
from ptsmc_jax.scenario.attitude_keys import Attitude
from ptsmc_jax.scenario.custom import Custom, custom_kind, fastest_rate
from ptsmc_jax.scenario.errors import ScenarioError, brief, wrong
from ptsmc_jax.scenario.schema import PartTable, make_table
from ptsmc_jax.scenario.values import MOST_STEPS, Meaning, Table, rounded
from ptsmc_jax.signals import disturbances

if TYPE_CHECKING:
    from ptsmc_jax.scenario.spacecraft_scenario import SpacecraftScenario
    from ptsmc_jax.scenario.tables import Scenario

CIRCULAR_RATE = 1.1e-3  # mean motion of an orbit of 550 km [rad/s]
PUBLISHED_RATE = 10.0 / 12.0  # l / J of the published observer [1/s], with a mean moment of inertia of 12 kg m^2
SIGMAS = 3.0  # standard deviations that count as the largest value of a normal random number
FEWEST_TIMES = 2001  # smallest number of times at which a custom disturbance is evaluated
LARGEST_PHASE_STEP = 0.1  # largest phase between two of these times [rad]: the error of the derivative is then 0.2 %
PHASE_COUNT = 16  # random phases at which a custom disturbance is evaluated


class Bounds(NamedTuple):
    """Largest magnitude and rate of each component of a disturbance."""

    size: np.ndarray  # (m,) largest magnitude of d [N m, or unit of d]
    rate: np.ndarray  # (m,) largest magnitude of d' [the same per second]


class DisturbanceTable(PartTable, frozen=True):
    """A disturbance, alone or one of several."""

    sampled_only: ClassVar[bool] = False

    def tables_by_name(self, name: str) -> dict[str, "DisturbanceTable"]:
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

    def bounds(self, scenario: "Scenario") -> Bounds | None:
        """Return the largest magnitude and rate of each component, dispersions included.

        The result is None if custom code that determines it has not run yet.
        """
        if self.part_class is None or has_unloaded_reference(scenario):
            return None
        if isinstance(self, Custom):
            return path_bounds(scenario, self.build(None, scenario), self.largest_frequency())
        numbers: Any = self
        largest = np.abs(numbers.amplitude) * (1.0 + largest_deviation(scenario, "disturbance_amplitude"))
        return Bounds(*self.part_class.bounds(msgspec.structs.replace(numbers, amplitude=largest)))

    def check(self, name: str, scenario: "Scenario") -> None:
        """Raise ScenarioError if keys contradict each other; `name`: the table's name, for errors."""

    def build(self, inertia: jax.Array | None, scenario: "Scenario") -> disturbances.Disturbance | None:
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

    def walk(self, period: float) -> jax.Array | None:
        """Return the rate of the random walk, 1 sigma per second for each input (m,), None if there is none.

        `period` is the control period [s].
        """


class NoDisturbance(DisturbanceTable, frozen=True):
    """No disturbance."""

    kind: Literal["none"] = "none"

    def bounds(self, scenario: "Scenario") -> Bounds:
        """Return zeros."""
        return Bounds(np.zeros(scenario.inputs), np.zeros(scenario.inputs))

    def build(self, inertia: jax.Array | None, scenario: "Scenario") -> disturbances.Disturbance | None:
        """Return None."""


class GravityTable(Attitude, DisturbanceTable, frozen=True):
    """The gravity gradient of the orbit of [orbit], or of a circular orbit."""

    @property
    def rate(self) -> float:
        """Mean motion of the circular orbit without [orbit] [rad/s]."""
        orbit_rate: float | None = self.orbit_rate  # pyright: ignore[reportAttributeAccessIssue]
        return CIRCULAR_RATE if orbit_rate is None else orbit_rate

    def check(self, name: str, scenario: Any) -> None:
        """Raise ScenarioError for an invalid attitude, and a second orbit beside [orbit]."""
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

    def bounds(self, scenario: Any) -> Bounds | None:
        """Return bounds of the torque 3 n^2 c x J c, where c is the unit vector to the central body.

        They follow from |c x J c| <= (J_3 - J_1) / 2 and |(c x J c)'| <= (J_3 - J_1) |c'|. J_1 and J_3 are the smallest
        and the largest principal moment of the true body. If the inertia is dispersed, J_1 is decreased and J_3
        increased by three sigma. c moves in body axes with the rates of the orbit and of the body. The bound on the
        body rate is the sum of the initial rate, the rate of the reference, and 2 pi / t_f, which is twice the mean
        rate of half a turn within t_f.

        On an eccentric orbit the torque is largest at perigee, where 3 n^2 becomes 3 n^2 / (1 - e)^3. The relative rate
        of the distance is at most e times the angular rate of the radius vector at perigee.
        """
        if has_unloaded_reference(scenario):
            return None
        rate, e = self.rate, 0.0
        if scenario.orbit is not None:
            orbit = scenario.orbit.build(scenario.loop.epoch)
            rate, e = float(orbit.rate()), float(orbit.eccentricity)
        inertia = np.asarray(scenario.true_inertia, dtype=float)
        moments = np.sort(inertia) if inertia.ndim == 1 else np.linalg.eigvalsh(inertia)
        deviation = largest_deviation(scenario, "inertia")
        moment_difference = moments[2] * (1.0 + deviation) - moments[0] * (1.0 - deviation)
        factor = 3.0 * rate * rate * moment_difference / (1.0 - e) ** 3
        perigee_rate = rate * math.sqrt(1.0 + e) / (1.0 - e) ** 1.5
        initial_rate = sum(scenario.initial_rates.values())
        reference_rate = sum(scenario.reference.frequencies(scenario).values())
        body_rate = initial_rate + reference_rate + 2.0 * math.pi / scenario.controller.t_f
        return Bounds(np.full(3, 0.5 * factor), np.full(3, factor * ((1.0 + 1.5 * e) * perigee_rate + body_rate)))

    def build(self, inertia: Any, scenario: Any) -> disturbances.Disturbance:
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

    def bounds(self, scenario: "Scenario") -> Bounds:
        """Return three sigma at the end of the run, and a bound on the rate of the walk, which has no exact bound.

        It is three sigma of the change of the walk over the time constant J / l of the default observer, divided by
        that time constant. With this c, K2 = c J / l covers three sigma of the estimate's error.
        """
        density = SIGMAS * np.asarray(self.density)  # pyright: ignore[reportAttributeAccessIssue]
        time_constant = 1.0 / observer_rate(scenario)
        return Bounds(density * np.sqrt(scenario.loop.t_end), density / np.sqrt(time_constant))

    def build(self, inertia: jax.Array | None, scenario: "Scenario") -> disturbances.Disturbance | None:
        """Return None: the rollout adds the steps of the walk."""

    def walk(self, period: float) -> jax.Array | None:
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

    def tables_by_name(self, name: str) -> dict[str, DisturbanceTable]:
        """Return the terms of the sum by their names in a file, such as disturbance.terms[0]."""
        return {f"{name}.terms[{k}]": term for k, term in enumerate(self.terms)}


def without_sums(kinds: Mapping[str, type[Table]]) -> dict[str, type[Table]]:
    """Return the kinds of disturbances that a sum may contain."""
    return {kind: struct for kind, struct in kinds.items() if struct is not SumDisturbance}


def _disturbance_kinds(default_kind: str, body: bool) -> Mapping[str, type[Table]]:
    """Return the disturbances by kind; `body`: whether the plant is a spacecraft."""
    changes = () if body else (("frequency", Scaled(1.0, time=-1, each=True)),)  # as in the paper's Figs. 1 and 2
    kinds: dict[str, type[Table]] = {
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


def largest_disturbance(scenario: "Scenario") -> tuple[float, float] | None:
    """Return K [N m, or unit of d] and c [the same per second] of a scenario's disturbance.

    The result is None if the disturbance, or the reference that determines it, is custom code that has not run yet.

    Raises:
        ScenarioError: a bound overflows.
    """
    inputs = scenario.inputs
    with np.errstate(over="ignore"):
        bounds = [term.bounds(scenario) for term in scenario.terms]
        known = [term_bounds for term_bounds in bounds if term_bounds is not None]
        if len(known) < len(bounds):
            return None
        largest = sum((term_bounds.size for term_bounds in known), np.zeros(inputs))
        largest += largest_deviation(scenario, "disturbance_bias")
        fastest = sum((term_bounds.rate for term_bounds in known), np.zeros(inputs))
    if not np.all(np.isfinite([largest, fastest])):
        raise ScenarioError("disturbance has an infinite amplitude or rate; allowed are smaller numbers in the table")
    return float(np.max(largest)), float(np.max(fastest))


def largest_deviation(scenario: "Scenario", key: str) -> float:
    """Return the largest deviation that bounds assume for a key of [dispersion], 0 if it is absent."""
    table = getattr(scenario.dispersion, key, None)
    return 0.0 if table is None else table.largest


def observer_rate(scenario: "Scenario") -> float:
    """Return the rate l / J of the published observer [1/s], with gain l and mean moment of inertia J.

    It is scaled by t_f. In the sampled loop it is at most one over the control period. For a plant without a body
    the published rate is 10 1/s.
    """
    rate = mission.scales(scenario).scaled_value(
        Scaled(10.0 if scenario.moments[0] is None else PUBLISHED_RATE, time=-1)
    )
    return min(rate, 1.0 / scenario.loop.period) if scenario.sampled else rate


def observer_gain(scenario: "Scenario") -> float:
    """Return the gain l of the published observer [N m s], scaled to the mission.

    The published gain is 10 N m s for a mean moment of 12 kg m^2.
    """
    return rounded(observer_rate(scenario) * scenario.mean_inertia)


def has_unloaded_reference(scenario: "Scenario") -> bool:
    """Whether the reference is custom code that has not run yet, so that its rate is unknown."""
    return getattr(getattr(scenario, "reference", None), "is_unloaded", False)


def path_bounds(scenario: Any, signal: Any, fastest: float = 0.0) -> Bounds:
    """Return the largest size and rate of a custom disturbance d(t, x) on the nominal path to the target.

    On that path the error falls like (t_f - t)^3 until t_f, then the state follows the target. Amplitudes and phases
    of the dispersions are included, see `_extreme_disturbances`. The bounds of a disturbance that fails, or is not
    finite at t = 0, are zero: `custom_checks` reports it before a run.

    Args:
        scenario: a scenario whose reference is known.
        signal: the disturbance, a function of t [s] and the plant's state.
        fastest: largest angular frequency of the disturbance [rad/s].

    Raises:
        ScenarioError: the disturbance is finite at t = 0 and not finite later on the path.
    """
    from ptsmc_jax.batching import lapack  # the import takes 0.1 s, and most scenarios do not need it

    steps = min(float(scenario.loop.t_end) * fastest / LARGEST_PHASE_STEP, MOST_STEPS)
    t = np.linspace(0.0, float(scenario.loop.t_end), max(FEWEST_TIMES, math.ceil(steps) + 1))
    remaining = np.clip(1.0 - t / scenario.controller.t_f, 0.0, 1.0) ** 3
    states = (
        remaining[:, None] * scenario.plant.x0 if scenario.moments[0] is None else _body_states(scenario, t, remaining)
    )
    largest = np.zeros((2, scenario.inputs))
    for disturbance in _extreme_disturbances(scenario, signal):
        try:
            values = np.asarray(lapack.vmap(disturbance)(jnp.asarray(t), jax.tree.map(jnp.asarray, states)))
        except Exception:  # `custom_checks` reports it before a run
            values = np.zeros(0)
        invalid = np.flatnonzero(~np.isfinite(values).all(axis=1)) if values.shape == (t.size, scenario.inputs) else [0]
        if len(invalid) and invalid[0] == 0:
            return Bounds(*np.zeros_like(largest))
        if len(invalid):
            raise ScenarioError(
                f"disturbance.code names a class {type(signal).__name__} whose __call__ returns "
                f"{values[invalid[0]].tolist()} at t = {t[invalid[0]]:.6g} s on the way to the target, but must return "
                "finite numbers"
            )
        sizes = (np.max(np.abs(samples), axis=0) for samples in (values, np.gradient(values, t, axis=0)))
        largest = np.maximum(largest, [*sizes])
    return Bounds(*largest)


def _extreme_disturbances(scenario: "Scenario", signal: disturbances.Disturbance) -> list[disturbances.Disturbance]:
    """Return a custom disturbance with the smallest and the largest random amplitudes, at `PHASE_COUNT` phases."""
    extremes, largest = [signal], 1.0 + largest_deviation(scenario, "disturbance_amplitude")
    amplitudes, phases = disturbances.values(signal, "amplitude"), disturbances.values(signal, "phase")
    if largest != 1.0 and amplitudes.size:
        extremes = [disturbances.with_values(signal, "amplitude", amplitudes * k) for k in (largest, 2.0 - largest)]
    if getattr(scenario.dispersion, "disturbance_phase", None) is None or not phases.size:
        return extremes
    angles = np.linspace(0.0, 2.0 * np.pi, PHASE_COUNT, endpoint=False)
    return [disturbances.with_values(one, "phase", phases + angle) for one in extremes for angle in angles]


def _body_states(scenario: "SpacecraftScenario", t: np.ndarray, remaining: np.ndarray) -> AttitudeState:
    """Return the states of the body on the nominal path at times t (n,) [s].

    `remaining` (n,) is the remaining fraction of the initial rotation from the reference.
    """
    from ptsmc_jax.batching import lapack

    reference = scenario.reference.build(scenario)
    target = lapack.vmap(lambda time: reference(time).q)(jnp.asarray(t))
    start = jnp.asarray(attitude_keys.quaternion(scenario.initial, "initial"))
    rotation = attitude.multiply(attitude.conjugate(target[0]), start)
    rotation = rotation * jnp.where(rotation[3] < 0.0, -1.0, 1.0)
    turn = attitude.rotation_vector(rotation[:3])
    q = jax.vmap(lambda one, fraction: attitude.multiply(one, attitude.from_rotation_vector(fraction * turn)))(
        target, jnp.asarray(remaining)
    )
    q_dot = jnp.asarray(np.gradient(np.asarray(q), t, axis=0))
    w = 2.0 * jax.vmap(lambda one, rate: attitude.multiply(attitude.conjugate(one), rate)[:3])(q, q_dot)
    return AttitudeState(q, w)
