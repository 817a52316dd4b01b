"""What happens in a session: records accepted, refused or dropped, motion, results."""

import threading
from collections.abc import Callable
from dataclasses import dataclass, field

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
from sceneloom.db34t.scene_objects import FoundObjects
from sceneloom.db34t.setting import SensorKind, Setting, Snapshot
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
