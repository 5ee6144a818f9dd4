"""Run the exported C in Basilisk, with its body, wheels, star tracker and gyro, and compare it with the library.

    python3.11 -m venv benchmarks/.venv-basilisk  # its versions of others are not those that the tests use
    benchmarks/.venv-basilisk/bin/python -m pip install --editable . bsk==2.12.1
    benchmarks/.venv-basilisk/bin/python benchmarks/in_basilisk.py [TRIALS]

In each period Basilisk integrates the body. The exported module `basilisk.py` reads its star tracker and inertial
measurement unit, and commands the motors of the wheels. Attitudes at t = 0, the start of the filter and its gains are
those of the library's trials. The noise is Basilisk's own, white and of the scenario's size. The scenario's disturbance
is an external torque, constant in a period at its mean.
"""

import runpy
import subprocess
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
    """A spacecraft of Basilisk with wheels, star tracker, gyro and flight computer, at rest at an attitude (4,)."""

    def __init__(self, parts: Any, attitude: np.ndarray, seed: int, computer: Any):
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
        process, nanoseconds = self.sim.CreateNewProcess("process"), self._nano(self.period)
        process.addTask(self.sim.CreateNewTask("dynamics", nanoseconds // FINER), 2)  # first
        process.addTask(self.sim.CreateNewTask("flight software", nanoseconds), 1)
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
        self._pushed, self._torque = messaging.CmdTorqueBodyMsg(), messaging.CmdTorqueBodyMsgPayload
        wheels.rwMotorCmdInMsg.subscribeTo(computer.motorsOutMsg)
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
            self.sim.AddModelToTask("dynamics", model)
        computer.starInMsg.subscribeTo(self.star.sensorOutMsg)
        computer.gyroInMsg.subscribeTo(self.gyro.sensorOutMsg)
        computer.speedsInMsg.subscribeTo(wheels.rwSpeedOutMsg)
        self._wheels = factory.getConfigMessage()
        computer.wheelsInMsg.subscribeTo(self._wheels)
        self.sim.AddModelToTask("flight software", computer)
        self.push(0, np.zeros(3))
        self.sim.InitializeSimulation()

    def push(self, k: int, disturbance: np.ndarray) -> None:
        """Apply the disturbance (3,) from period k on [N m]."""
        torque = self._torque()
        torque.torqueRequestBody = disturbance.tolist()
        self._pushed.write(torque, self._nano(self.period * k))

    def until(self, k: int) -> np.ndarray:
        """Simulate up to sample k, with the sample; return the true attitude, modified Rodrigues parameters (3,)."""
        self.sim.ConfigureStopTime(self._nano(self.period * k))
        self.sim.ExecuteSimulation()
        return np.asarray(self.body.scStateOutMsg.read().sigma_BN)


def simulated(made: Any, library: Any, flight_computer: Any, trial: int, seed: int = 0) -> tuple[float, float, int]:
    """Simulate a trial; return RMS window error [-], peak torque of a wheel [N m], and samples with another status."""
    import jax.numpy as jnp
    from scipy.spatial.transform import Rotation

    from ptsmc_jax.onboard.library import InTheLoop
    from ptsmc_jax.simulation.control_period import first_period

    parts = made.ready.dispersion.apply(made.ready.parts, jnp.uint32(seed), jnp.uint32(trial))
    first = first_period(parts.clock.ticks(parts.controller.t_f, parts.controller.delta))
    booted = InTheLoop(library, parts).boot(parts, jnp.uint32(seed), jnp.uint32(trial), parts.initial, first)
    computer = flight_computer(library.folder)
    computer.start = np.asarray(booted.sensors[1])
    craft = Basilisk(parts, np.asarray(parts.initial.q), trial, computer)
    target = Rotation.from_quat(np.asarray(parts.reference(jnp.asarray(0.0)).q)).as_quat()
    h, t_f, window, t_end = (float(v) for v in (craft.period, parts.controller.t_f, parts.window, parts.t_end))
    t = h * np.arange(round(t_end / h) + 1)
    errors, peak, odd = np.zeros(len(t)), 0.0, 0
    for k, now in enumerate(t):
        q = Rotation.from_mrp(craft.until(k)).as_quat()
        q = q if q @ target > 0.0 else -q
        errors[k] = np.linalg.norm(q[:3] - target[:3])
        odd += int(computer.status != 0)
        peak = max(peak, float(np.max(np.abs(computer.values("wheel_torque")))))
        craft.push(k, np.asarray(parts.disturbance(jnp.asarray(now + h / 2), parts.initial)))
    inside = (t >= t_f - 1e-9) & (t <= t_f + window + 1e-9)
    squares = errors[inside] ** 2
    mean = np.sum((squares[1:] + squares[:-1]) / 2) / (len(squares) - 1)
    return float(np.sqrt(mean)), peak, odd


def main() -> None:
    """Print both accuracies for published and for tuned gains."""
    from ptsmc_jax.configure import configure

    configure()
    from ptsmc_jax import scenario
    from ptsmc_jax.campaigns import montecarlo, store
    from ptsmc_jax.onboard import folder
    from ptsmc_jax.onboard.library import Library

    trials = int(sys.argv[1]) if len(sys.argv) > 1 else 100
    flight = scenario.read(ROOT / "scenarios" / "filtered_flight.toml")
    flight = scenario.replace(flight, tune=None, wheels={"kind": "pyramid"}, loop__clock="flight")
    print(f"| gains, {trials} trials | RMS window error in Basilisk | in the library | largest wheel torque [N m] | "
          "in the library | status not ok |")  # fmt: skip
    for name, gains in (("published", {}), ("tuned", TUNED)):
        made = folder.Controller(scenario.replace(flight, **gains), "flight", name)
        with tempfile.TemporaryDirectory() as place:
            store.write_folder(Path(place) / "c", lambda making, made=made: folder.write_program(making, made))
            library = Library(Path(place) / "c")
            subprocess.run(["make", "-C", f"{place}/c", "shared"], check=True, stdout=subprocess.DEVNULL)
            flight_computer = runpy.run_path(f"{place}/c/basilisk.py")["FlightComputer"]
            theirs = np.array([simulated(made, library, flight_computer, k) for k in range(trials)])
        ours = montecarlo.run(made.ready.parts, made.ready.dispersion, 0, np.arange(trials))
        rms = [float(np.sqrt(np.mean(np.square(v)))) for v in (theirs[:, 0], ours.metrics.window_error)]
        peaks = theirs[:, 1].max(), float(np.max(ours.metrics.peak_wheel_torque))
        print(f"| {name} | {rms[0]:.3e} | {rms[1]:.3e} | {peaks[0]:.4f} | {peaks[1]:.4f} | {int(theirs[:, 2].sum())} |")


if __name__ == "__main__":
    main()
