"""Places that say little: a bare corridor, and a plain with a few posts; a robot drives straight through."""

import numpy as np

from rcnn_odom.geometry import FloatArray
from rcnn_odom.simulation.drawing import PLASTER, upright
from rcnn_odom.simulation.scene import Walls, join

SPEED = 1.0
"""Metres a second: a minute's drive is 60 m."""
BEYOND = 500.0
"""Metres by which a corridor's ends are out of every laser's range."""
POST = 0.08
"""Metres, half a post's width."""


def along(stamps: FloatArray) -> FloatArray:
    """The laser in every frame, (N, 3): straight on along x at ``SPEED``; metres and radians."""
    return np.stack([SPEED * stamps, np.zeros_like(stamps), np.zeros_like(stamps)], axis=1)


def bare_corridor(length: float, rng: np.random.Generator) -> Walls:
    """Two parallel walls along x, 1.6 to 3 m apart, with the way somewhere between them, and no end in sight.

    Args:
        length: metres that are driven.
        rng: decides how wide it is and where the way is.
    """
    width = rng.uniform(1.6, 3.0)
    right = -width * rng.uniform(0.3, 0.7)
    sides = [[-BEYOND, y, length + BEYOND, y] for y in (right, right + width)]
    return upright(np.array(sides), PLASTER)


def few_posts(length: float, rng: np.random.Generator) -> Walls:
    """Thin square posts beside the way, one every six metres, one to twelve metres aside: a few beams each.

    Args:
        length: metres that are driven.
        rng: decides where they are.
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
    return join([upright(np.stack(side, axis=1), PLASTER) for side in sides])
