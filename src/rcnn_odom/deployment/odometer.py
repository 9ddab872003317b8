"""Odometry in a stream: a pose for each scan, in constant memory."""

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
from rcnn_odom.models.streaming import Description, ScanTracker
from rcnn_odom.models.tracking import Kind, Tracking, no_step
from rcnn_odom.recordings.beams import BeamCheck
from rcnn_odom.recordings.scan import Scan

LaserPose = tuple[float, float, float]
"""Pose of a laser on its robot: x and y in metres and heading in radians."""


@dataclass(frozen=True, eq=False)
class Pose:
    """The pose of the laser in the frame of its first scan, and the step from the previous pose.

    If the odometer knows the pose of the laser on the robot, pose and step are those of the robot.

    Attributes:
        stamp: stamp of the scan in seconds; None if it has none.
        x, y: metres ahead and to the left of the first pose.
        heading: radians, counter-clockwise, not wrapped.
        step: motion since the previous pose. Its covariance is nan if the model gives none. A network's
            covariance is fitted so that 68 % of the errors on validation drives lie within one standard
            deviation. If the last motion was only repeated, the deviations are as large as typical motions.
        covariance: (3, 3) of x, y and heading in the frame of the first pose, accumulated over the steps. The
            errors of a network's steps are treated as independent. After a step of unknown covariance the
            entries that depend on it stay nan.
        degraded: notes on why the estimate is worse than usual for its model, separated by semicolons;
            otherwise empty.

    Example:
        >>> pose = Pose(stamp=0.5, x=1.0, y=2.0, heading=np.pi / 2)  # 1 m ahead, 2 m to the left, turned left
        >>> pose.matrix().round(3)
        array([[ 0., -1.,  0.,  1.],
               [ 1.,  0.,  0.,  2.],
               [ 0.,  0.,  1.,  0.],
               [ 0.,  0.,  0.,  1.]])
        >>> pose.as_dict()["stamp"], pose.as_dict()["x"]
        (0.5, 1.0)
    """

    stamp: float | None = None
    x: float = 0.0
    y: float = 0.0
    heading: float = 0.0
    step: Step = field(default_factory=no_step)
    covariance: FloatArray = field(default_factory=lambda: np.zeros((3, 3)))
    degraded: str = ""

    def matrix(self) -> FloatArray:
        """The transform (4, 4) from the frame of the laser, or the robot, to the frame of the first pose."""
        return planar_to_poses([[self.x, self.y, self.heading]])[0]

    def as_dict(self) -> dict[str, Any]:
        """Plain values for JSON, with None for nan."""
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
    """Computes poses from the scans of one laser, which are given in order.

    Problems of the stream raise no error. Instead, ``degraded`` of the pose holds a note on each problem,
    which begins with the kind of the problem and a colon. The kinds are documented in
    :class:`rcnn_odom.models.tracking.Tracking` for stamps and frames, in
    :class:`rcnn_odom.models.pairs.PairTracker` for networks and in
    :class:`rcnn_odom.models.matcher.MatcherTracker` for scan matching.

    Args:
        tracker: the model; None for scan matching, which needs no training and works with any 2D laser.
        laser_pose: pose of the laser on the robot, to get poses of the robot; x and y in metres and heading
            in radians. None to get poses of the laser.

    Attributes:
        tracker, laser_pose: as given.
        estimates: number of steps that were estimated from their scans.

    Example:
        A square room of 8 m, seen from its centre and then from 1 m ahead:

        >>> bearings = np.deg2rad(np.arange(0.5, 360.0))
        >>> cos, sin, odometer = np.cos(bearings), np.abs(np.sin(bearings)), Odometer()
        >>> for x in (0.0, 1.0):
        ...     ranges = np.minimum((4 - x * np.sign(cos)) / np.abs(cos), 4 / sin)
        ...     pose = odometer.step(ranges, stamp=x, angles=bearings)
        >>> round(pose.x, 2), odometer.estimates
        (1.0, 1)
    """

    def __init__(self, tracker: ScanTracker | None = None, laser_pose: LaserPose | None = None) -> None:
        if tracker is None:
            # Imported here because networks do not need its compiled code.
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
        """Makes an odometer with the network in a file of ``rcnn-odom export``, run by ONNX Runtime.

        Args:
            path: the file, or the name of a network that ships with the project: ``all_round`` or
                ``half_circle``.
            sensor: the sensor for which the network must have been trained; None for any.
            threads: number of threads of the computation.
            laser_pose: as in the class.

        Raises:
            InputError: the file does not exist, was not written by ``rcnn-odom export``, or holds a network
                for another sensor.

        Example:
            >>> odometer = Odometer.from_onnx("all_round")
            >>> odometer.sensor.field_of_view_deg
            360.0
        """
        stepper = OnnxStepper(find_file(path), threads)
        if sensor is not None and stepper.description.sensor != sensor:
            raise InputError(
                f"{path}: trained for {stepper.description.sensor}, not {sensor}; use another network"
            )
        return cls(PairTracker(stepper), laser_pose)

    @classmethod
    def from_checkpoint(cls, path: str | Path) -> "Odometer":
        """Raises an error that says how to use a checkpoint, which must be exported first.

        Raises:
            InputError: always.

        Example:
            >>> Odometer.from_checkpoint("best.ckpt")
            Traceback (most recent call last):
            rcnn_odom.errors.InputError: best.ckpt: a checkpoint must be exported first: ...
        """
        raise InputError(
            f"{path}: a checkpoint must be exported first: rcnn-odom export {shlex.quote(str(path))}, then "
            f"Odometer.from_onnx; both in one call: rcnn_odom.training.export.load_odometer({str(path)!r})"
        )

    def reset(self) -> None:
        """Forgets everything: the next scan is the origin.

        Example:
            >>> odometer = Odometer()
            >>> pose = odometer.step([[2.0, 0.0], [0.0, 1.0]])
            >>> odometer.reset()
            >>> len(odometer.returns())
            0
        """
        self._tracking = Tracking(self.tracker)
        self._planar_pose, self._covariance, self._last_pose = np.zeros(3), AccumulatedCovariance(), Pose()
        self._is_used, self.estimates = False, 0

    @property
    def has_seen(self) -> bool:
        """Whether there is an earlier scan with returns, with which the next one can be compared."""
        return self.tracker.has_seen

    @property
    def beam_check(self) -> BeamCheck | None:
        """Compares the beams of scans with those of the network's sensor; None if any laser works."""
        return self.tracker.beam_check if isinstance(self.tracker, PairTracker) else None

    @property
    def sensor(self) -> Sensor | None:
        """The laser for which the network was trained; None if the model works with any laser."""
        return self.tracker.description.sensor if isinstance(self.tracker, PairTracker) else None

    @property
    def network(self) -> Description | None:
        """Description of the network that gives the steps, or the priors of the matcher; None without one."""
        description: Description | None = getattr(self.tracker, "description", None)
        return description

    def step(
        self, scan: Scan | npt.ArrayLike, stamp: float | None = None, angles: npt.ArrayLike | None = None
    ) -> Pose:
        """Computes the pose of one more scan.

        Args:
            scan: a :class:`Scan`, which has its own stamp and bearings; or ranges (P,) in metres,
                counter-clockwise; or points (P, 2 or more), x ahead and y to the left in metres. A range that
                is not positive, not finite, or at least a network's maximum range counts as no return.
            stamp: seconds, for ranges or points. If it is None or nan, one period is assumed to have passed.
            angles: (P,) bearings of the ranges in radians, 0 ahead, counter-clockwise. None is allowed for
                networks only, and means beams that are spread evenly over the sensor's field of view, from
                its right end or, if it is a full circle, from behind.

        Raises:
            ValueError: the shapes of the arrays do not match, or the bearings of the beams are unknown.
        """
        if not isinstance(scan, Scan):
            scan = _as_scan(scan, stamp, angles)
        if scan.bearings is None and self.sensor is None:
            raise ValueError("ranges without angles do not define a scan; give the angles of the beams")
        tracked = self._tracking.step(scan)
        self._is_used = tracked.kind is not Kind.PASSED_OVER
        degraded = "; ".join(tracked.notes)
        if not self._is_used:
            return replace(self._last_pose, step=tracked.step, degraded=degraded)
        self.estimates += tracked.kind is Kind.ESTIMATED
        step = tracked.step if self.laser_pose is None else change_step_frame(tracked.step, self.laser_pose)
        self._covariance.add(self._planar_pose, step)
        self._planar_pose = advance(self._planar_pose, step.array())
        stamp = None if scan.stamp is None or not math.isfinite(scan.stamp) else float(scan.stamp)
        x, y, heading = self._planar_pose.tolist()
        self._last_pose = Pose(stamp, x, y, heading, step, self._covariance.value, degraded)
        return self._last_pose

    def returns(self) -> npt.NDArray[np.float32]:
        """The returns of the last scan as points (P, 2) in metres, in the frame of the first pose.

        Empty if the last scan had no return or was not used.

        Example:
            >>> odometer = Odometer()
            >>> pose = odometer.step([[2.0, 0.0], [0.0, 1.0]])  # a scan given as two points
            >>> odometer.returns().round(3).tolist()
            [[2.0, 0.0], [0.0, 1.0]]
        """
        if not self._is_used:
            return np.empty((0, 2), np.float32)
        return self._from_laser(self.tracker.returns())

    def local_map(self) -> npt.NDArray[np.float32] | None:
        """The map of scan matching as points (C, 2) in metres, in the frame of the first pose.

        None if the model keeps no map.

        Example:
            >>> odometer = Odometer()
            >>> pose = odometer.step([[2.0, y / 10] for y in range(-10, 11)])  # a wall 2 m ahead
            >>> set(odometer.local_map()[:, 0].round(3).tolist())
            {2.0}
        """
        map_points = getattr(self.tracker, "map_points", None)
        return None if map_points is None else self._from_laser(map_points())

    def _from_laser(self, points: FloatArray) -> npt.NDArray[np.float32]:
        """Transforms points (P, 2) from the laser's frame to the frame of the first pose."""
        planar = (
            self._planar_pose
            if self.laser_pose is None
            else advance(self._planar_pose, np.array(self.laser_pose))
        )
        pose = planar_to_poses(planar[None])[0]
        return (points @ pose[:2, :2].T + pose[:2, 3]).astype(np.float32)


def _as_scan(values: npt.ArrayLike, stamp: float | None, angles: npt.ArrayLike | None) -> Scan:
    values = np.asarray(values, dtype=np.float64)
    if values.ndim == 2:
        return Scan.from_points(values, stamp)
    bearings = None if angles is None else np.asarray(angles, dtype=np.float64)
    return Scan(values, bearings, stamp=stamp)
