"""The table [dispersion] of scenario files: its keys, and the kinds of random quantities that a key may have.

`_SPACECRAFT` and `_STATE` list the keys and their kinds. Each kind is a table whose `build` returns the distribution.
"""

import dataclasses
from collections.abc import Mapping
from typing import TYPE_CHECKING, Annotated, Any, ClassVar, Literal

import msgspec
import numpy as np
from msgspec import Meta

from ptsmc_jax.declare import Scaled
from ptsmc_jax.dispersions import numbers
from ptsmc_jax.dispersions.numbers import RandomNumbers, any_attitude, axis_angle, interval
from ptsmc_jax.numerics.pytrees import vector
from ptsmc_jax.scenario.custom import CUSTOM_DRAW
from ptsmc_jax.scenario.values import Four, Kinds, Meaning, NotNegative, NotNegatives, Positive, Table, Three, Truth

if TYPE_CHECKING:
    from ptsmc_jax.simulation.assembly import Parts

Angle = Annotated[float, Meta(ge=0, le=180, description="an angle from 0 to 180")]
SmallFraction = Annotated[float, Meta(ge=0, le=0.3, description="a number from 0 to 0.3")]
BelowHalf = Annotated[float, Meta(gt=0, lt=0.5, description="a number greater than 0 and below 0.5")]
BelowOne = Annotated[float, Meta(ge=0, lt=1, description="a number from 0 to below 1")]


class Numbers(Table, frozen=True):
    """Normal random numbers about the nominal values of a scenario, or other ones in derived tables."""

    distribution: ClassVar[str] = "normal"  # distribution of `dispersions.numbers.RandomNumbers`
    width_key: ClassVar[str] = "std"  # the key that holds the spread; it is in degrees if its name ends with _deg
    norm_quantile: ClassVar[float] = 4.6  # norm / spread that 1 of 10 000 vectors (3,) exceeds
    largest_deviation: ClassVar[float] = 3.0  # largest deviation that bounds assume, relative to the spread

    def widths(self, count: int = 1) -> np.ndarray:
        """Return the widths of `count` numbers (count,), converted to rad if the key is in degrees.

        A single width in the table applies to all numbers.
        """
        width = np.ones(count) * getattr(self, self.width_key)
        return np.deg2rad(width) if self.width_key.endswith("_deg") else width

    @property
    def is_zero(self) -> bool:
        """Whether the spread is zero."""
        return not np.any(self.widths())

    @property
    def largest(self) -> float:
        """The largest deviation from the nominal value that bounds assume."""
        return self.largest_deviation * float(self.widths()[0])

    def build(self, parts: "Parts", count: int) -> RandomNumbers:
        """Return the distribution of `count` random numbers (count,)."""
        return RandomNumbers(self.distribution, vector(self.widths(count)))


class Uniform(Numbers, frozen=True):
    """Uniform random numbers, symmetric about the nominal value."""

    distribution: ClassVar[str] = "uniform"
    width_key: ClassVar[str] = "half_width"
    norm_quantile: ClassVar[float] = float(np.sqrt(3.0))
    largest_deviation: ClassVar[float] = 1.0


RATE, BIAS = Scaled(0.01, time=-1), Scaled(1e-3, inertia=1, order=-1)
BIAS_TEXT = "of each component; default: 1e-3, scaled to the mission"


class NormalRate(Numbers, frozen=True):
    """Each axis normal about initial.rate."""

    kind: Literal["normal"] = "normal"
    std: Annotated[
        NotNegative | None, Meaning("1 sigma per axis; default: 0.01, scaled to the mission", "rad/s")
    ] = None  # fmt: skip
    scaled: ClassVar[Mapping[str, Scaled]] = {"std": RATE}


class UniformRate(Uniform, frozen=True):
    """Each axis uniform about initial.rate."""

    kind: Literal["uniform"] = "uniform"
    half_width: Annotated[
        NotNegative | None, Meaning("largest deviation per axis; default: 0.01, scaled to the mission", "rad/s")
    ] = None
    scaled: ClassVar[Mapping[str, Scaled]] = {"half_width": RATE}


class NormalBias(Numbers, frozen=True):
    """Normal about the value in [disturbance]."""

    kind: Literal["normal"] = "normal"
    std: Annotated[NotNegative | None, Meaning("1 sigma " + BIAS_TEXT, "unit of d")] = None
    scaled: ClassVar[Mapping[str, Scaled]] = {"std": BIAS}


class UniformBias(Uniform, frozen=True):
    """Uniform about the value in [disturbance]."""

    kind: Literal["uniform"] = "uniform"
    half_width: Annotated[NotNegative | None, Meaning("largest deviation " + BIAS_TEXT, "unit of d")] = None
    scaled: ClassVar[Mapping[str, Scaled]] = {"half_width": BIAS}


class UniformState(Uniform, frozen=True):
    """Every state uniform about x0."""

    kind: Literal["uniform"] = "uniform"
    half_width: Annotated[
        NotNegatives, Meaning("largest deviation, one number for each state; default: 1 each")
    ] = ()  # fmt: skip


class NormalState(Numbers, frozen=True):
    """Every state normal about x0."""

    kind: Literal["normal"] = "normal"
    std: Annotated[NotNegatives, Meaning("1 sigma, one number for each state; default: 1 each")] = ()


class NormalFactor(Numbers, frozen=True):
    """The value times 1 + a normal number, truncated at three sigma."""

    distribution: ClassVar[str] = "truncated_normal"
    kind: Literal["relative_normal"] = "relative_normal"
    std: Annotated[SmallFraction, Meaning("relative standard deviation")] = 0.1


class UniformFactor(Uniform, frozen=True):
    """The value times 1 + a uniform number."""

    kind: Literal["relative_uniform"] = "relative_uniform"
    half_width: Annotated[BelowOne, Meaning("largest relative deviation")] = 0.2


class NormalTurn(Numbers, frozen=True):
    """Rotated by a normal rotation vector."""

    width_key: ClassVar[str] = "std_deg"
    kind: Literal["normal"] = "normal"
    std_deg: Annotated[NotNegative, Meaning("1 sigma per component", "deg")] = 0.1


class UniformTurn(Uniform, frozen=True):
    """Rotated by a rotation vector with uniform components."""

    width_key: ClassVar[str] = "half_width_deg"
    kind: Literal["uniform"] = "uniform"
    half_width_deg: Annotated[NotNegative, Meaning("largest size of a component", "deg")] = 0.1


class UniformAttitude(Table, frozen=True):
    """A random attitude, uniform on SO(3)."""

    kind: Literal["uniform"] = "uniform"

    def largest_angle(self, angle: float) -> float:
        """Return pi, the largest angle [rad] to the reference."""
        return np.pi

    def build(self, parts: "Parts", count: int) -> RandomNumbers:
        """Return the distribution of the random numbers."""
        return any_attitude()


class AxisAngle(Table, frozen=True):
    """A uniform angle about a random axis: of the body from the reference at t = 0, or of the reference."""

    kind: Literal["axis_angle"] = "axis_angle"
    min_deg: Annotated[Angle, Meaning("smallest angle, at most max_deg", "deg")] = 20.0
    max_deg: Annotated[Angle, Meaning("largest angle", "deg")] = 140.0

    def largest_angle(self, angle: float) -> float:
        """Return the largest angle [rad] to the reference; `angle`: nominal angle [rad]."""
        return float(np.deg2rad(self.max_deg))

    def build(self, parts: "Parts", count: int) -> RandomNumbers:
        """Return the distribution of the random numbers."""
        return axis_angle(np.deg2rad(self.min_deg), np.deg2rad(self.max_deg))


class NormalAttitude(Table, frozen=True):
    """The nominal attitude, rotated by a normal rotation vector."""

    kind: Literal["normal"] = "normal"
    std_deg: Annotated[NotNegative, Meaning("1 sigma per axis", "deg")] = 1.0

    def largest_angle(self, angle: float) -> float:
        """Return the angle to the reference [rad] that one random attitude in 10 000 exceeds; `angle`: nominal."""
        return min(angle + 4.6 * float(np.deg2rad(self.std_deg)), np.pi)

    def build(self, parts: "Parts", count: int) -> RandomNumbers:
        """Return the distribution of a rotation vector (3,) [rad]."""
        return RandomNumbers("normal", vector(np.full(3, np.deg2rad(self.std_deg))))


class RelativeInertia(Table, frozen=True):
    """Normal relative errors of the true principal moments, truncated at three sigma and to moments of a real body."""

    kind: Literal["relative_normal"] = "relative_normal"
    std: Annotated[SmallFraction, Meaning("relative standard deviation")] = 0.05
    axes_deg: Annotated[NotNegative, Meaning("1 sigma of the small rotation of the principal axes", "deg")] = 0.0

    @property
    def largest(self) -> float:
        """The largest relative deviation of a moment that bounds assume, three sigma."""
        return 3.0 * self.std

    def build(self, parts: "Parts", count: int) -> numbers.RelativeInertia:
        """Return `dispersions.numbers.RelativeInertia` about the inertia of the true body."""
        moments, axes = np.linalg.eigh(np.asarray(parts.plant.inertia))
        return numbers.RelativeInertia(*map(vector, (moments, axes, self.std, np.deg2rad(self.axes_deg))))


class CorrelatedInertia(Table, frozen=True):
    """Correlated errors of the true inertia, as `ptsmc identify` estimates them. Every sample is a physical inertia.

    The coordinates are those of `dispersions.numbers.CorrelatedInertia`, and zeros give the nominal inertia.
    """

    kind: Literal["correlated"] = "correlated"
    factor: Annotated[
        Annotated[
            tuple[
                tuple[float],
                tuple[float, float],
                Three,
                Four,
                tuple[float, float, float, float, float],
                tuple[float, float, float, float, float, float],
            ],
            Meta(description="six rows of 1 to 6 numbers"),
        ],
        Meaning("lower triangular factor A of the covariance A A' of the coordinates, by rows"),
    ] = tuple((0.0,) * k for k in range(1, 7))  # pyright: ignore[reportAssignmentType]

    @property
    def largest(self) -> float:
        """The largest relative deviation of a moment that bounds assume, three sigma.

        Coordinates c change a moment by at most 2 |c| of it, to first order.
        """
        return 6.0 * float(np.linalg.norm(self.matrix(), 2))

    def matrix(self) -> np.ndarray:
        """Return the factor (6, 6) [-]."""
        return np.array([[*row, *(0.0,) * (6 - len(row))] for row in self.factor])

    def build(self, parts: "Parts", count: int) -> numbers.CorrelatedInertia:
        """Return `dispersions.numbers.CorrelatedInertia` about the inertia of the true body."""
        return numbers.CorrelatedInertia(
            vector(numbers.pseudo_root(np.asarray(parts.plant.inertia))), vector(self.matrix())
        )


class UniformPhase(Table, frozen=True):
    """Uniform over the circle."""

    kind: Literal["uniform"] = "uniform"

    def build(self, parts: "Parts", count: int) -> RandomNumbers:
        """Return the distribution of the random numbers."""
        return RandomNumbers("interval", vector(np.full(count, 2.0 * np.pi)))


class Interval(Table, frozen=True):
    """A uniform time between two times."""

    earliest: Annotated[NotNegative, Meaning("earliest start, at most latest", "s")] = 0.0
    latest: Annotated[NotNegative | None, Meaning("latest start; default: loop.t_end", "s")] = None

    def numbers(self, parts: "Parts", low: float, high: float) -> RandomNumbers:
        """Return a uniform random time [s] and a uniform random number.

        Args:
            parts: nominal parts; the end of their run [s] is the default of `latest`.
            low: smallest number.
            high: largest number.
        """
        end = float(parts.t_end) if self.latest is None else self.latest
        return interval([self.earliest, low], [end, high])


class Outage(Interval, frozen=True):
    """No samples for `duration`, starting at a uniform time between `earliest` and `latest`."""

    kind: Literal["uniform"] = "uniform"
    duration: Annotated[Positive | None, Meaning("duration; default: 10, scaled to the mission", "s")] = None
    scaled: ClassVar[Mapping[str, Scaled]] = {"duration": Scaled(10.0, time=1)}

    def build(self, parts: "Parts", count: int) -> RandomNumbers:
        """Return the distribution of the random begin, and the duration."""
        assert self.duration is not None  # `scenario.reading` has filled in the default
        return dataclasses.replace(self.numbers(parts, self.duration, self.duration), common=True)


class Failure(Interval, frozen=True):
    """One random wheel fails at a uniform time between two times."""

    kind: Literal["uniform"] = "uniform"
    known: Annotated[Truth, Meaning("whether the allocation uses the other wheels after the failure")] = False

    def build(self, parts: "Parts", count: int) -> RandomNumbers:
        """Return the distribution of the time, and a number on (0, 1) that chooses the wheel."""
        return self.numbers(parts, 0.0, 1.0)


class Jitter(Table, frozen=True):
    """Random sample times. A trial has a random largest error, and each sample a uniform error up to this size."""

    kind: Literal["uniform"] = "uniform"
    largest: Annotated[BelowHalf, Meaning("largest timing error, as a fraction of loop.period")] = 0.1
    smallest: Annotated[NotNegative, Meaning("smallest value of the largest timing error, at most largest")] = 0.0

    def build(self, parts: "Parts", count: int) -> RandomNumbers:
        """Return the distribution of the random numbers."""
        return interval([self.smallest], [self.largest])


FACTORS: Kinds = {"relative_normal": NormalFactor, "relative_uniform": UniformFactor}
TURNS: Kinds = {"normal": NormalTurn, "uniform": UniformTurn}
# by key: its meaning and its kinds, the default first
_DISTURBANCE: dict[str, tuple[str, Kinds]] = {
    "disturbance_phase": (
        "phase of every sinusoid, and of gravity_gradient without [orbit]", {"uniform": UniformPhase}
    ),
    "disturbance_amplitude": ("independent factor on each component of each sinusoid and constant", FACTORS),
    "disturbance_bias": ("an additional constant disturbance", {"normal": NormalBias, "uniform": UniformBias}),
}  # fmt: skip
_ANY_PLANT: dict[str, tuple[str, Kinds]] = {
    "torque_limit": ("factor on hardware.torque_limit", FACTORS),
    "timing_jitter": (
        "timing error of the samples as a fraction of loop.period; the flight software does not know it",
        {"uniform": Jitter},
    ),
    "custom": ("random quantities of custom code", {"custom": CUSTOM_DRAW}),
}
_SPACECRAFT: dict[str, tuple[str, Kinds]] = {
    "attitude": (
        "of the body at t = 0",
        {"axis_angle": AxisAngle, "uniform": UniformAttitude, "normal": NormalAttitude},
    ),
    "rate": ("of the body at t = 0", {"normal": NormalRate, "uniform": UniformRate}),
    "inertia": (
        "inertia of the true body about true_inertia; the law uses spacecraft.inertia",
        {"relative_normal": RelativeInertia, "correlated": CorrelatedInertia},
    ),
    "reference": (
        "a rotation of the whole reference",
        {"normal": NormalAttitude, "uniform": UniformAttitude, "axis_angle": AxisAngle},
    ),
    **_DISTURBANCE,
    "attitude_noise": ("factor on hardware.attitude_noise", FACTORS),
    "rate_noise": ("factor on hardware.rate_noise", FACTORS),
    "actuator_scale": ("factor on the torque of each axis or wheel that the flight software does not know", FACTORS),
    "actuator_misalignment": ("a rotation of each axis or wheel that the flight software does not know", TURNS),
    "star_tracker_misalignment": ("a rotation of the star tracker in the body", TURNS),
    "gyro_scale": ("factor on the gyro's reading about each axis", FACTORS),
    "star_tracker_outage": ("an interval without samples of the star tracker, with a filter", {"uniform": Outage}),
    "wheel_failure": ("failure of one wheel: it has no torque from a random time on", {"uniform": Failure}),
    "mode_frequency": ("factor on each of flexible.frequency", FACTORS),
    "mode_coupling": ("factor on each row of flexible.coupling", FACTORS),
    **_ANY_PLANT,
}
_STATE: dict[str, tuple[str, Kinds]] = {
    "x0": ("initial state", {"uniform": UniformState, "normal": NormalState}),
    **_DISTURBANCE,
    "state_noise": ("factor on hardware.state_noise", FACTORS),
    "actuator_scale": ("factor on each input that the computer does not know", FACTORS),
    **_ANY_PLANT,
}


def _dispersion_table(name: str, rows: Mapping[str, tuple[str, Kinds]]) -> Any:
    """Return the class of the table [dispersion] of a plant.

    Args:
        name: name of the class.
        rows: meaning and kinds of each quantity, by its key.
    """
    summary = "Random quantities of each trial, each an inline table with a kind; the others stay nominal."
    keys = [(key, Annotated[Table | None, Meaning(meaning)], None) for key, (meaning, _) in rows.items()]
    namespace = {"__doc__": summary, "__module__": __name__}
    return msgspec.defstruct(name, keys, bases=(Table,), frozen=True, kw_only=True, namespace=namespace)


Dispersion, StateDispersion = _dispersion_table("Dispersion", _SPACECRAFT), _dispersion_table("StateDispersion", _STATE)
DISPERSIONS = {key: kinds for key, (_, kinds) in {**_SPACECRAFT, **_STATE}.items()}
