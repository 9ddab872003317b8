"""The course of a run, gathered in constant memory: time, speed, deviations and marked stretches."""

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
"""Maximum number of points of a curve, about two for each dot of a picture."""
WINDOW = 1.0
"""Seconds over which speed and turn rate are measured; those of single steps are mostly noise."""
MOST_STRETCHES = 24
"""Maximum number of stretches for each cause; if there are more, neighbours are merged."""
STRETCH_GAP = 10
"""Scans; stretches of one cause that are at most this far apart are one stretch."""


def causes_in(degraded: str) -> list[str]:
    """The causes in the notes of a pose: the text before each colon.

    >>> causes_in("poor match: much of it does not fit; held: nothing determines the heading")
    ['poor match', 'held']
    """
    return [note.split(":")[0] for note in degraded.split("; ") if ":" in note]


class RecordingTime:
    """Seconds since the first scan, in spite of late scans and of clocks that are set.

    Unlike :class:`rcnn_odom.recordings.clock.Clock`, which estimates periods, it never gives a clock up: what
    counts here is the time between two plausible stamps.

    Attributes:
        seconds: duration of the recording so far. A late scan, or a jump that counts as a clock that was set,
            adds nothing. None if no scan had a stamp yet.
    """

    def __init__(self) -> None:
        self.seconds: float | None = None
        self._latest, self._late = 0.0, 0

    def add(self, stamp: float | None) -> None:
        """Adds the stamp of one more scan in seconds; None if it has none."""
        if stamp is None or not math.isfinite(stamp):
            return
        passed = stamp - self._latest
        if self.seconds is None or abs(passed) > CLOCK_JUMP:
            self.seconds, self._latest = self.seconds or 0.0, stamp
        elif passed > 0:
            self.seconds, self._latest, self._late = self.seconds + passed, stamp, 0
        else:
            self._late += 1
            if self._late == LATE_IN_A_ROW:  # the clock was set back by a few seconds
                self._latest, self._late = stamp, 0


class RecentMotion:
    """Speed and turn rate over the last second.

    Attributes:
        speed: metres per second; nan if there is no time, or less than half a second of it.
        turn_rate: radians per second, counter-clockwise; nan likewise.
    """

    def __init__(self) -> None:
        self.speed = self.turn_rate = math.nan
        self._poses: deque[tuple[float, float, float, float]] = deque(maxlen=1000)

    def add(self, seconds: float | None, pose: Pose) -> None:
        """Adds one more pose, at this time of the recording."""
        if seconds is None:
            return
        poses = self._poses
        poses.append((seconds, pose.x, pose.y, pose.heading))
        while len(poses) > 2 and seconds - poses[1][0] >= WINDOW:
            poses.popleft()
        start, x, y, heading = poses[0]
        passed = seconds - start
        if passed < WINDOW / 2:
            self.speed = self.turn_rate = math.nan
            return
        self.speed = math.hypot(pose.x - x, pose.y - y) / passed
        self.turn_rate = (pose.heading - heading) / passed


class Moment(NamedTuple):
    """The values of all curves at one scan.

    Attributes:
        scan: its number, from 1.
        seconds: of the recording; nan without a clock.
        speed, turn_rate: metres and radians per second over the last second.
        x, y, heading: standard deviations of its step in metres and radians, x ahead and y to the left in
            the frame of the scan before; nan if they are unknown or there is no step.
        pose_x, pose_y, pose_heading: standard deviations of its pose, in the frame of the first pose.
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
    """Moments of an endless stream in constant memory: one for each scan, later one for 2, 4, 8, ... scans.

    A moment for several scans has their largest speed, turn rate and deviations of a step, so that no peak is
    lost; its other values are those of the last scan.

    Args:
        capacity: maximum number of moments; even.
    """

    def __init__(self, capacity: int = MOMENTS) -> None:
        self._rows = np.full((capacity, len(Moment._fields)), np.nan)
        self._every, self._seen = 1, 0

    def add(self, moment: Moment) -> None:
        """Adds one more scan."""
        place, shared = divmod(self._seen, self._every)
        if place == len(self._rows):
            place //= 2
            self._rows[:place] = _merge_moments(self._rows[::2], self._rows[1::2])
            self._every *= 2
        row = np.array(moment)
        self._rows[place] = _merge_moments(self._rows[place], row) if shared else row
        self._seen += 1

    def column(self, name: str) -> FloatArray:
        """One field of all moments, (M,)."""
        filled = -(-self._seen // self._every)
        return self._rows[:filled, Moment._fields.index(name)]


def _merge_moments(earlier: FloatArray, later: FloatArray) -> FloatArray:
    """Merges pairs of moments (..., F) into one each."""
    merged = later.copy()
    merged[..., PEAKS] = np.fmax(earlier[..., PEAKS], later[..., PEAKS])
    turns = earlier[..., TURN_RATE], later[..., TURN_RATE]
    is_earlier = ~(np.abs(turns[1]) >= np.abs(turns[0])) & ~np.isnan(turns[0])
    merged[..., TURN_RATE] = np.where(is_earlier, *turns)
    return merged


@dataclass
class Stretch:
    """Scans near each other that are marked for the same cause.

    Attributes:
        first, last: numbers of scans, from 1, as the lines of ``steps.jsonl``.
        start, end: seconds of the recording at these scans; None without a clock.
        scans: how many of the scans are marked.
    """

    first: int
    last: int
    start: float | None
    end: float | None
    scans: int = 1

    def absorb(self, later: "Stretch") -> None:
        """Extends this stretch to the end of a later one."""
        self.last, self.end, self.scans = later.last, later.end, self.scans + later.scans


class Marks:
    """The marked stretches of a run by their cause, in constant memory.

    Attributes:
        stretches: by cause, in order of time.
        first_notes: by cause, ``degraded`` of the first pose that is marked for it.
    """

    def __init__(self) -> None:
        self.stretches: dict[str, list[Stretch]] = {}
        self.first_notes: dict[str, str] = {}
        self._gaps: dict[str, int] = {}

    def add(self, scan: int, seconds: float | None, degraded: str) -> None:
        """Adds one more scan: its number from 1, its time, and the notes of its pose."""
        for cause in dict.fromkeys(causes_in(degraded)):
            kept = self.stretches.setdefault(cause, [])
            self.first_notes.setdefault(cause, degraded)
            gap = self._gaps.setdefault(cause, STRETCH_GAP)
            kept.append(Stretch(scan, scan, seconds, seconds))
            if len(kept) > 1 and scan - kept[-2].last <= gap:
                kept[-2].absorb(kept.pop())
            while len(kept) > MOST_STRETCHES:
                self._gaps[cause] *= 2
                kept[:] = _merge_near(kept, self._gaps[cause])

    def counts(self) -> dict[str, int]:
        """Number of marked scans by cause, the most frequent cause first."""
        counts = {cause: sum(one.scans for one in kept) for cause, kept in self.stretches.items()}
        return dict(sorted(counts.items(), key=lambda item: -item[1]))

    def as_dict(self) -> dict[str, list[dict[str, Any]]]:
        """The stretches by cause, the most frequent cause first, ready for JSON."""
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


def _merge_near(stretches: list[Stretch], gap: int) -> list[Stretch]:
    """Merges stretches that are at most ``gap`` scans apart."""
    merged = stretches[:1]
    for _, later in pairwise(stretches):
        if later.first - merged[-1].last <= gap:
            merged[-1].absorb(later)
        else:
            merged.append(later)
    return merged


class Timeline:
    """The course of a run from its first pose to its last.

    Attributes:
        curves: values over time.
        marks: marked stretches.
        end: the last pose.
        top_speed: the largest speed over one second, in metres per second; 0 if no speed is known.
        scans: number of poses.
    """

    def __init__(self) -> None:
        self.curves, self.marks, self.end = Curves(), Marks(), Pose()
        self.top_speed, self.scans = 0.0, 0
        self._time, self._motion = RecordingTime(), RecentMotion()

    @property
    def seconds(self) -> float | None:
        """Duration of the recording so far; None without a clock."""
        return self._time.seconds

    def add(self, pose: Pose) -> None:
        """Adds one more pose, with the stamp of its scan."""
        self.scans, self.end = self.scans + 1, pose
        self._time.add(pose.stamp)
        self._motion.add(self.seconds, pose)
        speed, turn_rate = self._motion.speed, self._motion.turn_rate
        self.top_speed = max(self.top_speed, 0.0 if math.isnan(speed) else speed)
        seconds = math.nan if self.seconds is None else self.seconds
        deviations = _deviations(pose.step.covariance)
        deviations[deviations == 0] = np.nan  # there is no step: the first scan, or one that was passed over
        pose_deviations = _deviations(pose.covariance)
        self.curves.add(
            Moment(self.scans, seconds, speed, turn_rate, *deviations.tolist(), *pose_deviations.tolist())
        )
        self.marks.add(self.scans, self.seconds, pose.degraded)


def _deviations(covariance: FloatArray) -> FloatArray:
    """Standard deviations (3,) of a covariance (3, 3)."""
    return np.sqrt(np.maximum(np.diag(covariance), 0.0))
