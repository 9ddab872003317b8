"""Standard deviations of the estimated steps, fitted on validation drives."""

import numpy as np
import torch
from torch import Tensor, nn

from rcnn_odom.geometry import FloatArray, motion_errors, motions_of
from rcnn_odom.models.two_numbers import TURN_FRACTION, Apply, steps_of

WITHIN_DEVIATION = 0.6827
"""Fraction of a normal distribution within one standard deviation of its mean."""
LEAST_DEVIATION = 1e-6
"""Lower bound of the standard deviations, which are above 0 even if validation has no errors at all."""


class Uncertainty(nn.Module):
    """Standard deviations of distance and heading: non-negative weighted sums of difficulty features.

    The features are: 1; the absolute distance and turn of the step, divided by the standard deviations of the
    training motions; and for a recurrent network also the absolute difference between its estimate and that
    of its first stage, divided in the same way. The weights are fitted on validation drives and scaled so
    that 68.27 % of the errors lie within one standard deviation. This is the normalised nonconformity of
    Papadopoulos, Gammerman and Vovk, "Normalized nonconformity measures for regression conformal prediction",
    2008, except that the same drives are used for the fit and the scale.

    The two numbers do not describe sideways motion. Therefore the standard deviation across the direction of
    the step is the same for all steps.

    Args:
        recurrent: whether there is an estimate of a first stage.

    Attributes:
        weights: (2, K) weights of the features for distance (metres) and turn (radians); nan before
            :meth:`fit`.
        lateral: standard deviation across the step in metres; nan before :meth:`fit`.
    """

    weights: Tensor
    lateral: Tensor

    def __init__(self, recurrent: bool) -> None:
        super().__init__()
        self.register_buffer("weights", torch.full((2, 5 if recurrent else 3), torch.nan))
        self.register_buffer("lateral", torch.tensor(torch.nan))

    def features(self, motion: Tensor, deviation: Tensor, first_stage: Tensor | None) -> Tensor:
        """Difficulty features (..., K), none of them negative.

        Args:
            motion: (..., 2) estimated distance and turn in metres and radians.
            deviation: (2,) standard deviations of the training motions.
            first_stage: (..., 2) estimate of the first stage of a recurrent network; None without one.

        Example:
            >>> Uncertainty(recurrent=False).features(torch.tensor([2.0, -0.5]), torch.ones(2), None).tolist()
            [1.0, 2.0, 0.5]
        """
        parts = [torch.ones_like(motion[..., :1]), (motion / deviation).abs()]
        if first_stage is not None:
            parts.append(((motion - first_stage) / deviation).abs())
        return torch.cat(parts, -1)

    def fit(self, features: FloatArray, errors: FloatArray) -> None:
        """Fits ``weights`` and ``lateral`` to the errors on validation drives.

        Args:
            features: (N, K) of :meth:`features`.
            errors: (N, 3) of :func:`two_number_errors`.
        """
        from scipy.optimize import nnls  # its import takes a second, and only this method needs it

        errors = np.abs(errors)
        for output in range(2):
            weights, _ = nnls(features, errors[:, output])
            # At least a tenth of the mean error for every step, because no step is certain.
            weights[0] = max(weights[0], 0.1 * float(errors[:, output].mean()), LEAST_DEVIATION)
            scale = np.quantile(errors[:, output] / (features @ weights), WITHIN_DEVIATION)
            self.weights[output] = torch.from_numpy(max(scale, LEAST_DEVIATION) * weights)
        self.lateral.fill_(max(float(np.quantile(errors[:, 2], WITHIN_DEVIATION)), LEAST_DEVIATION))


def two_number_errors(motions: FloatArray, truth: FloatArray, apply: Apply) -> FloatArray:
    """Errors (N, 3) of motions (N, 2) against true steps (N, 3): of the distance, the heading and across.

    The error across the step is the distance in metres from the end of the true step to that of the
    estimated one, perpendicular to the estimated step and positive to the left.

    Example:
        >>> estimate, truth = np.array([[1.0, 0.0]]), np.array([[0.75, -0.25, 0.0]])
        >>> two_number_errors(estimate, truth, "middle")
        array([[0.25, 0.  , 0.25]])
    """
    error = steps_of(motions, apply) - truth
    direction = TURN_FRACTION[apply] * motions[:, 1]
    lateral = np.cos(direction) * error[:, 1] - np.sin(direction) * error[:, 0]
    return np.column_stack([motion_errors(motions, motions_of(truth)), lateral])
