"""Text of recordings: unpacked and decoded, without the byte order mark that some programs begin it with."""

import codecs
import io
from collections.abc import Iterator
from pathlib import Path

from rcnn_odom.errors import InputError
from rcnn_odom.recordings.packing import HEAD, open_unpacked, read_head, unpacking_errors

MARK = "\ufeff"
"""The byte order mark. It is skipped at the start of any line, since files are also joined together."""


def need_text(path: Path) -> bytes:
    """The first bytes of a text file, unpacked and without a byte order mark.

    Raises:
        InputError: it cannot be read or unpacked, is empty, or is text in UTF-16 or UTF-32.
    """
    head = read_head(path)
    refuse_utf16(path, head)
    head = head.removeprefix(codecs.BOM_UTF8)
    if len(head) < HEAD // 2 and not head.strip():
        raise InputError(f"{path}: is empty; give a recording with scans in it")
    return head


def refuse_utf16(path: str | Path, head: bytes) -> None:
    """Refuses a text in UTF-16 or UTF-32, of which a reader of UTF-8 understands no word.

    Raises:
        InputError: the first bytes of the file are such a text.
    """
    marked = head.startswith((codecs.BOM_UTF16_LE, codecs.BOM_UTF16_BE)) and b"\0" in head
    every_other_is_zero = any(head) and (not any(head[::2]) or not any(head[1::2]))
    # The mark of UTF-16 also begins that of UTF-32, whose letters leave two bytes in the middle at zero.
    if head.startswith((codecs.BOM_UTF32_LE, codecs.BOM_UTF32_BE)) or (
        len(head) > 3 and any(head) and not any(head[1::4] + head[2::4])
    ):
        raise InputError(f"{path}: is text in UTF-32; save it as UTF-8")
    if marked or (len(head) > 3 and every_other_is_zero):
        raise InputError(f"{path}: is text in UTF-16; save it as UTF-8")


def lines_of(path: Path) -> Iterator[tuple[int, str]]:
    """The lines of a text file, unpacked, and their numbers from 1 on.

    Raises:
        InputError: it cannot be read or unpacked to its end.
    """
    with open_unpacked(path) as file:
        try:
            # A byte that is no text becomes a character that is no number, and then an error with its line.
            text = io.TextIOWrapper(file, encoding="utf-8", errors="replace")
            for number, line in enumerate(text, start=1):
                yield number, line.lstrip(MARK)
        except unpacking_errors() as error:
            raise InputError(f"{path}: cannot be read to its end ({error}); download it again") from error
