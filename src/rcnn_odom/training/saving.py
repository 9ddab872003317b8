"""Saves checkpoints atomically, often, and before a training stops."""

import multiprocessing
import os
import signal
import threading
import time
from contextlib import suppress
from functools import partial
from pathlib import Path
from typing import Any

import lightning as L
import torch
from lightning.fabric.plugins.io import TorchCheckpointIO
from lightning.pytorch.callbacks import Callback, ModelCheckpoint
from lightning.pytorch.loggers import TensorBoardLogger

from rcnn_odom.errors import InputError
from rcnn_odom.files import write_atomically

SAVE_EVERY_SECONDS = 60.0
"""Seconds between checkpoints within an epoch; saving the largest network takes less than a second."""
SIGNALS = (signal.SIGINT, signal.SIGTERM)
CONTINUE, SAVE, TIME_UP, STOP = 0, 1, 2, 3
"""Requests of a process after a step. The largest request of all processes is carried out by all."""
STDERR = 2


class Stopped(Exception):
    """The training was stopped by a signal, and has saved a checkpoint to continue from."""


class TimeUp(Exception):
    """The training reached ``trainer.max_time``, and has saved a checkpoint to continue from."""


class AtomicCheckpointIO(TorchCheckpointIO):
    """Writes a checkpoint completely or not at all; Lightning's own can leave half a file."""

    def save_checkpoint(self, checkpoint: dict[str, Any], path: Any, storage_options: Any = None) -> None:
        """Called by the Trainer in the process that writes.

        Raises:
            InputError: the checkpoint cannot be written. An older one of that name is kept.
        """
        path = Path(path)
        try:
            write_atomically(path, partial(torch.save, checkpoint))
        except (OSError, RuntimeError) as error:  # torch's writer raises RuntimeError for an OSError
            cause = error.__context__ if isinstance(error.__context__, OSError) else error
            reason = cause.strerror if isinstance(cause, OSError) else str(error).splitlines()[0]
            kept = "the previous one is kept; " if path.exists() else ""
            raise InputError(
                f"{path}: checkpoint cannot be written ({reason}); {kept}make room there, and the same "
                "command continues"
            ) from error


class Best(ModelCheckpoint):
    """Saves the weights with the lowest validation drift.

    Args:
        path: path of the checkpoint.
    """

    def __init__(self, path: Path) -> None:
        super().__init__(
            path.parent,
            path.stem,
            monitor="val/drift",
            save_weights_only=True,
            enable_version_counter=False,
            save_on_train_epoch_end=False,
        )

    def load_state_dict(self, state_dict: dict[str, Any]) -> None:
        """Restores the state, also if the run's folder was moved; Lightning would lose the score then."""
        before, now = str(state_dict["dirpath"]), str(self.dirpath)
        paths = ("best_model_path", "kth_best_model_path", "last_model_path")
        moved = {name: str(state_dict[name]).replace(before, now, 1) for name in paths}
        models = {path.replace(before, now, 1): score for path, score in state_dict["best_k_models"].items()}
        super().load_state_dict(state_dict | moved | {"dirpath": self.dirpath, "best_k_models": models})


class Saving(Callback):
    """Saves all that a training needs to continue bit for bit; stops it on a signal or after a time limit.

    A checkpoint is written at the end of every epoch, every ``SAVE_EVERY_SECONDS`` within one, and at the
    first Ctrl-C or SIGTERM, after the present step or validation. A second signal stops at once.

    Lightning's Timer is not used: it adds up the time of all commands, and it validates when the time is
    over, so that weights from the middle of an epoch could become the best checkpoint.

    Args:
        path: path of the checkpoint.
        seconds: time limit of this command for training and validation; at least one step is done. None: no
            limit.

    Attributes:
        spent: seconds of the limit that were used before the training started.
    """

    def __init__(self, path: Path, seconds: float | None = None) -> None:
        self.path, self.seconds, self.spent = path, seconds, 0.0
        self._asked_to_stop = False
        self._within_epoch = False
        self._last_saved = 0.0
        self._handlers: dict[signal.Signals, Any] = {}

    def on_train_start(self, trainer: L.Trainer, pl_module: L.LightningModule) -> None:
        """Installs the signal handlers."""
        self._last_saved = self._started = time.monotonic()
        self._several = trainer.world_size > 1
        if threading.current_thread() is threading.main_thread():  # Python allows handlers only there.
            self._handlers = {number: signal.signal(number, self._on_signal) for number in SIGNALS}

    def _on_signal(self, number: int, frame: object) -> None:
        starter = multiprocessing.parent_process() if self._several else None
        if number == signal.SIGINT and starter is not None and starter.pid == os.getppid():
            return  # Ctrl-C reaches all processes of a terminal, and the parent process also passes it on.
        if self._asked_to_stop or not self._within_epoch:
            raise KeyboardInterrupt
        self._asked_to_stop = True
        # Logging cannot be used here: the signal may have interrupted it.
        with suppress(OSError):  # stderr may be closed.
            os.write(STDERR, b"stopping after this step or validation has been saved\n")

    def on_train_batch_start(
        self, trainer: L.Trainer, pl_module: L.LightningModule, batch: Any, batch_idx: int
    ) -> None:
        """From here to the end of the epoch, a signal stops the training only after a checkpoint."""
        self._within_epoch = True

    def on_train_batch_end(
        self, trainer: L.Trainer, pl_module: L.LightningModule, outputs: Any, batch: Any, batch_idx: int
    ) -> None:
        """Saves and stops if requested, but not between the last step of an epoch and its validation."""
        if trainer.is_last_batch:
            return
        due = SAVE if time.monotonic() - self._last_saved > SAVE_EVERY_SECONDS else CONTINUE
        request = self._agree(trainer, max(due, self._own_request()))
        if request:
            self._save(trainer)
        _stop_if_requested(request)

    def _own_request(self) -> int:
        """The request of this process after a step or an epoch."""
        if self._asked_to_stop:
            return STOP
        is_over = self.seconds is not None and time.monotonic() - self._started + self.spent > self.seconds
        return TIME_UP if is_over else CONTINUE

    def on_train_epoch_end(self, trainer: L.Trainer, pl_module: L.LightningModule) -> None:
        """Saves and stops if requested; called after the validation."""
        self._save(trainer)
        self._within_epoch = False
        request = self._agree(trainer, self._own_request())
        is_last = trainer.current_epoch + 1 == trainer.max_epochs
        _stop_if_requested(CONTINUE if is_last and request == TIME_UP else request)

    def _agree(self, trainer: L.Trainer, own_request: int) -> int:
        """The largest request of all processes, so that all do the same."""
        if trainer.world_size == 1:
            return own_request
        request = torch.tensor(own_request, device=trainer.strategy.root_device)
        return int(trainer.strategy.reduce(request, reduce_op="max"))

    def _save(self, trainer: L.Trainer) -> None:
        """Writes the checkpoint."""
        trainer.lightning_module.check_weights()  # type: ignore[operator]
        if trainer.is_global_zero:
            # A training that continues from this checkpoint will not log these points again.
            assert isinstance(trainer.logger, TensorBoardLogger)
            trainer.logger.experiment.flush()
        trainer.save_checkpoint(self.path)
        self._last_saved = time.monotonic()

    def on_train_end(self, trainer: L.Trainer, pl_module: L.LightningModule, *_: BaseException) -> None:
        """Restores the previous signal handlers, also if the training fails."""
        while self._handlers:
            signal.signal(*self._handlers.popitem())

    on_exception = on_train_end  # type: ignore[assignment]


def _stop_if_requested(request: int) -> None:
    """Ends a training that has been saved.

    Raises:
        Stopped: a signal has requested it.
        TimeUp: the time limit is over.
    """
    if request >= TIME_UP:
        raise Stopped if request == STOP else TimeUp
