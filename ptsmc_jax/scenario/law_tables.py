"""The tables [controller] and [observer] of scenario files: shared keys, defaults, and the classes by kind.

The numbers of a law are declared in `laws`, and those of an observer in `observers`. Start with `LawTable`, which
`LAWS` lists by kind, and `ObserverTable`, which `OBSERVERS` lists.
"""

import dataclasses
from collections.abc import Mapping
from typing import TYPE_CHECKING, Annotated, Any, ClassVar, Literal, Self

import msgspec

from ptsmc_jax.declare import Scaled
from ptsmc_jax.laws import baselines, kinematics, prescribed_time, time_base
from ptsmc_jax.laws.base import AccelerationLaw, Law
from ptsmc_jax.numerics.pytrees import vector
from ptsmc_jax.observers import base, finite_time, nonlinear
from ptsmc_jax.observers.prescribed_time import PrescribedTimeObserver
from ptsmc_jax.plants.base import Plant
from ptsmc_jax.scenario import disturbance_tables, mission
from ptsmc_jax.scenario.custom import Custom, custom_kind
from ptsmc_jax.scenario.errors import show, wrong
from ptsmc_jax.scenario.schema import PartTable, make_table
from ptsmc_jax.scenario.values import Meaning, NotNegative, Positive, rounded

if TYPE_CHECKING:
    from ptsmc_jax.scenario.tables import Scenario

PUBLISHED_DELTA_O = Scaled(0.05, time=1)  # delta_o of the prescribed-time observer [s]
KINEMATICS = {"chain": kinematics.ChainKinematics, "system": kinematics.SecondOrderKinematics}


class LawTable(PartTable, frozen=True):
    """A law for any plant."""

    t_f: Annotated[
        Positive,
        Meaning(
            "prescribed time of convergence; for laws without a prescribed time,"
            " the time from which the error is evaluated",
            "s",
        ),
    ] = 30.0
    disturbance_rate_bound: Annotated[
        NotNegative | None,
        Meaning(
            "bound c on each component of d' (Assumption 1); default: the bound of [disturbance] with its dispersions",
            "unit of d/s",
        ),
    ] = None
    disturbance_bound: Annotated[
        NotNegative | None,
        Meaning(
            "bound K on each component of d (Assumption 1), used without an observer; default: the bound "
            "of [disturbance] with its dispersions",
            "unit of d",
        ),
    ] = None
    initial_estimate_error: Annotated[NotNegative, Meaning("bound on the observer's error at t = 0", "unit of d")] = 0.0
    gains: ClassVar[tuple[str, ...]] = ("t_f",)
    usual: ClassVar[Mapping[str, str]] = {"t_f": "t_f", "delta": "delta"}

    @property
    def implicit(self) -> bool:
        """Whether the sampled law is discretised implicitly: it uses s at the end of the control period."""
        return getattr(self, "sampling", None) == "implicit"

    @property
    def law(self) -> Any:
        """The class of the law, `AccelerationLaw` for a custom law whose code has not run yet."""
        return self.part_class or AccelerationLaw

    def kinematics(self, motion: str) -> type[kinematics.Kinematics]:
        """Return the class of the error kinematics for plants of this `Scenario.motion`."""
        if motion != "spacecraft":
            return KINEMATICS[motion]
        additive = getattr(self, "error", "multiplicative") == "additive"
        return kinematics.AdditiveKinematics if additive else kinematics.MultiplicativeKinematics

    def free(self, *, sampled: bool) -> tuple[tuple[str, ...], tuple[str, ...]]:
        """Return the law's gains that are free by default: those before and those after the observer's in the list."""
        extra = self.free_if_sampled if sampled else ()  # implicit sampling has no boundary layer
        return self.free_by_default, tuple(name for name in extra if not (self.implicit and name == "sign_width"))

    def fill_defaults(self, scenario: "Scenario") -> Self:
        """Fill absent bounds of Assumption 1 from the disturbance, then absent gains.

        The gains are designed for the sampled loop. If the loop is continuous or the scenario is a published case, they
        are the published gains, scaled to the mission.
        """
        bounds = disturbance_tables.largest_disturbance(scenario)
        if bounds is not None:
            self = self._fill_absent(
                dict(zip(("disturbance_bound", "disturbance_rate_bound"), map(rounded, bounds), strict=True))
            )
        filled = self
        if scenario.sampled and not mission.is_published_case(scenario):
            scenario = msgspec.structs.replace(scenario, controller=self)
            filled = self._fill_absent(self.gains_of(mission.design(scenario), scenario))
        filled = filled._fill_absent(filled.published_in(mission.scales(scenario)))
        delta, by_default = getattr(filled, "delta", None), getattr(self, "delta", 0.0) is None
        if scenario.sampled and by_default and delta is not None:
            filled = msgspec.structs.replace(filled, delta=max(delta, scenario.loop.period))
        return filled

    def _fill_absent(self, defaults: Mapping[str, object]) -> Self:
        """Return the table with these values for its absent keys."""
        return msgspec.structs.replace(self, **{k: v for k, v in defaults.items() if getattr(self, k) is None})

    def published_in(self, scales: mission.Scales) -> dict[str, Any]:
        """Return the published gains by key, scaled to the units of a mission."""
        return {key: scales.scaled_value(scaled, self) for key, scaled in self.scaled.items()}

    def gains_of(self, design: mission.Design, scenario: "Scenario") -> Mapping[str, float]:
        """Return this law's gains for a design of the sampled loop, by key.

        The law receives the published gains, scaled to the bandwidth of the design.
        """
        published = self.published_in(mission.scales(scenario)._replace(time=1.0 / design.rate_factor))
        return self.law.designed(design, published)

    def check(self, scenario: "Scenario") -> None:
        """Raise ScenarioError if keys contradict each other or the scenario."""
        if not self.law.prescribed and scenario.order != 2:
            allowed = f"2 with controller.kind = {show(scenario.controller.kind)}, a law of second order"
            raise wrong("plant.order", scenario.order, allowed)
        refusal: tuple[str, str] | None = self.law.refusal(self, scenario.order)
        if refusal is not None:
            raise wrong(f"controller.{refusal[0]}", getattr(self, refusal[0]), refusal[1])
        if self.implicit:
            scenario.require_sampled_loop('controller.sampling = "implicit"')

    def build(self, scenario: "Scenario", model: Plant) -> Law:
        """Return the law for the design model of the plant, see `Scenario.design_model`."""
        law = self.part(kinematics=self.kinematics(scenario.motion)(model), delta=vector(scenario.hand_over))
        return dataclasses.replace(law, implicit=True) if self.implicit else law


class PrescribedTable(LawTable, frozen=True):
    """The paper's law."""

    sampling: Annotated[
        Literal["explicit", "implicit"],
        Meaning(
            "explicit: the torque follows from s at the sample. implicit: it follows from s at the end of"
            " the period, and needs no sign_width"
        ),
    ] = "explicit"


ErrorKind = Annotated[
    Literal["additive", "multiplicative"],
    Meaning(
        "definition of the error: additive, the paper's q_1 - q_1f, or multiplicative, the vector"
        " part of q_f* q, which is singular only 180 degrees from the reference"
    ),
]


class AttitudeTable(PrescribedTable, frozen=True):
    """The paper's law for a spacecraft."""

    error: ErrorKind = "additive"


class CustomTable(LawTable, frozen=True):
    """A custom law."""

    delta: Annotated[
        Positive | None,
        Meaning("time from the hand-over to t_f, for a law with a hand-over; default: one control period", "s"),
    ] = None
    gains: ClassVar[tuple[str, ...]] = ("delta", "t_f")


class CustomAttitudeTable(CustomTable, frozen=True):
    """A custom law for a spacecraft."""

    error: ErrorKind = "multiplicative"


def common_keys(law: LawTable) -> dict[str, object]:
    """Return the keys that all laws share, with the values of this law."""
    return {name: getattr(law, name) for name in LawTable.__struct_fields__}


COMPARISON = {
    "pd": baselines.PD,
    "terminal": baselines.Terminal,
    "fixed_time": baselines.FixedTime,
    "time_base_pd": time_base.TimeBasePD,
    "time_base_sliding": time_base.TimeBaseSliding,
    "scaling": baselines.Scaling,
    "predefined_time": baselines.PredefinedTime,
    "super_twisting": baselines.SuperTwisting,
}
BASELINES = {kind: make_table(LawTable, made, kind) for kind, made in COMPARISON.items()}
_SUMMARY = "A custom law, a class derived from ptsmc_jax.AccelerationLaw; its fields are further keys."
_NEEDS = ("acceleration", "__call__")
# by the kind of the plant and the kind of the law, the default first
LAWS: dict[str, Mapping[str, type[LawTable]]] = {
    "spacecraft": {
        "prescribed_time": make_table(AttitudeTable, prescribed_time.PrescribedTime, "prescribed_time"),
        **BASELINES,
        "pd": make_table(LawTable, baselines.QuaternionPD, "pd"),
        "custom": custom_kind(CustomAttitudeTable, AccelerationLaw, _NEEDS, _SUMMARY, has_gains=True),
    },
    **{
        plant: {
            "prescribed_time": make_table(PrescribedTable, made, "prescribed_time", body=False),
            **BASELINES,
            "custom": custom_kind(CustomTable, AccelerationLaw, _NEEDS, _SUMMARY, has_gains=True),
        }
        for plant, made in (
            ("chain", prescribed_time.PrescribedTimeChain),
            ("system", prescribed_time.PrescribedTime),
        )
    },
}


class ObserverTable(PartTable, frozen=True):
    """An observer for any plant."""

    prefix: ClassVar[str] = "observer_"

    def check(self, scenario: "Scenario") -> None:
        """Raise ScenarioError if keys contradict each other or the scenario."""
        if isinstance(self, Custom):
            scenario.require_sampled_loop('observer.kind = "custom"')

    def build(self, scenario: "Scenario", model: Plant) -> base.Observer:
        """Return the observer for the design model of the plant, see `Scenario.design_model`."""
        law, names = scenario.controller, {field.name for field in dataclasses.fields(self.part_class)}
        law_bounds = {
            "disturbance_bound": law.disturbance_bound,
            "disturbance_rate_bound": law.disturbance_rate_bound,
            "initial_error": law.initial_estimate_error,
        }
        known_fields = {name: vector(value) for name, value in law_bounds.items() if name in names}
        return self.complete_for_file(scenario).part(model=model, **known_fields)


class LinearTable(ObserverTable, frozen=True):
    """An observer with the gain of l(w) in (53), or with its constant part."""

    def fill_defaults(self, scenario: "Scenario") -> Self:
        """Fill an absent gain, equal on all axes: the published one, scaled, or a design for the sampled loop."""
        if self.gain is not None:  # pyright: ignore[reportAttributeAccessIssue]
            return self
        gain = disturbance_tables.observer_gain(scenario)
        if scenario.sampled and not mission.is_published_case(scenario):
            gain = mission.design(scenario).observer
        return msgspec.structs.replace(self, gain=(gain,) * scenario.inputs)


class PrescribedTimeTable(LinearTable, frozen=True):
    """An observer that has converged by t_o."""

    def complete_for_file(self, scenario: "Scenario") -> Any:
        """Fill absent times: t_o with t_f / 3, delta_o with the published 0.05 s, scaled, or a control period."""
        table: Any = self
        t_o = scenario.controller.t_f / 3 if table.t_o is None else table.t_o
        period = scenario.loop.period if scenario.sampled else 0.0
        shortest = max(mission.scales(scenario).scaled_value(PUBLISHED_DELTA_O), period)
        delta_o = min(shortest, t_o / 4) if table.delta_o is None else table.delta_o
        return msgspec.structs.replace(self, t_o=t_o, delta_o=delta_o)

    def check(self, scenario: "Scenario") -> None:
        """Raise ScenarioError unless delta_o < t_o <= t_f: the observer must have converged before t_f."""
        table, t_f = self.complete_for_file(scenario), scenario.controller.t_f
        if table.t_o > t_f:
            raise wrong("observer.t_o", table.t_o, f"at most controller.t_f, {t_f} s")
        if table.delta_o >= table.t_o:
            raise wrong("observer.delta_o", table.delta_o, f"less than observer.t_o, {table.t_o} s")


class FiniteTimeTable(ObserverTable, frozen=True):
    """An observer whose gain is a bound on the disturbance's rate."""

    def fill_defaults(self, scenario: "Scenario") -> Self:
        """Return the table; an absent gain becomes 20 times the bound on the disturbance's rate, on all axes."""
        if self.gain is not None:  # pyright: ignore[reportAttributeAccessIssue]
            return self
        rate = scenario.controller.disturbance_rate_bound
        rate = rate or mission.scales(scenario).scaled_value(Scaled(1e-3, inertia=1, time=-1, order=-1))
        return msgspec.structs.replace(self, gain=(rounded(20.0 * rate),) * scenario.inputs)

    def check(self, scenario: "Scenario") -> None:
        """Raise ScenarioError if the gain is below the bound on the disturbance's rate."""
        gain = self.gain  # pyright: ignore[reportAttributeAccessIssue]
        rate_bound = scenario.controller.disturbance_rate_bound or 0.0  # None before custom code has run
        if min(gain) < rate_bound or min(gain) <= 0.0:
            raise wrong("observer.gain", gain, f"at least controller.disturbance_rate_bound, {rate_bound}, each")


def _observer_kinds(default: str, body: bool) -> Mapping[str, type[ObserverTable]]:
    """Return the observers by kind; default: the default kind, body: whether the plant is a spacecraft."""
    kinds = {
        "nonlinear": make_table(LinearTable, nonlinear.NonlinearObserver, "nonlinear", body),
        "none": make_table(ObserverTable, base.NoObserver, "none"),
        "finite_time": make_table(FiniteTimeTable, finite_time.FiniteTimeObserver, "finite_time", body),
        "prescribed_time": make_table(
            PrescribedTimeTable, PrescribedTimeObserver, "prescribed_time", body
        ),
        "custom": custom_kind(
            ObserverTable, base.SampledObserver, ("step",), has_gains=True,
            summary="A custom observer, a class derived from ptsmc_jax.SampledObserver; its fields are further keys.",
        ),
    }  # fmt: skip
    return {default: kinds[default], **kinds}


# by the kind of the plant and the kind of the observer, the default first
OBSERVERS = {
    "spacecraft": _observer_kinds("nonlinear", body=True),
    **dict.fromkeys(("chain", "system"), _observer_kinds("none", body=False)),
}
