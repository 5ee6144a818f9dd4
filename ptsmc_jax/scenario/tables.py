"""The tables that all scenarios share ([loop], [requirements], [tune]) and the base class `Scenario`.

A table is a struct. The annotation of each field holds meaning, unit and allowed values of a key. Errors, `ptsmc new`
and the scenario reference are made from them. Start with `Scenario`.
"""

from collections.abc import Callable, Collection, Mapping
from typing import TYPE_CHECKING, Annotated, Any, ClassVar, Literal, Self

import msgspec
from jax import Array
from msgspec import Meta

from ptsmc_jax.declare import Scaled
from ptsmc_jax.plants.base import Plant, State
from ptsmc_jax.scenario import epochs, keys
from ptsmc_jax.scenario.device_tables import FilterTable, NoFilter, WheelLimits
from ptsmc_jax.scenario.disturbance_tables import DisturbanceTable
from ptsmc_jax.scenario.errors import ScenarioError
from ptsmc_jax.scenario.law_tables import LAWS
from ptsmc_jax.scenario.values import (
    ABSENT,
    Interval,
    Kinds,
    Meaning,
    NotNegative,
    Quantile,
    ResolvedPositive,
    Table,
    Truth,
)
from ptsmc_jax.simulation.catalogues import Entry
from ptsmc_jax.simulation.pointing import Pointing

if TYPE_CHECKING:
    from ptsmc_jax.simulation.assembly import Parts


class Loop(Table, frozen=True):
    """Type of the control loop, and the times of a run."""

    mode: Annotated[
        Literal["continuous", "sampled"] | None,
        Meaning(
            "continuous: the law is evaluated inside the integrator. sampled: it is computed once a control period "
            "and held; default: sampled with [hardware], [sensors], [wheels] or [filter], otherwise continuous"
        ),
    ] = None
    period: Annotated[
        ResolvedPositive,
        Meaning(
            "control period of the sampled loop; default: t_f / 600 for a spacecraft, t_f / 100 for other plants", "s"
        ),
    ] = ABSENT
    clock: Annotated[
        Literal["anchored", "flight"],
        Meaning(
            "anchored: one sample is at t_f - delta. flight: samples are at multiples of the period, "
            "as on a flight computer"
        ),
    ] = "anchored"
    epoch: Annotated[
        Annotated[str, Meta(description=epochs.ALLOWED)] | None, Meaning("calendar time of t = 0, UTC")
    ] = None
    t_end: Annotated[
        ResolvedPositive,
        Meaning(
            "end of the run; default: 4/3 t_f or the end of the windows for a spacecraft, 3 t_f for other plants", "s"
        ),
    ] = ABSENT
    window: Annotated[
        ResolvedPositive,
        Meaning(
            "length of the window after t_f in which window_error is computed; default: t_f / 30 or a "
            "control period for a spacecraft, t_f / 5 for other plants",
            "s",
        ),
    ] = ABSENT
    settling_angle: Annotated[
        ResolvedPositive,
        Meaning(
            "largest angle to the reference of a settled run, for other plants |x_1|; default: 1e-3, less"
            " for small initial errors, at least five sigma of the noise",
            "rad",
        ),
    ] = ABSENT
    scaled: ClassVar[Mapping[str, Scaled]] = {
        "period": Scaled(0.05, time=1),
        "window": Scaled(1.0, time=1),
    }


class Limit(Table, frozen=True):
    """A requirement as a table: metric <= limit in a fraction of the trials or of the time."""

    limit: Annotated[
        NotNegative,
        Meaning(
            'largest allowed value, a number or a string with a unit such as "0.05 deg";'
            " 0 is allowed for `saturated` only"
        ),
    ]
    quantile: Annotated[
        Quantile | None, Meaning("fraction of the trials that must keep the limit; default: all simulated trials")
    ] = None
    probability: Annotated[
        Quantile | None,
        Meaning('fraction of trials or of the time, as `interpretation` defines; for "ensemble" it is the quantile'),
    ] = None
    confidence: Annotated[
        Quantile | None,
        Meaning("confidence of the one-sided bound that must show this fraction; default: no bound is required"),
    ] = None
    interpretation: Annotated[
        Literal["ensemble", "temporal", "mixed"] | None,
        Meaning(
            "ensemble (default): fraction of the runs, at all times. temporal: fraction of the time, "
            "in every run. mixed: fraction of the time of all runs"
        ),
    ] = None

    @property
    def fraction(self) -> float | None:
        """The required fraction, given as `quantile` or as `probability`."""
        return self.quantile if self.probability is None else self.probability


# gains that tuning can change, without the gains of custom parts
NON_LAW_GAINS = ("observer_gain", "filter_bandwidth", "command_corner")
TUNABLE_GAINS = (
    *dict.fromkeys(name for laws in LAWS.values() for law in laws.values() for name in law.gains),
    *NON_LAW_GAINS,
)
FREE_ALLOWED = f"a list of some of {', '.join(TUNABLE_GAINS)}"
FreeGains = Annotated[tuple[str, ...], Meta(min_length=1, description=FREE_ALLOWED)]


class Tune(Table, frozen=True):
    """Objective, gains and bounds of `tune`, `pareto` and `compare`."""

    free: Annotated[
        FreeGains | None,
        Meaning(
            "gains to tune; default: all except t_f, and in the continuous loop except k1, sign_width and surface_rate"
        ),
    ] = None
    bounds: Annotated[
        Annotated[dict[str, Interval], Meta(description="a table of two numbers for each gain, in SI units")],
        Meaning(
            "lower and upper bound of each gain; default: from the mission; the search may widen default "
            "bounds, see scenario.toml in the results"
        ),
    ] = {}  # noqa: RUF012
    per_axis: Annotated[Truth, Meaning("tune one observer_gain for each axis")] = False
    minimise: Annotated[
        Annotated[str, Meta(description='a metric, "t_f" or "limits"')],
        Meaning(
            'the objective: a metric, "t_f" (the shortest t_f that meets the requirements), or "limits" '
            "(the largest ratio of a metric to its limit)"
        ),
    ] = "window_error"
    statistic: Annotated[
        Literal["rms", "mean", "worst", "quantile", "cvar"],
        Meaning(
            "statistic of this metric over the trials: RMS, mean, largest value, a quantile, or CVaR (the"
            " RMS of the worst 1 - level of the trials)"
        ),
    ] = "rms"
    level: Annotated[Quantile | None, Meaning("level of the quantile or the CVaR; default: 0.9")] = None
    torque_weight: Annotated[
        NotNegative, Meaning("weight of ln(RMS peak torque) in the objective, besides ln(error) (Remark 1)")
    ] = 0.0
    worst_case: Annotated[
        Truth,
        Meaning("require the limits also in the worst case within the dispersions, not only in the random trials"),
    ] = False
    # limited, because all trials are simulated at once, in memory
    trials: Annotated[
        Annotated[int, Meta(ge=1, le=10**6, description="a whole number from 1 to 1000000")],
        Meaning("number of training trials; requirements with a quantile add trials"),
    ] = 256
    starts: Annotated[
        Annotated[int, Meta(ge=1, le=100, description="a whole number from 1 to 100")],
        Meaning(
            "number of starting points: the scenario's gains, analytical designs, and the best of a Sobol sequence"
        ),
    ] = 12
    steps: Annotated[
        Annotated[int, Meta(ge=1, le=10**5, description="a whole number from 1 to 100000")],
        Meaning("largest number of gradient evaluations in one local search"),
    ] = 40

    @property
    def gains(self) -> tuple[str, ...]:
        """The names of the free gains; in a validated scenario `free` is filled in."""
        return self.free or ()


STATISTICS = {
    "rms": "RMS {}", "mean": "mean {}", "worst": "largest {}", "quantile": "{level:g} % quantile of {}",
    "cvar": "CVaR of the {}",
}  # fmt: skip
LEVELS = ("quantile", "cvar")  # statistics that need a probability level
T_F, LIMITS = "t_f", "limits"  # objectives that are no metric of a run


def objective_name(tune: Tune) -> str:
    """Return the name of a search's objective.

    >>> objective_name(Tune()), objective_name(Tune(minimise="effort", statistic="quantile", level=0.9))
    ('RMS window error', '90 % quantile of effort')
    """
    if tune.minimise in (T_F, LIMITS):
        return {T_F: "t_f", LIMITS: "largest metric over its limit"}[tune.minimise]
    return STATISTICS[tune.statistic].format(tune.minimise.replace("_", " "), level=100.0 * (tune.level or 0.0))


class Scenario(Table, frozen=True, kw_only=True, eq=False):
    """A validated scenario: one field for each table, with all defaults filled in. Optional tables may be None.

    Each kind of plant has a subclass, see `layouts.SCENARIOS`. `defaulted` holds the values of the keys that the file
    omits, by the path of the key: `replace` computes their defaults again.
    """

    defaulted: dict[tuple[str, ...], Any] = {}  # noqa: RUF012
    plant: Any
    # the classes of these tables by kind are in `TABLES`
    disturbance: Any  # `disturbance_tables.DisturbanceTable`, or several
    controller: Any  # `law_tables.LawTable`
    observer: Any  # `law_tables.ObserverTable`
    loop: Loop
    hardware: Any = None  # `device_tables.Actuators`
    sensors: Any = None  # `custom.SensorTable` or `sensor_tables.SensorSuite`
    dispersion: Any = None
    requirements: dict[str, float | Limit] = {}  # noqa: RUF012
    tune: Tune | None = None
    telemetry: Any = None  # `identify_tables.Telemetry` or `StateTelemetry`
    identify: Any = None  # `identify_tables.Identify`

    TABLES: ClassVar[Mapping[str, type[Table] | Kinds]] = {}  # class of each table, or classes by kind
    unit_of_d: ClassVar[str] = keys.UNIT_OF_D
    metrics: ClassVar[Mapping[str, Entry]] = {}
    motion: ClassVar[str] = ""  # selects the error kinematics: "spacecraft", "chain" or "system"
    reaching: ClassVar[float] = 1.0  # K1 / decay rate of s in the hold phase: 2 for a spacecraft, see (60)

    def __repr__(self) -> str:
        """Return the tables of the scenario, one line each."""
        tables = {name: getattr(self, name) for name in self.__struct_fields__ if name != "defaulted"}
        return type(self).__name__ + "".join(f"\n  {name}: {table!r}" for name, table in tables.items() if table)

    @classmethod
    def plant_defaults(cls, plant: Any, given: Collection[str], law: object) -> dict[str, Mapping[str, object]]:
        """Return defaults that depend on the plant and the law, by table and key.

        Args:
            plant: the table [plant].
            given: keys of [plant] in the file.
            law: kind of the law.
        """
        return {}

    def default_mode(self) -> Literal["continuous", "sampled"]:
        """Return "sampled" if there are devices, which need the sampled loop, and "continuous" otherwise."""
        devices = (getattr(self, name, None) for name in ("hardware", "sensors", "wheels", "filter"))
        return "continuous" if all(one is None for one in devices) else "sampled"

    @property
    def sampled(self) -> bool:
        """Whether the loop is sampled."""
        return self.loop.mode == "sampled"

    def require_sampled_loop(self, user: str) -> None:
        """Raise ScenarioError unless the loop is sampled; user: the table or key that needs the sampled loop."""
        if not self.sampled:
            raise ScenarioError(f'{user} needs the sampled loop, but loop.mode is "{self.loop.mode}"')

    @property
    def has_discontinuous_sign(self) -> bool:
        """Whether the law switches with the discontinuous sign, which has no derivative."""
        return getattr(self.controller, "sign_width", None) == 0.0

    @property
    def terms(self) -> tuple[DisturbanceTable, ...]:
        """The disturbances that act together, one for [disturbance] unless it is a sum."""
        return tuple(self.terms_by_place.values())

    @property
    def terms_by_place(self) -> dict[str, Any]:
        """The same disturbances by their place in a file: "disturbance", or "disturbance.terms[0]" and so on."""
        return self.disturbance.tables_by_name("disturbance")

    @property
    def inputs(self) -> int:
        """The number of inputs of the plant."""
        raise NotImplementedError

    @property
    def order(self) -> int:
        """The order of the motion that a law drives to zero."""
        return 2

    @property
    def grid_order(self) -> int:
        """The order that determines the grid of the continuous loop, see `clock.graded_clock`."""
        return self.order

    @property
    def devices(self) -> Any:
        """The table [hardware], with all devices off if it is absent."""
        table: Any = self.TABLES["hardware"]
        return table() if self.hardware is None else self.hardware

    @property
    def estimator(self) -> FilterTable:
        """The table [filter], `NoFilter` if it is absent."""
        return NoFilter()

    @property
    def reaction_wheels(self) -> WheelLimits | None:
        """The table [wheels], None without wheels."""
        return None

    @property
    def influence(self) -> float:
        """Acceleration of the error for a unit disturbance."""
        return 1.0

    @property
    def least_eta(self) -> float:
        """The lower bound of eta, excluded (Theorems 2 and 3)."""
        return float(self.order)

    def modes(self) -> list[tuple[float, float, float]]:
        """Return the frequency [rad/s], damping and fraction of the inertia of each flexible mode."""
        return []

    def largest_acceleration(self) -> float | None:
        """Return the largest acceleration of the error that the actuators allow, None if it is not known."""
        return None

    def start_tangent(self) -> float:
        """Return the initial acceleration of the error / (eta^2 / t_f^2)."""
        raise NotImplementedError

    def default_settling_angle(self) -> float:
        """Return the default of `loop.settling_angle`."""
        raise NotImplementedError

    @property
    def moments(self) -> tuple[float, float] | tuple[None, None]:
        """Mean and largest moment of inertia [kg m^2], (None, None) without a body."""
        return None, None

    @property
    def mean_inertia(self) -> float:
        """Mean moment of inertia [kg m^2]; 1 without a body."""
        return self.moments[0] or 1.0

    @property
    def tuned_tables(self) -> dict[str, Any]:
        """The tables that may have gains, by their place in a file.

        The name of a gain is the `prefix` of its table and the key, such as "filter_bandwidth" for [filter].
        """
        tables = {
            "controller": self.controller,
            "observer": self.observer,
            "sensors": self.sensors,
            "filter": self.estimator,
            "hardware.command_filter": self.devices.command_filter,
        }
        return {where: table for where, table in tables.items() if table is not None}

    @property
    def gains(self) -> tuple[str, ...]:
        """The names of all gains that tuning can change."""
        return tuple(name for table in self.tuned_tables.values() for name in table.gains)

    @property
    def hand_over(self) -> float:
        """Time delta from the hand-over to t_f [s], a control period for a law without a hand-over."""
        return getattr(self.controller, "delta", None) or self.loop.period

    @property
    def uses_measurements(self) -> bool:
        """Whether the law uses measurements instead of the true state."""
        devices = self.devices
        return self.estimator.on or any(getattr(devices, key) is not None for key in devices.noise_keys)

    @property
    def search(self) -> Tune:
        """The table [tune], which must be given."""
        assert self.tune is not None, "a scenario without [tune]"
        return self.tune

    @property
    def end(self) -> float:
        """The end of the run, `loop.t_end` [s]."""
        return self.loop.t_end

    @property
    def window(self) -> float:
        """The length of the window after t_f, `loop.window` [s]."""
        return self.loop.window

    def observation(self) -> Pointing | None:
        """Return the observation of pointing errors, a part of `simulation.pointing`, or None."""
        return None

    def fill_plant_defaults(self) -> Self:
        """Return the scenario with the defaults of its plant that depend on other keys."""
        return self

    def complete_for_file(self) -> Self:
        """Return the scenario for a file, with all keys that depend on other keys filled in."""
        return msgspec.structs.replace(self, observer=self.observer.complete_for_file(self))

    def check_body(self) -> None:
        """Raise ScenarioError if the body or its initial state is not valid, before defaults are derived from it."""

    def check_devices(self) -> None:
        """Raise ScenarioError if devices contradict each other or lists have a wrong length, before gains are set."""

    def check_plant(self) -> None:
        """Raise ScenarioError if keys that concern the plant contradict each other."""

    def check_reference_until(self, last: float) -> None:
        """Raise ScenarioError if the reference ends before `last` [s], the end of the longest run of a search."""

    def design_model(self) -> Plant:
        """Return the design model of law and observer, a part of `plants`."""
        raise NotImplementedError

    def true_plant(self, model: Plant) -> Plant:
        """Return the true plant; model: the design model, which is the default."""
        return model

    def initial_state(self) -> State:
        """Return the initial state."""
        raise NotImplementedError

    def build_reference(self) -> Callable[[Array], object]:
        """Return the reference, a part of `signals.references`."""
        raise NotImplementedError

    def frequencies(self, setup: "Parts", t_f: float) -> dict[str, float]:
        """Return the angular frequencies of the plant's motion [rad/s], by the key that causes each of them.

        Args:
            setup: the parts without a clock.
            t_f: shortest prescribed time [s].
        """
        return {}

    def __eq__(self, other: object) -> bool:
        """Compare the values of two scenarios, stated and default ones alike."""
        names = [name for name in self.__struct_fields__ if name != "defaulted"]
        return isinstance(other, Scenario) and all(getattr(self, name) == getattr(other, name) for name in names)


def limit_of(scenario: Scenario, metric: str) -> float | None:
    """Return the limit that a scenario requires for a metric, None if there is none."""
    required = scenario.requirements.get(metric)
    return required.limit if isinstance(required, Limit) else required


def check_scenario(candidate: object, alternatives: str = "") -> Scenario:
    """Return a scenario; raise TypeError for any other object.

    `alternatives` names further allowed objects in the error, such as ", or its file".
    """
    if not isinstance(candidate, Scenario):
        type_name = type(candidate).__name__
        needed = f"a scenario is needed, as read or from_tables return it{alternatives}"
        raise TypeError(f"{needed}, but this is a {type_name}")
    return candidate
