"""The table [observer] of scenario files: defaults, validation, and the classes by kind in `OBSERVERS`.

The numbers of an observer are declared in `observers`. Start with `ObserverTable`.
"""

import dataclasses
from collections.abc import Mapping
from typing import Any, ClassVar

import msgspec

from ptsmc_jax.declare import Scaled
from ptsmc_jax.numerics.pytrees import vector
from ptsmc_jax.observers import base, finite_time, none, nonlinear, prescribed_time
from ptsmc_jax.scenario import disturbance_tables, mission
from ptsmc_jax.scenario.custom import Custom, custom_kind
from ptsmc_jax.scenario.errors import wrong
from ptsmc_jax.scenario.schema import PartTable, make_table

PUBLISHED_DELTA_O = Scaled(0.05, time=1)  # delta_o of the prescribed-time observer [s]


class ObserverTable(PartTable, frozen=True):
    """An observer for any plant."""

    prefix: ClassVar[str] = "observer_"

    def check(self, scenario: Any) -> None:
        """Raise ScenarioError if keys contradict each other or the scenario."""
        if isinstance(self, Custom):
            scenario.require_sampled_loop('observer.kind = "custom"')

    def build(self, scenario: Any, model: Any) -> Any:
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

    def fill_defaults(self, scenario: Any) -> Any:
        """Fill an absent gain, equal on all axes: the published one, scaled, or a design for the sampled loop."""
        if self.gain is not None:  # pyright: ignore[reportAttributeAccessIssue]
            return self
        gain = disturbance_tables.observer_gain(scenario)
        if scenario.sampled and not mission.is_published_case(scenario):
            gain = mission.design(scenario).observer
        return msgspec.structs.replace(self, gain=(gain,) * scenario.inputs)


class PrescribedTimeTable(LinearTable, frozen=True):
    """An observer that has converged by t_o."""

    def complete_for_file(self, scenario: Any) -> Any:
        """Fill absent times: t_o with t_f / 3, delta_o with the published 0.05 s, scaled, or a control period."""
        table: Any = self
        t_o = scenario.controller.t_f / 3 if table.t_o is None else table.t_o
        period = scenario.loop.period if scenario.sampled else 0.0
        shortest = max(mission.scales(scenario).scaled_value(PUBLISHED_DELTA_O), period)
        delta_o = min(shortest, t_o / 4) if table.delta_o is None else table.delta_o
        return msgspec.structs.replace(self, t_o=t_o, delta_o=delta_o)

    def check(self, scenario: Any) -> None:
        """Raise ScenarioError unless delta_o < t_o <= t_f: the observer must have converged before t_f."""
        table, t_f = self.complete_for_file(scenario), scenario.controller.t_f
        if table.t_o > t_f:
            raise wrong("observer.t_o", table.t_o, f"at most controller.t_f, {t_f}")
        if table.delta_o >= table.t_o:
            raise wrong("observer.delta_o", table.delta_o, f"less than observer.t_o, {table.t_o}")


class FiniteTimeTable(ObserverTable, frozen=True):
    """An observer whose gain is a bound on the disturbance's rate."""

    def fill_defaults(self, scenario: Any) -> Any:
        """Fill an absent gain from the bound on the disturbance's rate."""
        if self.gain is not None:  # pyright: ignore[reportAttributeAccessIssue]
            return self
        rate = scenario.controller.disturbance_rate_bound
        rate = rate or mission.scales(scenario).scaled_value(Scaled(1e-3, inertia=1, time=-1, order=-1))
        return msgspec.structs.replace(self, gain=(20.0 * rate,) * scenario.inputs)

    def check(self, scenario: Any) -> None:
        """Raise ScenarioError if the gain is below the bound on the disturbance's rate."""
        gain = self.gain  # pyright: ignore[reportAttributeAccessIssue]
        rate_bound = scenario.controller.disturbance_rate_bound or 0.0  # None before custom code has run
        if min(gain) < rate_bound or min(gain) <= 0.0:
            raise wrong("observer.gain", gain, f"at least controller.disturbance_rate_bound, {rate_bound}, each")


def _observer_kinds(default: str, body: bool) -> Mapping[str, type[ObserverTable]]:
    """Return the observers by kind; default: the default kind, body: whether the plant is a spacecraft."""
    kinds = {
        "nonlinear": make_table(LinearTable, nonlinear.NonlinearObserver, "nonlinear", body),
        "none": make_table(ObserverTable, none.NoObserver, "none"),
        "finite_time": make_table(FiniteTimeTable, finite_time.FiniteTimeObserver, "finite_time", body),
        "prescribed_time": make_table(
            PrescribedTimeTable, prescribed_time.PrescribedTimeObserver, "prescribed_time", body
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
