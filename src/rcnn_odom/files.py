"""Work that several processes want done, and one of them should do."""

import logging
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path

from filelock import FileLock, Timeout

log = logging.getLogger(__name__)


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
def held(path: Path) -> Iterator[bool]:
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
