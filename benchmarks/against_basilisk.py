"""Compare runs of the library with Basilisk's C++ modules: difference of the attitudes, then speed of many slews.

    python3.11 -m venv benchmarks/.venv-basilisk  # its versions of others are not those that the tests use
    benchmarks/.venv-basilisk/bin/python -m pip install --editable . bsk==2.12.1
    benchmarks/.venv-basilisk/bin/python benchmarks/against_basilisk.py [RUNS]

Difference: the library simulates bodies, wheels and a gravity gradient with the paper's law. Basilisk applies the same
torques in each period, in steps four times as fine. RUNS = 0 omits the second part.

Speed: both simulate slews of the first flight's body from attitudes 20 to 140 degrees away to rest. A slew has 900
control periods of 0.05 s with one RK4 step each; the torque is constant in a period. Basilisk runs MRP feedback on the
true state, one run after the other in a process for each core. Set-up and execution are timed separately. The library
computes more in a step: the paper's law with its disturbance, observer and every metric.
"""

import multiprocessing
import os
import sys
import time
from typing import Any

import numpy as np

PERIOD, PERIODS = 0.05, 900
FINER = 4  # of Basilisk's steps in a period
INERTIA = [10.0, 0.0, 0.0, 0.0, 12.0, 0.0, 0.0, 0.0, 14.0]


def slews(seed: int, count: int) -> np.ndarray:
    """Return initial MRPs (count, 3): axis uniform, angle uniform from 20 to 140 degrees."""
    rng = np.random.default_rng(seed)
    axis = rng.normal(size=(count, 3))
    axis /= np.linalg.norm(axis, axis=1, keepdims=True)
    return axis * np.tan(np.deg2rad(rng.uniform(20.0, 140.0, (count, 1))) / 4.0)


def basilisk(starts: np.ndarray) -> tuple[float, float, float]:
    """Simulate slews one by one; return seconds of set-up and of execution, and the largest final MRP."""
    from Basilisk.architecture import messaging  # pyright: ignore[reportMissingImports]
    from Basilisk.fswAlgorithms import attTrackingError, inertial3D, mrpFeedback  # pyright: ignore[reportMissingImports]
    from Basilisk.simulation import extForceTorque, simpleNav, spacecraft  # pyright: ignore[reportMissingImports]
    from Basilisk.utilities import SimulationBaseClass, macros  # pyright: ignore[reportMissingImports]

    set_up = execution = largest = 0.0
    for sigma in starts:
        begin = time.perf_counter()
        sim = SimulationBaseClass.SimBaseClass()
        process = sim.CreateNewProcess("process")
        process.addTask(sim.CreateNewTask("task", macros.sec2nano(PERIOD)))
        body = spacecraft.Spacecraft()
        body.hub.mHub = 100.0
        body.hub.IHubPntBc_B = [INERTIA[k : k + 3] for k in (0, 3, 6)]
        body.hub.sigma_BNInit = [[v] for v in sigma]
        body.hub.omega_BN_BInit = [[0.0], [0.0], [0.0]]
        torque = extForceTorque.ExtForceTorque()
        body.addDynamicEffector(torque)
        nav = simpleNav.SimpleNav()
        nav.scStateInMsg.subscribeTo(body.scStateOutMsg)
        wanted = inertial3D.inertial3D()
        wanted.sigma_R0N = [0.0, 0.0, 0.0]
        off = attTrackingError.attTrackingError()
        off.attNavInMsg.subscribeTo(nav.attOutMsg)
        off.attRefInMsg.subscribeTo(wanted.attRefOutMsg)
        law = mrpFeedback.mrpFeedback()
        law.K, law.P, law.Ki = 2.0, 8.0, -1.0
        law.integralLimit = 0.1
        law.guidInMsg.subscribeTo(off.attGuidOutMsg)
        vehicle = messaging.VehicleConfigMsg().write(messaging.VehicleConfigMsgPayload(ISCPntB_B=INERTIA))
        law.vehConfigInMsg.subscribeTo(vehicle)
        torque.cmdTorqueInMsg.subscribeTo(law.cmdTorqueOutMsg)
        for model in (body, nav, wanted, off, law, torque):
            sim.AddModelToTask("task", model)
        sim.InitializeSimulation()
        sim.ConfigureStopTime(macros.sec2nano(PERIOD * PERIODS))
        ready = time.perf_counter()
        sim.ExecuteSimulation()
        done = time.perf_counter()
        set_up, execution = set_up + ready - begin, execution + done - ready
        largest = max(largest, float(np.linalg.norm(body.scStateOutMsg.read().sigma_BN)))
    return set_up, execution, largest


SLEW: dict[str, Any] = {
    "initial": {"rotvec_deg": [60.0, -40.0, 70.0], "rate": [0.02, -0.01, 0.03]},
    "controller": {"t_f": 35.0, "delta": 0.5, "error": "multiplicative"},
    "disturbance": {"kind": "none"},
    "loop": {"mode": "sampled", "clock": "flight", "period": PERIOD, "t_end": PERIOD * PERIODS},
}
FULL = [[11.0, 1.5, -0.7], [1.5, 9.0, 0.4], [-0.7, 0.4, 14.0]]
CUBESAT = {"spacecraft": {"inertia": [0.05, 0.08, 0.11]}, "observer": {"gain": [0.05] * 3}}
FLIGHTS: dict[str, dict[str, Any]] = {
    "three principal moments": {},
    "full inertia": {"spacecraft": {"inertia": FULL}},
    "slender, 10 : 10 : 0.1": {"spacecraft": {"inertia": [10.0, 10.0, 0.1]}},
    "CubeSat": CUBESAT,
    "wheels from rest, full inertia": {"spacecraft": {"inertia": FULL}, "wheels": {}},
    "wheels with 0.5, -0.2, 0.1, 0.3 N m s": {"wheels": {"momentum": [0.5, -0.2, 0.1, 0.3]}},
    "a wheel with 40 N m s": {"wheels": {"momentum": [40.0, 0.0, 0.0, 0.0]}},
    "CubeSat, a wheel with 0.1 N m s": {**CUBESAT, "wheels": {"momentum": [0.1, 0.0, 0.0, 0.0]}},
    "gravity gradient": {"disturbance": {"kind": "gravity_gradient", "orbit_rate": 1.1e-3, "phase": 0.7}},
    "gravity gradient, wheels": {
        "disturbance": {"kind": "gravity_gradient", "orbit_rate": 1.1e-3, "phase": 0.7},
        "wheels": {"momentum": [0.5, -0.2, 0.1, 0.3]},
    },
}
SPIN = 1e-3  # spin inertia of a wheel [kg m^2]: how its momentum is shared between speed and inertia does not matter


def simulated_again(run: Any, table: dict[str, Any]) -> np.ndarray:
    """Apply the torques of a run; return attitudes (rows, 4), scalar last, at the times of its rows."""
    from Basilisk.architecture import messaging  # pyright: ignore[reportMissingImports]
    from Basilisk.simulation import (  # pyright: ignore[reportMissingImports]
        GravityGradientEffector,
        extForceTorque,
        gravityEffector,
        reactionWheelStateEffector,
        spacecraft,
    )
    from Basilisk.utilities import SimulationBaseClass, macros, simIncludeRW  # pyright: ignore[reportMissingImports]
    from scipy.spatial.transform import Rotation

    log, parts = run.log, run.parts
    sim = SimulationBaseClass.SimBaseClass()
    sim.CreateNewProcess("process").addTask(sim.CreateNewTask("task", macros.sec2nano(PERIOD) // FINER))
    body, inertia = spacecraft.Spacecraft(), np.asarray(parts.plant.inertia)
    factory, wheels = simIncludeRW.rwFactory(), reactionWheelStateEffector.ReactionWheelStateEffector()
    if log.wheels is not None:
        for axis, h in zip(np.asarray(parts.actuators.wheels.axes).T, log.wheels[0][0], strict=True):
            speed = (h / SPIN - axis @ log.x.w[0]) / macros.RPM
            factory.create("custom", axis.tolist(), Js=SPIN, Omega=float(speed), useMaxTorque=False)
            inertia = inertia + SPIN * np.outer(axis, axis)  # Basilisk counts it to the hub's
    body.hub.mHub, body.hub.IHubPntBc_B = 100.0, inertia.tolist()
    body.hub.sigma_BNInit = [[v] for v in Rotation.from_quat(log.x.q[0]).as_mrp()]
    body.hub.omega_BN_BInit = [[v] for v in log.x.w[0]]
    models, torque = [body], extForceTorque.ExtForceTorque()
    disturbance = table.get("disturbance", {})
    if disturbance.get("kind") == "gravity_gradient":
        rate, phase = disturbance["orbit_rate"], disturbance["phase"]
        earth = gravityEffector.GravBodyData()
        earth.planetName, earth.mu, earth.isCentralBody = "earth", 3.986004415e14, True
        radius = (earth.mu / rate**2) ** (1 / 3)
        body.gravField.gravBodies = spacecraft.GravBodyVector([earth])
        body.hub.r_CN_NInit = [[radius * np.cos(phase)], [radius * np.sin(phase)], [0.0]]
        body.hub.v_CN_NInit = [[-radius * rate * np.sin(phase)], [radius * rate * np.cos(phase)], [0.0]]
        gradient = GravityGradientEffector.GravityGradientEffector()
        gradient.addPlanetName("earth")
        body.addDynamicEffector(gradient)
        models.append(gradient)
    if log.wheels is None:
        body.addDynamicEffector(torque)
        models.append(torque)
        command, message = messaging.CmdTorqueBodyMsg(), messaging.CmdTorqueBodyMsgPayload
        torque.cmdTorqueInMsg.subscribeTo(command)
        held, key = log.u, "torqueRequestBody"
    else:
        factory.addToSpacecraft("wheels", wheels, body)
        models.append(wheels)
        command, message = messaging.ArrayMotorTorqueMsg(), messaging.ArrayMotorTorqueMsgPayload
        wheels.rwMotorCmdInMsg.subscribeTo(command)
        held, key = -log.wheels[1], "motorTorque"  # on the wheel
    for model in reversed(models):  # effectors first: they read the command before the body is integrated
        sim.AddModelToTask("task", model)

    def say(k: int) -> None:
        payload = message()
        setattr(payload, key, held[k].tolist())
        command.write(payload, macros.sec2nano(PERIOD * k))

    say(0)
    sim.InitializeSimulation()
    found = [log.x.q[0]]
    for k in range(1, len(log.t)):
        sim.ConfigureStopTime(macros.sec2nano(PERIOD * k))
        sim.ExecuteSimulation()
        say(k)
        found.append(Rotation.from_mrp(np.asarray(body.scStateOutMsg.read().sigma_BN)).as_quat())
    return np.asarray(found)


def apart() -> None:
    """Print the largest angle between both over each run."""
    from common import say
    from scipy.spatial.transform import Rotation

    from ptsmc_jax import scenario
    from ptsmc_jax.campaigns import runs

    say("largest angle between the library's flight and Basilisk's of the same torques, 45 s [rad]")
    for name, table in FLIGHTS.items():
        run = runs.simulate(scenario.study(scenario.from_tables({**SLEW, **table})))
        theirs = Rotation.from_quat(simulated_again(run, table))
        angle = (Rotation.from_quat(run.log.x.q).inv() * theirs).magnitude().max()
        say(f"| {name} | {angle:.1e} | {run.status}, {run.parts.substeps} steps a period |")


def main() -> None:
    """Print the differences, then both rates and their ratio."""
    from ptsmc_jax.configure import configure

    configure()
    apart()
    if sys.argv[1:] == ["0"]:
        return
    runs, cores = int(sys.argv[1]) if len(sys.argv) > 1 else 200, len(os.sched_getaffinity(0))
    with multiprocessing.get_context("spawn").Pool(cores) as pool:
        pool.map(basilisk, [slews(9, 2)] * cores)  # imports
        theirs = []
        for turn in range(3):
            begin = time.perf_counter()
            told = pool.map(basilisk, [slews(turn * cores + k, runs // cores) for k in range(cores)], chunksize=1)
            whole, count = time.perf_counter() - begin, runs // cores * cores
            busy = max(execution for _, execution, _ in told)
            theirs.append((count * PERIODS / busy / 1e6, count * PERIODS / whole / 1e6))
            assert max(largest for *_, largest in told) < 0.1, "a slew that does not end"
    executing, all_in = np.median(theirs, axis=0)
    from common import machine, medians, row, say, steps, study

    from ptsmc_jax.campaigns import montecarlo

    trials, ready = np.arange(16_384), {"without noise": study(), "with noise": study(noise=True)}

    def flight(one):
        return lambda: montecarlo.run(one.parts, one.dispersion, 0, trials).metrics

    seconds = medians({name: flight(one) for name, one in ready.items()})
    say(machine())
    for name, one in ready.items():
        rate = trials.size * steps(one.parts) / seconds[name] / 1e6
        row(f"Basilisk 2.12.1, {cores} processes of {runs // cores} runs, executing; ours {name}", executing, rate)
        row(f"the same with Basilisk's set-up; ours {name}", all_in, rate)


if __name__ == "__main__":
    main()
