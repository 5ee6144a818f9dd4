"""Defaults, bounds and designs follow the mission: other units of time and inertia rescale them and change nothing."""

import math
import tomllib
from collections.abc import Mapping
from typing import Any

import numpy as np
import pytest

from ptsmc_jax.scenario import from_tables, mission, parsing, replace
from ptsmc_jax.scenario.errors import ScenarioError
from ptsmc_jax.scenario.law_tables import LAWS
from tests.tree import ROOT
from tests.units import in_units, powers
from tuning.search import gains as gain_names

SATELLITES = sorted((ROOT / "benchmarks" / "satellites").glob("*.toml"))


def flat(tables: Any, path: str = "") -> dict[str, Any]:
    """Return the numbers of nested tables by their path."""
    if isinstance(tables, Mapping):
        return {k: v for key, one in tables.items() for k, v in flat(one, f"{path}.{key}").items()}
    if isinstance(tables, list | tuple):
        return {k: v for n, one in enumerate(tables) for k, v in flat(one, f"{path}[{n}]").items()}
    return {path: tables}


CHAIN = {"plant": {"kind": "chain", "x0": [1.0, 0.5]}, "loop": {"mode": "sampled"}, "controller": {"t_f": 8.0}}


@pytest.mark.parametrize("path", SATELLITES, ids=lambda path: path.stem)
@pytest.mark.parametrize(("inertia", "time"), [(4.0, 1.0), (1.0, 0.25), (0.0625, 16.0)])
def test_other_units_rescale_every_default_and_every_bound(path, inertia, time):
    """Powers of 4 leave even square roots exact, so equal means equal but for the last digits of powers."""
    raw = {**tomllib.loads(path.read_text()), "tune": {}}
    here = parsing.dump(from_tables(raw))
    there = parsing.dump(from_tables(in_units(raw, inertia, time)))
    expected, found = flat(in_units(here, inertia, time)), flat(there)
    assert expected.keys() == found.keys()
    for key, value in expected.items():
        assert found[key] == (pytest.approx(value, rel=1e-12) if isinstance(value, float) else value), key


@pytest.mark.parametrize("law", [law for law in LAWS["spacecraft"] if law != "own"])
def test_gains_of_every_law_follow_the_mission(law):
    raw = tomllib.loads((ROOT / "benchmarks" / "satellites" / "uosat12.toml").read_text())
    raw = {**raw, "controller": {"kind": law, "t_f": raw["controller"]["t_f"]}, "tune": {}}
    here, there = (from_tables(tables) for tables in (raw, in_units(raw, 4.0, 16.0)))
    units = gain_names.units_of(here)
    for name in here.gains:
        p = getattr(here.controller, "p", 0.0)
        mass, second = {"1/s^p": (0.0, -p), "1/s^(2-p)": (0.0, p - 2.0)}.get(units[name]) or powers(units[name])
        factor = 4.0**mass * 16.0**second
        table = next(table for table in here.tuned_tables.values() if name in table.gains)
        other = next(table for table in there.tuned_tables.values() if name in table.gains)
        key = name.removeprefix(table.prefix)
        if getattr(table, key) is not None and name not in ("sign_width",):
            assert np.asarray(getattr(other, key)) == pytest.approx(np.asarray(getattr(table, key)) * factor, rel=1e-12)
        if name in here.search.gains and name != "sign_width":
            bounds = np.asarray(here.search.bounds[name]) * factor
            assert there.search.bounds[name] == pytest.approx(tuple(bounds), rel=1e-12), name


def test_the_papers_cases_keep_the_published_numbers():
    """Case I, and Case II with t_f = 35 and 40 s; another body or time scales them."""
    for t_f in (30.0, 35.0, 40.0):
        law = from_tables({"controller": {"t_f": t_f}}).controller
        assert (law.eta, law.delta, law.k1, law.surface_rate, law.sign_width) == (3.0, 0.05, 1.0, 1.0, 1e-3)
    slow = from_tables({"controller": {"t_f": 60.0}})
    assert (slow.controller.delta, slow.controller.k1, slow.disturbance.frequency) == (0.1, 0.5, (0.05,) * 3)
    assert slow.disturbance.amplitude == (0.0025,) * 3
    heavy = from_tables({"spacecraft": {"inertia": [40.0, 48.0, 56.0]}})
    assert heavy.observer.gain == (40.0,) * 3
    assert heavy.controller.k1 == 1.0


def test_a_slew_of_ten_milliseconds_is_taken():
    """Its run ends 3.3 ms after t_f, not 10 s."""
    quick = from_tables({"controller": {"t_f": 0.01}, "loop": {"mode": "sampled"}})
    assert quick.loop.t_end == pytest.approx(0.04 / 3.0)
    assert quick.loop.window == pytest.approx(0.01 / 30.0)


def test_beyond_all_numbers_is_refused():
    with pytest.raises(ScenarioError, match=r"controller\.t_f"):
        from_tables({"controller": {"t_f": 1e300}})


def sampled(**tables: Any) -> Any:
    """Return a sampled scenario of a body of 50 kg m^2 that turns in 100 s."""
    base = {"spacecraft": {"inertia": [40.0, 50.0, 60.0]}, "controller": {"t_f": 100.0},
            "loop": {"mode": "sampled", "period": 0.25}, "disturbance": {"kind": "none"}}  # fmt: skip
    return from_tables({**base, **tables})


def test_dead_time_limits_the_bandwidth():
    """Without noise p T = 0.25, T of hold, delay and lag together."""
    for hardware, dead in (({}, 0.125), ({"delay": 2}, 0.625), ({"delay": 1, "torque_lag": 0.3}, 0.675)):
        said = sampled(hardware=hardware) if hardware else sampled()
        assert mission.dead_time(said) == pytest.approx(dead)
        assert mission.design(said).pole == pytest.approx(0.25 / dead)


def test_both_poles_of_the_design_keep_the_margins_that_it_promises():
    """In continuous time, with the dead time as e^(-sT), T = 1, and the observer of the rate l / J = r.

    L = (1 + r / s) (2 p s + p^2) e^(-sT) / s^2 + r e^(-sT) / s, since the estimate is r / s of the unexplained torque.
    """
    p, r = mission.STABLE, mission.OBSERVER * mission.STABLE
    w = np.geomspace(1e-3, 30.0, 200_001)
    s = 1j * w
    L = ((1 + r / s) * (2 * p * s + p**2) / s**2 + r / s) * np.exp(-s)
    crossover = np.argmin(np.abs(np.abs(L) - 1.0))
    assert np.rad2deg(np.angle(L[crossover])) + 180.0 == pytest.approx(35.6, abs=0.5)
    real = np.flatnonzero(np.diff(np.sign(L.imag)) != 0)
    down = -20.0 * np.log10(np.abs(L[real[L[real].real < 0.0]]))
    assert np.min(down[down > 0.0]) == pytest.approx(7.2, abs=0.3)


def test_noise_and_the_torque_limit_limit_the_bandwidth():
    """Five sigma of the torque noise, J (2 p + l / J) sigma_w with l = J p / 2, take half of the limit."""
    limit, sigma = 0.1, 1e-4
    said = sampled(hardware={"rate_noise": sigma, "torque_limit": limit})
    pole = mission.design(said).pole
    assert 60.0 * 2.5 * pole * sigma == pytest.approx(0.5 * limit / 5.0)


def test_late_modes_limit_the_bandwidth_and_early_ones_do_not():
    """A mode is late if its frequency times the dead time, 0.125 s, exceeds 60 deg."""
    modes = {"damping": [0.002], "coupling": [[0.0, 2.0, 0.0]]}
    early, late = (sampled(flexible={"frequency": [w], **modes}) for w in (4.0, 12.0))
    fraction = 4.0 / 50.0
    free = 12.0 / math.sqrt(1.0 - fraction)
    assert mission.design(early).pole == pytest.approx(2.0)
    assert mission.design(late).pole == pytest.approx(0.5 * 0.002 * free / (fraction / (1.0 - fraction)))


def test_a_weak_actuator_asks_for_a_smaller_eta():
    """From rest the first torque is 2 eta^2 J tan(angle / 2) / t_f^2; 2.4 is the least."""
    start = {"dispersion": {"attitude": {"kind": "axis_angle", "min_deg": 60.0, "max_deg": 60.0}}}
    needed = 2.0 * 60.0 * math.tan(math.radians(30.0)) / 100.0**2
    weak = sampled(**start, hardware={"torque_limit": 7.0 * needed})
    assert weak.controller.eta == pytest.approx(math.sqrt(0.9 * 7.0))
    assert sampled(**start, hardware={"torque_limit": 20.0 * needed}).controller.eta == 3.0
    assert sampled(**start, hardware={"torque_limit": needed}).controller.eta == pytest.approx(2.4)


def test_the_settling_angle_follows_small_slews_and_coarse_sensors():
    small = {"attitude": {"kind": "axis_angle", "min_deg": 0.1, "max_deg": 0.2}}
    assert sampled(dispersion=small).loop.settling_angle == pytest.approx(1e-3 * math.radians(0.2))
    assert sampled(hardware={"attitude_noise": 0.01, "rate_noise": 0.0}).loop.settling_angle == 0.05


def test_designs_are_starting_points_within_the_bounds_or_near():
    """Each has gains for the whole law, delta between a period and t_f."""
    said = replace(sampled(), tune={})
    designs = mission.designs(said)
    assert len(designs) > 5
    for design in designs:
        gains = said.controller.gains_of(design, said)
        assert said.loop.period <= gains["delta"] < said.controller.t_f
        assert all(value > 0.0 for value in gains.values())
