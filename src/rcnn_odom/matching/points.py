"""The returns of a scan as points in angular order, for any order of the laser's beams."""

import numpy as np

from rcnn_odom.compiled import compiled
from rcnn_odom.geometry import FloatArray

MOST_MOVES = 20
"""Mean number of places that a point may move in an insertion sort before a full sort is cheaper."""
LARGEST_ANGLE = 1e6
"""Radians; beams with a larger bearing are dropped as invalid."""


def find_points(ranges: FloatArray, bearings: FloatArray, farthest: float) -> FloatArray:
    """The returns of a scan as points in angular order.

    Args:
        ranges: (P,) metres. A range that is not positive, not finite, or at least ``farthest`` is no return.
        bearings: (P,) radians, in any order and not necessarily wrapped.
        farthest: metres.

    Returns:
        (R, 3) x and y in metres and the bearing in [-pi, pi), sorted by bearing.

    Example:
        Two returns, to the left and ahead; a range of 0 m and one of 90 m are no returns:

        >>> ranges, bearings = np.array([1.0, 0.0, 2.0, 90.0]), np.deg2rad([90.0, 45.0, 0.0, -45.0])
        >>> find_points(ranges, bearings, farthest=80.0).round(3) + 0.0
        array([[2.   , 0.   , 0.   ],
               [0.   , 1.   , 1.571]])
    """
    found = np.empty((len(ranges), 3))
    count = _collect(ranges, bearings, farthest, found)
    _sort(found, count)
    return found[:count]


@compiled
def _collect(ranges, bearings, farthest, found):  # type: ignore[no-untyped-def]
    """Writes x, y and bearing of the returns to ``found`` in the order of the beams; returns their number."""
    n = 0
    for i in range(len(ranges)):
        if 0 < ranges[i] < farthest and abs(bearings[i]) < LARGEST_ANGLE:
            b = bearings[i]
            if not -np.pi <= b < np.pi:
                b -= 2 * np.pi * np.floor((b + np.pi) / (2 * np.pi))
            found[n, 0], found[n, 1] = ranges[i] * np.cos(b), ranges[i] * np.sin(b)
            found[n, 2] = b
            n += 1
    return n


@compiled
def _sort(found, n):  # type: ignore[no-untyped-def]
    """Sorts the first ``n`` points by bearing; fast for nearly sorted points, as scans usually are."""
    falling = 0
    for i in range(1, n):
        falling += found[i, 2] < found[i - 1, 2]
    if 2 * falling > n:  # the laser turns clockwise
        found[:n] = found[:n][::-1].copy()
    # If the revolution does not begin behind the laser, swap its two parts.
    for i in range(1, n):
        if found[i, 2] < found[i - 1, 2] - np.pi:
            found[:n] = np.concatenate((found[i:n], found[:i]))
            break
    if not _insert(found, n):
        found[:n] = found[:n][np.argsort(found[:n, 2])]


@compiled
def _insert(found, n):  # type: ignore[no-untyped-def]
    """Insertion sort of the first ``n`` points by bearing; False if it stopped after too many moves."""
    moves = 0
    for i in range(1, n):
        j = i
        while j > 0 and found[j - 1, 2] > found[j, 2] and moves < MOST_MOVES * n:
            for k in range(3):
                found[j, k], found[j - 1, k] = found[j - 1, k], found[j, k]
            j -= 1
            moves += 1
    return moves < MOST_MOVES * n
