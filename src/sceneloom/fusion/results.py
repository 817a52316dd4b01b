"""Results that wait to be fetched: first in, first out, of each fusion type, for callers that may wait."""

import threading
from collections import deque
from collections.abc import Callable
from dataclasses import dataclass, field
from typing import Generic, TypeVar

Item = TypeVar("Item")


@dataclass(slots=True)
class ResultQueue(Generic[Item]):
    """A bounded queue from threads that fuse to several that fetch."""

    _bytes: int = 0
    _items: deque[tuple[Item, int]] = field(default_factory=deque)
    _changed: threading.Condition = field(default_factory=threading.Condition)
    _closed: bool = False

    def __len__(self) -> int:
        return len(self._items)

    def put(self, item: Item, *, size: int, most: int, most_bytes: int) -> int:
        """Append a result, drop the oldest ones beyond the limits, and give how many were dropped.

        Args:
            size: of the item [byte].
            most: how many may wait.
            most_bytes: how large they may be together; the newest one stays in any case.
        """
        dropped = 0
        with self._changed:
            self._items.append((item, size))
            self._bytes += size
            while len(self._items) > 1 and (len(self._items) > most or self._bytes > most_bytes):
                self._take()
                dropped += 1
            self._changed.notify()
        return dropped

    def put_back(self, item: Item, *, size: int, before: Callable[[Item], bool]) -> None:
        """Take back an item that was fetched, to its location: in front of all that it comes before."""
        with self._changed:
            location = next(
                (k for k, (other, _) in enumerate(self._items) if before(other)), len(self._items)
            )
            self._items.insert(location, (item, size))
            self._bytes += size
            self._changed.notify()

    def get(self, timeout_s: float = 0.0) -> Item | None:
        """Fetch the oldest result, waiting for one up to `timeout_s`; None where none came or the queue is closed."""
        with self._changed:
            if not self._items and timeout_s > 0.0:
                self._changed.wait_for(lambda: self._items or self._closed, timeout_s)
            return self._take() if self._items else None

    def _take(self) -> Item:
        item, size = self._items.popleft()
        self._bytes -= size
        return item

    def close(self) -> None:
        """Let all who wait go; what is there can still be fetched."""
        with self._changed:
            self._closed = True
            self._changed.notify_all()
