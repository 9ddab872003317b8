"""A run as an mcap file of ROS 2 messages, for Foxglove and ``ros2 bag``: ``rcnn-odom run --mcap``."""

import math
import tempfile
from pathlib import Path
from typing import Any

from rcnn_odom.deployment import ros_messages as ros
from rcnn_odom.deployment.odometer import Odometer, Pose
from rcnn_odom.deployment.output import (
    LocalMaps,
    OutputFile,
    Remarks,
    Stamps,
    add_bearings,
    is_passed_over,
)
from rcnn_odom.deployment.sampling import EvenSample
from rcnn_odom.recordings.clock import CLOCK_JUMP
from rcnn_odom.recordings.scan import Scan
from rcnn_odom.recordings.stream import ScanStream

OPTION = "--mcap"
ODOM, LASER = "odom", "laser"
"""Names of the frame of the first pose, and of the laser's frame if scans do not name it."""
TOPICS = {
    "/odometry": ros.ODOMETRY,
    "/path": ros.PATH,
    "/scan": ros.LASER_SCAN,
    "/points": ros.POINT_CLOUD,
    "/local_map": ros.POINT_CLOUD,
    "/tf": ros.TRANSFORMS,
    "/tf_static": ros.TRANSFORMS,
    "/rosout": ros.LOG,
}
PATH_EVERY, PATH_POSES = 100, 1000
"""Scans between two messages on /path, and maximum number of poses in each: they bound the file's size."""


class McapLog:
    """Writes odometry, path, scans, local map, transforms and remarks.

    A scan that was passed over, whose pose is the last one again, only appears as a remark on /rosout.

    The twist in /odometry is known only if this scan and the one before have stamps in the recording, at most
    ten seconds apart. Otherwise it is 0, with the variances of 1e6 that mark unknown values
    (:func:`rcnn_odom.deployment.ros_messages.ros_covariance`): nav_msgs/Odometry has no flag for an unknown
    twist, and its consumers expect finite numbers.

    Args:
        path: of the file, which must not exist.
        base: name of the robot's frame; it replaces the laser's frame if the poses are those of the robot.

    Raises:
        InputError: the file exists, has another ending, or its folder cannot be written.
    """

    def __init__(self, path: Path, base: str = "base_link") -> None:
        self._file, self._base = OutputFile(path, OPTION, ".mcap"), base
        self._bag: _Bag | None = None

    def open(self, stream: ScanStream, odometer: Odometer) -> None:
        """Prepares for a run that begins."""
        self._odometer = odometer
        self._stamps, self._remarks = Stamps(odometer.tracker.period), Remarks()
        self._maps = LocalMaps(odometer)
        self._path = EvenSample[tuple[int, ros.Planar]](PATH_POSES)
        self._last: tuple[int, ros.Planar] | None = None
        self._is_equal = False  # whether the last two stamps are
        self._last_stamp: int | None = None  # in the recording, of the last pose; None if it has none
        self._frame, self._count = "", 0

    def add(self, pose: Pose, scan: Scan) -> None:
        """Writes one more pose and its scan.

        Raises:
            InputError: the file cannot be created.
            OSError: the file can no longer be written.
        """
        self._bag = self._bag or _Bag(self._file)
        nanoseconds = round(1e9 * self._stamps.next(pose.stamp))
        self._bag.set_time(nanoseconds, round(1e9 * self._stamps.period))
        for remark in self._remarks.add(pose.degraded):
            level = ros.WARNING if remark.is_warning else ros.INFORMATION
            self._bag.write("/rosout", ros.log(nanoseconds, level, remark.text))
        if is_passed_over(pose):
            return
        self._write_pose(self._bag, nanoseconds, pose, scan)
        self._write_scan(self._bag, nanoseconds, scan)
        if (points := self._maps.add()) is not None:
            self._bag.write("/local_map", ros.point_cloud(nanoseconds, ODOM, points))
        self._count += 1
        if self._count % PATH_EVERY == 1:
            self._write_path(self._bag)

    def finish(self, keep: bool) -> None:
        """Completes the file, or removes it.

        Raises:
            OSError: the file can no longer be written.
        """
        if self._bag is None:
            return
        if not keep:
            self._bag.abandon()
            self._file.remove()
            return
        if self._count % PATH_EVERY != 1:  # the last pose is not yet in a path
            self._write_path(self._bag)
        self._bag.close()

    def _write_pose(self, bag: "_Bag", nanoseconds: int, pose: Pose, scan: Scan) -> None:
        """Writes where the laser, or the robot, is."""
        frame, laser_pose = scan.frame_id.lstrip("/"), self._odometer.laser_pose
        # A frame must not be its own parent.
        if not frame or frame == ODOM or (laser_pose and frame == self._base):
            frame = LASER
        if laser_pose and frame != self._frame:
            bag.write("/tf_static", ros.transforms(nanoseconds, self._base, frame, laser_pose))
        self._frame = frame
        child = self._base if laser_pose else frame
        planar, seconds = (pose.x, pose.y, pose.heading), self._measure_time(nanoseconds)
        bag.write("/odometry", ros.odometry(nanoseconds, ODOM, child, pose, seconds))
        bag.write("/tf", ros.transforms(nanoseconds, ODOM, child, planar))
        self._last = nanoseconds, planar
        self._path.add(lambda: (nanoseconds, planar))

    def _measure_time(self, nanoseconds: int) -> float:
        """Seconds since the last pose, from the stamps of the recording; nan if they are unknown."""
        before, self._last_stamp = self._last_stamp, nanoseconds if self._stamps.is_recorded else None
        if before is None or self._last_stamp is None:
            return math.nan
        seconds = 1e-9 * (nanoseconds - before)
        # Until a coarse clock advances, its stamps are equal; the next step is not of all that time.
        was_equal, self._is_equal = self._is_equal, seconds == 0
        return seconds if 0 < seconds <= CLOCK_JUMP and not was_equal else math.nan

    def _write_scan(self, bag: "_Bag", nanoseconds: int, scan: Scan) -> None:
        scan = add_bearings(scan, self._odometer)
        if ros.has_even_beams(scan):
            bag.write("/scan", ros.laser_scan(nanoseconds, self._frame, scan))
        else:
            bag.write("/points", ros.point_cloud(nanoseconds, self._frame, scan.points()))

    def _write_path(self, bag: "_Bag") -> None:
        """Writes an even sample of the poses so far, and the last pose."""
        if self._last is None:
            return
        poses = self._path.items
        if poses[-1] != self._last:
            poses = [*poses, self._last]
        bag.write("/path", ros.path(self._last[0], ODOM, poses))


class _Bag:
    """A single mcap file, written with ``rosbags``, whose writer makes a folder with a bag and a YAML file.

    Args:
        file: to write. It exists from the beginning, and grows in chunks of a megabyte.

    Raises:
        InputError: the file cannot be written.
    """

    def __init__(self, file: OutputFile) -> None:
        from rosbags.rosbag2 import CompressionFormat, CompressionMode, StoragePlugin, Writer

        file.make_folder()
        try:
            with tempfile.TemporaryDirectory(prefix=".mcap-", dir=file.path.parent) as scratch:
                # Version 8 writes QoS settings as numbers, which all versions of ROS 2 can read.
                self._writer = Writer(
                    Path(scratch) / file.path.stem, version=8, storage_plugin=StoragePlugin.MCAP
                )
                self._writer.set_compression(CompressionMode.STORAGE, CompressionFormat.ZSTD)
                self._writer.open()
                assert self._writer.storage is not None
                self._writer.storage.path.rename(file.path)  # the open file stays valid
        except OSError as error:
            file.remove()
            raise file.cannot_write(error) from error
        self._connections: dict[str, Any] = {}
        self._time, self._shift = 0, 0

    def set_time(self, nanoseconds: int, period: int) -> None:
        """Sets the log time of the next messages.

        Players sort messages by log time, so it never goes back, even if stamps do.
        """
        if nanoseconds + self._shift < self._time - 1e9 * CLOCK_JUMP:  # the clock was set
            self._shift = self._time + period - nanoseconds
        self._time = max(self._time, nanoseconds + self._shift)

    def write(self, topic: str, message: Any) -> None:
        """Writes one message."""
        kind = TOPICS[topic]
        if topic not in self._connections:
            self._connections[topic] = self._writer.add_connection(
                topic, kind, typestore=ros.typestore(), offered_qos_profiles=_qos_profiles(topic)
            )
        self._writer.write(self._connections[topic], self._time, ros.serialize(message, kind))

    def close(self) -> None:
        """Writes the index of the file and closes it."""
        with tempfile.TemporaryDirectory() as scratch:
            # The writer also writes a YAML file; it is not needed, because the mcap file holds the same.
            self._writer.metapath = Path(scratch) / self._writer.metapath.name
            self._writer.close()

    def abandon(self) -> None:
        """Closes the file without completing it."""
        self._writer.abort()


def _qos_profiles(topic: str) -> list[Any]:
    """QoS of a topic. Static transforms are also delivered to subscribers that come later."""
    if topic != "/tf_static":
        return []
    from rosbags.interfaces import Qos, QosDurability, QosHistory, QosLiveliness, QosReliability, QosTime

    default = QosTime(0, 0)
    return [
        Qos(
            QosHistory.KEEP_LAST,
            1,
            QosReliability.RELIABLE,
            QosDurability.TRANSIENT_LOCAL,
            default,
            default,
            QosLiveliness.SYSTEM_DEFAULT,
            default,
            avoid_ros_namespace_conventions=False,
        )
    ]
