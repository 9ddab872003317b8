"""What a model has to say for itself to be trained, exported and run on a robot."""

from abc import abstractmethod
from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from typing import Any, ClassVar

import numpy as np
import numpy.typing as npt
import torch
from torch import Tensor, nn

from rcnn_odom.geometry import FloatArray, Step, Steps
from rcnn_odom.models.contract import Description, Model, Stepper
from rcnn_odom.models.encoding import Sensor
from rcnn_odom.models.pairs import as_used
from rcnn_odom.options import option
from rcnn_odom.recordings.recording import Drive

CHUNK = 64
"""Pairs that go through a network together when a whole drive is estimated."""

Batch = dict[str, Tensor]
"""``pairs`` (B, T, 2, bins) of encoded scans and ``steps`` (B, T, 3), the true ones."""
State = tuple[Tensor, ...]
"""What a network carries from pair to pair, in the order of :meth:`TrainedModel.initial_state`."""


@dataclass(kw_only=True)
class Recipe:
    """Options that every training has; ``Options`` of a network begin with them.

    Attributes:
        epochs: through the training drives.
        learning_rate: the top of the one-cycle rate.
        window: consecutive pairs in a training window.
        batch_size: windows in a batch.
        stride: frames between the beginnings of training windows; None: as many as the window has pairs.
        repeat: how often each window comes in an epoch, each time augmented in another way.
        pretrained: checkpoint whose weights training begins with, of the same model or of its first stage;
            None: random weights, and a first stage that is found or trained.
        averaging: decay of the moving average of the weights over the steps, which is validated and kept in
            their place; 0: the weights themselves.
    """

    epochs: int = option(above=0)
    learning_rate: float = option(above=0)
    window: int = option(above=0)
    batch_size: int = option(above=0)
    stride: int | None = option(default=None, above=0)
    repeat: int = option(default=1, above=0)
    pretrained: str | None = None
    averaging: float = option(default=0.0, least=0, below=1)


def chunks_of_pairs(scans: Tensor) -> Iterator[Tensor]:
    """The consecutive pairs of scans (N, bins), (1, T, 2, bins) at a time."""
    for start in range(0, len(scans) - 1, CHUNK):
        block = scans[start : start + CHUNK + 1]
        yield torch.stack([block[:-1], block[1:]], dim=1)[None]


class TrainedModel(nn.Module, Model):
    """A network.

    A subclass has ``name``, ``Options``, :meth:`forward` and :meth:`loss`; everything else has a default that
    fits a network without state and without a fitted uncertainty. Weights and buffers are what a checkpoint
    keeps.

    Attributes:
        first_stage: name of a model that is trained before this one; its options are ``model.first_stage``.
            None: there is none.
        only_in_training: options beside the recipe's that do not change what trained weights compute, such as
            those of the loss: a checkpoint with other values of them can be fine-tuned.
        typical_step: (3,) root mean square of the training steps, metres and radians; not for
            :meth:`forward`, since fine-tuning changes it under the same weights.
        least_filled: share of bins with a return below which a scan is unlike any validation scan; nan
            before :meth:`calibrate`.
        period: usual seconds between validation scans; nan before :meth:`calibrate`.
    """

    trains: ClassVar[bool] = True
    first_stage: ClassVar[str | None] = None
    only_in_training: ClassVar[tuple[str, ...]] = ()
    typical_step: Tensor
    least_filled: Tensor
    period: Tensor

    def __init__(self, options: dict[str, Any], sensor: Sensor) -> None:
        super().__init__()
        self.options, self.sensor = options, sensor
        self.register_buffer("typical_step", torch.full((3,), torch.nan))
        self.register_buffer("least_filled", torch.tensor(torch.nan))
        self.register_buffer("period", torch.tensor(torch.nan))

    @abstractmethod
    def forward(self, pairs: Tensor, state: State = ()) -> tuple[Tensor, Tensor, State]:
        """Steps of consecutive pairs of scans.

        Args:
            pairs: (B, T, 2, bins) encoded scans, the earlier first.
            state: as returned for the pairs before; empty at the beginning.

        Returns:
            Steps (B, T, 3) in metres and radians, their covariances (B, T, 3, 3), nan where unknown, and the
            state after them.
        """

    @abstractmethod
    def loss(self, batch: Batch) -> dict[str, Tensor]:
        """What training makes small, ``loss``, and beside it scalars that are logged under their names.

        ``diverged`` (B,), of bool, may tell which windows are to blame for a loss that is not finite; it is
        not logged.
        """

    def initial_state(self) -> dict[str, Tensor]:
        """The state before the first pair for B = 1, by the names that it has in an exported file."""
        return {}

    def set_units(self, steps: FloatArray) -> None:
        """Told the training drives' steps (N, 3) before training, for the scales of inputs and outputs."""
        self.typical_step.copy_(torch.from_numpy(np.sqrt(np.square(steps).mean(0))))

    def take_weights(self, model: "TrainedModel") -> None:
        """Takes the weights of a trained network with the same options, to train them further.

        The scales that :meth:`set_units` had given that network come with its weights, which mean nothing in
        others; ``typical_step`` stays that of the new training drives.

        Raises:
            RuntimeError: the weights have other shapes or names.
        """
        typical_step = self.typical_step.clone()
        self.load_state_dict(model.state_dict())
        self.typical_step.copy_(typical_step)

    def take_first_stage(self, model: "TrainedModel") -> None:
        """Takes what it needs of its trained first stage.

        Raises:
            InputError: that was trained with other options than this model needs.
        """
        raise NotImplementedError

    def calibrate(self, drives: Sequence[Drive]) -> None:
        """Fits what is known of validation drives: how full and how frequent scans are.

        A subclass fits its covariances here too.
        """
        filled = np.concatenate([(np.array(drive.scans) > 0).mean(1) for drive in drives])
        # Half of the fifth percentile: one empty scan must not switch the note on few returns off.
        self.least_filled.fill_(0.5 * float(np.quantile(filled, 0.05)))
        period = float(np.median(np.concatenate([np.diff(drive.stamps) for drive in drives])))
        self.period.fill_(period if period > 0 else torch.nan)

    @property
    def calibrated(self) -> bool:
        """Whether :meth:`calibrate` has been called."""
        return bool(torch.isfinite(self.least_filled))

    def estimate(self, drive: Drive) -> Steps:
        """The steps of one whole drive; see :meth:`estimate_scans`."""
        device = next(self.parameters()).device
        return self.estimate_scans(torch.from_numpy(np.array(drive.scans)).to(device))

    @torch.no_grad()
    def estimate_scans(self, scans: Tensor) -> Steps:
        """The steps of encoded scans (N, bins), the state carried throughout.

        In full precision whatever the training's, so that a checkpoint gives the same numbers everywhere.
        """
        state: State = ()
        values: list[FloatArray] = []
        covariances: list[FloatArray] = []
        with torch.autocast(scans.device.type, enabled=False):
            for pairs in chunks_of_pairs(scans):
                steps, spread, state = self(pairs, state)
                values.append(steps[0].double().cpu().numpy())
                covariances.append(spread[0].double().cpu().numpy())
        return Steps(np.concatenate(values), np.concatenate(covariances))

    def describe(self) -> Description:
        """What an odometer has to know."""
        x, y, heading = self.typical_step.double().tolist()
        return Description(self.sensor, (x, y, heading), float(self.least_filled), float(self.period))

    def stepper(self) -> Stepper:
        """One pair after the other, computed by PyTorch; robots run the exported file, which is faster."""
        return as_used(TorchStepper(self))


class TorchStepper:
    """A network that is called as it is: the reference that an exported file is compared with."""

    def __init__(self, model: TrainedModel) -> None:
        self.model, self.description = model.eval(), model.describe()
        self.reset()

    def reset(self) -> None:
        """Forgets all earlier pairs."""
        self._state: State = ()
        self._before: State = ()

    def forget_last(self) -> None:
        """Forgets the last pair: the next one is compared in its place."""
        self._state = self._before

    @torch.no_grad()
    def __call__(self, pair: npt.NDArray[np.float32]) -> Step:
        """The step between two encoded scans (2, bins), the earlier first."""
        self._before = self._state
        pairs = torch.from_numpy(pair)[None, None].to(self.model.typical_step.device)
        steps, spread, self._state = self.model(pairs, self._state)
        x, y, heading = steps.flatten().double().tolist()
        return Step(x, y, heading, spread[0, 0].double().cpu().numpy())
