"""Streaming odometry: one scan in, one pose out, in constant memory."""

import math
import shlex
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import Any

import numpy as np
import numpy.typing as npt

from rcnn_odom.deployment.shipped import find_file
from rcnn_odom.errors import InputError
from rcnn_odom.geometry import (
    AccumulatedCovariance,
    FloatArray,
    Step,
    advance,
    change_step_frame,
    planar_to_poses,
)
from rcnn_odom.models.encoding import Sensor
from rcnn_odom.models.onnx_stepper import OnnxStepper
from rcnn_odom.models.pairs import PairTracker
from rcnn_odom.models.streaming import ScanTracker
from rcnn_odom.models.tracking import Kind, Tracking, no_step
from rcnn_odom.recordings.beams import BeamCheck
from rcnn_odom.recordings.scan import Scan

LaserPose = tuple[float, float, float]
"""x and y in metres and heading in radians of a laser on its robot."""


@dataclass(frozen=True, eq=False)
class Pose:
    """Where the laser is, seen from where its first scan was taken, and the step since the last pose.

    Of an odometer that is told where the laser sits on the robot, all of it is the robot's.

    Attributes:
        stamp: seconds, of the scan; None where it has none.
        x, y: metres, x ahead and y to the left of the first pose.
        heading: radians, counter-clockwise, not wrapped.
        step: from the pose before. Of a network its covariance is fitted so that 68 % of the errors on
            validation drives lie within one standard deviation; nan where the model does not know it. Where
            the last motion only went on, the deviations are as large as typical motions.
        covariance: (3, 3) of x, y and heading in the frame of the first pose, accumulated from those of the
            steps; of a network as if their errors were independent. From a step of unknown
            covariance on what depends on it stays nan.
        degraded: empty, or in words why the estimate is worse than its model's usual.
    """

    stamp: float | None = None
    x: float = 0.0
    y: float = 0.0
    heading: float = 0.0
    step: Step = field(default_factory=no_step)
    covariance: FloatArray = field(default_factory=lambda: np.zeros((3, 3)))
    degraded: str = ""

    def matrix(self) -> FloatArray:
        """Laser, or robot, to the frame of the first pose, (4, 4)."""
        return planar_to_poses([[self.x, self.y, self.heading]])[0]

    def as_dict(self) -> dict[str, Any]:
        """Plain values for JSON, None in place of nan."""
        return {
            "stamp": self.stamp,
            "x": self.x,
            "y": self.y,
            "heading": self.heading,
            "step": self.step.array().tolist(),
            "covariance": _without_nan(self.step.covariance),
            "pose_covariance": _without_nan(self.covariance),
            "degraded": self.degraded,
        }


def _without_nan(covariance: FloatArray) -> list[list[float | None]]:
    return [[None if math.isnan(value) else value for value in row] for row in covariance.tolist()]


class Odometer:
    """Poses from the scans of one laser, in their order.

    What may go wrong in a stream never raises. The pose's ``degraded`` then says what happened, the kind of
    it before a colon: see :class:`rcnn_odom.models.tracking.Tracking` for what stamps and frames tell,
    :class:`rcnn_odom.models.pairs.PairTracker` for networks, and the matcher for what it adds.

    Args:
        tracker: the model; None: scan matching, which needs no training and takes any 2D laser.
        laser_pose: x and y in metres and heading in radians of the laser on the robot, whose poses are then
            given; None: poses of the laser.

    Attributes:
        tracker, laser_pose: as given.
        estimates: steps that were estimated from their scan.

    >>> bearings = np.deg2rad(np.arange(-90.0, 91.0))
    >>> pose = Odometer().step(np.full(181, 8.0), stamp=0.0, angles=bearings)
    >>> pose.x, pose.y, pose.heading
    (0.0, 0.0, 0.0)
    """

    def __init__(self, tracker: ScanTracker | None = None, laser_pose: LaserPose | None = None) -> None:
        if tracker is None:
            # Compiled code, which networks do not need.
            from rcnn_odom.models.matcher import MatcherTracker

            tracker = MatcherTracker()
        self.tracker, self.laser_pose = tracker, laser_pose
        self.reset()

    @classmethod
    def from_onnx(
        cls,
        path: str | Path,
        sensor: Sensor | None = None,
        threads: int = 1,
        laser_pose: LaserPose | None = None,
    ) -> "Odometer":
        """The network of a file written by ``rcnn-odom export``, computed by ONNX Runtime.

        Args:
            path: the file, or the name of a model that ships with the project, ``rcnn_small``.
            sensor: which it must have been trained for; None for any.
            threads: of the computation.
            laser_pose: as above.

        Raises:
            InputError: no such file, not one of ``rcnn-odom export``, or of another sensor.
        """
        stepper = OnnxStepper(find_file(path), threads)
        if sensor is not None and stepper.description.sensor != sensor:
            raise InputError(
                f"{path}: made for {stepper.description.sensor}, not {sensor}; take a fitting one"
            )
        return cls(PairTracker(stepper), laser_pose)

    @classmethod
    def from_checkpoint(cls, path: str | Path) -> "Odometer":
        """Tells where to go with a checkpoint, which is exported before it runs.

        Raises:
            InputError: always.
        """
        raise InputError(
            f"{path}: a checkpoint is exported before it runs: rcnn-odom export {shlex.quote(str(path))}, "
            f"then Odometer.from_onnx; at once: rcnn_odom.training.export.load_odometer({str(path)!r})"
        )

    def reset(self) -> None:
        """Begins anew: the next scan is the origin."""
        self._tracking = Tracking(self.tracker)
        self._position, self._covariance, self._last_pose = np.zeros(3), AccumulatedCovariance(), Pose()
        self._is_used, self.estimates = False, 0

    @property
    def has_seen(self) -> bool:
        """Whether there is a scan with returns that the next one can be compared with."""
        return self.tracker.has_seen

    @property
    def beam_check(self) -> BeamCheck | None:
        """What compares the scans' beams with those that a network knows; None: the model takes any laser."""
        return self.tracker.beam_check if isinstance(self.tracker, PairTracker) else None

    @property
    def sensor(self) -> Sensor | None:
        """The laser that a network was trained for; None: the model takes any."""
        return self.tracker.description.sensor if isinstance(self.tracker, PairTracker) else None

    def step(
        self, scan: Scan | npt.ArrayLike, stamp: float | None = None, angles: npt.ArrayLike | None = None
    ) -> Pose:
        """The pose at one more scan.

        Args:
            scan: a :class:`Scan`, which has its own stamp and bearings; or ranges (P,) in metres,
                counter-clockwise; or points (P, 2 or more), x ahead and y to the left in metres. What is not
                positive, not finite, or at a network's maximum range or beyond it is no return.
            stamp: seconds, of ranges or points. Without one (None, nan) the scan counts as the next after
                the last one.
            angles: of the ranges, (P,) radians, 0 ahead, counter-clockwise. None, for networks: evenly over
                the sensor's field of view, from its right end or from behind on.

        Raises:
            ValueError: the arrays' shapes do not fit, or nothing says where the beams lie.
        """
        if not isinstance(scan, Scan):
            scan = _as_scan(scan, stamp, angles)
        if scan.bearings is None and self.sensor is None:
            raise ValueError("ranges without angles say nothing of any laser; give the angles of the beams")
        found = self._tracking.step(scan)
        self._is_used = found.kind is not Kind.PASSED_OVER
        degraded = "; ".join(found.notes)
        if not self._is_used:
            return replace(self._last_pose, step=found.step, degraded=degraded)
        self.estimates += found.kind is Kind.ESTIMATED
        step = found.step if self.laser_pose is None else change_step_frame(found.step, self.laser_pose)
        self._covariance.add(self._position, step)
        self._position = advance(self._position, step.array())
        stamp = None if scan.stamp is None or not math.isfinite(scan.stamp) else float(scan.stamp)
        x, y, heading = self._position.tolist()
        self._last_pose = Pose(stamp, x, y, heading, step, self._covariance.value, degraded)
        return self._last_pose

    def returns(self) -> npt.NDArray[np.float32]:
        """Points (P, 2) in metres of the last scan in the frame of the first pose.

        Empty if the last scan had no return or was not used.
        """
        if not self._is_used:
            return np.empty((0, 2), np.float32)
        place = (
            self._position if self.laser_pose is None else advance(self._position, np.array(self.laser_pose))
        )
        pose = planar_to_poses(place[None])[0]
        return (self.tracker.returns() @ pose[:2, :2].T + pose[:2, 3]).astype(np.float32)


def _as_scan(values: npt.ArrayLike, stamp: float | None, angles: npt.ArrayLike | None) -> Scan:
    values = np.asarray(values, dtype=np.float64)
    if values.ndim == 2:
        return Scan.from_points(values, stamp)
    bearings = None if angles is None else np.asarray(angles, dtype=np.float64)
    return Scan(values, bearings, stamp=stamp)
