"""Tests of the shortest t_f for a limit on the input, by theory and by simulation."""

from dataclasses import replace

import numpy as np
import pytest

from ptsmc_jax import scenario
from ptsmc_jax.campaigns import montecarlo
from ptsmc_jax.simulation import rollout
from ptsmc_jax.simulation.requirements import Requirement
from tests.helpers import short
from tuning.search import design
from tuning.search.gains import in_scenario, with_gains

SPREAD = {"attitude": {"kind": "axis_angle", "min_deg": 20.0, "max_deg": 120.0}}
CASE = {
    "controller": {"t_f": 20.0, "eta": 3.2, "delta": 1.0},
    "loop": {"mode": "sampled", "clock": "flight", "period": 0.1, "t_end": 22.0},
    "hardware": {"attitude_noise": 1e-5, "rate_noise": 1e-6},
    "disturbance": {"amplitude": [1e-3, 1e-3, 1e-3]},
    "dispersion": SPREAD,
}


def largest(tables, t_f, trials):
    """Return the largest peak torque [N m] of `trials` trials with this t_f [s]; tables: of the scenario."""
    tables = {
        **tables,
        "controller": {**tables["controller"], "t_f": t_f},
        "loop": {**tables["loop"], "t_end": t_f + 2},
    }
    ready = scenario.study(scenario.from_tables(tables))
    return montecarlo.run(ready.parts, ready.dispersion, 4, np.arange(trials)).metrics.peak_torque.max()


@pytest.mark.long
def test_shortest_t_f_just_keeps_the_torque_limit_in_simulated_trials():
    limit, trials = 0.6, 32
    found = design.shortest_time(scenario.from_tables(CASE), Requirement("peak_torque", limit), 4, np.arange(trials))
    assert found.theory is not None
    assert found.simulated is not None
    assert found.simulated == pytest.approx(found.theory, rel=0.03)  # disturbance 1e-3 N m and noise 1 % of 0.6 N m
    assert largest(CASE, found.simulated, trials) <= limit
    assert largest(CASE, 0.995 * found.simulated, trials) > limit


PLANTS = short(["chain", "spacecraft"], ["chain"])
STARTS = {
    "chain": {"plant": {"kind": "chain", "order": 2, "x0": [14.0, 0.0]}},
    "spacecraft": {"initial": {"rotvec_deg": [0, 0, 90]}},
}
RULES = {"chain": 14.0, "spacecraft": 2 * 14.0 * np.tan(np.pi / 4)}  # peak torque t_f^2 / eta^2


@pytest.mark.parametrize("plant", PLANTS)
def test_shortest_t_f_from_rest_agrees_with_rule_3_5(plant):
    """Rule 3.5 has a closed form from rest. Without a disturbance, the search agrees with it."""
    tables = {
        **STARTS[plant],
        "controller": {"eta": 4.0, "disturbance_rate_bound": 0.0},
        "disturbance": {"kind": "none"},
    }
    found = design.shortest_time(scenario.from_tables(tables), Requirement("peak_torque", 0.25), 0, np.arange(1))
    rule = 4.0 * np.sqrt(RULES[plant] / 0.25)
    assert found.theory == pytest.approx(rule, rel=2e-3)
    assert found.simulated == pytest.approx(rule, rel=2e-3)


@pytest.mark.parametrize("plant", PLANTS)
def test_a_torque_limit_below_the_disturbance_has_no_shortest_t_f(plant):
    tables = {} if plant == "spacecraft" else STARTS[plant]
    found = design.shortest_time(scenario.from_tables(tables), Requirement("peak_torque", 0.009), 0, np.arange(1))
    assert (found.theory, found.simulated) == (None, None)


# `make test-long` also builds a new scenario with this t_f; a test below checks that only t_f changes
@pytest.mark.parametrize("posed_anew", short([False, True], [False]))
def test_shortest_t_f_of_a_chain_keeps_the_limit_and_agrees_with_theory(posed_anew):
    chain = scenario.from_tables({"plant": {"kind": "chain", "order": 3}})
    found = design.shortest_time(chain, Requirement("peak_torque", 5.0), 0, np.arange(1))
    assert found.theory is not None
    assert found.simulated is not None
    assert found.simulated == pytest.approx(found.theory, rel=5e-3)  # the disturbance is 0.01 of 5
    t_f = found.simulated if posed_anew else 1.5 * found.theory  # longest examined t_f, so the program is compiled
    ready = scenario.study(in_scenario(chain, {"t_f": t_f}))  # the rest of the scenario is unchanged
    run = montecarlo.run(with_gains(ready.parts, {"t_f": found.simulated}), ready.dispersion, 0, np.arange(1))
    assert run.metrics.peak_torque[0] <= 5.0 * (1 + 1e-6)


OBSERVED = {
    "plant": {"kind": "chain", "order": 2, "x0": [1.0, 0.0]},
    "controller": {"t_f": 5.0, "delta": 0.5},
    "observer": {"kind": "prescribed_time", "t_o": 4.0},
    "loop": {"mode": "sampled", "clock": "flight", "period": 0.1, "t_end": 6.0},
}


@pytest.mark.parametrize("fails_until", [None, 4.5])
def test_shortest_t_f_exceeds_the_convergence_time_of_the_observer(fails_until, monkeypatch):
    """The observer converges in 4 s, so the search begins at 1.05 times 4 s and has a tolerance of 1e-3.

    A failed run breaks every limit, even if its torque is small.
    """

    def run(parts, *others, simulated=montecarlo.run):
        result = simulated(parts, *others)
        fails = fails_until is not None and parts.controller.t_f < fails_until
        return replace(result, status=np.full_like(result.status, rollout.DIVERGED)) if fails else result

    monkeypatch.setattr(montecarlo, "run", run)
    found = design.shortest_time(scenario.from_tables(OBSERVED), Requirement("peak_torque", 1e4), 0, np.arange(1))
    assert found.theory is not None
    assert found.simulated is not None
    assert 4.2 < found.theory <= 4.2 * (1.0 + 2e-3)
    least = 4.2 if fails_until is None else fails_until
    assert least < found.simulated <= least * (1.0 + 2e-3)


@pytest.mark.parametrize(("confidence", "least"), [(None, 6), (0.5, 7)])
def test_shortest_t_f_for_a_quantile_limit_keeps_it_in_that_fraction_of_the_trials(confidence, least):
    """It is not necessary that all trials keep the limit."""
    tables = {
        "plant": {"kind": "chain", "order": 2, "x0": [1.0, 0.0]},
        "controller": {"t_f": 5.0, "delta": 0.5},
        "loop": {"mode": "sampled", "clock": "flight", "period": 0.1, "t_end": 6.5},  # one program with the verdict
        "hardware": {"state_noise": [2e-5, 1e-5]},
        "dispersion": {"x0": {"kind": "uniform", "half_width": [0.5, 0.1]}},
    }
    trials, asked = np.arange(8), Requirement("peak_torque", 2.0, quantile=0.75, confidence=confidence)
    found = design.shortest_time(scenario.from_tables(tables), asked, 4, trials)
    ready = scenario.study(scenario.from_tables(tables))
    assert found.simulated is not None
    assert found.theory is not None
    for factor, shown in ((1.0, True), (0.995, False)):
        drawn = ready.dispersion, np.uint32(4), trials.astype(np.uint32)
        assert (np.sum(design._predict_peaks(ready.parts, *drawn, factor * found.theory) <= 2.0) >= least) == shown
        parts = with_gains(ready.parts, {"t_f": factor * found.simulated})
        peaks = montecarlo.run(parts, ready.dispersion, 4, trials).metrics.peak_torque
        assert asked.verdict(peaks, np.ones(8, bool)).met == shown
        assert (np.sum(peaks <= 2.0) >= least) == shown
    assert found.theory == pytest.approx(found.simulated, rel=0.05)
    assert (found.limit, found.quantile) == (2.0, 0.75)


@pytest.mark.parametrize("power", [1.0, 2.0, 3.0])
def test_search_for_the_shortest_t_f_finds_the_last_crossing_of_the_limit(power):
    """It returns None if no t_f keeps the limit, and accepts infinite values."""
    found = design._shortest_t_f(lambda t: t**-power + 0.02 * np.sin(t), 0.1, 3.0, 1e-3, 1e3, 1e-4, 60)
    assert found is not None
    assert found**-power + 0.02 * np.sin(found) <= 0.1
    before = found * (1 - 2e-4)
    assert before**-power + 0.02 * np.sin(before) > 0.1
    assert design._shortest_t_f(lambda t: 1.0 + 1 / t, 0.5, 1.0, 1e-3, 10.0, 1e-4, 60) is None
    assert design._shortest_t_f(lambda t: np.inf if t < 2.0 else 0.0, 0.5, 1.0, 0.1, 10.0, 1e-3, 60) == pytest.approx(
        2.0, rel=2e-3
    )


def test_search_for_the_shortest_t_f_converges_if_peaks_hardly_decrease_with_t_f():
    """It halves its bracket, because steps after the rule 1 / t^2 are tiny in this case, from both sides."""
    for start in (60.0, 10.0):
        found = design._shortest_t_f(lambda t: 1.0 + 1e-6 * (30.0 - t), 1.0, start, 1.0, 100.0, 1e-3, 60)
        assert found == pytest.approx(30.0, rel=1e-3)


SPINNING = {
    "initial": {"rotvec_deg": [0, 50, 30]},
    "reference": {"kind": "spin", "rate": [0.0, 0.0, 0.1]},  # its q4 vanishes at 31.4 s
    "controller": {"t_f": 28.0, "delta": 0.5},
    "loop": {"mode": "sampled", "period": 0.1, "t_end": 29.5},
}


@pytest.mark.parametrize(("limit", "follows"), [(5.0, True), (0.14, False)])
def test_a_reference_that_reaches_the_singularity_prevents_only_the_simulated_time(limit, follows):
    """If the law cannot follow the reference until t_f, only the time from theory is returned."""
    found = design.shortest_time(scenario.from_tables(SPINNING), Requirement("peak_torque", limit), 0, np.arange(1))
    assert found.theory is not None
    assert (found.theory < 20.0) == follows
    assert (found.simulated is not None) == follows
