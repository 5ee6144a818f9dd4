"""The one time loop: parts in, metrics, status and (if asked for) the history out. It knows no law and no plant.

`simulate` is pure and composes with jit, vmap, grad and jvp; every number in `Parts` is a leaf, so another gain,
inertia or noise is the same compiled program.
"""

from dataclasses import dataclass, field
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
from jaxtyping import Array, Float

from ptsmc_jax import metrics, numerics
from ptsmc_jax.clock import Anchored, Flight, Graded, Ticks
from ptsmc_jax.controllers import Law
from ptsmc_jax.draws import Whole
from ptsmc_jax.hardware import Sensor
from ptsmc_jax.numerics import Leaf
from ptsmc_jax.observers import Observer
from ptsmc_jax.plants import Plant

Scalar = Float[Array, ""]

OK, DIVERGED, TOO_FAST, SINGULAR = range(4)
# code: (status, reason)
STATUS = {
    OK: ("ok", ""),
    DIVERGED: ("diverged", "the state is not finite"),
    TOO_FAST: ("diverged", "the body turns more than 1 rad in an integration step"),
    SINGULAR: ("singular", "the law's singularity (q4 = 0 for the additive error) came nearer than 1e-3"),
}
SINGULAR_CLEARANCE = 1e-3


@jax.tree_util.register_dataclass
@dataclass(frozen=True)
class Parts:
    """Everything a run is made of. `plant` is the truth; controller and observer hold their own, nominal model."""

    plant: Plant
    disturbance: Any  # callable: t [s] -> (m,) [N m]
    reference: Any  # callable: t [s] -> what the law is to reach, a Target for spacecraft
    controller: Law
    observer: Any  # observers.Observer
    sensors: Any  # hardware.Sensor, or None: the law sees the true state
    clock: Anchored | Flight | Graded  # Graded: continuous loop; the others: sampled
    initial: Any  # state of the plant
    t_end: Leaf  # [s]
    window: Leaf  # after t_f, for window_error [s]
    settling_angle: Leaf  # [rad]
    substeps: int = field(default=1, metadata={"static": True})  # RK4 steps of the plant a control period


class Log(NamedTuple):
    """History at the start of each interval and at t_end; arrays (time, component), time (time,)."""

    t: Array  # [s]
    x: Any  # true state
    d_hat: Array  # estimated disturbance [N m]
    u: Array  # delivered torque, from this time on [N m]
    commanded: Array  # [N m]
    s: Array  # sliding variable that the law used
    disturbance: Array  # true disturbance [N m]
    reference: Any  # what the reference is then
    error: Array  # what the law drives to zero: the attitude error vector [-], for a chain x_1
    lasts: Array  # bool: the row starts an interval of positive length, or is the last


class Result(NamedTuple):
    """What a run returns: its metrics, its status code (see `STATUS`) with the first bad time, NaN if none [s]."""

    metrics: metrics.Metrics
    status: Array
    bad_time: Array
    log: Log | None


class _State(NamedTuple):
    x: Any
    d_hat: Array
    u: Array  # delivered last
    measured: Any  # state at the last sample, what the digital observer starts from
    sight: metrics.Sight
    running: metrics.Running
    at_t_f: tuple  # what the state at t_f is computed from
    status: Array
    bad_time: Array


def simulate(parts: Parts, seed: Whole = 0, trial: Whole = 0, record: bool = False) -> Result:
    """One closed-loop run. seed, trial: whole numbers below 2^32 that name its noise; record: return the history too.

    A run that goes wrong never raises: it returns a status and the first bad time, and its metrics as they came out.
    """
    ticks = parts.clock.ticks(parts.controller.t_f, parts.controller.delta)
    judged = metrics.Judged(parts.controller.t_f, parts.t_end, parts.window, parts.settling_angle)
    x0 = parts.controller.align(parts.initial, parts.reference(jnp.zeros_like(parts.t_end)))
    loop = _continuous if isinstance(parts.clock, Graded) else _sampled
    return loop(parts, ticks, judged, x0, seed, trial, record)


# One compiled program for all parts of the same structure.
simulate_jit = jax.jit(simulate, static_argnames="record")


def _sampled(parts: Parts, ticks: Ticks, judged: metrics.Judged, x0: Any, seed, trial, record) -> Result:
    """Measured, computed and held over each control period; digital observer; plant by RK4 under the held torque."""
    controller = parts.controller
    observer: Observer = parts.observer
    sensors: Sensor | None = parts.sensors
    k2 = observer.error_bound()
    lengths = ticks.t_next - ticks.t
    length_before = jnp.concatenate([jnp.zeros(1), lengths[:-1]])
    partial_before = jnp.concatenate([jnp.zeros(1), ticks.noise_weight[:-1]]) < 1.0
    # the observer's matrix for a whole period and for the partial first one, outside the loop
    matrix = observer.update_matrix(parts.clock.period)  # pyright: ignore[reportAttributeAccessIssue]
    first_length = jnp.sum(jnp.where(ticks.noise_weight < 1.0, lengths, 0.0))
    first_matrix = observer.update_matrix(first_length)
    keys = None if sensors is None else sensors.keys(seed, trial)

    def fly(x: Any, t: Scalar, u: Array, dt: Scalar) -> Any:
        step = dt / parts.substeps
        for k in range(parts.substeps):
            x = numerics.rk4(lambda time, y: parts.plant.rate(y, u, parts.disturbance(time)), t + k * step, x, step)
        return parts.plant.normalise(x)

    def period(carry: tuple[_State, Any], tick: tuple) -> tuple[tuple[_State, Any], Any]:
        (now, dt_before, partial), (state, noise) = tick, carry
        dt = now.t_next - now.t
        if sensors is None:
            measured, noise_next = state.x, noise
        else:
            noise_next = sensors.noise(keys, now.sample + 1)
            measured = sensors.measure(state.x, numerics.lerp(now.noise_weight, noise, noise_next))
        d_hat = observer.update(
            jnp.where(partial, first_matrix, matrix), state.d_hat, state.measured, measured, state.u, dt_before
        )
        d_hat = jnp.where(dt_before > 0.0, d_hat, state.d_hat)
        u, s = controller.torque(now.t, now.hold, measured, parts.reference(now.t), d_hat, k2(now.t))
        row = _row(parts, now.t, state.x, d_hat, u, u, s, dt > 0.0) if record else None
        x = fly(state.x, now.t, u, dt)
        from_here = (now.t, state.x, u)
        state = _advance(parts, judged, state, now, x, d_hat, measured, (u,), (1.0,), from_here, dt / parts.substeps)
        return (state, noise_next), row

    noise = None if sensors is None else sensors.noise(keys, ticks.sample[0])
    state = _begin(parts, judged, x0)
    state = state._replace(at_t_f=(jnp.zeros_like(judged.t_f), x0, jnp.zeros(parts.plant.inputs)))
    (state, _), rows = jax.lax.scan(period, (state, noise), (ticks, length_before, partial_before))
    t, x, u = state.at_t_f
    at_t_f = _sight(parts, judged.t_f, fly(x, t, u, judged.t_f - t))
    return _finish(parts, judged, state, at_t_f, k2, rows, held=True)


def _continuous(parts: Parts, ticks: Ticks, judged: metrics.Judged, x0: Any, seed, trial, record) -> Result:
    """Law and observer inside the integrator's stages; the observer's linear part exact in every step."""
    del seed, trial  # nothing is drawn
    controller = parts.controller
    observer: Observer = parts.observer
    k2 = observer.error_bound()
    decays = jax.vmap(lambda dt: numerics.decay(observer.decay_matrix(), dt))(ticks.t_next - ticks.t)

    def step(state: _State, tick: tuple) -> tuple[_State, Any]:
        now, linear = tick
        dt = now.t_next - now.t

        def rate(t: Scalar, x: Any, d_hat: Array) -> tuple[Any, Array, tuple[Array, Array]]:
            u, s = controller.torque(t, now.hold, x, parts.reference(t), d_hat, k2(t))
            x_dot = parts.plant.rate(x, u, parts.disturbance(t))
            return x_dot, observer.forcing(x, x_dot, u), (u, s)

        x, d_hat, (u, s), (u_middle, _) = numerics.etdrk4(rate, linear, now.t, state.x, state.d_hat, dt)
        row = _row(parts, now.t, state.x, state.d_hat, u, u, s, dt > 0.0) if record else None
        x = parts.plant.normalise(x)
        _, _, (u_end, _) = rate(now.t_next, x, d_hat)
        torques = (u, u_middle, u_end)
        return _advance(parts, judged, state, now, x, d_hat, x, torques, (1 / 6, 4 / 6, 1 / 6), None, dt), row

    state = _begin(parts, judged, x0)
    state = state._replace(at_t_f=(state.sight,))
    state, rows = jax.lax.scan(step, state, (ticks, decays))
    return _finish(parts, judged, state, state.at_t_f[0], k2, rows, held=False)


def _begin(parts: Parts, judged: metrics.Judged, x0: Any) -> _State:
    zero, none = jnp.zeros_like(judged.t_f), jnp.zeros(parts.plant.inputs)
    sight = _sight(parts, zero, x0)
    state = _State(
        x=x0,
        d_hat=none,
        u=none,
        measured=x0,
        sight=sight,
        running=metrics.begin(sight, judged, parts.plant.inputs),
        at_t_f=(),
        status=jnp.int32(OK),
        bad_time=jnp.full_like(zero, jnp.nan),
    )
    status, bad_time = _watch(parts, state, zero, zero, x0, none)
    return state._replace(status=status, bad_time=bad_time)


def _advance(parts, judged, state: _State, now: Ticks, x, d_hat, measured, torques, weights, at_t_f, step) -> _State:
    """The state after an interval: metrics, status and what the state at t_f is computed from (None: this sight).

    torques: at the quadrature nodes of `weights` in the interval, the last one at its end; step: longest integration
    step taken in it [s].
    """
    sight = _sight(parts, now.t_next, x)
    span = metrics.Span(now.t, now.t_next, state.sight, sight, torques, torques, weights)
    crosses = (now.t < judged.t_f) & (judged.t_f <= now.t_next)
    status, bad_time = _watch(parts, state, now.t_next, step, x, torques[-1])
    return _State(
        x=x,
        d_hat=d_hat,
        u=torques[-1],
        measured=measured,
        sight=sight,
        running=metrics.update(state.running, span, judged),
        at_t_f=numerics.select(crosses, (sight,) if at_t_f is None else at_t_f, state.at_t_f),
        status=status,
        bad_time=bad_time,
    )


def _finish(parts: Parts, judged, state: _State, at_t_f, k2, rows, *, held: bool) -> Result:
    log = None
    if rows is not None:  # the last row: the state at t_end, with the torque held until then or as it is there
        target = parts.reference(judged.t_end)
        hold = judged.t_end >= parts.controller.hand_over
        u, s = parts.controller.torque(judged.t_end, hold, state.x, target, state.d_hat, k2(judged.t_end))
        u = state.u if held else u
        last = _row(parts, judged.t_end, state.x, state.d_hat, u, u, s, jnp.asarray(True))
        log = jax.tree.map(lambda many, one: jnp.concatenate([many, jnp.asarray(one)[None]]), rows, last)
    return Result(metrics.finish(state.running, at_t_f, judged), state.status, state.bad_time, log)


def _sight(parts: Parts, t: Scalar, x: Any) -> metrics.Sight:
    target = parts.reference(t)
    error, error_rate = parts.controller.errors(x, target)
    return metrics.Sight(
        error,
        error_rate,
        parts.controller.angle(x, target),
        parts.plant.speed(x),
        numerics.norm(parts.plant.momentum(x)),
    )


def _watch(parts: Parts, state: _State, t: Scalar, dt: Scalar, x: Any, u: Array) -> tuple[Array, Array]:
    """Status and first bad time after an interval; the first thing that goes wrong stays."""
    finite = jnp.all(jnp.isfinite(u))
    for leaf in jax.tree.leaves(x):
        finite = finite & jnp.all(jnp.isfinite(leaf))
    fast = parts.plant.too_fast(x, dt)
    near = parts.controller.clearance(x, parts.reference(t)) < SINGULAR_CLEARANCE
    code = jnp.where(~finite, DIVERGED, jnp.where(near, SINGULAR, jnp.where(fast, TOO_FAST, OK))).astype(jnp.int32)
    first = (state.status == OK) & (code != OK)
    return jnp.where(first, code, state.status), jnp.where(first, t, state.bad_time)


def _row(parts: Parts, t, x, d_hat, u, commanded, s, lasts) -> Log:
    target = parts.reference(t)
    error, _ = parts.controller.errors(x, target)
    return Log(t, x, d_hat, u, commanded, s, parts.disturbance(t), target, error, lasts)
