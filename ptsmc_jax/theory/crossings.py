"""Frequency response of an opened loop on a grid, and the grid intervals that contain the crossings of the margins.

A Schur decomposition makes A triangular. Each solution with z I - A is then a substitution, state by state, for all
grid points at once. Read `frequency_grid` and `find_brackets` first.
"""

from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, ArrayLike, Complex, Float

from ptsmc_jax.theory.linear import Opening

LOWEST, POINTS = 1e-6, 240  # Lowest grid frequency as a fraction of the Nyquist frequency; grid size without poles.
# offsets of grid points from a pole, in units of the pole's damping
POLE_OFFSETS = np.array([-3.0, -1.0, -0.3, 0.3, 1.0, 3.0])
NEAREST = 3  # Number of crossings of each kind that are refined.
KIND_ENDS = (2 * NEAREST, 3 * NEAREST)  # Indices that split the crossings: L real, |L| = 1, L nearest to -1.
REAL_TOLERANCE = 1e-2  # L counts as real at an end of the grid if |Im L / Re L| is smaller.
EQUAL_TOLERANCE = 1e-6  # Relative differences of |L| below this count as zero, for grid points that coincide.
CHUNK = 64  # Number of grid points in one evaluation of L, small enough for the processor's cache.
LARGEST_MARGIN = 100.0  # dB. Larger gain margins count as infinite; peak sensitivity reported for an unstable loop.


def poles_of(opening: Opening) -> Complex[Array, "loops n"]:
    """Return the poles [-] of the closed loop, then of the loops with one axis open.

    The sensitivity may peak near the poles of the closed loop, and L of an axis near those of the loop open there.
    """
    m = opening.c.shape[0]
    closed_axes = jnp.asarray(np.append(np.ones((1, m)), 1.0 - np.eye(m), axis=0))
    return jax.lax.map(lambda gains: jnp.linalg.eigvals(opening.closed(jnp.diag(gains))), closed_axes)


def frequency_grid(poles: Complex[Array, "loops n"], h: Any) -> Float[Array, " points"]:
    """Return grid frequencies [rad/s] for a period h [s], denser toward 0, the Nyquist frequency and the poles."""
    low = np.geomspace(LOWEST, 0.5, POINTS // 2, endpoint=False)
    high = 1.0 - np.append(0.5 * np.geomspace(1.0, 1e-4, POINTS // 4), 0.0)
    base = np.unique(np.concatenate([low, np.linspace(0.05, 0.95, POINTS // 4), high]))
    upper = jnp.argsort(-poles.imag, axis=1)[:, : (poles.shape[1] + 1) // 2]  # one pole of each conjugate pair
    poles = jnp.take_along_axis(poles, upper, axis=1).reshape(-1)
    damping = jnp.clip(jnp.abs(jnp.log(jnp.maximum(jnp.abs(poles), 1e-12))) / jnp.pi, LOWEST, 1.0)
    near_poles = jnp.abs(jnp.angle(poles))[None] / jnp.pi + POLE_OFFSETS[:, None] * damping[None]
    frequencies = jnp.append(jnp.asarray(base), jnp.clip(jnp.nan_to_num(near_poles), LOWEST, 1.0))
    return jnp.sort(frequencies) * jnp.pi / h


class SchurOpening(NamedTuple):
    """State space of an opened loop in Schur coordinates, for fast evaluation at many z. Gradients are stopped."""

    opening: Opening  # With a triangular A.
    axes: Array  # (n, n) unitary, with the Schur vectors as columns.

    def resolvent_products(self, z: Complex[Array, " points"]) -> tuple[Array, Array]:
        """Return X = (z I - A)^-1 B and Y' of Y = C (z I - A)^-1, (n, m, points) each, in Schur coordinates."""
        a, n = self.opening.a, self.opening.a.shape[0]

        def substitute(off_diagonal: Array, b: Array, *, up: bool) -> Array:
            """Return (z I - A)^-1 b by substitution, for all points at once; off_diagonal: A without its diagonal."""

            def eliminate(k: Array, x: Array) -> Array:
                i = n - 1 - k if up else k
                solution = x[i] / (z - a[i, i])[None]  # substitution by columns is three times as fast as by rows
                return (x + off_diagonal[:, i][:, None, None] * solution[None]).at[i].set(solution)

            return jax.lax.fori_loop(0, n, eliminate, jnp.broadcast_to(b[:, :, None] + 0j, (*b.shape, z.size)))

        off_diagonal = jnp.triu(a, 1)
        return substitute(off_diagonal, self.opening.b, up=True), substitute(off_diagonal.T, self.opening.c.T, up=False)

    def response(self, z: Complex[Array, " points"]) -> tuple[Array, Array]:
        """Return L [-] at many z and its derivative by z, (points, m, m) each."""
        x, y = self.resolvent_products(z)
        return -jnp.einsum("kn,nmp->pkm", self.opening.c, x), jnp.einsum("nkp,nmp->pkm", y, x)

    def response_in_chunks(self, z: Complex[Array, " points"]) -> Complex[Array, "points m m"]:
        """Return L [-] at any number of z, evaluated in chunks of `CHUNK` points."""
        chunks = jnp.resize(z, (-(-z.size // CHUNK), CHUNK))
        responses = jax.lax.map(lambda z: self.response(z)[0], chunks)
        return responses.reshape(-1, *responses.shape[2:])[: z.size]


def schur_form(a: ArrayLike) -> tuple[Array, Array]:
    """Return the complex Schur form of a matrix and its unitary basis, (n, n) each. Gradients are stopped."""
    upper, axes = jax.scipy.linalg.schur(jax.lax.stop_gradient(a), output="complex")
    return upper, axes


def in_schur_coordinates(opening: Opening, schur: tuple[Array, Array] | None = None) -> SchurOpening:
    """Transform the state space of an opened loop L [-] to Schur coordinates, where A is triangular.

    Args:
        opening: the opened loop.
        schur: result of `schur_form` for its A, or None to compute it.
    """
    fixed = jax.lax.stop_gradient(opening)
    a, axes = schur or schur_form(fixed.a)
    return SchurOpening(Opening(a, jnp.conj(axes.T) @ fixed.b, fixed.c @ axes), axes)


def response(opening: Opening, schur: SchurOpening, z: Complex[Array, " points"]) -> tuple[Array, Array]:
    """Return L [-] at many z and its derivative by z, (points, m, m) each. L has gradients by `opening`.

    L = Y (z X - A X - B) - C X with X and Y of `SchurOpening.resolvent_products`, whose gradients are stopped. The
    bracket is zero for an exact X. Therefore L depends on errors of X and Y, and on their gradients, only in second
    order.

    Args:
        opening: the opened loop.
        schur: the same loop in Schur coordinates.
        z: points e^(i w h).
    """
    x, y = jax.lax.stop_gradient(schur.resolvent_products(z))
    x = jnp.einsum("ij,jmp->imp", schur.axes, x)
    y = jnp.einsum("ij,jmp->imp", jnp.conj(schur.axes), y)
    residual = z[None, None] * x - jnp.einsum("ij,jmp->imp", opening.a, x) - opening.b[:, :, None]
    L = jnp.einsum("nkp,nmp->pkm", y, residual) - jnp.einsum("kn,nmp->pkm", opening.c, x)
    return L, jnp.einsum("nkp,nmp->pkm", y, x)


@jax.jit
def axis_response(response: Complex[Array, "m m"], axis: Any) -> Complex[Array, ""]:
    """Return L [-] of one axis with all other axes closed.

    The function closes the other axes one after the other. Closing axis j subtracts L e_j e_j' L / (1 + L_jj) from L.
    This loop compiles much faster than the solution of a linear system.
    """
    unit_vectors = jnp.eye(response.shape[0])
    selected = unit_vectors[axis]

    def close_axis(L: Array, other: Array) -> tuple[Array, None]:
        column, row = L @ other, other @ L
        gain = jnp.where(other @ selected > 0.0, 0.0, 1.0 / (1.0 + row @ other))
        return L - gain * column[:, None] * row[None], None

    return selected @ jax.lax.scan(close_axis, response, unit_vectors)[0] @ selected


def axis_responses(response: Complex[Array, "points m m"]) -> Complex[Array, "points m"]:
    """Return L [-] of every axis with the other axes closed, at many points."""
    axes = jnp.arange(response.shape[1])
    return jax.vmap(jax.vmap(axis_response, (None, 0)), (0, None))(response, axes)


class Brackets(NamedTuple):
    """Grid intervals with crossings, (places,): `NEAREST` intervals of each of four kinds.

    The kinds are: L real and -1 with more gain; L real and -1 with less gain; |L| = 1; |1 + L| smallest. If there are
    fewer crossings of a kind, the remaining entries have `exists` = False.
    """

    low: Array  # [rad/s] Lower end.
    high: Array  # [rad/s] Upper end.
    at_low: Array  # Value at the lower end of the function with a zero in the interval: `sine`, ln |L|, d|1 + L|^2/dw.
    at_high: Array  # Value of this function at the upper end.
    exists: Array  # bool
    further: Array  # [rad/s] Further frequencies to evaluate: the grid point with L nearest to -1, and both ends.


def find_brackets(w: Array, L: Array) -> Brackets:
    """Return the grid intervals that contain crossings of L of one axis, see `Brackets`.

    Args:
        w: grid frequencies (points,) [rad/s], ascending.
        L: values of L at these frequencies (points,) [-].
    """
    phase_sine, size, distance = sine(L), jnp.log(jnp.abs(L)), jnp.abs(1.0 + L) ** 2
    real, factor = real_axis_crossings(L)
    # the tolerance of 0.1 keeps crossings near -1, because refinement may move them to the other side of -1
    more, less = (jnp.where(real & (side * factor > -0.1), side * factor, jnp.inf) for side in (1.0, -1.0))
    unit_gain, phase = unit_gain_crossings(L)
    is_minimum = (distance[1:-1] <= distance[:-2]) & (distance[1:-1] <= distance[2:])
    nearest = jnp.append(jnp.inf, jnp.where(is_minimum, distance[1:-1], jnp.inf))
    distances = (more, less, jnp.where(unit_gain, jnp.abs(phase), jnp.inf), nearest)
    values, places = zip(*map(smallest_values, distances), strict=True)
    j, k = jnp.concatenate(places[:3]), jnp.maximum(places[3], 1)
    derivative = (distance[1:] - distance[:-1]) / jnp.where(w[1:] == w[:-1], 1.0, w[1:] - w[:-1]) / 2

    def crossing_values(indices: Array) -> Array:
        return jnp.append(phase_sine[indices][: KIND_ENDS[0]], size[indices][KIND_ENDS[0] :])

    return Brackets(
        low=jnp.append(w[j], w[k - 1]),
        high=jnp.append(w[j + 1], w[k + 1]),
        at_low=jnp.append(crossing_values(j), derivative[k - 1]),
        at_high=jnp.append(crossing_values(j + 1), derivative[k]),
        exists=jnp.isfinite(jnp.concatenate(values)),
        further=w[jnp.stack([jnp.argmin(distance), 0, -1])],
    )


def sine(L: Array) -> Array:
    """Return the sine of the phase of L [-]. Like Im L it is zero for a real L, but it stays bounded near a pole."""
    size = jnp.abs(L)
    return L.imag / jnp.where(size > 0.0, size, 1.0)


def smallest_values(values: Array, count: int = NEAREST) -> tuple[Array, Array]:
    """Return the `count` smallest values, in ascending order, and their indices. Faster than sorting all values."""
    smallest, places = [], []
    for _ in range(count):
        place = jnp.argmin(values)
        smallest.append(values[place])
        places.append(place)
        values = jnp.where(jnp.arange(values.size) == place, jnp.inf, values)  # `.at[]` is a slow scatter under vmap
    return jnp.stack(smallest), jnp.stack(places)


def real_axis_crossings(L: Array) -> tuple[Array, Array]:
    """Return which intervals have a crossing of the negative real axis by L [-], and ln of the gain that makes L = -1.

    Crossings that need a gain change of more than `LARGEST_MARGIN` are ignored. They result from rounding errors near
    poles at 1. Sign changes of Im L at a pole on the unit circle, where L is infinite, are ignored as well.
    """
    real, imag = L.real, L.imag
    fraction = imag[:-1] / jnp.where(imag[:-1] == imag[1:], 1.0, imag[:-1] - imag[1:])
    crossing = real[:-1] + fraction * (real[1:] - real[:-1])
    limit = 10.0 ** (LARGEST_MARGIN / 20.0)
    crosses = (imag[:-1] * imag[1:] < 0.0) & (crossing < -1.0 / limit) & (crossing > -limit) & ~_has_pole_on_circle(L)
    return crosses, -jnp.log(jnp.where(crosses, -crossing, 1.0))


def _has_pole_on_circle(L: Array) -> Array:
    """Return which intervals have a pole on the unit circle, (points - 1,) bool.

    There |L| grows toward the interval from both sides, and the phase of L jumps by more than 90 deg.
    """
    size = jnp.abs(L)
    grows, falls = size[1:-1] >= (1.0 - EQUAL_TOLERANCE) * size[:-2], size[1:-1] >= (1.0 - EQUAL_TOLERANCE) * size[2:]
    jumps = (L[1:] * jnp.conj(L[:-1])).real < 0.0
    return jumps & jnp.append(True, grows) & jnp.append(falls, True)


def unit_gain_crossings(L: Array) -> tuple[Array, Array]:
    """Return which intervals have a crossing of |L| = 1, and the angle from -1 to L there, in (-pi, pi] [rad]."""
    crosses, fraction = _interpolate_unit_gain(L)
    phase_step = jnp.angle(L[1:] / L[:-1])
    return crosses, jnp.angle(-L[:-1] * jnp.exp(1j * fraction * phase_step))


def _interpolate_unit_gain(L: Array) -> tuple[Array, Array]:
    """Return which intervals have a crossing of |L| = 1, and its place as a fraction, by interpolation of ln |L|."""
    size = jnp.log(jnp.abs(L))
    crosses = size[:-1] * size[1:] < 0.0
    return crosses, size[:-1] / jnp.where(crosses, size[:-1] - size[1:], 1.0)


def crossing_delays(w: Array, L: Array) -> tuple[Array, Array]:
    """Return delays [s] that rotate L to -1 if |L| crosses 1 in an interval, else infinity, (points - 1,).

    The second result is the frequency of each crossing [rad/s].
    """
    crosses, angle = unit_gain_crossings(L)
    frequency = w[:-1] * (w[1:] / w[:-1]) ** jnp.where(crosses, _interpolate_unit_gain(L)[1], 0.0)
    return jnp.where(crosses, jnp.where(angle < 0.0, angle + 2.0 * jnp.pi, angle) / frequency, jnp.inf), frequency


def find_zeros(values: Complex[Array, "rows points"], count: int) -> tuple[Array, Array]:
    """Return approximate zeros of an analytic function on a grid: fractional row and point, (count,) each.

    The search applies the argument principle to every cell of the grid. A cell contains a zero if the values at its
    four corners wind around zero, which shows in the crossings of the negative real axis. At the last point the values
    are real, and a sign change between rows is a zero. Two zeros in one cell may be missed.

    Args:
        values: the function on the grid, real at the last point.
        count: number of zeros to return, those in the first rows. The row is infinite if there are fewer zeros.
    """
    x, y = values.real, values.imag.at[:, -1].set(0.0)
    above = (y >= 0.0).astype(int)

    def count_crossing(begin: tuple, end: tuple) -> Array:
        """Return 1 (-1) if the line between two points crosses the negative real axis from above (below), else 0."""
        direction = above[begin] - above[end]
        return jnp.where(direction * (x[begin] * y[end] - x[end] * y[begin]) > 0.0, direction, 0)

    every, but_last, but_first = slice(None), slice(None, -1), slice(1, None)
    by_points = count_crossing((every, but_last), (every, but_first))
    by_rows = count_crossing((but_last, every), (but_first, every))
    winding = by_points[:-1] + by_rows[:, 1:] - by_points[1:] - by_rows[:, :-1]
    inside = jnp.append(winding != 0, x[:-1, -1:] * x[1:, -1:] < 0.0, axis=1)
    rows, places = smallest_values(jnp.where(inside, jnp.arange(len(inside))[:, None], jnp.inf).reshape(-1), count)
    row, point = jnp.divmod(places, values.shape[1])
    last = point == values.shape[1] - 1
    # linear interpolation from three corners of the cell
    corner = values[row, point]
    to_row, to_point = values[row + 1, point] - corner, jnp.where(last, 1j, values[row, point + 1] - corner)
    area = (jnp.conj(to_point) * to_row).imag
    area = jnp.where(area == 0.0, 1.0, area)
    by_row = -(jnp.conj(to_point) * corner).imag / area
    by_point = jnp.where(last, 0.0, (jnp.conj(to_row) * corner).imag / area)
    return rows + by_row.clip(0.0, 1.0), point + by_point.clip(0.0, 1.0)


def is_real_at_ends(ends: Array) -> Array:
    """Return whether L [-] is real at each end of the grid, bool. A gain can then move a pole to 1 or to -1."""
    return jnp.abs(ends.imag) < REAL_TOLERANCE * jnp.abs(ends.real)


def margins_on_grid(L: Complex[Array, " points"]) -> tuple[Array, Array, Array]:
    """Return gain margin [dB] (infinite if there is none), phase margin [deg] and peak sensitivity [dB] of a grid.

    The function interpolates between grid points: crossings in ln L, the distance to -1 along straight lines.
    """
    crosses, _ = real_axis_crossings(L)
    size, angle = jnp.log(jnp.abs(L)), jnp.angle(-L)
    phase_step = angle[:-1] - angle[1:]
    factor = -size[:-1] + angle[:-1] / jnp.where(crosses, phase_step, 1.0) * (size[:-1] - size[1:])
    ends = L[jnp.array([0, -1])]
    real = is_real_at_ends(ends) & (ends.real < 0.0)
    factors = jnp.append(factor, -jnp.log(jnp.where(real, -ends.real, 1.0)))
    gain = jnp.min(jnp.where(jnp.append(crosses, real) & (factors != 0.0), jnp.abs(factors), jnp.inf))
    unit_gain, angle_from_minus_one = unit_gain_crossings(L)
    phase = jnp.min(jnp.where(unit_gain, jnp.abs(angle_from_minus_one), jnp.pi))
    step = L[1:] - L[:-1]
    size = jnp.maximum(jnp.abs(step) ** 2, 1e-300)
    fraction = jnp.clip(-(jnp.conj(step) * (1.0 + L[:-1])).real / size, 0.0, 1.0)
    nearest = jnp.min(jnp.abs(1.0 + L[:-1] + fraction * step))
    return 20.0 / np.log(10.0) * gain, jnp.rad2deg(phase), -20.0 * jnp.log10(nearest)
