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
from jax.typing import ArrayLike

from ptsmc_jax.dispersions.variation import RESULT_COLUMNS, Dispersion
from ptsmc_jax.laws.base import Law, Sample
from ptsmc_jax.observers.base import Bound
from ptsmc_jax.plants.base import check_indices
from ptsmc_jax.plants.second_order import TRACING_ADVICE, TRACING_ERRORS
from ptsmc_jax.scenario import systems
from ptsmc_jax.scenario.custom import Custom
from ptsmc_jax.scenario.errors import ScenarioError, brief
from ptsmc_jax.scenario.tables import Scenario
from ptsmc_jax.signals.disturbances import Disturbance, Sum
from ptsmc_jax.simulation.catalogues import CATALOGUE
from ptsmc_jax.simulation.rollout import Parts


def check(parts: Parts, dispersion: Dispersion, scenario: Scenario) -> None:
    """Raise ScenarioError if a custom part fails at t = 0 or returns values that a run cannot use.

    Args:
        parts: the parts of a run.
        dispersion: its dispersions, which may be custom too.
        scenario: the scenario that they are built from.
    """
    signals = iter(parts.disturbance.terms if isinstance(parts.disturbance, Sum) else (parts.disturbance,))
    for place, term in scenario.terms_by_place.items():
        if isinstance(term, Custom):
            signal = next(one for one in signals if isinstance(one, term.part_class))
            _check_disturbance(parts, signal, _Checker(place, term))
    for name, check_part in _CHECKS.items():
        table = getattr(scenario, name, None)
        if isinstance(table, Custom):
            check_part(parts, _Checker(name, table))
    if dispersion.custom is not None:
        _check_draw(parts, dispersion, _Checker("dispersion.custom", getattr(scenario.dispersion, "custom", None)))


def describe_missing_derivative(parts: Parts, scenario: Scenario) -> str | None:
    """Return in words that the derivatives of a custom law by the error are zero, or None if they are not.

    The derivatives of the discontinuous sign, of a rounded number and of `stop_gradient` are zero, although the law
    reacts to the error. They are evaluated at several errors, because derivatives are also zero beyond a limit and in a
    dead zone. A law with `__call__` is not checked.

    Args:
        parts: the parts of a run.
        scenario: the scenario that they are built from.

    Raises:
        ScenarioError: JAX cannot differentiate the law.
    """
    if not _has_custom_acceleration(parts, scenario):
        return None
    differentiate, _, errors = _derivatives_of_law(parts)
    points = [jax.tree.map(lambda v, k=k: k * jnp.where(v == 0.0, 0.1, v), errors) for k in (1.0, 0.1, 1e-3, 1e-6)]
    beginning = f"{_Checker('controller', scenario.controller).beginning} acceleration"
    try:
        for point in points:
            for hold in (False, True):
                if any(np.any(np.asarray(v) != 0.0) for v in jax.tree.leaves(differentiate({}, point, hold))):
                    return None
    except Exception as error:  # for example jax.pure_callback
        raise ScenarioError(f"{beginning} cannot be differentiated: {systems.describe_failure(error, '')}") from None
    return (
        f"{beginning} has zero derivatives by the error; use jax.numpy.tanh(s / width) instead of sign, and neither "
        "round nor stop_gradient"
    )


def describe_infinite_derivative(parts: Parts, scenario: Scenario) -> str | None:
    """Return in words that a custom law has a derivative at its first sample that is not finite, or None.

    Args:
        parts: the parts of a run.
        scenario: the scenario that they are built from.
    """
    if not _has_custom_acceleration(parts, scenario):
        return None
    differentiate, gains, errors = _derivatives_of_law(parts)
    if all(np.all(np.isfinite(v)) for v in jax.tree.leaves(differentiate(gains, errors, False))):
        return None
    return (
        f"{_Checker('controller', scenario.controller).beginning} acceleration has a derivative at t = 0 that is not "
        "finite; add a small constant inside a square root or a norm, whose derivative at zero is not finite"
    )


def _has_custom_acceleration(parts: Parts, scenario: Scenario) -> bool:
    """Return whether the law is custom and defines `acceleration`, but not `__call__`."""
    return isinstance(scenario.controller, Custom) and type(parts.controller).__call__ is Law.__call__


def _derivatives_of_law(parts: Parts) -> tuple[Callable, dict[str, Any], tuple[Any, Any]]:
    """Return the derivatives of a law's acceleration and memory at t = 0, its gains by name, and the initial errors.

    The derivatives are a function of gains by name, the errors (eps, eps') and whether the sample is in the hold phase.
    They are by these gains and errors.
    """
    law: Any = parts.controller
    zero = jnp.zeros_like(parts.t_end)
    target = parts.reference(zero)
    k2 = parts.observer.error_bound()(zero)

    def outputs(gains: dict[str, Any], errors: tuple[Any, Any], hold: Any) -> list[Any]:
        now = Sample(zero, jnp.asarray(hold), jnp.asarray(parts.period), law.begin())
        a, _, *memory = dataclasses.replace(law, **gains).acceleration(now, *errors, k2)
        return [v for v in jax.tree.leaves((a, memory)) if jnp.issubdtype(jnp.result_type(v), jnp.inexact)]

    errors = law.kinematics.errors(law.kinematics.align(parts.plant.visible(parts.initial), target), target)
    gains = {name: jnp.asarray(getattr(law, name)) for name in law.tunable}
    return jax.jit(jax.jacfwd(outputs, argnums=(0, 1))), gains, errors


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
        self.beginning, self._made = f"{name}.code is {shown}, whose", table.part_class

    def __call__(self, method: str, function: Callable, *args: object) -> Any:
        """Return the value of a method of the custom class, after it has also been traced.

        Args:
            method: name of the method, for errors.
            function: the method.
            args: its arguments.

        Raises:
            ScenarioError: the method fails.
        """
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
            raise ScenarioError(f"{self.beginning} {method} {reason}") from None

    def error(self, method: str, returned: str, allowed: str) -> ScenarioError:
        """Return the error for a returned value.

        Args:
            method: name of the method.
            returned: description of the returned value.
            allowed: description of the required value.
        """
        return ScenarioError(f"{self.beginning} {method} returns {returned} at t = 0, but must return {allowed}")

    def check(self, method: str, allowed: str, value: object, example: object, *, exact: bool = False) -> None:
        """Raise ScenarioError if a value has not the structure and shapes of an example.

        Args:
            method: name of the method that returned it.
            allowed: description of the required value.
            value: the value.
            example: a pytree of arrays.
            exact: whether types of numbers must be equal, too, as in a memory. Otherwise real numbers are required.
        """
        found, expected = _describe(value, exact), _describe(example, exact)
        if found != expected:
            raise self.error(method, found, f"{allowed}, of the form {expected}")

    def check_finite(self, method: str, value: object, occasion: str = "") -> None:
        """Raise ScenarioError if a pytree has numbers that are not finite; `occasion`: end of the sentence."""
        for number in map(np.asarray, jax.tree.leaves(value)):
            if not np.all(np.isfinite(number)):
                raise self.error(method, f"{number.tolist()}", f"finite numbers{occasion}")


def _check_tracing(function: Callable, args: tuple) -> None:
    """Raise the errors that a method raises in a run, when its arguments and the fields of its object are traced."""
    owner = getattr(function, "__self__", function)
    if jax.tree_util.all_leaves([owner]):  # an object that is not a pytree has no fields to trace
        jax.eval_shape(function, *args)
        return
    unbound = getattr(function, "__func__", type(owner).__call__)
    jax.eval_shape(lambda owner, args: unbound(owner, *args), owner, args)


def _describe(value: object, exact: bool) -> str:
    """Return the structure of a pytree with the type and shape of each array, such as (f64(3,), nothing)."""

    def describe_array(array: ArrayLike) -> str:
        array = np.asarray(array)
        is_real = array.dtype.kind in "iuf" and not exact
        return f"{'real' if is_real else array.dtype.name.replace('float', 'f')}{array.shape}"

    return str(jax.tree.map(describe_array, value)).replace("'", "").replace("None", "nothing")


def _check_disturbance(parts: Parts, signal: Disturbance, call: _Checker) -> None:
    """Check the value of a custom disturbance at t = 0: (inputs,) finite numbers."""
    d = call("__call__", signal, jnp.zeros_like(parts.t_end), parts.initial)
    call.check("__call__", "a number for each input", d, jnp.zeros(parts.plant.inputs))
    call.check_finite("__call__", d)


def _check_reference(parts: Parts, call: _Checker) -> None:
    """Check that a custom reference has a unit quaternion (4,) with two finite derivatives."""
    q = call("attitude", parts.reference.attitude, jnp.zeros_like(parts.t_end))
    call.check("attitude", "a quaternion", q, jnp.zeros(4))
    if not abs(float(jnp.sum(q * q)) - 1.0) < 1e-9:
        raise call.error("attitude", f"{q.tolist()}", "a quaternion of length 1")
    target = call("attitude", parts.reference, jnp.zeros_like(parts.t_end))
    call.check_finite("attitude", target, " with two finite derivatives")


def _check_sensors(parts: Parts, call: _Checker) -> None:
    """Check `begin` and `see` of custom sensors: shapes, types and finite values.

    `see` is called for a control period, and for dt = 0 as at the first sample.
    """
    custom, zero = parts.sensors.custom, jnp.zeros(())
    x = parts.controller.kinematics.align(parts.plant.visible(parts.initial), parts.reference(zero))
    memory = call("begin", custom.begin, x)
    for dt, occasion in ((jnp.asarray(parts.period), ""), (zero, ", also at the first sample, where dt is 0")):
        returned = call("see", custom.see, memory, x, jnp.zeros(custom.draws), zero, dt)
        call.check("see", "the measured state and the memory", returned, (x, memory), exact=True)
        call.check_finite("see", returned[0], occasion)


def _check_draw(parts: Parts, dispersion: Dispersion, call: _Checker) -> None:
    """Check `at` and `values` of custom dispersions: the parts keep their structure, and names of columns are new."""
    custom: Any = dispersion.custom
    c = jnp.full(custom.count, 0.5)
    changed = call("at", custom.at, c, parts)
    if jax.tree.structure(parts) != jax.tree.structure(changed):
        names = [field.name for field in dataclasses.fields(parts) if isinstance(changed, Parts)]
        trees = {name: (getattr(parts, name), getattr(changed, name)) for name in names}
        differing = [name for name, trees in trees.items() if len(set(map(jax.tree.structure, trees))) > 1]
        shown = f"parts with another {' and '.join(differing)}" if differing else f"a {type(changed).__name__}"
        raise call.error("at", shown, "the same parts with other numbers (use dataclasses.replace)")
    for before, after in zip(jax.tree.leaves(parts), jax.tree.leaves(changed), strict=True):
        call.check("at", "parts with numbers of the same shapes", after, before, exact=True)
        call.check_finite("at", after)
    values = call("values", custom.values, c)
    names = values if isinstance(values, dict) else ()
    call.check("values", "a dict of numbers by name", values, dict.fromkeys(names, 0.0))
    call.check_finite("values", values)
    row_names = {*RESULT_COLUMNS, *RESULT_COLUMNS.values()}
    used_names = {"status", "reason", "bad_time", *row_names, *CATALOGUE, *dispersion.values(parts)}
    for name in names:
        if not isinstance(name, str) or name in used_names or not is_column_name(name):
            raise call.error("values", f"a number {name!r}", "printable names that no column of the result file has")


def _check_observer(parts: Parts, call: _Checker) -> None:
    """Check `begin`, `step`, `estimate` and `error_bound` of a custom observer."""
    observer, m = parts.observer, parts.plant.inputs
    memory = call("begin", observer.begin)
    period = jnp.asarray(parts.period)
    new_memory = call("step", observer.step, memory, jnp.zeros(m), period, period)
    call.check("step", "a memory as begin does", new_memory, memory, exact=True)
    estimate = call("estimate", observer.estimate, new_memory)
    call.check("estimate", "a number for each input", estimate, jnp.zeros(m))
    bound = observer.error_bound()
    if not isinstance(bound, Bound):
        allowed = "a bound such as ptsmc_jax.observers.base.constant_bound(K, components)"
        raise call.error("error_bound", f"a {type(bound).__name__}", allowed)
    largest = call("error_bound", bound.__call__, period)
    call.check("error_bound", "a number", largest, period)
    call.check_finite("error_bound", (estimate, largest))


def _check_law(parts: Parts, call: _Checker) -> None:
    """Check `begin` and `acceleration` of a custom law, or its own `__call__` instead of `acceleration`."""
    law: Any = parts.controller
    zero, u = jnp.zeros_like(parts.t_end), jnp.zeros(parts.plant.inputs)
    target = parts.reference(zero)
    x = law.kinematics.align(parts.plant.visible(parts.initial), target)
    k2, memory = parts.observer.error_bound()(zero), call("begin", law.begin)
    now = Sample(zero, jnp.asarray(False), jnp.asarray(parts.period), memory)
    method, function, arguments = "acceleration", law.acceleration, (now, *law.kinematics.errors(x, target), k2)
    has_memory = memory is not None
    if type(law).__call__ is not Law.__call__:
        method, function, arguments, has_memory = "__call__", law.__call__, (now, x, target, u, k2), True
    try:
        returned = call(method, function, *arguments)
    except ScenarioError as error:
        if memory is None and "NoneType" in str(error):
            raise ScenarioError(f"{error}; a law that uses now.memory needs a method begin") from None
        raise
    first = f"an {'acceleration' if method == 'acceleration' else 'input'}"
    example = (u, u, memory) if has_memory else (u, u)
    allowed = f"{first}, a sliding variable and its memory" if has_memory else f"{first} and a sliding variable"
    call.check(method, allowed, returned, example)
    call.check_finite(method, returned[:2])
    call.check(method, "a memory as begin does", returned[2:], example[2:], exact=True)


_CHECKS = {  # by table
    "reference": _check_reference,
    "sensors": _check_sensors,
    "observer": _check_observer,
    "controller": _check_law,
}
