"""The map of a building's floor: the clearance for a robot or a person."""

from dataclasses import dataclass

import numpy as np
import numpy.typing as npt
from scipy import ndimage

from rcnn_odom.geometry import FloatArray
from rcnn_odom.simulation.scene import Walls

CELL = 0.1
"""Metres between the points of the floor map."""
ROOM_TO_DRIVE = 0.45
"""Metres; least distance from the middle of a robot to the nearest wall."""


@dataclass(frozen=True)
class Floor:
    """The free space of a floor.

    Attributes:
        clearance: (X, Y) metres to the nearest wall, at the points of a grid with spacing ``CELL`` that
            begins at the origin; never more than the true distance.
        reachable: (X, Y) whether a robot can be there; all these points are connected.
    """

    clearance: FloatArray
    reachable: npt.NDArray[np.bool_]

    def room_at(self, points: FloatArray) -> FloatArray:
        """Distances (...) in metres from points (..., 2) to the nearest wall; 0 outside of the building."""
        cells = np.moveaxis(points, -1, 0) / CELL
        return ndimage.map_coordinates(self.clearance, cells, order=1, mode="constant")


def map_floor(walls: Walls, far_corner: tuple[float, float]) -> Floor:
    """Compute the clearance, and the largest connected part of the floor where a robot fits.

    Args:
        walls: everything that stands on the floor.
        far_corner: x and y in metres of the corner opposite to the origin.
    """
    length = np.hypot(*(walls.ends[:, 2:] - walls.ends[:, :2]).T)
    pieces = 1 + (length / (CELL / 2)).astype(int)
    wall = np.repeat(np.arange(len(walls)), pieces + 1)
    first = np.cumsum(pieces + 1) - pieces - 1
    along = (np.arange(len(wall)) - first[wall]) / pieces[wall]
    points = (walls.ends[wall, :2] + along[:, None] * (walls.ends[wall, 2:] - walls.ends[wall, :2])) / CELL
    free = np.ones(np.ceil(np.array(far_corner) / CELL).astype(int) + 16, dtype=bool)
    # Marks all four grid points around a point of a wall, so the map never overestimates the clearance.
    low, high = np.floor(points + 1e-6).astype(int), np.ceil(points - 1e-6).astype(int)
    for x in (low[:, 0], high[:, 0]):
        for y in (low[:, 1], high[:, 1]):
            free[x, y] = False
    clearance = CELL * ndimage.distance_transform_edt(free)
    parts, _ = ndimage.label(clearance >= ROOM_TO_DRIVE)
    # The part that contains the origin is the open space around the building.
    sizes = np.bincount(parts.ravel())
    sizes[[0, parts[0, 0]]] = 0
    return Floor(clearance, parts == sizes.argmax())
