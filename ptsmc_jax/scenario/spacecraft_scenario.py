"""Scenarios of a spacecraft: tables, validation, and the parts that they build. Start with `SpacecraftScenario`."""

import math
from collections.abc import Collection, Mapping
from typing import TYPE_CHECKING, Annotated, Any, ClassVar, Literal, Self

import msgspec
import numpy as np
from msgspec import Meta

from ptsmc_jax import formulas
from ptsmc_jax.declare import Scaled
from ptsmc_jax.numerics.pytrees import vector
from ptsmc_jax.plants.base import Plant
from ptsmc_jax.plants.flexible_body import flexible
from ptsmc_jax.plants.rigid_body import AttitudeState, spacecraft
from ptsmc_jax.scenario import attitude_keys, device_tables, dispersion_tables, errors, identify_tables, tables
from ptsmc_jax.scenario.custom import SENSORS
from ptsmc_jax.scenario.disturbance_tables import DISTURBANCES, SIGMAS, largest_deviation
from ptsmc_jax.scenario.errors import ScenarioError, wrong
from ptsmc_jax.scenario.law_tables import LAWS, OBSERVERS
from ptsmc_jax.scenario.reference_tables import ORBITS, REFERENCES, Initial, OrbitTable
from ptsmc_jax.scenario.sensor_tables import SensorSuite
from ptsmc_jax.scenario.tables import Loop, Scenario, Tune
from ptsmc_jax.scenario.values import (
    ABSENT,
    Inertia,
    Kinds,
    Meaning,
    NotNegative,
    Positive,
    ResolvedPositive,
    Table,
    Three,
)
from ptsmc_jax.signals.references import Reference
from ptsmc_jax.simulation import catalogues
from ptsmc_jax.simulation.pointing import Pointing as PointingPart
from ptsmc_jax.simulation.pointing import boresight_frame

if TYPE_CHECKING:
    from ptsmc_jax.simulation.assembly import Parts

LONGEST_STEP = 0.02  # largest step of the continuous loop in the hold phase / t_f, see `clock`
# Largest number of integration steps of 0.025 rad in two control periods under a comparison law. A run that turns
# faster is marked.
MAX_COMPARISON_STEPS = 50
_CASE_I: dict[str, Mapping[str, object]] = {
    "initial": {"quat_xyzw": [0.4714045207910317, -0.3333333333333333, 0.5773502691896258, 0.5773502691896258]},
    "reference": {"quat_xyzw": [0.0, 0.0, 0.0, 1.0]},
}


class SpacecraftPlant(Table, frozen=True):
    """A spacecraft with quaternion and body rate as its state; [spacecraft] and [initial] hold its numbers."""

    kind: Literal["spacecraft"] = "spacecraft"


class Spacecraft(Table, frozen=True):
    """The rigid body."""

    inertia: Annotated[
        Inertia,
        Meaning(
            "three principal moments, or a symmetric 3x3 tensor. Off its diagonal are the sums of -m x y: if your "
            "CAD program prints the sums of m x y, change their sign. With [wheels] it is the inertia of the whole "
            "spacecraft minus the spin inertia of each wheel about its axis",
            "kg m^2",
        ),
    ] = (10.0, 12.0, 14.0)
    true_inertia: Annotated[
        Inertia | None, Meaning("of the true plant; default: inertia of the design model", "kg m^2")
    ] = None


class Flexible(Table, frozen=True):
    """Flexible appendages, or sloshing liquid, of the true plant. Law, observer and filter use a rigid design model.

    J w' + D' e'' = -w x (J w + D' e') + u + d,
    e'' + 2 z W e' + W^2 e = -D w'.
    The modes e are at rest at t = 0. J is the inertia of the whole body, and D has the rows of `coupling`.
    """

    frequency: Annotated[
        Annotated[
            tuple[Positive, ...], Meta(min_length=1, description="a list of numbers greater than 0, one for each mode")
        ]
        | None,
        Meaning("cantilevered frequency W of each mode; default: 6, scaled to the mission", "rad/s"),
    ] = None
    damping: Annotated[
        Annotated[
            tuple[NotNegative, ...],
            Meta(min_length=1, description="a list of numbers of at least 0, one for each mode"),
        ],
        Meaning("damping ratio z of each mode"),
    ] = (0.005,)
    coupling: Annotated[
        Annotated[tuple[Three, ...], Meta(min_length=1, description="a list of rows of three numbers")] | None,
        Meaning(
            "coupling D of the modes with the rotation about each axis, one row for each mode; default: "
            "0.8 about x, scaled to the mission",
            "sqrt(kg) m",
        ),
    ] = None
    scaled: ClassVar[Mapping[str, Scaled]] = {
        "frequency": Scaled((6.0,), time=-1),
        "coupling": Scaled(((0.8, 0.0, 0.0),), inertia=0.5),
    }

    def check(self, inertia: Inertia) -> None:
        """Raise ScenarioError for lists of different lengths and for modes that no body can have.

        `inertia` is the inertia of the true body [kg m^2].
        """
        lists = {key: getattr(self, key) for key in self.__struct_fields__}
        modes = sorted(map(len, lists.values()))[1]  # the length that two of the three lists have
        for key, value in lists.items():
            if len(value) != modes:
                others = (f"flexible.{other} ({len(one)})" for other, one in lists.items() if other != key)
                raise wrong(f"flexible.{key}", value, f"as long as {' and '.join(others)}, one entry for each mode")
        try:
            formulas.rest_inertia(formulas.check_inertia(inertia), self.coupling)
        except ValueError as error:
            raise errors.value_error("flexible.coupling", self.coupling, f": {error}") from None

    def check_random_modes(self, scenario: "SpacecraftScenario") -> None:
        """Raise ScenarioError if random couplings and inertias may be physically impossible.

        A random row of D is at most f times the nominal row, and a random moment at least s times the nominal moment.
        The inertia of the rigid rest of the body is then at least s J - f^2 D'D, which must be positive definite.
        Random rotations of the principal axes are not considered.
        """
        largest_factor = 1.0 + largest_deviation(scenario, "mode_coupling")
        smallest_moment = 1.0 - SIGMAS * getattr(getattr(scenario.dispersion, "inertia", None), "std", 0.0)
        inertia = smallest_moment * formulas.check_inertia(scenario.true_inertia)
        try:
            formulas.rest_inertia(inertia, largest_factor * np.asarray(self.coupling))
        except ValueError as error:
            raise ScenarioError(
                "dispersion.mode_coupling or dispersion.inertia is too large: a trial may have rows "
                f"{largest_factor:.6g} times those of flexible.coupling and moments {smallest_moment:.6g} times the "
                f"nominal ones, but {error}"
            ) from None


class Pointing(Table, frozen=True):
    """Observation of pointing error indices (ECSS-E-ST-60-10C) in windows, from t_f + `after` to t_end."""

    boresight: Annotated[
        Three,
        Meaning(
            "direction of an instrument in body axes, of any length; the indices of its half-cone "
            "angle are then computed too"
        ),
    ] = (0.0, 0.0, 1.0)
    window: Annotated[
        ResolvedPositive,
        Meaning("length of the windows for mean errors (MPE, RPE, PDE); default: t_f / 30", "s"),
    ] = ABSENT
    after: Annotated[NotNegative, Meaning("time from t_f to the start of the observation", "s")] = 0.0
    scaled: ClassVar[Mapping[str, Scaled]] = {"window": Scaled(1.0, time=1)}

    @property
    def time_after_t_f(self) -> float:
        """Smallest time from t_f to the end of the run [s]: the observation needs two windows."""
        return self.after + 2.0 * self.window

    def check(self, scenario: "SpacecraftScenario") -> None:
        """Raise ScenarioError for a zero boresight, a short window, or a run that ends before two windows."""
        attitude_keys.check_direction("pointing.boresight", self.boresight)
        t_f, needed = scenario.controller.t_f, scenario.controller.t_f + self.time_after_t_f
        if scenario.end < needed * (1 - 1e-9):  # the default t_end is later, so the file has a t_end
            numbers = f"{t_f:g} + {self.after:g} + 2 * {self.window:g} = {needed:g} s"
            reason = f"at least controller.t_f + pointing.after + 2 pointing.window, {numbers}"
            raise wrong("loop.t_end", scenario.end, reason)
        sampled = scenario.sampled
        longest_step = LONGEST_STEP * scenario.controller.t_f
        shortest, source = (scenario.loop.period, "loop.period") if sampled else (longest_step, "the longest step")
        jitter = getattr(scenario.dispersion, "timing_jitter", None)
        if sampled and jitter is not None:  # a period may begin early and end late
            shortest, source = shortest * (1.0 + 2.0 * jitter.largest), "the longest control period with its jitter"
        if self.window < shortest * (1 - 1e-9):
            raise wrong("pointing.window", self.window, f"at least {source}, {shortest:.9g} s")

    def build(self, scenario: Any) -> PointingPart:
        """Return `pointing.Pointing`, with the limits whose requirements concern a fraction of the time."""
        limits = {
            name: vector(limit.limit)
            for name, limit in scenario.requirements.items()
            if getattr(limit, "interpretation", None) not in (None, "ensemble")
        }
        # if no limit needs samples in a window, their number is 0, so that one program serves all control periods
        needs_samples = scenario.sampled and any(name.startswith(catalogues.RELATIVE_INDICES) for name in limits)
        # both ends of a window may be samples, and jitter of half a period may move one more sample into it
        samples = math.ceil(self.window / scenario.loop.period) + 2 if needs_samples else 0
        return PointingPart(
            vector(boresight_frame(self.boresight)), vector(self.after), vector(self.window), limits, samples
        )


class SpacecraftScenario(Scenario, frozen=True, kw_only=True):
    """A scenario of a spacecraft."""

    spacecraft: Spacecraft
    initial: Initial
    reference: Any  # `reference_tables.ReferenceTable`
    orbit: OrbitTable | None = None
    flexible: Flexible | None = None
    wheels: device_tables.WheelLimits | None = None
    filter: device_tables.FilterTable | None = None
    pointing: Pointing | None = None

    TABLES: ClassVar[Mapping[str, type[Table] | Kinds]] = {
        "plant": SpacecraftPlant,
        "spacecraft": Spacecraft,
        "flexible": Flexible,
        "initial": Initial,
        "orbit": ORBITS,
        "reference": REFERENCES,
        "disturbance": DISTURBANCES["spacecraft"],
        "controller": LAWS["spacecraft"],
        "observer": OBSERVERS["spacecraft"],
        "loop": Loop,
        "hardware": device_tables.Hardware,
        "sensors": SENSORS,
        "wheels": device_tables.WHEELS,
        "filter": device_tables.FILTERS,
        "pointing": Pointing,
        "dispersion": dispersion_tables.Dispersion,
        "tune": Tune,
        "telemetry": identify_tables.Telemetry,
        "identify": identify_tables.Identify,
    }
    unit_of_d: ClassVar[str] = "N m"
    metrics: ClassVar[Mapping[str, catalogues.Entry]] = catalogues.CATALOGUE
    motion: ClassVar[str] = "spacecraft"
    reaching: ClassVar[float] = 2.0

    @classmethod
    def plant_defaults(cls, plant: Table, given: Collection[str], law: object) -> dict[str, Mapping[str, object]]:
        """Return the attitudes of the published Case I."""
        return _CASE_I

    @property
    def inputs(self) -> int:
        """The number of torques: one about each body axis."""
        return 3

    @property
    def grid_order(self) -> int:
        """The order of the finest grid that the published cases need."""
        return 1

    @property
    def estimator(self) -> device_tables.FilterTable:
        """The table [filter], `NoFilter` if it is absent, or the Kalman filter of [[sensors]]."""
        if isinstance(self.sensors, SensorSuite):
            return device_tables.KalmanFilter()
        return device_tables.NoFilter() if self.filter is None else self.filter

    @property
    def devices(self) -> device_tables.Hardware:
        """The table [hardware], with one star tracker and one gyro that are equivalent to [[sensors]]."""
        table = super().devices
        suite = self.sensors
        return suite.equivalent_hardware(table, self.loop.period) if isinstance(suite, SensorSuite) else table

    @property
    def reaction_wheels(self) -> device_tables.WheelLimits | None:
        """The table [wheels], None without wheels."""
        return self.wheels

    @property
    def moments(self) -> tuple[float, float]:
        """Mean and largest moment of inertia [kg m^2]."""
        values = np.asarray(self.spacecraft.inertia, dtype=float)
        if values.ndim == 1:
            return float(np.mean(values)), float(values.max())
        return float(np.mean(np.diag(values))), float(np.linalg.eigvalsh(values).max())

    @property
    def influence(self) -> float:
        """Acceleration of the error for a unit torque about the mean axis, 1 / (2 J) [1/(kg m^2)]."""
        return 0.5 / self.mean_inertia

    def modes(self) -> list[tuple[float, float, float]]:
        """Return the frequency [rad/s], damping and fraction of the inertia of each mode of the free body."""
        if self.flexible is None:
            return []
        table, rows = self.flexible, np.asarray(self.flexible.coupling)
        inertia = formulas.check_inertia(self.true_inertia)
        fractions = [float(row @ np.linalg.solve(inertia, row)) for row in rows]
        return [
            (frequency / math.sqrt(1.0 - fraction), damping, fraction / (1.0 - fraction))
            for frequency, damping, fraction in zip(table.frequency or (), table.damping, fractions, strict=True)
        ]

    def largest_acceleration(self) -> float | None:
        """Return the acceleration of the error that the weakest axis allows [1/s^2], None without a torque limit."""
        inertia, accelerations = formulas.check_inertia(self.spacecraft.inertia), []
        limits = [self.devices.torque_limit, tables.limit_of(self, "peak_torque")]
        accelerations += [limit / np.diag(inertia).max() for limit in limits if limit is not None]
        if self.wheels is not None:
            allocation = np.linalg.pinv(formulas.wheel_axes(self.wheels.spin_axes()).T)
            wheel_torque = np.abs(allocation @ inertia).max()  # of one wheel, for a unit acceleration about one axis
            limits = [self.wheels.torque_limit, tables.limit_of(self, "peak_wheel_torque")]
            accelerations += [limit / wheel_torque for limit in limits if limit is not None]
        return 0.5 * float(min(accelerations)) if accelerations else None

    def start_angle(self) -> float:
        """Return the largest angle to the reference at t = 0 [rad], dispersions included."""
        start = np.asarray(attitude_keys.quaternion(self.initial, "initial"), dtype=float)
        target = np.asarray(self.reference.initial_reference_attitude(self), dtype=float)
        target = target * np.copysign(1.0, start @ target)  # both signs are the same attitude
        angle = 4.0 * float(np.arctan2(np.linalg.norm(start - target), np.linalg.norm(start + target)))
        for table in (getattr(self.dispersion, "attitude", None), getattr(self.dispersion, "reference", None)):
            angle = angle if table is None else table.largest_angle(angle)
        return angle

    def start_tangent(self) -> float:
        """Return tan(angle / 2) for the angle to the reference at t = 0, limited to 160 degrees."""
        return math.tan(0.5 * min(self.start_angle(), math.radians(160.0)))

    def default_settling_angle(self) -> float:
        """Return the default of `loop.settling_angle` [rad]."""
        noise = self.devices.attitude_noise or 0.0
        return max(1e-3 * min(1.0, self.start_angle() or 1.0), min(5.0 * noise, 1.0))

    def fill_plant_defaults(self) -> Self:
        """Return the scenario with the defaults of the filter."""
        return msgspec.structs.replace(self, filter=None if self.filter is None else self.filter.fill_defaults(self))

    @property
    def true_inertia(self) -> Inertia:
        """Inertia of the true body, three moments or a tensor (3, 3) [kg m^2]."""
        table = self.spacecraft
        return table.inertia if table.true_inertia is None else table.true_inertia

    def check_body(self) -> None:
        """Raise ScenarioError for an inertia that no body can have."""
        for key in ("inertia", "true_inertia"):
            value = getattr(self.spacecraft, key)
            if value is not None:
                try:
                    formulas.check_inertia(value)
                except ValueError as error:
                    raise errors.value_error(f"spacecraft.{key}", value, f": {error}") from None

    def check_devices(self) -> None:
        """Raise ScenarioError for modes that no body can have and for devices that contradict each other."""
        if self.flexible is not None:
            self.flexible.check(self.true_inertia)
        self.devices.check(self)
        self.estimator.check(self)
        if self.wheels is not None:
            self.wheels.check()

    def check_plant(self) -> None:
        """Raise ScenarioError for invalid attitudes, settling angle, disturbance, pointing or random modes."""
        attitude_keys.quaternion(self.initial, "initial")
        angle = self.loop.settling_angle
        if angle >= math.pi:  # probably in degrees: every attitude would count as settled
            raise wrong("loop.settling_angle", angle, 'less than pi [rad], or with its unit, such as "0.5 deg"')
        if self.orbit is not None:
            self.orbit.check()
        self.reference.check(self)
        for place, term in self.terms_by_place.items():
            term.check(place, self)
        if self.pointing is not None:
            self.pointing.check(self)
        if self.flexible is not None:
            self.flexible.check_random_modes(self)

    def check_reference_until(self, last: float) -> None:
        self.reference.check_reference_until(self, last, "tune.bounds.t_f")

    def observation(self) -> PointingPart | None:
        """Return the observation of pointing errors, None without [pointing]."""
        return None if self.pointing is None else self.pointing.build(self)

    def design_model(self) -> Plant:
        """Return the rigid body of the design model."""
        return spacecraft(self.spacecraft.inertia)

    def true_plant(self, model: Plant) -> Plant:
        """Return the true plant: the body with its true inertia and its flexible modes; model: not used."""
        modes = self.flexible
        if modes is None:
            return spacecraft(self.true_inertia)
        return flexible(self.true_inertia, modes.frequency, modes.damping, modes.coupling)

    def initial_state(self) -> AttitudeState:
        """Return attitude and rate at t = 0."""
        q = vector(attitude_keys.quaternion(self.initial, "initial"))
        return AttitudeState(q, vector(self.initial.rate))

    def build_reference(self) -> Reference:
        """Return the reference."""
        return self.reference.build(self)

    @property
    def initial_rates(self) -> dict[str, float]:
        """The nominal and the dispersed body rate at t = 0 [rad/s] by key; one rate in 10 000 exceeds their sum."""
        rates = {"initial.rate": float(np.linalg.norm(self.initial.rate))}
        table = getattr(self.dispersion, "rate", None)
        if table is not None:
            rates[f"dispersion.rate.{table.width_key}"] = float(table.norm_quantile * table.widths()[0])
        return rates

    def frequencies(self, setup: "Parts", t_f: float) -> dict[str, float]:
        """Return the angular frequencies of start, reference, law, wheels and flexible modes [rad/s], by key.

        Args:
            setup: the parts without a clock.
            t_f: shortest prescribed time [s].
        """
        frequencies = {**self.initial_rates, **self.reference.frequencies(self)}
        law = self.controller.law
        key, rate = law.half_turn_rate(self.controller, t_f)
        if not law.prescribed:
            rate = min(rate, 0.5 * MAX_COMPARISON_STEPS * 0.025 / self.loop.period)
        frequencies[f"controller.{key}"] = rate
        for key, rate in self._nutation_rates(setup).items():
            frequencies[key] = frequencies.get(key, 0.0) + rate
        if self.flexible is not None:
            modes, largest_factor = self.flexible, 1.0 + largest_deviation(self, "mode_frequency")
            inertia = np.asarray(setup.plant.inertia)
            fastest = formulas.free_mode_frequencies(inertia, modes.frequency, modes.coupling).max()
            frequencies["flexible.frequency"] = largest_factor * float(fastest)
        return frequencies

    def _nutation_rates(self, setup: Any) -> dict[str, float]:
        """Return bounds on the nutation rate of a body with wheels [rad/s], by the key that causes each of them.

        The bound is |H| / sqrt(J_1 J_2) with the two smallest principal moments, from J w' = -w x H + u. In inertial
        axes only disturbances change H = J w + A h, since torques of the wheels are internal.
        """
        if self.wheels is None:
            return {}
        wheels = setup.actuators.wheels
        least, middle, largest = np.linalg.eigvalsh(np.asarray(setup.plant.inertia))
        momenta = {
            "wheels.momentum": np.linalg.norm(np.asarray(wheels.axes) @ np.asarray(wheels.initial)),
            **{key: largest * rate for key, rate in self.initial_rates.items()},
            "disturbance.amplitude": sum(term.impulse(self.end) for term in self.terms),
        }
        return {key: float(moment) / math.sqrt(least * middle) for key, moment in momenta.items()}
