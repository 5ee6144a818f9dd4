"""Scenarios for the export to C, which together contain every kind of law, observer, sensor and actuator."""

from typing import Any

from ptsmc_jax.scenario.law_tables import BASELINES
from tests.tree import ROOT

LOOP = {"mode": "sampled", "period": 0.1, "t_end": 6.5}
LAW = {"t_f": 5.0, "delta": 0.5}
BETWEEN = {"t_f": 5.3, "delta": 0.6}  # in single precision the hand-over is after its sample
NOISE = {"attitude_noise": 2e-5, "rate_noise": 1e-6}
SPREAD = {"attitude": {"kind": "axis_angle", "min_deg": 20.0, "max_deg": 90.0}}
MISFITS = {**SPREAD, "actuator_scale": {"kind": "relative_uniform", "half_width": 0.05},
           "wheel_failure": {"kind": "uniform", "latest": 4.0}, "timing_jitter": {"largest": 0.3}}  # fmt: skip
FULL = [[11.0, 1.5, -0.7], [1.5, 9.0, 0.4], [-0.7, 0.4, 14.0]]
CUSTOM = f"{ROOT / 'scenarios' / 'own_parts.py'}:"
PENDULUM = f"{ROOT / 'scenarios' / 'two_link_arm.py'}:arm"


def flight(**tables: Any) -> dict[str, Any]:
    """Return the tables of a short scenario without filter. Keys of `tables` are added or replace its keys."""
    found: dict[str, Any] = {"loop": LOOP, "controller": LAW, "hardware": NOISE, "dispersion": SPREAD}
    for name, table in tables.items():
        found[name] = {**found.get(name, {}), **table} if isinstance(table, dict) and name != "observer" else table
    return found


PROFILE = str(ROOT / "tests" / "attitude_profile.csv")
ORBIT = {"eccentricity": 0.02, "inclination": 1.7}
# moving references with the tables that they need, by kind
MOVING: dict[str, dict[str, Any]] = {
    "table": {"reference": {"kind": "table", "file": PROFILE}},
    "nadir": {"reference": {"kind": "nadir"}, "orbit": ORBIT, "disturbance": {"kind": "gravity_gradient"}},
    "ground_target": {"reference": {"kind": "ground_target", "latitude": 0.1, "longitude": -0.1}, "orbit": ORBIT},
    "two_vector": {
        "reference": {"kind": "two_vector", "primary": "sun", "secondary": "nadir"},
        "orbit": {**ORBIT, "ascending_node": 1.0}, "loop": {"epoch": "2026-06-01T06:00:00"},
    },
}  # fmt: skip
FILTER = {"filter": {"kind": "steady_state"}}
CHAIN = {"plant": {"kind": "chain", "order": 2, "x0": [1.0, -0.2]}, "loop": LOOP, "controller": LAW,
         "hardware": {"state_noise": [1e-5, 1e-5]},
         "dispersion": {"x0": {"kind": "uniform", "half_width": [0.5, 0.1]}}}  # fmt: skip
FLIGHTS: dict[str, dict[str, Any]] = {
    "raw": flight(),
    "filter": flight(**FILTER),
    "wheels": flight(**FILTER, wheels={"torque_limit": 2.0, "momentum_limit": 2.0}, spacecraft={"inertia": FULL},
                     hardware={"command_filter": {"kind": "notch", "corner": 4.0}}, dispersion=MISFITS,
                     controller=BETWEEN),
    "chain": CHAIN,
    "multiplicative": flight(controller={"error": "multiplicative"}, spacecraft={"inertia": FULL},
                             reference={"kind": "sinusoid", "amplitude": [0.1, 0.05, 0.08],
                                        "frequency": [0.2, 0.3, 0.1]}),
    "custom law": flight(controller={"kind": "custom", "code": CUSTOM + "Scaling", "delta": 1.0},
                      observer={"kind": "custom", "code": CUSTOM + "LowPass"},
                      reference={"kind": "custom", "code": CUSTOM + "Nodding", "angle": 0.1}),
    # further variants
    "no observer": flight(observer={"kind": "none"}, controller={"sign_width": 0.0}),
    "finite time observer": flight(observer={"kind": "finite_time", "gain": [0.1, 0.1, 0.1]},
                                   controller={"disturbance_rate_bound": 1e-3}),
    "prescribed time observer": flight(observer={"kind": "prescribed_time", "t_o": 2.0}),
    "implicit": flight(controller={"sampling": "implicit"}),
    "chain of order 4": {**CHAIN, "plant": {"kind": "chain", "order": 4, "x0": [1.0, 0.0, 0.0, 0.0]},
                         "hardware": {}, "dispersion": {}, "controller": {"t_f": 5.0, "delta": 1.0}},
    "implicit chain": {**CHAIN, "controller": {**BETWEEN, "sampling": "implicit"}},
    # explicit gains, because designed gains would keep the torque below its limit
    "delay, limit, quantised": flight(
        hardware={"delay": 2, "torque_limit": 3.0, "torque_step": 1e-3}, observer={"gain": [10.0] * 3},
        controller={"delta": 1.0, "eta": 3.0, "k1": 1.0, "surface_rate": 1.0, "sign_width": 1e-3}),
    "lag and rate limit": flight(
        **FILTER, hardware={"torque_lag": 0.1, "torque_rate_limit": 20.0, "torque_limit": 4.0}),
    "first-order roll-off of a chain": {
        **CHAIN, "hardware": {"delay": 1, "command_filter": {"kind": "first_order", "corner": 9.0}}},
    "second-order roll-off, lag": flight(
        hardware={"torque_lag": 0.1, "command_filter": {"kind": "second_order", "corner": 6.0}}),
    "slow star tracker": flight(
        **FILTER, hardware={"star_tracker_every": 5, "rate_bias": 1e-5, "rate_bias_walk": 1e-7}),
    "star tracker out of step": flight(**FILTER, hardware={"star_tracker_period": 0.25, "rate_bias": 1e-5}),
    "wheels with lag, limits, delay": flight(
        hardware={"torque_lag": 0.05, "delay": 1}, controller={"delta": 1.0}, dispersion=MISFITS,
        wheels={"torque_limit": 1.5, "momentum_limit": 4.0, "momentum": [0.5, -0.2, 0.1, 0.3]}),
    "spin": flight(reference={"kind": "spin", "rate": [0.01, 0.02, -0.01]}),
    "slew": flight(controller={"error": "multiplicative"},
                   reference={"kind": "slew", "to_quat_xyzw": [0.0, 0.0, 0.3826834323650898, 0.9238795325112867],
                              "duration": 4.0}),
    **{kind: flight(controller={"error": "multiplicative"}, **tables) for kind, tables in MOVING.items()},
    **{kind: {**flight(), "controller": {"kind": kind, "t_f": 5.0}} for kind in
       BASELINES},
    # for larger angles the body turns by more than 1 rad in a period, which the C rejects
    "predefined_time": {**flight(), "controller": {"kind": "predefined_time", "t_f": 5.0},
                        "dispersion": {"attitude": {"kind": "axis_angle", "min_deg": 5.0, "max_deg": 15.0}}},
    "system": {"plant": {"kind": "system", "system": PENDULUM, "x0": [1.0, -0.5, 0.0, 0.0]}, "loop": LOOP,
               "controller": LAW},
}  # fmt: skip
SIX = ("raw", "filter", "wheels", "chain", "multiplicative", "custom law")
