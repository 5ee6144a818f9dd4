"""FMUs of controller and plant: validity, closed loop against the simulator, saved states, errors of use."""

import json
import re
import subprocess
import zipfile
from xml.etree import ElementTree

import jax
import jax.numpy as jnp
import numpy as np
import pytest

import ptsmc_jax as ptsmc
from ptsmc_jax import scenario
from ptsmc_jax.campaigns import store
from ptsmc_jax.onboard import fmu as fmu_files
from ptsmc_jax.onboard import folder
from ptsmc_jax.onboard.library import Library, compiler
from ptsmc_jax.scenario.errors import ScenarioError
from ptsmc_jax.simulation import rollout
from tests.onboard.compiled import STRICT, needs_compiler, program, step_many
from tests.onboard.flights import FLIGHTS, FULL, MOVING, SIX, flight
from tests.onboard.test_sensor_suite_export import TABLES
from tests.tree import ROOT

pytest.importorskip("fmpy")
from fmpy.validation import validate_fmu

from tests.onboard.fmus import Unit, closed_loop

pytestmark = needs_compiler

SEED, SAMPLES = 5, 65
OTHERS = ("wheels with lag, limits, delay", "star tracker out of step", "system", "suite", *MOVING)
# wheels with failures, delay, filter with a slow star tracker, gyro bias, random walk of the disturbance, jitter
RICH = flight(
    filter={"kind": "steady_state"},
    spacecraft={"inertia": FULL},
    hardware={"star_tracker_every": 3, "rate_bias": 1e-5, "rate_bias_walk": 1e-7, "delay": 1, "torque_lag": 0.02},
    wheels={"torque_limit": 2.0, "momentum_limit": 3.0},
    controller={"delta": 1.0},
    dispersion={
        "attitude": {"kind": "axis_angle", "min_deg": 20.0, "max_deg": 60.0},
        "inertia": {"kind": "relative_normal", "std": 0.02, "axes_deg": 2.0},
        "actuator_scale": {"kind": "relative_uniform", "half_width": 0.05},
        "wheel_failure": {"kind": "uniform", "latest": 4.0},
        "timing_jitter": {"largest": 0.3},
    },
)


def made_from(tables, reference_input=False):
    """Return the `folder.Controller` of a scenario with these tables.

    reference_input: whether the reference is an input of it.
    """
    complete = scenario.reading.complete(scenario.from_tables(tables))
    return folder.Controller(complete, "flight", "a scenario", reference_input)


def simulated(made, seed, trials):
    """Return true states and disturbances (trials, samples, n) by the simulator, in the order of the FMU.

    made: the controller, whose scenario is simulated. trials: their numbers.
    """
    plant = made.ready.parts.plant

    def run(trial):
        parts = made.ready.dispersion.apply(made.ready.parts, jnp.uint32(seed), trial)
        log = rollout.simulate(parts, jnp.uint32(seed), trial, record=True).log
        assert log is not None
        signals = jax.vmap(lambda x: plant.signals_of(plant.visible(x)))(log.x)
        columns = [signals[name].reshape(len(log.t), -1) for name in sorted(signals)]
        return jnp.concatenate([*columns, log.disturbance.reshape(len(log.t), -1)], axis=1)

    return np.asarray(jax.jit(jax.vmap(run))(jnp.asarray(trials, jnp.uint32)))


def true_states(made, rows):
    """Return the true states and disturbances (samples, n) of a closed loop of FMUs, in the columns of `simulated`.

    rows: of `closed_loop`.
    """
    names = [*sorted(made.ready.parts.plant.signals), "disturbance"]
    columns = [name for one in names for name in rows[0][0] if name.partition("[")[0] == f"true_{one}"]
    return np.array([[readings[name] for name in columns] for readings, _ in rows])


@pytest.fixture(scope="module")
def rich():
    """Return the `folder.Controller`; the FMUs of controller and plant are exported from it.

    Its scenario has wheels, delay, filter, noise, dispersions and a wheel failure.
    """
    return made_from(RICH)


@pytest.fixture(scope="module")
def files(rich, tmp_path_factory):
    """Return the folder of the FMUs of controller and plant for both versions of FMI."""
    place = tmp_path_factory.mktemp("fmus")
    fmus = folder.Fmus(controller=True, plant=True)
    fmus.write(place, rich)
    return place


@pytest.fixture(scope="module")
def expected(rich):
    """Return the true states (2, samples, n) of trials 0 and 3, computed by the simulator."""
    return simulated(rich, SEED, [0, 3])


@pytest.fixture(scope="module")
def library(tmp_path_factory):
    """Return the compiled C code of the controller as a `Library`, exported without an FMU."""
    place = tmp_path_factory.mktemp("exported") / "c"
    program(RICH, place)
    return Library(place)


@pytest.fixture(scope="module", params=fmu_files.VERSIONS)
def loop(files, request):
    """Return the units (controller, plant) of one version of FMI."""
    return tuple(Unit(files / f"{name}_fmi{request.param}.fmu") for name in ("controller", "plant"))


def run(loop, trial=0, count=SAMPLES):
    """Reset both FMUs and simulate `count` periods of a trial; return the rows of `closed_loop`.

    loop: the units of controller and plant.
    """
    for one in loop:
        one.unit.reset()
    return closed_loop(loop, count, {"seed": SEED, "trial": trial})


def test_fmpy_finds_no_problem_in_the_fmus(files):
    found = {path.name: validate_fmu(str(path)) for path in sorted(files.iterdir())}
    assert found == {f"{name}_fmi{k}.fmu": [] for name in ("controller", "plant") for k in (2, 3)}


def test_closed_loop_of_fmus_equals_the_simulation(rich, expected, loop):
    assert not np.allclose(expected[0], expected[1])
    for k, trial in enumerate((0, 3)):
        rows = run(loop, trial)
        np.testing.assert_allclose(true_states(rich, rows), expected[k, :SAMPLES], rtol=0.0, atol=1e-10)
        assert all(commands["status"] in (0, 1) for _, commands in rows)


def assert_outputs_of_the_c(library, controller, rows):
    """Assert that a controller FMU has returned the outputs and statuses of the exported C, to the last bit.

    controller: its unit. rows: of `closed_loop`.
    """
    state, columns = library.initial_state(), library.columns
    for name, value in rows[0][0].items():
        if name.startswith("initial_"):
            element, *places = re.split(r"\W", name.removeprefix("initial_").rstrip("]"))
            element += "".join(f"[{int(place) - 1}]" for place in places)
            state[columns["state"].index(element)] = value
    inputs = controller.names("input")
    for k, (readings, commands) in enumerate(rows):
        given = [k * controller.period, *(readings[name] for name in inputs)]
        state, out, status = step_many(library, state, np.array(given))
        found = np.array([v for name, v in commands.items() if name != "status"])
        assert found.tobytes() == out.tobytes()
        assert status == commands["status"]


def test_controller_fmu_has_the_outputs_of_the_exported_c(library, loop):
    assert_outputs_of_the_c(library, loop[0], run(loop, 3))


def test_saved_and_restored_states_replay_to_the_last_bit(loop):
    """After a saved state is set again, also from bytes and after a reset, both FMUs return the same numbers."""
    rows = run(loop, 1, 40)
    whole = run(loop, 1, 20)
    assert whole == rows[:20]  # reset
    states = [one.unit.getFMUState() for one in loop]
    blobs = [one.unit.serializeFMUState(state) for one, state in zip(loop, states, strict=True)]
    controller, plant = loop

    def proceed(first):
        readings, found = first, []
        for k in range(20, 40):
            controller.write({name: readings[name] for name in controller.names("input")})
            controller.step(k)
            commands = controller.read(controller.names("output"))
            found.append((readings, commands))
            plant.write({name: commands[name] for name in plant.names("input")})
            plant.step(k)
            readings = plant.read(plant.names("output"))
        return found

    first = plant.read(plant.names("output"))
    assert proceed(first) == rows[20:]
    for one, state in zip(loop, states, strict=True):
        one.unit.setFMUState(state)
    assert proceed(first) == rows[20:]
    for one, blob in zip(loop, blobs, strict=True):
        one.unit.setFMUState(one.unit.deserializeFMUState(blob))
    assert proceed(first) == rows[20:]


def test_two_instances_of_an_fmu_are_independent(loop):
    """Second instances of both FMUs, for another trial, do not change the results of the first ones."""
    controller, plant = loop
    alone = run(loop, 2, 10)
    other_controller, other_plant = (one.instance() for one in loop)
    for one in loop:
        one.unit.reset()
    plant.begin({"seed": SEED, "trial": 2})
    plant.begin({"seed": SEED, "trial": 9}, other_plant)
    inputs, starts = controller.names("input"), [n for n in controller.names("parameter") if n in alone[0][0]]
    controller.begin({name: alone[0][0][name] for name in starts})
    controller.begin(plant.read(starts, other_plant), other_controller)
    for k, (readings, commands) in enumerate(alone):
        assert plant.read(list(readings)) == readings
        assert plant.read(["true_attitude[1]"], other_plant)["true_attitude[1]"] != readings["true_attitude[1]"]
        controller.write({name: readings[name] for name in inputs})
        controller.write(plant.read(inputs, other_plant), other_controller)
        controller.step(k)
        controller.step(k, other_controller)
        assert controller.read(list(commands)) == commands
        assert controller.read(["command[1]"], other_controller)["command[1]"] != commands["command[1]"]
        plant.write({name: commands[name] for name in plant.names("input")})
        plant.step(k)
        plant.step(k, other_plant)
    other_controller.terminate()
    other_plant.terminate()


def test_shorter_communication_steps_give_the_same_samples(loop):
    """With a quarter of the period, the FMUs sample at the same times as with the period."""
    controller, plant = loop
    expected = run(loop, 1, 20)
    for one in loop:
        one.unit.reset()
    plant.begin({"seed": SEED, "trial": 1})
    readings = plant.read(plant.names("output"))
    controller.begin({name: readings[name] for name in controller.names("parameter") if name in readings})
    for k in range(80):
        assert readings == expected[k // 4][0]  # constant between samples
        controller.write({name: readings[name] for name in controller.names("input")})
        t, length = 0.25 * k * controller.period, 0.25 * controller.period
        controller.unit.doStep(t, length)
        commands = controller.read(controller.names("output"))
        assert commands == expected[k // 4][1]
        plant.write({name: commands[name] for name in plant.names("input")})
        plant.unit.doStep(t, length)
        readings = plant.read(plant.names("output"))


def test_gains_of_the_controller_fmu_are_tunable_and_its_period_is_fixed(loop):
    controller, _ = loop
    usual = run(loop, 1, 12)
    for one in loop:
        one.unit.reset()
    (gain,) = (name for name in controller.of if name == "law_eta")
    before = controller.read([gain])[gain]
    half = closed_loop(loop, 6, {"seed": SEED, "trial": 1})
    assert half == usual[:6]
    controller.write({gain: 1.5 * before})
    controller.write({name: usual[6][0][name] for name in controller.names("input")})
    controller.step(6)
    assert controller.read(["command[1]"])["command[1]"] != usual[6][1]["command[1]"]
    for name, value in (("period", 0.2), ("command[1]", 1.0), (gain, np.nan)):
        with pytest.raises(Exception, match=r"status 3 \(error\)"):
            controller.write({name: value})
    with pytest.raises(Exception, match=r"status 3 \(error\)"):
        controller.unit.doStep(0.0, controller.period)  # earlier than the last step's end


def test_inertia_of_the_plant_fmu_can_be_changed_before_a_run(tmp_path):
    """The inverse follows. The body turns as in closed form under a constant torque about a principal axis."""
    tables = flight(hardware={"attitude_noise": 0.0, "rate_noise": 0.0}, dispersion={},
                    disturbance={"kind": "constant", "amplitude": [0.0, 0.0, 0.0]})  # fmt: skip
    made = made_from(tables)
    fmus = folder.Fmus(plant=True, version=3)
    fmus.write(tmp_path, made)
    plant = Unit(tmp_path / "plant_fmi3.fmu")
    plant.begin({"plant_inertia[3,3]": 20.0})
    for k in range(10):
        plant.write({"command[3]": 0.5})
        plant.step(k)
    assert plant.read(["true_rate[3]"])["true_rate[3]"] == pytest.approx(0.5 / 20.0 * 10 * plant.period, rel=1e-12)


def test_unusable_inputs_of_the_controller_fmu_return_a_warning_and_the_last_command(loop):
    controller, _ = loop
    rows = run(loop, 1, 5)
    controller.write({name: rows[-1][0][name] for name in controller.names("input")} | {"rate[1]": np.nan})
    controller.step(5)  # FMPy raises from the status "discard" on
    found = controller.read(controller.names("output"))
    assert found == rows[-1][1] | {"status": 4}


@pytest.mark.parametrize("version", fmu_files.VERSIONS)
@pytest.mark.parametrize("model", [pytest.param("controller", marks=pytest.mark.long), "plant"])
def test_sanitizers_find_no_error_in_the_c_code_of_the_fmus(rich, tmp_path, model, version):
    made = {"controller": folder.controller_model, "plant": folder.plant_model}[model](rich)
    texts, token = fmu_files.source_texts(made, version)
    for name, text in texts.items():
        (tmp_path / name).write_text(text)
    driver = str(ROOT / "tests" / "onboard" / "fmu_driver.c")
    strict = [flag for flag in STRICT if flag != "-Wconversion"]
    names = [str(tmp_path / name) for name in texts if name.endswith(".c")]
    flags = [f"-DVERSION={version}", "-g", "-fsanitize=address,undefined", "-fno-sanitize-recover=all"]
    built = [*compiler(), *strict, *flags, *names, driver, "-o", str(tmp_path / "driver"), "-lm"]
    done = subprocess.run(built, capture_output=True, text=True, check=False)
    assert done.returncode == 0, done.stderr
    sizes = [len(made.code.columns["in"]) - 1, len(made.code.columns["out"])]
    ran = [str(tmp_path / "driver"), token, repr(made.period), *map(str, sizes)]
    done = subprocess.run(ran, capture_output=True, text=True, check=False)
    assert done.returncode == 0, done.stdout + done.stderr


def test_fmus_contain_only_sources_without_a_compiler(tmp_path, monkeypatch):
    """This needs the option `binary=False`; otherwise an export without a compiler raises an error."""
    monkeypatch.setenv("CC", "no-compiler")
    tables = scenario.reading.complete(scenario.from_tables(FLIGHTS["chain"]))
    with pytest.raises(ScenarioError, match="there is no C compiler no-compiler"):
        ptsmc.export(tables, tmp_path / "made", trials=1, fmu=True)
    assert not (tmp_path / "made").exists()
    ptsmc.export(tables, tmp_path / "made", trials=1, fmu=True, fmu_plant=True, fmi=2, binary=False)
    found = sorted(path.name for path in (tmp_path / "made").glob("*.fmu"))
    assert found == ["controller_fmi2.fmu", "plant_fmi2.fmu"]
    names = zipfile.ZipFile(tmp_path / "made" / "plant_fmi2.fmu").namelist()
    assert "sources/fmi2.c" in names
    assert not any(name.startswith("binaries") for name in names)


def test_program_of_the_documentation_runs(files, monkeypatch, capsys):
    """The program for FMPy in docs/fmu.md prints the attitude at the end of trial 3."""
    text = (ROOT / "docs" / "fmu.md").read_text(encoding="utf-8")
    (code,) = re.findall(r"```py\n(.*?)```", text, re.DOTALL)
    monkeypatch.chdir(files)
    exec(compile(code.replace('["seed"], 0)', f'["seed"], {SEED})'), "fmu.md", "exec"), {"__name__": "fmu"})
    assert len(json.loads(capsys.readouterr().out)) == 4


class Unwritable(ptsmc.Disturbance):
    """A disturbance with an operation that C does not have."""

    def __call__(self, t, x):
        """Return a torque (3,) [N m] from a singular value decomposition, which C does not have."""
        return 1e-3 * jnp.linalg.svd(jnp.outer(x.w, x.w) + jnp.eye(3))[1]


def test_plant_that_c_cannot_express_is_refused():
    made = made_from(flight(disturbance={"kind": "custom", "code": f"{__file__}:Unwritable"}))
    with pytest.raises(ScenarioError, match=r"jnp.linalg.svd.* cannot be written in C"):
        folder.plant_model(made)


def test_quotes_in_the_name_of_a_scenario_file_are_escaped_in_the_description_of_an_fmu(rich):
    model = folder.controller_model(rich)._replace(title='controller of "a" & b.toml')
    for version in fmu_files.VERSIONS:
        described = ElementTree.fromstring(fmu_files.model_description(model, version, "token", []).encode())
        assert described.attrib["modelName"] == model.title


def test_units_in_the_description_of_an_fmu_are_products_of_base_units():
    assert fmu_files.parse_unit("N m s") == ("N.m.s", {"kg": 1, "m": 2, "s": -1})
    assert fmu_files.parse_unit("rad/s^2") == ("rad/s2", {"rad": 1, "s": -2})
    assert fmu_files.parse_unit("1/s") == ("1/s", {"s": -1})
    assert fmu_files.parse_unit("rad/s/sqrt(s)") == ("", {})
    assert fmu_files.parse_unit("-") == ("", {})


RANDOM = {**FLIGHTS["slew"], "dispersion": {"reference": {"kind": "normal", "std_deg": 3.0}}}


@pytest.mark.long
@pytest.mark.parametrize(
    ("name", "count"), [*((name, 1000) for name in SIX), *((name, 100) for name in OTHERS), ("random reference", 5)]
)
def test_closed_loops_of_other_scenarios_equal_the_simulation(name, count, tmp_path):
    """The controller also equals the exported C. The plant supplies a random reference to the controller."""
    supplied = name == "random reference"
    made, version = made_from({**FLIGHTS, "suite": TABLES, "random reference": RANDOM}[name], supplied), 3 - supplied
    fmus = folder.Fmus(controller=True, plant=True, version=version)
    fmus.write(tmp_path, made)
    store.write_folder(tmp_path / "c", lambda making: folder.write_program(making, made))
    library = Library(tmp_path / "c")
    loop = tuple(Unit(tmp_path / f"{one}_fmi{version}.fmu") for one in ("controller", "plant"))
    expected = simulated(made, SEED, range(count))
    for trial in range(count):
        rows = run(loop, trial)
        assert_outputs_of_the_c(library, loop[0], rows)
        found = true_states(made, rows)  # 1e-10: rounding of exp and log, amplified by the gains
        np.testing.assert_allclose(found, expected[trial, :SAMPLES], rtol=0.0, atol=1e-10, err_msg=f"trial {trial}")
