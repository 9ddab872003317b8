"""Computes how a scan would look from another pose: moves its points, or renders the surfaces between them.

With this, a pair of scans with a known motion gives training pairs of any motion. It also lets a network
measure the residual motion after a guess: the earlier scan is rendered from the guessed pose before the two
scans are compared (called warping in image registration).
"""

import math
from concurrent.futures import ThreadPoolExecutor
from functools import lru_cache, partial

import numpy as np
import numpy.typing as npt
from numba import njit

from rcnn_odom.compiled import compiled
from rcnn_odom.geometry import FloatArray
from rcnn_odom.models.encoding import Sensor

DepthVector = npt.NDArray[np.float32]

OCCLUSION_DEPTH = 0.5
"""Metres; a point that is so far behind the nearest point of its bin is hidden by it."""
LARGEST_GAP = math.radians(2.2)
"""Radians; largest angle between neighbouring returns of one surface, for any laser."""
GAP_SPACINGS = 3.5
"""The same as a multiple of the median spacing of the returns; the smaller limit applies."""
LARGEST_SLOPE = 8.0
"""Largest change of range per distance across, between neighbours of one surface (7 degrees incidence)."""
RANGE_NOISE = 0.1
"""Metres; additional difference of the ranges of neighbours that noise can cause."""


def reproject(depth: DepthVector, sensor: Sensor, viewpoint: npt.ArrayLike) -> DepthVector:
    """Moves the points of a scan to another viewpoint and encodes them again.

    Of points in the same bin, those more than half a metre behind the nearest one are hidden. No points are
    added, so that there may be gaps where the points are farther apart than the bins.

    Args:
        depth: (bins,) metres, 0: no return.
        sensor: defines the bins of both depth vectors.
        viewpoint: (3,) x and y in metres and heading in radians of the new pose in the frame of the old one.

    Returns:
        The depth vector (bins,) in metres, 0 without a return.

    Example:
        A point 5 m ahead is 4 m ahead after a motion of 1 m:

        >>> sensor = Sensor(resolution_deg=90.0)
        >>> reproject(np.array([0, 0, 5, 0, 0], np.float32), sensor, [1.0, 0.0, 0.0]).tolist()
        [0.0, 0.0, 4.0, 0.0, 0.0]
    """
    x, y, heading = np.asarray(viewpoint, dtype=np.float64).tolist()
    seen: DepthVector = _reproject(depth, *_layout(sensor), sensor.max_range, x, y, heading)
    return seen


def render(depth: DepthVector, sensor: Sensor, viewpoint: npt.ArrayLike, out: Sensor) -> DepthVector:
    """Renders the surfaces of a scan from another viewpoint, with one beam in the middle of each bin.

    Neighbouring returns that can lie on one surface are joined by a straight line. The range of a bin is that
    at which its beam hits the nearest line, or the nearest isolated point in the bin. Surfaces are only
    visible from the side that the laser has measured. The result does not show the laser's beam spacing.

    Args:
        depth: (bins,) metres, 0: no return.
        sensor: defines the bins of ``depth``.
        viewpoint: (3,) x and y in metres and heading in radians of the new pose in the frame of the old one.
        out: defines the bins of the result.

    Returns:
        The ranges (bins of ``out``,) in metres, 0 without a return.

    Example:
        A wall 4 m ahead, seen after a motion of 1 m towards it:

        >>> sensor = Sensor(resolution_deg=1.0, field_of_view_deg=90.0)
        >>> bearings = np.deg2rad(np.arange(-45.0, 46.0))
        >>> wall = (4 / np.cos(bearings)).astype(np.float32)
        >>> rendered = render(wall, sensor, [1.0, 0.0, 0.0], sensor)
        >>> (rendered * np.cos(bearings)).round(2)[[0, 45, 90]].tolist()
        [3.0, 3.0, 3.0]
    """
    x, y, heading = np.asarray(viewpoint, dtype=np.float64).tolist()
    seen: DepthVector = _render(depth, *_layout(sensor), *_layout(out), out.max_range, x, y, heading)
    return seen


def render_many(
    depths: npt.NDArray[np.float32], sensor: Sensor, viewpoints: FloatArray, out: Sensor, threads: int = 1
) -> npt.NDArray[np.float32]:
    """Renders many scans, see :func:`render`.

    Args:
        depths: (N, bins) metres, 0: no return.
        sensor: defines the bins of ``depths``.
        viewpoints: (N, 3) metres and radians.
        out: defines the bins of the result.
        threads: number of threads that share the scans.

    Returns:
        The ranges (N, bins of ``out``) in metres, 0 without a return.

    Example:
        >>> sensor = Sensor(resolution_deg=90.0)
        >>> points = np.tile(np.array([0, 0, 5, 0, 0], np.float32), (2, 1))
        >>> viewpoints = np.array([[0.0, 0.0, 0.0], [1.0, 0.0, 0.0]])
        >>> render_many(points, sensor, viewpoints, sensor)[:, 2].tolist()
        [5.0, 4.0]
    """
    seen = np.empty((len(depths), out.bins), np.float32)
    layout = *_layout(sensor), *_layout(out), out.max_range
    shares = zip(*(np.array_split(each, threads) for each in (seen, depths, viewpoints)), strict=True)
    with ThreadPoolExecutor(threads) as pool:
        for _ in pool.map(lambda share: _render_each(*share, *layout), shares):
            pass
    return seen


@lru_cache(maxsize=16)
def _layout(sensor: Sensor) -> tuple[FloatArray, float, float, bool]:
    """The layout of a sensor's bins.

    Returns:
        Directions (bins, 2) of the middles of the bins; the bearing of the first bin and the angle between
        bins in radians; and whether the last bin equals the first one, on a full circle.
    """
    first, step = math.radians(sensor.first_bin_deg), math.radians(sensor.resolution_deg)
    angles = first + step * np.arange(sensor.bins)
    return np.stack([np.cos(angles), np.sin(angles)], axis=1), first, step, sensor.field_of_view_deg == 360


@compiled
def _points_from(depth, rays, is_circle, x, y, heading):  # type: ignore[no-untyped-def]
    """Indices (P,) of the bins with a return, and the returns (P, 2) in the frame of the viewpoint."""
    distinct = len(depth) - 1 if is_circle else len(depth)
    at = np.empty(distinct, np.int64)
    count = 0
    for i in range(distinct):
        if depth[i] > 0:
            at[count] = i
            count += 1
    at = at[:count]
    points = np.empty((count, 2))
    cos, sin = math.cos(heading), math.sin(heading)
    for j in range(count):
        i = at[j]
        ahead, left = depth[i] * rays[i, 0] - x, depth[i] * rays[i, 1] - y
        points[j, 0], points[j, 1] = cos * ahead + sin * left, cos * left - sin * ahead
    return at, points


@compiled
def _bin_positions(points, first, step, bins):  # type: ignore[no-untyped-def]
    """Positions (P,) of points in bins, with fractions, and the number of bins in a full turn.

    The positions jump by a full turn in the direction opposite to the middle bin.
    """
    turn = 2 * math.pi / step
    lowest = (bins - turn) / 2
    positions = np.empty(len(points))
    for j in range(len(points)):
        place = (math.atan2(points[j, 1], points[j, 0]) - first) / step
        while place < lowest:
            place += turn
        while place >= lowest + turn:
            place -= turn
        positions[j] = place
    return positions, turn


@compiled
def _reproject(depth, rays, first, step, is_circle, max_range, x, y, heading):  # type: ignore[no-untyped-def]
    distinct = len(depth) - 1 if is_circle else len(depth)
    _, points = _points_from(depth, rays, is_circle, x, y, heading)
    positions, _ = _bin_positions(points, first, step, distinct)
    distance = np.sqrt(points[:, 0] ** 2 + points[:, 1] ** 2)
    nearest = np.full(distinct, np.inf)
    index = np.empty(len(points), np.int64)
    for j in range(len(points)):
        k = math.floor(positions[j] + (0.5 + 1e-6))
        if is_circle and (k < 0 or k >= distinct):
            k %= distinct
        if not (0 <= k < distinct and 0 < distance[j] < max_range):
            k = -1
        else:
            nearest[k] = min(nearest[k], distance[j])
        index[j] = k
    total, number = np.zeros(distinct), np.zeros(distinct)
    for j in range(len(points)):
        k = index[j]
        if k >= 0 and distance[j] < nearest[k] + OCCLUSION_DEPTH:
            total[k] += distance[j]
            number[k] += 1
    seen = np.zeros(len(depth), np.float32)
    for k in range(distinct):
        if number[k]:
            seen[k] = total[k] / number[k]
    if is_circle:
        seen[distinct] = seen[0]
    return seen


@compiled
def _render(  # type: ignore[no-untyped-def]
    depth, rays, _, step, is_circle, out_rays, out_first, out_step, out_circle, max_range, x, y, heading
):
    at, points = _points_from(depth, rays, is_circle, x, y, heading)
    drawn = len(out_rays) - 1 if out_circle else len(out_rays)
    positions, turn = _bin_positions(points, out_first, out_step, drawn)
    joined = _find_surfaces(depth, at, len(depth) - 1 if is_circle else 0, step)
    nearest = np.full(drawn, np.inf)
    _draw_lines(nearest, out_rays, points, positions, joined, turn, out_circle)
    _draw_points(nearest, points, positions, joined, out_circle)
    seen = np.zeros(len(out_rays), np.float32)
    for b in range(drawn):
        if nearest[b] < max_range:
            seen[b] = nearest[b]
    if out_circle:
        seen[drawn] = seen[0]
    return seen


def _render_each_uncompiled(  # type: ignore[no-untyped-def]
    seen,
    depths,
    viewpoints,
    rays,
    first,
    step,
    is_circle,
    out_rays,
    out_first,
    out_step,
    out_circle,
    max_range,
):
    for n in range(len(depths)):
        x, y, heading = viewpoints[n]
        seen[n] = _render(
            depths[n],
            rays,
            first,
            step,
            is_circle,
            out_rays,
            out_first,
            out_step,
            out_circle,
            max_range,
            x,
            y,
            heading,
        )


_render_each = compiled(_render_each_uncompiled, partial(njit, nogil=True))


@compiled
def _largest_gap(at, step):  # type: ignore[no-untyped-def]
    """Largest angle in radians between neighbours of one surface, from the median spacing of the returns.

    Args:
        at: (P,) bins of the returns.
        step: radians from bin to bin.
    """
    counts = np.zeros(64, np.int64)
    for j in range(1, len(at)):
        counts[min(at[j] - at[j - 1], 63)] += 1
    below, bins = counts[0], 0
    while 2 * below < len(at) - 1 and bins < 63:
        bins += 1
        below += counts[bins]
    return max(1.01 * step, min(GAP_SPACINGS * bins * step, LARGEST_GAP))


@compiled
def _find_surfaces(depth, at, bins_in_turn, step):  # type: ignore[no-untyped-def]
    """Whether each return and the next one, counter-clockwise, can lie on one surface, (P,).

    Args:
        depth: (bins,) metres.
        at: (P,) bins of the returns.
        bins_in_turn: number of bins of a full circle, on which the first return follows the last one; 0 if
            the sensor does not cover a full circle.
        step: radians from bin to bin.
    """
    largest, count = _largest_gap(at, step), len(at)
    joined = np.zeros(count, np.bool_)
    for j in range(count if count > 1 else 0):
        k = j + 1 if j + 1 < count else 0
        gap = (at[k] - at[j] if k else at[k] - at[j] + bins_in_turn) * step
        near, far = min(depth[at[j]], depth[at[k]]), max(depth[at[j]], depth[at[k]])
        joined[j] = 0 < gap <= largest and far - near < RANGE_NOISE + LARGEST_SLOPE * near * gap
    return joined


@compiled
def _draw_lines(nearest, rays, points, positions, joined, turn, is_circle):  # type: ignore[no-untyped-def]
    """Updates the nearest range of each bin whose middle is crossed by a line between joined points."""
    bins, count = len(nearest), len(points)
    for j in range(count):
        if not joined[j]:
            continue
        k = j + 1 if j + 1 < count else 0
        span = positions[k] - positions[j]
        if span > turn / 2:
            span -= turn
        elif span < -turn / 2:
            span += turn
        x, y = points[j, 0], points[j, 1]
        ex, ey = points[k, 0] - x, points[k, 1] - y
        cross = x * ey - y * ex
        # A line that is seen from behind has a negative span and therefore no bins. The tolerance includes
        # the ends of the line in spite of rounding errors.
        for b in range(int(np.ceil(positions[j] - 1e-6)), int(np.floor(positions[j] + span + 1e-6)) + 1):
            i = b
            if is_circle and i < 0:
                i += bins
            elif is_circle and i >= bins:
                i -= bins
            if 0 <= i < bins:
                across = rays[i, 0] * ey - rays[i, 1] * ex
                if across > 0 and 0 < cross < nearest[i] * across:
                    nearest[i] = cross / across


@compiled
def _draw_points(nearest, points, positions, joined, is_circle):  # type: ignore[no-untyped-def]
    """Updates the nearest range of each bin that contains an isolated point."""
    bins, count = len(nearest), len(points)
    for j in range(count):
        if joined[j] or joined[j - 1]:
            continue
        b = int(np.floor(positions[j] + 0.5))
        b = b % bins if is_circle else b
        if 0 <= b < bins:
            nearest[b] = min(nearest[b], math.sqrt(points[j, 0] ** 2 + points[j, 1] ** 2))
