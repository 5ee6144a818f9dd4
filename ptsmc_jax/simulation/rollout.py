"""A run: parts in, metrics, status and (if asked for) the history out. It knows no law and no plant.

`simulate` is pure and composes with jit, vmap, grad and jvp; every number in `Parts` is a leaf, so another gain,
inertia or noise is the same compiled program.
"""

from typing import Any

import jax
import jax.numpy as jnp

from ptsmc_jax import programs
from ptsmc_jax.devices.ticks import Ticks
from ptsmc_jax.numerics import guards
from ptsmc_jax.numerics.draws import WholeNumber, check_fits
from ptsmc_jax.numerics.pytrees import Scalar
from ptsmc_jax.simulation import continuous, sampled
from ptsmc_jax.simulation.assembly import Parts, check_parts
from ptsmc_jax.simulation.computer import OURS, Software
from ptsmc_jax.simulation.interval import Criteria
from ptsmc_jax.simulation.run_state import (
    DIVERGED,
    FINISHED,
    MISSED,
    OK,
    SINGULAR,
    SINGULAR_CLEARANCE,
    STATUS,
    TOO_FAST,
    UNBOUNDED,
    UNFINISHED,
    Log,
    Result,
    Run,
)  # fmt: skip

__all__ = [
    "DIVERGED", "FINISHED", "MISSED", "OK", "SINGULAR", "SINGULAR_CLEARANCE", "STATUS", "TOO_FAST", "UNBOUNDED",
    "UNFINISHED", "Log", "Parts", "Result", "simulate", "simulate_jit",
]  # fmt: skip


def simulate(
    parts: Parts, seed: WholeNumber = 0, trial: WholeNumber = 0, record: bool = False, software: Software = OURS
) -> Result:
    """One closed-loop run, which never raises: where it goes wrong, its status says so, with the first bad time.

    Args:
        parts: of the run.
        seed: whole number below 2^32 that names the noise, together with `trial`.
        trial: whole number below 2^32.
        record: return the history, too.
        software: the flight computer of a sampled loop, where it is not our own.

    Returns:
        Metrics, as they came out whatever the status, status, first bad time and history.

    Raises TypeError, with one sentence, where parts changed by hand do not fit each other.
    """
    _check(parts)
    ticks = parts.clock.ticks(parts.controller.t_f, parts.controller.delta)
    pointing = None if parts.pointing is None else parts.pointing.of_run(ticks.t.size)
    criteria = Criteria(parts.controller.t_f, parts.t_end, parts.window, parts.settling_angle, pointing)
    target = parts.reference(jnp.zeros_like(parts.t_end))
    # whole numbers and single precision in a start are numbers of the run, as they are in any other part
    x0 = jax.tree.map(lambda v: jnp.asarray(v, float), parts.aligned_initial)
    unit = parts.controller.kinematics.clearance_unit(parts.controller.clearance(x0, target))
    target_t_f = parts.reference(criteria.t_f)
    unit, gap = jax.lax.stop_gradient(unit), _first_missing(parts, ticks)
    run = Run(parts, ticks, criteria, x0, target, target_t_f, unit, gap, record)
    return sampled.simulate(run, seed, trial, software) if parts.clock.sampled else continuous.simulate(run)


def _check(parts: Parts) -> None:
    """Raise TypeError where parts do not fit each other, or JAX as it is set: JAX would from deep inside."""
    check_parts(parts)
    _check_bits(parts.t_end)
    for name, size in (("q", 4), ("w", 3)) if parts.plant.attitude else ():
        _check_shape(f"initial.{name}", getattr(parts.initial, name, None), [(size,)])
    if parts.plant.states is not None:
        _check_shape("initial", parts.initial, [(parts.plant.states,)])
    if not callable(parts.disturbance):
        raise TypeError(f"the disturbance must be a function of (t, x), but is {parts.disturbance!r}")
    value = jax.eval_shape(lambda: parts.disturbance(jnp.zeros_like(parts.t_end), parts.initial))
    _check_shape("what the disturbance returns", value, [(parts.plant.inputs,), ()])
    if not parts.clock.sampled:
        _check_continuous(parts)


def _check_continuous(parts: Parts) -> None:
    """Raise TypeError if parts of a continuous loop contain what only the sampled loop simulates."""
    optional = [name for name in ("walk_rate", "command_filter", "jitter") if getattr(parts, name) is not None]
    present = {"sensors": not parts.sensors.perfect, "actuators": not parts.actuators.ideal}
    for name in (*(name for name, there in present.items() if there), *optional):
        raise TypeError(f"the continuous loop cannot simulate {name}: remove {name}, or use a sampled clock")
    if not parts.controller.continuous:
        law = type(parts.controller).__name__
        raise TypeError(f"the law {law} needs the sampled loop: use a sampled clock")


def _check_bits(time: Any) -> None:
    """Raise TypeError where parts were made before JAX was set to compute with other bits, as their times show."""
    real = jnp.result_type(float)
    if isinstance(time, jax.Array) and jnp.issubdtype(time.dtype, jnp.floating) and time.dtype != real:
        had, has = (jnp.finfo(kind).bits for kind in (time.dtype, real))
        made = f"the parts have numbers of {had} bits, but JAX computes with {has} now"
        raise TypeError(f"{made}: make them anew, by study")


def _check_shape(name: str, value: Any, allowed: list[tuple[int, ...]]) -> None:
    shape = getattr(value, "shape", None)
    if shape not in allowed:
        found = f"of type {type(value).__name__}" if shape is None else f"one of shape {shape}"
        raise TypeError(f"{name} must be an array {allowed[0]}, but is {found}")


def _gap(ticks: Ticks, t_end: Scalar) -> Scalar:
    """First time without samples [s], where the clock was made for shorter t_f or delta than it got; NaN: none."""
    first, last = ticks.t[0], ticks.t_next[-1]
    ends = jnp.where(last < t_end - guards.rounding(t_end, t_end), last, jnp.nan)
    return jax.lax.stop_gradient(jnp.where(first > 0.0, 0.0, ends))


def _first_missing(parts: Parts, ticks: Ticks) -> Scalar:
    """The `_gap` [s]; of a continuous loop whose steps are too coarse for t_f and delta 0."""
    clock: Any = parts.clock
    gap = _gap(ticks, parts.t_end)
    law = parts.controller
    return gap if clock.sampled else jnp.where(clock.too_coarse(law.t_f, law.delta), 0.0, gap)


class _Flights(programs.Program):
    """`simulate` compiled: what is no parts, seed or trial is refused before JAX is given arrays made of it."""

    def __call__(self, *args: Any, **kwargs: Any) -> Any:
        """Call it as `simulate` is called."""
        given = dict(zip(("parts", "seed", "trial"), args, strict=False)) | kwargs
        check_parts(given.get("parts"))
        for name in ("seed", "trial"):
            check_fits(name, given.get(name))
        return super().__call__(*args, **kwargs)


# One compiled program for all parts of the same structure.
simulate_jit = _Flights(simulate, ("record", "software"))
# The same for a run that is flown to be looked at: compiled in half to a tenth of the time, flown in 3 to 8 times of it
simulate_once = _Flights(simulate, ("record", "software"), programs.QUICKLY)
LONG = 20_000  # periods from which on that loses more than it saves


def looked_at(parts: Parts) -> programs.Program:
    """`simulate` compiled for one run of such parts, by the host."""
    return simulate_jit if parts.clock.count > LONG else simulate_once
