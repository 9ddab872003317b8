"""ROS bags with LaserScan messages: ROS 1, ROS 2 sqlite3 and mcap, read by ``rosbags``; no ROS is needed."""

from collections import Counter
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import numpy as np

from rcnn_odom.errors import InputError
from rcnn_odom.recordings.scan import Scan
from rcnn_odom.recordings.stream import ScanStream

SUFFIXES = (".bag", ".mcap", ".db3")
METADATA = "metadata.yaml"
"""What the folder of a ROS 2 bag holds."""
LASER_SCAN = "sensor_msgs/msg/LaserScan"


def recognises(path: Path) -> bool:
    """Whether it is named like a bag, or is the folder of one."""
    return path.suffix in SUFFIXES or (path / METADATA).exists()


def stream(path: Path, topic: str | None = None) -> ScanStream:
    """The LaserScan messages of a bag, in the order of their arrival.

    Readings outside ``range_min`` to ``range_max`` are no returns. The stamp is the header's, or where
    that is 0 the time of arrival. A message that cannot be read is skipped and counted.

    Args:
        path: a ``.bag``, ``.mcap`` or ``.db3`` file, or the folder of a ROS 2 bag.
        topic: of the scans; None: the only one there is.

    Raises:
        InputError: the bag cannot be opened, has no LaserScan, or several topics of them.
    """
    bag = _open(path)
    topics = {name: info.msgtype for name, info in bag.topics.items()}
    try:
        topic = _choose(path, topic, topics)
    except InputError:
        bag.close()
        raise
    skipped: Counter[str] = Counter()
    return ScanStream(
        name=path.name,
        scans=_scans(bag, topic, path, skipped),
        total=bag.topics[topic].msgcount,
        notes=(f"{bag.topics[topic].msgcount} scans of {topic}",),
        skipped=skipped,
    )


def _open(path: Path) -> Any:
    from rosbags.highlevel import AnyReader
    from rosbags.typesys import Stores, get_typestore

    try:
        bag = AnyReader([path], default_typestore=get_typestore(Stores.LATEST))
        bag.open()
    except Exception as error:  # whatever the bytes of a damaged bag lead to
        raise InputError(
            f"{path}: cannot be opened as a ROS bag ({_reason(error)}); a bag whose recording was cut off is "
            "mended by 'rosbag reindex' or 'ros2 bag reindex', mcap by 'mcap recover'"
        ) from error
    return bag


def _reason(error: Exception) -> str:
    return (str(error) or type(error).__name__).splitlines()[0].rstrip(".")


def _choose(path: Path, topic: str | None, topics: dict[str, str | None]) -> str:
    lasers = sorted(name for name, kind in topics.items() if kind == LASER_SCAN)
    if topic is None and len(lasers) == 1:
        return lasers[0]
    if topic is not None and topic in lasers:
        return topic
    if lasers:
        wrong = f"no LaserScan topic {topic}" if topic else "several LaserScan topics"
        raise InputError(f"{path}: {wrong}; choose one with --topic: {', '.join(lasers)}")
    others = ", ".join(f"{name} ({kind})" for name, kind in sorted(topics.items())) or "none at all"
    raise InputError(f"{path}: no topic with {LASER_SCAN}; its topics: {others}")


def _scans(bag: Any, topic: str, path: Path, skipped: Counter[str]) -> Iterator[Scan]:
    connections = [connection for connection in bag.connections if connection.topic == topic]
    read = 0
    try:
        for connection, arrival, data in bag.messages(connections):
            try:
                scan = convert(bag.deserialize(data, connection.msgtype), arrival)
            except Exception:  # whatever the bytes of a damaged message lead to
                skipped["messages that cannot be read"] += 1
                continue
            yield scan
            read += 1
    except Exception as error:
        raise InputError(
            f"{path}: breaks off after {read} scans ({_reason(error)}); what came before is kept"
        ) from error
    finally:
        bag.close()


def convert(message: Any, arrival: int = 0) -> Scan:
    """Beams of a LaserScan message, whose angles count as ours do (REP 103); 0 is no return (REP 117).

    Args:
        message: of ``rosbags`` or of ROS 2.
        arrival: nanoseconds, in place of a stamp of 0.
    """
    ranges = np.asarray(message.ranges, dtype=np.float64)
    beam = np.arange(len(ranges))
    returned = (ranges >= message.range_min) & (ranges < message.range_max)
    stamp = message.header.stamp.sec + 1e-9 * message.header.stamp.nanosec
    return Scan(
        ranges=np.where(returned, ranges, 0.0),
        bearings=message.angle_min + message.angle_increment * beam,
        times=message.time_increment * beam if message.time_increment > 0 else None,
        stamp=stamp or 1e-9 * arrival,
        frame_id=message.header.frame_id,
    )
