"""Scans seen from another place: their points encoded again, or the surfaces between them drawn again.

Any pair of scans whose motion is known so gives pairs of any motion, and a network can be asked for what is
left of a motion after a first guess: the earlier scan is seen from where the guess leads before the two are
compared (predict and correct; image registration calls it warping).
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

HIDDEN = 0.5
"""Metres behind the nearest point of a bin from which on a point is hidden by it."""
LARGEST_GAP = math.radians(2.2)
"""Between neighbours of one surface, whatever the laser."""
GAP_SPACINGS = 3.5
"""... and in usual spacings of the returns."""
STEEPEST = 8.0
"""Metres of range by metre across, between neighbours of one surface: the laser sees it at 7 degrees."""
ROUGH = 0.1
"""Metres of range that neighbours may differ by, beside that, for noise."""


def reproject(depth: DepthVector, sensor: Sensor, viewpoint: npt.ArrayLike) -> DepthVector:
    """The depth vector of the same points, seen from another place.

    What is visible from both places is where it is; of two points in a bin that are more than half a metre
    apart only the nearer is seen. Points keep their number, so that bins that were full may have gaps.

    Args:
        depth: (bins,) metres, 0: no return.
        sensor: of both.
        viewpoint: x, y in metres and heading in radians (3,) of the other place, seen from the first.

    Returns:
        (bins,) metres.

    >>> wall = Sensor(resolution_deg=90.0)
    >>> reproject(np.array([0, 0, 5, 0, 0], np.float32), wall, [1.0, 0.0, 0.0]).tolist()
    [0.0, 0.0, 4.0, 0.0, 0.0]
    """
    x, y, heading = np.asarray(viewpoint, dtype=np.float64).tolist()
    seen: DepthVector = _reproject(depth, *_layout(sensor), sensor.max_range, x, y, heading)
    return seen


def render(depth: DepthVector, sensor: Sensor, viewpoint: npt.ArrayLike, out: Sensor) -> DepthVector:
    """The surfaces of a scan, seen from another place by beams in the middles of all bins.

    Neighbours that can lie on one surface are joined by a straight line, and each bin holds the range at
    which its middle meets the nearest of them, or of the points that stand alone. How the beams of the laser
    were spaced is then no longer to be seen. Backs of surfaces are not drawn.

    Args:
        depth: (bins,) metres, 0: no return.
        sensor: of these.
        viewpoint: x, y in metres and heading in radians (3,) of the other place, seen from the first.
        out: bins of what is drawn.

    Returns:
        (bins of out,) metres, 0 where nothing is seen.
    """
    x, y, heading = np.asarray(viewpoint, dtype=np.float64).tolist()
    seen: DepthVector = _render(depth, *_layout(sensor), *_layout(out), out.max_range, x, y, heading)
    return seen


def render_many(
    depths: npt.NDArray[np.float32], sensor: Sensor, viewpoints: FloatArray, out: Sensor, threads: int = 1
) -> npt.NDArray[np.float32]:
    """The same of many scans.

    Args:
        depths: (N, bins) metres.
        sensor: of these.
        viewpoints: (N, 3).
        out: bins of what is drawn.
        threads: that share the scans.

    Returns:
        (N, bins of out) metres.
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
    """Where the middles of the bins point, (bins, 2); the first and the spacing in radians; and whether the
    last bin is the first one."""
    first, step = math.radians(sensor.first_bin_deg), math.radians(sensor.resolution_deg)
    angles = first + step * np.arange(sensor.bins)
    return np.stack([np.cos(angles), np.sin(angles)], axis=1), first, step, sensor.field_of_view_deg == 360


@compiled
def _points_from(depth, rays, is_circle, x, y, heading):  # type: ignore[no-untyped-def]
    """Bins (P,) with a return, and the returns (P, 2) as seen from the viewpoint."""
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
def _places(points, first, step, bins):  # type: ignore[no-untyped-def]
    """Bins (P,) of points, with fractions, and bins in a turn; cut opposite to the middle of the bins."""
    turn = 2 * math.pi / step
    lowest = (bins - turn) / 2
    places = np.empty(len(points))
    for j in range(len(points)):
        place = (math.atan2(points[j, 1], points[j, 0]) - first) / step
        while place < lowest:
            place += turn
        while place >= lowest + turn:
            place -= turn
        places[j] = place
    return places, turn


@compiled
def _reproject(depth, rays, first, step, is_circle, max_range, x, y, heading):  # type: ignore[no-untyped-def]
    distinct = len(depth) - 1 if is_circle else len(depth)
    _, points = _points_from(depth, rays, is_circle, x, y, heading)
    places, _ = _places(points, first, step, distinct)
    distance = np.sqrt(points[:, 0] ** 2 + points[:, 1] ** 2)
    nearest = np.full(distinct, np.inf)
    index = np.empty(len(points), np.int64)
    for j in range(len(points)):
        k = math.floor(places[j] + (0.5 + 1e-6))
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
        if k >= 0 and distance[j] < nearest[k] + HIDDEN:
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
    places, turn = _places(points, out_first, out_step, drawn)
    joined = _find_surfaces(depth, at, len(depth) - 1 if is_circle else 0, step)
    nearest = np.full(drawn, np.inf)
    _draw_lines(nearest, out_rays, points, places, joined, turn, out_circle)
    _draw_points(nearest, points, places, joined, out_circle)
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
    """Radians between neighbours of one surface: by the median spacing of the returns (P,) bins."""
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
    """Whether each return (P,) and the next one, counter-clockwise, can lie on one surface.

    Args:
        depth: (bins,) metres.
        at: (P,) bins of the returns.
        bins_in_turn: of a circle, on which the first return follows the last one; 0: it does not.
        step: radians from bin to bin.
    """
    largest, count = _largest_gap(at, step), len(at)
    joined = np.zeros(count, np.bool_)
    for j in range(count if count > 1 else 0):
        k = j + 1 if j + 1 < count else 0
        gap = (at[k] - at[j] if k else at[k] - at[j] + bins_in_turn) * step
        near, far = min(depth[at[j]], depth[at[k]]), max(depth[at[j]], depth[at[k]])
        joined[j] = 0 < gap <= largest and far - near < ROUGH + STEEPEST * near * gap
    return joined


@compiled
def _draw_lines(nearest, rays, points, places, joined, turn, is_circle):  # type: ignore[no-untyped-def]
    """Draws the lines between joined points into the bins whose middles they cross."""
    bins, count = len(nearest), len(points)
    for j in range(count):
        if not joined[j]:
            continue
        k = j + 1 if j + 1 < count else 0
        span = places[k] - places[j]
        if span > turn / 2:
            span -= turn
        elif span < -turn / 2:
            span += turn
        x, y = points[j, 0], points[j, 1]
        ex, ey = points[k, 0] - x, points[k, 1] - y
        cross = x * ey - y * ex
        # A line whose back is seen has a negative span, and no bins.
        # With its ends, whatever rounding has made of a place in the middle of a bin.
        for b in range(int(np.ceil(places[j] - 1e-6)), int(np.floor(places[j] + span + 1e-6)) + 1):
            i = b
            if is_circle and i < 0:
                i += bins
            elif is_circle and i >= bins:
                i -= bins
            if 0 <= i < bins:
                across = rays[i, 0] * ey - rays[i, 1] * ex
                if across > 0 and cross < nearest[i] * across:
                    nearest[i] = cross / across


@compiled
def _draw_points(nearest, points, places, joined, is_circle):  # type: ignore[no-untyped-def]
    """Draws the points that stand alone, each into its bin."""
    bins, count = len(nearest), len(points)
    for j in range(count):
        if joined[j] or joined[j - 1]:
            continue
        b = int(np.floor(places[j] + 0.5))
        b = b % bins if is_circle else b
        if 0 <= b < bins:
            nearest[b] = min(nearest[b], math.sqrt(points[j, 0] ** 2 + points[j, 1] ** 2))
