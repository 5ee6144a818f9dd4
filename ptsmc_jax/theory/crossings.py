"""The frequency response of an opened loop on a grid, and between which of its points it crosses what margins are of.

All points at once: A comes in triangles, and what is solved with it goes state after state.
"""

from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, ArrayLike, Complex, Float

from ptsmc_jax.theory.linear import Opening

LOWEST, POINTS = 1e-6, 240  # of the grid: share of the Nyquist frequency that it begins at, and its size without poles
AROUND = np.array([-3.0, -1.0, -0.3, 0.3, 1.0, 3.0])  # of a pole, in times its damping
NEAREST = 3  # crossings of a kind that are closed in on
SPLIT = (2 * NEAREST, 3 * NEAREST)  # of the places looked for: L real, |L| = 1, L nearest to -1
REAL = 1e-2  # share of the real part below which the imaginary one counts as none, at the ends of the grid
EVEN = 1e-6  # share by which sizes of L may differ that are the same: of points of the grid that fall on each other
CHUNK = 64  # points of the grid at which L is evaluated at once: their states stay in the processor's cache
MOST = 100.0  # dB: no limit of the gain; of the sensitivity, that of an unstable loop


def poles_of(opening: Opening) -> Complex[Array, "loops n"]:
    """Poles [-] of the closed loop, at which the sensitivity may peak, then of those with an axis open, where L may."""
    m = opening.c.shape[0]
    closed = jnp.asarray(np.append(np.ones((1, m)), 1.0 - np.eye(m), axis=0))
    return jax.lax.map(lambda on: jnp.linalg.eigvals(opening.closed(jnp.diag(on))), closed)


def grid(poles: Complex[Array, "loops n"], h: Any) -> Float[Array, " points"]:
    """Frequencies [rad/s] for a period h [s], graded toward 0 and the Nyquist frequency, and around `poles_of`."""
    low = np.geomspace(LOWEST, 0.5, POINTS // 2, endpoint=False)
    high = 1.0 - np.append(0.5 * np.geomspace(1.0, 1e-4, POINTS // 4), 0.0)
    base = np.unique(np.concatenate([low, np.linspace(0.05, 0.95, POINTS // 4), high]))
    upper = jnp.argsort(-poles.imag, axis=1)[:, : (poles.shape[1] + 1) // 2]  # of pairs one; real ones need no more
    poles = jnp.take_along_axis(poles, upper, axis=1).reshape(-1)
    damping = jnp.clip(jnp.abs(jnp.log(jnp.maximum(jnp.abs(poles), 1e-12))) / jnp.pi, LOWEST, 1.0)
    near = jnp.abs(jnp.angle(poles))[None] / jnp.pi + AROUND[:, None] * damping[None]
    both = jnp.append(jnp.asarray(base), jnp.clip(jnp.nan_to_num(near), LOWEST, 1.0))
    return jnp.sort(both) * jnp.pi / h


class Triangles(NamedTuple):
    """An opened loop by Schur's decomposition: many of its values cost little. It has no slopes."""

    opening: Opening  # with a triangular A
    axes: Array  # (n, n) unitary: of its states in columns

    def halves(self, z: Complex[Array, " points"]) -> tuple[Array, Array]:
        """X = (z I - A)^-1 B and, turned, Y = C (z I - A)^-1, (n, m, points) each, by its own states."""
        a, n = self.opening.a, self.opening.a.shape[0]

        def solved(rest: Array, b: Array, *, up: bool) -> Array:
            """State after state, for all points at once; rest: A without its diagonal."""

            def state(k: Array, x: Array) -> Array:
                i = n - 1 - k if up else k
                own = x[i] / (z - a[i, i])[None]  # and what it adds to the others: three times as fast as row by row
                return (x + rest[:, i][:, None, None] * own[None]).at[i].set(own)

            return jax.lax.fori_loop(0, n, state, jnp.broadcast_to(b[:, :, None] + 0j, (*b.shape, z.size)))

        rest = jnp.triu(a, 1)
        return solved(rest, self.opening.b, up=True), solved(rest.T, self.opening.c.T, up=False)

    def response(self, z: Complex[Array, " points"]) -> tuple[Array, Array]:
        """L [-] at many z and its derivative by z, (points, m, m) each."""
        x, y = self.halves(z)
        return -jnp.einsum("kn,nmp->pkm", self.opening.c, x), jnp.einsum("nkp,nmp->pkm", y, x)

    def values(self, z: Complex[Array, " points"]) -> Complex[Array, "points m m"]:
        """L [-] at any number of z, evaluated in chunks."""
        chunks = jnp.resize(z, (-(-z.size // CHUNK), CHUNK))
        each = jax.lax.map(lambda z: self.response(z)[0], chunks)
        return each.reshape(-1, *each.shape[2:])[: z.size]


def triangle(a: ArrayLike) -> tuple[Array, Array]:
    """A matrix A as a triangle, and the axes that it is one in (Schur), (n, n) each; without slopes."""
    upper, axes = jax.scipy.linalg.schur(jax.lax.stop_gradient(a), output="complex")
    return upper, axes


def in_triangles(opening: Opening, known: tuple[Array, Array] | None = None) -> Triangles:
    """The loop L [-] in coordinates in which its matrix A is a `triangle`; known: that of A."""
    fixed = jax.lax.stop_gradient(opening)
    a, axes = known or triangle(fixed.a)
    return Triangles(Opening(a, jnp.conj(axes.T) @ fixed.b, fixed.c @ axes), axes)


def response(opening: Opening, quick: Triangles, z: Complex[Array, " points"]) -> tuple[Array, Array]:
    """L [-] at many z with its slopes by the loop, and its derivative by z, (points, m, m) each.

    L = Y (z X - A X - B) - C X: what X and Y are off by, Schur's rounding, counts in the second order only, and so does
    what they change with the loop.
    """
    x, y = jax.lax.stop_gradient(quick.halves(z))
    x = jnp.einsum("ij,jmp->imp", quick.axes, x)
    y = jnp.einsum("ij,jmp->imp", jnp.conj(quick.axes), y)
    off = z[None, None] * x - jnp.einsum("ij,jmp->imp", opening.a, x) - opening.b[:, :, None]
    L = jnp.einsum("nkp,nmp->pkm", y, off) - jnp.einsum("kn,nmp->pkm", opening.c, x)
    return L, jnp.einsum("nkp,nmp->pkm", y, x)


@jax.jit
def one_axis(response: Complex[Array, "m m"], axis: Any) -> Complex[Array, ""]:
    """L of one axis with the others closed one after the other: each takes what goes around it off the rest.

    A loop over the axes, which compiles in a fraction of what a solution of equations takes.
    """
    each = jnp.eye(response.shape[0])
    own = each[axis]

    def closed(L: Array, other: Array) -> tuple[Array, None]:
        column, row = L @ other, other @ L
        back = jnp.where(other @ own > 0.0, 0.0, 1.0 / (1.0 + row @ other))
        return L - back * column[:, None] * row[None], None

    return own @ jax.lax.scan(closed, response, each)[0] @ own


def each_axis(response: Complex[Array, "points m m"]) -> Complex[Array, "points m"]:
    """The same of all axes at many points."""
    axes = jnp.arange(response.shape[1])
    return jax.vmap(jax.vmap(one_axis, (None, 0)), (0, None))(response, axes)


class Brackets(NamedTuple):
    """Between which points L is real and may be -1 with more gain, or with less, has the size 1, is nearest to -1.

    `NEAREST` places of each of these four, (places,); those that there are too few of are not `there`.
    """

    low: Array  # [rad/s]
    high: Array  # [rad/s]
    at_low: Array  # what is zero in between: `sine`, ln |L|, the slope of |1 + L|^2 by w
    at_high: Array
    there: Array  # bool
    elsewhere: Array  # frequencies to look at besides [rad/s]: where L is nearest to -1, and both ends


def brackets(w: Array, seen: Array) -> Brackets:
    """The `Brackets` of an L [-] at frequencies w [rad/s], (points,) each."""
    turned, size, near = sine(seen), jnp.log(jnp.abs(seen)), jnp.abs(1.0 + seen) ** 2
    real, factor = real_at(seen)
    # one that lies a little to the other side may turn out to lie on this one
    more, less = (jnp.where(real & (side * factor > -0.1), side * factor, jnp.inf) for side in (1.0, -1.0))
    even, phase = even_at(seen)
    least = (near[1:-1] <= near[:-2]) & (near[1:-1] <= near[2:])
    nearest = jnp.append(jnp.inf, jnp.where(least, near[1:-1], jnp.inf))
    how_far = (more, less, jnp.where(even, jnp.abs(phase), jnp.inf), nearest)
    values, places = zip(*map(smallest, how_far), strict=True)
    j, k = jnp.concatenate(places[:3]), jnp.maximum(places[3], 1)
    slope = (near[1:] - near[:-1]) / jnp.where(w[1:] == w[:-1], 1.0, w[1:] - w[:-1]) / 2

    def crossed(at: Array) -> Array:
        return jnp.append(turned[at][: SPLIT[0]], size[at][SPLIT[0] :])

    return Brackets(
        low=jnp.append(w[j], w[k - 1]),
        high=jnp.append(w[j + 1], w[k + 1]),
        at_low=jnp.append(crossed(j), slope[k - 1]),
        at_high=jnp.append(crossed(j + 1), slope[k]),
        there=jnp.isfinite(jnp.concatenate(values)),
        elsewhere=w[jnp.stack([jnp.argmin(near), 0, -1])],
    )


def sine(L: Array) -> Array:
    """Of the phase of L [-]: zero where L is real, as Im L is, but no larger next to a pole."""
    size = jnp.abs(L)
    return L.imag / jnp.where(size > 0.0, size, 1.0)


def smallest(values: Array, count: int = NEAREST) -> tuple[Array, Array]:
    """The least of them, so many, and their places, in order; several times as fast as to sort them all."""
    least, places = [], []
    for _ in range(count):
        place = jnp.argmin(values)
        least.append(values[place])
        places.append(place)
        values = jnp.where(jnp.arange(values.size) == place, jnp.inf, values)  # `at`: scattered under vmap, in vain
    return jnp.stack(least), jnp.stack(places)


def real_at(seen: Array) -> tuple[Array, Array]:
    """Between which points L [-] is real and negative, bool, and ln of the gain with which it is -1 there.

    What no gain below `MOST` brings to -1 counts for nothing: so large an L is rounding, next to poles at 1. Nor does a
    way through infinity, past a pole on the unit circle.
    """
    real, imag = seen.real, seen.imag
    share = imag[:-1] / jnp.where(imag[:-1] == imag[1:], 1.0, imag[:-1] - imag[1:])
    crossing = real[:-1] + share * (real[1:] - real[:-1])
    limit = 10.0 ** (MOST / 20.0)
    there = (imag[:-1] * imag[1:] < 0.0) & (crossing < -1.0 / limit) & (crossing > -limit) & ~_through_infinity(seen)
    return there, -jnp.log(jnp.where(there, -crossing, 1.0))


def _through_infinity(seen: Array) -> Array:
    """Between which points L [-] turns back, (points - 1,) bool, larger and larger on its way there from both sides."""
    size = jnp.abs(seen)
    grows, falls = size[1:-1] >= (1.0 - EVEN) * size[:-2], size[1:-1] >= (1.0 - EVEN) * size[2:]
    back = (seen[1:] * jnp.conj(seen[:-1])).real < 0.0
    return back & jnp.append(True, grows) & jnp.append(falls, True)


def even_at(seen: Array) -> tuple[Array, Array]:
    """Between which points |L| is 1, bool, and the phase to -1 there (-pi, pi] [rad]."""
    there, share = _even(seen)
    turned = jnp.angle(seen[1:] / seen[:-1])
    return there, jnp.angle(-seen[:-1] * jnp.exp(1j * share * turned))


def _even(seen: Array) -> tuple[Array, Array]:
    """Between which points |L| is 1, and where, as a share of the way from one to the next, by logarithms."""
    size = jnp.log(jnp.abs(seen))
    there = size[:-1] * size[1:] < 0.0
    return there, size[:-1] / jnp.where(there, size[:-1] - size[1:], 1.0)


def delay_at(w: Array, seen: Array) -> tuple[Array, Array]:
    """Delays [s] that turn L to -1 where |L| is 1, and frequencies [rad/s]; infinite where it is not, (points - 1,)."""
    there, left = even_at(seen)
    at = w[:-1] * (w[1:] / w[:-1]) ** jnp.where(there, _even(seen)[1], 0.0)
    return jnp.where(there, jnp.where(left < 0.0, left + 2.0 * jnp.pi, left) / at, jnp.inf), at


def zeros_of(values: Complex[Array, "rows points"], count: int) -> tuple[Array, Array]:
    """Near zeros of an analytic function that is real at the last point: rows and points, (count,) each, with shares.

    Those of the first rows; infinite rows where there are no more. By the argument principle: there is one between two
    rows and two points around which the function goes around zero, as it crosses the negative real axis along the four
    lines from one to the next, and at the last point where its sign changes. Two of them in one place may be missed.
    """
    x, y = values.real, values.imag.at[:, -1].set(0.0)
    above = (y >= 0.0).astype(int)

    def crossed(begin: tuple, end: tuple) -> Array:
        """1 where the line from one to the next comes from above, -1 where it comes from below, else 0."""
        way = above[begin] - above[end]
        return jnp.where(way * (x[begin] * y[end] - x[end] * y[begin]) > 0.0, way, 0)

    every, first, later = slice(None), slice(None, -1), slice(1, None)
    by_points, by_rows = crossed((every, first), (every, later)), crossed((first, every), (later, every))
    turns = by_points[:-1] + by_rows[:, 1:] - by_points[1:] - by_rows[:, :-1]
    inside = jnp.append(turns != 0, x[:-1, -1:] * x[1:, -1:] < 0.0, axis=1)
    rows, places = smallest(jnp.where(inside, jnp.arange(len(inside))[:, None], jnp.inf).reshape(-1), count)
    row, point = jnp.divmod(places, values.shape[1])
    last = point == values.shape[1] - 1
    # by a plane through three corners
    here = values[row, point]
    to_row, to_point = values[row + 1, point] - here, jnp.where(last, 1j, values[row, point + 1] - here)
    area = (jnp.conj(to_point) * to_row).imag
    area = jnp.where(area == 0.0, 1.0, area)
    by_row = -(jnp.conj(to_point) * here).imag / area
    by_point = jnp.where(last, 0.0, (jnp.conj(to_row) * here).imag / area)
    return rows + by_row.clip(0.0, 1.0), point + by_point.clip(0.0, 1.0)


def ends_at(ends: Array) -> Array:
    """Whether L [-] is real at the ends of the grid too, bool: a pole comes to 1 there, or to -1."""
    return jnp.abs(ends.imag) < REAL * jnp.abs(ends.real)


def straight(seen: Complex[Array, " points"]) -> tuple[Array, Array, Array]:
    """Nearest gain [dB], infinite without any, phase [deg] and peak of the sensitivity [dB].

    By lines between points, of the logarithm where L crosses something.
    """
    there, _ = real_at(seen)
    size, angle = jnp.log(jnp.abs(seen)), jnp.angle(-seen)
    apart = angle[:-1] - angle[1:]
    factor = -size[:-1] + angle[:-1] / jnp.where(there, apart, 1.0) * (size[:-1] - size[1:])
    ends = seen[jnp.array([0, -1])]
    real = ends_at(ends) & (ends.real < 0.0)
    factors = jnp.append(factor, -jnp.log(jnp.where(real, -ends.real, 1.0)))
    gain = jnp.min(jnp.where(jnp.append(there, real) & (factors != 0.0), jnp.abs(factors), jnp.inf))
    even, left = even_at(seen)
    phase = jnp.min(jnp.where(even, jnp.abs(left), jnp.pi))
    step = seen[1:] - seen[:-1]
    size = jnp.maximum(jnp.abs(step) ** 2, 1e-300)
    along = jnp.clip(-(jnp.conj(step) * (1.0 + seen[:-1])).real / size, 0.0, 1.0)
    near = jnp.min(jnp.abs(1.0 + seen[:-1] + along * step))
    return 20.0 / np.log(10.0) * gain, jnp.rad2deg(phase), -20.0 * jnp.log10(near)
