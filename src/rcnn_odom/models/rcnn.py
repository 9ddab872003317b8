"""The recurrent networks of the paper: a pre-trained CNN followed by an LSTM (paper III-C2, fig. 2)."""

import logging
import math
from dataclasses import dataclass
from typing import Any, ClassVar

import torch
from torch import Tensor, nn
from torch.nn import functional as F

from rcnn_odom.errors import InputError
from rcnn_odom.models.cnn import (
    CNNClassification,
    CNNOptions,
    Encoder,
    Estimate,
    MotionHead,
    RotationClasses,
    TwoNumberModel,
)
from rcnn_odom.models.encoding import Sensor
from rcnn_odom.models.trained import State, TrainedModel
from rcnn_odom.options import option

log = logging.getLogger(__name__)


@dataclass(kw_only=True)
class FirstStageOptions(CNNOptions):
    """Options of the classification CNN that is trained first."""

    variant: str = option(choices=(CNNClassification.name,))


@dataclass(kw_only=True)
class RCNNOptions(CNNOptions):
    """The options of ``conf/model/rcnn_reg.yaml`` and ``rcnn_cls.yaml``, whose comments explain them."""

    hidden_size: int = option(above=0)
    layers: int = option(above=0)
    projection: int | None = option(above=0)
    freeze: bool
    first_stage: FirstStageOptions


class LSTM(nn.Module):
    """Stacked LSTM layers: one matrix product for the inputs of all steps, then the recurrence.

    The results equal those of ``torch.nn.LSTM`` (batch first), whose CPU kernel is slower because it repacks
    the weights at every call. Unlike there, dropout also applies to the outputs of the last layer.

    Args:
        inputs: width of the input.
        hidden: width of each layer.
        layers: number of layers.
        dropout: probability that an output is set to zero in training.

    Example:
        >>> outputs, (h, c) = LSTM(inputs=3, hidden=4, layers=2)(torch.zeros(1, 5, 3))
        >>> tuple(outputs.shape), tuple(h.shape)
        ((1, 5, 4), (2, 1, 4))
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

    def forward(self, inputs: Tensor, state: State = ()) -> tuple[Tensor, State]:
        """Outputs (B, T, hidden) of the last layer and the state after T steps.

        Args:
            inputs: (B, T, width).
            state: hidden and cell state, each (layers, B, hidden), as returned for the steps before; if
                empty, zeros are used.
        """
        if not state:
            zeros = inputs.new_zeros(len(self.weight_ih), len(inputs), self.hidden, dtype=torch.float32)
            state = zeros, zeros
        after = []
        for layer, (h, c) in enumerate(zip(*state, strict=True)):
            bias = self.bias_ih[layer] + self.bias_hh[layer]
            # Time is the first dimension, so that each step's gates are one contiguous block.
            gates_in = F.linear(inputs.transpose(0, 1), self.weight_ih[layer], bias)
            outputs = []
            for step in gates_in.unbind(0):
                i, f, g, o = (step + F.linear(h, self.weight_hh[layer])).chunk(4, -1)
                c = torch.sigmoid(f) * c + torch.sigmoid(i) * torch.tanh(g)
                h = torch.sigmoid(o) * torch.tanh(c)
                outputs.append(h)
            inputs = F.dropout(torch.stack(outputs, 1), self.dropout, self.training)
            after.append((h, c))
        return inputs, tuple(map(torch.stack, zip(*after, strict=True)))

    def initial_state(self) -> dict[str, Tensor]:
        """Zeros (layers, 1, hidden): the hidden and the cell state before the first step."""
        shape = len(self.weight_ih), 1, self.hidden
        return {"h": torch.zeros(shape), "c": torch.zeros(shape)}


class FirstStage(nn.Module):
    """The encoder and the head of the CNN that is trained first.

    Args:
        options: those of the recurrent network.
        sensor: defines the depth vectors.
        classes: classes of the rotation.
    """

    def __init__(self, options: dict[str, Any], sensor: Sensor, classes: RotationClasses) -> None:
        super().__init__()
        self.encoder = Encoder(sensor, options["kernel_size"], options["pooling"])
        self.head = MotionHead(self.encoder.features, classes, options["angle"])
        self.requires_grad_(not options["freeze"])
        # argmax has no gradient, and training on several processes fails for weights without a gradient.
        self.head.rotation.requires_grad_(not (options["freeze"] or self.head.argmax))


class RecurrentModel(TwoNumberModel):
    """The first stage, whose features and estimates are the input of an LSTM, and a head.

    With the option ``projection``, the features are replaced by that number of linear combinations, which
    limits the rank of the LSTM's input matrix. Dropout applies to the outputs of each LSTM layer.
    """

    Options = RCNNOptions
    first_stage = CNNClassification.name
    only_in_training: ClassVar[tuple[str, ...]] = (*TwoNumberModel.only_in_training, "freeze")

    def __init__(self, options: dict[str, Any], sensor: Sensor) -> None:
        super().__init__(options, sensor)
        self.cnn = FirstStage(options, sensor, self.classes)
        features, width = self.cnn.encoder.features, options["projection"]
        self.projection = nn.Linear(features, width) if width else nn.Identity()
        hidden = options["hidden_size"]
        self.lstm = LSTM((width or features) + 2, hidden, options["layers"], options["dropout"])
        # Larger initial weights for the first stage's two estimates, as if they were the only input.
        # Otherwise thousands of features would outweigh them, and the LSTM would have to learn the motion
        # again.
        with torch.no_grad():
            self.lstm.weight_ih[0][:, -2:].uniform_(-(2**-0.5), 2**-0.5)
        self.head = MotionHead(hidden, self.classes if self.classifies else None, options["angle"])

    def motions(self, pairs: Tensor, state: State = ()) -> tuple[Estimate, State]:
        """Motions (B, T, 2) of consecutive pairs (B, T, 2, bins) in metres, and the LSTM's new state."""
        features = self.cnn.encoder(pairs)
        first_stage = self.cnn.head(features).motion
        first = self.cnn.head.standardise(first_stage)
        features = self.projection(features)
        outputs, state = self.lstm(torch.cat([features, first.to(features.dtype)], -1), state)
        return self.head(outputs)._replace(first_stage=first_stage), state

    def initial_state(self) -> dict[str, Tensor]:
        """The LSTM's state before the first pair."""
        return self.lstm.initial_state()

    def take_first_stage(self, model: TrainedModel) -> None:
        """Copies the weights of encoder and head from a trained CNN.

        Raises:
            InputError: an option of its network differs from that of this model.
        """
        assert isinstance(model, CNNClassification)
        for key in ("kernel_size", "pooling", "rotation_classes"):
            if model.options[key] != self.options[key]:
                raise InputError(
                    f"trained with {key}={model.options[key]}, but model.{key} is {self.options[key]}; "
                    f"set model.{key} as in that training, or do not set model.pretrained"
                )
        self.cnn.encoder.load_state_dict(model.encoder.state_dict())
        self.cnn.head.load_state_dict(model.head.state_dict())
        if self.cnn.head.argmax and not self.options["freeze"]:
            log.info(
                "model.angle=argmax: the layer of the first stage that gives the class scores is not trained "
                "any further, because argmax has no gradient"
            )


class RCNNRegression(RecurrentModel):
    """Regression after the LSTM, with the loss of eq. 3; the paper's best network."""

    name, classifies = "rcnn_reg", False


class RCNNClassification(RecurrentModel):
    """Classification of the rotation after the LSTM, with the loss of eq. 4."""

    name, classifies = "rcnn_cls", True
