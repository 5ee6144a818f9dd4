"""The disturbance bounds of Assumption 1 from a scenario's disturbance and its dispersions. Start with `compute`.

K bounds each component of d, and c bounds each component of d'. The published bounds, 0.01 N m and 1e-3 N m/s, belong
to the disturbance 0.01 sin(0.1 t) of Case I. Each disturbance table has a method `bounds`, and the bounds of a sum add
up.
"""

import math
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np

from ptsmc_jax.declare import Scaled
from ptsmc_jax.numerics import attitude
from ptsmc_jax.plants.rigid_body import AttitudeState
from ptsmc_jax.scenario import attitude_keys, mission
from ptsmc_jax.scenario.errors import ScenarioError
from ptsmc_jax.scenario.values import MOST_STEPS
from ptsmc_jax.signals import disturbances

PUBLISHED_RATE = 10.0 / 12.0  # l / J of the published observer [1/s], with a mean moment of inertia of 12 kg m^2
SIGMAS = 3.0  # standard deviations that count as the largest value of a normal random number
FEWEST_TIMES = 2001  # smallest number of times at which a custom disturbance is evaluated
LARGEST_PHASE_STEP = 0.1  # largest phase between two of these times [rad]: the error of the derivative is then 0.2 %
PHASE_COUNT = 16  # random phases at which a custom disturbance is evaluated


class Bounds(NamedTuple):
    """Largest magnitude and rate of each component of a disturbance."""

    size: np.ndarray  # (m,) largest magnitude of d [N m, or unit of d]
    rate: np.ndarray  # (m,) largest magnitude of d' [the same per second]


def compute(scenario: Any) -> tuple[float, float] | None:
    """Return K [N m, or unit of d] and c [the same per second] of a scenario's disturbance.

    The result is None if the disturbance, or the reference that determines it, is custom code that has not run yet.

    Raises:
        ScenarioError: a bound overflows.
    """
    inputs = scenario.inputs
    with np.errstate(over="ignore"):
        bounds = [term.bounds(scenario) for term in scenario.terms]
        known = [term_bounds for term_bounds in bounds if term_bounds is not None]
        if len(known) < len(bounds):
            return None
        bias = getattr(scenario.dispersion, "disturbance_bias", None)
        largest_bias = 0.0 if bias is None else bias.largest
        largest = sum((term_bounds.size for term_bounds in known), np.zeros(inputs)) + largest_bias
        fastest = sum((term_bounds.rate for term_bounds in known), np.zeros(inputs))
    if not np.all(np.isfinite([largest, fastest])):
        raise ScenarioError("disturbance has an infinite amplitude or rate; allowed are smaller numbers in the table")
    return float(np.max(largest)), float(np.max(fastest))


def largest_factor(scenario: Any) -> float:
    """Return the largest random factor on the disturbance's amplitude."""
    amplitude = getattr(scenario.dispersion, "disturbance_amplitude", None)
    return 1.0 if amplitude is None else 1.0 + amplitude.largest


def observer_rate(scenario: Any) -> float:
    """Return l / J of the published observer [1/s], scaled to the mission and at most 1 / h.

    For a plant without a body the published rate is 10 1/s.
    """
    rate = mission.scales(scenario).scaled_value(
        Scaled(10.0 if scenario.moments[0] is None else PUBLISHED_RATE, time=-1)
    )
    return min(rate, 1.0 / scenario.loop.period) if scenario.sampled else rate


def observer_gain(scenario: Any) -> float:
    """Return the gain l of the published observer [N m s], scaled to the mission.

    The published gain is 10 N m s for a mean moment of 12 kg m^2.
    """
    return observer_rate(scenario) * scenario.mean_inertia


def has_unloaded_reference(scenario: Any) -> bool:
    """Whether the reference is custom code that has not run yet, so that its rate is unknown."""
    return getattr(getattr(scenario, "reference", None), "is_unloaded", False)


def gravity_gradient(scenario: Any, orbit_rate: float, eccentricity: float = 0.0) -> Bounds:
    """Return bounds of the gravity-gradient torque 3 n^2 c x J c, where c is the unit vector to the central body.

    They follow from |c x J c| <= (J_3 - J_1) / 2 and |(c x J c)'| <= (J_3 - J_1) |c'|. J_1 and J_3 are the smallest and
    the largest principal moment of the true body. If the inertia is dispersed, J_1 is decreased and J_3 increased by
    three sigma. c moves in body axes with the rates of the orbit and of the body. The bound on the body rate is the sum
    of the initial rate, the rate of the reference, and 2 pi / t_f, which is twice the mean rate of half a turn within
    t_f.

    On an eccentric orbit the torque is largest at perigee, where 3 n^2 becomes 3 n^2 / (1 - e)^3. The relative rate of
    the distance is at most e times the angular rate of the radius vector at perigee.

    Args:
        scenario: a scenario of a spacecraft whose reference is known.
        orbit_rate: n [rad/s].
        eccentricity: e of the orbit [-].
    """
    inertia = np.asarray(scenario.true_inertia, dtype=float)
    moments = np.sort(inertia) if inertia.ndim == 1 else np.linalg.eigvalsh(inertia)
    inertia_dispersion = getattr(scenario.dispersion, "inertia", None)
    deviation = 0.0 if inertia_dispersion is None else SIGMAS * inertia_dispersion.std
    moment_difference = moments[2] * (1.0 + deviation) - moments[0] * (1.0 - deviation)
    e = eccentricity
    factor = 3.0 * orbit_rate * orbit_rate * moment_difference / (1.0 - e) ** 3
    perigee_rate = orbit_rate * math.sqrt(1.0 + e) / (1.0 - e) ** 1.5
    reference_rate = sum(scenario.reference.frequencies(scenario).values())
    body_rate = scenario.initial_rate_bound + reference_rate + 2.0 * math.pi / scenario.controller.t_f
    return Bounds(np.full(3, 0.5 * factor), np.full(3, factor * ((1.0 + 1.5 * e) * perigee_rate + body_rate)))


def path_bounds(scenario: Any, signal: Any, fastest: float = 0.0) -> Bounds:
    """Return the largest size and rate of a custom disturbance d(t, x) on the nominal path to the target.

    On that path the error falls like (t_f - t)^3 until t_f, then the state follows the target. Amplitudes and phases
    of the dispersions are included, see `_extreme_disturbances`. The bounds of a disturbance that fails, or is not
    finite at t = 0, are zero: `custom_checks` reports it before a run.

    Args:
        scenario: a scenario whose reference is known.
        signal: the disturbance, a function of t [s] and the plant's state.
        fastest: largest angular frequency of the disturbance [rad/s].

    Raises:
        ScenarioError: the disturbance is finite at t = 0 and not finite later on the path.
    """
    from ptsmc_jax.batching import lapack  # the import takes 0.1 s, and most scenarios do not need it

    steps = min(float(scenario.loop.t_end) * fastest / LARGEST_PHASE_STEP, MOST_STEPS)
    t = np.linspace(0.0, float(scenario.loop.t_end), max(FEWEST_TIMES, math.ceil(steps) + 1))
    remaining = np.clip(1.0 - t / scenario.controller.t_f, 0.0, 1.0) ** 3
    states = (
        remaining[:, None] * scenario.plant.x0 if scenario.moments[0] is None else _body_states(scenario, t, remaining)
    )
    largest = np.zeros((2, scenario.inputs))
    for disturbance in _extreme_disturbances(scenario, signal):
        try:
            values = np.asarray(lapack.vmap(disturbance)(jnp.asarray(t), jax.tree.map(jnp.asarray, states)))
        except Exception:  # `custom_checks` reports it before a run
            values = np.zeros(0)
        invalid = np.flatnonzero(~np.isfinite(values).all(axis=1)) if values.shape == (t.size, scenario.inputs) else [0]
        if len(invalid) and invalid[0] == 0:
            return Bounds(*np.zeros_like(largest))
        if len(invalid):
            raise ScenarioError(
                f"disturbance.code names a class {type(signal).__name__} whose __call__ returns "
                f"{values[invalid[0]].tolist()} at t = {t[invalid[0]]:.6g} s on the way to the target, but must return "
                "finite numbers"
            )
        sizes = (np.max(np.abs(samples), axis=0) for samples in (values, np.gradient(values, t, axis=0)))
        largest = np.maximum(largest, [*sizes])
    return Bounds(*largest)


def _extreme_disturbances(scenario: Any, signal: Any) -> list[Any]:
    """Return a custom disturbance with the smallest and the largest random amplitudes, at `PHASE_COUNT` phases."""
    extremes, largest = [signal], largest_factor(scenario)
    amplitudes, phases = disturbances.values(signal, "amplitude"), disturbances.values(signal, "phase")
    if largest != 1.0 and amplitudes.size:
        extremes = [disturbances.with_values(signal, "amplitude", amplitudes * k) for k in (largest, 2.0 - largest)]
    if getattr(scenario.dispersion, "disturbance_phase", None) is None or not phases.size:
        return extremes
    angles = np.linspace(0.0, 2.0 * np.pi, PHASE_COUNT, endpoint=False)
    return [disturbances.with_values(one, "phase", phases + angle) for one in extremes for angle in angles]


def _body_states(scenario: Any, t: np.ndarray, remaining: np.ndarray) -> Any:
    """Return the states of the body on the nominal path at times t (n,) [s].

    `remaining` (n,) is the remaining fraction of the initial rotation from the reference.
    """
    from ptsmc_jax.batching import lapack

    reference = scenario.reference.build(scenario)
    target = lapack.vmap(lambda time: reference(time).q)(jnp.asarray(t))
    start = jnp.asarray(attitude_keys.quaternion(scenario.initial, "initial"))
    rotation = attitude.multiply(attitude.conjugate(target[0]), start)
    rotation = rotation * jnp.where(rotation[3] < 0.0, -1.0, 1.0)
    turn = attitude.rotation_vector(rotation[:3])
    q = jax.vmap(lambda one, fraction: attitude.multiply(one, attitude.from_rotation_vector(fraction * turn)))(
        target, jnp.asarray(remaining)
    )
    q_dot = jnp.asarray(np.gradient(np.asarray(q), t, axis=0))
    w = 2.0 * jax.vmap(lambda one, rate: attitude.multiply(attitude.conjugate(one), rate)[:3])(q, q_dot)
    return AttitudeState(q, w)
