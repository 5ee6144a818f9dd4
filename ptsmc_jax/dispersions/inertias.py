"""The true body's inertia J = R diag(moments) R^T, drawn about that of the scenario."""

import math
from dataclasses import dataclass
from functools import partial
from typing import ClassVar

import jax
import jax.numpy as jnp
from jaxtyping import Array, Float

from ptsmc_jax.dispersions.numbers import FARTHEST
from ptsmc_jax.numerics import attitude, draws, guards
from ptsmc_jax.numerics.pytrees import Leaf, pytree

CANDIDATES, SLENDER = 16, 4  # bodies drawn for one that is physical, and if none is, in another way


@pytree
@dataclass(frozen=True)
class RelativeInertia:
    """True inertia with random principal moments and axes.

    Each moment has a relative error from a truncated normal distribution, which ends at `FARTHEST` standard deviations.
    Each moment is at most the sum of the other two. The first valid one of `CANDIDATES` samples is used. If none is
    valid, as for slender bodies, the first valid one of `SLENDER` samples of `_slender` is used. If none of these is
    valid either, less than once in 1e10 trials, the trial is nominal.
    """

    moments: Leaf  # (3,) nominal principal moments [kg m^2]
    axes: Leaf  # (3, 3) their axes in columns
    std: Leaf  # of a moment, relative [-], at most 0.3
    turn: Leaf  # of the axes, per axis [rad]
    drawn: ClassVar[draws.Distribution] = "normal"
    count: ClassVar[int] = 3 * CANDIDATES + 3 + 4 * SLENDER

    def at(self, c: Float[Array, " n"]) -> tuple[Float[Array, "3 3"], Float[Array, "3 3"]]:
        """Inertia [kg m^2] and its inverse, (3, 3) each."""
        plain, turn, slender = jnp.split(c, (3 * CANDIDATES, 3 * CANDIDATES + 3))
        candidates = plain.reshape(CANDIDATES, 3), jnp.ones(CANDIDATES, dtype=bool)
        # loops over the draws: the same work, but a fraction of the code to compile
        sorting = jnp.eye(3)[jnp.argsort(self.moments)]  # here, for a kernel cannot sort
        more = jax.lax.map(partial(self._slender, sorting), slender.reshape(SLENDER, 4))
        shares, counts = jax.tree.map(lambda *both: jnp.concatenate(both), candidates, more)

        def look(first: tuple[Array, Array], candidate: tuple[Array, Array]) -> tuple[tuple[Array, Array], None]:
            """Whether there is a body so far, and the moments of the first one."""
            (is_there, moments), (share, counts) = first, candidate
            tried = self.moments * (1.0 + self.std * share)
            physical = (2.0 * jnp.max(tried) <= jnp.sum(tried)) & (jnp.min(tried) > 0.0)
            fits = counts & physical & (jnp.max(jnp.abs(share)) <= FARTHEST)
            return (is_there | fits, jnp.where(fits & ~is_there, tried, moments)), None

        (_, moments), _ = jax.lax.scan(look, (jnp.asarray(False), self.moments), (shares, counts))
        q = attitude.from_rotation_vector(self.turn * turn)
        axes = self.axes @ jnp.stack([attitude.rotate(q, axis) for axis in jnp.eye(3)], axis=1)
        return (axes @ jnp.diag(moments)) @ axes.T, (axes @ jnp.diag(1.0 / moments)) @ axes.T

    def _slender(self, sorting: Float[Array, "3 3"], n: Float[Array, "4"]) -> tuple[Float[Array, "3"], Array]:
        """Shares whose two larger moments differ by at most the smallest, and whether they count, from normals [-].

        Of nominal moments a, b >= c with shares s, those of a and b are as well given by u = (a s_a - b s_b) / r and
        v = (b s_a + a s_b) / r, r^2 = a^2 + b^2, which are normal and independent too. It is a body where
        |a - b + std r u| <= c (1 + std s_c), an interval of u that has the chance W(s_c). So s_c has the density of a
        normal number times W, u given s_c is normal within the interval, and v is free. Of s_c and -s_c one counts, or
        none, with the chances W(s_c) / 2 W(0) and W(-s_c) / 2 W(0): their sum is largest, 1, at s_c = 0, since both
        ends move in proportion to s_c, and 0 lies between them at first.
        """
        c, a, b = sorting @ self.moments
        r, std = guards.norm(jnp.stack([a, b])), jnp.where(self.std > 0.0, self.std, 1.0)

        def ends(s: Array) -> tuple[Array, Array]:
            """Both ends of that interval, as `_uniform` has them: twice W lies between."""
            reach = c * (1.0 + std * s)
            return _uniform((b - a - reach) / (std * r)), _uniform((b - a + reach) / (std * r))

        (low, high), one, other = (ends(s) for s in (jnp.zeros_like(c), n[0], -n[0]))
        stays = one[1] - one[0] > (high - low) * (1.0 + _uniform(n[1]))
        turns = other[1] - other[0] > (high - low) * (1.0 - _uniform(n[1]))
        s, (low, high) = guards.select(stays, (n[0], one), (-n[0], other))
        u, v = _normal(low + (high - low) * (1.0 + _uniform(n[2])) / 2.0), n[3]
        return jnp.stack([s, (a * u + b * v) / r, (a * v - b * u) / r]) @ sorting, stays | turns


def _uniform(normal: Float[Array, "..."]) -> Float[Array, "..."]:
    """Uniform on (-1, 1) for a standard normal number."""
    return jax.lax.erf(normal / math.sqrt(2.0))


def _normal(uniform: Float[Array, "..."]) -> Float[Array, "..."]:
    """Its inverse, finite at the ends too."""
    end = 1.0 - jnp.finfo(uniform.dtype).eps
    return math.sqrt(2.0) * jax.lax.erf_inv(jnp.clip(uniform, -end, end))
