"""The laws of a scenario file to compare with: each its physics in a file of `laws`, a table here, and a row below."""

import math
from collections.abc import Mapping
from typing import Annotated, Any, ClassVar, Literal

from msgspec import Meta

from ptsmc_jax.scenario import gain_bounds
from ptsmc_jax.scenario.baseline_record import BaselineTable, over_t_f, until_sampling
from ptsmc_jax.scenario.errors import wrong
from ptsmc_jax.scenario.gain_record import Allowed, Choice, GainBounds, between
from ptsmc_jax.scenario.mission import Design, Scales, scales
from ptsmc_jax.scenario.values import ABSENT, NotNegative, ResolvedNotNegative, ResolvedPositive, Scaled

Power = Annotated[float, Meta(gt=1, lt=2, description="a number between 1 and 2")]
AboveOne = Annotated[float, Meta(gt=1, description="a number greater than 1")]


class PDController(BaselineTable, frozen=True):
    """Quaternion PD with the reference's motion fed forward (Wie, Weiss, Arapostathis 1989).

    Attributes:
        k_p: gain on the vector part of the error quaternion [1/s^2]
        k_d: gain on the rate error [1/s]
    """

    kind: Literal["pd"] = "pd"
    switches: ClassVar[bool] = False
    k_p: ResolvedPositive = ABSENT
    k_d: ResolvedPositive = ABSENT
    scaled: ClassVar[Mapping[str, Scaled]] = {"k_p": Scaled(0.2, time=-2), "k_d": Scaled(0.6, time=-1)}
    gains: ClassVar[Mapping[str, GainBounds]] = {
        "k_p": over_t_f(2.0, 2000.0, 2),
        "k_d": over_t_f(0.3, 100.0),
        "t_f": gain_bounds.T_F,
    }
    free_by_default: ClassVar[tuple[str, ...]] = ("k_p", "k_d")

    def physics(self, motion: str) -> Any:
        """Return the class; the law of a spacecraft turns the body, not the error vector."""
        from ptsmc_jax.laws.baselines import PD, QuaternionPD

        return QuaternionPD if motion == "spacecraft" else PD

    def turning(self, t_f: float) -> tuple[str, float]:
        """The rate at the goal if all of its spring's potential energy had become motion."""
        return "controller.k_p", 2.0 * math.sqrt(self.k_p)


def _usual_surface(choice: Choice) -> tuple[float, float]:
    """Four decades about 0.03 1/s^p in the paper's case."""
    unit = scales(choice.scenario).time ** -choice.law.p
    return 3e-4 * unit, 3.0 * unit


class TerminalController(BaselineTable, frozen=True):
    """Nonsingular terminal sliding mode, s = v + sig^p(v') / b (Feng, Yu, Man 2002).

    Attributes:
        p: power of the surface
        b: scale of the surface [1/s^p]
        k: reaching gain [1/s^2]
        sign_width: of the smooth sign; 0 is the exact sign
    """

    kind: Literal["terminal"] = "terminal"
    p: Power = 1.3
    b: ResolvedPositive = ABSENT
    k: ResolvedPositive = ABSENT
    sign_width: NotNegative = 1e-3
    scaled: ClassVar[Mapping[str, Scaled]] = {"k": Scaled(0.1, time=-2)}
    gains: ClassVar[Mapping[str, GainBounds]] = {
        "p": GainBounds(lambda _: (1.05, 1.95), between(1.0, 2.0)),
        "b": GainBounds(_usual_surface),
        "k": over_t_f(2.0, 2000.0, 2),
        "sign_width": gain_bounds.SIGN_WIDTH,
        "t_f": gain_bounds.T_F,
    }
    free_by_default: ClassVar[tuple[str, ...]] = ("p", "b", "k")
    free_if_sampled: ClassVar[tuple[str, ...]] = ("sign_width",)

    def physics(self, motion: str) -> Any:
        """Return the class of `laws`, for every motion."""
        from ptsmc_jax.laws.baselines import Terminal

        return Terminal

    def published_in(self, units: Scales) -> dict[str, Any]:
        """With b, whose unit depends on p."""
        return {**super().published_in(units), "b": units.of(Scaled(0.1, time=-self.p))}

    def noise_of_s(self, position: float, velocity: float) -> float:
        """Return the noise of s = v + sig^p(v') / b."""
        return math.hypot(position, velocity**self.p / self.b)

    def turning(self, t_f: float) -> tuple[str, float]:
        """On its surface, at |v| = 1."""
        return "controller.b", 2.0 * self.b ** (1.0 / self.p)


def _usual_p(choice: Choice) -> tuple[float, float]:
    least = _allowed_p(choice)[0]
    return least + 0.05 * (2.0 - least), 2.0 - 0.05 * (2.0 - least)


def _allowed_p(choice: Choice) -> Allowed:
    """For gamma - 1/p > 1; where gamma is free too, it follows p."""
    return Allowed(1.0 if "gamma" in choice.free else max(1.0, 1.0 / (choice.law.gamma - 1.0)), 2.0)


def _usual_reaching(choice: Choice) -> tuple[float, float]:
    unit = scales(choice.scenario).time ** (choice.law.p - 2.0)
    return 1e-4 * unit, 10.0 * unit


def _usual_gamma(choice: Choice) -> tuple[float, float]:
    least = _allowed_gamma(choice)[0]
    return least + 0.05, least + 2.0


def _allowed_gamma(choice: Choice) -> Allowed:
    """Gamma - 1/p > 1, for every p."""
    return Allowed(1.0 + 1.0 / choice.smallest("p"), math.inf)


class FixedTimeController(BaselineTable, frozen=True):
    """Fixed-time sliding mode (Zuo 2015; Jiang, Hu, Friswell 2016), gamma - 1/p > 1.

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
    a1: ResolvedPositive = ABSENT
    b1: ResolvedPositive = ABSENT
    a2: ResolvedPositive = ABSENT
    b2: ResolvedPositive = ABSENT
    p: Power = 1.25
    gamma: AboveOne = 2.0
    m: AboveOne = 1.5
    n: Annotated[float, Meta(gt=0, lt=1, description="a number between 0 and 1")] = 0.5
    sign_width: NotNegative = 1e-3
    scaled: ClassVar[Mapping[str, Scaled]] = {"a1": Scaled(0.1, time=-1), "b1": Scaled(0.2, time=-1)}
    gains: ClassVar[Mapping[str, GainBounds]] = {
        "p": GainBounds(_usual_p, _allowed_p),  # before gamma, whose bounds go by it
        **dict.fromkeys(("a1", "b1"), over_t_f(0.01, 100.0)),
        **dict.fromkeys(("a2", "b2"), GainBounds(_usual_reaching)),
        "gamma": GainBounds(_usual_gamma, _allowed_gamma),
        "m": GainBounds(lambda _: (1.05, 3.0), between(1.0, math.inf)),
        "n": GainBounds(lambda _: (0.05, 0.95), between(0.0, 1.0)),
        "sign_width": gain_bounds.SIGN_WIDTH,
        "t_f": gain_bounds.T_F,
    }
    free_by_default: ClassVar[tuple[str, ...]] = ("a1", "b1", "a2", "b2", "p", "gamma", "m", "n")
    free_if_sampled: ClassVar[tuple[str, ...]] = ("sign_width",)

    def physics(self, motion: str) -> Any:
        """Return the class of `laws`, for every motion."""
        from ptsmc_jax.laws.baselines import FixedTime

        return FixedTime

    def turning(self, t_f: float) -> tuple[str, float]:
        """On its surface, at |v| = 1."""
        return "controller.a1", 2.0 * (self.a1 + self.b1)

    def published_in(self, units: Scales) -> dict[str, Any]:
        """With a2 and b2, whose unit depends on p."""
        return {**super().published_in(units), **dict.fromkeys(("a2", "b2"), units.of(Scaled(1.0, time=self.p - 2.0)))}

    def noise_of_s(self, position: float, velocity: float) -> float:
        """Return the noise of s = v + sig^p(v' / b1) near the reference."""
        return math.hypot(position, (velocity / self.b1) ** self.p)

    def check(self, scenario: Any) -> None:
        """Its surface is nonsingular for gamma - 1/p > 1 only."""
        super().check(scenario)
        if not self.gamma - 1.0 / self.p > 1.0:
            raise wrong("controller.gamma", self.gamma, f"greater than 1 + 1/p, {1.0 + 1.0 / self.p:.6g}")


class TimeBasePDController(BaselineTable, frozen=True):
    """A profile from the first error to zero at t_f, a quintic about the eigenaxis, under PD (Becerra and others 2018).

    Attributes:
        k_p: gain on what the error is apart from its profile [1/s^2]
        k_d: gain on its rate [1/s]
    """

    kind: Literal["time_base_pd"] = "time_base_pd"
    switches: ClassVar[bool] = False
    k_p: ResolvedPositive = ABSENT
    k_d: ResolvedPositive = ABSENT
    scaled: ClassVar[Mapping[str, Scaled]] = {"k_p": Scaled(1.0, time=-2), "k_d": Scaled(2.0, time=-1)}

    gains: ClassVar[Mapping[str, GainBounds]] = {
        "k_p": until_sampling(2.0, 0.25, 2),
        "k_d": until_sampling(0.3, 1.0),
        "t_f": gain_bounds.T_F,
    }
    free_by_default: ClassVar[tuple[str, ...]] = ("k_p", "k_d")

    def gains_of(self, design: Design, scenario: Any) -> dict[str, float]:
        """Return both poles of the tracking loop at the design's."""
        return {"k_p": design.pole**2, "k_d": 2.0 * design.pole}

    def physics(self, motion: str) -> Any:
        """Return the class of `laws`, for every motion."""
        from ptsmc_jax.laws.time_base import TimeBasePD

        return TimeBasePD

    def turning(self, t_f: float) -> tuple[str, float]:
        """In the middle of half a turn."""
        return _profile(t_f)


def _profile(t_f: float) -> tuple[str, float]:
    return "controller.t_f", 15.0 / 8.0 * math.pi / t_f


class TimeBaseSlidingController(BaselineTable, frozen=True):
    """The same profile under a sliding mode, s = E' + c E (Becerra and others 2018).

    Attributes:
        surface_rate: c, rate on the surface [1/s]
        k: rate of s [1/s]
        sign_width: thickness of the boundary layer; 0 is the discontinuous sign [1/s]
    """

    kind: Literal["time_base_sliding"] = "time_base_sliding"
    surface_rate: ResolvedPositive = ABSENT
    k: ResolvedPositive = ABSENT
    sign_width: ResolvedNotNegative = ABSENT
    scaled: ClassVar[Mapping[str, Scaled]] = {
        "surface_rate": Scaled(1.0, time=-1),
        "k": Scaled(1.0, time=-1),
        "sign_width": Scaled(1e-3, time=-1),
    }

    gains: ClassVar[Mapping[str, GainBounds]] = {
        "surface_rate": until_sampling(0.3, 1.0),
        "k": until_sampling(0.3, 1.0),
        "sign_width": gain_bounds.SIGN_WIDTH,
        "t_f": gain_bounds.T_F,
    }
    free_by_default: ClassVar[tuple[str, ...]] = ("surface_rate", "k")
    free_if_sampled: ClassVar[tuple[str, ...]] = ("sign_width",)

    def gains_of(self, design: Design, scenario: Any) -> dict[str, float]:
        """Return both poles of the tracking loop at the design's."""
        return {"surface_rate": design.pole, "k": design.pole, "sign_width": design.width}

    def physics(self, motion: str) -> Any:
        """Return the class of `laws`, for every motion."""
        from ptsmc_jax.laws.time_base import TimeBaseSliding

        return TimeBaseSliding

    def turning(self, t_f: float) -> tuple[str, float]:
        """In the middle of half a turn."""
        return _profile(t_f)


class ScalingController(BaselineTable, frozen=True):
    """Prescribed time by scaling with (t_f/(t_f - t))^(2+m) (Song, Wang, Holloway, Krstic 2017).

    Attributes:
        delta: time before t_f at which the gains become constant [s]
        m: excess of the power of the scaling
        k1: rate of the scaled error [1/s]
        k: rate of its surface, while the scaling is 1 [1/s]
    """

    kind: Literal["scaling"] = "scaling"
    switches: ClassVar[bool] = False
    delta: ResolvedPositive = ABSENT
    m: Annotated[float, Meta(ge=1, description="a number, at least 1")] = 1.0
    k1: ResolvedPositive = ABSENT
    k: ResolvedPositive = ABSENT
    scaled: ClassVar[Mapping[str, Scaled]] = {
        "delta": Scaled(2.0, time=1),
        "k1": Scaled(1.0, time=-1),
        "k": Scaled(1e-3, time=-1),
    }

    gains: ClassVar[Mapping[str, GainBounds]] = {
        "delta": gain_bounds.DELTA,
        "m": GainBounds(lambda _: (1.0, 5.0), lambda _: Allowed(1.0, math.inf, lower_included=True)),
        "k1": until_sampling(0.3, 0.5),
        "k": GainBounds(lambda choice: (1e-5 / choice.t_f, 10.0 / choice.t_f)),
        "t_f": gain_bounds.T_F,
    }
    free_by_default: ClassVar[tuple[str, ...]] = ("delta", "m", "k1", "k")

    def gains_of(self, design: Design, scenario: Any) -> dict[str, float]:
        """Return the hold phase's poles at the design's, and a hand-over where the approach is as fast."""
        return {**super().gains_of(design, scenario), "delta": design.delta, "k1": design.pole}

    def physics(self, motion: str) -> Any:
        """Return the class of `laws`, for every motion."""
        from ptsmc_jax.laws.baselines import Scaling

        return Scaling

    def turning(self, t_f: float) -> tuple[str, float]:
        """At the start."""
        return "controller.m", 2.0 * (2.0 + self.m) / t_f


class PredefinedTimeController(BaselineTable, frozen=True):
    """Predefined-time sliding mode (Sanchez-Torres and others 2018; Jimenez-Rodriguez and others 2020).

    Attributes:
        share: of t_f in which the error settles on the surface, after the rest, in which the surface is reached
        q1: power of the surface
        q2: power of the reaching law
        sign_width: thickness of the boundary layer; 0 is the discontinuous sign [1/s]
    """

    kind: Literal["predefined_time"] = "predefined_time"
    share: Annotated[float, Meta(gt=0, lt=1, description="a number between 0 and 1")] = 0.6
    q1: Annotated[float, Meta(gt=0, le=0.5, description="a number above 0 and at most 0.5")] = 0.3
    q2: Annotated[float, Meta(gt=0, lt=1, description="a number between 0 and 1")] = 0.3
    sign_width: ResolvedNotNegative = ABSENT
    scaled: ClassVar[Mapping[str, Scaled]] = {"sign_width": Scaled(1e-2, time=-1)}
    gains: ClassVar[Mapping[str, GainBounds]] = {
        "share": GainBounds(lambda _: (0.05, 0.95), between(0.0, 1.0)),
        "q1": GainBounds(lambda _: (0.05, 0.49), between(0.0, 0.5)),
        "q2": GainBounds(lambda _: (0.05, 0.95), between(0.0, 1.0)),
        "sign_width": gain_bounds.SIGN_WIDTH,
        "t_f": gain_bounds.T_F,
    }
    free_by_default: ClassVar[tuple[str, ...]] = ("share", "q1", "q2")
    free_if_sampled: ClassVar[tuple[str, ...]] = ("sign_width",)

    def gains_of(self, design: Design, scenario: Any) -> dict[str, float]:
        """Return none: its gains follow from t_f, in the sampled loop too."""
        return {}

    def physics(self, motion: str) -> Any:
        """Return the class of `laws`, for every motion."""
        from ptsmc_jax.laws.baselines import PredefinedTime

        return PredefinedTime

    def turning(self, t_f: float) -> tuple[str, float]:
        """On its surface, at |v| = 1."""
        return "controller.q1", 2.0 * math.pi / (self.q1 * self.share * t_f)


class SuperTwistingController(BaselineTable, frozen=True):
    """Super-twisting, s = eps' + c eps (Levant 1998; Moreno, Osorio 2012).

    Attributes:
        surface_rate: c, rate of the error on the surface [1/s]
        lipschitz: L, bound on each component of the derivative of eps'' that the disturbance makes [1/s^3]
        sign_width: thickness of the boundary layer; 0 is the discontinuous sign [1/s]
    """

    kind: Literal["super_twisting"] = "super_twisting"
    switches: ClassVar[bool] = False
    surface_rate: ResolvedPositive = ABSENT
    lipschitz: ResolvedPositive = ABSENT
    sign_width: ResolvedNotNegative = ABSENT
    scaled: ClassVar[Mapping[str, Scaled]] = {
        "surface_rate": Scaled(0.4, time=-1),
        "lipschitz": Scaled(0.01, time=-3),
        "sign_width": Scaled(1e-3, time=-1),
    }

    gains: ClassVar[Mapping[str, GainBounds]] = {
        "surface_rate": until_sampling(3.0, 0.2),
        "lipschitz": GainBounds(lambda choice: (0.1 / choice.t_f**3, 1e4 / choice.t_f**3)),
        "sign_width": gain_bounds.SIGN_WIDTH,
        "t_f": gain_bounds.T_F,
    }
    free_by_default: ClassVar[tuple[str, ...]] = ("surface_rate", "lipschitz")
    free_if_sampled: ClassVar[tuple[str, ...]] = ("sign_width",)

    def gains_of(self, design: Design, scenario: Any) -> dict[str, float]:
        """Return published gains within the bandwidth, and a boundary layer thicker than the noise."""
        return {**super().gains_of(design, scenario), "sign_width": design.width}

    def physics(self, motion: str) -> Any:
        """Return the class of `laws`, for every motion."""
        from ptsmc_jax.laws.baselines import SuperTwisting

        return SuperTwisting

    def turning(self, t_f: float) -> tuple[str, float]:
        """On its surface, at |v| = 1."""
        return "controller.surface_rate", 2.0 * self.surface_rate


BASELINES: Mapping[str, type[BaselineTable]] = {
    "pd": PDController,
    "terminal": TerminalController,
    "fixed_time": FixedTimeController,
    "time_base_pd": TimeBasePDController,
    "time_base_sliding": TimeBaseSlidingController,
    "scaling": ScalingController,
    "predefined_time": PredefinedTimeController,
    "super_twisting": SuperTwistingController,
}
