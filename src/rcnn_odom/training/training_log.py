"""Logs a training: a line for each epoch, and the curves in TensorBoard."""

import logging
import sys
import time
import warnings
from typing import Any

import lightning as L
import torch
from lightning.pytorch.callbacks import Callback

from rcnn_odom.evaluation.metrics import all_metrics
from rcnn_odom.terminal import show_any_text
from rcnn_odom.training.tensorboard import (
    EACH_EPOCH,
    EPOCH,
    EVERY_10_STEPS,
    LEARNING_RATE,
    training_tag,
    validation_scalars,
)

log = logging.getLogger(__name__)
# Lightning logs facts about the machine and advertisements, which users of this project do not need.
for library in ("lightning.pytorch", "lightning.fabric"):
    logging.getLogger(library).setLevel(logging.WARNING)
    warnings.filterwarnings("ignore", module=library.replace(".", r"\."))

LOGGED_STEPS = 10
"""Number of steps between two points of the curves of single steps."""


class TrainingLog(Callback):
    """Logs losses and their means over an epoch, the learning rate, validation scores, and a line per epoch.

    The lines stay in the log, which a progress bar does not. The means are not Lightning's, which lose the
    steps before a checkpoint: here an interrupted and resumed epoch has the same mean.

    Attributes:
        seconds: duration of training and validation up to the end of the last epoch; an interrupted training
            adds them up.
    """

    def __init__(self) -> None:
        self.seconds = 0.0
        self._sums: dict[str, float] = {}
        self._windows = 0
        self._log_files: list[str] = []

    def __getstate__(self) -> dict[str, Any]:
        """Adds the log files of this process, so that a process that trains writes to the same files."""
        handlers = logging.getLogger().handlers
        files = [handler.baseFilename for handler in handlers if isinstance(handler, logging.FileHandler)]
        return self.__dict__ | {"_log_files": files}

    def setup(self, trainer: L.Trainer, pl_module: L.LightningModule, stage: str) -> None:
        """Sets up logging in the first of the processes that were started for training."""
        if trainer.is_global_zero and not logging.getLogger().handlers:
            show_any_text()
            logging.basicConfig(level=logging.INFO, format="%(message)s", stream=sys.stdout)
            for file in self._log_files:
                logging.getLogger().addHandler(
                    logging.FileHandler(file, encoding="utf-8", errors="backslashreplace")
                )

    def on_train_start(self, trainer: L.Trainer, pl_module: L.LightningModule) -> None:
        """Starts to measure the time."""
        self._start = time.monotonic() - self.seconds

    def on_train_epoch_start(self, trainer: L.Trainer, pl_module: L.LightningModule) -> None:
        """Resets the means; Lightning does not call this when an interrupted epoch continues."""
        self._sums, self._windows = {}, 0

    def on_train_batch_start(
        self, trainer: L.Trainer, pl_module: L.LightningModule, batch: Any, batch_idx: int
    ) -> None:
        """Keeps the learning rate of this step, which the schedule changes after it."""
        self._rate = trainer.optimizers[0].param_groups[0]["lr"]

    def on_train_batch_end(
        self, trainer: L.Trainer, pl_module: L.LightningModule, outputs: Any, batch: Any, batch_idx: int
    ) -> None:
        """Adds the scalars of ``training_step`` to the means, and logs those of every tenth step."""
        values = {name: float(value.detach()) for name, value in outputs.items()}
        windows = len(batch["steps"])
        self._windows += windows
        for name, value in values.items():
            self._sums[name] = self._sums.get(name, 0.0) + windows * value
        assert trainer.logger is not None
        if trainer.global_step % LOGGED_STEPS == 0:
            points = {training_tag(EVERY_10_STEPS, name): value for name, value in values.items()}
            trainer.logger.log_metrics({LEARNING_RATE: self._rate, **points}, trainer.global_step - 1)

    def on_validation_end(self, trainer: L.Trainer, pl_module: L.LightningModule) -> None:
        """Adds the validation scores to their curves."""
        if trainer.logger is not None:
            values = {name: float(value) for name, value in trainer.callback_metrics.items()}
            trainer.logger.log_metrics(validation_scalars(values), trainer.global_step - 1)

    def on_train_epoch_end(self, trainer: L.Trainer, pl_module: L.LightningModule) -> None:
        """Logs the means of the epoch; called after its validation."""
        self.seconds = time.monotonic() - self._start
        sums, windows = self._sums_of_all_processes(trainer)
        means = {name: total / windows for name, total in sums.items()}
        points = {training_tag(EACH_EPOCH, name): mean for name, mean in means.items()}
        assert trainer.logger is not None
        trainer.logger.log_metrics({EPOCH: trainer.current_epoch, **points}, trainer.global_step - 1)
        self._log_line(trainer, means["loss"])

    def _sums_of_all_processes(self, trainer: L.Trainer) -> tuple[dict[str, float], float]:
        """Sums of the scalars by name, and the number of windows, of the epoch so far."""
        names = sorted(self._sums)
        own = torch.tensor([*(self._sums[name] for name in names), self._windows], dtype=torch.float64)
        *sums, windows = trainer.strategy.reduce(
            own.to(trainer.strategy.root_device), reduce_op="sum"
        ).tolist()
        return dict(zip(names, sums, strict=True)), windows

    def _log_line(self, trainer: L.Trainer, loss: float) -> None:
        """Logs the line of an epoch."""
        values = {name: float(value) for name, value in trainer.callback_metrics.items()}
        shown = ", ".join(
            f"{metric.title} {metric.show(values.get(f'val/{name}'))} {metric.unit}"
            for name, metric in all_metrics().items()
            if metric.in_training
        )
        worlds = trainer.datamodule.worlds  # type: ignore[attr-defined]
        waited = f"  waited {worlds.waited:.0f} s for new worlds" if worlds and worlds.waited > 0.5 else ""
        epoch = f"epoch {trainer.current_epoch + 1:2d}/{trainer.max_epochs}"
        log.info("%s  loss %.4f  validation: %s  %4.0f s%s", epoch, loss, shown, self.seconds, waited)

    def on_save_checkpoint(
        self, trainer: L.Trainer, pl_module: L.LightningModule, checkpoint: dict[str, Any]
    ) -> None:
        """Saves the time and the sums so far."""
        sums, windows = self._sums_of_all_processes(trainer)
        seconds = time.monotonic() - self._start
        checkpoint["training_log"] = {"seconds": seconds, "sums": sums, "windows": windows}

    def on_load_checkpoint(
        self, trainer: L.Trainer, pl_module: L.LightningModule, checkpoint: dict[str, Any]
    ) -> None:
        """Restores the time and the sums; the first process gets the sums of all processes."""
        saved = checkpoint["training_log"]
        self.seconds = saved["seconds"]
        self._sums = {name: total * trainer.is_global_zero for name, total in saved["sums"].items()}
        self._windows = saved["windows"] * trainer.is_global_zero
