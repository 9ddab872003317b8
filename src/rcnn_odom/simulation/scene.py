"""The scene that a laser measures: standing and moving upright rectangles, and the ground."""

from collections.abc import Sequence
from dataclasses import dataclass, fields

import numpy as np
import numpy.typing as npt

from rcnn_odom.geometry import FloatArray
from rcnn_odom.simulation.terrain import Ground


@dataclass(frozen=True)
class Material:
    """Properties of a surface for a laser.

    Attributes:
        returned: probability that a beam is returned.
        roughness: metres, standard deviation of the surface's depth, in addition to the laser's noise.
    """

    returned: float = 1.0
    roughness: float = 0.0


@dataclass(frozen=True)
class Walls:
    """S upright rectangles; a tree trunk, for instance, is five narrow ones.

    Attributes:
        ends: (S, 4) metres: x and y of one end, x and y of the other.
        heights: (S, 2) metres: z of the bottom and of the top in the world.
        returned: (S,) probability that a beam is returned.
        roughness: (S,) metres, standard deviation of the depth.
    """

    ends: FloatArray
    heights: FloatArray
    returned: FloatArray
    roughness: FloatArray

    def __len__(self) -> int:
        return len(self.ends)

    def __getitem__(self, chosen: slice | npt.NDArray) -> "Walls":
        return Walls(*(getattr(self, column.name)[chosen] for column in fields(self)))


def join(walls: Sequence[Walls]) -> Walls:
    """Join several sets of walls to one."""
    return Walls(*(np.concatenate([getattr(w, column.name) for w in walls]) for column in fields(Walls)))


NO_WALLS = Walls(np.zeros((0, 4)), np.zeros((0, 2)), np.zeros(0), np.zeros(0))


@dataclass(frozen=True)
class Scene:
    """All objects along a drive of N frames.

    Attributes:
        standing: walls that do not move.
        moving: walls of moving objects, those of one frame after those of the frame before.
        moving_starts: (N + 1,) index in ``moving`` of the first wall of each frame, and number of all.
        ground: the ground; None: the laser is level above a floor and never hits it.
    """

    standing: Walls
    moving: Walls
    moving_starts: npt.NDArray[np.int64]
    ground: Ground | None = None

    def walls(self, frame: int) -> Walls:
        """The walls of a frame, the standing ones first."""
        start, stop = self.moving_starts[frame : frame + 2]
        return join([self.standing, self.moving[start:stop]]) if stop > start else self.standing
