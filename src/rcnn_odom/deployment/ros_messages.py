"""Poses and scans as standard messages of ROS 2, made by ``rosbags``: no ROS is needed."""

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
"""Of x, y and heading among the six of a covariance: x, y, z and the turns about them."""
UNKNOWN = 1e6
"""Variance of what is not known. It is large, since 0 would be certainty."""
WARNING, INFORMATION = 30, 20
"""Levels of rcl_interfaces/msg/Log."""
EVEN = 0.01
"""Part of the spacing of beams by which one may be off its place, and all still count as even."""
FLOAT32 = 7
"""Of sensor_msgs/msg/PointField."""

Planar = tuple[float, float, float]
"""x and y in metres and heading in radians."""


def ros_covariance(covariance: FloatArray) -> FloatArray:
    """The 36 values of a message, row by row, of a covariance (3, 3) of x, y and heading.

    What is unknown (nan), and z, roll and pitch, which a planar laser does not measure, have a variance of
    1e6 and no covariances. ROS lays no value down for it: -1, in the first place, is of sensor_msgs/Imu and
    its like alone. robot_pose_ekf needs a large variance on dimensions that are not used, and drivers of
    planar robots write one there; robot_localization leaves out what its configuration does.
    """
    known = np.isfinite(np.diag(covariance))
    planar = np.where(np.outer(known, known) & np.isfinite(covariance), covariance, 0.0)
    values = UNKNOWN * np.eye(6)
    values[np.ix_(AXES, AXES)] = planar + np.diag(np.where(known, 0.0, UNKNOWN))
    return values.ravel()


def has_even_beams(scan: Scan) -> bool:
    """Whether a LaserScan message can say where the beams lie: one after the other at the same distance."""
    if scan.bearings is None or not scan.has_all_beams:
        return False
    if len(scan.bearings) < 2:
        return True
    if not np.isfinite(scan.bearings).all():
        return False
    angles = np.unwrap(scan.bearings)
    spacing = (angles[-1] - angles[0]) / (len(angles) - 1)
    off = np.abs(angles - angles[0] - spacing * np.arange(len(angles))).max()
    return bool(off < EVEN * abs(spacing))


@cache
def typestore() -> Any:
    """The types of ROS 2 Humble, which for these messages are those of later versions as well."""
    from rosbags.typesys import Stores, get_typestore

    return get_typestore(Stores.ROS2_HUMBLE)


def serialize(message: Any, kind: str) -> bytes:
    """A message of such a type as bytes."""
    return bytes(typestore().serialize_cdr(message, kind))


def velocity_of(step: Step, seconds: float) -> tuple[Planar, FloatArray]:
    """Velocity in metres and radians a second, in the frame in mid-turn, and its covariance (3, 3).

    Args:
        step: to the present pose.
        seconds: that it took; not positive: the velocity is unknown, and 0.

    Example:
        >>> velocity_of(Step(0.2, 0.0, 0.0), 0.1)[0]
        (2.0, 0.0, 0.0)
    """
    if seconds <= 0:
        return (0.0, 0.0, 0.0), unknown_covariance()
    middle = turn_to_middle(step)
    x, y, turn = (middle.array() / seconds).tolist()
    return (x, y, turn), middle.covariance / seconds**2


def odometry(nanoseconds: int, frame: str, child: str, pose: Pose, seconds: float) -> Any:
    """A pose in ``frame`` with its accumulated covariance, and the velocity in ``child``.

    Args:
        nanoseconds: of its stamp.
        frame, child: names of the fixed frame and of what moves.
        pose: of the odometer.
        seconds: since the pose before; not positive: the velocity is unknown, and 0 in the message.
    """
    (x, y, turn), of_velocity = velocity_of(pose.step, seconds)
    twist = _geometry("Twist", _vector(x, y), _geometry("Vector3", 0.0, 0.0, turn))
    return typestore().types[ODOMETRY](
        header=_header(nanoseconds, frame),
        child_frame_id=child,
        pose=_geometry(
            "PoseWithCovariance", _pose((pose.x, pose.y, pose.heading)), ros_covariance(pose.covariance)
        ),
        twist=_geometry("TwistWithCovariance", twist, ros_covariance(of_velocity)),
    )


def path(nanoseconds: int, frame: str, poses: Iterable[tuple[int, Planar]]) -> Any:
    """Poses in ``frame``, each with the nanoseconds of its stamp."""
    stamped = [_geometry("PoseStamped", _header(stamp, frame), _pose(pose)) for stamp, pose in poses]
    return typestore().types[PATH](header=_header(nanoseconds, frame), poses=stamped)


def transforms(nanoseconds: int, frame: str, child: str, place: Planar) -> Any:
    """Where ``child`` is in ``frame``, as /tf and /tf_static have it."""
    x, y, heading = place
    moved = _geometry("Transform", _vector(x, y), _quaternion(heading))
    stamped = _geometry("TransformStamped", _header(nanoseconds, frame), child, moved)
    return typestore().types[TRANSFORMS](transforms=[stamped])


def laser_scan(nanoseconds: int, frame: str, scan: Scan) -> Any:
    """A scan with even beams, as its laser gave it.

    What is no return is nan, or inf where it lies beyond the laser's reach (REP 117).
    How far the laser reaches is unknown of a scan: ``range_max`` is inf, and ``range_min`` 0.
    """
    assert scan.bearings is not None, "its beams are even"
    count = len(scan.ranges)
    angles = np.unwrap(scan.bearings) if count else np.zeros(1)
    extent = float(angles[-1] - angles[0])
    with np.errstate(over="ignore"):  # of readings that no laser gives
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
    """Words of this program."""
    return typestore().types[LOG](
        stamp=_time(nanoseconds), level=level, name="rcnn_odom", msg=text, file="", function="", line=0
    )


def _time_increment(scan: Scan) -> float:
    """Seconds from beam to beam; 0 where unknown, or where they are no such."""
    if scan.times is None or len(scan.times) < 2:
        return 0.0
    step = float(scan.times[1] - scan.times[0])
    is_even = np.allclose(scan.times, step * np.arange(len(scan.times)), rtol=0.0, atol=EVEN * abs(step))
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


def _pose(place: Planar) -> Any:
    x, y, heading = place
    return _geometry("Pose", _geometry("Point", x, y, 0.0), _quaternion(heading))
