"""The true plant of a scenario as stages for C: actuators, disturbance, motion, sensors. Read `plant_board` first."""

from dataclasses import replace

import jax
import jax.numpy as jnp

from ptsmc_jax.devices.ticks import Ticks
from ptsmc_jax.dispersions.variation import Dispersion
from ptsmc_jax.numerics.draws import WholeNumber
from ptsmc_jax.observers.base import Bound, NoObserver
from ptsmc_jax.onboard import derived
from ptsmc_jax.onboard.board import Board, Stage, Values
from ptsmc_jax.onboard.fmu import FILTER_STATE
from ptsmc_jax.plants.base import State as PlantState
from ptsmc_jax.simulation.assembly import Parts
from ptsmc_jax.simulation.computer import Computer, Decision, Period, Software
from ptsmc_jax.simulation.control_period import State, Tick, Vehicle, control_period, start

# the parts of a run that make up the plant; the reference is one, because initial attitudes may be relative to it
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
    run_numbers = {"seed": jnp.uint32(0), "trial": jnp.uint32(0), "period": parts.period, "t_end": parts.t_end}
    nominal = _plant_parts(parts)
    trial = _plant_parts(_draw_trial(parts, dispersion, run_numbers | nominal))
    nominal_parameters = run_numbers | nominal | {"drawn": jax.tree.map(lambda leaf: jnp.array(leaf, copy=True), trial)}
    command = "command" if parts.actuators.is_ideal else "sent_torque"
    always = ("period", "seed", "trial")
    inputs = {command: controller.outputs[command]}
    computer = Board(parts.plant, nominal_parameters, inputs, always_exported=always)

    def draw(parameters: Values) -> Values:
        return parameters | {"drawn": _plant_parts(_draw_trial(parts, dispersion, parameters))}

    def begin(parameters: Values, _: Values) -> Values:
        trial = _replace_parts(parts, parameters, parameters["drawn"])
        vehicle, state = _start_plant(trial, parameters["seed"], parameters["trial"])
        filtered = trial.sensors.filter_state(state.computer.sensors)
        return _state_and_outputs(trial, state, jnp.int32(0), controller) | {
            "now.keys": (vehicle.walk_key, vehicle.jitter_key),
            **{f"out.initial_{name}": filtered[name] for name in FILTER_STATE
               if name in filtered and name in controller.state},
        }  # fmt: skip

    def advance(parameters: Values, values: Values) -> Values:
        trial, sample = _replace_parts(parts, parameters, parameters["drawn"]), values["before.sample"]
        zero = jnp.zeros(())
        software, bound = _constant_command_software(values["in." + command]), trial.observer.error_bound()
        vehicle = Vehicle(trial, software, bound, zero, zero, *values["before.keys"])
        tick = Tick(_period_ticks(trial, sample), zero, jnp.asarray(False))
        after, _ = control_period(vehicle, values["before.plant"], tick)
        return _state_and_outputs(trial, after, sample + 1, controller)

    computer.rules.append(draw)
    values_at_start = jax.eval_shape(lambda parameters: begin(parameters, {}), nominal_parameters)
    computer.outputs = {name.removeprefix("out."): v for name, v in values_at_start.items() if name.startswith("out.")}
    computer.state = {name.removeprefix("now."): v for name, v in values_at_start.items() if name.startswith("now.")}
    computer.meanings = controller.meanings | _MEANINGS
    computer.meanings["true_disturbance"] = f"disturbance at this sample{controller.unit}"
    computer.meanings |= {f"true_{name}": f"{text}, without errors" for name, text in parts.plant.signals.items()}
    computer.stages = [
        Stage("begin", "The plant at the first sample: dispersions, sensors, first readings.", begin),
        Stage("advance", "One control period: actuators, disturbance, motion, then the readings at the next sample.",
              advance, (parts.plant,)),
    ]  # fmt: skip
    return computer


_MEANINGS = {
    "seed": "seed of the random numbers",
    "trial": "number of the trial",
    "period": "control period [s]",
    "t_end": "end of the run [s]",
    "true_torque": "torque on the body at the end of the last period [N m]",
    "initial_attitude": "attitude of a filter that has run before the first sample",
    "initial_bias": "gyro bias of a filter that has run before the first sample [rad/s]",
    "initial_gyro": "last gyro sample of a filter that has run before the first sample [rad/s]",
    "initial_past_attitude": "earlier attitudes of a filter that has run before the first sample",
    "initial_past_rate": "earlier rates of a filter that has run before the first sample [rad/s]",
}


def _plant_parts(parts: Parts) -> Values:
    """Return the parts of `PARTS` by name, without those that the run lacks."""
    return {name: getattr(parts, name) for name in PARTS if getattr(parts, name) is not None}


def _replace_parts(parts: Parts, values: Values, traced: Values) -> Parts:
    """Replace parts of the run by traced values.

    Args:
        parts: the nominal parts.
        values: parameters of the plant by name, for `period` and `t_end` [s].
        traced: values of the parts in `PARTS`, by name.
    """
    clock = replace(parts.clock, period=values["period"], t_end=values["t_end"])
    return replace(
        parts, clock=clock, t_end=values["t_end"], **{name: traced[name] for name in PARTS if name in traced}
    )


def _draw_trial(parts: Parts, dispersion: Dispersion, values: Values) -> Parts:
    """Return the parts with the dispersions of one trial, selected by the parameters `seed` and `trial`.

    The sign of the initial quaternion, q or -q, is chosen by `Parts.aligned_initial`.
    """
    nominal = _replace_parts(parts, values, values)
    if hasattr(nominal.plant, "with_inertia"):  # the inverse and a gravity gradient follow from the inertia
        nominal = nominal.with_inertia(nominal.plant.inertia, known=False)
    nominal = replace(nominal, actuators=derived.with_wheel_allocation(nominal.actuators))
    drawn = dispersion.apply(nominal, values["seed"], values["trial"])
    drawn = replace(drawn, initial=drawn.aligned_initial)
    if drawn.actuators.wheels is None:
        return drawn
    # the flight computer limits its command before it adds the compensation of the wheels' momentum
    return replace(drawn, actuators=replace(drawn.actuators, torque_limit=None))


def _period_ticks(parts: Parts, sample: jax.Array) -> Ticks:
    """Return a control period of the flight clock by the number of its sample."""
    t, t_next = (number.astype(float) * parts.period for number in (sample, sample + 1))
    return Ticks(t, t_next, jnp.asarray(False), sample, jnp.ones(()), jnp.asarray(False))


def _constant_command_software(command: jax.Array) -> Software:
    """Return flight software that always commands the same input (m,) [N m]."""
    zero = jnp.zeros_like(command)

    def boot(parts: Parts, seed: WholeNumber, trial: WholeNumber, x0: PlantState, first: Ticks) -> Computer:
        return Computer(parts.sensors.begin(seed, trial, x0, first), None, None, None, (zero, None))

    def decide(parts: Parts, k2: Bound, period: Period, computer: Computer, *_: object) -> tuple[Decision, Computer]:
        return Decision(None, zero, command, zero, zero), computer

    return Software(boot, decide)


def _start_plant(parts: Parts, seed: WholeNumber, trial: WholeNumber) -> tuple[Vehicle, State]:
    """Return the constants of the run, and its state at the first sample."""
    ticks = jax.tree.map(lambda v: v[None], _period_ticks(parts, jnp.int32(0)))
    # the plant needs no observer, which may have no counterpart in C
    parts = replace(parts, observer=NoObserver(parts.plant, jnp.zeros(())))
    return start(parts, ticks, parts.initial, seed, trial, _constant_command_software(jnp.zeros(parts.plant.inputs)))


def _state_and_outputs(parts: Parts, state: State, sample: jax.Array, controller: Board) -> Values:
    """Return the state and the outputs at a sample, by name, after its readings.

    Args:
        parts: the scenario of the trial.
        state: state of the run at the sample, with the memory of the sensors after the last sample.
        sample: number of the sample.
        controller: the flight computer, whose inputs are outputs of the plant.
    """
    now = _period_ticks(parts, sample)
    before = jnp.where(sample > 0, now.t - (sample - 1).astype(float) * parts.period, 0.0)
    visible = parts.plant.visible(state.x)
    signals, memory = parts.sensors.inputs(state.computer.sensors, visible, now, before, state.star_x)
    signals |= {"wheel_momentum": state.actuators.h, "acting": state.actuators.v, "applied": state.applied[0],
              "reference": parts.reference(now.t)}  # fmt: skip
    d = parts.disturbance(now.t if state.offset is None else now.t + state.offset, state.x)
    true_values = parts.plant.signals_of(visible) | {
        "disturbance": d if state.walk is None else d + state.walk,
        "torque": state.torque,
    }
    outputs = {name: jax.tree.map(lambda v, like: v.astype(like.dtype), signals[name], shape)
               for name, shape in controller.inputs.items()}  # fmt: skip
    outputs |= {f"true_{name}": value for name, value in true_values.items()}
    if hasattr(memory, "estimate"):  # the plant leaves out the filter, which is in the flight computer
        memory = memory._replace(estimate=None)
    applied = None if state.computer.applied is None else (state.applied[0], None)
    plant_state = state._replace(computer=state.computer._replace(sensors=memory, applied=applied))
    return {"now.plant": plant_state, "now.sample": sample} | {f"out.{name}": value for name, value in outputs.items()}
