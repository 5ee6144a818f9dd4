"""What is said where a limit was kept in the search and not on fresh trials; trials that campaigns fly."""

import inspect

import numpy as np
import pytest

from ptsmc_jax import scenario
from ptsmc_jax.numerics import statistics
from ptsmc_jax.simulation.catalogues import MARGINS, NO_SIGN
from ptsmc_jax.simulation.requirements import Requirement
from tuning.cli import campaign_commands
from tuning.output import campaign_sentences, search_sentences, sentences
from tuning.search import gains
from tuning.studies import tune_files, tuner

BEST = "with the best compromise "


def summary(over, *, searched: float | None = 0.97):
    verdict = {"metric": "peak_torque", "limit": 0.5, "margin": over, "met": over is not None and over <= 1.0}
    found = {"largest_over_limit": {"peak_torque": searched}, "averaged": 256}
    unknown = {"window_error": None}
    return {"verdicts": [verdict], "search": found, "training": unknown, "fresh": unknown}


def test_what_to_change_is_said_with_the_numbers():
    (said,) = search_sentences.advice(summary(1.1))
    assert "tune.trials = 1024" in said
    assert "requirements.peak_torque = 0.446" in said  # 0.5 / 1.1, and 2 % more
    (lost,) = search_sentences.advice(summary(None))
    assert "fail or lack it" in lost
    assert not list(search_sentences.advice(summary(0.9)))
    assert not list(search_sentences.advice(summary(1.1, searched=1.2)))  # the search says that it found none


@pytest.mark.parametrize("interpretation", ["temporal", "mixed"])
def test_what_is_asked_for_a_share_of_the_time_is_told_by_its_limit(interpretation):
    """3 % of the time beyond, 30 times what may be, by errors of 1.1 of the limit: a stricter limit is one by these."""
    asked = Requirement("ape_x", 0.5, quantile=0.999, interpretation=interpretation)
    within, unknown = np.full(4, 0.97), {"window_error": None}
    verdict = asked.verdict(np.full(4, 0.55), np.ones(4, bool), within).in_summary()
    found = {"search": {"largest_over_limit": {"ape_x": 0.99}}, "training": unknown, "fresh": unknown}
    (said,) = search_sentences.advice({**found, "verdicts": [verdict]})
    assert "fresh trials reach 1.1 times the limit" in said
    assert "requirements.ape_x = 0.446" in said
    (lost,) = search_sentences.advice({**found, "verdicts": [{**verdict, "worst": None}]})  # of a run that fails
    assert "fail or lack it" in lost


@pytest.mark.parametrize(
    ("metric", "limit", "worst", "said"),
    [
        ("gain_margin", 6.0, 5.2, "break it, the worst with 5.2 dB: tune with requirements.gain_margin = 6.94"),
        ("modulus_margin", 6.0, 7.5, "break it, the worst with 7.5 dB: tune with requirements.modulus_margin = 4.71"),
        ("phase_margin", 30.0, 0.0, "break it, some with none left: tune with a stricter requirements.phase_margin, "
         "or draw less in [dispersion]"),
    ],
)  # fmt: skip
def test_margins_that_fresh_loops_break_are_told_with_what_to_do(metric, limit, worst, said):
    """Of 256 loops 38 broke what was asked, and nothing was advised: the search looks at the hardest two."""
    asked = Requirement(metric, limit, at_least=metric != "modulus_margin", unit=MARGINS[metric].unit)
    values = np.full(256, worst)
    values[38:] = limit
    verdict = asked.verdict(values, np.ones(256, bool)).in_summary()
    unknown = {"window_error": None}
    found = {"verdicts": [verdict], "training": unknown, "fresh": unknown}
    (line,) = search_sentences.advice({**found, "search": {"largest_over_limit": {metric: 0.99}}})
    assert line == f"{metric}: kept by the loops that the search looked at, but 38 of 256 fresh ones {said}"
    verdict["trials"] = 1  # the nominal loop alone: the trust in it says why
    assert not list(search_sentences.advice({**found, "search": {"largest_over_limit": {metric: 0.99}}}))


def test_margins_are_shares_of_their_limits_in_words_too():
    """How near a limit is come to was told as how many times it is reached: 4.8 dB of 6 as 1.2 times."""
    reached = summary(1.0)
    reached["search"] |= {"largest_over_limit": {"gain_margin": 1.2}, "earlier": [
        {"margins": {"gain_margin": 0.03}, "over": {"gain_margin": 1.1}, "fresh_seed": 7}],
        "margins": {"gain_margin": 0.05}}  # fmt: skip
    _, compromise, on = search_sentences.search(reached)
    assert compromise.endswith("gain_margin reaches 0.8 times its limit on the training trials")
    assert on.startswith("gains that kept every limit in the search reached 0.9 times the limit of gain_margin on")


@pytest.mark.parametrize(
    ("tuned", "shown"),
    [
        ({"observer_gain": 50.0}, {"observer_gain"}),  # a plant with one input, or axes that ended alike
        (
            {"observer_gain": 45.0, "observer_gain_1": 50.0, "observer_gain_2": 40.0},
            {"observer_gain_1", "observer_gain_2"},
        ),
    ],
)
def test_an_observer_tuned_axis_by_axis_is_shown(tuned, shown):
    metric = {"rms": 1.0, "mean": 1.0, "max": 1.0}
    flown = {"trials": 8, "counts": {"ok": 8}, "window_error": metric, "peak_torque": metric, "effort": metric}
    each = {f"observer_gain_{k + 1}": 50.0 for k in range(len(shown))}
    found = {"plant": "chain", "gains": each, "paper": {"gains": {"observer_gain": 10.0}, **flown}}
    table = sentences.tuning({**found, "fresh": {"gains": tuned, **flown}})
    assert {row[0] for row in table.rows if row[0].startswith("observer_gain")} == shown


def test_a_campaign_does_not_fly_the_trials_of_a_search():
    from tuning.cli import main

    seeds = {
        command.__name__: inspect.signature(command).parameters["seed"].default
        for command in (main.tune, main.pareto, main.compare)
    }
    assert inspect.signature(campaign_commands.montecarlo).parameters["seed"].default not in seeds.values()


def tuned(times, counts, *, met=True, **more):
    """What `accuracy` reads."""
    group = {"window_error": None, "trials": 64, "counts": counts, "floor": None}
    verdict = {"metric": "peak_torque", "limit": 0.5, "unit": "N m", "met": met}
    return {"fresh": group, "training": group, "accuracy_gain_over_paper": times, "verdicts": [verdict], **more}


def test_shares_are_told_in_digits_that_say_something():
    """59 of 60 trials were 98.3333 %; near all of them it is what is missing that counts."""
    asked = Requirement("peak_torque", 0.5, quantile=0.95)
    verdict = asked.verdict(np.r_[np.zeros(59), 1.0], np.ones(60, bool)).in_summary()
    more = {"share": 59 / 60, "share_interval": [0.91056, 0.99957], "share_bound": 0.92333}
    said = sentences.verdict({**verdict, **more})
    assert "98.33 % of trials keep the limit (95 %: 91.06 to 99.957 %)" in said
    wide = Requirement("ape_x", 1.0, quantile=0.9, interpretation="mixed")
    seen = wide.verdict(np.ones(3), np.ones(3, bool), np.array([1.0, 0.95, 1.0]))
    assert str(seen).endswith("98.33 %: met")


@pytest.mark.parametrize(("failures", "advice"), [
    (0, "; with no failure 299 trials would do"), (9, "; with so many failures 1568 trials would do"), (10, ""),
])  # fmt: skip
def test_how_many_trials_would_do_is_said_where_more_of_them_keep_the_limit_than_are_asked_for(failures, advice):
    """Of 1 000 trials 10 are the very share that is asked for: more trials would have as many more of them."""
    asked = Requirement("peak_torque", 0.5, quantile=0.99, confidence=0.95)
    verdict = asked.verdict(np.r_[np.zeros(1000 - failures), np.ones(failures)], np.ones(1000, bool)).in_summary()
    more = {"share": 1.0 - failures / 1000, "share_interval": [0.9, 1.0], "share_bound": 0.985,
            "fewest_trials": statistics.fewest_for(failures, 0.99, 0.95)}  # fmt: skip
    assert sentences.verdict({**verdict, **more}).endswith(f"at least 98.5 % at 95 % one-sided confidence{advice}")


def test_the_best_of_a_map_is_a_pair_of_which_no_trial_fails_or_misses():
    pair = {"status": "flown", "failures": 0.0, "missed": 0.0, "window_error": 2e-6, "peak_torque": 0.3}
    pairs = [
        {**pair, "x": 1.0, "y": 1.0, "failures": 3.0, "window_error": 1e-6},
        {**pair, "x": 1.0, "y": 2.0},
        {**pair, "x": 2.0, "y": 1.0, "missed": 2.0, "window_error": 1e-6},
        {**pair, "x": 2.0, "y": 2.0, "status": "not allowed", "window_error": float("nan")},
    ]
    keys = "loop.period", "controller.delta"
    best, flown = sentences.grid(pairs, keys, "spacecraft")
    assert best == (
        "the smallest RMS window error is 2e-06, at loop.period = 1 and controller.delta = 2, "
        "where the mean peak of the input is 0.3 N m"
    )
    assert flown == "3 of 4 pairs flown, 2 with trials that failed or missed"
    best, _ = sentences.grid(pairs[:1], keys, "spacecraft")
    assert best.endswith("is 0.3 N m, where 3 trials failed or missed")


def test_less_accurate_gains_are_not_praised():
    """The interval of a ratio turns over with it: from 0.05..0.1 to 10..20."""
    less = tuned(0.08, {"ok": 64}, paper_is="paper, scaled", accuracy_gain_interval=[0.05, 0.1])
    (said,) = sentences.accuracy(less)
    assert said == (
        "the tuned gains are less accurate than the paper's gains, scaled to this body and period: they leave 12.5 "
        "times the error (95 %: 10 to 20)"
    )
    (said,) = sentences.accuracy({**less, "broken_by": {"paper": ["gain_margin", "effort"]}})
    assert said.endswith(
        "(95 %: 10 to 20); broken by the paper's gains, scaled to this body and period: gain_margin and effort"
    )
    (said,) = sentences.accuracy(tuned(0.08, {"ok": 64}, met=False))  # which is no consolation
    assert said.endswith("they leave 12.5 times the error, and break peak_torque")
    (said,) = sentences.accuracy(tuned(40.0, {"ok": 64}, met=False, paper_is="paper's law"))
    assert said == (
        "the tuned gains are 40 times as accurate as the paper's law with the paper's gains, but break peak_torque"
    )


def test_where_nothing_arrives_it_is_said_and_nothing_compared():
    said = list(sentences.accuracy(tuned(0.08, {"ok": 0, "missed": 60, "diverged": 4}, met=False)))
    assert said == ["with the tuned gains 64 of 64 fresh trials do not arrive: 60 missed, 4 diverged"]
    training = {"trials": 16, "counts": {"ok": 2, "missed": 14}}
    lines = search_sentences.search(summary(None, searched=None) | {"training": training})
    (said,) = [line for line in lines if line.startswith(BEST)]
    assert said.endswith("14 of 16 training trials do not arrive (14 missed), and so keep no limit")
    several = summary(None, searched=None) | {"training": training}
    several["search"]["largest_over_limit"] |= {"effort": None, "chattering": float("inf")}
    told = [line for line in search_sentences.search(several) if line.startswith(BEST)]
    assert told == [said]  # once, however many limits


def test_a_broken_requirement_is_named_with_its_limit():
    reached = summary(1.2, searched=1.2)
    reached["verdicts"][0]["unit"] = "N m"
    none, said = search_sentences.search(reached)
    assert none == "the search found no gains that meet every requirement"
    assert said.startswith(BEST)
    assert said.endswith("peak_torque reaches 1.2 times its limit, 0.5 N m, on the training trials")
    seen = tuner.Beyond(4.3, 0.5, str(Requirement("peak_torque", 0.5).verdict(np.array([0.4, 0.7]), np.ones(2, bool))))
    assert not seen.better
    assert tune_files._beyond(seen, 4.0) == (
        "no better beyond its bound: at 4.3 peak_torque at most 0.5 N m: worst 0.7: NOT met in 1 of 2 trials"
    )


@pytest.mark.parametrize(("times", "error"), [(1.002, "the same error"), (1.02, "1.02 times the error")])
def test_beyond_a_bound_the_error_may_stay_as_it_is(times, error):
    assert tune_files._beyond(tuner.Beyond(4.3, times, None), 4.0) == f"no better beyond its bound: {error} at 4.3"


def test_beyond_a_bound_gains_may_arrive_where_no_trial_does_with_the_tuned_ones():
    """Trained on the anchored clock and lost on that which flies, they have no error to tell another one by."""
    seen = tuner.Beyond(4.3, None, None)
    assert not seen.better
    assert tune_files._beyond(seen, 4.0) == (
        "on its bound 4: every requirement kept at 4.3, with no error to set that beside"
    )


def test_a_column_is_called_after_whose_gains_it_holds():
    paper = scenario.from_tables({"loop": {"mode": "sampled"}})
    assert gains.paper_is(paper) == "paper"
    assert gains.paper_is(scenario.replace(paper, loop__period=0.5)) == "paper, scaled"  # a hand-over of a period
    assert gains.paper_is(scenario.replace(paper, spacecraft={"inertia": [0.1, 0.1, 0.1]})) == "paper, scaled"
    assert gains.paper_is(scenario.replace(paper, controller={"kind": "pd"})) == "paper's law"


@pytest.mark.parametrize("kind", ["chain", "spacecraft"])
def test_the_papers_law_flies_in_place_of_another_on_every_plant(kind):
    order = {"order": 2} if kind == "chain" else {}
    flown = scenario.from_tables(
        {"plant": {"kind": kind, **order}, "loop": {"mode": "sampled"}, "controller": {"kind": "pd", "t_f": 12.0}}
    )
    papers = gains.papers(flown)
    assert (papers.controller.kind, papers.controller.t_f, papers.controller.eta) == ("prescribed_time", 12.0, 3.0)
    assert getattr(papers.controller, "error", "multiplicative") == "multiplicative"


@pytest.mark.parametrize(("most", "said"), [(0.0633, 1), (0.0, 0)])
def test_a_command_that_actuators_cut_is_said_where_nothing_was_required_of_it(most, said):
    """A peak torque of twice the actuators' limit stood in the table without a word."""
    summary = tuned(None, {"ok": 64})
    summary["fresh"] |= {"saturated": {"mean": 0.0059, "max": most}}
    lines = list(sentences.accuracy(summary))
    assert len(lines) == said
    assert all("for 0.59 % of a fresh trial on average and 6.33 % at most" in line for line in lines)


@pytest.mark.parametrize(("without", "largest"), [(1, "57.2"), (2, "none")])
def test_no_largest_settling_time_is_said_where_a_run_that_ended_never_settled(without, largest):
    """Of the trials that failed there is none either, but they are counted above the table."""
    at = {"value": 56.0, "low": 55.0, "high": 57.0}
    settling = {"without_value": without, "max": 57.2, "0.5": at, "0.9973": at}
    counts = {"ok": 58, "missed": 1, "diverged": 1}
    (table,) = campaign_sentences.quantiles(
        {"plant": "spacecraft", "counts": counts, "quantiles": {"settling_time": settling}}
    )
    assert table.rows == [("settling_time", "56", "56", "55..57", largest, "s")]


@pytest.mark.parametrize(
    ("times", "said"), [(1.001, "+0.10 % off that"), (0.98, "-2.00 % off that"), (3835.0, "3.84e+03 times that")]
)
def test_how_far_the_global_check_is_off_is_told_by_the_goals_themselves(times, said):
    check = {"rollouts": 7, "value": 2.0, "distance": float(np.log(times)), "kept": True}
    record = {"largest_over_limit": {}, "differential_evolution": check}
    (sentence,) = search_sentences.search({"search": record, "verdicts": [], "differential_evolution": check})
    assert sentence.endswith(f"the goal of the tuned gains is {said}")


@pytest.mark.parametrize("slopes", [None, {"start": 1e-9, "end": 1e-9}])
def test_margins_of_the_exact_sign_are_told_to_be_without_it(slopes):
    hold = {"stable": True, "gain_margin": 9.0, "phase_margin": 40.0, "delay_margin": 0.1, "modulus_margin": 3.0}
    found = {"influence": {}, "margins": {"hold": hold}, "slopes_off_central_differences": slopes}
    said = " ".join(search_sentences.trust({"trust": found, "at_bound": {}, "verdicts": []}))
    assert "gain 9 dB" in said
    assert (NO_SIGN in said) == (slopes is None)


@pytest.mark.parametrize(("start", "end", "said"), [
    (None, None, "are not checked"), (1e-9, None, "agree with differences to 1e-09 at the start"),
])  # fmt: skip
def test_slopes_that_have_no_differences_are_not_said_to_agree_with_them(start, end, said):
    """Without any number the sentence ended with "agree with differences to "."""
    found = {"influence": {}, "slopes_off_central_differences": {"start": start, "end": end}}
    (told,) = search_sentences.trust({"trust": found, "at_bound": {}, "verdicts": []})
    assert told.startswith(f"slopes by automatic differentiation {said}")


def test_gains_that_no_trial_ends_with_have_no_known_influence():
    found = {"influence": {"eta": "unknown", "delta": "unknown"}, "slopes_off_central_differences": None}
    told = list(search_sentences.trust({"trust": found, "at_bound": {"eta": "upper"}, "verdicts": []}))
    assert told[0].startswith("what eta, delta does is unknown: no training trial ends")
    assert not [line for line in told if "bound" in line[:30] or "influence" in line]


def test_slopes_that_are_off_may_be_due_to_steps_of_the_torque():
    """With steps of 1 mN m on a large satellite they were off by 3 in a loop that neither chatters nor breaks off."""
    found = {"influence": {}, "slopes_off_central_differences": {"start": 3.0, "end": 2.0}}
    (said,) = search_sentences.trust({"trust": found, "at_bound": {}, "verdicts": []})
    assert "hardware.torque_step" in said


@pytest.mark.parametrize(("least", "said"), [(2.0, []), (2.36, ["tune with tune.trials = 64"])])
def test_gains_that_fit_their_training_trials_too_closely_are_told(least, said):
    """By intervals that share nothing: 1.73e-6 (1.49 to 2.01) in training, 2.42e-6 from 2.36 on elsewhere."""
    at = {"training": [1.49, 2.01], "fresh": [least, 2.48]}
    errors = {on: {"window_error": {"rms_interval": interval}} for on, interval in at.items()}
    lines = list(search_sentences.advice({"search": {"averaged": 16}, "verdicts": [], **errors}))
    assert [line.rpartition("; ")[2] for line in lines] == said
