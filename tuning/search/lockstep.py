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

    def __init__(self, work: Callable[[Ask], None], turn: threading.Condition):
        self._work, self._turn = work, turn
        self.question: Any = None
        self.waits = self.ended = False
        self.error: BaseException | None = None
        self._answer: Any = None

    def start(self) -> None:
        threading.Thread(target=self._run, daemon=True).start()

    def _run(self) -> None:
        try:
            self._work(self._ask)
        except BaseException as error:
            self.error = error
        with self._turn:
            self.ended = True
            self._turn.notify_all()

    def _ask(self, question: Any) -> Any:
        with self._turn:
            self.question, self.waits = question, True
            self._turn.notify_all()
            self._turn.wait_for(lambda: not self.waits)
        if isinstance(self._answer, BaseException):
            raise self._answer
        return self._answer

    def tell(self, answer: Any) -> None:
        """Answer the request. If the answer is an exception, it is raised inside the task."""
        self._answer, self.waits = answer, False


def run_in_lockstep(
    works: Sequence[Callable[[Ask], None]], answer: Callable[[list[Any]], list[Any]], width: int
) -> None:
    """Run functions concurrently and answer their requests in batches.

    A function makes one request at a time, by calling its argument. All functions have stopped when
    `run_in_lockstep` returns or raises.

    Args:
        works: the functions.
        answer: returns the answers to a list of requests. It is called in this thread as soon as every running function
            waits for an answer.
        width: largest number of functions that run at a time.

    Raises:
        BaseException: The exception of a function or of `answer`. An exception of `answer`, such as KeyboardInterrupt,
            is first raised inside the functions that wait.
    """
    turn = threading.Condition()
    waiting, active, raised = [_Task(work, turn) for work in works], list[_Task](), None

    def all_stopped() -> bool:
        return all(task.waits or task.ended for task in active)

    with turn:
        while True:
            raised = raised or next((task.error for task in active if task.error is not None), None)
            active[:] = [task for task in active if not task.ended]
            while waiting and raised is None and len(active) < width:
                active.append(waiting.pop(0))
                active[-1].start()
            if not active:
                break
            try:
                turn.wait_for(all_stopped)
                if raised is not None:
                    raise raised
                if not any(task.ended for task in active):  # else another one starts and joins this batch
                    answers = answer([task.question for task in active])
                    for task, one in zip(active, answers, strict=True):
                        task.tell(one)
            except BaseException as error:
                raised = error
                for task in active:
                    if task.waits:
                        task.tell(raised)
            turn.notify_all()
    if raised is not None:
        raise raised
