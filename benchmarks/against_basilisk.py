"""Many slews of one spacecraft with Basilisk's C++ modules, and with the library, on the same cores.

    python3.11 -m venv benchmarks/.venv-basilisk  # its versions of others are not those that the tests use
    benchmarks/.venv-basilisk/bin/python -m pip install --editable . bsk==2.12.1
    benchmarks/.venv-basilisk/bin/python benchmarks/against_basilisk.py [RUNS]

Both fly the first flight's body from attitudes 20 to 140 degrees away to rest, 900 control periods of 0.05 s, one RK4
step each, torque held over the period. Basilisk: MRP feedback on the true state, one run after the other in a process
for each core, set-up and execution timed apart. The library: the paper's law with its disturbance, observer and every
metric, so that it does more in a step.
"""

import multiprocessing
import os
import sys
import time

import numpy as np

PERIOD, PERIODS = 0.05, 900
INERTIA = [10.0, 0.0, 0.0, 0.0, 12.0, 0.0, 0.0, 0.0, 14.0]


def slews(seed: int, count: int) -> np.ndarray:
    """Initial MRPs (count, 3): axis uniform, angle uniform from 20 to 140 degrees."""
    rng = np.random.default_rng(seed)
    axis = rng.normal(size=(count, 3))
    axis /= np.linalg.norm(axis, axis=1, keepdims=True)
    return axis * np.tan(np.deg2rad(rng.uniform(20.0, 140.0, (count, 1))) / 4.0)


def basilisk(starts: np.ndarray) -> tuple[float, float, float]:
    """Fly them one by one: seconds of set-up and of execution, and the largest final MRP."""
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


def main() -> None:
    """Print both rates and their ratio."""
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

    from ptsmc_jax.configure import configure

    configure()
    from common import machine, medians, row, say, steps, study

    from ptsmc_jax import montecarlo

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
