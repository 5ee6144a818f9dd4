"""Defaults that follow from the mission: they scale with its units, and the designed gains meet their conditions."""

import math
from typing import Any

import numpy as np
import pytest

from ptsmc_jax import scenario
from ptsmc_jax.scenario import mission, parsing

SAMPLED = {"loop": {"mode": "sampled"}}


@pytest.mark.parametrize("order", [2, 3])
def test_defaults_of_a_chain_scale_with_t_f(order):
    """The unit of d is the unit of x_1 over s^order, and the unit of s is the unit of x_1 over s^(order - 1)."""
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
    ("changes", "is_published"),
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
def test_default_gains_are_the_published_gains_in_published_cases_only(changes, is_published):
    """Published cases have the published inertia and a t_f of 30 to 40 s, or are chains with a t_f of 5 s."""
    law = scenario.from_tables({**SAMPLED, **changes}).controller
    assert mission.is_published_case(scenario.from_tables(changes)) == is_published
    found = (law.eta, law.delta, law.k1, law.surface_rate, law.sign_width)
    assert (found == (3.0, 0.05, 1.0, 1.0, 1e-3)) == is_published


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


@pytest.mark.parametrize(
    ("tables", "angle"),
    [
        ({}, 1e-3),
        ({"initial": {"rotvec_deg": [0.0, 0.0, 180.0 / math.pi]}}, 1e-3),
        ({"initial": {"rotvec_deg": [0.0, 0.0, 9.0 / math.pi]}}, 5e-5),  # a start angle of 0.05 rad
        ({**SAMPLED, "hardware": {"attitude_noise": 3e-4}}, 1.5e-3),
        ({**SAMPLED, "hardware": {"attitude_noise": 1e-5}}, 1e-3),
        (
            {"dispersion": {"attitude": {"kind": "axis_angle", "min_deg": 0.1, "max_deg": 0.2}}},
            1e-3 * math.radians(0.2),
        ),
    ],
    ids=str,
)
def test_the_default_settling_angle_follows_the_start_and_the_noise(tables, angle):
    assert scenario.from_tables(tables).loop.settling_angle == pytest.approx(angle, rel=1e-9)


def sampled(**tables: Any) -> Any:
    """Return a sampled scenario of a body of 50 kg m^2 that turns in 100 s; tables replace its tables."""
    base = {"spacecraft": {"inertia": [40.0, 50.0, 60.0]}, "controller": {"t_f": 100.0},
            "loop": {"mode": "sampled", "period": 0.25}, "disturbance": {"kind": "none"}}  # fmt: skip
    return scenario.from_tables({**base, **tables})


def test_dead_time_limits_the_bandwidth_of_the_default_gains():
    """Without noise p T = 0.25, where T is the sum of hold, delay and lag."""
    for hardware, dead in (({}, 0.125), ({"delay": 2}, 0.625), ({"delay": 1, "torque_lag": 0.3}, 0.675)):
        said = sampled(hardware=hardware) if hardware else sampled()
        assert mission.dead_time(said) == pytest.approx(dead)
        assert mission.design(said).pole == pytest.approx(0.25 / dead)
        assert "bandwidth set by the dead time" in str(mission.describe_default_gains(said))


def test_the_designed_loop_has_the_documented_stability_margins():
    """The loop is in continuous time, with the dead time e^(-sT), T = 1, and an observer with the rate l / J = r.

    L = (1 + r / s) (2 p s + p^2) e^(-sT) / s^2 + r e^(-sT) / s, since the estimate is r / s times the unexplained
    torque.
    """
    p, r = mission.MAX_POLE_TIMES_DEAD_TIME, mission.OBSERVER_TO_POLE * mission.MAX_POLE_TIMES_DEAD_TIME
    w = np.geomspace(1e-3, 30.0, 200_001)
    s = 1j * w
    L = ((1 + r / s) * (2 * p * s + p**2) / s**2 + r / s) * np.exp(-s)
    crossover = np.argmin(np.abs(np.abs(L) - 1.0))
    assert np.rad2deg(np.angle(L[crossover])) + 180.0 == pytest.approx(35.6, abs=0.5)
    real = np.flatnonzero(np.diff(np.sign(L.imag)) != 0)
    down = -20.0 * np.log10(np.abs(L[real[L[real].real < 0.0]]))
    assert np.min(down[down > 0.0]) == pytest.approx(7.2, abs=0.3)


def test_noise_and_torque_limit_bound_the_bandwidth_of_the_default_gains():
    """Five sigma of the torque noise J (2 p + l / J) sigma_w, with l = J p / 2, are half of the limit."""
    limit, sigma = 0.1, 1e-4
    said = sampled(hardware={"rate_noise": sigma, "torque_limit": limit})
    pole = mission.design(said).pole
    assert 60.0 * 2.5 * pole * sigma == pytest.approx(0.5 * limit / 5.0)
    assert "bandwidth set by the torque limit" in str(mission.describe_default_gains(said))


def test_late_modes_limit_the_bandwidth_of_the_default_gains_and_early_ones_do_not():
    """A mode is late if its frequency times the dead time, 0.125 s, exceeds 60 deg."""
    modes = {"damping": [0.002], "coupling": [[0.0, 2.0, 0.0]]}
    early, late = (sampled(flexible={"frequency": [w], **modes}) for w in (4.0, 12.0))
    fraction = 4.0 / 50.0
    free = 12.0 / math.sqrt(1.0 - fraction)
    assert mission.design(early).pole == pytest.approx(2.0)
    assert mission.design(late).pole == pytest.approx(0.5 * 0.002 * free / (fraction / (1.0 - fraction)))
    assert "bandwidth set by the damping of a flexible mode" in str(mission.describe_default_gains(late))
    late = sampled(flexible={"frequency": [12.0], "damping": [1e-6], "coupling": [[0.0, 2.0, 0.0]]})
    assert "bandwidth set by controller.t_f" in str(mission.describe_default_gains(late))


def test_default_gains_are_described_only_if_the_file_states_no_gain():
    assert mission.describe_default_gains(sampled(observer={"gain": [1.0, 1.0, 1.0]})) is not None
    for law in ({"k1": 0.5}, {"kind": "pd", "k_p": 0.1}):
        assert mission.describe_default_gains(sampled(controller={"t_f": 60.0, **law})) is None
    for published in (scenario.from_tables({}), scenario.from_tables({"controller": {"kind": "pd"}, **SAMPLED})):
        assert "bandwidth" not in str(mission.describe_default_gains(published))


def test_a_weak_actuator_reduces_the_default_eta():
    """From rest the first torque is 2 eta^2 J tan(angle / 2) / t_f^2. The smallest default of eta is 2.4."""
    start = {"dispersion": {"attitude": {"kind": "axis_angle", "min_deg": 60.0, "max_deg": 60.0}}}
    needed = 2.0 * 60.0 * math.tan(math.radians(30.0)) / 100.0**2
    weak = sampled(**start, hardware={"torque_limit": 7.0 * needed})
    assert weak.controller.eta == pytest.approx(math.sqrt(0.9 * 7.0))
    assert sampled(**start, hardware={"torque_limit": 20.0 * needed}).controller.eta == 3.0
    assert sampled(**start, hardware={"torque_limit": needed}).controller.eta == pytest.approx(2.4)


def test_designs_are_starting_points_within_the_bounds_or_near():
    """Each design has all gains of the law, with delta between a control period and t_f."""
    said = scenario.replace(sampled(), tune={})
    designs = mission.starting_designs(said)
    assert len(designs) > 5
    for design in designs:
        gains = said.controller.gains_of(design, said)
        assert said.loop.period <= gains["delta"] < said.controller.t_f
        assert all(value > 0.0 for value in gains.values())


@pytest.mark.parametrize("t_f", [30.0, 35.0, 47.0, 60.0])
@pytest.mark.parametrize("mode", ["continuous", "sampled"])
def test_defaults_and_bounds_have_no_rounding_errors_in_their_last_digits(mode, t_f):
    """Products such as 0.30000000000000004 have 17 digits. Designed gains of the sampled loop are irrational."""
    tables = {"loop": {"mode": mode}, "controller": {"t_f": t_f}, "tune": {}}
    read = scenario.from_tables(tables)
    gains = () if mode == "sampled" else (read.controller.sign_width, *read.observer.gain)
    for value in (read.loop.period, *gains, *np.ravel([*read.search.bounds.values()])):
        assert value == float(f"{value:.15g}")
