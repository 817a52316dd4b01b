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
        dropped: how many results were dropped because nobody fetched them in time.
    """

    dropped: int = 0
    _items: deque[Item] = field(default_factory=deque)
    _changed: threading.Condition = field(default_factory=threading.Condition)
    _closed: bool = False

    def __len__(self) -> int:
        return len(self._items)

    def put(self, item: Item, *, most: int) -> int:
        """Append a result, drop the oldest ones beyond `most`, and give how many were dropped."""
        with self._changed:
            self._items.append(item)
            dropped = max(len(self._items) - most, 0)
            for _ in range(dropped):
                self._items.popleft()
            self.dropped += dropped
            self._changed.notify()
        return dropped

    def put_back(self, item: Item, *, before: Callable[[Item], bool]) -> None:
        """Take back an item that was fetched, to its place: in front of all that it comes before."""
        with self._changed:
            place = next((k for k, other in enumerate(self._items) if before(other)), len(self._items))
            self._items.insert(place, item)
            self._changed.notify()

    def get(self, timeout_s: float = 0.0) -> Item | None:
        """Fetch the oldest result, waiting for one up to `timeout_s`; None where none came or the queue is closed."""
        with self._changed:
            self._changed.wait_for(lambda: self._items or self._closed, timeout_s)
            return self._items.popleft() if self._items else None

    def close(self) -> None:
        """Let all who wait go; what is there can still be fetched."""
        with self._changed:
            self._closed = True
            self._changed.notify_all()
