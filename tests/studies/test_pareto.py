"""The Pareto front of accuracy against peak torque: points, dominance, knee, files."""

import csv
import json
from types import SimpleNamespace
from typing import Any

import jax.numpy as jnp
import numpy as np
import pytest

from ptsmc_jax import scenario
from ptsmc_jax.campaigns.montecarlo import Trials
from ptsmc_jax.formulas import ARCSEC, pointing_angle
from ptsmc_jax.simulation import rollout
from ptsmc_jax.simulation.catalogues import CATALOGUE
from ptsmc_jax.simulation.metrics import Metrics
from tests.helpers import SHORT, SHORT_CHAIN, short, small_search, tree
from tests.output.pages import checked
from tuning.search import local_search, local_searches
from tuning.search.evaluate import Measurement
from tuning.studies import front, judging, pareto, posing, trades


@pytest.mark.parametrize("scale", [1.0, 1e-6])
def test_knee_is_at_the_bend_of_the_front(scale):
    """The front is two straight lines in logarithms, first steep, then flat. The knee is their intersection."""
    torque = np.geomspace(0.1, 10.0, 21)
    error = np.where(torque < 1.0, torque**-3.0, torque**-0.2) * scale
    assert pareto.find_knee(np.stack([torque, error], axis=1)) == 10


@pytest.mark.parametrize(("lost", "largest"), [(0, 90.0), (5, 90.0), (20, 80.0)])
def test_required_fraction_of_the_peak_torque_counts_failed_trials(lost, largest):
    """Earlier, with 5 failed of 100 trials, the result was the 90 % quantile of the other 95."""
    asked = scenario.from_tables({"requirements": {"peak_torque": {"limit": 1.0, "quantile": 0.9}}})
    peaks, status = np.arange(1.0, 101.0), np.full(100, rollout.OK)
    status[100 - lost :] = rollout.DIVERGED
    metrics = Metrics({"peak_torque": peaks})
    assert (
        judging.required_quantile("peak_torque", asked, Trials(np.arange(100), metrics, status, peaks, {})) == largest
    )


def point(peak, rms, **others):
    """Return a point of a Pareto front with this peak torque and RMS error."""
    return front.Point(peak, {}, rms=rms, costs={"peak_torque": peak}, **others)


def trials(errors):
    """Return `Trials` with these window errors. All other metrics have the same values."""
    ok = np.zeros(len(errors), dtype=np.int32)
    metrics = Metrics(dict.fromkeys(CATALOGUE, jnp.asarray(errors)))
    return Trials(np.arange(len(errors)), metrics, ok, np.full(len(errors), np.nan), {})


def test_dominated_points_of_a_front_are_worse_by_more_than_the_confidence_interval():
    """The points are sorted by peak torque. One point that is not dominated is the knee."""
    rng = np.random.default_rng(0)
    common = rng.lognormal(0.0, 0.5, 400)
    sizes = {0.2: 4.0, 0.3: 2.0, 0.4: 2.5, 0.5: 1.0, 0.6: 1.0005}  # by peak torque
    judged = []
    for peak, size in sizes.items():
        errors = size * common * rng.normal(1.0, 0.05, 400)
        judged.append((point(peak, float(np.sqrt(np.mean(errors**2)))), trials(errors)))
    marked = pareto.mark_points(judged)
    assert [p.peak for p in marked] == sorted(sizes)
    # only the point with peak torque 0.4 is worse than a point with less torque by more than the interval
    assert {p.peak for p in marked if p.dominated} == {0.4}
    assert sum(p.knee for p in marked) == 1
    assert not any(p.knee and p.dominated for p in marked)


def test_points_with_zero_or_missing_error_are_not_the_knee_of_a_front():
    """Their logarithms are not finite. Earlier, such a point became the knee."""
    sizes = {0.2: 4.0, 0.3: 2.0, 0.5: 1.6, 0.6: 0.0, np.nan: np.nan}
    judged = [(point(peak, size), trials([size])) for peak, size in sizes.items()]
    assert [p.peak for p in pareto.mark_points(judged) if p.knee] == [0.3]


def test_points_of_a_front_with_more_failures_or_too_few_trials_do_not_dominate():
    """A point has half the error at less torque, but failed trials, or too few trials for an interval.

    A single trial without dispersions has no interval and can dominate.
    """
    rng = np.random.default_rng(0)
    errors = rng.lognormal(0.0, 0.5, 400)
    better = point(0.2, 0.5), trials(0.5 * errors * rng.normal(1.0, 0.05, 400))
    worse = point(0.3, 1.0), trials(errors)

    def dominated(*judged):
        return [one.peak for one in pareto.mark_points(judged) if one.dominated]

    failed, failed_more = (point(0.2, 0.5, failures=1), better[1]), (point(0.3, 1.0, failures=2), worse[1])
    assert dominated(better, worse) == dominated(failed, failed_more) == [0.3]
    assert dominated(failed, worse) == []
    for count, beaten in ((5, []), (1, [0.3])):
        few = [(one[0], trials(np.asarray(one[1].metrics.window_error)[:count])) for one in (better, worse)]
        assert dominated(*few) == beaten


CHAIN = SHORT_CHAIN.replace("peak_torque = 3.0", "peak_torque = 0.55")
SPACECRAFT = SHORT.replace("peak_torque = 30.0", "peak_torque = 8.0")


@pytest.mark.parametrize(
    ("text", "limit"), short([(CHAIN, 0.55), (SPACECRAFT, 8.0)], [(CHAIN, 0.55)]), ids=["chain", "spacecraft"]
)
def test_pareto_command_computes_a_torque_front(command, tmp_path, monkeypatch, text, limit):
    """The gains of each row reproduce its error and torque. Output, page and files agree.

    The scenario's torque limit is a target. Its gains are at least as accurate as all known gains that keep the limit.
    """
    small_search(monkeypatch, 60)
    (tmp_path / "s.toml").write_text(text.replace("steps = 4", "steps = 6"))
    refined, search, begun, searched = pareto.refine_targets, posing.TuningSetup.search, [], []

    def spied(targets, known, posed, tell):
        begun.append(({one.value: one.problem for one in targets}, np.asarray(known), posed.evaluate))
        return refined(targets, known, posed, tell)

    def searching(posed, problem, *args, **options):
        searched.append(problem.limits[problem.metrics.index("peak_torque")])
        return search(posed, problem, *args, **options)

    monkeypatch.setattr(pareto, "refine_targets", spied)
    monkeypatch.setattr(posing.TuningSetup, "search", searching)
    status, told, _ = command("pareto", "s.toml", "--points", 4, "--out", "p")
    assert set(tree(tmp_path / "p")) == {
        "front.csv", "summary.json", "scenario.toml", "versions.json", "figures/front.png"
    }  # fmt: skip
    summary = json.loads((tmp_path / "p" / "summary.json").read_text())
    assert status == (0 if summary["status"] == "met" else 1)
    with (tmp_path / "p" / "front.csv").open() as file:
        rows = list(csv.DictReader(file))
    kept = [row for row in rows if row["dominated"] == "0"]
    assert len(kept) >= 3
    assert sum(row["knee"] == "1" for row in rows) == 1
    peaks = [float(row["peak_torque"]) for row in rows]
    assert peaks == sorted(peaks)
    # the scenario's torque limit is a target, and its gains are at least as accurate as all known feasible gains
    (trained,) = [float(row["trained_objective"]) for row in rows if float(row["limit"]) == limit]
    ((problems, known, evaluate),) = begun
    simulated = evaluate.measure(problems[limit].tightened(1.0 - pareto.MARGIN), known)
    assert len(known) > len(searched)  # including other local minima of the searches
    assert searched.count(limit) == 1
    assert trained <= np.exp(simulated.value[simulated.largest_c <= local_search.SLACK].min()) * (1.0 + 1e-9)
    for row in rows:
        assert float(row["rms_low"]) <= float(row["rms_window_error"]) <= float(row["rms_high"])
        # simulate the gains of the row again
        values = {"eta": float(row["eta"]), "delta": float(row["delta"])}
        made = scenario.replace(
            scenario.read(tmp_path / "s.toml"), **{f"controller__{k}": v for k, v in values.items()}
        )
        simulated = judging.judge(made, summary["seed"])
        np.testing.assert_allclose(np.sqrt(np.mean(simulated.metrics.window_error**2)), float(row["rms_window_error"]))
        np.testing.assert_allclose(simulated.metrics.peak_torque.max(), float(row["peak_torque"]))
    assert f"{len(kept)} points, each judged on 60 held-out trials" in told
    read = checked(tmp_path / "p")
    assert set(read.charts) == {"front"}
    colours = {series["name"].split(",")[0]: series["marker"]["color"] for series in read.charts["front"]["data"]}
    assert (colours["front"], colours["published gains"]) == ("#0072B2", "#D55E00")  # as in figures/front.png
    assert all(float(row["rms_window_error"]) > summary["lower_bound"] > 0.0 for row in rows)
    assert "lower bound on the RMS error with these sensors" in told
    drawn = read.charts["front"]["layout"]["shapes"][-1]
    bound = summary["lower_bound"]
    shown = float(pointing_angle(bound)) * ARCSEC if "[plant]" not in text else bound  # a chart of a spacecraft: arcsec
    np.testing.assert_allclose([drawn["y0"], drawn["y1"]], shown, rtol=1e-12)
    assert f"{sum(not point['dominated'] for point in summary['points'])} points, each judged on" in read.text
    assert command("pareto", "s.toml", "--points", 4, "--out", "p")[1].endswith("(from an earlier run)\n")
    assert command("pareto", "s.toml", "--points", 5, "--out", "p")[0] == 2


def test_torque_front_does_not_need_a_torque_limit():
    made = scenario.from_tables({"requirements": {"effort": 9.0}, "tune": {}})
    assert trades.Torque(made).base.requirements == {"effort": 9.0, "peak_torque": trades.INACTIVE_LIMIT}
    quantile = scenario.replace(made, requirements={"peak_torque": {"limit": 0.5, "quantile": 0.9}})
    assert trades.Torque(quantile).base is quantile


@pytest.mark.parametrize("limit", [None, 0.5, 1.001, 1.4, 1.5, 3.0, 5.0, 6.0, 15.9, 16.0])
def test_torque_limit_of_the_scenario_replaces_the_nearest_default_limit_of_a_front(limit):
    """The nearest limit is in logarithms. The ends stay, because searches have found feasible gains for them."""
    usual = np.array([1.0, 2.0, 4.0, 8.0, 16.0])
    ladder, middle = trades.limits_between(1.0, 16.0, 5, limit)
    stages = {1.001: 1, 1.4: 1, 1.5: 1, 3.0: 2, 5.0: 2, 6.0: 3, 15.9: 3}  # above 2 sqrt(2), 4 is nearer than 2
    assert middle == stages.get(limit, 2)
    np.testing.assert_allclose(np.delete(ladder, middle), np.delete(usual, middle), rtol=1e-14)
    assert ladder[middle] == (limit if limit in stages else pytest.approx(4.0, rel=1e-14))


@pytest.mark.parametrize(("found", "best"), [(None, 2.0), (3.0, 2.0), (1.5, 1.5)])
def test_refined_gains_of_a_front_are_not_worse_than_known_feasible_gains(monkeypatch, found, best):
    """F is the gain itself. Gain 1 breaks the limit, gain 2 keeps it. The local search finds nothing, 3 or 1.5."""

    def measured(problem, normalised):
        f = normalised[:, 0]
        return Measurement(normalised, f, np.where(f < 1.4, 0.1, -0.1)[:, None, None], f)

    class Found(local_searches.LocalSearches):
        def search_locally(self, problem, starts):
            if found is not None:
                self._best = local_search.Best(np.full(1, found), 1, pareto.MARGIN)
                self._best.offer(self._best.normalised[None], measured(problem, self._best.normalised[None]))

        def tightened(self, problem):
            return problem

    monkeypatch.setattr(pareto, "LocalSearches", Found)
    posed: Any = SimpleNamespace(
        evaluate=SimpleNamespace(measure=measured), settings=SimpleNamespace(with_gradients=True)
    )
    problem: Any = SimpleNamespace(rows=["peak_torque"])
    step = pareto._refine_gains(posed, problem, np.asarray([[1.0], [2.0], [4.0]]))
    assert step is not None
    assert (step.f, step.violation) == (best, 0.0)
    assert pareto._refine_gains(posed, problem, np.asarray([[1.0]])) is None or found is not None


@pytest.mark.parametrize(("least", "limits"), [(9.0, [5.0]), (2.0, [5.0, 0.25]), (1e-9, [5.0, 0.25, 0.0125])])
def test_least_torque_search_lowers_the_limit_until_it_is_infeasible(least, limits):
    """Under a feasible limit, a search returns the most accurate gains, and not those with the least torque."""
    asked = []

    def asking_for(limit):
        asked.append(limit)
        return len(asked), max(0.97 * limit, least)

    found, peak = trades.least_torque(asking_for, 100.0)
    np.testing.assert_allclose(asked, limits)
    assert (found, peak) == (len(limits), max(0.97 * limits[-1], least))
