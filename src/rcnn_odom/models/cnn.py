"""The convolutional networks of the paper, and the parts that all its networks share.

These are the encoder (paper table I), the heads (paper III-C1), the losses (eq. 3 and 4), and the conversion
of a head's two outputs, distance and heading change, into a step.
"""

import math
from abc import abstractmethod
from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any, ClassVar, Literal, NamedTuple

import numpy as np
import torch
from torch import Tensor, nn
from torch.nn import functional as F

from rcnn_odom.errors import InputError
from rcnn_odom.geometry import FloatArray, motions_of
from rcnn_odom.models.encoding import Sensor
from rcnn_odom.models.losses import classification_loss, regression_loss
from rcnn_odom.models.trained import Batch, Recipe, State, TrainedModel, chunks_of_pairs
from rcnn_odom.models.two_numbers import TURN_FRACTION
from rcnn_odom.models.uncertainty import Uncertainty, two_number_errors
from rcnn_odom.options import option
from rcnn_odom.recordings.recording import Drive

CHANNELS = (32, 32, 64, 64, 128, 128)
"""Output channels of the six convolutions."""
STRIDES = (1, 2, 1, 2, 1, 2)
"""Strides of the six convolutions."""


class Estimate(NamedTuple):
    """The output of a head.

    Attributes:
        motion: (..., 2) distance in metres and heading change in radians.
        scores: (..., C) class scores; None for regression.
        first_stage: (..., 2) motions that the first stage of a recurrent network estimates; None without one.
    """

    motion: Tensor
    scores: Tensor | None
    first_stage: Tensor | None = None


@dataclass(frozen=True)
class RotationClasses:
    """Heading classes of equal width around straight ahead (paper III-C: 112 classes of 0.1 degrees).

    Attributes:
        count: number of classes.
        width_deg: width of a class in degrees.

    Example:
        >>> classes = RotationClasses(count=2, width_deg=1.0)
        >>> classes.index(torch.deg2rad(torch.tensor([-0.5, 0.5, 9.0]))).tolist()
        [0, 1, 1]
    """

    count: int = option(above=0)
    width_deg: float = option(above=0)

    @property
    def width(self) -> float:
        """Width of a class in radians."""
        return math.radians(self.width_deg)

    def centres(self) -> Tensor:
        """Headings (count,) of the centres of the classes in radians."""
        return (torch.arange(self.count, dtype=torch.float64) - (self.count - 1) / 2) * self.width

    def index(self, heading: Tensor) -> Tensor:
        """Classes of headings in radians; headings outside the range belong to the outermost class."""
        return torch.floor(heading / self.width + self.count / 2).clamp(0, self.count - 1).long()

    def outside(self, heading: Tensor) -> Tensor:
        """Number of headings outside the range, a scalar."""
        return (heading.abs() > self.count / 2 * self.width).sum()


@dataclass(kw_only=True)
class CNNOptions(Recipe):
    """The options of ``conf/model/cnn_reg.yaml`` and ``cnn_cls.yaml``, whose comments explain them."""

    kernel_size: int = option(fits=lambda size: size > 0 and size % 2 == 1, wanted="odd; the paper uses 3")
    pooling: str = option(choices=("avg", "max"))
    angle: str = option(choices=("expectation", "argmax"))
    rotation_classes: RotationClasses
    apply: str = option(choices=tuple(TURN_FRACTION))
    beta: float = option(above=0)
    per_sample_norm: bool
    dropout: float = option(least=0, below=1)


class Encoder(nn.Module):
    """Six convolutions over a pair of depth vectors (paper table I), with two pooling layers between them.

    ``Conv2d`` with a height of one is used instead of ``Conv1d``, because only ``Conv2d`` has fast
    channels-last kernels on the CPU. Padding keeps the length in layers of stride 1: 3,601 bins give
    128 x 113 features.

    Args:
        sensor: defines the depth vectors; ranges are divided by its ``max_range``.
        kernel_size: an odd number; the paper chose 3 and also tried 5 and 7.
        pooling: ``avg`` (the paper's choice) or ``max``.
        inputs: number of input channels; 2 for the two scans.

    Attributes:
        channels: number of output channels.
        places: (places,) centre of each output position, in bins, with fractions.
        features: number of output values, channels times places.
        max_range: that of the sensor, in metres.

    Raises:
        InputError: the sensor has too few bins for six layers.
        ValueError: ``kernel_size`` is even.
    """

    def __init__(
        self,
        sensor: Sensor,
        kernel_size: int = 3,
        pooling: Literal["avg", "max"] = "avg",
        inputs: int = 2,
    ) -> None:
        super().__init__()
        if kernel_size % 2 == 0:
            raise ValueError(f"kernel_size must be odd, not {kernel_size}, so that padding keeps the length")
        layers: list[nn.Module] = []
        length = sensor.bins
        first, spacing = 0.0, 1  # centre of the first output position, and spacing of the positions, in bins
        for number, (channels, stride) in enumerate(zip(CHANNELS, STRIDES, strict=True)):
            if number in (2, 4):
                pool = {"avg": nn.AvgPool2d, "max": nn.MaxPool2d}[pooling]
                layers.append(pool((1, 2)))
                length //= 2
                first, spacing = first + spacing / 2, 2 * spacing
            convolution = nn.Conv2d(
                inputs, channels, (1, kernel_size), stride=(1, stride), padding=(0, kernel_size // 2)
            )
            nn.init.kaiming_normal_(convolution.weight, nonlinearity="relu")
            nn.init.zeros_(convolution.bias)  # type: ignore[arg-type]
            layers += [convolution, nn.ReLU(inplace=True)]
            length, inputs, spacing = (length - 1) // stride + 1, channels, spacing * stride
        if length < 1:
            raise InputError(
                f"data.sensor has {sensor.bins} bins, which are too few for the network's six layers"
            )
        self.layers = nn.Sequential(*layers)
        self.layers.to(memory_format=torch.channels_last)  # type: ignore[call-overload]
        self.max_range, self.channels = sensor.max_range, inputs
        self.places = first + spacing * np.arange(length, dtype=np.float64)
        self.features = inputs * length

    def forward(self, pairs: Tensor) -> Tensor:
        """Features (..., features) of pairs (..., 2, bins) in metres, the earlier scan first."""
        image = self.lay_out((pairs / self.max_range).flatten(0, -3))
        return self.convolve(image).flatten(1).unflatten(0, pairs.shape[:-2])

    def convolve(self, image: Tensor) -> Tensor:
        """Features (N, channels, 1, places) of images (N, inputs, 1, bins)."""
        # The motion appears as small differences between two scans, which bf16 would round to zero before
        # the first layer can compute them.
        with torch.autocast(image.device.type, enabled=False):
            image = self.layers[0](image)
        if torch.is_autocast_enabled(image.device.type):
            # The next layer rounds anyway. Rounding before the ReLU gives the same result and halves the
            # memory traffic.
            image = image.to(torch.get_autocast_dtype(image.device.type))
        convolved: Tensor = self.layers[1:](image)
        return convolved

    def lay_out(self, pairs: Tensor) -> Tensor:
        """Images (B, 2, 1, bins) of pairs (B, 2, bins), in channels-last memory layout."""
        return pairs.transpose(1, 2).contiguous().transpose(1, 2).unsqueeze(2)


class MotionHead(nn.Module):
    """Two fully connected layers, one for the distance and one for the rotation (paper III-C1).

    The layers give standardised values, which are converted into metres and radians with the mean and the
    standard deviation of the training motions (stored as buffers). This is equivalent to the paper's layers,
    but suits the optimiser better: radians per scan are about a hundred times smaller than metres per scan.

    Args:
        features: width of the input.
        classes: classes of the rotation; None for regression.
        angle: how class scores give an angle: ``expectation`` over the classes, or ``argmax``.

    Attributes:
        mean: (2,) mean of the training motions, in metres and radians.
        deviation: (2,) their standard deviation.
    """

    centres: Tensor | None
    mean: Tensor
    deviation: Tensor

    def __init__(
        self, features: int, classes: RotationClasses | None, angle: Literal["expectation", "argmax"]
    ) -> None:
        super().__init__()
        self.distance = nn.Linear(features, 1)
        self.rotation = nn.Linear(features, classes.count if classes else 1)
        self.argmax = {"argmax": True, "expectation": False}[angle]
        centres = classes.centres().float() if classes else None
        self.register_buffer("centres", centres, persistent=False)
        self.register_buffer("mean", torch.zeros(2))
        self.register_buffer("deviation", torch.ones(2))

    def forward(self, features: Tensor) -> Estimate:
        """Motions (..., 2) and class scores (..., C) of features (..., features)."""
        # bf16 has three digits, which are too few for distances that are summed over thousands of scans.
        with torch.autocast(features.device.type, enabled=False):
            features = features.float()
            distance = self.distance(features).squeeze(-1) * self.deviation[0] + self.mean[0]
            rotation = self.rotation(features)
            if self.centres is None:
                heading, scores = rotation.squeeze(-1) * self.deviation[1] + self.mean[1], None
            elif self.argmax:
                heading, scores = self.centres[rotation.argmax(-1)], rotation
            else:
                heading, scores = rotation.softmax(-1) @ self.centres, rotation
        return Estimate(torch.stack([distance, heading], -1), scores)

    def standardise(self, motion: Tensor) -> Tensor:
        """Motions (..., 2) minus the training set's mean, divided by its standard deviation."""
        return (motion - self.mean) / self.deviation


class TwoNumberModel(TrainedModel):
    """Base class of networks that estimate distance and heading change: their loss and their steps.

    A subclass builds ``head`` and defines :meth:`motions`. The option ``apply`` is the part of the turn after
    which the distance is driven (see :mod:`rcnn_odom.models.two_numbers`).

    Attributes:
        classifies: whether the rotation is estimated by classification.
        head: gives the motions.
        classes: heading classes.
        turn_fraction: part of the turn after which the distance is driven, from 0 to 1.
        uncertainty: standard deviations of the motions.
    """

    only_in_training: ClassVar[tuple[str, ...]] = ("beta", "per_sample_norm", "dropout")
    classifies: ClassVar[bool]
    head: MotionHead

    def __init__(self, options: dict[str, Any], sensor: Sensor) -> None:
        super().__init__(options, sensor)
        self.classes = RotationClasses(**options["rotation_classes"])
        self.turn_fraction = TURN_FRACTION[options["apply"]]
        self.uncertainty = Uncertainty(self.first_stage is not None)

    @abstractmethod
    def motions(self, pairs: Tensor, state: State = ()) -> tuple[Estimate, State]:
        """Motions (B, T, 2) of pairs of scans (B, T, 2, bins) in metres, and the state after them."""

    def forward(self, pairs: Tensor, state: State = ()) -> tuple[Tensor, Tensor, State]:
        """Steps (B, T, 3), their covariances (B, T, 3, 3) and the state after the last pair."""
        estimate, state = self.motions(pairs, state)
        distance, turn = estimate.motion.unbind(-1)
        direction = self.turn_fraction * turn
        steps = torch.stack([distance * direction.cos(), distance * direction.sin(), turn], -1)
        deviations = self._difficulty(estimate) @ self.uncertainty.weights.T
        return steps, self._covariances(distance, direction, deviations.square()), state

    def _covariances(self, distance: Tensor, direction: Tensor, variances: Tensor) -> Tensor:
        """The covariances J V J' (..., 3, 3) of steps.

        V is the diagonal matrix of the variances of the distance, across the step, and of the turn. J
        contains the derivatives of x, y and heading by these three. The products are computed element by
        element, because a matrix product would make the heading's variance nan if that across the step is
        nan, although it does not depend on it.

        Args:
            distance: (...) metres.
            direction: (...) direction of the step in the frame of the earlier scan, in radians.
            variances: (..., 2) of distance and turn.
        """
        along, turned = variances.unbind(-1)
        across = self.uncertainty.lateral.square()
        cos, sin = direction.cos(), direction.sin()
        x_by_turn, y_by_turn = -self.turn_fraction * distance * sin, self.turn_fraction * distance * cos
        xx = cos.square() * along + sin.square() * across + x_by_turn.square() * turned
        yy = sin.square() * along + cos.square() * across + y_by_turn.square() * turned
        xy = cos * sin * (along - across) + x_by_turn * y_by_turn * turned
        unknown = 0 * across  # nan if the variances of x and y are nan, so that their covariances are too
        xh, yh = x_by_turn * turned + unknown, y_by_turn * turned + unknown
        return torch.stack([xx, xy, xh, xy, yy, yh, xh, yh, turned], -1).unflatten(-1, (3, 3))

    def loss(self, batch: Batch) -> dict[str, Tensor]:
        """The loss of eq. 3 or 4, its two parts, and the fraction of headings outside all classes."""
        x, y, heading = batch["steps"].unbind(-1)
        truth = torch.stack([x * (heading / 2).cos() + y * (heading / 2).sin(), heading], -1)
        estimate, _ = self.motions(batch["pairs"])
        beta, per_sample = self.options["beta"], self.options["per_sample_norm"]
        outside = {}
        if estimate.scores is None:
            loss = regression_loss(estimate.motion, truth, beta, per_sample)
        else:
            classes = self.classes.index(heading)
            loss = classification_loss(estimate.motion, estimate.scores, truth, classes, beta, per_sample)
            outside = {"headings_outside_classes": self.classes.outside(heading) / heading.numel()}
        parts = {"loss_distance": loss.distance, "loss_rotation": loss.rotation}
        # One bad window makes the mean of all nan; the estimates show which window it is.
        diverged = ~estimate.motion.isfinite().flatten(1).all(1)
        return {"loss": loss.total, **parts, **outside, "diverged": diverged}

    def set_units(self, steps: Sequence[FloatArray]) -> None:
        """Also sets the mean and the standard deviation of the training motions in all heads."""
        super().set_units(steps)
        motions = motions_of(np.concatenate(steps))
        for head in (part for part in self.modules() if isinstance(part, MotionHead)):
            head.mean.copy_(torch.from_numpy(motions.mean(0)))
            head.deviation.copy_(torch.from_numpy(np.maximum(motions.std(0), 1e-6)))

    def calibrate(self, drives: Sequence[Drive]) -> None:
        """Also fits the uncertainty."""
        super().calibrate(drives)
        features, motions = (
            np.concatenate(each) for each in zip(*map(self._features_and_motions, drives), strict=True)
        )
        truth = np.concatenate([drive.steps for drive in drives])
        self.uncertainty.fit(features, two_number_errors(motions, truth, self.options["apply"]))

    @property
    def calibrated(self) -> bool:
        """Also requires the deviation across a step, which checkpoints of version 0.1 do not have."""
        return super().calibrated and bool(torch.isfinite(self.uncertainty.lateral))

    @torch.no_grad()
    def _features_and_motions(self, drive: Drive) -> tuple[FloatArray, FloatArray]:
        """Difficulty features (N-1, K) and motions (N-1, 2) of a drive."""
        state: State = ()
        features, motions = [], []
        for pairs in chunks_of_pairs(torch.from_numpy(np.array(drive.scans))):
            estimate, state = self.motions(pairs.to(self.head.mean.device), state)
            features.append(self._difficulty(estimate)[0].double().cpu().numpy())
            motions.append(estimate.motion[0].double().cpu().numpy())
        return np.concatenate(features), np.concatenate(motions)

    def _difficulty(self, estimate: Estimate) -> Tensor:
        """Difficulty features (..., K) of an estimate."""
        return self.uncertainty.features(estimate.motion, self.head.deviation, estimate.first_stage)


class ConvolutionalModel(TwoNumberModel):
    """Encoder and head, which estimate the motion from one pair of scans without a state (paper III-C1)."""

    Options = CNNOptions

    def __init__(self, options: dict[str, Any], sensor: Sensor) -> None:
        super().__init__(options, sensor)
        self.encoder = Encoder(sensor, options["kernel_size"], options["pooling"])
        classes = self.classes if self.classifies else None
        self.head = MotionHead(self.encoder.features, classes, options["angle"])

    def motions(self, pairs: Tensor, state: State = ()) -> tuple[Estimate, State]:
        """Motions (B, T, 2) of pairs (B, T, 2, bins) in metres; dropout applies to the features."""
        return self.head(F.dropout(self.encoder(pairs), self.options["dropout"], self.training)), ()


class CNNRegression(ConvolutionalModel):
    """Distance and rotation by regression, with the loss of eq. 3."""

    name, classifies = "cnn_reg", False


class CNNClassification(ConvolutionalModel):
    """Rotation by classification, with the loss of eq. 4; the first stage of both recurrent networks."""

    name, classifies = "cnn_cls", True
