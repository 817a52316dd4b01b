"""The session log: everything that sessions receive and return, in one MCAP file that can be replayed."""

import logging
import os
import threading
import time
from collections import Counter, deque
from collections.abc import Callable, Iterator, Mapping, Sequence
from contextlib import suppress
from dataclasses import replace
from functools import partial
from pathlib import Path
from types import MappingProxyType, TracebackType
from typing import Any, BinaryIO, NamedTuple, Self

import numpy as np
from google.protobuf.message import Message

from sceneloom.arrays import AnyArray, Float32Array, Float64Array
from sceneloom.db34t.boxes import Boxes2d, Boxes3d
from sceneloom.db34t.calibration import SensorKind
from sceneloom.db34t.protobuf import encode, encode_in, fill_message
from sceneloom.db34t.queues import Dropped, Event, Flushed, Moved, Refused, Result
from sceneloom.db34t.received_records import Accepted, Setting
from sceneloom.db34t.records import (
    ENCODINGS,
    FusedDetections,
    ImageData,
    PointCloudData,
    ResultRecord,
    SensorFusionData,
    SentRecord,
    kind_of,
    size_of,
)
from sceneloom.db34t.types import bytes_view
from sceneloom.db34t.wire import fusion_pb2
from sceneloom.errors import OutputError, SceneloomError
from sceneloom.formats.base.output import check_output
from sceneloom.formats.messages.cameras import camera_model_record, is_foreign
from sceneloom.formats.messages.foxglove import encode as encode_shown
from sceneloom.formats.messages.foxglove import foxglove_type, schema_bytes, serialised
from sceneloom.formats.messages.mcap_files import McapWriter
from sceneloom.formats.messages.points import pack
from sceneloom.formats.messages.records import (
    AnyRecord,
    Box2D,
    Box3D,
    Boxes2DRecord,
    Boxes3DRecord,
    CameraModelRecord,
    CloudRecord,
    CompressedImageRecord,
    ImageRecord,
    TransformRecord,
)
from sceneloom.geometry.rigid import RigidTransform
from sceneloom.service.messages import motion_request, properties_message, value_to_protobuf
from sceneloom.version import __version__

_FrameName = Callable[[str, int], str]
"""Gives the name of the frame of a kind of sensor and its number."""

_FISHEYE = "kannala_brandt"

_RAW_NAMES = MappingProxyType({1: "mono8", 3: "rgb8", 4: "rgba8"})

_COLOURS = ("r", "g", "b")

_LARGEST_COLOUR = 255


def shown_records(
    record: SentRecord | ResultRecord, frame_id: str, image_frame_id: str = ""
) -> dict[str, AnyRecord]:
    """Give what viewers show of a record: one message, or of a result one for each part.

    Args:
        frame_id: the frame of the sensor; of a result that of its points and boxes.
        image_frame_id: of a result, the frame of the camera; "" for the same.

    Returns:
        By part: image, depth, points, boxes_3d, boxes_2d; without those that no message can hold.
    """
    camera, found = image_frame_id or frame_id, dict[str, AnyRecord | None]()
    time_ns = record.timestamp.nanoseconds
    match record:
        case ImageData():
            size_hwc = record.height, record.width, record.channel
            found["image"] = _image(time_ns, camera, record.encoding, size_hwc, record.data)
        case PointCloudData():
            found["points"] = _cloud(time_ns, frame_id, record.fields, record.points)
        case SensorFusionData():
            size_hwc = record.height, record.width, record.image_channel
            image_ns = _image_time_ns(record)
            found["image"] = _image(image_ns, camera, record.encoding, size_hwc, record.image_data)
            height, width = record.height, record.width
            depth = bytes_view(record.image_depth)
            found["depth"] = ImageRecord(image_ns, camera, "32FC1", width, height, 4 * width, depth)
            found["points"] = _cloud(time_ns, frame_id, record.point_fields, record.points)
        case FusedDetections():
            found["boxes_3d"] = _boxes_3d(record, frame_id)
            found["boxes_2d"] = _boxes_2d(record, _image_time_ns(record), camera)
        case Boxes3d():
            found["boxes_3d"] = _boxes_3d(record, frame_id)
        case Boxes2d():
            found["boxes_2d"] = _boxes_2d(record, time_ns, camera)
    return {part: shown for part, shown in found.items() if shown is not None}


def _shown_camera_models(setting: Setting, frame_name: _FrameName) -> dict[int, CameraModelRecord]:
    """Give the intrinsics of each camera whose model viewers know."""
    cameras = {camera_id: pair.camera for (camera_id, _), pair in setting.pairs.items()}
    return {
        camera_id: camera_model_record(camera, 0, frame_name("camera", camera_id), _FISHEYE)
        for camera_id, camera in cameras.items()
        if not is_foreign(camera)
    }


def _shown_transforms(setting: Setting, frame_name: _FrameName) -> Iterator[TransformRecord]:
    """Give the extrinsics of each camera in its lidars; a left-handed lidar frame has none."""
    axes = setting.frames.lidar.standard_from_declared(SensorKind.LIDAR)
    if np.linalg.det(axes) < 0:
        return
    standard_from_declared = RigidTransform(axes, np.zeros(3))
    for (camera_id, lidar_id), pair in setting.pairs.items():
        lidar_from_camera = (pair.camera_from_lidar @ standard_from_declared).inverse()
        yield TransformRecord(
            0,
            frame_name("lidar", lidar_id),
            frame_name("camera", camera_id),
            lidar_from_camera.translation,
            lidar_from_camera.quaternion_xyzw,
        )


def _image_time_ns(record: SensorFusionData | FusedDetections) -> int:
    return (record.image_timestamp or record.timestamp).nanoseconds


def _image(
    time_ns: int, frame_id: str, encoding: str, size_hwc: tuple[int, int, int], data: AnyArray
) -> ImageRecord | CompressedImageRecord | None:
    height, width, channel = size_hwc
    if ENCODINGS[encoding].is_file:
        return CompressedImageRecord(time_ns, frame_id, encoding, bytes_view(data))
    name = _RAW_NAMES.get(channel) if encoding == "raw" else encoding
    if name is None:
        return None
    return ImageRecord(time_ns, frame_id, name, width, height, width * channel, bytes_view(data))


def _cloud(time_ns: int, frame_id: str, names: Sequence[str], table: Float32Array) -> CloudRecord:
    """Points as they were sent; colours that are whole numbers from 0 to 255 as bytes, which viewers ask for."""
    colours = table[:, [k for k, name in enumerate(names) if name in _COLOURS]]
    columns: dict[tuple[str, ...], AnyArray] = {tuple(names): table}
    # NaN is in no range
    whole = (colours >= 0) & (colours <= _LARGEST_COLOUR) & (colours == np.floor(colours))
    if colours.shape[1] == len(_COLOURS) and whole.all():
        rest = [k for k, name in enumerate(names) if name not in _COLOURS]
        by_name = [names.index(name) for name in _COLOURS]
        columns = {
            tuple(names[k] for k in rest): table[:, rest],
            ("red", "green", "blue"): table[:, by_name].astype(np.uint8),
            ("alpha",): np.full(len(table), _LARGEST_COLOUR, np.uint8),
        }
    packed = pack(columns, len(table))
    return CloudRecord(time_ns, frame_id, packed.fields, packed.stride, packed.data, packed.count)


def _boxes_3d(record: Boxes3d | FusedDetections, frame_id: str) -> Boxes3DRecord:
    boxes = tuple(
        Box3D(
            str(k),
            frame_id,
            record.centers[k],
            _quaternion_xyzw(record.directions[k]),
            record.sizes_lwh[k],
            record.class_names[k],
            {**_metadata(record, k), "velocity": str(record.velocities[k])},
        )
        for k in range(len(record))
        if record.directions[k].any()
    )
    return Boxes3DRecord(record.timestamp.nanoseconds, boxes)


def _boxes_2d(record: Boxes2d | FusedDetections, time_ns: int, frame_id: str) -> Boxes2DRecord:
    boxes = tuple(
        Box2D(str(k), (x1, y1, x2 - x1, y2 - y1), record.class_names[k], _metadata(record, k))
        for k, (x1, y1, x2, y2) in enumerate(record.corners_xyxy.astype(np.float64).tolist())
    )
    return Boxes2DRecord(time_ns, frame_id, boxes)


def _metadata(record: Boxes2d | Boxes3d | FusedDetections, k: int) -> dict[str, str]:
    return {"id": str(record.id[k]), "confidence": str(record.confidence[k])}


def _quaternion_xyzw(direction: Float32Array) -> Float64Array:
    """Rotation (4,) of the x axis into a direction (3,) of any length but 0, without roll."""
    dx, dy, dz = direction.astype(np.float64).tolist()
    yaw, pitch = np.arctan2(dy, dx) / 2, -np.arctan2(dz, np.hypot(dx, dy)) / 2
    about_y, about_z = (np.sin(pitch), np.cos(pitch)), (np.sin(yaw), np.cos(yaw))
    return np.array(
        [
            -about_z[0] * about_y[0],
            about_z[1] * about_y[0],
            about_z[0] * about_y[1],
            about_z[1] * about_y[1],
        ]
    )


LOG = logging.getLogger(__name__)

_CHUNK_BYTES = 4 << 20
"""Of messages that are compressed and written together; the most that is kept in memory, beside the largest message."""

_MOST_CHANNELS = 60_000
"""Channels of one file, of at most 65535 that the format counts."""

_OVERHEAD = 2048
"""What an entry that waits keeps beside its arrays [byte], about."""

_SENSORS = {"raw": "sensor", "image": "camera", "boxes_2d": "camera", "points": "lidar", "boxes_3d": "lidar"}

Step = Callable[[int], None]
"""Writes an entry, given when it happened [ns]."""


class NotLoggedError(SceneloomError):
    """Something is not in the log: the disk was too slow or failed."""


class LogWriter:
    """Writes messages of any number of channels into the file of a log; until it is closed it has another name.

    Attributes:
        path: where the log is once it is closed.
        draft: where it is until then.
    """

    def __init__(self, path: Path, *, overwrite: bool = False) -> None:
        """Begin a log, which may replace one that is there.

        Raises:
            OutputError: the log, or an unfinished one of its name, is there, or cannot be written.
        """
        self.path, self.draft = path, unfinished_path(path)
        self._overwrite = overwrite
        check_output(path, overwrite=overwrite)
        check_output(self.draft, overwrite=overwrite)
        try:
            self._stream: BinaryIO = self.draft.open("wb")
        except OSError as error:
            raise OutputError(f"{self.draft}: cannot be written: {error.strerror}") from error
        library = f"sceneloom {__version__}"
        self._writer = McapWriter(self._stream, library=library, compression="lz4", chunk_bytes=_CHUNK_BYTES)
        self._stream.flush()
        self._latest_ns = 0
        self._schemas: dict[str, int] = {}
        self._channels: dict[tuple[str, str, str], int] = {}

    def add_metadata(self, name: str, values: Mapping[str, str]) -> None:
        """Write values that are no message."""
        self._writer.add_metadata(name, dict(values))

    def add(
        self,
        topic: str,
        message_type: type[Any],
        content: bytes,
        *,
        session: str,
        what: str,
        timestamp_ns: int | None = None,
        log_time_ns: int | None = None,
    ) -> None:
        """Write a message.

        Args:
            topic: of its channel.
            message_type: its class.
            content: its bytes.
            session: that it is of.
            what: what it says, for those who read the log again.
            timestamp_ns: when what it says was measured; None for when it happened.
            log_time_ns: when it happened; None for now.

        Raises:
            OutputError: there are more channels than a log may have.
        """
        # times never run backwards in the file, whatever the clock does: its order is what is replayed
        self._latest_ns = max(time.time_ns() if log_time_ns is None else log_time_ns, self._latest_ns)
        published_ns = self._latest_ns if timestamp_ns is None else timestamp_ns
        name = message_type.DESCRIPTOR.full_name
        channel = self._channels.get((topic, name, session))
        if channel is None:
            if len(self._channels) >= _MOST_CHANNELS:
                raise OutputError(f"{_MOST_CHANNELS} channels, as many as a log may have")
            if name not in self._schemas:
                self._schemas[name] = self._writer.add_schema(name, "protobuf", schema_bytes(message_type))
            metadata = {"session": session, "what": what}
            channel = self._writer.add_channel(topic, "protobuf", self._schemas[name], metadata)
            self._channels[topic, name, session] = channel
        self._writer.add_message(channel, self._latest_ns, [content], published_ns)

    def flush(self) -> None:
        """Hand what was added to the disk."""
        self._writer.flush()

    def close(self) -> None:
        """Complete the log and give it its name.

        Raises:
            OutputError: a log of that name is there by now.
        """
        self._writer.finish()
        self._stream.flush()
        os.fsync(self._stream.fileno())
        self._stream.close()
        check_output(self.path, overwrite=self._overwrite)
        self.draft.replace(self.path)


def unfinished_path(path: Path) -> Path:
    """Where a log is until it is closed, and stays after a crash."""
    return path.with_name(f"{path.stem}.unfinished{path.suffix}")


class _Entry(NamedTuple):
    step: Step
    session: str
    size: int
    time_ns: int


class BlackBox:
    """Writes what happens in sessions; give `session(name)` as the observer of each, or the box itself for one.

    Arrays of records have to stay as they are after they were sent. Neither a file that cannot be written nor a disk
    that is too slow disturbs the sessions: `failure`, `lost` and `close` report it. Once there is no room, everything
    is left out until half of what waits is written: so the log has long parts that are whole, and not images without
    their sweeps.

    Attributes:
        writer: the file.
        shown: whether images, clouds, boxes and results are written once more as MCAP viewers know them.
        failure: why nothing is written any more; None while all is well.
        lost: by session, how many entries are not in the log: the disk was too slow, or failed.
    """

    def __init__(
        self,
        path: str | Path,
        *,
        shown: bool = True,
        overwrite: bool = False,
        most_bytes: int = 512 << 20,
        most_entries: int = 20_000,
        kept_back_s: float = 1.0,
        clock_ns: Callable[[], int] = time.time_ns,
    ) -> None:
        """Begin a log.

        Args:
            path: of the MCAP file; until it is closed it stands beside as `NAME.unfinished.mcap`.
            shown: whether viewers are to show it; without, files are half as large.
            overwrite: replace a log that is there.
            most_bytes: of records and results that wait to be written; the default is some one and a half seconds of
                10 Hz of 1080p and 250,000 points.
            most_entries: how many entries may wait.
            kept_back_s: how long what was written may wait for the disk [s]; 0: observers return when it is there.
            clock_ns: gives the time of entries.

        Raises:
            OutputError: the file is there, or cannot be written.
        """
        self.writer = LogWriter(Path(path), overwrite=overwrite)
        self.shown = shown
        self.failure: Exception | None = None
        self.lost = Counter[str]()
        self._most_bytes, self._most_entries = most_bytes, most_entries
        self._kept_back_s, self._clock_ns = kept_back_s, clock_ns
        self._names: set[str] = set()
        self._own: Callable[[Event], None] | None = None
        self._entries = deque[_Entry]()
        self._bytes = 0
        self._missing = Counter[str]()
        self._full = self._writing = self._closed = False
        self._changed = threading.Condition()
        self._thread = threading.Thread(target=self._work, name="log", daemon=True)
        self._thread.start()

    def __enter__(self) -> Self:
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        self.close()

    def __call__(self, event: Event) -> None:
        """Observe the only session of a program."""
        if self._own is None:
            self._own = self.session("default")
        self._own(event)

    def session(self, name: str) -> Callable[[Event], None]:
        """Give the observer of a session; one of a name that ended and began again is another session."""
        chosen, number = name, 1
        while chosen in self._names:
            number += 1
            chosen = f"{name}#{number}"
        self._names.add(chosen)
        values = {"session": chosen, "sceneloom": __version__}
        with suppress(NotLoggedError):
            self.put(lambda _: self._attempt(partial(self.writer.add_metadata, "session", values)), chosen)
        return _Session(self, chosen)

    @property
    def pressed(self) -> bool:
        """Whether so much waits that only what cannot be made again should be written."""
        return 2 * self._bytes > self._most_bytes

    def put(self, step: Step, session: str, size: int = 0) -> None:
        """Let something be written after all that came before.

        Args:
            step: writes it.
            session: that it is of.
            size: how much memory it keeps [byte].

        Raises:
            NotLoggedError: it will not be: there is no room, or the log has ended.
        """
        with self._changed:
            if self._closed or self.failure is not None or not self._has_room(size):
                self._leave_out(session)
            for name, count in self._missing.items():
                self._append(partial(self._gap, name, count), name, 0)
            self._missing.clear()
            self._append(step, session, size)
            self._changed.notify_all()
            if self._kept_back_s <= 0:
                self._changed.wait_for(self._is_done)

    def add(self, topic: str, message_type: type[Any], content: bytes, **named: Any) -> None:
        """Write a message now, as `LogWriter.add` does; a log that cannot be written is cut."""
        self._attempt(partial(self.writer.add, topic, message_type, content, **named))

    def close(self) -> None:
        """Write all that waits, complete the file and give it its name.

        Raises:
            OutputError: it could not be written; what is there is beside it.
        """
        with self._changed:
            is_first, self._closed = not self._closed, True
            self._changed.notify_all()
        self._thread.join()
        if self.lost:
            LOG.warning("the log is not whole", extra={"fields": {"lost": dict(self.lost)}})
        if is_first:
            self._attempt(self.writer.close)
        if self.failure is not None:
            raise OutputError(
                f"{self.writer.path}: cannot be written: {self.failure}; see {self.writer.draft}"
            )

    def _has_room(self, size: int) -> bool:
        waiting = len(self._entries) + self._writing
        share = 0.5 if self._full else 1.0
        fits = self._bytes + size <= share * self._most_bytes and waiting < share * self._most_entries
        self._full = waiting > 0 and not fits
        return not self._full

    def _leave_out(self, session: str) -> None:
        ended = self._closed or self.failure is not None
        if not self._missing and not ended:
            waiting = {"waiting_bytes": self._bytes, "waiting_entries": len(self._entries)}
            LOG.warning(
                "the disk is slower than what is to be logged: the log has a gap",
                extra={"fields": {"session": session, **waiting}},
            )
        self.lost[session] += 1
        self._missing[session] += 1
        raise NotLoggedError("the log has ended" if ended else "the log has no room")

    def _append(self, step: Step, session: str, size: int) -> None:
        self._entries.append(_Entry(step, session, size, self._clock_ns()))
        self._bytes += size

    def _is_done(self) -> bool:
        return not self._entries and not self._writing

    def _work(self) -> None:
        due_s: float | None = None
        while True:
            with self._changed:
                patience_s = None if due_s is None else max(due_s - time.monotonic(), 0.0)
                self._changed.wait_for(lambda: self._entries or self._closed, patience_s)
                if not self._entries and self._closed:
                    break
                entry = self._entries.popleft() if self._entries else None
                self._writing = entry is not None
            if entry is not None:
                self._write(entry)
                due_s = time.monotonic() + self._kept_back_s if due_s is None else due_s
            if due_s is not None and time.monotonic() >= due_s:
                self._attempt(self.writer.flush)
                due_s = None
            with self._changed:
                self._writing = False
                self._bytes -= 0 if entry is None else entry.size
                self._changed.notify_all()
        for session, count in self._missing.items():
            self._write(_Entry(partial(self._gap, session, count), session, 0, self._clock_ns()))

    def _write(self, entry: _Entry) -> None:
        try:
            entry.step(entry.time_ns)
        except Exception as error:  # noqa: BLE001 - one entry that cannot be stated must not end the log
            LOG.error("an entry cannot be logged", extra={"fields": {"error": repr(error)}})  # noqa: TRY400
            with self._changed:
                self._missing[entry.session] += 1
                self.lost[entry.session] += 1
            return
        if self.failure is not None:
            with self._changed:
                self.lost[entry.session] += 1

    def _attempt(self, step: Callable[[], None]) -> None:
        """Do a step with the file; one that cannot be written ends the log, and not what it is a log of."""
        if self.failure is not None:
            return
        try:
            step()
        except Exception as error:  # noqa: BLE001 - whatever a full disk or a foreign writer does
            LOG.error("the log is cut: it cannot be written", extra={"fields": {"error": repr(error)}})  # noqa: TRY400
            with self._changed:
                self.failure = error
                self.lost.update(entry.session for entry in self._entries)
                self._bytes -= sum(entry.size for entry in self._entries)
                self._entries.clear()
                self._changed.notify_all()

    def _gap(self, session: str, count: int, time_ns: int) -> None:
        reason = f"{count} entries are missing here: the disk was slower than what came"
        status = fusion_pb2.Status(status=0, cause="log-gap", reason=reason)
        topic, content = f"/{session}/gap", serialised(status)
        self.add(topic, type(status), content, session=session, what="gap", log_time_ns=time_ns)


class _Session:
    """Writes what happens in one session; not for several threads at once, as interfaces call their observers."""

    def __init__(self, box: BlackBox, name: str) -> None:
        self._box, self._name = box, name
        self._time_ns = 0
        self._setting: Setting | None = None
        self._drawn: dict[str, set[str]] = {}

    def __call__(self, event: Event) -> None:
        """Let an event be written.

        Raises:
            NotLoggedError: it will not be.
        """
        held = event.accepted.record if isinstance(event, Dropped) else getattr(event, "record", None)
        size = _OVERHEAD + (size_of(held) if isinstance(held, SentRecord | ResultRecord) else 0)
        self._box.put(partial(self._event, event), self._name, size)

    def _event(self, event: Event, time_ns: int) -> None:
        self._time_ns = time_ns
        match event:
            case Accepted():
                self._accepted(event)
            case Refused():
                self._refused(event)
            case Dropped():
                record = event.accepted.record
                self._record(f"dropped/{kind_of(record).name}", record, "dropped-record")
            case Moved():
                self._add("motion", motion_request(event.sent, session=self._name), "motion")
            case Flushed():
                self._add("flush", fusion_pb2.FlushRequest(session=self._name), "flush")
            case Result():
                self._given(event)

    def _accepted(self, event: Accepted) -> None:
        """Write a record that was taken, after the configuration in force where that is another."""
        if event.setting is not self._setting:
            self._configured(event.setting)
        kind = kind_of(event.record).name
        name = f"{_SENSORS[kind]}/{event.sensor_id}/{kind}"
        self._record(name, event.record, "record")
        if self._shows:
            shown = shown_records(event.record, self._frame(str(event.kind), event.sensor_id))
            for part, record in shown.items():
                self._show(f"{name}/{part}_shown", record, event.record.timestamp.nanoseconds)

    def _refused(self, event: Refused) -> None:
        """Write why a record was not taken, and the record where it is one."""
        outcome = event.outcome
        status = fusion_pb2.Status(status=outcome.status, cause=outcome.cause, reason=outcome.reason)
        self._add("refused", status, "refused")
        if isinstance(event.record, SentRecord):
            self._record(f"refused/{kind_of(event.record).name}", event.record, "refused-record")

    def _given(self, result: Result) -> None:
        """Write a result; of its configuration the revision, for it stands in the file already."""
        record = result.record
        reply = fusion_pb2.GetReply(number=result.number)
        reply.configuration.revision = result.configuration.revision
        topic, time_ns = f"results/{kind_of(record).name}", record.timestamp.nanoseconds
        self._write(topic, fusion_pb2.GetReply, encode_in(reply, record), "result", time_ns)
        if not self._shows:
            return
        lidar, camera = self._frame("lidar", record.lidar_id), self._frame("camera", record.camera_id)
        in_camera = not isinstance(record, FusedDetections) and record.point_frame == "camera"
        for part, shown in shown_records(record, camera if in_camera else lidar, camera).items():
            if part != "image":  # it is there as it was sent
                self._show(f"fused/camera{record.camera_id}_lidar{record.lidar_id}/{part}", shown, time_ns)

    @property
    def _shows(self) -> bool:
        """Whether viewers get their own form: not while the disk lags behind, for it can be made of ours."""
        return self._box.shown and not self._box.pressed

    def _configured(self, setting: Setting) -> None:
        before, self._setting = self._setting, setting
        if before is None or before.properties is not setting.properties:
            self._add("configuration", properties_message(setting.properties), "properties")
            self._add("algorithms", value_to_protobuf(setting.properties.algorithms), "algorithms")
        known = {} if before is None else before.table.entries
        for pair, entry in setting.table.entries.items():
            if known.get(pair) is not entry:
                request = fusion_pb2.SetCalibrationRequest(
                    camera_id=pair[0], lidar_id=pair[1], session=self._name
                )
                fill_message(request.calibration, entry.data)
                self._add("calibration", request, "calibration")
        if set(known) - set(setting.table.entries):
            self._add("pairs", value_to_protobuf(list(setting.table.entries)), "pairs")
        if self._box.shown:
            for camera_id, camera_model in _shown_camera_models(setting, self._frame).items():
                self._show(f"camera/{camera_id}/camera model", camera_model)
            for transform in _shown_transforms(setting, self._frame):
                self._show("frames", transform)

    def _frame(self, kind: str, sensor_id: int) -> str:
        return f"{self._name}/{kind}{sensor_id}"

    def _record(self, name: str, record: SentRecord, what: str) -> None:
        message_type = getattr(fusion_pb2, kind_of(record).message_name)
        self._write(name, message_type, encode(record), what, record.timestamp.nanoseconds)

    def _add(self, name: str, message: Message, what: str) -> None:
        self._write(name, type(message), serialised(message), what)

    def _show(self, name: str, record: AnyRecord, timestamp_ns: int | None = None) -> None:
        if isinstance(record, Boxes3DRecord):  # viewers keep a box until it is taken away
            drawn = {box.id for box in record.boxes}
            record = replace(record, gone=tuple(sorted(self._drawn.get(name, set()) - drawn)))
            self._drawn[name] = drawn
        schema, parts = encode_shown(record)
        self._write(name, foxglove_type(schema), b"".join(parts), "shown", timestamp_ns)

    def _write(
        self,
        name: str,
        message_type: type[Any],
        content: bytes,
        what: str,
        timestamp_ns: int | None = None,
    ) -> None:
        self._box.add(
            f"/{self._name}/{name}", message_type, content, session=self._name, what=what,
            timestamp_ns=timestamp_ns, log_time_ns=self._time_ns,
        )  # fmt: skip
