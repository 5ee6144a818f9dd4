"""Batches of requests from concurrent tasks: each task has a thread, and requests are answered together.

The tuner runs several local searches side by side in this way, and simulates their points in one call.
Read `run_in_lockstep` first.
"""

import threading
from collections.abc import Callable, Sequence
from queue import SimpleQueue
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
    # Queues only wake waiting threads, the state is in the dictionaries. Unlike waiting for a `threading.Condition`,
    # waiting for a `SimpleQueue` can be interrupted safely.
    requests, answers = dict[int, Any](), dict[int, Any]()  # of the functions that wait, by their numbers
    ended = dict[int, BaseException | None]()  # exceptions of the functions that have ended
    changed, woken = SimpleQueue[None](), [SimpleQueue[None]() for _ in functions]
    waiting = SimpleQueue[int | None]()  # numbers of functions to run; None ends a thread

    def run(number: int) -> BaseException | None:
        def ask(request: Any) -> Any:
            requests[number] = request
            changed.put(None)
            while number not in answers:
                woken[number].get()
            received = answers.pop(number)
            if isinstance(received, BaseException):
                raise received
            return received

        try:
            functions[number](ask)
        except BaseException as error:
            return error
        return None

    def work() -> None:
        while (number := waiting.get()) is not None:
            ended[number] = run(number)
            changed.put(None)

    running, started, failure = set[int](), 0, None
    threads = range(min(width, len(functions)))
    try:
        for _ in threads:
            threading.Thread(target=work, daemon=True).start()
        while True:
            try:
                for number in list(answers):
                    woken[number].put(None)
                failure = failure or next(filter(None, ended.values()), None)
                running.difference_update(ended)
                while started < len(functions) and failure is None and len(running) < width:
                    waiting.put(started)
                    running.add(started)
                    started += 1
                if not running:
                    break
                # if a function has ended, another function starts first, and its request joins this batch
                if not running.isdisjoint(ended):
                    continue
                if not running <= requests.keys():
                    changed.get()
                    continue
                if failure is not None:
                    raise failure
                numbers = sorted(running)
                answers.update(zip(numbers, answer([requests[k] for k in numbers]), strict=True))
                requests.clear()
            except BaseException as error:
                failure = error
                answers.update(dict.fromkeys(requests, failure))
                requests.clear()
    finally:
        for _ in threads:
            waiting.put(None)
    if failure is not None:
        raise failure
