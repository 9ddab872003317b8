"""Processes that encode scans: for the cache, and beside training for worlds that it sees only once."""

import math
import os
import signal
import traceback
from collections import deque
from collections.abc import Callable, Iterator
from contextlib import contextmanager, suppress
from functools import lru_cache
from itertools import pairwise
from multiprocessing import get_context, resource_tracker
from multiprocessing.connection import Connection, wait
from types import TracebackType

import numpy as np
import numpy.typing as npt

from rcnn_odom.datasets.sequence import Sequence
from rcnn_odom.errors import InputError
from rcnn_odom.motion import FloatArray
from rcnn_odom.scan import Sensor, encode

CHUNK = 64
"""Frames that a worker hands over at a time."""

ONE_THREAD = dict.fromkeys(
    ("OMP_NUM_THREADS", "OPENBLAS_NUM_THREADS", "MKL_NUM_THREADS", "NUMBA_NUM_THREADS"), "1"
)

OpenDrive = Callable[[str], Sequence]
Piece = tuple[int, int, int]
"""Number of a drive, its first frame and the one after the last."""
Block = tuple[int, int, npt.NDArray[np.float32], FloatArray]
"""Number of a drive, first frame, and from there on depth vectors (n, bins) and poses (n, 4, 4)."""


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


class Workers:
    """Processes that read and encode drives; what comes out does not depend on how many there are.

    They end at once when closed, and by themselves when this process is killed.

    Args:
        count: processes.
        open_drive: name -> ``Sequence``, called in the workers, so picklable.
        sensor: what the depth vectors are like.
        niceness: by how much the workers give way to others, 0 to 19.
    """

    def __init__(self, count: int, open_drive: OpenDrive, sensor: Sensor, niceness: int = 0) -> None:
        # Fresh processes: a fork of one that has started torch's threads can hang.
        context = get_context("spawn")
        self._connections, self._processes = [], []
        with _what_workers_inherit():
            for _ in range(count):
                ours, theirs = context.Pipe()
                process = context.Process(
                    target=_work, args=(theirs, open_drive, sensor, niceness), daemon=True
                )
                process.start()
                theirs.close()  # so that the death of the worker is the end of the pipe
                self._connections.append(ours)
                self._processes.append(process)

    def encode(self, names: list[str], lengths: list[int]) -> Iterator[Block]:
        """All frames of the drives, in whatever order they get done.

        Raises:
            InputError: a frame cannot be read, or a worker was killed.
        """
        todo: dict[Connection, deque[Piece]] = {}
        try:
            for connection, pieces in zip(
                self._connections, share(lengths, len(self._connections)), strict=True
            ):
                if pieces:
                    with _telling_of_death():
                        connection.send([(names[number], start, stop) for number, start, stop in pieces])
                    todo[connection] = deque(pieces)
            while todo:
                for ready in wait(list(todo)):
                    assert isinstance(ready, Connection)
                    scans, poses = _receive(ready)
                    number, start, _ = todo[ready].popleft()
                    if not todo[ready]:
                        del todo[ready]
                    yield number, start, scans, poses
        finally:
            if todo:  # what is still to come would be taken for the answer to the next call
                self.close()

    def close(self) -> None:
        """Ends the workers in the middle of whatever they do."""
        for process in self._processes:
            process.terminate()
        for process in self._processes:
            process.join()

    def __enter__(self) -> "Workers":
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
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


@contextmanager
def _telling_of_death() -> Iterator[None]:
    try:
        yield
    except (EOFError, OSError) as error:
        raise InputError(
            "a process that encodes scans was killed, perhaps for want of memory; try data.workers=1"
        ) from error


def _receive(connection: Connection) -> tuple[npt.NDArray[np.float32], FloatArray]:
    with _telling_of_death():
        answer = connection.recv()
    if isinstance(answer, Exception):
        raise answer
    return answer


def _work(connection: Connection, open_drive: OpenDrive, sensor: Sensor, niceness: int) -> None:
    """What a worker does until its parent ends."""
    os.nice(niceness)
    # Pieces of a drive follow each other.
    open_drive = lru_cache(1)(open_drive)
    with suppress(EOFError, OSError):  # the parent has ended
        while True:
            for name, start, stop in connection.recv():
                connection.send(_encode(open_drive, name, range(start, stop), sensor))


def _encode(
    open_drive: OpenDrive, name: str, frames: range, sensor: Sensor
) -> tuple[npt.NDArray[np.float32], FloatArray] | Exception:
    try:
        sequence = open_drive(name)
        scans = np.stack([encode(*sequence.read_scan(frame), sensor) for frame in frames])
        return scans, sequence.poses[frames.start : frames.stop]
    except Exception as error:
        error.add_note(traceback.format_exc())  # a traceback does not travel
        return error
