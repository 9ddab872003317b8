"""The local map: voxels, each with the mean point and the mean normal of the points in it."""

import numpy as np

from rcnn_odom.compiled import compiled
from rcnn_odom.geometry import FloatArray

SLOTS = 1 << 16
"""Slots of the hash table, a power of two."""
MOST_CELLS = 20_000
"""A map with so many cells takes no new ones until some are forgotten. Usual maps are far smaller."""


class LocalMap:
    """Points with normals in a fixed frame, averaged in voxels and forgotten after some distance.

    A voxel has one cell for each of four directions of normals, so that both sides of a thin wall stay apart.

    Args:
        voxel: edge length in metres.
        most_weight: number of points from which on a new point changes the mean by a constant share.

    Example:
        Two points of a wall fall into one cell, which becomes their mean with weight 2:

        >>> grid, normals = LocalMap(voxel=0.1, most_weight=10.0), np.array([[-1.0, 0.0], [-1.0, 0.0]])
        >>> grid.add(np.array([[2.02, 0.05], [2.04, 0.05]]), normals, pose=np.zeros(3), travelled=0.0)
        >>> grid.present().round(3) + 0.0
        array([[ 2.03,  0.05, -1.  ,  0.  ,  2.  ,  0.  ]])
        >>> grid.forget(before=5.0)  # the laser has moved on; this wall was last seen at 0 m
        >>> len(grid.present())
        0
    """

    def __init__(self, voxel: float, most_weight: float) -> None:
        self.voxel, self.most_weight = voxel, most_weight
        self.cells = np.empty((MOST_CELLS, 6))
        self.keys = np.empty(MOST_CELLS, np.int64)
        self.slots = np.full(SLOTS, -1, np.int32)
        self.count = 0

    def clear(self) -> None:
        """Removes all cells.

        Example:
            >>> grid = LocalMap(voxel=0.1, most_weight=10.0)
            >>> grid.add(np.ones((1, 2)), np.array([[-1.0, 0.0]]), pose=np.zeros(3), travelled=0.0)
            >>> grid.clear()
            >>> len(grid.present())
            0
        """
        self.slots[:] = -1
        self.count = 0

    def add(self, points: FloatArray, normals: FloatArray, pose: FloatArray, travelled: float) -> None:
        """Adds points that were seen from a pose.

        Args:
            points, normals: (P, 2) metres and unit vectors in the laser's frame.
            pose: (3,) metres and radians in the map's frame.
            travelled: metres travelled to that pose.
        """
        self.count = _add(
            points,
            normals,
            pose,
            travelled,
            self.voxel,
            self.most_weight,
            self.cells,
            self.keys,
            self.slots,
            self.count,
        )

    def present(self) -> FloatArray:
        """The cells (C, 6): x and y in metres, normal, weight, and metres travelled when last seen."""
        return self.cells[: self.count]

    def forget(self, before: float) -> None:
        """Removes the cells that were last seen before so many metres travelled."""
        self.count = _forget(before, self.cells, self.keys, self.slots, self.count)


@compiled
def _key(column, row, nx, ny):  # type: ignore[no-untyped-def]
    """The key of a cell: 29 bits for each index of the voxel and two for the direction of the normal."""
    side = (nx <= 0) if abs(nx) > abs(ny) else 2 + (ny <= 0)
    return (((column & 0x1FFFFFFF) << 29 | (row & 0x1FFFFFFF)) << 2) | side


@compiled
def _slot(key, slots, keys):  # type: ignore[no-untyped-def]
    """The slot of a key in the hash table, or the free slot where it belongs."""
    mixed = key * np.int64(-7046029254386353131)
    place = (mixed >> 40) & (SLOTS - 1)
    while slots[place] >= 0 and keys[slots[place]] != key:
        place = (place + 1) & (SLOTS - 1)
    return place


@compiled
def _add(  # type: ignore[no-untyped-def]
    points, normals, pose, travelled, voxel, most, cells, keys, slots, count
):
    """Adds points to the cells; returns the new number of cells."""
    cos, sin = np.cos(pose[2]), np.sin(pose[2])
    for i in range(len(points)):
        x = pose[0] + cos * points[i, 0] - sin * points[i, 1]
        y = pose[1] + sin * points[i, 0] + cos * points[i, 1]
        nx = cos * normals[i, 0] - sin * normals[i, 1]
        ny = sin * normals[i, 0] + cos * normals[i, 1]
        key = _key(np.int64(np.floor(x / voxel)), np.int64(np.floor(y / voxel)), nx, ny)
        place = _slot(key, slots, keys)
        cell = slots[place]
        if cell < 0:
            if count == len(cells):
                continue
            cell = count
            slots[place], keys[cell] = cell, key
            cells[cell] = (x, y, nx, ny, 1.0, travelled)
            count += 1
            continue
        weight = min(cells[cell, 4], most)
        share = 1 / (weight + 1)
        cells[cell, 0] += share * (x - cells[cell, 0])
        cells[cell, 1] += share * (y - cells[cell, 1])
        nx, ny = (
            cells[cell, 2] + share * (nx - cells[cell, 2]),
            cells[cell, 3] + share * (ny - cells[cell, 3]),
        )
        length = np.sqrt(nx * nx + ny * ny)
        if length > 1e-9:
            cells[cell, 2], cells[cell, 3] = nx / length, ny / length
        cells[cell, 4], cells[cell, 5] = weight + 1, travelled
    return count


@compiled
def _forget(before, cells, keys, slots, count):  # type: ignore[no-untyped-def]
    """Moves the remaining cells to the front and rebuilds the hash table; returns their number."""
    slots[:] = -1
    kept = 0
    for cell in range(count):
        if cells[cell, 5] >= before:
            cells[kept], keys[kept] = cells[cell], keys[cell]
            slots[_slot(keys[kept], slots, keys)] = kept
            kept += 1
    return kept
