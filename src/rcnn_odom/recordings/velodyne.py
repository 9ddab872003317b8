"""Finds the points of one beam of a spinning laser with many, stored laser by laser or in any order.

The beams of a Velodyne meet at a point above the origin of its points. A beam of elevation e consists of the
points with z = height + r tan(e), where r is the horizontal range. Seen from that height, the points of a
beam lie on one cone, to a few hundredths of a degree. Seen from the origin (height 0), beams overlap.
"""

from collections.abc import Sequence
from typing import NamedTuple

import numpy as np
import numpy.typing as npt

from rcnn_odom.geometry import FloatArray

LEVEL = np.deg2rad(0.15)
"""The ring with the elevation nearest to this one, slightly above horizontal, is chosen. KITTI's two most
level rings lie at +0.06 to +0.25 and at -0.1 to -0.3 degrees, so the one nearest to 0 would change between
sequences. Of the two, the upper one hits the road later when the car pitches."""
NEAR_LEVEL = np.deg2rad(2.0)
"""A beam farther from ``LEVEL`` hits the road or the sky instead of walls."""
HALF_RING_SPACING = np.deg2rad(0.2)
FARTHEST = np.float32(1e6)
"""Metres; a point with a larger coordinate is not a return."""
RING_DROP = np.deg2rad(30.0)
"""The azimuth drops by more than this between rings; within one, close objects make it drop by up to 7."""

SAMPLED_POINTS = 1024
"""Approximate number of a cloud's points from which its order is found."""
MOST_STEPS_BACK = 0.25
"""Largest part of a ring's steps in which the azimuth falls, because of noise and close objects."""
RINGS_SPREAD = 0.5
"""Largest spread of the elevation within rings, as a part of its spread over all points."""
SAME_LASER = np.deg2rad(0.06)
"""Largest difference in elevation between two groups of points of the same laser."""
AROUND_START = 5
"""Number of points before and after the start of a ring whose elevations are compared."""
MOST_CUT = 0.25
"""Largest part of the starts within a laser's turn; such a start cuts a turn in two."""
ONE_BEAM = np.deg2rad(0.1)
"""Largest spread of the elevation of a single beam."""
HIGHEST = 0.5
"""Metres; largest distance from the origin to the point where the beams meet."""
HIGHEST_RISE = 3.5
"""Metres; the same if the points were shifted along z, to the ground or to the base of a robot."""
BIN = np.deg2rad(0.05)
"""Bin of the histograms of elevations."""
SEEN = np.deg2rad(4.0)
"""Largest angle from level in the histograms of elevations."""
DISTINCT = 1.5
"""Least ratio of the sharpness of a histogram of elevations to that of its moving mean over half a degree. It
is 3 to 6 in KITTI, even if points are thinned to a grid of 0.2 m, but 1.0 to 1.2 in a frame that is not the
laser's."""
LEAST_OF_BEAM = 0.2
"""Least number of points of a beam, as a part of the points of the fullest beam."""
SHARPER = 1.1
"""Least ratio by which a height must make the histogram sharper to be used."""

NEAR, FAR = 15.0, 20.0
"""Metres; thinning by a grid of cubes affects points nearer than ``NEAR``, but not points beyond ``FAR``."""
FEWEST_GAPS = 20
"""Least number of gaps between points for a decision about thinning."""
THINNED = 1.5
"""Above this ratio of the angles between near points to those between far ones, points are thinned."""

Points = npt.NDArray[np.floating]


class Beam(NamedTuple):
    """One laser of many, found from its points.

    Attributes:
        elevation: radians, seen from the point where the beams meet.
        height: metres, z coordinate of that point.
    """

    elevation: float
    height: float = 0.0


def split_rings(points: Points) -> list[Points] | None:
    """Split points into the rings of the lasers.

    Args:
        points: (P, 3 or more) metres.

    Returns:
        The points (Q, 3) of each laser, in the order of the file; a single ring, in any order, if there is
        only one beam. None if the points are not stored laser by laser (sorted by azimuth, shuffled,
        clockwise or direction by direction), or if most turns begin in another direction than azimuth 0, so
        that the rings cannot be separated.
    """
    starts = ring_starts(points)
    order = _PointOrder(points, starts)
    if order.is_one_beam:
        return [points[:, :3]]
    if not order.is_laser_by_laser or _are_turns_cut(points, starts, order.height):
        return None
    ends = [*starts[1:], len(points)]
    return [points[start:end, :3] for start, end in zip(starts, ends, strict=True)]


def ring_starts(points: Points) -> npt.NDArray[np.int64]:
    """Find the first point of each ring in points (P, 3 or more) that are stored laser by laser.

    Within a ring, the azimuth in [0, 2 pi) grows; a new ring begins where it drops. Noise that moves points
    back and forth across azimuth 0 does not begin a ring, because each step back undoes a step forward.
    The azimuth is computed only at the few candidate steps, because it is expensive.

    Returns:
        (R,) indices, the first 0.
    """
    x, y = np.ascontiguousarray(points[:, :2].T)
    right = y < 0
    cross = x[:-1] * y[1:] - y[:-1] * x[1:]
    dot = x[:-1] * x[1:] + y[:-1] * y[1:]
    # At a drop, the points either change between the left and the right half plane, or turn clockwise.
    candidates = np.flatnonzero((right[:-1] != right[1:]) | (cross < -np.tan(RING_DROP) * dot))
    step = _azimuth(x, y, candidates + 1) - _azimuth(x, y, candidates)
    change = (step < -RING_DROP).astype(np.int64) - (step > 2 * np.pi - RING_DROP)
    # A frame may begin with a few points just before azimuth 0; they belong to the first ring.
    short_of_zero = len(x) > 0 and _azimuth(x, y, np.array([0]))[0] > 2 * np.pi - RING_DROP
    level = np.cumsum(change) - int(short_of_zero)
    highest_before = np.maximum.accumulate(np.concatenate([[0], level]))[:-1]
    return np.concatenate([[0], candidates[level > highest_before] + 1])


def _are_turns_cut(points: Points, starts: npt.NDArray[np.int64], height: float) -> bool:
    """Whether many starts lie within the turn of one laser, which happens if turns do not begin at azimuth 0.

    Elevations are seen from the height where the beams meet; from other heights, neighbouring lasers can
    have equal elevations.
    """
    after = starts[1:, None] + np.arange(AROUND_START)  # (starts, points)
    after = after[(after[:, -1] < len(points)) & (after[:, 0] >= AROUND_START)]
    if len(after) < 2:
        return False
    elevation, before = (
        np.median(elevations_from(points[at.ravel()], height).reshape(at.shape), axis=1)
        for at in (after, after - AROUND_START)
    )
    return bool(np.mean(np.abs(elevation - before) < SAME_LASER) > MOST_CUT)


def _azimuth(x: Points, y: Points, at: npt.NDArray[np.int64]) -> FloatArray:
    return np.arctan2(y[at], x[at], dtype=np.float64) % (2 * np.pi)


class _PointOrder:
    """Finds the order of points (P, 3 or more) with given ring starts, from a sample of the points.

    Attributes:
        x, y: (S,) metres of the sample.
        slope, closeness: (S,) z / distance, and 1 / distance in 1 / metres.
        steps_back: part of the steps from point to point in which the azimuth falls.
        overall_spread: spread of the elevations in radians about one cone.
        are_ringed: whether the elevations spread clearly less within the rings.
        height: metres, height of the cones' common apex.
    """

    def __init__(self, points: Points, starts: npt.NDArray[np.int64]) -> None:
        # An odd stride, because the number of lasers is even: the sample must contain points of all lasers.
        stride = (len(points) // SAMPLED_POINTS) | 1
        self.x, self.y, z = points[::stride, :3].T.astype(np.float64)
        next_x, next_y = points[1::stride, :2].T.astype(np.float64)
        back = self.x[: len(next_x)] * next_y < self.y[: len(next_x)] * next_x
        self.steps_back = np.count_nonzero(back) / max(len(back), 1)
        distance = np.maximum(np.sqrt(self.x**2 + self.y**2), 1.0)
        self.slope, self.closeness = np.clip(z / distance, -1.0, 1.0), 1 / distance
        self.overall_spread, _ = self._fit(np.zeros(len(z), np.int64), HIGHEST)
        # The number of starts before each point of the sample.
        firsts = np.minimum(-(-starts[1:] // stride), len(z))
        ring = np.cumsum(np.bincount(firsts, minlength=len(z) + 1)[: len(z)])
        within, _ = self._fit(ring, HIGHEST)
        self.are_ringed = within <= RINGS_SPREAD * self.overall_spread
        within, self.height = self._fit(ring, HIGHEST_RISE)
        if not self.are_ringed:  # the cloud may be shifted along z; then both fits need the wider bound
            overall_spread, _ = self._fit(np.zeros(len(z), np.int64), HIGHEST_RISE)
            self.are_ringed = within <= RINGS_SPREAD * overall_spread

    @property
    def is_laser_by_laser(self) -> bool:
        """Whether the points of each laser are stored one after another."""
        return bool(self.steps_back < MOST_STEPS_BACK) and self.are_ringed

    @property
    def is_one_beam(self) -> bool:
        """Whether all points are of one beam; the laser may be tilted, so that its points lie in a plane."""
        if self.overall_spread < ONE_BEAM or self.is_laser_by_laser:
            return self.overall_spread < ONE_BEAM
        azimuth = np.arctan2(self.y, self.x)
        plane = np.stack([np.ones_like(azimuth), np.cos(azimuth), np.sin(azimuth), self.closeness], axis=1)
        fit = np.linalg.lstsq(plane, self.slope, rcond=None)[0]
        return bool(np.std(self.slope - plane @ fit) < ONE_BEAM)

    def _fit(self, ring: npt.NDArray[np.int64], highest: float) -> tuple[float, float]:
        """Fit a cone to each ring, all cones with the same apex on the z axis.

        Args:
            ring: (S,) ring of each point of the sample.
            highest: metres, bound on the absolute height of the apex.

        Returns:
            The standard deviation of the points about the cones in radians, and the height in metres.
        """
        count = np.bincount(ring)
        freedom = len(ring) - np.count_nonzero(count) - 1
        if freedom <= 0:
            return 0.0, 0.0
        share = 1 / np.maximum(count, 1)
        slope = self.slope - (np.bincount(ring, self.slope) * share)[ring]
        closeness = self.closeness - (np.bincount(ring, self.closeness) * share)[ring]
        height = _slope_over(closeness, slope, highest)
        slope -= height * closeness
        return float(np.sqrt(slope @ slope / freedom)), height


def _slope_over(closeness: FloatArray, slope: FloatArray, highest: float) -> float:
    """Least-squares slope of ``slope`` over ``closeness`` (P,), both with zero mean: the beams' height."""
    square = float(closeness @ closeness)
    return float(np.clip(closeness @ slope / square, -highest, highest)) if square > 1e-9 else 0.0


def median_elevation(points: Points) -> float:
    """Median elevation in radians of points (P, 3), seen from the origin; nan if there are no points."""
    return float(np.median(elevations_from(points, 0.0))) if len(points) else float("nan")


def fit_beam(ring: Points) -> Beam:
    """Fit a beam to the points (P, 3 or more) of one ring, P >= 1."""
    x, y, z = ring[:, :3].astype(np.float64).T
    distance = np.maximum(np.hypot(x, y), 1.0)
    closeness, slope = 1 / distance, z / distance
    height = _slope_over(closeness - closeness.mean(), slope - slope.mean(), HIGHEST)
    return Beam(float(np.median(elevations_from(ring, height))), height)


def find_level_beam(clouds: Sequence[Points]) -> Beam:
    """Find the beam nearest to ``LEVEL``, from points in any order.

    Args:
        clouds: frames of one laser, each (P, 3 or more) metres.

    Raises:
        ValueError: no beam is within 2 degrees of level, or the elevations do not cluster at beams.
    """
    points = np.concatenate([cloud[:, :3] for cloud in clouds])
    height = _find_height(points[np.abs(elevations_from(points, 0.0)) < SEEN])
    if not _are_distinct(elevations_from(points, height)):
        raise ValueError("they do not cluster at beams as seen from the laser, so they are not in its frame")
    return Beam(level_elevation(clouds, height), height)


def _are_distinct(elevations: FloatArray) -> bool:
    """Whether the elevations (P,) near level cluster at beams."""
    counts = np.histogram(elevations, int(2 * SEEN / BIN), (-SEEN, SEEN))[0].astype(np.float64)
    smooth = np.convolve(counts, np.full(9, 1 / 9), "same")
    return bool(counts @ counts >= DISTINCT * (smooth @ smooth))


def _find_height(points: Points) -> float:
    """The height in metres where the beams meet: the elevations of points (P, 3) cluster most from there."""

    def sharpness(height: float) -> float:
        counts, _ = np.histogram(elevations_from(points, height), int(2 * SEEN / BIN), (-SEEN, SEEN))
        return float(np.sum(counts.astype(np.float64) ** 2))

    best = max(np.arange(-HIGHEST, HIGHEST, 0.01), key=sharpness)
    best = max(best + np.arange(-0.008, 0.01, 0.002), key=sharpness)
    return float(best) if sharpness(best) > SHARPER * sharpness(0.0) else 0.0


def level_elevation(clouds: Sequence[Points], height: float = 0.0) -> float:
    """Find the elevation of the beam nearest to ``LEVEL``, from points in any order.

    Args:
        clouds: frames of one laser, each (P, 3 or more) metres.
        height: metres, z coordinate of the point where the beams meet.

    Returns:
        Elevation in radians, seen from ``height``, of the beam that is nearest to level seen from the origin.

    Raises:
        ValueError: no beam is within 2 degrees of level.
    """
    points = np.concatenate([cloud[:, :3] for cloud in clouds])
    points = points[np.abs(elevations_from(points, height)) < SEEN]
    elevations, from_origin = elevations_from(points, height), elevations_from(points, 0.0)
    near = [
        (float(np.median(elevations[is_of_beam])), float(np.median(from_origin[is_of_beam])))
        for peak in _find_peaks(elevations)
        if (is_of_beam := np.abs(elevations - peak) < 1.5 * BIN).any()
    ]
    elevation, level = min(near, key=lambda beam: abs(beam[1] - LEVEL), default=(np.nan, np.inf))
    if abs(level - LEVEL) > NEAR_LEVEL:
        raise ValueError("no beam of the laser is within 2 degrees of level")
    return elevation


def _find_peaks(elevations: FloatArray) -> FloatArray:
    """Peaks (K,) of the histogram of elevations (P,), in radians."""
    counts, edges = np.histogram(elevations, int(2 * SEEN / BIN), (-SEEN, SEEN))
    smooth = np.convolve(counts, [1, 2, 1])  # one bin longer on either side
    inner = smooth[1:-1]
    is_peak = (inner >= smooth[:-2]) & (inner > smooth[2:]) & (inner >= LEAST_OF_BEAM * inner.max())
    return (edges[:-1] + edges[1:])[is_peak & (inner > 0)] / 2


def points_at(points: Points, elevation: float, height: float = 0.0) -> Points:
    """Select the points (Q, 3) of a beam: those within half a ring's spacing of its elevation.

    Args:
        points: (P, 3 or more) metres, in any order.
        elevation, height: radians and metres, see :class:`Beam`.
    """
    return points[are_at(points, elevation, height), :3]


def are_at(points: Points, elevation: float, height: float = 0.0) -> npt.NDArray[np.bool_]:
    """Mask (P,) of the points that :func:`points_at` selects."""
    near: npt.NDArray[np.bool_] = np.abs(elevations_from(points, height) - elevation) < HALF_RING_SPACING
    return near


def are_thinned(beams: Sequence[Points]) -> bool:
    """Whether the points of a beam were thinned to a grid of cubes, as by a voxel filter.

    Without thinning, the angle between neighbouring points does not depend on their range.

    Args:
        beams: points (P, 2 or more) of the beam, one array for each frame, at least one.
    """
    near, far = [], []
    for points in beams:
        x, y = points[np.argsort(np.arctan2(points[:, 1], points[:, 0])), :2].astype(np.float64).T
        gaps, distance = np.diff(np.arctan2(y, x)), np.hypot(x, y)
        farther = np.maximum(distance[1:], distance[:-1])
        near.append(gaps[farther < NEAR])
        far.append(gaps[farther > FAR])
    gaps_near, gaps_far = np.concatenate(near), np.concatenate(far)
    if min(len(gaps_near), len(gaps_far)) < FEWEST_GAPS:
        return False
    return bool(np.median(gaps_near) > THINNED * np.median(gaps_far))


def elevations_from(points: Points, height: float) -> FloatArray:
    """Elevations (P,) in radians of points (P, 3 or more), seen from a height in metres above the origin."""
    x, y, z = points[:, :3].T
    elevations: FloatArray = np.arctan2(z - height, np.hypot(x, y))
    return elevations
