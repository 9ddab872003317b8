"""What keeps a training safe: checkpoints that are whole or not there, saved often and before it stops."""

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

EVERY = 60.0
"""Seconds between checkpoints within an epoch; saving the largest network takes less than one."""
SIGNALS = (signal.SIGINT, signal.SIGTERM)
CONTINUE, SAVE, TIME_UP, STOP = 0, 1, 2, 3
"""What a process wants to happen after a step; the most that any of them wants is done."""
STDERR = 2


class Stopped(Exception):
    """Training was asked to stop, and has saved what it needs to go on."""


class TimeUp(Exception):
    """Training has had the time that it was given, and has saved what it needs to go on."""


class AtomicCheckpointIO(TorchCheckpointIO):
    """Checkpoints of numbers, written at once or not at all; Lightning's may end half-written on a disk."""

    def save_checkpoint(self, checkpoint: dict[str, Any], path: Any, storage_options: Any = None) -> None:
        """Called by the Trainer on the process that writes.

        Raises:
            InputError: it cannot be written; what was there before still is.
        """
        path = Path(path)
        try:
            write_atomically(path, partial(torch.save, checkpoint))
        except (OSError, RuntimeError) as error:  # torch's writer turns an OSError into the latter
            cause = error.__context__ if isinstance(error.__context__, OSError) else error
            reason = cause.strerror if isinstance(cause, OSError) else str(error).splitlines()[0]
            kept = "the one before is kept; " if path.exists() else ""
            raise InputError(
                f"{path}: checkpoint cannot be written ({reason}); {kept}make room there, and the same "
                "command goes on"
            ) from error


class Best(ModelCheckpoint):
    """The weights with the best validation drift.

    Args:
        path: of their checkpoint.
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
        """Goes on from a checkpoint's, wherever the run's folder now is; Lightning would forget the score."""
        before, now = str(state_dict["dirpath"]), str(self.dirpath)
        paths = ("best_model_path", "kth_best_model_path", "last_model_path")
        moved = {name: str(state_dict[name]).replace(before, now, 1) for name in paths}
        models = {path.replace(before, now, 1): score for path, score in state_dict["best_k_models"].items()}
        super().load_state_dict(state_dict | moved | {"dirpath": self.dirpath, "best_k_models": models})


class Saving(Callback):
    """Saves everything that a training needs to go on bit for bit, and stops it when it is asked to.

    Lightning's own timer would count the time of all sittings, and let a last validation in the middle of an
    epoch choose the best checkpoint.

    A checkpoint is written at the end of every epoch, every ``EVERY`` seconds within one, and at the first
    Ctrl-C or SIGTERM, which lets a step or a validation under way come to its end. A second one stops at
    once.

    Args:
        path: of the checkpoint.
        seconds: of training in this sitting, its validation included, after which it stops; a step is always
            done. None: never.

    Attributes:
        spent: seconds of them that are gone before training starts.
    """

    def __init__(self, path: Path, seconds: float | None = None) -> None:
        self.path, self.seconds, self.spent = path, seconds, 0.0
        self._asked_to_stop = False
        self._within_epoch = False
        self._last_saved = 0.0
        self._handlers: dict[signal.Signals, Any] = {}

    def on_train_start(self, trainer: L.Trainer, pl_module: L.LightningModule) -> None:
        """Listens to the signals from now on."""
        self._last_saved = self._started = time.monotonic()
        self._several = trainer.world_size > 1
        if threading.current_thread() is threading.main_thread():  # no other can
            self._handlers = {number: signal.signal(number, self._on_signal) for number in SIGNALS}

    def _on_signal(self, number: int, frame: object) -> None:
        starter = multiprocessing.parent_process() if self._several else None
        if number == signal.SIGINT and starter is not None and starter.pid == os.getppid():
            return  # Ctrl-C reaches all processes of a terminal; the one that started this one passes it on
        if self._asked_to_stop or not self._within_epoch:
            raise KeyboardInterrupt
        self._asked_to_stop = True
        # Not by logging, in the middle of which the signal may have come.
        with suppress(OSError):  # nobody may be there to read it
            os.write(STDERR, b"stopping as soon as this step or validation is done and saved\n")

    def on_train_batch_start(
        self, trainer: L.Trainer, pl_module: L.LightningModule, batch: Any, batch_idx: int
    ) -> None:
        """From here to the end of the epoch stopping has to wait for a moment that can be saved."""
        self._within_epoch = True

    def on_train_batch_end(
        self, trainer: L.Trainer, pl_module: L.LightningModule, outputs: Any, batch: Any, batch_idx: int
    ) -> None:
        """A moment that can be saved, except right before the validation, which belongs to the epoch."""
        if trainer.is_last_batch:
            return
        due = SAVE if time.monotonic() - self._last_saved > EVERY else CONTINUE
        wanted = self._agree(trainer, max(due, self._wish()))
        if wanted:
            self._save(trainer)
        _end(wanted)

    def _wish(self) -> int:
        """What this process wants after a step or an epoch."""
        if self._asked_to_stop:
            return STOP
        is_over = self.seconds is not None and time.monotonic() - self._started + self.spent > self.seconds
        return TIME_UP if is_over else CONTINUE

    def on_train_epoch_end(self, trainer: L.Trainer, pl_module: L.LightningModule) -> None:
        """Called after the validation."""
        self._save(trainer)
        self._within_epoch = False
        wanted = self._agree(trainer, self._wish())
        is_last = trainer.current_epoch + 1 == trainer.max_epochs
        _end(CONTINUE if is_last and wanted == TIME_UP else wanted)

    def _agree(self, trainer: L.Trainer, wanted: int) -> int:
        """The most that any of the processes wants, so that all do the same."""
        if trainer.world_size == 1:
            return wanted
        told = torch.tensor(wanted, device=trainer.strategy.root_device)
        return int(trainer.strategy.reduce(told, reduce_op="max"))

    def _save(self, trainer: L.Trainer) -> None:
        trainer.lightning_module.check_weights()  # type: ignore[operator]
        if trainer.is_global_zero:
            # What has been logged up to this step must not be lost either: it will not be logged again.
            assert isinstance(trainer.logger, TensorBoardLogger)
            trainer.logger.experiment.flush()
        trainer.save_checkpoint(self.path)
        self._last_saved = time.monotonic()

    def on_train_end(self, trainer: L.Trainer, pl_module: L.LightningModule, *_: BaseException) -> None:
        """Gives the signals back, also when training fails."""
        while self._handlers:
            signal.signal(*self._handlers.popitem())

    on_exception = on_train_end  # type: ignore[assignment]


def _end(wanted: int) -> None:
    """Ends a training that has been saved, if that is wanted."""
    if wanted >= TIME_UP:
        raise Stopped if wanted == STOP else TimeUp
