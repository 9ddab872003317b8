"""What is known of a step before its scan is matched: the last motion, wheels, or a network."""

import math
from dataclasses import dataclass, replace
from typing import Protocol

import numpy as np

from rcnn_odom.geometry import FloatArray, relative_step
from rcnn_odom.recordings.scan import Scan

WHEELS_DISTANCE, WHEELS_TURN = 0.01, 0.01
"""Metres and radians by which wheel odometry is off, and beside them ``SLIP`` of itself."""
SLIP = 0.1
LAST_MOTION = "the last motion goes on"
"""What becomes of a step, or of a direction of it, that the scan does not determine; in words for notes."""


@dataclass(frozen=True, eq=False)
class Prior:
    """A step that is expected.

    Attributes:
        step: (3,) x and y in metres and heading in radians from the scan before. A match begins there, and
            where the scan determines nothing it stands.
        covariance: (3, 3) of it, in the frame of the scan before; finite.
        pull: (3, 3) the part of that which was measured, and pulls at the match by its weight beside the
            match's own; None: the step is only where the match begins.
        stands: what is told where the step stands in place of a match.
        comes_from_scan: the step was estimated from this scan, so that it is one where nothing matches.
    """

    step: FloatArray
    covariance: FloatArray
    pull: FloatArray | None = None
    stands: str = LAST_MOTION
    comes_from_scan: bool = False


class PriorSource(Protocol):
    """Where a matcher's priors come from; it sees every scan that the matcher sees, in their order."""

    def reset(self) -> None:
        """Forgets everything."""

    def begin(self, scan: Scan) -> tuple[str, ...]:
        """Takes a scan that is not compared with those before; notes on it."""

    @property
    def has_seen(self) -> bool:
        """Whether it can tell of the next scan although the matcher has seen nothing yet."""

    def expect(
        self, scan: Scan, periods: int, seconds: float | None, held: Prior
    ) -> tuple[Prior, tuple[str, ...]]:
        """The prior of the step to one more scan, and notes on it.

        Args:
            scan: the next one.
            periods, seconds: since the last one, as of :class:`rcnn_odom.models.streaming.ScanTracker`.
            held: that of the matcher's last motion; the answer where the source knows nothing better.
        """

    def compare(self, step: FloatArray, is_determined: bool) -> None:
        """Learns of the match that followed.

        Args:
            step: (3,) that the matcher gives.
            is_determined: by the scan, in all directions.
        """


def believed(step: FloatArray, distance: float, turn: float, part: float) -> FloatArray:
    """The covariance (3, 3) of a step that is off by so many metres and radians, and by a part of itself."""
    x, y, heading = step.tolist()
    away, turned = distance + part * math.hypot(x, y), turn + part * abs(heading)
    return np.diag([away**2, away**2, turned**2])


class LastMotion:
    """The matcher's last motion goes on, as it is.

    Args:
        is_measured: it pulls by its covariance, as if it were measured; others have to be better.
    """

    has_seen = False

    def __init__(self, is_measured: bool = False) -> None:
        self._is_measured = is_measured

    def reset(self) -> None:
        """There is nothing to forget."""

    def begin(self, scan: Scan) -> tuple[str, ...]:
        """There is nothing to do."""
        return ()

    def expect(
        self, scan: Scan, periods: int, seconds: float | None, held: Prior
    ) -> tuple[Prior, tuple[str, ...]]:
        """The last motion."""
        return (replace(held, pull=held.covariance) if self._is_measured else held), ()

    def compare(self, step: FloatArray, is_determined: bool) -> None:
        """There is nothing to learn."""


class Wheels:
    """The robot's own odometry, where scans have it."""

    has_seen = False

    def __init__(self) -> None:
        self.reset()

    def reset(self) -> None:
        """Forgets where the wheels were."""
        self._pose: tuple[float, float, float] | None = None

    def begin(self, scan: Scan) -> tuple[str, ...]:
        """Takes where the wheels are."""
        self._pose = scan.wheel_pose
        return ()

    def expect(
        self, scan: Scan, periods: int, seconds: float | None, held: Prior
    ) -> tuple[Prior, tuple[str, ...]]:
        """The step of the wheels, or the last motion where a scan has none."""
        before, self._pose = self._pose, scan.wheel_pose
        if before is None or scan.wheel_pose is None:
            return held, ()
        step = relative_step(np.array(before), np.array(scan.wheel_pose))
        spread = believed(step, WHEELS_DISTANCE, WHEELS_TURN, SLIP)
        return Prior(step, spread, spread, "the wheels tell it"), ()

    def compare(self, step: FloatArray, is_determined: bool) -> None:
        """There is nothing to learn."""
