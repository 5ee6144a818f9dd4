"""Compare a spacecraft with two hinged panels, nonlinear in Basilisk, with its linear modes in the library.

    python3.11 -m venv benchmarks/.venv-basilisk
    benchmarks/.venv-basilisk/bin/python -m pip install --editable . bsk==2.12.1
    benchmarks/.venv-basilisk/bin/python benchmarks/flexible_against_basilisk.py

The modes follow from the panels' mass matrix about rest, free in translation, by the generalised eigenproblem. The
library simulates a slew with the paper's law. Basilisk applies the same torques in each period, in steps four times as
fine. Modes describe the linear motion, so the difference is of the order of the squares of the panels' angles and of
the rate, and smaller for smaller slews.
"""

from typing import Any

import numpy as np
from scipy import linalg

PERIOD, FINER, SECONDS = 0.05, 4, 45.0
HUB_MASS, HUB = 200.0, np.diag([40.0, 50.0, 60.0])
PANEL = {"mass": 20.0, "inertia": np.diag([2.0, 5.0, 6.9]), "arm": 1.2}  # about its centre; from the hinge to it [m]
STIFF, DAMPER = (300.0, 420.0), (0.6, 0.84)  # of each hinge [N m/rad], [N m s/rad]: damping in proportion
SIDES = (1.0, -1.0)


def frames() -> list[tuple[np.ndarray, np.ndarray]]:
    """Return the hinge [m] of each panel, and its axes h1, h2, h3 at rest as rows; the panel extends along -h1."""
    found = []
    for side in SIDES:
        h1, h2 = np.array([0.0, -side, 0.0]), np.array([1.0, 0.0, 0.0])
        found.append((np.array([0.1, 0.5 * side, 0.2]), np.stack([h1, h2, np.cross(h1, h2)])))
    return found


def cross(v: np.ndarray) -> np.ndarray:
    """Return the matrix of the cross product v x."""
    return np.array([[0.0, -v[2], v[1]], [v[2], 0.0, -v[0]], [-v[1], v[0], 0.0]])


def modal() -> dict[str, Any]:
    """Return the inertia of the whole body, and frequency, damping and coupling of its modes, free in translation."""
    n = len(SIDES)
    mass = np.zeros((6 + n, 6 + n))  # by the hub's velocity, its rate and the panels' angular rates
    mass[:3, :3], mass[3:6, 3:6] = HUB_MASS * np.eye(3), HUB
    for k, (hinge, axes) in enumerate(frames()):
        inertia = axes.T @ PANEL["inertia"] @ axes
        centre = hinge - PANEL["arm"] * axes[0]
        moves = np.zeros((3, 6 + n))
        moves[:, :3], moves[:, 3:6], moves[:, 6 + k] = np.eye(3), -cross(centre), PANEL["arm"] * axes[2]
        turns = np.zeros((3, 6 + n))
        turns[:, 3:6], turns[:, 6 + k] = np.eye(3), axes[1]
        mass += PANEL["mass"] * moves.T @ moves + turns.T @ inertia @ turns
    # no force on the whole: its velocity follows
    left = mass[3:, 3:] - mass[3:, :3] @ np.linalg.solve(mass[:3, :3], mass[:3, 3:])
    squares, shapes = linalg.eigh(np.diag(STIFF), left[3:, 3:])
    frequency = np.sqrt(squares)
    damping = np.diag(shapes.T @ np.diag(DAMPER) @ shapes) / (2.0 * frequency)
    modes = {"frequency": frequency, "damping": damping, "coupling": shapes.T @ left[3:, :3]}
    flexible = {key: value.tolist() for key, value in modes.items()}
    return {"spacecraft": {"inertia": left[:3, :3].tolist()}, "flexible": flexible}


def add_panels(body: Any) -> list[Any]:
    """Add the hinged panels to a Basilisk spacecraft and return them."""
    from Basilisk.simulation import hingedRigidBodyStateEffector  # pyright: ignore[reportMissingImports]

    panels = []
    for (hinge, axes), k, c in zip(frames(), STIFF, DAMPER, strict=True):
        panel = hingedRigidBodyStateEffector.HingedRigidBodyStateEffector()
        panel.mass, panel.IPntS_S, panel.d = PANEL["mass"], PANEL["inertia"].tolist(), PANEL["arm"]
        panel.k, panel.c = k, c
        panel.r_HB_B, panel.dcm_HB = [[v] for v in hinge], axes.tolist()
        body.addStateEffector(panel)
        panels.append(panel)
    return panels


def simulated_again(run: Any) -> tuple[np.ndarray, np.ndarray]:
    """Apply the torques of a run; return attitudes (rows, 4), scalar last, and angles of the panels (rows, 2)."""
    from Basilisk.architecture import messaging  # pyright: ignore[reportMissingImports]
    from Basilisk.simulation import extForceTorque, spacecraft  # pyright: ignore[reportMissingImports]
    from Basilisk.utilities import SimulationBaseClass, macros  # pyright: ignore[reportMissingImports]
    from scipy.spatial.transform import Rotation

    log, sim = run.log, SimulationBaseClass.SimBaseClass()
    sim.CreateNewProcess("process").addTask(sim.CreateNewTask("task", macros.sec2nano(PERIOD) // FINER))
    body, torque = spacecraft.Spacecraft(), extForceTorque.ExtForceTorque()
    body.hub.mHub, body.hub.IHubPntBc_B = HUB_MASS, HUB.tolist()
    body.hub.sigma_BNInit = [[v] for v in Rotation.from_quat(log.x.q[0]).as_mrp()]
    body.hub.omega_BN_BInit = [[v] for v in log.x.w[0]]
    panels = add_panels(body)
    body.addDynamicEffector(torque)
    command = messaging.CmdTorqueBodyMsg()
    torque.cmdTorqueInMsg.subscribeTo(command)
    for model in (torque, *panels, body):
        sim.AddModelToTask("task", model)

    def say(k: int) -> None:
        payload = messaging.CmdTorqueBodyMsgPayload()
        payload.torqueRequestBody = log.u[k].tolist()
        command.write(payload, macros.sec2nano(PERIOD * k))

    say(0)
    sim.InitializeSimulation()
    found, angles = [log.x.q[0]], [np.zeros(len(panels))]
    for k in range(1, len(log.t)):
        sim.ConfigureStopTime(macros.sec2nano(PERIOD * k))
        sim.ExecuteSimulation()
        say(k)
        found.append(Rotation.from_mrp(np.asarray(body.scStateOutMsg.read().sigma_BN)).as_quat())
        angles.append(np.array([panel.hingedRigidBodyOutMsg.read().theta for panel in panels]))
    return np.asarray(found), np.asarray(angles)


def main() -> None:
    """Print the largest angle between both, for slews of several sizes."""
    from ptsmc_jax.configure import configure

    configure()
    from scipy.spatial.transform import Rotation

    from ptsmc_jax import scenario
    from ptsmc_jax.campaigns import runs

    known = modal()
    print({key: np.round(value, 4).tolist() for key, value in known["flexible"].items()})
    for share in (1.0, 0.1, 0.01):
        table = {
            **known,
            "initial": {"rotvec_deg": [60.0 * share, -40.0 * share, 70.0 * share]},
            "controller": {"t_f": 35.0, "delta": 0.5, "error": "multiplicative"},
            "disturbance": {"kind": "none"},
            "loop": {"mode": "sampled", "clock": "flight", "period": PERIOD, "t_end": SECONDS},
        }
        run = runs.simulate(scenario.study(scenario.from_tables(table)))
        theirs, angles = simulated_again(run)
        off = (Rotation.from_quat(run.log.x.q).inv() * Rotation.from_quat(theirs)).magnitude().max()
        print(
            f"slew of {100 * share:g} %: largest angle apart {off:.1e} rad, "
            f"panels up to {np.abs(angles).max():.1e} rad, {run.status}, {run.parts.substeps} steps a period"
        )


if __name__ == "__main__":
    main()
