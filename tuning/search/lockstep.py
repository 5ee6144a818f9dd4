"""Batches of requests from concurrent tasks: each task has a thread, and requests are answered together.

The tuner runs several local searches side by side in this way, and simulates their points in one call.
Read `run_in_lockstep` first.
"""

import threading
from collections.abc import Callable, Sequence
from typing import Any

Ask = Callable[[Any], Any]


class _Task:
    """A task in its own thread, and its current request."""

    def __init__(self, work: Callable[[Ask], None], condition: threading.Condition):
        self._work, self._condition = work, condition
        self.request: Any = None
        self.is_waiting = self.has_ended = False
        self.error: BaseException | None = None
        self._answer: Any = None

    def start(self) -> None:
        threading.Thread(target=self._run_work, daemon=True).start()

    def _run_work(self) -> None:
        """Run the work of this task in its thread, record an error, and notify that the task has ended."""
        try:
            self._work(self._ask)
        except BaseException as error:
            self.error = error
        with self._condition:
            self.has_ended = True
            self._condition.notify_all()

    def _ask(self, request: Any) -> Any:
        with self._condition:
            self.request, self.is_waiting = request, True
            self._condition.notify_all()
            self._condition.wait_for(lambda: not self.is_waiting)
        if isinstance(self._answer, BaseException):
            raise self._answer
        return self._answer

    def set_answer(self, answer: Any) -> None:
        """Set the answer to the request. If the answer is an exception, it is raised inside the task."""
        self._answer, self.is_waiting = answer, False


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
    pending, active, failure = [_Task(work, condition) for work in functions], list[_Task](), None

    def all_stopped() -> bool:
        return all(task.is_waiting or task.has_ended for task in active)

    with condition:
        while True:
            failure = failure or next((task.error for task in active if task.error is not None), None)
            active[:] = [task for task in active if not task.has_ended]
            while pending and failure is None and len(active) < width:
                active.append(pending.pop(0))
                active[-1].start()
            if not active:
                break
            try:
                condition.wait_for(all_stopped)
                if failure is not None:
                    raise failure
                # otherwise another function starts first, and its request joins this batch
                if not any(task.has_ended for task in active):
                    answers = answer([task.request for task in active])
                    for task, task_answer in zip(active, answers, strict=True):
                        task.set_answer(task_answer)
            except BaseException as error:
                failure = error
                for task in active:
                    if task.is_waiting:
                        task.set_answer(failure)
            condition.notify_all()
    if failure is not None:
        raise failure
