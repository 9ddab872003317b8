"""A recurrent network that measures residual motions: an LSTM corrects the estimate of each comparison.

The first stage is :mod:`rcnn_odom.models.cnn_warp`. Its features, its residual motion and the standard
deviations of that are the input of LSTM layers, whose output corrects the motion and its information matrix
(paper III-C2, fig. 2).
"""

from dataclasses import dataclass
from typing import Any, ClassVar

import numpy as np
import torch
from torch import Tensor, nn

from rcnn_odom.errors import InputError
from rcnn_odom.geometry import advance, relative_step
from rcnn_odom.models.cnn import Encoder
from rcnn_odom.models.cnn_warp import (
    CHANNELS,
    CNNWarp,
    LocalConstraints,
    ResidualNetwork,
    WarpOptions,
    compare,
    find_scans_and_poses,
    invert,
    seeded_generator,
)
from rcnn_odom.models.encoding import Sensor
from rcnn_odom.models.rcnn import LSTM
from rcnn_odom.models.trained import Batch, State, TrainedModel
from rcnn_odom.options import option

ERROR_POWERS = (-3.0, -1.0)
"""In training, the errors of a window's earlier estimates are scaled by ten to a power between these."""


@dataclass(kw_only=True)
class FirstStageOptions(WarpOptions):
    """Options of the network that is trained first."""

    variant: str = option(choices=(CNNWarp.name,))


@dataclass(kw_only=True)
class RecurrentWarpOptions(WarpOptions):
    """The options of ``conf/model/rcnn_warp.yaml``, whose comments explain them."""

    hidden_size: int = option(above=0)
    layers: int = option(above=0)
    projection: int = option(above=0)
    dropout: float = option(least=0, below=1)
    freeze: bool
    first_stage: FirstStageOptions


class RCNNWarp(ResidualNetwork):
    """The first stage of the network, and an LSTM that corrects its residual motion."""

    name = "rcnn_warp"
    Options = RecurrentWarpOptions
    first_stage = CNNWarp.name
    only_in_training: ClassVar[tuple[str, ...]] = (*ResidualNetwork.only_in_training, "dropout", "freeze")

    def __init__(self, options: dict[str, Any], sensor: Sensor) -> None:
        super().__init__(options, sensor)
        self.encoder = Encoder(self.drawn, options["kernel_size"], options["pooling"], CHANNELS)
        self.constraints = LocalConstraints(
            self.encoder.channels, self.encoder.places, self.drawn, options["radians_a_metre"]
        )
        for part in (self.encoder, self.constraints):
            part.requires_grad_(not options["freeze"])
        self.projection = nn.Linear(self.encoder.features, options["projection"])
        self.lstm = LSTM(
            options["projection"] + 6, options["hidden_size"], options["layers"], options["dropout"]
        )
        self.correction = nn.Linear(options["hidden_size"], 6)
        # Before training, the correction is zero: the output equals that of the first stage.
        nn.init.zeros_(self.correction.weight)
        nn.init.zeros_(self.correction.bias)

    def measure(self, pairs: Tensor, state: State = ()) -> tuple[Tensor, Tensor, State]:
        """Motions (B, T, 3), their information matrices (B, T, 3, 3), in ``units``, and the LSTM's state."""
        flat = pairs.flatten(0, -3)
        features = self.encoder.convolve(compare(flat, self.drawn))
        motion, matrix = self.constraints(features, flat)
        deviations = invert(matrix).diagonal(dim1=-2, dim2=-1).sqrt()
        first = torch.cat([torch.asinh(motion / deviations), deviations.log()], -1)
        inputs = torch.cat([self.projection(features.flatten(1)).float(), first], -1)
        outputs, state = self.lstm(inputs.unflatten(0, pairs.shape[:-2]), state)
        with torch.autocast(pairs.device.type, enabled=False):
            shift, log_share = self.correction(outputs.float().flatten(0, 1)).chunk(2, -1)
        # Corrections are in units of the standard deviations, so that accurate measurements change little.
        motion = motion + shift * deviations
        share = (log_share / 2).exp()
        matrix = share.unsqueeze(-1) * matrix * share.unsqueeze(-2)
        return motion.unflatten(0, pairs.shape[:-2]), matrix.unflatten(0, pairs.shape[:-2]), state

    def initial_state(self) -> dict[str, Tensor]:
        """The LSTM's state before the first pair."""
        return self.lstm.initial_state()

    def take_first_stage(self, model: TrainedModel) -> None:
        """Copies the weights of encoder and constraints from a trained first stage.

        Raises:
            InputError: an option of its network differs from that of this model.
        """
        assert isinstance(model, CNNWarp)
        for key in ("kernel_size", "pooling", "resolution_deg", "radians_a_metre"):
            if model.options[key] != self.options[key]:
                raise InputError(
                    f"trained with {key}={model.options[key]}, but model.{key} is {self.options[key]}; "
                    f"set model.{key} as in that training, or do not set model.pretrained"
                )
        self.encoder.load_state_dict(model.encoder.state_dict())
        self.constraints.load_state_dict(model.head.state_dict())

    def loss(self, batch: Batch) -> dict[str, Tensor]:
        """The loss of all scans of the windows, see :meth:`compare_residuals`."""
        pairs, residuals = self.draw(batch)
        motion, matrix, _ = self.measure(pairs)
        outputs = self.compare_residuals(motion.flatten(0, 1), matrix.flatten(0, 1), residuals.flatten(0, 1))
        outputs["diverged"] = outputs["diverged"].unflatten(0, motion.shape[:2]).any(1)
        return outputs

    def draw(self, batch: Batch) -> tuple[Tensor, Tensor]:
        """Draws guesses for all scans of the windows as they occur in a stream.

        The guess of each scan is the last estimated pose, moved by the last estimated motion. Estimates have
        small random errors, and key scans change as in a stream.

        Returns:
            Rendered pairs (B, T, 2, rendered bins) and residual motions (B, T, 3) in metres and radians.
        """
        scans, poses = find_scans_and_poses(batch)
        rng = seeded_generator()
        count, steps = len(scans), scans.shape[1] - 1
        earlier, guesses, residuals = scans[:, :-1].copy(), *np.empty((2, count, steps, 3))
        spread = self.units.double().cpu().numpy()
        for n in range(count):
            errors = spread * 10 ** rng.uniform(*ERROR_POWERS) * rng.standard_normal((steps + 1, 3))
            key, estimate = 0, poses[n, 0]
            motion = relative_step(poses[n, 0], poses[n, 1]) + self.draw_residual(np.full(3, np.inf), rng)
            for t in range(1, steps + 1):
                guess = advance(estimate, motion)
                earlier[n, t - 1] = scans[n, key]
                guesses[n, t - 1] = relative_step(poses[n, key], guess)
                residuals[n, t - 1] = relative_step(guess, poses[n, t])
                before, estimate = estimate, advance(poses[n, t], errors[t])
                motion = relative_step(before, estimate)
                if self.warping.needs_key(relative_step(poses[n, key], estimate)):
                    key, estimate = t, poses[n, t]
        later = np.ascontiguousarray(scans[:, 1:])
        return self.draw_scans(earlier, later, guesses, residuals, rng, batch["pairs"].device)
