"""A stream of scans through a model: what stamps and frames say, and what happens at the ends of it."""

import math
from collections.abc import Iterable
from dataclasses import dataclass
from enum import Enum

import numpy as np

from rcnn_odom.geometry import FloatArray, Step, Steps, advance, wrap_angle
from rcnn_odom.models.streaming import ScanTracker
from rcnn_odom.recordings.beams import PATIENCE
from rcnn_odom.recordings.clock import LATE, Clock
from rcnn_odom.recordings.scan import Scan

OTHER_FRAME, TO_AND_FRO = "other frame", "to and fro"
"""Kinds of trouble."""
SWINGS = 2
"""Steps in a row that take the one before back, from which on that is told ..."""
SWING_DISTANCE, SWING_TURN = 0.1, math.radians(10.0)
"""... and metres or radians of such a step at least: no robot moves to and fro at the rate of its scans."""
TAKEN_BACK = 1 / 3
"""Part of a step that is left of it and of the one before at most."""
PASSED_OVER = (LATE, OTHER_FRAME)
"""Kinds of trouble whose scans are not used, so that the pose is the last one again."""


def no_step() -> Step:
    """A zero step with zero covariance, for the first pose and for repeated poses."""
    return Step(0.0, 0.0, 0.0, np.zeros((3, 3)))


class Kind(Enum):
    """Where the step to a scan comes from."""

    FIRST = "nothing moves up to the first scan"
    UNKNOWN = "nobody knows how far it went"
    PASSED_OVER = "the scan is not used"
    ESTIMATED = "the scan was compared"
    HELD = "the last motion goes on"


@dataclass(frozen=True, eq=False)
class Tracked:
    """What becomes of one scan of a stream.

    Attributes:
        step: of the laser since the scan before.
        kind: where it comes from.
        notes: what it suffers from, each with its kind before a colon; empty: nothing.
    """

    step: Step
    kind: Kind
    notes: tuple[str, ...] = ()


class Tracking:
    """Steps from the scans of one laser, in their order; what may go wrong in a stream never raises.

    What a model makes of a scan and of a gap is its own matter. Before a scan comes to it:

    - *late scan*, a stamp not after the one before: passed over.
      After five of them in a row the clock is taken as set, and it goes on as after a gap. After five scans
      with the very stamp of the scan before the clock is coarse: such scans then count as the next ones.
    - *clock set*, a stamp more than ten seconds before or after the last one: nobody knows how much time has
      passed, so no motion is added, the step's covariance is unknown, and the new stamps are the clock from
      there on; after five jumps in a row stamps no longer count. A stamp of 0, always, at first or among
      others, is none.
    - *other frame*, a scan of another ``frame_id`` than the scans before: passed over as of another laser.
      After five of them in a row it is the laser's (*new frame*), and no motion is added to there.
    - *to and fro*: each of the last two steps takes the one before it back, as where two lasers write to one
      topic under one name; the estimate stands.
    - *slow scans*: more than 1.5 times the period of training between them; the estimate stands.
    - *fast scans*: less than the period of training over 1.5; the estimate stands, but gaps are counted in
      periods of training, so that short ones are not noticed.

    Args:
        tracker: the model; it is reset.
    """

    def __init__(self, tracker: ScanTracker) -> None:
        self.tracker = tracker
        self.reset()

    def reset(self) -> None:
        """Begins anew: the next scan is the first."""
        self.tracker.reset()
        self._clock = Clock(self.tracker.period)
        self._frame, self._of_other_frame, self._begun = "", 0, False
        self._ranges, self._swings = np.empty(0), _Swings()

    def step(self, scan: Scan) -> Tracked:
        """The step to one more scan."""
        frame = scan.frame_id.lstrip("/")
        if frame and self._frame and frame != self._frame and self.tracker.has_seen:
            self._of_other_frame += 1
            if self._of_other_frame < PATIENCE:
                return _pass_over(f"{OTHER_FRAME}: {frame} after {self._frame}, passed over")
        stamp = None if scan.stamp is None or not math.isfinite(scan.stamp) else float(scan.stamp)
        tick = self._clock.read(stamp, repeats=np.array_equal(scan.ranges, self._ranges))
        self._ranges = scan.ranges
        if tick.late:
            return _pass_over(tick.late)
        notes = [*([tick.clock_set] if tick.clock_set else []), *self._follow_frame(frame)]
        if tick.clock_set or not self.tracker.has_seen:
            return self._begin((*notes, *self.tracker.begin(scan), *tick.notes))
        found = self.tracker.register(scan, tick.periods, tick.seconds)
        kind = Kind.ESTIMATED if found.is_estimated else Kind.HELD
        swings = self._swings.add(found.step.array())
        return Tracked(found.step, kind, (*notes, *found.notes, *swings, *tick.notes))

    def _follow_frame(self, frame: str) -> list[str]:
        """Takes a scan's frame for the laser's; words about it where the laser had another one."""
        before, self._frame, self._of_other_frame = self._frame, frame or self._frame, 0
        if before == self._frame or not before:
            return []
        # Another laser, or another place of it: nothing of before can be compared with its scans.
        self.tracker.reset()
        return [f"new frame: {frame} after {before}, no motion is added"]

    def _begin(self, notes: tuple[str, ...]) -> Tracked:
        """No motion: at the start, which is certain, or where nobody knows how far it went."""
        begun, self._begun = self._begun, self._begun or self.tracker.has_seen
        return (
            Tracked(Step(0.0, 0.0, 0.0), Kind.UNKNOWN, notes)
            if begun
            else Tracked(no_step(), Kind.FIRST, notes)
        )


class _Swings:
    """Counts steps in a row that take each other back."""

    def __init__(self) -> None:
        self._last, self._count = np.zeros(3), 0

    def add(self, step: FloatArray) -> tuple[str, ...]:
        """One more step (3,); words about it where it is one too many that go to and fro."""
        both, self._last = advance(self._last, step), step
        distance, turn = math.hypot(step[0], step[1]), abs(float(wrap_angle(step[2])))
        is_back = distance > SWING_DISTANCE and math.hypot(both[0], both[1]) < TAKEN_BACK * distance
        turns_back = turn > SWING_TURN and abs(float(wrap_angle(both[2]))) < TAKEN_BACK * turn
        self._count = self._count + 1 if is_back or turns_back else 0
        if self._count < SWINGS:
            return ()
        return (
            f"{TO_AND_FRO}: {distance:.2f} m and {math.degrees(turn):.0f} degrees in every step, as where "
            "two lasers write to one topic",
        )


def _pass_over(why: str) -> Tracked:
    return Tracked(no_step(), Kind.PASSED_OVER, (why,))


def estimate_by_tracking(tracker: ScanTracker, scans: Iterable[Scan]) -> Steps:
    """The steps of a whole drive as a stream would have them: those of ``rcnn-odom run``.

    Args:
        tracker: the model; it is reset.
        scans: N of them, as of :meth:`rcnn_odom.recordings.recording.Drive.raw_scans`.

    Returns:
        N - 1 steps; zero with zero covariance to a scan that is passed over.
    """
    tracking = Tracking(tracker)
    steps = [tracking.step(scan).step for scan in scans][1:]
    return Steps(
        np.array([step.array() for step in steps]).reshape(-1, 3),
        np.array([step.covariance for step in steps]).reshape(-1, 3, 3),
    )
