"""Filters of the commanded torque, between the law and the actuators, that avoid the excitation of flexible modes.

Each filter is a continuous filter discretised by the bilinear rule with prewarping at its corner frequency W:
g = tan(W h / 2) for a period h (Franklin, Powell, Workman, Digital Control of Dynamic Systems, 1998). Periods may
differ in length. A filter begins at rest: the integrator of a roll-off is zero before the first sample. Observers use
the filtered command. Vectors are (m,) in [N m]. Read `CommandFilter.step` first.
"""

from dataclasses import dataclass
from typing import NamedTuple

import jax.numpy as jnp
from jaxtyping import Array, PyTree

from ptsmc_jax import declare
from ptsmc_jax.numerics.pytrees import Leaf, Scalar, Vector, pytree


class FilterState(NamedTuple):
    """Memory of a second-order filter between samples: its integrators, half a period ahead of the last sample."""

    first: Array  # (m,) integrator of the band-pass output [N m]
    second: Array  # (m,) integrator of the low-pass output [N m]


@dataclass(frozen=True)
class CommandFilter(declare.Tunable):
    """A filter of the flight computer's command."""

    corner: Leaf = declare.gain(
        1.0,
        "corner",
        unit="rad/s",
        meaning="W, corner frequency (gain command_corner)",
        free=True,
    )

    def dead_time(self) -> Scalar | float:
        """Return the delay of the filter at low frequencies, the derivative of its phase [s]."""
        raise NotImplementedError

    def begin(self, inputs: int) -> PyTree:
        """Return the state at rest."""
        raise NotImplementedError

    def prewarped(self, dt: Scalar) -> Scalar:
        """Return g = tan(W dt / 2) [-] for a period dt [s]; W dt must be below pi."""
        return jnp.tan(0.5 * self.corner * dt)

    def step(self, state: PyTree, u: Vector, dt_before: Scalar, dt: Scalar) -> tuple[Vector, PyTree]:
        """Return the filtered command (m,) [N m] of a sample, and the state for the next sample.

        Args:
            state: from `begin` or from the last sample.
            u: command of the law (m,) [N m].
            dt_before: length of the period that ends at the sample [s].
            dt: length of the period that begins at the sample [s].
        """
        raise NotImplementedError


@pytree
@dataclass(frozen=True)
class FirstOrder(CommandFilter):
    """Roll-off of first order, W / (s + W).

    It attenuates by 3 dB at its corner, with a phase lag of 45 degrees, and by 20 dB per decade above.
    """

    def dead_time(self) -> Scalar | float:
        """Return 1 / W [s]."""
        return 1.0 / self.corner

    def begin(self, inputs: int) -> Vector:
        """Return the integrator (m,) [N m] at rest. Between samples it is advanced by half of the next period."""
        return jnp.zeros(inputs)

    def step(self, state: Vector, u: Vector, dt_before: Scalar, dt: Scalar) -> tuple[Vector, Vector]:
        """Return the low-pass output y of y' = W (u - y), and the next state."""
        g = self.prewarped(dt_before)
        y = (state + g * u) / (1.0 + g)
        return y, y + self.prewarped(dt) * (u - y)


@dataclass(frozen=True)
class _SecondOrderFilter(CommandFilter):
    """State-variable filter with two integrators: b' = W h, l' = W b, h = u - 2 z b - l."""

    damping: Leaf = declare.number(0.7, above=0.0, meaning="z, damping ratio")

    def dead_time(self) -> Scalar | float:
        """Return 2 z / W [s]."""
        return 2.0 * self.damping / self.corner

    def begin(self, inputs: int) -> FilterState:
        """Return the state at rest."""
        return FilterState(jnp.zeros(inputs), jnp.zeros(inputs))

    def _advance(
        self, state: FilterState, u: Vector, dt_before: Scalar, dt: Scalar
    ) -> tuple[Vector, Vector, FilterState]:
        """Return the band-pass output b, the low-pass output l and the next state."""
        g, next_g = self.prewarped(dt_before), self.prewarped(dt)
        band = (state.first + g * (u - state.second)) / (1.0 + g * (g + 2.0 * self.damping))
        low = state.second + g * band
        high = u - 2.0 * self.damping * band - low
        return band, low, FilterState(band + next_g * high, low + next_g * band)


@pytree
@dataclass(frozen=True)
class SecondOrder(_SecondOrderFilter):
    """Roll-off of second order, W^2 / (s^2 + 2 z W s + W^2).

    Its phase lag is 90 degrees at its corner. Above, it attenuates by 40 dB per decade.
    """

    def step(self, state: FilterState, u: Vector, dt_before: Scalar, dt: Scalar) -> tuple[Vector, FilterState]:
        """Return the low-pass output and the next state."""
        _, low, state = self._advance(state, u, dt_before, dt)
        return low, state


@pytree
@dataclass(frozen=True)
class Notch(_SecondOrderFilter):
    """Notch, (s^2 + W^2) / (s^2 + 2 z W s + W^2).

    The gain at its corner is zero, and its width increases with z.
    """

    damping: Leaf = declare.number(0.5, above=0.0, meaning="z, which increases the width of the notch")

    def step(self, state: FilterState, u: Vector, dt_before: Scalar, dt: Scalar) -> tuple[Vector, FilterState]:
        """Return u - 2 z b, the command minus the band-pass output, and the next state."""
        band, _, state = self._advance(state, u, dt_before, dt)
        return u - 2.0 * self.damping * band, state
