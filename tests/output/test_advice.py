"""What is said where a limit was kept in the search and not on fresh trials; trials that campaigns fly."""

import inspect

from tuning.cli import campaign_commands
from tuning.output import search_sentences


def summary(over, *, searched=0.97):
    verdict = {"metric": "peak_torque", "limit": 0.5, "margin": over, "met": over is not None and over <= 1.0}
    found = {"largest_over_limit": {"peak_torque": searched}, "averaged": 256}
    return {"verdicts": [verdict], "search": found}


def test_what_to_change_is_said_with_the_numbers():
    (said,) = search_sentences.advice(summary(1.1))
    assert "tune.trials = 1024" in said
    assert "requirements.peak_torque = 0.446" in said  # 0.5 / 1.1, and 2 % more
    (lost,) = search_sentences.advice(summary(None))
    assert "fail or lack it" in lost
    assert not list(search_sentences.advice(summary(0.9)))
    assert not list(search_sentences.advice(summary(1.1, searched=1.2)))  # the search says that it found none


def test_a_campaign_does_not_fly_the_trials_of_a_search():
    from tuning.cli import main

    seeds = {
        command.__name__: inspect.signature(command).parameters["seed"].default
        for command in (main.tune, main.pareto, main.compare)
    }
    assert inspect.signature(campaign_commands.montecarlo).parameters["seed"].default not in seeds.values()
