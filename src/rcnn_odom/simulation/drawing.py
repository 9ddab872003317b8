"""Plan of a building with rooms, doors, lines and furniture, and its conversion to walls for ray casting."""

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Literal

import numpy as np
import numpy.typing as npt

from rcnn_odom.geometry import FloatArray
from rcnn_odom.simulation.scene import Material, Walls, join

HEIGHTS = (-1.0, 3.0)
"""Metres, bottom and top of all walls relative to the laser's plane."""
PLASTER = Material(1.0, 0.003)
WOOD = Material(0.995, 0.005)
GLASS = Material(0.6, 0.01)

Leaf = Literal["open", "closed", "none"]


@dataclass(frozen=True)
class Room:
    """A room or hall: a rectangle between walls.

    Attributes:
        low: (x, y) of the lower left corner in metres.
        high: (x, y) of the upper right corner in metres.
    """

    low: tuple[float, float]
    high: tuple[float, float]

    @property
    def size(self) -> tuple[float, float]:
        """Metres along x and along y."""
        return self.high[0] - self.low[0], self.high[1] - self.low[1]


@dataclass(frozen=True)
class Door:
    """A door: an opening in a wall. Coordinates are in metres.

    Attributes:
        axis: direction of walking through the door: 0 along x, 1 along y.
        faces: the two faces of the wall on that axis, last the one of the room into which the leaf opens.
        middle: middle of the opening, on the other axis.
        width: width of the opening.
        wall: coordinates of the ends of the wall, on the other axis.
        leaf: state of the door leaf: ``open``, ``closed``, or ``none`` for an opening without a leaf.
    """

    axis: int
    faces: tuple[float, float]
    middle: float
    width: float
    wall: tuple[float, float]
    leaf: Leaf

    @property
    def place(self) -> tuple[float, float]:
        """(x, y) of the middle of the opening in metres."""
        through = sum(self.faces) / 2
        return (through, self.middle) if self.axis == 0 else (self.middle, through)


@dataclass
class Drawing:
    """The plan of a building while it is drawn. Coordinates are in metres.

    Attributes:
        lines: (x, y, x, y) of the walls of each material.
        doors: all doors.
        boxes: furniture as rectangles: x, y, half length, half width, and direction in radians.
        legs: thin things in the same form, which are drawn as crosses of two lines.
    """

    lines: dict[Material, list[tuple[float, ...]]]
    doors: list[Door]
    boxes: list[tuple[float, float, float, float, float]]
    legs: list[tuple[float, float, float, float, float]]


def as_walls(drawing: Drawing) -> Walls:
    """Convert a plan to walls, without the furniture that would stand in a doorway."""
    boxes = _keep_doorways_free(np.array(drawing.boxes).reshape(-1, 5), drawing.doors)
    legs = _keep_doorways_free(np.array(drawing.legs).reshape(-1, 5), drawing.doors)
    walls = [
        upright_walls(np.array(lines).reshape(-1, 4), material) for material, lines in drawing.lines.items()
    ]
    square = np.array([[-1, -1, 1, -1], [1, -1, 1, 1], [1, 1, -1, 1], [-1, 1, -1, -1]])
    cross = np.array([[-1, -1, 1, 1], [-1, 1, 1, -1]])
    return join(
        [*walls, upright_walls(_shapes(boxes, square), WOOD), upright_walls(_shapes(legs, cross), WOOD)]
    )


def _keep_doorways_free(things: FloatArray, doors: Sequence[Door]) -> FloatArray:
    places, halves = np.array([d.place for d in doors]), np.array([d.width / 2 for d in doors])
    apart = np.linalg.norm(things[:, None, :2] - places, axis=2)
    reach = np.hypot(things[:, 2], things[:, 3])
    return things[(apart > reach[:, None] + halves + 0.5).all(axis=1)]


def _shapes(things: FloatArray, corners: npt.NDArray) -> FloatArray:
    """Draw a shape for each of some things.

    Args:
        things: (K, 5) x, y, half length, half width and direction.
        corners: (L, 4) lines of the shape, from -1 to 1.

    Returns:
        Lines (L * K, 4).
    """
    x, y, half_length, half_width, direction = (column[:, None] for column in things.T)
    ends = []
    for end in (0, 2):
        u, v = half_length * corners[:, end], half_width * corners[:, end + 1]
        ends += [
            x + u * np.cos(direction) - v * np.sin(direction),
            y + u * np.sin(direction) + v * np.cos(direction),
        ]
    return np.stack(ends, axis=-1).reshape(-1, 4)


def upright_walls(ends: FloatArray, material: Material) -> Walls:
    """Make walls of one material from lines (S, 4) on the floor; they reach above and below the laser."""
    count = len(ends)
    return Walls(
        ends.astype(np.float64),
        np.tile(HEIGHTS, (count, 1)),
        np.full(count, material.returned),
        np.full(count, material.roughness),
    )
