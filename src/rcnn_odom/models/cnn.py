"""The convolutional networks of the paper, and what all its networks share.

Encoder (paper table I), heads (paper III-C1), losses (eq. 3 and 4), and the step that is meant by the two
numbers that a head says, distance and heading change.
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
STRIDES = (1, 2, 1, 2, 1, 2)


class Estimate(NamedTuple):
    """What a head says: motions (..., 2) in metres and radians; class scores (..., C) or None.

    Of a recurrent network also the motions (..., 2) that its first stage estimates.
    """

    motion: Tensor
    scores: Tensor | None
    first_stage: Tensor | None = None


@dataclass(frozen=True)
class RotationClasses:
    """Equal heading classes around straight ahead (paper III-C: 112 of 0.1 degrees)."""

    count: int = option(above=0)
    width_deg: float = option(above=0)

    @property
    def width(self) -> float:
        """Width of a class in radians."""
        return math.radians(self.width_deg)

    def centres(self) -> Tensor:
        """(count,) headings in radians."""
        return (torch.arange(self.count, dtype=torch.float64) - (self.count - 1) / 2) * self.width

    def index(self, heading: Tensor) -> Tensor:
        """Class of headings in radians; those outside the range go to the outermost class."""
        return torch.floor(heading / self.width + self.count / 2).clamp(0, self.count - 1).long()

    def outside(self, heading: Tensor) -> Tensor:
        """How many headings lie outside the range: a scalar."""
        return (heading.abs() > self.count / 2 * self.width).sum()


@dataclass(kw_only=True)
class CNNOptions(Recipe):
    """What ``conf/model`` sets; the comments there say what each means."""

    kernel_size: int = option(fits=lambda size: size > 0 and size % 2 == 1, wanted="odd; the paper uses 3")
    pooling: str = option(choices=("avg", "max"))
    angle: str = option(choices=("expectation", "argmax"))
    rotation_classes: RotationClasses
    apply: str = option(choices=tuple(TURN_FRACTION))
    beta: float = option(above=0)
    per_sample_norm: bool
    dropout: float = option(least=0, below=1)


class Encoder(nn.Module):
    """Six convolutions over a pair of depth vectors (paper table I) with two poolings between them.

    ``Conv2d`` with a height of one instead of ``Conv1d``: only the former has fast channels-last
    kernels on the CPU. Padding keeps the length of stride-1 layers: 3,601 bins give 128 x 113 features.

    Args:
        sensor: whose depth vectors it is given; ranges are divided by its ``max_range``.
        kernel_size: odd; the paper chose 3 and tried 5 and 7.
        pooling: ``avg`` (the paper's choice) or ``max``.
        inputs: channels of an image; 2: the two scans.

    Attributes:
        channels: of the output.
        places: bins, with fractions, in whose middle each place of the output looks, (places,).
        features: channels times places.

    Raises:
        InputError: there are too few bins for six layers.
        ValueError: the kernel has no middle.
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
            raise ValueError(f"kernel_size must be odd, not {kernel_size}: padding could not keep the length")
        layers: list[nn.Module] = []
        length = sensor.bins
        first, spacing = 0.0, 1  # of the places, in bins
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
                f"data.sensor has {sensor.bins} bins, too few for the network; six layers leave none"
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
        # The motion shows in small differences between two scans: bf16 would round them away before the
        # first layer can take them.
        with torch.autocast(image.device.type, enabled=False):
            image = self.layers[0](image)
        if torch.is_autocast_enabled(image.device.type):
            # The next layer rounds anyway: before the ReLU instead of after it, the result is the same
            # and half as many bytes pass through memory.
            image = image.to(torch.get_autocast_dtype(image.device.type))
        convolved: Tensor = self.layers[1:](image)
        return convolved

    def lay_out(self, pairs: Tensor) -> Tensor:
        """Images (B, 2, 1, bins) whose two scans are innermost in memory: the channels-last layout."""
        return pairs.transpose(1, 2).contiguous().transpose(1, 2).unsqueeze(2)


class MotionHead(nn.Module):
    """Two fully connected layers, one for the distance and one for the rotation (paper III-C1).

    The linear layers give standardised values; mean and deviation of the training set's motions, kept
    as buffers, turn them into metres and radians. It is the paper's layer with its weights measured
    in units that suit the optimiser: radians a frame are otherwise a hundred times smaller than metres.

    Args:
        features: width of the input.
        classes: rotation as classification; None for regression.
        angle: class scores become an angle by ``expectation`` over the classes, or ``argmax``.
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
        """Estimates (..., 2) and scores (..., C) from features (..., features)."""
        # bf16 has three digits: too few for a distance that is added up over thousands of frames.
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
        """Motions (..., 2) in deviations from the training set's mean."""
        return (motion - self.mean) / self.deviation


class TwoNumberModel(TrainedModel):
    """A network that says distance and heading change: their loss, and the step that they mean.

    A subclass builds ``head`` and has :meth:`motions`. ``apply`` is where along its turn a step is taken.

    Attributes:
        classifies: the head's rotation is a classification.
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
        """Steps (B, T, 3), their covariances (B, T, 3, 3) and the state after them."""
        estimate, state = self.motions(pairs, state)
        distance, turn = estimate.motion.unbind(-1)
        direction = self.turn_fraction * turn
        steps = torch.stack([distance * direction.cos(), distance * direction.sin(), turn], -1)
        deviations = self._difficulty(estimate) @ self.uncertainty.weights.T
        return steps, self._covariances(distance, direction, deviations.square()), state

    def _covariances(self, distance: Tensor, direction: Tensor, variances: Tensor) -> Tensor:
        """J V J' (..., 3, 3), V the variances of the distance, across the step and of the turn.

        J are the derivatives of x, y and heading by these three. Written out, since a product of matrices
        would lose the heading's variance, which does not depend on it, where that across the step is nan.

        Args:
            distance: (...) metres.
            direction: (...) radians, of the step in the frame of the earlier scan.
            variances: (..., 2) of distance and turn.
        """
        along, turned = variances.unbind(-1)
        across = self.uncertainty.lateral.square()
        cos, sin = direction.cos(), direction.sin()
        x_by_turn, y_by_turn = -self.turn_fraction * distance * sin, self.turn_fraction * distance * cos
        xx = cos.square() * along + sin.square() * across + x_by_turn.square() * turned
        yy = sin.square() * along + cos.square() * across + y_by_turn.square() * turned
        xy = cos * sin * (along - across) + x_by_turn * y_by_turn * turned
        unknown = 0 * across  # nan where x and y are not known: then their covariances are not either
        xh, yh = x_by_turn * turned + unknown, y_by_turn * turned + unknown
        return torch.stack([xx, xy, xh, xy, yy, yh, xh, yh, turned], -1).unflatten(-1, (3, 3))

    def loss(self, batch: Batch) -> dict[str, Tensor]:
        """Eq. 3 or 4 of a batch of windows, its two parts, and how many headings no class covers."""
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
        # One bad window spoils the mean of all: the estimates tell which it is.
        diverged = ~estimate.motion.isfinite().flatten(1).all(1)
        return {"loss": loss.total, **parts, **outside, "diverged": diverged}

    def set_units(self, steps: FloatArray) -> None:
        """Gives the heads the mean and the deviation of the training motions, their units."""
        super().set_units(steps)
        motions = motions_of(steps)
        for head in (part for part in self.modules() if isinstance(part, MotionHead)):
            head.mean.copy_(torch.from_numpy(motions.mean(0)))
            head.deviation.copy_(torch.from_numpy(np.maximum(motions.std(0), 1e-6)))

    def calibrate(self, drives: Sequence[Drive]) -> None:
        """Fits the uncertainty as well."""
        super().calibrate(drives)
        features, motions = (np.concatenate(each) for each in zip(*map(self._study, drives), strict=True))
        truth = np.concatenate([drive.steps for drive in drives])
        self.uncertainty.fit(features, two_number_errors(motions, truth, self.options["apply"]))

    @property
    def calibrated(self) -> bool:
        """Also asks for the deviation across a step, which checkpoints of version 0.1 do not have."""
        return super().calibrated and bool(torch.isfinite(self.uncertainty.lateral))

    @torch.no_grad()
    def _study(self, drive: Drive) -> tuple[FloatArray, FloatArray]:
        """Difficulty features (N-1, K) and motions (N-1, 2) of a drive."""
        state: State = ()
        features, motions = [], []
        for pairs in chunks_of_pairs(torch.from_numpy(np.array(drive.scans))):
            estimate, state = self.motions(pairs.to(self.head.mean.device), state)
            features.append(self._difficulty(estimate)[0].double().cpu().numpy())
            motions.append(estimate.motion[0].double().cpu().numpy())
        return np.concatenate(features), np.concatenate(motions)

    def _difficulty(self, estimate: Estimate) -> Tensor:
        return self.uncertainty.features(estimate.motion, self.head.deviation, estimate.first_stage)


class ConvolutionalModel(TwoNumberModel):
    """Encoder and head: a motion from one pair of scans, no memory (paper III-C1)."""

    Options = CNNOptions

    def __init__(self, options: dict[str, Any], sensor: Sensor) -> None:
        super().__init__(options, sensor)
        self.encoder = Encoder(sensor, options["kernel_size"], options["pooling"])
        classes = self.classes if self.classifies else None
        self.head = MotionHead(self.encoder.features, classes, options["angle"])

    def motions(self, pairs: Tensor, state: State = ()) -> tuple[Estimate, State]:
        """Motions (B, T, 2) of pairs (B, T, 2, bins); dropout hides a part of the features from the head."""
        return self.head(F.dropout(self.encoder(pairs), self.options["dropout"], self.training)), ()


class CNNRegression(ConvolutionalModel):
    """Both outputs by eq. 3."""

    name, classifies = "cnn_reg", False


class CNNClassification(ConvolutionalModel):
    """Rotation by eq. 4: the first stage of both recurrent networks."""

    name, classifies = "cnn_cls", True
