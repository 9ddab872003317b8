"""Base class of ROS 1 bags and mcap files, whose messages are stored in chunks, compressed or not."""

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
"""Bytes of messages outside of chunks that are read together as one chunk."""
CUT_OFF, DAMAGED = "it ends within a record", "a record of it is damaged"

Message: TypeAlias = tuple[int, int, memoryview]
"""Time of arrival in nanoseconds, number of the connection, content."""


class BrokenBag(Exception):
    """A file of a bag is damaged or cut off; the message says why. What can be read was read before."""


class NoBag(Exception):
    """A file is not damaged, but is not a bag; the message says what it is."""


class Connection(NamedTuple):
    """A writer of messages of a topic.

    Attributes:
        topic: name of the topic.
        kind: type of the messages, for instance ``sensor_msgs/msg/LaserScan``; empty if unknown.
        encoding: encoding of the messages, ``ros1``, ``cdr`` or another one.
    """

    topic: str
    kind: str
    encoding: str


@dataclass
class Chunk:
    """A part of a file with messages.

    Attributes:
        position, length: bytes, of the content as it is stored in the file.
        packing: compression, for instance ``lz4``; empty or ``none``: not compressed.
        start: nanoseconds, arrival of the first message; None: not known yet.
        checksum: CRC-32 of the decompressed content; 0: unknown.
        is_whole: whether the file holds the whole chunk.
        counts: number of messages of each connection; empty: not known yet.
    """

    position: int
    length: int
    packing: str = ""
    start: int | None = None
    checksum: int = 0
    is_whole: bool = True
    counts: Counter[int] = field(default_factory=Counter)


class ChunkedFile(ABC):
    """A file of a bag whose messages are stored in chunks.

    No index at the end of the file is needed. The headers of all records are read once, without the data
    between them, so the messages of a file that was cut off can be read up to the cut.

    Args:
        path: path of the file, not compressed as a whole.

    Attributes:
        connections: the connections by their numbers.
        counts: number of messages of each connection.
        broken: why the file is cut off or damaged; empty if it is not.
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
                    self._index_chunk(file, chunk)
                self.counts.update(chunk.counts)

    def messages(self, wanted: set[int]) -> Iterator[Message]:
        """Yield the messages of some connections in the order of their arrival.

        Args:
            wanted: numbers of the connections.

        Raises:
            BrokenBag: the file is damaged; raised after the last message that can be read.
        """
        with self.path.open("rb") as file:
            chunks = [chunk for chunk in self._chunks if wanted & chunk.counts.keys()]
            yield from sort_messages(
                (chunk.start or 0, partial(self._messages_of, file, chunk, wanted)) for chunk in chunks
            )
        if self.broken:
            raise BrokenBag(self.broken)

    @abstractmethod
    def _read_outline(self, file: BinaryIO, size: int) -> None:
        """Find chunks and connections.

        Raises:
            BrokenBag: the file is damaged or cut off; what was found before is kept.
        """

    @abstractmethod
    def _parse(self, content: memoryview) -> Iterator[Message]:
        """Yield the messages of a chunk in its own order, and add its connections.

        Raises:
            BrokenBag: the chunk is damaged or cut off.
        """

    def _add_loose(self, position: int, length: int, connection: int, time: int) -> None:
        """Add a message record outside of chunks; records that follow each other are read as one chunk."""
        run = self._run
        if run is None or run.position + run.length != position or run.length > LONGEST_RUN:
            run = self._run = Chunk(position, 0, start=time)
            self._chunks.append(run)
        run.length += length
        run.start = min(time, time if run.start is None else run.start)
        run.counts[connection] += 1

    def _index_chunk(self, file: BinaryIO, chunk: Chunk) -> None:
        """Count the messages of a chunk without an index, and find the time of the first one."""
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


def sort_messages(chunks: Iterable[tuple[int, Callable[[], Iterable[Message]]]]) -> Iterator[Message]:
    """Sort the messages of chunks by time; only chunks that overlap in time are in memory together.

    Args:
        chunks: for each chunk, the time of its first message in nanoseconds, and a function that reads its
            messages.

    Raises:
        BrokenBag: a chunk cannot be read; raised after the messages before it.

    >>> chunks = [(5, lambda: [(5, 0, b"b")]), (1, lambda: [(1, 0, b"a"), (7, 0, b"c")])]
    >>> [content for _, _, content in sort_messages(chunks)]
    [b'a', b'b', b'c']
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
    """Read ``count`` bytes.

    Raises:
        BrokenBag: the file ends before.
    """
    content = file.read(count)
    if len(content) != count:
        raise BrokenBag(CUT_OFF)
    return content


def message_type(name: str) -> str:
    """Convert the name of a message type to that of ROS 2; ROS 1 has no ``msg`` in it.

    >>> message_type("sensor_msgs/LaserScan")
    'sensor_msgs/msg/LaserScan'
    """
    package, slash, rest = name.partition("/")
    return f"{package}/msg/{rest}" if slash and "/" not in rest else name


def _read_content(file: BinaryIO, chunk: Chunk) -> memoryview:
    """Read and decompress the content of a chunk; of a chunk that was cut off, the part that is there."""
    file.seek(chunk.position)
    content = _unpack(file.read(chunk.length), chunk.packing)
    if chunk.checksum and chunk.is_whole and zlib.crc32(content) != chunk.checksum:
        raise BrokenBag("a chunk of it is damaged: its checksum is wrong")
    return memoryview(content)


def _unpack(content: bytes, packing: str) -> bytes:
    if packing in ("", "none"):
        return content
    unpackers, errors = _unpackers()
    if packing not in unpackers:
        raise BrokenBag(f"its chunks are packed by {packing!r}, which is not supported")
    unpacked = []
    try:
        while content:  # it may consist of several compressed frames
            unpacker = unpackers[packing]()
            unpacked.append(unpacker.decompress(content))
            content = unpacker.unused_data or b""
    except errors as error:
        raise BrokenBag(f"a chunk of it cannot be unpacked by {packing}") from error
    return b"".join(unpacked)


def _unpackers() -> tuple[dict[str, Callable[[], Any]], tuple[type[Exception], ...]]:
    """Decompressors by name, which also read the beginning of data that was cut off; and their errors."""
    import lz4.frame

    zstd = import_zstd()
    unpackers = {
        "bz2": bz2.BZ2Decompressor,
        "lz4": lz4.frame.LZ4FrameDecompressor,
        "zstd": zstd.ZstdDecompressor,
    }
    return unpackers, (OSError, RuntimeError, ValueError, EOFError, zstd.ZstdError)
