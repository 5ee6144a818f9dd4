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
from ptsmc_jax.scenario import disturbance_bounds, mission
from ptsmc_jax.scenario.custom import Custom, custom_kind
from ptsmc_jax.scenario.errors import wrong
from ptsmc_jax.scenario.schema import PartTable, table

SHORTEST = Scaled(0.05, time=1)  # delta_o of the prescribed-time observer [s]


class ObserverTable(PartTable, frozen=True):
    """An observer for any plant."""

    prefix: ClassVar[str] = "observer_"

    def check(self, scenario: Any) -> None:
        """Raise ScenarioError if keys contradict each other or the scenario."""
        if isinstance(self, Custom):
            scenario.need_samples('observer.kind = "custom"')

    def build(self, scenario: Any, model: Any) -> Any:
        """Return the observer for the design model of the plant, see `Scenario.model`."""
        law, names = scenario.controller, {field.name for field in dataclasses.fields(self.made)}
        known = {
            "disturbance_bound": law.disturbance_bound,
            "disturbance_rate_bound": law.disturbance_rate_bound,
            "initial_error": law.initial_estimate_error,
        }
        return self.written(scenario).part(model=model, **{k: vector(v) for k, v in known.items() if k in names})


class LinearTable(ObserverTable, frozen=True):
    """An observer with the gain of l(w) in (53), or with its constant part."""

    def filled(self, scenario: Any) -> Any:
        """Fill an absent gain, equal on all axes: the published one, scaled, or a design for the sampled loop."""
        if self.gain is not None:  # pyright: ignore[reportAttributeAccessIssue]
            return self
        gain = disturbance_bounds.observer_gain(scenario)
        if scenario.sampled and not mission.published(scenario):
            gain = mission.design(scenario).observer
        return msgspec.structs.replace(self, gain=(gain,) * scenario.inputs)


class PrescribedTimeTable(LinearTable, frozen=True):
    """An observer that has converged by t_o."""

    def written(self, scenario: Any) -> Any:
        """Fill absent times: t_o with t_f / 3, delta_o with the published 0.05 s, scaled, or a control period."""
        table: Any = self
        t_o = scenario.controller.t_f / 3 if table.t_o is None else table.t_o
        shortest = max(mission.scales(scenario).of(SHORTEST), scenario.loop.period if scenario.sampled else 0.0)
        delta_o = min(shortest, t_o / 4) if table.delta_o is None else table.delta_o
        return msgspec.structs.replace(self, t_o=t_o, delta_o=delta_o)

    def check(self, scenario: Any) -> None:
        """Raise ScenarioError unless delta_o < t_o <= t_f: the observer must have converged before t_f."""
        table, t_f = self.written(scenario), scenario.controller.t_f
        if table.t_o > t_f:
            raise wrong("observer.t_o", table.t_o, f"at most controller.t_f, {t_f}")
        if table.delta_o >= table.t_o:
            raise wrong("observer.delta_o", table.delta_o, f"less than observer.t_o, {table.t_o}")


class FiniteTimeTable(ObserverTable, frozen=True):
    """An observer whose gain is a bound on the disturbance's rate."""

    def filled(self, scenario: Any) -> Any:
        """Fill an absent gain from the bound on the disturbance's rate."""
        if self.gain is not None:  # pyright: ignore[reportAttributeAccessIssue]
            return self
        rate = scenario.controller.disturbance_rate_bound
        rate = rate or mission.scales(scenario).of(Scaled(1e-3, inertia=1, time=-1, order=-1))
        return msgspec.structs.replace(self, gain=(20.0 * rate,) * scenario.inputs)

    def check(self, scenario: Any) -> None:
        """Raise ScenarioError if the gain is below the bound on the disturbance's rate."""
        gain = self.gain  # pyright: ignore[reportAttributeAccessIssue]
        least = scenario.controller.disturbance_rate_bound or 0.0  # None before custom code has run
        if min(gain) < least or min(gain) <= 0.0:
            raise wrong("observer.gain", gain, f"at least controller.disturbance_rate_bound, {least}, each")


def _observers(first: str, body: bool) -> Mapping[str, type[ObserverTable]]:
    """Return the observers by kind; first: the default kind, body: whether the plant is a spacecraft."""
    kinds = {
        "nonlinear": table(LinearTable, nonlinear.NonlinearObserver, "nonlinear", body),
        "none": table(ObserverTable, none.NoObserver, "none"),
        "finite_time": table(FiniteTimeTable, finite_time.FiniteTimeObserver, "finite_time", body),
        "prescribed_time": table(PrescribedTimeTable, prescribed_time.PrescribedTimeObserver, "prescribed_time", body),
        "custom": custom_kind(
            ObserverTable, base.SampledObserver, ("step",), tuned=True,
            summary="A custom observer, a class derived from ptsmc_jax.SampledObserver; its fields are further keys.",
        ),
    }  # fmt: skip
    return {first: kinds[first], **kinds}


# by the kind of the plant and the kind of the observer, the default first
OBSERVERS = {
    "spacecraft": _observers("nonlinear", body=True),
    **dict.fromkeys(("chain", "system"), _observers("none", body=False)),
}
