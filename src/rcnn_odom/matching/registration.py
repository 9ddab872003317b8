"""Where a laser is in the map of what it has seen lately: registration of one scan after the other."""

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
"""Points without which a scan cannot be registered: three things that stand alone."""
MOST_POINTS = 250
"""Points of a scan that are aligned, every k-th in angular order."""
VOXEL, MOST_WEIGHT = 0.1, 10.0
"""Metres, and points whose mean a cell of the map is; see :class:`LocalMap`."""
MAP_LENGTH, SHORTEST_MAP = 2.0, 1.5
"""The length of the way that the map remembers, in median ranges of a scan, and at least in metres. A longer
one would hold on to old errors; a shorter one would lose what has left the field of view."""
KEY_DISTANCE, KEY_TURN, KEY_SHARE = 0.2, np.deg2rad(10.0), 0.9
"""A scan is added to the map after so many metres or radians, or when less of it is in the map ..."""
KEY_LEAST = 0.25
"""... and it is at least this part of the former away. At rest nothing is added, so that nothing drifts."""
TABLE_FARTHEST = 120.0
"""Metres: cells of the map that are farther away are not looked at."""
WIDE_GATE, NARROW_GATE, GATE_ERRORS = 5.0, 1.0, 3.0
"""Metres between partners in the first step: where the guess may be anywhere, and at least; otherwise it is
so many of the recent errors of guesses."""
GATE_TURN, GATE_FADES = 5.0, 0.9
"""Metres by which a radian of such an error counts, and by what the largest fades in each scan."""
GOOD_SCORE, LEAST_SCORE = 0.65, 0.25
"""Below the former other starts are tried as well; below the latter the scan does not fit the map."""
ELSEWHERE, ELSEWHERE_TURN, NEARLY = 0.3, np.deg2rad(5.0), 0.85
"""Metres or radians from which on an alignment is another place, which is a rival with this part of the best
score."""
SUDDEN, SUDDEN_TURN = 0.5, np.deg2rad(20.0)
"""Metres or radians from the guess, from which on a motion is told as sudden."""
WEAK_SHIFTS = (0.4, 0.8, 1.2, -0.4, -0.8)
"""Metres along a direction that is hardly determined, where other starts are tried."""
START_PENALTY, AWAY_PENALTY, TURN_PENALTY = 0.03, 0.03, 0.06
"""Of the score: for another start than the guess, and for a metre and a radian from it."""
CLOSEST_GATE, GATE_SHRINKS = 0.25, 0.5
"""Metres where the gate stops, and by what it shrinks in each step."""
SPARSE_GATE = 4.0
"""Spacings of the beams by which the gate of a point opens with its range."""
SAME_WALL = np.cos(np.deg2rad(45.0))
"""Cosine between two normals, below which a pair shows two different walls."""
CALM = 0.04
"""Times the gate: residuals of this size keep their weight even where most are smaller. A centimetre at last;
while the gate is open the few walls across a street must pull as well as the many along it."""
MOST_STEPS = 30
ENOUGH_LINES = 60
"""Points on lines, from which on these alone tell whether a scan fits."""
SCORE_WIDTH = 0.15
"""Metres of a residual that counts for nothing in the score."""
SETTINGS = np.array([CLOSEST_GATE, GATE_SHRINKS, SAME_WALL, CALM, MOST_STEPS, SCORE_WIDTH])
WEAK_PRIOR = 5e-4 * np.eye(3)
"""Pull to the guess, beside a mean square of 1 of residuals' change over metres or radians."""
POINT_ERROR = 0.01
"""Metres of a usual point's error, against which a measured guess is weighed."""
TURNS, FEWEST_FOR_TURNS = 5, 30
"""Peaks of the correlation of normals that are tried as turns, and points that tell of them."""
NEAR_GATE = 1.5
"""Metres of the gate where another start is thought to be near."""
SHIFTS = (0.5, 1.0, 1.5, 2.0, 3.0)
"""Metres straight ahead of where the laser was, where other starts are tried."""
FIRST_SHIFTS = (0.75, 1.5, 3.0, 4.5, -0.75, -1.5)
"""Metres ahead that are tried as well while the motion is not known yet."""
FORGET_EVERY = 10
"""Scans after which the map drops what it has forgotten."""
MOST_LOST = 5
"""Scans in a row that do not fit the map, after which a new map begins."""


@dataclass(frozen=True, eq=False)
class Match:
    """Where a scan was taken.

    Attributes:
        pose: (3,) x and y in metres and heading in radians in the map's frame.
        step: (3, 3) covariance of the step from the pose before, in that one's frame.
        noise: (3, 3) covariance of the part of its error that the next step takes back, in the pose's frame.
        held: (3, K) directions in the map's frame, of unit length in metres and radians, which the scan does
            not determine: along them the pose is the guess.
        fits: the scan fits the map; otherwise the pose is the guess.
        is_poor: much of it does not fit.
        is_ambiguous: it fits in another place nearly as well.
        surprise: metres and radians from where the guess led, if that is far; otherwise 0.
        begins_map: nothing has fitted for a while, and a new map begins with this scan.
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
        knows_motion: a scan has been registered, so that the next guess has something to go by.
    """

    def __init__(self) -> None:
        self._map = LocalMap(VOXEL, MOST_WEIGHT)
        self.pose, self.is_empty, self.knows_motion = np.zeros(3), True, False
        self._key_pose, self._key_normals = np.zeros(3), np.empty((0, 2))
        self._travelled, self._since, self._added, self._lost = 0.0, 0.0, 0, 0
        self._table: Table
        self._guess_error, self._uncertainty = np.inf, Uncertainty()

    def begin(self, scan: Outline) -> None:
        """Begins a new map with a scan at the present pose."""
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
            guess: (3,) pose in the map's frame.
            spread: (3, 3) covariance of the guess in the map's frame.
            pull: (3, 3) covariance of what was measured of it, by which it pulls; None: it pulls weakly.
        """
        if len(scan.points) < FEWEST_POINTS or self.is_empty:
            return self._lose(scan, guess, spread)
        found, has_rival = self._search(
            scan, guess, WEAK_PRIOR if pull is None else _stiffness(pull, len(scan.points))
        )
        if found.fit < LEAST_SCORE:
            return self._lose(scan, guess, spread)
        pose, held, information = hold_undetermined(found, guess, spread)
        off = math.hypot(pose[0] - guess[0], pose[1] - guess[1]), abs(_wrap(pose[2] - guess[2]))
        is_sudden = self.knows_motion and (off[0] > SUDDEN or off[1] > SUDDEN_TURN)
        error = off[0] + GATE_TURN * off[1]
        fading = 0.0 if np.isinf(self._guess_error) else GATE_FADES * self._guess_error
        self._guess_error, self._lost, self.knows_motion = max(fading, error), 0, True
        before, self.pose = self.pose, pose
        if self._is_key(pose, found.share):
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
        """The best alignment from the guess on, or where that is poor from others as well; has it a rival?"""
        points, normals = _thin(scan)
        # Things that stand alone look different from elsewhere; where there are lines, they alone tell it.
        lines = len(points) * scan.lines // len(scan.points) if scan.lines >= ENOUGH_LINES else len(points)
        found = np.zeros((7, 3))

        def align_from(start: FloatArray, gate: float) -> Aligned:
            table = self._table
            pose, score, fit = align(
                *(points, normals, table.entries, table.starts, table.centre),
                *(start, guess, stiffness, gate, SPARSE_GATE * scan.spacing, lines, SETTINGS, found),
            )
            return Aligned.of(pose, score, fit, found, scan, len(points))

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
        # What is nearer to the guess is preferred, so that a twin must fit better by more than chance.
        best = max(found_all, key=lambda other: other.score - _penalty(other.pose, guess, other is not first))
        return best, any(_is_rival(other, best) for other in found_all)

    def _other_starts(self, scan: Outline, guess: FloatArray, gate: float) -> list[tuple[FloatArray, float]]:
        """Poses where the laser may be as well, with the gates to begin with.

        By the turn that the normals tell, where it was, or straight ahead of there.
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

    def _lose(self, scan: Outline, guess: FloatArray, spread: FloatArray) -> Match:
        """The guess, for a scan that does not fit the map; after several of them a new map begins there.

        Where there is no map at all, one begins with the first scan that has enough to see.
        """
        self._lost += 1
        covariances = self._uncertainty.update(self.pose, guess, spread, np.zeros((3, 3)))
        self.pose = guess
        begins = (self._lost > MOST_LOST or self.is_empty) and len(scan.points) >= FEWEST_POINTS
        if begins:
            self.begin(scan)
        return Match(guess, *covariances, np.eye(3), fits=False, begins_map=begins)

    def _is_key(self, pose: FloatArray, share: float) -> bool:
        """Whether a scan adds something to the map."""
        step = relative_step(self._key_pose, pose)
        away = max(math.hypot(step[0], step[1]) / KEY_DISTANCE, abs(float(step[2])) / KEY_TURN)
        return away > 1 or (away > KEY_LEAST and share < KEY_SHARE)

    def _add(self, scan: Outline) -> None:
        """Adds a scan at the present pose to the map, which forgets what is too far back."""
        step = relative_step(self._key_pose, self.pose)
        self._travelled += math.hypot(step[0], step[1])
        self._map.add(scan.points, scan.normals, self.pose, self._travelled)
        self._since = max(self._since, self._travelled - max(SHORTEST_MAP, MAP_LENGTH * scan.reach))
        self._added += 1
        if self._added % FORGET_EVERY == 0:
            self._map.forget(self._since)
        self._key_pose, self._key_normals = self.pose, scan.normals
        self._table = build_table(self._map.present(), self._since, self.pose[:2], TABLE_FARTHEST)


def _thin(scan: Outline) -> tuple[FloatArray, FloatArray]:
    """Points and normals (K, 2) of a scan, evenly chosen."""
    if len(scan.points) <= MOST_POINTS:
        return scan.points, scan.normals
    chosen = np.arange(MOST_POINTS) * len(scan.points) // MOST_POINTS
    return scan.points[chosen], scan.normals[chosen]


def _penalty(pose: FloatArray, guess: FloatArray, is_other: bool) -> float:
    """Of a score, for what was reached from another start than the guess, or is far from it."""
    away = math.hypot(pose[0] - guess[0], pose[1] - guess[1])
    start = START_PENALTY if is_other else 0.0
    return start + AWAY_PENALTY * min(away, 3.0) + TURN_PENALTY * abs(_wrap(pose[2] - guess[2]))


def _is_rival(other: Aligned, best: Aligned) -> bool:
    """Whether another place fits a scan nearly as well as the best one."""
    step = relative_step(best.pose, other.pose)
    is_elsewhere = math.hypot(step[0], step[1]) > ELSEWHERE or abs(float(step[2])) > ELSEWHERE_TURN
    return is_elsewhere and other.score > NEARLY * best.score


def _stiffness(pull: FloatArray, points: int) -> FloatArray:
    """The pull (3, 3) of a measured guess, beside a mean square of 1 of a full scan's residuals' change."""
    return WEAK_PRIOR + np.linalg.inv(pull) * POINT_ERROR**2 * CORRELATED / points


def _wrap(angle: float) -> float:
    """An angle in radians, brought into [-pi, pi)."""
    return (float(angle) + math.pi) % (2 * math.pi) - math.pi
