"""The line that a tunnel, a corridor or a track follows, and what lies beside it."""

from dataclasses import dataclass

import numpy as np

from rcnn_odom.geometry import FloatArray
from rcnn_odom.simulation.street.polyline import unit
from rcnn_odom.simulation.street.smooth import average_twice

STEP = 0.5
"""Metres between the points of a way."""
EASING = 20.0
"""Metres over which a bend begins and ends, averaged over twice."""
MOST_TURNED = 1.0
"""Radians from the first direction, from which on the next bend leads back: no way crosses itself."""


@dataclass(frozen=True)
class Way:
    """A line in the plane with points every ``STEP`` metres.

    Attributes:
        points: (M, 2) metres.
        directions: (M,) radians, not wrapped.
    """

    points: FloatArray
    directions: FloatArray

    def place(self, along: FloatArray, aside: FloatArray) -> FloatArray:
        """Points (..., 2) so many metres along the way and to its left, both (...)."""
        at = STEP * np.arange(len(self.points))
        direction = self.direction(along)
        on = np.stack([np.interp(along, at, values) for values in self.points.T], axis=-1)
        return on + np.asarray(aside)[..., None] * unit(direction + np.pi / 2)

    def direction(self, along: FloatArray) -> FloatArray:
        """Radians of the way so many metres along it."""
        return np.interp(along, STEP * np.arange(len(self.points)), self.directions)


def straight_way(length: float) -> Way:
    """A way along x."""
    along = STEP * np.arange(int(length / STEP) + 2)
    return Way(np.stack([along, np.zeros_like(along)], axis=1), np.zeros_like(along))


def bending_way(
    length: float,
    radii: tuple[float, float],
    sections: tuple[float, float],
    straight: float,
    rng: np.random.Generator,
) -> Way:
    """Straight pieces and bends, as roads are laid out.

    Args:
        length: metres.
        radii: metres of the tightest and of the widest bend.
        sections: metres of the shortest and of the longest piece.
        straight: chance that a piece is straight.
        rng: decides everything.
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
