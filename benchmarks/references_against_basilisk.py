r"""Record the references of Basilisk's modules hillPoint and locationPointing on a Keplerian orbit.

    python3.11 -m venv benchmarks/.venv-basilisk
    benchmarks/.venv-basilisk/bin/python -m pip install bsk==2.12.1
    benchmarks/.venv-basilisk/bin/python benchmarks/references_against_basilisk.py \
        tests/signals/basilisk_references.json

`tests/signals/test_mission_references.py` compares the recorded numbers with `nadir` and `ground_target`. Basilisk gets
position and velocity from its own conversion of orbital elements. `locationPointing` turns the body axis to the target
by the shortest rotation from the present attitude, so only the direction of that axis is compared.
"""

import json
import math
import sys
from pathlib import Path

import numpy as np

MU, EARTH_RATE = 3.986004418e14, 7.292115e-5
ORBIT = {"semi_major_axis": 7.0e6, "eccentricity": 0.05, "inclination": 1.7, "ascending_node": 0.4, "perigee": 0.9,
         "true_anomaly": -0.5}  # fmt: skip
POINT = [4.2e6, 0.9e6, 4.7e6]  # Earth-fixed [m]; the Earth's angle is 0 at t = 0
AXIS = [0.0, 0.6, 0.8]  # body axis that points to the target
TIMES = [float(t) for t in range(0, 6001, 1000)]


def true_anomaly(t: float) -> float:
    """Return the true anomaly [rad] at t [s]; Kepler's equation is solved by bisection."""
    a, e, f = ORBIT["semi_major_axis"], ORBIT["eccentricity"], ORBIT["true_anomaly"]
    factor = math.sqrt((1.0 - e) / (1.0 + e))
    start = 2.0 * math.atan(factor * math.tan(0.5 * f))
    mean = start - e * math.sin(start) + math.sqrt(MU / a**3) * t
    low, high = mean - 1.0, mean + 1.0
    for _ in range(100):
        middle = 0.5 * (low + high)
        low, high = (middle, high) if middle - e * math.sin(middle) < mean else (low, middle)
    half = 0.5 * low
    return 2.0 * math.atan2(math.sin(half), factor * math.cos(half))


def record() -> dict:
    """Return orbit, target and the outputs of the modules at `TIMES`."""
    from Basilisk.architecture import messaging  # pyright: ignore[reportMissingImports]
    from Basilisk.fswAlgorithms import hillPoint, locationPointing  # pyright: ignore[reportMissingImports]
    from Basilisk.utilities import (  # pyright: ignore[reportMissingImports]
        RigidBodyKinematics,
        orbitalMotion,
    )

    rows = []
    for t in TIMES:
        elements = orbitalMotion.ClassicElements()
        elements.a, elements.e, elements.i = ORBIT["semi_major_axis"], ORBIT["eccentricity"], ORBIT["inclination"]
        elements.Omega, elements.omega, elements.f = ORBIT["ascending_node"], ORBIT["perigee"], true_anomaly(t)
        r, v = orbitalMotion.elem2rv(MU, elements)
        place = messaging.NavTransMsgPayload()
        place.r_BN_N, place.v_BN_N = r, v
        place_message = messaging.NavTransMsg().write(place)
        hill = hillPoint.hillPoint()
        hill.transNavInMsg.subscribeTo(place_message)
        hill.SelfInit()
        hill.Reset(0)
        hill.UpdateState(0)
        reference = hill.attRefOutMsg.read()
        turned = EARTH_RATE * t
        x, y, z = POINT
        ground = messaging.GroundStateMsgPayload()
        ground.r_LN_N = [math.cos(turned) * x - math.sin(turned) * y, math.sin(turned) * x + math.cos(turned) * y, z]
        ground_message = messaging.GroundStateMsg().write(ground)
        attitude_message = messaging.NavAttMsg().write(messaging.NavAttMsgPayload())
        pointing = locationPointing.locationPointing()
        pointing.pHat_B = AXIS
        pointing.scAttInMsg.subscribeTo(attitude_message)
        pointing.scTransInMsg.subscribeTo(place_message)
        pointing.locationInMsg.subscribeTo(ground_message)
        pointing.SelfInit()
        pointing.Reset(0)
        pointing.UpdateState(0)
        direction = RigidBodyKinematics.MRP2C(np.array(pointing.attRefOutMsg.read().sigma_RN)).T @ AXIS
        rows.append(
            {
                "hill_from_inertial": RigidBodyKinematics.MRP2C(np.array(reference.sigma_RN)).tolist(),
                "rate": list(reference.omega_RN_N),
                "acceleration": list(reference.domega_RN_N),
                "target_direction": direction.tolist(),
            }
        )
    return {"basilisk": "2.12.1", "orbit": ORBIT, "point": POINT, "times": TIMES, "rows": rows}


if __name__ == "__main__":
    recorded = record()
    rows = ",\n".join(map(json.dumps, recorded.pop("rows")))
    Path(sys.argv[1]).write_text(f'{json.dumps(recorded)[:-1]}, "rows": [\n{rows}\n]}}\n', encoding="utf-8")
