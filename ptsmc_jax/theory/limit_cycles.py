"""Detection of limit cycles in the hold phase of the nominal run. Linearised margins are meaningless there.

A limit cycle occurs, for example, if the boundary layer is too thin for the control period. By harmonic balance the
loop is then at its stability limit, and all its margins are zero. The linearisation does not show this, because the
derivative of the saturated sign is zero at every sample.

`find`, which is the function to read first, examines the second half of the full periods in the hold phase, without
noise and disturbance. Three criteria exclude other motions:

- A run that converges gets slower.
- A reference or a disturbance reverses less often than once in `SLOWEST` samples.
- The linearisation explains a linear oscillation, such as a flexible mode.

The third criterion compares the command u at the seen state x with the command at the state x_0 of zero error, all else
equal. The residual u(x_0) - u(x) - (du/dx) (x_0 - x) is zero if the linearisation is valid over the amplitude.
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

FEWEST = 16  # Smallest number of full hold periods for a decision.
TURNS, SLOWEST = 4, 40  # Smallest number of reversals of the command, and largest number of samples between them.
STAYS = 0.75  # Smallest ratio of the command's variation in the second half of the examined periods to the first half.
NONLINEAR = 0.1  # Smallest nonlinear fraction of a limit cycle: residual relative to the change of the command.
ROUNDING = 1e-8  # Rounding error, relative to the largest command.


class History(NamedTuple):
    """Commands of a nominal run in each control period."""

    command: Array  # (periods, m) [N m]
    in_hold: Array  # (periods,) bool: full periods in the hold phase


def history(parts: Parts, run: linear.Nominal) -> History:
    """Return the commands [N m] of a nominal run."""
    return History(run.command, linear.is_full(run.period.now, parts.period) & run.period.now.hold)


class LimitCycle(NamedTuple):
    """Limit cycle of the command, on the axis with the largest amplitude."""

    size: float  # peak-to-peak amplitude of the command [N m]
    periods: float  # period of the limit cycle in control periods


def find(parts: Parts, seen: History | None = None) -> LimitCycle | None:
    """Return the limit cycle of the nominal run in the hold phase, or None.

    The result is None if the run converges or oscillates linearly. It is also None for a law with a discontinuous sign,
    which always chatters: its margins ignore the switching term.

    Args:
        parts: the sampled scenario.
        seen: commands of the nominal run, if known. The nominal run is then only simulated if the command oscillates.
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
    turns = _oscillates(np.diff(u[last], axis=0), ROUNDING * np.abs(u).max())
    suspect = turns & _stays(u[last])
    if not suspect.any():
        return None
    run = linear.nominal_jit(parts) if run is None else run
    off, size = (np.asarray(v)[last] for v in _nonlinear_residual(parts, run))
    suspect &= _oscillates(off, NONLINEAR * np.abs(off).max(axis=0))
    suspect &= np.ptp(off, axis=0) > NONLINEAR * np.ptp(size, axis=0)
    if not suspect.any():
        return None
    return max(_measured(u[last, axis], off[:, axis]) for axis in np.flatnonzero(suspect))


def _measured(u: np.ndarray, off: np.ndarray) -> LimitCycle:
    """Return the limit cycle of one axis.

    The amplitude is the median over windows of one cycle, so that slower motions contribute little.

    Args:
        u: commands of the axis (times,) [N m].
        off: part of the commands that the linearisation does not explain (times,) [N m].
    """
    periods = 2.0 * (off.size - 1) / float(np.count_nonzero(_reversals(off, 0.0)))
    turns = np.lib.stride_tricks.sliding_window_view(u, int(np.ceil(periods)))
    return LimitCycle(float(np.median(np.ptp(turns, axis=1))), periods)


def _reversals(values: np.ndarray, least: Any) -> np.ndarray:
    """Return the sign changes of values (times,), ignoring values of at most `least` in size."""
    signs = np.sign(values[np.abs(values) > least])
    return signs[1:] != signs[:-1]


def _oscillates(values: np.ndarray, least: Any) -> np.ndarray:
    """Return which columns of values (times, m) change their sign often enough to be a limit cycle, (m,) bool."""
    least = np.broadcast_to(least, values.shape[1])
    turns = [np.count_nonzero(_reversals(v, low)) for v, low in zip(values.T, least, strict=True)]
    return np.asarray(turns) >= max(TURNS, values.shape[0] / SLOWEST)


def _stays(u: np.ndarray) -> np.ndarray:
    """Return which commands (times, m) vary nearly as much in the second half as in the first, (m,)."""
    first, second = np.array_split(np.diff(u, axis=0), 2)
    return np.linalg.norm(second, axis=0) >= STAYS * np.linalg.norm(first, axis=0)


@programs.jit(compiler_options=programs.QUICKLY)
def _nonlinear_residual(parts: Parts, run: linear.Nominal) -> tuple[Array, Array]:
    """Return the nonlinear residual of the command, see the module docstring, and u(x_0) - u(x), (periods, m) each."""
    parts = linear.quiet(parts)
    k2, kinematics, model = parts.observer.error_bound(), parts.controller.kinematics, parts.observer.model

    def in_period(period: computer.Period, before: computer.Computer, seen: Any) -> tuple[Array, Array]:
        target = parts.reference(period.now.t)
        d_hat, _ = computer.estimate(parts, period, before, seen)

        def error_derivatives(z: Array) -> Array:
            """Return eps and its derivatives at local coordinates z of the measured state."""
            return kinematics.derivatives(model.retract(seen, z), target).reshape(-1)

        def command(z: Array) -> Array:
            return computer.command(parts, k2, period, before, model.retract(seen, z), target, d_hat)[0]

        zero = jnp.zeros(model.local_coordinates(seen, seen).size)
        # LAPACK, because `matrices.solve` of six equations takes longer to compile than everything else here
        to_zero_error = -jnp.linalg.solve(jax.jacfwd(error_derivatives)(zero), error_derivatives(zero))
        here, linear_change = jax.jvp(command, (zero,), (to_zero_error,))
        change = command(to_zero_error) - here
        return change - linear_change, change

    return lapack.vmap(in_period)(run.period, run.carry.computer, run.after.computer.seen)


def without_margins(margins: Any, rows: Any) -> Any:
    """Set the margins of the marked rows to zero, because of a limit cycle. Negative margins do not change.

    Args:
        margins: `Margins` of loops, (times, m).
        rows: which rows to change, bool (times,).
    """
    values = jax.tree.map(np.asarray, margins)
    lost = np.asarray(rows)[:, None] & values.stable
    none = dict.fromkeys(values._fields, 0.0) | {"peak_sensitivity": MOST, "stable": False, "crossover": np.nan}
    return values._replace(**{name: np.where(lost, none[name], getattr(values, name)) for name in values._fields})
