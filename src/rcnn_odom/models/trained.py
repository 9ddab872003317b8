"""The interface of a model that can be trained, exported and run on a robot."""

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
from rcnn_odom.models.pairs import wrap_for_stream
from rcnn_odom.options import option
from rcnn_odom.recordings.recording import Drive

CHUNK = 64
"""Number of pairs that a network processes together when a whole drive is estimated."""

Batch = dict[str, Tensor]
"""``pairs`` (B, T, 2, bins) of encoded scans, in metres, and the true ``steps`` (B, T, 3)."""
State = tuple[Tensor, ...]
"""The state of a recurrent network between pairs, in the order of :meth:`TrainedModel.initial_state`."""


@dataclass(kw_only=True)
class Recipe:
    """Options of every training; the ``Options`` of a network are a subclass.

    Attributes:
        epochs: number of passes through the training drives.
        learning_rate: maximum of the one-cycle learning rate.
        window: number of consecutive pairs in a training window.
        batch_size: number of windows in a batch.
        stride: number of scans between the beginnings of training windows; None: as many as ``window``.
        repeat: how often each window occurs in an epoch, each time with another augmentation.
        pretrained: checkpoint of the same model or of its first stage, whose weights training begins with;
            None: random weights, and a first stage that is found among earlier trainings or trained.
        averaging: decay per step of the moving average of the weights, which is validated and saved instead
            of the weights themselves; 0: no average.
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
    """Yields the consecutive pairs of scans (N, bins) in chunks (1, T, 2, bins) of at most ``CHUNK`` pairs.

    Example:
        >>> [tuple(pairs.shape) for pairs in chunks_of_pairs(torch.zeros(100, 5))]
        [(1, 64, 2, 5), (1, 35, 2, 5)]
    """
    for start in range(0, len(scans) - 1, CHUNK):
        block = scans[start : start + CHUNK + 1]
        yield torch.stack([block[:-1], block[1:]], dim=1)[None]


class TrainedModel(nn.Module, Model):
    """Base class of all networks.

    A subclass defines ``name``, ``Options``, :meth:`forward` and :meth:`loss`. The defaults of everything
    else suit a network without state and without a fitted uncertainty. A checkpoint contains the weights and
    the buffers.

    Attributes:
        first_stage: name of a model that is trained before this one, with the options ``model.first_stage``;
            None without a first stage.
        only_in_training: options, in addition to those of :class:`Recipe`, that do not change what trained
            weights compute, such as those of the loss. A checkpoint can be fine-tuned with other values of
            them.
        typical_step: (3,) root mean square of the training steps, in metres and radians. :meth:`forward` must
            not use it, because fine-tuning changes it for the same weights.
        least_filled: fraction of bins with a return; scans with fewer returns are unlike all validation
            scans. nan before :meth:`calibrate`.
        period: median time in seconds between validation scans; nan before :meth:`calibrate`.
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
            state after the last pair.
        """

    @abstractmethod
    def loss(self, batch: Batch) -> dict[str, Tensor]:
        """The training loss of a batch.

        Returns:
            ``loss``, the scalar that is minimised, and other scalars, which are logged under their names.
            Optionally ``diverged`` (B,), bool, which marks the windows that cause a loss that is not finite;
            it is not logged.
        """

    def initial_state(self) -> dict[str, Tensor]:
        """The state before the first pair for B = 1; the keys are its names in an exported file."""
        return {}

    def set_units(self, steps: Sequence[FloatArray]) -> None:
        """Sets the scales of inputs and outputs from the steps (N, 3) of each training drive.

        It is called once before training.
        """
        self.typical_step.copy_(torch.from_numpy(np.sqrt(np.square(np.concatenate(steps)).mean(0))))

    def take_weights(self, model: "TrainedModel") -> None:
        """Copies the weights of a trained network with the same options, for fine-tuning.

        The scales of :meth:`set_units` are copied as well, because the weights are only valid with them. Only
        ``typical_step`` remains that of the new training drives.

        Raises:
            RuntimeError: the weights have other shapes or names.
        """
        typical_step = self.typical_step.clone()
        self.load_state_dict(model.state_dict())
        self.typical_step.copy_(typical_step)

    def take_first_stage(self, model: "TrainedModel") -> None:
        """Copies weights from a trained first stage.

        Raises:
            InputError: the options of the first stage do not suit this model.
        """
        raise NotImplementedError

    def calibrate(self, drives: Sequence[Drive]) -> None:
        """Fits ``least_filled`` and ``period`` to validation drives; a subclass also fits its covariances."""
        filled = np.concatenate([(np.array(drive.scans) > 0).mean(1) for drive in drives])
        # A percentile, because with the minimum, one empty scan would disable the note on few returns.
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
        """The steps of encoded scans (N, bins); the state is carried through the whole drive.

        The computation is in full precision, so that a checkpoint gives the same results everywhere.
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
        """The description of the network that an odometer needs."""
        x, y, heading = self.typical_step.double().tolist()
        return Description(self.sensor, (x, y, heading), float(self.least_filled), float(self.period))

    def stepper(self) -> Stepper:
        """The network in a stream, computed by PyTorch; robots use the exported file, which is faster."""
        return wrap_for_stream(TorchStepper(self))


class TorchStepper:
    """Runs a network on one pair after the other with PyTorch; exported files are compared with it.

    Args:
        model: the network.
    """

    def __init__(self, model: TrainedModel) -> None:
        self.model, self.description = model.eval(), model.describe()
        self.reset()

    def reset(self) -> None:
        """Forgets all earlier pairs."""
        self._state: State = ()
        self._before: State = ()

    def forget_last(self) -> None:
        """Restores the state before the last pair, which the next pair replaces."""
        self._state = self._before

    @torch.no_grad()
    def __call__(self, pair: npt.NDArray[np.float32]) -> Step:
        """The step between two encoded scans (2, bins), the earlier first."""
        self._before = self._state
        pairs = torch.from_numpy(pair)[None, None].to(self.model.typical_step.device)
        steps, spread, self._state = self.model(pairs, self._state)
        x, y, heading = steps.flatten().double().tolist()
        return Step(x, y, heading, spread[0, 0].double().cpu().numpy())
