"""One beam of a spinning laser that has many: out of points that come laser by laser, or in any order.

The beams of a Velodyne meet some way above the origin of its points: a beam of elevation e is where z =
height + r tan(e) at the horizontal range r. Seen from that height its points lie on one cone, to a few
hundredths of a degree; seen from the origin (the height 0) neighbours overlap.
"""

from collections.abc import Sequence
from typing import NamedTuple

import numpy as np
import numpy.typing as npt

from rcnn_odom.geometry import FloatArray

LEVEL = np.deg2rad(0.15)
"""Elevation that the chosen ring is to be nearest to: a hair above horizontal. KITTI's two most level rings
lie at +0.06 to +0.25 and at -0.1 to -0.3 degrees, so that the one nearest to 0 would change between
sequences; the upper one is also the one that a pitching car turns into the road last."""
NEAR_LEVEL = np.deg2rad(2.0)
"""A beam farther from ``LEVEL`` sees the road or the sky instead of walls."""
HALF_RING_SPACING = np.deg2rad(0.2)
FARTHEST = np.float32(1e6)
"""Metres: what claims to be farther away is no return."""
RING_DROP = np.deg2rad(30.0)
"""The azimuth drops by more than this between rings; within one, close objects make it drop by up to 7."""

SAMPLED_POINTS = 1024
"""So many of a cloud's points tell in what order it is."""
MOST_STEPS_BACK = 0.25
"""Within a ring the azimuth grows but for noise and close objects: part of the steps that may go back."""
RINGS_SPREAD = 0.5
"""The elevation spreads less than this within rings, as a part of its spread over all points."""
SAME_LASER = np.deg2rad(0.06)
AROUND_START = 5
"""Points before and after the start of a ring whose elevations tell whether the laser is the same."""
MOST_CUT = 0.25
"""Part of the starts that may lie within a laser's turn: where a turn that begins aside is cut in two."""
ONE_BEAM = np.deg2rad(0.1)
"""The elevation of a single beam spreads less than this."""
HIGHEST = 0.5
"""Metres: the beams meet no farther than this from the origin."""
HIGHEST_RISE = 3.5
"""Metres: nor farther where the points were raised, to the ground or the base of a robot."""
BIN = np.deg2rad(0.05)
"""Of a histogram of elevations."""
SEEN = np.deg2rad(4.0)
"""Up to so far from level the elevations are looked at."""
DISTINCT = 1.5
"""Beams make a histogram of elevations so much sharper than its mean over half a degree: by 3 to 6 in KITTI,
also where it is thinned to a grid of 0.2 m, but by 1.0 to 1.2 in a frame that is not the laser's."""
LEAST_OF_BEAM = 0.2
"""Part of the fullest beam's points that a beam must have."""
SHARPER = 1.1
"""A height is believed that makes the beams so much clearer."""

NEAR, FAR = 15.0, 20.0
"""Metres: a grid of cubes thins what is near the laser, and leaves what is far."""
FEWEST_GAPS = 20
THINNED = 1.5
"""Angles between near points that are so many times those between far ones tell of a grid."""

Points = npt.NDArray[np.floating]


class Beam(NamedTuple):
    """One laser of many, as its points show it in whatever order they come.

    Attributes:
        elevation: radians, seen from where the beams meet.
        height: metres of that place above the origin of the points.
    """

    elevation: float
    height: float = 0.0


def split_rings(points: Points) -> list[Points] | None:
    """The points (P, 3) of every laser, in the order of the file, out of points (P, 3 or more).

    Returns:
        A single ring, whatever its order, where there is one beam alone. None where the points do not come
        laser by laser: sorted by azimuth, shuffled, turning clockwise, one direction after the other; or
        where most turns begin in another direction than azimuth 0, so that they cannot be told apart.
    """
    starts = ring_starts(points)
    order = _Order(points, starts)
    if order.is_one_beam:
        return [points[:, :3]]
    if not order.is_laser_by_laser or _are_turns_cut(points, starts, order.height):
        return None
    ends = [*starts[1:], len(points)]
    return [points[start:end, :3] for start, end in zip(starts, ends, strict=True)]


def ring_starts(points: Points) -> npt.NDArray[np.int64]:
    """Where every ring begins in points (P, 3 or more) that come laser by laser.

    Within a ring the azimuth in [0, 2 pi) grows; a ring begins where it drops. Noise that carries points
    back and forth over azimuth 0 does not begin another: each step back over it undoes a step forward.
    The angle itself is computed at the few candidate steps alone, since it is the costly part.

    Returns:
        (R,) indices, the first 0.
    """
    x, y = np.ascontiguousarray(points[:, :2].T)
    right = y < 0
    cross = x[:-1] * y[1:] - y[:-1] * x[1:]
    dot = x[:-1] * x[1:] + y[:-1] * y[1:]
    # A drop either passes between the left and the right half plane or is a clockwise turn.
    candidates = np.flatnonzero((right[:-1] != right[1:]) | (cross < -np.tan(RING_DROP) * dot))
    step = _azimuth(x, y, candidates + 1) - _azimuth(x, y, candidates)
    change = (step < -RING_DROP).astype(np.int64) - (step > 2 * np.pi - RING_DROP)
    # A frame may begin with a few points just short of azimuth 0: they belong to the first ring.
    short_of_zero = len(x) > 0 and _azimuth(x, y, np.array([0]))[0] > 2 * np.pi - RING_DROP
    level = np.cumsum(change) - int(short_of_zero)
    highest_before = np.maximum.accumulate(np.concatenate([[0], level]))[:-1]
    return np.concatenate([[0], candidates[level > highest_before] + 1])


def _are_turns_cut(points: Points, starts: npt.NDArray[np.int64], height: float) -> bool:
    """Whether the same laser goes on over many of the starts, as where each turn begins somewhere else.

    The elevation is seen from the height of where the beams meet: seen from elsewhere, neighbours may agree.
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


class _Order:
    """How points (P, 3 or more) with these ring starts are ordered, judged by a sample of them."""

    def __init__(self, points: Points, starts: npt.NDArray[np.int64]) -> None:
        # Odd, since the number of lasers is even: a sample must not see the same few of them every time.
        stride = (len(points) // SAMPLED_POINTS) | 1
        self.x, self.y, z = points[::stride, :3].T.astype(np.float64)
        next_x, next_y = points[1::stride, :2].T.astype(np.float64)
        back = self.x[: len(next_x)] * next_y < self.y[: len(next_x)] * next_x
        self.steps_back = np.count_nonzero(back) / max(len(back), 1)
        distance = np.maximum(np.sqrt(self.x**2 + self.y**2), 1.0)
        self.slope, self.closeness = np.clip(z / distance, -1.0, 1.0), 1 / distance
        self.together, _ = self._fit(np.zeros(len(z), np.int64), HIGHEST)
        # The number of starts before each point of the sample.
        firsts = np.minimum(-(-starts[1:] // stride), len(z))
        ring = np.cumsum(np.bincount(firsts, minlength=len(z) + 1)[: len(z)])
        within, _ = self._fit(ring, HIGHEST)
        self.are_ringed = within <= RINGS_SPREAD * self.together
        within, self.height = self._fit(ring, HIGHEST_RISE)
        if not self.are_ringed:  # as of a raised cloud; as a whole it may lie about a higher cone, too
            together, _ = self._fit(np.zeros(len(z), np.int64), HIGHEST_RISE)
            self.are_ringed = within <= RINGS_SPREAD * together

    @property
    def is_laser_by_laser(self) -> bool:
        return bool(self.steps_back < MOST_STEPS_BACK) and self.are_ringed

    @property
    def is_one_beam(self) -> bool:
        """Of a laser that is level, or tilted as a whole: then its slopes are those of a plane."""
        if self.together < ONE_BEAM or self.is_laser_by_laser:
            return self.together < ONE_BEAM
        azimuth = np.arctan2(self.y, self.x)
        plane = np.stack([np.ones_like(azimuth), np.cos(azimuth), np.sin(azimuth), self.closeness], axis=1)
        fit = np.linalg.lstsq(plane, self.slope, rcond=None)[0]
        return bool(np.std(self.slope - plane @ fit) < ONE_BEAM)

    def _fit(self, ring: npt.NDArray[np.int64], highest: float) -> tuple[float, float]:
        """Standard deviation in radians about the cone of each ring, all with their top at one height.

        That height in metres is given too, no more than ``highest`` from the origin.
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
    """The height of the beams' meeting point, of values (P,) whose means are 0."""
    square = float(closeness @ closeness)
    return float(np.clip(closeness @ slope / square, -highest, highest)) if square > 1e-9 else 0.0


def median_elevation(points: Points) -> float:
    """The median elevation of points (P, 3), seen from the origin, in radians; nan if there are none."""
    return float(np.median(elevations_from(points, 0.0))) if len(points) else float("nan")


def fit_beam(ring: Points) -> Beam:
    """The beam of a ring's points (P, 3 or more), P >= 1."""
    x, y, z = ring[:, :3].astype(np.float64).T
    distance = np.maximum(np.hypot(x, y), 1.0)
    closeness, slope = 1 / distance, z / distance
    height = _slope_over(closeness - closeness.mean(), slope - slope.mean(), HIGHEST)
    return Beam(float(np.median(elevations_from(ring, height))), height)


def find_level_beam(clouds: Sequence[Points]) -> Beam:
    """The beam nearest to ``LEVEL``, of points that come in any order.

    Args:
        clouds: each (P, 3 or more) metres, frames of one laser.

    Raises:
        ValueError: no beam is within 2 degrees of level, or the points gather at no beams at all.
    """
    points = np.concatenate([cloud[:, :3] for cloud in clouds])
    height = _find_height(points[np.abs(elevations_from(points, 0.0)) < SEEN])
    if not _are_distinct(elevations_from(points, height)):
        raise ValueError("they gather at no beams as seen from the laser, so they are not in its frame")
    return Beam(level_elevation(clouds, height), height)


def _are_distinct(elevations: FloatArray) -> bool:
    """Whether elevations (P,) gather at beams, as far as any are near level."""
    counts = np.histogram(elevations, int(2 * SEEN / BIN), (-SEEN, SEEN))[0].astype(np.float64)
    smooth = np.convolve(counts, np.full(9, 1 / 9), "same")
    return bool(counts @ counts >= DISTINCT * (smooth @ smooth))


def _find_height(points: Points) -> float:
    """Where the beams meet: the height from which the elevations of points (P, 3) gather most."""

    def gathered(height: float) -> float:
        counts, _ = np.histogram(elevations_from(points, height), int(2 * SEEN / BIN), (-SEEN, SEEN))
        return float(np.sum(counts.astype(np.float64) ** 2))

    best = max(np.arange(-HIGHEST, HIGHEST, 0.01), key=gathered)
    best = max(best + np.arange(-0.008, 0.01, 0.002), key=gathered)
    return float(best) if gathered(best) > SHARPER * gathered(0.0) else 0.0


def level_elevation(clouds: Sequence[Points], height: float = 0.0) -> float:
    """The elevation of the beam nearest to ``LEVEL``, of points that come in any order.

    Args:
        clouds: each (P, 3 or more) metres, frames of one laser.
        height: metres of the place where the beams meet above the origin.

    Returns:
        Radians, seen from ``height``. The beam is nearest to level as seen from the origin.

    Raises:
        ValueError: no beam is within 2 degrees of level.
    """
    points = np.concatenate([cloud[:, :3] for cloud in clouds])
    points = points[np.abs(elevations_from(points, height)) < SEEN]
    elevations, from_origin = elevations_from(points, height), elevations_from(points, 0.0)
    near = [
        (float(np.median(elevations[of_beam])), float(np.median(from_origin[of_beam])))
        for peak in _find_peaks(elevations)
        if (of_beam := np.abs(elevations - peak) < 1.5 * BIN).any()
    ]
    elevation, level = min(near, key=lambda beam: abs(beam[1] - LEVEL), default=(np.nan, np.inf))
    if abs(level - LEVEL) > NEAR_LEVEL:
        raise ValueError("no beam of the laser is within 2 degrees of level")
    return elevation


def _find_peaks(elevations: FloatArray) -> FloatArray:
    """Where elevations (P,) gather, in radians."""
    counts, edges = np.histogram(elevations, int(2 * SEEN / BIN), (-SEEN, SEEN))
    smooth = np.convolve(counts, [1, 2, 1])  # of the bins and one more on either side
    inner = smooth[1:-1]
    is_peak = (inner >= smooth[:-2]) & (inner > smooth[2:]) & (inner >= LEAST_OF_BEAM * inner.max())
    return (edges[:-1] + edges[1:])[is_peak & (inner > 0)] / 2


def points_at(points: Points, elevation: float, height: float = 0.0) -> Points:
    """The points (Q, 3) within half a ring's spacing of an elevation in radians.

    Args:
        points: (P, 3 or more) metres, in any order.
        elevation, height: of the beam, see :class:`Beam`.
    """
    return points[are_at(points, elevation, height), :3]


def are_at(points: Points, elevation: float, height: float = 0.0) -> npt.NDArray[np.bool_]:
    """Which points (P,) are those of :func:`points_at`."""
    near: npt.NDArray[np.bool_] = np.abs(elevations_from(points, height) - elevation) < HALF_RING_SPACING
    return near


def are_thinned(beams: Sequence[Points]) -> bool:
    """Whether the points of a beam were thinned to a grid of cubes, as by a voxel filter.

    A laser's own points are as many degrees apart near it as far from it.

    Args:
        beams: its points (P, 2 or more) in each of some frames, at least one.
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
    """Radians (P,) of points (P, 3 or more) as seen from a height in metres above the origin."""
    x, y, z = points[:, :3].T
    elevations: FloatArray = np.arctan2(z - height, np.hypot(x, y))
    return elevations
