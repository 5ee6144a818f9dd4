"""How hardware that flies differs from what flight software takes it for: what trials may have, and how it is drawn.

`OF_MISFITS` has what parts may have, by the name of its row, that of a key of [dispersion], of the stream of its draws
and of its columns; `MISFITS` how each is drawn: numbers of the quantity = at(coordinates, nominal parts).
"""

from collections.abc import Callable
from dataclasses import dataclass, replace
from typing import Any, ClassVar, Protocol, runtime_checkable

import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float

from ptsmc_jax import formulas
from ptsmc_jax.dispersions.base import (
    INERTIA,
    NEAR,
    Drawn,
    Given,
    Numbers,
    Quantity,
    UnfitError,
    fitting,
    numbered,
    of_field,
    plant_of,
    positive,
    reason,
    tensors,
)
from ptsmc_jax.numerics import attitude
from ptsmc_jax.numerics.pytrees import Leaf, pytree
from ptsmc_jax.simulation.assembly import Parts


def channels(parts: Parts) -> Float[Array, "m channels"]:
    """Directions (m, channels) [-] in which flight software takes its channels to act: body axes, or wheels."""
    wheels = parts.effective_actuators.wheels
    return jnp.eye(parts.plant.inputs) if wheels is None else wheels.axes


def _size(parts: Parts) -> int:
    return channels(parts).shape[1] if parts.clock.sampled else 0


def _paired(name: str, count: int) -> list[str]:
    """Names of vectors of three: number of the vector, then of the component."""
    return [f"{name}_{k + 1}{i + 1}" for k in range(count) for i in range(3)]


def _modes(parts: Parts) -> int:
    """How many flexible modes the true plant has."""
    return getattr(parts.plant, "frequency", np.zeros(0)).shape[-1]


# --- what parts may have ---


def _with_actuators(parts: Parts, **changes: Any) -> Parts:
    return replace(parts, actuators=replace(parts.effective_actuators, **changes))


def _scale(parts: Parts) -> Numbers:
    scale = parts.effective_actuators.scale
    return jnp.ones(_size(parts)) if scale is None else scale


def _directions(parts: Parts) -> Numbers:
    """True directions of the channels, one after the other, (3 channels,) [-]."""
    directions = parts.effective_actuators.directions
    return jnp.ravel((channels(parts) if directions is None else directions).T)


def _failure(parts: Parts) -> Numbers:
    """When a wheel fails [s], and its number from 1 on, (2,); infinite and 0: none does."""
    fails = parts.effective_actuators.failure_times
    if fails is None:
        return jnp.array([jnp.inf, 0.0])
    wheel = jnp.argmin(fails).astype(float) + 1.0
    return jnp.stack([jnp.min(fails), jnp.where(jnp.any(jnp.isfinite(fails)), wheel, 0.0)])


def _with_failure(parts: Parts, failure: Numbers) -> Parts:
    wheel = jnp.arange(channels(parts).shape[1]).astype(float) + 1.0
    return _with_actuators(parts, failure_times=jnp.where(wheel == failure[1], failure[0], jnp.inf))


def _check_wheel(given: Given, parts: Parts) -> None:
    """Numbers of wheels are whole and those of wheels that there are, or 0."""
    wheel, last = given["wheel_failure"][:, 1], channels(parts).shape[1]
    fit = (wheel == np.round(wheel)) & (wheel >= 0.0) & (wheel <= last)
    UnfitError.check(fit, lambda row: f"a time and the number of a wheel, from 1 to {last}, or 0 for none")


def _check_jitter(given: Given, parts: Parts) -> None:
    """No control period is longer than the window over which pointing is averaged."""
    if parts.pointing is not None:
        most = 0.5 * (float(parts.pointing.window) / float(parts.period) - 1.0)
        fit = given["timing_jitter"][:, 0] <= most + 1e-9
        UnfitError.check(fit, lambda row: f"at most {most:.6g}, by which no control period exceeds pointing.window")


def _check_coupling(given: Given, parts: Parts) -> None:
    """The body can be, with the inertia that a row gives or else the nominal one."""
    rows = given["mode_coupling"].reshape(-1, _modes(parts), 3)
    nominal = np.asarray(plant_of(parts).inertia)
    inertia = tensors(given[INERTIA]) if INERTIA in given else np.broadcast_to(nominal, (len(rows), 3, 3))
    UnfitError.check(
        formulas.flexible_bodies(inertia, rows),
        lambda k: f"a flexible body's coupling ({reason(formulas.rest_inertia, inertia[k], rows[k])})",
    )


def check_inertia(given: Given, parts: Parts) -> None:
    """A flexible body can be with the inertia [kg m^2] of a row and the nominal coupling, where it gives no other."""
    if _modes(parts) and "mode_coupling" not in given:
        inertia, coupling = tensors(given[INERTIA]), np.asarray(plant_of(parts).coupling)
        UnfitError.check(
            formulas.flexible_bodies(inertia, np.broadcast_to(coupling, (len(inertia), *coupling.shape))),
            lambda k: f"a flexible body's inertia ({reason(formulas.rest_inertia, inertia[k], coupling)})",
        )


_OUTAGE = ["star_tracker_outage_begin", "star_tracker_outage_end"]
_FAILURE = ("wheel_failure_time", "wheel_failure_wheel")
OF_MISFITS: dict[str, Quantity] = {
    "actuator_scale": Quantity(
        lambda parts: numbered("actuator_scale_", _size(parts)),
        _scale,
        lambda parts, scale: _with_actuators(parts, scale=scale),
    ),
    "actuator_misalignment": Quantity(
        lambda parts: _paired("actuator_misalignment", _size(parts)),
        _directions,
        lambda parts, listed: _with_actuators(parts, directions=listed.reshape(-1, 3).T),
        fitting(
            lambda rows: np.abs(np.linalg.norm(rows.reshape(len(rows), -1, 3), axis=2) - 1.0) <= NEAR,
            "unit vectors, three numbers for each channel",
        ),
    ),
    "star_tracker_misalignment": of_field(
        "sensors", "misalignment", numbered("star_tracker_misalignment_", 3), [0.0] * 3, unit="rad"
    ),
    "gyro_scale": of_field("sensors", "rate_scale", numbered("gyro_scale_", 3), [1.0] * 3),
    "star_tracker_outage": of_field(
        "sensors",
        "outage",
        _OUTAGE,
        [np.inf, np.inf],
        fitting(lambda rows: rows[:, 0] <= rows[:, 1], "a begin and an end that is not before it"),
        "s",
    )._replace(columns=lambda parts: [] if getattr(parts.sensors, "filter", None) is None else _OUTAGE),
    "wheel_failure": Quantity(
        lambda parts: [] if parts.effective_actuators.wheels is None else list(_FAILURE),
        _failure,
        _with_failure,
        check_with=_check_wheel,
        unit=("s", "-"),
        categories=_FAILURE[1:],
    ),
    "timing_jitter": Quantity(
        lambda parts: ["timing_jitter"] if parts.clock.sampled else [],
        lambda parts: jnp.zeros(1) if parts.jitter is None else jnp.reshape(parts.jitter, 1),
        lambda parts, share: replace(parts, jitter=share[0]),
        fitting(lambda rows: (rows >= 0.0) & (rows < 0.5), "a share of the control period from 0 to below 0.5"),
        check_with=_check_jitter,
    ),
    "mode_frequency": Quantity(
        lambda parts: numbered("mode_frequency_", _modes(parts)),
        lambda parts: plant_of(parts).frequency,
        lambda parts, frequency: replace(parts, plant=replace(plant_of(parts), frequency=frequency)),
        positive,
        unit="rad/s",
    ),
    "mode_coupling": Quantity(
        lambda parts: _paired("mode_coupling", _modes(parts)),
        lambda parts: jnp.ravel(plant_of(parts).coupling),
        lambda parts, rows: replace(
            parts, plant=replace(plant_of(parts), coupling=rows.reshape(-1, 3)).with_rest_inverse()
        ),
        check_with=_check_coupling,
        unit="sqrt(kg) m",
    ),
}


# --- how they are drawn ---


@runtime_checkable
class Misfit(Protocol):
    """What every misfit has: how it is drawn, and what it makes of the drawn numbers."""

    @property
    def count(self) -> int:
        """How many coordinates there are."""
        ...

    @property
    def drawn(self) -> Drawn:
        """How they are drawn."""
        ...

    def at(self, c: Float[Array, " coordinates"], parts: Parts) -> Float[Array, " n"]:
        """The numbers (n,) of its quantity, from coordinates c [-] about the nominal parts."""
        ...


@dataclass(frozen=True)
class _Drawn:
    """What those have that are numbers about their nominal ones, `numbers` a class of `dispersions.numbers`."""

    numbers: Any

    @property
    def count(self) -> int:
        """How many numbers there are."""
        return self.numbers.count

    @property
    def drawn(self) -> Drawn:
        """How their coordinates are drawn."""
        return self.numbers.drawn


@pytree
@dataclass(frozen=True)
class Factors(_Drawn):
    """Factors about 1, of which each quantity has its own."""

    def at(self, c: Float[Array, " n"], parts: Parts) -> Float[Array, " n"]:
        """The factors (n,) of coordinates c [-]."""
        return self.numbers.at(c, jnp.ones(self.count))


@pytree
@dataclass(frozen=True)
class Turn(_Drawn):
    """A small rotation vector about zero."""

    def at(self, c: Float[Array, "3"], parts: Parts) -> Float[Array, "3"]:
        """The rotation vector (3,) [rad] of coordinates c [-]."""
        return self.numbers.at(c, jnp.zeros(3))


@pytree
@dataclass(frozen=True)
class TurnedChannels(_Drawn):
    """A small rotation vector for each channel."""

    def at(self, c: Float[Array, " n"], parts: Parts) -> Float[Array, " n"]:
        """Their directions, unit vectors one after the other (3 channels,) [-], of coordinates c [-]."""
        turns, axes = self.numbers.at(c, jnp.zeros(self.count)).reshape(-1, 3), channels(parts)
        each = [attitude.rotate(attitude.from_rotation_vector(turns[k]), axes[:, k]) for k in range(axes.shape[1])]
        return jnp.concatenate(each)


@pytree
@dataclass(frozen=True)
class FrequencyFactors(_Drawn):
    """A factor on the frequency of each mode."""

    def at(self, c: Float[Array, " n"], parts: Parts) -> Float[Array, " n"]:
        """The frequencies (n,) [rad/s] of coordinates c [-]."""
        return plant_of(parts).frequency * self.numbers.at(c, jnp.ones(self.count))


@pytree
@dataclass(frozen=True)
class CouplingFactors(_Drawn):
    """A factor on the coupling row of each mode."""

    def at(self, c: Float[Array, " modes"], parts: Parts) -> Float[Array, " n"]:
        """The rows (3 modes,) [sqrt(kg) m] of coordinates c [-]."""
        return jnp.ravel(plant_of(parts).coupling * self.numbers.at(c, jnp.ones(self.count))[:, None])


@pytree
@dataclass(frozen=True)
class Outage:
    """An interval without samples of the star tracker, as long in every trial, which begins at any time."""

    earliest: Leaf  # [s]
    latest: Leaf  # [s]
    duration: Leaf  # [s]
    drawn: ClassVar[Drawn] = "uniform"
    count: ClassVar[int] = 1

    def at(self, c: Float[Array, "1"], parts: Parts) -> Float[Array, "2"]:
        """Begin and end (2,) [s], begin = earliest + c (latest - earliest)."""
        begin = self.earliest + c[0] * (self.latest - self.earliest)
        return jnp.stack([begin, begin + self.duration])


@pytree
@dataclass(frozen=True)
class Failure:
    """One of the wheels, any, gives no torque from some time on."""

    earliest: Leaf  # [s]
    latest: Leaf  # [s]
    drawn: ClassVar[Drawn] = "uniform"
    count: ClassVar[int] = 2

    def at(self, c: Float[Array, "2"], parts: Parts) -> Float[Array, "2"]:
        """Time [s] and number of the wheel, (2,): earliest + c_1 (latest - earliest), 1 + floor(c_2 wheels)."""
        wheel = 1.0 + jnp.floor(c[1] * channels(parts).shape[1])
        return jnp.stack([self.earliest + c[0] * (self.latest - self.earliest), wheel])


@pytree
@dataclass(frozen=True)
class Jitter:
    """By which samples come early or late at most, as a share of the control period."""

    smallest: Leaf  # [-]
    largest: Leaf  # [-]
    drawn: ClassVar[Drawn] = "uniform"
    count: ClassVar[int] = 1

    def at(self, c: Float[Array, "1"], parts: Parts) -> Float[Array, "1"]:
        """Smallest + c (largest - smallest) [-], (1,)."""
        return self.smallest + c * (self.largest - self.smallest)


def _between(kind: type, *keys: str) -> Callable:
    """Made of a table's numbers, times [s] or shares [-]; without `latest` until the end of the run."""

    def made(table: Any, parts: Parts) -> Any:
        values = [parts.t_end if getattr(table, key) is None else getattr(table, key) for key in keys]
        return kind(*(jnp.asarray(v, float) for v in values))

    return made


def _about(kind: type, size: Callable[[Parts], int]) -> Callable:
    """Made of a table that says how so many numbers are drawn."""
    return lambda table, parts: kind(table.build(size(parts)))


# made of the table of [dispersion], about these parts
MISFITS: dict[str, Callable[[Any, Parts], Misfit]] = {
    "actuator_scale": _about(Factors, _size),
    "actuator_misalignment": _about(TurnedChannels, lambda parts: 3 * _size(parts)),
    "star_tracker_misalignment": _about(Turn, lambda parts: 3),
    "gyro_scale": _about(Factors, lambda parts: 3),
    "star_tracker_outage": _between(Outage, "earliest", "latest", "duration"),
    "wheel_failure": _between(Failure, "earliest", "latest"),
    "timing_jitter": _between(Jitter, "smallest", "largest"),
    "mode_frequency": _about(FrequencyFactors, _modes),
    "mode_coupling": _about(CouplingFactors, _modes),
}
