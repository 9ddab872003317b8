"""Decodes messages of a bag with ROS's own message definitions, and finds their stamps."""

from collections import Counter
from collections.abc import Callable, Iterator
from functools import cache
from typing import Any

from rcnn_odom.recordings.bags.chunks import BrokenBag
from rcnn_odom.recordings.bags.files import Bag
from rcnn_odom.recordings.bags.topics import TRANSFORMS, short_name
from rcnn_odom.recordings.packing import import_zstd

ZSTD = b"\x28\xb5\x2f\xfd"
"""First bytes of a message that ROS 2 compressed on its own."""


def header_stamp(message: Any) -> float:
    """Stamp of a message's header in seconds; 0 if it was not set."""
    return float(message.header.stamp.sec + 1e-9 * message.header.stamp.nanosec)


class Clock:
    """Gives the stamps of a topic: those of the headers, or times of arrival if the first header has none.

    The two are never mixed, because they may come from clocks that differ.
    """

    def __init__(self) -> None:
        self._has_headers: bool | None = None

    def stamp(self, message: Any, arrival: int) -> float | None:
        """Stamp of the next message in seconds; None if headers have stamps, but this one has none."""
        stamp = header_stamp(message)
        if self._has_headers is None:
            self._has_headers = stamp != 0
        return (stamp or None) if self._has_headers else 1e-9 * arrival


def read_known(bag: Bag, topic: str, kind: str, unreadable: Counter[str]) -> Iterator[tuple[Any, int]]:
    """Yield the messages of a topic and their times of arrival in nanoseconds.

    If the bag is cut off or damaged, the iteration ends there; the reader of the scans reports it.

    Args:
        bag: bag to read from.
        topic: name of the topic.
        kind: type of its messages.
        unreadable: counts the messages that cannot be decoded, by topic.
    """
    try:
        for encoding, arrival, content in bag.messages(topic, kind):
            try:
                yield deserialize(content, encoding, kind), arrival
            except ValueError:
                unreadable[topic] += 1
    except (BrokenBag, OSError):
        return


def deserialize(content: memoryview, encoding: str, kind: str) -> Any:
    """Decode a message.

    Args:
        content: bytes of the message.
        encoding: ``cdr`` or ``ros1``.
        kind: type of the message, one of ROS's own.

    Raises:
        ValueError: the bytes are not such a message, or the encoding is another one.
    """
    if encoding not in ("cdr", "ros1"):
        raise ValueError(f"it is in {encoding}, not in cdr or ros1")
    if encoding == "cdr" and content[:4] == ZSTD:
        content = _unpack(content)
    try:
        return _deserializer(encoding)(content, kind)
    except Exception as error:  # a damaged message can cause any exception
        raise ValueError(f"its {len(content)} bytes are not a {short_name(kind)}") from error


def _unpack(content: memoryview) -> memoryview:
    zstd = import_zstd()
    try:
        return memoryview(zstd.decompress(content))
    except zstd.ZstdError as error:
        raise ValueError("it cannot be unpacked by zstd") from error


@cache
def _deserializer(encoding: str) -> Callable[[memoryview, str], Any]:
    from rosbags.typesys import Stores, get_types_from_msg, get_typestore

    if encoding == "cdr":
        return get_typestore(Stores.LATEST).deserialize_cdr
    store = get_typestore(Stores.ROS1_NOETIC)  # here a header has a sequence number
    # This store only has the types of ROS 1's core, without the message for transforms.
    store.register(get_types_from_msg("geometry_msgs/TransformStamped[] transforms", TRANSFORMS))
    return store.deserialize_ros1
