"""Priors of a step before its scan is matched: from the last motion, the wheels, or a network."""

import math
from dataclasses import dataclass, replace
from typing import Protocol

import numpy as np

from rcnn_odom.geometry import FloatArray, relative_step
from rcnn_odom.recordings.scan import Scan

WHEELS_DISTANCE, WHEELS_TURN = 0.01, 0.01
"""Metres and radians; constant part of the standard deviation of a step of wheel odometry."""
SLIP = 0.1
"""The part of that standard deviation that grows with the step, as a fraction of the step."""
LAST_MOTION = "the last motion goes on"
"""What happens where the scan does not determine the motion; notes on the scan contain this."""
WHEELS_STEP = "the step of the wheels is used"
"""The same if there is wheel odometry."""


@dataclass(frozen=True, eq=False)
class Prior:
    """An expected step.

    Attributes:
        step: (3,) x and y in metres and heading in radians, in the frame of the scan before. It is the
            initial guess of the match, and is used in directions that the scan does not determine.
        covariance: (3, 3) of the step, in the frame of the scan before; finite.
        pull: (3, 3) covariance of the measurement that the step contains. The match is a weighted mean of
            this measurement and the scan. None: the step is only the initial guess.
        stands: text of the note if the step is used in place of a match.
        comes_from_scan: whether the step was estimated from this scan, so that it also counts as an estimate
            if the scan does not match.
    """

    step: FloatArray
    covariance: FloatArray
    pull: FloatArray | None = None
    stands: str = LAST_MOTION
    comes_from_scan: bool = False


class PriorSource(Protocol):
    """A source of a matcher's priors; it receives every scan that the matcher receives, in their order."""

    def reset(self) -> None:
        """Forgets everything."""

    def begin(self, scan: Scan) -> tuple[str, ...]:
        """Takes a scan that is not compared with those before; returns notes."""

    @property
    def has_seen(self) -> bool:
        """Whether the source can give a prior for the next scan although the matcher has no map yet."""

    def expect(
        self, scan: Scan, periods: int, seconds: float | None, last_motion: Prior
    ) -> tuple[Prior, tuple[str, ...]]:
        """The prior of the step to one more scan, and notes on it.

        Args:
            scan: the next scan.
            periods, seconds: since the last scan, as in :class:`rcnn_odom.models.streaming.ScanTracker`.
            last_motion: the prior from the matcher's last motion, which is returned if there is no better.
        """

    def compare(self, step: FloatArray, is_determined: bool) -> None:
        """Takes the result of the match, with which the source can compare its prior.

        Args:
            step: (3,) of the match.
            is_determined: whether the scan determines the step in all directions.
        """


def guess_covariance(step: FloatArray, distance: float, turn: float, part: float) -> FloatArray:
    """The covariance (3, 3) of a guessed step, from the assumed size of its errors.

    Args:
        step: (3,) in metres and radians.
        distance, turn: constant parts of the standard deviations, in metres and radians.
        part: fraction of the step's length and turn that is added to them.

    Example:
        >>> step = np.array([1.0, 0.0, 0.0])
        >>> guess_covariance(step, distance=0.1, turn=0.1, part=0.4).diagonal().round(4).tolist()
        [0.25, 0.25, 0.01]
    """
    x, y, heading = step.tolist()
    length_deviation, turn_deviation = distance + part * math.hypot(x, y), turn + part * abs(heading)
    return np.diag([length_deviation**2, length_deviation**2, turn_deviation**2])


class LastMotion:
    """Uses the matcher's last motion as the prior.

    Args:
        is_measured: whether the last motion counts as a measurement with its covariance. This is the baseline
            for priors from networks.
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
        self, scan: Scan, periods: int, seconds: float | None, last_motion: Prior
    ) -> tuple[Prior, tuple[str, ...]]:
        """The last motion."""
        return (replace(last_motion, pull=last_motion.covariance) if self._is_measured else last_motion), ()

    def compare(self, step: FloatArray, is_determined: bool) -> None:
        """There is nothing to compare."""


class Wheels:
    """Uses the robot's own odometry as the prior, for scans that have it.

    Example:
        The wheels have driven 1 m ahead:

        >>> wheels, last_motion = Wheels(), Prior(np.zeros(3), np.eye(3))
        >>> wheels.begin(Scan(np.ones(3), wheel_pose=(0.0, 0.0, 0.0)))
        ()
        >>> scan = Scan(np.ones(3), wheel_pose=(1.0, 0.0, 0.0))
        >>> prior, notes = wheels.expect(scan, 1, None, last_motion)
        >>> prior.step.tolist()
        [1.0, 0.0, 0.0]
    """

    has_seen = False

    def __init__(self) -> None:
        self.reset()

    def reset(self) -> None:
        """Forgets the last pose of the wheels."""
        self._pose: tuple[float, float, float] | None = None

    def begin(self, scan: Scan) -> tuple[str, ...]:
        """Stores the pose of the wheels."""
        self._pose = scan.wheel_pose
        return ()

    def expect(
        self, scan: Scan, periods: int, seconds: float | None, last_motion: Prior
    ) -> tuple[Prior, tuple[str, ...]]:
        """The step of the wheels, or the last motion if one of the two scans has no pose of the wheels."""
        before, self._pose = self._pose, scan.wheel_pose
        if before is None or scan.wheel_pose is None:
            return last_motion, ()
        step = relative_step(np.array(before), np.array(scan.wheel_pose))
        spread = guess_covariance(step, WHEELS_DISTANCE, WHEELS_TURN, SLIP)
        return Prior(step, spread, spread, WHEELS_STEP), ()

    def compare(self, step: FloatArray, is_determined: bool) -> None:
        """There is nothing to compare."""
