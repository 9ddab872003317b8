"""The line that a tunnel, a corridor or a track follows."""

from dataclasses import dataclass

import numpy as np

from rcnn_odom.geometry import FloatArray
from rcnn_odom.simulation.street.polyline import unit
from rcnn_odom.simulation.street.smooth import average_twice

STEP = 0.5
"""Metres between the points of a way."""
EASING = 20.0
"""Metres of the window over which the curvature is averaged twice, so that bends begin and end smoothly."""
MOST_TURNED = 1.0
"""Radians from the first direction; beyond it, the next bend turns back, so that no way crosses itself."""


@dataclass(frozen=True)
class Way:
    """A line in the plane with points every ``STEP`` metres.

    Attributes:
        points: (M, 2) metres.
        directions: (M,) radians, not wrapped.

    >>> straight_way(10.0).place(np.array([4.0]), np.array([1.0])).tolist()
    [[4.0, 1.0]]
    """

    points: FloatArray
    directions: FloatArray

    def place(self, along: FloatArray, aside: FloatArray) -> FloatArray:
        """Points (..., 2) at distances along the way and offsets to its left, both (...) in metres."""
        at = STEP * np.arange(len(self.points))
        direction = self.direction(along)
        on = np.stack([np.interp(along, at, values) for values in self.points.T], axis=-1)
        return on + np.asarray(aside)[..., None] * unit(direction + np.pi / 2)

    def direction(self, along: FloatArray) -> FloatArray:
        """Directions (...) of the way in radians at distances along it, (...) in metres."""
        return np.interp(along, STEP * np.arange(len(self.points)), self.directions)


def straight_way(length: float) -> Way:
    """A way along x of ``length`` metres."""
    along = STEP * np.arange(int(length / STEP) + 2)
    return Way(np.stack([along, np.zeros_like(along)], axis=1), np.zeros_like(along))


def bending_way(
    length: float,
    radii: tuple[float, float],
    sections: tuple[float, float],
    straight: float,
    rng: np.random.Generator,
) -> Way:
    """A random way of straight sections and bends, as roads have them.

    Args:
        length: metres.
        radii: metres, smallest and largest radius of a bend.
        sections: metres, length of the shortest and of the longest section.
        straight: probability that a section is straight.
        rng: source of all random choices.
    """
    window = round(EASING / STEP)
    count = int(length / STEP) + 2
    bends: list[FloatArray] = []
    turned = 0.0
    while sum(map(len, bends)) < count + 2 * window:
        piece = round(rng.uniform(*sections) / STEP)
        radius, side, is_straight = np.exp(rng.uniform(*np.log(radii))), rng.choice([-1, 1]), rng.random()
        if abs(turned) > MOST_TURNED:
            side = -np.sign(turned)
        curvature = 0.0 if is_straight < straight else side / radius
        turned += curvature * piece * STEP
        bends.append(np.full(piece, curvature))
    eased = average_twice(np.concatenate(bends), window)[:count]
    directions = np.concatenate([[0.0], np.cumsum(eased[:-1] * STEP)])
    steps = STEP * unit((directions[1:] + directions[:-1]) / 2)
    return Way(np.concatenate([np.zeros((1, 2)), np.cumsum(steps, axis=0)]), directions)
