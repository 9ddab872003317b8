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
from rcnn_odom.models.prior import LastMotion, Prior, PriorSource, Wheels, believed
from rcnn_odom.models.streaming import Registered
from rcnn_odom.models.tracking import estimate_by_tracking
from rcnn_odom.recordings.recording import Drive, wants_deskew
from rcnn_odom.recordings.scan import Scan

FARTHEST = 120.0
"""Metres from which on a reading is no return."""
LONGEST_HOLD = 10.0
"""Periods over which the last motion goes on; for longer it is not known to."""
GUESS_DISTANCE, GUESS_TURN, GUESS_PART = 0.1, 0.1, 0.5
"""Metres and radians a period by which the last motion is off as a guess, beside a part of itself."""


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

    Where the last motion goes on, another source of priors may have a better step, and the note says so.
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
        source: of what is known of a step before its scan is matched; None: the wheels or the last motion.
    """

    period = math.nan

    def __init__(self, wheels: bool = False, deskew: bool = True, source: PriorSource | None = None) -> None:
        self.wheels, self.deskew = wheels, deskew
        self._source = source or (Wheels() if wheels else LastMotion())
        compile_matching()
        self.reset()

    def reset(self) -> None:
        """Forgets everything."""
        self._registration, self._no_return = Registration(), NoReturn()
        self._motion, self._seconds, self._held = np.zeros(3), math.nan, 0.0
        self._velocities: deque[FloatArray] = deque(maxlen=2)
        self._held_in_a_row, self._held_directions = 0, np.empty((3, 0))
        self._source.reset()
        self._returns = np.empty((0, 2))

    @property
    def has_seen(self) -> bool:
        """Whether there is something that the next scan can be compared with."""
        return not self._registration.is_empty or self._source.has_seen

    def returns(self) -> FloatArray:
        """Points (P, 2) in metres of the last scan in the laser's frame."""
        return self._returns

    def begin(self, scan: Scan) -> tuple[str, ...]:
        """Begins a new map with a scan."""
        found = self._find_outline(scan)
        self._registration.begin(found)
        self._motion, self._held, self._held_in_a_row = np.zeros(3), 0.0, 0
        self._velocities.clear()
        notes = self._source.begin(scan)
        return notes if self.has_seen else (f"{_describe(found)}: none to compare with yet", *notes)

    def register(self, scan: Scan, periods: int = 1, seconds: float | None = None) -> Registered:
        """The step to one more scan."""
        passed = self._motions_passed(periods, seconds)
        scan_outline = self._find_outline(scan)
        prior, of_prior = self._source.expect(scan, periods, seconds, self._hold(passed))
        before = self._registration.pose
        turned = _turned(float(before[2]))
        match = self._registration.register(
            scan_outline,
            advance(before, prior.step),
            turned @ prior.covariance @ turned.T,
            None if prior.pull is None else turned @ prior.pull @ turned.T,
        )
        step = relative_step(before, match.pose)
        self._source.compare(step, match.fits and not (match.held.shape[1] or match.is_ambiguous))
        x, y, heading = step.tolist()
        is_estimated = match.fits or prior.comes_from_scan
        if is_estimated:
            self._motion, self._held = step / periods, 0.0
            self._seconds = seconds / periods if seconds else math.nan
            if seconds:
                in_own_frame = turn_to_middle(Step(x, y, heading)).array()
                self._velocities.append(in_own_frame / seconds)
        else:
            self._held += passed
        self._held_in_a_row = self._held_in_a_row + 1 if match.held.shape[1] else 0
        self._held_directions = match.held
        notes = (*_describe_match(match, scan_outline, prior.stands), *of_prior)
        return Registered(Step(x, y, heading, match.step, match.noise), notes, is_estimated)

    def _motions_passed(self, periods: int, seconds: float | None) -> float:
        """How often the last motion fits into the time since the last scan."""
        return seconds / self._seconds if seconds and self._seconds > 0 else float(periods)

    def _hold(self, passed: float) -> Prior:
        """The last motion, for as often as it fits into the time since the last scan."""
        share = max(0.0, min(passed, LONGEST_HOLD - self._held))
        guess, whole = (share % 1.0) * self._motion, int(share)
        for _ in range(whole):
            guess = advance(self._motion, guess)
        distance, turn = GUESS_DISTANCE * passed, GUESS_TURN * passed
        if longer := passed - share:  # whether it goes on for longer than that is not known
            x, y, heading = self._motion.tolist()
            distance, turn = distance + longer * math.hypot(x, y), turn + longer * abs(heading)
        return Prior(guess, self._grow(believed(guess, distance, turn, GUESS_PART)))

    def _grow(self, spread: FloatArray) -> FloatArray:
        """The covariance (3, 3) of the last motion, after some steps along directions that were held.

        A motion that goes on errs alike every time there: the error of n steps is n times that of one, its
        variance n times n, to which the last step adds 2 n - 1.
        """
        if not self._held_in_a_row:
            return spread
        turned = _turned(-float(self._registration.pose[2]))
        held = turned @ self._held_directions
        along = np.einsum("ik,ij,jk->k", held, spread, held)
        return spread + (2.0 * self._held_in_a_row) * (held * along) @ held.T

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


def _turned(heading: float) -> FloatArray:
    """The matrix (3, 3) that turns x and y by a heading in radians."""
    cos, sin = math.cos(heading), math.sin(heading)
    return np.array([[cos, -sin, 0.0], [sin, cos, 0.0], [0.0, 0.0, 1.0]])


def _describe(scan: Outline) -> str:
    """What there is to see in a scan that cannot be registered."""
    if len(scan.returns) == 0:
        return "no returns"
    return f"few returns: {len(scan.returns)}, {len(scan.points)} points of them of use"


def _describe_match(match: Match, scan: Outline, stands: str) -> tuple[str, ...]:
    """Notes on a match, and on what stands where there is none, in words."""
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
        return (f"{_describe(scan)}, {stands}",)
    lost = f"no match: the scan does not fit what was seen before, {stands}"
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
