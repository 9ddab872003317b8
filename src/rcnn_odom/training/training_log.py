"""What a training logs: a line and a point on every curve for each epoch."""

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

log = logging.getLogger(__name__)
# Lightning logs facts about the machine and advertises products; this project logs what a user needs.
for library in ("lightning.pytorch", "lightning.fabric"):
    logging.getLogger(library).setLevel(logging.WARNING)
    warnings.filterwarnings("ignore", module=library.replace(".", r"\."))

EVERY = 10
"""Steps from one point of a step's own curves to the next."""


class TrainingLog(Callback):
    """Logs losses, their means over an epoch, the learning rate, and a line for each epoch.

    A progress bar would leave no line behind. The means are this project's own because Lightning's
    forget the steps before a checkpoint: here an epoch that was interrupted has the same mean.

    Attributes:
        seconds: of training and validation up to the end of the last epoch, in all sittings.
    """

    def __init__(self) -> None:
        self.seconds = 0.0
        self._sums: dict[str, float] = {}
        self._windows = 0
        self._files: list[str] = []

    def __getstate__(self) -> dict[str, Any]:
        """Also tells a process that trains which files this one writes its messages to."""
        handlers = logging.getLogger().handlers
        files = [handler.baseFilename for handler in handlers if isinstance(handler, logging.FileHandler)]
        return self.__dict__ | {"_files": files}

    def setup(self, trainer: L.Trainer, pl_module: L.LightningModule, stage: str) -> None:
        """In a process that only trains, lets the first one speak."""
        if trainer.is_global_zero and not logging.getLogger().handlers:
            show_any_text()
            logging.basicConfig(level=logging.INFO, format="%(message)s", stream=sys.stdout)
            for file in self._files:
                logging.getLogger().addHandler(
                    logging.FileHandler(file, encoding="utf-8", errors="backslashreplace")
                )

    def on_train_start(self, trainer: L.Trainer, pl_module: L.LightningModule) -> None:
        """Starts the clock."""
        self._begun = time.monotonic() - self.seconds

    def on_train_epoch_start(self, trainer: L.Trainer, pl_module: L.LightningModule) -> None:
        """Begins the means; not called where an interrupted epoch goes on."""
        self._sums, self._windows = {}, 0

    def on_train_batch_start(
        self, trainer: L.Trainer, pl_module: L.LightningModule, batch: Any, batch_idx: int
    ) -> None:
        """Remembers the learning rate of the step, which moves on with it."""
        self._rate = trainer.optimizers[0].param_groups[0]["lr"]

    def on_train_batch_end(
        self, trainer: L.Trainer, pl_module: L.LightningModule, outputs: Any, batch: Any, batch_idx: int
    ) -> None:
        """Adds what ``training_step`` returns, scalars by name, to the means; logs every tenth step."""
        values = {name: float(value.detach()) for name, value in outputs.items()}
        windows = len(batch["steps"])
        self._windows += windows
        for name, value in values.items():
            self._sums[name] = self._sums.get(name, 0.0) + windows * value
        assert trainer.logger is not None
        if trainer.global_step % EVERY == 0:
            points = {f"train/{name}_step": value for name, value in values.items()}
            trainer.logger.log_metrics({"train/learning_rate": self._rate, **points}, trainer.global_step - 1)

    def on_train_epoch_end(self, trainer: L.Trainer, pl_module: L.LightningModule) -> None:
        """Called after the epoch's validation."""
        self.seconds = time.monotonic() - self._begun
        sums, windows = self._sums_of_all_processes(trainer)
        means = {name: total / windows for name, total in sums.items()}
        points = {f"train/{name}_epoch": mean for name, mean in means.items()}
        assert trainer.logger is not None
        trainer.logger.log_metrics({"epoch": trainer.current_epoch, **points}, trainer.global_step - 1)
        self._log_line(trainer, means["loss"])

    def _sums_of_all_processes(self, trainer: L.Trainer) -> tuple[dict[str, float], float]:
        """Sums and windows of the epoch so far."""
        names = sorted(self._sums)
        here = torch.tensor([*(self._sums[name] for name in names), self._windows], dtype=torch.float64)
        *sums, windows = trainer.strategy.reduce(
            here.to(trainer.strategy.root_device), reduce_op="sum"
        ).tolist()
        return dict(zip(names, sums, strict=True)), windows

    def _log_line(self, trainer: L.Trainer, loss: float) -> None:
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
        """Keeps the clock and the means so far."""
        sums, windows = self._sums_of_all_processes(trainer)
        seconds = time.monotonic() - self._begun
        checkpoint["training_log"] = {"seconds": seconds, "sums": sums, "windows": windows}

    def on_load_checkpoint(
        self, trainer: L.Trainer, pl_module: L.LightningModule, checkpoint: dict[str, Any]
    ) -> None:
        """Goes on from a checkpoint's; the sums of all processes are then one's."""
        kept = checkpoint["training_log"]
        self.seconds = kept["seconds"]
        self._sums = {name: total * trainer.is_global_zero for name, total in kept["sums"].items()}
        self._windows = kept["windows"] * trainer.is_global_zero
