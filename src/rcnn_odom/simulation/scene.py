"""What a laser can hit, in whatever world: upright rectangles, standing or moving, and the ground."""

from collections.abc import Sequence
from dataclasses import dataclass, fields

import numpy as np
import numpy.typing as npt

from rcnn_odom.geometry import FloatArray
from rcnn_odom.simulation.terrain import Ground


@dataclass(frozen=True)
class Material:
    """How a laser sees a surface.

    Attributes:
        returned: chance that a beam comes back.
        roughness: standard deviation of the depth in metres, beyond the laser's own noise.
    """

    returned: float = 1.0
    roughness: float = 0.0


@dataclass(frozen=True)
class Walls:
    """Upright rectangles, S of them: a house is some, a tree trunk is five narrow ones.

    Attributes:
        ends: (S, 4) metres: x and y of one end, x and y of the other.
        heights: (S, 2) metres: bottom and top, in the world's z.
        returned: (S,) chance that a beam comes back.
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
    """All of them as one."""
    return Walls(*(np.concatenate([getattr(w, column.name) for w in walls]) for column in fields(Walls)))


NO_WALLS = Walls(np.zeros((0, 4)), np.zeros((0, 2)), np.zeros(0), np.zeros(0))


@dataclass(frozen=True)
class Scene:
    """All that a drive of N frames passes.

    Attributes:
        standing: what does not move.
        moving: where the walls of all that moves are, frame after frame.
        moving_starts: (N + 1,) where in ``moving`` every frame begins.
        ground: None where a laser looks level over a floor and never meets it.
    """

    standing: Walls
    moving: Walls
    moving_starts: npt.NDArray[np.int64]
    ground: Ground | None = None

    def walls(self, frame: int) -> Walls:
        """Those of one frame, the standing ones first."""
        start, stop = self.moving_starts[frame : frame + 2]
        return join([self.standing, self.moving[start:stop]]) if stop > start else self.standing
