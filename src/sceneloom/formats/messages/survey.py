"""A first pass over all topics: names of sensors, timestamps, small messages, and the notes of our own writer."""

from collections import Counter
from collections.abc import Iterable, Iterator, Mapping, Sequence
from dataclasses import dataclass, field
from types import MappingProxyType
from typing import Any, TypeVar

import numpy as np

from sceneloom.arrays import Int64Array
from sceneloom.formats.base.diagnostics import Ledger
from sceneloom.formats.messages.records import AnyRecord, Kind, Topic, TopicLog, numbered
from sceneloom.scene.annotations import AttributePath
from sceneloom.scene.types import NO_FIELDS
from sceneloom.warnings import WarningKind

_TAILS = frozenset(
    {
        "points", "points_raw", "point_cloud", "pointcloud", "pointcloud2", "cloud", "points2", "image", "image_raw",
        "image_rect", "image_color", "image_rect_color", "image_mono", "image_rect_raw", "raw", "compressed",
        "compressed_image", "compressed_video", "video", "data", "data_raw", "fix", "imu", "h264", "navsatfix",
        "location", "odometry", "pose", "mag", "temperature", "compressedDepth",
    }
)  # fmt: skip
"""Last parts of topics that state what messages are, and not of which sensor."""

_CAMERA_MODEL_TAILS = frozenset({"camera_info", "calibration", "camera_calibration", "info", "intrinsics"})

_SAYING = (
    _TAILS | _CAMERA_MODEL_TAILS | {"annotations", "detections", "detections_2d", "boxes", "bounding_boxes", "objects"}
)


def _parts_of(topic: str, *, without: frozenset[str] = frozenset()) -> list[str]:
    """The parts of a topic's name, without those at the end that state what messages are; one at least stays."""
    parts = [part for part in topic.split("/") if part]
    while len(parts) > 1 and parts[-1] in without:
        parts.pop()
    return parts


def sensor_names(topics: Sequence[str]) -> list[str]:
    """Name the sensors of topics: short where that is unique, else the whole topic, with a number if need be."""
    bases = ["/".join(_parts_of(topic, without=_TAILS)) or topic or "topic" for topic in topics]
    counts, pairs = Counter(bases), zip(topics, bases, strict=True)
    return numbered(base if counts[base] == 1 else "/".join(_parts_of(topic)) or base for topic, base in pairs)


def nearest(topic: str, others: Iterable[str]) -> str | None:
    """The topic that belongs to the same sensor as another one: /front/camera_info to /front/image_raw.

    Without the last parts, which state what messages are, one of the two names has to begin with the other.
    """
    base = _parts_of(topic, without=_SAYING)
    found = []
    for other in others:
        bare = _parts_of(other, without=_SAYING)
        shared = min(len(base), len(bare))
        if shared and base[:shared] == bare[:shared]:
            found.append((shared, -len(bare), other))
    return max(found)[2] if found else None


VERSION = 1
ATTRIBUTE_PARTS = ("sensor_id", "static", "point_index")
"""What is noted of an attribute beside its name, values, timestamps and extras."""


@dataclass(frozen=True, slots=True)
class Notes:
    """What our writer left beside the messages; empty for files of others.

    Attributes:
        sensors, trajectories, annotations: one mapping for each.
        root: everything else by name.
    """

    sensors: tuple[Mapping[str, Any], ...] = ()
    trajectories: tuple[Mapping[str, Any], ...] = ()
    annotations: tuple[Mapping[str, Any], ...] = ()
    root: Mapping[str, Any] = field(default_factory=lambda: NO_FIELDS)

    @property
    def ours(self) -> bool:
        """Whether there are any."""
        return bool(self.root)


def attributes_from(notes: Iterable[Mapping[str, Any]]) -> tuple[AttributePath, ...]:
    """The attributes of notes."""
    return tuple(
        AttributePath(
            note["name"],
            tuple(tuple(value) if isinstance(value, list) else value for value in note["values"]),
            np.asarray(note["timestamps_ns"], np.int64) if "timestamps_ns" in note else None,
            extras=MappingProxyType(note["extras"]) if "extras" in note else NO_FIELDS,
            **{name: note[name] for name in ATTRIBUTE_PARTS if name in note},
        )
        for note in notes
    )


def in_order(timestamps_ns: Int64Array, location: str, ledger: Ledger) -> Int64Array:
    """Give the rows in the order of their times, the first of several with one time."""
    if (np.diff(timestamps_ns) < 0).any():
        count = int((np.diff(timestamps_ns) < 0).sum())
        message = "messages out of order; sorted by their times"
        ledger.note(WarningKind.REPAIRED, "messages-sorted", location, message, count=count)
    _, rows = np.unique(timestamps_ns, return_index=True)
    if len(rows) < len(timestamps_ns):
        message = "messages with the time of another one; the first counts"
        ledger.note(WarningKind.SKIPPED, "repeated-timestamps", location, message, count=len(timestamps_ns) - len(rows))
    return rows.astype(np.int64)


_R = TypeVar("_R")


@dataclass(slots=True)
class Survey:
    """What is in a log.

    Attributes:
        log: the messages.
        ledger: takes warnings and faults.
        notes: what our writer left.
        times_ns: of the messages of each topic of large ones, by its number.
        records: of each topic of small ones, by its number, with the times that count.
    """

    log: TopicLog
    ledger: Ledger
    notes: Notes
    times_ns: dict[int, Int64Array] = field(default_factory=dict)
    records: dict[int, list[AnyRecord]] = field(default_factory=dict)

    def topics(self, *kinds: Kind) -> list[Topic]:
        """The topics of some kinds that have messages."""
        return [topic for topic in self.log.topics if topic.kind in kinds and topic.count]

    def all_of(self, kind: Kind, record_type: type[_R]) -> Iterator[_R]:
        """The records of all topics of a kind."""
        for topic in self.topics(kind):
            yield from self.of(topic, record_type)

    def of(self, topic: Topic, record_type: type[_R]) -> list[_R]:
        """The records of a topic of small messages."""
        return [record for record in self.records.get(topic.number, ()) if isinstance(record, record_type)]
