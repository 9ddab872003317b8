"""Reads ROS bags with LaserScan or PointCloud2 messages: ROS 1, ROS 2 sqlite3 and mcap; no ROS is needed.

Only the requested topics are read, and their messages are decoded with ROS's own message definitions. So
damaged topics that are not requested, and wrong message definitions in a bag, do no harm.
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
from rcnn_odom.recordings.bags.files import METADATA, REPAIR_ADVICE, Bag, is_bag, open_bag
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
"""Number of clouds from which the ring or the cut is chosen."""
UNREADABLE = "messages that cannot be read"

T = TypeVar("T")


def recognises(path: Path) -> bool:
    """Whether the path is a bag or its folder, by its first bytes or by its name."""
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
    """Stream the scans of a bag in the order of their arrival.

    Scans have the stamps of their headers; if the first header has the stamp 0, they have their times of
    arrival. A message that cannot be read is skipped and counted.

    Args:
        path: a file of a bag, compressed or not; the folder of a ROS 2 bag, or the metadata.yaml in it.
        topic: topic of the scans, with or without its first slash; None: the only topic with LaserScan
            messages, or, if there is none, the only one with PointCloud2 messages.
        ring: number of the ring in point clouds, or of the row in clouds that are a grid; None: the most
            level one.
        height: lowest and highest z in metres in the frame of the cloud: take a slice of point clouds
            instead of a ring.
        odom_topic: topic of the robot's own odometry, with or without its first slash, from which scans get
            their ``wheel_pose``. The poses are transformed from the robot's frame (``child_frame_id`` of the
            messages) to the laser, if ``laser_pose`` or /tf_static gives the laser's pose on the robot.
        base: the robot's frame; the stream's ``laser_pose`` is then the pose of the laser in it by
            /tf_static.
        laser_pose: x and y in metres and heading in radians of the laser on the robot, instead of the pose
            from /tf_static.

    Raises:
        InputError: the bag cannot be opened, it has no such topic or several, the clouds have no such ring or
            height, /tf_static does not give the pose of the laser in ``base``, or the laser is not level.
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
    """Make a scan of a LaserScan message.

    Args:
        message: a message from ``rosbags`` or from ROS 2.
        arrival: time of arrival in nanoseconds, used if the stamp of the header is 0.

    Raises:
        ValueError: the directions of the beams do not follow from the message's angles.
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
            f"{path}: {topic.name} holds LaserScan messages, which have no {given} to choose; leave "
            f"--{given} out, or choose a topic with PointCloud2 messages with --topic"
        )
    skipped, clock, warned = Counter[str](), Clock(), list[str]()

    def to_scan(message: Any, arrival: int) -> Scan:
        scan = replace(convert(message), stamp=clock.stamp(message, arrival))
        if not warned:
            first, step, last = map(float, (message.angle_min, message.angle_increment, message.angle_max))
            if contradiction := compare_angles(first, step, last, len(scan.ranges)):
                log.warning("%s: %s: %s", path, topic.name, contradiction)
                warned.append(contradiction)
        return scan

    return ScanStream(
        name=_bag_name(path),
        scans=_read_messages(path, bag, topic, to_scan, skipped),
        total=topic.messages,
        notes=(f"{topic.messages} scans of {topic.name}", *bag.notes),
        skipped=skipped,
    )


def _stream_clouds(
    path: Path, bag: Bag, topic: Topic, ring: int | None, height: tuple[float, float] | None
) -> ScanStream:
    clouds = _sample_clouds(path, bag, topic)
    try:
        cut, cut_note = choose_cut(clouds, ring, height)
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
        name=_bag_name(path),
        scans=_read_messages(path, bag, topic, to_scan, skipped),
        total=topic.messages,
        beams=estimate_beams(clouds, cut) if is_ring else None,
        notes=(f"{topic.messages} point clouds of {topic.name}", cut_note, *bag.notes),
        skipped=skipped,
    )


def _bag_name(path: Path) -> str:
    """The user's name of a bag: the name of its folder if the path is its metadata.yaml."""
    whole = path.resolve()
    return (whole.parent if whole.name == METADATA else whole).name


def _sample_clouds(path: Path, bag: Bag, topic: Topic) -> list[Cloud]:
    """Read the first ``SAMPLED_CLOUDS`` clouds that have points.

    Raises:
        InputError: no cloud can be read, or none has points.
    """
    sample: list[Cloud] = []
    clouds = _read_messages(path, bag, topic, lambda message, _: read_cloud(message), Counter())
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
    """Name of the frame of the first scan."""
    messages = _read_messages(path, bag, topic, lambda message, _: str(message.header.frame_id), Counter())
    return next(messages)


def _close_after(bag: Bag, scans: Iterator[Scan]) -> Iterator[Scan]:
    try:
        yield from scans
    finally:
        bag.close()


def _read_messages(
    path: Path, bag: Bag, topic: Topic, convert: Callable[[Any, int], T], skipped: Counter[str]
) -> Iterator[T]:
    """Decode and convert the messages of a topic; those that cannot be read are counted in ``skipped``.

    Raises:
        InputError: the bag is cut off or damaged, or no message can be read.
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
        kept = "these scans are kept; " if read else ""
        raise InputError(f"{path}: breaks off after {read} scans ({error}); {kept}{REPAIR_ADVICE}") from error
    if not read and skipped[UNREADABLE]:
        raise InputError(
            f"{path}: none of its {skipped[UNREADABLE]} messages of {topic.name} can be read ({why}); record "
            "them again, or choose another topic"
        )
    if not read:
        raise InputError(
            f"{path}: no message of {topic.name} in it; choose another topic, or record it again"
        )
