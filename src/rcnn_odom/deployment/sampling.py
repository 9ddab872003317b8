"""A sample of a stream without end, in constant memory."""

from collections.abc import Callable
from typing import Generic, TypeVar

Item = TypeVar("Item")


class EvenSample(Generic[Item]):
    """Every item of a stream, then every second, every fourth ...: evenly spaced, never more than fit.

    Args:
        capacity: most items that are kept; even.

    Attributes:
        items: those that are kept, in order.
    """

    def __init__(self, capacity: int) -> None:
        self.capacity, self.items = capacity, list[Item]()
        self._every, self._seen = 1, 0

    def add(self, make: Callable[[], Item]) -> None:
        """One more item of the stream, which is made only if it is kept."""
        if self._seen % self._every == 0:
            if len(self.items) == self.capacity:
                self.items = self.items[::2]
                self._every *= 2
            # Doubled just now, this item may no longer be one of those that are kept.
            if self._seen % self._every == 0:
                self.items.append(make())
        self._seen += 1
