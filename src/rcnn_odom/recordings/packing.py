"""Opens compressed files; the kind of a file is found from its first bytes, not from its name."""

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
"""Number of first bytes from which the kind of a file is found."""
LFS_POINTER = b"version https://git-lfs.github.com/spec/"
ARCHIVES = {
    b"PK\x03\x04": "a zip archive",
    b"7z\xbc\xaf\x27\x1c": "a 7z archive",
    b"Rar!\x1a\x07": "a rar archive",
}


def _open_zstd(path: Path) -> BinaryIO:
    return cast(BinaryIO, import_zstd().open(path, "rb"))


def import_zstd() -> Any:
    """Import zstd, from Python 3.14 or its backport: these modules detect files that are cut off."""
    return import_module("compression.zstd" if sys.version_info >= (3, 14) else "backports.zstd")


PACKINGS: dict[bytes, Callable[..., Any]] = {
    b"\x1f\x8b": gzip.open,
    b"BZh": bz2.open,
    b"\xfd7zXZ\x00": lzma.open,
    b"\x28\xb5\x2f\xfd": _open_zstd,
}
"""First bytes of compressed files, and the functions that open them for reading bytes."""


def is_packed(path: Path) -> bool:
    """Whether a file is compressed by gzip, bzip2, xz or zstd."""
    return _find_opener(_first_bytes(path)) is not None


def open_unpacked(path: Path) -> BinaryIO:
    """Open a file for reading its content, which is decompressed while it is read.

    Reading a compressed file that is damaged or cut off raises one of :func:`unpacking_errors`.

    Raises:
        InputError: the file cannot be read, or is an archive or a pointer of Git LFS.
    """
    head = _first_bytes(path)
    refuse_pointer(path, head)
    for magic, kind in ARCHIVES.items():
        if head.startswith(magic):
            raise InputError(f"{path}: is {kind}; unpack it and give the recording in it")
    try:
        file: BinaryIO = (_find_opener(head) or _open_plain)(path)
        return file
    except OSError as error:
        raise InputError(f"{path}: cannot be read ({error.strerror}); give another file") from error


def refuse_pointer(path: str | Path, head: bytes) -> None:
    """Check that a file is not a pointer, which Git LFS writes in place of a large file that was not fetched.

    Args:
        path: path of the file, for the error.
        head: first bytes of the file.

    Raises:
        InputError: it is such a pointer.
    """
    if head.startswith(LFS_POINTER):
        raise InputError(f"{path}: is a pointer of Git LFS, not the file itself; fetch it with git lfs pull")


def _open_plain(path: Path) -> BinaryIO:
    return path.open("rb")


def read_head(path: Path) -> bytes:
    """Read the first bytes of a file's content after decompression, at most ``HEAD``.

    Raises:
        InputError: as for :func:`open_unpacked`; or the first bytes cannot be decompressed.
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
    """The exceptions from reading a compressed file that is damaged or cut off."""
    return EOFError, OSError, zlib.error, lzma.LZMAError, import_zstd().ZstdError


@contextmanager
def unpacked_file(path: Path) -> Iterator[Path]:
    """Path of a file that can be read in any order: the file, or a temporary file with its unpacked content.

    Raises:
        InputError: the file cannot be read or decompressed to its end.
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


def _find_opener(head: bytes) -> Callable[..., Any] | None:
    """The function that opens a compressed file with these first bytes; None if it is not compressed."""
    return next((open_ for magic, open_ in PACKINGS.items() if head.startswith(magic)), None)
