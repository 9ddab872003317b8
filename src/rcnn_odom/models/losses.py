"""The training losses of the paper: eq. 3 (regression) and eq. 4 (rotation as classification)."""

from typing import NamedTuple

from torch import Tensor
from torch.nn import functional as F


class Loss(NamedTuple):
    """A loss and the two parts it is made of, before beta; scalars."""

    total: Tensor
    distance: Tensor
    rotation: Tensor


def euclidean(estimate: Tensor, truth: Tensor, per_sample: bool = False) -> Tensor:
    """The L_e of eq. 3 over any shape: a scalar in the unit of its arguments.

    The paper's norm is taken over the batch, as root of the mean square, so that it does not grow
    with the batch; ``per_sample`` takes each sample's own norm (its absolute error) and the mean.
    """
    error = estimate - truth
    if per_sample:
        return error.abs().mean()
    # The square root has no gradient at zero: a batch without error must not give nan.
    return (error.square().mean() + 1e-12).sqrt()


def regression_loss(motion: Tensor, truth: Tensor, beta: float, per_sample: bool = False) -> Loss:
    """Eq. 3 for motions (..., 2) of metres and radians."""
    distance = euclidean(motion[..., 0], truth[..., 0], per_sample)
    rotation = euclidean(motion[..., 1], truth[..., 1], per_sample)
    return Loss(distance + beta * rotation, distance, rotation)


def classification_loss(
    motion: Tensor, scores: Tensor, truth: Tensor, classes: Tensor, beta: float, per_sample: bool = False
) -> Loss:
    """Eq. 4: distances of motions (..., 2), class scores (..., C) against class numbers (...)."""
    distance = euclidean(motion[..., 0], truth[..., 0], per_sample)
    rotation = F.cross_entropy(scores.flatten(0, -2), classes.flatten())
    return Loss(distance + beta * rotation, distance, rotation)
