"""Monte Carlo campaigns: trials are simulated in parts; each part is written at once and not simulated again.

A trial does not depend on the parts, so shards, clusters and interrupted runs give the same rows.
"""

from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass

import jax
import jax.numpy as jnp
import numpy as np
import polars as pl

from ptsmc_jax import configure, programs
from ptsmc_jax.batching import lanes
from ptsmc_jax.campaigns import montecarlo, run_tables
from ptsmc_jax.campaigns.montecarlo import CustomMetrics
from ptsmc_jax.campaigns.rows import Part, Rows, column_names, read
from ptsmc_jax.campaigns.run_tables import RunTable
from ptsmc_jax.devices.sensors import RATE_BIAS
from ptsmc_jax.dispersions.base import CUSTOM
from ptsmc_jax.dispersions.quantities import QUANTITIES
from ptsmc_jax.dispersions.variation import Dispersion, Row, trial_setup
from ptsmc_jax.scenario import Study, custom_checks
from ptsmc_jax.simulation import requirements, rollout
from ptsmc_jax.simulation.computer import PYTHON_SOFTWARE, Software
from ptsmc_jax.simulation.requirements import Requirement, Verdict
from ptsmc_jax.simulation.rollout import Parts

PART = 4096  # trials in one part

Block = tuple[int, int]  # first trial and number of trials of a part to simulate


@dataclass(frozen=True)
class Campaign:
    """The trials of a scenario under one seed."""

    ready: Study
    seed: int
    custom_metrics: CustomMetrics | None = None
    run_table: RunTable | None = None  # a row for each trial
    software: Software = PYTHON_SOFTWARE  # flight software: the simulated law, or exported C code

    def rows(self, trials: np.ndarray) -> np.ndarray | Row:
        """Return the numbers of these trials, or their rows in the run table."""
        return trials if self.run_table is None else self.run_table.rows(trials, self.seed)

    def simulate(self, trials: Sequence[int] | np.ndarray) -> pl.DataFrame:
        """Simulate these trials; return their rows."""
        # trials are repeated up to `FEW`, so that the program of the campaign simulates them, with exactly equal rows
        wanted = np.resize(np.asarray(trials, dtype=np.uint32), max(len(trials), montecarlo.FEW))
        parts, rows = self.ready.parts, self.rows(wanted)
        simulated = montecarlo.run(
            parts, self.ready.dispersion, self.seed, rows, custom_metrics=self.custom_metrics, software=self.software
        )
        statuses = [rollout.STATUS[int(code)] for code in simulated.status]
        frame = pl.DataFrame({
            "trial": wanted,
            "status": [status for status, _ in statuses],
            "reason": [reason for _, reason in statuses],
            "bad_time": simulated.bad_time,
            **self._trial_and_seed_columns(wanted),
            **{name: getattr(simulated.metrics, name) for name in self.ready.catalogue},
            **_sample_count_columns(simulated.samples),
            **simulated.drawn,
            **simulated.custom_metrics,
        })  # fmt: skip
        return frame.head(len(trials)).with_columns(pl.col(pl.Float64, pl.Float32).fill_nan(None))

    def draw(self, trials: Sequence[int] | np.ndarray) -> pl.DataFrame:
        """Return the dispersed quantities of these trials, without simulating them."""
        wanted = np.asarray(trials, dtype=np.uint32)
        padded = np.resize(wanted, -(-wanted.size // PART) * PART)
        drawn = _draw(self.ready.parts, self.ready.dispersion, jnp.uint32(self.seed), self.rows(padded))
        numbers = {name: np.asarray(v)[: wanted.size] for name, v in drawn.items()}
        return pl.DataFrame({"trial": wanted, **self._trial_and_seed_columns(wanted), **numbers})

    def _trial_and_seed_columns(self, trials: np.ndarray) -> dict[str, np.ndarray]:
        """Return the trial and seed numbers of these rows of a run table, by column; {} without them."""
        stated = {} if self.run_table is None else self.run_table.streams
        return {run_tables.RESULT_COLUMNS[name]: values[trials] for name, values in stated.items()}

    def custom_metric_names(self) -> list[str]:
        """Return the names of the custom metrics. Raises ValueError if they fail or a row cannot hold them."""
        function = self.custom_metrics
        if function is None:
            return []

        def call_and_check(result: rollout.Result, parts: Parts) -> dict[str, jax.Array]:
            try:
                returned: object = function(result, parts)
            except (Exception, SystemExit) as error:
                file = getattr(getattr(function, "__code__", None), "co_filename", "")
                raise ValueError(f"it {custom_checks.describe_failure(error, file)}") from error
            if not isinstance(returned, dict) or not returned or not all(isinstance(name, str) for name in returned):
                is_empty = isinstance(returned, dict) and not returned
                returned_type = "an empty dict" if is_empty else type(returned).__name__
                raise ValueError(f"it returns {returned_type}, but must return named numbers, a dict")
            for name, value in returned.items():
                is_single = isinstance(value, int | float | np.generic | np.ndarray | jax.Array) and not np.ndim(value)
                if not is_single or jnp.result_type(value).kind not in "iuf":
                    raise ValueError(f"its {name} is no single number")
            return returned

        arguments = self.ready.parts, self.ready.dispersion, self.seed, 0
        simulated = jax.eval_shape(
            lambda: montecarlo.one(*arguments, custom_metrics=call_and_check, software=self.software)
        )
        counts = _sample_count_columns(simulated.samples)
        for name in simulated.custom_metrics:
            if not custom_checks.is_column_name(name):
                raise ValueError(f"its {name!r} is no name of a column; allowed are names that can be printed")
            if name in {"trial", *run_tables.RESULT_COLUMNS.values(), *run_tables.RESULTS, *counts, *simulated.drawn}:
                raise ValueError(f"its {name} has the name of a column that the rows have already")
        return list(simulated.custom_metrics)


def _sample_count_columns(samples: Mapping[str, jax.Array | np.ndarray]) -> dict[str, jax.Array | np.ndarray]:
    """Return the numbers of samples by column name, given the numbers by the status that the C code returned."""
    return {f"{run_tables.COUNT_PREFIX}{status}": count for status, count in samples.items()}


def from_run_table(
    ready: Study,
    seed: int,
    table: RunTable,
    custom_metrics: CustomMetrics | None = None,
    where: str = "the run table",
) -> Campaign:
    """Return the campaign of a run table.

    A quantity that the table sets to its dispersed values, as `--dry-run` writes them, is dispersed instead. The trials
    then run in the program of the original campaign and are equal to the last digit.

    Args:
        ready: the scenario, ready to simulate.
        seed: seed of the rows that state no seed.
        table: the run table.
        custom_metrics: custom metrics.
        where: the name of the table in errors.

    Raises:
        RefusedError: initial angles or numbers of custom dispersions are not those of the trials.
    """
    dispersed = {*ready.dispersion.kinds, RATE_BIAS}
    unchanged = []  # quantities that have the same values with and without the table
    drawn = None  # the quantities of the trials without a table
    for name, values in table.given.items():
        quantity = QUANTITIES[name]
        columns, usual_values = quantity.columns(ready.parts), np.asarray(quantity.read(ready.parts))[None]
        if not dispersed.isdisjoint({name, CUSTOM}):  # a custom dispersion may change any quantity
            if drawn is None:
                drawn = Campaign(ready, seed, custom_metrics, table.without(table.given)).draw(range(table.count))
            if set(columns) <= set(drawn.columns):
                usual_values = drawn.select(columns).to_numpy()
            elif name in dispersed:
                usual_values = np.zeros_like(values)
        if np.array_equal(np.broadcast_to(usual_values, values.shape), values):
            unchanged.append(name)
    campaign = Campaign(ready, seed, custom_metrics, table.without(unchanged))
    if table.dependent:
        rows = drawn if drawn is not None and len(unchanged) == len(table.given) else campaign.draw(range(table.count))
        run_tables.check_dependent(table.dependent, rows, where)
    return campaign


@programs.jit
def _draw(parts: Parts, dispersion: Dispersion, seed: jax.Array, trials: jax.Array | Row) -> dict[str, jax.Array]:
    """Return the dispersed quantities of trials by column, (trials,) each, without a simulation."""
    return lanes.vmap(lambda trial: montecarlo.values(parts, dispersion, seed, trial))(trials)


def missing_parts(parts: Iterable[Part], trials: int, shard: tuple[int, int] = (1, 1)) -> list[Block]:
    """Return the parts that a campaign still needs.

    Args:
        parts: parts on disk.
        trials: number of trials of the campaign.
        shard: (i, n) selects every n-th part, from the i-th.
    """
    counts = {part.first: part.count for part in parts}
    all_parts = [(first, min(PART, trials - first)) for first in range(0, trials, PART)]
    number, shards = shard
    return [(first, count) for first, count in all_parts[number - 1 :: shards] if counts.get(first, 0) < count]


@dataclass
class Tally:
    """The progress of a campaign, for progress reports."""

    done: int  # number of simulated trials
    total: int  # number of all trials
    failed: int  # number of failed trials


def count_progress(parts: Iterable[Part], total: int, to_simulate: Iterable[Block] = ()) -> Tally:
    """Return the progress of a campaign.

    Args:
        parts: parts on disk.
        total: number of all trials.
        to_simulate: the blocks that are simulated next. Parts that begin like one of them are replaced and not counted.
    """
    simulated_again = {first for first, _ in to_simulate}
    done = [part for part in parts if part.first not in simulated_again]
    failed = sum(count_failures(read([part], ["status"])) for part in done if "status" in column_names(part))
    return Tally(sum(part.count for part in done), total, failed)


def count_failures(frame: pl.DataFrame) -> int:
    """Return the number of failed trials in these rows; 0 for rows that were not simulated."""
    return int((frame["status"] != "ok").sum()) if "status" in frame.columns else 0


def has_finished(frame: pl.DataFrame) -> np.ndarray:
    """Return which trials reached the end, (trials,) bool. Metrics of other trials cover only a part of the run."""
    return frame["status"].is_in(montecarlo.FINISHED).to_numpy()


def verdicts(required: Iterable[Requirement], frame: pl.DataFrame) -> list[Verdict]:
    """Return the verdict of each requirement over these rows; a failed trial violates all requirements."""
    return requirements.verdicts(required, lambda name: frame[name].to_numpy().astype(float), has_finished(frame))


def make_parts(
    simulate: Callable[[np.ndarray], pl.DataFrame], rows: Rows, wanted: list[Block]
) -> Iterator[tuple[Part, int]]:
    """Make the wanted parts on this machine and write them. Accelerators make several parts at a time.

    Args:
        simulate: returns the rows of trials, by their numbers.
        rows: the folder that the parts are written into.
        wanted: first trial and number of trials of each part, in order.

    Yields:
        Each part that is written, and its number of failed trials.
    """
    parts_per_group = max(1, montecarlo.block_size() * len(configure.devices()) // PART)
    groups = [wanted[k : k + parts_per_group] for k in range(0, len(wanted), parts_per_group)]

    def simulate_and_write(group: list[Block]) -> list[tuple[Part, int]]:
        """Return the written parts of a group, each with its number of failed trials."""
        frame = simulate(np.concatenate([np.arange(first, first + count) for first, count in group]))
        parts, first_row = [], 0
        for first, count in group:
            part = frame.slice(first_row, count)
            first_row += count
            parts.append((rows.write(first, part), count_failures(part)))
        return parts

    workers = ThreadPoolExecutor(2)  # one thread simulates while the other writes rows
    try:
        for group in groups[:1]:
            yield from simulate_and_write(group)  # the first group runs alone, since it compiles the program
        for parts in workers.map(simulate_and_write, groups[1:]):
            yield from parts
    finally:
        workers.shutdown(cancel_futures=True)


def report_progress(parts: Iterable[tuple[Part, int]], tally: Tally, report: Callable[[Tally], None]) -> None:
    """Add each written part to the progress, and report the progress.

    Args:
        parts: the parts, yielded when they are written, each with its number of failed trials.
        tally: progress before the first of these parts; its counts are increased in place.
        report: function that shows the progress, called once before the first part and once after each part.
    """
    report(tally)
    for part, failed in parts:
        tally.done += part.count
        tally.failed += failed
        report(tally)


def error_history(campaign: Campaign, trials: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Return the times (time,) [s] and the error's 2-norm (trials, time) [-] of these trials."""
    ready = campaign.ready
    rows = jax.tree.map(jnp.asarray, campaign.rows(trials))
    arguments = ready.parts, ready.dispersion, jnp.uint32(campaign.seed), rows, campaign.software
    t, error, has_length = map(np.asarray, _simulate_error_history(*arguments))
    return t[0][has_length[0]], error[:, has_length[0]]


@programs.jit(static_argnames="software")
def _simulate_error_history(
    parts: Parts, dispersion: Dispersion, seed: jax.Array, trials: jax.Array | Row, software: Software
) -> tuple:
    """Simulate trials with their history.

    Returns:
        For each trial and sample, (trials, time): time [s], 2-norm of the error, and whether its period has a length.
    """

    def simulate_one(trial: jax.Array | Row) -> tuple:
        trial_parts = trial_setup(parts, dispersion, seed, trial)
        log = rollout.simulate(
            trial_parts.dispersed_parts, trial_parts.seed, trial_parts.trial, record=True, software=software
        ).log
        assert log is not None
        return log.t, jnp.sqrt(jnp.sum(log.error**2, axis=-1)), log.has_length

    return montecarlo.map_in_blocks(simulate_one, trials)
