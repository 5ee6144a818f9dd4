"""Required stability margins: validation, verdicts, and constraints of the tuner with their gradients."""

import dataclasses
import json
import subprocess
import sys
from types import SimpleNamespace
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
import polars as pl
import pytest

import ptsmc_jax as ptsmc
from ptsmc_jax import explore, scenario
from ptsmc_jax.campaigns import campaign, margin_verdicts, runs, store
from ptsmc_jax.simulation import catalogues, rollout
from ptsmc_jax.simulation.requirements import Requirement, Verdict, violation_ratio
from ptsmc_jax.theory import margins, run_margins
from tests.helpers import FIRST_FLIGHT, ROOT, SHORT_CHAIN, assert_prepared, short, untuned
from tuning.search import margin_rows
from tuning.search.gains import with_gains
from tuning.studies import posing

BODY = {
    "controller": {"t_f": 8.0, "delta": 0.4, "eta": 3.0, "sign_width": 0.02, "k1": 2.0, "surface_rate": 1.0},
    "disturbance": {"amplitude": [0.01] * 3, "frequency": [0.1] * 3},
    "observer": {"gain": [40.0, 40.0, 40.0]},
    "loop": {"mode": "sampled", "period": 0.1, "t_end": 10.0, "window": 1.0},
    "hardware": {"attitude_noise": 2e-5, "rate_noise": 1e-6},
    "requirements": {"gain_margin": 6.0, "peak_sensitivity": 5.0},
    "tune": {"trials": 2, "free": ["eta", "observer_gain", "k1", "sign_width"]},
}


@pytest.mark.parametrize(
    ("changes", "said"),
    [
        ({"requirements": {"gain_margins": 6.0}}, "requirements.gain_margins is not a known metric"),
        ({"requirements": {"gain_margin": {"limit": 6.0, "quantile": 0.9}}}, "which every loop must keep"),
        ({"requirements": {"phase_margin": -3.0}}, "requirements.phase_margin is -3.0"),
        ({"loop": {"mode": "continuous"}, "hardware": {}}, "requirements.gain_margin needs the sampled loop"),
        ({"controller": {"t_f": 8.0, "sign_width": 0.0}}, "needs a boundary layer, but controller.sign_width is 0"),
    ],
)
def test_invalid_margin_requirements_are_refused(changes, said):
    tables = {**BODY, **changes}
    del tables["tune"]
    if tables["loop"]["mode"] == "continuous":
        del tables["hardware"]
    with pytest.raises(scenario.ScenarioError, match=said):
        scenario.from_tables(tables)


def test_every_margin_can_be_required():
    """The computed margins have the names of the catalogue of required margins."""
    some = margins.Margins(*(jnp.ones(2) for _ in range(5)), stable=jnp.ones(2, bool), crossover=jnp.ones(2))
    assert tuple(some.worst()) == tuple(catalogues.MARGINS)


@pytest.mark.parametrize("xp", [np, jnp], ids=["numpy", "jax"])
def test_worst_margins_are_the_smallest_and_the_largest_peak_sensitivity(xp):
    two = {"gain_up": [7.0, 9.0], "gain_down": [8.0, 6.5], "phase": [50.0, 40.0], "delay": [0.1, 0.2]}
    values = {**two, "peak_sensitivity": [3.0, 4.0], "stable": [True, True], "crossover": [1.0, 2.0]}
    some = margins.Margins(**{name: xp.asarray(v) for name, v in values.items()})
    expected = {"gain_margin": 6.5, "phase_margin": 40.0, "delay_margin": 0.1, "peak_sensitivity": 4.0}
    assert {name: float(v) for name, v in some.worst().items()} == expected
    unstable = some._replace(stable=xp.asarray([False, True]))
    assert float(unstable.worst()["peak_sensitivity"]) == margins.LARGEST_MARGIN


@pytest.mark.parametrize(
    ("value", "met", "over"), [(6.0, True, 1.0), (5.9, False, 1.0 + 0.1 / 6), (np.inf, True, 0.0), (-3.0, False, 2.5)]
)
def test_verdict_on_a_margin_with_a_lower_limit(value, met, over, tmp_path):
    """The verdict has the violation ratio. It is read back from JSON, also with an infinite margin."""
    verdict = Requirement("gain_margin", 6.0, "dB", at_least=True).verdict(np.asarray(value), np.asarray(True))
    assert verdict.met == met
    np.testing.assert_allclose(verdict.margin, over, rtol=1e-12)
    assert str(verdict).startswith("gain_margin at least 6 dB")
    store.write_json(tmp_path / "kept.json", {"worst": verdict.worst})
    kept = json.loads((tmp_path / "kept.json").read_text())["worst"]  # null if infinite
    read = str(Verdict.read({**dataclasses.asdict(verdict), "worst": kept}))
    assert read == str(verdict)
    assert ("unlimited" in read) == np.isinf(value)


def test_verdict_on_many_loops_uses_the_smallest_margin():
    asked = Requirement("phase_margin", 30.0, "deg", at_least=True)
    assert asked.verdict(np.array([50.0, 31.0]), np.array([True, True])).worst == 31.0
    assert asked.verdict(np.array([50.0, 29.0]), np.array([True, True])).failures == 1
    assert not asked.verdict(np.array([50.0, np.nan]), np.array([True, False])).met


@pytest.mark.parametrize(
    ("dispersion", "differ"),
    [
        ({"attitude": {}}, True),
        ({"rate": {}}, True),
        ({"inertia": {}}, True),
        ({"reference": {}}, True),
        ({"disturbance_phase": {}}, False),
        ({"attitude_noise": {"kind": "relative_normal"}}, False),
        ({"actuator_scale": {"kind": "relative_normal"}}, True),
    ],
)
def test_trials_have_different_loops_if_a_dispersion_affects_the_linearised_loop(dispersion, differ):
    made = scenario.from_tables({**BODY, "dispersion": dispersion})
    assert margin_verdicts.has_different_loops(scenario.study(made).dispersion) == differ


TRIALS = 6  # trials with margins: two at a time on each device, so that the last call is not full
JUDGED = run_margins.TIMES + 1  # number of loops of one trial


@pytest.fixture(scope="module", autouse=True)
def _few_loops():
    """Set small numbers of trials and of loops per call for all tests of the module."""
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(margin_verdicts, "TRIALS", TRIALS)
        patch.setattr(margin_verdicts, "LOOPS_PER_CALL", 2)
        patch.setattr(margin_verdicts, "EXACT_PER_CALL", JUDGED)
        patch.setattr(margin_rows, "CASES", 2)
        yield


def loops_and_margins(parts, dispersion, seed, late):
    """Return the loops (TRIALS, times, ..) of the first trials, and their margins interpolated over frequency.

    late: whether the loops allow delays by a fraction of a period.
    """
    arguments = margin_verdicts._arguments(parts, dispersion, seed, np.arange(TRIALS), late)
    *every, _ = margin_verdicts._loops_and_margins(*arguments)
    return jax.tree.map(lambda v: np.asarray(v)[:TRIALS], every)


def exact_margins(parts, dispersion, seed, late=False):
    """Return {margin: (TRIALS, times)}, the exact margins of the first trials' loops, computed trial by trial.

    late: whether the loops allow delays by a fraction of a period. Otherwise the delay margin is the phase margin over
    the crossover frequency, without the hold.
    """
    loops, _ = loops_and_margins(parts, dispersion, seed, late)
    each = [margins.compute_each(jax.tree.map(lambda v, k=k: v[k], loops), with_delay=late) for k in range(TRIALS)]
    if not late:
        each = [one._replace(delay=np.deg2rad(one.phase) / one.crossover) for one in each]
    return {name: np.stack([farthest(name, one.by_name()[name], 1) for one in each]) for name in catalogues.MARGINS}


def worst_of(each):
    """Return {margin: (TRIALS,)}, the worst margin of each trial over its times; each: from `exact_margins`."""
    return {name: farthest(name, v, 1) for name, v in each.items()}


def constraints_with_gradients(asked, bounds, normalised):
    """Return "c" (margins, entries) and "c_gradient" (margins, entries, gains) at one point, as a dict.

    asked: the required margins. bounds: of the gains. normalised: normalised gains (gains,).
    """
    return {
        name: v[0]
        for name, v in margin_rows.constraints_at_points(asked, bounds.scale, np.asarray(normalised)[None]).items()
    }


def farthest(name, values, axis):
    """Return the worst value of a margin along an axis: the largest peak sensitivity or the smallest other margin.

    name: of the margin.
    """
    return (np.max if name == "peak_sensitivity" else np.min)(np.asarray(values), axis=axis)


class Lag(ptsmc.Draw):
    """A dispersion of the torque lag, so that every trial has another loop, as with a dispersed inertia."""

    count = 1

    def at(self, c, parts):
        """Return the parts with the torque lag times 1 + 0.3 c[0]."""
        lag = parts.actuators.lag * (1.0 + 0.3 * c[0])
        return dataclasses.replace(parts, actuators=dataclasses.replace(parts.actuators, lag=lag))


CHAIN = {
    **BODY,
    "plant": {"kind": "chain", "x0": [1.0, 0.0]},
    "disturbance": {"amplitude": [0.01], "frequency": [1.0]},
    "observer": {"kind": "nonlinear", "gain": [40.0]},
    "hardware": {"state_noise": [2e-5, 1e-6], "torque_lag": 0.03, "torque_limit": 50.0},
}
# no trial is nominal; a loop also depends on the initial state, because it is linearised along the run
DRAWN = {
    "chain": {
        **CHAIN,
        "dispersion": {
            "custom": {"kind": "custom", "code": Lag},
            "x0": {"kind": "uniform", "half_width": [0.5, 0.1]},
        },
    },
    "spacecraft": {
        **BODY,
        "dispersion": {
            "inertia": {"kind": "relative_normal", "std": 0.05},
            "attitude": {"kind": "axis_angle", "min_deg": 10.0, "max_deg": 30.0},
        },
    },
}


def posed_of(plant):
    """Return the tuning problem of a plant in `DRAWN` with its dispersions and the hardest trials for its gains."""
    tables = DRAWN[plant]
    posed = posing.set_up_tuning(
        scenario.from_tables({**tables, "requirements": {**tables["requirements"], "peak_torque": 5.0}}), 3
    )
    assert posed.problem.margins is not None
    hardest, _ = margin_rows.select_hardest_trials(posed.problem.margins, posed.scenario_gains)
    return dataclasses.replace(posed, problem=dataclasses.replace(posed.problem, margins=hardest))


@pytest.fixture(scope="module", params=short(DRAWN, ["chain"]))
def drawn(request):
    """Return a tuning problem with six trials. The margins of the two hardest trials are constraints.

    The chain compiles faster.
    """
    return posed_of(request.param)


def test_margin_constraints_agree_with_verdicts_and_finite_differences(drawn):
    """Compare gradients with central differences of order 4 along a direction that changes all gains.

    The verdicts use the loops of the same trials, in any order of the rows. The constraints are ratios to the limits.
    """
    posed = drawn
    asked, bounds, normalised = (
        posed.problem.margins,
        posed.evaluate.bounds,
        posed.evaluate.bounds.normalise(posed.scenario_gains),
    )
    assert asked is not None
    found = constraints_with_gradients(asked, bounds, normalised)
    verdicts = margin_verdicts.judge_trials(posed.ready, 3)
    for row, verdict in zip(np.asarray(found["c"]), verdicts, strict=True):
        np.testing.assert_allclose(row.max() + 1.0, verdict.margin, rtol=1e-9)
    step, along = 1e-4, np.array([0.6, -0.9, 1.0, 0.7])
    points = [normalised + k * step * along for k in (-2, -1, 1, 2)]
    c = margin_rows.constraints_at_points(asked, bounds.scale, np.stack(points[:3]))["c"]  # one point more than devices
    c = [*c, constraints_with_gradients(asked, bounds, points[3])["c"]]
    numeric = (c[0] - 8 * c[1] + 8 * c[2] - c[3]) / (12 * step)
    slopes = np.asarray(found["c_gradient"])
    assert np.all(np.abs(slopes).reshape(-1, normalised.size).max(axis=0) > 0.0)  # every gain has an effect
    exact = slopes @ along
    np.testing.assert_allclose(exact, numeric, rtol=1e-6, atol=1e-8 * np.abs(exact).max())
    rows = pl.DataFrame({"trial": [0, 1], "status": ["ok", "ok"], "peak_torque": [1.0, 2.0]})  # not used by margins
    told = explore.verdicts(posed.ready.scenario, rows, seed=3)[-2:]
    assert [v.worst for v in told] == [v.worst for v in verdicts]  # loops of the same trials
    other_order = rows.with_columns(trial=pl.Series([TRIALS, 0]), status=pl.Series(["nonfinite", "ok"]))
    later_failed = explore.verdicts(posed.ready.scenario, other_order, seed=3)[-2:]
    assert [v.worst for v in later_failed] == [v.worst for v in verdicts]  # later trials do not matter
    tight = dataclasses.replace(asked, limits=asked.limits * 0.9)
    np.testing.assert_allclose(
        constraints_with_gradients(tight, bounds, normalised)["c"] + 1, (found["c"] + 1) / 0.9, rtol=1e-12
    )


def test_loops_that_a_torque_limit_opens_in_the_hold_phase_have_no_margins():
    """Earlier, their margins counted as unlimited, and every requirement on them was met."""
    posed = posed_of("chain")
    asked, bounds = posed.problem.margins, posed.evaluate.bounds
    assert asked is not None
    weak = dataclasses.replace(
        asked.parts.actuators, torque_limit=np.full_like(asked.parts.actuators.torque_limit, 1e-3)
    )
    parts = dataclasses.replace(asked.parts, actuators=weak)
    verdicts = margin_verdicts.judge_trials(dataclasses.replace(posed.ready, parts=parts), 3)
    assert [(verdict.failures, verdict.trials, verdict.met) for verdict in verdicts] == [(TRIALS, TRIALS, False)] * 2
    assert {verdict.reason for verdict in verdicts} == {"the loop is open in the hold phase in 6 trials"}
    found = constraints_with_gradients(
        dataclasses.replace(asked, parts=parts), bounds, bounds.normalise(posed.scenario_gains)
    )
    assert np.all(found["c"].max(axis=1) >= 1.0)


def test_a_trial_that_failed_meets_no_required_margin(drawn):
    all_finished = margin_verdicts.judge_trials(drawn.ready, 3, None, np.ones(2, bool))
    for limit, before in zip(drawn.ready.margins, all_finished, strict=True):
        # every loop keeps this limit
        loose = dataclasses.replace(limit, limit=before.worst)
        ready = dataclasses.replace(drawn.ready, margins=(loose,))
        (verdict,) = margin_verdicts.judge_trials(ready, 3, None, np.array([True, False]))
        assert (verdict.failures, verdict.trials, verdict.met) == (1, TRIALS, False)
        assert np.isnan(verdict.worst)
        assert str(verdict).endswith("no worst value, as the run failed in 1 trial: NOT met in 1 of 6 loops")


def test_trials_that_fail_after_the_judged_trials_change_no_verdict_on_the_nominal_loop():
    """Only the first TRIALS trials count, also if no dispersion changes the loop.

    A failed trial among them fails every margin.
    """
    ready = scenario.study(scenario.from_tables({**DRAWN["chain"], "dispersion": {}}))
    finished = np.arange(2 * TRIALS) != TRIALS
    assert [verdict.reason for verdict in margin_verdicts.judge_trials(ready, 3, None, finished)] == ["", ""]
    reasons = [verdict.reason for verdict in margin_verdicts.judge_trials(ready, 3, None, finished[1:])]
    assert reasons == ["the run failed in 1 trial"] * 2


@pytest.mark.long
def test_margin_gradients_with_dispersed_inertia_compile_if_delta_is_free():
    """Delta is free by default. The test starts another process, because XLA aborted it in an earlier version."""
    changes = {"dispersion__inertia": {"kind": "relative_normal", "std": 0.03}, "requirements": {"gain_margin": 6.0}}
    code = (
        "from ptsmc_jax.configure import configure; configure(1)\n"
        "import numpy as np; from ptsmc_jax import scenario\n"
        "from tuning.search import margin_rows; from tuning.search.normalisation import bounds_of_scenario\n"
        f"known = scenario.replace(scenario.read({str(FIRST_FLIGHT)!r}), **{changes!r})\n"
        "ready = scenario.study(known); bounds = bounds_of_scenario(known, ready.parts)\n"
        "margin_rows.CASES = 2\n"
        "asked = margin_rows.build_required_margins(ready, bounds, 0)\n"
        "found = margin_rows.constraints_at_points(asked, bounds.scale, np.full((1, len(bounds.names)), 0.5))\n"
        "print(found['c_gradient'].shape)"
    )
    done = subprocess.run([sys.executable, "-c", code], cwd=ROOT, capture_output=True, text=True, check=False)
    assert (done.returncode, done.stdout) == (0, "(1, 1, 30, 6)\n"), done.stderr[-2000:]


def test_evaluator_appends_constraints_on_the_worst_margins_of_all_trials(drawn, monkeypatch):
    """They are appended to the constraints of the metrics, and padded to equal length.

    With other gains, other trials are the hardest and become the constraints.
    """
    posed = drawn
    assert posed.problem.rows == ("peak_torque", "gain_margin", "peak_sensitivity")
    normalised = posed.evaluate.bounds.normalise(posed.scenario_gains)[None]
    simulated = {"gains": normalised, "f": np.zeros(1), "c": np.array([[[-0.3, -0.2, -0.4]]]), "value": np.zeros(1)}
    monkeypatch.setattr(posed.evaluate, "_simulate_and_judge", lambda *_: dict(simulated))
    c = posed.evaluate.measure(posed.problem, normalised).c[0]
    assert c[0].tolist() == [-0.3, -0.2, -0.4] + [-1.0] * (c.shape[1] - 3)  # padded to the length of margin rows
    verdicts = margin_verdicts.judge_trials(posed.ready, 3)
    assert [v.trials for v in verdicts] == [TRIALS, TRIALS]
    # the two hardest trials contain the worst margins of all trials
    for row, verdict in zip(c[1:], verdicts, strict=True):
        np.testing.assert_allclose(row.max() + 1.0, verdict.margin, rtol=1e-9)
    each = worst_of(exact_margins(posed.ready.parts, posed.ready.dispersion, 3))
    assert len(np.unique(each["gain_margin"])) == TRIALS
    # with other gains, other trials are the hardest and become the constraints
    asked = posed.problem.margins
    other = posed.scenario_gains * np.asarray([1.0, 0.2, 1.0, 1.0])  # a slow observer
    parts = with_gains(asked.parts, dict(zip(asked.names, other, strict=True)))
    each = worst_of(exact_margins(parts, asked.dispersion, 3))
    harder, near = margin_rows.select_hardest_trials(asked, other)
    bounds = posed.evaluate.bounds
    row = constraints_with_gradients(harder, bounds, bounds.normalise(other))["c"]
    np.testing.assert_allclose(row.max() + 1.0, near, rtol=1e-9)
    limits = posed.ready.margins
    shares = [violation_ratio(each[r.metric], r.limit, at_least=r.at_least) for r in limits]
    np.testing.assert_allclose(near, np.max(shares), rtol=1e-12)


def test_prepared_margin_program_is_the_program_of_the_search(drawn, monkeypatch):
    """A program with other shapes or types would be compiled in vain."""
    bounds = drawn.evaluate.bounds
    points = np.stack([bounds.normalise(drawn.scenario_gains)] * len(jax.local_devices()))
    assert_prepared(
        monkeypatch,
        margin_rows,
        "constraints_on_devices",
        lambda: margin_rows.build_required_margins(drawn.ready, bounds, 3),
        lambda: margin_rows.constraints_on_devices(drawn.problem.margins, bounds.scale, points),
    )


@pytest.mark.parametrize(
    ("owner", "program", "prepare", "ask"),
    [
        (
            margin_verdicts,
            "_loops_and_margins",
            margin_verdicts.prepare,
            lambda ready: margin_verdicts.judge_trials(ready, 3),
        ),
        (rollout, "simulate_once", runs.prepare, lambda ready: runs.rms_lower_bound(ready, 3)),
    ],
    ids=["margins", "lower_bound"],
)
def test_prepared_programs_of_a_campaign_are_those_that_it_uses(drawn, monkeypatch, owner, program, prepare, ask):
    """A program with other shapes or types would be compiled in vain."""
    ready = drawn.ready
    assert_prepared(monkeypatch, owner, program, lambda: prepare(ready), lambda: ask(ready))


FACTORS = [[1.0, 1.0, 1.0, 1.0], [1.0, 0.2, 1.0, 1.0], [1.3, 1.0, 5.0, 0.1]]  # on the gains
# factors, and whether delay margins are computed too, which needs programs three times as large
LOOKED = [*((factors, True) for factors in FACTORS), (FACTORS[2], False)]


def changed(posed, factors):
    """Return the parts with the gains multiplied by these factors, in the order of the problem's names."""
    return with_gains(
        posed.problem.parts, dict(zip(posed.problem.names, posed.scenario_gains * np.asarray(factors), strict=True))
    )


@pytest.mark.parametrize(("factors", "late"), short(LOOKED, LOOKED[-1:]))
def test_worst_margins_are_exact_without_exact_margins_of_all_loops(drawn, factors, late, monkeypatch):
    """The result equals that of exact margins of all loops. Interpolation errors are below half of `ASSUMED_ERROR`."""
    posed = drawn
    parts, dispersion = changed(posed, factors), posed.ready.dispersion
    every = exact_margins(parts, dispersion, 3, late)
    _, rough = loops_and_margins(parts, dispersion, 3, late)
    period = BODY["loop"]["period"]
    for name, values in every.items():
        some = np.isfinite(values)
        np.testing.assert_array_equal(some, np.isfinite(rough[name]))
        apart = np.abs(values - rough[name])[some] / (period if name == "delay_margin" else 1.0)
        assert apart.max(initial=0.0) < margin_verdicts.ASSUMED_ERROR[name] / 2, name
    each = worst_of(every)
    judged = []

    def counted(loops, **how):
        judged.append(len(loops.a))
        return of_each(loops, **how)

    of_each = margins.compute_each
    monkeypatch.setattr(margins, "compute_each", counted)
    # each limit is between the exact and the interpolated margin of one trial, which are on different sides of it
    both = {name: np.stack([v, worst_of(rough)[name]])[:, np.argsort(v)[TRIALS // 2]] for name, v in each.items()}
    limits = {name: float(abs(v.mean())) for name, v in both.items() if late or name != "delay_margin"}
    usual = margin_verdicts.ASSUMED_ERROR
    for known in (usual, dict.fromkeys(usual, 1e-9)):  # a too small error is corrected
        monkeypatch.setattr(margin_verdicts, "ASSUMED_ERROR", known)
        for names in (list(limits), ["phase_margin", list(limits)[2]], ["phase_margin"]):
            asked = {name: limits[name] for name in names}
            found, _ = margin_verdicts.worst_margins(parts, dispersion, 3, np.arange(TRIALS), asked, places=2)
            ratio = margin_verdicts.signed_violation_ratio
            near = [np.max([ratio(one[n], limits[n], n) for n in names], 0) for one in (each, found)]
            first = [np.argsort(-v, kind="stable")[:2] for v in near]
            np.testing.assert_array_equal(first[0], first[1])
            np.testing.assert_allclose(near[1][first[0]], near[0][first[0]], rtol=1e-9)
            for name in names:
                way = -1.0 if catalogues.MARGINS[name].at_least else 1.0
                np.testing.assert_allclose((way * found[name]).max(), (way * each[name]).max(), rtol=1e-9)
                beyond = way * np.stack([found[name], each[name]]) > way * limits[name]
                np.testing.assert_array_equal(*beyond)
    assert sum(judged) < 6 * every["phase_margin"].size / 2


class _Told(NamedTuple):
    """Fake loops, which have only a number and a period [s]."""

    number: Any
    period: Any


@pytest.mark.parametrize(
    ("period", "limit", "judged"), [(0.1, 0.25, {0}), (1.9, 0.25, {0, 1, 2, 3, 4, 5, 6, 7}), (0.1, 2.01, {0, 10})]
)
def test_assumed_error_of_delay_margins_is_a_fraction_of_a_period(monkeypatch, period, limit, judged):
    """Loops have delay margins of 1, 1.1, .. s. Only those near the smallest or the limit need exact values."""
    delays, seen = 1.0 + 0.1 * np.arange(32), set[int]()

    def looked(*given):
        assert given[-1] is True  # with delay margins
        loops = _Told(np.arange(32)[:, None], np.full((32, 1), period))
        return loops, {"delay_margin": delays[:, None]}, np.zeros((32, 1), bool)

    def of_each(loops, with_delay):
        assert with_delay
        seen.update(loops.number.tolist())
        return SimpleNamespace(by_name=lambda: {"delay_margin": delays[loops.number][:, None]})

    monkeypatch.setattr(margin_verdicts, "_loops_and_margins", looked)
    monkeypatch.setattr(margin_verdicts, "EXACT_PER_CALL", 16)
    monkeypatch.setattr(margin_verdicts.margins, "compute_each", of_each)
    nothing: Any = None
    found, _ = margin_verdicts.worst_margins(nothing, nothing, 3, np.arange(32), {"delay_margin": limit})
    np.testing.assert_array_equal(found["delay_margin"], delays)
    assert seen == judged


def test_margins_of_a_campaign_are_judged_with_the_trials_that_failed(command, tmp_path, monkeypatch):
    """Trials that a later command adds count, too. The shard without the first trials leaves the verdict to another."""
    judged = []

    def judge_trials(ready, seed, rows, finished):
        judged.append(finished.tolist())
        return [ready.margins[0].verdict(np.asarray(7.0), np.asarray(True))]

    monkeypatch.setattr(margin_verdicts, "judge_trials", judge_trials)
    monkeypatch.setattr(margin_verdicts, "prepare", lambda *_: None)
    monkeypatch.setattr(campaign, "has_finished", lambda frame: np.arange(frame.height) != 1)
    tables = {**untuned(SHORT_CHAIN), "requirements": {"gain_margin": 0.1}}
    store.write_toml(tmp_path / "s.toml", tables)
    run = ("montecarlo", "s.toml", "--no-figures", "--quiet", "--trials")
    command(*run, 2, "--shard", "2/2")
    assert not judged
    command(*run, 2)
    command(*run, 3)
    assert judged == [[True, False], [True, False, True]]


@pytest.mark.parametrize(
    ("left", "of_loops"),
    [
        pytest.param(None, True, marks=pytest.mark.long),  # with real loops
        (None, False), ('{"lower_bound": 1e-6, "marg', False), ('{"lower_bound": 1e-6}', False),
        ('{"lower_bound": 1e-6, "margins": [1]}', False), ('{"lower_bound": {}, "margins": []}', False),
        ('{"lower_bound": 1e-6, "margins": [{"metric": "gain_margin"}]}', False),
    ],
)  # fmt: skip
def test_campaign_without_its_margin_verdicts_is_reported_as_incomplete(command, tmp_path, monkeypatch, left, of_loops):
    """`summarize` then exits with status 1, and the repeated campaign computes the verdicts again.

    The process may be killed after the last trial, or the file of the verdicts may be damaged.
    """
    tables = {**untuned(SHORT_CHAIN), "requirements": {"peak_torque": 50.0, "gain_margin": 0.1}}
    if not of_loops:
        told = Requirement("gain_margin", 0.1, "dB", at_least=True).verdict(np.asarray(7.0), np.asarray(True))
        monkeypatch.setattr(margin_verdicts, "judge_trials", lambda *_: [told])
        monkeypatch.setattr(margin_verdicts, "prepare", lambda *_: None)
    store.write_toml(tmp_path / "s.toml", tables)
    again, folder = ("montecarlo", "s.toml", "--trials", 2, "--no-figures"), tmp_path / "out" / "montecarlo-s"
    assert command(*again, "--quiet") == (0, "", "")
    whole = (folder / "theory.json").read_text()
    (folder / "theory.json").unlink() if left is None else (folder / "theory.json").write_text(left)
    code, said, _ = command("summarize", folder, "--no-figures")
    assert code == 1
    assert "NOT finished: gain_margin is required and not judged yet; " in said
    assert json.loads((folder / "summary.json").read_text())["status"] == "incomplete"
    assert command(*again, "--quiet") == (0, "", "")
    assert (folder / "theory.json").read_text() == whole
