"""A scan as the matcher sees it: points, each with the normal of the line it lies on."""

from dataclasses import dataclass

import numpy as np
from numba import njit

from rcnn_odom.geometry import FloatArray
from rcnn_odom.matching.numeric import quantile

LINE_REACH, LINE_GAP = 0.2, 0.2
"""Metres from a point to the neighbours that its line is fitted to, and between two of these: more is a jump
from one thing to another behind it."""
SPARSE_REACH, SPARSE_GAP = 4.0, 8.0
"""The same for far points, in distances between neighbours on a wall that is seen squarely; they add up."""
SMALL = 0.6
"""Metres across: what stands alone and is smaller is a thing such as a post or a trunk."""
FEW_LINES = 60
"""Points on lines, from which on things that stand alone are left out: they are less exact."""
ENOUGH = 600
"""Lines in a scan: of more points every second one, third one ... has its line fitted."""
STRAIGHT = 0.1
"""Spread across a line over the spread along it, as variances, above which neighbours are no line."""
TYPICAL = 0.7
"""Share of the lines whose returns scatter less than what counts as usual: rough things are fewer than walls."""
MOST_MOVES = 20
"""Places by which a point of a nearly sorted scan may move on average before a full sort is cheaper."""


@dataclass(frozen=True, eq=False)
class Outline:
    """The points of a scan that lie on lines.

    Attributes:
        points: (P, 2) metres, x forward, y left, in angular order. Where there are few, things that stand alone
            follow, each twice.
        normals: (P, 2) of the lines through them, unit length, towards the laser; of a thing that stands alone
            towards the laser and across.
        returns: (R, 2) all points of the scan, on lines or not.
        scatter: mean square distance of returns from their lines, in square metres.
        normal_noise: mean square error of the normals in square radians that follows from it.
        reach: median range of the points in metres.
        spacing: median angle between neighbouring returns in radians.
    """

    points: FloatArray
    normals: FloatArray
    returns: FloatArray
    scatter: float
    normal_noise: float
    reach: float
    spacing: float


def find_points(ranges: FloatArray, bearings: FloatArray, farthest: float) -> FloatArray:
    """The returns of a scan as points, in angular order.

    Args:
        ranges: (P,) metres; not positive, not finite, or at ``farthest`` or beyond: no return.
        bearings: (P,) radians, any order and any turn of the circle.
        farthest: metres.

    Returns:
        (R, 3): x and y in metres, and the bearing in [-pi, pi), by which they rise.
    """
    found = np.empty((len(ranges), 3))
    return found[: _find_points(ranges, bearings, farthest, found)]


@njit(cache=True)
def _find_points(ranges, bearings, farthest, found):  # type: ignore[no-untyped-def]
    """Fills x, y and bearing, sorted by bearing; how many there are."""
    n = 0
    for i in range(len(ranges)):
        if 0 < ranges[i] < farthest and abs(bearings[i]) < 1e6:
            b = bearings[i]
            if not -np.pi <= b < np.pi:
                b -= 2 * np.pi * np.floor((b + np.pi) / (2 * np.pi))
            found[n, 0], found[n, 1] = ranges[i] * np.cos(b), ranges[i] * np.sin(b)
            found[n, 2] = b
            n += 1
    falling = 0
    for i in range(1, n):
        falling += found[i, 2] < found[i - 1, 2]
    if 2 * falling > n:
        found[:n] = found[:n][::-1].copy()
    # A revolution that begins elsewhere than behind: its parts change places.
    for i in range(1, n):
        if found[i, 2] < found[i - 1, 2] - np.pi:
            found[:n] = np.concatenate((found[i:n], found[:i]))
            break
    moves = 0
    for i in range(1, n):
        j = i
        while j > 0 and found[j - 1, 2] > found[j, 2] and moves < MOST_MOVES * n:
            for k in range(3):
                found[j, k], found[j - 1, k] = found[j - 1, k], found[j, k]
            j -= 1
            moves += 1
    if moves >= MOST_MOVES * n:
        found[:n] = found[:n][np.argsort(found[:n, 2])]
    return n


def outline(found: FloatArray) -> Outline:
    """Fits a line to the neighbours of every point.

    Args:
        found: (R, 3) of :func:`find_points`.
    """
    points, normals = np.empty((3 * len(found), 2)), np.empty((3 * len(found), 2))
    count, *about = _fit_lines(found, points, normals) if len(found) > 2 else (0, 0.0, 0.0, 0.0, 0.0)
    if count < FEW_LINES:
        count = _add_things(found, points, normals, count)
    return Outline(points[:count], normals[:count], found[:, :2], *about)


@njit(cache=True)
def _fit_lines(found, points, normals):  # type: ignore[no-untyped-def]
    """Points on lines and their normals, by running sums along what is connected; how many there are, and
    the mean squares of :class:`Outline`."""
    n = len(found)
    steps, apart = np.empty(n), 0
    for i in range(1, n):
        if found[i, 2] - found[i - 1, 2] > 1e-9:
            steps[apart] = found[i, 2] - found[i - 1, 2]
            apart += 1
    spacing = quantile(steps, apart, 0.5) if apart else 0.1
    # The circle is closed by hanging as many points on both ends as a line reaches over.
    closed = found[0, 2] + 2 * np.pi - found[n - 1, 2] < 8 * spacing
    extra = min(50, n // 2) if closed else 0
    total = n + 2 * extra
    x, y = np.empty(total), np.empty(total)
    for i in range(total):
        x[i], y[i] = found[(i - extra) % n, 0], found[(i - extra) % n, 1]
    first, last = np.empty(total, np.int64), np.empty(total, np.int64)
    radius = np.sqrt(x * x + y * y)
    sums = np.zeros((total + 1, 5))
    first[0] = 0
    for i in range(total):
        sums[i + 1, 0], sums[i + 1, 1] = sums[i, 0] + x[i], sums[i, 1] + y[i]
        sums[i + 1, 2] = sums[i, 2] + x[i] * x[i]
        sums[i + 1, 3], sums[i + 1, 4] = sums[i, 3] + x[i] * y[i], sums[i, 4] + y[i] * y[i]
        if i:
            gap = LINE_GAP + SPARSE_GAP * spacing * min(radius[i], radius[i - 1])
            broken = (x[i] - x[i - 1]) ** 2 + (y[i] - y[i - 1]) ** 2 > gap * gap
            first[i] = i if broken else first[i - 1]
    last[total - 1] = total - 1
    for i in range(total - 2, -1, -1):
        last[i] = i if first[i + 1] == i + 1 else last[i + 1]
    count, low, high = 0, 0, 0
    scatter, ranges, noise = np.empty(n), np.empty(n), 0.0
    for i in range(extra, extra + n, max(1, n // ENOUGH)):
        reach = (LINE_REACH + SPARSE_REACH * spacing * radius[i]) ** 2
        low, high = max(low, first[i]), max(high, i)
        high = min(high, last[i])
        while low < i and (x[low] - x[i]) ** 2 + (y[low] - y[i]) ** 2 > reach:
            low += 1
        while low > first[i] and (x[low - 1] - x[i]) ** 2 + (y[low - 1] - y[i]) ** 2 <= reach:
            low -= 1
        while high > i and (x[high] - x[i]) ** 2 + (y[high] - y[i]) ** 2 > reach:
            high -= 1
        while high < last[i] and (x[high + 1] - x[i]) ** 2 + (y[high + 1] - y[i]) ** 2 <= reach:
            high += 1
        m = high + 1 - low
        if m < 3:
            continue
        mx, my = (sums[high + 1, 0] - sums[low, 0]) / m, (sums[high + 1, 1] - sums[low, 1]) / m
        xx = (sums[high + 1, 2] - sums[low, 2]) / m - mx * mx
        xy = (sums[high + 1, 3] - sums[low, 3]) / m - mx * my
        yy = (sums[high + 1, 4] - sums[low, 4]) / m - my * my
        mean, half = (xx + yy) / 2, np.sqrt(((xx - yy) / 2) ** 2 + xy * xy)
        if mean - half > STRAIGHT * (mean + half) or half < 1e-12:
            continue
        # The eigenvector of the larger spread, from the row that is not nearly zero.
        along_x, along_y = (mean + half - yy, xy) if xx > yy else (xy, mean + half - xx)
        length = np.sqrt(along_x * along_x + along_y * along_y)
        nx, ny = -along_y / length, along_x / length
        off = (x[i] - mx) * nx + (y[i] - my) * ny
        if nx * x[i] + ny * y[i] > 0:
            nx, ny, off = -nx, -ny, -off
        points[count, 0], points[count, 1] = x[i] - off * nx, y[i] - off * ny
        normals[count, 0], normals[count, 1] = nx, ny
        # Of a line through m points: their scatter across it over m times that along it.
        scatter[count], ranges[count] = max(mean - half, 0.0), radius[i]
        noise += (mean - half) / (m * (mean + half))
        count += 1
    if count == 0:
        return 0, 0.0, 0.0, 0.0, spacing
    return count, quantile(scatter, count, TYPICAL), noise / count, quantile(ranges, count, 0.5), spacing


@njit(cache=True)
def _add_things(found, points, normals, count):  # type: ignore[no-untyped-def]
    """Appends small things that stand alone, as points that are held both ways; how many points there are."""
    n = len(found)
    start = 0
    for i in range(1, n + 1):
        if i < n and (found[i, 0] - found[i - 1, 0]) ** 2 + (found[i, 1] - found[i - 1, 1]) ** 2 < SMALL**2:
            continue
        wide = (found[i - 1, 0] - found[start, 0]) ** 2 + (found[i - 1, 1] - found[start, 1]) ** 2
        x, y = np.mean(found[start:i, 0]), np.mean(found[start:i, 1])
        radius = np.sqrt(x * x + y * y)
        if wide < SMALL**2 and radius > 1e-3:
            for k in range(2):
                points[count, 0], points[count, 1] = x, y
                normals[count, 0] = -x / radius if k == 0 else -y / radius
                normals[count, 1] = -y / radius if k == 0 else x / radius
                count += 1
        start = i
    return count
