"""Removes the motion of the laser during a scan: all beams as seen from its pose at one time."""

import numpy as np

from rcnn_odom.compiled import compiled
from rcnn_odom.geometry import FloatArray

LONGEST = 1.0
"""Seconds; beams whose time is farther from the stamp are invalid and stay unchanged."""


def deskew(ranges: FloatArray, bearings: FloatArray, times: FloatArray, velocity: FloatArray) -> FloatArray:
    """Ranges and bearings as seen from the pose of the laser at the scan's stamp.

    Args:
        ranges: (P,) metres.
        bearings: (P,) radians.
        times: (P,) seconds after the stamp.
        velocity: (3,) metres and radians per second, constant in the laser's own frame.

    Returns:
        (2, P) metres and radians; beams without a return are unchanged.

    Example:
        At 1 m/s towards a wall, a beam that is shot 0.1 s after the stamp measures 0.1 m too little:

        >>> velocity = np.array([1.0, 0.0, 0.0])
        >>> ranges, bearings = deskew(np.array([2.0, 1.9]), np.zeros(2), np.array([0.0, 0.1]), velocity)
        >>> ranges.round(3)
        array([2., 2.])
    """
    moved = np.empty((2, len(ranges)))
    _deskew(ranges, bearings, times, velocity, moved)
    return moved


@compiled
def _deskew(ranges, bearings, times, velocity, moved):  # type: ignore[no-untyped-def]
    """Writes the ranges and bearings to ``moved`` (2, P)."""
    for i in range(len(ranges)):
        if not (0 < ranges[i] < np.inf and abs(times[i]) <= LONGEST):
            moved[0, i], moved[1, i] = ranges[i], bearings[i]
            continue
        turn = velocity[2] * times[i]
        # At constant velocity the path is an arc: its chord points to half the turn and is a little shorter.
        chord = 1 - turn * turn / 24
        cos, sin = np.cos(turn / 2) * chord, np.sin(turn / 2) * chord
        x = (cos * velocity[0] - sin * velocity[1]) * times[i] + ranges[i] * np.cos(bearings[i] + turn)
        y = (sin * velocity[0] + cos * velocity[1]) * times[i] + ranges[i] * np.sin(bearings[i] + turn)
        moved[0, i], moved[1, i] = np.sqrt(x * x + y * y), np.arctan2(y, x)
