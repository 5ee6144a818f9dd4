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

RATE = 10.0 / 12.0  # l / J of the published observer [1/s], with a mean moment of inertia of 12 kg m^2
SIGMAS = 3.0  # standard deviations that count as the largest value of a normal random number
POINTS = 2001  # smallest number of times at which a custom disturbance is evaluated
FINE = 0.1  # largest phase between two of these times [rad]: the error of the derivative is then 0.2 %
PHASES = 16  # random phases at which a custom disturbance is evaluated


class Bounds(NamedTuple):
    """Largest magnitude and rate of each component of a disturbance."""

    size: np.ndarray  # (m,) of d [N m, or unit of d]
    rate: np.ndarray  # (m,) of d' [the same per second]


def compute(scenario: Any) -> tuple[float, float] | None:
    """Return K [N m, or unit of d] and c [the same per second] of a scenario's disturbance.

    The result is None if the disturbance, or the reference that determines it, is custom code that has not run yet.

    Raises:
        ScenarioError: a bound overflows.
    """
    inputs = scenario.inputs
    with np.errstate(over="ignore"):
        found = [term.bounds(scenario) for term in scenario.terms]
        known = [one for one in found if one is not None]
        if len(known) < len(found):
            return None
        largest = sum((one.size for one in known), np.zeros(inputs)) + _drawn_bias(scenario)
        fastest = sum((one.rate for one in known), np.zeros(inputs))
    if not np.all(np.isfinite([largest, fastest])):
        raise ScenarioError("disturbance has an infinite amplitude or rate; allowed are smaller numbers in the table")
    return float(np.max(largest)), float(np.max(fastest))


def drawn_factor(scenario: Any) -> float:
    """Return the largest random factor on the disturbance's amplitude."""
    drawn = getattr(scenario.dispersion, "disturbance_amplitude", None)
    return 1.0 if drawn is None else 1.0 + drawn.farthest * getattr(drawn, drawn.width)


def _drawn_bias(scenario: Any) -> float:
    drawn = getattr(scenario.dispersion, "disturbance_bias", None)
    return 0.0 if drawn is None else drawn.farthest * getattr(drawn, drawn.width)


def walk_rate(scenario: Any, density: np.ndarray) -> np.ndarray:
    """Return a bound c [unit of d/s] on the rate of a random walk, which has no exact bound.

    It is three sigma of the change of the walk over the time constant J / l of the default observer, divided by that
    time constant. With this c, K2 = c J / l covers three sigma of the estimate's error.

    Args:
        scenario: the scenario, for the observer's time constant.
        density: density of the walk (m,) [unit of d/sqrt(s)].
    """
    forgets = 1.0 / observer_rate(scenario)
    return SIGMAS * density / math.sqrt(forgets)


def observer_rate(scenario: Any) -> float:
    """Return l / J of the published observer [1/s], scaled to the mission and at most 1 / h.

    For a plant without a body the published rate is 10 1/s.
    """
    rate = mission.scales(scenario).of(Scaled(10.0 if scenario.moments[0] is None else RATE, time=-1))
    return min(rate, 1.0 / scenario.loop.period) if scenario.sampled else rate


def observer_gain(scenario: Any) -> float:
    """Return the gain l of the published observer [N m s], scaled to the mission.

    The published gain is 10 N m s for a mean moment of 12 kg m^2.
    """
    return observer_rate(scenario) * scenario.mean_inertia


def body_rate_bound(scenario: Any) -> float:
    """Return an approximate bound on the body rate [rad/s].

    It is the sum of the initial rate, the rate of the reference, and 2 pi / t_f, which is twice the mean rate of half a
    turn within t_f.
    """
    target = sum(scenario.reference.frequencies(scenario).values())
    return scenario.initial_rate_bound + target + 2.0 * math.pi / scenario.controller.t_f


def target_waits(scenario: Any) -> bool:
    """Whether the reference is custom code that has not run yet, so that its rate is unknown."""
    return getattr(getattr(scenario, "reference", None), "waits", False)


def gravity_gradient(scenario: Any, orbit_rate: float, eccentricity: float = 0.0) -> Bounds:
    """Return bounds of the gravity-gradient torque 3 n^2 c x J c, where c is the unit vector to the central body.

    They follow from |c x J c| <= (J_3 - J_1) / 2 and |(c x J c)'| <= (J_3 - J_1) |c'|. J_1 and J_3 are the smallest and
    the largest principal moment of the true body. If the inertia is dispersed, J_1 is decreased and J_3 increased by
    three sigma. c moves in body axes with the rates of the orbit and of the body.

    On an eccentric orbit the torque is largest at perigee, where 3 n^2 becomes 3 n^2 / (1 - e)^3. The relative rate of
    the distance is at most e times the angular rate of the radius vector at perigee.

    Args:
        scenario: a scenario of a spacecraft whose reference is known.
        orbit_rate: n [rad/s].
        eccentricity: e of the orbit [-].
    """
    inertia = np.asarray(scenario.true_inertia, dtype=float)
    moments = np.sort(inertia) if inertia.ndim == 1 else np.linalg.eigvalsh(inertia)
    drawn = getattr(scenario.dispersion, "inertia", None)
    off = 0.0 if drawn is None else SIGMAS * drawn.std
    apart = moments[2] * (1.0 + off) - moments[0] * (1.0 - off)
    e = eccentricity
    most = 3.0 * orbit_rate * orbit_rate * apart / (1.0 - e) ** 3
    perigee_rate = orbit_rate * math.sqrt(1.0 + e) / (1.0 - e) ** 1.5
    return Bounds(
        np.full(3, 0.5 * most), np.full(3, most * ((1.0 + 1.5 * e) * perigee_rate + body_rate_bound(scenario)))
    )


def along_the_run(scenario: Any, signal: Any, fastest: float = 0.0) -> Bounds:
    """Return the largest size and rate of a custom disturbance d(t, x) on the nominal path to the target.

    On that path the error falls like (t_f - t)^3 until t_f, then the state follows the target. Amplitudes and phases
    that the dispersions can draw are included, see `_as_drawn`. The bounds of a disturbance that fails, or is not
    finite at t = 0, are zero: `custom_checks` refuses it before a run.

    Args:
        scenario: a scenario whose reference is known.
        signal: the disturbance, a function of t [s] and the plant's state.
        fastest: how fast the disturbance changes [rad/s].

    Raises:
        ScenarioError: the disturbance is finite at t = 0 and not finite later on the path.
    """
    from ptsmc_jax.batching import lapack  # the import takes 0.1 s, and most scenarios do not need it

    needed = min(float(scenario.loop.t_end) * fastest / FINE, MOST_STEPS)
    t = np.linspace(0.0, float(scenario.loop.t_end), max(POINTS, math.ceil(needed) + 1))
    left = np.clip(1.0 - t / scenario.controller.t_f, 0.0, 1.0) ** 3
    states = left[:, None] * scenario.plant.x0 if scenario.moments[0] is None else _attitudes(scenario, t, left)
    largest = np.zeros((2, scenario.inputs))
    for drawn in _as_drawn(scenario, signal):
        try:
            acting = np.asarray(lapack.vmap(drawn)(jnp.asarray(t), jax.tree.map(jnp.asarray, states)))
        except Exception:  # `custom_checks` reports it before a run
            acting = np.zeros(0)
        bad = np.flatnonzero(~np.isfinite(acting).all(axis=1)) if acting.shape == (t.size, scenario.inputs) else [0]
        if len(bad) and bad[0] == 0:
            return Bounds(*np.zeros_like(largest))
        if len(bad):
            raise ScenarioError(
                f"disturbance.code names a class {type(signal).__name__} whose __call__ returns "
                f"{acting[bad[0]].tolist()} at t = {t[bad[0]]:.6g} s on the way to the target, but must return finite "
                "numbers"
            )
        sizes = (np.max(np.abs(d), axis=0) for d in (acting, np.gradient(acting, t, axis=0)))
        largest = np.maximum(largest, [*sizes])
    return Bounds(*largest)


def _as_drawn(scenario: Any, signal: Any) -> list[Any]:
    """Return a custom disturbance with the smallest and the largest random amplitudes, at `PHASES` phases."""
    found, most = [signal], drawn_factor(scenario)
    if most != 1.0 and disturbances.count(signal, "amplitude"):
        amplitudes = disturbances.values(signal, "amplitude")
        found = [disturbances.with_values(signal, "amplitude", amplitudes * k) for k in (most, 2.0 - most)]
    if getattr(scenario.dispersion, "disturbance_phase", None) is None or not disturbances.count(signal, "phase"):
        return found
    around, phases = np.linspace(0.0, 2.0 * np.pi, PHASES, endpoint=False), disturbances.values(signal, "phase")
    return [disturbances.with_values(one, "phase", phases + angle) for one in found for angle in around]


def _attitudes(scenario: Any, t: np.ndarray, left: np.ndarray) -> Any:
    """Return the states of the body on the nominal path at times t (n,) [s].

    `left` (n,) is the remaining fraction of the initial rotation from the reference.
    """
    from ptsmc_jax.batching import lapack

    reference = scenario.reference.build(scenario)
    target = lapack.vmap(lambda time: reference(time).q)(jnp.asarray(t))
    start = jnp.asarray(attitude_keys.quaternion(scenario.initial, "initial"))
    off = attitude.multiply(attitude.conjugate(target[0]), start)
    off = off * jnp.where(off[3] < 0.0, -1.0, 1.0)
    turned = attitude.rotation_vector(off[:3])
    q = jax.vmap(lambda one, fraction: attitude.multiply(one, attitude.from_rotation_vector(fraction * turned)))(
        target, jnp.asarray(left)
    )
    q_dot = jnp.asarray(np.gradient(np.asarray(q), t, axis=0))
    w = 2.0 * jax.vmap(lambda one, rate: attitude.multiply(attitude.conjugate(one), rate)[:3])(q, q_dot)
    return AttitudeState(q, w)
