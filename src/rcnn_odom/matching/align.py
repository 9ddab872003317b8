"""Point-to-line alignment of a scan with a map: partners by bearing, robust weights, Gauss-Newton.

Censi, "An ICP variant using a point-to-line metric", ICRA 2008. The weights are Cauchy's and the gate on the
distance between partners closes from step to step.
"""

from typing import NamedTuple

import numpy as np

from rcnn_odom.compiled import compiled
from rcnn_odom.geometry import FloatArray

BINS = 1024
"""Bins of the table of bearings."""
BEHIND = 1.0
"""Metres by which the laser may stand behind a wall and still see it; its place is not exact."""
FEWEST_PAIRS = 6
"""Pairs without which nothing is aligned."""
COARSE, ENOUGH = 3, 100
"""While the gate is closing, every third point is enough, if at least a hundred are then left."""
SETTLED = 1e-4
"""Metres: it is done when x and y change by less, and the heading by less than a tenth of it in radians."""
NORMAL_FROM_MEDIAN = 1.4826
"""Standard deviation of a normal distribution over the median of its absolute values."""
DAMPING = 1e-6
"""Beside a mean information of 1; damping keeps unconstrained directions from diverging."""


class Table(NamedTuple):
    """Map points sorted by their bearing from a centre.

    Attributes:
        entries: (M, 4) x and y in metres from the centre, along the map's axes, and the normal; sorted by
            bin.
        starts: (BINS + 1,) index of the first entry of each bin of bearings, and M at the end.
        centre: (2,) metres in the map's frame.
    """

    entries: FloatArray
    starts: np.ndarray
    centre: FloatArray


@compiled
def bearing_bin(x, y):  # type: ignore[no-untyped-def]
    """The bin of a direction. Bins are sorted by bearing, and each is at least 4 / BINS radians wide.

    The rank is y / (|x| + |y|), unfolded to -2 ... 2 round the circle; it grows by 0.5 to 1 per radian.
    """
    total = abs(x) + abs(y)
    if total == 0.0:
        return 0
    rank = y / total
    if x < 0:
        rank = 2 - rank if y >= 0 else -2 - rank
    return min(BINS - 1, int((rank + 2) * (BINS / 4)))


@compiled
def _fill_table(cells, since, centre, farthest, entries, starts):  # type: ignore[no-untyped-def]
    """Fills in the entries and starts of :class:`Table`; returns the number of entries."""
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
    """The cells of a map that can be seen from a place.

    Args:
        cells: (C, 6) of :meth:`rcnn_odom.matching.local_map.LocalMap.present`.
        since: metres of the way; cells that were last seen before are left out.
        centre: (2,) metres in the map's frame, near the laser. Cells that turn their back to it are left out.
        farthest: metres from the centre; cells beyond are left out.
    """
    entries, starts = np.empty((len(cells), 4)), np.empty(BINS + 1, np.int64)
    count = _fill_table(cells, since, centre, farthest, entries, starts)
    return Table(entries[:count], starts, np.array(centre[:2]))


@compiled
def nearest(entries, starts, x, y, nx, ny, gate, same):  # type: ignore[no-untyped-def]
    """The entry nearest to a point among those whose normals agree with its normal.

    The search walks outwards from the point's bin. It stops where everything in a bin's direction is farther
    away than the best entry so far.

    Args:
        entries, starts: of a :class:`Table`.
        x, y: metres from the table's centre.
        nx, ny: the point's normal.
        gate: metres.
        same: least cosine between normals.

    Returns:
        Its index; -1 where none is nearer than the gate.
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


@compiled
def align(  # type: ignore[no-untyped-def]
    points, normals, entries, starts, centre, start, guess, stiffness, gate, sparse, lines, settings, found
):
    """Moves a scan onto the map.

    Args:
        points, normals: (K, 2) of the scan, metres and unit vectors in the laser's frame.
        entries, starts, centre: of a :class:`Table`.
        start: (3,) pose in the map's frame to begin from, metres and radians.
        guess: (3,) pose to which a prior pulls.
        stiffness: (3, 3) of that pull, beside the mean information of the pairs.
        gate: metres between partners in the first step.
        sparse: radians; times its range it is added to the gate of a point, since the beams that hit far
            walls are far apart.
        lines: so many of the points, the first ones, count for the second score.
        settings: (6,) metres of the closest gate, the factor by which the gate shrinks in each step, the
            least cosine between normals of partners, the least scale of the weights as a part of the gate,
            the largest number of steps, and the residual in metres that scores nothing.
        found: (7, 3), is filled in. Rows 0 to 2: the information (3, 3) on x, y and heading, a mean over the
            pairs. Rows 3 to 5: the information that the errors of normals feign, for errors of 1 radian.
            Row 6: the sum of the weights, the weighted mean square of the residuals in square metres, and the
            share of points with a partner.

    Returns:
        The pose (3,), and two scores from 0 to 1, of all points and of those on lines: the mean of one minus
        the square of residual over width, but 0 for points with a larger residual or without a partner.
    """
    closest, shrink, same, calm, most_steps, width = settings
    n, pose = len(points), start.copy()
    residuals, sizes, partners = np.empty(n), np.empty(n), np.empty(n, np.int64)
    for _ in range(int(most_steps)):
        stride = COARSE if gate > closest and n >= COARSE * ENOUGH else 1
        turn, limits = (np.cos(pose[2]), np.sin(pose[2])), (stride, gate, sparse, same)
        paired = _pair(
            points, normals, entries, starts, centre, pose, turn, limits, residuals, sizes, partners
        )
        if paired < FEWEST_PAIRS:
            return pose, 0.0, 0.0
        median = np.partition(sizes[:paired], paired // 2)[paired // 2]
        scale = max(calm * gate, NORMAL_FROM_MEDIAN * median)
        gradient = _sum_up(points, entries, partners, residuals, stride, turn, scale, found)
        found[6, 2] = paired / n
        change = _solve_damped(found[:3] + stiffness, -gradient - stiffness @ (pose - guess))
        pose += change
        settled = abs(change[0]) < SETTLED and abs(change[1]) < SETTLED and abs(change[2]) < SETTLED / 10
        if gate == closest and settled:
            break
        gate = max(closest, shrink * gate)
    of_lines = _score(partners[:lines], residuals[:lines], width)
    return pose, _score(partners, residuals, width), of_lines


@compiled
def _pair(  # type: ignore[no-untyped-def]
    points, normals, entries, starts, centre, pose, turn, limits, residuals, sizes, partners
):
    """Looks for the partners of the points.

    Args:
        points, normals, entries, starts, centre, pose: as in :func:`align`.
        turn: cosine and sine of the pose's heading.
        limits: n, for a partner of every n-th point; and gate, sparse and same as in :func:`align`.
        residuals, partners: (K,), are filled in for these points: metres, and entries or -1.
        sizes: (K,), its first places are filled with the absolute residuals of the pairs.

    Returns:
        The number of pairs.
    """
    cos, sin = turn
    stride, gate, sparse, same = limits
    paired = 0
    for i in range(0, len(points), stride):
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
    return paired


@compiled
def _score(partners, residuals, width):  # type: ignore[no-untyped-def]
    score = 0.0
    for i in range(len(partners)):
        if partners[i] >= 0:
            score += max(0.0, 1 - (residuals[i] / width) ** 2)
    return score / len(partners)


@compiled
def _sum_up(points, entries, partners, residuals, stride, turn, scale, found):  # type: ignore[no-untyped-def]
    """Fills in ``found`` of :func:`align` but for the share.

    Returns:
        The gradient (3,) of half the mean square.
    """
    across, along = np.zeros((3, 3)), np.zeros((3, 3))
    cos, sin = turn
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


@compiled
def _solve_damped(a, b):  # type: ignore[no-untyped-def]
    """The solution (3,) of a symmetric positive definite system, by Cholesky; ``DAMPING`` is added to it."""
    for k in range(3):
        a[k, k] += DAMPING
    return solve3(a, b)


@compiled
def solve3(a, b):  # type: ignore[no-untyped-def]
    """The solution (3,) of a symmetric positive definite system, by Cholesky."""
    l00 = np.sqrt(a[0, 0])
    l10, l20 = a[1, 0] / l00, a[2, 0] / l00
    l11 = np.sqrt(max(a[1, 1] - l10 * l10, 1e-300))
    l21 = (a[2, 1] - l20 * l10) / l11
    l22 = np.sqrt(max(a[2, 2] - l20 * l20 - l21 * l21, 1e-300))
    y0 = b[0] / l00
    y1 = (b[1] - l10 * y0) / l11
    y2 = (b[2] - l20 * y0 - l21 * y1) / l22
    out = np.empty(3)
    out[2] = y2 / l22
    out[1] = (y1 - l21 * out[2]) / l11
    out[0] = (y0 - l10 * out[1] - l20 * out[2]) / l00
    return out
