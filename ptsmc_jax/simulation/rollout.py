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
from ptsmc_jax.simulation.computer import PYTHON_SOFTWARE, Software
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
    parts: Parts,
    seed: WholeNumber = 0,
    trial: WholeNumber = 0,
    record: bool = False,
    software: Software = PYTHON_SOFTWARE,
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
    _check_fit(parts)
    ticks = parts.clock.ticks(parts.controller.t_f, parts.controller.delta)
    pointing = None if parts.pointing is None else parts.pointing.for_run(ticks.t.size)
    criteria = Criteria(parts.controller.t_f, parts.t_end, parts.window, parts.settling_angle, pointing)
    target = parts.reference(jnp.zeros_like(parts.t_end))
    # the initial state may have integers or single precision; the run uses the precision of JAX
    x0 = jax.tree.map(lambda v: jnp.asarray(v, float), parts.aligned_initial)
    unit = parts.controller.kinematics.singularity_distance_unit(parts.controller.singularity_distance(x0, target))
    target_t_f = parts.reference(criteria.t_f)
    unit, uncovered_from = jax.lax.stop_gradient(unit), _first_uncovered_time(parts, ticks)
    run = Run(parts, ticks, criteria, x0, target, target_t_f, unit, uncovered_from, record)
    return sampled.simulate(run, seed, trial, software) if parts.clock.sampled else continuous.simulate(run)


def _check_fit(parts: Parts) -> None:
    """Raise TypeError if the parts do not fit together or do not have the precision of JAX."""
    check_parts(parts)
    _check_precision(parts.t_end)
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
    """Raise TypeError if parts of a continuous loop have devices that only the sampled loop simulates."""
    only_sampled = [name for name in ("walk_rate", "command_filter", "jitter") if getattr(parts, name) is not None]
    present = {"sensors": not parts.sensors.perfect, "actuators": not parts.actuators.is_ideal}
    for name in (*(name for name, is_present in present.items() if is_present), *only_sampled):
        raise TypeError(f"the continuous loop cannot simulate {name}: remove {name}, or use a sampled clock")
    if not parts.controller.continuous:
        law = type(parts.controller).__name__
        raise TypeError(f"the law {law} needs the sampled loop: use a sampled clock")


def _check_precision(time: Any) -> None:
    """Raise TypeError if the parts were built while JAX used another precision."""
    jax_type = jnp.result_type(float)
    if isinstance(time, jax.Array) and jnp.issubdtype(time.dtype, jnp.floating) and time.dtype != jax_type:
        parts_bits, jax_bits = (jnp.finfo(dtype).bits for dtype in (time.dtype, jax_type))
        message = f"the parts were built in {parts_bits}-bit precision, but JAX now uses {jax_bits}-bit"
        raise TypeError(f"{message}; build them again with study")


def _check_shape(name: str, value: Any, allowed: list[tuple[int, ...]]) -> None:
    shape = getattr(value, "shape", None)
    if shape not in allowed:
        actual = f"of type {type(value).__name__}" if shape is None else f"one of shape {shape}"
        raise TypeError(f"{name} must be an array {allowed[0]}, but is {actual}")


def _first_time_without_samples(ticks: Ticks, t_end: Scalar) -> Scalar:
    """Return the first time without samples [s], or NaN. A clock made for a shorter t_f or delta lacks samples."""
    first, last = ticks.t[0], ticks.t_next[-1]
    end_of_samples = jnp.where(last < t_end - guards.time_tolerance(t_end, t_end), last, jnp.nan)
    return jax.lax.stop_gradient(jnp.where(first > 0.0, 0.0, end_of_samples))


def _first_uncovered_time(parts: Parts, ticks: Ticks) -> Scalar:
    """Return the first time that the clock does not cover [s], or NaN; 0 if continuous steps are too coarse."""
    clock: Any = parts.clock
    without_samples = _first_time_without_samples(ticks, parts.t_end)
    if clock.sampled:
        return without_samples
    return jnp.where(clock.is_too_coarse(parts.controller.t_f, parts.controller.delta), 0.0, without_samples)


class _SimulateProgram(programs.Program):
    """Compiled `simulate`. It checks the types of parts, seed and trial before JAX converts them to arrays."""

    def __call__(self, *args: Any, **kwargs: Any) -> Any:
        """Check the arguments and call the program with the arguments of `simulate`."""
        arguments = dict(zip(("parts", "seed", "trial"), args, strict=False)) | kwargs
        check_parts(arguments.get("parts"))
        for name in ("seed", "trial"):
            check_fits(name, arguments.get(name))
        return super().__call__(*args, **kwargs)


# compiled `simulate`; one program serves all parts that differ in numbers only
simulate_parts = _SimulateProgram(simulate, ("record", "software"), title="the simulation")
# `simulate` for a single run: it compiles 2 to 10 times as fast, and runs 3 to 8 times as slowly
simulate_once = _SimulateProgram(simulate, ("record", "software"), programs.FAST_COMPILE, title="the simulation")
LONG_RUN = 20_000  # number of control periods above which the slower compilation of `simulate_parts` pays off


def single_run_program(parts: Parts) -> programs.Program:
    """Return the compiled `simulate` that is fastest for a single run, compilation included."""
    return simulate_parts if parts.clock.count > LONG_RUN else simulate_once
