"""Simulate one run: from its parts to metrics, status and history.

`simulate` is a pure function. It composes with jit, vmap, grad and jvp. Every number in `Parts` is a leaf of a pytree,
so other gains, inertias or noises reuse the compiled program. `simulate_parts` is the compiled function.
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
    INCOMPLETE,
    NOT_CONVERGED,
    OK,
    SINGULAR,
    SINGULAR_DISTANCE,
    STATUS,
    TOO_FAST,
    UNBOUNDED,
    Log,
    Result,
    Run,
)  # fmt: skip

__all__ = [
    "DIVERGED",
    "FINISHED",
    "INCOMPLETE",
    "NOT_CONVERGED",
    "OK",
    "SINGULAR",
    "SINGULAR_DISTANCE",
    "STATUS",
    "TOO_FAST",
    "UNBOUNDED",
    "Log",
    "Parts",
    "Result",
    "simulate",
    "simulate_parts",
]  # fmt: skip


def simulate(
    parts: Parts, seed: WholeNumber = 0, trial: WholeNumber = 0, record: bool = False, software: Software = OURS
) -> Result:
    """Simulate one closed-loop run. A run that diverges raises nothing: its status reports it.

    Args:
        parts: parts of the run.
        seed: whole number below 2^32 that selects the random numbers, together with `trial`.
        trial: whole number below 2^32.
        record: whether to return the history.
        software: flight software of a sampled loop; by default the law and observer of `parts`.

    Returns:
        Metrics, status, first bad time and history. The metrics of a diverged run are returned as computed.

    Raises:
        TypeError: the parts do not fit together.
    """
    _check(parts)
    ticks = parts.clock.ticks(parts.controller.t_f, parts.controller.delta)
    pointing = None if parts.pointing is None else parts.pointing.of_run(ticks.t.size)
    criteria = Criteria(parts.controller.t_f, parts.t_end, parts.window, parts.settling_angle, pointing)
    target = parts.reference(jnp.zeros_like(parts.t_end))
    # the initial state may have integers or single precision; the run uses the precision of JAX
    x0 = jax.tree.map(lambda v: jnp.asarray(v, float), parts.aligned_initial)
    unit = parts.controller.kinematics.singularity_distance_unit(parts.controller.singularity_distance(x0, target))
    target_t_f = parts.reference(criteria.t_f)
    unit, gap = jax.lax.stop_gradient(unit), _first_missing(parts, ticks)
    run = Run(parts, ticks, criteria, x0, target, target_t_f, unit, gap, record)
    return sampled.simulate(run, seed, trial, software) if parts.clock.sampled else continuous.simulate(run)


def _check(parts: Parts) -> None:
    """Raise TypeError if the parts do not fit together or do not have the precision of JAX."""
    check_parts(parts)
    _check_bits(parts.t_end)
    for name, shape in parts.plant.state_shapes.items():
        value = getattr(parts.initial, name, None) if name else parts.initial
        _check_shape(f"initial.{name}".rstrip("."), value, [shape])
    if not callable(parts.disturbance):
        raise TypeError(f"the disturbance must be a function of (t, x), but is {parts.disturbance!r}")
    value = jax.eval_shape(lambda: parts.disturbance(jnp.zeros_like(parts.t_end), parts.initial))
    _check_shape("the disturbance's value", value, [(parts.plant.inputs,), ()])
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
    """Raise TypeError if the parts were built while JAX had another precision."""
    real = jnp.result_type(float)
    if isinstance(time, jax.Array) and jnp.issubdtype(time.dtype, jnp.floating) and time.dtype != real:
        had, has = (jnp.finfo(kind).bits for kind in (time.dtype, real))
        built = f"the parts were built in {had}-bit precision, but JAX now uses {has}-bit"
        raise TypeError(f"{built}; build them again with study")


def _check_shape(name: str, value: Any, allowed: list[tuple[int, ...]]) -> None:
    shape = getattr(value, "shape", None)
    if shape not in allowed:
        found = f"of type {type(value).__name__}" if shape is None else f"one of shape {shape}"
        raise TypeError(f"{name} must be an array {allowed[0]}, but is {found}")


def _gap(ticks: Ticks, t_end: Scalar) -> Scalar:
    """Return the first time without samples [s], or NaN. A clock built for a shorter t_f or delta has too few."""
    first, last = ticks.t[0], ticks.t_next[-1]
    ends = jnp.where(last < t_end - guards.time_tolerance(t_end, t_end), last, jnp.nan)
    return jax.lax.stop_gradient(jnp.where(first > 0.0, 0.0, ends))


def _first_missing(parts: Parts, ticks: Ticks) -> Scalar:
    """Return the first time without samples [s], or NaN; 0 if the steps of a continuous loop are too coarse."""
    clock: Any = parts.clock
    gap = _gap(ticks, parts.t_end)
    law = parts.controller
    return gap if clock.sampled else jnp.where(clock.too_coarse(law.t_f, law.delta), 0.0, gap)


class _SimulateProgram(programs.Program):
    """Compiled `simulate`. It checks the types of parts, seed and trial before JAX converts them to arrays."""

    def __call__(self, *args: Any, **kwargs: Any) -> Any:
        """Check the arguments and call the program with the arguments of `simulate`."""
        arguments = dict(zip(("parts", "seed", "trial"), args, strict=False)) | kwargs
        check_parts(arguments.get("parts"))
        for name in ("seed", "trial"):
            check_fits(name, arguments.get(name))
        return super().__call__(*args, **kwargs)


# one compiled program for all parts of the same structure
simulate_parts = _SimulateProgram(simulate, ("record", "software"), title="the simulation")
# the same function for a single run: compiles 2 to 10 times as fast, and runs 3 to 8 times as slowly
simulate_once = _SimulateProgram(simulate, ("record", "software"), programs.QUICKLY, title="the simulation")
LONG = 20_000  # periods of a run. Longer runs are worth a slow compilation.


def single_run_program(parts: Parts) -> programs.Program:
    """Return the compiled `simulate` that is fastest for a single run, compilation included."""
    return simulate_parts if parts.clock.count > LONG else simulate_once
