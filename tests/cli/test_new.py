"""`ptsmc new`, `schema` and `examples`: the written scenario, its keys, and the keys in comments.

A written scenario has every key of its plant. Keys in comments are valid as soon as the # is removed.
"""

import io
import json
import os
import re
import subprocess
import sys
import tomllib
from collections.abc import Mapping

import pytest

from ptsmc_jax.scenario import from_tables, keys, layouts, parsing
from ptsmc_jax.scenario.attitude_keys import ATTITUDE_KEYS
from ptsmc_jax.scenario.sensor_tables import SENSORS
from ptsmc_jax.simulation import catalogues
from tests.helpers import ROOT, refused
from tests.scenario.every_key import ATTITUDE, COMMANDS, blocks, complete, key_of, kinds, values
from tuning.cli import new

PLANTS = " or ".join(layouts.SCENARIOS)
FLIGHT = ROOT / "scenarios" / "first_flight.toml"


@pytest.mark.parametrize("plant", ["spacecraft", "chain"])
def test_new_writes_the_default_scenario(plant):
    written = tomllib.loads(new.scenario_text(plant, {}))
    assert parsing.dump(from_tables(written)) == parsing.dump(from_tables({"plant": {"kind": plant}}))
    assert len(written) > 4  # with explicit keys


def test_schema_command_refuses_an_existing_file_without_force(command, tmp_path):
    code, said, _ = command("schema")
    assert (code, "anyOf" in json.loads((tmp_path / "scenario.schema.json").read_text())) == (0, True)
    assert "#:schema scenario.schema.json" in said
    assert command("schema")[0] == 2
    assert command("schema", "--force", "--quiet") == (0, "", "")


def test_new_writes_the_same_scenario_without_docstrings():
    """The option -OO of Python removes docstrings."""
    call = [sys.executable, "-OO", "-c", "from tuning.cli import new; print(new.scenario_text('chain', {}), end='')"]
    done = subprocess.run(call, capture_output=True, text=True, cwd=ROOT, check=False)
    assert (tomllib.loads(done.stdout), done.stderr) == (tomllib.loads(new.scenario_text("chain", {})), "")


@pytest.mark.parametrize("path", sorted((ROOT / "scenarios").glob("*.toml")), ids=lambda path: path.stem)
def test_new_like_a_scenario_writes_the_same_scenario(path):
    raw = parsing.load(path)
    written = tomllib.loads(new.scenario_text(None, raw))
    assert parsing.dump(from_tables(written)) == parsing.dump(from_tables(raw))
    assert all(set(given) <= set(written[table]) for table, given in raw.items())


@pytest.mark.parametrize("name", ["hubble", "pleiades"])
def test_commented_keys_of_other_laws_are_their_defaults(name):
    """The commented keys of a law have the same values as a scenario with only its kind and t_f."""
    raw = parsing.load(ROOT / "benchmarks" / "satellites" / f"{name}.toml")
    others = [values(lines) for lines in kinds(blocks(new.scenario_text(None, raw))["controller"])[1:]]
    others = [other for other in others if other["kind"] != "custom"]
    assert len(others) > 5
    for other in others:
        stated = {"kind": other["kind"], "t_f": raw["controller"]["t_f"]}
        assert parsing.dump(from_tables({**raw, "controller": stated}))["controller"] == pytest.approx(other)


def test_keys_of_custom_classes_keep_their_order_and_are_quoted():
    """A field name may have letters that TOML allows only in quoted keys."""
    custom = {"kind": "custom", "code": "mine.py:Mine", "größe": 3.0, "beta": 1.0, "alpha": 4.0}
    terms = [custom, {"kind": "none"}]
    raw = {"disturbance": {"kind": "sum", "terms": terms}, "dispersion": {"custom": custom}, "reference": custom}
    written = tomllib.loads(new.scenario_text(None, raw))
    assert list(written["reference"])[-3:] == ["größe", "beta", "alpha"]
    assert (written["dispersion"]["custom"], written["disturbance"]["terms"]) == (custom, terms)


@pytest.mark.parametrize("plant", layouts.TABLES)
def test_new_writes_every_key_of_the_plant_with_its_meaning(plant):
    """Tables and kinds are complete, and all metrics of the plant are named."""
    text = new.scenario_text(plant, {})
    found = blocks(text)
    names = list(layouts.TABLES[plant])
    names.insert(names.index("tune"), "requirements")
    tables = dict(layouts.TABLES[plant])
    if plant == "spacecraft":
        names.insert(names.index("sensors") + 1, "[sensors]")
        tables["[sensors]"] = SENSORS
    assert list(found) == names
    for name, table in tables.items():
        said = kinds(found[name])
        structs = list(table.values()) if isinstance(table, Mapping) else [table]
        assert len(said) == len(structs)
        explained = (
            set() if name in ("initial", "[sensors]") else ATTITUDE
        )  # attitude keys are explained in [initial] only
        for lines, struct in zip(said, structs, strict=True):
            wanted = {key.name: key.meaning for key in keys.list_keys(struct) if key.name not in explained}
            assert {key_of(line) for line in lines} - {"kind", *explained} == set(wanted), (name, struct)
            assert all(meaning in text.replace("\n# ", " ") for meaning in wanted.values())
    assert ("[unit of d" in text) == (layouts.SCENARIOS[plant].unit_of_d == keys.UNIT_OF_D)
    for metric in catalogues.CATALOGUES[plant]:  # the key of the metric itself requires a fraction of time
        assert bool(re.search(rf"\b{metric}\b", text)) == (not metric.startswith(catalogues.WITHIN)), metric


SENSOR_TEXT = """
[loop]
mode = "sampled"
[[sensors]]
kind = "gyro"
rate_noise_density = "0.02 deg/sqrt(h)"
[[sensors]]
kind = "star_tracker"
noise_across = "8 arcsec"
[[sensors]]
kind = "star_tracker"
rotvec_deg = [90.0, 0.0, 0.0]
noise_across = 4e-5
"""


def test_new_like_a_list_of_sensors_writes_the_same_sensors():
    """An earlier version ended in a traceback."""
    given = from_tables(tomllib.loads(SENSOR_TEXT))
    text = new.scenario_text(None, tomllib.loads(SENSOR_TEXT))
    assert parsing.dump(from_tables(tomllib.loads(text))) == parsing.dump(given)
    assert [table["kind"] for table in tomllib.loads(text)["sensors"]] == ["gyro", "star_tracker", "star_tracker"]


def test_commented_sensors_of_a_new_scenario_are_valid_together():
    groups = kinds(blocks(new.scenario_text(None, {}))["[sensors]"])
    for excluded in ({"rotvec_deg", "rate_noise"}, {"boresight", "rate_noise_density"}):
        sensors = [{key: v for key, v in values(lines).items() if key not in excluded} for lines in groups]
        from_tables({"loop": {"mode": "sampled"}, "sensors": sensors})


@pytest.mark.parametrize("plant", ["spacecraft", "chain"])
def test_commented_keys_of_a_new_scenario_are_valid(plant):
    """Every kind of every table, every dispersion and every attitude key is valid."""
    every = complete(plant)
    for _, tables in every:
        from_tables(tables)
    layout = layouts.TABLES[plant]
    dispersion = layout["dispersion"]
    assert isinstance(dispersion, type)
    drawn = sum(len(layouts.DISPERSIONS[key.name]) for key in keys.list_keys(dispersion))
    others = sum(len(table) if isinstance(table, Mapping) else 1 for table in layout.values()) - 1
    attitudes = len(ATTITUDE_KEYS) - 1 if plant == "spacecraft" else 0
    commands = len(COMMANDS) - 1 if plant == "spacecraft" else 0  # a log has one of them
    assert len(every) == others + drawn + attitudes + commands + 1  # 1: [requirements] is not in the layout


def test_new_command_refuses_an_existing_file_without_force(command, tmp_path):
    """With --force, it replaces the file."""
    assert command("new") == (0, "scenario in scenario.toml\n", "")
    written = (tmp_path / "scenario.toml").read_text()
    assert written == new.scenario_text(None, {})
    code, _, error = command("new")
    assert (code, error) == (
        2,
        "ptsmc: the file is scenario.toml, which exists already; allowed is another name, or --force to write "
        "over it\n",
    )
    assert command("new", "--like", FLIGHT, "--force", "--quiet") == (0, "", "")
    assert (tmp_path / "scenario.toml").read_text() == new.scenario_text(None, parsing.load(FLIGHT)) != written


def test_file_name_is_escaped_if_the_output_encoding_lacks_its_letters(command, tmp_path, monkeypatch):
    plain = io.TextIOWrapper(io.BytesIO(), encoding="ascii")
    monkeypatch.setattr(sys, "stdout", plain)
    assert command("new", "größe.toml")[::2] == (0, "")
    plain.seek(0)
    assert plain.read() == "scenario in gr\\xf6\\xdfe.toml\n"


@pytest.mark.parametrize(
    ("options", "said"),
    [
        (
            ["nowhere/s.toml"],
            "the file is nowhere/s.toml, but nowhere is no folder; allowed is a file in an existing folder",
        ),
        (["."], "the file is ., which exists already; allowed is another name"),
        (["chain"], "FILE is chain, which is a kind of plant; allowed are --plant chain and other file names"),
        (["a.toml", "--plant", "boat"], f"--plant is boat, but must be {PLANTS}"),
        (
            ["a.toml", "--plant", "chain", "--like", FLIGHT],
            "--plant is chain, but the scenario of --like has plant.kind = spacecraft",
        ),
        (
            ["a.toml", "--like", "eta.toml"],
            "controller.eta is 1.0, but must be a number greater than 2 (Theorem 2)",
        ),
        (["a.toml", "--like", "none.toml"], "the scenario file none.toml does not exist"),
    ],
)
def test_new_command_refuses_invalid_options_and_writes_nothing(command, tmp_path, options, said):
    (tmp_path / "eta.toml").write_text("controller.eta = 1.0\n")
    assert refused(command, tmp_path, "new", *options) == f"ptsmc: {said}"


def test_commented_keys_of_a_new_scenario_have_their_default_values(tmp_path):
    """The gain of a finite-time observer is 20 times a bound, and positive if the bound is zero."""
    for bound, gain in ((0.0, 0.02), (2e-3, 0.04)):
        lines = blocks(new.scenario_text(None, {"controller": {"disturbance_rate_bound": bound}}))["observer"]
        (shown,) = (values(group)["gain"] for group in kinds(lines) if values(group)["kind"] == "finite_time")
        assert shown == pytest.approx([gain] * 3)
        given = {"controller": {"disturbance_rate_bound": bound}, "observer": {"kind": "finite_time"}}
        assert parsing.dump(from_tables(given))["observer"]["gain"] == shown


def test_examples_command_copies_the_scenarios_and_refuses_changed_files(command, tmp_path):
    """With --force, changed files are replaced."""
    code, said, _ = command("examples", "mine")
    shipped = {path.name: path.read_text() for path in (ROOT / "scenarios").iterdir() if path.is_file()}
    assert {path.name: path.read_text() for path in (tmp_path / "mine").iterdir()} == shipped
    assert code == 0
    assert all(name in said for name in shipped)
    changed = tmp_path / "mine" / sorted(shipped)[-1]
    changed.write_text("")
    assert command("examples", "mine")[0] == 2
    assert changed.read_text() == ""
    assert command("examples", "mine", "--force", "--quiet") == (0, "", "")
    assert changed.read_text() == shipped[changed.name]
    assert command("examples", changed) == (2, "", f"ptsmc: File exists: {changed}\n")


@pytest.mark.long
def test_installed_wheel_simulates_an_example(tmp_path):
    """The wheel is built, installed in another folder and used there, with the dependencies of this environment."""
    pip = sys.executable, "-m", "pip", "--quiet", "--disable-pip-version-check"
    away = tmp_path / "away"
    away.mkdir()
    subprocess.run([*pip, "wheel", "--no-deps", "--wheel-dir", tmp_path, ROOT], check=True, cwd=away)
    (wheel,) = tmp_path.glob("*.whl")
    subprocess.run([*pip, "install", "--no-deps", "--target", tmp_path / "site", wheel], check=True, cwd=away)
    run = {"check": True, "cwd": away, "env": {**os.environ, "PYTHONPATH": str(tmp_path / "site")}}
    ptsmc = sys.executable, tmp_path / "site" / "bin" / "ptsmc"
    subprocess.run([*ptsmc, "examples", "--quiet"], **run)
    subprocess.run([*ptsmc, "simulate", "scenarios/two_link_arm.toml", "--out", "simulated"], **run)
    where = subprocess.run(
        [sys.executable, "-c", "import ptsmc_jax; print(ptsmc_jax.__file__)"], capture_output=True, text=True, **run
    )
    assert str(tmp_path / "site") in where.stdout
    assert (away / "simulated" / "summary.json").exists()
