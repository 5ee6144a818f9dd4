"""Test of progress in percent, with steps that end early and with further rounds."""

from tuning.search.evaluate import Evaluator
from tuning.search.shares import Bounds
from tuning.search.work import Work


def test_progress_is_done_work_over_done_and_remaining_work():
    seen, flown = [], Evaluator(Bounds((), (), ()))
    work = Work(lambda what, done, total, *_: seen.append((what, done)), flown, {"a": 50.0, "b": 50.0},
                {"harder trials": 25.0, "b": 50.0})  # fmt: skip

    def told(what, rollouts, gradients=0):
        flown.rollouts, flown.gradients = rollouts, gradients
        work(what, 0, 0, 0.0, 0.0)
        return seen[-1][1]

    assert told("compiling", 0) == 0
    assert told("a", 0) == 0
    assert seen[-1] == ("compiling", 0)  # no rollout is complete yet
    assert told("a", 25) == 25
    assert told("b", 30) == round(100 * 30 / 80)  # step a ended early: 30 done, 50 left
    assert told("b", 30, 4) == round(100 * 50 / 80)  # a rollout with gradients counts as five
    assert told("judging", 60, 4) == round(100 * 80 / 130)  # unplanned step: the remaining work is unchanged
    assert told("harder trials, round 1", 60, 4) == round(100 * 80 / 155)
    assert told("b", 70, 4) == round(100 * 90 / 140)
    assert told("b", 130, 4) == 100  # 80 rollouts instead of 50: progress is limited to 100 %
    assert set(work.seconds) == {"compiling", "a", "b", "judging", "harder trials, round 1"}
