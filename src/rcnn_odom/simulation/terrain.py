"""Hilly ground, and the poses of a car on it."""

from dataclasses import dataclass
from functools import cached_property

import numpy as np

from rcnn_odom.compiled import compiled
from rcnn_odom.geometry import FloatArray

GRID_STEP = 5.0
"""Metres between the points of the grid of heights."""
HILLINESS_DEG = (0.3, 2.5)
"""Standard deviation of the slope along a road, from a flat city to a hilly one (KITTI: 0.2 to 3 degrees)."""
WAVELENGTHS = (120.0, 500.0)
"""Metres, range of the wavelengths of hills."""
WHEELBASE, TRACK = 2.7, 1.6
"""Metres between the axles, and between left and right wheels."""


@dataclass(frozen=True)
class Ground:
    """Heights on a square grid, with bilinear interpolation between the grid points.

    Attributes:
        corner: (2,) metres, x and y of the first grid point.
        step: metres between grid points.
        heights: (X, Y) metres.
    """

    corner: FloatArray
    step: float
    heights: FloatArray

    @cached_property
    def steepest(self) -> float:
        """Upper bound of the slope in any direction, in metres of rise per metre."""
        rises = [np.abs(np.diff(self.heights, axis=axis)).max() for axis in (0, 1)]
        return float(np.hypot(*rises)) / self.step

    def at(self, points: FloatArray) -> FloatArray:
        """Heights (P,) in metres at points (P, 2); beyond the edge of the grid, the slope continues."""
        return _heights(self.heights, self.corner, self.step, points)


@compiled
def height_at(heights, corner, step, x, y):  # type: ignore[no-untyped-def]
    """Height in metres at one point of a :class:`Ground`, for compiled loops."""
    across, along = (x - corner[0]) / step, (y - corner[1]) / step
    i = min(max(int(across), 0), heights.shape[0] - 2)
    j = min(max(int(along), 0), heights.shape[1] - 2)
    u, v = across - i, along - j
    near = heights[i, j] * (1 - v) + heights[i, j + 1] * v
    return near * (1 - u) + (heights[i + 1, j] * (1 - v) + heights[i + 1, j + 1] * v) * u


@compiled
def _heights(heights, corner, step, points):  # type: ignore[no-untyped-def]
    out = np.empty(len(points))
    for i in range(len(points)):
        out[i] = height_at(heights, corner, step, points[i, 0], points[i, 1])
    return out


def random_ground(low: FloatArray, high: FloatArray, rng: np.random.Generator) -> Ground:
    """Random gentle hills between two corners (2,) of the world; the steepness is random as well."""
    count = 12
    waves = 2 * np.pi / rng.uniform(*WAVELENGTHS, count)
    direction = rng.uniform(0, 2 * np.pi, count)
    hilliness = np.tan(np.deg2rad(np.exp(rng.uniform(*np.log(HILLINESS_DEG)))))
    # The largest slope of a wave is amplitude * wave number; its mean square in one direction is a quarter of
    # the square of that.
    amplitude = 2 * hilliness / waves / np.sqrt(count)
    x, y = (np.arange(a, b + GRID_STEP, GRID_STEP) for a, b in zip(low, high, strict=True))
    phase = rng.uniform(0, 2 * np.pi, count)
    east, north = waves * np.cos(direction), waves * np.sin(direction)
    # sin(a + b) is expanded to products of functions of one axis, which is much faster than a grid of sines.
    heights = (np.sin(np.outer(x, east) + phase) * amplitude) @ np.cos(np.outer(north, y))
    heights += (np.cos(np.outer(x, east) + phase) * amplitude) @ np.sin(np.outer(north, y))
    return Ground(low, GRID_STEP, heights)


def flat_ground(low: FloatArray, high: FloatArray) -> Ground:
    """Flat ground at height 0 between two corners (2,)."""
    return Ground(low, float((high - low).max()), np.zeros((2, 2)))


def place_on_ground(planar: FloatArray, tilt: FloatArray, height: float, ground: Ground) -> FloatArray:
    """Compute the poses of a laser on a car that stands on the ground.

    Args:
        planar: (N, 3) x, y in metres and heading in radians of the laser.
        tilt: (N, 2) pitch (nose down) and roll (left side up) of the car on its springs, radians.
        height: metres, height of the laser above the ground.
        ground: the ground under the wheels.

    Returns:
        (N, 4, 4) laser to world.
    """
    middle, heading = planar[:, :2], planar[:, 2]
    forward = np.stack([np.cos(heading), np.sin(heading)], axis=1)
    left = np.stack([-forward[:, 1], forward[:, 0]], axis=1)
    places = [middle]
    for axis, half in ((forward, WHEELBASE / 2), (left, TRACK / 2)):
        places += [middle + half * axis, middle - half * axis]
    z, ahead, behind, leftward, rightward = map(ground.at, places)
    pitch = tilt[:, 0] - np.arctan((ahead - behind) / WHEELBASE)
    roll = tilt[:, 1] + np.arctan((leftward - rightward) / TRACK)
    poses = np.tile(np.eye(4), (len(planar), 1, 1))
    poses[:, :3, :3] = _rotations(heading, 2) @ _rotations(pitch, 1) @ _rotations(roll, 0)
    poses[:, :2, 3], poses[:, 2, 3] = middle, z + height
    return poses


def _rotations(angle: FloatArray, axis: int) -> FloatArray:
    """Rotation matrices (N, 3, 3) by angles (N,) in radians about one of the axes."""
    rotations = np.tile(np.eye(3), (len(angle), 1, 1))
    a, b = (axis + 1) % 3, (axis + 2) % 3
    rotations[:, a, a] = rotations[:, b, b] = np.cos(angle)
    rotations[:, b, a] = np.sin(angle)
    rotations[:, a, b] = -rotations[:, b, a]
    return rotations
