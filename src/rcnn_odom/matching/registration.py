"""Registration: the pose of one scan after the other in a local map that is built from them."""

import math
from dataclasses import dataclass, field

import numpy as np

from rcnn_odom.geometry import FloatArray, advance, relative_step
from rcnn_odom.matching import yaw
from rcnn_odom.matching.align import Table, align, build_table
from rcnn_odom.matching.covariance import (
    CORRELATED,
    Aligned,
    Uncertainty,
    hold_undetermined,
    weakest_direction,
)
from rcnn_odom.matching.local_map import LocalMap
from rcnn_odom.matching.outline import Outline

FEWEST_POINTS = 6
"""Minimum number of points for registration: those of three isolated objects."""
MOST_POINTS = 250
"""Points of a scan that are aligned, evenly chosen in angular order."""
VOXEL, MOST_WEIGHT = 0.1, 10.0
"""Edge length of the map's voxels in metres, and the weight of a cell; see :class:`LocalMap`."""
MAP_LENGTH, SHORTEST_MAP = 2.0, 1.5
"""Distance travelled after which the map forgets, in median ranges of a scan, and its minimum in metres. A
longer map keeps old errors; a shorter one loses what has left the field of view."""
KEY_DISTANCE, KEY_TURN, KEY_SHARE = 0.2, np.deg2rad(10.0), 0.9
"""A scan is added to the map after so many metres or radians, or if less than this share is in the map ..."""
KEY_LEAST = 0.25
"""... and it is at least this fraction of them away. At rest nothing is added, so that nothing drifts."""
TABLE_FARTHEST = 120.0
"""Metres; cells of the map that are farther away are not used."""
WIDE_GATE, NARROW_GATE, GATE_ERRORS = 5.0, 1.0, 3.0
"""Largest distance between partners in the first step (the gate): metres without a useful guess, metres at
least, and otherwise this multiple of the recent error of the guesses."""
GATE_TURN, GATE_FADES = 5.0, 0.9
"""Metres that equal an error of one radian, and the factor by which the largest error decays in each scan."""
GOOD_SCORE, LEAST_SCORE = 0.65, 0.25
"""Below the first score, other starts are tried as well; below the second, the scan does not fit the map."""
ELSEWHERE, ELSEWHERE_TURN, NEARLY = 0.3, np.deg2rad(5.0), 0.85
"""An alignment more than so many metres or radians away is another place. It makes the best one ambiguous if
its score is more than this fraction of the best."""
SUDDEN, SUDDEN_TURN = 0.5, np.deg2rad(20.0)
"""A motion more than so many metres or radians from the guess is reported as sudden."""
WEAK_SHIFTS = (0.4, 0.8, 1.2, -0.4, -0.8)
"""Metres along a hardly determined direction at which other starts are tried."""
START_PENALTY, AWAY_PENALTY, TURN_PENALTY = 0.03, 0.03, 0.06
"""Deductions from the score: for a start other than the guess, per metre and per radian from the guess."""
CLOSEST_GATE, GATE_SHRINKS = 0.25, 0.5
"""The smallest gate in metres, and the factor by which the gate shrinks in each step."""
SPARSE_GATE = 4.0
"""Increase of a point's gate with its range, in beam spacings."""
SAME_WALL = np.cos(np.deg2rad(45.0))
"""Least cosine between the normals of a pair; below it they belong to different walls."""
CALM = 0.04
"""Least scale of the robust weights as a fraction of the gate, one centimetre at the smallest gate. While the
gate is wide, the few walls across a street must count as much as the many along it."""
MOST_STEPS = 30
"""Largest number of Gauss-Newton steps."""
ENOUGH_LINES = 60
"""With so many points on lines, only these decide whether a scan fits."""
SCORE_WIDTH = 0.15
"""Metres; points with a larger residual have a score of 0."""
SETTINGS = np.array([CLOSEST_GATE, GATE_SHRINKS, SAME_WALL, CALM, MOST_STEPS, SCORE_WIDTH])
"""Settings of :func:`rcnn_odom.matching.align.align`."""
WEAK_PRIOR = 5e-4 * np.eye(3)
"""Information of a guess that was not measured, relative to the mean information of the pairs."""
POINT_ERROR = 0.01
"""Metres: the error of a typical point, by which a measured guess is weighted."""
TURNS, FEWEST_FOR_TURNS = 5, 30
"""Number of turns that are tried from the correlation of normals, and the points that it needs."""
NEAR_GATE = 1.5
"""Gate in metres for other starts that are near the guess."""
SHIFTS = (0.5, 1.0, 1.5, 2.0, 3.0)
"""Metres straight ahead of the last pose at which other starts are tried."""
FIRST_SHIFTS = (0.75, 1.5, 3.0, 4.5, -0.75, -1.5)
"""The same while no motion is known yet."""
FORGET_EVERY = 10
"""Number of scans added to the map between two removals of old cells."""
MOST_LOST = 5
"""A new map begins after more than so many scans in a row that do not fit."""


@dataclass(frozen=True, eq=False)
class Match:
    """The pose of a scan in the map.

    Attributes:
        pose: (3,) x and y in metres and heading in radians in the map's frame.
        step: (3, 3) covariance of the step from the previous pose, in the frame of that pose.
        noise: (3, 3) covariance of the part of its error that the next step cancels, in the pose's frame.
        held: (3, K) directions in the map's frame, of unit length in metres and radians, which the scan does
            not determine; along them the pose is the guess.
        fits: whether the scan fits the map; otherwise the pose is the guess.
        is_poor: much of the scan does not fit.
        is_ambiguous: the scan fits in another place nearly as well.
        surprise: metres and radians between the pose and the guess if that is much; otherwise 0.
        begins_map: several scans did not fit, and a new map begins with this scan.

    Example:
        A scan without returns fits no map, so that its pose is the guess:

        >>> nothing = Outline(*[np.empty((0, 2))] * 3, 0, 0.0, 0.0, reach=0.0, spacing=0.1)
        >>> match = Registration().register(nothing, guess=np.array([1.0, 0.0, 0.0]), spread=np.eye(3))
        >>> match.fits, match.pose.tolist()
        (False, [1.0, 0.0, 0.0])
    """

    pose: FloatArray
    step: FloatArray
    noise: FloatArray
    held: FloatArray = field(default_factory=lambda: np.empty((3, 0)))
    fits: bool = True
    is_poor: bool = False
    is_ambiguous: bool = False
    surprise: tuple[float, float] = (0.0, 0.0)
    begins_map: bool = False


class Registration:
    """Registers the scans of one laser against a map that they build.

    Attributes:
        pose: (3,) of the last scan in the map's frame, x and y in metres and heading in radians.
        is_empty: there is no map yet.
        knows_motion: a scan has been registered, so that the next guess can be based on a motion.

    Example:
        A square room of 8 m, seen from its centre and then from 1 m ahead:

        >>> from rcnn_odom.matching.outline import outline
        >>> from rcnn_odom.matching.points import find_points
        >>> bearings, registration = np.deg2rad(np.arange(0.5, 360.0)), Registration()
        >>> cos, sin = np.cos(bearings), np.abs(np.sin(bearings))
        >>> room = [np.minimum((4 - x * np.sign(cos)) / np.abs(cos), 4 / sin) for x in (0.0, 1.0)]
        >>> first, second = [outline(find_points(ranges, bearings, 80.0)) for ranges in room]
        >>> registration.begin(first)
        >>> registration.register(second, guess=np.zeros(3), spread=np.eye(3)).pose.round(2) + 0.0
        array([1., 0., 0.])
    """

    def __init__(self) -> None:
        self._map = LocalMap(VOXEL, MOST_WEIGHT)
        self.pose, self.is_empty, self.knows_motion = np.zeros(3), True, False
        self._key_pose, self._key_normals = np.zeros(3), np.empty((0, 2))
        self._travelled, self._since, self._added, self._lost = 0.0, 0.0, 0, 0
        self._table: Table
        self._guess_error, self._uncertainty = np.inf, Uncertainty()

    def map_points(self) -> FloatArray:
        """The points (C, 2) in metres in the map's frame with which the next scan is compared.

        Example:
            >>> wall, normals = np.array([[2.0, y] for y in range(6)]), np.repeat([[-1.0, 0.0]], 6, axis=0)
            >>> registration = Registration()
            >>> registration.begin(Outline(wall, normals, wall, 6, 0.0, 0.0, reach=2.0, spacing=0.01))
            >>> registration.map_points()[:2]
            array([[2., 0.],
                   [2., 1.]])
        """
        cells = self._map.present()
        return cells[cells[:, 5] >= self._since, :2]

    def begin(self, scan: Outline) -> None:
        """Begins a new map with a scan at the current pose."""
        self._map.clear()
        self._lost, self._guess_error, self.knows_motion = 0, np.inf, False
        self._uncertainty = Uncertainty()
        self._since = self._travelled
        self.is_empty = len(scan.points) < FEWEST_POINTS
        if not self.is_empty:
            self._add(scan)

    def register(
        self, scan: Outline, guess: FloatArray, spread: FloatArray, pull: FloatArray | None = None
    ) -> Match:
        """The pose of one more scan.

        Args:
            scan: its points and normals.
            guess: (3,) pose in the map's frame, from which the search starts.
            spread: (3, 3) covariance of the guess in the map's frame.
            pull: (3, 3) covariance of the guess as a measurement, by which the match is drawn to it. None: it
                was not measured and has a small weight.
        """
        if len(scan.points) < FEWEST_POINTS or self.is_empty:
            return self._keep_guess(scan, guess, spread)
        found, has_rival = self._search(
            scan, guess, WEAK_PRIOR if pull is None else _stiffness(pull, len(scan.points))
        )
        if found.fit < LEAST_SCORE:
            return self._keep_guess(scan, guess, spread)
        pose, held, information = hold_undetermined(found, guess, spread)
        off = math.hypot(pose[0] - guess[0], pose[1] - guess[1]), abs(_wrap(pose[2] - guess[2]))
        is_sudden = self.knows_motion and (off[0] > SUDDEN or off[1] > SUDDEN_TURN)
        error = off[0] + GATE_TURN * off[1]
        decayed = 0.0 if np.isinf(self._guess_error) else GATE_FADES * self._guess_error
        self._guess_error, self._lost, self.knows_motion = max(decayed, error), 0, True
        before, self.pose = self.pose, pose
        if self._is_keyframe(pose, found.share):
            self._add(scan)
        covariances = self._uncertainty.update(
            before, pose, spread, information, max(scan.reach, SHORTEST_MAP)
        )
        return Match(
            *(pose, *covariances, held),
            is_poor=found.fit < GOOD_SCORE,
            is_ambiguous=has_rival,
            surprise=off if is_sudden else (0.0, 0.0),
        )

    def _search(self, scan: Outline, guess: FloatArray, stiffness: FloatArray) -> tuple[Aligned, bool]:
        """The best alignment, and whether the scan fits elsewhere nearly as well.

        The search starts from the guess, and from other poses as well if that gives a poor result.
        """
        points, normals = _subsample(scan)
        # Isolated objects look different from other positions, so only lines count if there are enough.
        lines = len(points) * scan.lines // len(scan.points) if scan.lines >= ENOUGH_LINES else len(points)
        found = np.zeros((7, 3))

        def align_from(start: FloatArray, gate: float) -> Aligned:
            table = self._table
            pose, score, fit = align(
                *(points, normals, table.entries, table.starts, table.centre),
                *(start, guess, stiffness, gate, SPARSE_GATE * scan.spacing, lines, SETTINGS, found),
            )
            return Aligned.from_alignment(pose, score, fit, found, scan, len(points))

        gate = min(WIDE_GATE, max(NARROW_GATE, GATE_ERRORS * self._guess_error))
        best = align_from(guess, gate)
        starts: list[tuple[FloatArray, float]] = []
        if best.fit < GOOD_SCORE or not self.knows_motion:
            starts = self._other_starts(scan, guess, gate)
        elif (weak := weakest_direction(best)) is not None:
            starts = [(guess + shift * weak, WIDE_GATE) for shift in WEAK_SHIFTS]
        if not starts:
            return best, False
        found_all = [best, *(align_from(*start) for start in starts)]
        first = best
        # Poses near the guess are preferred: a similar place must fit better by more than chance.
        best = max(found_all, key=lambda other: other.score - _penalty(other.pose, guess, other is not first))
        return best, any(_is_rival(other, best) for other in found_all)

    def _other_starts(self, scan: Outline, guess: FloatArray, gate: float) -> list[tuple[FloatArray, float]]:
        """Other poses to start from, each with its first gate.

        They are the last pose, positions straight ahead of it, and turns that are found from the normals.
        """
        starts = [(guess, other) for other in (WIDE_GATE, NEAR_GATE) if other != gate]
        starts.append((self.pose, WIDE_GATE))
        turns = TURNS if len(scan.points) >= FEWEST_FOR_TURNS else 0
        for turn in yaw.turn_candidates(self._key_normals, scan.normals, turns):
            heading = guess[2] + _wrap(self._key_pose[2] + turn - guess[2])
            starts += [(np.array([x, y, heading]), WIDE_GATE) for x, y in (guess[:2], self.pose[:2])]
        ahead = np.array([self.pose[0], self.pose[1], guess[2]])
        shifts, gate = (SHIFTS, NEAR_GATE) if self.knows_motion else (FIRST_SHIFTS, WIDE_GATE)
        return starts + [(advance(ahead, np.array([shift, 0.0, 0.0])), gate) for shift in shifts]

    def _keep_guess(self, scan: Outline, guess: FloatArray, spread: FloatArray) -> Match:
        """Takes the guess as the pose of a scan that does not fit the map.

        After several of them a new map begins there. Without any map, one begins with the first scan that has
        enough points.
        """
        self._lost += 1
        covariances = self._uncertainty.update(self.pose, guess, spread, np.zeros((3, 3)))
        self.pose = guess
        begins = (self._lost > MOST_LOST or self.is_empty) and len(scan.points) >= FEWEST_POINTS
        if begins:
            self.begin(scan)
        return Match(guess, *covariances, np.eye(3), fits=False, begins_map=begins)

    def _is_keyframe(self, pose: FloatArray, share: float) -> bool:
        """Whether a scan at this pose, with this share of points in the map, is to be added to the map."""
        step = relative_step(self._key_pose, pose)
        away = max(math.hypot(step[0], step[1]) / KEY_DISTANCE, abs(float(step[2])) / KEY_TURN)
        return away > 1 or (away > KEY_LEAST and share < KEY_SHARE)

    def _add(self, scan: Outline) -> None:
        """Adds a scan at the current pose to the map and forgets what was seen too long ago."""
        step = relative_step(self._key_pose, self.pose)
        self._travelled += math.hypot(step[0], step[1])
        self._map.add(scan.points, scan.normals, self.pose, self._travelled)
        self._since = max(self._since, self._travelled - max(SHORTEST_MAP, MAP_LENGTH * scan.reach))
        self._added += 1
        if self._added % FORGET_EVERY == 0:
            self._map.forget(self._since)
        self._key_pose, self._key_normals = self.pose, scan.normals
        self._table = build_table(self._map.present(), self._since, self.pose[:2], TABLE_FARTHEST)


def _subsample(scan: Outline) -> tuple[FloatArray, FloatArray]:
    """At most ``MOST_POINTS`` points (K, 2) and normals (K, 2) of a scan, evenly chosen."""
    if len(scan.points) <= MOST_POINTS:
        return scan.points, scan.normals
    chosen = np.arange(MOST_POINTS) * len(scan.points) // MOST_POINTS
    return scan.points[chosen], scan.normals[chosen]


def _penalty(pose: FloatArray, guess: FloatArray, is_other: bool) -> float:
    """The deduction from the score of a pose for its distance from the guess and for another start."""
    away = math.hypot(pose[0] - guess[0], pose[1] - guess[1])
    start = START_PENALTY if is_other else 0.0
    return start + AWAY_PENALTY * min(away, 3.0) + TURN_PENALTY * abs(_wrap(pose[2] - guess[2]))


def _is_rival(other: Aligned, best: Aligned) -> bool:
    """Whether an alignment is in another place and its score is nearly the best."""
    step = relative_step(best.pose, other.pose)
    is_elsewhere = math.hypot(step[0], step[1]) > ELSEWHERE or abs(float(step[2])) > ELSEWHERE_TURN
    return is_elsewhere and other.score > NEARLY * best.score


def _stiffness(pull: FloatArray, points: int) -> FloatArray:
    """The information (3, 3) of a measured guess, relative to the mean information of a scan's pairs."""
    return WEAK_PRIOR + np.linalg.inv(pull) * POINT_ERROR**2 * CORRELATED / points


def _wrap(angle: float) -> float:
    """An angle in radians, wrapped to [-pi, pi)."""
    return (float(angle) + math.pi) % (2 * math.pi) - math.pi
