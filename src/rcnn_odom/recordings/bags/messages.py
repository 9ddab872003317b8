"""Messages of a bag out of their bytes, by the types that ROS itself has; and the stamps of a topic."""

from collections import Counter
from collections.abc import Callable, Iterator
from functools import cache
from typing import Any

from rcnn_odom.recordings.bags.chunks import BrokenBag
from rcnn_odom.recordings.bags.files import Bag
from rcnn_odom.recordings.bags.topics import TRANSFORMS, short_name
from rcnn_odom.recordings.packing import import_zstd

ZSTD = b"\x28\xb5\x2f\xfd"
"""First bytes of a message that ROS 2 packed by itself."""


def header_stamp(message: Any) -> float:
    """Seconds; 0 where the header has none."""
    return float(message.header.stamp.sec + 1e-9 * message.header.stamp.nanosec)


class Clock:
    """The stamps of a topic: of the headers, or the times of arrival where the first header has none.

    The two are not mixed, since they may be of clocks that know nothing of each other.
    """

    def __init__(self) -> None:
        self._has_headers: bool | None = None

    def stamp(self, message: Any, arrival: int) -> float | None:
        """Seconds; None where the header of a single message has no time."""
        stamp = header_stamp(message)
        if self._has_headers is None:
            self._has_headers = stamp != 0
        return (stamp or None) if self._has_headers else 1e-9 * arrival


def read_known(bag: Bag, topic: str, kind: str, unreadable: Counter[str]) -> Iterator[tuple[Any, int]]:
    """The messages of a topic beside the scans, and their nanoseconds of arrival; counts those that are none.

    That a bag breaks off is told where its scans are read.
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
    """A message of a type of ROS out of its bytes.

    Raises:
        ValueError: they are none.
    """
    if encoding not in ("cdr", "ros1"):
        raise ValueError(f"it is in {encoding}, not in cdr or ros1")
    if encoding == "cdr" and content[:4] == ZSTD:
        content = _unpack(content)
    try:
        return _deserializer(encoding)(content, kind)
    except Exception as error:  # whatever the bytes of a damaged message lead to
        raise ValueError(f"its {len(content)} bytes are no {short_name(kind)}") from error


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
    store = get_typestore(Stores.ROS1_NOETIC)  # where a header has a sequence number
    # Its types are those of ROS 1's core, of which the transforms' message is none.
    store.register(get_types_from_msg("geometry_msgs/TransformStamped[] transforms", TRANSFORMS))
    return store.deserialize_ros1
