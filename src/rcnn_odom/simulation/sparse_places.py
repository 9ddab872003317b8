"""Places with few features: a bare corridor, and a plain with a few posts; a robot drives straight ahead."""

import numpy as np

from rcnn_odom.geometry import FloatArray
from rcnn_odom.simulation.drawing import PLASTER, upright_walls
from rcnn_odom.simulation.scene import Walls, join

SPEED = 1.0
"""Metres per second; a drive of a minute is 60 m long."""
BEYOND = 500.0
"""Metres by which a corridor continues before and after the drive, out of the range of any laser."""
POST = 0.08
"""Metres, half the width of a post."""


def drive_straight(stamps: FloatArray) -> FloatArray:
    """A drive along x at ``SPEED``.

    Args:
        stamps: (N,) seconds.

    Returns:
        Poses of the laser (N, 3): x and y in metres, heading in radians.

    >>> drive_straight(np.array([0.0, 2.0]))[:, 0].tolist()
    [0.0, 2.0]
    """
    return np.stack([SPEED * stamps, np.zeros_like(stamps), np.zeros_like(stamps)], axis=1)


def bare_corridor(length: float, rng: np.random.Generator) -> Walls:
    """Two parallel walls along x, 1.6 to 3 m apart, on either side of the path; their ends are out of sight.

    Args:
        length: metres, length of the drive.
        rng: source of the width and of the position of the path between the walls.
    """
    width = rng.uniform(1.6, 3.0)
    right = -width * rng.uniform(0.3, 0.7)
    sides = [[-BEYOND, y, length + BEYOND, y] for y in (right, right + width)]
    return upright_walls(np.array(sides), PLASTER)


def few_posts(length: float, rng: np.random.Generator) -> Walls:
    """Thin square posts, one every six metres, 1 to 12 m beside the path; each is hit by only a few beams.

    Args:
        length: metres, length of the drive.
        rng: source of the positions.
    """
    x = np.arange(-18.0, length + 24.0, 6.0)
    x += rng.uniform(-2.5, 2.5, len(x))
    y = rng.uniform(1, 12, len(x)) * rng.choice([-1, 1], len(x))
    low, high, left, right = x - POST, x + POST, y + POST, y - POST
    sides = [
        (low, right, high, right),
        (high, right, high, left),
        (high, left, low, left),
        (low, left, low, right),
    ]
    return join([upright_walls(np.stack(side, axis=1), PLASTER) for side in sides])
