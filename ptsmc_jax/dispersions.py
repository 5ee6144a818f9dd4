"""What varies from trial to trial, and the draws: parts of a trial as a pure function of (seed, trial).

Every dispersion is a map from coordinates, numbers uniform on (0, 1) or standard normal, to a value: a trial's
coordinates are drawn, and a search for the worst trial moves them.
"""

from dataclasses import dataclass, replace
from typing import Any, ClassVar, Literal

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float

from ptsmc_jax import attitude, draws, signals
from ptsmc_jax.draws import Whole
from ptsmc_jax.numerics import Leaf
from ptsmc_jax.plants import AttitudeState, Spacecraft
from ptsmc_jax.rollout import Parts

INITIAL_ATTITUDE, INITIAL_STATE, INITIAL_RATE = "initial_attitude", "initial_state", "initial_rate"
INERTIA, DISTURBANCE_PHASE = "inertia", "disturbance_phase"
CANDIDATES = 16  # bodies drawn for one that is physical
FARTHEST = 3.0  # standard deviations of a principal moment, at most

Drawn = Literal["uniform", "normal"]
Coordinates = dict[str, Array]  # of a trial, by the name of what is drawn


@jax.tree_util.register_dataclass
@dataclass(frozen=True)
class UniformAttitude:
    """Initial attitude uniform on SO(3): a normal 4-vector, normalised (Muller, 1959)."""

    drawn: ClassVar[Drawn] = "normal"
    count: ClassVar[int] = 4

    def at(self, c: Float[Array, "4"], nominal: Float[Array, "4"], reference: Float[Array, "4"]) -> Float[Array, "4"]:
        """Initial attitude, (4,); nominal: that of [initial]; reference: the reference at t = 0."""
        del nominal, reference
        return attitude.normalise(c)


@jax.tree_util.register_dataclass
@dataclass(frozen=True)
class AxisAngle:
    """Initial attitude turned away from the reference at t = 0: axis uniform on the sphere, angle uniform."""

    smallest: Leaf  # [rad]
    largest: Leaf  # [rad]
    drawn: ClassVar[Drawn] = "uniform"
    count: ClassVar[int] = 3

    def at(self, c: Float[Array, "3"], nominal: Float[Array, "4"], reference: Float[Array, "4"]) -> Float[Array, "4"]:
        """Initial attitude, (4,); nominal: that of [initial]; reference: the reference at t = 0."""
        del nominal
        height, azimuth = 2.0 * c[0] - 1.0, 2.0 * np.pi * c[1]
        radius = jnp.sqrt(1.0 - height * height)
        axis = jnp.stack([radius * jnp.cos(azimuth), radius * jnp.sin(azimuth), height])
        angle = self.smallest + (self.largest - self.smallest) * c[2]
        return attitude.multiply(reference, attitude.from_rotation_vector(angle * axis))


@jax.tree_util.register_dataclass
@dataclass(frozen=True)
class NormalAttitude:
    """Initial attitude turned from the nominal one by a normal rotation vector."""

    std: Leaf  # per axis [rad]
    drawn: ClassVar[Drawn] = "normal"
    count: ClassVar[int] = 3

    def at(self, c: Float[Array, "3"], nominal: Float[Array, "4"], reference: Float[Array, "4"]) -> Float[Array, "4"]:
        """Initial attitude, (4,); nominal: that of [initial]; reference: the reference at t = 0."""
        del reference
        return attitude.multiply(nominal, attitude.from_rotation_vector(self.std * c))


@jax.tree_util.register_dataclass
@dataclass(frozen=True)
class UniformState:
    """Initial state of a chain or a system, or initial rate of a spacecraft, uniform about the nominal one."""

    half_width: Leaf  # (n,)
    drawn: ClassVar[Drawn] = "uniform"

    @property
    def count(self) -> int:
        """How many states there are."""
        return self.half_width.shape[-1]

    def at(self, c: Float[Array, " n"], nominal: Float[Array, " n"]) -> Float[Array, " n"]:
        """Initial state, (n,)."""
        return nominal + self.half_width * (2.0 * c - 1.0)


@jax.tree_util.register_dataclass
@dataclass(frozen=True)
class NormalState:
    """The same, normal about the nominal one."""

    std: Leaf  # (n,)
    drawn: ClassVar[Drawn] = "normal"

    @property
    def count(self) -> int:
        """How many states there are."""
        return self.std.shape[-1]

    def at(self, c: Float[Array, " n"], nominal: Float[Array, " n"]) -> Float[Array, " n"]:
        """Initial state, (n,)."""
        return nominal + self.std * c


@jax.tree_util.register_dataclass
@dataclass(frozen=True)
class RelativeInertia:
    """True inertia whose principal moments are each off by a normal share, and whose axes are turned.

    Truncated, not clipped: the first of `CANDIDATES` draws no moment of which is more than `FARTHEST` standard
    deviations off and that a body can have (each moment at most the sum of the other two). The nominal body where
    none is, which happens to a body in one plane once in a million draws.
    """

    moments: Leaf  # (3,) nominal principal moments [kg m^2]
    axes: Leaf  # (3, 3) their axes in columns
    std: Leaf  # of a moment, relative [-]
    turn: Leaf  # of the axes, per axis [rad]
    drawn: ClassVar[Drawn] = "normal"
    count: ClassVar[int] = 3 * CANDIDATES + 3

    def at(self, c: Float[Array, " n"]) -> tuple[Float[Array, "3 3"], Float[Array, "3 3"]]:
        """Inertia [kg m^2] and its inverse, (3, 3) each."""
        found = self.moments
        for share in c[: 3 * CANDIDATES].reshape(CANDIDATES, 3)[::-1]:  # so that the first one stays
            moments = self.moments * (1.0 + self.std * share)
            physical = (2.0 * jnp.max(moments) <= jnp.sum(moments)) & (jnp.min(moments) > 0.0)
            found = jnp.where(physical & (jnp.max(jnp.abs(share)) <= FARTHEST), moments, found)
        q = attitude.from_rotation_vector(self.turn * c[3 * CANDIDATES :])
        axes = self.axes @ jnp.stack([attitude.rotate(q, axis) for axis in jnp.eye(3)], axis=1)
        return (axes @ jnp.diag(found)) @ axes.T, (axes @ jnp.diag(1.0 / found)) @ axes.T


@jax.tree_util.register_dataclass
@dataclass(frozen=True)
class UniformPhase:
    """Phase of every sinusoidal disturbance, and of an orbit, later by an angle uniform between 0 and 2 pi."""

    drawn: ClassVar[Drawn] = "uniform"

    def at(self, c: Float[Array, " phases"], disturbance: Any) -> Any:
        """The disturbance."""
        return signals.later(disturbance, 2.0 * np.pi * c)


@jax.tree_util.register_dataclass
@dataclass(frozen=True)
class Dispersion:
    """Everything that is drawn for a trial; what is None stays nominal."""

    attitude: UniformAttitude | AxisAngle | NormalAttitude | None = None
    state: UniformState | NormalState | None = None  # of a chain or a system
    rate: UniformState | NormalState | None = None  # of a spacecraft
    inertia: RelativeInertia | None = None
    phase: UniformPhase | None = None

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
        }
        return {name: kind for name, kind in kinds.items() if kind is not None}

    def coordinates(self, parts: Parts, seed: Whole, trial: Whole) -> Coordinates:
        """Coordinates of a trial; each name has a stream of its own, so one more of them changes no other."""
        found = {}
        for name, kind in self.kinds.items():
            count = signals.phases(parts.disturbance) if isinstance(kind, UniformPhase) else kind.count
            draw = draws.normals if kind.drawn == "normal" else draws.uniforms
            found[name] = draw(draws.stream(seed, trial, name), count)
        return found

    def at(self, parts: Parts, coordinates: Coordinates) -> Parts:
        """The parts of the trial that has these coordinates."""
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
        if self.phase is not None:
            parts = replace(parts, disturbance=self.phase.at(coordinates[DISTURBANCE_PHASE], parts.disturbance))
        return parts

    def apply(self, parts: Parts, seed: Whole, trial: Whole) -> Parts:
        """The parts of one trial: a pure function of the nominal parts, the seed and the trial's number."""
        return self.at(parts, self.coordinates(parts, seed, trial))
