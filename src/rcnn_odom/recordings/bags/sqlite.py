"""Reads ROS 2 bags in sqlite3 files (``.db3``)."""

import sqlite3
from collections import Counter
from collections.abc import Iterator
from contextlib import closing, suppress
from pathlib import Path

from rcnn_odom.recordings.bags.chunks import BrokenBag, Connection, Message, NoBag, message_type

MESSAGES = "SELECT CAST(timestamp AS INTEGER), topic_id, data FROM messages"


class SqliteFile:
    """A bag in an sqlite3 file, with the same attributes and methods as :class:`ChunkedFile`.

    Raises:
        BrokenBag: the file cannot be opened.
        NoBag: the database is not a bag.
    """

    def __init__(self, path: Path) -> None:
        self.path = path
        self.broken = "it ends too early" if _is_cut_off(path) else ""
        self.counts: Counter[int] = Counter()
        try:
            with closing(_connect(path)) as database:
                self.connections = {
                    number: Connection(str(topic), message_type(str(kind)), str(encoding or "cdr"))
                    for number, topic, kind, encoding in database.execute(
                        "SELECT CAST(id AS INTEGER), name, type, serialization_format FROM topics"
                    )
                }
                self._count(database)
        except sqlite3.Error as error:
            if not self.broken and str(error).startswith("no such "):  # a table or column is missing
                raise NoBag(f"is a database of sqlite3, but not a ROS bag ({error})") from error
            raise BrokenBag(str(error)) from error

    def messages(self, wanted: set[int]) -> Iterator[Message]:
        """Yield the messages of some connections in the order of their arrival.

        Args:
            wanted: numbers of the connections.

        Raises:
            BrokenBag: the file is damaged; raised after the last message that can be read.
        """
        try:
            with closing(_connect(self.path)) as database:
                yield from (self._until_the_end if self.broken else self._by_time)(database, wanted)
        except sqlite3.Error as error:
            raise BrokenBag(str(error)) from error
        if self.broken:
            raise BrokenBag(self.broken)

    def _by_time(self, database: sqlite3.Connection, wanted: set[int]) -> Iterator[Message]:
        numbers = ", ".join("?" * len(wanted))
        query = f"{MESSAGES} WHERE topic_id IN ({numbers}) ORDER BY timestamp"
        for time, number, content in database.execute(query, sorted(wanted)):
            yield time, number, _as_bytes(content)

    def _until_the_end(self, database: sqlite3.Connection, wanted: set[int]) -> Iterator[Message]:
        """Yield messages in the order of writing, because a file that was cut off has no index.

        At the cut, content is read as zeros; so a message is only yielded if another one follows it.
        """
        complete = None
        for time, number, content in database.execute(f"{MESSAGES} NOT INDEXED"):
            if complete is not None and complete[1] in wanted:
                yield complete
            if number not in self.connections:
                return
            complete = time, number, _as_bytes(content)

    def _count(self, database: sqlite3.Connection) -> None:
        if not self.broken:
            try:
                counts = database.execute("SELECT topic_id, COUNT(*) FROM messages GROUP BY topic_id")
                self.counts.update(dict(counts))
                return
            except sqlite3.Error as error:
                self.broken = str(error)
        with suppress(sqlite3.Error):  # raised at the end of the file
            for (number,) in database.execute("SELECT topic_id FROM messages NOT INDEXED"):
                self.counts[number] += 1


def _as_bytes(content: object) -> memoryview:
    return memoryview(content if isinstance(content, bytes) else b"")


def _is_cut_off(path: Path) -> bool:
    """Whether a file has fewer pages than its header says, and no log with the rest."""
    with path.open("rb") as file:
        head = file.read(100).ljust(100, b"\0")
    page, pages = int.from_bytes(head[16:18], "big"), int.from_bytes(head[28:32], "big")
    is_valid = head[24:28] == head[92:96]  # otherwise the last writer did not update the number of pages
    return is_valid and not _log_of(path) and pages * (65536 if page == 1 else page) > path.stat().st_size


def _log_of(path: Path) -> Path | None:
    """The write-ahead log beside a database, if it has content that is not in the database yet."""
    log = path.with_name(f"{path.name}-wal")
    return log if log.is_file() and log.stat().st_size else None


def _connect(path: Path) -> sqlite3.Connection:
    """Open a database without writing; if it has no log, even without lock files."""
    # The log is read too: a recorder that crashed had not moved its content into the database.
    mode = "mode=ro" if _log_of(path) else "mode=ro&immutable=1"
    database = sqlite3.connect(f"{path.resolve().as_uri()}?{mode}", uri=True)
    database.execute("PRAGMA writable_schema = ON")  # also opens a file that was cut off
    database.text_factory = lambda text: text.decode(errors="replace")
    return database
