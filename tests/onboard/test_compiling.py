"""Compilation of a controller's folder, and the error messages if it fails."""

import json
import re
import shutil
import subprocess

import jax
import pytest

from ptsmc_jax import scenario
from ptsmc_jax.onboard import folder, sources
from ptsmc_jax.onboard.library import InTheLoop, Library
from ptsmc_jax.scenario.errors import ScenarioError
from tests.onboard.compiled import CC, STRICT, needs_compiler, program
from tests.onboard.flights import FLIGHTS


@pytest.fixture(scope="module")
def chain(tmp_path_factory):
    """Return the folder with the exported controller of a chain."""
    place = tmp_path_factory.mktemp("exported") / "controller"
    program(FLIGHTS["chain"], place)
    return place


def parts(name, **loop):
    """Return the parts of a scenario in FLIGHTS on the flight clock, with changes of its loop table."""
    tables = {**FLIGHTS[name], "loop": {**FLIGHTS[name]["loop"], **loop}}
    return scenario.study(folder.on_flight_clock(scenario.reading.complete(scenario.from_tables(tables)))).parts


@needs_compiler
def test_a_controller_that_is_absent_or_does_not_fit_or_compile_raises_an_error(chain, tmp_path):
    with pytest.raises(ScenarioError, match=r"^the controller is .*nothing, but must be a folder that ptsmc export"):
        Library(tmp_path / "nothing")
    library = Library(chain)
    with pytest.raises(ScenarioError, match="has other inputs than the scenario"):
        InTheLoop(library, parts("raw"))
    with pytest.raises(ScenarioError, match=r"^loop\.period is 0\.2 s, but must be 0\.1 s as in the controller in "):
        InTheLoop(library, parts("chain", period=0.2))
    shutil.copytree(chain, tmp_path / "controller")
    (tmp_path / "controller" / "ptsmc_flight.c").write_text("int main(void) { return }\n")
    with pytest.raises(ScenarioError, match=r"^the \*\.c and \*\.h files of .* do not compile: .*error: "):
        Library(tmp_path / "controller")


@needs_compiler
def test_compiled_files_are_those_that_a_campaign_copies_and_checks(chain, tmp_path):
    """Headers in the controller's folder are copied and part of the checksum. A header in another folder is refused."""
    changed = shutil.copytree(chain, tmp_path / "changed")
    code = changed / "ptsmc_flight.c"
    code.write_text('#include "board.h"\n' + code.read_text())
    (changed / ".#ptsmc_flight.c").symlink_to("somebody@elsewhere:1")  # lock file of an editor, a dangling link
    (changed / "board.h").touch()
    Library(changed)
    before = sources.checksum(changed)
    (changed / "board.h").write_text("/* changed */\n")
    assert sources.checksum(changed) != before
    sources.copy(changed, tmp_path / "kept")
    Library(tmp_path / "kept")
    (changed / "other").mkdir()
    (changed / "board.h").rename(changed / "other" / "board.h")
    code.write_text('#include "other/board.h"\n' + code.read_text())
    with pytest.raises(ScenarioError, match=r"changed/ptsmc_flight\.c:1:.* error: .*other/board\.h"):
        Library(changed)


@needs_compiler
def test_a_second_c_file_must_be_included(chain, tmp_path):
    """Otherwise the error message names the undefined symbol."""
    changed = shutil.copytree(chain, tmp_path / "changed")
    code = changed / "ptsmc_flight.c"
    (changed / "mine.c").write_text("double mine(double x) { return 2.0 * x; }\n")
    call = r"\1\n    if (mine(p->period) < 0.0) return 1;"
    calls = re.sub(r"^(int ptsmc_flight_step\([^{]*\{)", call, code.read_text(), flags=re.MULTILINE)
    code.write_text(f"double mine(double x);\n{calls}")
    with pytest.raises(ScenarioError, match=r"undefined symbol: mine; use a .* ptsmc_flight_parameters\.c"):
        Library(changed)
    code.write_text(f'#include "mine.c"\n{calls}')
    Library(changed)


@needs_compiler
def test_a_folder_with_the_layout_of_another_controller_raises_an_error(chain, tmp_path):
    """C would write beyond the rows of another layout. Values of a wrong type must not end in a traceback."""
    shutil.copytree(chain, tmp_path / "other")
    layout = json.loads((chain / "controller.json").read_text())
    fewer = {**layout["columns"], "state": layout["columns"]["state"][1:]}
    for changed in ({"name": 5}, {"period": 10**400}, {"columns": {"params": [1]}}, {"columns": fewer}):
        (tmp_path / "other" / "controller.json").write_text(json.dumps({**layout, **changed}))
        with pytest.raises(ScenarioError, match=r"^the controller is .*other, but must be a folder that ptsmc export"):
            Library(tmp_path / "other")


@needs_compiler
def test_cc_may_have_options_and_must_compile_for_this_machine(chain, monkeypatch, tmp_path):
    """CC is the compiler command. Warnings of -pedantic in XLA's headers must not stop the compilation."""
    monkeypatch.chdir(tmp_path)
    shutil.copytree(chain, "-c")
    monkeypatch.setenv("CC", f"{CC} -pedantic -Wall -Wextra -Werror")
    Library("-c")
    monkeypatch.setenv("CC", "true")
    said = "does not load after true has compiled it: .* use a C compiler for this machine"
    with pytest.raises(ScenarioError, match=said):
        Library("-c")


@needs_compiler
def test_a_period_rounded_to_32_bits_agrees_with_the_period_of_the_controller(chain):
    """The comparison of periods allows for the rounding of 32 bits."""
    library = Library(chain)
    with jax.enable_x64(False):
        known = parts("chain")
        assert float(known.period) != library.period
        InTheLoop(library, known)


def compiled(compiler, *arguments):
    """Run a C compiler with these arguments and strict warnings; return the finished process with its output."""
    return subprocess.run([compiler, *STRICT, *map(str, arguments)], capture_output=True, text=True, check=False)


compilers = pytest.mark.parametrize("compiler", [name for name in ("gcc", "clang") if shutil.which(name)])


@compilers
@pytest.mark.parametrize("option", ["-ffast-math", "-Ofast", "-ffinite-math-only"])
def test_code_does_not_compile_with_options_that_disable_nan(chain, compiler, option):
    """With such options a NaN input would pass all checks, with status 0 and an estimate that remains NaN."""
    done = compiled(compiler, option, "-fsyntax-only", chain / "ptsmc_flight.c")
    assert done.returncode != 0
    assert "compile without -ffast-math" in done.stderr


TWO = """
#include <string.h>
#include "ptsmc_flight_flat.h"
#include "ptsmc_other_flat.h"

int main(void)
{
    ptsmc_flight_state state;
    ptsmc_other_state other;
    ptsmc_flight_init(&ptsmc_flight_parameters, &state);
    ptsmc_other_init(&ptsmc_other_parameters, &other);
    return PTSMC_FLIGHT_OK + PTSMC_OTHER_OK;
}
"""


@compilers
def test_two_controllers_link_into_one_program(chain, tmp_path, compiler):
    other = tmp_path / "other"
    folder.export(scenario.from_tables(FLIGHTS["raw"]), other, name="other", trials=1)
    (tmp_path / "main.c").write_text(TWO)
    code = [place / f"ptsmc_{name}{end}.c" for place, name in ((chain, "flight"), (other, "other"))
            for end in ("", "_parameters")]  # fmt: skip
    program = tmp_path / "main"
    done = compiled(compiler, f"-I{chain}", f"-I{other}", *code, tmp_path / "main.c", "-o", program, "-lm")
    assert done.returncode == 0, done.stderr
    assert subprocess.run([program], check=False).returncode == 0


@compilers
@pytest.mark.parametrize(("real", "of_check"), [("double", "float"), ("float", "double")])
def test_files_of_different_precision_do_not_link(chain, tmp_path, compiler, real, of_check):
    objects = []
    for name, precision in (("ptsmc_flight", real), ("ptsmc_flight_parameters", real), ("check", of_check)):
        objects.append(tmp_path / f"{name}.o")
        done = compiled(compiler, f"-DPTSMC_REAL={precision}", "-c", chain / f"{name}.c", "-o", objects[-1])
        assert done.returncode == 0, done.stderr
    done = compiled(compiler, *objects, "-o", tmp_path / "check", "-lm")
    assert done.returncode != 0
    assert f"ptsmc_flight_init_{of_check}" in done.stderr


@needs_compiler
@pytest.mark.parametrize("name", ["in", "init", "state", "parameters"])
def test_a_controller_may_have_the_name_of_one_of_its_symbols(tmp_path, name):
    """A controller with a name such as `init`, which its C code also uses for a function or a variable, compiles."""
    folder.export(scenario.from_tables(FLIGHTS["chain"]), tmp_path / "out", name=name, trials=1)
    assert Library(tmp_path / "out").name == name
