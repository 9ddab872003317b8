"""Training in several processes: their errors and signals, as if there were one."""

import logging
import multiprocessing
import signal
from collections.abc import Iterator
from contextlib import contextmanager

import lightning as L
from torch.multiprocessing import ProcessExitedException, ProcessRaisedException

from rcnn_odom.errors import InputError
from rcnn_odom.training import cluster
from rcnn_odom.training.saving import SIGNALS, Stopped, TimeUp

# It warns of every process that it ends because another one has failed.
logging.getLogger("torch.multiprocessing").setLevel(logging.ERROR)


@contextmanager
def one_line_errors(trainer: L.Trainer) -> Iterator[None]:
    """Around a trainer's work, which it may do in other processes.

    Raises:
        InputError: one of them met a mistake of the user, or was killed.
        Stopped: they were asked to stop, and have saved.
        TimeUp: they have had their time, and have saved.
    """
    with _signals_passed_on(trainer) as asked:
        try:
            yield
        except ProcessRaisedException as error:
            raise _translate(error, asked=bool(asked)) from error
        except ProcessExitedException as error:
            if asked:
                raise Stopped from error
            raise InputError(
                "a training process was killed, perhaps for want of memory; the same command goes on from "
                "the last checkpoint"
            ) from error
        except RuntimeError as error:
            raise cluster.lost(error) from error


def _translate(error: ProcessRaisedException, *, asked: bool) -> Exception:
    """The error behind the traceback of another process, which is all that comes from there."""
    for line in str(error).splitlines():
        kind, _, message = line.partition(":")
        if kind == f"{InputError.__module__}.{InputError.__name__}":
            return InputError(message.strip())
        if kind == OSError.__name__:
            return InputError(f"{message.strip()}; make room, and the same command goes on")
        if asked or kind == f"{Stopped.__module__}.{Stopped.__name__}":
            return Stopped()
        if kind == f"{TimeUp.__module__}.{TimeUp.__name__}":
            return TimeUp()
    return error


@contextmanager
def _signals_passed_on(trainer: L.Trainer) -> Iterator[list[int]]:
    """Lets the processes that train save and stop, instead of ending the one that waits for them.

    Yields:
        The signals that have come.
    """
    asked: list[int] = []
    if trainer.world_size == 1 or cluster.has_joined():
        yield asked
        return

    def pass_on(number: int, frame: object) -> None:
        processes = multiprocessing.active_children()
        if asked or not processes:
            raise KeyboardInterrupt
        asked.append(number)
        for process in processes:
            process.terminate()

    before = {number: signal.signal(number, pass_on) for number in SIGNALS}
    try:
        yield asked
    finally:
        for number, handler in before.items():
            signal.signal(number, handler)
