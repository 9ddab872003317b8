"""Processes that share the work on the frames of drives: to encode them, or to write them to files."""

import math
import os
import signal
import traceback
from collections import deque
from collections.abc import Callable, Iterator
from contextlib import contextmanager, suppress
from itertools import pairwise
from multiprocessing import (
    get_all_start_methods,
    get_context,
    get_start_method,
    resource_tracker,
    set_start_method,
)
from multiprocessing.connection import Connection, wait
from typing import Generic, TypeVar

from rcnn_odom.errors import InputError

CHUNK = 64
"""Frames that a worker hands over at a time."""

ONE_THREAD = dict.fromkeys(
    ("OMP_NUM_THREADS", "OPENBLAS_NUM_THREADS", "MKL_NUM_THREADS", "NUMBA_NUM_THREADS"), "1"
)

Answer = TypeVar("Answer")
Task = Callable[[str, int, int], Answer]
"""What is to be done with a drive of this name from the first frame to the one before the last."""
Piece = tuple[int, int, int]
"""Number of a drive, its first frame and the one after the last."""


def share(lengths: list[int], workers: int) -> list[list[Piece]]:
    """Deals the frames of drives out to workers, evenly, in pieces of ``CHUNK``.

    Laid end to end, each worker gets one stretch: a world is built by two of them only where their
    stretches meet, and not for every piece.
    """
    total, shares = sum(lengths), []
    for begin, end in pairwise(total * worker // workers for worker in range(workers + 1)):
        pieces, first = [], 0
        for number, length in enumerate(lengths):
            start, stop = max(begin - first, 0), min(end - first, length)
            pieces += [(number, at, min(at + CHUNK, stop)) for at in range(start, stop, CHUNK)]
            first += length
        shares.append(pieces)
    return shares


def useful_workers(workers: int, frames: int) -> int:
    """As many workers as there are pieces for, at most."""
    return min(workers, math.ceil(frames / CHUNK))


class Workers(Generic[Answer]):
    """Processes that do a task on pieces of drives, the same ones however many processes there are.

    They end at once when closed, and by themselves when this process is killed.

    Args:
        count: processes.
        task: what they do; it and its answers are pickled, and each worker keeps its own copy.
        niceness: by how much the workers give way to others, 0 to 19.
        remedy: what the user can do when one is killed.
    """

    def __init__(
        self, count: int, task: Task[Answer], niceness: int = 0, remedy: str = "try data.workers=1"
    ) -> None:
        self._remedy = remedy
        # Fresh processes: a fork of one that has started torch's threads can hang.
        context = get_context("spawn")
        if get_start_method() not in get_all_start_methods():
            # A process of joblib says "loky" here, and a fresh one would look for that without knowing it.
            set_start_method("spawn", force=True)
        self._connections, self._processes = [], []
        with _what_workers_inherit():
            for _ in range(count):
                ours, theirs = context.Pipe()
                process = context.Process(target=_work, args=(theirs, task, niceness), daemon=True)
                process.start()
                theirs.close()  # so that the death of the worker is the end of the pipe
                self._connections.append(ours)
                self._processes.append(process)

    def run(self, names: list[str], lengths: list[int]) -> Iterator[tuple[Piece, Answer]]:
        """All pieces of the drives and the task's answers, in whatever order they get done.

        Raises:
            InputError: a worker was killed.
            Exception: whatever the task raised.
        """
        todo: dict[Connection, deque[Piece]] = {}
        try:
            for connection, pieces in zip(
                self._connections, share(lengths, len(self._connections)), strict=True
            ):
                if pieces:
                    with self._telling_of_death():
                        connection.send([(names[number], start, stop) for number, start, stop in pieces])
                    todo[connection] = deque(pieces)
            while todo:
                for ready in wait(list(todo)):
                    assert isinstance(ready, Connection)
                    answer = self._receive(ready)
                    piece = todo[ready].popleft()
                    if not todo[ready]:
                        del todo[ready]
                    yield piece, answer
        finally:
            if todo:  # what is still to come would be taken for the answer to the next call
                self.close()

    def _receive(self, connection: Connection) -> Answer:
        with self._telling_of_death():
            answer = connection.recv()
        if isinstance(answer, Exception):
            raise answer
        return answer

    @contextmanager
    def _telling_of_death(self) -> Iterator[None]:
        try:
            yield
        except (EOFError, OSError) as error:
            raise InputError(
                f"a worker process was killed, perhaps for want of memory; {self._remedy}"
            ) from error

    def close(self) -> None:
        """Ends the workers in the middle of whatever they do."""
        for process in self._processes:
            process.terminate()
        for process in self._processes:
            process.join()

    def __enter__(self) -> "Workers[Answer]":
        return self

    def __exit__(self, *_: object) -> None:
        self.close()


@contextmanager
def _what_workers_inherit() -> Iterator[None]:
    """One thread for each library, which looks while it is imported, and no ear for Ctrl-C.

    Ctrl-C reaches every process of a terminal, and it is the parent that ends its workers.
    """
    before = {name: os.environ.get(name) for name in ONE_THREAD}
    os.environ.update(ONE_THREAD)
    resource_tracker.ensure_running()  # or it starts with the first worker, and unblocks Ctrl-C
    heard = signal.pthread_sigmask(signal.SIG_BLOCK, {signal.SIGINT})
    try:
        yield
    finally:
        signal.pthread_sigmask(signal.SIG_SETMASK, heard)
        for name, value in before.items():
            os.environ.pop(name)
            if value is not None:
                os.environ[name] = value


def _work(connection: Connection, task: Task[Answer], niceness: int) -> None:
    """What a worker does until its parent ends."""
    os.nice(niceness)
    with suppress(EOFError, OSError):  # the parent has ended
        while True:
            for piece in connection.recv():
                connection.send(_answer(task, *piece))


def _answer(task: Task[Answer], name: str, start: int, stop: int) -> Answer | Exception:
    try:
        return task(name, start, stop)
    except Exception as error:
        error.add_note(traceback.format_exc())  # a traceback does not travel
        return error
