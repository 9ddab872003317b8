"""The networks as plain modules: convolutional encoder (paper table I), heads, recurrent network."""

import math
from dataclasses import dataclass
from typing import Literal, NamedTuple

import torch
from torch import Tensor, nn
from torch.nn import functional as F

from rcnn_odom.errors import InputError

CHANNELS = (32, 32, 64, 64, 128, 128)
STRIDES = (1, 2, 1, 2, 1, 2)

State = tuple[tuple[Tensor, Tensor], ...]
"""Hidden and cell state, each (B, hidden), of every LSTM layer."""


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

    count: int = 112
    width_deg: float = 0.1

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


class Encoder(nn.Module):
    """Six convolutions over a pair of depth vectors (paper table I) with two poolings between them.

    ``Conv2d`` with a height of one instead of ``Conv1d``: only the former has fast channels-last
    kernels on the CPU. Padding keeps the length of stride-1 layers: 3,601 bins give 128 x 113 features.

    Args:
        bins: length of a depth vector.
        kernel_size: odd; the paper chose 3 and tried 5 and 7.
        pooling: ``avg`` (the paper's choice) or ``max``.

    Raises:
        InputError: there are too few bins for six layers.
        ValueError: the kernel has no middle.
    """

    def __init__(self, bins: int, kernel_size: int = 3, pooling: Literal["avg", "max"] = "avg") -> None:
        super().__init__()
        if kernel_size % 2 == 0:
            raise ValueError(f"kernel_size must be odd, not {kernel_size}: padding could not keep the length")
        layers: list[nn.Module] = []
        length, inputs = bins, 2
        for number, (channels, stride) in enumerate(zip(CHANNELS, STRIDES, strict=True)):
            if number in (2, 4):
                pool = {"avg": nn.AvgPool2d, "max": nn.MaxPool2d}[pooling]
                layers.append(pool((1, 2)))
                length //= 2
            convolution = nn.Conv2d(
                inputs, channels, (1, kernel_size), stride=(1, stride), padding=(0, kernel_size // 2)
            )
            nn.init.kaiming_normal_(convolution.weight, nonlinearity="relu")
            nn.init.zeros_(convolution.bias)  # type: ignore[arg-type]
            layers += [convolution, nn.ReLU(inplace=True)]
            length, inputs = (length - 1) // stride + 1, channels
        if length < 1:
            raise InputError(f"data.sensor has {bins} bins, too few for the network; six layers leave none")
        self.layers = nn.Sequential(*layers)
        self.layers.to(memory_format=torch.channels_last)  # type: ignore[call-overload]
        self.features = inputs * length

    def forward(self, pairs: Tensor) -> Tensor:
        """Features (B, features) of pairs (B, 2, bins), earlier scan first, ranges within 0..1."""
        image = self.lay_out(pairs)
        # The motion shows in small differences between two scans: bf16 would round them away before the
        # first layer can take them.
        with torch.autocast(pairs.device.type, enabled=False):
            image = self.layers[0](image)
        if torch.is_autocast_enabled(pairs.device.type):
            # The next layer rounds anyway: before the ReLU instead of after it, the result is the same
            # and half as many bytes pass through memory.
            image = image.to(torch.get_autocast_dtype(pairs.device.type))
        return self.layers[1:](image).flatten(1)

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


class LSTM(nn.Module):
    """Stacked LSTM layers written out: one product for the inputs of all steps, then the recurrence.

    Equal to ``torch.nn.LSTM`` (batch first), whose CPU kernel repacks the weights at every call; but
    dropout falls on the outputs of the last layer as well.
    """

    def __init__(self, inputs: int, hidden: int, layers: int, dropout: float = 0.0) -> None:
        super().__init__()
        self.hidden, self.dropout = hidden, dropout
        widths = [inputs] + [hidden] * (layers - 1)
        self.weight_ih = nn.ParameterList([nn.Parameter(torch.empty(4 * hidden, width)) for width in widths])
        self.weight_hh = nn.ParameterList([nn.Parameter(torch.empty(4 * hidden, hidden)) for _ in widths])
        self.bias_ih = nn.ParameterList([nn.Parameter(torch.empty(4 * hidden)) for _ in widths])
        self.bias_hh = nn.ParameterList([nn.Parameter(torch.empty(4 * hidden)) for _ in widths])
        for parameter in self.parameters():
            nn.init.uniform_(parameter, -1 / math.sqrt(hidden), 1 / math.sqrt(hidden))

    def forward(self, inputs: Tensor, state: State | None = None) -> tuple[Tensor, State]:
        """Outputs (B, T, hidden) of the last layer and the state after T steps.

        Args:
            inputs: (B, T, width).
            state: as returned for the steps before; None starts from zeros.
        """
        if state is None:
            zero = inputs.new_zeros(len(inputs), self.hidden, dtype=torch.float32)
            state = ((zero, zero),) * len(self.weight_ih)
        after = []
        for layer, (h, c) in enumerate(state):
            bias = self.bias_ih[layer] + self.bias_hh[layer]
            # Time first: each step's gates are then one contiguous block.
            gates_in = F.linear(inputs.transpose(0, 1), self.weight_ih[layer], bias)
            outputs = []
            for step in gates_in.unbind(0):
                i, f, g, o = (step + F.linear(h, self.weight_hh[layer])).chunk(4, -1)
                c = torch.sigmoid(f) * c + torch.sigmoid(i) * torch.tanh(g)
                h = torch.sigmoid(o) * torch.tanh(c)
                outputs.append(h)
            inputs = F.dropout(torch.stack(outputs, 1), self.dropout, self.training)
            after.append((h, c))
        return inputs, tuple(after)


class CNN(nn.Module):
    """Encoder and head: a motion from one pair of scans, no memory (paper III-C1).

    Args:
        bins, max_range: the sensor's; ranges are divided by ``max_range`` (metres).
        classes: rotation as classification; None for regression.
        kernel_size, pooling: see :class:`Encoder`. angle: see :class:`MotionHead`.
        dropout: part of the features that training hides from the head.
    """

    def __init__(
        self,
        bins: int,
        max_range: float,
        classes: RotationClasses | None,
        kernel_size: int = 3,
        pooling: Literal["avg", "max"] = "avg",
        angle: Literal["expectation", "argmax"] = "expectation",
        dropout: float = 0.0,
    ) -> None:
        super().__init__()
        self.max_range, self.dropout = max_range, dropout
        self.encoder = Encoder(bins, kernel_size, pooling)
        self.head = MotionHead(self.encoder.features, classes, angle)

    def encode(self, pairs: Tensor) -> Tensor:
        """Features (B, T, features) of pairs of scans (B, T, 2, bins) in metres."""
        features = self.encoder((pairs / self.max_range).flatten(0, 1))
        return features.unflatten(0, pairs.shape[:2])

    def forward(self, pairs: Tensor, state: None = None) -> tuple[Estimate, None]:
        """Estimates for pairs (B, T, 2, bins) in metres; a CNN has no state."""
        return self.head(F.dropout(self.encode(pairs), self.dropout, self.training)), state


class RCNN(nn.Module):
    """A pre-trained CNN whose features and own estimates go through an LSTM (paper III-C2, fig. 2).

    Args:
        cnn: the first stage, with its head.
        classes: rotation of the final head as classification; None for regression.
        hidden, layers: of the LSTM (paper: 1,024 and 2). angle: see :class:`MotionHead`.
        dropout: part of each LSTM layer's outputs that training hides from what follows.
        projection: so many linear combinations of the features go into the LSTM in their place, which
            is an input matrix of that rank; None: the features themselves, as in the paper.
    """

    def __init__(
        self,
        cnn: CNN,
        classes: RotationClasses | None,
        hidden: int = 1024,
        layers: int = 2,
        angle: Literal["expectation", "argmax"] = "expectation",
        dropout: float = 0.0,
        projection: int | None = None,
    ) -> None:
        super().__init__()
        self.cnn = cnn
        features = cnn.encoder.features
        self.projection = nn.Linear(features, projection) if projection else nn.Identity()
        self.lstm = LSTM((projection or features) + 2, hidden, layers, dropout)
        # Drawn as if the two estimates were all the input: as two among thousands of features they would
        # hardly be heard, and the LSTM would have to find out again what the first stage knows.
        with torch.no_grad():
            self.lstm.weight_ih[0][:, -2:].uniform_(-(2**-0.5), 2**-0.5)
        self.head = MotionHead(hidden, classes, angle)

    def forward(self, pairs: Tensor, state: State | None = None) -> tuple[Estimate, State]:
        """Estimates for T consecutive pairs (B, T, 2, bins) in metres, and the state after them."""
        features = self.cnn.encode(pairs)
        first_stage = self.cnn.head(features).motion
        first = self.cnn.head.standardise(first_stage)
        features = self.projection(features)
        outputs, state = self.lstm(torch.cat([features, first.to(features.dtype)], -1), state)
        return self.head(outputs)._replace(first_stage=first_stage), state
