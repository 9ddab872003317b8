"""Scans that take time: points brought to where a laser that moved meanwhile would have seen them at once."""

import numpy as np

from rcnn_odom.compiled import compiled
from rcnn_odom.geometry import FloatArray

LONGEST = 1.0
"""Seconds from the stamp, beyond which times are not believed; such beams stay as they are."""


def deskew(ranges: FloatArray, bearings: FloatArray, times: FloatArray, velocity: FloatArray) -> FloatArray:
    """Ranges and bearings as seen from where the laser was at the scan's stamp.

    Args:
        ranges: (P,) metres.
        bearings: (P,) radians.
        times: (P,) seconds after the stamp.
        velocity: (3,) metres and radians a second, of the laser in its own frame, the same all the time.

    Returns:
        (2, P) metres and radians; beams without a return are unchanged.
    """
    moved = np.empty((2, len(ranges)))
    _deskew(ranges, bearings, times, velocity, moved)
    return moved


@compiled
def _deskew(ranges, bearings, times, velocity, moved):  # type: ignore[no-untyped-def]
    for i in range(len(ranges)):
        if not (0 < ranges[i] < np.inf and abs(times[i]) <= LONGEST):
            moved[0, i], moved[1, i] = ranges[i], bearings[i]
            continue
        turn = velocity[2] * times[i]
        # On the arc of a constant velocity: the chord lies at half the turn, and is a little shorter.
        chord = 1 - turn * turn / 24
        cos, sin = np.cos(turn / 2) * chord, np.sin(turn / 2) * chord
        x = (cos * velocity[0] - sin * velocity[1]) * times[i] + ranges[i] * np.cos(bearings[i] + turn)
        y = (sin * velocity[0] + cos * velocity[1]) * times[i] + ranges[i] * np.sin(bearings[i] + turn)
        moved[0, i], moved[1, i] = np.sqrt(x * x + y * y), np.arctan2(y, x)
