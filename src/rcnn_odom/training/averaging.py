"""The moving average of a training's weights, which is what validates and is kept."""

from functools import partial

import lightning as L
from lightning.pytorch.callbacks import WeightAveraging
from torch import Tensor
from torch.optim.swa_utils import get_ema_multi_avg_fn


class Averaging(WeightAveraging):
    """Keeps an exponential moving average of the weights over the steps, ``model.averaging``.

    Validation and the best checkpoint have the averaged weights; training goes on with its own. A checkpoint
    to go on from has both. Buffers (scales, units) are the network's own, never averages.

    It comes before the other callbacks, so that a step is in the average before it is saved.

    Args:
        decay: what is left of the average before a step, from 0 and below 1; less in the first steps, see
            :func:`decay_after`.
    """

    def __init__(self, decay: float) -> None:
        super().__init__(use_buffers=False, multi_avg_fn=partial(_update, decay))
        self._in_use = False

    def setup(self, trainer: L.Trainer, pl_module: L.LightningModule, stage: str) -> None:
        """Makes the average where the network will be, which has not been moved to its device yet."""
        self._device = trainer.strategy.root_device
        super().setup(trainer, pl_module, stage)

    def on_validation_epoch_start(self, trainer: L.Trainer, pl_module: L.LightningModule) -> None:
        """Lets the network have the averaged weights."""
        super().on_validation_epoch_start(trainer, pl_module)
        self._in_use = True

    def on_validation_epoch_end(self, trainer: L.Trainer, pl_module: L.LightningModule) -> None:
        """Leaves the network the averaged weights.

        Lightning would take them away here, before the best checkpoint is saved, which so would have the
        weights that were not validated.
        """

    def on_train_epoch_end(self, trainer: L.Trainer, pl_module: L.LightningModule) -> None:
        """Gives the network its own weights back, before they are saved to go on from."""
        if self._in_use:  # a process that has no drive to validate has kept its own
            self._swap_models(pl_module)
            self._in_use = False


def decay_after(steps: int, decay: float) -> float:
    """The decay of the average after so many steps: less at first, so that random weights do not linger.

    >>> [round(decay_after(steps, 0.99), 2) for steps in (0, 10, 100, 1000)]
    [0.1, 0.55, 0.92, 0.99]
    """
    return min(decay, (1 + steps) / (10 + steps))


def _update(decay: float, averages: list[Tensor], weights: list[Tensor], steps: Tensor) -> None:
    """Takes the weights after a step into their averages, in place.

    Args:
        decay: once the first steps are over.
        averages, weights: of all parameters.
        steps: how many are in the averages.
    """
    get_ema_multi_avg_fn(decay_after(int(steps), decay))(averages, weights, steps)
