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

from ptsmc_jax.dispersions.table_rows import OF_ROWS
from ptsmc_jax.dispersions.variation import Dispersion
from ptsmc_jax.laws.base import Law, Sample
from ptsmc_jax.observers.base import Bound
from ptsmc_jax.plants.base import check_indices
from ptsmc_jax.plants.second_order import INSTEAD, TRACED
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
    acting = iter(parts.disturbance.terms if isinstance(parts.disturbance, Sum) else (parts.disturbance,))
    for place, term in scenario.placed_terms.items():
        if isinstance(term, Custom):
            _disturbance(parts, next(one for one in acting if isinstance(one, term.made)), _Asked(place, term))
    for name, table in tables.items():
        if isinstance(table, Custom):
            _OF[name](parts, _Asked(name, table))

    if dispersion.custom is not None:
        _draw(parts, dispersion, _Asked("dispersion.custom", getattr(scenario.dispersion, "custom", None)))


def what_fails(error: BaseException, file: str) -> str:
    """Return the reason why custom code in a file failed when it was called or traced, as the end of a sentence."""
    if isinstance(error, TRACED):
        line = systems.line(error, file)
        return f"needs the value of a traced number, which is known only during the simulation{line}; {INSTEAD}"
    if isinstance(error, jax.errors.UnexpectedTracerError):
        return "stores a traced number outside its memory; it may use only its arguments and its memory"
    return f"fails: {systems.failure(error, file)}"


def names_column(name: str) -> bool:
    """Whether a name can be the heading of a column."""
    return name.isprintable() and bool(name.strip())


class _Asked:
    """Calls methods of a custom class and validates what they return."""

    def __init__(self, name: str, table: Any):
        shown = brief(table.code) if isinstance(table.code, str) else table.made.__name__
        self._beginning, self._made = f"{name}.code is {shown}, but its", table.made

    def __call__(self, method: str, function: Callable, *args: Any) -> Any:
        try:
            function(*args)
            _trace(function, args)
            returned = jax.tree.map(
                jnp.asarray, function(*args)
            )  # fails if the function stored a traced value in the first call
            check_indices(function, *args)
            return returned
        except (Exception, SystemExit) as error:
            reason = what_fails(error, inspect.getsourcefile(self._made) or "")
            raise ScenarioError(f"{self._beginning} {method} {reason}") from None

    def refused(self, method: str, returns: str, must: str) -> ScenarioError:
        """Return the error for a returned value.

        Args:
            method: name of the method.
            returns: description of the returned value.
            must: description of the required value.
        """
        return ScenarioError(f"{self._beginning} {method} returns {returns} at t = 0, but must return {must}")

    def check(self, method: str, what: str, value: Any, shape: tuple[int, ...]) -> None:
        """Raise ScenarioError if a value is not an array, not finite, or of another shape.

        Args:
            method: name of the method that returned it.
            what: description of the value.
            value: the value.
            shape: the required shape.
        """
        if not isinstance(value, jax.Array | np.ndarray):
            raise self.refused(method, f"{what} that is a {type(value).__name__}", f"an array of shape {shape}")
        got = np.asarray(value)
        if got.shape != shape:
            raise self.refused(method, f"{what} of shape {got.shape}", f"one of shape {shape}")
        if got.dtype.kind not in "iuf" or not np.all(np.isfinite(got)):
            raise self.refused(method, f"{what} {got.tolist()}", "finite real numbers")

    def same_memory(self, method: str, before: Any, after: Any) -> None:
        """Raise ScenarioError if a memory changes its shapes or types.

        Args:
            method: name of the method that returned `after`.
            before: the memory that it received.
            after: the memory that it returned.
        """
        was, now = (jax.tree.map(_kind, tree) for tree in (before, after))
        if was != now:
            raise self.refused(method, f"a memory {now}", f"one as begin does, {was}")


def _trace(function: Callable, args: tuple) -> None:
    """Raise the errors that a method raises in a run, when its arguments and the fields of its object are traced."""
    holder = getattr(function, "__self__", function)
    if jax.tree_util.all_leaves([holder]):  # an object that is not a pytree has no fields to trace
        jax.eval_shape(function, *args)
        return
    called = getattr(function, "__func__", type(holder).__call__)
    jax.eval_shape(lambda holder, args: called(holder, *args), holder, args)


def _kind(value: Any) -> str:
    """Return the type and shape of an array, such as f64(3,)."""
    return f"{value.dtype.name.replace('float', 'f')}{value.shape}"


def _described(returned: Any) -> str:
    """Describe a returned value in words."""
    if returned is None:
        return "nothing"
    if isinstance(returned, jax.Array):
        return f"an array of shape {returned.shape}"
    if isinstance(returned, tuple | list):
        return f"{'a list of ' if isinstance(returned, list) else ''}{len(returned)} values"
    return f"a {type(returned).__name__}"


def _changed(parts: Parts, drawn: Parts) -> str:
    """Describe the first part whose structure has changed."""
    for field in dataclasses.fields(parts):
        was, now = (getattr(one, field.name) for one in (parts, drawn))
        if jax.tree.structure(was) != jax.tree.structure(now):
            return f"{field.name} {_kind_of(now)} instead of {_kind_of(was)}"
    return "a different structure"


def _kind_of(part: Any) -> str:
    return "absent" if part is None else _described(part)


def _disturbance(parts: Parts, signal: Any, ask: _Asked) -> None:
    d = ask("__call__", signal, jnp.zeros_like(parts.t_end), parts.initial)
    ask.check("__call__", "a disturbance", d, (parts.plant.inputs,))


def _reference(parts: Parts, ask: _Asked) -> None:
    q = ask("attitude", parts.reference.attitude, jnp.zeros_like(parts.t_end))
    ask.check("attitude", "an attitude", q, (4,))
    if abs(float(jnp.sum(q * q)) - 1.0) > 1e-9:
        raise ask.refused("attitude", f"the quaternion {np.asarray(q).tolist()}", "one of length 1")
    target = ask("attitude", parts.reference, jnp.zeros_like(parts.t_end))
    ask.check("attitude", "an attitude whose second derivative is", target.w_dot, (3,))


def _sensors(parts: Parts, ask: _Asked) -> None:
    custom, zero = parts.sensors.custom, jnp.zeros(())
    x = parts.controller.kinematics.align(parts.plant.visible(parts.initial), parts.reference(zero))
    memory = ask("begin", custom.begin, x)
    period = jnp.asarray(parts.period)
    returned = ask("see", custom.see, memory, x, jnp.zeros(custom.draws), zero, period)
    if not isinstance(returned, tuple) or len(returned) != 2:
        raise ask.refused("see", _described(returned), "two values, the measured state and its memory")
    was, now = (jax.tree.map(_kind, one) for one in (jax.tree.map(jnp.asarray, x), returned[0]))
    if was != now:
        raise ask.refused("see", f"a state {now}", f"one as the plant's, {was}")
    ask.same_memory("see", memory, returned[1])
    first = ask("see", custom.see, memory, x, jnp.zeros(custom.draws), zero, zero)
    for (seen, _), where in ((returned, ""), (first, ", also at the first sample, where dt is 0")):
        if not all(np.all(np.isfinite(v)) for v in jax.tree.leaves(seen)):
            raise ask.refused("see", f"a state {jax.tree.map(np.asarray, seen)}", f"finite numbers{where}")


def _draw(parts: Parts, dispersion: Dispersion, ask: _Asked) -> None:
    custom: Any = dispersion.custom
    taken = {"status", "reason", "bad_time", *OF_ROWS, *OF_ROWS.values(), *CATALOGUE, *dispersion.values(parts)}
    c = jnp.full(custom.count, 0.5)
    drawn = ask("at", custom.at, c, parts)
    was, now = (jax.tree.map(lambda v: _kind(jnp.asarray(v)), one) for one in (parts, drawn))
    if jax.tree.structure(was) != jax.tree.structure(now):
        what = f"parts with {_changed(parts, drawn)}" if isinstance(drawn, Parts) else _described(drawn)
        raise ask.refused("at", what, "the same parts with other numbers (use dataclasses.replace)")
    for one, other, value in zip(*map(jax.tree.leaves, (was, now, drawn)), strict=True):
        if one != other:
            raise ask.refused("at", f"parts with {other} instead of {one}", "numbers of the same shapes")
        if not np.all(np.isfinite(value)):
            raise ask.refused("at", "parts with numbers that are not finite", "finite ones")
    values = ask("values", custom.values, c)
    if not isinstance(values, dict) or not all(isinstance(name, str) for name in values):
        raise ask.refused("values", _described(values), "a dict of numbers by name")
    for name, value in values.items():
        ask.check("values", f"a number {name}", value, ())
        if name in taken:
            raise ask.refused("values", f"a number {name}", "a name that no column of the result file has")
        if not names_column(name):
            raise ask.refused("values", f"a number {name!r}", "a printable name")


def _observer(parts: Parts, ask: _Asked) -> None:
    observer, m = parts.observer, parts.plant.inputs
    memory = ask("begin", observer.begin)
    period = jnp.asarray(parts.period)
    kept = ask("step", observer.step, memory, jnp.zeros(m), period, period)
    ask.same_memory("step", memory, kept)
    ask.check("estimate", "an estimate", ask("estimate", observer.estimate, kept), (m,))
    bound = observer.error_bound()
    if not isinstance(bound, Bound):
        must = "a bound such as ptsmc_jax.observers.base.constant_bound(K, components)"
        raise ask.refused("error_bound", _described(bound), must)
    ask.check("error_bound", "a bound", ask("error_bound", bound.__call__, period), ())


def _law(parts: Parts, ask: _Asked) -> None:
    law: Any = parts.controller
    zero, m = jnp.zeros_like(parts.t_end), parts.plant.inputs
    target = parts.reference(zero)
    x = law.kinematics.align(parts.plant.visible(parts.initial), target)
    k2, memory = parts.observer.error_bound()(zero), ask("begin", law.begin)
    now = Sample(zero, jnp.asarray(False), jnp.asarray(parts.period), memory)
    expected = ("an acceleration", "a sliding variable", *(() if memory is None else ("its memory",)))
    method, function, arguments = "acceleration", law.acceleration, (now, *law.kinematics.errors(x, target), k2)
    if type(law).__call__ is not Law.__call__:
        expected = ("an input", "a sliding variable", "its memory")
        method, function, arguments = "__call__", law.__call__, (now, x, target, jnp.zeros(m), k2)
    returned = ask(method, function, *arguments)
    if not isinstance(returned, tuple) or len(returned) != len(expected):
        raise ask.refused(method, _described(returned), f"({', '.join(expected)})")
    ask.check(method, expected[0], returned[0], (m,))
    ask.check(method, expected[1], returned[1], (m,))
    if len(expected) == 3:
        ask.same_memory(method, memory, returned[2])


_OF = {"reference": _reference, "sensors": _sensors, "observer": _observer, "controller": _law}  # check of each table
