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
from jax.tree_util import FlattenedIndexKey, keystr, tree_flatten_with_path
from jax.typing import ArrayLike
from jaxtyping import Array

from ptsmc_jax.devices.actuators import Actuators
from ptsmc_jax.dispersions import numbers
from ptsmc_jax.dispersions.quantities import PAIRS
from ptsmc_jax.identification.filtering import Model
from ptsmc_jax.identification.telemetry import Measurements, estimate_noise
from ptsmc_jax.numerics import attitude, matrices, paths
from ptsmc_jax.numerics.pytrees import vector
from ptsmc_jax.plants.rigid_body import AttitudeState
from ptsmc_jax.scenario import assembly
from ptsmc_jax.scenario.errors import ScenarioError, wrong
from ptsmc_jax.scenario.identify_tables import Identify
from ptsmc_jax.scenario.parsing import nearest_name_hint
from ptsmc_jax.scenario.sensor_tables import SensorSuite
from ptsmc_jax.scenario.tables import Scenario
from ptsmc_jax.signals import disturbances
from ptsmc_jax.simulation.assembly import Parts

# parameters of sensors that only [hardware] has, and that [[sensors]] replaces
HARDWARE_PARAMETERS = ("attitude_noise", "rate_noise", "gyro_scale", "star_tracker_misalignment")
PHASE = "disturbance_phase"
GYRO_BIAS = "gyro_bias"  # a state of the filter, not a constant
NOISE_UNITS = {"attitude": "rad", "rate": "rad/s"}
UNKNOWN_BIAS = 0.02  # 1 sigma of an unknown gyro bias [rad/s]
USUAL_SIGMA = {  # prior 1 sigma of a parameter without a dispersion: relative, in rad, or of a damping ratio
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
        has_prior: whether the factor is prior knowledge, from [dispersion].
        write: (model, changes) -> model; zero changes nothing.
        read: (model) -> numbers [unit].
        common: change of the coordinates that multiplies all numbers by e, to first order. None: a common factor has no
            meaning.
    """

    name: str
    labels: list[str]
    unit: str
    factor: np.ndarray
    has_prior: bool
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
    max_step: float  # longest integration step [s]
    has_gyro_bias: bool  # whether the gyro bias is estimated
    dispersed: tuple[str, ...] = ()  # parameters that [dispersion] varies, but that are not free
    unknown_noises: tuple[str, ...] = ()  # noises without a value in the scenario, whose start is an estimate

    @property
    def size(self) -> int:
        """The number of all coordinates."""
        return sum(parameter.size for parameter in self.parameters)

    def model_at(self, z: Array) -> Model:
        """Return the model at coordinates (n,) [-]."""
        model, begin = self.model, 0
        for parameter in self.parameters:
            model = parameter.write(model, jnp.asarray(parameter.factor) @ z[begin : begin + parameter.size])
            begin += parameter.size
        return model

    @cached_property
    def _jitted_numbers(self) -> Callable[[Array], Array]:
        """The compiled function from coordinates (n,) to the numbers of all parameters, joined in their order."""

        def read(z: Array) -> Array:
            model = self.model_at(z)
            return jnp.concatenate([jnp.ravel(parameter.read(model)) for parameter in self.parameters])

        return jax.jit(read)

    @cached_property
    def _jitted_derivatives(self) -> Callable[[Array], Array]:
        return jax.jit(jax.jacfwd(self._jitted_numbers))

    def numbers(self, z: np.ndarray) -> np.ndarray:
        """Return the numbers of all parameters at coordinates (n,) [-], in their units."""
        return np.asarray(self._jitted_numbers(jnp.asarray(z)))

    def derivatives(self, z: np.ndarray) -> np.ndarray:
        """Return the derivatives (k, n) of `numbers` by the coordinates (n,) [-]."""
        return np.asarray(self._jitted_derivatives(jnp.asarray(z)))

    @property
    def labels(self) -> list[str]:
        """The name of each number."""
        return [label for parameter in self.parameters for label in parameter.labels]

    @property
    def units(self) -> list[str]:
        """The unit of each number."""
        return [parameter.unit for parameter in self.parameters for _ in parameter.labels]

    @property
    def phases(self) -> list[int]:
        """The indices of the phases of sinusoids among the numbers.

        The phase of a gravity gradient is absent: the torque has the period pi of the phase, and no mirrored value.
        """
        is_sinusoid = [
            isinstance(term, disturbances.Sinusoid)
            for term in disturbances.terms(self.model.disturbance)
            for _ in range(disturbances.values(term, "phase").size)
        ]
        indices = [k for k, label in enumerate(self.labels) if label.startswith(PHASE)]
        return [k for k, is_mirrored in zip(indices, is_sinusoid, strict=False) if is_mirrored]

    def mirror_phase(self, z: np.ndarray, k: int) -> np.ndarray:
        """Return coordinates (n,) with number k, a phase p, mirrored to pi - p.

        A slow sinusoid has almost the same value at both phases, and the likelihood has a maximum near each of them.
        """
        by_phase = self.derivatives(z)[k]
        return z + wrap_angle(np.pi - 2.0 * self.numbers(z)[k]) * by_phase / (by_phase @ by_phase)

    def has_prior(self) -> np.ndarray:
        """Return whether each coordinate has prior knowledge, (n,) bool."""
        return np.concatenate([np.full(parameter.size, parameter.has_prior) for parameter in self.parameters])


def wrap_angle(angle: float) -> float:
    """Return an angle in [-pi, pi) [rad]."""
    return float((angle + np.pi) % (2.0 * np.pi) - np.pi)


def build(scenario: Scenario, logs: Sequence[Measurements], names: Sequence[str] | None = None) -> Problem:
    """Return the model of a scenario and its free parameters.

    Args:
        scenario: a complete scenario.
        logs: the logs, all with the same readings.
        names: free parameters; by default those of [identify].

    Raises:
        ScenarioError: a parameter is unknown, or the scenario does not have it.
    """
    setup = assembly.build_setup(scenario)
    table = scenario.identify or Identify()
    has_gyro = "rate" in logs[0].readings
    usual_names = ("inertia", GYRO_BIAS)[: 1 + has_gyro] if scenario.plant.kind == "spacecraft" else ("actuator_scale",)
    interval = float(np.median(np.diff(logs[0].t)))
    names = tuple(names or table.free or ())
    with_bias = GYRO_BIAS in (names or usual_names)
    model, unknown_noises = _build_model(scenario, table, setup, logs, with_bias)
    prior = scenario.dispersion if table.prior == "dispersion" else None
    possible = _possible_parameters(scenario, model, logs, interval, prior)
    names = names or (*usual_names, *(name for name in possible if getattr(prior, name, None) is not None))
    selected = []
    for name in dict.fromkeys((*names, *unknown_noises)):
        if name in possible:
            selected.append(possible[name]())
        elif name != GYRO_BIAS or not has_gyro:
            allowed_names = [*possible, *([GYRO_BIAS] if has_gyro else [])]
            raise ScenarioError(
                f"identify.free has {name}, which this scenario does not have; {nearest_name_hint(name, allowed_names)}"
            )
    if not selected:
        raise wrong("identify.free", names, f"a list with at least one parameter besides {GYRO_BIAS}")
    frequencies = [float(np.max(np.asarray(getattr(setup.plant, "frequency", [0.0]))))]
    fastest = max([*frequencies, *(term.largest_frequency() for term in scenario.terms)])
    rate = max(_usual_rate(log) for log in logs)
    max_step = min(interval * 1.5, 0.2 / max(fastest, 1e-12), 0.1 / max(rate, 1e-12))
    others = possible.keys() - {parameter.name for parameter in selected}
    dispersed = sorted(name for name in others if getattr(scenario.dispersion, name, None) is not None)
    return Problem(model, selected, max_step, with_bias, tuple(dispersed), tuple(unknown_noises))


def _build_model(
    scenario: Scenario, table: Identify, setup: Parts, logs: Sequence[Measurements], with_bias: bool
) -> tuple[Model, list[str]]:
    """Return the model of the scenario, and the names of the noises that it does not state. These are estimated."""
    devices, plant = scenario.devices, setup.plant
    actuators: Actuators = replace(setup.actuators, delay=0, spare_allocations=None, failure_times=None)
    if logs[0].by_channel:
        actuators = replace(actuators, torque_limit=None)
    noises, unknown_noises, period = {}, [], scenario.loop.period
    tracker = getattr(setup.sensors, "star_tracker", None)  # of a sensor suite
    stated_noises = {
        "attitude": getattr(devices, "attitude_noise", None) if tracker is None else np.asarray(tracker.noise).tolist(),
        "rate": devices.gyro_noise(period) if hasattr(devices, "gyro_noise") else None,
        "x": getattr(devices, "state_noise", None),
    }
    for name, readings in logs[0].readings.items():
        if stated_noises[name]:
            noises[name] = vector(stated_noises[name]) * jnp.ones(readings.shape[1] if name == "x" else 3)
        else:
            noises[name] = vector(np.maximum(np.mean([_estimate_noise(name, log) for log in logs], axis=0), 1e-12))
            unknown_noises.append("state_noise" if name == "x" else f"{name}_noise")
    bias = getattr(devices, "rate_bias", None) or 0.0
    walk_density: Any = setup.walk_rate if setup.walk_rate is None else setup.walk_rate * np.sqrt(period)
    if table.torque_walk is not None:
        walk_density = vector(table.torque_walk) * jnp.ones(plant.inputs) if table.torque_walk > 0.0 else None
    model = Model(
        plant=plant,
        disturbance=setup.disturbance,
        actuators=actuators,
        delay=vector(devices.delay_periods * (period or 0.0)),
        noises=noises,
        tracker_axes=jnp.eye(3) if tracker is None else tracker.axes(),
        rate_scale=vector(getattr(devices, "gyro_scale", None) or np.ones(3)),
        misalignment=vector(np.deg2rad(getattr(devices, "star_tracker_misalignment_deg", None) or np.zeros(3))),
        bias_sigma=vector(UNKNOWN_BIAS if with_bias and (table.prior == "none" or not bias) else bias),
        bias_walk=vector(getattr(devices, "rate_bias_walk", None) or 0.0),
        walk_density=walk_density,
        hidden_sigma=_hidden_sigma(plant, logs),
        acceleration_noise=vector(0.0),
    )
    return model, unknown_noises


def commanded_acceleration(model: Model, log: Measurements) -> float:
    """Return the RMS acceleration that the commands of a log give the plant at its first reading [rad/s^2]."""
    command = log.command
    if log.wheel_inertia is not None:
        command = log.wheel_inertia * np.diff(command, axis=0) / np.diff(log.t)[:, None]
    rms_command = jnp.asarray(np.sqrt(np.mean(command**2, axis=0)))
    if log.by_channel or log.wheel_inertia is not None:
        rms_command = model.actuators.on_body(rms_command)
    plant, zero = model.plant, jnp.zeros(model.plant.inputs)
    rest_state = AttitudeState(jnp.array([0.0, 0.0, 0.0, 1.0]), jnp.zeros(3))
    x = plant.with_hidden_at_rest(jnp.asarray(log.readings["x"][0]) if "x" in log.readings else rest_state)
    driven, free = (plant.velocity(plant.rate(jnp.zeros(()), x, u, zero)) for u in (rms_command, zero))
    return float(jnp.max(jnp.abs(driven - free)))


def _usual_rate(log: Measurements) -> float:
    """Return the body rate that 95 % of the readings of a log do not exceed [rad/s]; 0 without an attitude or rate."""
    readings = log.readings
    if "rate" in readings:
        return float(np.nanquantile(np.linalg.norm(readings["rate"], axis=1), 0.95))
    if "attitude" not in readings:
        return 0.0
    has_attitude = ~np.isnan(readings["attitude"][:, 0])
    q, t = readings["attitude"][has_attitude], log.t[has_attitude]
    angles = 2.0 * np.arccos(np.minimum(np.abs(np.sum(q[1:] * q[:-1], axis=1)), 1.0))
    return float(np.quantile(angles / np.diff(t), 0.95)) if q.shape[0] > 1 else 0.0


def _estimate_noise(name: str, log: Measurements) -> np.ndarray:
    """Return an estimate of the noise of a sensor in a log, see `telemetry.estimate_noise`."""
    values = log.readings[name]
    has_reading = ~np.isnan(values).any(axis=1)
    values = 2.0 * values[has_reading] if name == "attitude" else values[has_reading]
    if len(values) < 8:
        return np.full(3 if name != "x" else values.shape[1], 1e-3)
    noise = estimate_noise(values, axis=0)
    return np.full(3, np.max(noise)) if name != "x" else np.maximum(noise, 1e-9 * (1e-3 + np.ptp(values, axis=0)))


def _hidden_sigma(plant: Any, logs: Sequence[Measurements]) -> Array:
    """Return the prior 1 sigma of modal coordinates and their rates: ten times the deflection by the largest torque."""
    if not hasattr(plant, "coupling"):
        size = plant.z0.shape[-1] if hasattr(plant, "z0") else 0
        return jnp.zeros(size)
    largest = 1.0 if logs[0].wheel_inertia is not None else max(float(np.abs(log.command).max()) for log in logs)
    deflection = 10.0 * np.abs(np.asarray(plant.coupling @ plant.inertia_inverse)) @ np.full(3, largest)
    frequency = np.asarray(plant.frequency)
    return vector(np.concatenate([deflection / frequency**2, deflection / frequency]))


def _possible_parameters(
    scenario: Scenario, model: Model, logs: Sequence[Measurements], log_interval: float, prior: object
) -> dict[str, Callable[[], Parameter]]:
    """Return a factory for each parameter that the scenario has, by the name of the parameter.

    log_interval: time between two rows of the first log [s], the default prior 1 sigma of a delay.
    """
    plant, actuators = model.plant, model.actuators
    axes = np.eye(plant.inputs) if actuators.wheels is None else np.asarray(actuators.wheels.axes)
    torque = max(float(np.sqrt(np.mean(log.command**2))) for log in logs) or 1.0
    usual_sigma = {**USUAL_SIGMA, "delay": log_interval, "disturbance_bias": 0.1 * torque}

    def prior_sigma(name: str, count: int) -> tuple[np.ndarray, bool]:
        """Return the 1 sigma of each number, (count,), and whether [dispersion] gives it."""
        table: Any = getattr(prior, name, None)
        if name == PHASE and table is not None:  # uniform over the circle
            return np.full(count, np.pi / np.sqrt(3.0)), True
        if table is None:
            return np.full(count, usual_sigma["noise" if name.endswith("_noise") else name]), False
        sigmas = table.widths(count) * (1.0 if table.kind.endswith("normal") else 1.0 / np.sqrt(3.0))
        return np.maximum(sigmas, 1e-9), True

    possible: dict[str, Callable[[], Parameter]] = {}

    def add(
        name: str,
        unit: str,
        kind: str,
        get: Callable[[Model], Any],
        put: Callable[[Model, Array], Model],
        count: int,
    ) -> None:
        """Add a parameter with these numbers; see `_number_parameter`."""
        possible[name] = lambda: _number_parameter(name, unit, kind, model, get, put, *prior_sigma(name, count))

    def add_vector(name: str, unit: str, kind: str, path: str, count: int) -> None:
        """Add the numbers at a path of the model, (count,). If the model has None there, they are 1."""

        def get(model: Model) -> ArrayLike:
            value = paths.get(model, path)
            return 1.0 if value is None else value

        add(name, unit, kind, get, lambda model, new: paths.put(model, path, new), count)

    add_vector("actuator_scale", "-", "factor", "actuators.scale", axes.shape[1])
    # within its uncertainty, the estimate of a short delay may be negative; at exactly 0 the derivative would vanish
    add("delay", "s", "add", lambda m: m.delay, lambda m, new: replace(m, delay=new[0] + 1e-9), 1)
    add(
        "disturbance_bias", plant.input_unit, "add", lambda m: disturbances.bias(m.disturbance, plant.inputs),
        lambda m, new: replace(m, disturbance=disturbances.with_bias(m.disturbance, new)), plant.inputs,
    )  # fmt: skip
    if actuators.lag is not None:
        add(
            "torque_lag", "s", "log", lambda m: m.actuators.lag,
            lambda m, new: paths.put(m, "actuators.lag", new[0]), 1,
        )  # fmt: skip
    for name, noise in model.noises.items():
        key, count, unit = ("state_noise", noise.size, "") if name == "x" else (f"{name}_noise", 1, NOISE_UNITS[name])
        add(
            key, unit, "log", lambda m, name=name, count=count: m.noises[name][:count],
            lambda m, new, name=name, size=noise.size: replace(
                m, noises={**m.noises, name: new * jnp.ones(size)}
            ),
            count,
        )  # fmt: skip
    quantities: Any = (("amplitude", plant.input_unit, "factor"), ("phase", "rad", "add"))
    for quantity, unit, kind in quantities:
        values = np.asarray(disturbances.values(model.disturbance, quantity))
        count = values.size
        if np.any(values) if kind == "factor" else count:
            add(
                f"disturbance_{quantity}", unit, kind, lambda m, q=quantity: disturbances.values(m.disturbance, q),
                lambda m, new, q=quantity: replace(m, disturbance=disturbances.with_values(m.disturbance, q, new)),
                count,
            )  # fmt: skip
    if model.is_spacecraft:
        possible["inertia"] = lambda: _inertia_parameter(np.asarray(plant.inertia), prior)
        possible["actuator_misalignment"] = lambda: _misalignment_parameter(
            model, axes, *prior_sigma("actuator_misalignment", 1)
        )
        if "attitude" in model.noises:
            add_vector("star_tracker_misalignment", "rad", "add", "misalignment", 3)
        if "rate" in model.noises:
            add_vector("gyro_scale", "-", "factor", "rate_scale", 3)
    if hasattr(plant, "coupling"):
        add_vector("mode_frequency", "rad/s", "log", "plant.frequency", plant.frequency.size)
        # within its uncertainty, the estimate of a small damping ratio may be negative
        add_vector("mode_damping", "-", "add", "plant.damping", plant.frequency.size)
        possible["mode_coupling"] = lambda: _coupling_parameter(model, *prior_sigma("mode_coupling", 1))
    if not model.is_spacecraft:  # the numbers inside a custom plant
        leaves = tree_flatten_with_path(plant)[0]
        # the argument 0 of a `jax.tree_util.Partial` H is plant.H[0], its argument drag is plant.H['drag']
        short = [keystr(tuple(key for key in path if not isinstance(key, FlattenedIndexKey))) for path, _ in leaves]
        for k, (key_path, leaf) in enumerate(leaves):
            path = "plant" + (short[k] if short.count(short[k]) == 1 else keystr(key_path))
            if not path.startswith(("plant.inertia", "plant.z0")):
                possible.setdefault(path, lambda path=path, k=k, leaf=leaf: _leaf_parameter(path, model, k, leaf))
    if isinstance(getattr(scenario, "sensors", None), SensorSuite):
        possible = {name: make for name, make in possible.items() if name not in HARDWARE_PARAMETERS}
    return possible


def _number_parameter(
    name: str,
    unit: str,
    kind: str,
    model: Model,
    get: Callable[[Model], Any],
    put: Callable[[Model, Array], Model],
    sigmas: np.ndarray,
    has_prior: bool,
) -> Parameter:
    """Return the parameter of some numbers of a model. A number of zero is fixed unless a coordinate adds to it.

    Args:
        name: name of the parameter.
        unit: unit of the numbers.
        kind: effect of a coordinate c: "log" multiplies by e^c, "factor" multiplies by 1 + c, "add" adds c.
        model: the model of the scenario.
        get: returns the numbers of a model.
        put: returns a model with other numbers.
        sigmas: prior 1 sigma of the coordinates.
        has_prior: whether [dispersion] gives it.
    """
    count = len(sigmas)

    def read(model: Model) -> Array:
        return jnp.asarray(get(model), float) * jnp.ones(count)

    start = read(model)

    def write(model: Model, c: Array) -> Model:
        new = start * jnp.exp(c) if kind == "log" else start * (1.0 + c) if kind == "factor" else start + c
        return put(model, new)

    is_free = (np.asarray(start) != 0.0) | (kind == "add")
    common = None if kind == "add" else 1.0 / sigmas[is_free]
    labels = [name] if count == 1 else [f"{name}_{k + 1}" for k in range(count)]
    return Parameter(name, labels, unit, np.diag(sigmas)[:, is_free], has_prior, write, read, common)


def _leaf_parameter(path: str, model: Model, place: int, leaf: ArrayLike) -> Parameter:
    """Return the parameter of a leaf of a custom plant, whose number among the leaves is `place`."""
    start = np.asarray(leaf)
    sizes = np.where(start == 0.0, np.max(np.abs(start), initial=0.0) or 1.0, np.abs(start))

    def put(model: Model, new: Array) -> Model:
        leaves, tree = jax.tree.flatten(model.plant)
        leaves[place] = new.reshape(start.shape)
        return replace(model, plant=jax.tree.unflatten(tree, leaves))

    def get(model: Model) -> Array:
        return jnp.ravel(jax.tree.leaves(model.plant)[place])

    return _number_parameter(path, "", "add", model, get, put, USUAL_SIGMA["plant"] * sizes.ravel(), False)


def _misalignment_parameter(model: Model, axes: np.ndarray, sigmas: np.ndarray, has_prior: bool) -> Parameter:
    """Return the parameter of the channels' misalignment: small rotations of each channel about two axes normal to it.

    A rotation of a channel about its own axis has no effect.
    """
    directions = axes if model.actuators.directions is None else np.asarray(model.actuators.directions)
    normal_axes = [np.linalg.svd(direction[None])[2][1:] for direction in directions.T]  # (2, 3) for each channel

    def write(model: Model, c: Array) -> Model:
        rotated = []
        for k, direction in enumerate(directions.T):
            rotation = c[2 * k] * normal_axes[k][0] + c[2 * k + 1] * normal_axes[k][1]
            rotated.append(attitude.rotate(attitude.from_rotation_vector(rotation), jnp.asarray(direction)))
        return replace(model, actuators=replace(model.actuators, directions=jnp.stack(rotated, axis=1)))

    def read(model: Model) -> Array:
        current = directions if model.actuators.directions is None else model.actuators.directions
        pairs = zip(directions.T, current.T, strict=True)
        rotations = [attitude.cross(jnp.asarray(a), jnp.asarray(b)) for a, b in pairs]
        return jnp.concatenate([jnp.asarray(normal_axes[k]) @ rotation for k, rotation in enumerate(rotations)])

    count = 2 * directions.shape[1]
    labels = [f"actuator_misalignment_{k // 2 + 1}{'ab'[k % 2]}" for k in range(count)]
    factor = float(sigmas[0]) * np.eye(count)
    return Parameter("actuator_misalignment", labels, "rad", factor, has_prior, write, read)


def _coupling_parameter(model: Model, sigmas: np.ndarray, has_prior: bool) -> Parameter:
    """Return the parameter of the mode coupling (modes, 3). Its coordinates are relative to the norm of each row."""
    row_norms = np.linalg.norm(np.asarray(model.plant.coupling), axis=1, keepdims=True) * np.ones(3)

    def put(model: Model, new: Array) -> Model:
        return replace(model, plant=replace(model.plant, coupling=new.reshape(-1, 3)).with_rest_inverse())

    labels = [f"mode_coupling_{k + 1}{i + 1}" for k in range(len(row_norms)) for i in range(3)]
    parameter = _number_parameter(
        "mode_coupling", "sqrt(kg) m", "add", model, lambda model: jnp.ravel(model.plant.coupling), put,
        float(sigmas[0]) * row_norms.ravel(), has_prior,
    )  # fmt: skip
    return parameter._replace(labels=labels)


def _inertia_parameter(start: np.ndarray, prior: object) -> Parameter:
    """Return the inertia parameter, in log-Cholesky coordinates of the pseudo-inertia. Every value is physical.

    The prior covariance equals the covariance of the dispersion, to first order in the rotation of the principal axes.
    If the dispersion does not rotate the axes, they are known, and the estimate has the axes of the scenario.
    """
    table = getattr(prior, "inertia", None)
    if table is not None and hasattr(table, "factor"):
        root, factor = numbers.pseudo_root(start), table.matrix()
    else:
        usual = USUAL_SIGMA["inertia"]
        std, turn = (usual, usual) if table is None else (max(table.std, 1e-6), np.deg2rad(table.axes_deg))
        moments, axes = np.linalg.eigh(start)
        root = axes @ numbers.pseudo_root(np.diag(moments))  # a diagonal L keeps the principal axes
        changes = [std * moments[k] * np.outer(axes[:, k], axes[:, k]) for k in range(3)]
        for i, j in ((0, 1), (0, 2), (1, 2)) if turn else ():  # products of inertia in the principal axes
            sigma = turn * np.sqrt((moments[i] - moments[j]) ** 2 + std**2 * (moments[i] ** 2 + moments[j] ** 2))
            product = np.outer(axes[:, i], axes[:, j])
            changes.append(sigma * (product + product.T))
        by_prior = np.stack([np.asarray(_upper_triangle(jnp.asarray(change))) for change in changes], axis=1)
        factor = np.linalg.solve(inertia_derivatives(root), by_prior)

    def write(model: Model, c: Array) -> Model:
        inertia = numbers.from_coordinates(vector(root), c)
        plant = model.plant.with_inertia(inertia, matrices.solve(inertia, jnp.eye(3)))
        return replace(model, plant=plant, disturbance=disturbances.on_body(model.disturbance, inertia))

    labels = [f"inertia_{i + 1}{j + 1}" for i, j in PAIRS]
    common = np.linalg.lstsq(factor, np.repeat([0.5, 0.0], 3), rcond=None)[0]
    read = lambda model: _upper_triangle(model.plant.inertia)  # noqa: E731
    return Parameter("inertia", labels, "kg m^2", factor, table is not None, write, read, common)


def inertia_derivatives(root: np.ndarray) -> np.ndarray:
    """Return the derivatives (6, 6) [kg m^2] of the entries of an inertia by its log-Cholesky coordinates.

    root: factor of its pseudo-inertia (3, 3), see `numbers.pseudo_root`.
    """
    return np.asarray(jax.jacfwd(lambda c: _upper_triangle(numbers.from_coordinates(vector(root), c)))(jnp.zeros(6)))


def _upper_triangle(inertia: Array) -> Array:
    """Return the upper triangle (6,) of an inertia (3, 3), in the order of `PAIRS`."""
    return jnp.stack([inertia[i, j] for i, j in PAIRS])
