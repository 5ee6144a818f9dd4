"""Tests of concurrent functions with batched requests, including errors and interrupts."""

import signal
import threading
import time

import pytest

from tuning.search.lockstep import run_in_lockstep


def counting(upto, found, name):
    """Return a function of `ask` that requests answers to 1, 2, .., `upto` and stores them in the list found[name]."""

    def work(ask):
        for k in range(1, upto + 1):
            found.setdefault(name, []).append(ask((name, k)))

    return work


def test_requests_of_all_running_functions_are_answered_together_in_order():
    asked, found = [], {}

    def answer(questions):
        asked.append(questions)
        return [2 * k for _, k in questions]

    run_in_lockstep([counting(n, found, name) for n, name in ((3, "a"), (1, "b"), (2, "c"))], answer, width=2)
    assert found == {"a": [2, 4, 6], "b": [2], "c": [2, 4]}
    assert asked == [[("a", 1), ("b", 1)], [("a", 2), ("c", 1)], [("a", 3), ("c", 2)]]
    asked.clear()
    run_in_lockstep([counting(2, {}, "a"), counting(1, {}, "b")], answer, width=1)
    assert asked == [[("a", 1)], [("a", 2)], [("b", 1)]]
    run_in_lockstep([], answer, width=2)
    run_in_lockstep([lambda ask: None], answer, width=2)


@pytest.mark.parametrize("error", [KeyboardInterrupt, ValueError])
def test_an_exception_of_the_answering_function_ends_waiting_functions_and_the_call(error):
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
        run_in_lockstep([work, work, work], answer, width=2)
    assert len(put_away) == 2  # the third function was not started
    deadline = time.monotonic() + 10.0
    while threading.active_count() > threads and time.monotonic() < deadline:
        time.sleep(0.01)
    assert threading.active_count() <= threads


def test_an_exception_of_a_function_stops_the_other_functions_and_is_raised():
    found = {}

    def fails(ask):
        ask(("bad", 1))
        raise ZeroDivisionError

    works = [fails, counting(10, found, "a"), counting(1, found, "b")]
    with pytest.raises(ZeroDivisionError):
        run_in_lockstep(works, lambda q: [k for _, k in q], width=2)
    assert len(found["a"]) < 10
    assert "b" not in found


def test_an_interrupt_while_functions_work_is_raised_in_their_next_requests_and_in_the_caller():
    caller, stopped = threading.get_ident(), []

    def work(ask):
        ask("first")
        if not stopped:
            time.sleep(0.1)  # the caller waits for the next request
            signal.pthread_kill(caller, signal.SIGINT)
        try:
            ask("second")
        finally:
            stopped.append("best so far")

    before = signal.signal(signal.SIGINT, signal.default_int_handler)  # a process in the background may ignore it
    try:
        with pytest.raises(KeyboardInterrupt):
            run_in_lockstep([work, lambda ask: ask("only")], lambda questions: [None for _ in questions], width=2)
    finally:
        signal.signal(signal.SIGINT, before)
    assert stopped == ["best so far"]
