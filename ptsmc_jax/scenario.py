"""A scenario checked as a whole and turned into parts; attitudes in every parametrisation become quaternions here."""

import math
from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import jax
import jax.numpy as jnp
import msgspec
import numpy as np
from scipy.spatial.transform import Rotation

from ptsmc_jax import clock, dispersions, hardware, metrics, observers, plants, schema, signals, theory
from ptsmc_jax.controllers import PrescribedTime
from ptsmc_jax.requirements import Requirement
from ptsmc_jax.rollout import SINGULAR_CLEARANCE, Parts
from ptsmc_jax.schema import NOT_YET, Scenario, ScenarioError, wrong

MOST_STEPS = 200_000
MOST_SUBSTEPS = 50


@dataclass(frozen=True)
class Study:
    """A scenario ready to run."""

    scenario: Scenario
    parts: Parts
    dispersion: dispersions.Dispersion
    requirements: tuple[Requirement, ...]


@dataclass(frozen=True)
class Reach:
    """How far gains may move without another compilation: the clock's sizes are chosen for it."""

    t_f: float  # largest [s]
    delta: float  # largest [s]
    smallest_delta: float  # [s]
    gain: float  # smallest observer gain [N m s]


def read(path: str | Path) -> Scenario:
    """The scenario of a TOML file, checked; raises ScenarioError with one sentence."""
    return from_tables(schema.load(path))


def from_tables(raw: Mapping[str, Any]) -> Scenario:
    """The scenario of raw tables (a parsed file), checked; raises ScenarioError with one sentence."""
    scenario = schema.parse(raw, metrics.CATALOGUE)
    scenario = _resolve(scenario)
    _check_available(scenario)
    _check(scenario)
    return scenario


def replace(scenario: Scenario, **changes: Any) -> Scenario:
    """The scenario with other values, keys written table__key, checked again: replace(s, controller__eta=4.0)."""
    tables = schema.dump(scenario)
    for name, value in changes.items():
        table, _, key = name.partition("__")
        if not key:
            tables[table] = value
        elif value is None:
            tables.get(table, {}).pop(key, None)
        else:
            tables[table] = {**tables.get(table, {}), key: value}
    return from_tables(tables)


def study(scenario: Scenario, saves: object = (), reach: Reach | None = None) -> Study:
    """The parts of a checked scenario; `saves`: times [s] at which a continuous run must have nodes.

    Raises ScenarioError where the additive law cannot reach the reference from the initial attitude.
    """
    parts = _parts(scenario, saves, reach)
    _check_reachable(scenario, parts)
    requirements = tuple(
        Requirement(name, value.limit if isinstance(value, schema.Limit) else float(value))
        for name, value in scenario.requirements.items()
    )
    return Study(scenario, parts, _dispersion(scenario), requirements)


def reach_of(scenario: Scenario) -> Reach:
    """The reach of a scenario's own gains: none beyond them."""
    controller = scenario.controller
    return Reach(controller.t_f, controller.delta, controller.delta, min(scenario.observer.gain))


def quaternion(table: schema.Attitude, name: str) -> np.ndarray:
    """Unit quaternion [q1 q2 q3 q4] of a table's attitude key; `name` is the table's, for errors."""
    key = next(key for key in schema.ATTITUDE_KEYS if getattr(table, key) is not None)
    value = getattr(table, key)
    full = f"{name}.{key}"
    if table.sequence is not None and key != "euler_deg":
        raise ScenarioError(f"{name}.sequence is {schema.show(table.sequence)}, but goes with euler_deg only")
    array = np.array(value, dtype=float)
    if key in ("quat_xyzw", "quat_wxyz"):
        length = np.linalg.norm(array)
        if abs(length - 1.0) > 1e-6:
            raise wrong(full, value, f"a unit quaternion (its norm is {length:.9g}, allowed is 1 within 1e-6)")
        array = array / length
        return array if key == "quat_xyzw" else np.roll(array, -1)
    if key == "rotvec_deg":
        return Rotation.from_rotvec(array, degrees=True).as_quat(canonical=True)
    if key == "mrp":
        return Rotation.from_mrp(array).as_quat(canonical=True)
    if key == "dcm_body_to_inertial":
        off = np.abs(array @ array.T - np.eye(3)).max()
        if off > 1e-6 or np.linalg.det(array) < 0:
            raise wrong(full, value, "a rotation matrix (orthonormal within 1e-6, determinant +1)")
        return Rotation.from_matrix(array).as_quat(canonical=True)
    if table.sequence is None:
        raise ScenarioError(f'{full} needs {name}.sequence beside it, three axes in SciPy\'s notation, such as "ZYX"')
    try:
        return Rotation.from_euler(table.sequence, array, degrees=True).as_quat(canonical=True)
    except ValueError:
        raise wrong(
            f"{name}.sequence", table.sequence, 'three axes in SciPy\'s notation, such as "ZYX" or "zyx"'
        ) from None


def _resolve(scenario: Scenario) -> Scenario:
    """The defaults that depend on other keys: t_end, and the bounds of what is tuned."""
    loop, t_f = scenario.loop, scenario.controller.t_f
    if loop.t_end is None:
        loop = msgspec.structs.replace(loop, t_end=t_f + max(10.0, loop.window))
    tune = scenario.tune
    if tune is not None:
        shortest = loop.period if loop.mode == "sampled" else 0.0
        lower = max(shortest, min(0.05, t_f / 4))
        default = {
            "eta": (2.05, 8.0),
            "delta": (lower, min(max(5.0, 4 * lower), (lower + t_f) / 2)),
            "observer_gain": (0.5, 300.0),
            "k1": (0.1, 10.0),
            "sign_width": (1e-5, 1e-1),
        }
        bounds = {**{key: default[key] for key in tune.free if key in default}, **tune.bounds}
        tune = msgspec.structs.replace(tune, bounds=bounds)
    return msgspec.structs.replace(scenario, loop=loop, tune=tune)


def _check_available(scenario: Scenario) -> None:
    """Refuse what files may say but the project cannot do yet."""

    def refuse(key: str, value: Any, allowed: str) -> None:
        raise ScenarioError(f"{key} = {schema.show(value)} {NOT_YET}; allowed is {allowed}")

    if scenario.controller.error != "additive":
        refuse("controller.error", scenario.controller.error, '"additive"')
    if scenario.hardware is not None:
        built = ("attitude_noise", "rate_noise")
        for key in scenario.hardware.__struct_fields__:
            value = getattr(scenario.hardware, key)
            if value is not None and key not in built:
                refuse(f"hardware.{key}", value, " and ".join(built))
    if scenario.dispersion is not None:
        for key in ("rate", "inertia", "disturbance_phase"):
            value = getattr(scenario.dispersion, key)
            if value is not None:
                refuse(f"dispersion.{key}", msgspec.to_builtins(value), "attitude")
    for key, value in scenario.requirements.items():
        if isinstance(value, schema.Limit) and (value.quantile is not None or value.confidence is not None):
            tables = {k: v for k, v in msgspec.to_builtins(value).items() if v is not None}
            refuse(f"requirements.{key}", tables, "a number, which holds for every trial")
    tune = scenario.tune
    if tune is not None:
        if tune.objective != "rms":
            refuse("tune.objective", tune.objective, '"rms"')
        if tune.level is not None:
            raise ScenarioError(f'tune.level is {tune.level}, but goes with tune.objective = "cvar" only')
        if "t_f" in tune.free:
            refuse("tune.free", tune.free, "eta, delta, observer_gain, k1, sign_width")


def _check(scenario: Scenario) -> None:
    """What single keys cannot tell: keys against each other."""
    controller, loop = scenario.controller, scenario.loop
    try:
        plants.check_inertia(scenario.spacecraft.inertia)
    except ValueError as error:
        raise ScenarioError(f"spacecraft.inertia is {schema.show(scenario.spacecraft.inertia)}: {error}") from None
    quaternion(scenario.initial, "initial")
    quaternion(scenario.reference, "reference")
    t_f, delta, sampled = controller.t_f, controller.delta, loop.mode == "sampled"
    if delta >= t_f:
        raise wrong("controller.delta", delta, f"less than controller.t_f, {t_f}")
    assert loop.t_end is not None  # _resolve filled it in
    if loop.t_end < t_f:
        raise wrong("loop.t_end", loop.t_end, f"at least controller.t_f + loop.window, {t_f + loop.window}")
    if loop.t_end < t_f + loop.window - 1e-9:
        raise wrong("loop.window", loop.window, f"at most loop.t_end - controller.t_f, {loop.t_end - t_f}")
    if sampled and delta < loop.period * (1 - 1e-9):
        raise wrong("controller.delta", delta, f"at least one control period, loop.period = {loop.period}")
    if sampled and loop.t_end / loop.period > MOST_STEPS:
        raise wrong("loop.period", loop.period, f"at least loop.t_end / {MOST_STEPS}, {loop.t_end / MOST_STEPS}")
    if not sampled and scenario.hardware is not None:
        for key in scenario.hardware.__struct_fields__:
            if getattr(scenario.hardware, key) is not None:
                raise ScenarioError(f'hardware.{key} needs the sampled loop, but loop.mode is "{loop.mode}"')
    if scenario.dispersion is not None and isinstance(scenario.dispersion.attitude, schema.AxisAngle):
        angles = scenario.dispersion.attitude
        if angles.min_deg > angles.max_deg:
            raise wrong("dispersion.attitude.min_deg", angles.min_deg, f"at most max_deg, {angles.max_deg}")
    if scenario.tune is not None:
        _check_tune(scenario, scenario.tune)


def _check_tune(scenario: Scenario, tune: schema.Tune) -> None:
    t_f, period = scenario.controller.t_f, scenario.loop.period
    shortest = period if scenario.loop.mode == "sampled" else 0.0
    # gain: lowest and highest that a bound may be, and whether the lowest itself may be
    ranges = {
        "eta": (2.0, math.inf, False),
        "delta": (shortest, t_f, shortest > 0.0),
        "observer_gain": (0.0, math.inf, False),
        "k1": (0.0, math.inf, False),
        "sign_width": (0.0, math.inf, False),
    }
    if len(set(tune.free)) < len(tune.free):
        raise wrong("tune.free", tune.free, "a list that names each gain once")
    for name, (lower, upper) in tune.bounds.items():
        key = f"tune.bounds.{name}"
        if name not in schema.FREE:
            closest = schema.nearest(name, schema.FREE)
            raise ScenarioError(f"{key} is not a known gain; the nearest known one is {closest}")
        if name not in tune.free:
            raise ScenarioError(f"{key} bounds a gain that is not free; tune.free is {schema.show(tune.free)}")
        least, most, closed = ranges[name]
        if not (least <= lower if closed else least < lower) or not upper < most:
            allowed = f"two numbers {'from' if closed else 'above'} {least}"
            raise wrong(key, [lower, upper], allowed + (f" and below {most}" if math.isfinite(most) else ""))
        if lower >= upper:
            raise wrong(key, [lower, upper], "two numbers, the lower bound first and below the upper one")


def _check_reachable(scenario: Scenario, parts: Parts) -> None:
    """Refuse an attitude or a path on which the additive law meets its singularity q4 = 0 (theory: it cannot cross)."""
    table = scenario.initial
    key = next(key for key in schema.ATTITUDE_KEYS if getattr(table, key) is not None)
    said = f"initial.{key} is {schema.show(getattr(table, key))}"
    singular = "q4 = 0 (180 degrees from the inertial frame's identity), which the additive law cannot cross"
    grid = jnp.linspace(0.0, float(parts.t_end), 4001)
    held = np.asarray(jax.vmap(lambda t: parts.reference(t).q[3])(grid))
    worst = int(np.argmin(np.abs(held)))
    crosses = np.any(np.sign(held) != np.sign(held[0]))
    if crosses or abs(held[worst]) < SINGULAR_CLEARANCE:
        when = float(grid[int(np.argmax(np.sign(held) != np.sign(held[0])))]) if crosses else float(grid[worst])
        raise ScenarioError(
            f"reference.kind is {schema.show(scenario.reference.kind)}, but its attitude reaches {singular}, "
            f"at t = {when:.4g} s; allowed is a reference that stays away from it until t_end"
        )
    if scenario.dispersion is not None and scenario.dispersion.attitude is not None:
        return  # the attitude is drawn; a trial that meets the singularity is marked and counted
    t, square = (np.asarray(v) for v in _path(parts))
    if square[0] < SINGULAR_CLEARANCE**2:
        raise ScenarioError(f"{said}, but lies at {singular}; allowed is |q4| of at least {SINGULAR_CLEARANCE}")
    if square.min() < SINGULAR_CLEARANCE**2:
        when = float(t[int(np.argmin(square))])
        raise ScenarioError(
            f"{said} with initial.rate = {schema.show(table.rate)}, but from there the path to the reference meets "
            f"{singular}, at t = {when:.4g} s; allowed is a start whose path keeps |q4| above {SINGULAR_CLEARANCE}"
        )


_path = jax.jit(theory.predicted_path)


def _vector(values: Any) -> Any:
    return jnp.asarray(np.asarray(values, dtype=float))


def _parts(scenario: Scenario, saves: object, reach: Reach | None) -> Parts:
    reach = reach or reach_of(scenario)
    table, loop = scenario.controller, scenario.loop
    assert loop.t_end is not None
    model = plants.spacecraft(scenario.spacecraft.inertia)
    controller = PrescribedTime(
        model, *(_vector(v) for v in (table.t_f, table.eta, table.delta, table.k1, table.sign_width))
    )
    observer = observers.NonlinearObserver(
        model,
        _vector(scenario.observer.gain),
        _vector(table.disturbance_rate_bound),
        _vector(table.initial_estimate_error),
    )
    disturbance, frequency = _disturbance(scenario)
    reference = _reference(scenario)
    rates = [np.linalg.norm(scenario.initial.rate), np.linalg.norm(getattr(scenario.reference, "rate", 0.0))]
    body_rate = float(sum(rates)) + 2.0 * table.eta / table.t_f
    sensors = _sensors(scenario)
    if loop.mode == "continuous":
        timing = _grid(scenario, reach, observer, max(frequency, body_rate), saves)
        substeps = 1
    else:
        if loop.clock == "anchored":
            timing = clock.anchored(loop.period, loop.t_end, reach.t_f, loop.t_end - table.t_f + reach.delta)
        else:
            timing = clock.flight(loop.period, loop.t_end)
        # RK4 at 0.025 rad a step leaves some 1e-9 rad over 100 s
        needed = loop.period * max(frequency / 4, body_rate) / 0.025
        if needed > MOST_SUBSTEPS:
            raise _too_fast(scenario, loop.period * frequency / 4 / 0.025 > MOST_SUBSTEPS)
        substeps = max(1, math.ceil(needed))
    return Parts(
        plant=model,
        disturbance=disturbance,
        reference=reference,
        controller=controller,
        observer=observer,
        sensors=sensors,
        clock=timing,
        initial=plants.AttitudeState(
            jnp.asarray(quaternion(scenario.initial, "initial")), _vector(scenario.initial.rate)
        ),
        t_end=_vector(loop.t_end),
        window=_vector(loop.window),
        settling_angle=_vector(loop.settling_angle),
        substeps=substeps,
    )


def _grid(
    scenario: Scenario, reach: Reach, observer: observers.NonlinearObserver, frequency: float, saves: object
) -> clock.Graded:
    """Grid of the continuous loop; refused where the smooth sign is too stiff for a sensible number of steps."""
    loop, table = scenario.loop, scenario.controller
    assert loop.t_end is not None
    slowest = msgspec.structs.replace(scenario.observer, gain=(reach.gain,) * 3)
    bound = observers.NonlinearObserver(
        observer.model, _vector(slowest.gain), observer.disturbance_rate_bound, observer.initial_error
    ).error_bound()
    # s' = -(tau/2) |T J^-1| K2 tanh(s/width) + ...: the rate of the boundary layer at tau = t_f, and in hold
    switching = float(jnp.linalg.norm(observer.model.inertia_inverse) * jnp.maximum(bound.floor, bound.start))
    layer = switching / (2.0 * table.sign_width) if table.sign_width > 0 else 0.0
    steps = clock.graded_steps(reach.t_f, reach.smallest_delta, loop.t_end, table.k1, frequency, layer)
    if not sum(steps) <= MOST_STEPS:
        raise _too_many(scenario, sum(steps), layer * reach.t_f, frequency)
    return clock.graded(reach.t_f, reach.smallest_delta, loop.t_end, loop.window, table.k1, frequency, layer, saves)


def _too_fast(scenario: Scenario, disturbance: bool) -> ScenarioError:
    """Refusal of a sampled run in which too much happens within one period."""
    asks = f"loop.period = {scenario.loop.period} would take more than {MOST_SUBSTEPS} integration steps a period"
    if disturbance and isinstance(scenario.disturbance, schema.SinusoidDisturbance):
        return wrong("disturbance.frequency", scenario.disturbance.frequency, f"lower: {asks}")
    return wrong("loop.period", scenario.loop.period, f"shorter for these body rates: {asks}")


def _too_many(scenario: Scenario, steps: float, layer: float, frequency: float) -> ScenarioError:
    """Refusal of a continuous run that would need too many steps, in the name of what asks for them."""
    table, loop = scenario.controller, scenario.loop
    asks = f"the continuous loop would need {steps:.6g} steps, and at most {MOST_STEPS} are allowed"
    if isinstance(scenario.disturbance, schema.SinusoidDisturbance) and 0.3 * layer < 1.5 * frequency:
        return wrong("disturbance.frequency", scenario.disturbance.frequency, f"lower: {asks}")
    if table.sign_width > 0.0 and layer * table.t_f > steps / 10:
        return wrong("controller.sign_width", table.sign_width, f"larger, or 0 for the exact sign: {asks}")
    return wrong("loop.t_end", loop.t_end, f"earlier: {asks}")


def _disturbance(scenario: Scenario) -> tuple[Any, float]:
    """The disturbance and its highest angular frequency [rad/s]."""
    table = scenario.disturbance
    if isinstance(table, schema.NoDisturbance):
        return signals.Constant(jnp.zeros(3)), 0.0
    if isinstance(table, schema.ConstantDisturbance):
        return signals.Constant(_vector(table.amplitude)), 0.0
    signal = signals.Sinusoid(*(_vector(v) for v in (table.amplitude, table.frequency, table.phase, table.bias)))
    return signal, float(np.max(np.abs(table.frequency)))


def _reference(scenario: Scenario) -> Any:
    table = scenario.reference
    q = jnp.asarray(quaternion(table, "reference"))
    if isinstance(table, schema.SpinReference):
        return signals.Spin(q, _vector(table.rate))
    return signals.Fixed(q)


def _sensors(scenario: Scenario) -> hardware.Sensors | None:
    table = scenario.hardware
    if table is None or (table.attitude_noise is None and table.rate_noise is None):
        return None
    return hardware.Sensors(_vector(table.attitude_noise or 0.0), _vector(table.rate_noise or 0.0))


def _dispersion(scenario: Scenario) -> dispersions.Dispersion:
    table = scenario.dispersion.attitude if scenario.dispersion is not None else None
    if table is None:
        return dispersions.Dispersion()
    if isinstance(table, schema.UniformAttitude):
        return dispersions.Dispersion(dispersions.UniformAttitude())
    if isinstance(table, schema.NormalAttitude):
        return dispersions.Dispersion(dispersions.NormalAttitude(_vector(np.deg2rad(table.std_deg))))
    angles = (_vector(np.deg2rad(a)) for a in (table.min_deg, table.max_deg))
    return dispersions.Dispersion(dispersions.AxisAngle(*angles))
