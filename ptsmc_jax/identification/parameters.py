"""The parameters that can be estimated: their names, units, prior knowledge, and how they change the model.

The coordinates of a parameter are 0 for the scenario's value. They are scaled so that 1 is one sigma of the prior
knowledge, or of a usual uncertainty without it. Start with `build`.
"""

from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from functools import cached_property
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jax.tree_util import keystr, tree_flatten_with_path
from jaxtyping import Array

from ptsmc_jax.devices.actuators import Actuators
from ptsmc_jax.dispersions import inertias
from ptsmc_jax.dispersions.quantities import PAIRS
from ptsmc_jax.identification.filtering import Model
from ptsmc_jax.identification.telemetry import Measurements
from ptsmc_jax.numerics import attitude, matrices
from ptsmc_jax.numerics.pytrees import vector
from ptsmc_jax.plants.rigid_body import AttitudeState
from ptsmc_jax.scenario import build as building
from ptsmc_jax.scenario.errors import ScenarioError, wrong
from ptsmc_jax.scenario.parsing import nearest_name_hint
from ptsmc_jax.scenario.sensor_tables import SensorSuite
from ptsmc_jax.scenario.tables import Scenario
from ptsmc_jax.signals import disturbances

# parameters of sensors that only [hardware] has, and that [[sensors]] replaces
OF_HARDWARE = ("attitude_noise", "rate_noise", "gyro_scale", "star_tracker_misalignment")
GYRO_BIAS = "gyro_bias"  # is estimated as a state of the filter, not as a constant
UNKNOWN_BIAS = 0.02  # 1 sigma of an unknown gyro bias [rad/s]
USUAL = {  # prior 1 sigma of a parameter without a dispersion: relative, in rad, or of a damping ratio
    "inertia": 0.3, "actuator_scale": 0.1, "actuator_misalignment": 0.03, "gyro_scale": 0.02,
    "star_tracker_misalignment": 0.02, "noise": 1.0, "torque_lag": 0.7, "mode_frequency": 0.2, "mode_damping": 0.005,
    "mode_coupling": 0.3, "disturbance_amplitude": 1.0, "disturbance_phase": 2.0,
    "plant": 0.3,
}  # fmt: skip


class Parameter(NamedTuple):
    """A group of numbers that are estimated together.

    Attributes:
        name: name in `identify.free`.
        labels: name of each number in results.
        unit: unit of the numbers.
        factor: (numbers.., coordinates) matrix F. The changes that `write` takes are F z with coordinates z, whose
            prior 1 sigma is 1.
        known: whether the factor is prior knowledge, from [dispersion].
        write: (model, changes) -> model; zero changes nothing.
        read: (model) -> numbers [unit].
        common: coordinates that multiply all numbers by e, to first order; None if such a factor has no meaning.
    """

    name: str
    labels: list[str]
    unit: str
    factor: np.ndarray
    known: bool
    write: Callable[[Model, Array], Model]
    read: Callable[[Model], Array]
    common: np.ndarray | None = None

    @property
    def size(self) -> int:
        """The number of coordinates."""
        return self.factor.shape[1]


@dataclass(frozen=True, eq=False)
class Problem:
    """The model of a scenario and its free parameters."""

    model: Model
    parameters: list[Parameter]
    step: float  # longest integration step [s]
    bias: bool  # whether the gyro bias is estimated

    @property
    def size(self) -> int:
        """The number of all coordinates."""
        return sum(one.size for one in self.parameters)

    def at(self, z: Array) -> Model:
        """Return the model at coordinates (n,) [-]."""
        model, at = self.model, 0
        for one in self.parameters:
            model = one.write(model, jnp.asarray(one.factor) @ z[at : at + one.size])
            at += one.size
        return model

    def read(self, model: Model) -> Array:
        """Return the numbers of all parameters, one after another, in their units."""
        return jnp.concatenate([jnp.zeros(0), *(jnp.ravel(one.read(model)) for one in self.parameters)])

    @cached_property
    def _numbers(self) -> Callable[[Array], Array]:
        return jax.jit(lambda z: self.read(self.at(z)))

    def numbers(self, z: np.ndarray) -> np.ndarray:
        """Return the numbers of all parameters at coordinates (n,) [-], in their units."""
        return np.asarray(self._numbers(jnp.asarray(z)))

    def derivatives(self, z: np.ndarray) -> np.ndarray:
        """Return the derivatives (k, n) of `numbers` by the coordinates (n,) [-]."""
        return np.asarray(jax.jacfwd(self._numbers)(jnp.asarray(z)))

    @property
    def labels(self) -> list[str]:
        """The name of each number."""
        return [label for one in self.parameters for label in one.labels]

    @property
    def units(self) -> list[str]:
        """The unit of each number."""
        return [one.unit for one in self.parameters for _ in one.labels]

    def known(self) -> np.ndarray:
        """Return whether each coordinate has prior knowledge, (n,) bool."""
        return np.concatenate([np.zeros(0, bool), *(np.full(one.size, one.known) for one in self.parameters)])


def build(scenario: Scenario, logs: Sequence[Measurements], names: Sequence[str] | None = None) -> Problem:
    """Return the model of a scenario and its free parameters.

    Args:
        scenario: a complete scenario.
        logs: the logs, which have the same readings.
        names: free parameters; by default those of [identify].

    Raises:
        ScenarioError: a parameter is unknown, or the scenario does not have it.
    """
    setup = building.setup(scenario)
    table = scenario.identify
    stated = None if table is None else table.free
    has_gyro = "rate" in logs[0].readings
    names = tuple(names or stated or _usual(scenario, has_gyro))
    interval = float(np.median(np.diff(logs[0].t)))
    model, estimated = _model(scenario, setup, logs, interval, GYRO_BIAS in names)
    prior = scenario.dispersion if table is None or table.prior == "dispersion" else None
    catalogue = _catalogue(scenario, model, logs, interval, prior)
    found = []
    for name in dict.fromkeys((*names, *estimated)):
        if name in catalogue:
            model, parameter = catalogue[name](model)
            found.append(parameter)
        elif name != GYRO_BIAS or not has_gyro:
            known = [*catalogue, *([GYRO_BIAS] if has_gyro else [])]
            raise ScenarioError(
                f"identify.free has {name}, which this scenario does not have; {nearest_name_hint(name, known)}"
            )
    if not found:
        raise wrong("identify.free", names, f"a list with at least one parameter besides {GYRO_BIAS}")
    return Problem(model, found, _step(scenario, setup, interval), GYRO_BIAS in names)


def _usual(scenario: Scenario, has_gyro: bool) -> tuple[str, ...]:
    if scenario.plant.kind != "spacecraft":
        return ("actuator_scale",)
    return ("inertia", GYRO_BIAS) if has_gyro else ("inertia",)


def _step(scenario: Scenario, setup: Any, interval: float) -> float:
    """Return the longest integration step [s]: an interval of the log, or less for fast modes and disturbances."""
    quick = [float(np.max(np.asarray(getattr(setup.plant, "frequency", [0.0]))))]
    for term in scenario.terms:
        quick.append(term.largest_frequency())
    fastest = max(quick)
    return min(interval * 1.5, 0.2 / fastest if fastest > 0.0 else np.inf)


def _model(
    scenario: Any, setup: Any, logs: Sequence[Measurements], interval: float, with_bias: bool
) -> tuple[Model, list[str]]:
    """Return the model of the scenario, and the noises that it does not give, which are estimated."""
    table, devices, plant = scenario.identify, scenario.devices, setup.plant
    actuators: Actuators = replace(setup.actuators, delay=0, spare_allocations=None, failure_times=None)
    if logs[0].by_channel:
        actuators = replace(actuators, torque_limit=None)
    noises, estimated, period = {}, [], scenario.loop.period
    tracker = getattr(setup.sensors, "star_tracker", None)  # of a sensor suite
    given = {
        "attitude": getattr(devices, "attitude_noise", None) if tracker is None else np.asarray(tracker.noise).tolist(),
        "rate": devices.gyro_noise(period) if hasattr(devices, "gyro_noise") else None,
        "x": getattr(devices, "state_noise", None),
    }
    for name, readings in logs[0].readings.items():
        if given[name]:
            noises[name] = vector(given[name]) * jnp.ones(
                min(readings.shape[1], 3) if name != "x" else readings.shape[1]
            )
        else:
            noises[name] = vector(np.maximum(np.mean([_roughness(name, log) for log in logs], axis=0), 1e-12))
            estimated.append("state_noise" if name == "x" else f"{name}_noise")
    bias = getattr(devices, "rate_bias", None)
    nothing = table is not None and table.prior == "none"
    known_bias = 0.0 if bias is None else bias
    walk: Any = setup.walk_rate if setup.walk_rate is None else setup.walk_rate * np.sqrt(period)
    if table is not None and table.torque_walk is not None:
        walk = vector(table.torque_walk) * jnp.ones(plant.inputs) if table.torque_walk > 0.0 else None
    model = Model(
        plant=plant,
        disturbance=setup.disturbance,
        actuators=actuators,
        delay=vector(devices.delay_periods * (period or 0.0)),
        noises=noises,
        tracker_axes=jnp.eye(3) if tracker is None else tracker.axes(),
        rate_scale=vector(getattr(devices, "gyro_scale", None) or np.ones(3)),
        misalignment=vector(np.deg2rad(getattr(devices, "star_tracker_misalignment_deg", None) or np.zeros(3))),
        bias=vector(UNKNOWN_BIAS if with_bias and (nothing or not known_bias) else known_bias),
        bias_walk=vector(getattr(devices, "rate_bias_walk", None) or 0.0),
        walk=walk,
        modes=_hidden_spread(plant, logs),
        slack=vector(0.0),
    )
    return model, estimated


def acceleration(model: Model, log: Measurements) -> float:
    """Return the RMS acceleration that the commands of a log give the plant at its first reading [rad/s^2]."""
    command = log.command
    if log.wheel_inertia is not None:
        command = log.wheel_inertia * np.diff(command, axis=0) / np.diff(log.t)[:, None]
    size = jnp.asarray(np.sqrt(np.mean(command**2, axis=0)))
    size = model.actuators.on_body(size) if log.by_channel or log.wheel_inertia is not None else size
    plant, zero = model.plant, jnp.zeros(model.plant.inputs)
    still = AttitudeState(jnp.array([0.0, 0.0, 0.0, 1.0]), jnp.zeros(3))
    x = plant.with_hidden_at_rest(jnp.asarray(log.readings["x"][0]) if "x" in log.readings else still)
    pushed, free = (plant.velocity(plant.rate(jnp.zeros(()), x, u, zero)) for u in (size, zero))
    return float(jnp.max(jnp.abs(pushed - free)))


def _roughness(name: str, log: Measurements) -> np.ndarray:
    """Return a robust estimate of the noise from third differences. They have 20 times the variance of the noise."""
    values = log.readings[name]
    there = ~np.isnan(values).any(axis=1)
    values = 2.0 * values[there] if name == "attitude" else values[there]
    if len(values) < 8:
        return np.full(3 if name != "x" else values.shape[1], 1e-3)
    sizes = 1.4826 * np.median(np.abs(np.diff(values, 3, axis=0)), axis=0) / np.sqrt(20.0)
    return np.full(3, np.max(sizes)) if name != "x" else np.maximum(sizes, 1e-9 * (1e-3 + np.ptp(values, axis=0)))


def _hidden_spread(plant: Any, logs: Sequence[Measurements]) -> Array:
    """Return the prior 1 sigma of modal coordinates and their rates: ten times the deflection by the largest torque."""
    if not hasattr(plant, "coupling"):
        size = plant.z0.shape[-1] if hasattr(plant, "z0") else 0
        return jnp.zeros(size)
    largest = 1.0 if logs[0].wheel_inertia is not None else max(float(np.abs(log.command).max()) for log in logs)
    deflection = 10.0 * np.abs(np.asarray(plant.coupling @ plant.inertia_inverse)) @ np.full(3, largest)
    frequency = np.asarray(plant.frequency)
    return vector(np.concatenate([deflection / frequency**2, deflection / frequency]))


Maker = Callable[[Model], tuple[Model, Parameter]]


def _catalogue(
    scenario: Any, model: Model, logs: Sequence[Measurements], interval: float, prior: Any
) -> dict[str, Maker]:
    """Return the functions that add each possible parameter to a model, by name; see `field`."""
    plant, actuators = model.plant, model.actuators
    axes = np.eye(plant.inputs) if actuators.wheels is None else np.asarray(actuators.wheels.axes)
    torque = max(float(np.sqrt(np.mean(log.command**2))) for log in logs) or 1.0
    usual = {**USUAL, "delay": interval, "disturbance_bias": 0.1 * torque}

    def spread(name: str, count: int) -> tuple[np.ndarray, bool]:
        """Return the 1 sigma of each number, (count,), and whether [dispersion] gives it."""
        table: Any = getattr(prior, name, None)
        if not hasattr(table, "widths"):  # no dispersion is given, or a phase is uniform over the circle
            return np.full(count, usual["noise" if name.endswith("_noise") else name]), False
        sigmas = table.widths(count) * (1.0 if table.name.endswith("normal") else 1.0 / np.sqrt(3.0))
        return np.maximum(sigmas, 1e-9), True

    def field(
        name: str, path: Callable[[Model], Any], put: Callable[[Model, Array], Model], count: int, unit: str, how: str
    ) -> Maker:
        """Return a function that adds a parameter to a model; see `Parameter`.

        Args:
            name: name of the parameter.
            path: returns the parameter's present numbers in a model.
            put: returns a model with other numbers.
            count: number of numbers.
            unit: unit of the numbers.
            how: effect of a coordinate c: "log" multiplies by e^c, "factor" multiplies by 1 + c, others add c.
        """

        def make(model: Model) -> tuple[Model, Parameter]:
            sizes, known = spread(name, count)
            start = jnp.asarray(path(model), float) * jnp.ones(count)

            def write(model: Model, c: Array) -> Model:
                new = start * jnp.exp(c) if how == "log" else start * (1.0 + c) if how == "factor" else start + c
                return put(model, new)

            common = 1.0 / sizes if how in ("log", "factor") else None
            read = lambda model: jnp.asarray(path(model), float) * jnp.ones(count)  # noqa: E731
            labels = [name] if count == 1 else [f"{name}_{k + 1}" for k in range(count)]
            return put(model, start), Parameter(name, labels, unit, np.diag(sizes), known, write, read, common)

        return make

    def with_actuators(model: Model, **changes: Any) -> Model:
        return replace(model, actuators=replace(model.actuators, **changes))

    channels = axes.shape[1]
    made: dict[str, Maker] = {
        "actuator_scale": field(
            "actuator_scale",
            lambda model: jnp.ones(channels) if model.actuators.scale is None else model.actuators.scale,
            lambda model, new: with_actuators(model, scale=new),
            channels, "-", "factor",
        ),
        "delay": field(  # a delay below 0 has no meaning, and at 0 the derivative would vanish
            "delay", lambda m: m.delay, lambda m, new: replace(m, delay=jnp.maximum(new[0], 1e-9)), 1, "s", "add"
        ),
        "disturbance_bias": field(
            "disturbance_bias",
            lambda m: disturbances.bias(m.disturbance, plant.inputs),
            lambda m, new: replace(m, disturbance=disturbances.with_bias(m.disturbance, new)),
            plant.inputs, plant.input_unit, "add",
        ),
    }  # fmt: skip
    if actuators.lag is not None:
        made["torque_lag"] = field(
            "torque_lag", lambda m: m.actuators.lag, lambda m, new: with_actuators(m, lag=new[0]), 1, "s", "log"
        )
    for name, noise in model.noises.items():
        key, count = ("state_noise", noise.size) if name == "x" else (f"{name}_noise", 1)
        own_unit = {"attitude": "rad", "rate": "rad/s", "x": ""}[name]

        def put(model: Model, new: Array, name: str = name, size: int = noise.size) -> Model:
            return replace(model, noises={**model.noises, name: new * jnp.ones(size)})

        made[key] = field(key, lambda m, n=name, c=count: m.noises[n][:c], put, count, own_unit, "log")
    for name, quantity_unit, how in (
        ("disturbance_amplitude", plant.input_unit, "factor"),
        ("disturbance_phase", "rad", "add"),
    ):
        quantity: Any = name.removeprefix("disturbance_")
        count = disturbances.count_values(model.disturbance, quantity)
        if count:
            made[name] = field(
                name,
                lambda m, q=quantity: disturbances.values(m.disturbance, q),
                lambda m, new, q=quantity: replace(m, disturbance=disturbances.with_values(m.disturbance, q, new)),
                count, quantity_unit, how,
            )  # fmt: skip
    if model.spacecraft:
        made["inertia"] = lambda model: (model, _inertia(np.asarray(model.plant.inertia), prior))
        made["actuator_misalignment"] = lambda model: _misalignment(model, axes, *spread("actuator_misalignment", 1))
        if "attitude" in model.noises:
            made["star_tracker_misalignment"] = field(
                "star_tracker_misalignment", lambda m: m.misalignment,
                lambda m, new: replace(m, misalignment=new), 3, "rad", "add",
            )  # fmt: skip
        if "rate" in model.noises:
            made["gyro_scale"] = field(
                "gyro_scale", lambda m: m.rate_scale, lambda m, new: replace(m, rate_scale=new), 3, "-", "factor"
            )
    if hasattr(plant, "coupling"):
        modes = plant.frequency.size
        made["mode_frequency"] = field(
            "mode_frequency", lambda m: m.plant.frequency,
            lambda m, new: replace(m, plant=replace(m.plant, frequency=new)), modes, "rad/s", "log",
        )  # fmt: skip
        made["mode_damping"] = field(  # an estimate of a small ratio may be negative, within its uncertainty
            "mode_damping", lambda m: m.plant.damping,
            lambda m, new: replace(m, plant=replace(m.plant, damping=new)), modes, "-", "add",
        )  # fmt: skip
        made["mode_coupling"] = lambda model: (model, _coupling(model, *spread("mode_coupling", 1)))
    for path, leaf in _leaves(plant):
        made.setdefault(path, lambda model, path=path, leaf=leaf: (model, _leaf(path, leaf)))
    if isinstance(getattr(scenario, "sensors", None), SensorSuite):
        made = {name: maker for name, maker in made.items() if name not in OF_HARDWARE}
    return made


def _leaves(plant: Any) -> list[tuple[str, np.ndarray]]:
    """Return the numbers inside a custom plant, by the path that names them in `identify.free`."""
    if hasattr(plant, "with_inertia"):
        return []
    leaves, _ = tree_flatten_with_path(plant)
    paths = [("plant" + keystr(path), np.asarray(leaf)) for path, leaf in leaves]
    return [(path, leaf) for path, leaf in paths if not path.startswith(("plant.inertia", "plant.z0"))]


def _leaf(path: str, start: np.ndarray) -> Parameter:
    sizes = USUAL["plant"] * np.where(start == 0.0, np.max(np.abs(start), initial=0.0) or 1.0, np.abs(start)).ravel()

    def place(model: Model) -> tuple[list[Any], Any, int]:
        leaves, tree = jax.tree.flatten(model.plant)
        names = ["plant" + keystr(one) for one, _ in tree_flatten_with_path(model.plant)[0]]
        return leaves, tree, names.index(path)

    def write(model: Model, c: Array) -> Model:
        leaves, tree, at = place(model)
        leaves[at] = jnp.asarray(start, float) + c.reshape(start.shape)
        return replace(model, plant=jax.tree.unflatten(tree, leaves))

    def read(model: Model) -> Array:
        leaves, _, at = place(model)
        return jnp.ravel(leaves[at])

    labels = [path] if start.size == 1 else [f"{path}_{k + 1}" for k in range(start.size)]
    return Parameter(path, labels, "", np.diag(sizes), False, write, read)


def _misalignment(model: Model, axes: np.ndarray, sizes: np.ndarray, known: bool) -> tuple[Model, Parameter]:
    """Return the parameter of the channels' misalignment: small rotations of each channel about two axes across it.

    A rotation of a channel about its own axis has no effect.
    """
    directions = axes if model.actuators.directions is None else np.asarray(model.actuators.directions)
    across = [np.linalg.svd(direction[None])[2][1:] for direction in directions.T]  # (2, 3) for each channel

    def write(model: Model, c: Array) -> Model:
        turned = []
        for k, direction in enumerate(directions.T):
            turn = c[2 * k] * across[k][0] + c[2 * k + 1] * across[k][1]
            turned.append(attitude.rotate(attitude.from_rotation_vector(turn), jnp.asarray(direction)))
        return replace(model, actuators=replace(model.actuators, directions=jnp.stack(turned, axis=1)))

    def read(model: Model) -> Array:
        now = directions if model.actuators.directions is None else model.actuators.directions
        turns = [attitude.cross(jnp.asarray(a), jnp.asarray(b)) for a, b in zip(directions.T, now.T, strict=True)]
        return jnp.concatenate([jnp.asarray(across[k]) @ turn for k, turn in enumerate(turns)])

    count = 2 * directions.shape[1]
    labels = [f"actuator_misalignment_{k // 2 + 1}{'ab'[k % 2]}" for k in range(count)]
    factor = float(sizes[0]) * np.eye(count)
    return model, Parameter("actuator_misalignment", labels, "rad", factor, known, write, read)


def _coupling(model: Model, sizes: np.ndarray, known: bool) -> Parameter:
    start = np.asarray(model.plant.coupling)
    rows = np.linalg.norm(start, axis=1, keepdims=True) * np.ones(3)

    def write(model: Model, c: Array) -> Model:
        plant = replace(model.plant, coupling=jnp.asarray(start) + c.reshape(start.shape)).with_rest_inverse()
        return replace(model, plant=plant)

    labels = [f"mode_coupling_{k + 1}{i + 1}" for k in range(len(start)) for i in range(3)]
    factor = np.diag(float(sizes[0]) * rows.ravel())
    return Parameter(
        "mode_coupling", labels, "sqrt(kg) m", factor, known, write, lambda model: jnp.ravel(model.plant.coupling)
    )


def _inertia(start: np.ndarray, prior: Any) -> Parameter:
    """Return the inertia parameter, in log-Cholesky coordinates of the pseudo-inertia: every value is physical."""
    table = getattr(prior, "inertia", None)
    root = vector(inertias.pseudo_root(start))
    if table is not None and hasattr(table, "factor"):
        factor = table.matrix()
    else:
        std = USUAL["inertia"] if table is None else max(table.std, 1e-6)
        turn = std if table is None or not table.axes_deg else np.deg2rad(table.axes_deg)
        moments, axes = np.linalg.eigh(start)
        changes = [std * moments[k] * np.outer(axes[:, k], axes[:, k]) for k in range(3)]
        for k in range(3):
            cross = np.cross(np.eye(3), axes[:, k]).T * -1.0
            changes.append(turn * (cross @ start - start @ cross))
        by_prior = np.stack([np.asarray(_entries(jnp.asarray(change))) for change in changes], axis=1)
        factor = np.linalg.solve(by_coordinates(start), _full_rank(by_prior, std * np.min(moments)))

    def write(model: Model, c: Array) -> Model:
        inertia = inertias.from_coordinates(root, c)
        plant = model.plant.with_inertia(inertia, matrices.solve(inertia, jnp.eye(3)))
        return replace(model, plant=plant, disturbance=disturbances.on_body(model.disturbance, inertia))

    labels = [f"inertia_{i + 1}{j + 1}" for i, j in PAIRS]
    common = np.linalg.lstsq(factor, np.repeat([0.5, 0.0], 3), rcond=None)[0]
    read = lambda model: _entries(model.plant.inertia)  # noqa: E731
    return Parameter("inertia", labels, "kg m^2", factor, table is not None, write, read, common)


def by_coordinates(inertia: np.ndarray) -> np.ndarray:
    """Return the derivatives (6, 6) [kg m^2] of the entries of an inertia (3, 3) by its log-Cholesky coordinates."""
    root = vector(inertias.pseudo_root(inertia))
    return np.asarray(jax.jacfwd(lambda c: _entries(inertias.from_coordinates(root, c)))(jnp.zeros(6)))


def _full_rank(factor: np.ndarray, size: float) -> np.ndarray:
    """Return a factor of the prior covariance (n, n) with its singular values raised to at least 0.3 `size`.

    With equal moments of inertia the principal axes are arbitrary, and the factor would be singular.
    """
    u, s, vt = np.linalg.svd(factor)
    return (u * np.maximum(s, 0.3 * size)) @ vt


def _entries(inertia: Array) -> Array:
    return jnp.stack([inertia[i, j] for i, j in PAIRS])
