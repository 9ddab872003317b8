"""Reads files in the format mcap (https://mcap.dev/spec), of ROS 2 or of ROS 1.

The package ``mcap`` is not used, because it rejects a whole file if one string of any topic is damaged, and
cannot read a chunk that was cut off.
"""

import struct
from collections.abc import Iterator
from typing import BinaryIO

from rcnn_odom.recordings.bags.chunks import (
    CUT_OFF,
    DAMAGED,
    BrokenBag,
    Chunk,
    ChunkedFile,
    Connection,
    Message,
    message_type,
    read_exactly,
)

MAGIC = b"\x89MCAP0\r\n"
FOOTER, SCHEMA, CHANNEL, MESSAGE, CHUNK, MESSAGE_INDEX = 2, 3, 4, 5, 6, 7
HEAD = struct.Struct("<BQ")  # kind of record, length
MESSAGE_HEAD = struct.Struct("<HLQQ")  # channel, sequence, time of arrival, time of sending
CHUNK_HEAD = struct.Struct("<QQQLL")  # first and last time, length and CRC-32 unpacked, length of packing
INDEX_HEAD, INDEX_ENTRY = struct.Struct("<HL"), 16
UINT16, UINT32, UINT64 = struct.Struct("<H"), struct.Struct("<L"), struct.Struct("<Q")
LONGEST_NAME = 64
"""Bytes of the name of a compression; a longer name is taken to be damaged."""


class McapFile(ChunkedFile):
    """A file in mcap; see :class:`ChunkedFile`. The message definitions in its schemas are not used."""

    def _read_outline(self, file: BinaryIO, size: int) -> None:
        self._kinds: dict[int, str] = {}
        position = len(MAGIC)
        while True:
            file.seek(position)
            kind, length = HEAD.unpack(read_exactly(file, HEAD.size))
            end = position + HEAD.size + length
            if kind == FOOTER:
                _check_end(file, end)
                return
            if kind == 0:  # zeros, which a computer leaves when it loses power
                raise BrokenBag(DAMAGED)
            if kind == CHUNK:
                self._add_chunk(file, end, size)
            elif end > size:
                raise BrokenBag(CUT_OFF)
            elif kind == MESSAGE_INDEX and self._chunks:
                channel, entries = INDEX_HEAD.unpack(read_exactly(file, INDEX_HEAD.size))
                if entries >= INDEX_ENTRY:
                    self._chunks[-1].counts[channel] += entries // INDEX_ENTRY
            elif kind == MESSAGE:
                channel, _, time, _ = MESSAGE_HEAD.unpack(read_exactly(file, MESSAGE_HEAD.size))
                self._add_loose(position, end - position, channel, time)
            elif kind in (SCHEMA, CHANNEL):
                self._add_definition(kind, memoryview(read_exactly(file, length)))
            position = end

    def _add_chunk(self, file: BinaryIO, end: int, size: int) -> None:
        start, _, _, checksum, name_length = CHUNK_HEAD.unpack(read_exactly(file, CHUNK_HEAD.size))
        if name_length > LONGEST_NAME:
            raise BrokenBag(DAMAGED)
        packing = read_exactly(file, name_length).decode(errors="replace")
        (length,) = UINT64.unpack(read_exactly(file, UINT64.size))
        whole = file.tell() + length <= end <= size
        length = min(length, size - file.tell())
        self._chunks.append(Chunk(file.tell(), length, packing, start, checksum, whole))
        if not whole:
            raise BrokenBag("it ends within a chunk")

    def _parse(self, content: memoryview) -> Iterator[Message]:
        position = 0
        while position < len(content):
            start = position + HEAD.size
            if start > len(content):
                raise BrokenBag(CUT_OFF)
            kind, length = HEAD.unpack_from(content, position)
            position = start + length
            if position > len(content):
                raise BrokenBag(CUT_OFF)
            if kind == MESSAGE:
                data = start + MESSAGE_HEAD.size
                if data > position:
                    raise BrokenBag(DAMAGED)
                channel, _, time, _ = MESSAGE_HEAD.unpack_from(content, start)
                yield time, channel, content[data:position]
            elif kind in (SCHEMA, CHANNEL):
                self._add_definition(kind, content[start:position])

    def _add_definition(self, kind: int, record: memoryview) -> None:
        """Add a schema or a channel; a damaged one is ignored."""
        try:
            (number,) = UINT16.unpack_from(record, 0)
            if kind == SCHEMA:
                self._kinds[number] = message_type(_read_string(record, 2)[0])
                return
            (schema,) = UINT16.unpack_from(record, 2)
            topic, after = _read_string(record, 4)
            encoding, _ = _read_string(record, after)
        except struct.error:
            return
        encoding = (encoding or "cdr").lower()
        self.connections[number] = Connection(topic, self._kinds.get(schema, ""), encoding)


def _check_end(file: BinaryIO, position: int) -> None:
    """Check that only the end of the file follows the footer, unlike in files that were joined.

    Raises:
        BrokenBag: something else follows.
    """
    file.seek(position)
    if read_exactly(file, len(MAGIC)) != MAGIC:
        raise BrokenBag(DAMAGED)
    if file.read(1):
        raise BrokenBag("something follows after its end, as if files had been joined")


def _read_string(record: memoryview, position: int) -> tuple[str, int]:
    """Read a string of a record; returns it and the position after it."""
    start = position + UINT32.size
    end = start + UINT32.unpack_from(record, position)[0]
    return bytes(record[start:end]).decode(errors="replace"), end
