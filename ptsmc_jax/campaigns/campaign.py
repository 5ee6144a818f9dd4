"""A Monte Carlo campaign: trials flown part by part, each part written as it is done; what is there is not flown again.

What a trial is does not depend on the parts, so that shards, clusters and interrupted runs give the same rows.
"""

from collections import deque
from collections.abc import Callable, Iterable, Iterator, Sequence
from concurrent.futures import Future, ThreadPoolExecutor
from dataclasses import dataclass
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
import polars as pl

from ptsmc_jax import configure, programs
from ptsmc_jax.batching import lanes
from ptsmc_jax.campaigns import montecarlo, plans
from ptsmc_jax.campaigns.montecarlo import OwnMetrics
from ptsmc_jax.campaigns.plans import Plan
from ptsmc_jax.campaigns.rows import Part, Rows, read
from ptsmc_jax.devices.sensors import RATE_BIAS
from ptsmc_jax.dispersions import planned
from ptsmc_jax.dispersions.base import OWN
from ptsmc_jax.dispersions.planned import Row
from ptsmc_jax.dispersions.quantities import QUANTITIES
from ptsmc_jax.dispersions.variation import Dispersion
from ptsmc_jax.scenario import Study, own_checks
from ptsmc_jax.simulation import requirements, rollout
from ptsmc_jax.simulation.computer import OURS, Software
from ptsmc_jax.simulation.requirements import Requirement, Verdict
from ptsmc_jax.simulation.rollout import Parts

PART = 4096  # trials in one part
WAITING = 2  # parts that may wait to be written while the next one is flown

Wanted = tuple[int, int]  # first trial and count of a part to fly


@dataclass(frozen=True)
class Campaign:
    """What is flown: a scenario's trials under one seed."""

    ready: Study
    seed: int
    own: OwnMetrics | None = None  # metrics of one's own
    plan: Plan | None = None  # whose rows are flown, a trial each
    software: Software = OURS  # the flight computer, where it is not the parts' own code

    @property
    def plan_given(self) -> bool:
        """Whether a plan gives anything that would not be drawn."""
        return self.plan is not None and bool(self.plan.given)

    def rows(self, trials: np.ndarray) -> np.ndarray | Row:
        """What is flown as these trials: their numbers, or their rows in the plan."""
        return trials if self.plan is None else self.plan.rows(trials, self.seed)

    def fly(self, trials: Sequence[int] | np.ndarray) -> pl.DataFrame:
        """Rows of these trials."""
        # never so few that another program flies them: rows are then the same to the last digit
        wanted = np.resize(np.asarray(trials, dtype=np.uint32), max(len(trials), montecarlo.FEW))
        parts, rows = self.ready.parts, self.rows(wanted)
        flown = montecarlo.run(parts, self.ready.dispersion, self.seed, rows, own=self.own, software=self.software)
        statuses = [rollout.STATUS[int(code)] for code in flown.status]
        frame = pl.DataFrame({
            "trial": wanted,
            "status": [status for status, _ in statuses],
            "reason": [reason for _, reason in statuses],
            "bad_time": flown.bad_time,
            **self._origin(wanted),
            **{name: getattr(flown.metrics, name) for name in self.ready.catalogue},
            **_counted(flown.samples),
            **flown.drawn,
            **flown.own,
        })  # fmt: skip
        return frame.head(len(trials)).with_columns(pl.col(pl.Float64, pl.Float32).fill_nan(None))

    def draw(self, trials: Sequence[int] | np.ndarray) -> pl.DataFrame:
        """What these trials would fly with."""
        wanted = np.asarray(trials, dtype=np.uint32)
        padded = np.resize(wanted, -(-wanted.size // PART) * PART)
        drawn = _draw(self.ready.parts, self.ready.dispersion, jnp.uint32(self.seed), self.rows(padded))
        numbers = {name: np.asarray(v)[: wanted.size] for name, v in drawn.items()}
        return pl.DataFrame({"trial": wanted, **self._origin(wanted), **numbers})

    def _origin(self, trials: np.ndarray) -> dict[str, np.ndarray]:
        return {} if self.plan is None else self.plan.origin(trials)

    def own_names(self) -> list[str]:
        """Names of the metrics of one's own; raises ValueError where they fail, or are none that a row can hold."""
        made = self.own
        if made is None:
            return []

        def asked(result: Any, parts: Any) -> Any:
            try:
                returned: Any = made(result, parts)
            except (Exception, SystemExit) as error:
                file = getattr(getattr(made, "__code__", None), "co_filename", "")
                raise ValueError(f"it {own_checks.what_fails(error, file)}") from error
            if not isinstance(returned, dict) or not returned or not all(isinstance(name, str) for name in returned):
                what = "an empty dict" if isinstance(returned, dict) and not returned else type(returned).__name__
                raise ValueError(f"it returns {what}, but must return named numbers, a dict")
            for name, value in returned.items():
                single = isinstance(value, int | float | np.generic | np.ndarray | jax.Array) and not np.ndim(value)
                if not single or jnp.result_type(value).kind not in "iuf":
                    raise ValueError(f"its {name} is no single number")
            return returned

        about = self.ready.parts, self.ready.dispersion, self.seed, 0
        flown = jax.eval_shape(lambda: montecarlo.one(*about, own=asked, software=self.software))
        counted = _counted(flown.samples)
        for name in flown.own:
            if not own_checks.names_column(name):
                raise ValueError(f"its {name!r} is no name of a column; allowed are names that can be printed")
            if name in {"trial", *plans.OF_ROWS.values(), *plans.RESULTS, *counted, *flown.drawn}:
                raise ValueError(f"its {name} has the name of a column that the rows have already")
        return list(flown.own)


def _counted(samples: dict[str, Any]) -> dict[str, Any]:
    """How the samples of trials ended, by the columns of their rows."""
    return {f"{plans.COUNTED}{status}": count for status, count in samples.items()}


def of_plan(ready: Study, seed: int, plan: Plan, own: OwnMetrics | None = None, where: str = "the plan") -> Campaign:
    """The campaign that flies a plan.

    What it says of a quantity in every row as it is drawn anyway, as `--dry-run` writes it, is left to be drawn: the
    very program of the campaign that was planned then flies it, to the last digit.

    Args:
        ready: the scenario, ready to fly.
        seed: of rows that do not say theirs.
        plan: its rows.
        own: metrics of one's own.
        where: what errors call the plan.

    Raises RefusedError where initial angles, or numbers of draws of one's own, are not those that follow or are drawn.
    """
    kinds = {*ready.dispersion.kinds, RATE_BIAS}
    same = []  # quantities that the plan gives as they would be without it
    drawn = None  # what its trials would fly with then
    for name, values in plan.given.items():
        quantity = QUANTITIES[name]
        columns, usual = quantity.columns(ready.parts), np.asarray(quantity.read(ready.parts))[None]
        if not kinds.isdisjoint({name, OWN}):  # a draw of one's own may change any
            if drawn is None:
                drawn = Campaign(ready, seed, own, plan.without(plan.given)).draw(range(plan.count))
            if set(columns) <= set(drawn.columns):
                usual = drawn.select(columns).to_numpy()
            elif name in kinds:
                usual = np.zeros_like(values)
        if np.array_equal(np.broadcast_to(usual, values.shape), values):
            same.append(name)
    campaign = Campaign(ready, seed, own, plan.without(same))
    if plan.angle is not None or plan.own:
        rows = drawn if drawn is not None and not campaign.plan_given else campaign.draw(range(plan.count))
        plans.check_drawn(plan.own, rows, where)
        if plan.angle is not None:
            plans.check_angle(plan.angle, rows[plans.ANGLE].to_numpy(), where)
    return campaign


@programs.jit
def _draw(parts: Parts, dispersion: Dispersion, seed: jax.Array, trials: jax.Array | Row) -> dict[str, jax.Array]:
    return lanes.vmap(lambda trial: montecarlo.values(parts, dispersion, seed, trial))(trials)


def missing(parts: Iterable[Part], trials: int, shard: tuple[int, int] = (1, 1)) -> list[Wanted]:
    """Parts that are not there yet, of a campaign of so many trials; shard (i, n): of every n-th part from the i-th."""
    flown = {part.first: part.count for part in parts}
    every = [(first, min(PART, trials - first)) for first in range(0, trials, PART)]
    number, shards = shard
    return [(first, count) for first, count in every[number - 1 :: shards] if flown.get(first, 0) < count]


def staying(parts: Iterable[Part], wanted: Iterable[Wanted]) -> list[Part]:
    """The parts that are not flown anew: one that is to have more trials is, and none of its own are done yet."""
    anew = {first for first, _ in wanted}
    return [part for part in parts if part.first not in anew]


@dataclass
class Tally:
    """Where a campaign stands."""

    done: int  # trials
    total: int
    failed: int  # that did not end well


def tally(parts: list[Part], total: int) -> Tally:
    """Where a campaign with these parts stands."""
    failed = sum(failures(read([part], ["status"])) for part in parts)
    return Tally(sum(part.count for part in parts), total, failed)


def failures(frame: pl.DataFrame) -> int:
    """How many of these rows did not end well."""
    return int((frame["status"] != "ok").sum())


def finished(frame: pl.DataFrame) -> np.ndarray:
    """Which of these rows were flown to the end, (trials,) bool: their metrics are those of the run."""
    return frame["status"].is_in(montecarlo.FINISHED).to_numpy()


def verdicts(asked: Iterable[Requirement], frame: pl.DataFrame) -> list[Verdict]:
    """One for each requirement over these rows; a failed trial breaks every one."""
    return requirements.verdicts(asked, lambda name: frame[name].to_numpy().astype(float), finished(frame))


def here(make: Callable[[np.ndarray], pl.DataFrame], rows: Rows, wanted: list[Wanted]) -> Iterator[tuple[Part, int]]:
    """Make the wanted parts on this machine, and write each while the next one is made.

    Yields each part that is on the disk, and how many of its trials did not end well. make: numbers of trials -> rows.
    Accelerators, which fly more than a part at a time, make several in one go.
    """
    together = max(1, montecarlo.block_size() * len(configure.devices()) // PART)
    writing: deque[tuple[Future[Part], int]] = deque()
    with ThreadPoolExecutor(1) as writer:
        for group, frame in _frames(make, [wanted[k : k + together] for k in range(0, len(wanted), together)]):
            begin = 0
            for first, count in group:
                part = frame.slice(begin, count)
                begin += count
                bad = failures(part) if "status" in part.columns else 0
                writing.append((writer.submit(rows.write, first, part), bad))
            while writing and (len(writing) > WAITING or writing[0][0].done()):
                part_on_disk, bad = writing.popleft()
                yield part_on_disk.result(), bad
        for part_on_disk, bad in writing:
            yield part_on_disk.result(), bad


def _frames(
    make: Callable[[np.ndarray], pl.DataFrame], groups: Sequence[list[Wanted]]
) -> Iterator[tuple[list[Wanted], pl.DataFrame]]:
    """The rows of each group of parts, in order; two at a time, so that one is flown while rows are made of another."""

    def of(group: list[Wanted]) -> pl.DataFrame:
        return make(np.concatenate([np.arange(first, first + count) for first, count in group]))

    for group in groups[:1]:
        yield group, of(group)  # alone: it compiles
    flying: deque[tuple[list[Wanted], Future[pl.DataFrame]]] = deque()
    with ThreadPoolExecutor(2) as makers:
        for group in groups[1:]:
            flying.append((group, makers.submit(of, group)))
            if len(flying) == 2:
                first, frame = flying.popleft()
                yield first, frame.result()
        for group, frame in flying:
            yield group, frame.result()


def follow(parts: Iterable[tuple[Part, int]], standing: Tally, report: Callable[[Tally], None]) -> None:
    """Tell of each part as it lands."""
    report(standing)
    for part, failed in parts:
        standing.done += part.count
        standing.failed += failed
        report(standing)


def history(campaign: Campaign, trials: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Times (time,) [s] and what the law drives to zero, its 2-norm (trials, time) [-], of these trials' histories."""
    ready = campaign.ready
    rows = jax.tree.map(jnp.asarray, campaign.rows(trials))
    about = ready.parts, ready.dispersion, jnp.uint32(campaign.seed), rows, campaign.software
    t, error, has_length = map(np.asarray, _history(*about))
    return t[0][has_length[0]], error[:, has_length[0]]


@programs.jit(static_argnames="software")
def _history(
    parts: Parts, dispersion: Dispersion, seed: jax.Array, trials: jax.Array | Row, software: Software
) -> tuple:
    def one(trial: jax.Array | Row) -> tuple:
        about = planned.about(parts, dispersion, seed, trial)
        log = rollout.simulate(about.drawn, about.seed, about.trial, record=True, software=software).log
        assert log is not None
        return log.t, jnp.sqrt(jnp.sum(log.error**2, axis=-1)), log.has_length

    return montecarlo.blocks(one, trials)
