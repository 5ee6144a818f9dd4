"""The paper's laws of a scenario file: each a table with its keys, its gains, what it is refused for, how it is built.

A law is its physics in a file of `laws`, a table, and a row: here, or among those to compare with.
"""

import dataclasses
from collections.abc import Mapping
from typing import Annotated, Any, ClassVar, Literal

from msgspec import Meta

from ptsmc_jax import formulas
from ptsmc_jax.scenario import gain_bounds
from ptsmc_jax.scenario.baseline_tables import BASELINES
from ptsmc_jax.scenario.errors import wrong
from ptsmc_jax.scenario.gain_record import GainBounds
from ptsmc_jax.scenario.law_record import LawTable
from ptsmc_jax.scenario.mission import Design
from ptsmc_jax.scenario.own_laws import OwnAttitudeLaw, OwnLaw
from ptsmc_jax.scenario.values import ABSENT, NotNegative, Positive, ResolvedNotNegative, ResolvedPositive, Scaled

Eta = Annotated[float, Meta(gt=2, description="a number greater than 2 (Theorem 2)")]


class PrescribedTable(LawTable, frozen=True):
    """The paper's gains, whatever the plant."""

    prescribed: ClassVar[bool] = True
    gains: ClassVar[Mapping[str, GainBounds]] = {
        "eta": gain_bounds.ETA,
        "delta": gain_bounds.DELTA,
        "k1": gain_bounds.K1,
        "sign_width": gain_bounds.SIGN_WIDTH,
        "surface_rate": gain_bounds.SURFACE_RATE,
        "t_f": gain_bounds.T_F,
    }
    free_by_default: ClassVar[tuple[str, ...]] = ("eta", "delta")
    free_if_sampled: ClassVar[tuple[str, ...]] = ("k1", "sign_width", "surface_rate")
    scaled: ClassVar[Mapping[str, Scaled]] = {
        "eta": Scaled(3.0),
        "delta": Scaled(0.05, time=1),
        "k1": Scaled(1.0, time=-1),
        "sign_width": Scaled(1e-3, time=-1),
        "surface_rate": Scaled(1.0, time=-1),
        "layer_time": Scaled(1.0, time=1),
    }

    @property
    def implicit(self) -> bool:
        """Whether the held input is chosen for the end of its period."""
        return self.sampling == "implicit"  # pyright: ignore[reportAttributeAccessIssue]

    def free(self, *, sampled: bool) -> tuple[tuple[str, ...], tuple[str, ...]]:
        """With implicit sampling there is no boundary layer."""
        first, rest = super().free(sampled=sampled)
        return first, tuple(name for name in rest if not (self.implicit and name == "sign_width"))

    def check(self, scenario: Any) -> None:
        """Implicit sampling needs samples."""
        if self.implicit:
            scenario.need_samples('controller.sampling = "implicit"')

    def gains_of(self, design: Design, scenario: Any) -> dict[str, float]:
        """Return both hold poles at the design's, with `reaching` the factor of K1 in (60)."""
        return {
            "eta": design.eta,
            "delta": design.delta,
            "k1": scenario.reaching * design.pole,
            "sign_width": design.width,
            "surface_rate": design.pole,
        }

    def physics(self, motion: str) -> Any:
        """Return `laws.prescribed_time.PrescribedTime`, for every motion but a chain."""
        from ptsmc_jax.laws.prescribed_time import PrescribedTime

        return PrescribedTime

    def build(self, scenario: Any, model: Any) -> Any:
        """The law of a plant's model."""
        return dataclasses.replace(super().build(scenario, model), implicit=self.implicit)

    def turning(self, t_f: float) -> tuple[str, float]:
        """On its surface, at the start."""
        return "controller.eta", 2.0 * self.eta / t_f  # pyright: ignore[reportAttributeAccessIssue]


class SpacecraftController(PrescribedTable, frozen=True):
    """The paper's law for a spacecraft: (56) and (57) before the hand-over, (59) and (60) after it.

    Attributes:
        error: the paper's q_1 - q_1f, or the vector part of q_f* q, singular 180 degrees from the reference only
        t_f: the prescribed time [s]
        eta: power of the approach: the error falls like (t_f - t)^eta, up to a logarithm; 3 in the paper
        delta: time before t_f at which the gains become constant (Remark 1); 0.05 in the paper [s]
        k1: K1, rate of s from the hand-over on, halved by (60); 1 in the paper [1/s]
        sign_width: thickness of the boundary layer, tanh(s / sign_width); 0 is the discontinuous sign [1/s]
        surface_rate: c of s = eps' + c eps, the error's rate on the surface from the hand-over on; 1 in the paper [1/s]
        layer_time: time that converts the thickness of the boundary layer into the units of s before the hand-over;
            1 in the paper [s]
        sampling: held input by s at the sample, or by where s is to land at the period's end, which needs no sign_width
        disturbance_rate_bound: c of Assumption 1, on each component of d'; default: by [disturbance] as drawn [N m/s]
        disturbance_bound: K of Assumption 1, on each component of d, used without an observer; default: by
            [disturbance] as drawn [N m]
        initial_estimate_error: bound on the observer's error at t = 0 [N m]
    """

    kind: Literal["prescribed_time"] = "prescribed_time"
    error: Literal["additive", "multiplicative"] = "additive"
    t_f: Positive = 30.0
    eta: Eta | None = None
    delta: ResolvedPositive = ABSENT
    k1: ResolvedPositive = ABSENT
    sign_width: ResolvedNotNegative = ABSENT
    surface_rate: ResolvedPositive = ABSENT
    layer_time: ResolvedPositive = ABSENT
    sampling: Literal["explicit", "implicit"] = "explicit"
    disturbance_rate_bound: NotNegative | None = None
    disturbance_bound: NotNegative | None = None
    initial_estimate_error: NotNegative = 0.0


class SystemController(PrescribedTable, frozen=True):
    """The paper's law (29) for a second-order system, with (57)'s gains.

    Attributes:
        t_f: the prescribed time [s]
        eta: power of the approach: the error falls like (t_f - t)^eta, up to a logarithm; 3 in the paper
        delta: time before t_f at which the gains become constant (Remark 1); 0.05 in the paper [s]
        k1: K1, rate of s from the hand-over on; 1 in the paper [1/s]
        sign_width: thickness of the boundary layer, tanh(s / sign_width); 0 is the discontinuous sign [unit of s]
        surface_rate: c of s = eps' + c eps, the error's rate on the surface from the hand-over on; 1 in the paper [1/s]
        layer_time: time that converts the thickness of the boundary layer into the units of s before the hand-over;
            1 in the paper [s]
        sampling: held input by s at the sample, or by where s is to land at the period's end, which needs no sign_width
        disturbance_rate_bound: c of Assumption 1, on each component of d'; default: by [disturbance] [unit of d/s]
        disturbance_bound: K of Assumption 1, on each component of d, used without an observer; default: by
            [disturbance] [unit of d]
        initial_estimate_error: bound on the observer's error at t = 0 [unit of d]
    """

    kind: Literal["prescribed_time"] = "prescribed_time"
    t_f: Positive = 5.0
    eta: Eta | None = None
    delta: ResolvedPositive = ABSENT
    k1: ResolvedPositive = ABSENT
    sign_width: ResolvedNotNegative = ABSENT
    surface_rate: ResolvedPositive = ABSENT
    layer_time: ResolvedPositive = ABSENT
    sampling: Literal["explicit", "implicit"] = "explicit"
    disturbance_rate_bound: NotNegative | None = None
    disturbance_bound: NotNegative | None = None
    initial_estimate_error: NotNegative = 0.0


class ChainController(SystemController, frozen=True):
    """The paper's law (52) for an integrator chain; without an observer (36) to (40).

    Attributes:
        eta: power of the approach; default: order + 1
        a: a_1 to a_(order-1) of the surface (39), stable; default: all poles at -1
        surface_rate: the poles of (39) are this times those of a; 1 in the paper [1/s]
    """

    eta: Annotated[float, Meta(gt=0, description="a number greater than the order (Theorems 1 and 3)")] | None = None
    a: Annotated[tuple[float, ...], Meta(min_length=1, description="a list of numbers, a_1 to a_(order-1) of (39)")] = (
        1.0,
    )
    scaled: ClassVar[Mapping[str, Scaled]] = {
        **PrescribedTable.scaled,
        "sign_width": Scaled(1e-3, time=1, order=-1),
    }

    def physics(self, motion: str) -> Any:
        """Return `laws.prescribed_time.PrescribedTimeChain`."""
        from ptsmc_jax.laws.prescribed_time import PrescribedTimeChain

        return PrescribedTimeChain

    def check(self, scenario: Any) -> None:
        """Theorems 1 and 3, and a surface (39) that is stable."""
        super().check(scenario)
        n = scenario.order
        if not self.eta > n:
            theorem = "Theorem 1" if n == 2 else "Theorem 3"
            raise wrong("controller.eta", self.eta, f"greater than plant.order, {n} ({theorem})")
        if len(self.a) != n - 1:
            raise wrong("controller.a", self.a, f"a list of plant.order - 1 = {n - 1} numbers")
        if not formulas.hurwitz(self.a):
            stable = "such that all roots of p^(n-1) + a_(n-1) p^(n-2) + .. + a_1 are stable (39)"
            raise wrong("controller.a", self.a, stable)


# by the kind of the plant and the kind of the law, the default first
LAWS: dict[str, Mapping[str, type[LawTable]]] = {
    "spacecraft": {
        "prescribed_time": SpacecraftController,
        **BASELINES,
        "own": OwnAttitudeLaw,
    },
    "chain": {"prescribed_time": ChainController, **BASELINES, "own": OwnLaw},
    "system": {"prescribed_time": SystemController, **BASELINES, "own": OwnLaw},
}
