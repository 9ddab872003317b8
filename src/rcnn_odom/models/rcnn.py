"""The recurrent networks of the paper: a pre-trained CNN, then an LSTM (paper III-C2, fig. 2)."""

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
    """Of the classifying CNN that is trained first."""

    variant: str = option(choices=(CNNClassification.name,))


@dataclass(kw_only=True)
class RCNNOptions(CNNOptions):
    """What ``conf/model`` sets beside the CNN's options."""

    hidden_size: int = option(above=0)
    layers: int = option(above=0)
    projection: int | None = option(above=0)
    freeze: bool
    first_stage: FirstStageOptions


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

    def forward(self, inputs: Tensor, state: State = ()) -> tuple[Tensor, State]:
        """Outputs (B, T, hidden) of the last layer and the state after T steps.

        Args:
            inputs: (B, T, width).
            state: hidden and cell state, each (layers, B, hidden), as returned for the steps before; empty:
                zeros.
        """
        if not state:
            zeros = inputs.new_zeros(len(self.weight_ih), len(inputs), self.hidden, dtype=torch.float32)
            state = zeros, zeros
        after = []
        for layer, (h, c) in enumerate(zip(*state, strict=True)):
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
        return inputs, tuple(map(torch.stack, zip(*after, strict=True)))

    def initial_state(self) -> dict[str, Tensor]:
        """Zeros (layers, 1, hidden): the hidden and the cell state before the first step."""
        shape = len(self.weight_ih), 1, self.hidden
        return {"h": torch.zeros(shape), "c": torch.zeros(shape)}


class FirstStage(nn.Module):
    """The encoder of the CNN that is trained first, and its head.

    Args:
        options: of the recurrent network. sensor: its laser. classes: of the rotation.
    """

    def __init__(self, options: dict[str, Any], sensor: Sensor, classes: RotationClasses) -> None:
        super().__init__()
        self.encoder = Encoder(sensor, options["kernel_size"], options["pooling"])
        self.head = MotionHead(self.encoder.features, classes, options["angle"])
        self.requires_grad_(not options["freeze"])
        # The largest score has no gradient, and several processes cannot train a weight that gets none.
        self.head.rotation.requires_grad_(not (options["freeze"] or self.head.argmax))


class RecurrentModel(TwoNumberModel):
    """The first stage's features and own estimates go through an LSTM.

    With ``projection`` so many linear combinations of the features take their place, which is an input matrix
    of that rank. Dropout hides a part of each LSTM layer's outputs from what follows.
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
        # Drawn as if the two estimates were all the input: as two among thousands of features they would
        # hardly be heard, and the LSTM would have to find out again what the first stage knows.
        with torch.no_grad():
            self.lstm.weight_ih[0][:, -2:].uniform_(-(2**-0.5), 2**-0.5)
        self.head = MotionHead(hidden, self.classes if self.classifies else None, options["angle"])

    def motions(self, pairs: Tensor, state: State = ()) -> tuple[Estimate, State]:
        """Motions of T consecutive pairs (B, T, 2, bins) in metres, and the LSTM's state after them."""
        features = self.cnn.encoder(pairs)
        first_stage = self.cnn.head(features).motion
        first = self.cnn.head.standardise(first_stage)
        features = self.projection(features)
        outputs, state = self.lstm(torch.cat([features, first.to(features.dtype)], -1), state)
        return self.head(outputs)._replace(first_stage=first_stage), state

    def initial_state(self) -> dict[str, Tensor]:
        """Of the LSTM."""
        return self.lstm.initial_state()

    def take_first_stage(self, model: TrainedModel) -> None:
        """Takes encoder and head of a trained CNN.

        Raises:
            InputError: its network is another one.
        """
        assert isinstance(model, CNNClassification)
        for key in ("kernel_size", "pooling", "rotation_classes"):
            if model.options[key] != self.options[key]:
                raise InputError(
                    f"trained with {key}={model.options[key]}, but model.{key} is {self.options[key]}; "
                    "set it as in that training, or leave model.pretrained out"
                )
        self.cnn.encoder.load_state_dict(model.encoder.state_dict())
        self.cnn.head.load_state_dict(model.head.state_dict())
        if self.cnn.head.argmax and not self.options["freeze"]:
            log.info(
                "model.angle=argmax: the first stage's class scores are not trained any further, since the "
                "largest of them has no gradient"
            )


class RCNNRegression(RecurrentModel):
    """Eq. 3 after the LSTM: the paper's best."""

    name, classifies = "rcnn_reg", False


class RCNNClassification(RecurrentModel):
    """Eq. 4 after the LSTM."""

    name, classifies = "rcnn_cls", True
