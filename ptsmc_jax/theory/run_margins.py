"""Margins along the nominal run of a sampled loop: in the hold phase, and in the approach phase with frozen gains.

Read `margins_along_run` first. It is the function behind `ptsmc margins`.
"""

from typing import NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float

from ptsmc_jax import programs
from ptsmc_jax.batching import lapack
from ptsmc_jax.numerics.pytrees import Scalar
from ptsmc_jax.simulation import rollout
from ptsmc_jax.simulation.assembly import Parts
from ptsmc_jax.theory import limit_cycles, linear, margins
from ptsmc_jax.theory.limit_cycles import History, command_history
from ptsmc_jax.theory.linear import Loop
from ptsmc_jax.theory.margins import Margins

# shortest time to go at which margins are computed, in periods; gains then change by a tenth in a period
SHORTEST = 10
TIMES = 4  # number of times to go at which margins are computed
FURTHER_TIMES = 24  # number of further times to go of `margins_along_run`
LONGEST = 0.25  # longest time to go at which margins are computed, as a fraction of t_f


class Course(NamedTuple):
    """Margins along a nominal run."""

    t: np.ndarray  # (times,) [s] The last is in the hold phase, the others are before the hand-over.
    judged: np.ndarray  # (times,) bool: whether the loop with frozen gains is meaningful, see `judged_times`.
    loops: Loop  # The first axis of all arrays is the time.
    at_input: Margins  # (times, m) Margins of the loop opened at each input.
    at_sensors: Margins  # (k,) Margins of the loop opened at each measured signal, in the hold phase.
    together: dict[str, float]  # Margins in the hold phase if gain, phase or delay changes equally in all inputs.
    singularity_distance: float  # Smallest distance to the singularity, in the unit of `rollout.SINGULAR_DISTANCE`.
    not_converged: bool  # Whether the run has not converged at t_f, see `rollout.is_not_converged`.
    limit_cycle: limit_cycles.LimitCycle | None = None  # Limit cycle in the hold phase, if there is one.

    @property
    def hold(self) -> tuple[Loop, Margins]:
        """The loop in the hold phase, and its margins (m,)."""
        return jax.tree.map(lambda v: v[-1], (self.loops, self.at_input))

    @property
    def before_hand_over(self) -> Margins:
        """The margins before the hand-over, (times, m)."""
        return jax.tree.map(lambda v: v[:-1], self.at_input)

    def worst(self) -> dict[str, float]:
        """Return the worst of each of `catalogues.MARGINS` over the axes, the judged times and the hold phase."""
        where_judged = jax.tree.map(lambda v: v[self.judged], self.at_input)
        return {name: float(v) for name, v in where_judged.worst().items()}


def judged_times(parts: Parts) -> Float[Array, " times"]:
    """Return times to go [s] at which a loop with frozen gains is meaningful, shortest first, logarithmically spaced.

    The shortest is at the hand-over, where gains are largest, but at least `SHORTEST` periods. The gains then change by
    at most a tenth from one sample to the next. The longest is the fraction `LONGEST` of t_f. With the
    prescribed-time law, the settling time of a loop with frozen gains is about 4 / (eta - 1/2) times the time to go.
    The times are differentiable by t_f and delta.
    """
    law = parts.controller
    shortest = jnp.maximum(law.delta, SHORTEST * parts.period)
    longest = jnp.maximum(LONGEST * law.t_f, shortest)
    return shortest * (longest / shortest) ** (jnp.arange(TIMES) / (TIMES - 1))


def find_period_indices(parts: Parts, run: linear.NominalRun, times: Array) -> Array:
    """Return the indices of the full control periods nearest to some times to go, and of one period in the hold phase.

    The period in the hold phase is the last period of the run. If the loop diverges, it is the last period that starts
    with at most twice the error at the hand-over. If loops are averaged over several periods, the period is late enough
    that all of them are in the hold phase, unless the run is too short. If there is no full period before the
    hand-over, every index is the index of the period in the hold phase.

    Args:
        parts: the sampled scenario.
        run: its nominal run.
        times: times to go (times,) [s].

    Returns:
        Indices into the periods of `run`, (times + 1,). The last one is in the hold phase.
    """
    ticks, law = run.period.now, parts.controller
    full = linear.is_full(ticks, parts.period)
    errors = lapack.vmap(lambda x, t: law.kinematics.errors(x, parts.reference(t))[0])(run.carry.x, ticks.t)
    error_norm, hold = jnp.linalg.norm(errors, axis=1), full & ticks.hold
    first = jnp.argmax(hold)
    is_near = hold & (error_norm <= 2.0 * error_norm[first])
    last_near, end = (jnp.max(jnp.where(candidates, jnp.arange(hold.size), first)) for candidates in (is_near, hold))
    last = jnp.maximum(last_near, jnp.minimum(first + linear.averaging_periods(parts) - 1, end))
    before = full & ~law.in_hold(ticks.t, ticks.t_next, ticks.hold)
    time_to_go = jnp.where(before, law.t_f - ticks.t, jnp.inf)
    nearest = jnp.argmin(jnp.abs(time_to_go[None] - times[:, None]), axis=1)
    return jnp.append(jnp.where(jnp.any(before), nearest, last), last)


_find_period_indices_jit = programs.jit(find_period_indices)


class TimedMargins(NamedTuple):
    """Margins at several times of a nominal run. The last time is in the hold phase."""

    t: np.ndarray  # (times,) [s]
    hold: np.ndarray  # (times,) bool: whether the time is in the hold phase
    loops: Loop  # the first axis of all arrays is the time
    margins: Margins  # (times, m)


def margins_at(parts: Parts, times_to_go: Float[Array, " times"], run: linear.NominalRun) -> TimedMargins:
    """Return the margins at some times to go and in the hold phase.

    Args:
        parts: the sampled scenario.
        times_to_go: times to go (times,) [s].
        run: its nominal run.
    """
    indices = np.asarray(_find_period_indices_jit(parts, run, times_to_go))
    loops = linear.open_loops(parts, run, indices)
    ticks = jax.tree.map(lambda v: np.asarray(v)[indices], run.period.now)
    values = linear.map_in_batches(margins.compute_each, loops, margins.LOOPS_PER_CALL)
    return TimedMargins(ticks.t, ticks.hold, loops, values)


def judged_loops(parts: Parts, run: linear.NominalRun, *, fractional_delays: bool = True) -> tuple[Loop, Array]:
    """Return the loops at the `judged_times` and in the hold phase, and which of them are in the hold phase.

    The first axis (times + 1) of the loops is the time. The last time is in the hold phase. See `Loop` for the units.

    Args:
        parts: the sampled scenario.
        run: its nominal run.
        fractional_delays: whether the loops support fractional delays, see `linear.linearise_period`.
    """
    indices = find_period_indices(parts, run, judged_times(parts))
    loops = linear.open_loops(parts, run, indices, fractional_delays=fractional_delays)
    return loops, run.period.now.hold[indices]


@programs.jit(
    static_argnames="with_delay", compiler_options=programs.FAST_COMPILE, title="the margins of the nominal run"
)
def judged_margins(parts: Parts, with_delay: bool = True) -> tuple[Margins, Array, History]:
    """Return the margins at the `judged_times` and in the hold phase, and the commands of the nominal run.

    The margins are (times + 1, m). The second result marks the entries in the hold phase, (times + 1,) bool. The
    function supports all JAX transformations.

    Args:
        parts: the sampled scenario.
        with_delay: whether to compute the delay margin; otherwise it is NaN.
    """
    run = linear.simulate_nominal(parts)
    loops, hold = judged_loops(parts, run, fractional_delays=with_delay)
    return margins.compute_each(loops, with_delay=with_delay), hold, command_history(parts, run)


def judge_run(parts: Parts, *, with_delay: bool = True) -> tuple[Margins, np.ndarray, limit_cycles.LimitCycle | None]:
    """Return the margins at the `judged_times` and in the hold phase, and the limit cycle of the nominal run.

    The margins are (times + 1, m). The second result marks the entries in the hold phase, (times + 1,) bool. If
    there is a limit cycle, the margins in the hold phase are zero, see `limit_cycles`.

    Args:
        parts: the sampled scenario.
        with_delay: whether to compute the delay margin, which takes half of the compilation; otherwise it is NaN.
    """
    values, hold, commands = jax.tree.map(np.asarray, judged_margins(parts, with_delay))
    limit_cycle = limit_cycles.find(parts, commands)
    return limit_cycles.zero_margins(values, hold & (limit_cycle is not None)), hold, limit_cycle


def margins_along_run(parts: Parts) -> Course:
    """Return the margins of sampled parts along their nominal run.

    The times are the judged ones, one in the hold phase, and about `FURTHER_TIMES` further ones. If there is a limit
    cycle, the margins in the hold phase are zero, see `limit_cycles`.
    """
    run = linear.simulate_nominal_jit(parts)
    times_to_go, commands, singularity_distance, not_converged = _run_data(parts, run)
    at_times = margins_at(parts, times_to_go, run)
    index_at = {t: k for k, t in reversed(list(enumerate(at_times.t.tolist()))) if not at_times.hold[k]}
    order = np.asarray([k for _, k in sorted(index_at.items())] + [len(at_times.t) - 1])
    t, _, loops, at_input = jax.tree.map(lambda v: v[order], at_times)
    in_hold, last = order == order[-1], jax.tree.map(lambda v: v[-1:], loops)
    judged = (order < TIMES) | in_hold
    limit_cycle = limit_cycles.find(parts, commands)
    has_cycle = limit_cycle is not None
    at_input = limit_cycles.zero_margins(at_input, in_hold & has_cycle)
    at_sensors = limit_cycles.zero_margins(margins.compute_each(last, sensors=True), [has_cycle])
    at_sensors = jax.tree.map(lambda v: v[0], at_sensors)
    together = margins.simultaneous_margins(jax.tree.map(lambda v: v[0], last))
    if has_cycle:
        together = dict.fromkeys(together, float("nan"))
    return Course(
        t,
        judged,
        loops,
        at_input,
        at_sensors,
        together,
        float(singularity_distance),
        bool(not_converged),
        limit_cycle,
    )


@programs.jit(compiler_options=programs.FAST_COMPILE)
def _run_data(parts: Parts, run: linear.NominalRun) -> tuple[Array, History, Scalar, Array]:
    """Return the data of `margins_along_run` that one compiled program computes.

    Returns:
        The times to go (TIMES + FURTHER_TIMES,) [s], judged ones first; the commands; the smallest distance to the
        law's singularity [-]; whether the run has not converged at t_f.
    """
    law = parts.controller
    distances = lapack.vmap(lambda x, t: law.singularity_distance(x, parts.reference(t)))(run.carry.x, run.period.now.t)
    nearest = jnp.min(distances / law.kinematics.singularity_distance_unit(distances[0]))
    t = run.period.now.t
    first_angle, final_angle = (
        law.kinematics.angle(jax.tree.map(lambda v, k=k: v[k], run.carry.x), parts.reference(t[k]))
        for k in (0, jnp.argmax(t >= law.t_f))
    )
    not_converged = rollout.is_not_converged(final_angle, first_angle, parts.settling_angle)
    further_times = jnp.geomspace(parts.period, law.t_f, FURTHER_TIMES)
    return jnp.append(judged_times(parts), further_times), command_history(parts, run), nearest, not_converged


def margins_at_ends(parts: Parts) -> dict[str, tuple[Margins, float]]:
    """Return the margins and the `controlled_radius` at the last full period before the "hand_over" and in "hold".

    If there is no full period before the hand-over, both results are from the hold phase.
    """
    run = linear.simulate_nominal_jit(parts)
    last_before = linear.full_periods(parts, run, hold=False)[-1:]
    time_to_go = float(parts.controller.t_f) - np.asarray(run.period.now.t)[last_before]
    timed = margins_at(parts, jnp.asarray(time_to_go), run)
    ends = {"hand_over": 0, "hold": -1}
    by_end = {name: jax.tree.map(lambda v, k=k: v[k], (timed.margins, timed.loops)) for name, k in ends.items()}
    return {name: (values, controlled_radius(loop)) for name, (values, loop) in by_end.items()}


def controlled_radius(loop: Loop) -> float:
    """Return the largest modulus of the poles of the closed loop that the controller moves [-].

    The poles of stored wheel momentum and of estimated biases stay at 1, and would hide the distance of all other poles
    to the stability limit. An unstable pole counts even if the controller does not move it. The result is NaN if the
    nominal run is not finite.

    Args:
        loop: the linearised loop.
    """
    poles, without_controller = linear.closed_poles(loop), linear.closed_poles(loop, 0.0)
    size, tolerance = np.abs(poles), margins.CIRCLE_TOLERANCE
    stays = np.min(np.abs(poles[:, None] - without_controller), axis=1) <= tolerance
    return float(size[~stays | (size > 1.0 + tolerance)].max(initial=0.0))
