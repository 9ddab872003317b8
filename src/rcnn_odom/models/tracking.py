"""Runs a model on a stream of scans: checks stamps and frames, and handles the first scans and faults."""

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
"""Kinds of faults, with which the notes begin."""
SWINGS = 2
"""Number of steps in a row that reverse the step before, from which on the note *to and fro* is given."""
SWING_DISTANCE, SWING_TURN = 0.1, math.radians(10.0)
"""Metres and radians; smaller steps do not count, because a robot may shake by that much."""
REVERSAL_FRACTION = 1 / 3
"""A step reverses the one before if their composition is smaller than this fraction of the step."""
PASSED_OVER = (LATE, OTHER_FRAME)
"""Kinds of faults for which a scan is not used, so that the last pose is repeated."""


def no_step() -> Step:
    """A zero step with zero covariance, for the first pose and for repeated poses.

    Example:
        >>> no_step().array().tolist(), bool(no_step().covariance.any())
        ([0.0, 0.0, 0.0], False)
    """
    return Step(0.0, 0.0, 0.0, np.zeros((3, 3)))


class Kind(Enum):
    """The origin of the step to a scan."""

    FIRST = "it is the first scan"
    UNKNOWN = "the motion to this scan is unknown"
    PASSED_OVER = "the scan is not used"
    ESTIMATED = "the step was estimated from the scan"
    HELD = "the last motion goes on"


@dataclass(frozen=True, eq=False)
class Tracked:
    """The result for one scan of a stream.

    Attributes:
        step: motion of the laser since the scan before.
        kind: origin of the step.
        notes: messages about faults, each with its kind before a colon; empty without a fault.
    """

    step: Step
    kind: Kind
    notes: tuple[str, ...] = ()


class Tracking:
    """Makes steps from the scans of one laser in their order; faults of the stream raise no errors.

    The model handles scans without returns, gaps and the like itself. This class handles these faults:

    - *late scan*: the stamp is not later than the one before; the scan is not used. After five of them in a
      row, the clock must have been set, and tracking continues as after a gap. After five scans with exactly
      the stamp of the scan before, the clock is too coarse, and such scans count as the next ones.
    - *clock set*: the stamp is more than ten seconds before or after the last one. The elapsed time is
      unknown, so that no motion is added and the step's covariance is unknown. From there on, the new stamps
      are used; after five jumps in a row, stamps are ignored. A stamp of 0 counts as no stamp.
    - *other frame*: the ``frame_id`` differs from that of the scans before. The scan is not used, because it
      comes from another laser. After five of them in a row, the frame of the laser must have changed
      (*new frame*), and no motion is added for the change.
    - *to and fro*: each of the last two steps reversed the step before it, as if two lasers published to one
      topic with the same ``frame_id``; the estimate is used.
    - *slow scans*: the period is more than 1.5 times that of training; the estimate is used.
    - *fast scans*: the period is less than that of training divided by 1.5; the estimate is used, but gaps
      are counted in periods of training, so that short ones are not noticed.

    Args:
        tracker: the model, which is reset.

    Attributes:
        tracker: as given.
    """

    def __init__(self, tracker: ScanTracker) -> None:
        self.tracker = tracker
        self.reset()

    def reset(self) -> None:
        """Forgets all scans: the next one is the first."""
        self.tracker.reset()
        self._clock = Clock(self.tracker.period)
        self._frame, self._other_frames, self._has_begun = "", 0, False
        self._ranges, self._swings = np.empty(0), _SwingCounter()

    def step(self, scan: Scan) -> Tracked:
        """The step to one more scan."""
        frame = scan.frame_id.lstrip("/")
        if frame and self._frame and frame != self._frame and self.tracker.has_seen:
            self._other_frames += 1
            if self._other_frames < PATIENCE:
                return _pass_over(f"{OTHER_FRAME}: {frame} after {self._frame}, passed over")
        stamp = None if scan.stamp is None or not math.isfinite(scan.stamp) else float(scan.stamp)
        tick = self._clock.read(stamp, repeats=np.array_equal(scan.ranges, self._ranges))
        self._ranges = scan.ranges
        if tick.late:
            return _pass_over(tick.late)
        notes = [*([tick.clock_set] if tick.clock_set else []), *self._update_frame(frame)]
        if tick.clock_set or not self.tracker.has_seen:
            return self._begin((*notes, *self.tracker.begin(scan), *tick.notes))
        found = self.tracker.register(scan, tick.periods, tick.seconds)
        kind = Kind.ESTIMATED if found.is_estimated else Kind.HELD
        swings = self._swings.add(found.step.array())
        return Tracked(found.step, kind, (*notes, *found.notes, *swings, *tick.notes))

    def _update_frame(self, frame: str) -> list[str]:
        """Stores the frame of a scan as the laser's; returns a note if the laser had another one."""
        before, self._frame, self._other_frames = self._frame, frame or self._frame, 0
        if before == self._frame or not before:
            return []
        # The laser or its mounting has changed: earlier scans cannot be compared with the new ones.
        self.tracker.reset()
        return [f"new frame: {frame} after {before}, no motion is added"]

    def _begin(self, notes: tuple[str, ...]) -> Tracked:
        """A zero step: certain for the first scan, else with unknown covariance."""
        had_begun, self._has_begun = self._has_begun, self._has_begun or self.tracker.has_seen
        return (
            Tracked(Step(0.0, 0.0, 0.0), Kind.UNKNOWN, notes)
            if had_begun
            else Tracked(no_step(), Kind.FIRST, notes)
        )


class _SwingCounter:
    """Counts consecutive steps that reverse the step before."""

    def __init__(self) -> None:
        self._last, self._count = np.zeros(3), 0

    def add(self, step: FloatArray) -> tuple[str, ...]:
        """Counts one more step (3,); returns a note if ``SWINGS`` or more steps were reversals."""
        both, self._last = advance(self._last, step), step
        distance, turn = math.hypot(step[0], step[1]), abs(float(wrap_angle(step[2])))
        is_back = distance > SWING_DISTANCE and math.hypot(both[0], both[1]) < REVERSAL_FRACTION * distance
        turns_back = turn > SWING_TURN and abs(float(wrap_angle(both[2]))) < REVERSAL_FRACTION * turn
        self._count = self._count + 1 if is_back or turns_back else 0
        if self._count < SWINGS:
            return ()
        return (
            f"{TO_AND_FRO}: {distance:.2f} m and {math.degrees(turn):.0f} degrees in every step, as if two "
            "lasers published to one topic",
        )


def _pass_over(note: str) -> Tracked:
    """The result for a scan that is not used."""
    return Tracked(no_step(), Kind.PASSED_OVER, (note,))


def estimate_by_tracking(tracker: ScanTracker, scans: Iterable[Scan]) -> Steps:
    """The steps of a whole drive, estimated as in a stream; they equal those of ``rcnn-odom run``.

    Args:
        tracker: the model, which is reset.
        scans: N scans, such as those of :meth:`rcnn_odom.recordings.recording.Drive.raw_scans`.

    Returns:
        N - 1 steps; those to scans that are passed over are zero with zero covariance.
    """
    tracking = Tracking(tracker)
    steps = [tracking.step(scan).step for scan in scans][1:]
    return Steps(
        np.array([step.array() for step in steps]).reshape(-1, 3),
        np.array([step.covariance for step in steps]).reshape(-1, 3, 3),
    )
