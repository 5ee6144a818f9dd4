"""The tables that every scenario has, whatever its plant: how a run is closed, judged and tuned; and the scenario.

A table is a struct whose docstring says what each key means, with its unit; its type says what is allowed and the
default. Errors, `ptsmc new` and the scenario reference are made from them.
"""

from collections.abc import Collection, Mapping
from typing import Annotated, Any, ClassVar, Literal

import msgspec
from msgspec import Meta

from ptsmc_jax.declare import Scaled
from ptsmc_jax.scenario import keys
from ptsmc_jax.scenario.device_tables import NoFilter
from ptsmc_jax.scenario.errors import ScenarioError
from ptsmc_jax.scenario.law_tables import LAWS
from ptsmc_jax.scenario.values import (
    ABSENT,
    Interval,
    Kinds,
    Meaning,
    NotNegative,
    Positive,
    Quantile,
    ResolvedPositive,
    Table,
    Truth,
)
from ptsmc_jax.simulation.catalogues import Entry


class Loop(Table, frozen=True):
    """How the loop is closed, and until when a run goes."""

    mode: Annotated[
        Literal["continuous", "sampled"], Meaning("the law inside the integrator, or computed and held once a period")
    ] = "continuous"
    period: Annotated[
        ResolvedPositive,
        Meaning("control period, sampled loop only; default: t_f / 600, of other plants t_f / 100", "s"),
    ] = ABSENT
    clock: Annotated[
        Literal["anchored", "flight"],
        Meaning("a sample at t_f - delta, as `tune` has where it moves either, or at whole periods, as a computer has"),
    ] = "anchored"
    t_end: Annotated[
        Positive | None,
        Meaning("end of the run; default: 4/3 t_f, or longer for the window; of other plants 3 t_f", "s"),
    ] = None
    window: Annotated[
        Positive | None,
        Meaning(
            "time after t_f over which window_error is taken; default: t_f / 30, or a control period if "
            "longer; of other plants t_f / 5",
            "s",
        ),
    ] = None
    settling_angle: Annotated[
        ResolvedPositive,
        Meaning(
            "angle to the reference that counts as settled; default: 1e-3, less for small initial errors,"
            " at least five sigma of the noise; of other plants |x_1|",
            "rad",
        ),
    ] = ABSENT
    scaled: ClassVar[Mapping[str, Scaled]] = {
        "period": Scaled(0.05, time=1),
        "window": Scaled(1.0, time=1),
    }


class Limit(Table, frozen=True):
    """A requirement in full: metric <= limit in a share of the trials, or of the time."""

    limit: Annotated[
        NotNegative, Meaning('the largest value allowed, a number or with its unit, "0.05 deg"; 0 of `saturated` only')
    ]
    quantile: Annotated[
        Quantile | None, Meaning("fraction of the trials that must keep the limit; default: all simulated trials")
    ] = None
    probability: Annotated[
        Quantile | None, Meaning("of what `interpretation` says; of an ensemble it is the quantile")
    ] = None
    confidence: Annotated[
        Quantile | None, Meaning("of the one-sided bound by which that share must be shown; default: none asked")
    ] = None
    interpretation: Annotated[
        Literal["ensemble", "temporal", "mixed"] | None,
        Meaning("of the runs, at all times (default); of the time, in every run; of the time of all runs"),
    ] = None

    @property
    def share(self) -> float | None:
        """What is asked for, by either name."""
        return self.quantile if self.probability is None else self.probability


# gains that tuning may move, besides those of parts of one's own
OF_NO_LAW = ("observer_gain", "filter_bandwidth", "command_corner")
FREE = (*dict.fromkeys(name for laws in LAWS.values() for law in laws.values() for name in law.gains), *OF_NO_LAW)
FREE_ALLOWED = f"a list of some of {', '.join(FREE)}"
FreeGains = Annotated[tuple[str, ...], Meta(min_length=1, description=FREE_ALLOWED)]


class Tune(Table, frozen=True):
    """Objective, gains and bounds of `tune`, `pareto` and `compare`."""

    free: Annotated[
        FreeGains | None,
        Meaning(
            "the gains to find; default: all but t_f; without sampling all but k1, sign_width and surface_rate too"
        ),
    ] = None
    bounds: Annotated[
        Annotated[dict[str, Interval], Meta(description="a table of two numbers for each gain")],
        Meaning(
            "two numbers for each gain; defaults follow the mission and move with the search: see "
            "scenario.toml of a run"
        ),
    ] = {}  # noqa: RUF012
    per_axis: Annotated[Truth, Meaning("observer_gain as one number for each axis")] = False
    minimise: Annotated[
        Annotated[str, Meta(description='a metric, "t_f" or "limits"')],
        Meaning(
            'the objective: a metric, "t_f" (the shortest for the requirements), or "limits" (the largest'
            " metric over its limit: as far inside all limits as possible)"
        ),
    ] = "window_error"
    statistic: Annotated[
        Literal["rms", "mean", "worst", "quantile", "cvar"],
        Meaning(
            "of that metric over the trials: its RMS, mean, largest value, a quantile, or CVaR (the RMS "
            "of the worst 1 - level of the trials)"
        ),
    ] = "rms"
    level: Annotated[Quantile | None, Meaning("of the quantile or the CVaR; default: 0.9")] = None
    torque_weight: Annotated[
        NotNegative, Meaning("weight of ln(RMS peak torque) beside ln(error), Remark 1's trade-off")
    ] = 0.0
    worst_case: Annotated[
        Truth, Meaning("keep the requirements in the worst case inside the dispersions too, not only where drawn")
    ] = False
    # all trials are flown at once and held in memory
    trials: Annotated[
        Annotated[int, Meta(ge=1, le=10**6, description="a whole number from 1 to 1000000")],
        Meaning("trials to tune on; requirements with a quantile add more of them"),
    ] = 256
    starts: Annotated[
        Annotated[int, Meta(ge=1, le=100, description="a whole number from 1 to 100")],
        Meaning("starting points of local searches: the scenario's gains, designs, and the best of a sweep"),
    ] = 12
    steps: Annotated[
        Annotated[int, Meta(ge=1, le=10**5, description="a whole number from 1 to 100000")],
        Meaning("largest number of points with gradients in one local search"),
    ] = 40

    @property
    def gains(self) -> tuple[str, ...]:
        """The gains to find, in a checked scenario, where `free` is filled in."""
        return self.free or ()


STATISTICS = {
    "rms": "RMS {}", "mean": "mean {}", "worst": "largest {}", "quantile": "{level:g} % quantile of {}",
    "cvar": "CVaR of the {}",
}  # fmt: skip
LEVELS = ("quantile", "cvar")  # statistics with a level
T_F, LIMITS = "t_f", "limits"  # objectives that are no metric of a run


def objective_name(tune: Tune) -> str:
    """Name what a search minimises.

    >>> objective_name(Tune()), objective_name(Tune(minimise="effort", statistic="quantile", level=0.9))
    ('RMS window error', '90 % quantile of effort')
    """
    if tune.minimise in (T_F, LIMITS):
        return {T_F: "t_f", LIMITS: "largest metric over its limit"}[tune.minimise]
    return STATISTICS[tune.statistic].format(tune.minimise.replace("_", " "), level=100.0 * (tune.level or 0.0))


class Scenario(Table, frozen=True, kw_only=True, eq=False):
    """A scenario as its file says it, every key resolved: the tables that all plants have; optional ones may be off.

    Each kind of plant has its own type, see `layouts.SCENARIOS`, which says what depends on the plant. `defaulted`
    holds what the file does not say, by the path of its key: `replace` returns such keys to their defaults.
    """

    defaulted: dict[tuple[str, ...], Any] = {}  # noqa: RUF012
    plant: Any
    # the tables of their kinds, see `TABLES`
    disturbance: Any  # `disturbance_tables.DisturbanceTable`, or several
    controller: Any  # `law_tables.LawTable`
    observer: Any  # `observer_tables.ObserverTable`
    loop: Loop
    hardware: Any = None  # `device_tables.Actuators`
    sensors: Any = None  # `own_devices.OwnSensors`
    dispersion: Any = None
    requirements: dict[str, float | Limit] = {}  # noqa: RUF012
    tune: Tune | None = None

    TABLES: ClassVar[Mapping[str, type[Table] | Kinds]] = {}  # a table, or one for each kind, the default first
    unit_of_d: ClassVar[str] = keys.UNIT_OF_D
    metrics: ClassVar[Mapping[str, Entry]] = {}
    motion: ClassVar[str] = ""  # what the laws drive to zero: "spacecraft", "chain" or "system"
    reaching: ClassVar[float] = 1.0  # K1 over the rate at which s decays after the hand-over: 2 where (60) halves it

    def __repr__(self) -> str:
        """The tables that it has, a line each."""
        tables = {name: getattr(self, name) for name in self.__struct_fields__ if name != "defaulted"}
        return type(self).__name__ + "".join(f"\n  {name}: {table!r}" for name, table in tables.items() if table)

    @classmethod
    def fallback(cls, plant: Any, given: Collection[str], law: object) -> dict[str, Mapping[str, Any]]:
        """Defaults that depend on other keys, by table; given: keys of [plant] that are there, law: its kind."""
        return {}

    @property
    def sampled(self) -> bool:
        """Whether the loop is sampled."""
        return self.loop.mode == "sampled"

    def need_samples(self, what: str) -> None:
        """Raise ScenarioError in the continuous loop; what: the table, or the key, that needs the sampled one."""
        if not self.sampled:
            raise ScenarioError(f'{what} needs the sampled loop, but loop.mode is "{self.loop.mode}"')

    @property
    def exact_sign(self) -> bool:
        """Whether the law switches by the exact sign, which has no slope."""
        return getattr(self.controller, "sign_width", None) == 0.0

    @property
    def terms(self) -> tuple[Any, ...]:
        """The disturbances that act together."""
        return tuple(self.placed_terms.values())

    @property
    def placed_terms(self) -> dict[str, Any]:
        """These by where a file has them: "disturbance", or "disturbance.terms[0]" and so on."""
        return self.disturbance.placed("disturbance")

    @property
    def inputs(self) -> int:
        """How many inputs the plant has."""
        raise NotImplementedError

    @property
    def order(self) -> int:
        """The order of the motion that a law drives to zero."""
        return 2

    @property
    def grid_order(self) -> int:
        """The order that the grid of the continuous loop is made for, see `clock.graded`."""
        return self.order

    @property
    def devices(self) -> Any:
        """The table [hardware], all of it off where it is absent."""
        table: Any = self.TABLES["hardware"]
        return table() if self.hardware is None else self.hardware

    @property
    def estimator(self) -> Any:
        """The table [filter], `NoFilter` where it is absent."""
        return NoFilter()

    @property
    def reaction_wheels(self) -> Any:
        """The table [wheels]; None: there are none."""
        return None

    @property
    def influence(self) -> float:
        """Acceleration of the error for a unit of the disturbance."""
        return 1.0

    @property
    def least_eta(self) -> float:
        """The number that eta must exceed (Theorems 2 and 3)."""
        return float(self.order)

    def modes(self) -> list[tuple[float, float, float]]:
        """Return the frequency [rad/s], damping and fraction of the inertia of each flexible mode."""
        return []

    def largest_acceleration(self) -> float | None:
        """Return the largest acceleration of the error that the actuators allow, None if it is not known."""
        return None

    def start_tangent(self) -> float:
        """Return what the first acceleration is proportional to, eta^2 / t_f^2 times this."""
        raise NotImplementedError

    def usual_settling(self) -> float:
        """Return the default of `loop.settling_angle`."""
        raise NotImplementedError

    @property
    def moments(self) -> tuple[float, float] | tuple[None, None]:
        """Mean and largest moment of inertia [kg m^2]; None without a body."""
        return None, None

    @property
    def mean_inertia(self) -> float:
        """Mean moment of inertia [kg m^2]; 1 without a body."""
        return self.moments[0] or 1.0

    @property
    def tuned_tables(self) -> dict[str, Any]:
        """The tables that may have gains for tuning to move, by where a file has them.

        A table knows its gains by name, which is its `prefix` and the key: "filter_bandwidth" of the table [filter].
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
        """The names of the gains that it has for tuning to move."""
        return tuple(name for table in self.tuned_tables.values() for name in table.gains)

    @property
    def hand_over(self) -> float:
        """How long before t_f the law hands over [s]; a period for a law that does not."""
        return getattr(self.controller, "delta", None) or self.loop.period

    @property
    def measured(self) -> bool:
        """Whether the law sees something else than the true state."""
        return self.estimator.on or self.devices.noisy

    @property
    def search(self) -> Tune:
        """The table [tune] of a scenario that is to be tuned."""
        assert self.tune is not None, "a scenario without [tune]"
        return self.tune

    @property
    def end(self) -> float:
        """The end of the run, `loop.t_end` [s]."""
        assert self.loop.t_end is not None, "a scenario that is not resolved"
        return self.loop.t_end

    @property
    def window(self) -> float:
        """How long the window after t_f is, `loop.window` [s]."""
        assert self.loop.window is not None, "a scenario that is not resolved"
        return self.loop.window

    def observation(self) -> Any:
        """What pointing error indices are taken of, a part of `simulation.pointing`; None: nothing."""
        return None

    def resolved(self) -> Any:
        """With the defaults of its plant that depend on other keys."""
        return self

    def written(self) -> Any:
        """With every key that follows from others where it is absent, as files have it."""
        return msgspec.structs.replace(self, observer=self.observer.written(self))

    def check_body(self) -> None:
        """Raise ScenarioError if there is no such body: before defaults follow from its inertia."""

    def check_devices(self) -> None:
        """Raise ScenarioError if devices contradict each other or have lists of another length, before gains follow."""

    def check_plant(self) -> None:
        """Raise ScenarioError where keys of the plant contradict each other."""

    def model(self) -> Any:
        """The plant as the law knows it, a part of `plants`."""
        raise NotImplementedError

    def truth(self, model: Any) -> Any:
        """The plant that flies."""
        return model

    def start(self) -> Any:
        """Its initial state."""
        raise NotImplementedError

    def target(self) -> Any:
        """What the law is to reach, a part of `signals.references`."""
        raise NotImplementedError

    def frequencies(self, setup: Any, t_f: float) -> dict[str, float]:
        """How fast the plant moves and turns [rad/s], by the key that says so, on the way to the shortest t_f [s]."""
        return {}

    def __eq__(self, other: object) -> bool:
        """Two scenarios are equal where their values are, whether a file says them or not."""
        names = [name for name in self.__struct_fields__ if name != "defaulted"]
        return isinstance(other, Scenario) and all(getattr(self, name) == getattr(other, name) for name in names)


def limit_of(scenario: Scenario, metric: str) -> float | None:
    """Return the limit that a scenario requires for a metric, None if there is none."""
    required = scenario.requirements.get(metric)
    return required.limit if isinstance(required, Limit) else required


def check_scenario(what: object, besides: str = "") -> Scenario:
    """What is a scenario; raises TypeError, with one sentence, where it is none; besides: what else it may be."""
    if not isinstance(what, Scenario):
        found = type(what).__name__
        raise TypeError(f"a scenario is needed, as read or from_tables return it{besides}, but this is a {found}")
    return what
