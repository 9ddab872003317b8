"""Odometry by scan matching, for any 2D laser, without training."""

import math
from collections import deque
from dataclasses import dataclass
from functools import cache
from typing import ClassVar

import numpy as np

from rcnn_odom.geometry import (
    FloatArray,
    Step,
    Steps,
    advance,
    planar_to_poses,
    relative_step,
    rotation_matrix,
    turn_to_middle,
)
from rcnn_odom.matching.deskew import deskew
from rcnn_odom.matching.local_map import LocalMap
from rcnn_odom.matching.no_return import NoReturn
from rcnn_odom.matching.outline import Outline, outline
from rcnn_odom.matching.points import find_points
from rcnn_odom.matching.registration import FEWEST_POINTS, Match, Registration
from rcnn_odom.models.contract import Model
from rcnn_odom.models.prior import LastMotion, Prior, PriorSource, Wheels, guess_covariance
from rcnn_odom.models.streaming import Registered
from rcnn_odom.models.tracking import estimate_by_tracking
from rcnn_odom.recordings.recording import Drive, wants_deskew
from rcnn_odom.recordings.scan import Scan

FARTHEST = 120.0
"""Metres; a range of at least that is no return."""
LONGEST_HOLD = 10.0
"""Periods for which the last motion is assumed to continue; after that the pose stands still."""
GUESS_DISTANCE, GUESS_TURN, GUESS_PART = 0.1, 0.1, 0.5
"""Deviation of the last motion as a guess: metres and radians per period, and a fraction of the motion."""


@dataclass(frozen=True)
class MatcherOptions:
    """The options of ``conf/model/matcher.yaml``.

    Attributes:
        wheels: use the robot's own odometry, for scans that have it, as a measured guess of each match.

    Example:
        >>> MatcherOptions()
        MatcherOptions(wheels=False)
    """

    wheels: bool = False


@cache
def compile_matching() -> None:
    """Compiles the code for a scan, or loads it from numba's cache, so that the first scan is not delayed.

    :class:`MatcherTracker` calls it, and only the first call in a process does something.

    Example:
        >>> compile_matching()
    """
    bearings = np.linspace(-np.pi, np.pi, 90)
    room = np.minimum(
        3 / np.maximum(np.abs(np.cos(bearings)), 0.1), 2 / np.maximum(np.abs(np.sin(bearings)), 0.1)
    )
    no_return, registration = NoReturn(), Registration()
    for scale in (1.0, 1.0, 3.0):  # the last scan does not fit, so that other starts are tried as well
        moved, turned = deskew(scale * room, bearings, np.zeros(90), np.ones(3))
        found = outline(find_points(moved, turned, no_return.limit(moved, FARTHEST)))
        if registration.is_empty:
            registration.begin(found)
        registration.register(found, np.zeros(3), np.eye(3))
    few = outline(find_points(np.full(6, 5.0), np.arange(6.0), FARTHEST))
    registration.register(few, np.zeros(3), np.eye(3))
    LocalMap(0.1, 1.0).forget(0.0)


class MatcherTracker:
    """Registers each scan against a local map of what the laser has seen recently.

    Where the last motion goes on, another source of priors may give a better step, which the note then names.
    Notes are of these kinds:

    - *no returns*, or fewer than six points on lines or objects (*few returns*): the last motion goes on.
    - *no match*: the scan does not fit the map; the last motion goes on. After several in a row a new map
      begins (*new map*).
    - *held*: the scan does not determine the motion along a direction; along it the last motion goes on.
    - *poor match*: much of the scan does not fit the map; the estimate is used.
    - *sudden motion*: half a metre or 20 degrees from the last motion; the estimate is used.
    - *ambiguous*: the scan fits the map in two places; the better one is used.

    Args:
        wheels: as in :class:`MatcherOptions`.
        deskew: remove the motion during a scan if its beams have times.
        source: source of the prior of each step; None: the wheels or the last motion.

    Example:
        A square room of 8 m, seen from its centre and then from 1 m ahead:

        >>> bearings = np.deg2rad(np.arange(0.5, 360.0))
        >>> cos, sin = np.cos(bearings), np.abs(np.sin(bearings))
        >>> room = [np.minimum((4 - x * np.sign(cos)) / np.abs(cos), 4 / sin) for x in (0.0, 1.0)]
        >>> tracker = MatcherTracker()
        >>> tracker.begin(Scan(room[0], bearings))
        ()
        >>> registered = tracker.register(Scan(room[1], bearings))
        >>> registered.step.array().round(2) + 0.0
        array([1., 0., 0.])
    """

    period = math.nan

    def __init__(self, wheels: bool = False, deskew: bool = True, source: PriorSource | None = None) -> None:
        self.wheels, self.deskew = wheels, deskew
        self._source = source or (Wheels() if wheels else LastMotion())
        compile_matching()
        self.reset()

    def reset(self) -> None:
        """Forgets the map and the motion.

        Example:
            >>> tracker = MatcherTracker()
            >>> notes = tracker.begin(Scan(np.full(360, 2.0), np.deg2rad(np.arange(360.0))))
            >>> before = tracker.has_seen
            >>> tracker.reset()
            >>> before, tracker.has_seen
            (True, False)
        """
        self._registration, self._no_return = Registration(), NoReturn()
        self._motion, self._seconds, self._motions_held = np.zeros(3), math.nan, 0.0
        self._velocities: deque[FloatArray] = deque(maxlen=2)
        self._held_in_a_row, self._held_directions = 0, np.empty((3, 0))
        self._source.reset()
        self._returns = np.empty((0, 2))

    @property
    def has_seen(self) -> bool:
        """Whether there is a map, or another source, with which the next scan can be compared."""
        return not self._registration.is_empty or self._source.has_seen

    def map_points(self) -> FloatArray:
        """The local map, points (C, 2) in metres, in the frame of the last scan.

        Example:
            >>> tracker = MatcherTracker()
            >>> notes = tracker.begin(Scan(np.full(21, 2.0), np.deg2rad(np.arange(-10.0, 11.0))))
            >>> np.hypot(*tracker.map_points().T).round(1).tolist()[:2]
            [2.0, 2.0]
        """
        pose = planar_to_poses(self._registration.pose[None])[0]
        points: FloatArray = (self._registration.map_points() - pose[:2, 3]) @ pose[:2, :2]
        return points

    def returns(self) -> FloatArray:
        """Points (P, 2) in metres of the last scan in the laser's frame.

        Example:
            >>> tracker = MatcherTracker()
            >>> notes = tracker.begin(Scan(np.array([1.0, 2.0, np.inf]), np.deg2rad([0.0, 90.0, 180.0])))
            >>> tracker.returns().round(3) + 0.0
            array([[1., 0.],
                   [0., 2.]])
        """
        return self._returns

    def begin(self, scan: Scan) -> tuple[str, ...]:
        """Begins a new map with a scan; returns notes as in :class:`Registered`."""
        found = self._find_outline(scan)
        self._registration.begin(found)
        self._motion, self._motions_held, self._held_in_a_row = np.zeros(3), 0.0, 0
        self._velocities.clear()
        notes = self._source.begin(scan)
        return notes if self.has_seen else (f"{_describe_lack(found)}: none to compare with yet", *notes)

    def register(self, scan: Scan, periods: int = 1, seconds: float | None = None) -> Registered:
        """The step to one more scan.

        Args:
            scan: as the laser gave it.
            periods: usual times between scans since the last one, more than 1 over a gap.
            seconds: since the last scan; None if unknown.
        """
        elapsed = self._motions_elapsed(periods, seconds)
        scan_outline = self._find_outline(scan)
        prior, prior_notes = self._source.expect(scan, periods, seconds, self._continue_motion(elapsed))
        before = self._registration.pose
        rotation = rotation_matrix(float(before[2]))
        match = self._registration.register(
            scan_outline,
            advance(before, prior.step),
            rotation @ prior.covariance @ rotation.T,
            None if prior.pull is None else rotation @ prior.pull @ rotation.T,
        )
        step = relative_step(before, match.pose)
        self._source.compare(step, match.fits and not (match.held.shape[1] or match.is_ambiguous))
        x, y, heading = step.tolist()
        is_estimated = match.fits or prior.comes_from_scan
        if is_estimated:
            self._motion, self._motions_held = step / periods, 0.0
            self._seconds = seconds / periods if seconds else math.nan
            if seconds:
                in_own_frame = turn_to_middle(Step(x, y, heading)).array()
                self._velocities.append(in_own_frame / seconds)
        else:
            self._motions_held += elapsed
        self._held_in_a_row = self._held_in_a_row + 1 if match.held.shape[1] else 0
        self._held_directions = match.held
        notes = (*_describe_match(match, scan_outline, prior.stands), *prior_notes)
        return Registered(Step(x, y, heading, match.step, match.noise), notes, is_estimated)

    def _motions_elapsed(self, periods: int, seconds: float | None) -> float:
        """The time since the last scan divided by the duration of the last motion."""
        return seconds / self._seconds if seconds and self._seconds > 0 else float(periods)

    def _continue_motion(self, elapsed: float) -> Prior:
        """The last motion, repeated ``elapsed`` times, the time since the last scan in such motions."""
        repeats = max(0.0, min(elapsed, LONGEST_HOLD - self._motions_held))
        guess, whole = (repeats % 1.0) * self._motion, int(repeats)
        for _ in range(whole):
            guess = advance(self._motion, guess)
        distance, turn = GUESS_DISTANCE * elapsed, GUESS_TURN * elapsed
        if longer := elapsed - repeats:  # in the rest of the time the motion may have continued or not
            x, y, heading = self._motion.tolist()
            distance, turn = distance + longer * math.hypot(x, y), turn + longer * abs(heading)
        return Prior(guess, self._inflate(guess_covariance(guess, distance, turn, GUESS_PART)))

    def _inflate(self, spread: FloatArray) -> FloatArray:
        """The covariance (3, 3) of the last motion, larger along directions held for several steps.

        The errors of a motion that goes on are equal in every step: the error of n steps is n times that of
        one and its variance n * n times, to which the last step contributes 2 n - 1.
        """
        if not self._held_in_a_row:
            return spread
        held = rotation_matrix(-float(self._registration.pose[2])) @ self._held_directions
        along = np.einsum("ik,ij,jk->k", held, spread, held)
        return spread + (2.0 * self._held_in_a_row) * (held * along) @ held.T

    def _find_outline(self, scan: Scan) -> Outline:
        """The outline of a scan, undistorted if requested."""
        ranges = np.ascontiguousarray(scan.ranges, dtype=np.float64)
        bearings = scan.bearings
        if bearings is None:
            bearings = np.linspace(-np.pi, np.pi, len(ranges), endpoint=False)
        bearings = np.ascontiguousarray(bearings, dtype=np.float64)
        limit = self._no_return.limit(ranges, FARTHEST)
        if self.deskew and scan.times is not None and self._velocities:
            times = np.ascontiguousarray(scan.times, dtype=np.float64)
            ranges = np.where(ranges < limit, ranges, np.inf)
            # The mean of the last two, because an error of the last step alone would alternate in sign from
            # scan to scan without decaying.
            velocity = np.mean(self._velocities, axis=0)
            ranges, bearings = deskew(ranges, bearings, times, velocity)
            limit = FARTHEST
        found = outline(find_points(ranges, bearings, limit))
        self._returns = found.returns
        return found


def _describe_lack(scan: Outline) -> str:
    """The note on a scan that has too few points."""
    if len(scan.returns) == 0:
        return "no returns"
    return f"few returns: {len(scan.returns)}, {len(scan.points)} points of them of use"


def _describe_match(match: Match, scan: Outline, stands: str) -> tuple[str, ...]:
    """Notes on a match; ``stands`` says what is used where there is none."""
    if match.fits:
        notes = []
        if match.is_poor:
            notes.append("poor match: much of the scan does not fit what was seen before")
        if match.is_ambiguous:
            notes.append("ambiguous: the scan fits the map in two places, the better one is taken")
        if any(match.surprise):
            notes.append(_describe_surprise(*match.surprise))
        if match.held.shape[1]:
            notes.append(f"held: nothing seen determines {_name_directions(match)}, {stands}")
        return tuple(notes)
    if len(scan.points) < FEWEST_POINTS:
        return (f"{_describe_lack(scan)}, {stands}",)
    lost = f"no match: the scan does not fit what was seen before, {stands}"
    return (lost, "new map: it begins here") if match.begins_map else (lost,)


def _describe_surprise(distance: float, turn: float) -> str:
    """The note on a motion so many metres and radians from the last one."""
    return f"sudden motion: {distance:.2f} m and {math.degrees(turn):.0f} degrees from where the last one led"


def _name_directions(match: Match) -> str:
    """The undetermined directions in words, relative to the heading of the laser."""
    names = []
    for x, y, heading in match.held.T:
        if abs(heading) > max(abs(x), abs(y)):
            names.append("the heading")
        else:
            angle = math.degrees(math.atan2(y, x) - match.pose[2])
            names.append(f"the motion at {(angle + 90) % 180 - 90:.0f} degrees")
    return " and ".join(names)


class Matcher(Model):
    """Odometry by scan matching, for any 2D laser, without training.

    Example:
        >>> from rcnn_odom.models.encoding import Sensor
        >>> Matcher({"wheels": True}, Sensor()).tracker().wheels
        True
    """

    name = "matcher"
    Options = MatcherOptions
    uses_depth_vectors: ClassVar[bool] = False

    def tracker(self) -> MatcherTracker:
        """The matcher for a stream of scans, with the same options."""
        return MatcherTracker(deskew=self.deskew != "off", **self.options)

    def estimate(self, drive: Drive) -> Steps:
        """The steps of a whole drive, which equal those of ``rcnn-odom run``.

        Example:
            The laser stands for three scans in a square room of 8 m:

            >>> from rcnn_odom.models.encoding import Sensor
            >>> from rcnn_odom.recordings.recording import Recording
            >>> bearings = np.deg2rad(np.arange(0.5, 360.0))
            >>> scan = Scan(4 / np.maximum(np.abs(np.cos(bearings)), np.abs(np.sin(bearings))), bearings)
            >>> poses, stamps = np.tile(np.eye(4), (3, 1, 1)), np.arange(3.0)
            >>> recording = Recording("room", poses, stamps, read_scan=lambda frame: scan, fingerprint="")
            >>> Matcher({}, Sensor()).estimate(Drive.unencoded(recording)).values.round(2) + 0.0
            array([[0., 0., 0.],
                   [0., 0., 0.]])
        """
        deskew = wants_deskew(self.deskew, drive.is_compensated)
        return estimate_by_tracking(MatcherTracker(deskew=deskew, **self.options), drive.raw_scans())
