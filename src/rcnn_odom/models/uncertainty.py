"""How far off an estimate may be: a standard deviation for each step, fitted on validation drives."""

import torch
from torch import Tensor, nn

from rcnn_odom.geometry import FloatArray, motion_errors
from rcnn_odom.models.networks import Estimate, MotionHead

WITHIN = 0.6827
"""Share of a normal distribution within one standard deviation of its mean."""
LEAST = 1e-6
"""Deviations stay above 0 where validation has no errors at all."""


class Uncertainty(nn.Module):
    """Standard deviations of distance and heading as sums of what tells of difficulty, none negative.

    What tells of it, in deviations of the training motions: 1; how long the step and how sharp the turn
    is; of a recurrent network, how far it and its first stage are apart. The weights are fitted on
    validation drives and scaled until 68.27 % of their errors lie within one deviation: the normalised
    nonconformity of Papadopoulos, Gammerman and Vovk, "Normalized nonconformity measures for regression
    conformal prediction", 2008, but with one set of drives for the fit and the scale.

    Attributes:
        weights: (2, K) metres and radians; nan before :meth:`fit`.
        least_filled: half the smallest share of bins with a return in the validation scans: below it a
            scan is unlike any that these weights know. nan before :meth:`fit`.
        period: usual seconds between these scans. nan before :meth:`fit`, or where their stamps do not
            grow.
    """

    weights: Tensor
    least_filled: Tensor
    period: Tensor

    def __init__(self, recurrent: bool) -> None:
        super().__init__()
        self.register_buffer("weights", torch.full((2, 5 if recurrent else 3), torch.nan))
        self.register_buffer("least_filled", torch.tensor(torch.nan))
        self.register_buffer("period", torch.tensor(torch.nan))

    def features(self, estimate: Estimate, head: MotionHead) -> Tensor:
        """What tells of difficulty, (..., K), each at least 0.

        Args:
            estimate: of a network.
            head: its, for its units.
        """
        parts = [torch.ones_like(estimate.motion[..., :1]), (estimate.motion / head.deviation).abs()]
        if estimate.first_stage is not None:
            parts.append(((estimate.motion - estimate.first_stage) / head.deviation).abs())
        return torch.cat(parts, -1)

    def forward(self, estimate: Estimate, head: MotionHead) -> Tensor:
        """Standard deviations (..., 2) in metres and radians; nan before :meth:`fit`."""
        return self.features(estimate, head) @ self.weights.T

    def fit(
        self,
        features: FloatArray,
        motions: FloatArray,
        truth: FloatArray,
        filled: FloatArray,
        intervals: FloatArray,
    ) -> None:
        """Fits the weights to validation drives.

        Args:
            features: (N, K).
            motions: estimated, (N, 2) metres and radians.
            truth: (N, 2).
            filled: share of bins with a return in each scan.
            intervals: seconds between scans.
        """
        import numpy as np
        from scipy.optimize import nnls  # A second to import, which an odometer has no use for.

        errors = np.abs(motion_errors(motions, truth))
        for output in range(2):
            weights, _ = nnls(features, errors[:, output])
            # A constant of a tenth of the usual error: no step is certain.
            weights[0] = max(weights[0], 0.1 * float(errors[:, output].mean()), LEAST)
            scale = np.quantile(errors[:, output] / (features @ weights), WITHIN)
            self.weights[output] = torch.from_numpy(max(scale, LEAST) * weights)
        self.least_filled.fill_(0.5 * float(np.min(filled)))
        period = float(np.median(intervals))
        self.period.fill_(period if period > 0 else torch.nan)

    @property
    def fitted(self) -> bool:
        """Whether :meth:`fit` has been called."""
        return bool(torch.isfinite(self.weights).all())
