"""The command `ptsmc identify`."""

from pathlib import Path
from typing import Annotated

from cyclopts import Parameter

from tuning.cli.options import Figures, Force, Out, Quiet, Trust, prepare
from tuning.output import progress, terminal

LogFiles = Annotated[
    tuple[Path, ...], Parameter(name="LOG", help="Telemetry, .csv or .parquet; [telemetry] maps columns.")
]


def identify(
    scenario: Annotated[Path, Parameter(name="SCENARIO", help="Scenario file (TOML) with today's model.")],
    logs: LogFiles,
    /,
    *,
    validate: Annotated[
        tuple[Path, ...], Parameter(negative="", help="Log that is predicted only, to check the model; several times.")
    ] = (),
    out: Out = None,
    trust: Trust = False,
    force: Force = False,
    quiet: Quiet = False,
    figures: Figures = True,
) -> int:
    """Estimate the parameters in [identify] of a scenario from telemetry, and write the identified scenario.

    Exit status: 0 the model explains the logs and every parameter is determined, 1 not, 2 configuration error.
    """
    loaded, folder = prepare(scenario, "identify", out, trust=trust, force=force)
    from ptsmc_jax.campaigns import store
    from ptsmc_jax.identification import estimation, results, telemetry
    from tuning.studies import identifying

    read = [telemetry.measurements(loaded, telemetry.read(path), path.name) for path in logs]
    others = [telemetry.measurements(loaded, telemetry.read(path), path.name) for path in validate]
    with store.in_use(folder, force=force):
        with progress.Progress(quiet) as report:
            found = estimation.of_logs(loaded, read, others, report=lambda text: report(text, 0, 0))
        made_by = {"logs": [str(path) for path in logs], "validate": [str(path) for path in validate]}
        store.write(folder, lambda making: identifying.write(making, found, figures, made_by))
    if not quiet:
        from tuning.output import identify_report, summaries

        summary = summaries.read(summaries.Identified, results.summary(found))
        terminal.show(identify_report.of(summary), folder)
    return 0 if found.good else 1


COMMANDS = (identify,)
