"""`ptsmc export`, and simulations with the exported C in the loop."""

import shlex
import sys
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Literal

from cyclopts import Parameter

from tuning.cli.options import Force, Out, Quiet, Seed, Trust, prepare, whole_number
from tuning.errors import UsageError
from tuning.output import terminal

if TYPE_CHECKING:
    from ptsmc_jax.onboard.library import InTheLoop
    from ptsmc_jax.scenario.assembly import Study
    from ptsmc_jax.scenario.tables import Scenario

ControllerFolder = Annotated[
    Path | None,
    Parameter(help="Folder of `ptsmc export`: its C code is compiled and controls the simulation."),
]


def export(
    scenario: Annotated[
        Path, Parameter(name="SCENARIO", help='Scenario file (TOML) with loop.mode = "sampled", such as a tuned.toml.')
    ],
    /,
    *,
    out: Out = None,
    name: Annotated[
        str | None,
        Parameter(
            help="Name of the C files, with _ for signs that C does not allow; default: the name of the scenario file."
        ),
    ] = None,
    trials: Annotated[int, whole_number("Trials in vectors.csv, 1 to 100.", 1, 100)] = 3,
    seed: Seed = 0,
    reference_input: Annotated[
        bool, Parameter(negative="", help="Make the reference an input instead of a function of time in the C.")
    ] = False,
    fmu: Annotated[bool, Parameter(negative="", help="Write the controller as an FMU, too.")] = False,
    fmu_plant: Annotated[
        bool, Parameter(negative="", help="Write the true plant with actuators and sensors as an FMU, too.")
    ] = False,
    fmi: Annotated[Literal[2, 3] | None, Parameter(help="Version of FMI; default: a file for each.")] = None,
    no_binary: Annotated[
        bool, Parameter(negative="", help="Write FMUs without a binary for this machine; sources only.")
    ] = False,
    trust: Trust = False,
    force: Force = False,
    quiet: Quiet = False,
) -> int:
    """Export attitude filter, observer, law and wheel allocation of a scenario as C99, with test vectors.

    Exit status: 0 done, 2 configuration error, or a part that cannot be written in C.
    """
    if not (fmu or fmu_plant) and (fmi is not None or no_binary):
        option = "--no-binary is given" if fmi is None else f"--fmi is {fmi}"
        raise UsageError(f"{option}, but must be absent without --fmu or --fmu-plant")
    loaded, folder = prepare(scenario, "export", out, trust=trust, force=force)
    from ptsmc_jax.campaigns import store
    from ptsmc_jax.onboard import folder as controllers
    from ptsmc_jax.onboard import templates

    c_name = controllers.identifier(name or scenario.stem)
    controller = controllers.Controller(loaded, c_name, scenario.name, reference_input)
    fmus = controllers.Fmus(fmu, fmu_plant, fmi, not no_binary)
    with store.lock_folder(folder, force=force):
        store.write_folder(folder, lambda staging: controllers.write(staging, controller, seed, trials, fmus))
    if not quiet:
        counts = templates.count_operations(controller.code.counts)
        costs = ", ".join(f"{count} {operation}" for operation, count in counts.items() if count)
        check = f"make -C {shlex.quote(str(folder))} check"
        outputs = ", ".join(["controller", *fmus.files])
        terminal.print_lines(f"a step takes at most {costs}", f"{outputs} in {folder}; {check}")
    return 0


def on_flight_clock(scenario: "Scenario") -> "Scenario":
    """Return the scenario on the flight clock of exported C code. Raises ScenarioError if C cannot control it."""
    from ptsmc_jax.onboard import folder

    return folder.on_flight_clock(scenario)


def compile_controller(controller: Path, ready: "Study") -> "InTheLoop":
    """Compile the C of a folder for the parts of a study, and print which parameters differ.

    Raises ScenarioError if it does not compile or belongs to other parts.
    """
    from ptsmc_jax.onboard.library import InTheLoop, Library

    computer = InTheLoop(Library(controller), ready.parts, ready.dispersion)
    report_parameter_differences(computer)
    return computer


def report_parameter_differences(computer: "InTheLoop") -> None:
    """Print the parameters in which the compiled controller differs from the scenario."""
    if computer.parameter_differences:
        print(f"ptsmc: {computer.parameter_differences}", file=sys.stderr)


COMMANDS = (export,)
