"""Run the exported C in Basilisk, with its body, wheels, star tracker and gyro, and compare it with the library.

    python3.11 -m venv benchmarks/.venv-basilisk  # its versions of others are not those that the tests use
    benchmarks/.venv-basilisk/bin/python -m pip install --editable . bsk==2.12.1
    benchmarks/.venv-basilisk/bin/python benchmarks/in_basilisk.py [TRIALS]

In each period Basilisk integrates the body. The exported module `basilisk.py` reads its star tracker and inertial
measurement unit, and commands the motors of the wheels. Attitudes at t = 0, the start of the filter and its gains are
those of the library's trials. The noise is Basilisk's own, white and of the scenario's size. The scenario's disturbance
is an external torque, constant in a period at its mean.

The second table is for `ground_target.toml`. Basilisk integrates the orbit too, and the error is the angle between the
boresight and the direction from Basilisk's position to the target.
"""

import runpy
import subprocess
import sys
import tempfile
from collections.abc import Iterator
from contextlib import contextmanager
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
    """A spacecraft of Basilisk with wheels, star tracker, gyro and flight computer, at rest at the initial attitude.

    `orbit`: the table [orbit] of the scenario; None: no gravity.
    """

    def __init__(self, parts: Any, orbit: Any, seed: int, computer: Any):
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
            orbitalMotion,
            simIncludeGravBody,
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
        self.body.hub.sigma_BNInit = [[v] for v in Rotation.from_quat(np.asarray(parts.initial.q)).as_mrp()]
        self.body.hub.omega_BN_BInit = [[0.0]] * 3
        if orbit is not None:
            self.gravity = simIncludeGravBody.gravBodyFactory()
            earth = self.gravity.createEarth()
            earth.isCentralBody, earth.mu = True, float(orbit.gravitational_parameter)
            self.gravity.addBodiesTo(self.body)
            elements = orbitalMotion.ClassicElements()
            elements.a, elements.e, elements.i = orbit.semi_major_axis, orbit.eccentricity, orbit.inclination
            elements.Omega, elements.omega, elements.f = orbit.ascending_node, orbit.perigee, orbit.true_anomaly
            r, v = orbitalMotion.elem2rv(earth.mu, elements)
            self.body.hub.r_CN_NInit, self.body.hub.v_CN_NInit = r, v
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

    def until(self, k: int) -> Any:
        """Simulate up to sample k, with the sample; return Basilisk's message with the true state."""
        self.sim.ConfigureStopTime(self._nano(self.period * k))
        self.sim.ExecuteSimulation()
        return self.body.scStateOutMsg.read()


class FixedError:
    """The norm |v| of the quaternion to the reference at t = 0 [-]."""

    def __init__(self, parts: Any):
        self.target = np.asarray(parts.reference(np.zeros(())).q)

    def __call__(self, t: float, state: Any) -> float:
        """Return the error at t [s] of Basilisk's state."""
        from scipy.spatial.transform import Rotation

        q = Rotation.from_mrp(state.sigma_BN).as_quat()
        return float(np.linalg.norm((q if q @ self.target > 0.0 else -q)[:3] - self.target[:3]))


class GroundError:
    """The angle between the boresight and the direction to a target on the WGS-84 ellipsoid [rad]."""

    def __init__(self, reference: Any, boresight: Any):
        latitude, longitude, height = reference.latitude, reference.longitude, reference.height
        normal = 6378137.0 / np.sqrt(1.0 - 0.00669437999014 * np.sin(latitude) ** 2)
        around = (normal + height) * np.cos(latitude)
        up = (normal * (1.0 - 0.00669437999014) + height) * np.sin(latitude)
        self.boresight, self.longitude, self.around, self.up = np.asarray(boresight), longitude, around, up

    def __call__(self, t: float, state: Any) -> float:
        """Return the error at t [s] of Basilisk's state, with attitude and position."""
        from scipy.spatial.transform import Rotation

        angle = self.longitude + 7.292115e-5 * t
        direction = [self.around * np.cos(angle), self.around * np.sin(angle), self.up] - np.asarray(state.r_BN_N)
        axis = Rotation.from_mrp(state.sigma_BN).apply(self.boresight)
        return float(np.arctan2(np.linalg.norm(np.cross(axis, direction)), axis @ direction))


def simulated(
    made: Any, library: Any, flight_computer: Any, trial: int, orbit: Any = None, error: Any = None, seed: int = 0
) -> tuple[np.ndarray, np.ndarray, float, int]:
    """Simulate a trial in Basilisk.

    Args:
        made: the exported controller.
        library: its C, compiled.
        flight_computer: the class `FlightComputer` of the export.
        trial: number of the trial.
        orbit: see `Basilisk`.
        error: function of time and state; None: `FixedError`.
        seed: seed of the library's trials.

    Returns:
        times (n,) [s], errors (n,), peak torque of a wheel [N m], and number of samples with another status than ok.
    """
    import jax.numpy as jnp

    from ptsmc_jax.onboard.library import InTheLoop
    from ptsmc_jax.simulation.control_period import first_period

    parts = made.ready.dispersion.apply(made.ready.parts, jnp.uint32(seed), jnp.uint32(trial))
    first = first_period(parts.clock.ticks(parts.controller.t_f, parts.controller.delta))
    booted = InTheLoop(library, parts).boot(parts, jnp.uint32(seed), jnp.uint32(trial), parts.initial, first)
    computer = flight_computer(library.folder)
    computer.start = np.asarray(booted.sensors[1])
    craft, error = Basilisk(parts, orbit, trial, computer), error or FixedError(parts)
    h = craft.period
    t = h * np.arange(round(float(parts.t_end) / h) + 1)
    errors, peak, odd = np.zeros(len(t)), 0.0, 0
    for k, now in enumerate(t):
        errors[k] = error(now, craft.until(k))
        odd += int(computer.status != 0)
        peak = max(peak, float(np.max(np.abs(computer.values("wheel_torque")))))
        craft.push(k, np.asarray(parts.disturbance(jnp.asarray(now + h / 2), parts.initial)))
    return t, errors, peak, odd


def window_error(parts: Any, t: np.ndarray, errors: np.ndarray) -> float:
    """Return the RMS of the errors in the window after t_f, by the trapezoidal rule."""
    t_f = float(parts.controller.t_f)
    squares = errors[(t >= t_f - 1e-9) & (t <= t_f + float(parts.window) + 1e-9)] ** 2
    return float(np.sqrt(np.sum((squares[1:] + squares[:-1]) / 2) / (len(squares) - 1)))


@contextmanager
def exported(flight: Any, name: str) -> Iterator[tuple[Any, Any, Any]]:
    """Export the controller of a scenario; return it, its library and its class for Basilisk."""
    from ptsmc_jax.campaigns import store
    from ptsmc_jax.onboard import folder
    from ptsmc_jax.onboard.library import Library

    made = folder.Controller(flight, "flight", name)
    with tempfile.TemporaryDirectory() as place:
        store.write_folder(Path(place) / "c", lambda making: folder.write_program(making, made))
        subprocess.run(["make", "-C", f"{place}/c", "shared"], check=True, stdout=subprocess.DEVNULL)
        yield made, Library(Path(place) / "c"), runpy.run_path(f"{place}/c/basilisk.py")["FlightComputer"]


def follow_target(trials: int) -> None:
    """Print the errors of `ground_target.toml` in Basilisk and in the library."""
    from ptsmc_jax import scenario
    from ptsmc_jax.campaigns import montecarlo

    flight: Any = scenario.read(Path(__file__).parent / "ground_target.toml")
    error = GroundError(flight.reference, flight.pointing.boresight)
    largest, peaks, odd = [], [], 0
    with exported(flight, "ground_target") as (made, library, flight_computer):
        for trial in range(trials):
            t, errors, peak, others = simulated(made, library, flight_computer, trial, flight.orbit, error)
            after = flight.controller.t_f + flight.pointing.after
            largest.append(errors[t >= after - 1e-9].max())
            peaks.append(peak)
            odd += others
    ours = montecarlo.run(made.ready.parts, made.ready.dispersion, 0, np.arange(trials)).metrics
    print(f"\n| ground target, {trials} trials | Basilisk | library | required |\n|---|---|---|---|")
    angle, torque = flight.requirements["ape_boresight"].limit, flight.requirements["peak_wheel_torque"]
    for text, scale, *values in (
        ("largest angle from the target [arcsec]", 648000.0 / np.pi, max(largest), ours.ape_boresight.max(), angle),
        ("largest wheel torque [N m]", 1.0, max(peaks), ours.peak_wheel_torque.max(), torque),
    ):
        print(f"| {text} | " + " | ".join(f"{scale * float(value):.4g}" for value in values) + " |")
    print(f"| samples with another status than ok | {odd} | | |")


def main() -> None:
    """Print both accuracies for published and for tuned gains."""
    from ptsmc_jax.configure import configure

    configure()
    from ptsmc_jax import scenario
    from ptsmc_jax.campaigns import montecarlo

    trials = int(sys.argv[1]) if len(sys.argv) > 1 else 100
    flight = scenario.read(ROOT / "scenarios" / "filtered_flight.toml")
    flight = scenario.replace(flight, tune=None, wheels={"kind": "pyramid"}, loop__clock="flight")
    print(f"| gains, {trials} trials | RMS window error in Basilisk | in the library | largest wheel torque [N m] | "
          "in the library | status not ok |\n|---|---|---|---|---|---|")  # fmt: skip
    for name, gains in (("published", {}), ("tuned", TUNED)):
        with exported(scenario.replace(flight, **gains), name) as (made, library, flight_computer):
            found = [simulated(made, library, flight_computer, k) for k in range(trials)]
        theirs = [window_error(made.ready.parts, t, errors) for t, errors, _, _ in found]
        peak, odd = max(row[2] for row in found), sum(row[3] for row in found)
        ours = montecarlo.run(made.ready.parts, made.ready.dispersion, 0, np.arange(trials)).metrics
        rms = [float(np.sqrt(np.mean(np.square(v)))) for v in (theirs, ours.window_error)]
        print(f"| {name} | {rms[0]:.3e} | {rms[1]:.3e} | {peak:.4f} | {float(np.max(ours.peak_wheel_torque)):.4f} | "
              f"{odd} |")  # fmt: skip
    follow_target(trials)


if __name__ == "__main__":
    main()
