"""The training losses of the paper: eq. 3 (regression) and eq. 4 (rotation as classification)."""

from typing import NamedTuple

from torch import Tensor
from torch.nn import functional as F


class Loss(NamedTuple):
    """A loss and its two parts, scalars.

    Attributes:
        total: distance loss plus beta times rotation loss.
        distance: loss of the distance.
        rotation: loss of the rotation, without the factor beta.
    """

    total: Tensor
    distance: Tensor
    rotation: Tensor


def euclidean(estimate: Tensor, truth: Tensor, per_sample: bool = False) -> Tensor:
    """The loss L_e of eq. 3, a scalar in the unit of its arguments.

    The paper's norm is taken over the batch, as the root of the mean square, so that it does not depend on
    the size of the batch.

    Args:
        estimate, truth: tensors of the same shape.
        per_sample: take the norm of each sample (its absolute error), and the mean of these.

    Example:
        >>> euclidean(Tensor([3.0, -3.0]), Tensor([0.0, 0.0])).item()
        3.0
    """
    error = estimate - truth
    if per_sample:
        return error.abs().mean()
    # The square root has no finite gradient at zero; a batch without any error must not give nan.
    return (error.square().mean() + 1e-12).sqrt()


def regression_loss(motion: Tensor, truth: Tensor, beta: float, per_sample: bool = False) -> Loss:
    """The loss of eq. 3.

    Args:
        motion, truth: (..., 2) estimated and true motions in metres and radians.
        beta: factor of the rotation loss.
        per_sample: as in :func:`euclidean`.
    """
    distance = euclidean(motion[..., 0], truth[..., 0], per_sample)
    rotation = euclidean(motion[..., 1], truth[..., 1], per_sample)
    return Loss(distance + beta * rotation, distance, rotation)


def classification_loss(
    motion: Tensor, scores: Tensor, truth: Tensor, classes: Tensor, beta: float, per_sample: bool = False
) -> Loss:
    """The loss of eq. 4.

    Args:
        motion, truth: (..., 2) estimated and true motions in metres and radians, of which the distance is
            used.
        scores: (..., C) estimated class scores of the rotation.
        classes: (...) true classes.
        beta: factor of the rotation loss, the cross-entropy.
        per_sample: as in :func:`euclidean`, for the distance.
    """
    distance = euclidean(motion[..., 0], truth[..., 0], per_sample)
    rotation = F.cross_entropy(scores.flatten(0, -2), classes.flatten())
    return Loss(distance + beta * rotation, distance, rotation)
