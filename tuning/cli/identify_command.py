"""The command `ptsmc identify`."""

from pathlib import Path
from typing import Annotated

from cyclopts import Parameter

from tuning.cli.options import USUAL, Common, Out, positive, prepare
from tuning.errors import UsageError
from tuning.output import progress, terminal


def identify(
    scenario: Annotated[Path, Parameter(name="SCENARIO", help="Scenario file (TOML) with today's model.")],
    *logs: Annotated[Path, Parameter(name="LOG", help="Telemetry, .csv or .parquet; [telemetry] maps its columns.")],
    validate: tuple[Path, ...] = (),
    design: bool = False,
    duration: Annotated[float | None, positive("s")] = None,
    rate: Annotated[float | None, positive("rad/s")] = None,
    torque: Annotated[float | None, positive("N m")] = None,
    out: Out = None,
    common: Common = USUAL,
) -> int:
    """Estimate the parameters in [identify] of a scenario from telemetry, and write the identified scenario.

    With --design it proposes the manoeuvre to record instead.

    Ctrl-C in the first local search writes nothing. A later Ctrl-C writes the best estimates so far, marked as not
    converged.

    Exit status: 0 the model explains the logs, and logs and prior knowledge together determine every parameter; 1 not;
    2 configuration error.

    Args:
        validate: Log that is predicted only, to check the model; several times.
        design: Propose a torque profile that determines the parameters; without logs.
        duration: Duration of the profile in s or with a unit; default: 5 t_f.
        rate: Largest rate in the profile in rad/s or with a unit, such as "2 deg/s"; default: 3 rad / t_f.
        torque: Largest torque in N m or with a unit; default: of the actuators.
    """
    if design == bool(logs):
        raise UsageError(
            "--design needs no log: leave the log files out"
            if design
            else "give at least one log file after the scenario, or --design"
        )
    design_options = {"--duration": duration, "--rate": rate, "--torque": torque}
    misplaced = next((name for name, value in design_options.items() if value is not None), None)
    if misplaced is not None and not design:
        raise UsageError(f"{misplaced} is {design_options[misplaced]}, but must be absent without --design")
    if design and validate:
        raise UsageError("--validate needs a log for the estimates, and does not go with --design")
    loaded, folder = prepare(scenario, "identify", out, trust=common.trust, force=common.force)
    from ptsmc_jax.campaigns import store
    from ptsmc_jax.identification import design as designing
    from ptsmc_jax.identification import estimation, results, telemetry
    from tuning.studies import identifying

    if design:
        with store.lock_folder(folder, force=common.force):
            with progress.Progress(common.quiet) as report:
                profile = designing.design(
                    loaded, duration, rate=rate, torque=torque, report=lambda text: report(text, 0, 0)
                )
            write = identifying.write_design
            store.write_folder(folder, lambda staging: write(staging, loaded, profile, common.figures))
        if not common.quiet:
            terminal.print_result("identify", identifying.design_summary(profile), loaded.plant.kind, folder)
        return 0
    fitted, predicted = (
        [telemetry.measurements(loaded, telemetry.read(path), path.name) for path in paths]
        for paths in (logs, validate)
    )
    with store.lock_folder(folder, force=common.force):
        with progress.Progress(common.quiet) as report:
            result = estimation.estimate_parameters(loaded, fitted, predicted, report=lambda text: report(text, 0, 0))
        made_by = {"logs": [str(path) for path in logs], "validate": [str(path) for path in validate]}
        store.write_folder(folder, lambda staging: identifying.write(staging, result, common.figures, made_by))
    if not common.quiet:
        terminal.print_result("identify", results.summary(result), loaded.plant.kind, folder)
    return 0 if result.is_identified else 1
