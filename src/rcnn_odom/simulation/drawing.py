"""What a building is drawn with: rooms, doors, lines and furniture, and the walls that they become."""

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Literal

import numpy as np
import numpy.typing as npt

from rcnn_odom.geometry import FloatArray
from rcnn_odom.simulation.scene import Material, Walls, join

HEIGHTS = (-1.0, 3.0)
PLASTER = Material(1.0, 0.003)
WOOD = Material(0.995, 0.005)
GLASS = Material(0.6, 0.01)

Leaf = Literal["open", "closed", "none"]


@dataclass(frozen=True)
class Room:
    """A rectangle between walls, a hall too: its lower left and upper right corner in metres."""

    low: tuple[float, float]
    high: tuple[float, float]

    @property
    def size(self) -> tuple[float, float]:
        """Metres along x and along y."""
        return self.high[0] - self.low[0], self.high[1] - self.low[1]


@dataclass(frozen=True)
class Door:
    """An opening through a wall.

    Attributes:
        axis: 0 when one walks through it along x, 1 along y.
        faces: where on that axis the wall begins and ends, that of the room the leaf opens into last.
        middle: of the opening, on the other axis.
        width: metres.
        wall: where the wall begins and ends, on the other axis.
        leaf: what can be seen of the door itself.
    """

    axis: int
    faces: tuple[float, float]
    middle: float
    width: float
    wall: tuple[float, float]
    leaf: Leaf

    @property
    def place(self) -> tuple[float, float]:
        """The middle of the opening."""
        through = sum(self.faces) / 2
        return (through, self.middle) if self.axis == 0 else (self.middle, through)


@dataclass
class Drawing:
    """The building as far as it is drawn: lines (x, y, x, y) of every material, and free-standing things."""

    lines: dict[Material, list[tuple[float, ...]]]
    doors: list[Door]
    boxes: list[tuple[float, float, float, float, float]]
    """x, y, half the length, half the width and direction of furniture."""
    legs: list[tuple[float, float, float, float, float]]
    """The same of thin things: a cross of two lines each."""


def as_walls(drawing: Drawing) -> Walls:
    """All that was drawn, without the furniture that would stand in a doorway."""
    boxes = _keep_doorways_free(np.array(drawing.boxes).reshape(-1, 5), drawing.doors)
    legs = _keep_doorways_free(np.array(drawing.legs).reshape(-1, 5), drawing.doors)
    walls = [upright(np.array(lines).reshape(-1, 4), material) for material, lines in drawing.lines.items()]
    square = np.array([[-1, -1, 1, -1], [1, -1, 1, 1], [1, 1, -1, 1], [-1, 1, -1, -1]])
    cross = np.array([[-1, -1, 1, 1], [-1, 1, 1, -1]])
    return join([*walls, upright(_shapes(boxes, square), WOOD), upright(_shapes(legs, cross), WOOD)])


def _keep_doorways_free(things: FloatArray, doors: Sequence[Door]) -> FloatArray:
    places, halves = np.array([d.place for d in doors]), np.array([d.width / 2 for d in doors])
    apart = np.linalg.norm(things[:, None, :2] - places, axis=2)
    reach = np.hypot(things[:, 2], things[:, 3])
    return things[(apart > reach[:, None] + halves + 0.5).all(axis=1)]


def _shapes(things: FloatArray, corners: npt.NDArray) -> FloatArray:
    """Lines (L * K, 4) of a shape of ``corners`` (L, 4), unit size, for each of ``things`` (K, 5)."""
    x, y, half_length, half_width, direction = (column[:, None] for column in things.T)
    ends = []
    for end in (0, 2):
        u, v = half_length * corners[:, end], half_width * corners[:, end + 1]
        ends += [
            x + u * np.cos(direction) - v * np.sin(direction),
            y + u * np.sin(direction) + v * np.cos(direction),
        ]
    return np.stack(ends, axis=-1).reshape(-1, 4)


def upright(ends: FloatArray, material: Material) -> Walls:
    """Walls of one material over lines (S, 4) on the floor, as high as the laser looks."""
    count = len(ends)
    return Walls(
        ends.astype(np.float64),
        np.tile(HEIGHTS, (count, 1)),
        np.full(count, material.returned),
        np.full(count, material.roughness),
    )
