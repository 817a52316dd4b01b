"""A first pass over all topics: names of sensors, timestamps, small messages, and the notes of our own writer."""

from collections import Counter
from collections.abc import Iterable, Iterator, Mapping, Sequence
from dataclasses import dataclass, field, replace
from types import MappingProxyType
from typing import Any, TypeVar, cast

import msgspec
import numpy as np

from sceneloom.arrays import BoolArray, Int64Array
from sceneloom.errors import DataError, OptionError
from sceneloom.formats.base.diagnostics import Ledger
from sceneloom.formats.messages.records import LARGE, AnyRecord, Kind, Topic, TopicLog, TransformRecord, numbered
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


def _read_notes(text: str | None, name: str) -> Notes:
    """Read what our writer left."""
    if text is None:
        return Notes()
    try:
        root = msgspec.json.decode(text, type=dict[str, Any])
        lists = {
            key: msgspec.convert(root.get(key, ()), tuple[dict[str, Any], ...])
            for key in ("sensors", "trajectories", "annotations")
        }
    except (msgspec.MsgspecError, RecursionError) as error:
        raise DataError(name, "sceneloom.scene", f"notes that cannot be read: {error}") from error
    return Notes(**lists, root=MappingProxyType(root))


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


_TIMESTAMPS = ("header", "receive")
"""Which times can be asked for."""

_FAR_NS = 60_000_000_000
"""No network delays messages by more than this: another clock timestamped them."""

_ZERO_NS = 1_000_000_000


@dataclass(frozen=True, slots=True, eq=False)
class _TopicTimes:
    """The times of one topic's messages, (N,) int64 [ns]; `fixed` ones state what always holds."""

    topic: Topic
    timestamps_ns: Int64Array
    received_ns: Int64Array
    fixed: bool = False

    @property
    def unset(self) -> BoolArray:
        """(N,) bool, which messages are timestamped 0 and were received at another time."""
        unset: BoolArray = (self.timestamps_ns == 0) & (np.abs(self.received_ns) > _ZERO_NS)
        return unset

    @property
    def delay_ns(self) -> int | None:
        """How long after its timestamp a message was received, in the middle; None where no message has a timestamp."""
        timestamped = ~self.unset
        if self.fixed or not timestamped.any():
            return None
        return int(np.median(self.received_ns[timestamped] - self.timestamps_ns[timestamped]))


def _settle_times(
    all_times: Sequence[_TopicTimes], name: str, ledger: Ledger, *, wanted: str | None
) -> dict[int, Int64Array]:
    """By number of the topic, the times that count: of the heads, unless topics are on different clocks."""
    if wanted not in (None, *_TIMESTAMPS):
        raise OptionError(f"timestamps {wanted!r}; expected one of {', '.join(_TIMESTAMPS)}")
    strangers = _strangers(all_times, name, ledger) if wanted is None else frozenset()
    found = {}
    for times in all_times:
        if wanted == "receive" or times.topic.number in strangers:
            found[times.topic.number] = times.received_ns
            continue
        unset = times.unset
        if unset.any() and not times.fixed:
            message = "messages timestamped 0; the time at which they were received counts"
            location = f"{name}: {times.topic.name}"
            ledger.note(WarningKind.REPAIRED, "timestamps-zero", location, message, count=int(unset.sum()))
        found[times.topic.number] = np.where(unset, times.received_ns, times.timestamps_ns)
    return found


def _strangers(all_times: Sequence[_TopicTimes], name: str, ledger: Ledger) -> frozenset[int]:
    """The topics whose timestamps are of another clock than those of the others."""
    delays = {
        times.topic.number: (times.topic.name, delay) for times in all_times if (delay := times.delay_ns) is not None
    }
    if not delays:
        return frozenset()
    near = {number for number, (_, delay) in delays.items() if abs(delay) <= _FAR_NS}
    if not near:
        usual = int(np.median([delay for _, delay in delays.values()]))
        near = {number for number, (_, delay) in delays.items() if abs(delay - usual) <= _FAR_NS}
        message = f"messages were received {usual / 1e9:.3f} s after their timestamps; the timestamps count"
        ledger.note(WarningKind.ASSUMED, "received-much-later", name, message, count=len(near))
    far = {number: row for number, row in delays.items() if number not in near}
    if far:
        reported = "; ".join(f"{topic} {delay / 1e9:+.3f} s" for topic, delay in sorted(far.values()))
        usual = int(np.median([delays[number][1] for number in near]))
        problem = (
            f"mixed time bases: messages were received {usual / 1e9:+.3f} s after their timestamps, but of {reported}; "
            'expected one clock: state timestamps="receive" to go by when they were received, timestamps="header" by '
            "the "
            "timestamps as they are, or `--lenient` to go by when those few were received"
        )
        ledger.fault("mixed-time-bases", DataError(name, "", problem), count=len(far))
    return frozenset(far)


def in_order(timestamps_ns: Int64Array, location: str, ledger: Ledger) -> Int64Array:
    """Give the rows in the order of their times, the first of several with one time."""
    if (np.diff(timestamps_ns) < 0).any():
        count = int((np.diff(timestamps_ns) < 0).sum())
        message = "messages out of order; sorted by their times"
        ledger.note(WarningKind.REPAIRED, "messages-sorted", location, message, count=count)
    _, rows = np.unique(timestamps_ns, return_index=True)
    if len(rows) < len(timestamps_ns):
        message = "messages with the time of another one; the first counts"
        ledger.note(
            WarningKind.SKIPPED,
            "repeated-timestamps",
            location,
            message,
            count=len(timestamps_ns) - len(rows),
        )
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


def survey(log: TopicLog, ledger: Ledger, *, timestamps: str | None) -> Survey:
    """Look at all topics.

    Args:
        log: the messages.
        ledger: takes warnings and faults.
        timestamps: which times count, "header" or "receive"; None: see `_settle_times`.

    Raises:
        DataError: a small message is wrong, or topics are on different clocks.
    """
    found = Survey(log, ledger, _read_notes(log.notes, log.name))
    _note_unknown(log, ledger)
    times: list[_TopicTimes] = []
    rows: dict[int, list[tuple[int, list[AnyRecord]]]] = {}
    for topic in log.topics:
        if topic.kind is None or not topic.count or topic.kind is Kind.NOTES:
            continue
        received = log.receive_times(topic)
        if topic.kind in LARGE:
            reported, looked = log.timestamps(topic)
            if not looked and not found.notes.ours:
                message = "some messages state the time at which they were received, so the others are taken to do so"
                ledger.note(WarningKind.ASSUMED, "timestamps-from-index", f"{log.name}: {topic.name}", message)
            times.append(_TopicTimes(topic, reported, received))
        else:
            rows[topic.number] = _read(log, topic, ledger)
            first = np.array([records[0].timestamp_ns for _, records in rows[topic.number]], np.int64)
            kept = received[np.array([k for k, _ in rows[topic.number]], np.int64)]
            records = [record for _, row in rows[topic.number] for record in row]
            fixed = all(isinstance(record, TransformRecord) and record.fixed for record in records)
            fixed = topic.kind is Kind.CAMERA_MODEL or (bool(records) and fixed)
            times.append(_TopicTimes(topic, first, kept, fixed))
    settled = _settle_times([row for row in times if len(row.timestamps_ns)], log.name, ledger, wanted=timestamps)
    # our own writer moves scenes that begin before 0 where a format knows no such times
    moved_ns = int(found.notes.root.get("time_shift_ns", 0))
    for row in times:
        number = row.topic.number
        settled[number] = settled.get(number, row.timestamps_ns) - moved_ns
        if number in rows:
            counted = settled[number] - row.timestamps_ns
            found.records[number] = [
                _moved(record, int(shift))
                for (_, records), shift in zip(rows[number], counted.tolist(), strict=True)
                for record in records
            ]
        else:
            found.times_ns[number] = settled[number]
    return found


def _moved(record: AnyRecord, shift_ns: int) -> AnyRecord:
    if shift_ns == 0:
        return record
    return cast("AnyRecord", replace(cast("Any", record), timestamp_ns=record.timestamp_ns + shift_ns))


def _read(log: TopicLog, topic: Topic, ledger: Ledger) -> list[tuple[int, list[AnyRecord]]]:
    """Read all messages of a topic; those that state nothing are left out."""
    found = []
    for k in range(topic.count):
        try:
            records = list(log.read(topic, k))
        except DataError as error:
            ledger.fault("messages-at-fault", error)
            continue
        if records:
            found.append((k, records))
    return found


def _note_unknown(log: TopicLog, ledger: Ledger) -> None:
    """Report which messages are not read, by their type."""
    groups: dict[tuple[str, str], list[Topic]] = {}
    for topic in log.topics:
        if topic.kind is None and topic.count:
            groups.setdefault((topic.schema, topic.why), []).append(topic)
    for (schema, why), topics in groups.items():
        names = ", ".join(sorted({topic.name for topic in topics}))
        message = f"messages {schema or 'without a type'} on {names}: {why}"
        count = sum(topic.count for topic in topics)
        ledger.note(WarningKind.SKIPPED, "unknown-messages", log.name, message, count=count)
