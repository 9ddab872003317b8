"""How far off an estimate may be: a standard deviation for each step, fitted on validation drives."""

import numpy as np
import torch
from torch import Tensor, nn

from rcnn_odom.geometry import FloatArray, motion_errors, motions_of
from rcnn_odom.models.two_numbers import TURN_FRACTION, Apply, steps_of

WITHIN = 0.6827
"""Share of a normal distribution within one standard deviation of its mean."""
LEAST = 1e-6
"""Deviations stay above 0 where validation has no errors at all."""


class Uncertainty(nn.Module):
    """Standard deviations of distance and heading: non-negative weighted sums of difficulty features.

    The features, in deviations of the training motions: 1; how long the step and how sharp the turn is; of a
    recurrent network, how far its estimate and that of its first stage are apart. The weights are fitted on
    validation drives and scaled until 68.27 % of their errors lie within one deviation: the normalised
    nonconformity of Papadopoulos, Gammerman and Vovk, "Normalized nonconformity measures for regression
    conformal prediction", 2008, but with one set of drives for the fit and the scale.

    Two numbers do not say how far a step goes sideways: its deviation across its own direction is one number
    for all steps.

    Attributes:
        weights: (2, K) metres and radians; nan before :meth:`fit`.
        lateral: metres; nan before :meth:`fit`.
    """

    weights: Tensor
    lateral: Tensor

    def __init__(self, recurrent: bool) -> None:
        super().__init__()
        self.register_buffer("weights", torch.full((2, 5 if recurrent else 3), torch.nan))
        self.register_buffer("lateral", torch.tensor(torch.nan))

    def features(self, motion: Tensor, deviation: Tensor, first_stage: Tensor | None) -> Tensor:
        """Difficulty features (..., K), each at least 0.

        Args:
            motion: (..., 2) estimated, metres and radians.
            deviation: (2,) of the training motions.
            first_stage: (..., 2) estimated by the first stage of a recurrent network.
        """
        parts = [torch.ones_like(motion[..., :1]), (motion / deviation).abs()]
        if first_stage is not None:
            parts.append(((motion - first_stage) / deviation).abs())
        return torch.cat(parts, -1)

    def fit(self, features: FloatArray, errors: FloatArray) -> None:
        """Fits to validation drives.

        Args:
            features: (N, K).
            errors: (N, 3) of :func:`two_number_errors`.
        """
        from scipy.optimize import nnls  # takes a second to import, and is needed here alone

        errors = np.abs(errors)
        for output in range(2):
            weights, _ = nnls(features, errors[:, output])
            # A constant of a tenth of the usual error: no step is certain.
            weights[0] = max(weights[0], 0.1 * float(errors[:, output].mean()), LEAST)
            scale = np.quantile(errors[:, output] / (features @ weights), WITHIN)
            self.weights[output] = torch.from_numpy(max(scale, LEAST) * weights)
        self.lateral.fill_(max(float(np.quantile(errors[:, 2], WITHIN)), LEAST))


def two_number_errors(motions: FloatArray, truth: FloatArray, apply: Apply) -> FloatArray:
    """Errors (N, 3) of motions (N, 2) against true steps (N, 3): distance, heading and across the step.

    The last, in metres, is how far the estimated step ends to the left of the true one, seen in its own
    direction.
    """
    missed = steps_of(motions, apply) - truth
    direction = TURN_FRACTION[apply] * motions[:, 1]
    lateral = np.cos(direction) * missed[:, 1] - np.sin(direction) * missed[:, 0]
    return np.column_stack([motion_errors(motions, motions_of(truth)), lateral])
