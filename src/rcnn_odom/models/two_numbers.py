"""Converts the paper's two numbers of a motion, distance and heading change, into steps.

The two numbers do not define the direction of the distance: it can be that of the heading before, in the
middle of, or after the turn. The option ``apply`` selects one of these.
"""

from typing import Literal

import numpy as np
import numpy.typing as npt

from rcnn_odom.geometry import FloatArray, motions_of

Apply = Literal["start", "middle", "end"]

TURN_FRACTION = {"start": 0.0, "middle": 0.5, "end": 1.0}
"""The fraction of the heading change after which the distance is driven, for each value of ``apply``."""


def steps_of(motions: npt.ArrayLike, apply: Apply) -> FloatArray:
    """Converts motions (..., 2) in metres and radians into steps (..., 3).

    Example:
        >>> steps_of([[2.0, np.pi / 2]], "start").round(3)
        array([[2.   , 0.   , 1.571]])
    """
    distance, turn = np.moveaxis(np.asarray(motions, dtype=np.float64), -1, 0)
    direction = TURN_FRACTION[apply] * turn
    return np.stack([distance * np.cos(direction), distance * np.sin(direction), turn], axis=-1)


def restate(steps: npt.ArrayLike, apply: Apply) -> FloatArray:
    """Reduces steps (..., 3) to two numbers and converts these back; sideways motion is lost.

    The drift of the reduced true steps is the lowest that an estimate of two numbers can reach (the floor).

    Example:
        >>> restate([[2.0, 0.5, 0.0]], "middle")
        array([[2., 0., 0.]])
    """
    return steps_of(motions_of(steps), apply)
