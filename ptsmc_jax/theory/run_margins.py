"""Margins along the nominal run of a sampled loop: in hold, and on the way to the hand-over with its gains frozen."""

from typing import NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float

from ptsmc_jax import programs
from ptsmc_jax.batching import lapack
from ptsmc_jax.numerics.pytrees import Scalar
from ptsmc_jax.simulation import run_state
from ptsmc_jax.simulation.assembly import Parts
from ptsmc_jax.theory import linear, margins, rest
from ptsmc_jax.theory.linear import Loop
from ptsmc_jax.theory.margins import FIELDS, Margins
from ptsmc_jax.theory.rest import History, history

SLOWEST = 10  # periods to go: from one to the next the gains before the hand-over change by a tenth
TIMES, SHARE = 4, 0.25  # to go at which margins are judged, and the longest as a share of t_f


class Course(NamedTuple):
    """Margins along a nominal run."""

    t: np.ndarray  # (times,) [s], the last in hold, those before it before the hand-over
    judged: np.ndarray  # (times,) bool: where the frozen loop means something, see `judged_times`
    loops: Loop  # arrays over the times first
    at_input: Margins  # (times, m)
    at_sensors: Margins  # (k,) in hold
    together: dict[str, float]  # the same of all axes of the input at once, in hold
    clearance: float  # the run's least, as `run_state.SINGULAR_CLEARANCE` has it
    missed: bool  # the run is not where it should be at t_f, as `run_state.misses` has it
    swing: rest.Swing | None = None  # by which the run does not come to rest in hold

    @property
    def hold(self) -> tuple[Loop, Margins]:
        """The loop in hold, and its margins (m,)."""
        return jax.tree.map(lambda v: v[-1], (self.loops, self.at_input))

    @property
    def before(self) -> Margins:
        """(times, m) before the hand-over."""
        return jax.tree.map(lambda v: v[:-1], self.at_input)

    def worst(self) -> dict[str, float]:
        """`catalogues.MARGINS`, the worst over the axes, in hold and where it is judged before the hand-over."""
        where_judged = jax.tree.map(lambda v: v[self.judged], self.at_input)
        return {name: float(v) for name, v in where_judged.worst().items()}


def judged_times(parts: Parts) -> Float[Array, " times"]:
    """Times to go [s] at which frozen gains mean something, the shortest first, evenly spaced by their logarithms.

    From the hand-over, where gains are largest, but no nearer than where they change by a tenth from one sample to the
    next; to where the loop takes as long to settle as it has left. They move with t_f and delta, and with them slopes.
    """
    law = parts.controller
    shortest = jnp.maximum(law.delta, SLOWEST * parts.period)
    longest = jnp.maximum(SHARE * law.t_f, shortest)
    return shortest * (longest / shortest) ** (jnp.arange(TIMES) / (TIMES - 1))


def moments(parts: Parts, run: linear.Nominal, times: Array) -> Array:
    """Numbers of the whole control periods nearest to so long before t_f [s], and then of one in hold.

    Before the hand-over, or in hold where there is none. In hold: the last; of an unstable loop the last at whose start
    it is at most twice as far off as at the hand-over, but one whose mean over a star tracker's interval is all of the
    hold.
    """
    ticks, law = run.period.now, parts.controller
    full = linear.is_full(ticks, parts.period)
    off = lapack.vmap(lambda x, t: law.kinematics.errors(x, parts.reference(t))[0])(run.carry.x, ticks.t)
    size, hold = jnp.linalg.norm(off, axis=1), full & ticks.hold
    first = jnp.argmax(hold)
    near = hold & (size <= 2.0 * size[first])
    last_near, end = (jnp.max(jnp.where(some, jnp.arange(hold.size), first)) for some in (near, hold))
    last = jnp.maximum(last_near, jnp.minimum(first + linear.averaged(parts) - 1, end))
    before = full & ~law.in_hold(ticks.t, ticks.t_next, ticks.hold)
    left = jnp.where(before, law.t_f - ticks.t, jnp.inf)
    nearest = jnp.argmin(jnp.abs(left[None] - times[:, None]), axis=1)
    return jnp.append(jnp.where(jnp.any(before), nearest, last), last)


_moments = programs.jit(moments)


class TimedMargins(NamedTuple):
    """Margins at times of a nominal run, the last of them in hold."""

    t: np.ndarray  # (times,) [s]
    hold: np.ndarray  # (times,) bool: in hold
    loops: Loop  # arrays over the times first
    margins: Margins  # (times, m)


def at(parts: Parts, left: Float[Array, " times"], flown: linear.Nominal | None = None) -> TimedMargins:
    """Margins of sampled parts at these times to go [s], (times,), and in hold; flown: their nominal run, if known."""
    run: linear.Nominal = linear.nominal_jit(parts) if flown is None else flown
    indices = np.asarray(_moments(parts, run, left))
    loops = linear.loops_in(parts, run, indices)
    ticks = jax.tree.map(lambda v: np.asarray(v)[indices], run.period.now)
    return TimedMargins(ticks.t, ticks.hold, loops, margins.in_turn(loops))


def judged_loops(parts: Parts, flown: linear.Nominal | None = None, *, late: bool = True) -> tuple[Loop, Array]:
    """The loops whose margins are judged, and in hold, (times + 1, ..), and which are in hold; h in [s].

    late: of delay too, see `linear.opened`.
    """
    run = linear.nominal(parts) if flown is None else flown
    indices = moments(parts, run, judged_times(parts))
    return linear.loops_at(parts, run, indices, late=late), run.period.now.hold[indices]


def judged(parts: Parts) -> tuple[Margins, Array, History]:
    """Margins of `judged_loops`, (times + 1, m), which are in hold, and the run; for any transformation."""
    run = linear.nominal(parts)
    loops, hold = judged_loops(parts, run)
    return margins.of_each(loops), hold, history(parts, run)


judged_jit = programs.jit(judged, compiler_options=programs.QUICKLY)


def along(parts: Parts, times: int = 24) -> Course:
    """Margins of sampled parts along their nominal run: in hold, where judged, and at about so many times besides.

    None is left in hold where the run does not come to rest, see `rest`.
    """
    run = linear.nominal_jit(parts)
    looked_at, commands, clearance, missed = _along(parts, run, times)
    at_times = at(parts, looked_at, run)
    first_at = {t: k for k, t in reversed(list(enumerate(at_times.t.tolist()))) if not at_times.hold[k]}
    order = np.asarray([k for _, k in sorted(first_at.items())] + [len(at_times.t) - 1])
    t, _, loops, at_input = jax.tree.map(lambda v: v[order], at_times)
    counts = (order < TIMES) | (order == order[-1])
    last = jax.tree.map(lambda v: v[-1:], loops)
    at_sensors = margins.of_each(last, sensors=True)
    swing = rest.swing(parts, commands)
    if swing is None:
        at_once = margins.together(jax.tree.map(lambda v: v[0], last))
    else:
        at_once = dict.fromkeys(FIELDS, float("nan"))
        at_input, at_sensors = rest.none_left(at_input, order == order[-1]), rest.none_left(at_sensors, [True])
    at_sensors = jax.tree.map(lambda v: np.asarray(v)[0], at_sensors)
    return Course(t, counts, loops, at_input, at_sensors, at_once, float(clearance), bool(missed), swing)


@programs.jit(static_argnames="times", compiler_options=programs.QUICKLY)
def _along(parts: Parts, run: linear.Nominal, times: int) -> tuple[Array, History, Scalar, Array]:
    """The times to go that `along` looks at, (TIMES + times,) [s], those that are judged first; the commands.

    And the least clearance from the law's singularity [-], and whether the run misses t_f.
    """
    law = parts.controller
    besides = jnp.geomspace(parts.period, law.t_f, times)
    clear = lapack.vmap(lambda x, t: law.clearance(x, parts.reference(t)))(run.carry.x, run.period.now.t)
    nearest = jnp.min(clear / law.kinematics.clearance_unit(clear[0]))
    t = run.period.now.t
    first, arrived = (
        law.kinematics.angle(jax.tree.map(lambda v, k=k: v[k], run.carry.x), parts.reference(t[k]))
        for k in (0, jnp.argmax(t >= law.t_f))
    )
    missed = run_state.misses(arrived, first, parts.settling_angle)
    return jnp.append(judged_times(parts), besides), history(parts, run), nearest, missed


def at_ends(parts: Parts) -> dict[str, tuple[Margins, float]]:
    """Margins at the last whole period before the "hand_over" and in "hold", and the largest modulus of the poles.

    Without a whole period before the hand-over those in hold are both.
    """
    run = linear.nominal_jit(parts)
    before = linear.full_periods(parts, run, hold=False)[-1:]
    left = float(parts.controller.t_f) - np.asarray(run.period.now.t)[before]
    both = at(parts, jnp.asarray(left), run)
    ends = {"hand_over": 0, "hold": -1}
    each = {name: jax.tree.map(lambda v, k=k: v[k], (both.margins, both.loops)) for name, k in ends.items()}
    return {name: (seen, linear.radius(loop)) for name, (seen, loop) in each.items()}
