"""Worker processes that share the frames of drives, for encoding or for writing them to files."""

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
"""Number of frames in a piece, for which a worker sends one answer."""

ONE_THREAD = dict.fromkeys(
    ("OMP_NUM_THREADS", "OPENBLAS_NUM_THREADS", "MKL_NUM_THREADS", "NUMBA_NUM_THREADS"), "1"
)

Answer = TypeVar("Answer")
Task = Callable[[str, int, int], Answer]
"""Work on a drive, given its name, the first frame, and the frame after the last one."""
Piece = tuple[int, int, int]
"""Index of a drive, the first frame, and the frame after the last one."""


def split_frames(lengths: list[int], workers: int) -> list[list[Piece]]:
    """Distribute the frames of drives evenly to workers, in pieces of at most ``CHUNK`` frames.

    Each worker gets one continuous range of the frames of all drives in a row. So a simulated world is built
    only by the few workers whose ranges it overlaps.

    Args:
        lengths: number of frames of each drive.
        workers: number of workers.

    Returns:
        The pieces of each worker.

    >>> split_frames([100, 50], workers=2)
    [[(0, 0, 64), (0, 64, 75)], [(0, 75, 100), (1, 0, 50)]]
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
    """The number of workers, but at most one for each piece of ``CHUNK`` frames."""
    return min(workers, math.ceil(frames / CHUNK))


class Workers(Generic[Answer]):
    """Processes that apply a task to pieces of drives.

    They end at once when this object is closed, and by themselves when this process is killed.

    Args:
        count: number of processes.
        task: the work; it and its answers are pickled, and each worker has its own copy of it.
        niceness: niceness added to the workers, 0 to 19.
        remedy: advice to the user if a worker is killed.
    """

    def __init__(
        self, count: int, task: Task[Answer], niceness: int = 0, remedy: str = "try data.workers=1"
    ) -> None:
        self._remedy = remedy
        # Spawned processes, because a fork of a process with torch's threads can hang.
        context = get_context("spawn")
        if get_start_method() not in get_all_start_methods():
            # In a process of joblib it is "loky", an unknown method that a spawned process would try to set.
            set_start_method("spawn", force=True)
        self._connections, self._processes = [], []
        with _environment_of_workers():
            for _ in range(count):
                ours, theirs = context.Pipe()
                process = context.Process(target=_run_worker, args=(theirs, task, niceness), daemon=True)
                process.start()
                theirs.close()  # so that the pipe ends when the worker dies
                self._connections.append(ours)
                self._processes.append(process)

    def run(self, names: list[str], lengths: list[int]) -> Iterator[tuple[Piece, Answer]]:
        """Yield all pieces of the drives with the task's answers, in the order in which they are completed.

        Args:
            names: names of the drives.
            lengths: their numbers of frames.

        Raises:
            InputError: a worker was killed.
            Exception: the task raised it.
        """
        todo: dict[Connection, deque[Piece]] = {}
        try:
            for connection, pieces in zip(
                self._connections, split_frames(lengths, len(self._connections)), strict=True
            ):
                if pieces:
                    with self._report_killed_worker():
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
            if todo:  # answers that are still to come would be mistaken for answers to the next call
                self.close()

    def _receive(self, connection: Connection) -> Answer:
        with self._report_killed_worker():
            answer = connection.recv()
        if isinstance(answer, Exception):
            raise answer
        return answer

    @contextmanager
    def _report_killed_worker(self) -> Iterator[None]:
        try:
            yield
        except (EOFError, OSError) as error:
            raise InputError(
                f"a worker process was killed, perhaps for lack of memory; {self._remedy}"
            ) from error

    def close(self) -> None:
        """End the workers at once, even during their work."""
        for process in self._processes:
            process.terminate()
        for process in self._processes:
            process.join()

    def __enter__(self) -> "Workers[Answer]":
        return self

    def __exit__(self, *_: object) -> None:
        self.close()


@contextmanager
def _environment_of_workers() -> Iterator[None]:
    """Make new processes use one thread for each library and ignore Ctrl-C.

    Libraries read the number of threads from the environment when they are imported. Ctrl-C reaches all
    processes of a terminal, but the parent ends its workers itself.
    """
    before = {name: os.environ.get(name) for name in ONE_THREAD}
    os.environ.update(ONE_THREAD)
    resource_tracker.ensure_running()  # otherwise it starts with the first worker and unblocks Ctrl-C
    old_mask = signal.pthread_sigmask(signal.SIG_BLOCK, {signal.SIGINT})
    try:
        yield
    finally:
        signal.pthread_sigmask(signal.SIG_SETMASK, old_mask)
        for name, value in before.items():
            os.environ.pop(name)
            if value is not None:
                os.environ[name] = value


def _run_worker(connection: Connection, task: Task[Answer], niceness: int) -> None:
    """Work on pieces until the parent process ends."""
    os.nice(niceness)
    with suppress(EOFError, OSError):  # the parent has ended
        while True:
            for piece in connection.recv():
                connection.send(_run_task(task, *piece))


def _run_task(task: Task[Answer], name: str, start: int, stop: int) -> Answer | Exception:
    try:
        return task(name, start, stop)
    except Exception as error:
        error.add_note(traceback.format_exc())  # a traceback cannot be sent to another process
        return error
