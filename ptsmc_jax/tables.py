"""The tables of a scenario file: every key, its type, range, default and description, for each kind of plant."""

import typing
from typing import Annotated, Any, Literal

from msgspec import Meta

from ptsmc_jax.device_tables import AxesWheels, Hardware, NoFilter, PyramidWheels, StateHardware, SteadyStateFilter
from ptsmc_jax.dispersion_tables import (
    Dispersion,
    StateDispersion,
)
from ptsmc_jax.values import (
    Count,
    Each,
    EachNotNegative,
    EachPositive,
    Four,
    Inertia,
    Interval,
    Matrix,
    NotNegative,
    Number,
    Numbers,
    Positive,
    Quantile,
    Table,
    Three,
    ThreeNotNegative,
    ThreePositive,
    Truth,
)


class SpacecraftPlant(Table, frozen=True):
    kind: Literal["spacecraft"] = "spacecraft"


class ChainPlant(Table, frozen=True):
    """Integrator chain (35); x0 is as long as order says, and says it where order is absent."""

    kind: Literal["chain"] = "chain"
    order: Annotated[int, Meta(ge=2, le=20, description="a whole number from 2 to 20")] = 2
    x0: Numbers = (5.0, 3.0)


class SystemPlant(Table, frozen=True):
    """A system (25) of one's own: where it stands, or, from Python, itself."""

    kind: Literal["system"] = "system"
    system: Annotated[Any, Meta(description='"FILE.py:NAME", a system made with plants.system')] = None
    x0: Numbers = (1.0, 0.0)


class Spacecraft(Table, frozen=True):
    inertia: Inertia = (10.0, 12.0, 14.0)
    true_inertia: Inertia | None = None


class Attitude(Table, frozen=True):
    """Exactly one of the attitude keys; `euler_deg` goes with `sequence`."""

    quat_xyzw: Four | None = None
    quat_wxyz: Four | None = None
    rotvec_deg: Three | None = None
    mrp: Three | None = None
    dcm_body_to_inertial: Matrix | None = None
    euler_deg: Three | None = None
    sequence: Annotated[str, Meta(description='three axes in SciPy\'s notation, such as "ZYX" or "zyx"')] | None = None


ATTITUDE_KEYS = ("quat_xyzw", "quat_wxyz", "rotvec_deg", "mrp", "dcm_body_to_inertial", "euler_deg")


class Initial(Attitude, frozen=True):
    rate: Three = (0.0, 0.0, 0.0)


class FixedReference(Attitude, frozen=True):
    kind: Literal["fixed"] = "fixed"


class SpinReference(Attitude, frozen=True):
    kind: Literal["spin"] = "spin"
    rate: Three = (0.0, 0.0, 0.0)


class SinusoidReference(Attitude, frozen=True):
    kind: Literal["sinusoid"] = "sinusoid"
    amplitude: Three = (0.1, 0.1, 0.1)
    frequency: Three = (0.1, 0.1, 0.1)
    phase: Three = (0.0, 0.0, 0.0)


class SlewReference(Attitude, frozen=True):
    kind: Literal["slew"] = "slew"
    to_quat_xyzw: Four = (0.0, 0.0, 0.0, 1.0)
    duration: Positive = 30.0
    way: Literal["short", "long"] = "short"


class NoDisturbance(Table, frozen=True):
    kind: Literal["none"] = "none"


class ConstantDisturbance(Table, frozen=True):
    kind: Literal["constant"] = "constant"
    amplitude: Three = (0.01, 0.01, 0.01)


class SinusoidDisturbance(Table, frozen=True):
    kind: Literal["sinusoid"] = "sinusoid"
    amplitude: Three = (0.01, 0.01, 0.01)
    frequency: Three = (0.1, 0.1, 0.1)
    phase: Three = (0.0, 0.0, 0.0)
    bias: Three = (0.0, 0.0, 0.0)


class GravityGradient(Attitude, frozen=True):
    """The attitude is that of the orbit's frame: z along its normal, x to where the phase counts from."""

    kind: Literal["gravity_gradient"] = "gravity_gradient"
    orbit_rate: Positive = 1.1e-3
    phase: Number = 0.0


class RandomWalk(Table, frozen=True):
    kind: Literal["random_walk"] = "random_walk"
    density: ThreeNotNegative = (1e-4, 1e-4, 1e-4)


class EachRandomWalk(Table, frozen=True):
    kind: Literal["random_walk"] = "random_walk"
    density: EachNotNegative | None = None  # 1e-4 each


class SumDisturbance(Table, frozen=True):
    """Several disturbances at once, each a table with its own kind."""

    kind: Literal["sum"] = "sum"
    terms: tuple[Any, ...] = ()


class EachConstant(Table, frozen=True):
    kind: Literal["constant"] = "constant"
    amplitude: Each | None = None  # 0.01 each


class EachSinusoid(Table, frozen=True):
    kind: Literal["sinusoid"] = "sinusoid"
    amplitude: Each | None = None  # 0.01 each
    frequency: Each | None = None  # 1
    phase: Each | None = None  # 0
    bias: Each | None = None  # 0


class Controller(Table, frozen=True):
    kind: Literal["prescribed_time"] = "prescribed_time"
    error: Literal["additive", "multiplicative"] = "additive"
    t_f: Positive = 30.0
    eta: Annotated[float, Meta(gt=2, description="a number greater than 2 (Theorem 2)")] = 3.0
    delta: Positive = 0.05
    k1: Positive = 1.0
    sign_width: NotNegative = 1e-3
    disturbance_rate_bound: NotNegative = 1e-3
    disturbance_bound: NotNegative = 0.01
    initial_estimate_error: NotNegative = 0.0


class Baseline(Table, frozen=True):
    """What the laws to compare with have besides their gains; t_f is when they are judged."""

    t_f: Positive = 30.0
    disturbance_rate_bound: NotNegative = 1e-3
    disturbance_bound: NotNegative = 0.01
    initial_estimate_error: NotNegative = 0.0


class PDController(Baseline, frozen=True):
    kind: Literal["pd"] = "pd"
    k_p: Positive = 0.2
    k_d: Positive = 0.6


Power = Annotated[float, Meta(gt=1, lt=2, description="a number between 1 and 2")]


class TerminalController(Baseline, frozen=True):
    kind: Literal["terminal"] = "terminal"
    p: Power = 1.3
    b: Positive = 0.1
    k: Positive = 0.1
    sign_width: NotNegative = 1e-3


class FixedTimeController(Baseline, frozen=True):
    """gamma - 1/p must be greater than 1."""

    kind: Literal["fixed_time"] = "fixed_time"
    a1: Positive = 0.1
    b1: Positive = 0.2
    a2: Positive = 1.0
    b2: Positive = 1.0
    p: Power = 1.25
    gamma: Annotated[float, Meta(gt=1, description="a number greater than 1")] = 2.0
    m: Annotated[float, Meta(gt=1, description="a number greater than 1")] = 1.5
    n: Annotated[float, Meta(gt=0, lt=1, description="a number between 0 and 1")] = 0.5
    sign_width: NotNegative = 1e-3


class SystemController(Table, frozen=True):
    kind: Literal["prescribed_time"] = "prescribed_time"
    t_f: Positive = 5.0
    eta: Annotated[float, Meta(gt=2, description="a number greater than 2 (Theorem 2)")] = 3.0
    delta: Positive = 0.05
    k1: Positive = 1.0
    sign_width: NotNegative = 1e-3
    disturbance_rate_bound: NotNegative = 0.01
    disturbance_bound: NotNegative = 0.01
    initial_estimate_error: NotNegative = 0.0


class ChainController(SystemController, frozen=True):
    eta: Positive = 3.0
    a: Annotated[tuple[float, ...], Meta(min_length=1, description="a list of numbers, a_1 to a_(order-1) of (39)")] = (
        1.0,
    )


class NoObserver(Table, frozen=True):
    kind: Literal["none"] = "none"


class NonlinearObserver(Table, frozen=True):
    kind: Literal["nonlinear"] = "nonlinear"
    gain: ThreePositive = (10.0, 10.0, 10.0)


class EachNonlinearObserver(Table, frozen=True):
    kind: Literal["nonlinear"] = "nonlinear"
    gain: EachPositive | None = None  # 10 each


class Prescribed(Table, frozen=True):
    """What a prescribed-time observer has besides its gain."""

    mu: Annotated[float, Meta(gt=1, description="a number greater than 1")] = 2.0
    t_o: Positive | None = None  # a third of t_f
    delta_o: Positive | None = None  # 0.05 s, or a period if that is longer


class PrescribedTimeObserver(Prescribed, frozen=True):
    kind: Literal["prescribed_time"] = "prescribed_time"
    gain: ThreePositive = (10.0, 10.0, 10.0)


class EachPrescribedTimeObserver(Prescribed, frozen=True):
    kind: Literal["prescribed_time"] = "prescribed_time"
    gain: EachPositive | None = None  # 10 each


class FiniteTimeObserver(Table, frozen=True):
    kind: Literal["finite_time"] = "finite_time"
    gain: ThreePositive | None = None  # 20 times controller.disturbance_rate_bound
    sign_width: NotNegative = 1e-5


class EachFiniteTimeObserver(Table, frozen=True):
    kind: Literal["finite_time"] = "finite_time"
    gain: EachPositive | None = None  # 20 times controller.disturbance_rate_bound
    sign_width: NotNegative = 1e-5


class Loop(Table, frozen=True):
    mode: Literal["continuous", "sampled"] = "continuous"
    period: Positive = 0.05
    clock: Literal["anchored", "flight"] = "anchored"
    t_end: Positive | None = None
    window: Positive = 1.0
    settling_angle: Positive = 1e-3


class Limit(Table, frozen=True):
    """A requirement in full: metric <= limit in this share of the trials, with this one-sided confidence."""

    limit: Positive
    quantile: Quantile | None = None
    confidence: Quantile | None = None


Free = Literal[
    "eta", "delta", "observer_gain", "k1", "sign_width", "t_f", "filter_bandwidth",
    "k_p", "k_d", "p", "b", "k", "a1", "b1", "a2", "b2", "gamma", "m", "n",
]  # fmt: skip
FREE: tuple[str, ...] = typing.get_args(Free)
FreeGains = Annotated[tuple[Free, ...], Meta(min_length=1, description=f"a list of some of {', '.join(FREE)}")]


class Tune(Table, frozen=True):
    free: FreeGains | None = None  # eta, delta, observer_gain
    bounds: Annotated[dict[str, Interval], Meta(description="a table of two numbers for each gain")] = {}  # noqa: RUF012
    per_axis: Truth = False
    objective: Literal["rms", "worst", "cvar", "t_f"] = "rms"
    level: Quantile | None = None
    torque_weight: NotNegative = 0.0
    worst_case: Truth = False
    trials: Count = 256
    starts: Count = 8
    steps: Count = 150


class Scenario(Table, frozen=True, kw_only=True):
    """A scenario as its file says it, every key resolved; tables that are None are off, or not of this plant's."""

    plant: SpacecraftPlant | ChainPlant | SystemPlant
    spacecraft: Spacecraft | None = None
    initial: Initial | None = None
    reference: FixedReference | SpinReference | SinusoidReference | SlewReference | None = None
    disturbance: (
        NoDisturbance
        | ConstantDisturbance
        | SinusoidDisturbance
        | GravityGradient
        | RandomWalk
        | SumDisturbance
        | EachConstant
        | EachSinusoid
        | EachRandomWalk
    )
    controller: Any  # the table of its kind, see `layouts.TABLES`
    observer: (
        NoObserver
        | NonlinearObserver
        | EachNonlinearObserver
        | PrescribedTimeObserver
        | EachPrescribedTimeObserver
        | FiniteTimeObserver
        | EachFiniteTimeObserver
    )
    loop: Loop
    hardware: Hardware | StateHardware | None = None
    wheels: PyramidWheels | AxesWheels | None = None
    filter: NoFilter | SteadyStateFilter | None = None
    dispersion: Dispersion | StateDispersion | None = None
    requirements: dict[str, float | Limit] = {}  # noqa: RUF012
    tune: Tune | None = None
