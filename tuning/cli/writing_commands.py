"""Commands that write files without a study: a page of results, a scenario, C code; and convert attitudes."""

import json
import re
import shlex
from importlib.resources import files
from pathlib import Path
from typing import Annotated, Literal

from cyclopts import Parameter

from tuning.cli.options import Force, Out, Quiet, Seed, Trust, prepare, whole_number
from tuning.errors import UsageError
from tuning.output import terminal
from tuning.output.progress import Progress

Overwrite = Annotated[bool, Parameter(help="Overwrite existing files.")]


def report(
    folder: Annotated[Path, Parameter(name="DIR", help="Result folder of a command.")], /, *, quiet: Quiet = False
) -> int:
    """Write the results of a folder as one self-contained HTML page, DIR/report.html.

    Exit status: 0 done, 2 configuration error or damaged rows.
    """
    from ptsmc_jax.campaigns import store
    from tuning.output import page

    page.read(folder)  # raises RefusedError without a result
    with store.lock_folder(folder, shared=True):
        content = page.build(folder)
        store.write_folder(folder, lambda staging: store.write_text(staging / "report.html", content))
    if not quiet:
        terminal.print_lines(f"page in {folder / 'report.html'}")
    return 0


def new(
    file: Annotated[Path, Parameter(help="Scenario file to write.")] = Path("scenario.toml"),
    /,
    *,
    plant: str | None = None,
    like: Path | None = None,
    force: Overwrite = False,
    quiet: Quiet = False,
) -> int:
    """Write a scenario file with every key, its value, unit and meaning.

    Exit status: 0 done, 2 configuration error.

    Args:
        plant: Kind of the plant: spacecraft, chain or system; default: spacecraft.
        like: Scenario to start from; default: the default values.
    """
    from ptsmc_jax.campaigns import store
    from ptsmc_jax.scenario import layouts, parsing
    from tuning.cli import new as templates

    if str(file) in layouts.TABLES:
        raise UsageError(f"FILE is {file}, which is a kind of plant; allowed are --plant {file} and other file names")
    store.check_file(file, force)
    raw = parsing.load(like) if like is not None else {}
    store.write_text(file, templates.scenario_text(plant, raw))
    if not quiet:
        terminal.print_lines(f"scenario in {file}")
    return 0


def schema(
    file: Annotated[Path, Parameter(help="JSON Schema to write.")] = Path("scenario.schema.json"),
    /,
    *,
    force: Overwrite = False,
    quiet: Quiet = False,
) -> int:
    """Write a JSON Schema of scenario files. Editors use it to complete keys and to check values.

    Exit status: 0 done, 2 configuration error.
    """
    from ptsmc_jax.campaigns import store
    from ptsmc_jax.scenario.json_schema import json_schema

    store.check_file(file, force)
    store.write_text(file, json.dumps(json_schema(), indent=1) + "\n")
    if not quiet:
        terminal.print_lines(f"JSON Schema in {file}; in a scenario file: #:schema {file}")
    return 0


def examples(
    folder: Annotated[Path, Parameter(name="DIR", help="Folder to write the files to.")] = Path("scenarios"),
    /,
    *,
    force: Overwrite = False,
    quiet: Quiet = False,
) -> int:
    """Copy the packaged scenarios and the Python files that some of them name.

    Exit status: 0 done, 2 configuration error.
    """
    from ptsmc_jax.campaigns import store

    packaged = sorted(path for path in _examples().iterdir() if path.suffix in (".toml", ".py"))
    folder.mkdir(parents=True, exist_ok=True)
    for path in packaged:
        store.check_file(folder / path.name, force)
    for path in packaged:
        store.write_text(folder / path.name, path.read_text(encoding="utf-8"))
    if not quiet:
        terminal.print_lines(f"{len(packaged)} files in {folder}: {', '.join(path.name for path in packaged)}")
    return 0


def _examples() -> Path:
    """Return the folder of the packaged scenarios: in the package, or at the top of a checkout."""
    package = Path(str(files("ptsmc_jax")))
    installed = package / "examples"
    return installed if installed.is_dir() else package.parent / "scenarios"


def export(
    scenario: Annotated[Path, Parameter(help='Scenario file (TOML) with loop.mode = "sampled", such as a tuned.toml.')],
    /,
    *,
    out: Out = None,
    name: str | None = None,
    trials: Annotated[int, whole_number(1, 100)] = 3,
    seed: Seed = 0,
    reference_input: bool = False,
    fmu: bool = False,
    fmu_plant: bool = False,
    fmi: Literal[2, 3] | None = None,
    no_binary: bool = False,
    trust: Trust = False,
    force: Force = False,
    quiet: Quiet = False,
) -> int:
    """Export attitude filter, observer, law and wheel allocation of a scenario as C99, with test vectors.

    Exit status: 0 done, 2 configuration error, or a part that cannot be written in C.

    Args:
        name: Name of the C files, with _ for signs that C does not allow; default: the name of the scenario file.
        trials: Trials in vectors.csv, 1 to 100.
        reference_input: Make the reference an input instead of a function of time in the C.
        fmu: Write the controller as an FMU, too.
        fmu_plant: Write the true plant with actuators and sensors as an FMU, too.
        fmi: Version of FMI; default: a file for each.
        no_binary: Write FMUs without a binary for this machine; sources only.
    """
    if not (fmu or fmu_plant) and (fmi is not None or no_binary):
        option = "--no-binary is given" if fmi is None else f"--fmi is {fmi}"
        raise UsageError(f"{option}, but must be absent without --fmu or --fmu-plant")
    if name is not None and not re.search("[A-Za-z0-9]", name):
        raise UsageError(f'--name is "{name}", but must have a letter from A to Z or a digit')
    loaded, folder = prepare(scenario, "export", out, trust=trust, force=force)
    from ptsmc_jax.campaigns import store
    from ptsmc_jax.onboard import folder as controllers
    from ptsmc_jax.onboard import templates

    c_name = controllers.identifier(name or scenario.stem)
    controller = controllers.Controller(loaded, c_name, scenario.name, reference_input)
    fmus = controllers.Fmus(fmu, fmu_plant, fmi, not no_binary)
    with store.lock_folder(folder, force=force), Progress(quiet) as report_progress:
        report_progress("writing the controller and its test vectors", 0, 0)
        store.write_folder(folder, lambda staging: controllers.write(staging, controller, seed, trials, fmus))
    if not quiet:
        costs = templates.format_counts(controller.code.counts)
        check = f"make -C {shlex.quote(str(folder))} check"
        outputs = ", ".join(["controller", *fmus.files])
        terminal.print_lines(f"a step takes at most {costs}", f"{outputs} in {folder}; {check}")
        terminal.print_gains_hint(controller.scenario)
    return 0


# the first number may be negative
_Numbers = Annotated[str | None, Parameter(help="Numbers, separated by commas or spaces.", allow_leading_hyphen=True)]
_Rows = Annotated[str | None, Parameter(help="Nine numbers, row by row.", allow_leading_hyphen=True)]


def convert_attitude(
    *,
    quat_xyzw: _Numbers = None,
    quat_wxyz: _Numbers = None,
    rotvec_deg: _Numbers = None,
    mrp: _Numbers = None,
    dcm_body_to_inertial: _Rows = None,
    euler_deg: _Numbers = None,
    sequence: str | None = None,
) -> int:
    """Print one attitude, of the body relative to the inertial frame, in every form that a scenario takes.

    Exit status: 0 done, 2 configuration error.

    Args:
        sequence: Three axes in SciPy's notation, for euler_deg and for the output; default: ZYX.
    """
    from tuning.cli import convert

    texts = {
        "quat_xyzw": quat_xyzw, "quat_wxyz": quat_wxyz, "rotvec_deg": rotvec_deg, "mrp": mrp,
        "dcm_body_to_inertial": dcm_body_to_inertial, "euler_deg": euler_deg, "sequence": sequence,
    }  # fmt: skip
    terminal.print_lines(*convert.attitude_lines(convert.parse_quaternion(texts), sequence))
    return 0


COMMANDS = (report, new, schema, examples, convert_attitude)
