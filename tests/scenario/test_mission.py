"""Defaults that follow from the mission: they scale with its units, and the designed gains meet their conditions."""

import math

import numpy as np
import pytest

from ptsmc_jax import scenario
from ptsmc_jax.scenario import mission, parsing

# powers of inertia and time in the unit of each default, by table and key
UNITS = {
    "loop": {"period": (0, 1), "t_end": (0, 1), "window": (0, 1), "settling_angle": (0, 0)},
    "controller": {
        "t_f": (0, 1),
        "delta": (0, 1),
        "layer_time": (0, 1),
        "disturbance_bound": (1, -2),
        "disturbance_rate_bound": (1, -3),
        **dict.fromkeys(("k1", "k_d", "surface_rate", "sign_width"), (0, -1)),
        "k_p": (0, -2),
        "lipschitz": (0, -3),
    },
    "observer": {"gain": (1, -1)},
    "disturbance": {"amplitude": (1, -2), "density": (1, -2.5), "frequency": (0, -1)},
    "flexible": {"frequency": (0, -1), "coupling": (0.5, 0)},
    "reference": {"frequency": (0, -1), "duration": (0, 1)},
    "pointing": {"window": (0, 1)},
    "dispersion.rate": {"std": (0, -1), "half_width": (0, -1)},
    "dispersion.disturbance_bias": {"std": (1, -2), "half_width": (1, -2)},
    "dispersion.star_tracker_outage": {"duration": (0, 1)},
    "tune.bounds": {
        "eta": (0, 0),
        "delta": (0, 1),
        "observer_gain": (1, -1),
        **dict.fromkeys(("k1", "k_d", "surface_rate", "sign_width"), (0, -1)),
        "k_p": (0, -2),
        "lipschitz": (0, -3),
    },
}
SAMPLED = {"loop": {"mode": "sampled"}}
NORMAL = {"rate": {"kind": "normal"}, "disturbance_bias": {"kind": "normal"}}
UNIFORM = {"rate": {"kind": "uniform"}, "disturbance_bias": {"kind": "uniform"}}
MISSIONS = {
    "continuous": {},
    "sampled": SAMPLED,
    "flexible modes": {**SAMPLED, "flexible": {}},
    "moving reference": {**SAMPLED, "reference": {"kind": "sinusoid"}},
    "slew": {"reference": {"kind": "slew"}, "pointing": {}},
    "constant disturbance": {**SAMPLED, "disturbance": {"kind": "constant"}},
    "random walk": {**SAMPLED, "disturbance": {"kind": "random_walk"}},
    "normal dispersions": {**SAMPLED, "dispersion": NORMAL},
    "uniform dispersions": {"dispersion": UNIFORM},
    "outage": {**SAMPLED, "filter": {"kind": "steady_state", "bandwidth": 0.1}, "hardware": {"attitude_noise": 1e-5},
               "dispersion": {"star_tracker_outage": {}}},
    "proportional-derivative law": {**SAMPLED, "controller": {"kind": "pd"}},
    "super-twisting law": {**SAMPLED, "controller": {"kind": "super_twisting"}},
}  # fmt: skip


def numbers_of(tables):
    """Defaults with a unit, by table and key."""
    dumped = parsing.dump(scenario.from_tables({**tables, "tune": {}}))
    found = {}
    for place, units in UNITS.items():
        table = dumped
        for name in place.split("."):
            table = table.get(name, {})
        found |= {(place, key): np.asarray(table[key]) for key in units if key in table}
    return found


def of_body(tables, inertia, t_f):
    """The scenario's tables for a body of this mean inertia [kg m^2] and this t_f [s]."""
    body = {"inertia": [0.5 * inertia, inertia, 1.5 * inertia]}
    return {**tables, "spacecraft": body, "controller": {**tables.get("controller", {}), "t_f": t_f}}


@pytest.mark.parametrize("name", MISSIONS)
def test_defaults_scale_with_the_units_of_the_mission(name):
    """A body of a thousandth of the inertia in eight times the time gets the same defaults in other units."""
    inertia, time = 1e-3, 8.0
    one, other = (
        numbers_of(of_body(MISSIONS[name], 20.0 * by, 50.0 * slower)) for by, slower in ((1.0, 1.0), (inertia, time))
    )
    assert set(one) == set(other)
    for place, key in one:
        of_inertia, of_time = UNITS[place][key]
        expected = one[place, key] * inertia**of_inertia * time**of_time
        np.testing.assert_allclose(other[place, key], expected, rtol=1e-9, err_msg=f"{place}.{key}")


@pytest.mark.parametrize("order", [2, 3])
def test_defaults_of_a_chain_scale_with_t_f(order):
    """The unit of d is that of x_1 over s^order; that of s is x_1 over s^(order - 1)."""
    units = {"loop": {"period": 1, "t_end": 1, "window": 1},
             "controller": {"delta": 1, "layer_time": 1, "k1": -1, "surface_rate": -1, "sign_width": 1 - order,
                            "disturbance_bound": -order, "disturbance_rate_bound": -order - 1},
             "observer": {"gain": -1}, "disturbance": {"amplitude": -order, "frequency": -1}}  # fmt: skip
    plant, law = {"kind": "chain", "order": order}, {"t_f": 40.0}
    tables = {"plant": plant, "observer": {"kind": "nonlinear"}}
    one = parsing.dump(scenario.from_tables({**tables, "controller": law}))
    other = parsing.dump(scenario.from_tables({**tables, "controller": {"t_f": 240.0}}))
    for place, keys in units.items():
        for key, power in keys.items():
            expected = np.asarray(one[place][key]) * 6.0**power
            np.testing.assert_allclose(other[place][key], expected, rtol=1e-9, err_msg=f"{place}.{key}")


@pytest.mark.parametrize(
    ("changes", "published"),
    [
        ({}, True),
        ({"controller": {"t_f": 40.0}}, True),
        ({"controller": {"t_f": 40.1}}, False),
        ({"controller": {"t_f": 29.9}}, False),
        ({"spacecraft": {"inertia": [10.0, 12.0, 14.1]}}, False),
        ({"plant": {"kind": "chain"}}, True),
        ({"plant": {"kind": "chain"}, "controller": {"t_f": 5.1}}, False),
    ],
    ids=str,
)
def test_the_papers_cases_keep_the_published_numbers(changes, published):
    law = scenario.from_tables({**SAMPLED, **changes}).controller
    assert mission.published(scenario.from_tables(changes)) == published
    found = (law.eta, law.delta, law.k1, law.surface_rate, law.sign_width)
    assert (found == (3.0, 0.05, 1.0, 1.0, 1e-3)) == published


@pytest.mark.parametrize("hardware", [{}, {"delay": 2}, {"torque_lag": 0.5}], ids=str)
@pytest.mark.parametrize("plant", ["spacecraft", "chain"])
def test_designed_gains_place_both_poles_of_the_hold_phase(plant, hardware):
    """Both poles are at -p, p times the dead time is at most 1/4, and the rate gain is 2 p at the hand-over."""
    tables = {**SAMPLED, "hardware": hardware, "controller": {"t_f": 60.0}, "plant": {"kind": plant}}
    found = scenario.from_tables(tables)
    law, period = found.controller, found.loop.period
    pole = law.surface_rate
    assert law.k1 == pytest.approx(pole * (2.0 if plant == "spacecraft" else 1.0), rel=1e-12)  # (60) halves K1
    assert (2.0 * law.eta - 1.0) / law.delta == pytest.approx(2.0 * pole, rel=1e-12)
    dead_time = (hardware.get("delay", 0) + 0.5) * period + hardware.get("torque_lag", 0.0)
    assert 0.0 < pole * dead_time <= 0.25 * (1.0 + 1e-12)
    assert period <= law.delta <= 0.5 * law.t_f + period


def test_the_default_eta_keeps_the_first_torque_below_its_limit():
    """The first torque is 2 J eta^2 tan(angle / 2) / t_f^2 about the axis of the turn; a tenth of the limit is left."""
    body = {"spacecraft": {"inertia": [20.0, 20.0, 20.0]}, "initial": {"rotvec_deg": [0.0, 0.0, 90.0]}}
    tables = {**SAMPLED, **body, "controller": {"t_f": 60.0}}
    assert scenario.from_tables(tables).controller.eta == 3.0
    limit = 2.0 * 20.0 * 2.6**2 / 60.0**2 / 0.9
    limited = scenario.from_tables({**tables, "hardware": {"torque_limit": limit}})
    assert limited.controller.eta == pytest.approx(2.6, rel=1e-9)


@pytest.mark.parametrize(
    ("tables", "angle"),
    [
        ({}, 1e-3),
        ({"initial": {"rotvec_deg": [0.0, 0.0, 180.0 / math.pi]}}, 1e-3),
        ({"initial": {"rotvec_deg": [0.0, 0.0, 9.0 / math.pi]}}, 5e-5),  # a start angle of 0.05 rad
        ({**SAMPLED, "hardware": {"attitude_noise": 3e-4}}, 1.5e-3),
        ({**SAMPLED, "hardware": {"attitude_noise": 1e-5}}, 1e-3),
    ],
    ids=str,
)
def test_the_default_settling_angle_follows_the_start_and_the_noise(tables, angle):
    assert scenario.from_tables(tables).loop.settling_angle == pytest.approx(angle, rel=1e-9)
