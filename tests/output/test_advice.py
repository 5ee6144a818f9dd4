"""What is said where a limit was kept in the search and not on fresh trials, and of trials that a quantile takes."""

import inspect

import pytest

from ptsmc_jax.simulation.requirements import Requirement, must_keep
from tuning.cli import campaign_commands
from tuning.output import search_sentences
from tuning.search import confirm


def summary(over, *, searched=0.97, **search):
    verdict = {"metric": "peak_torque", "limit": 0.5, "margin": over, "met": over is not None and over <= 1.0}
    found = {"largest_over_limit": {"peak_torque": searched}, "averaged": 256, "asked": 256, **search}
    return {"verdicts": [verdict], "search": found}


def test_what_to_change_is_said_with_the_numbers():
    (said,) = search_sentences.advice(summary(1.1))
    assert "tune.trials = 1024" in said
    assert "requirements.peak_torque = 0.446" in said  # 0.5 / 1.1, and 2 % more
    (lost,) = search_sentences.advice(summary(None))
    assert "fail or lack it" in lost
    assert not list(search_sentences.advice(summary(0.9)))
    assert not list(search_sentences.advice(summary(1.1, searched=1.2)))  # the search says that it found none


@pytest.mark.parametrize(("quantile", "confidence"), [(0.99, 0.95), (0.9973, 0.9)])
def test_a_quantile_takes_as_many_trials_as_may_break_it(quantile, confidence):
    """With 299 trials 99 % at 95 % allows none beyond the limit: a search on them asks for every one."""
    wanted = [Requirement("peak_torque", 0.5, None, quantile, confidence)]
    trials = confirm.training_trials(wanted, 256)
    least = must_keep(trials, quantile, confidence)
    assert least is not None
    assert trials - least >= 1
    assert confirm.training_trials(wanted, 5000) == 5000
    assert confirm.training_trials([Requirement("peak_torque", 0.5, None, 0.9)], 256) == 256
    (said,) = [s for s in search_sentences.search(summary(0.9, averaged=trials)) if "tune.trials" in s]
    assert f"tuned on {trials} trials" in said


def test_a_campaign_does_not_fly_the_trials_of_a_search():
    from tuning.cli import main

    seeds = {
        command.__name__: inspect.signature(command).parameters["seed"].default
        for command in (main.tune, main.pareto, main.compare)
    }
    assert inspect.signature(campaign_commands.montecarlo).parameters["seed"].default not in seeds.values()
