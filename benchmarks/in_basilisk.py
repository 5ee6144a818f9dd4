"""Run the exported C in Basilisk, with its body, wheels, star tracker and gyro, and compare it with the library.

    python3.11 -m venv benchmarks/.venv-basilisk  # its versions of others are not those that the tests use
    benchmarks/.venv-basilisk/bin/python -m pip install --editable . bsk==2.12.1
    benchmarks/.venv-basilisk/bin/python benchmarks/in_basilisk.py [TRIALS]

In each period Basilisk integrates the body. `ptsmc_step` reads its star tracker and inertial measurement unit, and
commands the motors of the wheels. Attitudes at t = 0, the start of the filter and its gains are those of the library's
trials. The noise is Basilisk's own, white and of the scenario's size. The scenario's disturbance is an external torque,
constant in a period at its mean.
"""

import sys
import tempfile
from pathlib import Path
from typing import Any

import numpy as np

ROOT = Path(__file__).parent.parent
SPIN = 1e-3  # spin inertia of a wheel [kg m^2]: how its momentum is shared between speed and inertia does not matter
FINER = 2  # of Basilisk's steps in a period
# by `ptsmc tune scenarios/filtered_flight.toml`
TUNED: dict[str, Any] = {
    "controller__eta": 2.8612,
    "controller__delta": 0.05,
    "controller__k1": 48.3565,
    "controller__sign_width": 0.0001559,
    "observer__gain": [135.214] * 3,
    "filter__bandwidth": 0.0229487,
}


class Basilisk:
    """A spacecraft of Basilisk with wheels, star tracker and gyro, at rest at an initial attitude (4,)."""

    def __init__(self, parts: Any, attitude: np.ndarray, seed: int):
        from Basilisk.architecture import messaging  # pyright: ignore[reportMissingImports]
        from Basilisk.simulation import (  # pyright: ignore[reportMissingImports]
            extForceTorque,
            imuSensor,
            reactionWheelStateEffector,
            spacecraft,
            starTracker,
        )
        from Basilisk.utilities import (  # pyright: ignore[reportMissingImports]
            SimulationBaseClass,
            macros,
            simIncludeRW,
        )
        from scipy.spatial.transform import Rotation

        self.period, self.axes, self._nano = float(parts.clock.period), parts.actuators.wheels.axes, macros.sec2nano
        self.sim = SimulationBaseClass.SimBaseClass()
        self.sim.CreateNewProcess("process").addTask(self.sim.CreateNewTask("task", self._nano(self.period) // FINER))
        self.body, inertia = spacecraft.Spacecraft(), np.asarray(parts.plant.inertia)
        factory, wheels = simIncludeRW.rwFactory(), reactionWheelStateEffector.ReactionWheelStateEffector()
        limit = parts.actuators.wheels.torque_limit
        for axis in np.asarray(self.axes).T:
            bound = {"useMaxTorque": False} if limit is None else {"useMaxTorque": True, "u_max": float(limit)}
            factory.create("custom", axis.tolist(), Js=SPIN, Omega=0.0, **bound)
            inertia = inertia + SPIN * np.outer(axis, axis)  # Basilisk counts it to the hub's
        self.body.hub.mHub, self.body.hub.IHubPntBc_B = 100.0, inertia.tolist()
        self.body.hub.sigma_BNInit = [[v] for v in Rotation.from_quat(attitude).as_mrp()]
        self.body.hub.omega_BN_BInit = [[0.0]] * 3
        factory.addToSpacecraft("wheels", wheels, self.body)
        push = extForceTorque.ExtForceTorque()
        self.body.addDynamicEffector(push)
        self._motors, self._pushed = messaging.ArrayMotorTorqueMsg(), messaging.CmdTorqueBodyMsg()
        self._motor, self._torque = messaging.ArrayMotorTorqueMsgPayload, messaging.CmdTorqueBodyMsgPayload
        wheels.rwMotorCmdInMsg.subscribeTo(self._motors)
        push.cmdTorqueInMsg.subscribeTo(self._pushed)
        white, still = np.zeros((3, 3)).tolist(), [[0.0]] * 3  # errors without memory
        self.star, self.gyro, self.wheels = starTracker.StarTracker(), imuSensor.ImuSensor(), wheels
        self.star.PMatrix = np.diag(np.broadcast_to(parts.sensors.attitude_noise, 3)).tolist()
        self.star.setAMatrix(white)
        self.star.setWalkBounds(still)
        self.gyro.PMatrixGyro = np.diag(np.broadcast_to(parts.sensors.rate_noise, 3)).tolist()
        self.gyro.PMatrixAccel = white
        self.gyro.setAMatrixGyro(white)
        self.gyro.setWalkBoundsGyro(still)
        self.gyro.setErrorBoundsGyro(still)
        self.star.RNGSeed, self.gyro.RNGSeed = 2 * seed + 1, 2 * seed + 2
        for sensor in (self.star, self.gyro):
            sensor.scStateInMsg.subscribeTo(self.body.scStateOutMsg)
        for model in (push, wheels, self.body, self.star, self.gyro):  # commands are read, then the body moves
            self.sim.AddModelToTask("task", model)
        self.act(0, np.zeros(self.axes.shape[1]), np.zeros(3))
        self.sim.InitializeSimulation()

    def act(self, k: int, wheel_torque: np.ndarray, disturbance: np.ndarray) -> None:
        """Apply the torques of the wheels (wheels,) and the disturbance (3,) from period k on [N m]."""
        motors, torque = self._motor(), self._torque()
        motors.motorTorque = (-wheel_torque).tolist()  # on the wheel
        torque.torqueRequestBody = disturbance.tolist()
        self._motors.write(motors, self._nano(self.period * k))
        self._pushed.write(torque, self._nano(self.period * k))

    def until(self, k: int) -> dict[str, np.ndarray]:
        """Simulate up to sample k; return the measurements and the true state."""
        self.sim.ConfigureStopTime(self._nano(self.period * k))
        self.sim.ExecuteSimulation()
        true = self.body.scStateOutMsg.read()
        w, star = np.asarray(true.omega_BN_B), np.roll(self.star.sensorOutMsg.read().qInrtl2Case, -1)
        speeds = np.asarray(self.wheels.rwSpeedOutMsg.read().wheelSpeeds)[: self.axes.shape[1]]
        gyro = np.asarray(self.gyro.sensorOutMsg.read().AngVelPlatform)
        told = {"attitude": star, "attitude_valid": np.ones(1), "rate": gyro}
        return told | {"wheel_momentum": SPIN * (speeds + self.axes.T @ w), "sigma": np.asarray(true.sigma_BN)}


def simulated(made: Any, library: Any, trial: int, seed: int = 0) -> tuple[float, float, int]:
    """Simulate a trial; return RMS window error [-], peak torque of a wheel [N m], and samples with another status."""
    import jax.numpy as jnp
    from scipy.spatial.transform import Rotation

    from ptsmc_jax.onboard.library import InTheLoop

    parts = made.ready.dispersion.apply(made.ready.parts, jnp.uint32(seed), jnp.uint32(trial))
    first = made.first(parts)
    loop = InTheLoop(library, parts)
    computer = loop.boot(parts, jnp.uint32(seed), jnp.uint32(trial), parts.initial, first)
    state = np.asarray(computer.sensors[1])
    craft = Basilisk(parts, np.asarray(parts.initial.q), trial)
    target = Rotation.from_quat(np.asarray(parts.reference(jnp.asarray(0.0)).q)).as_quat()
    names, outputs = list(loop.board.inputs), library.columns["out"]
    at = outputs.index("wheel_torque[0]")
    h, t_f, window, t_end = (float(v) for v in (craft.period, parts.controller.t_f, parts.window, parts.t_end))
    t = h * np.arange(round(t_end / h) + 1)
    errors, peak, odd = np.zeros(len(t)), 0.0, 0
    count = craft.axes.shape[1]
    for k, now in enumerate(t):
        seen = craft.until(k)
        q = Rotation.from_mrp(seen["sigma"]).as_quat()
        q = q if q @ target > 0.0 else -q
        errors[k] = np.linalg.norm(q[:3] - target[:3])
        state, out, status = library.many(state, np.concatenate([[now], *(seen[name] for name in names)]))
        odd += int(status != 0)
        torque = out[at : at + count]
        peak = max(peak, float(np.max(np.abs(torque))))
        craft.act(k, torque, np.asarray(made.disturbance(parts, now + h / 2)))
    inside = (t >= t_f - 1e-9) & (t <= t_f + window + 1e-9)
    squares = errors[inside] ** 2
    mean = np.sum((squares[1:] + squares[:-1]) / 2) / (len(squares) - 1)
    return float(np.sqrt(mean)), peak, odd


def main() -> None:
    """Print both accuracies for published and for tuned gains."""
    from ptsmc_jax.configure import configure

    configure()
    import jax.numpy as jnp

    from ptsmc_jax import scenario
    from ptsmc_jax.campaigns import montecarlo, store
    from ptsmc_jax.onboard import folder
    from ptsmc_jax.onboard.library import Library
    from ptsmc_jax.simulation.control_period import first_period

    class Controller(folder.Controller):
        """A controller with the first control period and the disturbance of a trial."""

        def first(self, parts: Any) -> Any:
            return first_period(parts.clock.ticks(parts.controller.t_f, parts.controller.delta))

        def disturbance(self, parts: Any, t: float) -> Any:
            return parts.disturbance(jnp.asarray(t), parts.initial)

    trials = int(sys.argv[1]) if len(sys.argv) > 1 else 100
    flight = scenario.read(ROOT / "scenarios" / "filtered_flight.toml")
    flight = scenario.replace(flight, tune=None, wheels={"kind": "pyramid"}, loop__clock="flight")
    print(f"| gains, {trials} trials | RMS window error in Basilisk | in the library | largest wheel torque [N m] | "
          "in the library | status not ok |")  # fmt: skip
    for name, gains in (("the paper's", {}), ("tuned", TUNED)):
        made = Controller(scenario.replace(flight, **gains), "flight", name)
        with tempfile.TemporaryDirectory() as place:
            store.write(Path(place) / "c", lambda making, made=made: folder.write_program(making, made))
            library = Library(Path(place) / "c")
        ours = montecarlo.run(made.ready.parts, made.ready.dispersion, 0, np.arange(trials))
        theirs = np.array([simulated(made, library, k) for k in range(trials)])
        rms = [float(np.sqrt(np.mean(np.square(v)))) for v in (theirs[:, 0], ours.metrics.window_error)]
        peaks = theirs[:, 1].max(), float(np.max(ours.metrics.peak_wheel_torque))
        print(f"| {name} | {rms[0]:.3e} | {rms[1]:.3e} | {peaks[0]:.4f} | {peaks[1]:.4f} | {int(theirs[:, 2].sum())} |")


if __name__ == "__main__":
    main()
