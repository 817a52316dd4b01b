"""What came in, what was left out and why: counted by cause, for results nobody can see are missing."""

import threading
from collections import Counter
from dataclasses import dataclass, field


@dataclass(slots=True)
class Counters:
    """Counts by name, from any thread.

    Names are words joined by dots, the first says what happened: `received.image`, `refused.bad-record`,
    `dropped.queue-full`, `unpaired.camera`, `results.sensor`, …
    """

    _counts: Counter[str] = field(default_factory=Counter)
    _lock: threading.Lock = field(default_factory=threading.Lock)

    def add(self, name: str, count: int = 1) -> None:
        """Count something that happened, if it did."""
        if count == 0:
            return
        with self._lock:
            self._counts[name] += count

    def counts(self) -> dict[str, int]:
        """All that was counted, by name in the order of the alphabet."""
        with self._lock:
            return dict(sorted(self._counts.items()))
