"""Reads text files: decompressed, decoded, and without the byte order mark that some programs write."""

import codecs
import io
from collections.abc import Iterator
from pathlib import Path

from rcnn_odom.errors import InputError
from rcnn_odom.recordings.packing import HEAD, open_unpacked, read_head, unpacking_errors

MARK = "\ufeff"
"""The byte order mark. It is removed from the start of each line, because files may have been joined."""


def need_text(path: Path) -> bytes:
    """The first bytes of a text file after decompression, without a byte order mark.

    Raises:
        InputError: the file cannot be read or decompressed, is empty, or is text in UTF-16 or UTF-32.
    """
    head = read_head(path)
    refuse_utf16(path, head)
    head = head.removeprefix(codecs.BOM_UTF8)
    if len(head) < HEAD // 2 and not head.strip():
        raise InputError(f"{path}: is empty; give a recording with scans in it")
    return head


def refuse_utf16(path: str | Path, head: bytes) -> None:
    """Check that a text is not in UTF-16 or UTF-32, because it is read as UTF-8.

    Args:
        path: path of the file, for the error.
        head: first bytes of the file.

    Raises:
        InputError: the first bytes are text in UTF-16 or UTF-32.
    """
    marked = head.startswith((codecs.BOM_UTF16_LE, codecs.BOM_UTF16_BE)) and b"\0" in head
    every_other_is_zero = any(head) and (not any(head[::2]) or not any(head[1::2]))
    # The mark of UTF-32 begins with that of UTF-16. In UTF-32, most characters have two zeros in the middle.
    if head.startswith((codecs.BOM_UTF32_LE, codecs.BOM_UTF32_BE)) or (
        len(head) > 3 and any(head) and not any(head[1::4] + head[2::4])
    ):
        raise InputError(f"{path}: is text in UTF-32; save it as UTF-8")
    if marked or (len(head) > 3 and every_other_is_zero):
        raise InputError(f"{path}: is text in UTF-16; save it as UTF-8")


def lines_of(path: Path) -> Iterator[tuple[int, str]]:
    """Yield the numbers (from 1 on) and texts of the lines of a file, which may be compressed.

    Raises:
        InputError: the file cannot be read or decompressed to its end.
    """
    with open_unpacked(path) as file:
        try:
            # An invalid byte becomes a replacement character; the parser then reports its line.
            text = io.TextIOWrapper(file, encoding="utf-8", errors="replace")
            for number, line in enumerate(text, start=1):
                yield number, line.lstrip(MARK)
        except unpacking_errors() as error:
            raise InputError(f"{path}: cannot be read to its end ({error}); download it again") from error
