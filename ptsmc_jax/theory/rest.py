"""Whether the nominal run comes to rest in hold, without which the slopes at its last sample are nobody's margins.

A loop that swings by itself, such as one whose sign is too narrow for its control period, is at its border of stability
(harmonic balance), though the sign, saturated at every sample, has no slope there: of each margin nothing is left.

Looked for in the second half of the hold's whole periods, without noise and disturbance. What is no such swing is told
apart by three things: a run on its way to rest gets slower; a reference or a disturbance is slower than `SLOWEST`
samples; and what rings in a linear way, such as a flexible mode, is what slopes say it is. For the last, the command
u at the state x as it was seen is set beside that at x_0 where the error and its derivatives are zero, all else alike:
u(x_0) - u(x) - (du/dx) (x_0 - x) is zero where the slopes hold as far as the run swings.
"""

from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array

from ptsmc_jax import programs
from ptsmc_jax.batching import lapack
from ptsmc_jax.simulation import computer
from ptsmc_jax.simulation.assembly import Parts
from ptsmc_jax.theory import linear
from ptsmc_jax.theory.crossings import MOST

FEWEST = 16  # whole periods in hold, below which nothing is said
TURNS, SLOWEST = 4, 40  # times that the command turns back at least, and samples of a turn at most
STAYS = 0.75  # of the swing in the first half of what is looked at is there in the second
SHARE = 0.1  # of the swing is not what slopes say it is
ROUNDING = 1e-8  # of the largest command


class History(NamedTuple):
    """Commands of a nominal run."""

    command: Array  # (periods, m) [N m]
    in_hold: Array  # (periods,) bool: whole periods in hold


def history(parts: Parts, run: linear.Nominal) -> History:
    """The commands [N m] of a nominal run."""
    return History(run.command, linear.is_full(run.period.now, parts.period) & run.period.now.hold)


class Swing(NamedTuple):
    """How a run that does not come to rest swings, on its worst axis."""

    size: float  # of the command, from peak to peak [N m]
    periods: float  # control periods from one peak to the next


def swing(parts: Parts, seen: History | None = None) -> Swing | None:
    """How the nominal run of sampled parts swings in hold; None: it comes to rest, or slopes say how it rings.

    seen: its history, where it is known; only where the command does swing is more computed. Of a law with the exact
    sign, which always swings, margins are those without it: None.
    """
    if not np.all(np.asarray(getattr(parts.controller, "sign_width", 1.0))):
        return None
    run = None
    if seen is None:
        run = linear.nominal_jit(parts)
        seen = history(parts, run)
    u, in_hold = map(np.asarray, seen)
    whole = np.flatnonzero(in_hold)
    last = whole[whole.size // 2 :]
    if whole.size < FEWEST or not np.isfinite(u[last]).all():
        return None
    turns = _turns(np.diff(u[last], axis=0), ROUNDING * np.abs(u).max())
    suspect = turns & _stays(u[last])
    if not suspect.any():
        return None
    off, size = (np.asarray(v)[last] for v in _unexplained(parts, linear.nominal_jit(parts) if run is None else run))
    suspect &= _turns(off, SHARE * np.abs(off).max(axis=0)) & (np.ptp(off, axis=0) > SHARE * np.ptp(size, axis=0))
    if not suspect.any():
        return None
    return max(_measured(u[last, axis], off[:, axis]) for axis in np.flatnonzero(suspect))


def _measured(u: np.ndarray, off: np.ndarray) -> Swing:
    """The swing of an axis's commands (times,), of which slopes leave `off`; what is slower adds little in a turn."""
    periods = 2.0 * (off.size - 1) / float(np.count_nonzero(_reversals(off, 0.0)))
    turns = np.lib.stride_tricks.sliding_window_view(u, int(np.ceil(periods)))
    return Swing(float(np.median(np.ptp(turns, axis=1))), periods)


def _reversals(values: np.ndarray, least: Any) -> np.ndarray:
    """Where values (times,), those that are too small left out, change their sign."""
    signs = np.sign(values[np.abs(values) > least])
    return signs[1:] != signs[:-1]


def _turns(values: np.ndarray, least: Any) -> np.ndarray:
    """Which of values (times, m) change their sign often enough, (m,)."""
    least = np.broadcast_to(least, values.shape[1])
    turns = [np.count_nonzero(_reversals(v, low)) for v, low in zip(values.T, least, strict=True)]
    return np.asarray(turns) >= max(TURNS, values.shape[0] / SLOWEST)


def _stays(u: np.ndarray) -> np.ndarray:
    """Which of commands (times, m) change as much in the second half as in the first, (m,)."""
    first, second = np.array_split(np.diff(u, axis=0), 2)
    return np.linalg.norm(second, axis=0) >= STAYS * np.linalg.norm(first, axis=0)


@programs.jit(compiler_options=programs.QUICKLY)
def _unexplained(parts: Parts, run: linear.Nominal) -> tuple[Array, Array]:
    """What slopes leave of the command's way to where the error is zero, see above, and all of it, (periods, m)."""
    parts = linear.quiet(parts)
    k2, kinematics, model = parts.observer.error_bound(), parts.controller.kinematics, parts.observer.model

    def one(period: computer.Period, before: computer.Computer, seen: Any) -> tuple[Array, Array]:
        target = parts.reference(period.now.t)
        d_hat, _ = computer.estimate(parts, period, before, seen)

        def error(by: Array) -> Array:
            return kinematics.derivatives(model.retract(seen, by), target).reshape(-1)

        def commanded(by: Array) -> Array:
            return computer.command(parts, k2, period, before, model.retract(seen, by), target, d_hat)[0]

        zero = jnp.zeros(model.local_coordinates(seen, seen).size)
        # LAPACK's: written out, a body's six equations are compiled for longer than all else here
        way = -jnp.linalg.solve(jax.jacfwd(error)(zero), error(zero))
        here, sloped = jax.jvp(commanded, (zero,), (way,))
        whole = commanded(way) - here
        return whole - sloped, whole

    return lapack.vmap(one)(run.period, run.carry.computer, run.after.computer.seen)


def none_left(margins: Any, rows: Any) -> Any:
    """The `Margins` of loops, (times, m), with none left in these rows (times,) where they are not negative anyway."""
    values = jax.tree.map(np.asarray, margins)
    lost = np.asarray(rows)[:, None] & values.stable
    none = dict.fromkeys(values._fields, 0.0) | {"modulus": MOST, "stable": False, "crossover": np.nan}
    return values._replace(**{name: np.where(lost, none[name], getattr(values, name)) for name in values._fields})
