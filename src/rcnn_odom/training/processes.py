"""Errors and signals of training in several processes, handled as in a single process."""

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

# It logs a warning for every process that it ends after another one has failed.
logging.getLogger("torch.multiprocessing").setLevel(logging.ERROR)


@contextmanager
def one_line_errors(trainer: L.Trainer) -> Iterator[None]:
    """Translates the errors of a Trainer that may work in other processes.

    Raises:
        InputError: a process has found a mistake of the user, or was killed.
        Stopped: the processes were stopped by a signal, and have saved a checkpoint.
        TimeUp: the processes have reached the time limit, and have saved a checkpoint.
    """
    with _pass_signals_on(trainer) as received:
        try:
            yield
        except ProcessRaisedException as error:
            raise _translate(error, received=bool(received)) from error
        except ProcessExitedException as error:
            if received:
                raise Stopped from error
            raise InputError(
                "a training process was killed, perhaps for lack of memory; the same command continues from "
                "the last checkpoint"
            ) from error
        except RuntimeError as error:
            raise cluster.translate_lost_process(error) from error


def _translate(error: ProcessRaisedException, *, received: bool) -> Exception:
    """The original error, from the traceback of another process."""
    for line in str(error).splitlines():
        kind, _, message = line.partition(":")
        if kind == f"{InputError.__module__}.{InputError.__name__}":
            return InputError(message.strip())
        if kind == OSError.__name__:
            return InputError(f"{message.strip()}; make room, then repeat the command")
        if received or kind == f"{Stopped.__module__}.{Stopped.__name__}":
            return Stopped()
        if kind == f"{TimeUp.__module__}.{TimeUp.__name__}":
            return TimeUp()
    return error


@contextmanager
def _pass_signals_on(trainer: L.Trainer) -> Iterator[list[int]]:
    """Passes signals on to the processes that train, so that they save and stop.

    Yields:
        The signals that were received.
    """
    received: list[int] = []
    if trainer.world_size == 1 or cluster.has_joined():
        yield received
        return

    def pass_on(number: int, frame: object) -> None:
        processes = multiprocessing.active_children()
        if received or not processes:
            raise KeyboardInterrupt
        received.append(number)
        for process in processes:
            process.terminate()

    before = {number: signal.signal(number, pass_on) for number in SIGNALS}
    try:
        yield received
    finally:
        for number, handler in before.items():
            signal.signal(number, handler)
