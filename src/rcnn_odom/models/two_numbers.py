"""Steps out of the paper's two numbers, distance and heading change, and how little two numbers can say.

Where along the turn the distance is driven is not said by them: ``apply`` decides it, and is known nowhere
else.
"""

from typing import Literal

import numpy as np
import numpy.typing as npt

from rcnn_odom.geometry import FloatArray, motions_of

Apply = Literal["start", "middle", "end"]

TURN_FRACTION = {"start": 0.0, "middle": 0.5, "end": 1.0}
"""How much of the heading change has happened when the distance is driven."""


def steps_of(motions: npt.ArrayLike, apply: Apply) -> FloatArray:
    """Steps (..., 3) out of motions (..., 2) of metres and radians.

    >>> steps_of([[2.0, np.pi / 2]], "start").round(3)
    array([[2.   , 0.   , 1.571]])
    """
    distance, turn = np.moveaxis(np.asarray(motions, dtype=np.float64), -1, 0)
    direction = TURN_FRACTION[apply] * turn
    return np.stack([distance * np.cos(direction), distance * np.sin(direction), turn], axis=-1)


def restate(steps: npt.ArrayLike, apply: Apply) -> FloatArray:
    """Steps (..., 3) cut to what two numbers can say of them; the drift of the truth so cut is the floor."""
    return steps_of(motions_of(steps), apply)
