"""Atomic writing of files, and file locks that end with their process."""

import logging
import os
from collections.abc import Callable, Iterator
from contextlib import contextmanager, suppress
from pathlib import Path
from typing import IO

from filelock import FileLock, Timeout

log = logging.getLogger(__name__)


def write_atomically(path: Path, write: bytes | str | Callable[[IO[bytes]], object]) -> None:
    """Writes a whole file or nothing: the old file stays until the new one is completely on the disk.

    Args:
        path: the file to write; its folder is created if missing.
        write: the content, or a function that writes the content to an open file.

    Raises:
        OSError: the file cannot be written; no partial file is left behind.
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
def one_at_a_time(folder: Path, lock_name: str, activity: str) -> Iterator[None]:
    """Allows one process at a time to do a piece of work; the other processes wait.

    The lock ends with its process, also if the process is killed. A network file system must support
    ``flock``, as NFS 4 and Lustre do.

    Args:
        folder: folder of the lock, visible to all the processes; it is created if missing.
        lock_name: name of the work, used in the file name of the lock.
        activity: what the working process does ("encoding scans"), for the log message of those that wait.
    """
    folder.mkdir(parents=True, exist_ok=True)
    lock = FileLock(folder / f".{lock_name}.lock")
    try:
        lock.acquire(timeout=0)
    except Timeout:
        log.info("waiting for another process that is %s", activity)
        lock.acquire()
    try:
        yield
    finally:
        lock.release()


@contextmanager
def lock_if_free(path: Path) -> Iterator[bool]:
    """Takes a lock if it is free. The context's value is whether it was; the lock ends with its process."""
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
