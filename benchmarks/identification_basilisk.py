"""Estimate parameters from telemetry that Basilisk simulated, and compare them with Basilisk's true values.

    python3.11 -m venv benchmarks/.venv-basilisk
    benchmarks/.venv-basilisk/bin/python -m pip install --editable . bsk==2.12.1
    benchmarks/.venv-basilisk/bin/python benchmarks/identification_basilisk.py --logs 3

Basilisk integrates the spacecraft, its wheels and its hinged panels. It adds the noise of its star tracker and of its
gyro, which has a constant bias. `identify` gets the readings, the commands, and a model whose inertia is 20 % off and
whose modes are 10 % off. The wheels deliver up to 4 % less or more torque than commanded. Their scale is estimated with
a known inertia, because torque commands determine only the ratio of both.

The script prints the estimate, the true value, the standard deviation and the error of each parameter of the first log.
It counts the errors of all logs that are above 3 standard deviations.

The panels are nonlinear in Basilisk, and linear modes in the library. Their true modes follow from the mass matrix of
`flexible_against_basilisk.py`.
"""

import argparse
from typing import Any, NamedTuple

import numpy as np
import polars as pl
from flexible_against_basilisk import HUB, HUB_MASS, add_panels, modal

FINER = 4  # of Basilisk's steps in a sample interval
PHASE = 10.0  # duration of a constant torque [s]
SPIN = 1e-5  # spin inertia of a wheel [kg m^2]
AXES = [[1.0, 0.1, 0.0], [0.0, 1.0, 0.1], [0.1, 0.0, 1.0]]  # of the wheels
SCALE = [0.96, 1.03, 0.99]  # delivered over commanded torque of each wheel
MOMENTUM = [1e-3, -5e-4, 2e-4]  # of the wheels at t = 0 [N m s]
BIAS = [4e-5, -7e-5, 2e-5]  # of the gyro [rad/s]
PAIRS = [(0, 0), (0, 1), (0, 2), (1, 1), (1, 2), (2, 2)]
BODY = [[12.0, 0.6, -0.4], [0.6, 9.0, 0.5], [-0.4, 0.5, 15.0]]
CUBESAT = [[0.05, 0.002, -0.001], [0.002, 0.09, 0.003], [-0.001, 0.003, 0.11]]
COLUMNS: dict[str, Any] = {
    "attitude": ["q0", "q1", "q2", "q3"], "quaternion_order": "wxyz", "rate": ["w1", "w2", "w3"],
}  # fmt: skip


class Case(NamedTuple):
    """A spacecraft and its estimated parameters."""

    name: str
    truth: dict[str, Any]  # tables of the true model
    start: dict[str, Any]  # tables of the model that `identify` gets, instead of those of the truth
    free: list[str]
    telemetry: dict[str, Any]
    torque: float  # largest torque of an axis or a wheel [N m]
    true_values: dict[str, list[float]]
    period: float = 0.2  # sample interval [s]
    samples: int = 1001
    wheels: bool = False
    panels: bool = False


def entries(inertia: Any) -> list[float]:
    """Return the six entries of an inertia in the order of `identify`."""
    return [float(inertia[i][j]) for i, j in PAIRS]


def wrong(inertia: Any) -> list[float]:
    """Return principal moments that are 20 % off, without products of inertia."""
    return (np.diag(np.asarray(inertia)) * [0.8, 1.2, 0.8]).tolist()


def cases() -> list[Case]:
    """Return all cases."""
    torque = {"torque": ["c1", "c2", "c3"]}
    panels = modal()
    modes = panels["flexible"]
    wheels = {"kind": "axes", "axes": AXES, "momentum": MOMENTUM}
    small = {"spacecraft": {"inertia": CUBESAT}, "wheels": wheels}
    return [
        Case(
            "rigid body, commanded torque", {"spacecraft": {"inertia": BODY}}, {"spacecraft": {"inertia": wrong(BODY)}},
            ["inertia", "gyro_bias"], torque, 0.06, {"inertia": entries(BODY)},
        ),
        Case(
            "three wheels, measured speeds", small, {"spacecraft": {"inertia": wrong(CUBESAT)}},
            ["inertia", "gyro_bias"], {"wheel_speed": ["s1", "s2", "s3"], "wheel_inertia": SPIN}, 5e-4,
            {"inertia": entries(CUBESAT)}, wheels=True,
        ),
        Case(
            "three wheels, commanded torques, known inertia", small, {}, ["actuator_scale", "gyro_bias"],
            {"wheel_torque": ["c1", "c2", "c3"]}, 5e-4, {"actuator_scale": SCALE}, wheels=True,
        ),
        Case(
            "two hinged panels", panels,
            {
                "spacecraft": {"inertia": wrong(panels["spacecraft"]["inertia"])},
                "flexible": {**modes, "frequency": (np.array(modes["frequency"]) * [0.9, 1.1]).tolist()},
            },
            ["inertia", "mode_frequency", "mode_damping", "gyro_bias"], torque, 0.2,
            {
                "inertia": entries(panels["spacecraft"]["inertia"]), "mode_frequency": modes["frequency"],
                "mode_damping": modes["damping"],
            },
            period=0.1, samples=401, panels=True,
        ),
    ]  # fmt: skip


def devices(case: Case) -> tuple[float, float]:
    """Return the noise of the star tracker [rad] and of the gyro [rad/s], 1 sigma."""
    return (5e-5, 1.4e-4) if case.wheels else (2e-5, 2e-5)


def telemetry(case: Case, seed: int) -> pl.DataFrame:
    """Return the readings, the commands and the speeds of the wheels of a run of Basilisk."""
    from Basilisk.architecture import messaging  # pyright: ignore[reportMissingImports]
    from Basilisk.simulation import (  # pyright: ignore[reportMissingImports]
        extForceTorque,
        imuSensor,
        reactionWheelStateEffector,
        spacecraft,
        starTracker,
    )
    from Basilisk.utilities import SimulationBaseClass, macros, simIncludeRW  # pyright: ignore[reportMissingImports]

    rng, sim = np.random.default_rng(seed), SimulationBaseClass.SimBaseClass()
    nano = macros.sec2nano(case.period)
    sim.CreateNewProcess("process").addTask(sim.CreateNewTask("task", nano // FINER))
    body, effectors = spacecraft.Spacecraft(), []
    body.hub.mHub, body.hub.IHubPntBc_B = HUB_MASS, np.asarray(case.truth["spacecraft"]["inertia"]).tolist()
    factory, wheels = simIncludeRW.rwFactory(), reactionWheelStateEffector.ReactionWheelStateEffector()
    axes = (np.array(AXES) / np.linalg.norm(AXES, axis=1, keepdims=True)) if case.wheels else np.zeros((0, 3))
    if case.wheels:
        for axis, momentum in zip(axes, MOMENTUM, strict=True):
            factory.create("custom", axis.tolist(), Js=SPIN, Omega=momentum / SPIN / macros.RPM, useMaxTorque=False)
        # Basilisk counts the spin inertia to the hub's
        body.hub.IHubPntBc_B = (np.array(CUBESAT) + SPIN * axes.T @ axes).tolist()
        factory.addToSpacecraft("wheels", wheels, body)
        command, message, key = messaging.ArrayMotorTorqueMsg(), messaging.ArrayMotorTorqueMsgPayload, "motorTorque"
        wheels.rwMotorCmdInMsg.subscribeTo(command)
        effectors.append(wheels)
    else:
        push = extForceTorque.ExtForceTorque()
        body.addDynamicEffector(push)
        command, message, key = messaging.CmdTorqueBodyMsg(), messaging.CmdTorqueBodyMsgPayload, "torqueRequestBody"
        push.cmdTorqueInMsg.subscribeTo(command)
        effectors.append(push)
    if case.panels:
        body.hub.IHubPntBc_B = HUB.tolist()
        effectors += add_panels(body)
    star, gyro = starTracker.StarTracker(), imuSensor.ImuSensor()
    star_noise, gyro_noise = devices(case)
    white, still = np.zeros((3, 3)).tolist(), [[0.0]] * 3  # errors without memory
    star.PMatrix, gyro.PMatrixGyro = (star_noise * np.eye(3)).tolist(), (gyro_noise * np.eye(3)).tolist()
    gyro.PMatrixAccel, gyro.senRotBias = white, BIAS
    star.setAMatrix(white)
    star.setWalkBounds(still)
    gyro.setAMatrixGyro(white)
    gyro.setWalkBoundsGyro(still)
    gyro.setErrorBoundsGyro(still)
    star.RNGSeed, gyro.RNGSeed = 2 * seed + 1, 2 * seed + 2
    for sensor in (star, gyro):
        sensor.scStateInMsg.subscribeTo(body.scStateOutMsg)
    for model in (*effectors, body, star, gyro):  # commands are read, then the body moves
        sim.AddModelToTask("task", model)
    # each direction gets a torque and then its opposite
    count = round(PHASE / case.period)
    directions = rng.uniform(-1.0, 1.0, (case.samples // (2 * count) + 1, 3))
    torques = case.torque * np.repeat(np.repeat(directions, 2, axis=0) * np.tile([[1.0], [-1.0]], (len(directions), 1)),
                                      count, axis=0)  # fmt: skip
    found: dict[str, list[float]] = {}
    payload = message()
    for k in range(case.samples):
        if k:
            sim.ConfigureStopTime(nano * k)
            sim.ExecuteSimulation()
        setattr(payload, key, (-torques[k] * SCALE if case.wheels else torques[k]).tolist())  # on the wheel
        command.write(payload, nano * k)  # acts until the next sample
        if k == 0:
            sim.InitializeSimulation()
            sim.ConfigureStopTime(0)
            sim.ExecuteSimulation()
        blocks = {"q": star.sensorOutMsg.read().qInrtl2Case, "w": gyro.sensorOutMsg.read().AngVelPlatform,
                  "c": torques[k]}  # fmt: skip
        if case.wheels:
            blocks["s"] = wheels.rwSpeedOutMsg.read().wheelSpeeds[:3]
        found.setdefault("t", []).append(k * case.period)
        for name, values in blocks.items():
            for i, value in enumerate(values):
                found.setdefault(f"{name}{i + (name != 'q')}", []).append(float(value))
    return pl.DataFrame(found)


def main() -> None:
    """Print a table for each case and log, and the number of errors above 3 standard deviations."""
    from ptsmc_jax.configure import configure

    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--logs", type=int, default=1, help="logs of each case")
    parser.add_argument("--case", default="", help="part of the name of the cases to run")
    arguments = parser.parse_args()
    configure()
    from ptsmc_jax import explore, scenario

    for case in cases():
        if arguments.case not in case.name:
            continue
        star, gyro = devices(case)
        loaded = scenario.from_tables({
            **case.truth,
            **case.start,
            "loop": {"mode": "sampled", "period": case.period},
            "disturbance": {"kind": "none"},
            "hardware": {"attitude_noise": star, "rate_noise": gyro, "rate_bias": 1e-4},
            "identify": {"free": case.free, "prior": "none"},
            "telemetry": {**COLUMNS, **case.telemetry},
        })  # fmt: skip
        all_sigmas: list[float] = []
        for seed in range(arguments.logs):
            found = explore.identify(loaded, telemetry(case, seed))
            (bias, bias_std) = found.gyro_bias()[0]
            truth = np.concatenate([*case.true_values.values(), BIAS])
            labels = [*found.problem.labels, *(f"gyro_bias_{k + 1}" for k in range(3))]
            estimate, std = np.append(found.estimate, bias), np.append(found.std, bias_std)
            sigmas = (estimate - truth) / std
            all_sigmas += sigmas.tolist()
            fit = found.fits[0]
            print(
                f"{case.name}, log {seed}: mean square of the innovations {fit.mean_square:.3f}, white: {fit.is_white}"
            )
            if seed == 0:
                print("\n| parameter | estimate | true value | standard deviation | error in standard deviations |")
                print("|---|---|---|---|---|")
                for line in zip(labels, estimate, truth, std, sigmas, strict=True):
                    print("| {} | {:.6g} | {:.6g} | {:.2g} | {:.2f} |".format(*line), flush=True)
        errors = np.abs(all_sigmas)
        print(f"{case.name}: {np.sum(errors > 3.0)} of {errors.size} errors above 3 standard deviations, "
              f"largest {errors.max():.2f}, RMS {np.sqrt(np.mean(errors**2)):.2f}", flush=True)  # fmt: skip


if __name__ == "__main__":
    main()
