"""Lines through points in the plane, and directions in it."""

import numpy as np

from rcnn_odom.geometry import FloatArray


def arc_length(points: FloatArray) -> FloatArray:
    """Metres from the first of points (N, 2) to each along them, (N,)."""
    return np.concatenate([[0.0], np.cumsum(np.hypot(*np.diff(points, axis=0).T))])


def resample(points: FloatArray, travelled: FloatArray, at: FloatArray) -> FloatArray:
    """Points (M, 2) on a line at other places.

    Args:
        points: (N, 2) of the line.
        travelled: (N,) how far along it they are, rising.
        at: (M,) how far along it those wanted are; before and after the line its ends stand in.
    """
    return np.stack([np.interp(at, travelled, values) for values in points.T], axis=1)


def unit(direction: FloatArray) -> FloatArray:
    """Unit vectors (..., 2) of directions (...) in radians."""
    return np.stack([np.cos(direction), np.sin(direction)], axis=-1)
