"""Chooses the topics of a bag that hold the scans and the odometry."""

from pathlib import Path
from typing import NamedTuple

from rcnn_odom.errors import InputError
from rcnn_odom.recordings.bags.files import REPAIR_ADVICE, Bag

LASER_SCAN, POINT_CLOUD = "sensor_msgs/msg/LaserScan", "sensor_msgs/msg/PointCloud2"
ODOMETRY, TRANSFORMS = "nav_msgs/msg/Odometry", "tf2_msgs/msg/TFMessage"


class Topic(NamedTuple):
    """A topic of a bag.

    Attributes:
        name: name of the topic.
        kind: type of its messages.
        messages: number of its messages.
    """

    name: str
    kind: str
    messages: int


def choose_topic(path: Path, bag: Bag, wanted: str | None) -> Topic:
    """Choose the topic with the scans.

    Args:
        path: path of the bag, for errors.
        bag: the bag.
        wanted: name of the topic, with or without its first slash; None: the only topic with LaserScan
            messages, or, if there is none, the only one with PointCloud2 messages. Topics without a message
            are ignored if others have messages.

    Raises:
        InputError: there is no such topic, there are several, or the encoding of its messages is not ROS's.
    """
    topics = _list_topics(bag)
    lasers = [topic for topic in topics if topic.kind == LASER_SCAN]
    clouds = [topic for topic in topics if topic.kind == POINT_CLOUD]
    if wanted is not None:
        found = [topic for topic in lasers + clouds if _is_called(topic, wanted)]
        found = sorted(found, key=lambda topic: topic.name != wanted)[:1]
    else:
        written = [[topic for topic in some if topic.messages] for some in (lasers, clouds)]
        found = written[0] or written[1] or lasers or clouds
    if len(found) != 1:
        raise _choice_error(path, bag, lasers, clouds, wanted, several=found)
    _need_known_encoding(path, bag, found[0])
    return found[0]


def choose_odometry(path: Path, bag: Bag, wanted: str) -> str:
    """Find the topic of the robot's own odometry; returns its name as in the bag.

    Args:
        path: path of the bag, for errors.
        bag: the bag.
        wanted: name of the topic, with or without its first slash.

    Raises:
        InputError: there is no topic of this name, or its messages are of another type.
    """
    topics = [topic for topic in _list_topics(bag) if _is_called(topic, wanted)]
    found = [topic for topic in topics if topic.kind == ODOMETRY]
    if found:
        return found[0].name
    names = ", ".join(topic.name for topic in _list_topics(bag) if topic.kind == ODOMETRY)
    wrong = f"{wanted} holds {topics[0].kind or 'messages of no type'}" if topics else f"no topic {wanted}"
    advice = f"choose one with --odom-topic: {names}" if names else f"it has none with {ODOMETRY}"
    raise InputError(f"{path}: {wrong}; {advice}, or leave --odom-topic out")


def _list_topics(bag: Bag) -> list[Topic]:
    return [
        Topic(name, kind, count)
        for name, kinds in sorted(bag.topics.items())
        for kind, count in sorted(kinds.items())
    ]


def _is_called(topic: Topic, name: str) -> bool:
    return topic.name.strip("/") == name.strip("/")


def _choice_error(
    path: Path, bag: Bag, lasers: list[Topic], clouds: list[Topic], wanted: str | None, several: list[Topic]
) -> InputError:
    """The error if there is not exactly one topic to read."""
    topics = _list_topics(bag)
    if not lasers and not clouds:
        if bag.broken:
            return InputError(f"{path}: breaks off before any scan ({bag.broken}); {REPAIR_ADVICE}")
        others = ", ".join(f"{topic.name} ({topic.kind or 'no type'})" for topic in topics) or "none at all"
        return InputError(f"{path}: no topic with {LASER_SCAN} or {POINT_CLOUD}; its topics: {others}")
    kinds = [topic.kind for topic in topics if wanted and _is_called(topic, wanted)]
    if kinds:
        wrong = f"{wanted} holds {kinds[0] or 'messages of no type'}, which is not a scan"
    elif wanted is not None:
        wrong = f"no topic {wanted}"
    else:
        wrong = f"several {short_name(several[0].kind)} topics"
    choice = " and ".join(_name_all(some) for some in (lasers, clouds) if some)
    return InputError(f"{path}: {wrong}; choose one with --topic: {choice}")


def _name_all(topics: list[Topic]) -> str:
    return f"{', '.join(topic.name for topic in topics)} ({short_name(topics[0].kind)})"


def short_name(kind: str) -> str:
    """The last part of a message type's name.

    >>> short_name(LASER_SCAN)
    'LaserScan'
    """
    return kind.rpartition("/")[2]


def _need_known_encoding(path: Path, bag: Bag, topic: Topic) -> None:
    encodings = bag.encodings(topic.name, topic.kind)
    if encodings.isdisjoint(("cdr", "ros1")):
        raise InputError(
            f"{path}: the messages of {topic.name} are in {', '.join(sorted(encodings))}, not in ROS's own "
            "cdr or ros1; convert the bag to one of them"
        )
