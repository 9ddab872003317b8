"""What the laser has seen lately: voxels, each with the mean point and the mean normal of what fell into it."""

import numpy as np
from numba import njit

from rcnn_odom.geometry import FloatArray

SLOTS = 1 << 16
"""Of the hash table; a power of two."""
MOST_CELLS = 20_000
"""A bound that no usual map comes near: the table stays mostly empty."""
X, Y, NX, NY, WEIGHT, SEEN = range(6)


class LocalMap:
    """Points with normals in a fixed frame, averaged in voxels and forgotten by how far the laser has come.

    A voxel has a cell for each of four directions of normals, so that both sides of a thin wall stay apart.

    Args:
        voxel: metres.
        most_weight: scans after which a cell's mean only follows new ones slowly.
    """

    def __init__(self, voxel: float, most_weight: float) -> None:
        self.voxel, self.most_weight = voxel, most_weight
        self.cells = np.empty((MOST_CELLS, 6))
        self.keys = np.empty(MOST_CELLS, np.int64)
        self.slots = np.full(SLOTS, -1, np.int32)
        self.count = 0

    def clear(self) -> None:
        """Forgets everything."""
        self.slots[:] = -1
        self.count = 0

    def add(self, points: FloatArray, normals: FloatArray, pose: FloatArray, travelled: float) -> None:
        """Adds what was seen from a pose (x, y, heading) after so many metres."""
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
        """Its cells (C, 6): x, y, normal, weight, and the metres after which each was seen last."""
        return self.cells[: self.count]

    def forget(self, before: float) -> None:
        """Removes what was last seen before the laser had come so many metres."""
        self.count = _forget(before, self.cells, self.keys, self.slots, self.count)


@njit(cache=True)
def _slot(key, slots, keys):  # type: ignore[no-untyped-def]
    """Where a key is in the table, or the free slot where it belongs."""
    mixed = key * np.int64(-7046029254386353131)
    place = (mixed >> 40) & (SLOTS - 1)
    while slots[place] >= 0 and keys[slots[place]] != key:
        place = (place + 1) & (SLOTS - 1)
    return place


@njit(cache=True)
def _add(points, normals, pose, travelled, voxel, most, cells, keys, slots, count):  # type: ignore[no-untyped-def]
    cos, sin = np.cos(pose[2]), np.sin(pose[2])
    for i in range(len(points)):
        x = pose[0] + cos * points[i, 0] - sin * points[i, 1]
        y = pose[1] + sin * points[i, 0] + cos * points[i, 1]
        nx = cos * normals[i, 0] - sin * normals[i, 1]
        ny = sin * normals[i, 0] + cos * normals[i, 1]
        if abs(nx) > abs(ny):
            side = 0 if nx > 0 else 1
        else:
            side = 2 if ny > 0 else 3
        column, row = np.int64(np.floor(x / voxel)), np.int64(np.floor(y / voxel))
        key = (((column & 0x1FFFFFFF) << 29 | (row & 0x1FFFFFFF)) << 2) | side
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


@njit(cache=True)
def _forget(before, cells, keys, slots, count):  # type: ignore[no-untyped-def]
    slots[:] = -1
    kept = 0
    for cell in range(count):
        if cells[cell, 5] >= before:
            cells[kept], keys[kept] = cells[cell], keys[cell]
            slots[_slot(keys[kept], slots, keys)] = kept
            kept += 1
    return kept
