"""The true plant of a scenario as stages for C: actuators, disturbance, motion, sensors. Read `plant_board` first."""

from dataclasses import replace
from typing import Any

import jax
import jax.numpy as jnp

from ptsmc_jax.devices.actuators import ActuatorState
from ptsmc_jax.devices.ticks import Ticks
from ptsmc_jax.dispersions.variation import Dispersion
from ptsmc_jax.numerics import draws
from ptsmc_jax.onboard import derived
from ptsmc_jax.onboard.board import Board, Given, Stage
from ptsmc_jax.onboard.fmu import FILTER_STATE
from ptsmc_jax.simulation.assembly import Parts
from ptsmc_jax.simulation.computer import Computer, Decision, Software
from ptsmc_jax.simulation.control_period import (
    DISTURBANCE_WALK,
    SAMPLE_TIMES,
    State,
    Tick,
    Vehicle,
    control_period,
    star_state,
)

# parts that the plant consists of; the reference because initial attitudes may be relative to it
PARTS = ("plant", "disturbance", "sensors", "actuators", "initial", "reference", "walk_rate", "jitter")


def plant_board(parts: Parts, dispersion: Dispersion, controller: Board) -> Board:
    """Return the plant of a scenario, in the form that the export translates to C.

    The plant has one stage for each control period. The stage calls `control_period` with a flight computer that
    commands the input, and then reads the sensors at the next sample.

    Args:
        parts: the scenario on the flight clock.
        dispersion: the dispersions. C computes those of a trial from the parameters `seed` and `trial`.
        controller: the flight computer of the scenario. The plant has outputs with the names of its inputs.
    """
    numbers = {"seed": jnp.uint32(0), "trial": jnp.uint32(0), "period": parts.period, "t_end": parts.t_end}
    nominal = _picked(parts)
    trial = _picked(_of_trial(parts, dispersion, numbers | nominal))
    parameters = numbers | nominal | {"drawn": jax.tree.map(lambda leaf: jnp.array(leaf, copy=True), trial)}
    command = "command" if parts.actuators.ideal else "sent_torque"
    always = ("period", "seed", "trial")
    computer = Board(parts.plant, parameters, inputs={command: controller.outputs[command]}, always=always)

    def draw(given: Given) -> Given:
        return given | {"drawn": _picked(_of_trial(parts, dispersion, given))}

    def begin(given: Given, _: Given) -> Given:
        vehicle, state, memory, filtered = _begin(
            _assembled(parts, given, given["drawn"]), given["seed"], given["trial"]
        )
        return _written(vehicle, state, memory, jnp.int32(0), controller) | {
            f"out.initial_{name}": value for name, value in filtered.items() if name in controller.state
        }

    def advance(given: Given, values: Given) -> Given:
        now, sample = values["before.plant"], values["before.sample"]
        vehicle = _vehicle(_assembled(parts, given, given["drawn"]), values["in." + command], now["keys"])
        state = State(now["x"], now["torque"], Computer(None, None, None, None, now["applied"]), now["actuators"],
                      now["walk"], now["star_x"], now["offset"])  # fmt: skip
        after, _ = control_period(
            vehicle, state, Tick(_period(vehicle.parts, sample), jnp.zeros(()), jnp.asarray(False))
        )
        return _written(vehicle, after, now["sensors"], sample + 1, controller)

    computer.rules.append(draw)
    written = jax.eval_shape(lambda given: begin(given, {}), parameters)
    computer.outputs = {name.removeprefix("out."): v for name, v in written.items() if name.startswith("out.")}
    computer.state = {name.removeprefix("now."): v for name, v in written.items() if name.startswith("now.")}
    computer.about = controller.about | _ABOUT | {"true_disturbance": f"disturbance at this sample{controller.unit}"}
    computer.about |= {f"true_{name}": f"{text}, without errors" for name, text in parts.plant.signals.items()}
    computer.stages = [
        Stage("begin", "The plant at the first sample: dispersions, sensors, first readings.", (), begin),
        Stage("advance", "A control period: actuators, disturbance, motion, then the readings at the next sample.",
              ("in." + command, "before.plant", "before.sample"), advance, (parts.plant,)),
    ]  # fmt: skip
    return computer


_ABOUT = {
    "seed": "seed of the random numbers",
    "trial": "number of the trial",
    "period": "of the control loop [s]",
    "t_end": "end of the run [s]",
    "true_torque": "torque on the body at the end of the last period [N m]",
    "initial_attitude": "attitude of a filter that has run before the first sample",
    "initial_bias": "gyro bias of a filter that has run before the first sample [rad/s]",
    "initial_gyro": "last gyro sample of a filter that has run before the first sample [rad/s]",
    "initial_past_attitude": "earlier attitudes of a filter that has run before the first sample",
    "initial_past_rate": "earlier rates of a filter that has run before the first sample [rad/s]",
}


def _picked(parts: Parts) -> dict[str, Any]:
    """Return the parts that the plant consists of, by name."""
    return {name: getattr(parts, name) for name in PARTS if getattr(parts, name) is not None}


def _assembled(parts: Parts, given: Given, picked: Given) -> Parts:
    """Return the parts with these values, and with the times in the parameters."""
    clock = replace(parts.clock, period=given["period"], t_end=given["t_end"])
    return replace(parts, clock=clock, t_end=given["t_end"], **{name: picked[name] for name in PARTS if name in picked})


def _of_trial(parts: Parts, dispersion: Dispersion, given: Given) -> Parts:
    """Return the parts of the trial in the parameters, with the initial state that the simulation begins from."""
    nominal = _assembled(parts, given, given)
    if hasattr(nominal.plant, "with_inertia"):  # the inverse and a gravity gradient follow from the inertia
        nominal = nominal.with_inertia(nominal.plant.inertia, known=False)
    nominal = replace(nominal, actuators=derived.allocated(nominal.actuators))
    drawn = dispersion.apply(nominal, given["seed"], given["trial"])
    drawn = replace(drawn, initial=drawn.aligned_initial)
    if drawn.actuators.wheels is None:
        return drawn
    # the flight computer limits its command before it adds the compensation of the wheels' momentum
    return replace(drawn, actuators=replace(drawn.actuators, torque_limit=None))


def _period(parts: Parts, sample: Any) -> Ticks:
    """Return a control period of the flight clock by the number of its sample."""
    t, t_next = (number.astype(float) * parts.period for number in (sample, sample + 1))
    return Ticks(t, t_next, jnp.asarray(False), sample, jnp.ones(()), jnp.asarray(False))


def _vehicle(parts: Parts, command: Any, keys: Any) -> Vehicle:
    """Return the constants of a run, with a flight computer that commands an input (m,) [N m]."""
    zero = jnp.zeros(parts.plant.inputs)

    def decide(parts: Parts, k2: Any, period: Any, computer: Computer, *_: Any) -> tuple[Decision, Computer]:
        return Decision(None, zero, command, zero, zero), computer

    software, nothing = Software(lambda *_: None, decide), jnp.zeros(())  # pyright: ignore[reportArgumentType]
    return Vehicle(parts, software, parts.observer.error_bound(), nothing, nothing, *keys)


def _begin(parts: Parts, seed: Any, trial: Any) -> tuple[Vehicle, State, Any, dict[str, Any]]:
    """Return the run and its state at the first sample, the memory of the sensors, and the state of a filter."""
    actuators, inputs, x = parts.actuators, parts.plant.inputs, parts.initial
    walk_key = None if parts.walk_rate is None else draws.stream(seed, trial, DISTURBANCE_WALK)
    jitter_key = None if parts.jitter is None else draws.stream(seed, trial, SAMPLE_TIMES)
    vehicle, first = _vehicle(parts, jnp.zeros(inputs), (walk_key, jitter_key)), _period(parts, jnp.int32(0))
    zero = jnp.zeros(inputs)
    computer = Computer(None, None, None, None, None if actuators.holds else (zero, None))
    state = State(x, zero, computer, actuators.begin(inputs), None if walk_key is None else zero,
                  star_state(parts, first, lambda t: x), vehicle.draw_offset(first.t, first.sample))  # fmt: skip
    memory = parts.sensors.begin(seed, trial, parts.plant.visible(x), first)
    filtered = {name: v for name, v in parts.sensors.remembered(memory).items() if name in FILTER_STATE}
    return vehicle, state, memory, filtered


def _written(vehicle: Vehicle, state: State, memory: Any, sample: Any, controller: Board) -> Given:
    """Return the state and the outputs at a sample, by name, after its readings.

    Args:
        vehicle: the constants of the run.
        state: state of the run at the sample.
        memory: memory of the sensors after the last sample.
        sample: number of the sample.
        controller: the flight computer, whose inputs are outputs of the plant.
    """
    parts, now = vehicle.parts, _period(vehicle.parts, sample)
    before = jnp.where(sample > 0, now.t - (sample - 1).astype(float) * parts.period, 0.0)
    visible = parts.plant.visible(state.x)
    named, memory = parts.sensors.inputs(memory, visible, now, before, state.star_x)
    named |= {"wheel_momentum": state.actuators.h, "acting": state.actuators.v, "applied": state.applied[0],
              "reference": parts.reference(now.t)}  # fmt: skip
    d = parts.disturbance(now.t if state.offset is None else now.t + state.offset, state.x)
    true = parts.plant.signals_of(visible) | {
        "disturbance": d if state.walk is None else d + state.walk,
        "torque": state.torque,
    }
    outputs = {name: jax.tree.map(lambda v, of: v.astype(of.dtype), named[name], shape)
               for name, shape in controller.inputs.items()}  # fmt: skip
    outputs |= {f"true_{name}": value for name, value in true.items()}
    applied = None if state.computer.applied is None else (state.applied[0], None)
    kept = {"x": state.x, "torque": state.torque, "applied": applied, "walk": state.walk, "offset": state.offset,
            "actuators": ActuatorState(*state.actuators), "star_x": state.star_x, "sensors": _without_filter(memory),
            "keys": (vehicle.walk_key, vehicle.jitter_key)}  # fmt: skip
    return {"now.plant": kept, "now.sample": sample} | {f"out.{name}": value for name, value in outputs.items()}


def _without_filter(memory: Any) -> Any:
    """Return the memory of sensors without the estimate of the flight computer's filter."""
    return memory._replace(estimate=None) if hasattr(memory, "estimate") else memory
