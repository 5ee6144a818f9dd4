"""Batches of requests from concurrent tasks: each task has a thread, and requests are answered together.

The tuner runs several local searches side by side in this way, and simulates their points in one call.
Read `run_in_lockstep` first.
"""

import threading
from collections.abc import Callable, Sequence
from typing import Any

Ask = Callable[[Any], Any]


def run_in_lockstep(
    functions: Sequence[Callable[[Ask], None]], answer: Callable[[list[Any]], list[Any]], width: int
) -> None:
    """Run functions concurrently and answer their requests in batches.

    A function makes one request at a time, by calling its argument. All functions have stopped when
    `run_in_lockstep` returns or raises.

    Args:
        functions: the functions.
        answer: returns the answers to a list of requests. It is called in this thread as soon as every running function
            waits for an answer.
        width: largest number of functions that run at a time.

    Raises:
        BaseException: The exception of a function or of `answer`. An exception of `answer`, such as KeyboardInterrupt,
            is first raised inside the functions that wait.
    """
    condition = threading.Condition()
    requests, answers = dict[int, Any](), dict[int, Any]()  # of the functions that wait, by their numbers
    ended = dict[int, BaseException | None]()  # exceptions of the functions that have ended

    def run(number: int) -> None:
        def ask(request: Any) -> Any:
            with condition:
                requests[number] = request
                condition.notify_all()
                condition.wait_for(lambda: number in answers)
                received = answers.pop(number)
            if isinstance(received, BaseException):
                raise received
            return received

        exception = None
        try:
            functions[number](ask)
        except BaseException as error:
            exception = error
        with condition:
            ended[number] = exception
            condition.notify_all()

    running, started, failure = set[int](), 0, None
    with condition:
        while True:
            failure = failure or next(filter(None, ended.values()), None)
            running.difference_update(ended)
            while started < len(functions) and failure is None and len(running) < width:
                threading.Thread(target=run, args=(started,), daemon=True).start()
                running.add(started)
                started += 1
            if not running:
                break
            try:
                condition.wait_for(lambda: running <= requests.keys() | ended.keys())
                if failure is not None:
                    raise failure
                # if a function has ended, another function starts first, and its request joins this batch
                if running.isdisjoint(ended):
                    numbers = sorted(running)
                    answers.update(zip(numbers, answer([requests[k] for k in numbers]), strict=True))
                    requests.clear()
            except BaseException as error:
                failure = error
                answers.update(dict.fromkeys(requests, failure))
                requests.clear()
            condition.notify_all()
    if failure is not None:
        raise failure
