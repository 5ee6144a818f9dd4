"""Parts and scenarios that several tests use."""

import dataclasses
import json
from pathlib import Path
from typing import Any

import jax.numpy as jnp
import numpy as np

from ptsmc_jax import clock, controllers, hardware, observers, plants, signals
from ptsmc_jax.rollout import Parts

ROOT = Path(__file__).parent.parent
FIRST_FLIGHT = ROOT / "scenarios" / "first_flight.toml"
REFERENCE = json.loads((Path(__file__).parent / "spacecraft_continuous.json").read_text())

PAPER_INERTIA = (10.0, 12.0, 14.0)
FULL_INERTIA = ((11.0, 1.5, -0.7), (1.5, 9.0, 0.4), (-0.7, 0.4, 14.0))
PAPER_ATTITUDE = np.array([np.sqrt(2) / 3, -1 / 3, np.sqrt(3) / 3, np.sqrt(3) / 3])


def vector(*values: Any) -> Any:
    """A float64 array."""
    return jnp.asarray(np.asarray(values[0] if len(values) == 1 else values, dtype=float))


def parts(
    t_f=30.0,
    eta=3.0,
    delta=0.05,
    gain=10.0,
    *,
    inertia: Any = PAPER_INERTIA,
    q: Any = PAPER_ATTITUDE,
    rate: Any = (0.0, 0.0, 0.0),
    reference: Any = None,
    disturbance: Any = None,
    rate_bound=1e-3,
    noise: tuple[float, float] | None = None,
    period: float | None = None,
    flight=False,
    t_end: float | None = None,
    sign_width=1e-3,
    k1=1.0,
    saves: Any = (),
    reach: tuple[float, float] | None = None,
) -> Parts:
    """Parts of the paper's Case I with changes; continuous unless a period is given; reach: largest (t_f, delta)."""
    body = plants.spacecraft(inertia)
    t_end = t_f + 10.0 if t_end is None else t_end
    if period is None:
        timing: Any = clock.graded(t_f, delta, t_end, 1.0, k1, 0.1, 0.2, saves)
    elif flight:
        timing = clock.flight(period, t_end)
    else:
        longest = reach or (t_f, delta)
        timing = clock.anchored(period, t_end, longest[0], t_end - t_f + longest[1])
    return Parts(
        plant=body,
        disturbance=disturbance
        or signals.Sinusoid(vector([0.01] * 3), vector([0.1] * 3), vector([0.0] * 3), vector([0.0] * 3)),
        reference=reference or signals.Fixed(vector([0.0, 0.0, 0.0, 1.0])),
        controller=controllers.PrescribedTime(body, *(vector(v) for v in (t_f, eta, delta, k1, sign_width))),
        observer=observers.NonlinearObserver(body, vector([gain] * 3), vector(rate_bound), vector(0.0)),
        sensors=None if noise is None else hardware.Sensors(*(vector(v) for v in noise)),
        clock=timing,
        initial=plants.AttitudeState(vector(q), vector(rate)),
        t_end=vector(t_end),
        window=vector(1.0),
        settling_angle=vector(1e-3),
    )


def with_controller(run: Parts, **changes: Any) -> Parts:
    """The parts with other values in the controller."""
    return dataclasses.replace(run, controller=dataclasses.replace(run.controller, **changes))
