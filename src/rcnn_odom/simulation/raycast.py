"""Casts the beams of a laser: a depth buffer over upright walls, then ray marching over the ground."""

from functools import partial

import numpy as np
import numpy.typing as npt
from numba import vectorize

from rcnn_odom.compiled import compiled
from rcnn_odom.geometry import FloatArray
from rcnn_odom.simulation.scene import Walls
from rcnn_odom.simulation.terrain import Ground, height_at

NO_WALL = -1
HIT_GROUND = -2
_MARCH = 2.0
"""Metres, step of the ray marching over the ground."""
_CELLS = 4096
"""Number of cells of the table that finds the beams at an azimuth."""


def cast(
    walls: Walls, ground: Ground | None, origin: FloatArray, directions: FloatArray, max_range: float
) -> tuple[FloatArray, npt.NDArray[np.int64], FloatArray]:
    """Find the nearest wall or ground that each beam hits.

    Args:
        walls: S upright rectangles, in world coordinates.
        ground: ground in world coordinates; None: there is none.
        origin: (3,) metres, common origin of the beams.
        directions: (B, 3) directions of the beams in the world, none of them vertical.
        max_range: metres, in the horizontal plane.

    Returns:
        Horizontal distance (B,) in metres, inf if nothing is within ``max_range``; hit (B,): the index of a
        wall, ``HIT_GROUND`` or ``NO_WALL``; and squareness (B,): the sine of the horizontal angle between
        beam and wall, from 0 along the wall to 1 at a right angle.
    """
    beams, order = _by_azimuth(directions)
    depth, hit = _nearest_walls(walls.ends, walls.heights, origin, beams, max_range)
    origins = np.tile(origin, (len(order), 1))
    squareness = _add_ground(walls, ground, origins, beams, max_range, depth, hit)
    back = np.argsort(order)
    return depth[back], hit[back], squareness[back]


def cast_each(
    walls: Walls, ground: Ground | None, origins: FloatArray, directions: FloatArray, max_range: float
) -> tuple[FloatArray, npt.NDArray[np.int64], FloatArray]:
    """The same as :func:`cast` for beams with different origins near each other, as of a moving laser.

    Args:
        walls, ground, directions, max_range: as for :func:`cast`.
        origins: (B, 3) metres, origins of the beams.
    """
    beams, order = _by_azimuth(directions)
    origins = np.ascontiguousarray(origins[order])
    depth, hit = _nearest_walls_each(walls.ends, walls.heights, origins, beams, max_range)
    squareness = _add_ground(walls, ground, origins, beams, max_range, depth, hit)
    back = np.argsort(order)
    return depth[back], hit[back], squareness[back]


def _by_azimuth(directions: FloatArray) -> tuple[FloatArray, npt.NDArray[np.int64]]:
    """Sort beams by azimuth; returns their ranks, x, y and slopes (4, B), and the order (B,) of the beams."""
    rank = _azimuth_rank(directions[:, 0], directions[:, 1])
    order = np.argsort(rank)
    level = np.hypot(directions[:, 0], directions[:, 1])
    return np.stack([rank, *(directions / level[:, None]).T])[:, order], order


def _add_ground(
    walls: Walls,
    ground: Ground | None,
    origins: FloatArray,
    beams: FloatArray,
    max_range: float,
    depth: FloatArray,
    hit: npt.NDArray[np.int64],
) -> FloatArray:
    """Compute the squareness (B,), and update ``depth`` and ``hit`` of beams that hit the ground first."""
    squareness = _squareness(walls.ends, hit, beams)
    if ground is not None:
        shape = ground.heights, ground.corner, ground.step, ground.steepest
        _meet_ground(*shape, origins, beams, max_range, depth, hit, squareness)
    return squareness


@partial(compiled, how=vectorize)
def _azimuth_rank(x, y):  # type: ignore[no-untyped-def]
    """A number from -2 to 2 that grows with the azimuth, ten times faster to compute than the azimuth."""
    share = y / (abs(x) + abs(y))
    if x >= 0:
        return share
    return 2 - share if y >= 0 else -2 - share


@compiled
def _first_beam(ranks, table, rank):  # type: ignore[no-untyped-def]
    """The first of the sorted beams whose rank is not below ``rank``; the table shortens the search."""
    beam = table[int((rank + 2) * (_CELLS / 4))]
    while beam > 0 and ranks[beam - 1] >= rank:
        beam -= 1
    while beam < len(ranks) and ranks[beam] < rank:
        beam += 1
    return beam


@compiled
def _nearest_walls(  # type: ignore[no-untyped-def]
    ends, heights, origin, beams, max_range
):
    ranks, east, north, slope = beams
    depth = np.full(len(ranks), np.inf)
    hit = np.full(len(ranks), NO_WALL)
    table = np.searchsorted(ranks, np.arange(_CELLS + 1) * (4 / _CELLS) - 2)
    for wall in range(len(ends)):
        x1, y1 = ends[wall, 0] - origin[0], ends[wall, 1] - origin[1]
        x2, y2 = ends[wall, 2] - origin[0], ends[wall, 3] - origin[1]
        across = x1 * y2 - y1 * x2  # 0: edge-on
        reach = 2 * max_range + abs(x2 - x1) + abs(y2 - y1)
        if across == 0 or (x1 + x2) ** 2 + (y1 + y2) ** 2 > reach**2:
            continue
        if across < 0:  # swap the ends, so that the second one is counter-clockwise from the first
            x1, y1, x2, y2, across = x2, y2, x1, y1, -across
        low, high = heights[wall, 0] - origin[2], heights[wall, 1] - origin[2]
        first = _first_beam(ranks, table, _azimuth_rank(x1, y1))
        stop = _first_beam(ranks, table, _azimuth_rank(x2, y2))
        if y1 >= 0 > y2:  # the wall crosses the direction where the ranks jump from 2 to -2
            stop += len(ranks)
        for position in range(first, stop):
            beam = position % len(ranks)
            closing = east[beam] * (y2 - y1) - north[beam] * (x2 - x1)
            if closing <= 0:  # the beam is parallel to the wall and cannot hit it
                continue
            distance = across / closing
            if distance < depth[beam] and low <= slope[beam] * distance <= high:
                depth[beam], hit[beam] = distance, wall
    far = depth >= max_range
    depth[far], hit[far] = np.inf, NO_WALL
    return depth, hit


@compiled
def _nearest_walls_each(  # type: ignore[no-untyped-def]
    ends, heights, origins, beams, max_range
):
    ranks, east, north, slope = beams
    depth = np.full(len(ranks), np.inf)
    hit = np.full(len(ranks), NO_WALL)
    if len(ranks) == 0:
        return depth, hit
    middle = origins.sum(axis=0) / len(origins)
    apart = np.sqrt((origins[:, 0] - middle[0]) ** 2 + (origins[:, 1] - middle[1]) ** 2).max()
    for wall in range(len(ends)):
        first_rank, width = _rank_interval(ends[wall], middle, apart, max_range)
        first = np.searchsorted(ranks, first_rank)
        for later in range(len(ranks)):
            beam = (first + later) % len(ranks)
            if (ranks[beam] - first_rank) % 4 > width:
                break
            x1, y1 = ends[wall, 0] - origins[beam, 0], ends[wall, 1] - origins[beam, 1]
            x2, y2 = ends[wall, 2] - origins[beam, 0], ends[wall, 3] - origins[beam, 1]
            left1, left2 = east[beam] * y1 - north[beam] * x1, east[beam] * y2 - north[beam] * x2
            if (left1 > 0) == (left2 > 0):  # both ends are on the same side of the beam
                continue
            distance = (x1 * y2 - y1 * x2) / (left2 - left1)
            top = origins[beam, 2] + slope[beam] * distance
            if 0 < distance < depth[beam] and heights[wall, 0] <= top <= heights[wall, 1]:
                depth[beam], hit[beam] = distance, wall
    far = depth >= max_range
    depth[far], hit[far] = np.inf, NO_WALL
    return depth, hit


@compiled
def _rank_interval(wall, middle, apart, max_range):  # type: ignore[no-untyped-def]
    """Rank of the first beam that may hit a wall, and difference to the rank of the last such beam.

    No beam starts farther than ``apart`` from the middle. So the azimuth of a point at distance ``near``
    differs by at most arcsin(apart / near) from its azimuth seen from the middle. Differences of ranks are
    smaller than those of angles.
    """
    x1, y1 = wall[0] - middle[0], wall[1] - middle[1]
    x2, y2 = wall[2] - middle[0], wall[3] - middle[1]
    long = (x2 - x1) ** 2 + (y2 - y1) ** 2
    share = 0.0 if long == 0 else min(max(-(x1 * (x2 - x1) + y1 * (y2 - y1)) / long, 0.0), 1.0)
    near = np.hypot(x1 + share * (x2 - x1), y1 + share * (y2 - y1))
    if near > max_range + apart:
        return 0.0, -1.0
    if near <= apart + 1e-9:
        return -2.0, 4.0
    slack = np.arcsin(apart / near) + 1e-9
    if x1 * y2 < y1 * x2:
        x1, y1, x2, y2 = x2, y2, x1, y1
    start = _azimuth_rank(x1, y1)
    width = (_azimuth_rank(x2, y2) - start) % 4 + 2 * slack
    return (start - slack + 2) % 4 - 2, width


@compiled
def _squareness(ends, hit, beams):  # type: ignore[no-untyped-def]
    _, east, north, _ = beams
    squareness = np.zeros(len(hit))
    for beam in range(len(hit)):
        if hit[beam] != NO_WALL:
            x, y = ends[hit[beam], 2] - ends[hit[beam], 0], ends[hit[beam], 3] - ends[hit[beam], 1]
            squareness[beam] = abs(east[beam] * y - north[beam] * x) / np.hypot(x, y)
    return squareness


@compiled
def _meet_ground(  # type: ignore[no-untyped-def]
    heights, corner, step, steepest, origins, beams, max_range, depth, hit, squareness
):
    _, east, north, slope = beams
    for beam in range(len(slope)):
        origin = origins[beam]
        above_before = origin[2] - height_at(heights, corner, step, origin[0], origin[1])
        distance = 0.0
        end = min(depth[beam], max_range)
        closing = max(steepest - slope[beam], 1e-3)
        while distance < end:
            # The ground cannot reach the beam within this distance, even at its steepest.
            distance += _MARCH * max(1, int(above_before / (closing * _MARCH)))
            x, y = origin[0] + east[beam] * distance, origin[1] + north[beam] * distance
            above = origin[2] + slope[beam] * distance - height_at(heights, corner, step, x, y)
            if above < 0:
                # The step was one _MARCH long: a longer one cannot end below the ground, because even the
                # steepest ground would need all of it to rise to the beam.
                share = above_before / (above_before - above)
                met = distance - (1 - share) * _MARCH
                if met < end:
                    depth[beam], hit[beam] = met, HIT_GROUND
                    squareness[beam] = (above_before - above) / _MARCH
                break
            above_before = above
