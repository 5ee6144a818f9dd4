"""The control period of the flight computer as a sequence of stages; the export turns each stage into a C function.

A stage calls the same code of `devices`, `observers` and `laws` as the simulation. It reads and writes values by name,
with a prefix:

- `in.`: inputs at this sample
- `before.`: state after the last sample
- `last.`: outputs of the last sample
- `now.`: state after this sample
- `out.`: outputs of this sample

Read `build_board` first.
"""

import dataclasses
from collections.abc import Callable
from dataclasses import dataclass, field
from functools import partial
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np

from ptsmc_jax.batching.dependence import dependence
from ptsmc_jax.devices.actuators import Actuators, ActuatorState, Drive
from ptsmc_jax.devices.attitude_filter import Estimate
from ptsmc_jax.devices.attitude_sensors import SampleTimes, StarTracker
from ptsmc_jax.devices.command_filter import CommandFilter
from ptsmc_jax.devices.kalman_filter import KalmanFilter, Track
from ptsmc_jax.laws.base import Law, Sample
from ptsmc_jax.numerics import attitude, guards
from ptsmc_jax.observers.base import Memory, Observer
from ptsmc_jax.onboard import derived, origins
from ptsmc_jax.plants.base import Plant, State
from ptsmc_jax.plants.rigid_body import AttitudeState
from ptsmc_jax.signals.references import Target
from ptsmc_jax.simulation import rollout
from ptsmc_jax.simulation.assembly import Parts

ATTITUDE_IS_SET = 0.25  # |q|^2 of the quaternion in the state is larger if it has been set, and 0 before


Values = dict[str, Any]  # values by name


@dataclass(frozen=True)
class Stage:
    """A function of the flight computer."""

    name: str
    description: str
    run: Callable[[Values, Values], Values]  # (parameters, all values) -> values that it writes, by name
    parts: tuple[object, ...] = ()  # parts whose docstrings the C function has as a comment


@dataclass
class Board:
    """The flight computer of a scenario: shapes of its values by name, their meanings, and its stages."""

    model: Plant  # design model of the plant
    parameters: Values
    inputs: Values = field(default_factory=dict)
    state: Values = field(default_factory=dict)
    outputs: Values = field(default_factory=dict)
    stages: list[Stage] = field(default_factory=list)
    rules: list[derived.Rule] = field(default_factory=list)  # rules that derive parameters from other parameters
    meanings: dict[str, str] = field(default_factory=dict)  # meaning of each value, by name
    always_exported: tuple[str, ...] = ("period",)  # parameters that C has even if no stage reads them

    @property
    def unit(self) -> str:
        """The unit of inputs and disturbances, in brackets."""
        return f" [{self.model.input_unit}]" if self.model.input_unit else ""

    def measured_state(self, values: Values, prefix: str) -> State:
        """Return the measured state from its signals in `values`, which have the prefix "in", "before" or "now"."""
        return self.model.state_of({name: values[f"{prefix}.{name}"] for name in self.model.signals})

    @property
    def part_descriptions(self) -> dict[str, str]:
        """The type of each part and the values that are fixed in it, by name of the part."""
        parts = {name: part for name, part in self.parameters.items() if dataclasses.is_dataclass(part)}
        return {name: _static_description(part) for name, part in parts.items()}


def _static_description(part: Any) -> str:
    """Return a part's class name with its compile-time constants, such as "Actuators(delay=2)".

    Parts inside the part are described in the same way.
    """
    constants = []
    for entry in dataclasses.fields(part):
        value = getattr(part, entry.name)
        if entry.metadata.get("static"):
            constants.append(f"{entry.name}={value!r}")
        elif isinstance(value, tuple) and all(map(dataclasses.is_dataclass, value)):
            constants += [f"{entry.name}[{k}]={_static_description(inner)}" for k, inner in enumerate(value)]
        elif isinstance(value, SampleTimes):
            constants.append(f"{entry.name}={_static_description(value)}")
    return type(part).__qualname__ + (f"({', '.join(constants)})" if constants else "")


def real(*shape: int) -> jax.ShapeDtypeStruct:
    """Return shape and dtype of an array of real numbers with these dimensions."""
    return jax.ShapeDtypeStruct(shape, jnp.result_type(float))


def flag() -> jax.ShapeDtypeStruct:
    """Return shape and dtype of a flag, an integer that is 0 or 1."""
    return jax.ShapeDtypeStruct((), jnp.int32)


SCALARS = {"t": real, "dt": real, "regular": flag, "tracking": flag}  # scalar arguments of the C functions


def build_board(parts: Parts, reference_input: bool = False) -> Board:
    """Return the flight computer of a scenario with a sampled loop.

    Args:
        parts: the scenario.
        reference_input: whether the reference is an input instead of a function of time in the code.
    """
    observer, law = parts.observer, parts.controller
    device = parts.actuators
    parameters, inputs = board_parameters(parts), observer.model.inputs
    computer = Board(observer.model, parameters, rules=derived.rules(parts))
    computer.meanings["period"] = "control period [s]"
    computer.meanings["observer_matrix"] = origins.summary(type(observer).update_matrix.__doc__).rstrip(".")
    if parameters["filter"] is None:
        _add_sensor_stage(computer, parts)
    elif isinstance(parameters["filter"], KalmanFilter):
        _add_kalman_filter_stage(computer, parameters["filter"])
    else:
        _add_filter_stage(computer, parts)
    _add_observer_stage(computer, observer, device)
    _add_law_stage(computer, law, observer, parts.command_filter)
    computer.stages.append(Stage("begin", "Initial memory of observer, law and filters.", begin))
    if not device.is_ideal:
        _add_actuator_stage(computer, device, inputs)
    return _with_reference_input(computer) if reference_input else computer


def _with_reference_input(computer: Board) -> Board:
    """Return the flight computer with the reference as an input. Both signs of its quaternion give the same result."""
    target = jax.eval_shape(computer.parameters["reference"], real())
    is_attitude = isinstance(target, Target)
    computer.inputs["reference"] = target
    computer.parameters = {name: value for name, value in computer.parameters.items() if name != "reference"}
    if is_attitude:
        computer.state["reference"] = real(4)
        computer.meanings |= {
            "reference_q": "reference attitude",
            "reference_w": "its rate, in reference axes [rad/s]",
            "reference_w_dot": "time derivative of that rate [rad/s^2]",
            "reference": "reference attitude at the last sample",
        }
    else:
        computer.meanings["reference"] = "reference at this sample"

    def with_input(stage: Stage) -> Stage:
        def run_stage(parameters: Values, values: Values) -> Values:
            target, kept = values["in.reference"], {}
            if is_attitude:
                q = attitude.unit(target.q)
                target = target._replace(q=jnp.where(jnp.dot(q, values["before.reference"]) < 0.0, -q, q))
                kept = {"now.reference": target.q} if stage.name == "sense" else {}
            return stage.run({**parameters, "reference": lambda t: target}, values) | kept

        return dataclasses.replace(stage, run=run_stage)

    computer.stages = [with_input(stage) if stage.name in ("sense", "command") else stage for stage in computer.stages]
    return computer


def board_parameters(parts: Parts) -> Values:
    """Return the parameters of the flight computer by name [SI units]. They belong to the design model."""
    observer, sensors, period = parts.observer, parts.sensors, parts.period
    parameters = {
        "law": parts.controller,
        "reference": parts.reference,
        "observer": observer,
        "observer_matrix": observer.update_matrix(period),
        "bound": observer.error_bound(),
        "filter": getattr(sensors, "filter", None),
        "actuators": parts.actuators,
        "command_filter": parts.command_filter,
        "period": period,
    }
    if isinstance(parameters["filter"], KalmanFilter):
        # C starts at control sample 0, and so it does not need the initial covariances for other samples
        parameters["filter"] = dataclasses.replace(parameters["filter"], first=parameters["filter"].first[:1])
    elif parameters["filter"] is not None:  # C derives the filter's gains from its bandwidth
        parameters["filter_bandwidth"] = sensors.bandwidth(period)
        if sensors.own_times is not None:
            parameters["star_tracker_interval"] = sensors.own_times.interval
    return parameters


def _nearest_form(parameters: Values, values: Values, x: State, before: State) -> State:
    """Return the equivalent form of a state, such as q or -q, that is nearest to the state at the last sample.

    At the first sample it is the form of `Kinematics.align`.
    """
    law, target = parameters["law"], parameters["reference"](values["t"])
    nearest, aligned = law.model.nearest_representation(x, before), law.kinematics.align(x, target)
    return jax.tree.map(lambda *forms: jnp.where(values["tracking"] != 0, *forms), nearest, aligned)


def _add_sensor_stage(computer: Board, parts: Parts) -> None:
    """Add the stage that reads the measured state directly, without an attitude filter."""
    model = computer.model
    signals = jax.eval_shape(model.signals_of, parts.plant.visible(parts.initial))
    computer.inputs |= signals
    computer.state |= signals
    computer.meanings |= model.signals

    def sense(parameters: Values, values: Values) -> Values:
        before, measured = (computer.measured_state(values, prefix) for prefix in ("before", "in"))
        x = _nearest_form(parameters, values, model.normalise_measurement(measured), before)
        return {f"now.{name}": value for name, value in model.signals_of(x).items()}

    computer.stages.append(Stage("sense", "The measured state, which the law uses without a filter.", sense))


def _add_filter_stage(computer: Board, parts: Parts) -> None:
    """Add the stage of the attitude filter with constant gains, from star tracker and gyro."""
    sensors: Any = parts.sensors
    has_age = sensors.own_times is not None  # the star tracker has its own clock
    computer.parameters["filter_bandwidth"] = derived.shortest_filter_bandwidth(sensors, parts.period)
    age = {"attitude_age": real()} if has_age else {}
    computer.inputs |= {"attitude": real(4), "attitude_valid": flag(), **age, "rate": real(3)}
    computer.state |= {"attitude": real(4), "rate": real(3), "bias": real(3), "gyro": real(3)}
    computer.meanings |= computer.model.signals | {
        "attitude_valid": "whether the star tracker has an attitude at this sample: 0 or 1",
        "attitude_age": "age of this attitude at the sample, at most the time since the last sample [s]",
        "bias": "estimated gyro bias [rad/s]",
        "gyro": "rate that the gyro measured at the last sample [rad/s]",
        "filter_bandwidth": "bandwidth of the corrections by the star tracker [rad/s]",
        "star_tracker_interval": "time between two samples of the star tracker [s]",
    }

    def sense(parameters: Values, values: Values) -> Values:
        attitude_filter, dt, one = parameters["filter"], values["dt"], jnp.ones_like(values["dt"])
        before, gyro, gyro_before = values["before.attitude"], values["in.rate"], values["before.gyro"]
        valid = values["in.attitude_valid"] != 0
        measured = attitude.unit(jnp.where(valid, values["in.attitude"], before))  # an invalid input is not used
        start = jnp.where(jnp.dot(before, before) > ATTITUDE_IS_SET, before, measured)
        last_estimate = Estimate(start, values["before.bias"])
        if has_age:
            estimate = jax.lax.cond(
                valid,
                lambda age: attitude_filter.correct_between(
                    last_estimate, gyro_before, gyro, dt, measured, jnp.clip(age, 0.0, dt), one
                ),
                lambda _: attitude_filter.propagate(last_estimate, gyro_before, gyro, dt),
                values["in.attitude_age"],
            )
        else:
            ahead = attitude_filter.propagate(last_estimate, gyro_before, gyro, dt)
            estimate = jax.lax.cond(valid, lambda: attitude_filter.correct(ahead, measured, one), lambda: ahead)
        rate = gyro - estimate.bias
        x = _nearest_form(parameters, values, AttitudeState(estimate.q, rate), AttitudeState(start, rate))
        return {"now.attitude": x.q, "now.rate": rate, "now.bias": estimate.bias, "now.gyro": gyro}

    summary = "Attitude filter: propagates the attitude with the gyro and corrects it with the star tracker."
    computer.stages.append(Stage("sense", summary, sense, (sensors.filter,)))


def _add_kalman_filter_stage(computer: Board, estimator: KalmanFilter) -> None:
    """Add the stage of the attitude Kalman filter, from a gyro and attitude sensors."""
    computer.inputs["rate"] = real(3)
    computer.meanings["rate"] = computer.model.signals["rate"]
    for sensor in estimator.sensors:
        name, identity = sensor.name, jnp.array([0.0, 0.0, 0.0, 1.0])
        computer.inputs |= {name: jax.eval_shape(sensor.read, identity), f"{name}_valid": flag()}
        computer.meanings[name] = origins.summary(type(sensor).__doc__)
        computer.meanings[f"{name}_valid"] = f"whether {name} has a reading at this sample: 0 or 1"
        if sensor.times.every is None:
            computer.inputs[f"{name}_age"] = real()
            computer.meanings[f"{name}_age"] = f"age of the reading of {name} at the sample [s]"
    track = jax.eval_shape(estimator.begin, real(4), real(3), real(3), real(6), 0, real())
    computer.state |= {"attitude": real(4), "rate": real(3)} | track.by_name
    computer.meanings |= {
        "bias": "estimated gyro bias [rad/s]",
        "gyro": "rate that the gyro measured at the last sample, minus its estimated noise [rad/s]",
        "past_attitude": "estimated attitudes at the last samples, the newest first",
        "past_rate": "estimated body rates at these samples [rad/s]",
        "covariance": "covariance of the errors of attitude [rad], bias [rad/s], last gyro sample [rad/s] and past "
        "attitudes [rad]",
    }

    def sense(parameters: Values, values: Values) -> Values:
        estimator, before, one = parameters["filter"], values["before.attitude"], jnp.ones_like(values["dt"])
        start, readings = before, []
        for sensor in estimator.sensors:  # before the attitude is known, use the reading of a star tracker
            valid = values[f"in.{sensor.name}_valid"] != 0
            reading = jnp.where(valid, values[f"in.{sensor.name}"], sensor.read(start))
            if isinstance(sensor, StarTracker):
                reading = attitude.unit(reading)
                is_unknown = valid & (jnp.dot(start, start) <= ATTITUDE_IS_SET)
                start = jnp.where(is_unknown, sensor.body(reading), start)
            readings.append((valid, reading))
        past = values.get("before.past_attitude")
        if past is not None:
            past = jax.vmap(lambda q: jnp.where(jnp.dot(q, q) > ATTITUDE_IS_SET, q, start))(past)
        covariance = jax.lax.cond(
            jnp.dot(before, before) > ATTITUDE_IS_SET,
            lambda: values["before.covariance"],
            lambda: estimator.covariance_at_switch_on(),
        )
        estimates = (values["before.bias"], values["before.gyro"], past, values.get("before.past_rate"))
        track = estimator.propagate(Track(start, *estimates, covariance), values["in.rate"], values["dt"])
        for k, (sensor, (valid, reading)) in enumerate(zip(estimator.sensors, readings, strict=True)):
            age = values.get(f"in.{sensor.name}_age", sensor.times.wait * estimator.period)
            corrected = partial(estimator.correct, track, k, reading, age, one)
            track = jax.lax.cond(valid, corrected, lambda track=track: track)
        x = _nearest_form(parameters, values, AttitudeState(track.q, track.w), AttitudeState(start, track.w))
        now = track._replace(q=x.q).by_name | {"rate": track.w}
        return {f"now.{name}": value for name, value in now.items()}

    summary = "Attitude Kalman filter: propagates the attitude with the gyro and corrects it with the attitude sensors."
    computer.stages.append(Stage("sense", summary, sense, (estimator,)))


def _add_observer_stage(computer: Board, observer: Observer, device: Actuators) -> None:
    """Add a stage that estimates the disturbance from the motion in the last period."""
    m, wheels = observer.model.inputs, device.wheels
    computer.state["observer"] = jax.eval_shape(observer.begin)
    computer.outputs["d_hat"] = real(m)
    computer.meanings |= {"observer": "memory of the observer; the first numbers are the estimate",
                   "d_hat": f"estimated disturbance{computer.unit}"}  # fmt: skip
    telemetry_shapes = {}  # wheel telemetry that determines the torque over the next period
    if wheels is not None:
        per_wheel = real(*np.shape(wheels.initial))
        computer.meanings["wheel_momentum"] = (
            "absolute momentum of each wheel: spin inertia times (wheel speed + axis . body rate) [N m s]"
        )
        telemetry_shapes = {"wheel_momentum": per_wheel, **({"acting": per_wheel} if device.has_dynamics else {})}
        computer.inputs |= telemetry_shapes
        computer.state |= telemetry_shapes
        torque_name = "last.wheel_torque"
    elif device.has_dynamics:
        computer.inputs["applied"] = real(m)
        computer.meanings["applied"] = f"mean torque on the body over the last period, from telemetry{computer.unit}"
        torque_name = "in.applied"
    else:
        torque_name = "last.command" if device.is_ideal else "last.torque"

    def observe(parameters: Values, values: Values) -> Values:
        observer, t, dt, memory = parameters["observer"], values["t"], values["dt"], values["before.observer"]
        model = observer.model
        before, now = computer.measured_state(values, "before"), computer.measured_state(values, "now")

        def update_observer() -> Memory:
            applied = values[torque_name]
            if telemetry_shapes:
                momentum, limited = values["before.wheel_momentum"], jnp.zeros((), bool)
                drive = Drive(values.get("before.acting"), applied, momentum, limited)
                torque, wheel_momentum = parameters["actuators"].assumed_torque(drive, dt)
                mean_rate = (model.velocity(before) + model.velocity(now)) / 2
                applied = torque - jnp.cross(mean_rate, wheel_momentum)
            impulse = model.implied_disturbance_impulse(t, before, now, applied, dt)
            return observer.update(parameters["observer_matrix"], memory, impulse, t, dt)

        memory = jax.lax.cond(values["regular"] != 0, update_observer, lambda: memory)
        results = {"now.observer": memory, "out.d_hat": observer.estimate(memory)}
        return results | {f"now.{name}": values[f"in.{name}"] for name in telemetry_shapes}

    summary = "Disturbance observer: estimates the disturbance from the motion since the last sample."
    computer.stages.append(Stage("observe", summary, observe, (observer,)))


def _add_law_stage(computer: Board, law: Law, observer: Observer, command_filter: CommandFilter | None) -> None:
    """Add a stage that evaluates the law, before and after its hand-over, and filters its command."""
    m, x = observer.model.inputs, computer.model.state_of(computer.state)
    target = jax.eval_shape(computer.parameters["reference"], real())
    now = Sample(jnp.zeros(()), jnp.zeros((), bool), jnp.ones(()), law.begin())
    _, s, _ = jax.eval_shape(lambda *arguments: law(*arguments), now, x, target, jnp.zeros(m), jnp.zeros(()))
    computer.state["law"] = jax.eval_shape(law.begin)
    computer.outputs |= {"command": real(m), "s": real(*s.shape)}
    filter_note = "" if command_filter is None else ", after the command filter"
    computer.meanings |= {
        "law": "memory of the law",
        "command": f"command of the law{filter_note}{computer.unit}",
        "s": "sliding variable",
    }
    memories, filter_parts = ["law"], ()
    if command_filter is not None:
        computer.state["command_filter"] = jax.eval_shape(lambda: command_filter.begin(m))
        computer.meanings["command_filter"] = "states of the command filter, half a period ahead"
        memories, filter_parts = ["law", "command_filter"], (command_filter,)
    traced = jax.make_jaxpr(law.singularity_distance)(x, target)
    can_be_singular = any(dependence(traced.jaxpr, [True] * len(traced.jaxpr.invars)))  # whether the distance can vary
    if can_be_singular:
        computer.state |= {"singularity_distance": real(), "singularity_distance_unit": real()}
        computer.meanings |= {"singularity_distance": "distance to the law's singularity, divided by its unit [-]",
                           "singularity_distance_unit": "unit of singularity_distance"}  # fmt: skip

    def command(parameters: Values, values: Values) -> Values:
        law, period, t = parameters["law"], parameters["period"], values["t"]
        memory_before = {name: values[f"before.{name}"] for name in memories}
        now, reference = computer.measured_state(values, "now"), parameters["reference"](t)
        hold = t >= law.hand_over - guards.time_tolerance(period, law.hand_over)  # the tolerance of `clock.Sampled`

        def evaluate_law() -> tuple[jax.Array, jax.Array, Values]:
            sample, k2 = Sample(t, hold, period, memory_before["law"]), parameters["bound"](t)
            u, s, law_memory = law(sample, now, reference, values["out.d_hat"], k2)
            u, s = (jnp.asarray(v, jnp.result_type(float)) for v in (u, s))  # a custom law may return integers
            if command_filter is None:
                return u, s, {"law": law_memory}
            elapsed = jnp.where(values["dt"] > 0.0, period, 0.0)  # a whole period, even after missed samples
            u, integrators = parameters["command_filter"].step(memory_before["command_filter"], u, elapsed, period)
            return u, s, {"law": law_memory, "command_filter": integrators}

        if can_be_singular:
            distance = law.singularity_distance(now, reference)
            unit = jnp.where(
                values["tracking"] != 0,
                values["before.singularity_distance_unit"],
                law.kinematics.singularity_distance_unit(distance),
            )
            singularity_distance, last = distance / unit, (values["last.command"], values["last.s"], memory_before)
            u, s, memory_after = jax.lax.cond(
                singularity_distance >= rollout.SINGULAR_DISTANCE, evaluate_law, lambda: last
            )
            memory_after |= {"singularity_distance": singularity_distance, "singularity_distance_unit": unit}
        else:
            u, s, memory_after = evaluate_law()
        return {"out.command": u, "out.s": s} | {f"now.{name}": value for name, value in memory_after.items()}

    summary = f"Control law: the command for the measured state{filter_note}; the last command if the law is singular."
    computer.stages.append(Stage("command", summary, command, (law, law.kinematics, *filter_parts)))


def begin(parameters: Values, values: Values) -> Values:
    """Return the memory before the first sample."""
    command_filter, m = parameters["command_filter"], parameters["observer"].model.inputs
    memories = {} if command_filter is None else {"now.command_filter": command_filter.begin(m)}
    estimator = parameters["filter"]
    if isinstance(estimator, KalmanFilter):
        memories["now.covariance"] = estimator.covariance(estimator.first[0])
    return {"now.observer": parameters["observer"].begin(), "now.law": parameters["law"].begin(), **memories}


def _add_actuator_stage(computer: Board, device: Actuators, m: int) -> None:
    """Add a stage that models the actuators: delay, limits, allocation to wheels."""
    wheels = device.wheels
    if device.delay:
        computer.state["queue"] = real(device.delay, m)
        computer.meanings["queue"] = f"delayed commands, the oldest first{computer.unit}"
    if device.has_dynamics:
        computer.inputs.setdefault("acting", real(m))
        computer.meanings["acting"] = f"torque of each axis or wheel at this sample, from telemetry{computer.unit}"
    compensation_note = "" if wheels is None else ", plus the compensation of the wheels' momentum"
    computer.outputs |= {"sent_torque": real(m), "torque": real(m)}
    computer.meanings["sent_torque"] = (
        f"torque to send to the actuators at this sample: `command` within its limit{compensation_note}{computer.unit}"
    )
    computer.meanings["torque"] = (
        f"torque on the body from this sample on, as the flight computer assumes it{computer.unit}"
    )
    if wheels is not None:
        computer.outputs["wheel_torque"] = real(*np.shape(wheels.initial))
        computer.meanings["wheel_torque"] = "torque of each wheel on the body about its axis, from this sample on [N m]"

    def act(parameters: Values, values: Values) -> Values:
        actuators, u = parameters["actuators"], values["out.command"]
        state = ActuatorState(values.get("before.queue"), values.get("in.acting"), values.get("in.wheel_momentum"))
        rate = values.get("now.rate", jnp.zeros_like(u))
        drive, queue = actuators.command(state, u, rate, jnp.zeros(()), parameters["period"], jnp.ones(()))
        results = {"limited": drive.limited, "out.sent_torque": actuators.send(state, u, rate)[0]}
        results |= {} if queue is None else {"now.queue": queue}
        if wheels is None:
            return {**results, "out.torque": drive.c}
        return {**results, "out.torque": actuators.wheels.axes @ drive.c, "out.wheel_torque": drive.c}

    computer.stages.append(Stage("act", "Actuators: limits, delay, allocation to wheels.", act, (device,)))
