"""The `ptsmc` command. Commands that compute import JAX after they have checked their arguments."""

import dataclasses
import functools
import io
import sys
from pathlib import Path
from typing import Annotated, Literal

from cyclopts import App, CycloptsError, Parameter
from cyclopts.exceptions import UnknownOptionError, UnusedCliTokensError

import ptsmc_jax
from tuning.cli import INTERRUPTED, campaign_commands, identify_command, searches, writing_commands
from tuning.cli.options import (
    USUAL,
    Common,
    ControllerFolder,
    Device,
    Figures,
    Force,
    Out,
    Quiet,
    SampledFile,
    ScenarioFile,
    Seed,
    parse_traded_values,
    prepare,
    whole_number,
)
from tuning.errors import UsageError
from tuning.output import progress, terminal

app = App(
    name="ptsmc",
    help="Prescribed-time sliding mode attitude control: simulate, tune, verify and export.",
    version=ptsmc_jax.__version__,
    help_format="plaintext",
    default_parameter=Parameter(negative=""),
    suppress_keyboard_interrupt=False,
)


@app.command
def simulate(
    scenario: ScenarioFile = None,
    /,
    *,
    out: Out = None,
    seed: Seed = 0,
    trial: Annotated[int | None, whole_number()] = None,
    controller: ControllerFolder = None,
    aem: bool = False,
    common: Common = USUAL,
) -> int:
    """Simulate one run and write its history, metrics and figures.

    Exit status: 0 every requirement met, 1 not met or the run failed, 2 configuration error.

    Args:
        trial: Simulate this dispersed trial; default: nominal parameters with the noise of trial 0.
        aem: Write attitude.aem too, a CCSDS attitude ephemeris message.
    """
    loaded, folder = prepare(scenario, "simulate", out, trust=common.trust, in_c=controller is not None)
    from ptsmc_jax.campaigns import runs, store
    from ptsmc_jax.scenario import study, timing
    from ptsmc_jax.simulation.computer import PYTHON_SOFTWARE
    from tuning.studies import single

    if aem and loaded.motion != "spacecraft":
        raise UsageError("--aem is given, but the plant is no spacecraft and has no attitude")
    store.check_folder(folder, common.force)
    ready = study(loaded, drawn=trial is not None)
    computer = None
    if controller is not None:
        from ptsmc_jax.onboard.library import InTheLoop, Library

        computer = InTheLoop(Library(controller), ready.parts, ready.dispersion)
        if computer.parameter_differences:
            print(f"ptsmc: {computer.parameter_differences}", file=sys.stderr)
    with store.lock_folder(folder, force=common.force), progress.Progress(common.quiet) as report:
        report(f"simulating {timing.count_steps(ready.parts)} integration steps with their history", 0, 0)
        run = runs.simulate(ready, seed, trial, PYTHON_SOFTWARE if computer is None else computer.software)
        written = loaded, run, seed, trial, common.figures, computer
        store.write_folder(folder, lambda staging: single.write(staging, *written, aem=aem))
    if not common.quiet:
        terminal.print_result("simulate", single.summary(run, loaded, computer), loaded.plant.kind, folder)
        if not run.met and computer is None:
            terminal.print_gains_hint(loaded)
    return 0 if run.met else 1


@app.command
def reproduce(*, out: Out = None, force: Force = False, quiet: Quiet = False, figures: Figures = True) -> int:
    """Simulate every figure of the paper, and compare its claims and errors with measurements.

    Exit status: 0 done, 1 a run failed, 2 configuration error.
    """
    from ptsmc_jax.campaigns import store

    folder = out if out is not None else Path("out") / "reproduce"
    store.check_folder(folder, force)
    from ptsmc_jax.configure import configure

    configure(keep_programs=True)
    from tuning.studies import reproduction

    with store.lock_folder(folder, force=force):
        with progress.Progress(quiet) as report:
            report("simulating the paper's figures", 0, 0)
            reproduced = reproduction.reproduce()
        store.write_folder(folder, lambda staging: reproduction.write(staging, reproduced, figures))
    if not quiet:
        terminal.print_result("reproduce", reproduction.summary(reproduced), "spacecraft", folder)
    return 0 if reproduced.ok else 1


@app.command(name="map")
def map_(
    scenario: SampledFile = None,
    /,
    *,
    x: Annotated[
        str | None,
        Parameter(
            help="KEY=LOW:HIGH:COUNT, with numbers in the unit of the key or with a unit, such as "
            "loop.period=20ms:0.2s:9; KEY[0] for one number of a list; default: loop.period, 0.4 to 10 times its value."
        ),
    ] = None,
    y: str | None = None,
    trials: Annotated[int, whole_number(1, 1_000_000)] = 32,
    out: Out = None,
    seed: Seed = 0,
    device: Device = "cpu",
    common: Common = USUAL,
) -> int:
    """Simulate the scenario over two of its keys: error and peak torque, with the stability limits of linear theory.

    Exit status: 0 done, 2 configuration error. A pair that is not allowed or fails is marked, not dropped.

    Args:
        y: KEY=LOW:HIGH:COUNT; default: delta from a period to t_f / 7, or the law's first gain.
        trials: Trials of each pair, 1 to 1000000.
    """
    loaded, folder = prepare(scenario, "map", out, device, trust=common.trust)
    from ptsmc_jax.campaigns import store
    from tuning.studies import mapping

    x_axis = mapping.parse_axis(x or mapping.default_period_axis(loaded), "--x", loaded)
    y_axis = mapping.parse_axis(y or mapping.default_gain_axis(loaded), "--y", loaded)
    if x_axis.key == y_axis.key:
        raise UsageError(f"--y is {y_axis.text}, but must be another key than --x")
    with store.lock_folder(folder, force=common.force):
        with progress.Progress(common.quiet) as report:
            results = mapping.simulate(
                loaded, x_axis, y_axis, seed, trials, lambda done, total: report("simulating pairs", done, total)
            )
        store.write_folder(folder, lambda staging: mapping.write(staging, results, seed, common.figures))
    if not common.quiet:
        from tuning.output import reports

        pairs = [dataclasses.asdict(cell) for cell in results.cells]
        x_label, y_label = (mapping.label_with_unit(loaded, axis.key) for axis in (x_axis, y_axis))
        terminal.print_lines(*reports.map_lines(pairs, (x_label, y_label), loaded.plant.kind), f"results in {folder}")
        if loaded.requirements and not any(cell.meets == 1 for cell in results.cells):
            terminal.print_gains_hint(loaded)
    return 0


@app.command
def margins(
    scenario: SampledFile = None,
    /,
    *,
    out: Out = None,
    common: Common = USUAL,
) -> int:
    """Print the gain, phase and delay margins and the peak sensitivity of the nominal loop.

    They are computed in the hold phase and in the frozen approach phase. The nominal loop has no dispersions. `tune`
    and `montecarlo` judge required margins by the worst dispersed loop.

    Exit status: 0 stable in the hold phase, 1 not stable or open in the hold phase, 2 configuration error.
    """
    loaded, folder = prepare(scenario, "margins", out, trust=common.trust, force=common.force)
    from ptsmc_jax.campaigns import store
    from tuning.studies import stability

    with store.lock_folder(folder, force=common.force):
        with progress.Progress(common.quiet) as report:
            report("linearising the loop", 0, 0)
            ready, course = stability.find_margins(loaded)
        store.write_folder(folder, lambda staging: stability.write(staging, ready, course, common.figures))
    summary = stability.summary(ready, course)
    if not common.quiet:
        terminal.print_result("margins", summary, loaded.plant.kind, folder)
    return 0 if summary["stable"] and not summary["open"] else 1


@app.command
def tune(
    scenario: ScenarioFile = None,
    /,
    *,
    out: Out = None,
    seed: Seed = 0,
    global_check: bool = False,
    device: Device = "cpu",
    common: Common = USUAL,
) -> int:
    """Find the gains with the smallest error after t_f that meet every requirement, and verify them on held-out trials.

    Ctrl-C ends the search and verifies the best gains so far. A second Ctrl-C, or one after the search, stops without a
    result. In each case, the same command resumes.

    Exit status: 0 every requirement met on the held-out trials, 1 not met, 2 configuration error, 130 interrupted.

    Args:
        global_check: Check the result by differential evolution, an independent global search.
    """
    loaded, folder = prepare(scenario, "tune", out, device, trust=common.trust)
    from ptsmc_jax.scenario.tables import objective_name
    from tuning.studies import posing, tune_files, tuner

    loaded = posing.with_tune(loaded)
    identity = tune_files.identity(loaded, seed, with_global_check=global_check) | {"device": device}
    search = searches.LongSearch(
        identity,
        objective_name(loaded.search),
        work=lambda report, journal: tuner.tune(loaded, seed, report, journal, with_global_check=global_check),
        write=lambda staging, tuning: tune_files.write(staging, loaded, tuning, common.figures, identity),
    )
    return searches.run(search, loaded, folder, force=common.force, quiet=common.quiet)


@app.command
def pareto(
    scenario: ScenarioFile = None,
    /,
    *,
    against: Literal["torque", "margins", "t_f"] = "torque",
    points: Annotated[int | None, whole_number(3, 100)] = None,
    limits: Annotated[
        str | None,
        Parameter(
            help="Limits on the peak sensitivity max |S| to tune for, with --against margins [dB], such as 4,6. "
            "Default: 3 to 12. The gains without a limit are found, too."
        ),
    ] = None,
    times: str | None = None,
    out: Out = None,
    seed: Seed = 0,
    device: Device = "cpu",
    common: Common = USUAL,
) -> int:
    """Trace the Pareto front of accuracy against peak torque, margins or slew time, verified on held-out trials.

    After Ctrl-C or a kill, the same command resumes the search.

    Exit status: 0 a point of the front meets every requirement, 1 none does, 2 configuration error, 130 interrupted.

    Args:
        against: Quantity that the accuracy is traded against.
        points: Number of torque limits, each with its own tuned gains, 3 to 100; default: 20.
        times: Prescribed times to tune for, with --against t_f, such as 20,30 or 20s,1min; default: t_f / 2 to 2 t_f.
    """
    values = parse_traded_values(against, points, times, limits)
    loaded, folder = prepare(scenario, "pareto", out, device, trust=common.trust)
    from tuning.studies import pareto as fronts
    from tuning.studies import posing, trades

    trade = trades.build(against, posing.with_tune(loaded), points, values)
    loaded, identity = trade.scenario, trade.identity(seed) | {"device": device}
    search = searches.LongSearch(
        identity,
        "window error",
        work=lambda report, journal: fronts.trace(trade, seed, report, journal),
        write=lambda staging, traced_front: fronts.write(staging, trade, traced_front, common.figures, identity),
    )
    return searches.run(search, loaded, folder, force=common.force, quiet=common.quiet)


@app.command
def compare(
    scenario: SampledFile = None,
    /,
    *,
    out: Out = None,
    seed: Seed = 0,
    against: Annotated[
        tuple[str, ...] | None,
        Parameter(
            help="Law to compare with: pd, terminal, fixed_time, time_base_pd, time_base_sliding, scaling, "
            "predefined_time, super_twisting; repeat the option for several. Default: all of them. The prescribed-time "
            "law is always compared.",
        ),
    ] = None,
    law: Annotated[tuple[str, ...], Parameter(show_default=False)] = (),
    device: Device = "cpu",
    common: Common = USUAL,
) -> int:
    """Tune the prescribed-time law and other attitude laws to the same requirements, and compare them.

    After Ctrl-C or a kill, the same command resumes the search.

    All tuned laws are verified on the same held-out trials. Only the prescribed-time law decides the exit status, even
    if the scenario has another law.

    Exit status: 0 the tuned prescribed-time law meets every requirement, 1 it does not, 2 configuration error, 130
    interrupted.

    Args:
        law: Custom law, FILE.py:NAME, to include in the comparison; repeat the option for several.
    """
    loaded, folder = prepare(scenario, "compare", out, device, trust=common.trust)
    from ptsmc_jax.scenario.tables import objective_name
    from tuning.studies import compare as comparing
    from tuning.studies import posing

    rivals = comparing.Rivals(against, law)
    rivals.check()
    comparing.check(loaded)
    loaded = posing.with_tune(loaded)
    contenders = functools.cache(lambda: comparing.validated_contenders(loaded, rivals))

    def check() -> None:
        for name, contender in contenders().items():
            for text in comparing.warn_about_plain_numbers(contender):
                print(f"ptsmc: {name}: {text}", file=sys.stderr)

    identity = comparing.identity(loaded, seed, rivals) | {"device": device}
    search = searches.LongSearch(
        identity,
        objective_name(loaded.search),
        work=lambda report, journal: comparing.compare(loaded, seed, report, journal, contenders()),
        write=lambda staging, comparison: comparing.write(staging, loaded, comparison, common.figures, identity),
        check=check,
    )
    return searches.run(search, loaded, folder, force=common.force, quiet=common.quiet)


@app.command
def completion(
    shell: Literal["bash", "zsh", "fish", "powershell"],
    /,
) -> int:
    """Print the script that completes commands and options in a shell: source <(ptsmc completion bash).

    Exit status: 0 done, 2 configuration error.

    Args:
        shell: Name of the shell.
    """
    terminal.print_lines(app.generate_completion(shell=shell))
    return 0


_COMMANDS = (
    *writing_commands.COMMANDS,
    *campaign_commands.COMMANDS,
    writing_commands.export,
    identify_command.identify,
)
for _command in _COMMANDS:
    app.command(_command)


def main() -> None:
    """Run a command; a configuration error ends it with one sentence and exit status 2, without a traceback."""
    status: object = None
    if isinstance(sys.stdout, io.TextIOWrapper) and sys.stdout.errors == "strict":
        sys.stdout.reconfigure(errors="backslashreplace")  # like the error stream: file names contain any character
    try:
        status = app(sys.argv[1:], exit_on_error=False, print_error=False, result_action="return_value")
    except KeyboardInterrupt as error:
        print(f"ptsmc: interrupted; {error if error.args else 'nothing was written'}", file=sys.stderr)
        status = INTERRUPTED
    except UnusedCliTokensError as error:
        _fail(_describe_unused_arguments(error))
    except UnknownOptionError as error:
        _fail(_describe_unknown_option(error))
    except CycloptsError as error:
        refused = error.__cause__
        _fail(str(refused) if isinstance(refused, UsageError) else " ".join(str(error).split()))
    except OSError as error:
        name = error.filename2 or error.filename  # for a move, filename2 is its target; None if the disk is full
        _fail(f"{error.strerror or error}{'' if name is None else f': {name}'}")
    except (Exception, SystemExit) as error:  # custom code may exit
        _fail(str(error) if _is_configuration_error(error) else _describe_custom_code_error(error))
    finally:
        if (programs := sys.modules.get("ptsmc_jax.programs")) is not None:
            programs.cancel_prepared()  # exiting waits for compilations
    sys.exit(status if isinstance(status, int) else 0)


def _describe_unknown_option(error: UnknownOptionError) -> str:
    """Return the message about an option that a command does not have. It may be a key of the table [tune]."""
    command = " ".join(error.command_chain or ())
    option = (error.token.keyword or error.token.value).partition("=")[0]
    if command in searches.COMMANDS:
        from ptsmc_jax.scenario.tables import Tune

        key = option.removeprefix("--").replace("-", "_")
        if key in Tune.__struct_fields__:
            return f"{command} does not take {option}; set tune.{key} in the scenario"
    return " ".join(str(error).split())


def _describe_unused_arguments(error: UnusedCliTokensError) -> str:
    """Return the message about arguments that a command does not take."""
    command, unused = " ".join(error.command_chain or ()), " ".join(error.unused_tokens or ())
    return f"{command} does not take {unused}; its arguments: ptsmc {command} --help"


def _is_configuration_error(error: BaseException) -> bool:
    """Return whether an error means that the user's input is not allowed, which has exit status 2."""
    from ptsmc_jax.campaigns.store import RefusedError
    from ptsmc_jax.scenario.errors import ScenarioError

    return isinstance(error, ScenarioError | RefusedError | UsageError)


def _describe_custom_code_error(error: BaseException) -> str:
    """Return the message about an error in custom code; raise the error again if it is not from custom code."""
    systems = sys.modules.get("ptsmc_jax.scenario.systems")
    file = None if systems is None else systems.find_faulty_file(error)
    if file is None:
        raise error
    from ptsmc_jax.scenario.custom_checks import describe_failure

    return f"{file} {describe_failure(error, file)}"


def _fail(message: str) -> None:
    """Print a sentence with its control characters escaped, and exit with status 2."""
    printable = "".join(c if c.isprintable() else c.encode("unicode_escape").decode() for c in message)
    print(f"ptsmc: {printable}", file=sys.stderr)
    sys.exit(2)
