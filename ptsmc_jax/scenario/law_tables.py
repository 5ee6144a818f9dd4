"""The laws of a scenario file: each a table with its keys, its gains, what it is refused for, and what it is made into.

A law is its physics in a file of `laws`, a table here, and a row in `LAWS`.
"""

import dataclasses
import math
from collections.abc import Mapping
from typing import Annotated, Any, ClassVar, Literal

from msgspec import Meta

from ptsmc_jax.scenario import gain_bounds
from ptsmc_jax.scenario.errors import wrong
from ptsmc_jax.scenario.gain_bounds import Allowed, Choice, GainBounds, between
from ptsmc_jax.scenario.values import NotNegative, Positive, Table

Power = Annotated[float, Meta(gt=1, lt=2, description="a number between 1 and 2")]
AboveOne = Annotated[float, Meta(gt=1, description="a number greater than 1")]
Eta = Annotated[float, Meta(gt=2, description="a number greater than 2 (Theorem 2)")]


class LawTable(Table, frozen=True):
    """A law, whatever it is for; each has t_f, and bounds of Assumption 1 on the disturbance."""

    gains: ClassVar[Mapping[str, GainBounds]] = {}  # all that tuning may move
    # those that are free where a scenario does not say; the second ones in the sampled loop only, since without samples
    # a larger K1 and a narrower sign cost nothing but steps
    free_by_default: ClassVar[tuple[str, ...]] = ()
    free_if_sampled: ClassVar[tuple[str, ...]] = ()
    prescribed: ClassVar[bool] = False  # hands over at t_f - delta, and flies in either loop; others when sampled only

    def physics(self) -> Any:
        """What flies: a class of `laws`, its fields named as the keys."""
        raise NotImplementedError

    def turning(self, t_f: float) -> tuple[str, float]:
        """How fast it turns the body [rad/s], at most, and the key that says so."""
        raise NotImplementedError

    def check(self) -> None:
        """Raise ScenarioError where its keys contradict each other."""

    def build(self, scenario: Any, model: Any) -> Any:
        """The law of a plant's model."""
        from ptsmc_jax.numerics.pytrees import vector

        made = self.physics()
        names = [field.name for field in dataclasses.fields(made) if field.name != "model"]
        own = {name: gain_bounds.hand_over(scenario) if name == "delta" else getattr(self, name) for name in names}
        return made(model, **{name: vector(value) for name, value in own.items()})


def _eta_must_exceed_two(_: Any) -> float:
    return 2.0  # Theorems 1 and 2


class PrescribedTable(LawTable, frozen=True):
    """The paper's gains, whatever the plant."""

    prescribed: ClassVar[bool] = True
    gains: ClassVar[Mapping[str, GainBounds]] = {
        "eta": gain_bounds.eta(_eta_must_exceed_two),
        "delta": gain_bounds.DELTA,
        "k1": gain_bounds.K1,
        "sign_width": gain_bounds.SIGN_WIDTH,
        "surface_rate": gain_bounds.SURFACE_RATE,
        "t_f": gain_bounds.T_F,
    }
    free_by_default: ClassVar[tuple[str, ...]] = ("eta", "delta")
    free_if_sampled: ClassVar[tuple[str, ...]] = ("k1", "sign_width")

    def turning(self, t_f: float) -> tuple[str, float]:
        """On its surface, at the start."""
        return "controller.eta", 2.0 * self.eta / t_f  # pyright: ignore[reportAttributeAccessIssue]


class SpacecraftController(PrescribedTable, frozen=True):
    """The paper's law for a spacecraft: (56) and (57) before the hand-over, (59) and (60) after it.

    Attributes:
        error: the paper's q_1 - q_1f, or the vector part of q_f* q, singular 180 degrees from the reference only
        t_f: the prescribed time [s]
        eta: power of the approach: the error falls like (t_f - t)^eta, up to a logarithm
        delta: hand-over to constant gains so long before t_f (Remark 1) [s]
        k1: K1, rate of s from the hand-over on, halved by (60) [1/s]
        sign_width: of the smooth sign tanh(s / sign_width); 0 is the exact sign
        surface_rate: c of s = eps' + c eps, the error's rate on the surface from the hand-over on; 1 in the paper [1/s]
        disturbance_rate_bound: c of Assumption 1, bound on each component of d' [N m/s]
        disturbance_bound: K of Assumption 1, bound on each component of d, used without an observer [N m]
        initial_estimate_error: bound on the observer's error at t = 0 [N m]
    """

    kind: Literal["prescribed_time"] = "prescribed_time"
    error: Literal["additive", "multiplicative"] = "additive"
    t_f: Positive = 30.0
    eta: Eta = 3.0
    delta: Positive = 0.05
    k1: Positive = 1.0
    sign_width: NotNegative = 1e-3
    surface_rate: Positive = 1.0
    disturbance_rate_bound: NotNegative = 1e-3
    disturbance_bound: NotNegative = 0.01
    initial_estimate_error: NotNegative = 0.0

    def physics(self) -> Any:
        """By its error."""
        from ptsmc_jax.laws.prescribed_time import PrescribedTime, PrescribedTimeMultiplicative

        return PrescribedTimeMultiplicative if self.error == "multiplicative" else PrescribedTime


class BaselineTable(LawTable, frozen=True):
    """What the laws to compare with have besides their gains.

    Attributes:
        t_f: when the law is judged [s]
        disturbance_rate_bound: c of Assumption 1, bound on each component of d' [N m/s]
        disturbance_bound: K of Assumption 1, bound on each component of d, used without an observer [N m]
        initial_estimate_error: bound on the observer's error at t = 0 [N m]
    """

    t_f: Positive = 30.0
    disturbance_rate_bound: NotNegative = 1e-3
    disturbance_bound: NotNegative = 0.01
    initial_estimate_error: NotNegative = 0.0


def _over_t_f(low: float, high: float, power: int = 1) -> GainBounds:
    """Bounds low / t_f^power and high / t_f^power."""
    return GainBounds(lambda choice: (low / choice.t_f**power, high / choice.t_f**power))


class PDController(BaselineTable, frozen=True):
    """Quaternion PD with the reference's motion fed forward (Wie, Weiss, Arapostathis 1989); sampled loop only.

    Attributes:
        k_p: gain on the vector part of the error quaternion [1/s^2]
        k_d: gain on the rate error [1/s]
    """

    kind: Literal["pd"] = "pd"
    k_p: Positive = 0.2
    k_d: Positive = 0.6
    gains: ClassVar[Mapping[str, GainBounds]] = {
        "k_p": _over_t_f(2.0, 2000.0, 2),
        "k_d": _over_t_f(0.3, 100.0),
        "t_f": gain_bounds.T_F,
    }
    free_by_default: ClassVar[tuple[str, ...]] = ("k_p", "k_d")

    def physics(self) -> Any:
        """`laws.pd`."""
        from ptsmc_jax.laws.pd import QuaternionPD

        return QuaternionPD

    def turning(self, t_f: float) -> tuple[str, float]:
        """The rate at the goal if all of its spring's potential energy had become motion."""
        return "controller.k_p", 2.0 * math.sqrt(self.k_p)


class TerminalController(BaselineTable, frozen=True):
    """Nonsingular terminal sliding mode, s = v + sig^p(v') / b (Feng, Yu, Man 2002); sampled loop only.

    Attributes:
        p: power of the surface
        b: scale of the surface [1/s^p]
        k: reaching gain [1/s^2]
        sign_width: of the smooth sign; 0 is the exact sign
    """

    kind: Literal["terminal"] = "terminal"
    p: Power = 1.3
    b: Positive = 0.1
    k: Positive = 0.1
    sign_width: NotNegative = 1e-3
    gains: ClassVar[Mapping[str, GainBounds]] = {
        "p": GainBounds(lambda _: (1.05, 1.95), between(1.0, 2.0)),
        "b": _over_t_f(0.01, 100.0),
        "k": _over_t_f(2.0, 2000.0, 2),
        "sign_width": gain_bounds.SIGN_WIDTH,
        "t_f": gain_bounds.T_F,
    }
    free_by_default: ClassVar[tuple[str, ...]] = ("p", "b", "k")
    free_if_sampled: ClassVar[tuple[str, ...]] = ("sign_width",)

    def physics(self) -> Any:
        """`laws.terminal`."""
        from ptsmc_jax.laws.terminal import Terminal

        return Terminal

    def turning(self, t_f: float) -> tuple[str, float]:
        """On its surface, at |v| = 1."""
        return "controller.b", 2.0 * self.b ** (1.0 / self.p)


def _usual_p(choice: Choice) -> tuple[float, float]:
    least = _allowed_p(choice)[0]
    return least + 0.05 * (2.0 - least), 2.0 - 0.05 * (2.0 - least)


def _allowed_p(choice: Choice) -> Allowed:
    """For gamma - 1/p > 1; where gamma is free too, it follows p."""
    return Allowed(1.0 if "gamma" in choice.free else max(1.0, 1.0 / (choice.law.gamma - 1.0)), 2.0)


def _usual_gamma(choice: Choice) -> tuple[float, float]:
    least = _allowed_gamma(choice)[0]
    return least + 0.05, least + 2.0


def _allowed_gamma(choice: Choice) -> Allowed:
    """Gamma - 1/p > 1, for every p."""
    return Allowed(1.0 + 1.0 / choice.smallest("p"), math.inf)


class FixedTimeController(BaselineTable, frozen=True):
    """Fixed-time sliding mode (Zuo 2015; Jiang, Hu, Friswell 2016), gamma - 1/p > 1; sampled loop only.

    Attributes:
        a1: surface, weight of |v|^gamma, which rules far from the goal [1/s]
        b1: surface, weight of |v|^(1/p), which rules near it [1/s]
        a2: reaching law, weight of |s|^m, which rules far from the surface [1/s^(2-p)]
        b2: reaching law, weight of |s|^n, which rules near it [1/s^(2-p)]
        p: power of the surface
        gamma: power of the surface
        m: power of the reaching law
        n: power of the reaching law
        sign_width: of the smooth sign; 0 is the exact sign
    """

    kind: Literal["fixed_time"] = "fixed_time"
    a1: Positive = 0.1
    b1: Positive = 0.2
    a2: Positive = 1.0
    b2: Positive = 1.0
    p: Power = 1.25
    gamma: AboveOne = 2.0
    m: AboveOne = 1.5
    n: Annotated[float, Meta(gt=0, lt=1, description="a number between 0 and 1")] = 0.5
    sign_width: NotNegative = 1e-3
    gains: ClassVar[Mapping[str, GainBounds]] = {
        "p": GainBounds(_usual_p, _allowed_p),  # before gamma, whose bounds go by it
        **dict.fromkeys(("a1", "b1"), _over_t_f(0.01, 100.0)),
        **dict.fromkeys(("a2", "b2"), GainBounds(lambda _: (1e-4, 10.0))),
        "gamma": GainBounds(_usual_gamma, _allowed_gamma),
        "m": GainBounds(lambda _: (1.05, 3.0), between(1.0, math.inf)),
        "n": GainBounds(lambda _: (0.05, 0.95), between(0.0, 1.0)),
        "sign_width": gain_bounds.SIGN_WIDTH,
        "t_f": gain_bounds.T_F,
    }
    free_by_default: ClassVar[tuple[str, ...]] = ("a1", "b1", "a2", "b2", "p", "gamma", "m", "n")
    free_if_sampled: ClassVar[tuple[str, ...]] = ("sign_width",)

    def physics(self) -> Any:
        """`laws.fixed_time`."""
        from ptsmc_jax.laws.fixed_time import FixedTime

        return FixedTime

    def turning(self, t_f: float) -> tuple[str, float]:
        """On its surface, at |v| = 1."""
        return "controller.a1", 2.0 * (self.a1 + self.b1)

    def check(self) -> None:
        """Its surface is nonsingular for gamma - 1/p > 1 only."""
        if not self.gamma - 1.0 / self.p > 1.0:
            raise wrong("controller.gamma", self.gamma, f"greater than 1 + 1/p, {1.0 + 1.0 / self.p:.6g}")


class SystemController(PrescribedTable, frozen=True):
    """The paper's law (29) for a second-order system, with (57)'s gains.

    Attributes:
        t_f: the prescribed time [s]
        eta: power of the approach: the error falls like (t_f - t)^eta, up to a logarithm
        delta: hand-over to constant gains so long before t_f (Remark 1) [s]
        k1: K1, rate of s from the hand-over on [1/s]
        sign_width: of the smooth sign tanh(s / sign_width); 0 is the exact sign [unit of s]
        surface_rate: c of s = eps' + c eps, the error's rate on the surface from the hand-over on; 1 in the paper [1/s]
        disturbance_rate_bound: c of Assumption 1, bound on each component of d' [unit of d/s]
        disturbance_bound: K of Assumption 1, bound on each component of d, used without an observer [unit of d]
        initial_estimate_error: bound on the observer's error at t = 0 [unit of d]
    """

    kind: Literal["prescribed_time"] = "prescribed_time"
    t_f: Positive = 5.0
    eta: Eta = 3.0
    delta: Positive = 0.05
    k1: Positive = 1.0
    sign_width: NotNegative = 1e-3
    surface_rate: Positive = 1.0
    disturbance_rate_bound: NotNegative = 0.01
    disturbance_bound: NotNegative = 0.01
    initial_estimate_error: NotNegative = 0.0

    def physics(self) -> Any:
        """`laws.prescribed_time`."""
        from ptsmc_jax.laws.prescribed_time import PrescribedTimeSystem

        return PrescribedTimeSystem


class ChainController(SystemController, frozen=True):
    """The paper's law (52) for an integrator chain; without an observer (36) to (40).

    Attributes:
        eta: power of the approach; default: order + 1
        a: a_1 to a_(order-1) of the surface (39), stable; default: all poles at -1
        surface_rate: the poles of (39) are this times those of a; 1 in the paper [1/s]
    """

    eta: Annotated[float, Meta(gt=0, description="a number greater than the order (Theorems 1 and 3)")] = 3.0
    a: Annotated[tuple[float, ...], Meta(min_length=1, description="a list of numbers, a_1 to a_(order-1) of (39)")] = (
        1.0,
    )
    gains: ClassVar[Mapping[str, GainBounds]] = {
        **PrescribedTable.gains,
        "eta": gain_bounds.eta(lambda scenario: float(scenario.plant.order)),  # Theorem 3
    }

    def physics(self) -> Any:
        """`laws.prescribed_time`."""
        from ptsmc_jax.laws.prescribed_time import PrescribedTimeChain

        return PrescribedTimeChain


# by the kind of the plant and the kind of the law, the default first
LAWS: dict[str, Mapping[str, type[LawTable]]] = {
    "spacecraft": {
        "prescribed_time": SpacecraftController,
        "pd": PDController,
        "terminal": TerminalController,
        "fixed_time": FixedTimeController,
    },
    "chain": {"prescribed_time": ChainController},
    "system": {"prescribed_time": SystemController},
}
