import copy
import math
import pickle
import re
import tomllib
from typing import Any

import jsonschema
import pytest

from ptsmc_jax.scenario import errors, from_tables, parsing
from ptsmc_jax.scenario.errors import ScenarioError
from ptsmc_jax.scenario.json_schema import json_schema
from ptsmc_jax.scenario.state_scenario import ChainPlant
from ptsmc_jax.scenario.tables import Scenario
from ptsmc_jax.simulation.catalogues import CATALOGUE
from tests.helpers import ROOT, refuses
from tests.scenario.every_key import complete

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
        **{key: value for key, value in DEFAULTS["controller"].items() if key != "error"},
        **{"t_f": 5.0, "eta": 4.0, "a": [1.0, 2.0], "disturbance_rate_bound": 0.01},
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

# what `ptsmc new` does not write, or what excludes other keys
NOISY = {"attitude_noise": 2e-5, "rate_noise": 1e-6}
SAMPLED = {"mode": "sampled"}
ARM = str(ROOT / "scenarios" / "two_link_arm.py") + ":arm"
OTHERS: list[tuple[str, dict[str, Any]]] = [
    *((name, {name: table}) for name, table in DEFAULTS.items()),
    *((name, {"plant": CHAIN_DEFAULTS["plant"], name: table}) for name, table in CHAIN_DEFAULTS.items()),
    ("spacecraft", {"spacecraft": {"inertia": [[10.0, 1.0, 0.0], [1.0, 12.0, 0.5], [0.0, 0.5, 14.0]]}}),
    ("hardware", {"loop": SAMPLED, "hardware": {"rate_noise_density": 1e-7}}),
    ("hardware", {"loop": SAMPLED, "hardware": {**NOISY, "star_tracker_period": 0.25}, "filter": {}}),
    ("hardware", {"loop": SAMPLED, "hardware": {**NOISY, "star_tracker_every": 4}, "filter": {}}),
    (
        "requirements",
        {
            "loop": SAMPLED, "pointing": {}, "hardware": {"attitude_noise": 1e-5},
            "requirements": {
                "ake_boresight": {"limit": 1e-4, "probability": 0.9973, "confidence": 0.9, "interpretation": "mixed"},
            },
        },
    ),
    ("requirements", {"requirements": dict.fromkeys(CATALOGUE, 0.5)}),
    ("plant", {"plant": {"kind": "system", "system": ARM, "truth": ARM, "x0": [0.4, -0.3, 0.0, 0.0]}}),
]  # fmt: skip
# scenarios with every key of every kind, and the name of the table whose keys they contain
COMPLETE = [*complete("spacecraft"), *complete("chain"), *OTHERS]
BUILT_IN = [(name, tables) for name, tables in COMPLETE if "code" not in str(tables[name])]


def leaves(tables, path=()):
    """Yield the path, a tuple of keys and indices, and the value of every number and text in nested tables."""
    if isinstance(tables, dict | list):
        for key, value in tables.items() if isinstance(tables, dict) else enumerate(tables):
            yield from leaves(value, (*path, key))
    else:
        yield path, tables


def value_at(tables, path):
    """Return the value at a path in nested tables; path: keys and indices."""
    for key in path:
        tables = tables[key]
    return tables


def changed(tables, path, value):
    """Return a copy of the tables with a new value at a path of keys and indices."""
    tables = copy.deepcopy(tables)
    value_at(tables, path[:-1])[path[-1]] = value
    return tables


def key_of(path):
    """Return the key that an error about the value at this path names. For any bound of a gain, it is `tune.bounds`."""
    key = ".".join(part for part in path if isinstance(part, str))
    return "tune.bounds" if key.startswith("tune.bounds") else key


def at_each(wanted, scenarios=BUILT_IN):
    """Return (tables, path) of each scenario, for each value of a table with a true `wanted(path, value)`.

    scenarios: pairs of the name of a table and the tables of a scenario.
    """
    return [
        (tables, (name, *path))
        for name, tables in scenarios
        for path, value in leaves(tables[name])
        if wanted((name, *path), value)
    ]


def refusal(tables):
    """Return the error message of an invalid scenario; the test fails if it is accepted."""
    try:
        from_tables(tables)
    except ScenarioError as error:
        return str(error)
    pytest.fail(f"accepted: {tables}")


NUMBERS = at_each(lambda _, value: type(value) in (int, float), COMPLETE)


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
    assert fourth["tune"]["bounds"]["eta"] == [4.05, 10.0]
    assert fourth["tune"]["bounds"]["delta"] == pytest.approx([5.0 / 600.0, 5.0 / 4.0], rel=1e-14)


def test_optional_tables_are_off_by_default():
    scenario = parsing.parse({})
    assert scenario.hardware is scenario.dispersion is scenario.tune is None
    assert scenario.requirements == {}


FINITE = [(bad, f"{bad} is no finite number") for bad in (math.nan, math.inf, -math.inf)]


@pytest.mark.parametrize(("bad", "shown"), [*FINITE, (True, "true"), ("1.0", '"1.0"'), ([1.0], "[1.0]"), ({}, "{")])
def test_every_number_of_a_scenario_must_be_finite_and_of_the_right_type(bad, shown):
    for tables, path in NUMBERS:
        said = refusal(changed(tables, path, bad))
        assert said.startswith(f"{key_of(path)} is ")
        assert shown in said
        # NumPy converts booleans and strings to numbers; the error must name the wrong type
        assert re.search("number|angle|three principal moments", said)


def test_lists_of_wrong_length_are_refused():
    of_any_length = {"inertia", "true_inertia", "free", "wheel_speed", "wheel_torque", "state", "input"}
    for tables, path in at_each(lambda path, _: path[-1] == 0 and not of_any_length & set(path)):
        right = value_at(tables, path[:-1])
        for wrong in ([], right[:-1], [*right, 0.0]):
            said = refusal(changed(tables, path[:-1], wrong))
            assert said.startswith(f"{key_of(path)} is ")
            assert errors.show(wrong) in said
            assert re.search("must be .*((one|two|three|four) |a list of )", said)


NAMES = [name for name in Scenario.__struct_fields__ if name != "defaulted"]


@pytest.mark.parametrize("name", NAMES)
def test_error_for_a_misspelt_table_names_the_nearest_table(name):
    misspelt = name.replace(name[2], "", 1)
    assert refusal({misspelt: {}}) == f"[{misspelt}] is not a known table; the nearest known one is [{name}]"


def test_error_for_a_misspelt_key_names_the_nearest_key():
    for tables, path in at_each(lambda path, _: all(isinstance(part, str) for part in path)):
        *table, key = path
        said = refusal(changed(tables, [*table, f"{key}_"], 1.0))
        assert said.startswith(f"{'.'.join(table)}.{key}_ is not a known ")
        assert said.endswith(f"the nearest known one is {'.'.join(path)}") or (
            table[0] == "requirements" and said.endswith(f"the nearest known one is {key}")
        )


@pytest.mark.parametrize("name", NAMES)
def test_a_value_instead_of_a_table_is_refused(name):
    assert refusal({name: 3}).startswith(f"{name} is 3, but must be a table")


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
def test_error_messages_show_values_as_a_scenario_file_would_write_them(value, shown):
    assert errors.show(value) == shown


def test_dump_of_a_scenario_omits_none_and_keeps_zero():
    dumped = parsing.dump(from_tables({"hardware": {"rate_noise": 0.0}, "loop": {"mode": "sampled"}}))
    assert dumped["hardware"] == {"rate_noise": 0.0}
    assert {"requirements", "tune", "dispersion"}.isdisjoint(dumped)


@pytest.mark.parametrize(
    ("content", "said"),
    [
        (b"[controller\neta = 3.0", "is no valid TOML"),
        (b"[controller]\neta = 3.0\neta = 4.0", "is no valid TOML"),
        (b"\x00", "is no valid TOML"),
        (b"\xff\xfe", "is not encoded in UTF-8"),
        (b"x = " + 5000 * b"9", ""),  # more digits than Python converts to a number
        (None, "cannot be read: Is a directory"),
    ],
    ids=["unclosed", "twice", "null", "binary", "digits", "directory"],
)
def test_error_for_an_unreadable_scenario_file_names_the_file(tmp_path, content, said):
    path = tmp_path / "some.toml"
    path.mkdir() if content is None else path.write_bytes(content)
    with refuses(ScenarioError, f"the scenario file {path} {said}"):
        parsing.load(path)


@pytest.mark.parametrize(
    ("content", "quoted"),
    [
        (
            "[loop]\nt_end = 60 s\n",
            "(at line 2, column 12): t_end = 60 s; a text needs quotes, also a number with a unit",
        ),
        (
            "mode =\tsampled  # at 20 Hz",
            "(at line 1, column 8): mode = sampled # at 20 Hz; a text needs quotes, also a number ",
        ),
        ("inertia = [350 kg cm^2, 300, 320]", "inertia = [350 kg cm^2, 300, 320]; a text needs quotes"),
        ("[loop]\nt_end = 60,0\n", "(at line 2, column 11): t_end = 60,0"),
        (f'mode = {100_000 * "a "}"', "mode = a a a"),  # in a time that is not quadratic in the length
    ],
)
def test_error_for_invalid_toml_quotes_the_line(tmp_path, content, quoted):
    path = tmp_path / "some.toml"
    path.write_text(content)
    with pytest.raises(ScenarioError) as caught:
        parsing.load(path)
    assert quoted in str(caught.value)
    assert ("needs quotes" in str(caught.value)) == ("needs quotes" in quoted)


def test_error_for_an_absent_scenario_file_names_the_file(tmp_path):
    with pytest.raises(ScenarioError) as caught:
        parsing.load(tmp_path / "none.toml")
    assert str(caught.value) == f"the scenario file {tmp_path / 'none.toml'} does not exist"


def test_every_kind_of_a_table_can_be_pickled():
    for _, tables in COMPLETE:
        parsed = parsing.parse(tables)
        assert pickle.loads(pickle.dumps(parsed)) == parsed, tables


# JSON Schema, with an independent validator
VALIDATOR = jsonschema.Draft202012Validator(json_schema())
PACKAGED = [*(ROOT / "scenarios").glob("*.toml"), *(ROOT / "benchmarks" / "satellites").glob("*.toml")]


@pytest.mark.parametrize("path", sorted(PACKAGED), ids=lambda path: path.stem)
def test_scenarios_of_the_repository_are_valid_by_the_json_schema(path):
    jsonschema.Draft202012Validator.check_schema(json_schema())
    VALIDATOR.validate(tomllib.loads(path.read_text()))


def test_json_schema_accepts_texts_with_a_unit_in_lists_and_matrices():
    for inertia in (["300 kg cm^2", 0.02, 0.04], [["300 kg cm^2", 0, 0], [0, 0.02, 0], [0, 0, 0.04]]):
        VALIDATOR.validate({"spacecraft": {"inertia": inertia}})
    VALIDATOR.validate({"flexible": {"coupling": [["0.8 sqrt(kg) m", 0, 0]]}})
    for table, key, value in (("spacecraft", "inertia", "300 kg cm^2"), ("flexible", "coupling", ["0.8 sqrt(kg) m"])):
        assert not VALIDATOR.is_valid({table: {key: value}})


def test_json_schema_has_every_key_and_no_other():
    for _, tables in BUILT_IN:
        VALIDATOR.validate(tables)
        for path, _ in leaves(tables) if "code" not in str(tables) else ():  # a custom part may have any key
            if isinstance(path[-1], str) and "bounds" not in path:
                misspelt = changed(tables, [*path[:-1], f"{path[-1]}_"], 1.0)
                assert not VALIDATOR.is_valid(misspelt), path


@pytest.mark.parametrize(
    "tables",
    [
        {"controller": {"eta": 2.0}},
        {"controller": {"kind": "pid"}},
        {"observer": {"gain": [1.0, 1.0]}},
        {"loop": {"mode": "discrete"}},
        {"dispersion": {"inertia": {"std": 0.5}}},
        {"disturbance": {"kind": "sum", "terms": []}},
        {"disturbance": {"kind": "sum", "terms": [{"kind": "sum", "terms": [{"kind": "constant"}]}]}},
        {"disturbance": {"kind": "sum", "terms": [{"kind": "constant", "frequency": [1, 1, 1]}]}},
        {"plant": {"kind": "chain"}, "wheels": {}},
        {"requirements": {"peak_torque": {"quantile": 0.9}}},
    ],
)
def test_json_schema_refuses_values_out_of_range_and_tables_of_other_plants(tables):
    assert not VALIDATOR.is_valid(tables)
