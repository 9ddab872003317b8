"""Point-to-line alignment of a scan with a map by Gauss-Newton steps.

Censi, "An ICP variant using a point-to-line metric", ICRA 2008. Corresponding points are found by their
bearings, residuals have Cauchy weights, and the largest distance between corresponding points (the gate)
shrinks in every step.
"""

from typing import NamedTuple

import numpy as np

from rcnn_odom.compiled import compiled
from rcnn_odom.geometry import FloatArray

BINS = 1024
"""Bins of bearings in a :class:`Table`."""
BEHIND = 1.0
"""Metres: a wall is kept if the laser is less far behind it, because the laser's position is uncertain."""
FEWEST_PAIRS = 6
"""Minimum number of pairs for an alignment."""
COARSE, ENOUGH = 3, 100
"""While the gate shrinks, only every third point is used, if that leaves at least a hundred."""
SETTLED = 1e-4
"""Converged when x and y change by less (metres) and the heading by less than a tenth of it (radians)."""
NORMAL_FROM_MEDIAN = 1.4826
"""Standard deviation of a normal distribution divided by the median of its absolute values."""
DAMPING = 1e-6
"""Added to the mean information of the pairs; damping keeps unconstrained directions from diverging."""


class Table(NamedTuple):
    """Map points sorted by their bearing from a centre.

    Attributes:
        entries: (M, 4) x and y in metres from the centre, along the map's axes, and the normal; sorted by
            bin.
        starts: (BINS + 1,) index of the first entry of each bin of bearings, and M at the end.
        centre: (2,) metres in the map's frame.

    Example:
        >>> cells = np.array([[0.0, 3.0, 0.0, -1.0, 1.0, 0.0], [3.0, 0.0, -1.0, 0.0, 1.0, 0.0]])
        >>> table = build_table(cells, 0.0, np.array([1.0, 0.0]), farthest=50.0)
        >>> table.entries + 0.0  # seen from (1, 0), with the smaller bearing first
        array([[ 2.,  0., -1.,  0.],
               [-1.,  3.,  0., -1.]])
    """

    entries: FloatArray
    starts: np.ndarray
    centre: FloatArray


@compiled
def bearing_bin(x, y):  # type: ignore[no-untyped-def]
    """The bin of a direction. Bins are sorted by bearing, and each is at least 4 / BINS radians wide.

    The rank of a direction is y / (|x| + |y|), continued to -2 ... 2 around the circle. It grows by 0.5 to 1
    per radian and needs no arctangent.

    Example:
        >>> bearing_bin(0.0, -1.0), bearing_bin(1.0, 0.0), bearing_bin(0.0, 1.0)  # right, ahead, left
        (256, 512, 768)
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
    """Writes ``entries`` and ``starts`` of a :class:`Table`; returns the number of entries."""
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
    """The cells of a map that are visible from a position.

    Args:
        cells: (C, 6) as returned by :meth:`rcnn_odom.matching.local_map.LocalMap.present`.
        since: metres travelled; cells that were last seen earlier are left out.
        centre: (2,) metres in the map's frame, near the laser. Cells that face away from it are left out.
        farthest: metres from the centre; cells that are farther away are left out.

    Example:
        Two walls with normals along -x: the one ahead faces the laser, the one behind faces away.

        >>> cells = np.array([[2.0, 0.0, -1.0, 0.0, 1.0, 0.0], [-2.0, 0.0, -1.0, 0.0, 1.0, 0.0]])
        >>> build_table(cells, since=0.0, centre=np.zeros(2), farthest=50.0).entries
        array([[ 2.,  0., -1.,  0.]])
    """
    entries, starts = np.empty((len(cells), 4)), np.empty(BINS + 1, np.int64)
    count = _fill_table(cells, since, centre, farthest, entries, starts)
    return Table(entries[:count], starts, np.array(centre[:2]))


@compiled
def nearest(entries, starts, x, y, nx, ny, gate, same):  # type: ignore[no-untyped-def]
    """The entry nearest to a point among those with a similar normal.

    The search begins in the bin of the point and continues on both sides. It stops when all points in the
    direction of the next bin are farther away than the best entry so far.

    Args:
        entries, starts: of a :class:`Table`.
        x, y: metres from the table's centre.
        nx, ny: normal of the point.
        gate: largest distance in metres.
        same: least cosine between the normals.

    Returns:
        The index of the entry; -1 if none is within the gate.

    Example:
        >>> cells = np.array([[2.0, -1.0, -1.0, 0.0, 1.0, 0.0], [2.0, 1.0, -1.0, 0.0, 1.0, 0.0]])
        >>> entries, starts, _ = build_table(cells, 0.0, np.zeros(2), 50.0)
        >>> nearest(entries, starts, 2.1, 0.8, -1.0, 0.0, 0.5, 0.7)  # the second entry, 0.22 m away
        1
        >>> nearest(entries, starts, 2.1, 0.8, 0.0, 1.0, 0.5, 0.7)  # the normals differ by 90 degrees
        -1
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
    """The pose at which the points of a scan lie on the lines of the map.

    Args:
        points, normals: (K, 2) of the scan, metres and unit vectors in the laser's frame.
        entries, starts, centre: of a :class:`Table`.
        start: (3,) pose in the map's frame to begin from, metres and radians.
        guess: (3,) mean of the prior of the pose.
        stiffness: (3, 3) information of the prior, relative to the mean information of the pairs.
        gate: largest distance in metres between partners in the first step.
        sparse: radians; multiplied by the range of a point it is added to its gate, because beams that hit
            far walls are far apart.
        lines: number of points, from the first one on, that count for the second score.
        settings: (6,) the smallest gate in metres, the factor by which the gate shrinks in each step, the
            least cosine between the normals of partners, the least scale of the weights as a fraction of the
            gate, the largest number of steps, and the residual in metres with a score of 0.
        found: (7, 3), written by the function. Rows 0 to 2: the information (3, 3) on x, y and heading, a
            mean over the pairs. Rows 3 to 5: the spurious part of it from errors of the normals, for errors
            of 1 radian. Row 6: the sum of the weights, the weighted mean square of the residuals in square
            metres, and the share of points with a partner.

    Returns:
        The pose (3,) and two scores from 0 to 1, of all points and of those on lines: the mean of one minus
        the squared ratio of residual and width, or 0 for points with a larger residual or without a partner.

    Example:
        Two walls, 2 m ahead and 2 m to the left, seen from 0.1 m ahead of the centre and 0.2 m left of it:

        >>> from rcnn_odom.matching.registration import SETTINGS
        >>> places, normals = np.linspace(-1.0, 1.0, 9), np.repeat([[-1.0, 0.0], [0.0, -1.0]], 9, axis=0)
        >>> points = np.array([[2.0, y] for y in places] + [[x, 2.0] for x in places])
        >>> table = build_table(np.hstack([points, normals, np.zeros((18, 2))]), 0.0, np.zeros(2), 50.0)
        >>> prior = np.zeros(3), np.zeros(3), np.zeros((3, 3))  # start and guess; no stiffness
        >>> options = 1.0, 0.0, 18, SETTINGS, np.empty((7, 3))  # gate, sparse, lines, settings, found
        >>> pose, *scores = align(points - [0.1, 0.2], normals, *table, *prior, *options)
        >>> pose.round(3) + 0.0
        array([0.1, 0.2, 0. ])
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
    line_score = _score(partners[:lines], residuals[:lines], width)
    return pose, _score(partners, residuals, width), line_score


@compiled
def _pair(  # type: ignore[no-untyped-def]
    points, normals, entries, starts, centre, pose, turn, limits, residuals, sizes, partners
):
    """Finds the partners of the points, the nearest entries of the map.

    Args:
        points, normals, entries, starts, centre, pose: as in :func:`align`.
        turn: cosine and sine of the pose's heading.
        limits: the stride n, so that every n-th point is used; gate and sparse as in :func:`align`; and the
            least cosine between normals.
        residuals, partners: (K,), written for these points: metres, and the index of the entry or -1.
        sizes: (K,), its first elements are set to the absolute residuals of the pairs.

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
    """The score of points with these partners (K,) and residuals (K,), as in :func:`align`."""
    score = 0.0
    for i in range(len(partners)):
        if partners[i] >= 0:
            score += max(0.0, 1 - (residuals[i] / width) ** 2)
    return score / len(partners)


@compiled
def _sum_up(points, entries, partners, residuals, stride, turn, scale, found):  # type: ignore[no-untyped-def]
    """Writes ``found`` of :func:`align` except for the share of points with a partner.

    Returns:
        The gradient (3,) of half the weighted mean square of the residuals.
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
    """:func:`solve3` after ``DAMPING`` has been added to the diagonal of ``a`` in place."""
    for k in range(3):
        a[k, k] += DAMPING
    return solve3(a, b)


@compiled
def solve3(a, b):  # type: ignore[no-untyped-def]
    """The solution (3,) of a symmetric positive definite system by the Cholesky decomposition.

    Example:
        >>> solve3(np.diag([1.0, 2.0, 4.0]), np.array([1.0, 4.0, 2.0]))
        array([1. , 2. , 0.5])
    """
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
