"""Topics of packets as sensors: lidars by the decoders of captures, Ouster's IMUs, Continental's ARS548 and SRR520.

Source: Continental ARS 548 RDI, "Interface specification" (SOME/IP services DetectionList and ObjectList), whose layout
the public headers of nebula (continental_ars548.hpp) give, too; for SRR520 those and its decoder (continental_srr520).
"""

from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass, replace
from itertools import pairwise, takewhile
from pathlib import Path
from types import MappingProxyType
from typing import Any

import msgspec
import numpy as np

from sceneloom.arrays import AnyArray, BoolArray, Float64Array, Int64Array, UInt8Array, read_only
from sceneloom.errors import DataError
from sceneloom.formats.messages.records import Kind, NotesRecord, PacketsRecord, Topic, TopicLog
from sceneloom.formats.messages.survey import Survey
from sceneloom.formats.packets import ouster, robosense
from sceneloom.formats.packets.reader import check_model, decoder_of, find_angles, find_metadata
from sceneloom.formats.packets.spec import CaptureReading
from sceneloom.formats.packets.sweeps import PacketDecoder, PacketSweeps, find_sweeps, on_scene_clock
from sceneloom.geometry.euler import rotation_from_cuboid_angles
from sceneloom.geometry.rigid import RigidTransform
from sceneloom.scene.clouds import LidarSensor, RadarFrame, RadarPoints, RadarSensor
from sceneloom.scene.frames import LazyFrames
from sceneloom.scene.motion import ImuSensor, VectorSamples
from sceneloom.scene.types import PointsFrame
from sceneloom.warnings import WarningKind

_SAMPLE = 64  # packets by which a lidar is recognised
_DELAYED_NS = 10_000_000_000  # a packet whose own time is farther from its message's has none
_OUSTER_FRAME = "os_sensor"  # whose axes the points are in; messages of its packets name no frame. Source: ouster_ros


@dataclass(frozen=True, slots=True)
class PacketReading:
    """Where a bag lies, beside which files of angles and metadata may be, and what is stated of its packets."""

    path: Path
    options: CaptureReading


@dataclass(frozen=True, slots=True, eq=False)
class _MessagePackets:
    """Some packets of a topic, of one length [bytes] or longer; they are what `find_sweeps` reads.

    Attributes:
        messages, numbers: (P,) int64, of the message that each packet is in, and of the packet in it.
        arrivals_ns: (P,) int64 [ns], when they came.
    """

    log: TopicLog
    topic: Topic
    length: int
    messages: Int64Array
    numbers: Int64Array
    arrivals_ns: Int64Array

    @property
    def rows(self) -> Int64Array:
        """The numbers of all."""
        return np.arange(len(self.messages))

    def payloads(self, rows: Int64Array) -> UInt8Array:
        """The packets with these numbers, (K,) int64, as (K, L) uint8; each message of several in a row is read once.

        Raises:
            DataError: a message cannot be read, or has other packets than when it was opened.
        """
        found = np.empty((len(rows), self.length), np.uint8)
        into = found.reshape(-1)
        messages, numbers = self.messages[rows], self.numbers[rows]
        limits = [0, *(np.flatnonzero(np.diff(messages)) + 1).tolist(), len(rows)]
        for start, stop in pairwise(limits):
            packets = () if start == stop else _read(self.log, self.topic, int(messages[start])).packets
            if (
                isinstance(packets, np.ndarray)
                and packets.shape[1] >= self.length
                and numbers[start:stop].max() < len(packets)
            ):
                found[start:stop] = packets[numbers[start:stop], : self.length]
                continue
            for row in range(start, stop):
                packet = packets[numbers[row]] if numbers[row] < len(packets) else b""
                if len(packet) < self.length:
                    problem = f"{len(packet)} bytes in packet {numbers[row]}; expected {self.length}"
                    raise DataError(self.log.name, f"{self.topic.name}[{messages[start]}]", problem)
                into[row * self.length : (row + 1) * self.length] = np.frombuffer(packet, np.uint8, self.length)
        return found


def _read(log: TopicLog, topic: Topic, k: int) -> PacketsRecord:
    record = log.read(topic, k)[0]
    if not isinstance(record, PacketsRecord):
        raise DataError(log.name, f"{topic.name}[{k}]", "no packets; expected those of a sensor")
    return record


@dataclass(frozen=True, slots=True, eq=False)
class PacketDraft:
    """A sensor of a topic of packets before it is placed.

    Attributes:
        topic: of its packets.
        frame_id: of its points.
        suffix: of its id, behind what its topic is called.
        content: sweeps and cycles, or the streams of an IMU.
        model: the maker's name for the device; "" of radars and IMUs.
        mount: where it is on the ego by its own account; None where it does not state it.
        on_ego: whether points are in the frame of the ego.
    """

    topic: Topic
    frame_id: str
    suffix: str
    content: LazyFrames[Any] | Mapping[str, VectorSamples]
    model: str = ""
    mount: RigidTransform | None = None
    on_ego: bool = False

    @property
    def times_ns(self) -> Int64Array:
        """Of sweeps and cycles; none of an IMU."""
        return self.content.timestamps_ns if isinstance(self.content, LazyFrames) else np.zeros(0, np.int64)

    def sensor(self, identifier: str, **fields: Any) -> LidarSensor | RadarSensor | ImuSensor:
        """The sensor, with mount, poses and points frame if it is no IMU; an IMU's axes become those of the ego."""
        sensor_id = f"{identifier}{self.suffix}"
        if not isinstance(self.content, LazyFrames):
            mount = fields.get("mount")
            if mount is None:
                return ImuSensor(sensor_id, MappingProxyType(dict(self.content)))
            turned = {
                name: VectorSamples(one.timestamps_ns, read_only(one.values @ mount.rotation.T))
                for name, one in self.content.items()
            }
            return ImuSensor(sensor_id, MappingProxyType(turned))
        if self.model:
            return LidarSensor(sensor_id, self.content, model=self.model, **fields)
        if self.on_ego:
            fields["points_frame"] = PointsFrame.EGO
        return RadarSensor(sensor_id, self.content, **fields)


@dataclass(frozen=True, slots=True, eq=False)
class _Group:
    """The packets of one length of a topic."""

    frame_id: str
    packets: _MessagePackets
    sample: UInt8Array  # some of them
    is_state: bool  # whether they state a lidar's angles

    @property
    def topic(self) -> Topic:
        return self.packets.topic

    @property
    def where(self) -> str:
        return f"{self.packets.log.name}: {self.topic.name}"


def draft_packets(found: Survey, reading: PacketReading) -> list[PacketDraft]:
    """Look at all packets of a log: sensors that can be read; the rest is noted.

    Raises:
        DataError: a message is damaged, or metadata or angles are missing; where lenient, these are left out.
        OptionError: there is no such model.
    """
    check_model(reading.options)
    topics = found.topics(Kind.PACKETS)
    metadata = _metadata(found, reading, needed=any(topic.schema.endswith("PacketMsg") for topic in topics))
    groups = [group for topic in topics for group in _groups(found, topic)]
    states = {group.topic.name: group.sample[0] for group in groups if group.is_state}
    groups = [group for group in groups if not group.is_state]
    drafts: list[PacketDraft] = []
    shifts_ns: dict[str, int] = {}
    imus: list[tuple[_Group, ouster.OusterMetadata]] = []
    left: list[_Group] = []
    for group in groups:
        try:
            made = _radar(group, found)
            made = _short_range_radar(group, found) if made is None else made
            if made is None:
                made = _lidar(group, found, reading, metadata, states, shifts_ns)
        except DataError as error:
            found.ledger.fault("lidar-unreadable", error, count=len(group.packets.messages))
            continue
        imu = next((one for one in metadata if group.packets.length - one.imu_length in (0, 1)), None)
        if made is None and imu is not None and group.topic.schema.endswith("PacketMsg"):
            imus.append((group, imu))
        elif made is None:
            left.append(group)
        else:
            drafts += made
    for group, imu in imus:
        shortened = replace(group.packets, length=imu.imu_length)
        streams = ouster.imu_streams(imu, shortened.payloads(shortened.rows), shifts_ns.get(imu.file, 0))
        drafts.append(PacketDraft(group.topic, group.frame_id or _OUSTER_FRAME, "", streams))
    _note_left(found, left, metadata)
    return _told_apart(drafts)


def _told_apart(drafts: Sequence[PacketDraft]) -> list[PacketDraft]:
    """The same drafts, with a number where a topic has two of one suffix."""
    counts: dict[tuple[int, str], int] = {}
    kept = []
    for draft in drafts:
        key = draft.topic.number, draft.suffix
        counts[key] = counts.get(key, 0) + 1
        kept.append(draft if counts[key] == 1 else replace(draft, suffix=f"{draft.suffix}~{counts[key]}"))
    return kept


def _groups(found: Survey, topic: Topic) -> Iterator[_Group]:
    """The packets of a topic by their lengths and whether they are of a lidar's state; each message is read once."""
    kinds: dict[tuple[int, bool], tuple[list[int], list[int], list[int]]] = {}
    frame_id = ""
    for k, settled_ns in enumerate(found.times_ns[topic.number].tolist()):
        try:
            record = _read(found.log, topic, k)
        except DataError as error:
            found.ledger.fault("messages-at-fault", error)
            continue
        frame_id = frame_id or record.frame_id
        delays_ns = np.zeros(len(record.packets), np.int64)
        if record.arrivals_ns is not None and record.timestamp_ns:
            delays_ns = record.arrivals_ns - record.timestamp_ns
        arrivals_ns = settled_ns + np.where(np.abs(delays_ns) < _DELAYED_NS, delays_ns, 0)
        for number, (packet, arrival_ns) in enumerate(zip(record.packets, arrivals_ns.tolist(), strict=True)):
            kind = len(packet), robosense.is_state(memoryview(packet))
            columns = kinds.get(kind)
            if columns is None:
                columns = kinds[kind] = ([], [], [])
            columns[0].append(k)
            columns[1].append(number)
            columns[2].append(arrival_ns)
    for (length, is_state), columns in kinds.items():
        packets = _MessagePackets(found.log, topic, length, *(np.array(one, np.int64) for one in columns))
        if length:
            yield _Group(frame_id, packets, packets.payloads(packets.rows[:_SAMPLE]), is_state)


def _lidar(
    group: _Group,
    found: Survey,
    reading: PacketReading,
    metadata: Sequence[ouster.OusterMetadata],
    states: Mapping[str, UInt8Array],
    shifts_ns: dict[str, int],
) -> list[PacketDraft] | None:
    """The lidar of a group; None of packets that no decoder knows."""
    decoder: PacketDecoder | None = None
    packets, frame_id = group.packets, group.frame_id
    if group.topic.schema.endswith("PacketMsg"):
        # early messages were one byte longer than the packet
        fitting = [one for one in metadata if packets.length - one.length in (0, 1)]
        if fitting:
            name = group.topic.name
            first = [np.ascontiguousarray(group.sample[:1, : one.length]) for one in fitting]
            sessions = [ouster.session_of(packet, one) for packet, one in zip(first, fitting, strict=True)]
            ranks = [(own == one.session, _shared(one.file, name)) for own, one in zip(sessions, fitting, strict=True)]
            chosen = fitting[ranks.index(max(ranks))]
            decoder, packets = ouster.OusterDecoder(chosen), replace(packets, length=chosen.length)
            frame_id = frame_id or _OUSTER_FRAME
    else:
        nearest = max(states, key=lambda name: _shared(name, group.topic.name), default=None)
        state = None if nearest is None else states[nearest]
        angles = find_angles(reading.path, reading.options, group.topic.name)
        decoder = decoder_of(group.sample, reading.options, angles, state)
    if decoder is None:
        return None
    sweeps: PacketSweeps | None = find_sweeps(
        packets, packets.rows, packets.arrivals_ns, decoder, group.where, found.ledger
    )
    if sweeps is None:
        return []
    if isinstance(decoder, ouster.OusterDecoder):
        shifts_ns.setdefault(decoder.metadata.file, int(sweeps.shifts_ns[0]))
    return [PacketDraft(group.topic, frame_id, "", sweeps.frames, decoder.model)]


def _shared(one: str, topic: str) -> int:
    """How many parts of the names of two topics are the same, from the first; the first may follow that of a log."""
    parts = zip(one.rpartition(": ")[2].split("/"), topic.split("/"), strict=False)
    return sum(1 for _ in takewhile(lambda pair: pair[0] == pair[1], parts))


def _metadata(found: Survey, reading: PacketReading, *, needed: bool) -> list[ouster.OusterMetadata]:
    """Metadata of Ouster's lidars: of files that are named, else of topics, else beside the bag."""
    topics = found.topics(Kind.DESCRIPTION)
    known = []
    for topic in topics if needed and reading.options.metadata is None else ():
        record = found.log.read(topic, topic.count - 1)[0]
        try:
            text = record.text if isinstance(record, NotesRecord) else ""
            known.append(ouster.parse_metadata(_object(text), f"{found.log.name}: {topic.name}"))
            topics = [one for one in topics if one is not topic]
        except DataError:
            continue
    for topic in topics:
        message = f"messages {topic.schema} on {topic.name}: of a type that is not read"
        found.ledger.note(WarningKind.SKIPPED, "unknown-messages", found.log.name, message, count=topic.count)
    return known or (find_metadata(reading.path, reading.options) if needed else [])


def _object(text: str) -> Mapping[str, Any]:
    """What JSON of a topic holds; DataError where it is no object."""
    try:
        return msgspec.json.decode(text, type=dict[str, Any])
    except (msgspec.MsgspecError, RecursionError) as error:
        raise DataError("", "", f"no JSON object: {error}") from error


def _note_left(found: Survey, left: Sequence[_Group], metadata: Sequence[ouster.OusterMetadata]) -> None:
    for group in left:
        count, length = len(group.packets.messages), group.packets.length
        if group.topic.schema.endswith("PacketMsg") and "imu" not in group.topic.name.lower():
            stated = ", ".join(f"{one.file} ({one.length} bytes)" for one in metadata) or "none"
            problem = (
                f"packets of {length} bytes of an Ouster; expected its metadata on a topic, beside the bag or as "
                f"`--input-option metadata=FILE.json`, found {stated}"
            )
            found.ledger.fault("lidar-unreadable", DataError(found.log.name, group.topic.name, problem), count=count)
            continue
        message = f"packets of {length} bytes are of no lidar or radar that is known"
        found.ledger.note(WarningKind.SKIPPED, "packets-unknown", group.where, message, count=count)


# Radar: Continental ARS548

_Layout = list[tuple[Any, ...]]


def _floats(*names: str) -> _Layout:
    return [(name, ">f4") for name in names]


def _bytes(*names: str) -> _Layout:
    return [(name, "u1") for name in names]


_HEAD: _Layout = [
    ("service", ">u2"), ("method", ">u2"), ("length", ">u4"), ("someip", "V8"), ("e2e", "V20"),
    ("nanoseconds", ">u4"), ("seconds", ">u4"), ("stamp_sync_status", "u1"),
    ("event_data_qualifier", ">u4"), ("extended_qualifier", "u1"),
]  # fmt: skip
_DETECTION: _Layout = [
    *_floats("azimuth_angle", "azimuth_angle_std"),
    ("invalid_flags", "u1"),
    *_floats("elevation_angle", "elevation_angle_std", "range", "range_std", "range_rate", "range_rate_std"),
    *(("rcs", "i1"), ("measurement_id", ">u2")),
    *_bytes("raw_positive_predictive_value", "classification", "raw_multi_target_probability"),
    *(("object_id", ">u2"), ("raw_ambiguity_flag", "u1"), ("sort_index", ">u2")),
]
_ORIGIN = ("origin_x", "origin_y", "origin_z", "origin_roll", "origin_pitch", "origin_yaw")
_CLASSES = ("car", "truck", "motorcycle", "bicycle", "pedestrian", "animal", "hazard", "unknown", "overdrivable")


def _motion(name: str) -> _Layout:
    """A velocity or an acceleration: its flags, (x, y) with deviations, and their covariance."""
    names = (f"{name}_x", f"{name}_x_std", f"{name}_y", f"{name}_y_std", f"{name}_covariance_xy")
    return [(f"{name}_invalid_flags", "u1"), *_floats(*names)]


_OBJECT: _Layout = [
    *(("status_sensor", ">u2"), ("object_id", ">u4"), ("age", ">u2")),
    *_bytes("status_measurement", "status_movement"),
    *(("position_invalid_flags", ">u2"), ("position_reference", "u1")),
    *_floats("position_x", "position_x_std", "position_y", "position_y_std", "position_z", "position_z_std"),
    *_floats("position_covariance_xy", "orientation", "orientation_std"),
    ("existence_invalid_flags", "u1"),
    *_floats("raw_existence_probability", "existence_ppv"),
    *_bytes(*(f"raw_classification_{name}" for name in _CLASSES), "raw_classification_underdrivable"),
    *(row for name in ("absolute_velocity", "relative_velocity", "absolute_acceleration") for row in _motion(name)),
    *_motion("relative_acceleration"),
    ("orientation_rate_invalid_flags", "u1"),
    *_floats("orientation_rate_mean", "orientation_rate_std"),
    *(("shape_length_status", ">u4"), ("shape_length_edge_invalid_flags", "u1")),
    *_floats("shape_length_edge_mean", "shape_length_edge_std"),
    *(("shape_width_status", ">u4"), ("shape_width_edge_invalid_flags", "u1")),
    *_floats("shape_width_edge_mean", "shape_width_edge_std"),
]
_DETECTIONS = np.dtype(
    [
        *_HEAD,
        ("origin_invalid_flags", ">u2"),
        *(row for name in _ORIGIN for row in _floats(name, f"{name}_std")),
        ("list_invalid_flags", "u1"),
        ("rows", np.dtype(_DETECTION), 800),
        *_floats("ambiguity_free_velocity_min", "ambiguity_free_velocity_max"),
        ("count", ">u4"),
        *_floats("alignment_azimuth_correction", "alignment_elevation_correction"),
        *(("alignment_status", "u1"), ("reserved", "V14")),
    ]
)
_OBJECTS = np.dtype([*_HEAD, ("count", "u1"), ("rows", np.dtype(_OBJECT), 50)])
_LISTS = {336: _DETECTIONS, 329: _OBJECTS}
"""Layouts of the lists by the method ids of their services."""

_STATES = {84: 380, 330: 396}
"""Lengths and method ids of the radar's status, and of that of its filters, which have no points."""

_UNUSABLE = 0b101  # flags of detections whose distance or azimuth is invalid
_SYNCHRONISED = 1
_ELEVATION_UNKNOWN, _RATE_UNKNOWN = 0b10000, 0b1000000


def _radar(group: _Group, found: Survey) -> list[PacketDraft] | None:
    """The radar of a group of packets: a sensor of detections, or of objects; None of packets of others."""
    length, head = group.packets.length, np.dtype(_HEAD)
    method, layout = next((row for row in _LISTS.items() if row[1].itemsize == length), (0, None))
    if length in _STATES and (group.sample[:, :4].copy().view(">u2")[:, 1] == _STATES[length]).all():
        message = "the radar's packets of its status have no points"
        count = len(group.packets.messages)
        found.ledger.note(WarningKind.SKIPPED, "radar-status", group.where, message, count=count)
        return []
    if layout is None:
        return None
    heads = np.concatenate(
        [
            np.ascontiguousarray(group.packets.payloads(rows)[:, : head.itemsize]).view(head)[:, 0]
            for rows in np.array_split(group.packets.rows, len(group.packets.rows) // _SAMPLE + 1)
        ]
    )
    rows = np.flatnonzero((heads["service"] == 0) & (heads["method"] == method))
    if not len(rows):
        return None
    times_ns, rows = _cycle_times(group, found, heads, rows)
    reader = _RadarCycles(group.packets, rows, times_ns, is_objects=layout is _OBJECTS)
    suffix = "/objects" if layout is _OBJECTS else ""
    mount = None if layout is _OBJECTS else _stated_mount(reader.record(0))
    frames = LazyFrames(times_ns, reader)
    return [PacketDraft(group.topic, group.frame_id, suffix, frames, mount=mount, on_ego=layout is _OBJECTS)]


def _cycle_times(group: _Group, found: Survey, heads: AnyArray, rows: Int64Array) -> tuple[Int64Array, Int64Array]:
    """Times of the cycles of a radar whose heads are these rows, (K,) int64 [ns], and the rows that remain."""
    arrivals_ns = group.packets.arrivals_ns[rows]
    raw_ns = heads["seconds"][rows].astype(np.int64) * 1_000_000_000 + heads["nanoseconds"][rows]
    synchronised = heads["stamp_sync_status"][rows] == _SYNCHRONISED
    times_ns = on_scene_clock(raw_ns, arrivals_ns, 0, group.where, found.ledger) if synchronised.all() else arrivals_ns
    if not synchronised.all():
        message = "the radar's clock is not synchronised; when packets came counts"
        found.ledger.note(WarningKind.ASSUMED, "radar-clock", group.where, message, count=int((~synchronised).sum()))
    times_ns, first = np.unique(times_ns, return_index=True)
    if len(first) < len(rows):
        message = "a packet is there twice; it counts once"
        found.ledger.note(WarningKind.REPAIRED, "packets-repeated", group.where, message, count=len(rows) - len(first))
    return times_ns, rows[first]


def _stated_mount(record: Any) -> RigidTransform | None:
    """Where the radar is on the vehicle by its own configuration; None where it does not know."""
    numbers = np.array([record[name] for name in _ORIGIN], np.float64)
    if record["origin_invalid_flags"] or not np.isfinite(numbers).all() or not numbers.any():
        return None
    return RigidTransform(rotation_from_cuboid_angles(numbers[3:], unit="radians", order="zyx"), numbers[:3])


@dataclass(frozen=True, slots=True, eq=False)
class _RadarCycles:
    """Reads cycles of a radar, each a packet; what `LazyFrames` calls."""

    packets: _MessagePackets
    rows: Int64Array
    times_ns: Int64Array
    is_objects: bool

    def record(self, number: int) -> Any:
        """The list of a cycle."""
        content = self.packets.payloads(self.rows[number : number + 1])
        return content.view(_OBJECTS if self.is_objects else _DETECTIONS)[0, 0]

    def __call__(self, number: int) -> RadarFrame:
        """Read one cycle."""
        record = self.record(number)
        rows = record["rows"][: min(int(record["count"]), len(record["rows"]))]
        read = _objects if self.is_objects else _detections
        points = read(rows)
        dropped = len(rows) - len(points)
        names = ("ambiguity_free_velocity_min", "ambiguity_free_velocity_max", "alignment_status", "stamp_sync_status")
        extras = {name: record[name].item() for name in names if name in (record.dtype.names or ())}
        extras |= {"dropped_points": dropped} if dropped else {}
        return RadarFrame(int(self.times_ns[number]), points, MappingProxyType(extras))


def _columns(rows: AnyArray, *, without: Sequence[str] = ()) -> dict[str, AnyArray]:
    names = [name for name in rows.dtype.names or () if name not in without]
    return {name: rows[name].astype(rows.dtype[name].newbyteorder("=")) for name in names}


def _detections(rows: AnyArray) -> RadarPoints:
    """Detections whose distance and azimuth are valid, by their angles; an invalid elevation is 0, a velocity NaN."""
    azimuths, elevations, ranges = (
        rows[name].astype(np.float64) for name in ("azimuth_angle", "elevation_angle", "range")
    )
    elevations = np.where(rows["invalid_flags"] & _ELEVATION_UNKNOWN, 0.0, elevations)
    with np.errstate(invalid="ignore", over="ignore"):
        level = np.cos(elevations)
        directions = np.stack((level * np.cos(azimuths), level * np.sin(azimuths), np.sin(elevations)), axis=1)
        positions = (directions * ranges[:, None]).astype(np.float32)
    kept = np.isfinite(positions).all(axis=1) & ((rows["invalid_flags"] & _UNUSABLE) == 0)
    rates = np.where(rows["invalid_flags"] & _RATE_UNKNOWN, np.nan, rows["range_rate"])
    return _radar_points(positions, directions, rates, _columns(rows, without=("range_rate",)), kept)


def _objects(rows: AnyArray) -> RadarPoints:
    """Objects at their reference points, with their velocities relative to the vehicle, NaN where they are invalid."""
    names = [f"position_{axis}" for axis in "xyz"]
    positions = np.stack([rows[name] for name in names], axis=1).astype(np.float32)
    kept = np.isfinite(positions).all(axis=1) & (rows["position_invalid_flags"] == 0)
    velocities = np.stack([rows[f"relative_velocity_{axis}"] for axis in "xy"], axis=1).astype(np.float64)
    velocities[rows["relative_velocity_invalid_flags"] != 0] = np.nan
    return _radar_points(positions, *_decomposed(velocities), _columns(rows, without=names), kept)


def _decomposed(velocities: AnyArray) -> tuple[Float64Array, Float64Array]:
    """Directions, (N, 3), and lengths of velocities (N, 2) [m/s]; along x where they are zero, or not known (NaN)."""
    velocities = velocities.astype(np.float64)
    lengths = np.linalg.norm(velocities, axis=1)
    directions = np.tile([1.0, 0.0, 0.0], (len(velocities), 1))
    known = (lengths > 0) & np.isfinite(lengths)
    np.divide(velocities, lengths[:, None], out=directions[:, :2], where=known[:, None])
    return directions, lengths


def _radar_points(
    positions: AnyArray, directions: AnyArray, lengths: AnyArray, columns: Mapping[str, AnyArray], kept: BoolArray
) -> RadarPoints:
    """The points that are kept, of arrays of all."""
    with np.errstate(over="ignore"):
        return RadarPoints(
            read_only(positions[kept], np.float32),
            read_only(directions[kept], np.float32),
            read_only(lengths[kept], np.float32),
            extras=MappingProxyType({name: read_only(values[kept]) for name, values in columns.items()}),
        )


# Radar: Continental SRR520. Each packet is a frame of CAN FD behind its id; a message holds the packets of one list.

_CAN_HEAD: _Layout = [
    ("id", ">u4"), ("microseconds", ">u4"), ("seconds", ">u4"), ("nanoseconds", ">u4"), ("stamp_sync_status", "u1"),
    ("signal_status", "u1"), ("sequence_counter", "u1"), ("cycle_counter", ">u4"),
]  # fmt: skip
_SCAN_HEAD = np.dtype([*_CAN_HEAD, ("v_ambiguous", ">u2"), ("max_range", ">u2"), ("count", ">u2"), ("reserved", "V7")])
_OBJECTS_HEAD = np.dtype(
    [*_CAN_HEAD, ("ego_vx", ">u2"), ("ego_yaw_rate", ">u2"), *_bytes("motion_type", "count"), ("reserved", "V7")]
)
_ELEMENT_LENGTH, _CRC_LENGTH = 68, 8
_COUNTER = 66  # the byte of an element that counts them within a list
_CRC_ID, _STATUS_ID = 800, 700

_Field = tuple[str, int, float, float]  # name, bits, unit of the number, and what is added to it
_SCAN_FIELDS: tuple[_Field, ...] = (
    ("range", 12, 0.024420024, 0.0), ("azimuth_angle", 9, 0.006159986, -1.570796327),
    ("range_rate", 11, 0.014662757, -15.0), ("rcs", 7, 0.476190476, -40.0),
    *((f"pdh0{k}", 1, 100.0, 0.0) for k in range(5)), ("snr", 4, 1.7, 11.0),
)  # fmt: skip
_OBJECT_FIELDS: tuple[_Field, ...] = (
    ("object_id", 8, 1.0, 0.0), ("dist_x", 16, 0.009155553, -300.0), ("dist_y", 16, 0.009155553, -300.0),
    ("v_abs_x", 14, 0.009156391, -75.0), ("v_abs_y", 14, 0.009156391, -75.0),
    ("a_abs_x", 10, 0.019569472, -10.0), ("a_abs_y", 10, 0.019569472, -10.0),
    *((f"{name}_{axis}_std", 14, 0.001831166, 0.0) for name in ("dist", "v_abs", "a_abs") for axis in "xy"),
    ("box_length", 12, 0.007326007, 0.0), ("box_width", 12, 0.007326007, 0.0),
    ("orientation", 12, 0.001534729, -3.14159), ("rcs", 12, 0.024425989, -50.0), ("score", 4, 6.666666667, 0.0),
    ("life_cycles", 16, 1.0, 0.0), ("reserved", 5, 1.0, 0.0), ("object_status", 2, 1.0, 0.0),
    ("box_valid", 1, 1.0, 0.0),
)  # fmt: skip
_UNKNOWN_IF_FULL = frozenset(
    {"azimuth_angle", "range_rate", "dist_x", "dist_y", "v_abs_x", "v_abs_y", "a_abs_x", "a_abs_y", "orientation"}
    | {"rcs"}
)
"""Fields of which the largest number is no value."""


@dataclass(frozen=True, slots=True)
class _CanList:
    """A list that an SRR520 sends: the ids of its head and of its elements, layouts, and what its sensor is called."""

    head_id: int
    element_id: int
    head: np.dtype[Any]
    fields: tuple[_Field, ...]
    each: int  # rows of an element
    suffix: str


_CAN_LISTS = (
    _CanList(900, 901, _SCAN_HEAD, _SCAN_FIELDS, 10, ""),
    _CanList(1100, 1101, _SCAN_HEAD, _SCAN_FIELDS, 10, "/hrr"),
    _CanList(1200, 1201, _OBJECTS_HEAD, _OBJECT_FIELDS, 2, "/objects"),
)
_HEAD_UNITS = MappingProxyType(
    {"v_ambiguous": (0.003051851, -100.0), "max_range": (0.1, 0.0), "ego_vx": (0.003051851, -100.0)}
    | {"ego_yaw_rate": (9.58766e-05, -3.14159)}
)


def _short_range_radar(group: _Group, found: Survey) -> list[PacketDraft] | None:
    """The sensors of an SRR520 whose heads a group has, none of its other packets; None of packets of others."""
    ids = np.ascontiguousarray(group.sample[:, :4]).view(">u4")[:, 0]
    length = group.packets.length
    if length == _CRC_LENGTH and (ids == _CRC_ID).all():
        return []
    if length == _ELEMENT_LENGTH and np.isin(ids, [_STATUS_ID, *(one.element_id for one in _CAN_LISTS)]).all():
        alone = int((group.packets.numbers == 0).sum())
        if alone:
            message = "a list without its head; it is left out"
            found.ledger.note(WarningKind.SKIPPED, "packets-unusable", group.where, message, count=alone)
        return []
    if length != _SCAN_HEAD.itemsize or not np.isin(ids, [one.head_id for one in _CAN_LISTS]).all():
        return None
    content = group.packets.payloads(group.packets.rows)
    drafts = []
    for one in _CAN_LISTS:
        heads = content.view(one.head)[:, 0]
        rows = np.flatnonzero(heads["id"] == one.head_id)
        if len(rows):
            times_ns, rows = _cycle_times(group, found, heads, rows)
            reader = _CanCycles(group.packets, one, rows, times_ns)
            frames, on_ego = LazyFrames(times_ns, reader), one.fields is _OBJECT_FIELDS
            drafts.append(PacketDraft(group.topic, group.frame_id, one.suffix, frames, on_ego=on_ego))
    return drafts


@dataclass(frozen=True, slots=True, eq=False)
class _CanCycles:
    """Reads cycles of an SRR520, each a list in a message; what `LazyFrames` calls."""

    packets: _MessagePackets
    kind: _CanList
    rows: Int64Array
    times_ns: Int64Array

    def __call__(self, number: int) -> RadarFrame:
        """Read one cycle; elements that are missing are counted as dropped points."""
        row = int(self.rows[number])
        head = self.packets.payloads(self.rows[number : number + 1]).view(self.kind.head)[0, 0]
        message = _read(self.packets.log, self.packets.topic, int(self.packets.messages[row]))
        wanted = self.kind.element_id.to_bytes(4, "big")
        elements = [bytes(one) for one in message.packets if len(one) == _ELEMENT_LENGTH and bytes(one[:4]) == wanted]
        elements.sort(key=lambda one: one[_COUNTER])
        count, each = int(head["count"]), self.kind.each
        size = sum(bits for _, bits, *_ in self.kind.fields) // 8
        body = np.frombuffer(b"".join(one[4 : 4 + each * size] for one in elements), np.uint8).reshape(-1, each, size)
        # a row is where its element says that it is
        numbers = np.array([one[_COUNTER] for one in elements], np.int64)[:, None] * each + np.arange(each)
        columns = _bit_fields(body[numbers < count], self.kind.fields)
        extras = {name: head[name].item() for name in head.dtype.names or () if name not in _NO_EXTRAS}
        extras |= {name: extras[name] * unit + first for name, (unit, first) in _HEAD_UNITS.items() if name in extras}
        read = _can_objects if self.kind.fields is _OBJECT_FIELDS else _can_detections
        points = read(columns, extras)
        dropped = count - len(points)
        extras |= {"dropped_points": dropped} if dropped > 0 else {}
        return RadarFrame(int(self.times_ns[number]), points, MappingProxyType(extras))


_NO_EXTRAS = frozenset({"id", "seconds", "nanoseconds", "count", "reserved"})


def _bit_fields(rows: UInt8Array, fields: Sequence[_Field]) -> dict[str, AnyArray]:
    """Numbers of some bits each, the first ones first, of rows of bytes, (N, B) uint8; NaN where there is no value."""
    bits = np.unpackbits(rows, axis=1)
    columns: dict[str, AnyArray] = {}
    start = 0
    for name, count, unit, first in fields:
        numbers = bits[:, start : start + count] @ (1 << np.arange(count - 1, -1, -1))
        start += count
        columns[name] = numbers.astype(np.uint16) if unit == 1.0 else (numbers * unit + first).astype(np.float32)
        if name in _UNKNOWN_IF_FULL:
            columns[name][numbers == (1 << count) - 1] = np.nan
    return columns


def _can_detections(columns: dict[str, AnyArray], _: Mapping[str, Any]) -> RadarPoints:
    """Detections whose azimuth is known, in the plane of the radar."""
    azimuths = columns["azimuth_angle"].astype(np.float64)
    directions = np.stack((np.cos(azimuths), np.sin(azimuths), np.zeros(len(azimuths))), axis=1)
    positions = directions * columns["range"][:, None]
    return _radar_points(positions, directions, columns.pop("range_rate"), columns, np.isfinite(azimuths))


def _can_objects(columns: dict[str, AnyArray], extras: Mapping[str, Any]) -> RadarPoints:
    """Objects whose position is known, with their velocities relative to the vehicle, which moves and turns."""
    x, y = (columns.pop(f"dist_{axis}").astype(np.float64) for axis in "xy")
    columns.pop("reserved")
    moved = np.stack((extras["ego_vx"] - extras["ego_yaw_rate"] * y, extras["ego_yaw_rate"] * x), axis=1)
    directions, lengths = _decomposed(np.stack((columns["v_abs_x"], columns["v_abs_y"]), axis=1) - moved)
    kept = np.isfinite(x) & np.isfinite(y)
    return _radar_points(np.stack((x, y, np.zeros(len(x))), axis=1), directions, lengths, columns, kept)
