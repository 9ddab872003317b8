"""The map of a building's floor: where a robot or a person has room."""

from dataclasses import dataclass

import numpy as np
import numpy.typing as npt
from scipy import ndimage

from rcnn_odom.geometry import FloatArray
from rcnn_odom.simulation.scene import Walls

CELL = 0.1
"""Metres between the points of the floor's map."""
ROOM_TO_DRIVE = 0.45
"""Metres between the middle of a robot and the nearest wall, at least."""


@dataclass(frozen=True)
class Floor:
    """Where there is room on the floor.

    Attributes:
        clearance: (X, Y) metres to the nearest wall, at every corner of a grid of ``CELL`` that begins at
            the origin; never more than the true distance.
        reachable: (X, Y) where a robot can be, all of it from everywhere.
    """

    clearance: FloatArray
    reachable: npt.NDArray[np.bool_]

    def room_at(self, points: FloatArray) -> FloatArray:
        """Metres to the nearest wall from points (..., 2); 0 outside of the building."""
        cells = np.moveaxis(points, -1, 0) / CELL
        return ndimage.map_coordinates(self.clearance, cells, order=1, mode="constant")


def map_floor(walls: Walls, far_corner: tuple[float, float]) -> Floor:
    """The clearance everywhere, and the largest connected part where a robot fits."""
    length = np.hypot(*(walls.ends[:, 2:] - walls.ends[:, :2]).T)
    pieces = 1 + (length / (CELL / 2)).astype(int)
    wall = np.repeat(np.arange(len(walls)), pieces + 1)
    first = np.cumsum(pieces + 1) - pieces - 1
    along = (np.arange(len(wall)) - first[wall]) / pieces[wall]
    points = (walls.ends[wall, :2] + along[:, None] * (walls.ends[wall, 2:] - walls.ends[wall, :2])) / CELL
    free = np.ones(np.ceil(np.array(far_corner) / CELL).astype(int) + 16, dtype=bool)
    # All four corners around a point: whichever way one looks, the map's wall is not behind the true one.
    low, high = np.floor(points + 1e-6).astype(int), np.ceil(points - 1e-6).astype(int)
    for x in (low[:, 0], high[:, 0]):
        for y in (low[:, 1], high[:, 1]):
            free[x, y] = False
    clearance = CELL * ndimage.distance_transform_edt(free)
    parts, _ = ndimage.label(clearance >= ROOM_TO_DRIVE)
    # The first part is the open country around the building: it holds the origin.
    sizes = np.bincount(parts.ravel())
    sizes[[0, parts[0, 0]]] = 0
    return Floor(clearance, parts == sizes.argmax())
