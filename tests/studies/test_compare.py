"""`ptsmc compare`: all laws have the same search settings and are judged on the same trials."""

import csv
import json
import tomllib
import typing
from dataclasses import replace
from types import SimpleNamespace

import numpy as np
import pytest

import tuning
from ptsmc_jax import scenario
from ptsmc_jax.campaigns import montecarlo
from ptsmc_jax.campaigns.store import RefusedError
from ptsmc_jax.figures import study_plots, style
from ptsmc_jax.scenario import systems
from ptsmc_jax.scenario.errors import ScenarioError
from ptsmc_jax.scenario.law_tables import BASELINES
from ptsmc_jax.simulation import rollout
from ptsmc_jax.simulation.metrics import Metrics
from ptsmc_jax.simulation.requirements import Requirement
from tests.helpers import ROOT, SHORT, refused
from tests.output.pages import checked
from tuning.cli import main
from tuning.errors import UsageError
from tuning.output import compare_report, page, summaries
from tuning.output.formats import format_ratio
from tuning.search import custom_parts, gains
from tuning.studies import compare, judging, tuner

TABLES = tomllib.loads(SHORT)


def tuned(scenario):
    """Return the table [tune] of a scenario that must have one."""
    assert scenario.tune is not None
    return scenario.tune


def test_all_laws_have_the_same_mission_requirements_and_search_settings(monkeypatch):
    """The free gains are those of each law, and gains of the observer."""
    base = scenario.from_tables(TABLES)
    posed = compare.contenders(base)
    assert list(posed) == ["prescribed_time", *BASELINES]
    assert set(posed) >= {
        "prescribed_time", "pd", "terminal", "fixed_time", "time_base_pd", "time_base_sliding", "scaling",
        "predefined_time", "super_twisting",
    }  # fmt: skip
    assert posed["prescribed_time"] is base
    for kind, other in posed.items():
        assert other.controller.kind == kind
        assert other.controller.t_f == base.controller.t_f
        for table in ("loop", "hardware", "dispersion", "observer", "disturbance", "spacecraft", "requirements"):
            assert getattr(other, table) == getattr(base, table)
        for key in compare.SHARED_KEYS:
            assert getattr(other.tune, key) == getattr(base.tune, key)
    free = {kind: tuned(other).free for kind, other in posed.items()}
    assert free["pd"] == ("k_p", "k_d", "observer_gain")
    assert free["terminal"] == ("p", "b", "k", "observer_gain", "sign_width")
    assert free["fixed_time"] == ("a1", "b1", "a2", "b2", "p", "gamma", "m", "n", "observer_gain", "sign_width")


def test_help_of_option_against_lists_every_law():
    _, option = typing.get_args(typing.get_type_hints(main.compare, include_extras=True)["against"])
    said = option.help.split(": ")[1].split(";")[0]
    assert said.split(", ") == compare.law_kinds()[1:]


def test_custom_law_is_compared_with_the_requested_laws():
    """Unknown laws are refused. The requested laws are a part of the identity of the comparison."""
    base = scenario.from_tables(TABLES)
    where = str(ROOT / "scenarios" / "own_parts.py") + ":Scaling"
    rivals = compare.Rivals(("pd",), (where,))
    rivals.check()
    posed = compare.contenders(base, rivals)
    assert list(posed) == ["prescribed_time", "pd", "Scaling"]
    assert posed["Scaling"].controller.code == where
    assert posed["Scaling"].requirements == base.requirements
    assert tuned(posed["Scaling"]).free == ("delta", "m", "k1", "k", "observer_gain")
    assert compare.identity(base, 3, rivals)["laws"] == ["prescribed_time", "pd", "Scaling"]
    assert compare.identity(base, 3) == {"command": "compare", "seed": 3}
    for wrong, said in ((compare.Rivals(("lqr",)), "--against is lqr"), (compare.Rivals(None, ("x",)), "--law is x")):
        with pytest.raises(UsageError, match=said):
            wrong.check()


def test_custom_law_of_the_scenario_keeps_the_settings_of_the_scenario(tmp_path):
    (tmp_path / "own.py").write_bytes((ROOT / "scenarios" / "own_parts.py").read_bytes())
    law = {"kind": "custom", "code": f"{tmp_path}/own.py:Scaling", "t_f": 5.0, "delta": 0.7}
    mine = scenario.replace(scenario.from_tables(TABLES), tune=None, controller=law)
    mine = scenario.replace(mine, tune={"free": ["delta"], "trials": 8})
    assert compare.contenders(mine, compare.Rivals(("pd",)))["Scaling"] is mine  # without the option --law
    (tmp_path / "linked.py").symlink_to(tmp_path / "own.py")
    named = compare.contenders(mine, compare.Rivals(("pd",), (f"{tmp_path}/linked.py:Scaling",)))
    assert list(named) == ["prescribed_time", "pd", "Scaling"]
    assert named["Scaling"] is mine


def test_checksums_accept_only_the_custom_laws_of_the_comparison(tmp_path):
    for name in ("simulated", "beside", "other"):
        (tmp_path / f"{name}.py").write_text(f"# {name}\n")
    where = {name: f"{tmp_path}/{name}.py:Mine" for name in ("simulated", "beside", "other")}
    of_scenario = {"controller_sha256": systems.checksum(where["simulated"])}
    of_rivals = {"custom_laws": {where["beside"]: systems.checksum(where["beside"])}}
    for made, names in ((of_scenario | of_rivals, ("simulated", "beside")), (of_rivals, ("beside",))):
        for name in names:
            custom_parts.check_unchanged({"controller.code": where[name]}, tmp_path, made)
        with pytest.raises(RefusedError, match="was made with another"):
            custom_parts.check_unchanged({"controller.code": where["other"]}, tmp_path, made)


def test_custom_laws_with_equal_names_get_different_labels():
    named = compare.Rivals((), ("a.py:Mine", "b.py:Mine", "c.py:Mine", "a.py:Mine", "a.py:published")).law_tables
    assert list(named) == ["prescribed_time", "Mine", "custom Mine", "custom custom Mine", "custom published"]
    assert len({law.get("code") for law in named.values()}) == 5


def test_different_paths_of_one_file_are_the_same_custom_law(tmp_path, monkeypatch):
    """Earlier, `./mine.py:Mine` and `mine.py:Mine` were two laws, and the comparison did not resume."""
    monkeypatch.chdir(tmp_path)
    (tmp_path / "mine.py").write_text("")
    ways = ("mine.py:Mine", "./mine.py:Mine", f"{tmp_path}/mine.py:Mine")
    base = scenario.from_tables(TABLES)
    known = [compare.identity(base, 0, compare.Rivals((), (way,))) for way in ways]
    assert known[0] == known[1] == known[2] == compare.identity(base, 0, compare.Rivals((), ways))
    assert list(compare.Rivals((), ways).law_tables) == ["prescribed_time", "Mine"]


def test_baseline_law_of_the_scenario_keeps_the_bounds_of_the_scenario():
    mine = scenario.replace(scenario.from_tables(TABLES), tune=None, controller={"kind": "pd", "t_f": 5.0, "k_p": 2.0})
    mine = scenario.replace(mine, tune={"free": ["k_d"], "bounds": {"k_d": [0.5, 3.0]}, "trials": 8})
    posed = compare.contenders(mine)
    assert posed["pd"] is mine
    assert posed["prescribed_time"].controller.kind == "prescribed_time"
    expected = ("eta", "delta", "observer_gain", "k1", "sign_width", "surface_rate")
    assert tuned(posed["prescribed_time"]).free == expected
    assert gains.published_scenario(mine).controller.eta == 3.0
    assert gains.published_scenario(mine).controller.t_f == 5.0


@pytest.mark.parametrize(
    ("tables", "said"),
    [
        ({"loop": {"mode": "continuous"}}, 'loop.mode is "continuous", but must be "sampled"'),
        ({"plant": {"kind": "chain"}}, "for another plant use ptsmc tune for one law at a time"),
    ],
)
def test_comparison_refuses_the_continuous_loop_and_other_plants(tables, said):
    with pytest.raises(ScenarioError, match=said):
        compare.check(scenario.from_tables(tables))


def test_model_errors_change_the_plant_but_not_the_law(eight):
    """The true inertia is 10 % larger or smaller, or the delay is one period longer. The design model is the same.

    Model errors add to those of the scenario. The results count the trials that fail with a model error.
    """
    base = scenario.from_tables(TABLES)
    parts = scenario.study(base).parts
    others = compare.perturbed_scenarios(base)
    assert tuple(others) == compare.MODEL_ERRORS
    for name, factor in (("heavier", 1.1), ("lighter", 0.9), ("later", 1.0)):
        other = scenario.study(others[name]).parts
        np.testing.assert_allclose(other.plant.inertia, factor * np.asarray(parts.plant.inertia), rtol=1e-15)
        np.testing.assert_array_equal(other.controller.model.inertia, parts.controller.model.inertia)
        assert getattr(other.actuators, "delay", 0) == (1 if name == "later" else 0)
    twice = scenario.replace(others["heavier"], hardware__delay=1)
    again = compare.perturbed_scenarios(twice)
    np.testing.assert_allclose(
        scenario.study(again["lighter"]).parts.plant.inertia, 0.9 * 1.1 * np.asarray(parts.plant.inertia), rtol=1e-15
    )
    assert getattr(scenario.study(again["later"]).parts.actuators, "delay", 0) == 2
    ok = rollout.OK
    lost = changed(eight, [ok] * 7 + [rollout.NOT_CONVERGED], window_error=[2.0] * 7 + [2.0], peak_torque=[0.3] * 8)
    said = compare.contender_results(replace(contender(eight), changed={"later": lost}))["model_errors"]
    assert said == {"later": {"window_error": 2.0, "window_error_interval": None,
                              "largest_peak_torque": 0.3, "failures": 1}}  # fmt: skip


def test_every_law_appears_in_table_page_and_figures(eight, tmp_path):
    """There are more laws than plot colours. Tables, charts and figures show all of them.

    Each law has its own colour and marker, and tuned and published gains have the colours of other figures.
    """
    base = scenario.from_tables(TABLES)
    margins = {"hold": {"stable": True, "gain_margin": 7.5, "phase_margin": 40.0, "delay_margin": None,
                        "peak_sensitivity": 3.0}}  # fmt: skip
    settled = changed(eight, eight.status, settling_time=1.0 + np.arange(8))
    one = replace(contender(settled), margins=margins, changed={"heavier": eight})
    names = ["published", *compare.law_kinds()]
    found = compare.Comparison(dict.fromkeys(names, one), 0, False)
    (tmp_path / "out").mkdir()
    compare.write(tmp_path / "out", base, found, True, compare.identity(base, 0))
    rows = list(csv.DictReader((tmp_path / "out" / "compare.csv").read_text().splitlines()))
    said = json.loads((tmp_path / "out" / "summary.json").read_text())
    low, high = said["laws"]["pd"]["window_error_interval"]
    assert low < said["laws"]["pd"]["window_error"] < high
    for row in rows:
        assert (float(row["window_error_low"]), float(row["window_error_high"])) == (low, high)
        assert (row["nominal_gain_margin"], row["nominal_delay_margin"], row["window_error_later"]) == ("7.5", "", "")
        assert row["met"] == str(int(said["laws"][row["law"]]["met"]))
        near, far = said["laws"][row["law"]]["settling_near_far"]
        assert [float(v) for k, v in row.items() if k.startswith("settling")] == [4.0, near, far]
        assert row["window_error_heavier"] == row["window_error"]
    laws = summaries.read(summaries.Compare, said).laws
    answers = [(question, compare_report.answer_table(question, laws)) for question in compare_report.QUESTIONS]
    read = checked(tmp_path / "out")
    assert "the section Gains lists the tuned gains of each law" in read.text
    for k, (question, table) in enumerate(answers):
        assert [row[0] for row in table.rows] == ["published gains", *(name.replace("_", " ") for name in names[1:])]
        assert question.title in read.text
        drawn = read.charts[f"question_{k}"]["data"]
        assert drawn
        for series in drawn:
            assert series["y"] == [row[0] for row in table.rows]
    arcsec = [format_ratio(np.degrees(2 * np.arcsin(bound)) * 3600) for bound in (low, high)]
    assert answers[0][1].rows[3][2] == f"{arcsec[0]} to {arcsec[1]}"
    figures = dict(compare.plot_figures(found))
    drawn = [line for line in figures["settling"].axes[0].lines if line.get_marker() in study_plots.MARKERS]
    looks = {(line.get_color(), line.get_marker()) for line in drawn}
    assert len(drawn) == len(looks) == len(names)
    # earlier, the points of all other laws covered those of the published gains
    order = [str(line.get_label()) for line in sorted(drawn, key=lambda line: -line.get_zorder())]
    assert order[:2] == ["prescribed time", "published gains"]
    # the same colours as in the figures of a tuning
    of_tuning = study_plots.tradeoff({name: (np.ones(2), np.ones(2)) for name in ("tuned", "published gains")}, {})
    for figure in (figures["settling"], figures["tradeoff"], of_tuning):
        colours = {str(line.get_label()).split(":")[0]: line.get_color() for line in figure.axes[0].lines}
        tuned = colours["tuned" if figure is of_tuning else "prescribed time"]
        assert (tuned, colours["published gains"]) == (style.STYLES[0][0], style.STYLES[1][0])


def test_settling_times_are_medians_over_the_smallest_and_over_the_largest_initial_angles():
    angle, settling = np.linspace(0.3, 2.4, 100), np.concatenate([np.full(50, 30.0), np.full(50, 33.0)])
    assert compare._median_settling_times(angle, settling) == (30.0, 33.0)
    assert compare._median_settling_times(-angle, angle) == (
        angle[89],
        angle[9],
    )  # medians of the last and the first 20 trials
    assert compare._median_settling_times(angle, np.where(angle > 2.2, np.inf, settling)) == (30.0, 33.0)
    assert compare._median_settling_times(angle, np.where(angle > 2.0, np.inf, settling)) == (30.0, None)


def test_search_settings_and_known_bounds_are_passed_to_all_laws():
    asked = {"minimise": "effort", "statistic": "cvar", "level": 0.8, "torque_weight": 0.1, "worst_case": True,
             "trials": 7, "starts": 3, "steps": 5}  # fmt: skip
    known = {"disturbance_rate_bound": 2e-3, "disturbance_bound": 0.03, "initial_estimate_error": 0.004}
    base = scenario.replace(scenario.from_tables(TABLES), tune=asked,
                            controller={"t_f": 5.0, "delta": 0.5, "sign_width": 0.02, **known})  # fmt: skip
    for kind, other in compare.contenders(base).items():
        assert {key: getattr(other.tune, key) for key in asked} == asked
        assert {key: getattr(other.controller, key) for key in known} == known
        assert getattr(other.controller, "sign_width", 0.02) == 0.02, kind


def test_all_laws_have_free_gains_if_t_f_is_minimised():
    base = scenario.replace(scenario.from_tables(TABLES), tune={
        "free": ["eta", "delta", "t_f"], "minimise": "t_f", "bounds": {"t_f": [4.0, 8.0]}})  # fmt: skip
    free = {kind: tuned(other) for kind, other in compare.contenders(base).items()}
    assert free["pd"].free == ("k_p", "k_d", "observer_gain", "t_f")
    fixed = ("a1", "b1", "a2", "b2", "p", "gamma", "m", "n", "observer_gain", "sign_width", "t_f")
    assert free["fixed_time"].free == fixed
    assert all(tune.bounds["t_f"] == (4.0, 8.0) for tune in free.values())


@pytest.fixture(scope="module")
def eight():
    """Return the `Trials` of eight simulated trials of a spacecraft."""
    ready = scenario.study(judging.on_flight_clock(scenario.from_tables(TABLES)))  # the compiled program of judging
    return montecarlo.run(ready.parts, ready.dispersion, 0, np.arange(8))


def contender(trials, **changes):
    """Return the `compare.Contender` of a law with these held-out trials; changes: `verdicts` replaces the verdicts."""
    base = scenario.from_tables(TABLES)
    verdicts = judging.verdicts_of(base, trials, 0)
    return compare.Contender(base, {}, {}, {}, trials, changes.get("verdicts", verdicts), None)


def changed(trials, status, **metrics):
    """Return the trials with another status and other values of metrics."""
    numbers = {name: np.asarray(value, dtype=float) for name, value in metrics.items()}
    return replace(trials, status=np.asarray(status, dtype=np.int32), metrics=Metrics({**trials.metrics, **numbers}))


def test_statistics_of_a_compared_law_use_its_finished_trials(eight):
    """Settling times count all trials. A law does not meet its requirements if a trial has not converged."""
    nan, ok, bad = np.nan, rollout.OK, rollout.DIVERGED
    trials = changed(eight, [ok] * 6 + [rollout.NOT_CONVERGED, bad], window_error=[1.0] * 5 + [2.0, 3.0, 99.0],
                     peak_torque=[1.0] * 5 + [2.0, 3.0, 99.0],
                     settling_time=[1.0, 2.0, 3.0, 4.0, nan, nan, nan, 0.5])  # fmt: skip
    one = contender(trials)
    assert not one.met  # one trial diverged, and one did not converge by t_f
    found = compare.contender_results(one)
    assert found["window_error"] == pytest.approx(np.sqrt((5 + 4 + 9) / 7))
    assert found["peak_torque"] == pytest.approx(10 / 7)
    assert found["largest_peak_torque"] == 3.0
    assert found["unsettled"] == 4
    assert found["settling_time"] == {"0.01": 1.0, "0.5": 4.0, "0.99": None}  # quantiles of all trials, settled or not
    assert found["settling_near_far"] is not None
    alike = np.full(8, 2.0) + 4.4e-16 * np.arange(8)  # an angle with a dispersion from 115 to 115 deg
    alike = compare.contender_results(contender(replace(trials, drawn={**trials.drawn, "initial_angle": alike})))
    assert alike["settling_near_far"] is None
    one_not_converged = contender(changed(eight, [ok] * 7 + [rollout.NOT_CONVERGED]))
    assert all(v.met for v in one_not_converged.verdicts)
    assert not one_not_converged.met


def rivals(monkeypatch, eight, interrupt=None):
    """Replace search and judging by functions that record their law and seed; return the list of records.

    A record is ("tune" or "judge", law, seed). interrupt: the law whose search is interrupted.
    """
    asked = []

    def tune(posed, seed, told, journal, *, with_checks, tries):
        assert tries == 1  # more tries would judge on different trials
        law = posed.controller.kind
        asked.append(("tune", law, seed))
        return SimpleNamespace(tuned=posed, gains={}, at_bound={}, widened_bounds={}, held_out={"tuned": eight},
                               verdicts=[], lower_bounds={"tuned": None},
                               search=SimpleNamespace(interrupted=law == interrupt, problem=None))  # fmt: skip

    def judge(simulated, seed):
        asked.append(("judge", "published", seed))
        return eight

    monkeypatch.setattr(compare, "_add_margins_and_model_errors", lambda one, *_: one)
    monkeypatch.setattr(tuner, "tune", tune)
    monkeypatch.setattr(judging, "judge", judge)
    return asked


def test_all_laws_are_tuned_by_one_seed_and_judged_by_another(monkeypatch, eight):
    """The status is that of the prescribed-time law. Another seed is another comparison."""
    asked = rivals(monkeypatch, eight)
    base = scenario.from_tables(TABLES)
    made = compare.compare(base, 5, lambda *told: None, None, compare.validated_contenders(base))
    assert asked == [("judge", "published", judging.derive_held_out_seed(5)),
                     *(("tune", law, 5) for law in compare.law_kinds())]  # fmt: skip
    assert made.status == "met"
    lost = {**made.contenders, compare.OURS: contender(changed(eight, [rollout.DIVERGED] * 8))}
    assert replace(made, contenders=lost).status == "not met"
    assert compare.identity(made.contenders["published"].simulated, 5) != compare.identity(
        made.contenders["published"].simulated, 6
    )


def test_function_and_command_compare_the_same_laws(monkeypatch, eight):
    """Unknown laws and other plants are refused."""
    asked = rivals(monkeypatch, eight)
    found = tuning.compare(scenario.from_tables(TABLES), against=["pd"], seed=5)
    assert [(law, seed) for what, law, seed in asked if what == "tune"] == [("prescribed_time", 5), ("pd", 5)]
    assert list(found.summary["laws"]) == ["published", "prescribed_time", "pd"]
    assert found.report.headline in repr(found)
    assert list(found.plot("tradeoff")) == ["tradeoff"]
    for other, said in ((["lqr"], "is lqr, but must be one of pd"), ("pd", "is p, but must be one of pd")):
        with pytest.raises(ValueError, match=said):
            tuning.compare(scenario.from_tables(TABLES), against=other)
    with pytest.raises(ScenarioError, match=r"plant\.kind"):
        tuning.compare(scenario.from_tables({"plant": {"kind": "chain"}}))


def test_an_interruption_ends_the_comparison(monkeypatch, eight):
    asked = rivals(monkeypatch, eight, interrupt="pd")
    base = scenario.from_tables(TABLES)
    made = compare.compare(base, 5, lambda *told: None, None, compare.validated_contenders(base))
    assert made.status == "interrupted"
    assert [law for what, law, _ in asked if what == "tune"] == ["prescribed_time", "pd"]


def test_scenario_that_a_law_cannot_control_is_refused_before_any_search(monkeypatch, eight):
    asked = rivals(monkeypatch, eight)
    opposite = {"initial": {"rotvec_deg": [0.0, 0.0, 90.0]}, "reference": {"rotvec_deg": [0.0, 0.0, -90.0]}}
    tables = {name: table for name, table in TABLES.items() if name != "dispersion"} | opposite
    with pytest.raises(ScenarioError, match=r"the law terminal cannot be used in this scenario: .*q_e4 = 0"):
        compare.validated_contenders(scenario.from_tables(tables))
    assert not asked


def test_a_warning_names_its_laws_unless_it_concerns_all_of_them(eight):
    """Earlier, two laws had nearly the same line without a name, and the advice to reduce a gain that was tuned."""
    quiet = scenario.replace(scenario.from_tables(TABLES), disturbance={"kind": "constant", "amplitude": [1e-6, 0, 0]})
    noisy = scenario.replace(quiet, hardware__rate_noise=1e-2, tune={"trials": 8})
    gains_by_law = {"published": 20.0, compare.OURS: 30.0, "pd": 40.0, "scaling": 40.0}

    def warnings(gains):
        made = {law: replace(contender(eight), simulated=scenario.replace(noisy, observer__gain=[gain] * 3))
                for law, gain in gains.items()}  # fmt: skip
        return [text for text in compare.summary(compare.Comparison(made, 0, False))["warnings"] if "noise" in text]

    published, ours, others = warnings(gains_by_law)
    assert published.startswith("published gains: observer.gain is [20.0,")
    assert published.endswith('try a smaller gain, or observer.kind = "none"')
    assert ours.startswith("prescribed_time: observer.gain is [30.0,")
    assert others.startswith("pd, scaling: observer.gain is [40.0,")
    assert others.endswith('; try observer.kind = "none"')
    (same,) = warnings(dict.fromkeys([compare.OURS, "pd"], 40.0))
    assert same.startswith("observer.gain is [40.0,")


def test_plain_numbers_of_a_custom_law_cause_a_warning_before_and_after_the_search(
    command, eight, tmp_path, monkeypatch
):
    """Earlier, a law without any gain was compared without being tuned, and nothing reported it."""
    monkeypatch.chdir(tmp_path)
    (tmp_path / "own.py").write_text(
        "import ptsmc_jax as ptsmc\n\n\nclass Plain(ptsmc.AccelerationLaw):\n"
        "    k_p: float = 0.2\n    k_d: float = 1.0\n    k_i: float = ptsmc.gain(0.1, (0.01, 1.0))\n"
        "    floor: float = ptsmc.number(0.1)\n    axis: tuple = (1.0, 0.0, 0.0)\n\n"
        "    def acceleration(self, now, error, error_rate, bound):\n"
        "        return -self.k_p * error - self.k_d * error_rate, error\n"
    )
    posed = compare.contenders(scenario.from_tables(TABLES), compare.Rivals(("pd",), ("own.py:Plain",)))
    made = {law: replace(contender(eight), simulated=one) for law, one in posed.items()}
    (warning,) = compare.summary(compare.Comparison(made, 0, False))["warnings"]
    assert warning.startswith("Plain: the search does not tune k_p, k_d, because they are plain numbers")

    def stop(*_):
        raise UsageError("the search begins")

    monkeypatch.setattr(compare, "compare", stop)
    (tmp_path / "s.toml").write_text(SHORT)
    status, _, error = command("compare", "s.toml", "--against", "pd", "--law", "own.py:Plain")
    assert status == 2
    assert error.splitlines()[-2:] == [f"ptsmc: {warning}", "ptsmc: the search begins"]


def lines_of(summary):
    """Return a list of the sentences on gains in the report of a comparison with this summary."""
    return list(compare_report.gain_lines(summaries.read(summaries.Compare, summary)))


def test_required_margins_appear_in_table_csv_file_and_report(eight, tmp_path):
    """The table and compare.csv have the margins of every law. The report has those that break a limit."""
    asked = Requirement("gain_margin", 6.0, "dB", at_least=True), Requirement("delay_margin", 0.1, "s", at_least=True)
    base = scenario.from_tables({**TABLES, "requirements": {one.metric: one.limit for one in asked}})
    values = {"published": ([9.5, 5.04], [np.inf, np.inf]), compare.OURS: ([6.5, np.nan], [0.3, 0.2])}
    made = {
        law: replace(contender(eight, verdicts=[
            one.verdict(np.array(v), ~np.isnan(v)) for one, v in zip(asked, both, strict=True)]), gains={"delta": 0.5})
        for law, both in values.items()
    }  # fmt: skip
    nominal = {"gain_margin": 8.5, "phase_margin": 40.0, "delay_margin": 0.4, "peak_sensitivity": 3.0}
    made["published"] = replace(made["published"], margins={"hold": nominal})
    made[compare.OURS] = replace(made[compare.OURS], widened_bounds={"delta": (0.1, 4.0)})
    found = compare.Comparison(made, 0, False)
    (tmp_path / "out").mkdir()
    compare.write(tmp_path / "out", base, found, False, compare.identity(base, 0))
    rows = list(csv.DictReader((tmp_path / "out" / "compare.csv").read_text().splitlines()))
    assert [row["worst_gain_margin"] for row in rows] == ["5.04", "nan"]
    assert [row["worst_delay_margin"] for row in rows] == ["inf", "0.2"]
    assert [row["nominal_gain_margin"] for row in rows] == ["8.5", ""]
    for said in (compare.summary(found), json.loads((tmp_path / "out" / "summary.json").read_text())):
        (question,) = [one for one in compare_report.QUESTIONS if "margins" in one.title]
        table = compare_report.answer_table(question, summaries.read(summaries.Compare, said).laws)
        # earlier, one column was of the nominal loop or of the dispersed loops, and its heading did not say which
        assert table.head == (
            "", "gain, worst loop [dB]", "gain, nominal loop [dB]", "phase, nominal loop [deg]",
            "delay, worst loop [s]", "delay, nominal loop [s]", "peak sensitivity, nominal loop [dB]",
        )  # fmt: skip
        assert table.rows == [
            ("published gains", "5.04", "8.5", "40", "unlimited", "0.4", "3"),
            ("prescribed time", "-", "-", "-", "0.2", "-", "-"),
        ]
        lines = lines_of(said)
        assert "  gain_margin at least 6 dB: worst of 2 dispersed loops 5.04 dB: NOT met in 1 of 2 loops" in lines
        assert "  gain_margin at least 6 dB: no worst value: NOT met in 1 of 2 loops" in lines
        assert not [line for line in lines if "delay_margin" in line]
        moved = "  the search moved the bounds of delta, which tune.bounds does not set, to 0.1 and 4"
        assert lines[lines.index("prescribed time: delta 0.5 s") + 1] == moved
        assert lines[-1] == "a trial has settled when its angle stays below 206 arcsec"
    assert "no law meets every requirement" in page.build(tmp_path / "out")
    assert not [line for line in lines_of(compare.summary(found)) if "interrupted" in line]
    cut_short = compare.summary(replace(found, interrupted=True))
    assert lines_of(cut_short)[0].startswith("interrupted while prescribed time was tuned")


def test_missing_custom_law_is_refused_and_leaves_no_folder(command, tmp_path):
    said = refused(command, tmp_path, "compare", "s.toml", "--law", "gone.py:Mine")
    assert "--law is gone.py:Mine: the file gone.py does not exist" in said
