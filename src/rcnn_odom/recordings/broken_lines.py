"""Counts the unusable lines of a stream, and warns about the first few."""

import logging
from collections import Counter

log = logging.getLogger(__name__)

MAX_WARNINGS = 3
"""Limits the output for a file in which every line has the same fault."""


class BrokenLines:
    """Counts the broken lines of a stream and logs a warning for each of the first ``MAX_WARNINGS``.

    Args:
        name: name of the file or source.
        what: name of such lines in the counts.
        skipped: the counts of the stream.
        is_live: True: warn at once. False: hold the warnings back until the first good line, because a file
            without any good line is refused as a whole.

    Attributes:
        count: number of broken lines so far.
        first: line number and fault of the first one.
    """

    def __init__(self, name: str, what: str, skipped: Counter[str], *, is_live: bool = False) -> None:
        self.name, self.what, self.skipped = name, what, skipped
        self.count, self.first = 0, ""
        self._is_warning_at_once = is_live
        self._waiting: list[str] = []

    def add(self, number: int, fault: str, reason: object) -> None:
        """Count a broken line.

        Args:
            number: its line number.
            fault: the kind of fault.
            reason: why the line is broken.
        """
        self.count += 1
        self.skipped[self.what] += 1
        if self.count == 1:
            self.first = f"line {number}: {reason}"
        if self.count <= MAX_WARNINGS:
            more = "; further such lines are only counted" if self.count == MAX_WARNINGS else ""
            self._waiting.append(f"{self.name}:{number}: {fault} ({reason}), skipped{more}")
        if self._is_warning_at_once:
            self.log_warnings()

    def log_warnings(self) -> None:
        """Log the waiting warnings, and from now on log every warning at once; call it at a good line."""
        self._is_warning_at_once = True
        for message in self._waiting:
            log.warning("%s", message)
        self._waiting = []
