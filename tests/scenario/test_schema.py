import copy
import math
import pickle
import re
from collections.abc import Mapping

import pytest

from ptsmc_jax.scenario import errors, from_tables, layouts, parsing
from ptsmc_jax.scenario.attitude_keys import Attitude
from ptsmc_jax.scenario.custom import Custom
from ptsmc_jax.scenario.device_tables import AxesWheels, PyramidWheels
from ptsmc_jax.scenario.disturbance_tables import GravityTable, SumDisturbance
from ptsmc_jax.scenario.errors import ScenarioError
from ptsmc_jax.scenario.state_scenario import ChainPlant
from ptsmc_jax.scenario.tables import Limit, Scenario
from ptsmc_jax.scenario.values import Table
from ptsmc_jax.simulation.catalogues import CATALOGUE, STATE_CATALOGUE
from tests.helpers import ROOT

# design.md, "A scenario file": the published Case I, and the defaults of [tune]
DEFAULTS = {
    "plant": {"kind": "spacecraft"},
    "spacecraft": {"inertia": [10.0, 12.0, 14.0]},
    "initial": {
        "quat_xyzw": [0.4714045207910317, -0.3333333333333333, 0.5773502691896258, 0.5773502691896258],
        "rate": [0.0, 0.0, 0.0],
    },
    "reference": {"kind": "fixed", "quat_xyzw": [0.0, 0.0, 0.0, 1.0]},
    "disturbance": {
        "kind": "sinusoid",
        "amplitude": [0.01, 0.01, 0.01],
        "frequency": [0.1, 0.1, 0.1],
        "phase": [0.0, 0.0, 0.0],
        "bias": [0.0, 0.0, 0.0],
    },
    "controller": {
        "kind": "prescribed_time",
        "error": "additive",
        "t_f": 30.0,
        "eta": 3.0,
        "delta": 0.05,
        "k1": 1.0,
        "sign_width": 1e-3,
        "layer_time": 1.0,
        "surface_rate": 1.0,
        "sampling": "explicit",
        "disturbance_rate_bound": 1e-3,
        "disturbance_bound": 0.01,
        "initial_estimate_error": 0.0,
    },
    "observer": {"kind": "nonlinear", "gain": [10.0, 10.0, 10.0]},
    "loop": {
        "mode": "continuous",
        "period": 0.05,
        "clock": "anchored",
        "t_end": 40.0,
        "window": 1.0,
        "settling_angle": 1e-3,
    },
}
# Fig. 2 of the paper
CHAIN_DEFAULTS = {
    "plant": {"kind": "chain", "order": 3, "x0": [5.0, 3.0, 2.0]},
    "disturbance": {"kind": "sinusoid", "amplitude": [0.01], "frequency": [1.0], "phase": [0.0], "bias": [0.0]},
    "controller": {
        "kind": "prescribed_time",
        "t_f": 5.0,
        "eta": 4.0,
        "delta": 0.05,
        "k1": 1.0,
        "a": [1.0, 2.0],
        "sign_width": 1e-3,
        "layer_time": 1.0,
        "surface_rate": 1.0,
        "sampling": "explicit",
        "disturbance_rate_bound": 0.01,
        "disturbance_bound": 0.01,
        "initial_estimate_error": 0.0,
    },
    "observer": {"kind": "none"},
    "loop": {**DEFAULTS["loop"], "t_end": 15.0},
}
TUNE_DEFAULTS = {
    "free": ["eta", "delta", "observer_gain"],
    # delta: t_f / 600 to t_f / 4; observer_gain: 1.5 J / t_f to 600 times this value
    "bounds": {"eta": [2.05, 8.0], "delta": [0.05, 7.5], "observer_gain": [0.6, 360.0]},
    "per_axis": False,
    "minimise": "window_error",
    "statistic": "rms",
    "torque_weight": 0.0,
    "worst_case": False,
    "trials": 256,
    "starts": 12,
    "steps": 40,
}

ATTITUDES = [
    {"quat_xyzw": [0.0, 0.0, 0.0, 1.0]},
    {"quat_wxyz": [1.0, 0.0, 0.0, 0.0]},
    {"rotvec_deg": [10.0, 20.0, 30.0]},
    {"mrp": [0.1, 0.2, 0.3]},
    {"dcm_body_to_inertial": [[1.0, 0.0, 0.0], [0.0, 1.0, 0.0], [0.0, 0.0, 1.0]]},
    {"euler_deg": [10.0, 20.0, 30.0], "sequence": "ZYX"},
]
DRAWN_ATTITUDES = {"axis_angle": {"min_deg": 20.0, "max_deg": 140.0}, "normal": {"std_deg": 3.0}, "uniform": {}}
BASELINE = {"t_f": 30.0, "disturbance_rate_bound": 1e-3, "disturbance_bound": 0.01, "initial_estimate_error": 0.0}
BASELINES = {
    "pd": {"k_p": 0.2, "k_d": 0.6},
    "terminal": {"p": 1.3, "b": 0.1, "k": 0.1, "sign_width": 1e-3},
    "fixed_time": {
        "a1": 0.1, "b1": 0.2, "a2": 1.0, "b2": 1.0, "p": 1.25, "gamma": 2.0, "m": 1.5, "n": 0.5, "sign_width": 1e-3,
    },
    "time_base_pd": {"k_p": 1.0, "k_d": 2.0},
    "time_base_sliding": {"surface_rate": 1.0, "k": 1.0, "sign_width": 1e-3},
    "scaling": {"delta": 2.0, "m": 1.0, "k1": 1.0, "k": 1e-3},
    "predefined_time": {"share": 0.6, "q1": 0.3, "q2": 0.3, "sign_width": 1e-2},
    "super_twisting": {"surface_rate": 0.4, "lipschitz": 0.01, "sign_width": 1e-3},
}  # fmt: skip
# every key of every table, one table at a time, so that a scenario contains only one error
ARM = str(ROOT / "scenarios" / "two_link_arm.py") + ":arm"
SYSTEM_CONTROLLER = {key: value for key, value in CHAIN_DEFAULTS["controller"].items() if key != "a"}
COMPLETE = [
    *({name: table} for name, table in DEFAULTS.items()),
    *({"initial": {**attitude, "rate": [0.0, 0.0, 0.1]}} for attitude in ATTITUDES),
    *({"reference": {"kind": "fixed", **attitude}} for attitude in ATTITUDES),
    *({"reference": {"kind": "spin", **attitude, "rate": [0.0, 0.0, 0.01]}} for attitude in ATTITUDES),
    *(
        {"reference": {**moving, **attitude}}
        for attitude in ATTITUDES
        for moving in (
            {"kind": "sinusoid", "amplitude": [0.1] * 3, "frequency": [0.2] * 3, "phase": [0.3] * 3},
            {"kind": "slew", "to_quat_xyzw": [0.6, 0.0, 0.0, 0.8], "duration": 20.0, "way": "short"},
        )
    ),
    {"spacecraft": {"inertia": [[10.0, 1.0, 0.0], [1.0, 12.0, 0.5], [0.0, 0.5, 14.0]]}},
    {"disturbance": {"kind": "constant", "amplitude": [0.01, 0.01, 0.01]}},
    {"disturbance": {"kind": "none"}},
    {
        "hardware": {
            "command_filter": {"kind": "second_order", "corner": 2.0, "damping": 0.7},
            "torque_limit": 0.5,
            "torque_rate_limit": 5.0,
            "torque_lag": 0.1,
            "torque_step": 1e-4,
            "delay": 1,
            "attitude_noise": 2e-5,
            "rate_noise": 1e-6,
            "rate_bias": 1e-6,
            "rate_bias_walk": 1e-8,
            "star_tracker_every": 4,
        }
    },
    {"hardware": {"rate_noise_density": 1e-7}},
    {"hardware": {"attitude_noise": 2e-5, "rate_noise": 1e-6, "star_tracker_period": 0.25}, "filter": {}},
    {"hardware": {"command_filter": {"kind": "first_order", "corner": 2.0}}},
    {"hardware": {"command_filter": {"kind": "notch", "corner": 2.0, "damping": 0.3}}},
    {"spacecraft": {"true_inertia": [10.0, 12.0, 14.0]}},
    {"flexible": {"frequency": [6.0, 9.0], "damping": [0.005, 0.0], "coupling": [[0.8, 0.0, 0.1], [0.0, 0.5, 0.0]]}},
    {"wheels": {"kind": "pyramid", "cant_deg": 30.0, "torque_limit": 0.2, "momentum_limit": 4.0}},
    {"wheels": {"kind": "axes", "momentum": [0.1, 0.2, 0.3]}},
    {"pointing": {"boresight": [0.0, 0.6, 0.8], "window": 1.0, "after": 2.0}},
    {
        "pointing": {},
        "hardware": {"attitude_noise": 1e-5},
        "requirements": {
            "ake_boresight": {"limit": 1e-4, "probability": 0.9973, "confidence": 0.9, "interpretation": "mixed"},
        },
    },
    {"filter": {"kind": "none"}},
    {"filter": {"kind": "steady_state", "bandwidth": 0.1}},
    {"disturbance": {"kind": "gravity_gradient", "orbit_rate": 1e-3, "phase": 0.1, "mrp": [0.0, 0.0, 0.1]}},
    {"disturbance": {"kind": "random_walk", "density": [1e-4, 1e-4, 1e-4]}},
    *({"dispersion": {"attitude": {"kind": kind, **keys}}} for kind, keys in DRAWN_ATTITUDES.items()),
    {"dispersion": {"rate": {"kind": "normal", "std": 0.01}}},
    {"dispersion": {"inertia": {"kind": "relative_normal", "std": 0.05, "axes_deg": 2.0}}},
    {"dispersion": {"rate": {"kind": "uniform", "half_width": 0.01}}},
    {"dispersion": {"disturbance_phase": {"kind": "uniform"}}},
    {
        "dispersion": {
            "disturbance_amplitude": {"kind": "relative_normal", "std": 0.1},
            "disturbance_bias": {"kind": "normal", "std": 1e-3},
        }
    },
    {
        "dispersion": {
            "disturbance_amplitude": {"kind": "relative_uniform", "half_width": 0.1},
            "disturbance_bias": {"kind": "uniform", "half_width": 1e-3},
        }
    },
    *({"dispersion": {"reference": {"kind": kind, **keys}}} for kind, keys in DRAWN_ATTITUDES.items()),
    {
        "hardware": {"attitude_noise": 1e-5, "rate_noise": 1e-6, "torque_limit": 0.5},
        "dispersion": {
            "attitude_noise": {"kind": "relative_normal", "std": 0.1},
            "rate_noise": {"kind": "relative_uniform", "half_width": 0.1},
            "torque_limit": {"kind": "relative_normal", "std": 0.1},
        },
    },
    {
        "loop": {"mode": "sampled"},
        "flexible": {},
        "hardware": {"attitude_noise": 1e-5, "rate_noise": 1e-6},
        "wheels": {"kind": "pyramid"},
        "filter": {"kind": "steady_state"},
        "dispersion": {
            "actuator_scale": {"kind": "relative_normal", "std": 0.1},
            "actuator_misalignment": {"kind": "normal", "std_deg": 0.1},
            "star_tracker_misalignment": {"kind": "uniform", "half_width_deg": 0.1},
            "gyro_scale": {"kind": "relative_uniform", "half_width": 0.1},
            "mode_frequency": {"kind": "relative_normal", "std": 0.1},
            "mode_coupling": {"kind": "relative_uniform", "half_width": 0.1},
            "star_tracker_outage": {"kind": "uniform", "duration": 5.0, "earliest": 1.0, "latest": 20.0},
            "wheel_failure": {"kind": "uniform", "earliest": 1.0, "latest": 20.0, "known": True},
            "timing_jitter": {"kind": "uniform", "largest": 0.1, "smallest": 0.01},
        },
    },
    {"requirements": dict.fromkeys(CATALOGUE, 0.5)},
    {"requirements": {"window_error": {"limit": 1e-4, "quantile": 0.9973, "confidence": 0.9}}},
    {"tune": {**TUNE_DEFAULTS, "statistic": "cvar", "level": 0.9}},
    *({"controller": {"kind": kind, **gains, **BASELINE}} for kind, gains in BASELINES.items()),
    {"observer": {"kind": "none"}},
    {"observer": {"kind": "finite_time", "gain": [0.1, 0.1, 0.1], "sign_width": 1e-5}},
    {"observer": {"kind": "prescribed_time", "gain": [1.0, 1.0, 1.0], "mu": 3.0, "t_o": 6.0, "delta_o": 0.1}},
    *(
        {"plant": {"kind": "chain", "order": 3, "x0": [5.0, 3.0, 2.0]}, **tables}
        for tables in (
            CHAIN_DEFAULTS,
            {"controller": {"kind": "pd", **BASELINES["pd"], **BASELINE}},
            {"disturbance": {"kind": "constant", "amplitude": [0.01]}},
            {"disturbance": {"kind": "random_walk", "density": [1e-4]}},
            {"observer": {"kind": "nonlinear", "gain": [10.0]}},
            {"observer": {"kind": "finite_time", "gain": [0.1], "sign_width": 1e-5}},
            {"observer": {"kind": "prescribed_time", "gain": [1.0], "mu": 3.0, "t_o": 6.0, "delta_o": 0.1}},
            {"hardware": {"state_noise": [1e-5, 1e-5, 0.0], "delay": 1, "torque_limit": 0.5, "torque_lag": 0.1}},
            {
                "hardware": {
                    "torque_rate_limit": 5.0,
                    "torque_step": 1e-4,
                    "command_filter": {"kind": "first_order", "corner": 2.0},
                }
            },
            {"dispersion": {"x0": {"kind": "uniform", "half_width": [1.0, 0.5, 0.0]}}},
            {"dispersion": {"x0": {"kind": "normal", "std": [1.0, 0.5, 0.0]}}},
            {"dispersion": {"disturbance_phase": {"kind": "uniform"}}},
            {"dispersion": {"disturbance_amplitude": {"kind": "relative_normal", "std": 0.1}}},
            {"dispersion": {"disturbance_bias": {"kind": "normal", "std": 1e-3}}},
            {
                "hardware": {"state_noise": [1e-5, 1e-5, 0.0], "torque_limit": 0.5},
                "dispersion": {
                    "state_noise": {"kind": "relative_normal", "std": 0.1},
                    "torque_limit": {"kind": "relative_uniform", "half_width": 0.1},
                    "timing_jitter": {"kind": "uniform", "largest": 0.1, "smallest": 0.01},
                },
            },
            {"requirements": dict.fromkeys(STATE_CATALOGUE, 0.5)},
        )
    ),
    {
        "plant": {"kind": "system", "system": ARM, "truth": ARM, "x0": [0.4, -0.3, 0.0, 0.0]},
        "controller": SYSTEM_CONTROLLER,
    },
]


def leaves(tables, path=()):
    if isinstance(tables, dict | list):
        for key, value in tables.items() if isinstance(tables, dict) else enumerate(tables):
            yield from leaves(value, (*path, key))
    else:
        yield path, tables


def value_at(tables, path):
    for key in path:
        tables = tables[key]
    return tables


def changed(tables, path, value):
    """Return the tables with a new value at a path."""
    tables = copy.deepcopy(tables)
    value_at(tables, path[:-1])[path[-1]] = value
    return tables


def key_of(path):
    """Return the key that an error names. For bounds it is the key of the interval."""
    key = ".".join(part for part in path if isinstance(part, str))
    return "tune.bounds" if key.startswith("tune.bounds") else key


def at_each(wanted):
    return [
        pytest.param(tables, path, id=".".join(map(str, path)))
        for tables in COMPLETE
        for path, value in leaves(tables)
        if wanted(path, value)
    ]


def refusal(tables):
    try:
        from_tables(tables)
    except ScenarioError as error:
        return str(error)
    pytest.fail(f"accepted: {tables}")


each_number = pytest.mark.parametrize(("tables", "path"), at_each(lambda _, value: type(value) in (int, float)))
each_key = pytest.mark.parametrize(("tables", "path"), at_each(lambda path, _: isinstance(path[-1], str)))
each_list = pytest.mark.parametrize(
    ("tables", "path"), at_each(lambda path, _: path[-1] == 0 and not {"inertia", "true_inertia", "free"} & set(path))
)


def test_defaults_are_the_published_case_one():
    assert parsing.dump(from_tables({})) == DEFAULTS
    tune = parsing.dump(from_tables({"tune": {}}))["tune"]
    for name, bounds in TUNE_DEFAULTS["bounds"].items():
        assert tune["bounds"].pop(name) == pytest.approx(bounds, rel=1e-12)  # rounding
    assert tune == {**TUNE_DEFAULTS, "bounds": {}}


def test_defaults_of_a_chain_are_the_published_figures_one_and_two():
    assert parsing.dump(from_tables({"plant": {"kind": "chain", "order": 3}})) == CHAIN_DEFAULTS
    second = from_tables({"plant": {"kind": "chain"}})
    assert (second.plant, second.controller.eta) == (ChainPlant(order=2, x0=(5.0, 3.0)), 3.0)
    fourth = parsing.dump(from_tables({"plant": {"kind": "chain", "x0": [1, 0, 0, 0]}, "tune": {}}))
    assert (fourth["plant"]["order"], fourth["controller"]["eta"], fourth["controller"]["a"]) == (4, 5.0, [1, 3, 3])
    assert fourth["tune"]["free"] == ["eta", "delta"]  # no observer, no gain
    assert fourth["tune"]["bounds"] == {"eta": [4.05, 10.0], "delta": [5.0 / 600.0, 5.0 / 4.0]}


def test_optional_tables_are_off_by_default():
    scenario = parsing.parse({})
    assert scenario.hardware is scenario.dispersion is scenario.tune is None
    assert scenario.requirements == {}


def every_kind():
    """Return all tables by kind, except custom parts (see test_own_kinds) and sums of disturbances."""
    tables = [kinds for layout in layouts.TABLES.values() for kinds in layout.values()]
    tables += [*layouts.DISPERSIONS.values(), *layouts.KINDS.values(), Limit]
    found = {one for kinds in tables for one in (kinds.values() if isinstance(kinds, Mapping) else [kinds])}
    return {one for one in found if not issubclass(one, Custom | SumDisturbance)}


def test_the_tables_of_these_tests_contain_every_key():
    named = {struct: set() for struct in every_kind()}

    def visit(parsed, raw):
        if isinstance(raw, dict):
            if isinstance(parsed, Table) and not isinstance(parsed, Scenario):
                named[type(parsed)] |= set(raw)
            for key, value in raw.items():
                visit(getattr(parsed, key) if isinstance(parsed, Table) else parsed[key], value)

    for tables in COMPLETE:
        visit(parsing.parse(tables), tables)
    named[AxesWheels].add("axes")  # a list of rows, which is tested elsewhere
    for wheels in (PyramidWheels, AxesWheels):
        named[wheels] |= {"momentum", "torque_limit", "momentum_limit"}
    for struct, keys in named.items():
        if issubclass(struct, GravityTable):
            keys |= set(Attitude.__struct_fields__)  # as in [initial]
        if "custom" in struct.__struct_fields__:
            keys.add("custom")  # see test_custom_devices
    assert named == {struct: set(struct.__struct_fields__) for struct in named}


@each_number
def test_nan_and_infinite_numbers_are_refused(tables, path):
    for bad in (math.nan, math.inf, -math.inf):
        said = refusal(changed(tables, path, bad))
        assert said.startswith(f"{key_of(path)} is ")
        assert f"{bad} is no finite number" in said


@each_number
def test_other_types_are_refused_as_numbers(tables, path):
    for bad, shown in ((True, "true"), ("1.0", '"1.0"'), ([1.0], "[1.0]"), ({}, "{")):
        said = refusal(changed(tables, path, bad))
        assert said.startswith(f"{key_of(path)} is ")
        assert shown in said
        # NumPy converts booleans and strings to numbers; the error must name the wrong type
        assert re.search("number|angle|three principal moments", said)


@each_list
def test_lists_of_wrong_length_are_refused(tables, path):
    right = value_at(tables, path[:-1])
    for wrong in ([], right[:-1], [*right, 0.0]):
        said = refusal(changed(tables, path[:-1], wrong))
        assert said.startswith(f"{key_of(path)} is ")
        assert errors.show(wrong) in said
        assert re.search("must be .*((one|two|three|four) |a list of )", said)


NAMES = [name for name in Scenario.__struct_fields__ if name != "defaulted"]


@pytest.mark.parametrize("name", NAMES)
def test_misspelt_table_names_the_nearest(name):
    misspelt = name.replace(name[2], "", 1)
    assert refusal({misspelt: {}}) == f"[{misspelt}] is not a known table; the nearest known one is [{name}]"


@each_key
def test_misspelt_key_names_the_nearest(tables, path):
    *table, key = path
    said = refusal(changed(tables, [*table, f"{key}_"], 1.0))
    assert said.startswith(f"{'.'.join(table)}.{key}_ is not a known ")
    assert said.endswith(f"the nearest known one is {'.'.join(path)}") or (
        table[0] == "requirements" and said.endswith(f"the nearest known one is {key}")
    )


@pytest.mark.parametrize("name", NAMES)
def test_a_value_instead_of_a_table_is_refused(name):
    assert refusal({name: 3}) == f"{name} is 3, but must be a table"


@pytest.mark.parametrize(
    ("value", "shown"),
    [
        (True, "true"),
        (3, "3"),
        (1e-3, "0.001"),
        ("ZYX", '"ZYX"'),
        ('a"b\nc', r'"a\"b\nc"'),
        ((1.0, [2, "x"]), '[1.0, [2, "x"]]'),
        ({"kind": "normal", "std": 0.1}, '{ kind = "normal", std = 0.1 }'),
    ],
)
def test_values_are_shown_as_a_scenario_file_would_write_them(value, shown):
    assert errors.show(value) == shown


def test_dump_omits_none_and_keeps_zero():
    dumped = parsing.dump(from_tables({"hardware": {"rate_noise": 0.0}, "loop": {"mode": "sampled"}}))
    assert dumped["hardware"] == {"rate_noise": 0.0}
    assert {"requirements", "tune", "dispersion"}.isdisjoint(dumped)


@pytest.mark.parametrize(
    ("content", "said"),
    [
        (b"[controller\neta = 3.0", "is no valid TOML"),
        (b"[controller]\neta = 3.0\neta = 4.0", "is no valid TOML"),
        (b"\x00", "is no valid TOML"),
        (b"\xff\xfe", "is no text in UTF-8"),
        (b"x = " + 5000 * b"9", ""),  # more digits than Python converts to a number
        (None, "is a folder"),
    ],
    ids=["unclosed", "twice", "null", "binary", "digits", "directory"],
)
def test_a_file_that_cannot_be_read_is_named(tmp_path, content, said):
    path = tmp_path / "some.toml"
    path.mkdir() if content is None else path.write_bytes(content)
    with pytest.raises(ScenarioError) as caught:
        parsing.load(path)
    assert f"the scenario file {path} {said}" in str(caught.value)


def test_a_file_that_is_not_there_is_named(tmp_path):
    with pytest.raises(ScenarioError) as caught:
        parsing.load(tmp_path / "none.toml")
    assert str(caught.value) == f"the scenario file {tmp_path / 'none.toml'} is not there"


def test_every_kind_of_a_table_can_be_pickled():
    for tables in COMPLETE:
        parsed = parsing.parse(tables)
        assert pickle.loads(pickle.dumps(parsed)) == parsed, tables
