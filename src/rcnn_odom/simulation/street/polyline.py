"""Polylines and directions in the plane."""

import numpy as np

from rcnn_odom.geometry import FloatArray


def arc_length(points: FloatArray) -> FloatArray:
    """Distances (N,) along a line with points (N, 2), from its first point to each point.

    >>> arc_length(np.array([[0.0, 0.0], [3.0, 4.0], [3.0, 5.0]])).tolist()
    [0.0, 5.0, 6.0]
    """
    return np.concatenate([[0.0], np.cumsum(np.hypot(*np.diff(points, axis=0).T))])


def resample(points: FloatArray, travelled: FloatArray, at: FloatArray) -> FloatArray:
    """Interpolate points on a line; values other than coordinates can be interpolated in the same way.

    Args:
        points: (N, K) points of the line.
        travelled: (N,) distances of these points along the line, increasing.
        at: (M,) distances of the wanted points; beyond the ends of the line, its end points are used.

    Returns:
        Points (M, K).

    >>> resample(np.array([[0.0, 0.0], [2.0, 4.0]]), np.array([0.0, 1.0]), np.array([0.5])).tolist()
    [[1.0, 2.0]]
    """
    return np.stack([np.interp(at, travelled, values) for values in points.T], axis=1)


def unit(direction: FloatArray) -> FloatArray:
    """Unit vectors (..., 2) of directions (...) in radians."""
    return np.stack([np.cos(direction), np.sin(direction)], axis=-1)
