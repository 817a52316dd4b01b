"""Results that wait to be fetched: first in, first out, of each fusion type, for callers that may wait."""

import threading
from collections import deque
from collections.abc import Callable
from dataclasses import dataclass, field
from typing import Generic, TypeVar

Item = TypeVar("Item")


@dataclass(slots=True)
class ResultQueue(Generic[Item]):
    """A bounded queue from one thread that fuses to several that fetch.

    Attributes:
        size: how many bytes an item has.
        dropped: how many results were dropped because nobody fetched them in time.
    """

    size: Callable[[Item], int] = lambda _: 0
    dropped: int = 0
    _bytes: int = 0
    _items: deque[Item] = field(default_factory=deque)
    _changed: threading.Condition = field(default_factory=threading.Condition)
    _closed: bool = False

    def __len__(self) -> int:
        return len(self._items)

    def put(self, item: Item, *, most: int, most_bytes: int = 2**63) -> int:
        """Append a result, drop the oldest ones beyond the limits, and give how many were dropped.

        Args:
            most: how many may wait.
            most_bytes: how large they may be together; the newest one stays in any case.
        """
        dropped = 0
        with self._changed:
            self._items.append(item)
            self._bytes += self.size(item)
            while len(self._items) > 1 and (len(self._items) > most or self._bytes > most_bytes):
                self._take()
                dropped += 1
            self.dropped += dropped
            self._changed.notify()
        return dropped

    def put_back(self, item: Item, *, before: Callable[[Item], bool]) -> None:
        """Take back an item that was fetched, to its place: in front of all that it comes before."""
        with self._changed:
            place = next((k for k, other in enumerate(self._items) if before(other)), len(self._items))
            self._items.insert(place, item)
            self._bytes += self.size(item)
            self._changed.notify()

    def get(self, timeout_s: float = 0.0) -> Item | None:
        """Fetch the oldest result, waiting for one up to `timeout_s`; None where none came or the queue is closed."""
        with self._changed:
            self._changed.wait_for(lambda: self._items or self._closed, timeout_s)
            return self._take() if self._items else None

    def _take(self) -> Item:
        item = self._items.popleft()
        self._bytes -= self.size(item)
        return item

    def close(self) -> None:
        """Let all who wait go; what is there can still be fetched."""
        with self._changed:
            self._closed = True
            self._changed.notify_all()
