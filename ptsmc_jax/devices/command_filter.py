"""Filters of the commanded torque, between the law and its actuators, that keep it off what rings in the body.

Each is that of continuous time by the bilinear rule, its corner W met exactly: g = tan(W h / 2) for a period h (Tustin
with prewarping; Franklin, Powell, Workman, Digital Control of Dynamic Systems, 1998). It integrates from one sample to
the next, whatever the period's length is, and begins at rest: a roll-off has no output at the first sample. The flight
computer knows its filter: observers use the filtered command. Vectors (m,) in N m.
"""

from dataclasses import dataclass
from typing import Any, NamedTuple

import jax.numpy as jnp
from jaxtyping import Array

from ptsmc_jax import declare
from ptsmc_jax.numerics.pytrees import Leaf, Scalar, Vector, pytree


class FilterState(NamedTuple):
    """Integrators of a second-order filter between samples, advanced by half of the next period."""

    first: Array  # (m,) of the band [N m]
    second: Array  # (m,) of the low pass [N m]


@dataclass(frozen=True)
class CommandFilter(declare.Tunable):
    """A filter of the flight computer's command."""

    corner: Leaf = declare.gain(
        1.0,
        "corner",
        unit="rad/s",
        meaning="W, its corner frequency, which tuning may move as command_corner",
        free=True,
    )

    def dead_time(self) -> Scalar | float:
        """Return its delay at low frequencies, the derivative of its phase [s]."""
        raise NotImplementedError

    def begin(self, inputs: int) -> Any:
        """At rest."""
        raise NotImplementedError

    def prewarped(self, dt: Scalar) -> Scalar:
        """The g = tan(W dt / 2) [-] for a period dt [s]; W dt below pi."""
        return jnp.tan(0.5 * self.corner * dt)

    def step(self, state: Any, u: Vector, before: Scalar, dt: Scalar) -> tuple[Vector, Any]:
        """Filtered command (m,) [N m] of a sample, and the state for the next one.

        before, dt: lengths of the periods that end and begin at the sample [s].
        """
        raise NotImplementedError


@pytree
@dataclass(frozen=True)
class FirstOrder(CommandFilter):
    """Roll-off of first order, W / (s + W).

    3 dB and 45 degrees at the corner, then 20 dB a decade.
    """

    def dead_time(self) -> Scalar | float:
        """1 / W [s]."""
        return 1.0 / self.corner

    def begin(self, inputs: int) -> Vector:
        """At rest: its one integrator (m,) [N m], between samples too advanced by half of the next period."""
        return jnp.zeros(inputs)

    def step(self, state: Vector, u: Vector, before: Scalar, dt: Scalar) -> tuple[Vector, Vector]:
        """The low pass y, y' = W (u - y)."""
        g = self.prewarped(before)
        y = (state + g * u) / (1.0 + g)
        return y, y + self.prewarped(dt) * (u - y)


@dataclass(frozen=True)
class _Second(CommandFilter):
    """Two integrators: b' = W h, l' = W b, h = u - 2 z b - l, as one of all second-order filters has them."""

    damping: Leaf = declare.number(0.7, above=0.0, meaning="z, its damping ratio")

    def dead_time(self) -> Scalar | float:
        """2 z / W [s]."""
        return 2.0 * self.damping / self.corner

    def begin(self, inputs: int) -> FilterState:
        """At rest."""
        return FilterState(jnp.zeros(inputs), jnp.zeros(inputs))

    def _integrated(
        self, state: FilterState, u: Vector, before: Scalar, dt: Scalar
    ) -> tuple[Vector, Vector, FilterState]:
        """Band b and low pass l of this sample."""
        g, next_g = self.prewarped(before), self.prewarped(dt)
        band = (state.first + g * (u - state.second)) / (1.0 + g * (g + 2.0 * self.damping))
        low = state.second + g * band
        high = u - 2.0 * self.damping * band - low
        return band, low, FilterState(band + next_g * high, low + next_g * band)


@pytree
@dataclass(frozen=True)
class SecondOrder(_Second):
    """Roll-off of second order, W^2 / (s^2 + 2 z W s + W^2).

    90 degrees at the corner, then 40 dB a decade.
    """

    def step(self, state: FilterState, u: Vector, before: Scalar, dt: Scalar) -> tuple[Vector, FilterState]:
        """The low pass."""
        _, low, state = self._integrated(state, u, before, dt)
        return low, state


@pytree
@dataclass(frozen=True)
class Notch(_Second):
    """Notch, (s^2 + W^2) / (s^2 + 2 z W s + W^2).

    Nothing passes at its corner, and its width grows with z.
    """

    damping: Leaf = declare.number(0.5, above=0.0, meaning="z, how wide it is")

    def step(self, state: FilterState, u: Vector, before: Scalar, dt: Scalar) -> tuple[Vector, FilterState]:
        """The command without the band, u - 2 z b."""
        band, _, state = self._integrated(state, u, before, dt)
        return u - 2.0 * self.damping * band, state
