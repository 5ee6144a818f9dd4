"""Check the JSON Schema of scenario files with an independent validator."""

import tomllib

import jsonschema
import pytest

from ptsmc_jax.scenario.json_schema import json_schema
from tests.helpers import ROOT
from tests.scenario.test_schema import BUILT_IN, changed, leaves

VALIDATOR = jsonschema.Draft202012Validator(json_schema())
PACKAGED = [*(ROOT / "scenarios").glob("*.toml"), *(ROOT / "benchmarks" / "satellites").glob("*.toml")]


@pytest.mark.parametrize("path", sorted(PACKAGED), ids=lambda path: path.stem)
def test_packaged_scenarios_are_valid(path):
    jsonschema.Draft202012Validator.check_schema(json_schema())
    VALIDATOR.validate(tomllib.loads(path.read_text()))


def test_the_schema_has_every_key_and_no_other():
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
def test_values_out_of_range_and_tables_of_other_plants_are_invalid(tables):
    assert not VALIDATOR.is_valid(tables)
