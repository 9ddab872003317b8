"""Odometry by scan matching, for any 2D laser, without training."""

import math
from collections import deque
from dataclasses import dataclass
from functools import cache
from typing import ClassVar

import numpy as np

from rcnn_odom.geometry import FloatArray, Step, Steps, advance, relative_step, turn_to_middle
from rcnn_odom.matching.deskew import deskew
from rcnn_odom.matching.local_map import LocalMap
from rcnn_odom.matching.no_return import NoReturn
from rcnn_odom.matching.outline import Outline, outline
from rcnn_odom.matching.points import find_points
from rcnn_odom.matching.registration import FEWEST_POINTS, Match, Registration
from rcnn_odom.models.contract import Model
from rcnn_odom.models.streaming import Registered
from rcnn_odom.models.tracking import estimate_by_tracking
from rcnn_odom.recordings.recording import Drive, wants_deskew
from rcnn_odom.recordings.scan import Scan

FARTHEST = 120.0
"""Metres from which on a reading is no return."""
LONGEST_HOLD = 10.0
"""Periods over which the last motion goes on; for longer it is not known to."""
GUESS_DISTANCE, GUESS_TURN = 0.1, 0.1
"""Metres and radians a period by which the last motion is off as a guess, and beside them half of itself."""
WHEELS_DISTANCE, WHEELS_TURN = 0.01, 0.01
"""The same of wheel odometry."""
SLIP = 0.1
"""Part of a motion by which wheel odometry is off beside that."""


@dataclass(frozen=True)
class MatcherOptions:
    """What ``conf/model/matcher.yaml`` sets.

    Attributes:
        wheels: the robot's own odometry, where a scan has it, is the guess of a match and pulls it.
    """

    wheels: bool = False


@cache
def compile_matching() -> None:
    """Compiles what a scan needs, or loads it from the cache, so that the first scan does not wait for it."""
    bearings = np.linspace(-np.pi, np.pi, 90)
    room = np.minimum(
        3 / np.maximum(np.abs(np.cos(bearings)), 0.1), 2 / np.maximum(np.abs(np.sin(bearings)), 0.1)
    )
    no_return, registration = NoReturn(), Registration()
    for scale in (1.0, 1.0, 3.0):  # the last does not fit, so that other starts are tried as well
        moved, turned = deskew(scale * room, bearings, np.zeros(90), np.ones(3))
        found = outline(find_points(moved, turned, no_return.limit(moved, FARTHEST)))
        if registration.is_empty:
            registration.begin(found)
        registration.register(found, np.zeros(3), np.eye(3))
    few = outline(find_points(np.full(6, 5.0), np.arange(6.0), FARTHEST))
    registration.register(few, np.zeros(3), np.eye(3))
    LocalMap(0.1, 1.0).forget(0.0)


class MatcherTracker:
    """Registers each scan against a map of what the laser has seen lately.

    Notes are of these kinds:

    - *no returns*, or fewer than six points on anything (*few returns*): the last motion goes on.
    - *no match*: the scan does not fit the map; the last motion goes on. After several in a row a new map
      begins (*new map*).
    - *held*: what is seen does not determine the motion along a direction; along it the last motion goes on.
    - *poor match*: much of the scan does not fit the map; the estimate stands.
    - *sudden motion*: half a metre or 20 degrees from where the last motion led; the estimate stands.
    - *ambiguous*: the scan fits the map in two places; the better one is taken.

    Args:
        wheels: as in :class:`MatcherOptions`.
        deskew: scans whose beams have times are undistorted by the current motion.
    """

    period = math.nan

    def __init__(self, wheels: bool = False, deskew: bool = True) -> None:
        self.wheels, self.deskew = wheels, deskew
        compile_matching()
        self.reset()

    def reset(self) -> None:
        """Forgets everything."""
        self._registration, self._no_return = Registration(), NoReturn()
        self._motion, self._seconds, self._held = np.zeros(3), math.nan, 0.0
        self._velocities: deque[FloatArray] = deque(maxlen=2)
        self._held_in_a_row, self._held_directions = 0, np.empty((3, 0))
        self._wheel_pose: tuple[float, float, float] | None = None
        self._returns = np.empty((0, 2))

    @property
    def has_seen(self) -> bool:
        """Whether there is a map that the next scan can be compared with."""
        return not self._registration.is_empty

    def returns(self) -> FloatArray:
        """Points (P, 2) in metres of the last scan in the laser's frame."""
        return self._returns

    def begin(self, scan: Scan) -> tuple[str, ...]:
        """Begins a new map with a scan."""
        found = self._find_outline(scan)
        self._registration.begin(found)
        self._motion, self._held, self._held_in_a_row = np.zeros(3), 0.0, 0
        self._velocities.clear()
        self._wheel_pose = scan.wheel_pose
        return () if self.has_seen else (f"{_describe(found)}: none to compare with yet",)

    def register(self, scan: Scan, periods: int = 1, seconds: float | None = None) -> Registered:
        """The step to one more scan."""
        passed = self._motions_passed(periods, seconds)
        scan_outline = self._find_outline(scan)
        guess, spread, is_measured = self._guess(scan, passed)
        before = self._registration.pose
        spread = self._in_map(spread, float(before[2]), is_measured)
        match = self._registration.register(scan_outline, advance(before, guess), spread, is_measured)
        step = relative_step(before, match.pose)
        x, y, heading = step.tolist()
        self._wheel_pose = scan.wheel_pose
        if match.fits:
            self._motion, self._held = step / periods, 0.0
            self._seconds = seconds / periods if seconds else math.nan
            if seconds:
                in_own_frame = turn_to_middle(Step(x, y, heading)).array()
                self._velocities.append(in_own_frame / seconds)
        else:
            self._held += passed
        self._held_in_a_row = self._held_in_a_row + 1 if match.held.shape[1] else 0
        self._held_directions = match.held
        notes = _describe_match(match, scan_outline)
        return Registered(Step(x, y, heading, match.step, match.noise), notes, match.fits)

    def _motions_passed(self, periods: int, seconds: float | None) -> float:
        """How often the last motion fits into the time since the last scan."""
        return seconds / self._seconds if seconds and self._seconds > 0 else float(periods)

    def _guess(self, scan: Scan, passed: float) -> tuple[FloatArray, FloatArray, bool]:
        """The step (3,) that is expected, its covariance (3, 3), and whether it was measured.

        Args:
            scan: the next one.
            passed: how often the last motion fits into the time since the last scan.
        """
        longer = 0.0
        if self.wheels and scan.wheel_pose is not None and self._wheel_pose is not None:
            guess = relative_step(np.array(self._wheel_pose), np.array(scan.wheel_pose))
            least, part = (WHEELS_DISTANCE, WHEELS_TURN), SLIP
            is_measured = True
        else:
            share = max(0.0, min(passed, LONGEST_HOLD - self._held))
            guess, whole = (share % 1.0) * self._motion, int(share)
            for _ in range(whole):
                guess = advance(self._motion, guess)
            least, part, is_measured = (GUESS_DISTANCE * passed, GUESS_TURN * passed), 0.5, False
            longer = passed - share  # whether it goes on for longer than that is not known
        x, y, heading = guess.tolist()
        distance, turn = least[0] + part * math.hypot(x, y), least[1] + part * abs(heading)
        if longer:
            x, y, heading = self._motion.tolist()
            distance, turn = distance + longer * math.hypot(x, y), turn + longer * abs(heading)
        return guess, np.diag([distance**2, distance**2, turn**2]), is_measured

    def _in_map(self, spread: FloatArray, heading: float, is_measured: bool) -> FloatArray:
        """The covariance (3, 3) of a guess, of the laser's frame, in the map's.

        Along what was held before, a motion that goes on errs alike every time: the error of n steps is n
        times that of one, its variance n times n, to which the last step adds 2 n - 1.
        """
        cos, sin = math.cos(heading), math.sin(heading)
        turned = np.array([[cos, -sin, 0.0], [sin, cos, 0.0], [0.0, 0.0, 1.0]])
        spread = turned @ spread @ turned.T
        if self._held_in_a_row and not is_measured:
            held = self._held_directions
            along = np.einsum("ik,ij,jk->k", held, spread, held)
            spread = spread + (2.0 * self._held_in_a_row) * (held * along) @ held.T
        return spread

    def _find_outline(self, scan: Scan) -> Outline:
        """Points and lines of a scan, undistorted if wanted."""
        ranges = np.ascontiguousarray(scan.ranges, dtype=np.float64)
        bearings = scan.bearings
        if bearings is None:
            bearings = np.linspace(-np.pi, np.pi, len(ranges), endpoint=False)
        bearings = np.ascontiguousarray(bearings, dtype=np.float64)
        limit = self._no_return.limit(ranges, FARTHEST)
        if self.deskew and scan.times is not None and self._velocities:
            times = np.ascontiguousarray(scan.times, dtype=np.float64)
            ranges = np.where(ranges < limit, ranges, np.inf)
            # The mean of the last two: an error of the last step alone would come back in the next one
            # with the opposite sign, and never end.
            velocity = np.mean(self._velocities, axis=0)
            ranges, bearings = deskew(ranges, bearings, times, velocity)
            limit = FARTHEST
        found = outline(find_points(ranges, bearings, limit))
        self._returns = found.returns
        return found


def _describe(scan: Outline) -> str:
    """What there is to see in a scan that cannot be registered."""
    if len(scan.returns) == 0:
        return "no returns"
    return f"few returns: {len(scan.returns)}, {len(scan.points)} points of them of use"


def _describe_match(match: Match, scan: Outline) -> tuple[str, ...]:
    """Notes on a match, in words."""
    if match.fits:
        notes = []
        if match.is_poor:
            notes.append("poor match: much of the scan does not fit what was seen before")
        if match.is_ambiguous:
            notes.append("ambiguous: the scan fits the map in two places, the better one is taken")
        if any(match.surprise):
            notes.append(_describe_surprise(*match.surprise))
        if match.held.shape[1]:
            notes.append(f"held: nothing seen determines {_name_directions(match)}, the last motion goes on")
        return tuple(notes)
    if len(scan.points) < FEWEST_POINTS:
        return (f"{_describe(scan)}, the last motion goes on",)
    lost = "no match: the scan does not fit what was seen before, the last motion goes on"
    return (lost, "new map: it begins here") if match.begins_map else (lost,)


def _describe_surprise(distance: float, turn: float) -> str:
    return f"sudden motion: {distance:.2f} m and {math.degrees(turn):.0f} degrees from where the last one led"


def _name_directions(match: Match) -> str:
    """The directions that are not determined, as seen from the laser."""
    names = []
    for x, y, heading in match.held.T:
        if abs(heading) > max(abs(x), abs(y)):
            names.append("the heading")
        else:
            angle = math.degrees(math.atan2(y, x) - match.pose[2])
            names.append(f"the motion at {(angle + 90) % 180 - 90:.0f} degrees")
    return " and ".join(names)


class Matcher(Model):
    """Odometry by scan matching, for any 2D laser, without training."""

    name = "matcher"
    Options = MatcherOptions
    uses_depth_vectors: ClassVar[bool] = False

    def tracker(self) -> MatcherTracker:
        """The same in a stream."""
        return MatcherTracker(deskew=self.deskew != "off", **self.options)

    def estimate(self, drive: Drive) -> Steps:
        """The steps of one whole drive, those that ``rcnn-odom run`` gives."""
        deskew = wants_deskew(self.deskew, drive.is_compensated)
        return estimate_by_tracking(MatcherTracker(deskew=deskew, **self.options), drive.raw_scans())
