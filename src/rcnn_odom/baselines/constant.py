"""Constant motion: what a drift is worth that no laser has contributed to."""

from dataclasses import dataclass

import numpy as np
import numpy.typing as npt

from rcnn_odom.motion import FloatArray


@dataclass(frozen=True)
class ConstantMotion:
    """The same motion for every pair of scans: the training set's mean, for instance.

    Attributes:
        motion: (2,) metres and radians.
    """

    motion: FloatArray

    def estimate(self, scans: npt.ArrayLike) -> FloatArray:
        """Motions (N-1, 2) for scans (N, bins)."""
        return np.tile(self.motion, (len(np.asarray(scans)) - 1, 1))


def held_motion() -> ConstantMotion:
    """Repeats its own last estimate, and begins at rest: the odometry that never moves.

    It is what a matcher that holds its last motion on failure amounts to when it fails from the start.
    """
    return ConstantMotion(np.zeros(2))
