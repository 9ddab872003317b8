"""The outline of a scan, the input of the matcher: points, each with the normal of the line through it."""

from dataclasses import dataclass

import numpy as np

from rcnn_odom.compiled import compiled
from rcnn_odom.geometry import FloatArray

LINE_REACH, LINE_GAP = 0.2, 0.2
"""Metres from a point to the neighbours to which its line is fitted, and between two neighbours. A wider gap
is a jump to an object behind."""
SPARSE_REACH, SPARSE_GAP = 4.0, 8.0
"""Added for far points: multiples of the distance between neighbours on a wall that faces the laser."""
CLOSED = 8.0
"""A scan covers the whole circle if its last and first point are less than so many beam spacings apart."""
OVERLAP = 50
"""Points that are repeated at both ends of a full circle, so that lines continue across the ends."""
UNKNOWN_SPACING = 0.1
"""Radians, for a scan whose points all have the same bearing."""
SMALL = 0.6
"""Metres: an isolated object that is narrower is used as a whole, such as a post or a trunk."""
BESIDE = np.deg2rad(3.0)
"""Radians; a return at a larger angle is no neighbour."""
FEW_LINES = 200
"""With so many points on lines, isolated objects are left out, because they are less accurate."""
ENOUGH = 600
"""Lines per scan. With n times as many points (n = 2, 3, ...) a line is fitted to every n-th point only."""
FEWEST_ON_LINE = 3
"""Minimum number of points for a line."""
STRAIGHT = 0.1
"""Neighbours are no line if their variance across it, divided by the variance along it, is larger."""
TYPICAL = 0.7
"""Quantile of the scatter of lines that counts as typical: there are fewer rough objects than walls."""


@dataclass(frozen=True, eq=False)
class Outline:
    """The points of a scan that lie on lines.

    Attributes:
        points: (P, 2) metres, x forward, y left, projected on their lines, in angular order. If there are
            few, isolated objects follow, each as two equal points.
        normals: (P, 2) unit normals of the lines, towards the laser. An isolated object has one normal
            towards the laser and one across.
        returns: (R, 2) metres, all points of the scan, on lines or not.
        lines: number of the points that lie on lines; the points of isolated objects come after them.
        scatter: typical mean square distance of returns from their line, in square metres.
        normal_noise: mean square error of the normals that results from the scatter, in square radians.
        reach: median range of the points on lines in metres.
        spacing: median angle between neighbouring returns in radians.

    Example:
        A post 5 m ahead is one return on no line. It becomes two points, with normals back and across:

        >>> post = outline(np.array([[5.0, 0.0, 0.0]]))
        >>> post.lines, post.points.tolist(), (post.normals + 0.0).tolist()
        (0, [[5.0, 0.0], [5.0, 0.0]], [[-1.0, 0.0], [0.0, 1.0]])
    """

    points: FloatArray
    normals: FloatArray
    returns: FloatArray
    lines: int
    scatter: float
    normal_noise: float
    reach: float
    spacing: float


def outline(found: FloatArray) -> Outline:
    """The outline of a scan: a line is fitted to the neighbours of every point.

    Args:
        found: (R, 3) points as returned by :func:`rcnn_odom.matching.points.find_points`.

    Example:
        A straight wall 2 m ahead: all its points have x = 2 m and a normal that points back to the laser.

        >>> bearings = np.deg2rad(np.arange(-45.0, 46.0))
        >>> x, y = np.full(91, 2.0), 2.0 * np.tan(bearings)
        >>> wall = outline(np.stack([x, y, bearings], axis=1))
        >>> wall.lines, np.unique(wall.points[:, 0].round(6)), np.unique(wall.normals.round(6) + 0.0, axis=0)
        (91, array([2.]), array([[-1.,  0.]]))
    """
    points, normals = np.empty((3 * len(found), 2)), np.empty((3 * len(found), 2))
    count, *statistics = _fit_lines(found, points, normals) if len(found) > 2 else (0, 0.0, 0.0, 0.0, 0.0)
    lines = count
    if lines < FEW_LINES:
        count = _add_isolated(found, points, normals, lines)
    if not lines and count:
        statistics[2] = float(np.median(np.hypot(*points[:count].T)))
    return Outline(points[:count], normals[:count], found[:, :2], lines, *statistics)


@compiled
def _fit_lines(found, points, normals):  # type: ignore[no-untyped-def]
    """Writes the points on lines and their normals to ``points`` and ``normals``.

    Returns:
        Their number; scatter, noise of the normals, reach and spacing as in :class:`Outline`.
    """
    n = len(found)
    spacing = _median_spacing(found)
    # A full circle is closed by repeating points at both ends.
    closed = found[0, 2] + 2 * np.pi - found[n - 1, 2] < CLOSED * spacing
    extra = min(OVERLAP, n // 2) if closed else 0
    xy, radius = _unroll(found, extra)
    first, last = _connected(xy, radius, spacing)
    sums = _running_sums(xy)
    count, low, high = 0, 0, 0
    scatter, ranges, noise = np.empty(n), np.empty(n), 0.0
    for i in range(extra, extra + n, max(1, n // ENOUGH)):
        reach = (LINE_REACH + SPARSE_REACH * spacing * radius[i]) ** 2
        low, high = _neighbours(xy, i, reach, first[i], last[i], low, high)
        m = high + 1 - low
        if m < FEWEST_ON_LINE:
            continue
        x, y, nx, ny, across, along = _fit_line(sums, low, high)
        if across > STRAIGHT * along or along - across < 2e-12:
            continue
        off = (xy[i, 0] - x) * nx + (xy[i, 1] - y) * ny
        if nx * xy[i, 0] + ny * xy[i, 1] > 0:
            nx, ny, off = -nx, -ny, -off
        points[count, 0], points[count, 1] = xy[i, 0] - off * nx, xy[i, 1] - off * ny
        normals[count, 0], normals[count, 1] = nx, ny
        scatter[count], ranges[count] = max(across, 0.0), radius[i]
        # The variance of the direction of a line fitted to m points.
        noise += across / (m * along)
        count += 1
    if count == 0:
        return 0, 0.0, 0.0, 0.0, spacing
    usual, middle = int(TYPICAL * count), count // 2
    usual_scatter = np.partition(scatter[:count], usual)[usual]
    return count, usual_scatter, noise / count, np.partition(ranges[:count], middle)[middle], spacing


@compiled
def _median_spacing(found):  # type: ignore[no-untyped-def]
    """Median angle between neighbouring points in radians."""
    steps, apart = np.empty(len(found)), 0
    for i in range(1, len(found)):
        if found[i, 2] - found[i - 1, 2] > 1e-9:
            steps[apart] = found[i, 2] - found[i - 1, 2]
            apart += 1
    return np.partition(steps[:apart], apart // 2)[apart // 2] if apart else UNKNOWN_SPACING


@compiled
def _unroll(found, extra):  # type: ignore[no-untyped-def]
    """Points (T, 2), of which ``extra`` are repeated at each end of the circle, and their ranges (T,)."""
    n = len(found)
    xy = np.empty((n + 2 * extra, 2))
    for i in range(len(xy)):
        xy[i, 0], xy[i, 1] = found[(i - extra) % n, 0], found[(i - extra) % n, 1]
    return xy, np.sqrt(xy[:, 0] * xy[:, 0] + xy[:, 1] * xy[:, 1])


@compiled
def _connected(xy, radius, spacing):  # type: ignore[no-untyped-def]
    """For each point the first (T,) and the last (T,) point of its run of points without a jump."""
    total = len(xy)
    first, last = np.empty(total, np.int64), np.empty(total, np.int64)
    first[0], last[total - 1] = 0, total - 1
    for i in range(1, total):
        gap = LINE_GAP + SPARSE_GAP * spacing * min(radius[i], radius[i - 1])
        broken = (xy[i, 0] - xy[i - 1, 0]) ** 2 + (xy[i, 1] - xy[i - 1, 1]) ** 2 > gap * gap
        first[i] = i if broken else first[i - 1]
    for i in range(total - 2, -1, -1):
        last[i] = i if first[i + 1] == i + 1 else last[i + 1]
    return first, last


@compiled
def _running_sums(xy):  # type: ignore[no-untyped-def]
    """Cumulative sums (T + 1, 5) of x, y, xx, xy and yy, each over all earlier points."""
    sums = np.zeros((len(xy) + 1, 5))
    for i in range(len(xy)):
        x, y = xy[i, 0], xy[i, 1]
        sums[i + 1, 0], sums[i + 1, 1] = sums[i, 0] + x, sums[i, 1] + y
        sums[i + 1, 2], sums[i + 1, 3] = sums[i, 2] + x * x, sums[i, 3] + x * y
        sums[i + 1, 4] = sums[i, 4] + y * y
    return sums


@compiled
def _neighbours(xy, i, reach, first, last, low, high):  # type: ignore[no-untyped-def]
    """The first and the last neighbour of a point, found from those of the previous point.

    Args:
        xy: (T, 2) metres.
        i: index of the point.
        reach: square of the largest distance, in square metres.
        first, last: the run of connected points to which it belongs.
        low, high: the result for the previous point.
    """
    low, high = max(low, first), min(max(high, i), last)
    while low < i and _square(xy, low, i) > reach:
        low += 1
    while low > first and _square(xy, low - 1, i) <= reach:
        low -= 1
    while high > i and _square(xy, high, i) > reach:
        high -= 1
    while high < last and _square(xy, high + 1, i) <= reach:
        high += 1
    return low, high


@compiled
def _square(xy, i, j):  # type: ignore[no-untyped-def]
    """The squared distance between two points."""
    return (xy[i, 0] - xy[j, 0]) ** 2 + (xy[i, 1] - xy[j, 1]) ** 2


@compiled
def _fit_line(sums, low, high):  # type: ignore[no-untyped-def]
    """The line through points low to high: their mean, its normal, and the variances across and along it."""
    m = high + 1 - low
    x, y = (sums[high + 1, 0] - sums[low, 0]) / m, (sums[high + 1, 1] - sums[low, 1]) / m
    xx = (sums[high + 1, 2] - sums[low, 2]) / m - x * x
    xy = (sums[high + 1, 3] - sums[low, 3]) / m - x * y
    yy = (sums[high + 1, 4] - sums[low, 4]) / m - y * y
    mean, half = (xx + yy) / 2, np.sqrt(((xx - yy) / 2) ** 2 + xy * xy)
    # The eigenvector of the larger variance, from the row that is not nearly zero.
    along_x, along_y = (mean + half - yy, xy) if xx > yy else (xy, mean + half - xx)
    length = np.sqrt(along_x * along_x + along_y * along_y)
    if length == 0.0:
        return x, y, 0.0, 0.0, 0.0, 0.0
    return x, y, -along_y / length, along_x / length, mean - half, mean + half


@compiled
def _is_isolated(found, start, stop, radius):  # type: ignore[no-untyped-def]
    """Whether the neighbours of returns start to stop - 1, ``radius`` metres away, are far behind or absent.

    Returns at a grazing angle on a wall are also far apart, but there one of the neighbours is nearer.
    """
    n = len(found)
    for here, beside in ((start, start - 1), (stop - 1, stop)):
        other = beside % n
        apart = abs(found[other, 2] - found[here, 2])
        if min(apart, 2 * np.pi - apart) > BESIDE or start == other:
            continue
        if np.sqrt(found[other, 0] ** 2 + found[other, 1] ** 2) < radius + SMALL:
            return False
    return True


@compiled
def _add_isolated(found, points, normals, count):  # type: ignore[no-untyped-def]
    """Appends small isolated objects, each with a normal in both directions; returns the new count."""
    n = len(found)
    start = 0
    for i in range(1, n + 1):
        if i < n and (found[i, 0] - found[i - 1, 0]) ** 2 + (found[i, 1] - found[i - 1, 1]) ** 2 < SMALL**2:
            continue
        width = (found[i - 1, 0] - found[start, 0]) ** 2 + (found[i - 1, 1] - found[start, 1]) ** 2
        x, y = np.mean(found[start:i, 0]), np.mean(found[start:i, 1])
        radius = np.sqrt(x * x + y * y)
        if width < SMALL**2 and radius > 1e-3 and _is_isolated(found, start, i, radius):
            for k in range(2):
                points[count, 0], points[count, 1] = x, y
                normals[count, 0] = -x / radius if k == 0 else -y / radius
                normals[count, 1] = -y / radius if k == 0 else x / radius
                count += 1
        start = i
    return count
