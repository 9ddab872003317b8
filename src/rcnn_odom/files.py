"""Files that are whole or not there, and locks that end with their process."""

import logging
import os
from collections.abc import Callable, Iterator
from contextlib import contextmanager, suppress
from pathlib import Path
from typing import IO

from filelock import FileLock, Timeout

log = logging.getLogger(__name__)


def write_atomically(path: Path, write: bytes | str | Callable[[IO[bytes]], object]) -> None:
    """Writes a file at once or not at all: what was there before stays until all is on the disk.

    Args:
        path: of the file; its folder is made where missing.
        write: the content, or a function that writes it into an open file.

    Raises:
        OSError: it cannot be written; nothing is left behind.
    """
    path.parent.mkdir(parents=True, exist_ok=True)
    partial = path.with_name(f".{path.name}.{os.getpid()}.partial")
    try:
        with partial.open("wb") as file:
            if callable(write):
                write(file)
            else:
                file.write(write.encode() if isinstance(write, str) else write)
            file.flush()
            os.fsync(file.fileno())
        partial.replace(path)
    finally:
        with suppress(OSError):
            partial.unlink(missing_ok=True)


@contextmanager
def one_at_a_time(folder: Path, work: str, what: str) -> Iterator[None]:
    """Lets one process at a time do a piece of work; the others wait.

    The lock ends with its process, however that ends. On a network file system it needs a working
    ``flock``, as NFS 4 and Lustre have.

    Args:
        folder: all of them see it; made where missing.
        work: by this name, fit for a file.
        what: it is, for the message of those who wait.
    """
    folder.mkdir(parents=True, exist_ok=True)
    lock = FileLock(folder / f".{work}.lock")
    try:
        lock.acquire(timeout=0)
    except Timeout:
        log.info("waiting for another process that is %s", what)
        lock.acquire()
    try:
        yield
    finally:
        lock.release()


@contextmanager
def lock_if_free(path: Path) -> Iterator[bool]:
    """Holds a lock if no other process does, which is the value; the lock ends with its process."""
    lock = FileLock(path)
    try:
        lock.acquire(timeout=0)
    except Timeout:
        yield False
        return
    try:
        yield True
    finally:
        lock.release()
