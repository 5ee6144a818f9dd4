"""Margins that are asked for: what is refused, verdicts, rows of constraints and their slopes."""

import dataclasses
import json

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from ptsmc_jax import explore, programs, scenario
from ptsmc_jax.campaigns import margin_verdicts, store
from ptsmc_jax.simulation import catalogues
from ptsmc_jax.simulation.requirements import Requirement, over, verdict_text
from ptsmc_jax.theory import margins
from tests.helpers import SHORT
from tuning.search import margin_rows
from tuning.search.gains import with_gains
from tuning.studies import stability, tuner

BODY = {
    "controller": {"t_f": 8.0, "delta": 0.4, "sign_width": 0.02, "k1": 2.0},
    "observer": {"gain": [40.0, 40.0, 40.0]},
    "loop": {"mode": "sampled", "period": 0.1, "t_end": 10.0},
    "hardware": {"attitude_noise": 2e-5, "rate_noise": 1e-6},
    "requirements": {"gain_margin": 6.0, "modulus_margin": 5.0},
    "tune": {"trials": 2, "free": ["eta", "observer_gain", "k1", "sign_width"]},
}


@pytest.mark.parametrize(
    ("changes", "said"),
    [
        ({"requirements": {"gain_margins": 6.0}}, "requirements.gain_margins is not a known metric"),
        ({"requirements": {"gain_margin": {"limit": 6.0, "quantile": 0.9}}}, "which every loop must keep"),
        ({"requirements": {"phase_margin": -3.0}}, "requirements.phase_margin is -3.0"),
        ({"loop": {"mode": "continuous"}, "hardware": {}}, "requirements.gain_margin needs the sampled loop"),
        ({"controller": {"t_f": 8.0, "sign_width": 0.0}}, "needs a sign with a slope, but controller.sign_width is 0"),
    ],
)
def test_margins_that_cannot_be_judged_are_refused(changes, said):
    tables = {**BODY, **changes}
    del tables["tune"]
    if tables["loop"]["mode"] == "continuous":
        del tables["hardware"]
    with pytest.raises(scenario.ScenarioError, match=said):
        scenario.from_tables(tables)


def test_every_margin_has_its_requirement():
    some = margins.Margins(*(jnp.ones(2) for _ in range(5)), stable=jnp.ones(2, bool), crossover=jnp.ones(2))
    assert tuple(some.worst()) == tuple(catalogues.MARGINS)


@pytest.mark.parametrize(
    ("value", "met", "over"), [(6.0, True, 1.0), (5.9, False, 1.0 + 0.1 / 6), (np.inf, True, 0.0), (-3.0, False, 2.5)]
)
def test_a_margin_is_to_be_at_least_its_limit(value, met, over, tmp_path):
    verdict = Requirement("gain_margin", 6.0, "dB", at_least=True).verdict(np.asarray(value), np.asarray(True))
    assert verdict.met == met
    np.testing.assert_allclose(verdict.margin, over, rtol=1e-12)
    assert str(verdict).startswith("gain_margin at least 6 dB")
    store.write_json(tmp_path / "kept.json", {"worst": verdict.worst})
    kept = json.loads((tmp_path / "kept.json").read_text())["worst"]  # null where infinite
    read = verdict_text(verdict.metric, verdict.limit, "dB", kept, verdict.failures, 1, at_least=True)
    assert read == str(verdict)
    assert ("unlimited" in read) == np.isinf(value)


def test_of_many_loops_the_smallest_margin_counts_and_one_without_a_value_breaks_the_limit():
    asked = Requirement("phase_margin", 30.0, "deg", at_least=True)
    assert asked.verdict(np.array([50.0, 31.0]), np.array([True, True])).worst == 31.0
    assert asked.verdict(np.array([50.0, 29.0]), np.array([True, True])).failures == 1
    assert not asked.verdict(np.array([50.0, np.nan]), np.array([True, False])).met


def test_a_run_is_judged_by_the_margins_of_its_loop(command, tmp_path):
    asked = "[requirements]\ngain_margin = 1.0\nphase_margin = 89.0\n"
    (tmp_path / "asks.toml").write_text(SHORT.split("[requirements]")[0] + asked)
    status, out, _ = command("simulate", "asks.toml", "--no-figures")
    assert status == 1
    assert "gain_margin at least 1 dB" in out
    assert "phase_margin at least 89 deg" in out
    said = json.loads((tmp_path / "out" / "simulate-asks" / "summary.json").read_text())["verdicts"]
    assert (said["gain_margin"]["met"], said["phase_margin"]["met"]) == (True, False)
    _, course = stability.find(scenario.read(tmp_path / "asks.toml"))
    np.testing.assert_allclose(said["phase_margin"]["worst"], course.worst()["phase_margin"], rtol=1e-9)


@programs.jit
def one_by_one(parts, dispersion, seed, trials):
    """Margins of each trial's loop, all of them in full."""
    return jax.lax.map(lambda trial: margins.judged(dispersion.apply(parts, seed, trial))[0].worst(), trials)


@pytest.fixture(scope="module")
def drawn():
    """A problem whose inertias are drawn, of four loops the two hardest rows."""
    tables = {**BODY, "dispersion": {"inertia": {"kind": "relative_normal", "std": 0.05}}}
    tables["requirements"] = {**BODY["requirements"], "peak_torque": 5.0}
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(margin_verdicts, "TRIALS", 4)
        patch.setattr(margin_rows, "CASES", 2)
        yield tuner.pose(scenario.from_tables(tables), 3)


def test_rows_of_constraints_are_met_where_the_verdicts_are_and_have_slopes(drawn):
    """Slopes against central differences of order 4, over all axes and times; those of what has no limit are zero."""
    posed = drawn
    asked, bounds, share = posed.problem.margins, posed.evaluate.bounds, posed.evaluate.bounds.share(posed.own)
    assert asked is not None
    found = margin_rows.sloped(asked, bounds, share)
    verdicts = margin_verdicts.over_trials(posed.ready, 3)
    for row, verdict in zip(np.asarray(found["c"]), verdicts, strict=True):
        np.testing.assert_allclose(row.max() + 1.0, verdict.margin, rtol=1e-9)
    step = 1e-4
    points = [share + k * step * e for e in np.eye(share.size) for k in (-2, -1, 1, 2)]
    c = np.stack([np.asarray(margin_rows.sloped(asked, bounds, p)["c"]) for p in points])
    c = c.reshape(share.size, 4, *c.shape[1:])
    numeric = (c[:, 0] - 8 * c[:, 1] + 8 * c[:, 2] - c[:, 3]) / (12 * step)
    exact = np.moveaxis(np.asarray(found["c_slope"]), -1, 0)
    np.testing.assert_allclose(exact, numeric, rtol=1e-6, atol=1e-8 * np.abs(exact).max())
    told = explore.verdicts(posed.ready.scenario, explore.trials(posed.ready.scenario, 2, seed=3), seed=3)[-2:]
    assert [v.worst for v in told] == [v.worst for v in verdicts]  # of the loops of the same trials
    tight = dataclasses.replace(asked, limits=asked.limits * 0.9)
    np.testing.assert_allclose(margin_rows.sloped(tight, bounds, share)["c"] + 1, (found["c"] + 1) / 0.9, rtol=1e-12)


def test_the_evaluator_puts_margins_beside_what_is_flown_and_drawn_inertias_are_judged_by_the_worst(drawn):
    posed = drawn
    assert posed.problem.rows == ("peak_torque", "gain_margin", "modulus_margin")
    share = posed.evaluate.bounds.share(posed.own)[None]
    c = posed.evaluate.fly(posed.problem, share).c[0]
    verdicts = margin_verdicts.over_trials(posed.ready, 3)
    assert [v.trials for v in verdicts] == [4, 4]
    # its two hardest cases hold the worst of the four
    for row, verdict in zip(c[1:], verdicts, strict=True):
        np.testing.assert_allclose(row.max() + 1.0, verdict.margin, rtol=1e-9)
    seed, trials = jnp.uint32(3), jnp.arange(4, dtype=jnp.uint32)
    each = one_by_one(posed.ready.parts, posed.ready.dispersion, seed, trials)
    assert len(np.unique(each["gain_margin"])) == 4
    # with other gains others are the hardest, and they take the places
    asked = posed.problem.margins
    assert asked is not None
    other = posed.own * np.asarray([1.0, 0.2, 1.0, 1.0])  # a slow observer
    parts = with_gains(asked.parts, dict(zip(asked.names, other, strict=True)))
    each = one_by_one(parts, asked.dispersion, seed, trials)
    harder, near = margin_rows.hardest(asked, other)
    row = np.asarray(margin_rows.rows(harder, jnp.asarray(other)))
    np.testing.assert_allclose(row.max() + 1.0, near, rtol=1e-9)
    limits = posed.ready.margins
    shares = [over(each[r.metric], r.limit, at_least=r.at_least) for r in limits]
    np.testing.assert_allclose(near, np.max(shares), rtol=1e-12)
