"""Files by their first bytes: packed ones are unpacked, and what a file is does not depend on its name."""

import bz2
import gzip
import lzma
import shutil
import sys
import zlib
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from importlib import import_module
from pathlib import Path
from tempfile import TemporaryDirectory
from typing import Any, BinaryIO, cast

from rcnn_odom.errors import InputError

HEAD = 4096
"""Bytes that tell what a file is."""
LFS_POINTER = b"version https://git-lfs.github.com/spec/"
ARCHIVES = {
    b"PK\x03\x04": "a zip archive",
    b"7z\xbc\xaf\x27\x1c": "a 7z archive",
    b"Rar!\x1a\x07": "a rar archive",
}


def _open_zstd(path: Path) -> BinaryIO:
    return cast(BinaryIO, import_zstd().open(path, "rb"))


def import_zstd() -> Any:
    """The module of Python 3.14, or its backport; unlike others they tell where a file was cut off."""
    return import_module("compression.zstd" if sys.version_info >= (3, 14) else "backports.zstd")


PACKINGS: dict[bytes, Callable[..., Any]] = {
    b"\x1f\x8b": gzip.open,
    b"BZh": bz2.open,
    b"\xfd7zXZ\x00": lzma.open,
    b"\x28\xb5\x2f\xfd": _open_zstd,
}
"""First bytes of packed files, and what opens them for reading bytes."""


def is_packed(path: Path) -> bool:
    """Whether a file is packed by gzip, bzip2, xz or zstd."""
    return _packing(_first_bytes(path)) is not None


def open_unpacked(path: Path) -> BinaryIO:
    """What a file holds, unpacked while it is read.

    Reading a packed file that is damaged or cut off raises one of :func:`unpacking_errors`.

    Raises:
        InputError: it cannot be read, or is an archive of files or a pointer of Git LFS.
    """
    head = _first_bytes(path)
    refuse_pointer(path, head)
    for magic, kind in ARCHIVES.items():
        if head.startswith(magic):
            raise InputError(f"{path}: is {kind}; unpack it and give the recording in it")
    try:
        file: BinaryIO = (_packing(head) or _open_plain)(path)
        return file
    except OSError as error:
        raise InputError(f"{path}: cannot be read ({error.strerror}); give another file") from error


def refuse_pointer(path: str | Path, head: bytes) -> None:
    """Refuses what Git LFS leaves in place of a large file that it has not fetched.

    Raises:
        InputError: the first bytes of the file are those of such a pointer.
    """
    if head.startswith(LFS_POINTER):
        raise InputError(f"{path}: is a pointer of Git LFS, not the file itself; fetch it with git lfs pull")


def _open_plain(path: Path) -> BinaryIO:
    return path.open("rb")


def read_head(path: Path) -> bytes:
    """The first bytes of what a file holds, unpacked; ``HEAD`` of them at most.

    Raises:
        InputError: see :func:`open_unpacked`; or nothing of a packed file can be unpacked.
    """
    with open_unpacked(path) as file:
        try:
            head = file.read(HEAD)
        except unpacking_errors() as error:
            raise InputError(f"{path}: cannot be unpacked ({error}); download it again") from error
    if head[257:262] == b"ustar":
        raise InputError(f"{path}: is a tar archive; unpack it and give the recording in it")
    return head


def unpacking_errors() -> tuple[type[Exception], ...]:
    """What reading a packed file raises where it is damaged or cut off."""
    return EOFError, OSError, zlib.error, lzma.LZMAError, import_zstd().ZstdError


@contextmanager
def unpacked_file(path: Path) -> Iterator[Path]:
    """A file to be read in any order: the path itself, or that of a temporary file with what it holds.

    Raises:
        InputError: it cannot be read or unpacked to its end.
    """
    if not is_packed(path):
        yield path
        return
    with TemporaryDirectory(prefix="rcnn_odom") as folder:
        unpacked = Path(folder) / "unpacked"
        try:
            with open_unpacked(path) as source, unpacked.open("wb") as target:
                shutil.copyfileobj(source, target, 1 << 20)
        except unpacking_errors() as error:
            raise InputError(f"{path}: cannot be unpacked to its end ({error}); download it again") from error
        yield unpacked


def _first_bytes(path: Path) -> bytes:
    try:
        with path.open("rb") as file:
            return file.read(HEAD)
    except OSError as error:
        raise InputError(f"{path}: cannot be read ({error.strerror}); give another file") from error


def _packing(head: bytes) -> Callable[..., Any] | None:
    return next((open_ for magic, open_ in PACKINGS.items() if head.startswith(magic)), None)
