"""What happens in a fusion interface, for those who look on: what was taken, refused, dropped, fused and given."""

import threading
from collections.abc import Callable
from dataclasses import dataclass

from sceneloom.fusion.accepted import Accepted
from sceneloom.fusion.counters import Counters
from sceneloom.fusion.found_objects import FoundObjects
from sceneloom.fusion.messages.records import ResultRecord, SentRecord
from sceneloom.fusion.outcome import Outcome
from sceneloom.fusion.properties.store import Snapshot
from sceneloom.fusion.queues import Flushed, Moved


@dataclass(frozen=True, slots=True, eq=False)
class Result:
    """One result, as clause 5.7 gives it.

    Attributes:
        number: among the results of its type, from 0 on; a gap where results were dropped.
        record: of table 9, or the records of table 10 of one pair.
        configuration: the properties in force when its sweep came; all calibrations among them.
        found: of records of table 10 in the process that fused them, what they report.
    """

    number: int
    record: ResultRecord
    configuration: Snapshot
    found: FoundObjects | None = None


@dataclass(frozen=True, slots=True, eq=False)
class Refused:
    """A record that was not taken, and why.

    Attributes:
        record: as it was sent.
        outcome: the answer.
    """

    record: SentRecord
    outcome: Outcome


@dataclass(frozen=True, slots=True, eq=False)
class Dropped:
    """A record that had been taken and was dropped before it was fused, because too many waited.

    Attributes:
        accepted: the record.
    """

    accepted: Accepted


Event = Accepted | Refused | Dropped | Moved | Flushed | Result
"""What an observer is reported, in the order in which it counts."""

Observer = Callable[[Event], None]


class Announcer:
    """Reports an observer what happens, one call at a time, from any thread.

    Attributes:
        observed: whether somebody looks on.
    """

    def __init__(self, observer: Observer | None, counters: Counters) -> None:
        """Report an observer, or nobody; an observer that fails is counted."""
        self.observed = observer is not None
        self._observer = observer
        self._counters = counters
        self._telling = threading.Lock()

    def notify(self, event: Event) -> None:
        """Report what happened."""
        if self._observer is None:
            return
        with self._telling:
            try:
                self._observer(event)
            except Exception as error:  # noqa: BLE001 - who only looks on must not end the session
                self._counters.add(f"errors.observer.{type(error).__name__}")
