"""Works side by side: who is asked together, and what becomes of errors and interrupts."""

import threading

import pytest

from tuning.search.lockstep import in_step


def counting(upto, found, name):
    """A work that asks for the double of 1, 2, .. and keeps what it is told."""

    def work(ask):
        for k in range(1, upto + 1):
            found.setdefault(name, []).append(ask((name, k)))

    return work


def test_questions_of_all_that_are_at_work_are_answered_together_in_order():
    asked, found = [], {}

    def answer(questions):
        asked.append(questions)
        return [2 * k for _, k in questions]

    in_step([counting(n, found, name) for n, name in ((3, "a"), (1, "b"), (2, "c"))], answer, width=2)
    assert found == {"a": [2, 4, 6], "b": [2], "c": [2, 4]}
    assert asked == [[("a", 1), ("b", 1)], [("a", 2), ("c", 1)], [("a", 3), ("c", 2)]]
    asked.clear()
    in_step([counting(2, {}, "a"), counting(1, {}, "b")], answer, width=1)
    assert asked == [[("a", 1)], [("a", 2)], [("b", 1)]]
    in_step([], answer, width=2)
    in_step([lambda ask: None], answer, width=2)


@pytest.mark.parametrize("error", [KeyboardInterrupt, ValueError])
def test_an_interrupt_reaches_all_that_wait_and_then_the_caller(error):
    put_away, threads, calls = [], threading.active_count(), iter(range(3))

    def work(ask):
        try:
            while True:
                ask("more")
        finally:
            put_away.append("best so far")

    def answer(questions):
        if next(calls) == 2:
            raise error
        return [None] * len(questions)

    with pytest.raises(error):
        in_step([work, work, work], answer, width=2)
    assert len(put_away) == 2  # the third was not begun
    assert threading.active_count() <= threads + 1  # the last may be on its way out


def test_what_a_work_raises_stops_the_others_and_is_raised():
    found = {}

    def fails(ask):
        ask(("bad", 1))
        raise ZeroDivisionError

    with pytest.raises(ZeroDivisionError):
        in_step([fails, counting(10, found, "a"), counting(1, found, "b")], lambda q: [k for _, k in q], width=2)
    assert len(found["a"]) < 10
    assert "b" not in found
