"""ROS bags with LaserScan or PointCloud2 messages: ROS 1, ROS 2 sqlite3 and mcap; no ROS is needed.

Only the topics that are asked for are looked at, and their messages are read by the types that ROS itself
has: what a bag says about other topics, or about its types, cannot keep it from being read.
"""

import logging
from collections import Counter
from collections.abc import Callable, Iterator
from dataclasses import replace
from itertools import islice
from pathlib import Path
from typing import Any, TypeVar

import numpy as np

from rcnn_odom.errors import InputError
from rcnn_odom.recordings.bags.chunks import BrokenBag
from rcnn_odom.recordings.bags.files import MENDED_BY, METADATA, Bag, is_bag, open_bag
from rcnn_odom.recordings.bags.messages import Clock, deserialize, header_stamp
from rcnn_odom.recordings.bags.point_cloud import (
    PLANE,
    Cloud,
    choose_cut,
    estimate_beams,
    read_cloud,
    seconds_after,
)
from rcnn_odom.recordings.bags.robot import RobotOptions, place_on_robot
from rcnn_odom.recordings.bags.topics import LASER_SCAN, Topic, choose_topic
from rcnn_odom.recordings.laser_scan import compare_angles, from_laser_scan
from rcnn_odom.recordings.scan import Scan
from rcnn_odom.recordings.stream import ScanStream

log = logging.getLogger(__name__)

SAMPLED_CLOUDS = 20
UNREADABLE = "messages that cannot be read"

T = TypeVar("T")


def recognises(path: Path) -> bool:
    """Whether it is a bag or the folder of one by its first bytes, or named like one."""
    return is_bag(path)


def stream(
    path: Path,
    topic: str | None = None,
    ring: int | None = None,
    height: tuple[float, float] | None = None,
    odom_topic: str | None = None,
    base: str | None = None,
    laser_pose: tuple[float, float, float] | None = None,
) -> ScanStream:
    """The scans of a bag, in the order of their arrival.

    The stamp is the header's, or where the first one's is 0 the time of arrival. A message that cannot
    be read is skipped and counted.

    Args:
        path: a file of a bag, packed or not; the folder of a ROS 2 bag, or the metadata.yaml in it.
        topic: of the scans, with or without its first slash; None: the only one with LaserScan messages, or
            where there is none with PointCloud2 messages.
        ring: of point clouds, as they number them, or the row of clouds that lie in a grid; None: the most
            level one.
        height: metres from and to, in the frame of the cloud: a slice of point clouds instead of a ring.
        odom_topic: of the robot's own odometry, with or without its first slash, which gives the scans their
            ``wheel_pose``. It is moved from the robot's frame (the messages' ``child_frame_id``) to the
            laser, as far as ``laser_pose`` or /tf_static says where that sits.
        base: the robot's frame: /tf_static says where the laser sits in it, the stream's ``laser_pose``.
        laser_pose: x and y in metres and heading in radians of the laser on the robot, in place of what
            /tf_static says.

    Raises:
        InputError: the bag cannot be opened, has no such topic or several, or cannot be cut so; or it does
            not tell where the laser sits on ``base``, or not that it is level.
    """
    bag = open_bag(path)
    try:
        chosen = choose_topic(path, bag, topic)
        found = _stream_lasers if chosen.kind == LASER_SCAN else _stream_clouds
        scans = found(path, bag, chosen, ring, height)
        if wanted := RobotOptions(odom_topic, base, laser_pose):
            frame = _first_frame(path, bag, chosen)
            scans = place_on_robot(scans, path, bag, frame, wanted)
        return replace(scans, scans=_close_after(bag, scans.scans))
    except BaseException:
        bag.close()
        raise


def convert(message: Any, arrival: int = 0) -> Scan:
    """The beams of a LaserScan message.

    Args:
        message: of ``rosbags`` or of ROS 2.
        arrival: nanoseconds, in place of a stamp of 0.

    Raises:
        ValueError: its angles do not say where its beams lie.
    """
    return from_laser_scan(
        message.ranges,
        float(message.angle_min),
        float(message.angle_increment),
        float(message.angle_max),
        message.range_min,
        message.range_max,
        message.time_increment,
        message.scan_time,
        header_stamp(message) or 1e-9 * arrival,
        message.header.frame_id,
    )


def _stream_lasers(
    path: Path, bag: Bag, topic: Topic, ring: int | None, height: tuple[float, float] | None
) -> ScanStream:
    if ring is not None or height is not None:
        given = "ring" if height is None else "height"
        raise InputError(
            f"{path}: {topic.name} holds LaserScan messages, of which there is no {given} to choose; leave "
            f"--{given} out, or choose a topic with PointCloud2 messages with --topic"
        )
    skipped, clock, told = Counter[str](), Clock(), list[str]()

    def to_scan(message: Any, arrival: int) -> Scan:
        scan = replace(convert(message), stamp=clock.stamp(message, arrival))
        if not told:
            first, step, last = map(float, (message.angle_min, message.angle_increment, message.angle_max))
            if contradiction := compare_angles(first, step, last, len(scan.ranges)):
                log.warning("%s: %s: %s", path, topic.name, contradiction)
                told.append(contradiction)
        return scan

    return ScanStream(
        name=_name_of(path),
        scans=_read(path, bag, topic, to_scan, skipped),
        total=topic.messages,
        notes=(f"{topic.messages} scans of {topic.name}", *bag.notes),
        skipped=skipped,
    )


def _stream_clouds(
    path: Path, bag: Bag, topic: Topic, ring: int | None, height: tuple[float, float] | None
) -> ScanStream:
    clouds = _sample_clouds(path, bag, topic)
    try:
        cut, about = choose_cut(clouds, ring, height)
    except ValueError as error:
        raise InputError(f"{path}: {topic.name} cannot be cut to a planar scan: {error}") from error

    skipped, clock = Counter[str](), Clock()

    def to_scan(message: Any, arrival: int) -> Scan:
        cloud, stamp = read_cloud(message), clock.stamp(message, arrival)
        seen = cut(cloud)
        times = None if cloud.times is None else seconds_after(stamp, cloud.times[seen])
        return Scan.from_points(cloud.points[seen], stamp, message.header.frame_id, times)

    is_ring = height is None and any(np.ptp(cloud.points[:, 2]) > PLANE for cloud in clouds)
    return ScanStream(
        name=_name_of(path),
        scans=_read(path, bag, topic, to_scan, skipped),
        total=topic.messages,
        beams=estimate_beams(clouds, cut) if is_ring else None,
        notes=(f"{topic.messages} point clouds of {topic.name}", about, *bag.notes),
        skipped=skipped,
    )


def _name_of(path: Path) -> str:
    """Of a bag as a user knows it: of its folder where the path is its metadata.yaml."""
    whole = path.resolve()
    return (whole.parent if whole.name == METADATA else whole).name


def _sample_clouds(path: Path, bag: Bag, topic: Topic) -> list[Cloud]:
    """The first clouds that have points.

    Raises:
        InputError: none can be read, or none has points.
    """
    sample: list[Cloud] = []
    clouds = _read(path, bag, topic, lambda message, _: read_cloud(message), Counter())
    try:
        sample.extend(islice((cloud for cloud in clouds if len(cloud.points)), SAMPLED_CLOUDS))
    except InputError:
        if not sample:
            raise
    if not sample:
        raise InputError(
            f"{path}: none of the point clouds of {topic.name} has a point; choose another topic"
        )
    return sample


def _first_frame(path: Path, bag: Bag, topic: Topic) -> str:
    messages = _read(path, bag, topic, lambda message, _: str(message.header.frame_id), Counter())
    return next(messages)


def _close_after(bag: Bag, scans: Iterator[Scan]) -> Iterator[Scan]:
    try:
        yield from scans
    finally:
        bag.close()


def _read(
    path: Path, bag: Bag, topic: Topic, convert: Callable[[Any, int], T], skipped: Counter[str]
) -> Iterator[T]:
    """What becomes of each message of a topic that can be read.

    Raises:
        InputError: the bag breaks off, or not one message can be read.
    """
    read, why = 0, ""
    try:
        for encoding, arrival, content in bag.messages(topic.name, topic.kind):
            try:
                value = convert(deserialize(content, encoding, topic.kind), arrival)
            except ValueError as error:
                skipped[UNREADABLE] += 1
                why = why or str(error)
                continue
            yield value
            read += 1
    except (BrokenBag, OSError) as error:
        kept = "what came before is kept; " if read else ""
        raise InputError(f"{path}: breaks off after {read} scans ({error}); {kept}{MENDED_BY}") from error
    if not read and skipped[UNREADABLE]:
        raise InputError(
            f"{path}: none of its {skipped[UNREADABLE]} messages of {topic.name} can be read ({why}); record "
            "them again, or choose another topic"
        )
    if not read:
        raise InputError(
            f"{path}: no message of {topic.name} in it; choose another topic, or record it again"
        )
