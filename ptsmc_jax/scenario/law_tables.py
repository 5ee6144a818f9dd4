"""The tables of a scenario file that say how it is steered: the law, its gains, and the disturbance observer."""

from typing import Annotated, Literal

from msgspec import Meta

from ptsmc_jax.scenario.values import EachPositive, NotNegative, Positive, Table, ThreePositive

Power = Annotated[float, Meta(gt=1, lt=2, description="a number between 1 and 2")]
AboveOne = Annotated[float, Meta(gt=1, description="a number greater than 1")]
Eta = Annotated[float, Meta(gt=2, description="a number greater than 2 (Theorem 2)")]


class Controller(Table, frozen=True):
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


class Baseline(Table, frozen=True):
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


class PDController(Baseline, frozen=True):
    """Quaternion PD with the reference's motion fed forward (Wie, Weiss, Arapostathis 1989); sampled loop only.

    Attributes:
        k_p: gain on the vector part of the error quaternion [1/s^2]
        k_d: gain on the rate error [1/s]
    """

    kind: Literal["pd"] = "pd"
    k_p: Positive = 0.2
    k_d: Positive = 0.6


class TerminalController(Baseline, frozen=True):
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


class FixedTimeController(Baseline, frozen=True):
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


class SystemController(Table, frozen=True):
    """The paper's law (29) for a second-order system, with (57)'s gains.

    Attributes:
        t_f: the prescribed time [s]
        eta: power of the approach: the error falls like (t_f - t)^eta, up to a logarithm
        delta: hand-over to constant gains so long before t_f (Remark 1) [s]
        k1: K1, rate of s from the hand-over on [1/s]
        sign_width: of the smooth sign tanh(s / sign_width); 0 is the exact sign
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


class NoObserver(Table, frozen=True):
    """None: d_hat = 0, and K switches against the whole disturbance."""

    kind: Literal["none"] = "none"


class NonlinearObserver(Table, frozen=True):
    """The paper's nonlinear disturbance observer (53), its estimate zero at t = 0.

    Attributes:
        gain: diagonal of l(w) [N m s]
    """

    kind: Literal["nonlinear"] = "nonlinear"
    gain: ThreePositive = (10.0, 10.0, 10.0)


class EachNonlinearObserver(Table, frozen=True):
    """The paper's nonlinear disturbance observer (53), its estimate zero at t = 0.

    Attributes:
        gain: one number for each input; default: 10 each [1/s]
    """

    kind: Literal["nonlinear"] = "nonlinear"
    gain: EachPositive | None = None


class Prescribed(Table, frozen=True):
    """What a prescribed-time observer has besides its gain.

    Attributes:
        mu: the error at t = 0 falls like (t_o - t)^mu; what a moving disturbance adds, like c (t_o - t)/(mu - 1)
        t_o: time by which it has converged; default: a third of t_f [s]
        delta_o: mu/(t_o - t) is off from so long before t_o; default: 0.05, or a period, at most t_o/4 [s]
    """

    mu: Annotated[float, Meta(gt=1, description="a number greater than 1")] = 2.0
    t_o: Positive | None = None
    delta_o: Positive | None = None


class PrescribedTimeObserver(Prescribed, frozen=True):
    """An observer that has converged by t_o, the nonlinear one from then on.

    Attributes:
        gain: diagonal of the constant part of l [N m s]
    """

    kind: Literal["prescribed_time"] = "prescribed_time"
    gain: ThreePositive = (10.0, 10.0, 10.0)


class EachPrescribedTimeObserver(Prescribed, frozen=True):
    """An observer that has converged by t_o, the nonlinear one from then on.

    Attributes:
        gain: constant part, one number for each input; default: 10 each [1/s]
    """

    kind: Literal["prescribed_time"] = "prescribed_time"
    gain: EachPositive | None = None


class FiniteTimeObserver(Table, frozen=True):
    """A super-twisting observer, exact after a finite time (Levant 1998).

    Attributes:
        gain: per axis, at least controller.disturbance_rate_bound; default: 20 times that [N m/s]
        sign_width: of its smooth sign, in the continuous loop [N m s]
    """

    kind: Literal["finite_time"] = "finite_time"
    gain: ThreePositive | None = None
    sign_width: NotNegative = 1e-5


class EachFiniteTimeObserver(Table, frozen=True):
    """A super-twisting observer, exact after a finite time (Levant 1998).

    Attributes:
        gain: one for each input, at least controller.disturbance_rate_bound; default: 20 times that [unit of d/s]
        sign_width: of its smooth sign, in the continuous loop
    """

    kind: Literal["finite_time"] = "finite_time"
    gain: EachPositive | None = None
    sign_width: NotNegative = 1e-5
