"""A run as an mcap file of ROS 2 messages, for Foxglove and ``ros2 bag``: ``rcnn-odom run --mcap``."""

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
    is_passed_over,
    with_bearings,
)
from rcnn_odom.deployment.sampling import EvenSample
from rcnn_odom.recordings.clock import CLOCK_JUMP
from rcnn_odom.recordings.scan import Scan
from rcnn_odom.recordings.stream import ScanStream

OPTION = "--mcap"
ODOM, LASER = "odom", "laser"
"""Frames: of the first pose, and of a laser whose scans do not name theirs."""
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
"""Scans between two paths that are written, and most poses of one: the file grows evenly with the scans."""


class McapLog:
    """Odometry, path, scans, local map, transforms and marks.

    Scans that are passed over, whose pose is the last one again, are told on /rosout alone.

    Args:
        path: of the file, which must not exist.
        base: name of the robot's frame, in the place of the laser's where the poses are the robot's.

    Raises:
        InputError: the file exists, has another ending, or its folder cannot be written.
    """

    def __init__(self, path: Path, base: str = "base_link") -> None:
        self._file, self._base = OutputFile(path, OPTION, ".mcap"), base
        self._bag: _Bag | None = None

    def open(self, stream: ScanStream, odometer: Odometer) -> None:
        """Gets to know a run that begins."""
        self._odometer = odometer
        self._stamps, self._remarks = Stamps(odometer.tracker.period), Remarks()
        self._maps = LocalMaps(odometer)
        self._path = EvenSample[tuple[int, ros.Planar]](PATH_POSES)
        self._last: tuple[int, ros.Planar] | None = None
        self._frame, self._count = "", 0

    def add(self, pose: Pose, scan: Scan) -> None:
        """One more pose, with its scan.

        Raises:
            InputError: the file cannot be written.
            OSError: it can no longer be written.
        """
        self._bag = self._bag or _Bag(self._file)
        nanoseconds = round(1e9 * self._stamps.next(pose.stamp))
        self._bag.set_time(nanoseconds, round(1e9 * self._stamps.period))
        for remark in self._remarks.add(pose.degraded):
            level = ros.WARNING if remark.is_warning else ros.INFORMATION
            self._bag.write("/rosout", ros.log(nanoseconds, level, remark.text))
        if is_passed_over(pose):
            return
        self._write_place(self._bag, nanoseconds, pose, scan)
        self._write_scan(self._bag, nanoseconds, scan)
        if (points := self._maps.add()) is not None:
            self._bag.write("/local_map", ros.point_cloud(nanoseconds, ODOM, points))
        self._count += 1
        if self._count % PATH_EVERY == 1:
            self._write_path(self._bag)

    def finish(self, keep: bool) -> None:
        """Completes the file, or removes it.

        Raises:
            OSError: it can no longer be written.
        """
        if self._bag is None:
            return
        if not keep:
            self._bag.abandon()
            self._file.remove()
            return
        if self._count % PATH_EVERY != 1:  # the last one is not written yet
            self._write_path(self._bag)
        self._bag.close()

    def _write_place(self, bag: "_Bag", nanoseconds: int, pose: Pose, scan: Scan) -> None:
        """Where the laser, or the robot, is."""
        frame, robot = scan.frame_id.lstrip("/"), self._odometer.laser_pose
        if not frame or frame == ODOM or (robot and frame == self._base):  # it would be its own parent
            frame = LASER
        if robot and frame != self._frame:
            bag.write("/tf_static", ros.transforms(nanoseconds, self._base, frame, robot))
        self._frame = frame
        child = self._base if robot else frame
        passed = 0.0 if self._last is None else 1e-9 * (nanoseconds - self._last[0])
        place = (pose.x, pose.y, pose.heading)
        bag.write("/odometry", ros.odometry(nanoseconds, ODOM, child, pose, passed))
        bag.write("/tf", ros.transforms(nanoseconds, ODOM, child, place))
        self._last = nanoseconds, place
        self._path.add(lambda: (nanoseconds, place))

    def _write_scan(self, bag: "_Bag", nanoseconds: int, scan: Scan) -> None:
        scan = with_bearings(scan, self._odometer)
        if ros.has_even_beams(scan):
            bag.write("/scan", ros.laser_scan(nanoseconds, self._frame, scan))
        else:
            bag.write("/points", ros.point_cloud(nanoseconds, self._frame, scan.points()))

    def _write_path(self, bag: "_Bag") -> None:
        """An even sample of the poses so far, and the last one."""
        if self._last is None:
            return
        poses = self._path.items
        if poses[-1] != self._last:
            poses = [*poses, self._last]
        bag.write("/path", ros.path(self._last[0], ODOM, poses))


class _Bag:
    """A single mcap file by the writer of ``rosbags``, which by itself makes folders of a file and its YAML.

    Args:
        file: to write; it is there at once, and grows by chunks of a megabyte.

    Raises:
        InputError: it cannot be written.
    """

    def __init__(self, file: OutputFile) -> None:
        from rosbags.rosbag2 import CompressionFormat, CompressionMode, StoragePlugin, Writer

        file.make_folder()
        try:
            with tempfile.TemporaryDirectory(prefix=".mcap-", dir=file.path.parent) as scratch:
                # Version 8 has the qualities of service as numbers, which all of ROS 2 reads.
                self._writer = Writer(
                    Path(scratch) / file.path.stem, version=8, storage_plugin=StoragePlugin.MCAP
                )
                self._writer.set_compression(CompressionMode.STORAGE, CompressionFormat.ZSTD)
                self._writer.open()
                assert self._writer.storage is not None
                self._writer.storage.path.rename(file.path)  # it stays open
        except OSError as error:
            file.remove()
            raise file.cannot_write(error) from error
        self._connections: dict[str, Any] = {}
        self._time, self._shift = 0, 0

    def set_time(self, nanoseconds: int, period: int) -> None:
        """The time of the next messages. Players sort by it: it never goes back, even where stamps do."""
        if nanoseconds + self._shift < self._time - 1e9 * CLOCK_JUMP:  # the clock was set
            self._shift = self._time + period - nanoseconds
        self._time = max(self._time, nanoseconds + self._shift)

    def write(self, topic: str, message: Any) -> None:
        """One message."""
        kind = TOPICS[topic]
        if topic not in self._connections:
            self._connections[topic] = self._writer.add_connection(
                topic, kind, typestore=ros.typestore(), offered_qos_profiles=_qualities(topic)
            )
        self._writer.write(self._connections[topic], self._time, ros.serialize(message, kind))

    def close(self) -> None:
        """Writes the index of the file."""
        with tempfile.TemporaryDirectory() as scratch:
            # A YAML beside the bag, all of which the file itself holds as well.
            self._writer.metapath = Path(scratch) / self._writer.metapath.name
            self._writer.close()

    def abandon(self) -> None:
        """Closes the file as it is."""
        self._writer.abort()


def _qualities(topic: str) -> list[Any]:
    """Of the static transforms: whoever comes later gets them too."""
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
