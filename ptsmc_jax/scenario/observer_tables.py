"""The observers of a scenario file: each a table with its keys, its gain, what it is refused for, what it is made into.

An observer is its physics in a file of `observers`, a table here, and a row in `OBSERVERS`.
"""

import math
from collections.abc import Mapping
from typing import Annotated, Any, ClassVar, Literal

import msgspec
from msgspec import Meta

from ptsmc_jax.scenario import disturbance_bounds, mission
from ptsmc_jax.scenario.errors import wrong
from ptsmc_jax.scenario.gain_bounds import dead_beat
from ptsmc_jax.scenario.gain_record import Allowed, Choice, GainBounds
from ptsmc_jax.scenario.own import Code, Own, build
from ptsmc_jax.scenario.values import EachPositive, Kind, Kinds, NotNegative, Positive, Scaled, ThreePositive

SHORTEST = Scaled(0.05, time=1)  # delta_o of the prescribed-time observer [s]


class ObserverTable(Kind, frozen=True):
    """An observer, whatever it is for."""

    prefix: ClassVar[str] = "observer_"
    gains: ClassVar[Mapping[str, GainBounds]] = {}

    def check(self, scenario: Any) -> None:
        """Raise ScenarioError where its keys contradict each other, or the scenario's."""

    def build(self, scenario: Any, model: Any) -> Any:
        """The observer of a plant's model."""
        raise NotImplementedError

    def _common(self, scenario: Any, model: Any) -> tuple[Any, Any, Any, Any]:
        """The model, the gain, and the bounds of Assumption 1."""
        from ptsmc_jax.numerics.pytrees import vector

        law, own = scenario.controller, self.gain  # pyright: ignore[reportAttributeAccessIssue]
        return model, vector(own), vector(law.disturbance_rate_bound), vector(law.initial_estimate_error)


class NoObserver(ObserverTable, frozen=True):
    """None: d_hat = 0, and K switches against the whole disturbance."""

    kind: Literal["none"] = "none"

    def build(self, scenario: Any, model: Any) -> Any:
        """`observers.none`."""
        from ptsmc_jax.numerics.pytrees import vector
        from ptsmc_jax.observers.none import NoObserver as Physics

        return Physics(model, vector(scenario.controller.disturbance_bound))


class LinearTable(ObserverTable, frozen=True):
    """An observer with the key `gain`, that of l(w) in (53), or its constant part."""

    lists: ClassVar[tuple[str, ...]] = ("gain",)
    gains: ClassVar[Mapping[str, GainBounds]] = {
        "observer_gain": GainBounds(
            dead_beat, above="a dead-beat observer: nothing of its error is left after a period"
        )
    }

    def filled(self, scenario: Any) -> Any:
        """Fill an absent gain, the same on each axis: as in the paper's case, or designed for the sampled loop."""
        if self.gain is not None:  # pyright: ignore[reportAttributeAccessIssue]
            return self
        gain = disturbance_bounds.observer_gain(scenario)
        if scenario.sampled and not mission.published(scenario):
            gain = mission.design(scenario).observer
        return msgspec.structs.replace(self, gain=(gain,) * scenario.inputs)


class NonlinearObserver(LinearTable, frozen=True):
    """The paper's nonlinear disturbance observer (53), its estimate zero at t = 0.

    Attributes:
        gain: diagonal of l(w); 10 in the paper; default: as fast as the hold phase if sampled [N m s]
    """

    kind: Literal["nonlinear"] = "nonlinear"
    gain: ThreePositive | None = None

    def build(self, scenario: Any, model: Any) -> Any:
        """`observers.nonlinear`."""
        from ptsmc_jax.observers.nonlinear import NonlinearObserver as Physics

        return Physics(*self._common(scenario, model))


class EachNonlinearObserver(NonlinearObserver, frozen=True):
    """The paper's nonlinear disturbance observer (53), its estimate zero at t = 0.

    Attributes:
        gain: one number for each input; default: 10 each, or as fast as the hold phase if sampled [1/s]
    """

    gain: EachPositive | None = None  # pyright: ignore[reportIncompatibleVariableOverride]


class PrescribedTimeObserver(LinearTable, frozen=True):
    """An observer that has converged by t_o, the nonlinear one from then on.

    Attributes:
        mu: the error at t = 0 falls like (t_o - t)^mu; what a moving disturbance adds, like c (t_o - t)/(mu - 1)
        t_o: prescribed time of convergence; default: a third of t_f [s]
        delta_o: time before t_o at which mu/(t_o - t) is switched off; default: t_f / 600, or a period, at most
            t_o/4 [s]
        gain: diagonal of the constant part of l; default: that of the nonlinear one [N m s]
    """

    kind: Literal["prescribed_time"] = "prescribed_time"
    mu: Annotated[float, Meta(gt=1, description="a number greater than 1")] = 2.0
    t_o: Positive | None = None
    delta_o: Positive | None = None
    gain: ThreePositive | None = None

    def times(self, scenario: Any) -> tuple[float, float]:
        """T_o and delta_o [s]; a third of t_f, and the paper's 0.05 s scaled or a period, if not given."""
        t_o = scenario.controller.t_f / 3 if self.t_o is None else self.t_o
        shortest = max(mission.scales(scenario).of(SHORTEST), scenario.loop.period if scenario.sampled else 0.0)
        return t_o, min(shortest, t_o / 4) if self.delta_o is None else self.delta_o

    def written(self, scenario: Any) -> Any:
        """The table with both times filled in."""
        t_o, delta_o = self.times(scenario)
        return msgspec.structs.replace(self, t_o=t_o, delta_o=delta_o)

    def check(self, scenario: Any) -> None:
        """The observer must have converged before t_f."""
        t_o, delta_o = self.times(scenario)
        if t_o > scenario.controller.t_f:
            raise wrong("observer.t_o", t_o, f"at most controller.t_f, {scenario.controller.t_f}")
        if delta_o >= t_o:
            raise wrong("observer.delta_o", delta_o, f"less than observer.t_o, {t_o}")

    def build(self, scenario: Any, model: Any) -> Any:
        """`observers.prescribed_time`."""
        from ptsmc_jax.numerics.pytrees import vector
        from ptsmc_jax.observers.prescribed_time import PrescribedTimeObserver as Physics

        times = (vector(value) for value in (self.mu, *self.times(scenario)))
        return Physics(*self._common(scenario, model), *times)


class EachPrescribedTimeObserver(PrescribedTimeObserver, frozen=True):
    """An observer that has converged by t_o, the nonlinear one from then on.

    Attributes:
        gain: constant part, one number for each input; default: that of the nonlinear one [1/s]
    """

    gain: EachPositive | None = None  # pyright: ignore[reportIncompatibleVariableOverride]


def _usual_bound(choice: Choice) -> tuple[float, float]:
    """A bound on the disturbance's rate."""
    own = choice.scenario.observer.gain
    return max(choice.law.disturbance_rate_bound, 0.05 * min(own)), 50.0 * max(own)


def _allowed_bound(choice: Choice) -> Allowed:
    least = choice.law.disturbance_rate_bound
    return Allowed(least, math.inf, least > 0.0)


class FiniteTimeObserver(ObserverTable, frozen=True):
    """A super-twisting observer, exact after a finite time (Levant 1998).

    Attributes:
        gain: per axis, at least controller.disturbance_rate_bound; default: 20 times that [N m/s]
        sign_width: of its smooth sign, in the continuous loop [N m s]
    """

    kind: Literal["finite_time"] = "finite_time"
    gain: ThreePositive | None = None
    sign_width: NotNegative | None = None
    gains: ClassVar[Mapping[str, GainBounds]] = {"observer_gain": GainBounds(_usual_bound, _allowed_bound)}
    lists: ClassVar[tuple[str, ...]] = ("gain",)
    scaled: ClassVar[Mapping[str, Scaled]] = {"sign_width": Scaled(1e-5, inertia=1, time=1, order=-1)}

    def filled(self, scenario: Any) -> Any:
        """Fill an absent gain from the bound on the disturbance's rate."""
        if self.gain is not None:
            return self
        rate = scenario.controller.disturbance_rate_bound
        rate = rate or mission.scales(scenario).of(Scaled(1e-3, inertia=1, time=-1, order=-1))
        return msgspec.structs.replace(self, gain=(20.0 * rate,) * scenario.inputs)

    def check(self, scenario: Any) -> None:
        """Its gain is a bound on the disturbance's rate."""
        assert self.gain is not None  # `filled`
        least = scenario.controller.disturbance_rate_bound or 0.0  # not known yet where code of one's own says it
        if min(self.gain) < least or min(self.gain) <= 0.0:
            raise wrong("observer.gain", self.gain, f"at least controller.disturbance_rate_bound, {least}, each")

    def build(self, scenario: Any, model: Any) -> Any:
        """`observers.finite_time`."""
        from ptsmc_jax.numerics.pytrees import vector
        from ptsmc_jax.observers.finite_time import FiniteTimeObserver as Physics

        return Physics(*self._common(scenario, model), vector(self.sign_width))


class EachFiniteTimeObserver(FiniteTimeObserver, frozen=True):
    """A super-twisting observer, exact after a finite time (Levant 1998).

    Attributes:
        gain: one for each input, at least controller.disturbance_rate_bound; default: 20 times that [unit of d/s]
        sign_width: of its smooth sign, in the continuous loop
    """

    gain: EachPositive | None = None  # pyright: ignore[reportIncompatibleVariableOverride]


class OwnObserver(Own, ObserverTable, kw_only=True, frozen=True):
    """An observer of one's own, a class derived from ptsmc_jax.SampledObserver; its fields are further keys."""

    kind: Literal["own"] = "own"
    code: Code
    needs: ClassVar[tuple[str, ...]] = ("step",)
    tuned: ClassVar[bool] = True
    prefix: ClassVar[str] = ObserverTable.prefix

    @classmethod
    def base(cls) -> type:
        """`observers.base.SampledObserver`."""
        from ptsmc_jax.observers.base import SampledObserver

        return SampledObserver

    def check(self, scenario: Any) -> None:
        """An observer of one's own is written for samples, and needs the sampled loop."""
        scenario.need_samples('observer.kind = "own"')

    def build(self, scenario: Any, model: Any) -> Any:
        """What the code names."""
        from ptsmc_jax.numerics.pytrees import vector

        made = build(self, model=model, disturbance_bound=vector(scenario.controller.disturbance_bound))
        type(made).tunable = tuple(name.removeprefix(self.prefix) for name in self.gains)
        return made


_EACH: Kinds = {
    "nonlinear": EachNonlinearObserver,
    "finite_time": EachFiniteTimeObserver,
    "prescribed_time": EachPrescribedTimeObserver,
    "own": OwnObserver,
}
# by the kind of the plant and the kind of the observer, the default first
OBSERVERS: dict[str, Mapping[str, type[ObserverTable]]] = {
    "spacecraft": {
        "nonlinear": NonlinearObserver,
        "none": NoObserver,
        "finite_time": FiniteTimeObserver,
        "prescribed_time": PrescribedTimeObserver,
        "own": OwnObserver,
    },
    "chain": {"none": NoObserver, **_EACH},
    "system": {"none": NoObserver, **_EACH},
}
