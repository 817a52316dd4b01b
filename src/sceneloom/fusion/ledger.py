"""What became of every record: none is left out without being counted."""

import threading
from collections import Counter
from dataclasses import dataclass, field

from sceneloom.fusion.counters import Counters

Stream = tuple[str, int]
"""The kind of record and the sensor that sends it."""


@dataclass(slots=True, eq=False)
class Ticket:
    """One record on its way through the system.

    Attributes:
        stream: of the record.
        holders: how many locations keep it: an image goes to each lidar that its camera is calibrated with.
        fused: whether it took part in a result.
        support: what happened to it where it did not, as `dropped.queue-full`; "" for nothing but time.
        size: of its arrays [byte].
    """

    stream: Stream
    holders: int = 1
    fused: bool = False
    support: str = ""
    size: int = 0


@dataclass(slots=True)
class Ledger:
    """Counts every record once when nobody keeps it any more, from any thread.

    It was `fused` if it took part in a result, else `dropped`, or its part in the fusion `failed`, or it is `unpaired`:
    nothing came that it belongs to. So for each kind of record

        received + gathered = fused + unpaired + dropped + failed + waiting

    Attributes:
        counters: where.
        waiting_bytes: of the records that have come and are not done with.
    """

    counters: Counters
    waiting_bytes: int = 0
    _waiting: Counter[Stream] = field(default_factory=Counter)
    _lock: threading.Lock = field(default_factory=threading.Lock)

    def issue(self, ticket: Ticket) -> None:
        """Note a record that comes in."""
        with self._lock:
            self._waiting[ticket.stream] += 1
            self.waiting_bytes += ticket.size

    def share(self, ticket: Ticket, holders: int) -> None:
        """Note that so many locations keep a record; none of them: it is done."""
        with self._lock:
            ticket.holders = holders + 1
        self.settle(ticket)

    def settle(self, ticket: Ticket, support: str = "") -> None:
        """Note that one location does not keep a record any more, and why if not because it was used or is too old."""
        with self._lock:
            ticket.holders -= 1
            ticket.support = ticket.support or support
            if ticket.holders != 0:
                return
            self._waiting[ticket.stream] -= 1
            self.waiting_bytes -= ticket.size
            if not self._waiting[ticket.stream]:
                del self._waiting[ticket.stream]
        outcome = "fused" if ticket.fused else ticket.support or "unpaired"
        self.counters.add(f"{outcome}.{ticket.stream[0]}")

    def waiting(self, stream: Stream | None = None) -> int:
        """How many records of a stream, or of all, have come and are not done with."""
        with self._lock:
            return self._waiting.total() if stream is None else self._waiting[stream]
