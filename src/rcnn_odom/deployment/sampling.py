"""A sample of an endless stream in constant memory."""

from collections.abc import Callable
from typing import Generic, TypeVar

Item = TypeVar("Item")


class EvenSample(Generic[Item]):
    """Keeps every item of a stream, then every second, then every fourth, and so on: an even sample.

    Args:
        capacity: maximum number of items; even.

    Attributes:
        items: the items that are kept, in order.

    Example:
        >>> sample = EvenSample(4)
        >>> for number in range(10):
        ...     sample.add(lambda: number)
        >>> sample.items
        [0, 4, 8]
    """

    def __init__(self, capacity: int) -> None:
        self.capacity, self.items = capacity, list[Item]()
        self._every, self._seen = 1, 0

    def add(self, make: Callable[[], Item]) -> None:
        """Adds one item of the stream; ``make`` is called only if the item is kept."""
        if self._seen % self._every == 0:
            if len(self.items) == self.capacity:
                self.items = self.items[::2]
                self._every *= 2
            # The interval may just have doubled, and then this item may no longer be kept.
            if self._seen % self._every == 0:
                self.items.append(make())
        self._seen += 1
