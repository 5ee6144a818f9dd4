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
from ptsmc_jax.theory.crossings import LARGEST_MARGIN

FEWEST_PERIODS = 16  # Smallest number of full hold periods for a decision.
FEWEST_REVERSALS = 4  # Smallest number of reversals of the command.
SLOWEST = 40  # Largest mean number of samples between two reversals.
SUSTAINED = 0.75  # Smallest ratio of the command's variation in the second half of the examined periods to the first.
NONLINEAR = 0.1  # Smallest ratio of the residual (module docstring) to u(x_0) - u(x), peak to peak, of a limit cycle.
ROUNDING = 1e-8  # Rounding error of commands, relative to the largest command.


class History(NamedTuple):
    """Commands of a nominal run in each control period."""

    command: Array  # (periods, m) [N m]
    in_hold: Array  # (periods,) bool: whether a period has the full length and begins in the hold phase


def command_history(parts: Parts, run: linear.NominalRun) -> History:
    """Return the commands [N m] of a nominal run."""
    return History(run.command, linear.is_full(run.period.now, parts.period) & run.period.now.hold)


class LimitCycle(NamedTuple):
    """Limit cycle of the command, on the axis with the largest amplitude."""

    size: float  # peak-to-peak amplitude of the command [N m]
    periods: float  # period of the limit cycle in control periods


def find(parts: Parts, commands: History | None = None) -> LimitCycle | None:
    """Return the limit cycle of the nominal run in the hold phase, or None.

    The result is None if the run converges or oscillates linearly. It is also None for a law with a discontinuous sign,
    which always chatters: its margins ignore the switching term.

    Args:
        parts: the sampled scenario.
        commands: commands of the nominal run, or None to simulate it. If they are given, this function simulates the
            nominal run only if the command oscillates.
    """
    if not np.all(np.asarray(getattr(parts.controller, "sign_width", 1.0))):
        return None
    run = None
    if commands is None:
        run = linear.simulate_nominal_jit(parts)
        commands = command_history(parts, run)
    u, in_hold = map(np.asarray, commands)
    hold_periods = np.flatnonzero(in_hold)
    examined = hold_periods[hold_periods.size // 2 :]
    if hold_periods.size < FEWEST_PERIODS or not np.isfinite(u[examined]).all():
        return None
    oscillating = _is_oscillating(np.diff(u[examined], axis=0), ROUNDING * np.abs(u).max())
    suspect = oscillating & _is_sustained(u[examined])
    if not suspect.any():
        return None
    run = linear.simulate_nominal_jit(parts) if run is None else run
    residual, change = (np.asarray(v)[examined] for v in _nonlinear_residual(parts, run))
    suspect &= _is_oscillating(residual, NONLINEAR * np.abs(residual).max(axis=0))
    suspect &= np.ptp(residual, axis=0) > NONLINEAR * np.ptp(change, axis=0)
    if not suspect.any():
        return None
    return max(_measure_cycle(u[examined, axis], residual[:, axis]) for axis in np.flatnonzero(suspect))


def _measure_cycle(u: np.ndarray, residual: np.ndarray) -> LimitCycle:
    """Return the limit cycle of one axis.

    The amplitude is the median over windows of one cycle, so that slower motions contribute little.

    Args:
        u: commands of the axis (times,) [N m].
        residual: part of the commands that the linearisation does not explain (times,) [N m].
    """
    periods = 2.0 * (residual.size - 1) / float(np.count_nonzero(_sign_changes(residual, 0.0)))
    cycles = np.lib.stride_tricks.sliding_window_view(u, int(np.ceil(periods)))
    return LimitCycle(float(np.median(np.ptp(cycles, axis=1))), periods)


def _sign_changes(values: np.ndarray, threshold: Any) -> np.ndarray:
    """Remove values (times,) of at most `threshold` in size. Return whether each sign differs from the next, bool."""
    signs = np.sign(values[np.abs(values) > threshold])
    return signs[1:] != signs[:-1]


def _is_oscillating(values: np.ndarray, threshold: Any) -> np.ndarray:
    """Return which columns of values (times, m) change their sign often enough to be a limit cycle, (m,) bool."""
    threshold = np.broadcast_to(threshold, values.shape[1])
    reversals = [np.count_nonzero(_sign_changes(v, low)) for v, low in zip(values.T, threshold, strict=True)]
    return np.asarray(reversals) >= max(FEWEST_REVERSALS, values.shape[0] / SLOWEST)


def _is_sustained(u: np.ndarray) -> np.ndarray:
    """Return which commands (times, m) vary nearly as much in the second half as in the first, (m,)."""
    first, second = np.array_split(np.diff(u, axis=0), 2)
    return np.linalg.norm(second, axis=0) >= SUSTAINED * np.linalg.norm(first, axis=0)


@programs.jit(compiler_options=programs.FAST_COMPILE)
def _nonlinear_residual(parts: Parts, run: linear.NominalRun) -> tuple[Array, Array]:
    """Return the nonlinear residual of the command, see the module docstring, and u(x_0) - u(x), (periods, m) each."""
    parts = linear.quiet(parts)
    k2, kinematics, model = parts.observer.error_bound(), parts.controller.kinematics, parts.observer.model

    def residual_in_period(period: computer.Period, before: computer.Computer, seen: Any) -> tuple[Array, Array]:
        target = parts.reference(period.now.t)
        d_hat, _ = computer.estimate(parts, period, before, seen)
        sample = period.sample(before.law)

        def error_derivatives(z: Array) -> Array:
            """Return eps and its derivatives at local coordinates z of the measured state."""
            return kinematics.derivatives(model.retract(seen, z), target).reshape(-1)

        def command(z: Array) -> Array:
            return parts.controller(sample, model.retract(seen, z), target, d_hat, k2(sample.t))[0]

        zero = jnp.zeros(model.local_coordinates(seen, seen).size)
        # LAPACK, because `matrices.solve` of six equations takes longer to compile than everything else here
        to_zero_error = -jnp.linalg.solve(jax.jacfwd(error_derivatives)(zero), error_derivatives(zero))
        command_here, linear_change = jax.jvp(command, (zero,), (to_zero_error,))
        change = command(to_zero_error) - command_here
        return change - linear_change, change

    return lapack.vmap(residual_in_period)(run.period, run.carry.computer, run.after.computer.seen)


def zero_margins(margins: Any, rows: Any) -> Any:
    """Set the margins of the marked rows to zero, because of a limit cycle. Negative margins do not change.

    Args:
        margins: `Margins` of loops, (times, m).
        rows: which rows to change, bool (times,).
    """
    values = jax.tree.map(np.asarray, margins)
    set_to_zero = np.asarray(rows)[:, None] & values.stable
    not_zero = {"peak_sensitivity": LARGEST_MARGIN, "stable": False, "crossover": np.nan}
    new = dict.fromkeys(values._fields, 0.0) | not_zero
    return values._replace(**{name: np.where(set_to_zero, new[name], getattr(values, name)) for name in new})
