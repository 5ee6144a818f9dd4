"""The folder of a controller: it compiles without warnings, replays the simulation, and rejects invalid input."""

import csv
import os
import re
import shutil
import subprocess
from dataclasses import replace
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
import pytest

import ptsmc_jax as ptsmc
from ptsmc_jax import scenario
from ptsmc_jax.onboard import folder, generate, templates
from ptsmc_jax.onboard.board import build_board
from ptsmc_jax.onboard.library import Library, compiler
from ptsmc_jax.scenario.errors import ScenarioError
from ptsmc_jax.scenario.law_tables import LAWS
from ptsmc_jax.simulation import rollout
from tests.helpers import ROOT, SHORT, fly, short
from tests.onboard.compiled import CC, STRICT, needs_compiler, step_many
from tests.onboard.flights import FLIGHTS, flight


@pytest.fixture(scope="module")
def exported(tmp_path_factory):
    """Return the path of the exported folder of a short scenario without filter."""
    place = tmp_path_factory.mktemp("short")
    (place / "short.toml").write_text(SHORT)
    return folder.export(place / "short.toml", place / "controller", trials=2)


NO_MAKE = CC is None or shutil.which("make") is None
needs_make = pytest.mark.skipif(NO_MAKE, reason="this machine has no C compiler or no make")
QUICK = "CFLAGS=-O0"  # for builds that another test compiles with optimisation


def make(place, *args):
    """Run make in a folder with these arguments, and return the finished process with its output as text."""
    environment = {
        name: value for name, value in os.environ.items() if name not in ("MAKEFLAGS", "MFLAGS", "MAKELEVEL")
    }
    called = ["make", "-B", f"CC={CC}", *args]  # without variables of an outer make that may run these tests
    return subprocess.run(called, cwd=place, env=environment, capture_output=True, text=True, check=False)


@needs_make
@pytest.mark.parametrize("real", ["double", "float"])
def test_exported_c_compiles_without_warnings_and_replays_the_simulation(exported, tmp_path, real):
    """The check fails for another gain."""
    place = shutil.copytree(exported, tmp_path / "controller")
    done = make(place, "check", f"REAL={real}")
    assert done.returncode == 0, done.stdout + done.stderr
    assert "130 samples; other status: 0" in done.stdout
    # another gain gives other commands
    (parameters,) = place.glob("*_parameters.c")
    text = parameters.read_text()
    assert "R(3), /* law_eta */" in text
    parameters.write_text(text.replace("R(3), /* law_eta */", "R(3.01), /* law_eta */"))
    done = make(place, "check", f"REAL={real}", QUICK)
    assert done.returncode != 0
    assert "130 samples; other status: 0" in done.stdout


@needs_compiler
def test_exported_c_compiles_with_the_compilers_default_language(exported):
    """Without -std=c99 the C library declares further names such as `finite`, which must not conflict."""
    sources = [str(place) for place in sorted(exported.glob("*.c"))]
    called = [*compiler(), "-fsyntax-only", "-Wall", "-Wextra", "-Werror", *sources]
    done = subprocess.run(called, capture_output=True, text=True, check=False)
    assert done.returncode == 0, done.stderr


EVERY = [(plant, kind) for plant, laws in LAWS.items() for kind in laws if kind != "custom"]


def of_law(plant, kind):
    """Return the tables of a short scenario with this law and its default gains.

    plant: spacecraft, chain or system. kind: of the controller.
    """
    gains = {"delta": 0.5} if kind == "prescribed_time" else {}
    tables = {"spacecraft": FLIGHTS["raw"], "chain": FLIGHTS["chain"], "system": FLIGHTS["system"]}[plant]
    return {**tables, "controller": {"kind": kind, "t_f": 5.0, **gains}}


@needs_make
@pytest.mark.long  # short tests: `Odd` below (memories), and `test_library.py` (published and custom laws)
@pytest.mark.parametrize(("plant", "kind"), EVERY)
def test_every_registered_law_replays_the_simulation(plant, kind, tmp_path):
    made = scenario.reading.complete(scenario.from_tables(of_law(plant, kind)))
    place = folder.export(made, tmp_path / "controller", name="law", trials=1)
    done = make(place, "check")
    assert done.returncode == 0, done.stdout + done.stderr
    assert "other status: 0" in done.stdout


class Odd(ptsmc.AccelerationLaw):
    """A law whose memory has integers, an empty array, and names that are not allowed in a C struct."""

    def begin(self) -> Any:
        """Return the initial memory, a dict of arrays."""
        return {"none": jnp.zeros(0), "I": jnp.zeros(3), "i": jnp.zeros((2, 3), int), "a b": jnp.zeros(()), "a-b": 0.0}

    def acceleration(self, now: Any, error: Any, error_rate: Any, bound: Any) -> Any:
        """Return the acceleration of a PD law with the memory added, the sign of the error as s, and the memory."""
        memory = now.memory
        whole = jnp.sign(error).astype(int)
        kept = {**memory, "I": memory["I"] + error, "i": jnp.stack([memory["i"][1] - 1, memory["i"].sum() % 3 - whole])}
        return -error - 2.0 * error_rate - 0.1 * kept["I"] + 1e-3 * kept["i"][0], whole, kept


class Named(ptsmc.AccelerationLaw):
    """A PD law with a variable and a description that would be wrong in C: a name in use, and comment marks."""

    k: float = ptsmc.gain(1.0, (0.1, 10.0), meaning="of v, */ and of /* v", unit="1/s^2")

    def __call__(self, now: Any, x: Any, target: Any, d_hat: Any, k2: Any) -> Any:
        """Return the torque, the body rate as s, and the memory.

        The code uses a variable `d`, the name of a pointer in the C, and the inverse inertia, which that pointer
        provides.
        """
        d = jnp.sum(x.w * x.w)
        damped = self.model.inertia_inverse @ (-self.k * x.q[:3] - 2.0 * x.w) / (1.0 + d)
        return self.model.inertia @ self.model.inertia @ damped * (1.0 + d), x.w, now.memory


def with_custom_law(law):
    """Return a short scenario with a custom law and a moving reference; law: its class."""
    moving = {"kind": "spin", "rate": [0.01, 0.02, -0.01]}
    simulated = {**FLIGHTS["raw"], "reference": moving, "controller": {"kind": "custom", "code": law, "t_f": 5.0}}
    return scenario.reading.complete(scenario.from_tables(simulated))


@needs_make
@pytest.mark.parametrize("law", short([Odd, Named], [Odd]))
def test_export_supports_unusual_memories_and_names(law, tmp_path):
    """The memories contain integers, empty arrays and names that are not identifiers in C."""
    done = make(folder.export(with_custom_law(law), tmp_path / "controller", name="law", trials=1), "check")
    assert done.returncode == 0, done.stdout + done.stderr
    assert "other status: 0" in done.stdout


@needs_compiler
def test_names_and_comment_marks_of_c_in_a_law_compile(tmp_path):
    folder.write_program(tmp_path, folder.Controller(with_custom_law(Named), "law", "a scenario"))
    called = [*compiler(), *STRICT, "-fsyntax-only", *map(str, sorted(tmp_path.glob("*.c")))]
    done = subprocess.run(called, capture_output=True, text=True, check=False)
    assert done.returncode == 0, done.stderr


class Tabled(ptsmc.AccelerationLaw):
    """PD with a loop that reads a table and fills another table."""

    def acceleration(self, now: Any, error: Any, error_rate: Any, bound: Any) -> Any:
        """Return a PD command plus a small part from a loop that reads 600 and stores 900 numbers, and s, the error."""
        shares = jnp.linspace(0.0, 1e-3, 300), jnp.linspace(1e-3, 0.0, 300)
        end, rows = jax.lax.scan(lambda c, row: (0.99 * c + row[0] * error, c * row[1]), jnp.zeros(3), shares)
        return -error - 2.0 * error_rate + 1e-3 * (end + rows[7] + rows[299]), error


@pytest.mark.skipif(shutil.which("make") is None or shutil.which("gcc") is None, reason="this machine has no gcc")
def test_documented_stack_size_includes_the_tables_of_loops(tmp_path):
    """The README must not state less than the 12 632 bytes that gcc reports."""
    folder.write_program(tmp_path, folder.Controller(with_custom_law(Tabled), "law", "a scenario"))
    (stated,) = re.findall(r"At most (\d+) bytes of stack", (tmp_path / "README.md").read_text())
    counted = dict(re.findall(r":(\w+)\t(\d+)", make(tmp_path, "stack").stdout))
    assert int(counted["ptsmc_law_step_double"]) + int(counted["command"]) <= int(stated) < 20_000


class Halving(ptsmc.AccelerationLaw):
    """PD with a command that is halved until it is small."""

    def acceleration(self, now: Any, error: Any, error_rate: Any, bound: Any) -> Any:
        """Return a PD command, halved by a loop with an unknown number of passes, and the error as s."""
        start = -error - 2.0 * error_rate
        return jax.lax.while_loop(lambda a: jnp.max(jnp.abs(a)) > 1.0, lambda a: 0.5 * a, start), error


@pytest.mark.parametrize(("law", "said"), [(Halving, True), (Odd, False)])
def test_readme_reports_loops_with_an_unknown_number_of_passes(law, said, tmp_path):
    folder.write_program(tmp_path, folder.Controller(with_custom_law(law), "law", "a scenario"))
    assert ("one pass of each loop with an unknown number of passes" in (tmp_path / "README.md").read_text()) == said


class Unsigned(Odd):
    """A law whose memory is an unsigned 64-bit integer, a type that the export refuses."""

    def begin(self) -> Any:
        """Return the initial memory, an unsigned integer of 64 bits [-]."""
        return jnp.zeros(1, jnp.uint64)

    def acceleration(self, now: Any, error: Any, error_rate: Any, bound: Any) -> Any:
        """Return a PD command, the error as s, and the memory plus one."""
        return -error - 2.0 * error_rate, error, now.memory + jnp.uint64(1)


class Lost(ptsmc.AccelerationLaw):
    """A law whose command becomes NaN."""

    def acceleration(self, now: Any, error: Any, error_rate: Any, bound: Any) -> Any:
        """Return a PD command, which is NaN after 2 s, and the error as s."""
        return jnp.where(now.t > 2.0, jnp.nan, -error - 2.0 * error_rate), error


@pytest.mark.parametrize(
    ("law", "said"),
    [
        (Unsigned, "^law has the type uint64, but must have"),
        (Lost, "^none of the first 1 trials is finite and away from the law's singularity"),
    ],
)
def test_export_raises_an_error_for_unsupported_or_diverging_laws(tmp_path, law, said):
    simulated = {**FLIGHTS["chain"], "controller": {"kind": "custom", "code": law, "t_f": 5.0}}
    made = scenario.reading.complete(scenario.from_tables(simulated))
    with pytest.raises(ScenarioError, match=said):
        folder.export(made, tmp_path / "controller", name="law", trials=1)


@needs_make
def test_make_check_starts_each_sample_from_the_simulated_state(exported, tmp_path):
    """Rounding errors thus do not accumulate. With a state of another time the next sample is invalid input."""
    place = shutil.copytree(exported, tmp_path / "controller")
    with (place / "vectors.csv").open() as file:
        header, *rows = csv.reader(file)
    rows[20][header.index("state.t")] = "100.0"
    (place / "vectors.csv").write_text("\n".join(map(",".join, [header, *rows])) + "\n")
    done = make(place, "check", QUICK)
    assert done.returncode != 0
    assert "130 samples; other status: 1;" in done.stdout


@needs_make
def test_reference_as_an_input_replays_the_simulation(tmp_path):
    """The reference of the vectors moves. Its quaternion may change its sign from sample to sample."""
    made = scenario.reading.complete(scenario.from_tables(FLIGHTS["slew"]))
    place = folder.export(made, tmp_path / "controller", name="led", trials=1, reference_input=True)
    done = make(place, "check", QUICK)
    assert done.returncode == 0, done.stdout + done.stderr
    assert "65 samples; other status: 0" in done.stdout
    library = Library(place, options=("-O0",))
    first = library.columns["in"].index("reference_q[0]")
    with (place / "vectors.csv").open() as file:
        _, *rows = csv.reader(file)
    given = np.array([row[3 : 3 + len(library.columns["in"])] for row in rows[1:]], float)
    assert np.ptp(given[:, first + 2]) > 0.3
    states, found = [library.initial_state(), library.initial_state()], []
    for k, row in enumerate(given):
        other = row.copy()
        other[first : first + 4] *= (-1.0) ** k
        for j, one in enumerate((row, other)):
            states[j], out, status = step_many(library, states[j], one)
            found.append(out)
            assert status == 0
        assert found[-1].tobytes() == found[-2].tobytes()
    given[0, first : first + 4] = 0.1  # not a rotation
    assert step_many(library, library.initial_state(), given[0])[2] == 4


@needs_make
def test_random_input_passes_a_short_fuzz_run(exported, tmp_path):
    """The run has a hundredth of the rounds of `make fuzz`, with sanitizers if the compiler has them."""
    place = shutil.copytree(exported, tmp_path / "controller")
    text = (place / "Makefile").read_text().replace("1000000", "10000")
    (place / "Makefile").write_text(text)
    done = make(place, "fuzz")
    if "sanitize" in done.stderr and "cannot find" in done.stderr:
        done = make(place, "fuzz", "SANITIZE=-O1")
    assert done.returncode == 0, done.stdout + done.stderr
    assert done.stdout.splitlines()[-1].startswith("10000 rounds:")


def test_exported_test_vectors_equal_the_simulated_run(exported):
    """Commands, estimates and s in vectors.csv equal the history of the same trial."""
    with (exported / "vectors.csv").open() as file:
        header, *rows = csv.reader(file)
    mine = [row for row in rows if row[0] == "1" and row[1] != "-1"]
    ready = scenario.study(scenario.read(exported / "scenario.toml"))
    parts = ready.dispersion.apply(ready.parts, jnp.uint32(0), jnp.uint32(1))
    log = fly(parts, 0, 1).log
    for name, column in (("out.command", log.commanded), ("out.d_hat", log.d_hat), ("out.s", log.s)):
        at = header.index(f"{name}[0]")
        found = np.array([[float(v) for v in row[at : at + 3]] for row in mine])
        np.testing.assert_allclose(found, column[: len(found)], rtol=1e-11, atol=1e-13)


def test_rounding_tolerance_uses_the_gain_growth_until_the_last_sample_before_the_hand_over(exported):
    """At this sample, delta + h before t_f, the gains are (t_f / (delta + h))^2 times the initial gains.

    From rest the error is |v| r^3 (1 + 3 ln(1/r)) with r = (t_f - t) / t_f. Divided by r^2 it is at most
    3 e^(-2/3) |v|.
    """
    with (exported / "vectors.csv").open() as file:
        starts = [row for row in csv.DictReader(file) if row["sample"] == "0"]
    farthest = max(np.linalg.norm([float(row[f"in.attitude[{k}]"]) for k in range(3)]) for row in starts)
    (told,) = re.findall(r"8\.9e-16\) \* ([\d.e+-]+);", (exported / "check.c").read_text())
    expected = 4.0 * (5.0 / (0.5 + 0.1)) ** 2 / (3.0 * np.exp(-2.0 / 3.0) * farthest)
    np.testing.assert_allclose(float(told), expected, rtol=0.05)  # sampled every 0.02 t_f


def test_other_gains_change_only_the_parameter_file_of_the_exported_c(exported, tmp_path):
    known = scenario.replace(
        scenario.read(exported / "scenario.toml"), controller__eta=2.8, spacecraft__inertia=[9, 11, 13]
    )
    other = folder.export(known, tmp_path / "other", name="short", trials=2)

    def code(place):
        return (place / "ptsmc_short.c").read_text().splitlines()[3:]

    assert code(other) == code(exported)
    assert (other / "ptsmc_short_parameters.c").read_text() != (exported / "ptsmc_short_parameters.c").read_text()


def test_exported_c_has_the_names_and_equations_of_the_law(exported):
    text = (exported / "ptsmc_short.c").read_text()
    assert "(56) and (57) in the approach phase, (59) and (60) in the hold phase." in text.replace("\n * ", " ")
    for line in (
        "const real error_1 = now->attitude[0] - p->reference_q[0];",
        "const real acceleration_3 = -switching_3",
    ):
        assert line in text
    header = (exported / "ptsmc_short.h").read_text()
    assert "exponent of the approach phase" in header
    assert "/* c of Assumption 1, bound on each component of d' [N m/s] */" in header


def test_the_documentation_names_every_file_input_and_output_of_an_export(exported):
    files = {path.name for path in exported.iterdir()}
    readme = (exported / "README.md").read_text()
    assert not [name for name in files - {"README.md"} if f"`{name}`" not in readme]
    found = {name.replace("_short", "_NAME") for name in files}

    def slow(name, reference_input=False):
        return {**FLIGHTS[name], "hardware": {**FLIGHTS[name]["hardware"], "torque_lag": 0.1}}, reference_input

    exports = [slow("star tracker out of step"), slow("wheels with lag, limits, delay"), slow("chain", True)]
    for tables, reference_input in (*exports, (FLIGHTS["raw"], True)):
        made = build_board(scenario.study(scenario.from_tables(tables)).parts, reference_input)
        columns = generate.column_names(made)
        found |= {column.partition("[")[0] for struct in ("in", "out") for column in columns[struct]}
        assert any("[N m]" in meaning for meaning in made.meanings.values()) == ("plant" not in tables)
    page = (ROOT / "docs" / "export.md").read_text()
    assert not [name for name in found if f"`{name}`" not in page]


def test_singularity_limit_in_c_equals_that_of_the_simulator(monkeypatch):
    monkeypatch.setattr(rollout, "SINGULAR_DISTANCE", 0.0125)
    made = folder.Controller(scenario.from_tables(flight()), "short", "a scenario")
    code = templates.controller_texts(made.code, made.info)["ptsmc_short.c"]
    limits = re.findall(r"singularity_distance >= R\((.*?)\)", code)
    assert limits == ["0.0125", "0.0125"]


def test_command_filter_advances_by_one_period_after_missed_samples():
    """The prewarped tan(W h / 2) of a longer gap could have any value. At the first sample the output is zero."""
    tables = flight(controller={"error": "multiplicative"}, hardware={"command_filter": {"kind": "first_order"}})
    parts: Any = scenario.study(scenario.from_tables(tables)).parts
    known = {"t": 1.0, "tracking": 1, "out.d_hat": np.zeros(3), "before.law": parts.controller.begin(),
             "before.command_filter": np.zeros(3), "now.attitude": parts.initial.q, "now.rate": np.zeros(3),
             "before.singularity_distance_unit": 1.0, "last.command": np.ones(3), "last.s": np.zeros(3)}  # fmt: skip

    def commanded(simulated, gap):
        made = build_board(simulated)
        (stage,) = (one for one in made.stages if one.name == "command")
        values = jax.tree.map(jnp.asarray, known | {"dt": gap})
        return np.asarray(stage.run(made.parameters, values)["out.command"])

    period = float(parts.period)
    g = np.tan(0.5 * float(parts.command_filter.corner) * period)
    once = commanded(parts, period)
    np.testing.assert_allclose(once, g / (1.0 + g) * commanded(replace(parts, command_filter=None), period), rtol=1e-13)
    np.testing.assert_array_equal(commanded(parts, 7.0 * period), once)
    np.testing.assert_array_equal(commanded(parts, 0.0), 0.0)


def test_identifier_returns_valid_c_names():
    assert [folder.identifier(name) for name in ("tuned", "2 flights", "é-x", "")] == ["tuned", "c_2_flights", "x", "c"]
