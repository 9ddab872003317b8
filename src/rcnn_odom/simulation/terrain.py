"""Hills, and how a car stands on them."""

from dataclasses import dataclass
from functools import cached_property

import numpy as np

from rcnn_odom.compiled import compiled
from rcnn_odom.geometry import FloatArray

GRID_STEP = 5.0
HILLINESS_DEG = (0.3, 2.5)
"""Standard deviation of the slope along a road, from a flat city to a hilly one (KITTI: 0.2 to 3 degrees)."""
WAVELENGTHS = (120.0, 500.0)
WHEELBASE, TRACK = 2.7, 1.6


@dataclass(frozen=True)
class Ground:
    """Heights on a square grid, bilinear between its corners.

    Attributes:
        corner: (2,) metres, x and y of the grid's first corner.
        step: metres between corners.
        heights: (X, Y) metres.
    """

    corner: FloatArray
    step: float
    heights: FloatArray

    @cached_property
    def steepest(self) -> float:
        """Metres by which it rises in a metre at most, in any direction."""
        rises = [np.abs(np.diff(self.heights, axis=axis)).max() for axis in (0, 1)]
        return float(np.hypot(*rises)) / self.step

    def at(self, points: FloatArray) -> FloatArray:
        """Height (P,) in metres under points (P, 2); beyond the rim the slope goes on."""
        return _heights(self.heights, self.corner, self.step, points)


@compiled
def height_at(heights, corner, step, x, y):  # type: ignore[no-untyped-def]
    """Height in metres at one point of a :class:`Ground`, for loops that are compiled."""
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
    """Gentle hills between two corners (2,) of the world; how steep they are is the city's own."""
    count = 12
    waves = 2 * np.pi / rng.uniform(*WAVELENGTHS, count)
    direction = rng.uniform(0, 2 * np.pi, count)
    hilliness = np.tan(np.deg2rad(np.exp(rng.uniform(*np.log(HILLINESS_DEG)))))
    # A wave slopes by amplitude * wave at most; in any one direction its mean square is a quarter of that's.
    amplitude = 2 * hilliness / waves / np.sqrt(count)
    x, y = (np.arange(a, b + GRID_STEP, GRID_STEP) for a, b in zip(low, high, strict=True))
    phase = rng.uniform(0, 2 * np.pi, count)
    east, north = waves * np.cos(direction), waves * np.sin(direction)
    # sin(a + b) in products of one axis each: a grid of sines would cost far more.
    heights = (np.sin(np.outer(x, east) + phase) * amplitude) @ np.cos(np.outer(north, y))
    heights += (np.cos(np.outer(x, east) + phase) * amplitude) @ np.sin(np.outer(north, y))
    return Ground(low, GRID_STEP, heights)


def flat_ground(low: FloatArray, high: FloatArray) -> Ground:
    """A plain at height 0 between two corners (2,)."""
    return Ground(low, float((high - low).max()), np.zeros((2, 2)))


def stand(planar: FloatArray, tilt: FloatArray, height: float, ground: Ground) -> FloatArray:
    """Poses of a laser on a car on the ground.

    Args:
        planar: (N, 3) x, y in metres and heading in radians of the laser.
        tilt: (N, 2) pitch (nose down) and roll (left side up) of the car on its springs, radians.
        height: metres of the laser above the ground.
        ground: what the four wheels stand on.

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
