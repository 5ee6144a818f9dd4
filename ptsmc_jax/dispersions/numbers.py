"""Numbers and phases: a normal one is x = nominal + std c, a uniform one x = nominal + half_width (2 c - 1)."""

import math
from dataclasses import dataclass, field
from typing import ClassVar

import jax
import numpy as np
from jaxtyping import Array, Float

from ptsmc_jax.dispersions.base import FARTHEST, Drawn
from ptsmc_jax.numerics.pytrees import Leaf, pytree


@dataclass(frozen=True)
class _Spread:
    """What numbers about nominal ones have: how far each of them spreads."""

    spread: Leaf  # (n,)

    @property
    def count(self) -> int:
        """How many numbers there are."""
        return self.spread.shape[-1]


@pytree
@dataclass(frozen=True)
class Uniform(_Spread):
    """Numbers uniform about nominal ones; they spread by their half widths."""

    drawn: ClassVar[Drawn] = "uniform"

    def at(self, c: Float[Array, " n"], nominal: Float[Array, " n"]) -> Float[Array, " n"]:
        """The numbers, (n,), in the units of the nominal ones, from coordinates c [-]."""
        return nominal + self.spread * (2.0 * c - 1.0)


@pytree
@dataclass(frozen=True)
class Normal(_Spread):
    """Numbers normal about nominal ones; they spread by their standard deviations."""

    drawn: ClassVar[Drawn] = "normal"

    def at(self, c: Float[Array, " n"], nominal: Float[Array, " n"]) -> Float[Array, " n"]:
        """The numbers, (n,), in the units of the nominal ones, from coordinates c [-]."""
        return nominal + self.spread * c


@pytree
@dataclass(frozen=True)
class TruncatedNormal(_Spread):
    """Numbers normal about nominal ones, truncated (not clipped) at `FARTHEST` standard deviations, their spread."""

    drawn: ClassVar[Drawn] = "uniform"  # through the inverse of the truncated law

    def at(self, c: Float[Array, " n"], nominal: Float[Array, " n"]) -> Float[Array, " n"]:
        """The numbers, (n,), in the units of the nominal ones: erf_inv of a c [-] between its values at both ends."""
        within = math.erf(FARTHEST / math.sqrt(2.0))
        return nominal + self.spread * math.sqrt(2.0) * jax.lax.erf_inv((2.0 * c - 1.0) * within)


@pytree
@dataclass(frozen=True)
class UniformPhase:
    """Phase of every sinusoidal disturbance, and of an orbit, later by an angle uniform between 0 and 2 pi."""

    count: int = field(metadata={"static": True})
    drawn: ClassVar[Drawn] = "uniform"

    def at(self, c: Float[Array, " phases"], nominal: Float[Array, " phases"]) -> Float[Array, " phases"]:
        """The phases, (phases,) [rad]."""
        return nominal + 2.0 * np.pi * c


Factor = Uniform | TruncatedNormal  # about one
