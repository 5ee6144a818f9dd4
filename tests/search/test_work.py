"""Progress on one scale: what is done over what is done and left, whatever ends early or comes in addition."""

from tuning.search.evaluate import Evaluator
from tuning.search.shares import Bounds
from tuning.search.work import Work


def test_steps_that_end_early_and_further_rounds_move_one_scale():
    seen, flown = [], Evaluator(Bounds((), (), ()))
    work = Work(lambda what, done, total, *_: seen.append((what, done)), flown, {"a": 50.0, "b": 50.0},
                {"harder trials": 25.0, "b": 50.0})  # fmt: skip

    def told(what, rollouts, gradients=0):
        flown.rollouts, flown.gradients = rollouts, gradients
        work(what, 0, 0, 0.0, 0.0)
        return seen[-1][1]

    assert told("compiling", 0) == 0
    assert told("a", 0) == 0
    assert seen[-1] == ("compiling", 0)  # whatever has begun: nothing has flown yet
    assert told("a", 25) == 25
    assert told("b", 30) == round(100 * 30 / 80)  # a ended early: 30 done, 50 left
    assert told("b", 30, 4) == round(100 * 50 / 80)  # a rollout with slopes is worth five
    assert told("judging", 60, 4) == round(100 * 80 / 130)  # not planned: what is left stays
    assert told("harder trials, round 1", 60, 4) == round(100 * 80 / 155)
    assert told("b", 70, 4) == round(100 * 90 / 140)
    assert told("b", 130, 4) == 100  # 80 where 50 were planned: nothing is left, and no more than all is done
    assert set(work.seconds) == {"compiling", "a", "b", "judging", "harder trials, round 1"}
