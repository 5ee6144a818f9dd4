"""The commands of a campaign: `ptsmc montecarlo`, `summarize`, `worst`, `replay`."""

import contextlib
import sys
from dataclasses import replace
from functools import partial
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Literal

from cyclopts import Group, Parameter
from cyclopts.validators import MutuallyExclusive, Number

from tuning.cli import searches
from tuning.cli.options import (
    USUAL,
    Common,
    ControllerFolder,
    Device,
    Figures,
    Out,
    Quiet,
    ScenarioFile,
    Seed,
    prepare,
    resumable,
    whole_number,
)
from tuning.errors import UsageError
from tuning.output import terminal
from tuning.output.progress import CampaignProgress, Progress

if TYPE_CHECKING:
    from ptsmc_jax.campaigns.cluster import Cluster
    from ptsmc_jax.scenario.tables import Scenario
    from tuning.studies.campaign_folder import Folder

CAMPAIGN_SEED = 1000  # differs from the default seed of a search, whose trials must not verify its gains
MOST_TRIALS = 2**32  # trial numbers have 32 bits

HELP = Group.create_default_parameters()  # options of this group appear in the help
# options of the same group exclude each other
TRIALS, STOPPING, PARTS, WHERE = (Group(show=False, validator=MutuallyExclusive()) for _ in range(4))

CampaignFolder = Annotated[Path, Parameter(name="DIR", help="Folder of `ptsmc montecarlo`.")]


def montecarlo(
    scenario: ScenarioFile = None,
    /,
    *,
    trials: Annotated[int | None, whole_number(1, MOST_TRIALS, group=(HELP, TRIALS))] = None,
    runs: Annotated[
        Path | None,
        Parameter(
            group=(HELP, TRIALS, STOPPING),
            help="Run table, .csv or .parquet, or DIR/runs of --dry-run: each row is a trial. Its columns are named as "
            "in the rows of a campaign; quantities without a column are random, with the random numbers of the columns "
            "`trial` and `seed`.",
        ),
    ] = None,
    seed: Seed = CAMPAIGN_SEED,
    out: Out = None,
    until_confident: Annotated[
        float | None,
        Parameter(
            validator=Number(gt=0, lt=1),
            group=(HELP, STOPPING, PARTS),
            help="Stop when the 95 % interval of the fraction of trials that keep each limit is narrower than this "
            "width, between 0 and 1.",
        ),
    ] = None,
    metrics: str | None = None,
    shard: Annotated[str, Parameter(group=(HELP, PARTS, WHERE))] = "1/1",
    cluster: Annotated[str | None, Parameter(group=(HELP, WHERE))] = None,
    tls_ca: Path | None = None,
    tls_cert: Path | None = None,
    tls_key: Path | None = None,
    device: Device = "cpu",
    precision: Literal["64", "32"] = "64",
    dry_run: Annotated[bool, Parameter(group=(HELP, PARTS, WHERE))] = False,
    controller: ControllerFolder = None,
    common: Common = USUAL,
) -> int:
    """Simulate many dispersed trials and write one row for each. `ptsmc replay` repeats any trial.

    After Ctrl-C or a kill, the same command resumes the campaign. With more --trials it adds trials. The default folder
    is out/montecarlo-NAME, followed by the names of --controller and --runs.

    Exit status: 0 every requirement met (without requirements: every trial converged at t_f), 1 not met, 2
    configuration error or a full disk, 130 interrupted.

    Args:
        trials: Number of trials, 1 to 4294967296; default: 10000.
        metrics: FILE.py:NAME of a function that adds custom metrics to the rows.
        shard: I/N: simulate the I-th of N shards only, for batch queues; shards may share a folder.
        cluster: Simulate on a Dask cluster: ADDRESS or scheduler file, or local:N for N processes on this machine.
        tls_ca: TLS: certificate authority's file.
        tls_cert: TLS: this client's certificate.
        tls_key: TLS: this client's private key.
        precision: Bits of every number; docs/python.md lists the limits of 32 bits.
        dry_run: Write the run table of the trials into DIR/runs, and simulate nothing.
    """
    this_shard = _parse_shard(shard)
    tls_files = {"tls_ca_file": tls_ca, "tls_client_cert": tls_cert, "tls_client_key": tls_key}
    tls = {name: str(path) for name, path in tls_files.items() if path is not None}
    on_cluster, is_partial = cluster is not None, this_shard != (1, 1) or dry_run
    for is_refused, message in (
        (tls and not on_cluster, "--tls-ca, --tls-cert and --tls-key need --cluster"),
        (
            common.force and this_shard != (1, 1),
            "--force starts the whole campaign again, which would delete the rows of other shards, and does not go "
            "with --shard; remove the folder before the first shard starts, or choose another with --out",
        ),
        (
            on_cluster and (precision, device) != ("64", "cpu"),
            "--cluster simulates on the workers' processors with 64 bits; allowed are --device cpu and --precision 64",
        ),
        (controller and device != "cpu", f"--device is {device}, but must be cpu with --controller"),
    ):
        if is_refused:
            raise UsageError(message)
    bits = 32 if precision == "32" else 64
    loaded, path = prepare(scenario, "montecarlo", out, device, bits, trust=common.trust, in_c=controller is not None)
    from ptsmc_jax.campaigns import store
    from ptsmc_jax.simulation import catalogues

    if until_confident is not None and set(loaded.requirements) <= set(catalogues.MARGINS):
        raise UsageError("--until-confident needs [requirements] on metrics in the scenario")
    from tuning.studies import campaign_folder, campaign_summary

    table = None
    if runs is not None:
        from ptsmc_jax.campaigns import run_tables

        table = run_tables.read(runs)
        trials = table.height
    if out is None:
        names = [path.name, *([controller.resolve().name] if controller else ()), *([runs.stem] if runs else ())]
        path = path.with_name("-".join(names))
    folder = campaign_folder.Folder(
        path, loaded, seed, 10_000 if trials is None else trials, metrics, bits,
        table_name=None if runs is None else runs.name, table=table, controller=controller,
    )  # fmt: skip
    if scenario is not None:
        searches.warn_about_seed(scenario, seed)
    _ = folder.campaign  # raises configuration errors before anything is written
    if folder.parameter_differences:
        print(f"ptsmc: {folder.parameter_differences}", file=sys.stderr)
    _warn_about_trials(loaded, folder.trials)

    with (
        resumable(common.force),
        store.lock_folder(folder.path, shared=this_shard != (1, 1)),
        _connect_cluster(cluster, tls) as workers,
    ):
        campaign_folder.begin(folder, common.force)
        with CampaignProgress(common.quiet) as report:
            simulate = partial(campaign_folder.simulate, folder, this_shard, report, workers)
            if dry_run:
                campaign_folder.write_run_table(folder, report)
            elif until_confident is None:
                simulate()
            else:
                count = campaign_summary.until_confident(folder, until_confident, simulate)
                folder = campaign_folder.write_trial_count(folder, count)
        if not is_partial:
            return _summarise(folder, common.quiet, common.figures)
    if dry_run and not common.quiet:
        terminal.print_lines(
            f"run table of {folder.trials} trials in {folder.dry_run_rows.folder}; nothing was simulated"
        )
    elif not common.quiet:
        simulated = sum(part.count for part in folder.rows.parts()[0])
        terminal.print_lines(
            f"shard {shard} done: {simulated} of {folder.trials} trials are in {folder.path}",
            "when all are there, in this folder or gathered into one: ptsmc summarize DIR",
        )
    return 0


def _warn_about_trials(loaded: "Scenario", trials: int) -> None:
    """Print a warning for each requirement that cannot be verified by so few trials."""
    from ptsmc_jax import scenario as scenarios
    from ptsmc_jax.simulation.requirements import fewest_trials

    for requirement in scenarios.requirements(loaded):
        quantile, confidence = requirement.quantile, requirement.confidence
        if quantile and confidence and trials < (needed := fewest_trials(quantile, confidence)):
            print(
                f"ptsmc: {requirement.metric} in {100 * quantile:g} % of trials with {100 * confidence:g} % confidence "
                f"takes at least {needed} trials with no failure; with {trials} its verdict is NOT shown or NOT met",
                file=sys.stderr,
            )


def _connect_cluster(cluster: str | None, tls: dict[str, str]) -> "contextlib.AbstractContextManager[Cluster | None]":
    """Return a context manager that connects to a cluster. Its value is None if there is no cluster."""
    if cluster is None:
        return contextlib.nullcontext()
    from ptsmc_jax.campaigns import cluster as clusters

    return contextlib.closing(clusters.connect(cluster, tls))


def summarize(folder: CampaignFolder, /, *, quiet: Quiet = False, figures: Figures = True) -> int:
    """Write the verdicts, the quantiles with intervals, and the figures of a campaign from its rows.

    Exit status: 0 every requirement met (without requirements: every trial converged at t_f), 1 not met or not
    finished, 2 configuration error or damaged rows.
    """
    _configure_jax(folder)
    from ptsmc_jax.campaigns import store
    from tuning.studies import campaign_folder

    campaign = campaign_folder.open_folder(folder)
    try:
        with store.lock_folder(folder, shared=True):
            return _summarise(campaign, quiet, figures)
    except store.InUseError as error:
        print(f"ptsmc: {error}; the summary is printed and not written", file=sys.stderr)
        return _summarise(campaign, quiet, figures, write=False)


def worst(
    folder: CampaignFolder,
    /,
    *,
    by: Annotated[
        str,
        Parameter(
            help="Column that ranks the trials: the largest value is the worst, or the smallest of `within_*` and "
            "`controller_ok`."
        ),
    ] = "window_error",
    n: Annotated[int, whole_number(1, 10_000, name=("--n", "-n"))] = 5,
    why: bool = False,
    quiet: Quiet = False,
) -> int:
    """Print the worst trials of a campaign, failed trials first, and write them to worst.csv.

    Exit status: 0 done, 2 configuration error.

    Args:
        n: Number of trials, 1 to 10000.
        why: Write why.csv: the inputs of these trials as percentiles of all trials, for every required metric.
    """
    _configure_jax(folder)
    from ptsmc_jax import scenario as scenarios
    from ptsmc_jax.campaigns import store
    from tuning.output import campaign_report
    from tuning.studies import campaign_folder, campaign_summary

    campaign = campaign_folder.open_folder(folder)
    frame = campaign_summary.worst_trials(campaign, by, n)
    store.write_csv(folder / "worst.csv", frame.columns, frame.rows())
    inputs = []
    if why:
        required = [requirement.metric for requirement in scenarios.requirements(campaign.scenario)]
        inputs = campaign_summary.explain_worst_trials(campaign, list(dict.fromkeys((by, *required))), n)
        store.write_csv(folder / "why.csv", list(inputs[0]) if inputs else [], [list(row.values()) for row in inputs])
    if not quiet:
        terminal.print_table(campaign_report.worst_trial_table(frame, by, campaign.units))
        terminal.print_lines(campaign_report.replay_hint(frame, folder, is_custom=bool(campaign.custom_code)))
        terminal.print_lines(*campaign_report.explanation_lines(inputs, campaign.units))
    return 0


def replay(
    folder: CampaignFolder,
    /,
    *,
    trial: Annotated[int, whole_number()],
    out: Path | None = None,
    common: Common = USUAL,
) -> int:
    """Simulate one trial of a campaign again with its history, and compare it with its row.

    Exit status: 0 the run equals its row to 1e-12 (or has no row yet), 1 it does not, 2 configuration error.

    Args:
        trial: Number of the trial.
        out: Folder for the results; default: DIR/replay/TRIAL.
    """
    _configure_jax(folder)
    from ptsmc_jax.campaigns import store
    from tuning.output import campaign_report
    from tuning.search import custom_parts
    from tuning.studies import campaign_folder, campaign_summary, single

    campaign = campaign_folder.open_folder(folder)
    if trial >= campaign.trials:
        raise UsageError(f"--trial is {trial}, but must be a whole number from 0 to {campaign.trials - 1}")
    replay_folder = out if out is not None else folder / "replay" / str(trial)
    is_overwritten = common.force or out is None  # a replay overwrites an earlier one
    store.check_folder(replay_folder, is_overwritten)
    custom_parts.allow_results(campaign.custom_code, folder, campaign.identity, common.trust)
    campaign = replace(campaign, trusted=True)
    with store.lock_folder(replay_folder, force=is_overwritten), Progress(common.quiet) as report:
        report(f"simulating trial {trial}", 0, 0)
        repeated = campaign_summary.replay(campaign, trial)
        run_details = campaign.scenario, repeated.run, campaign.seed, trial, common.figures, campaign.computer
        # `ptsmc simulate` can repeat neither a row of a run table nor a run with 32 bits
        needs_campaign = campaign.table is not None or campaign.bits != 64
        origin = {"campaign": str(folder.absolute()), "metrics": campaign.custom_metrics} if needs_campaign else {}
        store.write_folder(replay_folder, lambda staging: single.write(staging, *run_details, origin))
    if not common.quiet:
        summary = single.summary(repeated.run, campaign.scenario, campaign.computer)
        terminal.print_result("simulate", summary, campaign.scenario.plant.kind, replay_folder)
        terminal.print_lines(
            *campaign_report.replay_lines(repeated.difference, repeated.rounding, campaign_summary.TOLERANCE)
        )
    return 0 if repeated.difference is None or repeated.difference <= campaign_summary.TOLERANCE else 1


def _configure_jax(folder: Path) -> None:
    """Configure JAX with the precision that the campaign in a folder was simulated with."""
    from ptsmc_jax.campaigns import store
    from ptsmc_jax.configure import configure

    configure(keep_programs=True, device="cpu", bits=32 if store.read_versions(folder).get("precision") == 32 else 64)


def _summarise(folder: "Folder", quiet: bool, figures: bool, *, write: bool = True) -> int:
    """Summarise a campaign, and write and print its results.

    Args:
        folder: the folder of the campaign.
        quiet: print nothing.
        figures: write figures, too.
        write: write `summary.json` and the figures.

    Returns:
        The exit status: 0 if every requirement is met, otherwise 1.
    """
    from tuning.studies import campaign_summary

    with Progress(quiet) as report:
        report("summing up", 0, 0)
        summary = campaign_summary.summarise(folder)
        if write:
            campaign_summary.write_summary(folder, summary, figures)
    if not quiet:
        terminal.print_result("montecarlo", summary, folder.scenario.plant.kind, folder.path)
        if summary["status"] == "not met" and folder.controller is None:
            terminal.print_gains_hint(folder.scenario)
    return 0 if summary["status"] == "met" else 1


def _parse_shard(value: str) -> tuple[int, int]:
    """Return I and N of the option --shard I/N, from 1; raise UsageError if they are not valid."""
    index, _, count = value.partition("/")
    try:
        parsed = int(index), int(count)
    except ValueError:
        parsed = (0, 0)
    if not 1 <= parsed[0] <= parsed[1]:
        raise UsageError(f"--shard is {value}, but must be I/N with I from 1 to N")
    return parsed


COMMANDS = (montecarlo, summarize, worst, replay)
