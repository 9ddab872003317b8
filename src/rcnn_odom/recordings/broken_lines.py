"""Lines of a stream that cannot be used: the first few are told one by one, all are counted."""

import logging
from collections import Counter

log = logging.getLogger(__name__)

TOLD_SINGLY = 3
"""A file whose every line is wrong in the same way fills no screen."""


class BrokenLines:
    """Tells and counts them.

    Args:
        name: of the file or source.
        what: what to call the lines in the counts.
        skipped: the counts of the stream.
        is_live: tells them at once; those of a file wait for its first good line, since of a file without one
            the whole is told.

    Attributes:
        count: how many there were.
        first: number and fault of the first one, in words.
    """

    def __init__(self, name: str, what: str, skipped: Counter[str], *, is_live: bool = False) -> None:
        self.name, self.what, self.skipped = name, what, skipped
        self.count, self.first = 0, ""
        self._tell_at_once = is_live
        self._waiting: list[str] = []

    def add(self, number: int, fault: str, reason: object) -> None:
        """One more: its line number, the kind of fault, and why."""
        self.count += 1
        self.skipped[self.what] += 1
        if self.count == 1:
            self.first = f"line {number}: {reason}"
        if self.count <= TOLD_SINGLY:
            more = ", and so on: more are only counted" if self.count == TOLD_SINGLY else ""
            self._waiting.append(f"{self.name}:{number}: {fault} ({reason}), skipped{more}")
        if self._tell_at_once:
            self.tell()

    def tell(self) -> None:
        """There is a good line: from here on the others are told at once."""
        self._tell_at_once = True
        for message in self._waiting:
            log.warning("%s", message)
        self._waiting = []
