"""What happens in a session: records accepted, refused or dropped, motion, results; who counts it and looks on."""

import threading
from collections import Counter
from collections.abc import Callable
from dataclasses import dataclass, field

from sceneloom.db34t.calibration import SensorKind
from sceneloom.db34t.properties import Snapshot
from sceneloom.db34t.records import (
    Boxes2d,
    Boxes3d,
    ImageData,
    PointCloudData,
    RawData,
    ResultRecord,
    SentRecord,
    kind_of,
    size_of,
)
from sceneloom.db34t.results import FoundObjects
from sceneloom.db34t.setting import Setting
from sceneloom.db34t.types import Outcome
from sceneloom.scene.cameras import CameraImage
from sceneloom.scene.clouds import LidarFrame
from sceneloom.scene.poses import Poses

Stream = tuple[str, int]
"""The kind of record and the sensor that sends it."""

FrameRecord = RawData | ImageData | PointCloudData | Boxes3d | Boxes2d
"""What is sent of one frame."""

Measurement = LidarFrame | CameraImage | Boxes3d | Boxes2d
"""What is fused."""

CLOCK_JUMP_NS = 10_000_000_000
"""A record that is so much older than the newest one was not late: its sensor's clock was set back."""


@dataclass(slots=True, eq=False)
class Ticket:
    """One record on its way through the system.

    Attributes:
        stream: of the record.
        size: of its arrays [byte].
        holders: how many fusion systems keep it: an image goes to each lidar that its camera is calibrated with.
        fused: whether it took part in a result.
        outcome: what happened to it where it did not, as `dropped.queue-full`; "" for nothing but time.
    """

    stream: Stream
    size: int = 0
    holders: int = 1
    fused: bool = False
    outcome: str = ""


@dataclass(slots=True)
class Counters:
    """Counts by name, and follows records until nobody keeps them any more; from any thread.

    Names are words joined by dots, the first says what happened: `received.image`, `refused.bad-record`,
    `dropped.queue-full`, `unpaired.camera`, `results.sensor`, … A record was `fused` if it took part in a result, else
    `dropped`, or its part in the fusion `failed`, or it is `unpaired`: nothing came that it belongs to. For each kind

        received + gathered = fused + unpaired + dropped + failed + waiting

    Attributes:
        waiting_bytes: of the records that have come and are not done with.
    """

    waiting_bytes: int = 0
    _counts: Counter[str] = field(default_factory=Counter)
    _waiting: Counter[Stream] = field(default_factory=Counter)
    _lock: threading.Lock = field(default_factory=threading.Lock)

    def add(self, name: str, count: int = 1) -> None:
        """Count something that happened, if it did."""
        if count:
            with self._lock:
                self._counts[name] += count

    def counts(self) -> dict[str, int]:
        """All that was counted, by name in the order of the alphabet."""
        with self._lock:
            return dict(sorted(self._counts.items()))

    def issue(self, ticket: Ticket) -> None:
        """Note a record that comes in."""
        with self._lock:
            self._waiting[ticket.stream] += 1
            self.waiting_bytes += ticket.size

    def share(self, ticket: Ticket, holders: int) -> None:
        """Note that so many fusion systems keep a record; none of them: it is done."""
        with self._lock:
            ticket.holders = holders + 1
        self.settle(ticket)

    def settle(self, ticket: Ticket, outcome: str = "") -> None:
        """Note that one of them does not keep a record any more, and why if not because it was used or is too old."""
        with self._lock:
            ticket.holders -= 1
            ticket.outcome = ticket.outcome or outcome
            if ticket.holders != 0:
                return
            self._waiting[ticket.stream] -= 1
            self.waiting_bytes -= ticket.size
            if not self._waiting[ticket.stream]:
                del self._waiting[ticket.stream]
        self.add(f"{'fused' if ticket.fused else ticket.outcome or 'unpaired'}.{ticket.stream[0]}")

    def waiting(self, stream: Stream | None = None) -> int:
        """How many records of a stream, or of all, have come and are not done with."""
        with self._lock:
            return self._waiting.total() if stream is None else self._waiting[stream]


@dataclass(frozen=True, slots=True, eq=False)
class Accepted:
    """A record that was taken.

    Attributes:
        sensor_id: who sent it.
        kind: camera or lidar.
        record: as it was sent.
        image: of an image its record; of raw data the one that they make.
        measurement: what is fused.
        setting: the configuration in force when it came.
        ticket: what becomes of it.
        timestamp_ns: of the record [ns].
    """

    sensor_id: int
    kind: SensorKind
    record: FrameRecord
    measurement: Measurement
    setting: Setting
    image: ImageData | None = None
    ticket: Ticket = field(init=False)
    timestamp_ns: int = field(init=False)

    def __post_init__(self) -> None:
        stream = kind_of(self.record).name, self.sensor_id
        object.__setattr__(self, "ticket", Ticket(stream, size_of(self.record)))
        object.__setattr__(self, "timestamp_ns", self.record.timestamp.nanoseconds)

    @property
    def stream(self) -> Stream:
        """Which queue it waits in: the kind of record and the sensor."""
        return self.ticket.stream


@dataclass(frozen=True, slots=True, eq=False)
class Moved:
    """The vehicle's trajectory of the last while is known anew.

    Attributes:
        path: that trajectory, from an origin of its own.
        sent: the part of it that came now.
    """

    path: Poses
    sent: Poses


@dataclass(frozen=True, slots=True, eq=False)
class Flushed:
    """What waits is to be fused with what has come.

    Attributes:
        done: set when it is.
        final: whether nothing comes after it.
    """

    done: threading.Event = field(default_factory=threading.Event)
    final: bool = False


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
    """A record that was not taken, and the answer, which says why."""

    record: SentRecord
    outcome: Outcome


@dataclass(frozen=True, slots=True, eq=False)
class Dropped:
    """A record that had been taken and was dropped before it was fused, because too many waited."""

    accepted: Accepted


Task = Accepted | Moved | Flushed
"""What a worker does."""

Event = Task | Refused | Dropped | Result
"""What an observer is told, in the order in which it counts."""

Observer = Callable[[Event], None]


class Announcer:
    """Tells an observer what happens, one call at a time, from any thread.

    Attributes:
        observed: whether somebody looks on.
    """

    def __init__(self, observer: Observer | None, counters: Counters) -> None:
        """Tell an observer, or nobody; an observer that fails is counted."""
        self.observed = observer is not None
        self._observer = observer
        self._counters = counters
        self._lock = threading.Lock()

    def notify(self, event: Event) -> None:
        """Tell what happened."""
        if self._observer is None:
            return
        with self._lock:
            try:
                self._observer(event)
            except Exception as error:  # noqa: BLE001 - who only looks on must not end the session
                self._counters.add(f"errors.observer.{type(error).__name__}")
