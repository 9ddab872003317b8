"""Point-to-line alignment of a scan with a map: partners by bearing, robust weights, Gauss-Newton.

Censi, "An ICP variant using a point-to-line metric", ICRA 2008. The weights are Cauchy's and the gate on the
distance between partners closes from step to step.
"""

from typing import NamedTuple

import numpy as np
from numba import njit

from rcnn_odom.geometry import FloatArray
from rcnn_odom.matching.numeric import quantile, solve3

BINS = 1024
"""Of the table of bearings."""
BEHIND = 1.0
"""Metres behind a wall from which on the laser cannot see its face."""
FEWEST_PAIRS = 6
COARSE, ENOUGH = 3, 100
"""Every so-manieth point is enough while the gate closes, if there are so many of them then."""
SETTLED = 1e-4
"""Metres: a change of the pose below it, and of the heading below a tenth in radians, is the last."""
DAMPING = 1e-6
"""Beside a mean square of 1: keeps unconstrained directions from diverging."""


class Table(NamedTuple):
    """Map points sorted by their bearing from a centre.

    Attributes:
        entries: (M, 4) x, y relative to the centre, and the normal.
        starts: (BINS + 1,) where the entries of each bin of bearings begin.
        centre: (2,) metres, in the map's frame.
    """

    entries: FloatArray
    starts: np.ndarray
    centre: FloatArray


@njit(cache=True)
def bearing_bin(x, y):  # type: ignore[no-untyped-def]
    """Bin of a direction; bins grow with the bearing, and one is at least 4 / BINS radians wide.

    The rank is y / (|x| + |y|), unfolded to -2 ... 2 round the circle: it grows by 0.5 to 1 a radian.
    """
    total = abs(x) + abs(y)
    if total == 0.0:
        return 0
    rank = y / total
    if x < 0:
        rank = 2 - rank if y >= 0 else -2 - rank
    return min(BINS - 1, int((rank + 2) * (BINS / 4)))


@njit(cache=True)
def _fill_table(cells, since, centre, farthest, entries, starts):  # type: ignore[no-untyped-def]
    """Sorts cells seen since ``since`` metres and near enough by bearing; how many there are."""
    bins = np.empty(len(cells), np.int32)
    starts[:] = 0
    for i in range(len(cells)):
        x, y = cells[i, 0] - centre[0], cells[i, 1] - centre[1]
        bins[i] = -1
        behind = x * cells[i, 2] + y * cells[i, 3]
        if cells[i, 5] >= since and behind < BEHIND and x * x + y * y < farthest * farthest:
            bins[i] = bearing_bin(x, y)
            starts[bins[i] + 1] += 1
    for k in range(BINS):
        starts[k + 1] += starts[k]
    place = starts[:-1].copy()
    for i in range(len(cells)):
        if bins[i] >= 0:
            at = place[bins[i]]
            place[bins[i]] += 1
            entries[at, 0], entries[at, 1] = cells[i, 0] - centre[0], cells[i, 1] - centre[1]
            entries[at, 2], entries[at, 3] = cells[i, 2], cells[i, 3]
    return starts[BINS]


def build_table(cells: FloatArray, since: float, centre: FloatArray, farthest: float) -> Table:
    """Cells (C, 6) of a map, those seen since ``since`` metres, by their bearing from a centre (2,)."""
    entries, starts = np.empty((len(cells), 4)), np.empty(BINS + 1, np.int64)
    count = _fill_table(cells, since, centre, farthest, entries, starts)
    return Table(entries[:count], starts, np.array(centre[:2]))


@njit(cache=True)
def nearest(entries, starts, x, y, nx, ny, gate, same):  # type: ignore[no-untyped-def]
    """The entry nearest to a point whose normal agrees; -1 where none is within the gate.

    Walks outwards until the bearing alone is farther away than the best.
    """
    home = bearing_bin(x, y)
    best, found = gate * gate, -1
    radius = np.sqrt(x * x + y * y)
    for k in range(BINS // 2 + 1):
        if k > 1:
            angle = (k - 1) * (4.0 / BINS)
            apart = radius * np.sin(angle) if angle < np.pi / 2 else radius
            if apart * apart > best:
                break
        for side in range(2 if 0 < k < BINS // 2 else 1):
            b = (home + k if side == 0 else home - k) % BINS
            for i in range(starts[b], starts[b + 1]):
                dx, dy = entries[i, 0] - x, entries[i, 1] - y
                d = dx * dx + dy * dy
                if d < best and entries[i, 2] * nx + entries[i, 3] * ny > same:
                    best, found = d, i
    return found


@njit(cache=True)
def align(  # type: ignore[no-untyped-def]
    points, normals, entries, starts, centre, start, guess, stiffness, gate, sparse, settings, found
):
    """Moves a scan onto the map.

    Args:
        points, normals: (K, 2) of the scan, in the laser's frame.
        entries, starts, centre: of a :class:`Table`.
        start: (3,) pose in the map's frame to begin from.
        guess: (3,) pose to which a prior pulls.
        stiffness: (3, 3) of that pull, beside a mean square of 1 of the residuals' change.
        gate: metres between partners in the first step.
        sparse: radians; times its range it is added to the gate of a point, since far ones are far apart.
        settings: closest gate, by what it shrinks, cosine of normals, calm, most steps, score's width.
        found: (7, 3), gets the information on x, y and heading, a mean over the pairs, in its first three
            rows, that along the walls, on which only errors of normals act, in the next three, and in the last
            the sum of weights, the weighted mean square of the residuals in square metres, and the share
            of points with a partner.

    Returns:
        The pose (3,) and its score: the mean over all points of one minus their squared residual, nothing
        where that is over the width.
    """
    closest, shrink, same, calm, most_steps, width = settings
    n = len(points)
    pose = start.copy()
    residuals, sizes, partners = np.empty(n), np.empty(n), np.empty(n, np.int64)
    normal = np.empty((3, 3))
    for step in range(int(most_steps)):
        cos, sin = np.cos(pose[2]), np.sin(pose[2])
        stride = COARSE if gate > closest and n >= COARSE * ENOUGH else 1
        paired = 0
        for i in range(0, n, stride):
            x = cos * points[i, 0] - sin * points[i, 1] + pose[0] - centre[0]
            y = sin * points[i, 0] + cos * points[i, 1] + pose[1] - centre[1]
            nx = cos * normals[i, 0] - sin * normals[i, 1]
            ny = sin * normals[i, 0] + cos * normals[i, 1]
            away = sparse * np.sqrt(points[i, 0] ** 2 + points[i, 1] ** 2)
            j = nearest(entries, starts, x, y, nx, ny, gate + away, same)
            partners[i] = j
            if j >= 0:
                residuals[i] = (x - entries[j, 0]) * entries[j, 2] + (y - entries[j, 1]) * entries[j, 3]
                sizes[paired] = abs(residuals[i])
                paired += 1
        if paired < FEWEST_PAIRS:
            return pose, 0.0
        scale = max(calm * gate, 1.4826 * quantile(sizes, paired, 0.5))
        gradient = _sum_up(points, entries, partners, residuals, stride, cos, sin, scale, found)
        found[6, 2] = paired / n
        right = -gradient - stiffness @ (pose - guess)
        normal[:] = found[:3] + stiffness
        for k in range(3):
            normal[k, k] += DAMPING
        change = solve3(normal, right)
        pose += change
        settled = abs(change[0]) < SETTLED and abs(change[1]) < SETTLED and abs(change[2]) < SETTLED / 10
        if gate == closest and settled:
            break
        gate = max(closest, shrink * gate)
    score = 0.0
    for i in range(n):
        if partners[i] >= 0:
            score += max(0.0, 1 - (residuals[i] / width) ** 2)
    return pose, score / n


@njit(cache=True)
def _sum_up(points, entries, partners, residuals, stride, cos, sin, scale, found):  # type: ignore[no-untyped-def]
    """Fills ``found`` of :func:`align` but for the share; the gradient (3,) of half the mean square."""
    across, along = np.zeros((3, 3)), np.zeros((3, 3))
    gradient, total, squares = np.zeros(3), 0.0, 0.0
    for i in range(0, len(points), stride):
        j = partners[i]
        if j < 0:
            continue
        w = 1 / (1 + (residuals[i] / (2 * scale)) ** 2)
        rx = cos * points[i, 0] - sin * points[i, 1]
        ry = sin * points[i, 0] + cos * points[i, 1]
        a, b = entries[j, 2], entries[j, 3]
        c, d = b * rx - a * ry, a * rx + b * ry
        total += w
        squares += w * residuals[i] * residuals[i]
        across[0, 0] += w * a * a
        across[0, 1] += w * a * b
        across[0, 2] += w * a * c
        across[1, 1] += w * b * b
        across[1, 2] += w * b * c
        across[2, 2] += w * c * c
        along[0, 2] -= w * b * d
        along[1, 2] += w * a * d
        along[2, 2] += w * d * d
        gradient[0] += w * a * residuals[i]
        gradient[1] += w * b * residuals[i]
        gradient[2] += w * c * residuals[i]
    along[0, 0], along[0, 1], along[1, 1] = across[1, 1], -across[0, 1], across[0, 0]
    for k in range(3):
        for m in range(3):
            found[k, m] = across[min(k, m), max(k, m)] / total
            found[3 + k, m] = along[min(k, m), max(k, m)] / total
    found[6, 0], found[6, 1] = total, squares / total
    return gradient / total
