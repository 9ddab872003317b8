"""The moving average of the weights, which is validated and saved as the best checkpoint."""

from functools import partial

import lightning as L
from lightning.pytorch.callbacks import WeightAveraging
from torch import Tensor
from torch.optim.swa_utils import get_ema_multi_avg_fn


class Averaging(WeightAveraging):
    """Keeps an exponential moving average of the weights over the training steps, ``model.averaging``.

    Validation and the best checkpoint use the averaged weights, and the training steps the raw ones. The last
    checkpoint has both. Buffers (scales, units) are not averaged.

    This callback must come before the others, so that a step is part of the average before it is saved.

    Args:
        decay: factor of the previous average at each step, from 0 and below 1. It is smaller in the first
            steps, see :func:`decay_after`.
    """

    def __init__(self, decay: float) -> None:
        super().__init__(use_buffers=False, multi_avg_fn=partial(_update, decay))
        self._in_use = False

    def setup(self, trainer: L.Trainer, pl_module: L.LightningModule, stage: str) -> None:
        """Creates the average on the device of the training; the network is moved there later."""
        self._device = trainer.strategy.root_device
        super().setup(trainer, pl_module, stage)

    def on_validation_epoch_start(self, trainer: L.Trainer, pl_module: L.LightningModule) -> None:
        """Gives the network the averaged weights."""
        super().on_validation_epoch_start(trainer, pl_module)
        self._in_use = True

    def on_validation_epoch_end(self, trainer: L.Trainer, pl_module: L.LightningModule) -> None:
        """Keeps the averaged weights in the network.

        Lightning would restore the raw weights here, before the best checkpoint is saved. The checkpoint
        would then have other weights than those that were validated.
        """

    def on_train_epoch_end(self, trainer: L.Trainer, pl_module: L.LightningModule) -> None:
        """Gives the network its raw weights back, before the last checkpoint is saved."""
        if self._in_use:  # False in a process that had no drive to validate.
            self._swap_models(pl_module)
            self._in_use = False


def decay_after(steps: int, decay: float) -> float:
    """The decay of the average after a number of steps; small at first, to drop the random weights.

    >>> [round(decay_after(steps, 0.99), 2) for steps in (0, 10, 100, 1000)]
    [0.1, 0.55, 0.92, 0.99]
    """
    return min(decay, (1 + steps) / (10 + steps))


def _update(decay: float, averages: list[Tensor], weights: list[Tensor], steps: Tensor) -> None:
    """Updates the averages with the weights after a step, in place.

    Args:
        decay: decay after the first steps.
        averages, weights: average and weights of each parameter.
        steps: number of steps in the averages.
    """
    get_ema_multi_avg_fn(decay_after(int(steps), decay))(averages, weights, steps)
