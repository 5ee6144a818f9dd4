import math
import tomllib
from dataclasses import replace
from functools import partial
from itertools import chain
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
import polars as pl
import pytest

from ptsmc_jax import configure, scenario
from ptsmc_jax.campaigns import campaign, montecarlo, rows, runs
from ptsmc_jax.simulation.metrics import Metrics
from ptsmc_jax.theory import lower_bound
from tests.helpers import SHORT, SHORT_CHAIN, same, short, untuned


def of_scenario(tables, seed):
    """Return the `Campaign` of a scenario's tables with this seed."""
    return campaign.Campaign(scenario.study(scenario.from_tables(tables)), seed)


@pytest.fixture(scope="module")
def simulated():
    """Return the `Campaign` of a short integrator chain and the data frame of its first 300 trials."""
    made = of_scenario(untuned(SHORT_CHAIN), 3)
    return made, made.simulate(range(300))


def test_row_has_all_results_and_inputs_of_its_trial(simulated):
    """A single simulation of a trial has the results and inputs of its row. The nominal run has no random inputs."""
    made, frame = simulated
    assert frame.columns[:4] == ["trial", "status", "reason", "bad_time"]
    assert frame.columns[4 : 4 + len(made.ready.catalogue)] == list(made.ready.catalogue)
    assert frame.columns[4 + len(made.ready.catalogue) :] == ["initial_angle", "initial_x1", "initial_x2"]
    assert frame["trial"].to_list() == list(range(300))
    assert frame["bad_time"].null_count() == 300
    run = runs.simulate(made.ready, 3, 250)
    for name, value in run.metrics.items():
        row = frame[name][250]
        assert row is None if np.isnan(value) else row == pytest.approx(value, rel=1e-12), name
    dispersed = {name: frame[name][250] for name in ("initial_angle", "initial_x1", "initial_x2")}
    assert run.drawn == pytest.approx(dispersed, rel=1e-12)
    assert runs.simulate(made.ready, 3).drawn == {}  # the nominal run


BLOCKS = [(128, 4096, 1), (16, 4096, 2), (64, 128, 2), (32, 64, 1)]


@pytest.mark.parametrize(("block", "capacity", "devices"), short(BLOCKS, BLOCKS[3:]))
def test_rows_do_not_depend_on_blocks_and_devices(simulated, monkeypatch, block, capacity, devices):
    made, frame = simulated
    monkeypatch.setattr(montecarlo, "CAPACITY", capacity)
    monkeypatch.setattr(montecarlo, "run", partial(montecarlo.run, block=block))
    found = jax.local_devices()[:devices]
    monkeypatch.setattr(configure, "devices", lambda: found)
    same(made.simulate(range(300)), frame)


def test_drawn_inputs_equal_the_inputs_of_the_simulated_rows(simulated):
    made, frame = simulated
    run_table = made.draw(range(300))
    assert run_table.columns == ["trial", *frame.columns[4 + len(made.ready.catalogue) :]]
    same(run_table, frame.select(run_table.columns))


def test_failed_trials_do_not_affect_the_others():
    """Rows of failed trials have a time and a reason; the other rows are those of a run without failed trials.

    Metrics that a failed trial does not have are empty. Initial angles are near 180 deg, so that a third of the trials
    reaches the law's singularity or diverges.
    """
    far = {"kind": "axis_angle", "min_deg": 170.0, "max_deg": 180.0}
    made = of_scenario({**untuned(SHORT), "dispersion": {"attitude": far}}, 0)
    frame = made.simulate(range(600))
    assert frame.columns[4 + len(made.ready.catalogue) :] == [
        "initial_angle", *(f"initial_q{k}" for k in range(1, 5)), *(f"initial_w{k}" for k in range(1, 4))
    ]  # fmt: skip
    bad = frame.filter(pl.col("status").is_in(["diverged", "singular"]))
    assert 0.2 < bad.height / 600 < 0.5
    assert {"singular", "diverged"} == set(bad["status"])
    assert bad["bad_time"].null_count() == 0
    assert bad["bad_time"].is_between(0.0, 6.5).all()
    assert "" not in set(bad["reason"])
    lost = bad.filter(pl.col("effort").is_null())
    assert lost.height > 0
    assert lost["saturated"].null_count() == lost.height  # no finite command, so no fraction of time in saturation
    counts = montecarlo.run(made.ready.parts, made.ready.dispersion, 0, np.arange(600)).counts()
    assert counts == {**dict.fromkeys(counts, 0), **dict(frame["status"].value_counts().rows())}
    good = frame.filter(~pl.col("status").is_in(["diverged", "singular"]))
    alone = montecarlo.run(made.ready.parts, made.ready.dispersion, 0, good["trial"].to_numpy())
    for name in made.ready.catalogue:
        got = getattr(alone.metrics, name)
        np.testing.assert_array_equal(np.isnan(got), good[name].is_null().to_numpy())
        known = ~np.isnan(got)
        # rounding errors grow near the singularity, but both results are from the same compiled program
        np.testing.assert_array_equal(got[known], good[name].to_numpy()[known], err_msg=name)


def test_missing_parts_of_a_campaign_are_found_and_divided_among_shards():
    """A part is a file with the rows of successive trials."""
    part, nowhere = rows.Part, Path()
    full = campaign.PART
    assert campaign.missing_parts([], 10) == [(0, 10)]
    assert campaign.missing_parts([], 2 * full + 1) == [(0, full), (full, full), (2 * full, 1)]
    there = [part(0, full, nowhere), part(2 * full, 1, nowhere)]
    assert campaign.missing_parts(there, 2 * full + 1) == [(full, full)]
    assert campaign.missing_parts(there, 3 * full) == [
        (full, full),
        (2 * full, full),
    ]  # the short last part is repeated
    shards = [campaign.missing_parts([], 7 * full, (k, 3)) for k in (1, 2, 3)]
    assert sorted(chain(*shards)) == campaign.missing_parts([], 7 * full)
    assert [len(shard) for shard in shards] == [3, 2, 2]


def test_parts_of_a_campaign_are_written_and_reported_one_after_the_other(simulated, tmp_path, monkeypatch):
    made, frame = simulated
    monkeypatch.setattr(campaign, "PART", 100)
    kept = rows.Rows(tmp_path / "trials", b"k")
    seen = []
    campaign.report_progress(
        campaign.make_parts(made.simulate, kept, campaign.missing_parts([], 300)),
        campaign.count_progress([], 300),
        lambda standing: seen.append((standing.done, standing.total, standing.failed)),
    )
    assert seen == [(0, 300, 0), (100, 300, 0), (200, 300, 0), (300, 300, 0)]
    same(rows.read(kept.parts()[0]), frame)


@pytest.mark.parametrize("together", short([2, 3, 16], [3]))
def test_parts_of_a_campaign_that_are_simulated_in_one_call_have_the_same_rows(
    simulated, tmp_path, monkeypatch, together
):
    """Accelerators simulate several parts of a shard together. They are not adjacent, and the last one is shorter."""
    made, frame = simulated
    monkeypatch.setattr(campaign, "PART", 40)
    monkeypatch.setattr(montecarlo, "run", partial(montecarlo.run, block=montecarlo.BLOCK))  # program of `simulated`
    monkeypatch.setattr(montecarlo, "block_size", lambda: 40 * together // len(configure.devices()))
    flights = []

    def make(trials):
        flights.append(len(trials))
        return made.simulate(trials)

    kept = rows.Rows(tmp_path / "trials", b"k")
    wanted = campaign.missing_parts([], 300, (2, 2))
    assert wanted == [(40, 40), (120, 40), (200, 40), (280, 20)]
    landed = [part for part, _ in campaign.make_parts(make, kept, wanted)]
    assert flights == {2: [80, 60], 3: [120, 20], 16: [140]}[together]
    assert [(part.first, part.count) for part in landed] == wanted
    for part in landed:
        same(rows.read([part]), frame[part.first : part.end])


def test_finished_parts_of_a_campaign_remain_if_a_later_part_fails(simulated, tmp_path, monkeypatch):
    made, _ = simulated
    monkeypatch.setattr(campaign, "PART", 100)
    kept = rows.Rows(tmp_path / "trials", b"k")

    def make(trials):
        if trials[0] == 200:
            raise KeyboardInterrupt
        return made.simulate(trials)

    with pytest.raises(KeyboardInterrupt):
        campaign.report_progress(
            campaign.make_parts(make, kept, campaign.missing_parts([], 300)),
            campaign.count_progress([], 300),
            lambda _: None,
        )
    assert [part.first for part in kept.parts()[0]] == [0, 100]


def test_failed_trials_are_counted_in_the_progress_of_a_campaign(simulated, tmp_path):
    _, frame = simulated
    kept = rows.Rows(tmp_path / "trials", b"k")
    worse = frame.with_columns(
        status=pl.when(pl.col("trial") % 3 == 0).then(pl.lit("diverged")).otherwise(pl.col("status"))
    )
    kept.write(0, worse)
    assert campaign.count_progress(kept.parts()[0], 900) == campaign.Tally(300, 900, 100)


def overshoot(result, parts):
    """Return custom metrics by name: the largest error after t_f, and the number of rows of the history."""
    error = jnp.sqrt(jnp.sum(result.log.error**2, axis=-1))
    late = result.log.t > parts.controller.t_f
    return {"overshoot": jnp.max(jnp.where(late, error, 0.0)), "rows": jnp.sum(result.log.has_length)}


def test_custom_metrics_are_columns_of_the_rows():
    made = of_scenario(untuned(SHORT_CHAIN), 3)
    with_metrics = replace(made, custom_metrics=overshoot)
    assert with_metrics.custom_metric_names() == ["overshoot", "rows"]
    more = with_metrics.simulate(range(100))
    same(more.drop("overshoot", "rows"), made.simulate(range(100)))
    log = runs.simulate(made.ready, 3, 42).log
    after = np.linalg.norm(log.error, axis=1)[log.t > 5.0].max()
    assert more["overshoot"][42] == pytest.approx(after, rel=1e-12)
    assert more["rows"][42] == len(log.t)


@pytest.mark.parametrize(
    ("made_of", "said"),
    [
        (lambda result, parts: jnp.zeros(()), "but must return named numbers, a dict"),
        (lambda result, parts: {"x": result.log.t}, "its x is no single number"),
        (lambda result, parts: {"x": "no"}, "its x is no single number"),
        (lambda result, parts: {"x": 1j * result.log.u[0, 0]}, "its x is no single number"),
        (
            lambda result, parts: {"x\n": result.log.u[0, 0]},
            r"its 'x\\n' is no name of a column; allowed are names that",
        ),
        (lambda result, parts: {"effort": jnp.zeros(())}, "its effort has the name of a column that the rows have"),
        # a column of campaigns with a run table
        (lambda result, parts: {"run_seed": jnp.zeros(())}, "its run_seed has the name of a column"),
        (lambda result, parts: {}, "it returns an empty dict, but must return named numbers"),
        (
            lambda result, parts: {"x": 1 / 0},
            r"it fails: ZeroDivisionError: division by zero \(line \d+ of test_campaign",
        ),
        (lambda result: {}, "it fails: TypeError: .* takes 1 positional argument but 2 were given"),
        (
            lambda result, parts: {"x": float(result.status)},
            "it needs the value of a traced number, which is known only during the simulation",
        ),
    ],
)
def test_invalid_custom_metrics_are_refused(simulated, made_of, said):
    with pytest.raises(ValueError, match=said):
        replace(simulated[0], custom_metrics=made_of).custom_metric_names()


def test_error_histories_of_a_campaign_equal_single_runs(simulated):
    made, _ = simulated
    t, error = campaign.error_history(made, np.array([3, 250], dtype=np.uint32))
    for k, trial in enumerate((3, 250)):
        log = runs.simulate(made.ready, 3, trial).log
        np.testing.assert_allclose(t, log.t, rtol=1e-14)
        np.testing.assert_allclose(error[k], np.linalg.norm(log.error, axis=1), rtol=1e-9)


@pytest.mark.parametrize("kind", [np.float64, np.float32])
def test_metrics_that_are_nan_are_null_in_the_rows_in_both_precisions(monkeypatch, kind):
    made = of_scenario(tomllib.loads(SHORT_CHAIN), 3)
    simulated = montecarlo.run(made.ready.parts, made.ready.dispersion, 3, np.arange(montecarlo.FEW))
    lacking = Metrics({**simulated.metrics, "settling_time": np.full(montecarlo.FEW, np.nan)})
    as_kind = replace(
        simulated,
        metrics=jax.tree.map(lambda v: np.asarray(v, kind), lacking),
        bad_time=simulated.bad_time.astype(kind),
    )
    monkeypatch.setattr(montecarlo, "run", lambda *_, **__: as_kind)
    frame = made.simulate(range(5))
    assert [frame[name].null_count() for name in ("bad_time", "settling_time", "window_error")] == [5, 5, 0]


@pytest.mark.parametrize(("varies", "rows", "simulated"), [
    (True, (), [0, 1, 2, 3]), (False, (), [None]), (True, (7, 9), [7, 9]), (False, (7,), [7]),
])  # fmt: skip
def test_lower_bound_of_a_campaign_is_pooled_over_its_first_trials_or_rows(monkeypatch, varies, rows, simulated):
    """It is the RMS of the bounds of trials 0 to 3, of the rows, or of one nominal run if nothing varies.

    Trial k has the bound k + 1. The second run fails and has none.
    """
    seen: list[Any] = []

    def fly(ready, seed, trial, *, with_margins):
        assert not with_margins
        seen.append((seed, trial))
        return SimpleNamespace(has_lower_bound=len(seen) != 2, parts=1.0 + (trial or 0), log=None)

    def along_each(simulated):
        return [lower_bound.LowerBound(bound, np.zeros(1), np.zeros(1)) for bound, _ in simulated]

    monkeypatch.setattr(runs, "simulate", fly)
    monkeypatch.setattr(lower_bound, "bounds_along_runs", along_each)
    ready: Any = SimpleNamespace(dispersion=SimpleNamespace(varies=varies))
    squares = [(1.0 + (k or 0)) ** 2 for j, k in enumerate(simulated) if j != 1]
    assert runs.rms_lower_bound(ready, 5, rows) == pytest.approx(math.sqrt(sum(squares) / len(squares)))
    assert seen == [(5, k) for k in simulated]


@pytest.mark.parametrize("status", ["not_converged", "singular", "diverged"])
def test_a_failed_run_counts_as_not_met_even_without_requirements(status):
    """`ptsmc simulate` then has exit status 1."""
    none: Any = None
    run = runs.Run(none, none, {}, {}, "ok", "", math.nan, [], {}, {})
    assert run.met
    assert not replace(run, status=status).met
