"""What ROS 1 bags and mcap files have in common: their messages lie in chunks, packed or not."""

import bz2
import heapq
import zlib
from abc import ABC, abstractmethod
from collections import Counter
from collections.abc import Callable, Iterable, Iterator
from dataclasses import dataclass, field
from functools import partial
from itertools import count
from operator import itemgetter
from pathlib import Path
from typing import Any, BinaryIO, NamedTuple, TypeAlias

from rcnn_odom.recordings.packing import import_zstd

LONGEST_RUN = 1 << 20
"""Bytes of messages outside of chunks that are read at once."""
CUT_OFF, DAMAGED = "it ends within a record", "a record of it is damaged"

Message: TypeAlias = tuple[int, int, memoryview]
"""Time of arrival in nanoseconds, number of the connection, content."""


class BrokenBag(Exception):
    """A file of a bag is damaged or ends too early; what came before was given. Says why, in words."""


class NoBag(Exception):
    """A file is whole, but of something else. Says of what, in words."""


class Connection(NamedTuple):
    """Who writes the messages of a topic.

    Attributes:
        topic: its name.
        kind: type of the messages, for instance ``sensor_msgs/msg/LaserScan``; empty if unknown.
        encoding: of the messages, ``ros1`` or ``cdr`` or another.
    """

    topic: str
    kind: str
    encoding: str


@dataclass
class Chunk:
    """Where messages lie in a file.

    Attributes:
        position, length: in bytes, of the content as it lies in the file.
        packing: ``lz4`` for instance; empty or ``none``: not packed.
        start: nanoseconds, arrival of its first message; None: not known yet.
        checksum: CRC-32 of the unpacked content, 0 if unknown.
        is_whole: the file does not end within it.
        counts: messages of each connection; empty: not known yet.
    """

    position: int
    length: int
    packing: str = ""
    start: int | None = None
    checksum: int = 0
    is_whole: bool = True
    counts: Counter[int] = field(default_factory=Counter)


class ChunkedFile(ABC):
    """A file of a bag whose messages lie in chunks.

    An index at the end is not needed: the whole file is gone through once, and what lies between the heads of
    records is passed over, so that a file that breaks off gives what is there.

    Args:
        path: of the file, not packed itself.

    Attributes:
        connections: by their numbers.
        counts: messages of each connection.
        broken: why the file ends too early, in words; empty where it does not.
    """

    def __init__(self, path: Path) -> None:
        self.path, self.broken = path, ""
        self.connections: dict[int, Connection] = {}
        self.counts: Counter[int] = Counter()
        self._chunks: list[Chunk] = []
        self._run: Chunk | None = None
        with path.open("rb") as file:
            try:
                self._read_outline(file, path.stat().st_size)
            except BrokenBag as error:
                self.broken = str(error)
                for chunk in self._chunks[-1:]:
                    chunk.counts.clear()  # its index may be cut off
            for chunk in self._chunks:
                if not chunk.counts or not chunk.counts.keys() <= self.connections.keys():
                    self._look_into(file, chunk)
                self.counts.update(chunk.counts)

    def messages(self, wanted: set[int]) -> Iterator[Message]:
        """The messages of some connections in the order of their arrival.

        Raises:
            BrokenBag: the file is damaged; after the last message that can be read.
        """
        with self.path.open("rb") as file:
            chunks = [chunk for chunk in self._chunks if wanted & chunk.counts.keys()]
            yield from in_order(
                (chunk.start or 0, partial(self._messages_of, file, chunk, wanted)) for chunk in chunks
            )
        if self.broken:
            raise BrokenBag(self.broken)

    @abstractmethod
    def _read_outline(self, file: BinaryIO, size: int) -> None:
        """Finds chunks and connections; raises BrokenBag where the file is damaged."""

    @abstractmethod
    def _parse(self, content: memoryview) -> Iterator[Message]:
        """The messages in a chunk, in its order; adds its connections. Raises BrokenBag where damaged."""

    def _add_loose(self, position: int, length: int, connection: int, time: int) -> None:
        """A message record outside of chunks; such that follow each other are read as one chunk."""
        run = self._run
        if run is None or run.position + run.length != position or run.length > LONGEST_RUN:
            run = self._run = Chunk(position, 0, start=time)
            self._chunks.append(run)
        run.length += length
        run.start = min(time, time if run.start is None else run.start)
        run.counts[connection] += 1

    def _look_into(self, file: BinaryIO, chunk: Chunk) -> None:
        """Learns from a chunk's content what no index says."""
        chunk.counts, chunk.start = Counter(), None
        try:
            for time, connection, _ in self._parse(_read_content(file, chunk)):
                chunk.counts[connection] += 1
                chunk.start = time if chunk.start is None else min(time, chunk.start)
        except BrokenBag as error:
            self.broken = self.broken or str(error)

    def _messages_of(self, file: BinaryIO, chunk: Chunk, wanted: set[int]) -> Iterator[Message]:
        for message in self._parse(_read_content(file, chunk)):
            if message[1] in wanted:
                yield message


def in_order(chunks: Iterable[tuple[int, Callable[[], Iterable[Message]]]]) -> Iterator[Message]:
    """The messages of chunks in the order of time; only chunks that overlap are in memory together.

    Args:
        chunks: nanoseconds of the first message, and what reads them all.

    Raises:
        BrokenBag: one could not be read; after the messages that came before.
    """
    pending: list[tuple[int, int, Message]] = []
    in_file = count()
    broken = None
    for start, read in sorted(chunks, key=itemgetter(0)):
        while pending and pending[0][0] <= start:
            yield heapq.heappop(pending)[2]
        try:
            for message in read():
                heapq.heappush(pending, (message[0], next(in_file), message))
        except BrokenBag as error:
            broken = error
            break
    while pending:
        yield heapq.heappop(pending)[2]
    if broken:
        raise broken


def read_exactly(file: BinaryIO, count: int) -> bytes:
    """So many bytes.

    Raises:
        BrokenBag: the file ends before.
    """
    content = file.read(count)
    if len(content) != count:
        raise BrokenBag(CUT_OFF)
    return content


def message_type(name: str) -> str:
    """The name of a message type as ROS 2 has it: ``sensor_msgs/msg/LaserScan`` for ROS 1's without ``msg``.

    >>> message_type("sensor_msgs/LaserScan")
    'sensor_msgs/msg/LaserScan'
    """
    package, slash, rest = name.partition("/")
    return f"{package}/msg/{rest}" if slash and "/" not in rest else name


def _read_content(file: BinaryIO, chunk: Chunk) -> memoryview:
    """What is in a chunk, unpacked; of one that the file ends in, what is there."""
    file.seek(chunk.position)
    content = _unpack(file.read(chunk.length), chunk.packing)
    if chunk.checksum and chunk.is_whole and zlib.crc32(content) != chunk.checksum:
        raise BrokenBag("a chunk of it is damaged, as its checksum says")
    return memoryview(content)


def _unpack(content: bytes, packing: str) -> bytes:
    if packing in ("", "none"):
        return content
    unpackers, errors = _unpackers()
    if packing not in unpackers:
        raise BrokenBag(f"its chunks are packed by {packing!r}, which is not known here")
    unpacked = []
    try:
        while content:  # which may be of several frames
            unpacker = unpackers[packing]()
            unpacked.append(unpacker.decompress(content))
            content = unpacker.unused_data or b""
    except errors as error:
        raise BrokenBag(f"a chunk of it cannot be unpacked by {packing}") from error
    return b"".join(unpacked)


def _unpackers() -> tuple[dict[str, Callable[[], Any]], tuple[type[Exception], ...]]:
    """What unpacks piece by piece, and so the beginning of what was cut off; and what they raise."""
    import lz4.frame

    zstd = import_zstd()
    unpackers = {
        "bz2": bz2.BZ2Decompressor,
        "lz4": lz4.frame.LZ4FrameDecompressor,
        "zstd": zstd.ZstdDecompressor,
    }
    return unpackers, (OSError, RuntimeError, ValueError, EOFError, zstd.ZstdError)
