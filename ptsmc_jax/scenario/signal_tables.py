"""The tables of a scenario file that say where a run starts, what it is to follow, and what disturbs it."""

from typing import Annotated, Any, Literal

from msgspec import Meta

from ptsmc_jax.scenario.values import (
    Each,
    EachNotNegative,
    Four,
    Matrix,
    Number,
    Positive,
    Table,
    Three,
    ThreeNotNegative,
)


class Attitude(Table, frozen=True):
    """Exactly one of the attitude keys, of the body relative to the inertial frame; `sequence` goes with `euler_deg`.

    Attributes:
        quat_xyzw: unit quaternion, scalar last
        quat_wxyz: unit quaternion, scalar first
        rotvec_deg: rotation vector [deg]
        mrp: modified Rodrigues parameters
        dcm_body_to_inertial: rotation matrix, by rows, that takes body components to inertial ones
        euler_deg: three angles of the axes in `sequence` [deg]
        sequence: three axes; capitals: intrinsic, about the body's; small letters: extrinsic
    """

    quat_xyzw: Four | None = None
    quat_wxyz: Four | None = None
    rotvec_deg: Three | None = None
    mrp: Three | None = None
    dcm_body_to_inertial: Matrix | None = None
    euler_deg: Three | None = None
    sequence: Annotated[str, Meta(description='three axes in SciPy\'s notation, such as "ZYX" or "zyx"')] | None = None


ATTITUDE_KEYS = ("quat_xyzw", "quat_wxyz", "rotvec_deg", "mrp", "dcm_body_to_inertial", "euler_deg")


class Initial(Attitude, frozen=True):
    """Where the spacecraft starts: one attitude key and the body rate.

    Attributes:
        rate: body rate at t = 0, body axes [rad/s]
    """

    rate: Three = (0.0, 0.0, 0.0)


class FixedReference(Attitude, frozen=True):
    """An attitude to be held."""

    kind: Literal["fixed"] = "fixed"


class SpinReference(Attitude, frozen=True):
    """The attitude at t = 0, turning from then on at a constant body rate.

    Attributes:
        rate: of the reference, its own axes [rad/s]
    """

    kind: Literal["spin"] = "spin"
    rate: Three = (0.0, 0.0, 0.0)


class SinusoidReference(Attitude, frozen=True):
    """On top of the attitude, the rotation vector amplitude sin(frequency t + phase), axis by axis.

    Attributes:
        amplitude: of the rotation vector, per axis [rad]
        frequency: per axis [rad/s]
        phase: per axis [rad]
    """

    kind: Literal["sinusoid"] = "sinusoid"
    amplitude: Three = (0.1, 0.1, 0.1)
    frequency: Three = (0.1, 0.1, 0.1)
    phase: Three = (0.0, 0.0, 0.0)


class SlewReference(Attitude, frozen=True):
    """From the attitude, at rest, to another one, at rest, about one axis.

    Attributes:
        to_quat_xyzw: the attitude at the end, unit quaternion, scalar last
        duration: how long it takes [s]
        way: the short way, or the long way round
    """

    kind: Literal["slew"] = "slew"
    to_quat_xyzw: Four = (0.0, 0.0, 0.0, 1.0)
    duration: Positive = 30.0
    way: Literal["short", "long"] = "short"


class NoDisturbance(Table, frozen=True):
    """Nothing disturbs."""

    kind: Literal["none"] = "none"


class ConstantDisturbance(Table, frozen=True):
    """A constant torque.

    Attributes:
        amplitude: the torque, per body axis [N m]
    """

    kind: Literal["constant"] = "constant"
    amplitude: Three = (0.01, 0.01, 0.01)


class SinusoidDisturbance(Table, frozen=True):
    """The torque bias + amplitude sin(frequency t + phase), axis by axis.

    Attributes:
        amplitude: per body axis [N m]
        frequency: per axis [rad/s]
        phase: per axis [rad]
        bias: constant part, per axis [N m]
    """

    kind: Literal["sinusoid"] = "sinusoid"
    amplitude: Three = (0.01, 0.01, 0.01)
    frequency: Three = (0.1, 0.1, 0.1)
    phase: Three = (0.0, 0.0, 0.0)
    bias: Three = (0.0, 0.0, 0.0)


class GravityGradient(Attitude, frozen=True):
    """The gravity gradient of a circular orbit, on the body that flies; the attitude key is that of the orbit's frame.

    The frame's z is along the orbit's normal, its x points to where the phase counts from.

    Attributes:
        orbit_rate: mean motion [rad/s]
        phase: where on the orbit the run starts [rad]
    """

    kind: Literal["gravity_gradient"] = "gravity_gradient"
    orbit_rate: Positive = 1.1e-3
    phase: Number = 0.0


class RandomWalk(Table, frozen=True):
    """A torque that wanders from zero, a new step each period; sampled loop only.

    Attributes:
        density: of the walk's white noise, per axis [N m/sqrt(s)]
    """

    kind: Literal["random_walk"] = "random_walk"
    density: ThreeNotNegative = (1e-4, 1e-4, 1e-4)


TERMS = 'a list of tables such as [{ kind = "constant" }]'


class SumDisturbance(Table, frozen=True):
    """Several disturbances at once.

    Attributes:
        terms: the disturbances, each an inline table with a kind of its own; needed
    """

    kind: Literal["sum"] = "sum"
    terms: Annotated[tuple[Any, ...], Meta(description=TERMS)] = ()


class EachRandomWalk(Table, frozen=True):
    """A disturbance that wanders from zero, a new step each period; sampled loop only.

    Attributes:
        density: of the walk's white noise, one number for each input; default: 1e-4 each [unit of d/sqrt(s)]
    """

    kind: Literal["random_walk"] = "random_walk"
    density: EachNotNegative | None = None


class EachConstant(Table, frozen=True):
    """A constant disturbance.

    Attributes:
        amplitude: one number for each input; default: 0.01 each [unit of d]
    """

    kind: Literal["constant"] = "constant"
    amplitude: Each | None = None


class EachSinusoid(Table, frozen=True):
    """The disturbance bias + amplitude sin(frequency t + phase), input by input.

    Attributes:
        amplitude: one number for each input; default: 0.01 each [unit of d]
        frequency: one for each; default: 1 each [rad/s]
        phase: one for each; default: 0 each [rad]
        bias: constant part, one for each; default: 0 each [unit of d]
    """

    kind: Literal["sinusoid"] = "sinusoid"
    amplitude: Each | None = None
    frequency: Each | None = None
    phase: Each | None = None
    bias: Each | None = None
