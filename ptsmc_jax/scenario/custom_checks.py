"""Validate custom parts at t = 0 before a run: shapes, types, finite values, and traceability by JAX.

Start with `check`. An error names the method of the custom class and the returned value in one sentence.
"""

import dataclasses
import inspect
from collections.abc import Callable
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np

from ptsmc_jax.dispersions.variation import RESULT_COLUMNS, Dispersion
from ptsmc_jax.laws.base import Law, Sample
from ptsmc_jax.observers.base import Bound
from ptsmc_jax.plants.base import check_indices
from ptsmc_jax.plants.second_order import TRACING_ADVICE, TRACING_ERRORS
from ptsmc_jax.scenario import systems
from ptsmc_jax.scenario.custom import Custom
from ptsmc_jax.scenario.errors import ScenarioError, brief
from ptsmc_jax.scenario.tables import Scenario
from ptsmc_jax.signals.disturbances import Sum
from ptsmc_jax.simulation.catalogues import CATALOGUE
from ptsmc_jax.simulation.rollout import Parts


def check(parts: Parts, dispersion: Dispersion, scenario: Scenario) -> None:
    """Raise ScenarioError if a custom part fails at t = 0 or returns values that a run cannot use.

    Args:
        parts: the parts of a run.
        dispersion: its dispersions, which may be custom too.
        scenario: the scenario that they are built from.
    """
    tables = {name: getattr(scenario, name, None) for name in ("reference", "sensors", "observer", "controller")}
    signals = iter(parts.disturbance.terms if isinstance(parts.disturbance, Sum) else (parts.disturbance,))
    for place, term in scenario.terms_by_place.items():
        if isinstance(term, Custom):
            _check_disturbance(
                parts, next(one for one in signals if isinstance(one, term.part_class)), _Checker(place, term)
            )
    for name, table in tables.items():
        if isinstance(table, Custom):
            _CHECKS[name](parts, _Checker(name, table))

    if dispersion.custom is not None:
        _check_draw(parts, dispersion, _Checker("dispersion.custom", getattr(scenario.dispersion, "custom", None)))


def describe_failure(error: BaseException, file: str) -> str:
    """Return the reason why custom code in a file failed when it was called or traced, as the end of a sentence."""
    if isinstance(error, TRACING_ERRORS):
        line = systems.failing_line(error, file)
        return f"needs the value of a traced number, which is known only during the simulation{line}; {TRACING_ADVICE}"
    if isinstance(error, jax.errors.UnexpectedTracerError):
        return "stores a traced number outside its memory; it may use only its arguments and its memory"
    return f"fails: {systems.describe_failure(error, file)}"


def is_column_name(name: str) -> bool:
    """Whether a name can be the heading of a column."""
    return name.isprintable() and bool(name.strip())


class _Checker:
    """Call methods of a custom class and validate the returned values."""

    def __init__(self, name: str, table: Any):
        shown = brief(table.code) if isinstance(table.code, str) else table.part_class.__name__
        self._beginning, self._made = f"{name}.code is {shown}, but its", table.part_class

    def __call__(self, method: str, function: Callable, *args: Any) -> Any:
        try:
            function(*args)
            _check_tracing(function, args)
            returned = jax.tree.map(
                jnp.asarray, function(*args)
            )  # fails if the function stored a traced value in the first call
            check_indices(function, *args)
            return returned
        except (Exception, SystemExit) as error:
            reason = describe_failure(error, inspect.getsourcefile(self._made) or "")
            raise ScenarioError(f"{self._beginning} {method} {reason}") from None

    def error(self, method: str, returns: str, allowed: str) -> ScenarioError:
        """Return the error for a returned value.

        Args:
            method: name of the method.
            returns: description of the returned value.
            allowed: description of the required value.
        """
        return ScenarioError(f"{self._beginning} {method} returns {returns} at t = 0, but must return {allowed}")

    def check_array(self, method: str, description: str, value: Any, shape: tuple[int, ...]) -> None:
        """Raise ScenarioError if a value is not an array, not finite, or of another shape.

        Args:
            method: name of the method that returned it.
            description: description of the value.
            value: the value.
            shape: the required shape.
        """
        if not isinstance(value, jax.Array | np.ndarray):
            raise self.error(method, f"{description} that is a {type(value).__name__}", f"an array of shape {shape}")
        array = np.asarray(value)
        if array.shape != shape:
            raise self.error(method, f"{description} of shape {array.shape}", f"one of shape {shape}")
        if array.dtype.kind not in "iuf" or not np.all(np.isfinite(array)):
            raise self.error(method, f"{description} {array.tolist()}", "finite real numbers")

    def check_memory(self, method: str, before: Any, after: Any) -> None:
        """Raise ScenarioError if a memory changes its shapes or types.

        Args:
            method: name of the method that returned `after`.
            before: the memory that it received.
            after: the memory that it returned.
        """
        expected, found = (jax.tree.map(_type_and_shape, tree) for tree in (before, after))
        if expected != found:
            raise self.error(method, f"a memory {found}", f"one as begin does, {expected}")


def _check_tracing(function: Callable, args: tuple) -> None:
    """Raise the errors that a method raises in a run, when its arguments and the fields of its object are traced."""
    owner = getattr(function, "__self__", function)
    if jax.tree_util.all_leaves([owner]):  # an object that is not a pytree has no fields to trace
        jax.eval_shape(function, *args)
        return
    unbound = getattr(function, "__func__", type(owner).__call__)
    jax.eval_shape(lambda owner, args: unbound(owner, *args), owner, args)


def _type_and_shape(value: Any) -> str:
    """Return the type and shape of an array, such as f64(3,)."""
    return f"{value.dtype.name.replace('float', 'f')}{value.shape}"


def _describe(returned: Any) -> str:
    """Describe a returned value in words."""
    if returned is None:
        return "nothing"
    if isinstance(returned, jax.Array):
        return f"an array of shape {returned.shape}"
    if isinstance(returned, tuple | list):
        return f"{'a list of ' if isinstance(returned, list) else ''}{len(returned)} values"
    return f"a {type(returned).__name__}"


def _describe_change(parts: Parts, changed: Parts) -> str:
    """Describe the first part whose structure has changed."""
    for field in dataclasses.fields(parts):
        before, after = (getattr(either, field.name) for either in (parts, changed))
        if jax.tree.structure(before) != jax.tree.structure(after):
            return f"{field.name} {_describe_part(after)} instead of {_describe_part(before)}"
    return "a different structure"


def _describe_part(part: Any) -> str:
    return "absent" if part is None else _describe(part)


def _check_disturbance(parts: Parts, signal: Any, call: _Checker) -> None:
    d = call("__call__", signal, jnp.zeros_like(parts.t_end), parts.initial)
    call.check_array("__call__", "a disturbance", d, (parts.plant.inputs,))


def _check_reference(parts: Parts, call: _Checker) -> None:
    q = call("attitude", parts.reference.attitude, jnp.zeros_like(parts.t_end))
    call.check_array("attitude", "an attitude", q, (4,))
    if abs(float(jnp.sum(q * q)) - 1.0) > 1e-9:
        raise call.error("attitude", f"the quaternion {np.asarray(q).tolist()}", "one of length 1")
    target = call("attitude", parts.reference, jnp.zeros_like(parts.t_end))
    call.check_array("attitude", "an attitude whose second derivative is", target.w_dot, (3,))


def _check_sensors(parts: Parts, call: _Checker) -> None:
    custom, zero = parts.sensors.custom, jnp.zeros(())
    x = parts.controller.kinematics.align(parts.plant.visible(parts.initial), parts.reference(zero))
    memory = call("begin", custom.begin, x)
    period = jnp.asarray(parts.period)
    returned = call("see", custom.see, memory, x, jnp.zeros(custom.draws), zero, period)
    if not isinstance(returned, tuple) or len(returned) != 2:
        raise call.error("see", _describe(returned), "two values, the measured state and its memory")
    expected, found = (jax.tree.map(_type_and_shape, one) for one in (jax.tree.map(jnp.asarray, x), returned[0]))
    if expected != found:
        raise call.error("see", f"a state {found}", f"one as the plant's, {expected}")
    call.check_memory("see", memory, returned[1])
    first = call("see", custom.see, memory, x, jnp.zeros(custom.draws), zero, zero)
    for (measured, _), occasion in ((returned, ""), (first, ", also at the first sample, where dt is 0")):
        if not all(np.all(np.isfinite(v)) for v in jax.tree.leaves(measured)):
            raise call.error("see", f"a state {jax.tree.map(np.asarray, measured)}", f"finite numbers{occasion}")


def _check_draw(parts: Parts, dispersion: Dispersion, call: _Checker) -> None:
    custom: Any = dispersion.custom
    row_names = {*RESULT_COLUMNS, *RESULT_COLUMNS.values()}
    used_names = {"status", "reason", "bad_time", *row_names, *CATALOGUE, *dispersion.values(parts)}
    c = jnp.full(custom.count, 0.5)
    changed = call("at", custom.at, c, parts)
    before, after = (jax.tree.map(lambda v: _type_and_shape(jnp.asarray(v)), tree) for tree in (parts, changed))
    if jax.tree.structure(before) != jax.tree.structure(after):
        shown = f"parts with {_describe_change(parts, changed)}" if isinstance(changed, Parts) else _describe(changed)
        raise call.error("at", shown, "the same parts with other numbers (use dataclasses.replace)")
    for expected, found, value in zip(*map(jax.tree.leaves, (before, after, changed)), strict=True):
        if expected != found:
            raise call.error("at", f"parts with {found} instead of {expected}", "numbers of the same shapes")
        if not np.all(np.isfinite(value)):
            raise call.error("at", "parts with numbers that are not finite", "finite ones")
    values = call("values", custom.values, c)
    if not isinstance(values, dict) or not all(isinstance(name, str) for name in values):
        raise call.error("values", _describe(values), "a dict of numbers by name")
    for name, value in values.items():
        call.check_array("values", f"a number {name}", value, ())
        if name in used_names:
            raise call.error("values", f"a number {name}", "a name that no column of the result file has")
        if not is_column_name(name):
            raise call.error("values", f"a number {name!r}", "a printable name")


def _check_observer(parts: Parts, call: _Checker) -> None:
    observer, m = parts.observer, parts.plant.inputs
    memory = call("begin", observer.begin)
    period = jnp.asarray(parts.period)
    new_memory = call("step", observer.step, memory, jnp.zeros(m), period, period)
    call.check_memory("step", memory, new_memory)
    call.check_array("estimate", "an estimate", call("estimate", observer.estimate, new_memory), (m,))
    bound = observer.error_bound()
    if not isinstance(bound, Bound):
        allowed = "a bound such as ptsmc_jax.observers.base.constant_bound(K, components)"
        raise call.error("error_bound", _describe(bound), allowed)
    call.check_array("error_bound", "a bound", call("error_bound", bound.__call__, period), ())


def _check_law(parts: Parts, call: _Checker) -> None:
    law: Any = parts.controller
    zero, m = jnp.zeros_like(parts.t_end), parts.plant.inputs
    target = parts.reference(zero)
    x = law.kinematics.align(parts.plant.visible(parts.initial), target)
    k2, memory = parts.observer.error_bound()(zero), call("begin", law.begin)
    now = Sample(zero, jnp.asarray(False), jnp.asarray(parts.period), memory)
    expected = ("an acceleration", "a sliding variable", *(() if memory is None else ("its memory",)))
    method, function, arguments = "acceleration", law.acceleration, (now, *law.kinematics.errors(x, target), k2)
    if type(law).__call__ is not Law.__call__:
        expected = ("an input", "a sliding variable", "its memory")
        method, function, arguments = "__call__", law.__call__, (now, x, target, jnp.zeros(m), k2)
    returned = call(method, function, *arguments)
    if not isinstance(returned, tuple) or len(returned) != len(expected):
        raise call.error(method, _describe(returned), f"({', '.join(expected)})")
    call.check_array(method, expected[0], returned[0], (m,))
    call.check_array(method, expected[1], returned[1], (m,))
    if len(expected) == 3:
        call.check_memory(method, memory, returned[2])


_CHECKS = {  # by table
    "reference": _check_reference,
    "sensors": _check_sensors,
    "observer": _check_observer,
    "controller": _check_law,
}
