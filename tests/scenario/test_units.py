"""Defaults, bounds and designs scale with the mission: other units of time and inertia only rescale them."""

import copy
import re
import tomllib
from collections.abc import Mapping
from typing import Any

import numpy as np
import pytest

from ptsmc_jax.scenario import from_tables, keys, layouts, parsing
from ptsmc_jax.scenario.errors import ScenarioError
from ptsmc_jax.scenario.law_tables import LAWS
from ptsmc_jax.simulation import catalogues
from ptsmc_jax.units import to_number
from tests.tree import ROOT
from tuning.search import gains as gain_names
from tuning.studies import tuner

# powers of the units of inertia and of time in a unit
UNITS = {"kg": (1.0, 0.0), "N": (1.0, -2.0), "s": (0.0, 1.0), "Hz": (0.0, -1.0), "rad": (0.0, 0.0), "deg": (0.0, 0.0),
         "m": (0.0, 0.0), "1": (0.0, 0.0), "-": (0.0, 0.0), "dB": (0.0, 0.0)}  # fmt: skip


def powers(unit: str) -> tuple[float, float]:
    """Return the powers of inertia and time in a unit such as "rad/s/sqrt(Hz)"; lengths are part of the inertia.

    >>> powers("N m s"), powers("rad/s/sqrt(Hz)"), powers("sqrt(kg) m"), powers("1/s^2")
    ((1.0, -1.0), (0.0, -0.5), (0.5, 0.0), (0.0, -2.0))
    """
    total = np.zeros(2)
    for sign, part in re.findall(r"(^|/)([^/]+)", unit):
        for root, name, power in re.findall(r"(sqrt\()?([A-Za-z]+|1|-)\)?(?:\^(\d))?", part):
            weight = (0.5 if root else 1.0) * float(power or 1) * (-1.0 if sign else 1.0)
            total += weight * np.asarray(UNITS[name])
    return float(total[0]), float(total[1])


def in_units(tables: Mapping[str, Any], inertia: float, time: float) -> dict[str, Any]:
    """Return the tables of a scenario with every number in other units, according to the declared units of keys.

    inertia, time: factors on numbers with these units.
    """
    plant = tables.get("plant", {}).get("kind", "spacecraft")
    layout: Mapping[str, Any] = layouts.TABLES[plant]
    scaled = copy.deepcopy(dict(tables))

    def times(value: Any, unit: str) -> Any:
        if isinstance(value, list | tuple):
            return [times(one, unit) for one in value]
        if isinstance(value, str):
            value = to_number(value, unit)
        mass, second = powers(unit)
        return value * inertia**mass * time**second

    def of(table: dict[str, Any], struct: Any) -> None:
        for key in keys.list_keys(struct, catalogues.CATALOGUE["peak_torque"].unit):
            if key.name in table and key.unit and not isinstance(table[key.name], dict):
                table[key.name] = times(table[key.name], key.unit)

    for name, table in scaled.items():
        kinds = layout.get(name)
        if name == "requirements":
            entries = {**catalogues.CATALOGUE, **catalogues.MARGINS}
            units = {metric: entry.unit for metric, entry in entries.items()}
            for metric, value in table.items():
                if isinstance(value, dict):
                    value["limit"] = times(value["limit"], units[metric])
                else:
                    table[metric] = times(value, units[metric])
        elif name == "tune":
            units = gain_names.units(plant)
            for gain, interval in table.get("bounds", {}).items():
                table["bounds"][gain] = times(interval, units[gain].replace("1/s^(2-p)", "-").replace("1/s^p", "-"))
        elif name == "dispersion":
            for key, one in table.items():
                of(one, layouts.DISPERSIONS[key][one["kind"]])
        elif name == "disturbance" and table.get("kind") == "sum":
            for term in table["terms"]:
                of(term, layout["disturbance"][term["kind"]])
        elif kinds is not None:
            of(table, kinds[table.get("kind", next(iter(kinds)))] if isinstance(kinds, Mapping) else kinds)
    return scaled


SATELLITES = {
    path.stem: tomllib.loads(path.read_text()) for path in sorted((ROOT / "benchmarks" / "satellites").glob("*.toml"))
}
BODY = {"inertia": [10.0, 20.0, 30.0]}
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
               "dispersion": {"star_tracker_outage": {"kind": "uniform"}}},
    "proportional-derivative law": {**SAMPLED, "controller": {"kind": "pd"}},
    "super-twisting law": {**SAMPLED, "controller": {"kind": "super_twisting"}},
}  # fmt: skip


def flat(tables: Any, path: str = "") -> dict[str, Any]:
    """Return the values of nested tables by their path, such as ".loop.period" or ".initial.rate[0]"."""
    if isinstance(tables, Mapping):
        return {k: v for key, one in tables.items() for k, v in flat(one, f"{path}.{key}").items()}
    if isinstance(tables, list | tuple):
        return {k: v for n, one in enumerate(tables) for k, v in flat(one, f"{path}[{n}]").items()}
    return {path: tables}


CASES = {
    f"{name}, units of {units}": (raw, units)
    for name, raw in SATELLITES.items()
    for units in ((4.0, 1.0), (1.0, 0.25), (0.0625, 16.0))
} | {
    name: ({**tables, "spacecraft": BODY, "controller": {**tables.get("controller", {}), "t_f": 50.0}}, (0.0625, 16.0))
    for name, tables in MISSIONS.items()
}


@pytest.mark.parametrize(("raw", "units"), CASES.values(), ids=CASES)
def test_other_units_rescale_every_default_and_every_bound(raw, units):
    """Square roots of powers of 4 are exact, so values agree except for rounding in other powers."""
    raw = {**raw, "tune": {}}
    here = parsing.dump(from_tables(raw))
    there = parsing.dump(from_tables(in_units(raw, *units)))
    expected, found = flat(in_units(here, *units)), flat(there)
    assert expected.keys() == found.keys()
    for key, value in expected.items():
        assert found[key] == (pytest.approx(value, rel=1e-12) if isinstance(value, float) else value), key


@pytest.mark.parametrize("law", [law for law in LAWS["spacecraft"] if law != "custom"])
def test_gains_of_every_law_scale_with_the_mission(law):
    raw = SATELLITES["uosat12"]
    raw = {**raw, "controller": {"kind": law, "t_f": raw["controller"]["t_f"]}, "tune": {}}
    here, there = (from_tables(tables) for tables in (raw, in_units(raw, 4.0, 16.0)))
    units = gain_names.units_of(here, here.gains)
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


def test_a_slew_of_ten_milliseconds_is_accepted():
    """The default time from t_f to the end is t_f / 3: 3.3 ms here, and 10 s for t_f = 30 s."""
    quick = from_tables({"controller": {"t_f": 0.01}, "loop": {"mode": "sampled"}})
    assert quick.loop.t_end == pytest.approx(0.04 / 3.0)
    assert quick.loop.window == pytest.approx(0.01 / 30.0)


def test_a_t_f_whose_default_times_overflow_is_refused():
    with pytest.raises(ScenarioError, match=r"controller\.t_f"):
        from_tables({"controller": {"t_f": 1e300}})


def test_every_gain_has_a_unit_with_a_list_of_sensors_too():
    raw = {key: value for key, value in SATELLITES["sixu"].items() if key not in ("hardware", "filter")}
    star = {"kind": "star_tracker", "boresight": [0.0, 0.0, 1.0], "noise_across": 3e-5, "noise_about": 2e-4}
    gyro = {"kind": "gyro", "rate_noise_density": 1e-5, "rate_bias_walk": 1e-7}
    here = from_tables({**raw, "sensors": [star, gyro]})
    assert set(gain_names.units_of(here, here.gains)) == set(here.gains)


def small_search_of(name: str, *, margins: bool) -> dict[str, Any]:
    """Return the tables of a satellite with a small search. Requirements on margins take long to compile."""
    raw = SATELLITES[name]
    kept = {key: value for key, value in raw["requirements"].items() if margins or key not in catalogues.MARGINS}
    return {**raw, "requirements": kept, "tune": {"trials": 8, "starts": 3, "steps": 8}}


@pytest.mark.long  # compilation takes minutes; the tests above check defaults and bounds
@pytest.mark.parametrize(("name", "margins"), [("cubetas", False), ("sixu", False), ("microsat", True)])
def test_other_units_rescale_the_tuned_gains_and_change_nothing_else(name, margins):
    """Gains are reported with 10 digits and agree to 1e-9. Single trials amplify this rounding."""
    tables, inertia, time = small_search_of(name, margins=margins), 4.0, 16.0
    here, there = (
        tuner.tune(from_tables(one), 0, with_checks=False) for one in (tables, in_units(tables, inertia, time))
    )
    units = gain_names.units_of(here.tuned, here.gains)
    for gain, value in here.gains.items():
        mass, second = powers(units[gain_names.base(gain)])
        assert there.gains[gain] == pytest.approx(value * inertia**mass * time**second, rel=1e-9), gain
    assert there.rollouts == here.rollouts
    assert there.gradients == here.gradients
    assert there.search.value == pytest.approx(here.search.value, rel=1e-9)
    for metric in ("window_error", "terminal_angle", "saturated"):
        one, other = (np.asarray(getattr(run.held_out["tuned"].metrics, metric)) for run in (here, there))
        np.testing.assert_allclose(other, one, rtol=1e-7)
    torque = inertia * time**-2.0
    one, other = (np.asarray(run.held_out["tuned"].metrics.peak_torque) for run in (here, there))
    np.testing.assert_allclose(other, torque * one, rtol=1e-7)
    np.testing.assert_array_equal(here.held_out["tuned"].status, there.held_out["tuned"].status)
