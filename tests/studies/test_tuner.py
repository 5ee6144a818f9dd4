"""Tuning runs: repeated searches after held-out trials, wider bounds, judging and reports."""

import tomllib
from dataclasses import dataclass
from types import SimpleNamespace
from typing import Any, cast

import numpy as np
import pytest

from ptsmc_jax import scenario
from ptsmc_jax.scenario.tables import objective_name
from ptsmc_jax.simulation.requirements import Requirement
from tests.helpers import FIRST_FLIGHT, ROOT, SHORT_CHAIN, small_search
from tuning.output import summaries, tune_report
from tuning.search import normalisation, trust, worst
from tuning.search.evaluate import Evaluator
from tuning.search.local_searches import Step
from tuning.studies import judging, posing, tune_files, tuner

LIMIT = 0.6  # on the peak torque


@pytest.fixture
def small(monkeypatch):
    """Search with few trials and judge on enough trials to break a limit, by the compiled programs of test_cli.py."""
    small_search(monkeypatch, 60)
    monkeypatch.setattr(worst, "SCREENED", 2)
    monkeypatch.setattr(
        tuner, "_compile_judging", lambda _: None
    )  # it compiles the margins, which the tests do not use
    monkeypatch.setattr(tuner, "_find_shortest_time", lambda *_: None)  # it needs another compiled program


def test_search_is_repeated_if_held_out_trials_break_a_limit(small):
    """Two training and two screened trials keep the limit, but some of 60 held-out trials break it.

    Each repeated search keeps more distance from the limit, and the third one meets it on the held-out trials.
    """
    text = SHORT_CHAIN.replace("peak_torque = 3.0", f"peak_torque = {LIMIT}").replace("trials = 8", "trials = 2")
    loaded = scenario.from_tables(tomllib.loads(text))
    steps = list[str]()
    found = tuner.tune(loaded, 0, lambda step, *_: steps.append(step), with_checks=False)
    first, second = found.earlier
    for number in (2, 3):
        assert any(step.startswith(f"search {number} of at most 3: ") and "peak_torque" in step for step in steps)
    assert found.met
    seeds = [one.held_out_seed for one in (first, second, found)]
    assert seeds == [
        judging.derive_held_out_seed(0),
        judging.derive_held_out_seed(0, 1),
        judging.derive_held_out_seed(0, 2),
    ]
    assert len(set(seeds)) == 3

    def peak(gains, seed):
        made = scenario.replace(loaded, **{f"controller__{name}": value for name, value in gains.items()})
        return judging.judge(made, seed).metrics.peak_torque.max() / LIMIT

    for one in (first, second):
        np.testing.assert_allclose(peak(one.gains, one.held_out_seed), one.over["peak_torque"], rtol=1e-12)
    assert first.over["peak_torque"] > second.over["peak_torque"] > 1.0
    # the violation on the held-out trials, and 2 % more
    reached = min(found.search.history, key=lambda step: abs(step.gains - [*second.gains.values()]).max()).worst[0]
    margins = [one["peak_torque"] for one in (first.margins, second.margins, found.search.margins)]
    np.testing.assert_allclose(margins[2], 1 - reached / (1.02 * second.over["peak_torque"]), rtol=1e-3)
    np.testing.assert_allclose(found.search.worst, 1 - margins[2], rtol=1e-3)  # the limit is active
    goes_on = {step.start: step.gains for step in reversed(found.search.history)}  # each start's first gains
    assert sorted(goes_on) == [0, 1, 2, 3, 4, 5]  # two starting points for each search
    for one, start in zip((first, second), (2, 4), strict=True):
        np.testing.assert_allclose(goes_on[start], [*one.gains.values()], rtol=1e-9)  # rounded to ten digits
    assert [step.start for step in found.search.history] == sorted(step.start for step in found.search.history)
    lines = tune_report.search_lines(summaries.tune(tune_files.summary(found)))
    told = [one for one in lines if one.startswith("earlier gains")]
    assert margins[0] == 0.03
    for one, before, after, sentence in zip((first, second), margins, margins[1:], told, strict=False):
        assert f"reached {one.over['peak_torque']:.4g} times the limit of peak_torque on held-out trials" in sentence
        assert f"{100 * after:.2g} % instead of {100 * before:.2g} %" in sentence
    assert len(told) == 2
    once = tuner.tune(loaded, 0, with_checks=False, tries=1)
    assert once.gains == first.gains
    assert not once.met


@pytest.mark.parametrize(("free", "anchored"), [(["eta", "delta"], True), (["eta", "t_f"], True), (["eta"], False)])
def test_tuning_of_delta_or_t_f_uses_the_anchored_clock(free, anchored):
    """On the flight clock, small changes of delta have no effect, and its gradient is zero."""
    bounds = {"eta": [2.6, 3.1], "delta": [0.1, 2.0], "t_f": [4.0, 6.0]}
    tables = tomllib.loads(SHORT_CHAIN) | {"tune": {"free": free, "bounds": {name: bounds[name] for name in free}}}
    simulated = scenario.replace(scenario.from_tables(tables), loop__clock="flight")
    posed = posing.set_up_tuning(simulated, 0)
    assert posed.problem.parts.clock.anchored == anchored
    assert posed.ready.scenario == (scenario.from_tables(tables) if anchored else simulated)


def test_reach_of_a_tuning_covers_the_bounds_and_the_gains_of_the_scenario():
    """The reach is the range of times and gains. Clock and integration steps are chosen for it."""
    wide = {"eta": [2.1, 9.0], "delta": [0.1, 4.0], "t_f": [20.0, 60.0], "observer_gain": [2.0, 50.0],
            "k1": [0.5, 7.0], "sign_width": [1e-4, 1e-2], "surface_rate": [0.2, 3.0]}  # fmt: skip
    made = scenario.from_tables({"controller": {"sign_width": 1e-3}, "tune": {"free": [*wide], "bounds": wide}})
    reach = posing.tuning_reach(made)
    assert (reach.smallest_t_f, reach.t_f) == (20.0, 60.0)
    assert reach.smallest_delta == 0.05  # the scenario's own is shorter
    assert (reach.gain, reach.largest_gain) == (2.0, 50.0)
    assert (reach.k1, reach.sign_width, reach.surface_rate) == (7.0, 1e-4, 3.0)
    assert posing.tuning_reach(made, t_f=99.0).t_f == 99.0


def test_single_nominal_trial_is_judged_without_the_quantile():
    """All trials are equal, so that one trial decides, without a confidence interval for 99 % of the trials."""
    asked = {"peak_torque": {"limit": 3.0, "quantile": 0.99, "confidence": 0.95}}
    tables = tomllib.loads(SHORT_CHAIN) | {"requirements": asked}
    del tables["tune"], tables["dispersion"], tables["hardware"]
    trials: Any = SimpleNamespace(status=np.zeros(1), finished=np.ones(1, bool), ok=np.ones(1, bool))
    for torque, met in ((2.9, True), (3.1, False)):
        trials.metrics = {"peak_torque": np.array([torque])}
        (verdict,) = judging.verdicts_of(scenario.from_tables(tables), trials, 1)
        assert (verdict.met, verdict.quantile, verdict.worst) == (met, None, torque)
    trials.metrics = {}  # a verdict on a metric that the trials lack would always be "not met"
    with pytest.raises(KeyError, match="peak_torque"):
        judging.verdicts_of(scenario.from_tables(tables), trials, 1)


def test_accuracy_gain_uses_trials_that_both_sets_of_gains_finish():
    """Both sets of gains finish ten trials, with an error ratio of five. Trials that one of them loses do not count."""

    def simulated(errors: Any, lost: int) -> Any:
        finished = np.arange(12) != lost
        return SimpleNamespace(finished=finished, metrics=SimpleNamespace(window_error=np.where(finished, errors, 1e3)))

    errors = np.linspace(1.0, 2.0, 12)
    told = tune_files._accuracy_gain({"tuned": simulated(errors, 3), "published": simulated(5.0 * errors, 7)})
    assert told["accuracy_gain_over_published"] == pytest.approx(5.0, rel=1e-12)
    assert told["accuracy_gain_interval"] == pytest.approx((5.0, 5.0), rel=1e-9)
    nothing = {"accuracy_gain_over_published": None, "accuracy_gain_interval": None}
    assert tune_files._accuracy_gain({"tuned": simulated(errors, 3)}) == nothing


@pytest.mark.parametrize(("objective", "said"), [(np.nan, "unknown"), (1e-3, "none")])
def test_influence_of_a_gain_is_unknown_if_no_trial_finishes(objective, said):
    """If no trial has an objective, its replacement value is equal for all gains, which is no evidence."""
    profile = trust.Profile(np.arange(3.0), np.full(3, objective), np.ones(3), np.zeros(3))
    found: Any = SimpleNamespace(
        gradient_error=None, without_gradients=None, profiles={"eta": profile}, sensitivities={}, margins={}
    )
    tuning: Any = SimpleNamespace(tuned=SimpleNamespace(sampled=True, hardware=None), at_bound={"eta": "upper"})
    assert tune_files._trust_entry(found, tuning)["influence"] == {"eta": said}


@pytest.mark.parametrize(
    ("tune", "column", "name"),
    [
        ({"minimise": "t_f"}, "objective_t_f", "t_f"),
        ({"minimise": "limits"}, "objective_limits", "largest metric over its limit"),
        ({}, "rms_window_error", "RMS window error"),
        ({"minimise": "effort", "statistic": "quantile"}, "quantile_effort", "90 % quantile of effort"),
    ],
)
def test_the_objective_in_the_history_of_a_search_is_named_after_its_metric(tune, column, name):
    tables = tomllib.loads(SHORT_CHAIN) | {"tune": {"free": ["eta", "t_f"], **tune}}
    some = scenario.from_tables(tables)
    columns = tune_files.history_columns(some, ["peak_torque"])
    assert columns == ["step", "start", "stage", column, "eta", "t_f", "peak_torque_over_limit"]
    assert objective_name(some.search) == name


@dataclass(frozen=True)
class Found:
    """The part of a `Search` that a search in wider bounds depends on."""

    gains: np.ndarray
    value: float
    problem: Any = None
    violation: float = 0.0
    interrupted: bool = False
    with_gradients: bool = True
    history: tuple[Step, ...] = ()

    @property
    def normalised(self) -> np.ndarray:
        """Return the gains as fractions of their bounds. All are at the upper bound."""
        return np.ones(len(self.gains))


class Rising:
    """A problem of K1 and eta with F = -ln K1. A search ends at the upper bounds of both; eta has no effect."""

    def __init__(self, made: scenario.Scenario, searched: list[dict[str, tuple[float, float]]]):
        self.ready, self.problem = SimpleNamespace(scenario=made), None
        self.settings = SimpleNamespace(seed=0)
        self.searched, names = searched, tuple(made.search.bounds)
        lower, upper = zip(*made.search.bounds.values(), strict=True)
        bounds = normalisation.Bounds(names, lower, upper)

        def measure(problem: Any, normalised: np.ndarray) -> Any:
            """Return F = -ln K1, without simulation."""
            k1 = np.array([bounds.gains(one)[names.index("k1")] for one in normalised])
            return SimpleNamespace(f=-np.log(k1), largest_c=np.zeros(len(k1)))

        self.evaluate = Evaluator(bounds)
        self.evaluate.measure = measure

    def search(self, problem: Any, gains: Any, starts: int, report: Any) -> Found:
        """Record the bounds, and return the gains at the upper bounds."""
        self.searched.append(dict(self.ready.scenario.search.bounds))
        self.evaluate.rollouts += 10
        upper = np.array(self.evaluate.bounds.upper)
        value = float(1.0 / upper[self.evaluate.bounds.names.index("k1")])
        return Found(upper, value, history=(Step(0, upper, value, upper, 1),))


def test_search_widens_default_bounds_of_gains_that_matter(monkeypatch):
    """The bound of K1 is multiplied by ten, at most three times. The bound of eta stays, because eta has no effect.

    Bounds that the scenario states do not change.
    """
    tables = {"controller": {"t_f": 30.0}, "tune": {"free": ["eta", "k1"]}}
    searched = list[dict[str, tuple[float, float]]]()
    monkeypatch.setattr(posing, "set_up_tuning", lambda made, *_, **__: Rising(made, searched))
    monkeypatch.setattr(tuner, "_renumber_starts", lambda before, more: more)
    some, told = scenario.from_tables(tables), []
    first, usual = Rising(some, searched), some.search.bounds
    outcome = first.search(None, None, 1, None)
    found, posed = tuner._search_in_wider_bounds(
        cast(Any, outcome), cast(Any, first), None, lambda *said: told.append(said[0])
    )
    factors = [one["k1"][1] / usual["k1"][1] for one in searched]
    np.testing.assert_allclose(factors, 10.0 ** np.arange(1 + tuner.MOST_WIDENINGS), rtol=1e-12)
    assert all(one["eta"] == usual["eta"] for one in searched)
    assert told == [f"beyond the bounds of k1, search {k} of at most 3" for k in (1, 2, 3)]
    assert found.gains[1] == pytest.approx(1e3 * usual["k1"][1])
    assert len(found.history) == 1 + tuner.MOST_WIDENINGS
    assert posed.evaluate.rollouts == 10 * (1 + tuner.MOST_WIDENINGS)
    assert posed.ready.scenario.search.bounds == searched[-1]
    stated = scenario.replace(some, tune__bounds={"k1": usual["k1"]})  # explicit bounds do not change
    first = Rising(stated, searched)
    assert tuner._search_in_wider_bounds(cast(Any, outcome), cast(Any, first), None, lambda *_: None)[1] is first


@pytest.mark.parametrize(
    ("metric", "values", "reached", "over"),
    [
        ("peak_torque", [0.4, 0.6], 0.9, {"peak_torque": 1.2}),
        ("peak_torque", [0.4, 0.6], 1.1, {}),  # the search did not keep the limit either
        ("peak_torque", [0.4, 0.6], 0.0, {}),  # the limit had no effect in the search
        ("gain_margin", [5.0, 7.0], 0.9, {"gain_margin": 2.0 - 5.0 / 6.0}),
        ("gain_margin", [0.0, 7.0], 0.9, {}),  # the loop has a limit cycle
    ],
)
def test_violations_that_a_repeated_search_cannot_fix_are_ignored(metric, values, reached, over):
    wanted = Requirement(metric, 0.5 if metric == "peak_torque" else 6.0, "", at_least=metric == "gain_margin")
    verdict = wanted.verdict(np.asarray(values), np.ones(2, bool))
    found = SimpleNamespace(worst=np.asarray([reached]), problem=SimpleNamespace(rows=[metric]))
    assert tuner._broken_ratios(cast("Any", found), [verdict]) == pytest.approx(over)


def test_a_scenario_with_default_gains_is_compared_with_the_published_gains_once():
    """The scenario omits the bandwidth of the filter. Its default equals the published gain."""
    loaded = scenario.read(ROOT / "scenarios" / "filtered_flight.toml")
    assert list(judging.reference_scenarios(loaded)[0]) == ["published"]
    other = scenario.replace(loaded, controller__eta=4.0)
    assert list(judging.reference_scenarios(other)[0]) == ["published", "before"]


def test_requirements_broken_by_more_accurate_gains_are_listed(monkeypatch):
    """Errors are compared over the trials that both sets of gains finish."""

    def simulated(errors, finished=(True, True)):
        return SimpleNamespace(metrics=SimpleNamespace(window_error=np.array(errors)), finished=np.array(finished))

    verdicts = {"published": [("gain_margin", False), ("effort", True)], "before": [("effort", True)]}
    monkeypatch.setattr(
        judging, "verdicts_of", lambda name, *_: [SimpleNamespace(metric=m, met=met) for m, met in verdicts[name]]
    )
    tuned, names = simulated([2.0, 2.0]), {name: name for name in ("tuned", "published", "before")}

    def broken_by(published, before):
        held_out: Any = {"tuned": tuned, "published": published, "before": before}
        return tuner._find_broken_requirements(cast(Any, names), held_out, 0, cast(Any, None))

    assert broken_by(simulated([1.0, 2.0]), simulated([1.0, 1.0])) == {"published": ["gain_margin"], "before": []}
    assert broken_by(simulated([3.0, 2.0]), simulated([2.0, 2.0])) == {}
    assert [*broken_by(simulated([1.0, 9.0], (True, False)), simulated([0.0, 0.0], (False, False)))] == ["published"]


@pytest.mark.parametrize("gain", [[0.02], [0.02, 0.03, 0.04]])
def test_held_out_trials_of_the_search_program_equal_those_of_a_campaign(gain):
    """The second case has different gains on each axis, which the tuned gain of all axes cannot represent."""
    tables = tomllib.loads(FIRST_FLIGHT.read_text()) | {"tune": {"free": ["delta", "observer_gain"]}}
    tables["pointing"] = {"boresight": [0.0, 0.0, 1.0], "window": 1.0}
    temporal = {"limit": "0.1 deg", "probability": 0.95, "interpretation": "temporal"}
    tables["requirements"] = {"ape_boresight": "0.1 deg", "ape_x": temporal}
    loaded = scenario.replace(scenario.from_tables(tables), observer__gain=gain * (3 // len(gain)))
    problem = posing.set_up_tuning(loaded, 0).problem
    assert problem.parts.clock.anchored
    judged, campaign = judging.judge(loaded, 5, problem), judging.judge(loaded, 5)
    np.testing.assert_array_equal(judged.status, campaign.status)
    assert {"ape_boresight", "ape_x", "within_ape_x"} <= set(judged.metrics)
    for name, values in judged.metrics.items():
        np.testing.assert_allclose(values, campaign.metrics[name], rtol=1e-9, atol=1e-15, err_msg=name)


def test_published_gains_of_another_law_are_judged_without_the_search_program():
    """The compiled program of a search serves only its own law. The held-out trials equal those of a campaign."""
    loaded = scenario.replace(scenario.from_tables(tomllib.loads(SHORT_CHAIN)), tune=None, controller={"kind": "pd"})
    problem = posing.set_up_tuning(posing.with_tune(loaded), 0).problem
    published = judging.reference_scenarios(loaded)[0]["published"]
    judged, campaign = judging.judge(published, 5, problem), judging.judge(published, 5)
    np.testing.assert_array_equal(judged.metrics.window_error, campaign.metrics.window_error)


def test_scenario_of_held_out_trials_differs_only_in_the_flight_clock():
    loaded = scenario.read(FIRST_FLIGHT)
    simulated = judging.on_flight_clock(loaded)
    assert simulated.loop.clock == "flight"
    assert simulated.controller == loaded.controller
    assert judging.on_flight_clock(scenario.from_tables({})) == scenario.from_tables({})
