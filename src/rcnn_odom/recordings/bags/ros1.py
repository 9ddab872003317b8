"""Reads ROS 1 bags, version 2.0 of the format (http://wiki.ros.org/Bags/Format/2.0)."""

import struct
from collections.abc import Iterator
from os import SEEK_END
from typing import BinaryIO

import numpy as np

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

MESSAGE, BAG_HEADER, INDEX, CHUNK, CONNECTION = (bytes([op]) for op in (2, 3, 4, 5, 7))
INDEX_ENTRY = 12
LONGEST_HEADER = 1 << 20
"""Bytes; a longer header is taken to be damaged."""
UINT32, TIME = struct.Struct("<L"), struct.Struct("<LL")

Fields = dict[bytes, bytes]


class Ros1File(ChunkedFile):
    """A bag of ROS 1; see :class:`ChunkedFile`. The message definitions in it are not used."""

    def _read_outline(self, file: BinaryIO, size: int) -> None:
        self._index_position = 0
        position = len(file.readline(32))
        while position < size:
            file.seek(position)
            fields, length = _read_head(file)
            op, data = fields.get(b"op"), file.tell()
            if op is None:
                raise BrokenBag(DAMAGED)
            if op == INDEX:  # writers of 2010 give a length that is too large
                length = INDEX_ENTRY * _get_number(fields, b"count")
            is_whole = data + length <= size
            if not is_whole and op != CHUNK:
                raise BrokenBag(CUT_OFF)
            if op == MESSAGE:  # it is in a chunk that was not closed
                self._add_loose(
                    position, data + length - position, _get_number(fields, b"conn"), _get_time(fields)
                )
            else:
                self._read_record(op, fields, file, length, is_whole)
            position = data + length
        if not self._index_position:
            raise BrokenBag("its recording was not closed")
        if self._index_position > size:
            raise BrokenBag("its end is missing")

    def _read_record(self, op: bytes, fields: Fields, file: BinaryIO, length: int, is_whole: bool) -> None:
        """Read a record; the file is at the record's data. Records of other kinds are skipped."""
        if op == BAG_HEADER:
            self._index_position = int.from_bytes(fields.get(b"index_pos", b""), "little")
            if fields.get(b"encryptor"):
                raise BrokenBag("it is encrypted")
        elif op == CHUNK:
            packing = fields.get(b"compression", b"").decode(errors="replace")
            chunk = Chunk(file.tell(), length, packing, is_whole=is_whole)
            self._chunks.append(chunk)
            if not is_whole:
                chunk.length = file.seek(0, SEEK_END) - chunk.position
                raise BrokenBag("it ends within a chunk")
        elif op == INDEX and length and self._chunks:
            self._add_index(fields, read_exactly(file, length))
        elif op == CONNECTION:
            self._add_connection(fields, read_exactly(file, length))

    def _parse(self, content: memoryview) -> Iterator[Message]:
        position = 0
        while position < len(content):
            try:
                start = position + 4 + UINT32.unpack_from(content, position)[0]
                data = start + 4
                end = data + UINT32.unpack_from(content, start)[0]
            except struct.error as error:
                raise BrokenBag(CUT_OFF) from error
            if end > len(content):
                raise BrokenBag(CUT_OFF)
            fields = read_fields(content[position + 4 : start])
            if fields.get(b"op") == MESSAGE:
                yield _get_time(fields), _get_number(fields, b"conn"), content[data:end]
            elif fields.get(b"op") == CONNECTION:
                self._add_connection(fields, content[data:end])
            position = end

    def _add_index(self, fields: Fields, entries: bytes) -> None:
        chunk = self._chunks[-1]
        times = np.frombuffer(entries, "<u4").reshape(-1, INDEX_ENTRY // 4).astype(np.uint64)
        first = int((times[:, 0] * 10**9 + times[:, 1]).min())
        chunk.start = first if chunk.start is None else min(first, chunk.start)
        chunk.counts[_get_number(fields, b"conn")] += len(entries) // INDEX_ENTRY

    def _add_connection(self, fields: Fields, data: bytes | memoryview) -> None:
        about = read_fields(data)
        self.connections[_get_number(fields, b"conn")] = Connection(
            topic=fields.get(b"topic", b"").decode(errors="replace"),
            kind=message_type(about.get(b"type", b"").decode(errors="replace")),
            encoding="ros1",
        )


def read_fields(header: bytes | memoryview) -> Fields:
    """Parse the fields ``name=value`` of a record's header, up to the first damaged field.

    >>> read_fields(bytes([4, 0, 0, 0]) + b"op=!")
    {b'op': b'!'}
    """
    fields: Fields = {}
    content, position = bytes(header), 0
    while position + 4 <= len(content):
        start = position + 4
        position = start + UINT32.unpack_from(content, position)[0]
        name, equals, value = content[start:position].partition(b"=")
        if not equals or position > len(content):
            break
        fields[name] = value
    return fields


def _read_head(file: BinaryIO) -> tuple[Fields, int]:
    """Read the header of a record; returns its fields and the length of the data that follow."""
    (length,) = UINT32.unpack(read_exactly(file, 4))
    if length > LONGEST_HEADER:
        raise BrokenBag(DAMAGED)
    return read_fields(read_exactly(file, length)), UINT32.unpack(read_exactly(file, 4))[0]


def _get_number(fields: Fields, name: bytes) -> int:
    try:
        return int(UINT32.unpack(fields[name])[0])
    except (KeyError, struct.error) as error:
        raise BrokenBag(DAMAGED) from error


def _get_time(fields: Fields) -> int:
    try:
        seconds, nanoseconds = TIME.unpack(fields[b"time"])
    except (KeyError, struct.error) as error:
        raise BrokenBag(DAMAGED) from error
    return int(seconds) * 10**9 + int(nanoseconds)
