"""What varies from trial to trial, and the draws: parts of a trial as a pure function of (seed, trial).

Every dispersion is a map from coordinates, numbers uniform on (0, 1) or standard normal, to a value: a trial's
coordinates are drawn, and a search for the worst trial moves them. A normal value is x = nominal + std c, a uniform
one x = nominal + half_width (2 c - 1).
"""

import math
from dataclasses import dataclass, field, replace
from typing import Any, ClassVar, Literal

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float

from ptsmc_jax import attitude, draws, numerics, signals
from ptsmc_jax.draws import Whole
from ptsmc_jax.numerics import Leaf, pytree
from ptsmc_jax.plants import AttitudeState, Spacecraft
from ptsmc_jax.rollout import Parts

INITIAL_ATTITUDE, INITIAL_STATE, INITIAL_RATE = "initial_attitude", "initial_state", "initial_rate"
INERTIA, REFERENCE = "inertia", "reference"
DISTURBANCE_PHASE, DISTURBANCE_AMPLITUDE = "disturbance_phase", "disturbance_amplitude"
DISTURBANCE_BIAS = "disturbance_bias"
CANDIDATES, SLENDER = 16, 4  # bodies drawn for one that is physical, and if none is, in another way
FARTHEST = 3.0  # standard deviations of what is truncated, at most

Drawn = Literal["uniform", "normal"]
Coordinates = dict[str, Array]  # of a trial, by the name of what is drawn


@pytree
@dataclass(frozen=True)
class UniformAttitude:
    """An attitude uniform on SO(3): a normal 4-vector, normalised (Muller, 1959)."""

    drawn: ClassVar[Drawn] = "normal"
    count: ClassVar[int] = 4

    def at(self, c: Float[Array, "4"], nominal: Float[Array, "4"], reference: Float[Array, "4"]) -> Float[Array, "4"]:
        """Attitude [-] (4,) of the body or the reference; nominal: its own; reference: the reference's at t = 0."""
        del nominal, reference
        return attitude.normalise(c)


@pytree
@dataclass(frozen=True)
class AxisAngle:
    """An attitude turned away from the reference at t = 0: axis uniform on the sphere, angle uniform."""

    smallest: Leaf  # [rad]
    largest: Leaf  # [rad]
    drawn: ClassVar[Drawn] = "uniform"
    count: ClassVar[int] = 3

    def at(self, c: Float[Array, "3"], nominal: Float[Array, "4"], reference: Float[Array, "4"]) -> Float[Array, "4"]:
        """Attitude [-] (4,) of the body or the reference; nominal: its own; reference: the reference's at t = 0."""
        del nominal
        height, azimuth = 2.0 * c[0] - 1.0, 2.0 * np.pi * c[1]
        radius = jnp.sqrt(1.0 - height * height)
        axis = jnp.stack([radius * jnp.cos(azimuth), radius * jnp.sin(azimuth), height])
        angle = self.smallest + (self.largest - self.smallest) * c[2]
        return attitude.multiply(reference, attitude.from_rotation_vector(angle * axis))


@pytree
@dataclass(frozen=True)
class NormalAttitude:
    """An attitude turned from the nominal one by a normal rotation vector."""

    std: Leaf  # per axis [rad]
    drawn: ClassVar[Drawn] = "normal"
    count: ClassVar[int] = 3

    def at(self, c: Float[Array, "3"], nominal: Float[Array, "4"], reference: Float[Array, "4"]) -> Float[Array, "4"]:
        """Attitude [-] (4,) of the body or the reference; nominal: its own; reference: the reference's at t = 0."""
        del reference
        return attitude.multiply(nominal, attitude.from_rotation_vector(self.std * c))


@pytree
@dataclass(frozen=True)
class Uniform:
    """Numbers uniform about nominal ones."""

    half_width: Leaf  # (n,)
    drawn: ClassVar[Drawn] = "uniform"

    @property
    def count(self) -> int:
        """How many numbers there are."""
        return self.half_width.shape[-1]

    def at(self, c: Float[Array, " n"], nominal: Float[Array, " n"]) -> Float[Array, " n"]:
        """The numbers, (n,), in the units of the nominal ones, from coordinates c [-]."""
        return nominal + self.half_width * (2.0 * c - 1.0)


@pytree
@dataclass(frozen=True)
class Normal:
    """Numbers normal about nominal ones."""

    std: Leaf  # (n,)
    drawn: ClassVar[Drawn] = "normal"

    @property
    def count(self) -> int:
        """How many numbers there are."""
        return self.std.shape[-1]

    def at(self, c: Float[Array, " n"], nominal: Float[Array, " n"]) -> Float[Array, " n"]:
        """The numbers, (n,), in the units of the nominal ones, from coordinates c [-]."""
        return nominal + self.std * c


@pytree
@dataclass(frozen=True)
class TruncatedNormal:
    """Numbers normal about nominal ones, truncated (not clipped) at `FARTHEST` standard deviations."""

    std: Leaf  # (n,)
    drawn: ClassVar[Drawn] = "uniform"  # through the inverse of the truncated law

    @property
    def count(self) -> int:
        """How many numbers there are."""
        return self.std.shape[-1]

    def at(self, c: Float[Array, " n"], nominal: Float[Array, " n"]) -> Float[Array, " n"]:
        """The numbers, (n,), in the units of the nominal ones: erf_inv of a c [-] between its values at both ends."""
        within = math.erf(FARTHEST / math.sqrt(2.0))
        return nominal + self.std * math.sqrt(2.0) * jax.lax.erf_inv((2.0 * c - 1.0) * within)


@pytree
@dataclass(frozen=True)
class RelativeInertia:
    """True inertia whose principal moments are each off by a normal share, and whose axes are turned.

    Truncated, not clipped: no moment is more than `FARTHEST` standard deviations off, and each is at most the sum of
    the other two. That is the law of the first of `CANDIDATES` draws that is such a body, and where none is, which
    happens to slender bodies, of the first of `SLENDER` draws by `_slender`, which leave out what is no body
    beforehand. (All of them fail less than once in 1e10 trials, which are then nominal.)
    """

    moments: Leaf  # (3,) nominal principal moments [kg m^2]
    axes: Leaf  # (3, 3) their axes in columns
    std: Leaf  # of a moment, relative [-], at most 0.3
    turn: Leaf  # of the axes, per axis [rad]
    drawn: ClassVar[Drawn] = "normal"
    count: ClassVar[int] = 3 * CANDIDATES + 3 + 4 * SLENDER

    def at(self, c: Float[Array, " n"]) -> tuple[Float[Array, "3 3"], Float[Array, "3 3"]]:
        """Inertia [kg m^2] and its inverse, (3, 3) each."""
        first, turn, rest = jnp.split(c, (3 * CANDIDATES, 3 * CANDIDATES + 3))
        shares = [(share, True) for share in first.reshape(CANDIDATES, 3)]
        shares += zip(*jax.vmap(self._slender)(rest.reshape(SLENDER, 4)), strict=True)
        found = self.moments
        for share, counts in shares[::-1]:  # so that the first one stays
            moments = self.moments * (1.0 + self.std * share)
            physical = (2.0 * jnp.max(moments) <= jnp.sum(moments)) & (jnp.min(moments) > 0.0)
            found = jnp.where(counts & physical & (jnp.max(jnp.abs(share)) <= FARTHEST), moments, found)
        q = attitude.from_rotation_vector(self.turn * turn)
        axes = self.axes @ jnp.stack([attitude.rotate(q, axis) for axis in jnp.eye(3)], axis=1)
        return (axes @ jnp.diag(found)) @ axes.T, (axes @ jnp.diag(1.0 / found)) @ axes.T

    def _slender(self, n: Float[Array, "4"]) -> tuple[Float[Array, "3"], Array]:
        """Shares whose two larger moments differ by at most the smallest, and whether they count, from normals [-].

        Of nominal moments a, b >= c with shares s, those of a and b are as well given by u = (a s_a - b s_b) / r and
        v = (b s_a + a s_b) / r, r^2 = a^2 + b^2, which are normal and independent too. It is a body where
        |a - b + std r u| <= c (1 + std s_c), an interval of u that has the chance W(s_c). So s_c has the density of a
        normal number times W, u given s_c is normal within the interval, and v is free. Of s_c and -s_c one counts, or
        none, with the chances W(s_c) / 2 W(0) and W(-s_c) / 2 W(0): their sum is largest, 1, at s_c = 0, since both
        ends move in proportion to s_c, and 0 lies between them at first.
        """
        order = jnp.argsort(self.moments)
        c, a, b = self.moments[order]
        r, std = numerics.norm(jnp.stack([a, b])), jnp.where(self.std > 0.0, self.std, 1.0)

        def ends(s: Array) -> tuple[Array, Array]:
            """Of the interval, as `_uniform` has them: twice W lies between."""
            reach = c * (1.0 + std * s)
            return _uniform((b - a - reach) / (std * r)), _uniform((b - a + reach) / (std * r))

        (low, high), one, other = (ends(s) for s in (jnp.zeros_like(c), n[0], -n[0]))
        stays = one[1] - one[0] > (high - low) * (1.0 + _uniform(n[1]))
        turns = other[1] - other[0] > (high - low) * (1.0 - _uniform(n[1]))
        s, (low, high) = numerics.select(stays, (n[0], one), (-n[0], other))
        u, v = _normal(low + (high - low) * (1.0 + _uniform(n[2])) / 2.0), n[3]
        return jnp.stack([s, (a * u + b * v) / r, (a * v - b * u) / r]) @ jnp.eye(3)[order], stays | turns


def _uniform(normal: Float[Array, "..."]) -> Float[Array, "..."]:
    """Uniform on (-1, 1) for a standard normal number."""
    return jax.lax.erf(normal / math.sqrt(2.0))


def _normal(uniform: Float[Array, "..."]) -> Float[Array, "..."]:
    """Its inverse, finite at the ends too."""
    end = 1.0 - jnp.finfo(uniform.dtype).eps
    return math.sqrt(2.0) * jax.lax.erf_inv(jnp.clip(uniform, -end, end))


@pytree
@dataclass(frozen=True)
class UniformPhase:
    """Phase of every sinusoidal disturbance, and of an orbit, later by an angle uniform between 0 and 2 pi."""

    count: int = field(metadata={"static": True})
    drawn: ClassVar[Drawn] = "uniform"

    def at(self, c: Float[Array, " phases"], nominal: Float[Array, " phases"]) -> Float[Array, " phases"]:
        """The phases, (phases,) [rad]."""
        return nominal + 2.0 * np.pi * c


Attitudes = UniformAttitude | AxisAngle | NormalAttitude
Factor = Uniform | TruncatedNormal  # about one

# of what a trial may have more or less, by one factor: name -> where in the parts it stands
LEVELS = {
    "attitude_noise": ("sensors", "attitude_noise"),
    "rate_noise": ("sensors", "rate_noise"),
    "state_noise": ("sensors", "sigma"),
    "torque_limit": ("actuators", "torque_limit"),
}


@pytree
@dataclass(frozen=True)
class Dispersion:
    """Everything that is drawn for a trial; what is None stays nominal.

    Coordinates are numbers (n,) [-] by the name of the stream that they are drawn from.
    """

    attitude: Attitudes | None = None
    state: Uniform | Normal | None = None  # of a chain or a system
    rate: Uniform | Normal | None = None  # of a spacecraft [rad/s]
    inertia: RelativeInertia | None = None
    phase: UniformPhase | None = None
    amplitude: Factor | None = None  # of every amplitude of the disturbance
    bias: Uniform | Normal | None = None  # a constant disturbance that is added, about zero [N m]
    reference: Attitudes | None = None
    levels: dict[str, Factor] = field(default_factory=dict)  # see `LEVELS`

    @property
    def varies(self) -> bool:
        """Whether anything differs from trial to trial."""
        return bool(self.kinds)

    @property
    def kinds(self) -> dict[str, Any]:
        """What is drawn, by the name of its stream."""
        kinds = {
            INITIAL_ATTITUDE: self.attitude,
            INITIAL_STATE: self.state,
            INITIAL_RATE: self.rate,
            INERTIA: self.inertia,
            DISTURBANCE_PHASE: self.phase,
            DISTURBANCE_AMPLITUDE: self.amplitude,
            DISTURBANCE_BIAS: self.bias,
            REFERENCE: self.reference,
            **{f"{name}_level": level for name, level in self.levels.items()},
        }
        return {name: kind for name, kind in kinds.items() if kind is not None}

    def coordinates(self, seed: Whole, trial: Whole) -> Coordinates:
        """Coordinates of a trial; each name has a stream of its own, so one more of them changes no other."""
        return {
            name: (draws.normals if kind.drawn == "normal" else draws.uniforms)(
                draws.stream(seed, trial, name), kind.count
            )
            for name, kind in self.kinds.items()
        }

    def at(self, parts: Parts, coordinates: Coordinates) -> Parts:
        """The parts of the trial that has these coordinates."""
        if not self.varies:
            return parts
        if self.reference is not None:
            q = parts.reference.q
            turned = self.reference.at(coordinates[REFERENCE], q, q)
            parts = replace(parts, reference=replace(parts.reference, q=turned))
        if self.state is not None:
            parts = replace(parts, initial=self.state.at(coordinates[INITIAL_STATE], parts.initial))
        if self.attitude is not None:
            reference = parts.reference(jnp.zeros_like(parts.t_end))
            q = self.attitude.at(coordinates[INITIAL_ATTITUDE], parts.initial.q, reference.q)
            parts = replace(parts, initial=AttitudeState(q, parts.initial.w))
        if self.rate is not None:
            w = self.rate.at(coordinates[INITIAL_RATE], parts.initial.w)
            parts = replace(parts, initial=AttitudeState(parts.initial.q, w))
        if self.inertia is not None:
            body = Spacecraft(*self.inertia.at(coordinates[INERTIA]))
            parts = replace(parts, plant=body, disturbance=signals.on_body(parts.disturbance, body.inertia))
        for name, level in self.levels.items():
            part, key = LEVELS[name]
            device = getattr(parts, part)
            nominal = getattr(device, key)
            factor = level.at(coordinates[f"{name}_level"], jnp.ones(level.count))
            parts = replace(parts, **{part: replace(device, **{key: nominal * factor[0]})})
        return replace(parts, disturbance=self._disturbance(parts.disturbance, coordinates))

    def _disturbance(self, nominal: Any, coordinates: Coordinates) -> Any:
        found = nominal
        if self.phase is not None:
            angles = self.phase.at(coordinates[DISTURBANCE_PHASE], signals.values(found, "phase"))
            found = signals.with_values(found, "phase", angles)
        if self.amplitude is not None:
            factor = self.amplitude.at(coordinates[DISTURBANCE_AMPLITUDE], jnp.ones(self.amplitude.count))
            found = signals.with_values(found, "amplitude", signals.values(found, "amplitude") * factor)
        if self.bias is not None:
            bias = signals.Constant(self.bias.at(coordinates[DISTURBANCE_BIAS], jnp.zeros(self.bias.count)))
            found = signals.Sum((*(found.terms if isinstance(found, signals.Sum) else (found,)), bias))
        return found

    def apply(self, parts: Parts, seed: Whole, trial: Whole) -> Parts:
        """The parts of one trial: a pure function of the nominal parts, the seed and the trial's number."""
        return self.at(parts, self.coordinates(seed, trial))

    def values(self, parts: Parts) -> dict[str, Array]:
        """What a trial flies, read from its parts: the initial state, and what else is drawn, by name, numbers each.

        Attitudes (q1 to q4) [-], rates [rad/s], inertia [kg m^2], phases [rad], torques [N m], noises [rad, rad/s].
        """
        initial, reference = parts.initial, parts.reference(jnp.zeros_like(parts.t_end))
        found: dict[str, Array] = {"initial_angle": parts.controller.angle(initial, reference)}
        if isinstance(initial, AttitudeState):
            found |= {f"initial_q{k + 1}": initial.q[k] for k in range(4)}
            found |= {f"initial_w{k + 1}": initial.w[k] for k in range(3)}
        else:
            found |= {f"initial_x{k + 1}": initial[k] for k in range(initial.shape[-1])}
        if self.reference is not None:
            found |= {f"reference_q{k + 1}": parts.reference.q[k] for k in range(4)}
        if self.inertia is not None:
            found |= {f"inertia_{i + 1}{j + 1}": parts.plant.inertia[i, j] for i in range(3) for j in range(i, 3)}
        if self.phase is not None:
            found |= _numbered(DISTURBANCE_PHASE, signals.values(parts.disturbance, "phase"), self.phase.count)
        if self.amplitude is not None:
            amplitudes = signals.values(parts.disturbance, "amplitude")
            found |= _numbered(DISTURBANCE_AMPLITUDE, amplitudes, self.amplitude.count)
        if self.bias is not None:
            found |= _numbered(DISTURBANCE_BIAS, parts.disturbance.terms[-1].value, self.bias.count)
        for name in self.levels:
            part, key = LEVELS[name]
            value = getattr(getattr(parts, part), key)
            found |= {name: value} if value.ndim == 0 else _numbered(name, value, value.shape[0])
        return found


def _numbered(name: str, values: Array, count: int) -> dict[str, Array]:
    """The first `count` of these numbers, by name and number."""
    return {f"{name}_{k + 1}": values[k] for k in range(count)}
