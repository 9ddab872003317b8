"""What happens along a run, gathered in constant memory: time, speed, deviations, and marked stretches."""

import math
from collections import deque
from dataclasses import dataclass
from itertools import pairwise
from typing import Any, NamedTuple

import numpy as np

from rcnn_odom.deployment.odometer import Pose
from rcnn_odom.geometry import FloatArray
from rcnn_odom.recordings.clock import CLOCK_JUMP, LATE_IN_A_ROW

MOMENTS = 2400
"""Points of a curve that are kept, about two for each dot of a picture."""
WINDOW = 1.0
"""Seconds over which speed and turn rate are measured: of single steps they are mostly noise."""
MOST_STRETCHES = 24
"""Of each cause that are kept; of more, neighbours become one."""
LEAST_APART = 10
"""Scans between two stretches of one cause; closer ones are one stretch."""


def causes_in(degraded: str) -> list[str]:
    """The kinds of trouble that the words of a pose name: what stands before a colon.

    >>> causes_in("poor match: much of it does not fit; held: nothing determines the heading")
    ['poor match', 'held']
    """
    return [note.split(":")[0] for note in degraded.split("; ") if ":" in note]


class RecordingTime:
    """Seconds since the first scan, which a clock that is set or goes back does not disturb.

    Attributes:
        seconds: of the recording until now; it stands still over stamps that go back, and over jumps that
            count as a clock that was set. None: no scan had a stamp yet.
    """

    def __init__(self) -> None:
        self.seconds: float | None = None
        self._latest, self._late = 0.0, 0

    def add(self, stamp: float | None) -> None:
        """The stamp of one more scan, in seconds; None where it has none."""
        if stamp is None or not math.isfinite(stamp):
            return
        passed = stamp - self._latest
        if self.seconds is None or abs(passed) > CLOCK_JUMP:
            self.seconds, self._latest = self.seconds or 0.0, stamp
        elif passed > 0:
            self.seconds, self._latest, self._late = self.seconds + passed, stamp, 0
        else:
            self._late += 1
            if self._late == LATE_IN_A_ROW:  # the clock was set back, by little
                self._latest, self._late = stamp, 0


class RecentMotion:
    """Speed and turn rate over the last second.

    Attributes:
        speed: metres per second; nan where less than half a second, or no time, is known.
        turn_rate: radians per second, counter-clockwise; nan likewise.
    """

    def __init__(self) -> None:
        self.speed = self.turn_rate = math.nan
        self._places: deque[tuple[float, float, float, float]] = deque(maxlen=1000)

    def add(self, seconds: float | None, pose: Pose) -> None:
        """One more pose, at this time of the recording."""
        if seconds is None:
            return
        places = self._places
        places.append((seconds, pose.x, pose.y, pose.heading))
        while len(places) > 2 and seconds - places[1][0] >= WINDOW:
            places.popleft()
        start, x, y, heading = places[0]
        passed = seconds - start
        if passed < WINDOW / 2:
            self.speed = self.turn_rate = math.nan
            return
        self.speed = math.hypot(pose.x - x, pose.y - y) / passed
        self.turn_rate = (pose.heading - heading) / passed


class Moment(NamedTuple):
    """What the curves show of one scan.

    Attributes:
        scan: its number, from 1.
        seconds: of the recording; nan without a clock.
        speed, turn_rate: metres and radians per second over the last second.
        x, y, heading: standard deviations of its step in metres and radians, x ahead and y to the left in
            the frame of the scan before; nan where unknown, and where there is no step.
        pose_x, pose_y, pose_heading: those of its pose, in the frame of the first.
    """

    scan: float
    seconds: float
    speed: float
    turn_rate: float
    x: float
    y: float
    heading: float
    pose_x: float
    pose_y: float
    pose_heading: float


PEAKS = [Moment._fields.index(name) for name in ("speed", "x", "y", "heading")]
TURN_RATE = Moment._fields.index("turn_rate")


class Curves:
    """Moments of a stream without end: each, then one for two, for four ... scans, never more than fit.

    Of scans that share a moment the largest speed, turn rate and deviation of a step stay, so that no peak
    is lost; everything else is that of the last one.

    Args:
        capacity: most moments that are kept; even.
    """

    def __init__(self, capacity: int = MOMENTS) -> None:
        self._rows = np.full((capacity, len(Moment._fields)), np.nan)
        self._every, self._seen = 1, 0

    def add(self, moment: Moment) -> None:
        """One more scan."""
        place, shared = divmod(self._seen, self._every)
        if place == len(self._rows):
            place //= 2
            self._rows[:place] = _join(self._rows[::2], self._rows[1::2])
            self._every *= 2
        row = np.array(moment)
        self._rows[place] = _join(self._rows[place], row) if shared else row
        self._seen += 1

    def column(self, name: str) -> FloatArray:
        """One field of all moments, (M,)."""
        filled = -(-self._seen // self._every)
        return self._rows[:filled, Moment._fields.index(name)]


def _join(earlier: FloatArray, later: FloatArray) -> FloatArray:
    """One moment (..., F) in place of two."""
    joined = later.copy()
    joined[..., PEAKS] = np.fmax(earlier[..., PEAKS], later[..., PEAKS])
    turns = earlier[..., TURN_RATE], later[..., TURN_RATE]
    is_earlier = ~(np.abs(turns[1]) >= np.abs(turns[0])) & ~np.isnan(turns[0])
    joined[..., TURN_RATE] = np.where(is_earlier, *turns)
    return joined


@dataclass
class Stretch:
    """Scans near each other that suffer from the same cause.

    Attributes:
        first, last: numbers of scans, from 1: lines of ``steps.jsonl``.
        start, end: their seconds of the recording; None without a clock.
        scans: so many of them are marked.
    """

    first: int
    last: int
    start: float | None
    end: float | None
    scans: int = 1

    def absorb(self, later: "Stretch") -> None:
        """Reaches to the end of a later one."""
        self.last, self.end, self.scans = later.last, later.end, self.scans + later.scans


class Marks:
    """The stretches of a run that are marked, by their cause, in constant memory.

    Attributes:
        stretches: of each cause, in order.
        words: the first note of each cause.
    """

    def __init__(self) -> None:
        self.stretches: dict[str, list[Stretch]] = {}
        self.words: dict[str, str] = {}
        self._apart: dict[str, int] = {}

    def add(self, scan: int, seconds: float | None, degraded: str) -> None:
        """One more scan, its number from 1, and what it suffers from in the words of its pose."""
        for cause in dict.fromkeys(causes_in(degraded)):
            kept = self.stretches.setdefault(cause, [])
            self.words.setdefault(cause, degraded)
            apart = self._apart.setdefault(cause, LEAST_APART)
            kept.append(Stretch(scan, scan, seconds, seconds))
            if len(kept) > 1 and scan - kept[-2].last <= apart:
                kept[-2].absorb(kept.pop())
            while len(kept) > MOST_STRETCHES:
                self._apart[cause] *= 2
                kept[:] = _join_near(kept, self._apart[cause])

    def counts(self) -> dict[str, int]:
        """Marked scans by cause, the most frequent first."""
        counts = {cause: sum(one.scans for one in kept) for cause, kept in self.stretches.items()}
        return dict(sorted(counts.items(), key=lambda item: -item[1]))

    def as_dict(self) -> dict[str, list[dict[str, Any]]]:
        """The stretches by cause, the most frequent first, ready for JSON."""
        names = {
            "from_s": "start",
            "to_s": "end",
            "first_scan": "first",
            "last_scan": "last",
            "scans": "scans",
        }
        return {
            cause: [
                {name: getattr(one, field) for name, field in names.items()} for one in self.stretches[cause]
            ]
            for cause in self.counts()
        }


def _join_near(stretches: list[Stretch], apart: int) -> list[Stretch]:
    """The same stretches, those at most so many scans apart as one."""
    joined = stretches[:1]
    for _, later in pairwise(stretches):
        if later.first - joined[-1].last <= apart:
            joined[-1].absorb(later)
        else:
            joined.append(later)
    return joined


class Timeline:
    """A run from its first pose to its last.

    Attributes:
        curves, marks: see there.
        end: the last pose.
        top_speed: metres per second over a second; 0 where no speed is known.
        scans: so many poses there were.
    """

    def __init__(self) -> None:
        self.curves, self.marks, self.end = Curves(), Marks(), Pose()
        self.top_speed, self.scans = 0.0, 0
        self._time, self._motion = RecordingTime(), RecentMotion()

    @property
    def seconds(self) -> float | None:
        """Of the recording until now; None without a clock."""
        return self._time.seconds

    def add(self, pose: Pose) -> None:
        """One more pose, with the stamp of its scan."""
        self.scans, self.end = self.scans + 1, pose
        self._time.add(pose.stamp)
        self._motion.add(self.seconds, pose)
        speed, turn_rate = self._motion.speed, self._motion.turn_rate
        self.top_speed = max(self.top_speed, 0.0 if math.isnan(speed) else speed)
        seconds = math.nan if self.seconds is None else self.seconds
        deviations = _deviations(pose.step.covariance)
        deviations[deviations == 0] = np.nan  # no step: the first scan, or one that was passed over
        pose_deviations = _deviations(pose.covariance)
        self.curves.add(
            Moment(self.scans, seconds, speed, turn_rate, *deviations.tolist(), *pose_deviations.tolist())
        )
        self.marks.add(self.scans, self.seconds, pose.degraded)


def _deviations(covariance: FloatArray) -> FloatArray:
    """Standard deviations (3,) of a covariance (3, 3)."""
    return np.sqrt(np.maximum(np.diag(covariance), 0.0))
