"""Poses and scans as standard messages of ROS 2, made with ``rosbags``: ROS itself is not needed."""

import math
from collections.abc import Iterable
from functools import cache
from typing import Any

import numpy as np
import numpy.typing as npt

from rcnn_odom.deployment.odometer import Pose
from rcnn_odom.geometry import FloatArray, Step, turn_to_middle, unknown_covariance
from rcnn_odom.recordings.scan import Scan

ODOMETRY, PATH, TRANSFORMS = "nav_msgs/msg/Odometry", "nav_msgs/msg/Path", "tf2_msgs/msg/TFMessage"
LASER_SCAN, POINT_CLOUD = "sensor_msgs/msg/LaserScan", "sensor_msgs/msg/PointCloud2"
LOG = "rcl_interfaces/msg/Log"
"""Types of messages."""
AXES = (0, 1, 5)
"""Rows of x, y and heading in a 6x6 covariance of ROS: x, y, z and the rotations about these axes."""
UNKNOWN_VARIANCE = 1e6
"""Variance of an unknown quantity. It is large, because 0 would mean that the quantity is exact."""
WARNING, INFORMATION = 30, 20
"""Levels of rcl_interfaces/msg/Log."""
EVEN_TOLERANCE = 0.01
"""Beams count as even if each is off its place by less than this part of their spacing."""
FLOAT32 = 7
"""Constant of sensor_msgs/msg/PointField."""

Planar = tuple[float, float, float]
"""x and y in metres and heading in radians."""


def ros_covariance(covariance: FloatArray) -> FloatArray:
    """The 36 values of a message, row by row, for a covariance (3, 3) of x, y and heading.

    Unknown quantities (nan), and z, roll and pitch, which a planar laser does not measure, get a variance of
    1e6 and zero covariances. ROS defines no value for an unknown one: -1 in the first place is defined only
    for sensor_msgs/Imu and similar messages. robot_pose_ekf needs a large variance on dimensions that are not
    used, and drivers of planar robots write one there; robot_localization ignores the dimensions that its
    configuration leaves out.

    Example:
        >>> ros_covariance(np.diag([0.04, 0.01, np.nan])).reshape(6, 6).diagonal().tolist()
        [0.04, 0.01, 1000000.0, 1000000.0, 1000000.0, 1000000.0]
    """
    known = np.isfinite(np.diag(covariance))
    planar = np.where(np.outer(known, known) & np.isfinite(covariance), covariance, 0.0)
    values = UNKNOWN_VARIANCE * np.eye(6)
    values[np.ix_(AXES, AXES)] = planar + np.diag(np.where(known, 0.0, UNKNOWN_VARIANCE))
    return values.ravel()


def has_even_beams(scan: Scan) -> bool:
    """Whether a LaserScan message can describe the beams: in order and with one spacing.

    Example:
        >>> has_even_beams(Scan(np.ones(3), np.array([0.0, 0.1, 0.2])))
        True
    """
    if scan.bearings is None or not scan.has_all_beams:
        return False
    if len(scan.bearings) < 2:
        return True
    if not np.isfinite(scan.bearings).all():
        return False
    angles = np.unwrap(scan.bearings)
    spacing = (angles[-1] - angles[0]) / (len(angles) - 1)
    off = np.abs(angles - angles[0] - spacing * np.arange(len(angles))).max()
    return bool(off < EVEN_TOLERANCE * abs(spacing))


@cache
def typestore() -> Any:
    """The message types of ROS 2 Humble; those used here are the same in later versions."""
    from rosbags.typesys import Stores, get_typestore

    return get_typestore(Stores.ROS2_HUMBLE)


def serialize(message: Any, kind: str) -> bytes:
    """The bytes (CDR) of a message of the type ``kind``."""
    return bytes(typestore().serialize_cdr(message, kind))


def velocity_of(step: Step, seconds: float) -> tuple[Planar, FloatArray]:
    """Velocity in metres and radians per second, in the frame at mid-turn, and its covariance (3, 3).

    Args:
        step: to the present pose.
        seconds: duration of the step. If it is not positive, or nan, the velocity is unknown: it is 0 and its
            covariance nan.

    Example:
        >>> velocity_of(Step(0.2, 0.0, 0.0), 0.1)[0]
        (2.0, 0.0, 0.0)
    """
    if not seconds > 0:
        return (0.0, 0.0, 0.0), unknown_covariance()
    middle = turn_to_middle(step)
    x, y, turn = (middle.array() / seconds).tolist()
    return (x, y, turn), middle.covariance / seconds**2


def odometry(nanoseconds: int, frame: str, child: str, pose: Pose, seconds: float) -> Any:
    """A pose in ``frame`` with its accumulated covariance, and the velocity in ``child``.

    Args:
        nanoseconds: of its stamp.
        frame, child: names of the fixed frame and of the moving one.
        pose: of the odometer.
        seconds: since the last pose. If it is not positive, or nan, the velocity is unknown: in the message
            it is 0, with variances of 1e6 (:func:`ros_covariance`).
    """
    (x, y, turn), velocity_covariance = velocity_of(pose.step, seconds)
    twist = _geometry("Twist", _vector(x, y), _geometry("Vector3", 0.0, 0.0, turn))
    return typestore().types[ODOMETRY](
        header=_header(nanoseconds, frame),
        child_frame_id=child,
        pose=_geometry(
            "PoseWithCovariance", _pose((pose.x, pose.y, pose.heading)), ros_covariance(pose.covariance)
        ),
        twist=_geometry("TwistWithCovariance", twist, ros_covariance(velocity_covariance)),
    )


def path(nanoseconds: int, frame: str, poses: Iterable[tuple[int, Planar]]) -> Any:
    """Poses in ``frame``, each with the nanoseconds of its stamp."""
    stamped = [_geometry("PoseStamped", _header(stamp, frame), _pose(pose)) for stamp, pose in poses]
    return typestore().types[PATH](header=_header(nanoseconds, frame), poses=stamped)


def transforms(nanoseconds: int, frame: str, child: str, pose: Planar) -> Any:
    """The pose of ``child`` in ``frame``, as a message for /tf and /tf_static."""
    x, y, heading = pose
    transform = _geometry("Transform", _vector(x, y), _quaternion(heading))
    stamped = _geometry("TransformStamped", _header(nanoseconds, frame), child, transform)
    return typestore().types[TRANSFORMS](transforms=[stamped])


def laser_scan(nanoseconds: int, frame: str, scan: Scan) -> Any:
    """A scan with even beams, as the laser gave it.

    A beam without a return is nan, or inf if the target is beyond the laser's range (REP 117).
    A scan does not say how far its laser reaches: ``range_max`` is inf, and ``range_min`` 0.
    """
    assert scan.bearings is not None, "its beams are even"
    count = len(scan.ranges)
    angles = np.unwrap(scan.bearings) if count else np.zeros(1)
    extent = float(angles[-1] - angles[0])
    with np.errstate(over="ignore"):  # ranges too large for float32, which no real laser gives
        ranges = np.where(scan.ranges > 0, scan.ranges, np.nan).astype(np.float32)
    return typestore().types[LASER_SCAN](
        header=_header(nanoseconds, frame),
        angle_min=float(angles[0]),
        angle_max=float(angles[0]) + extent,
        angle_increment=extent / max(count - 1, 1),
        time_increment=_time_increment(scan),
        scan_time=scan.turn_time or 0.0,
        range_min=0.0,
        range_max=math.inf,
        ranges=ranges,
        intensities=np.zeros(0, np.float32),
    )


def point_cloud(nanoseconds: int, frame: str, points: npt.ArrayLike) -> Any:
    """Points (P, 2) in metres in ``frame``, with z = 0."""
    flat = np.asarray(points, dtype=np.float32)
    values = np.zeros((len(flat), 3), np.float32)
    values[:, :2] = flat
    field = typestore().types["sensor_msgs/msg/PointField"]
    return typestore().types[POINT_CLOUD](
        header=_header(nanoseconds, frame),
        height=1,
        width=len(values),
        fields=[field(name, 4 * number, FLOAT32, 1) for number, name in enumerate("xyz")],
        is_bigendian=False,
        point_step=12,
        row_step=12 * len(values),
        data=np.frombuffer(values.astype("<f4").tobytes(), np.uint8),
        is_dense=True,
    )


def log(nanoseconds: int, level: int, text: str) -> Any:
    """A log message of this program."""
    return typestore().types[LOG](
        stamp=_time(nanoseconds), level=level, name="rcnn_odom", msg=text, file="", function="", line=0
    )


def _time_increment(scan: Scan) -> float:
    """Seconds between neighbouring beams; 0 if they are unknown, not positive or not even."""
    if scan.times is None or len(scan.times) < 2:
        return 0.0
    step = float(scan.times[1] - scan.times[0])
    even = step * np.arange(len(scan.times))
    is_even = np.allclose(scan.times, even, rtol=0.0, atol=EVEN_TOLERANCE * abs(step))
    return step if step > 0 and is_even else 0.0


def _time(nanoseconds: int) -> Any:
    return typestore().types["builtin_interfaces/msg/Time"](*divmod(nanoseconds, 10**9))


def _header(nanoseconds: int, frame: str) -> Any:
    return typestore().types["std_msgs/msg/Header"](stamp=_time(nanoseconds), frame_id=frame)


def _geometry(name: str, *values: Any) -> Any:
    return typestore().types[f"geometry_msgs/msg/{name}"](*values)


def _vector(x: float, y: float) -> Any:
    return _geometry("Vector3", x, y, 0.0)


def _quaternion(heading: float) -> Any:
    return _geometry("Quaternion", 0.0, 0.0, math.sin(heading / 2), math.cos(heading / 2))


def _pose(pose: Planar) -> Any:
    x, y, heading = pose
    return _geometry("Pose", _geometry("Point", x, y, 0.0), _quaternion(heading))
