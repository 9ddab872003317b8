"""A frame's points in other orders than laser by laser, as tools and drivers write them."""

from collections.abc import Callable

import numpy as np

Points = np.ndarray
Order = Callable[[Points], Points]


def _azimuth(points: Points, first: float = 0.0) -> np.ndarray:
    return (np.arctan2(points[:, 1], points[:, 0]) - first) % (2 * np.pi)


def by_columns(points: Points) -> Points:
    """Firing order: all lasers of one direction, then the next. Rings are told by azimuth's wraps."""
    azimuth = _azimuth(points)
    ring = np.cumsum(np.diff(azimuth, prepend=azimuth[0]) < -np.pi)
    return points[np.lexsort([ring, np.round(azimuth / np.deg2rad(0.5))])]


def turning_clockwise(points: Points) -> Points:
    """Laser by laser from the first on, each of them turning the other way."""
    azimuth = _azimuth(points)
    ring = np.cumsum(np.diff(azimuth, prepend=azimuth[0]) < -np.pi)
    return points[np.lexsort([-azimuth, ring])]


def thin(points: Points, leaf: float = 0.1) -> Points:
    """One point, their mean, in each cube of ``leaf`` metres; x grows fastest, z slowest."""
    cubes, which = np.unique(np.floor(points[:, [2, 1, 0]] / leaf), axis=0, return_inverse=True)
    sums = np.zeros((len(cubes), points.shape[1]))
    np.add.at(sums, which.ravel(), points)
    return (sums / np.bincount(which.ravel())[:, None]).astype(points.dtype)


def beginning_anywhere(points: Points) -> Points:
    """Laser by laser, the turn of each of them from another direction on."""
    rng = np.random.default_rng(0)
    azimuth = _azimuth(points)
    rings = np.split(points, np.flatnonzero(np.diff(azimuth) < -np.pi) + 1)
    return np.concatenate([np.roll(ring, rng.integers(len(ring)), axis=0) for ring in rings])


PERMUTED: dict[str, Order] = {
    "sorted by azimuth": lambda points: points[np.argsort(_azimuth(points))],
    "sorted by azimuth from behind": lambda points: points[
        np.argsort((_azimuth(points) - np.pi) % (2 * np.pi))
    ],
    "shuffled": lambda points: np.random.default_rng(0).permutation(points),
    "reversed": lambda points: points[::-1],
    "by columns": by_columns,
    "turning clockwise": turning_clockwise,
    "beginning anywhere": beginning_anywhere,
    "sorted by range": lambda points: points[np.argsort(np.hypot(points[:, 0], points[:, 1]))],
    "sorted by height": lambda points: points[np.argsort(points[:, 2])],
}
THINNED: dict[str, Order] = {
    "thinned in order": thin,
    "thinned and shuffled": lambda points: np.random.default_rng(0).permutation(thin(points)),
}
RINGED: dict[str, Order] = {
    "as it is": lambda points: points,
    "every third": lambda points: points[::3],
    "from another laser on": lambda points: np.roll(points, len(points) // 2, axis=0),
}
