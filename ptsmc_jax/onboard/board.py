"""The control period of the flight computer as a sequence of stages; the export turns each stage into a C function.

A stage calls the same code of `devices`, `observers` and `laws` as the simulation. It reads and writes values by name,
with a prefix:

- `in.`: inputs at this sample
- `before.`: state after the last sample
- `last.`: outputs of the last sample
- `now.`: state after this sample
- `out.`: outputs of this sample

Read `board` first.
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
from ptsmc_jax.observers.base import Observer
from ptsmc_jax.onboard import derived
from ptsmc_jax.plants.base import Plant, State
from ptsmc_jax.plants.rigid_body import AttitudeState
from ptsmc_jax.signals.references import Target
from ptsmc_jax.simulation import run_state
from ptsmc_jax.simulation.assembly import Parts

ATTITUDE_IS_SET = 0.25  # |q|^2 of the quaternion in the state is larger if it has been set, and 0 before


Given = dict[str, Any]  # values by name


@dataclass(frozen=True)
class Stage:
    """A function of the flight computer."""

    name: str
    about: str
    reads: tuple[str, ...]
    run: Callable[[Given, Given], Given]  # (parameters, values that it reads) -> values that it writes, by name
    parts: tuple[Any, ...] = ()  # parts whose docstrings the C function has as a comment


@dataclass
class Board:
    """The flight computer of a scenario: shapes of its values by name, their meanings, and its stages."""

    model: Plant  # design model of the plant
    parameters: dict[str, Any]
    inputs: dict[str, Any] = field(default_factory=dict)
    state: dict[str, Any] = field(default_factory=dict)
    outputs: dict[str, Any] = field(default_factory=dict)
    stages: list[Stage] = field(default_factory=list)
    rules: list[derived.Rule] = field(default_factory=list)  # rules that derive parameters from other parameters
    about: dict[str, str] = field(default_factory=dict)  # meaning of each value, by name
    always: tuple[str, ...] = ("period",)  # parameters that C has even if no stage reads them

    @property
    def unit(self) -> str:
        """The unit of inputs and disturbances, in brackets."""
        return f" [{self.model.input_unit}]" if self.model.input_unit else ""

    def names(self, when: str) -> tuple[str, ...]:
        """Return the names of the measured signals with a prefix, "in", "before" or "now"."""
        return tuple(f"{when}.{name}" for name in self.model.signals)

    def seen(self, given: Given, when: str) -> State:
        """Return the measured state from values by these names."""
        return self.model.state_of({name: given[f"{when}.{name}"] for name in self.model.signals})

    @property
    def parts(self) -> dict[str, str]:
        """The type of each part and the values that are fixed in it, by name of the part."""
        made = {name: part for name, part in self.parameters.items() if dataclasses.is_dataclass(part)}
        return {name: _static_description(part) for name, part in made.items()}


def _static_description(part: Any) -> str:
    """Return a part's class name with its compile-time constants, such as "Actuators(delay=2)".

    Parts inside the part are described in the same way.
    """
    fixed = []
    for entry in dataclasses.fields(part):
        value = getattr(part, entry.name)
        if entry.metadata.get("static"):
            fixed.append(f"{entry.name}={value!r}")
        elif isinstance(value, tuple) and all(map(dataclasses.is_dataclass, value)):
            fixed += [f"{entry.name}[{k}]={_static_description(one)}" for k, one in enumerate(value)]
        elif isinstance(value, SampleTimes):
            fixed.append(f"{entry.name}={_static_description(value)}")
    return type(part).__qualname__ + (f"({', '.join(fixed)})" if fixed else "")


def real(*shape: int) -> jax.ShapeDtypeStruct:
    """Return shape and dtype of an array of real numbers with these dimensions."""
    return jax.ShapeDtypeStruct(shape, jnp.result_type(float))


def integer() -> jax.ShapeDtypeStruct:
    """Return shape and dtype of a flag."""
    return jax.ShapeDtypeStruct((), jnp.int32)


SCALARS = {"t": real, "dt": real, "regular": integer, "tracking": integer}  # scalar arguments of the C functions


def board(parts: Parts, reference_input: bool = False) -> Board:
    """Return the flight computer of a scenario with a sampled loop.

    Args:
        parts: the scenario.
        reference_input: whether the reference is an input instead of a function of time in the code.
    """
    observer, law = parts.observer, parts.controller
    device = parts.actuators
    parameters, inputs = known(parts), observer.model.inputs
    computer = Board(observer.model, parameters, rules=derived.rules(parts))
    computer.about["period"] = "control period [s]"
    computer.about["observer_matrix"] = _summary(type(observer).update_matrix).rstrip(".")
    if parameters["filter"] is None:
        _reading(computer, parts)
    elif isinstance(parameters["filter"], KalmanFilter):
        _estimating(computer, parameters["filter"])
    else:
        _filtering(computer, parts)
    _observing(computer, observer, device)
    _commanding(computer, law, observer, parts.command_filter)
    computer.stages.append(Stage("begin", "Initial memory of observer, law and filters.", (), begin))
    if not device.ideal:
        _acting(computer, device, inputs)
    return _with_reference_input(computer) if reference_input else computer


def _with_reference_input(computer: Board) -> Board:
    """Return the flight computer with the reference as an input. Both signs of its quaternion give the same result."""
    target = jax.eval_shape(computer.parameters["reference"], real())
    about = {"reference_q": "reference attitude", "reference_w": "its rate, in reference axes [rad/s]",
             "reference_w_dot": "time derivative of that rate [rad/s^2]"}  # fmt: skip
    computer.inputs["reference"], computer.parameters = target, {**computer.parameters}
    del computer.parameters["reference"]
    computer.about |= about if isinstance(target, Target) else {"reference": "reference at this sample"}
    if isinstance(target, Target):
        computer.state["reference"] = real(4)
        computer.about["reference"] = "reference attitude at the last sample"

    def following(stage: Stage) -> Stage:
        def run(parameters: Given, given: Given) -> Given:
            target = given["in.reference"]
            if isinstance(target, Target):
                q = attitude.unit(target.q)
                target = target._replace(q=jnp.where(jnp.dot(q, given["before.reference"]) < 0.0, -q, q))
            written = stage.run({**parameters, "reference": lambda t: target}, given)
            kept = stage.name == "sense" and isinstance(target, Target)
            return written | ({"now.reference": target.q} if kept else {})

        reads = ("in.reference", *(("before.reference",) if isinstance(target, Target) else ()))
        return dataclasses.replace(stage, reads=(*stage.reads, *reads), run=run)

    computer.stages = [following(stage) if stage.name in ("sense", "command") else stage for stage in computer.stages]
    return computer


def known(parts: Parts) -> dict[str, Any]:
    """Return all parameters of the flight computer by name [SI units], as known on board: not the true plant's."""
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


def _summary(documented: Any) -> str:
    return " ".join((documented.__doc__ or "").strip().split("\n\n")[0].split())


def _continued(parameters: Given, given: Given, x: State, before: State) -> State:
    """Return the state in one of its equivalent forms, such as the sign of q.

    The form is the nearest to the state at the last sample. At the first sample it is `Kinematics.align`.
    """
    law, target = parameters["law"], parameters["reference"](given["t"])
    near, first = law.model.nearest(x, before), law.kinematics.align(x, target)
    return jax.tree.map(lambda *forms: jnp.where(given["tracking"] != 0, *forms), near, first)


def _reading(computer: Board, parts: Parts) -> None:
    """Add a stage that reads sensors without a filter."""
    model = computer.model
    signals = jax.eval_shape(model.signals_of, parts.plant.visible(parts.initial))
    computer.inputs |= signals
    computer.state |= signals
    computer.about |= model.signals

    def sense(parameters: Given, given: Given) -> Given:
        x = _continued(parameters, given, model.accepted(computer.seen(given, "in")), computer.seen(given, "before"))
        return {f"now.{name}": value for name, value in model.signals_of(x).items()}

    reads = ("tracking", "t", *computer.names("in"), *computer.names("before"))
    computer.stages.append(Stage("sense", "The measured state, which the law uses without a filter.", reads, sense))


def _filtering(computer: Board, parts: Parts) -> None:
    """Add the stage of the attitude filter with constant gains, from star tracker and gyro."""
    sensors: Any = parts.sensors
    aged = sensors.own_times is not None  # the star tracker has its own clock
    computer.parameters["filter_bandwidth"] = derived.bandwidth(sensors, parts.period)  # a number of few digits
    age = {"attitude_age": real()} if aged else {}
    computer.inputs |= {"attitude": real(4), "attitude_valid": integer(), **age, "rate": real(3)}
    computer.state |= {"attitude": real(4), "rate": real(3), "bias": real(3), "gyro": real(3)}
    computer.about |= computer.model.signals | {
        "attitude_valid": "whether the star tracker has an attitude at this sample: 0 or 1",
        "attitude_age": "age of this attitude at the sample, at most the time since the last sample [s]",
        "bias": "estimated gyro bias [rad/s]",
        "gyro": "rate that the gyro measured at the last sample [rad/s]",
        "filter_bandwidth": "bandwidth of the corrections by the star tracker [rad/s]",
        "star_tracker_interval": "time between two samples of the star tracker [s]",
    }

    def sense(parameters: Given, given: Given) -> Given:
        attitude_filter, dt, one = parameters["filter"], given["dt"], jnp.ones_like(given["dt"])
        before, gyro, gyro_before = given["before.attitude"], given["in.rate"], given["before.gyro"]
        valid = given["in.attitude_valid"] != 0
        measured = attitude.unit(jnp.where(valid, given["in.attitude"], before))  # an invalid input is not used
        start = jnp.where(jnp.dot(before, before) > ATTITUDE_IS_SET, before, measured)
        old = Estimate(start, given["before.bias"])
        if aged:
            estimate = jax.lax.cond(
                valid,
                lambda age: attitude_filter.correct_between(
                    old, gyro_before, gyro, dt, measured, jnp.clip(age, 0.0, dt), one
                ),
                lambda _: attitude_filter.propagate(old, gyro_before, gyro, dt),
                given["in.attitude_age"],
            )
        else:
            ahead = attitude_filter.propagate(old, gyro_before, gyro, dt)
            estimate = jax.lax.cond(valid, lambda: attitude_filter.correct(ahead, measured, one), lambda: ahead)
        rate = gyro - estimate.bias
        x = _continued(parameters, given, AttitudeState(estimate.q, rate), AttitudeState(start, rate))
        return {"now.attitude": x.q, "now.rate": rate, "now.bias": estimate.bias, "now.gyro": gyro}

    about = "Attitude filter: propagates the attitude with the gyro and corrects it with the star tracker."
    reads = ("in.attitude", "in.attitude_valid", "in.rate", "before.attitude", "before.bias", "before.gyro", "dt",
             "tracking", "t", *(("in.attitude_age",) if age else ()))  # fmt: skip
    computer.stages.append(Stage("sense", about, reads, sense, (sensors.filter,)))


def _estimating(computer: Board, estimator: KalmanFilter) -> None:
    """Add the stage of the attitude Kalman filter, from a gyro and attitude sensors."""
    computer.inputs["rate"] = real(3)
    computer.about["rate"] = computer.model.signals["rate"]
    for sensor in estimator.sensors:
        name, forward = sensor.name, jnp.array([0.0, 0.0, 0.0, 1.0])
        computer.inputs |= {name: jax.eval_shape(sensor.read, forward), f"{name}_valid": integer()}
        computer.about[name] = _summary(type(sensor))
        computer.about[f"{name}_valid"] = f"whether {name} has a reading at this sample: 0 or 1"
        if sensor.times.every is None:
            computer.inputs[f"{name}_age"] = real()
            computer.about[f"{name}_age"] = f"age of the reading of {name} at the sample [s]"
    past, size = estimator.past, 9 + 3 * estimator.past
    computer.state |= {"attitude": real(4), "rate": real(3), "bias": real(3), "gyro": real(3)}
    computer.state |= {"past_attitude": real(past, 4)} if past else {}
    computer.state |= {"past_rate": real(past, 3)} if estimator.between else {}
    computer.state["covariance"] = real(size, size)
    computer.about |= {
        "bias": "estimated gyro bias [rad/s]",
        "gyro": "rate that the gyro measured at the last sample, minus its estimated noise [rad/s]",
        "past_attitude": "estimated attitudes at the last samples, the newest first",
        "past_rate": "estimated body rates at these samples [rad/s]",
        "covariance": "covariance of the errors of attitude [rad], bias [rad/s], last gyro sample [rad/s] and past "
        "attitudes [rad]",
    }
    states = [name for name in computer.state if name != "rate"]
    reads = (*(f"in.{name}" for name in computer.inputs), *(f"before.{name}" for name in states), "dt", "tracking", "t")

    def sense(parameters: Given, given: Given) -> Given:
        known, before, one = parameters["filter"], given["before.attitude"], jnp.ones_like(given["dt"])
        start, readings = before, []
        for sensor in known.sensors:  # before the attitude is known, use the reading of a star tracker
            valid = given[f"in.{sensor.name}_valid"] != 0
            reading = jnp.where(valid, given[f"in.{sensor.name}"], sensor.read(start))
            if isinstance(sensor, StarTracker):
                reading = attitude.unit(reading)
                unknown = valid & (jnp.dot(start, start) <= ATTITUDE_IS_SET)
                start = jnp.where(unknown, sensor.body(reading), start)
            readings.append((valid, reading))
        past = given.get("before.past_attitude")
        if past is not None:
            past = jax.vmap(lambda q: jnp.where(jnp.dot(q, q) > ATTITUDE_IS_SET, q, start))(past)
        covariance = jax.lax.cond(
            jnp.dot(before, before) > ATTITUDE_IS_SET, lambda: given["before.covariance"], lambda: known.unknown()
        )
        estimates = (given["before.bias"], given["before.gyro"], past, given.get("before.past_rate"))
        track = known.propagate(Track(start, *estimates, covariance), given["in.rate"], given["dt"])
        for k, (sensor, (valid, reading)) in enumerate(zip(known.sensors, readings, strict=True)):
            age = given.get(f"in.{sensor.name}_age", sensor.times.wait * known.period)
            corrected = partial(known.correct, track, k, reading, age, one)
            track = jax.lax.cond(valid, corrected, lambda track=track: track)
        x = _continued(parameters, given, AttitudeState(track.q, track.w), AttitudeState(start, track.w))
        now = {
            "attitude": x.q,
            "rate": track.w,
            "bias": track.bias,
            "gyro": track.rate,
            "past_attitude": track.past_q,
            "past_rate": track.past_w,
            "covariance": track.covariance,
        }
        return {f"now.{name}": value for name, value in now.items() if value is not None}

    about = "Attitude Kalman filter: propagates the attitude with the gyro and corrects it with the attitude sensors."
    computer.stages.append(Stage("sense", about, reads, sense, (estimator,)))


def _observing(computer: Board, observer: Observer, device: Actuators) -> None:
    """Add a stage that estimates the disturbance from the motion in the last period."""
    m, wheels = observer.model.inputs, device.wheels
    computer.state["observer"] = jax.eval_shape(observer.begin)
    computer.outputs["d_hat"] = real(m)
    computer.about |= {"observer": "memory of the observer; the first numbers are the estimate",
                   "d_hat": f"estimated disturbance{computer.unit}"}  # fmt: skip
    measured = {}  # wheel telemetry that determines the torque over the next period
    if wheels is not None:
        each = real(*np.shape(wheels.initial))
        computer.about["wheel_momentum"] = (
            "absolute momentum of each wheel: spin inertia times (wheel speed + axis . body rate) [N m s]"
        )
        measured = {"wheel_momentum": each, **({"acting": each} if device.moves else {})}
        computer.inputs |= measured
        computer.state |= measured
        acted = "last.wheel_torque"
    elif device.moves:
        computer.inputs["applied"] = real(m)
        computer.about["applied"] = "mean torque on the body over the last period, from telemetry [N m]"
        acted = "in.applied"
    else:
        acted = "last.command" if device.ideal else "last.torque"

    def observe(parameters: Given, given: Given) -> Given:
        known, t, dt, memory = parameters["observer"], given["t"], given["dt"], given["before.observer"]
        model, before, now = known.model, computer.seen(given, "before"), computer.seen(given, "now")

        def updated() -> Any:
            applied = given[acted]
            if measured:
                drive = Drive(given.get("before.acting"), applied, given["before.wheel_momentum"], jnp.zeros((), bool))
                torque, stored = parameters["actuators"].assumed(drive, dt)
                turning = (model.velocity(before) + model.velocity(now)) / 2
                applied = torque - jnp.cross(turning, stored)
            impulse = model.unexplained_impulse(t, before, now, applied, dt)
            return known.update(parameters["observer_matrix"], memory, impulse, t, dt)

        memory = jax.lax.cond(given["regular"] != 0, updated, lambda: memory)
        written = {"now.observer": memory, "out.d_hat": known.estimate(memory)}
        return written | {f"now.{name}": given[f"in.{name}"] for name in measured}

    telemetry = [f"{when}.{name}" for when in ("before", "in") for name in measured]
    states = (*computer.names("before"), *computer.names("now"))
    reads = ("t", "dt", "regular", "before.observer", *states, acted, *telemetry)
    about = "Disturbance observer: estimates the disturbance from the motion since the last sample."
    computer.stages.append(Stage("observe", about, reads, observe, (observer,)))


def _commanding(computer: Board, law: Law, observer: Observer, command_filter: CommandFilter | None) -> None:
    """Add a stage that evaluates the law, before and after its hand-over, and filters its command."""
    m, memory = observer.model.inputs, law.begin()
    x = computer.model.state_of(computer.state)
    target = jax.eval_shape(computer.parameters["reference"], real())

    def once(law: Law, x: Any, target: Any) -> Any:
        now = Sample(jnp.zeros(()), jnp.zeros((), bool), jnp.ones(()), memory)
        return law(now, x, target, jnp.zeros(m), jnp.zeros(()))[1]

    computer.state["law"] = jax.eval_shape(law.begin)
    computer.outputs |= {"command": real(m), "s": real(*jax.eval_shape(once, law, x, target).shape)}
    filtered = "" if command_filter is None else ", after the command filter"
    computer.about |= {
        "law": "memory of the law",
        "command": f"command of the law{filtered}{computer.unit}",
        "s": "sliding variable",
    }
    memories, shaped = ["law"], ()
    if command_filter is not None:
        computer.state["command_filter"] = jax.eval_shape(lambda: command_filter.begin(m))
        computer.about["command_filter"] = "states of the command filter, half a period ahead"
        memories, shaped = ["law", "command_filter"], (command_filter,)
    traced = jax.make_jaxpr(law.singularity_distance)(x, target)
    singular = any(dependence(traced.jaxpr, [True] * len(traced.jaxpr.invars)))  # whether the distance can vary
    if singular:
        computer.state |= {"singularity_distance": real(), "singularity_distance_unit": real()}
        computer.about |= {"singularity_distance": "distance to the law's singularity, divided by its unit [-]",
                           "singularity_distance_unit": "unit of singularity_distance"}  # fmt: skip

    reads = ("t", "tracking", "out.d_hat", *(f"before.{name}" for name in memories), *computer.names("now"),
             *(("dt",) if shaped else ()),
             *(("before.singularity_distance_unit", "last.command", "last.s") if singular else ()))  # fmt: skip

    def command(parameters: Given, given: Given) -> Given:
        known, period, t = parameters["law"], parameters["period"], given["t"]
        last = {name: given[f"before.{name}"] for name in memories}
        now, reference = computer.seen(given, "now"), parameters["reference"](t)
        hold = t >= known.hand_over - guards.time_tolerance(period, known.hand_over)  # the tolerance of `clock.Flight`

        def decided() -> tuple[Any, Any, dict[str, Any]]:
            sample, d_hat, k2 = Sample(t, hold, period, last["law"]), given["out.d_hat"], parameters["bound"](t)
            u, s, law = known(sample, now, reference, d_hat, k2)
            u, s = (jnp.asarray(v, jnp.result_type(float)) for v in (u, s))  # a custom law may return integers
            if command_filter is None:
                return u, s, {"law": law}
            before = jnp.where(given["dt"] > 0.0, period, 0.0)  # a whole period, even after missed samples
            u, integrators = parameters["command_filter"].step(last["command_filter"], u, before, period)
            return u, s, {"law": law, "command_filter": integrators}

        if singular:
            distance = known.singularity_distance(now, reference)
            unit = jnp.where(
                given["tracking"] != 0,
                given["before.singularity_distance_unit"],
                known.kinematics.singularity_distance_unit(distance),
            )
            singularity_distance, stays = distance / unit, (given["last.command"], given["last.s"], last)
            u, s, kept = jax.lax.cond(singularity_distance >= run_state.SINGULAR_DISTANCE, decided, lambda: stays)
            kept |= {"singularity_distance": singularity_distance, "singularity_distance_unit": unit}
        else:
            u, s, kept = decided()
        return {"out.command": u, "out.s": s} | {f"now.{name}": value for name, value in kept.items()}

    about = f"Control law: the command for the measured state{filtered}; the last command if the law is singular."
    computer.stages.append(Stage("command", about, reads, command, (law, law.kinematics, *shaped)))


def begin(parameters: Given, given: Given) -> Given:
    """Return the memory before the first sample."""
    filtering, m = parameters["command_filter"], parameters["observer"].model.inputs
    begun = {} if filtering is None else {"now.command_filter": filtering.begin(m)}
    estimator = parameters["filter"]
    if isinstance(estimator, KalmanFilter):
        begun["now.covariance"] = estimator.covariance(estimator.first[0])
    return {"now.observer": parameters["observer"].begin(), "now.law": parameters["law"].begin(), **begun}


def _acting(computer: Board, device: Actuators, m: int) -> None:
    """Add a stage that models the actuators: delay, limits, allocation to wheels."""
    wheels, reads = device.wheels, ["out.command"]
    if device.delay:
        computer.state["queue"] = real(device.delay, m)
        computer.about["queue"] = "delayed commands, the oldest first [N m]"
        reads.append("before.queue")
    if device.moves:
        computer.inputs.setdefault("acting", real(m))
        computer.about["acting"] = "torque of each axis or wheel at this sample, from telemetry [N m]"
        reads.append("in.acting")
    compensated = "" if wheels is None else ", plus the compensation of the wheels' momentum"
    computer.outputs |= {"sent_torque": real(m), "torque": real(m)}
    computer.about["sent_torque"] = (
        f"torque to send to the actuators at this sample: `command` within its limit{compensated}{computer.unit}"
    )
    computer.about["torque"] = "torque on the body from this sample on, as the flight computer assumes it [N m]"
    if wheels is not None:
        computer.outputs["wheel_torque"] = real(*np.shape(wheels.initial))
        computer.about["wheel_torque"] = "torque of each wheel on the body about its axis, from this sample on [N m]"
        reads += ["in.wheel_momentum", "now.rate"]

    def act(parameters: Given, given: Given) -> Given:
        actuators, u = parameters["actuators"], given["out.command"]
        state = ActuatorState(given.get("before.queue"), given.get("in.acting"), given.get("in.wheel_momentum"))
        rate = given.get("now.rate", jnp.zeros_like(u))
        drive, queue = actuators.command(state, u, rate, jnp.zeros(()), parameters["period"], jnp.ones(()))
        written = {"limited": drive.limited, "out.sent_torque": actuators.send(state, u, rate)[0]}
        written |= {} if queue is None else {"now.queue": queue}
        if wheels is None:
            return {**written, "out.torque": drive.c}
        return {**written, "out.torque": actuators.wheels.axes @ drive.c, "out.wheel_torque": drive.c}

    what = "Actuators: limits, delay, allocation to wheels."
    computer.stages.append(Stage("act", what, tuple(reads), act, (device,)))
