"""The tables of a scenario file that define the random quantities of each trial."""

import dataclasses
from collections.abc import Mapping
from typing import Annotated, Any, ClassVar, Literal

import numpy as np
from msgspec import Meta

from ptsmc_jax.declare import Scaled
from ptsmc_jax.dispersions.inertias import RelativeInertia as RelativeInertiaPart
from ptsmc_jax.dispersions.numbers import RandomNumbers, any_attitude, axis_angle, interval
from ptsmc_jax.numerics.pytrees import vector
from ptsmc_jax.scenario.values import Meaning, NotNegative, NotNegatives, Positive, Table, Truth


class Numbers(Table, frozen=True):
    """Random numbers about those of the scenario."""

    distribution: ClassVar[str] = "normal"  # of `dispersions.numbers.RandomNumbers`
    width: ClassVar[str] = "std"  # the key that holds the spread
    degrees: ClassVar[bool] = False  # it is in degrees
    widest: ClassVar[float] = 0.0  # size that vectors of three stay below, all but one in 10 000, over the spread
    farthest: ClassVar[float] = 3.0  # largest deviation that bounds allow for, over the spread: three sigma

    def of(self, count: int = 1) -> np.ndarray:
        """The width of so many numbers, of which a single one of the table stands for all; in rad for degrees."""
        width = np.ones(count) * getattr(self, self.width)
        return np.deg2rad(width) if self.degrees else width

    @property
    def nothing(self) -> bool:
        """Whether it leaves everything as it is."""
        return not np.any(self.of())

    def build(self, parts: Any, count: int) -> Any:
        """Return `dispersions.numbers.RandomNumbers`, (count,)."""
        return RandomNumbers(self.distribution, vector(self.of(count)))


class Normal(Numbers, frozen=True):
    """Normal, not truncated."""

    widest: ClassVar[float] = 4.6


class Uniform(Numbers, frozen=True):
    """Uniform, as far on either side."""

    distribution: ClassVar[str] = "uniform"
    width: ClassVar[str] = "half_width"
    widest: ClassVar[float] = float(np.sqrt(3.0))
    farthest: ClassVar[float] = 1.0


class UniformAttitude(Table, frozen=True):
    """Any attitude at all, uniform on SO(3)."""

    kind: Literal["uniform"] = "uniform"

    def largest_angle(self, angle: float) -> float:
        """Return the largest angle [rad] of an attitude drawn about one at this angle."""
        return np.pi

    def build(self, parts: Any, count: int) -> Any:
        """Return `dispersions.numbers.RandomNumbers`."""
        return any_attitude()


class AxisAngle(Table, frozen=True):
    """A uniform angle about any axis: a body's from the reference at t = 0, a reference's from its own attitude."""

    kind: Literal["axis_angle"] = "axis_angle"
    min_deg: Annotated[
        Annotated[float, Meta(ge=0, le=180, description="an angle from 0 to 180 degrees")],
        Meaning("smallest angle", "deg"),
    ] = 20.0
    max_deg: Annotated[
        Annotated[float, Meta(ge=0, le=180, description="an angle from 0 to 180 degrees")],
        Meaning("largest angle", "deg"),
    ] = 140.0

    def largest_angle(self, angle: float) -> float:
        """Return the largest angle [rad] of an attitude drawn about one at this angle."""
        return float(np.deg2rad(self.max_deg))

    def build(self, parts: Any, count: int) -> Any:
        """Return `dispersions.numbers.RandomNumbers`."""
        return axis_angle(np.deg2rad(self.min_deg), np.deg2rad(self.max_deg))


class NormalAttitude(Table, frozen=True):
    """Turned by a normal rotation vector from what the scenario says."""

    kind: Literal["normal"] = "normal"
    std_deg: Annotated[NotNegative, Meaning("1 sigma per axis", "deg")] = 1.0

    def largest_angle(self, angle: float) -> float:
        """Return the angle [rad] that all but one of 10 000 attitudes drawn about one at this angle stay below."""
        return min(angle + 4.6 * float(np.deg2rad(self.std_deg)), np.pi)

    def build(self, parts: Any, count: int) -> Any:
        """Return `dispersions.numbers.RandomNumbers`, a rotation vector."""
        return RandomNumbers("normal", vector(np.full(3, np.deg2rad(self.std_deg))))


class NormalRate(Normal, frozen=True):
    """Each axis normal about initial.rate."""

    kind: Literal["normal"] = "normal"
    std: Annotated[NotNegative | None, Meaning("1 sigma per axis; default: 0.01, scaled to the mission", "rad/s")] = (
        None
    )
    scaled: ClassVar[Mapping[str, Scaled]] = {"std": Scaled(0.01, time=-1)}


class UniformRate(Uniform, frozen=True):
    """Each axis uniform about initial.rate."""

    kind: Literal["uniform"] = "uniform"
    half_width: Annotated[
        NotNegative | None, Meaning("largest deviation per axis; default: 0.01, scaled to the mission", "rad/s")
    ] = None
    scaled: ClassVar[Mapping[str, Scaled]] = {"half_width": Scaled(0.01, time=-1)}


class RelativeInertia(Table, frozen=True):
    """The true body's principal moments off by a normal share, truncated at three sigma and to what a body can have."""

    farthest: ClassVar[float] = 3.0  # how far a moment goes, in times std
    kind: Literal["relative_normal"] = "relative_normal"
    std: Annotated[
        Annotated[float, Meta(ge=0, le=0.3, description="a number from 0 to 0.3")], Meaning("1 sigma of the share")
    ] = 0.05
    axes_deg: Annotated[NotNegative, Meaning("1 sigma of the small rotation of the principal axes", "deg")] = 0.0

    def build(self, parts: Any, count: int) -> Any:
        """Return `dispersions.inertias.RelativeInertia` about the inertia of the true body."""
        moments, axes = np.linalg.eigh(np.asarray(parts.plant.inertia))
        return RelativeInertiaPart(*(vector(value) for value in (moments, axes, self.std, np.deg2rad(self.axes_deg))))


class UniformPhase(Table, frozen=True):
    """Uniform over the circle."""

    kind: Literal["uniform"] = "uniform"

    def build(self, parts: Any, count: int) -> Any:
        """Return `dispersions.numbers.RandomNumbers`."""
        return RandomNumbers("interval", vector(np.full(count, 2.0 * np.pi)))


class RelativeNormal(Numbers, frozen=True):
    """Times 1 + a normal number, truncated at three sigma."""

    distribution: ClassVar[str] = "truncated_normal"
    widest: ClassVar[float] = 3.0
    kind: Literal["relative_normal"] = "relative_normal"
    std: Annotated[
        Annotated[float, Meta(ge=0, le=0.3, description="a number from 0 to 0.3")], Meaning("1 sigma of the share")
    ] = 0.1


class RelativeUniform(Uniform, frozen=True):
    """Times 1 + a uniform number."""

    kind: Literal["relative_uniform"] = "relative_uniform"
    half_width: Annotated[
        Annotated[float, Meta(ge=0, lt=1, description="a number from 0 to below 1")], Meaning("largest share")
    ] = 0.2


class NormalTurn(Normal, frozen=True):
    """Turned by a normal rotation vector."""

    width: ClassVar[str] = "std_deg"
    kind: Literal["normal"] = "normal"
    std_deg: Annotated[NotNegative, Meaning("1 sigma per component", "deg")] = 0.1
    degrees: ClassVar[bool] = True


class UniformTurn(Uniform, frozen=True):
    """Turned by a rotation vector whose components are uniform."""

    width: ClassVar[str] = "half_width_deg"
    kind: Literal["uniform"] = "uniform"
    half_width_deg: Annotated[NotNegative, Meaning("largest size of a component", "deg")] = 0.1
    degrees: ClassVar[bool] = True


def _interval(table: Any, parts: Any) -> tuple[float, float]:
    """Return `earliest` and `latest` of a table [s]; by default until the end of the run."""
    return table.earliest, float(parts.t_end) if table.latest is None else table.latest


class Outage(Table, frozen=True):
    """Begins at any time between two, uniformly."""

    kind: Literal["uniform"] = "uniform"
    duration: Annotated[Positive | None, Meaning("how long it lasts; default: 10, scaled to the mission", "s")] = None
    scaled: ClassVar[Mapping[str, Scaled]] = {"duration": Scaled(10.0, time=1)}
    earliest: Annotated[NotNegative, Meaning("from when on it may begin", "s")] = 0.0
    latest: Annotated[NotNegative | None, Meaning("until when; default: loop.t_end", "s")] = None

    def build(self, parts: Any, count: int) -> Any:
        """Return `dispersions.numbers.RandomNumbers`: the random begin, and the duration."""
        begin, end = _interval(self, parts)
        return dataclasses.replace(interval([begin, self.duration], [end, self.duration]), common=True)


class Jitter(Table, frozen=True):
    """Of each trial its own, between two, uniformly; each sample then comes early or late by up to it, uniformly."""

    kind: Literal["uniform"] = "uniform"
    largest: Annotated[
        Positive, Meaning("share of loop.period by which a sample may come early or late, below a half")
    ] = 0.1
    smallest: Annotated[NotNegative, Meaning("likewise")] = 0.0

    def build(self, parts: Any, count: int) -> Any:
        """Return `dispersions.numbers.RandomNumbers`."""
        return interval([self.smallest], [self.largest])


class Failure(Table, frozen=True):
    """Of any one wheel, at any time between two, uniformly."""

    kind: Literal["uniform"] = "uniform"
    earliest: Annotated[NotNegative, Meaning("from when on it may be", "s")] = 0.0
    latest: Annotated[NotNegative | None, Meaning("until when; default: loop.t_end", "s")] = None
    known: Annotated[Truth, Meaning("the torque is given to the other wheels from then on")] = False

    def build(self, parts: Any, count: int) -> Any:
        """Return `dispersions.numbers.RandomNumbers`: the time, and a number on (0, 1) that chooses the wheel."""
        begin, end = _interval(self, parts)
        return interval([begin, 0.0], [end, 1.0])


class NormalBias(Normal, frozen=True):
    """Normal about what [disturbance] says."""

    kind: Literal["normal"] = "normal"
    std: Annotated[
        NotNegative | None, Meaning("1 sigma of each component; default: 1e-3, scaled to the mission", "unit of d")
    ] = None
    scaled: ClassVar[Mapping[str, Scaled]] = {"std": Scaled(1e-3, inertia=1, order=-1)}


class UniformBias(Uniform, frozen=True):
    """Uniform about what [disturbance] says."""

    kind: Literal["uniform"] = "uniform"
    half_width: Annotated[
        NotNegative | None,
        Meaning("largest deviation of each component; default: 1e-3, scaled to the mission", "unit of d"),
    ] = None
    scaled: ClassVar[Mapping[str, Scaled]] = {"half_width": Scaled(1e-3, inertia=1, order=-1)}


class UniformState(Uniform, frozen=True):
    """Every state uniform about x0."""

    kind: Literal["uniform"] = "uniform"
    half_width: Annotated[NotNegatives, Meaning("largest deviation, one number for each state; default: 1 each")] = ()


class NormalState(Normal, frozen=True):
    """Every state normal about x0."""

    kind: Literal["normal"] = "normal"
    std: Annotated[NotNegatives, Meaning("1 sigma, one number for each state; default: 1 each")] = ()


class Dispersion(Table, frozen=True):
    """What differs from trial to trial, each an inline table with a kind; what is absent stays as the scenario says."""

    attitude: Annotated[UniformAttitude | AxisAngle | NormalAttitude | None, Meaning("of the body at t = 0")] = None
    rate: Annotated[NormalRate | UniformRate | None, Meaning("of the body at t = 0")] = None
    inertia: Annotated[
        RelativeInertia | None, Meaning("of the true body, about true_inertia; the law keeps spacecraft.inertia")
    ] = None
    reference: Annotated[UniformAttitude | AxisAngle | NormalAttitude | None, Meaning("the whole reference turned")] = (
        None
    )
    disturbance_phase: Annotated[UniformPhase | None, Meaning("of every sinusoid, and of the orbit")] = None
    disturbance_amplitude: Annotated[
        RelativeNormal | RelativeUniform | None,
        Meaning("of each sinusoid and constant, an independent factor on each component"),
    ] = None
    disturbance_bias: Annotated[NormalBias | UniformBias | None, Meaning("a constant torque, added")] = None
    attitude_noise: Annotated[RelativeNormal | RelativeUniform | None, Meaning("factor on hardware.attitude_noise")] = (
        None
    )
    rate_noise: Annotated[RelativeNormal | RelativeUniform | None, Meaning("factor on hardware.rate_noise")] = None
    torque_limit: Annotated[RelativeNormal | RelativeUniform | None, Meaning("factor on hardware.torque_limit")] = None
    actuator_scale: Annotated[
        RelativeNormal | RelativeUniform | None,
        Meaning("factor on the torque of each axis, or wheel, that flight software does not know"),
    ] = None
    actuator_misalignment: Annotated[
        NormalTurn | UniformTurn | None,
        Meaning("each axis, or wheel, turned from where flight software takes it to be"),
    ] = None
    star_tracker_misalignment: Annotated[
        NormalTurn | UniformTurn | None, Meaning("the star tracker turned in the body")
    ] = None
    gyro_scale: Annotated[
        RelativeNormal | RelativeUniform | None, Meaning("factor on the rate that the gyro reads about each axis")
    ] = None
    star_tracker_outage: Annotated[
        Outage | None, Meaning("an interval without samples of the star tracker, with a filter")
    ] = None
    wheel_failure: Annotated[Failure | None, Meaning("a wheel that gives no torque any more")] = None
    timing_jitter: Annotated[
        Jitter | None,
        Meaning("share of loop.period by which samples come early or late, of which flight software knows nothing"),
    ] = None
    mode_frequency: Annotated[
        RelativeNormal | RelativeUniform | None, Meaning("factor on each of flexible.frequency")
    ] = None
    mode_coupling: Annotated[
        RelativeNormal | RelativeUniform | None, Meaning("factor on each row of flexible.coupling")
    ] = None
    own: Annotated[Any, Meaning("what code of one's own makes of numbers that are drawn")] = (
        None  # `own_devices.OwnDraw`
    )


class StateDispersion(Table, frozen=True):
    """What differs from trial to trial, each an inline table with a kind; what is absent stays as the scenario says."""

    x0: Annotated[UniformState | NormalState | None, Meaning("initial state")] = None
    disturbance_phase: Annotated[UniformPhase | None, Meaning("of every sinusoid")] = None
    disturbance_amplitude: Annotated[
        RelativeNormal | RelativeUniform | None,
        Meaning("of each sinusoid and constant, an independent factor on each component"),
    ] = None
    disturbance_bias: Annotated[NormalBias | UniformBias | None, Meaning("a constant, added")] = None
    state_noise: Annotated[RelativeNormal | RelativeUniform | None, Meaning("factor on hardware.state_noise")] = None
    torque_limit: Annotated[RelativeNormal | RelativeUniform | None, Meaning("factor on hardware.torque_limit")] = None
    timing_jitter: Annotated[
        Jitter | None,
        Meaning("share of loop.period by which samples come early or late, of which flight software knows nothing"),
    ] = None
    own: Annotated[Any, Meaning("what code of one's own makes of numbers that are drawn")] = (
        None  # `own_devices.OwnDraw`
    )
