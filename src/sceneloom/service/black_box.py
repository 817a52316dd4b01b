"""The black box: all that came into sessions and went out of them, in one MCAP file that can be played again."""

import logging
from collections.abc import Callable, Mapping
from contextlib import suppress
from dataclasses import replace
from pathlib import Path
from types import TracebackType
from typing import Any, Self

from google.protobuf.message import Message

from sceneloom.formats.mcap.foxglove_writing import encode as encode_shown
from sceneloom.formats.mcap.schemas import foxglove_type, serialised
from sceneloom.formats.topics.records import AnyRecord, Boxes3DRecord
from sceneloom.fusion.admitted import Admitted
from sceneloom.fusion.events import Dropped, Event, Refused, Result
from sceneloom.fusion.messages.fused import FusedDetections
from sceneloom.fusion.messages.protobuf_form import encode, encode_in, fill_message
from sceneloom.fusion.messages.records import ResultRecord, SentRecord, kind_of, size_of
from sceneloom.fusion.messages.wire import fusion_pb2
from sceneloom.fusion.queues import Flushed, Moved
from sceneloom.fusion.setting import Setting
from sceneloom.service.log_file import LogWriter
from sceneloom.service.log_queue import LogQueue, NotLoggedError
from sceneloom.service.log_shown import shown_lenses, shown_records, shown_transforms
from sceneloom.service.motion_form import motion_request
from sceneloom.service.replies import properties_message
from sceneloom.service.values import value_to_protobuf
from sceneloom.version import __version__

LOG = logging.getLogger(__name__)

_OVERHEAD = 2048
"""What an entry that waits keeps beside its arrays [byte], about."""


class BlackBox:
    """Writes what happens in sessions; give `session(name)` as the observer of each, or the box itself for one.

    A thread of its own writes, so the arrays of records have to stay as they are after they were sent. Neither a file
    that cannot be written nor a disk that is too slow disturbs the sessions: `failure`, `lost` and `close` tell.

    Attributes:
        writer: the file.
        queue: what waits to be written.
        shown: whether pictures, clouds, boxes and results are written once more as MCAP viewers know them.
    """

    def __init__(
        self, path: str | Path, *, shown: bool = True, overwrite: bool = False, **waiting: Any
    ) -> None:
        """Begin a log.

        Args:
            path: of the MCAP file; until it is closed it stands beside as `NAME.unfinished.mcap`.
            shown: whether viewers are to show it; without, files are half as large.
            overwrite: replace a log that is there.
            waiting: of `LogQueue`: most_bytes, most_entries, kept_back_s, clock_ns.

        Raises:
            OutputError: the file is there, or cannot be written.
        """
        self.writer = LogWriter(Path(path), overwrite=overwrite, on_failure=self._failed)
        self.queue = LogQueue(self.writer.flush, self._gap, **waiting)
        self.shown = shown
        self._names: set[str] = set()
        self._own: Callable[[Event], None] | None = None

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
        told = {"session": chosen, "sceneloom": __version__}
        with suppress(NotLoggedError):
            self.queue.put(lambda _: self.writer.add_metadata("session", told), session=chosen)
        return SessionLog(self.writer, self.queue, chosen, shown=self.shown)

    @property
    def failure(self) -> Exception | None:
        """Why nothing is written any more; None while all is well."""
        return self.writer.failure

    @property
    def lost(self) -> Mapping[str, int]:
        """By session, how many entries are not in the log: the disk was too slow, or failed."""
        return dict(self.queue.lost)

    def close(self) -> None:
        """Write all that waits, complete the file and give it its name.

        Raises:
            OutputError: it could not be written.
        """
        self.queue.close()
        if self.lost:
            LOG.warning("the log is not whole", extra={"fields": {"lost": self.lost}})
        self.writer.close()

    def _failed(self, error: Exception) -> None:
        LOG.error("the log is cut: it cannot be written", extra={"fields": {"error": repr(error)}})
        self.queue.cut()

    def _gap(self, session: str, count: int, time_ns: int) -> None:
        reason = f"{count} entries are missing here: the disk was slower than what came"
        status = fusion_pb2.Status(status=0, cause="log-gap", reason=reason)
        self.writer.add(
            f"/{session}/gap",
            type(status),
            serialised(status),
            session=session,
            what="gap",
            log_time_ns=time_ns,
        )


class SessionLog:
    """Writes what happens in one session; not for several threads at once, as interfaces call their observers."""

    def __init__(self, writer: LogWriter, queue: LogQueue, session: str, *, shown: bool) -> None:
        """Write into a file under a name."""
        self._writer = writer
        self._queue = queue
        self._time_ns = 0
        self._session = session
        self._shown = shown
        self._setting: Setting | None = None
        self._drawn: dict[str, set[str]] = {}

    def __call__(self, event: Event) -> None:
        """Let an event be written.

        Raises:
            NotLoggedError: it will not be.
        """
        self._queue.put(
            lambda time_ns: self._event(event, time_ns), session=self._session, size=_kept_by(event)
        )

    def _event(self, event: Event, time_ns: int) -> None:
        self._time_ns = time_ns
        _WRITERS[type(event)](self, event)

    def admitted(self, event: Admitted) -> None:
        """Write a record that was taken, after the configuration in force where that is another."""
        self._configured(event.setting)
        name = _source(event.record, event.sensor_id)
        self._record(name, event.record, "record")
        if self._shows:
            self._show(name, event.record, str(event.kind), event.sensor_id)

    def refused(self, event: Refused) -> None:
        """Write why a record was not taken, and the record where it is one."""
        outcome = event.outcome
        status = fusion_pb2.Status(status=outcome.status, cause=outcome.cause, reason=outcome.reason)
        self._add("refused", status, "refused")
        if isinstance(event.record, SentRecord):
            self._record(f"refused/{kind_of(event.record).name}", event.record, "refused-record")

    def dropped(self, event: Dropped) -> None:
        """Write a record that was taken and never fused."""
        self._record(
            f"dropped/{kind_of(event.admitted.record).name}", event.admitted.record, "dropped-record"
        )

    def moved(self, event: Moved) -> None:
        """Write where the vehicle was."""
        self._add("motion", motion_request(event.sent, session=self._session), "motion")

    def flushed(self, _: Flushed) -> None:
        """Write that what waited was fused."""
        self._add("flush", fusion_pb2.FlushRequest(session=self._session), "flush")

    def given(self, result: Result) -> None:
        """Write a result; of its configuration the revision, for it stands in the file already."""
        record = result.record
        reply = fusion_pb2.GetReply(number=result.number)
        reply.configuration.revision = result.configuration.revision
        content = encode_in(reply, record)
        self._write(
            f"results/{kind_of(record).name}",
            fusion_pb2.GetReply,
            content,
            "result",
            record.timestamp.nanoseconds,
        )
        if self._shows:
            self._show_result(result)

    @property
    def _shows(self) -> bool:
        """Whether viewers get their own form: not while the disk lags behind, for it can be made of ours."""
        return self._shown and not self._queue.pressed

    def _configured(self, setting: Setting) -> None:
        before = self._setting
        if setting is before:
            return
        self._setting = setting
        if before is None or before.properties is not setting.properties:
            self._add("configuration", properties_message(setting.properties), "properties")
            self._add("algorithms", value_to_protobuf(setting.properties.algorithms), "algorithms")
        known = {} if before is None else before.table.entries
        for pair, entry in setting.table.entries.items():
            if known.get(pair) is not entry:
                request = fusion_pb2.SetCalibrationRequest(
                    camera_id=pair[0], lidar_id=pair[1], session=self._session
                )
                fill_message(request.calibration, entry.data)
                self._add("calibration", request, "calibration")
        if set(known) - set(setting.table.entries):
            self._add("pairs", value_to_protobuf(list(setting.table.entries)), "pairs")
        if self._shown:
            self._show_setting(setting)

    def _show_setting(self, setting: Setting) -> None:
        for camera_id, lens in shown_lenses(setting, self._frame).items():
            self._add_shown(f"camera/{camera_id}/lens", lens)
        for transform in shown_transforms(setting, self._frame):
            self._add_shown("frames", transform)

    def _show(self, name: str, record: SentRecord, kind: str, sensor_id: int) -> None:
        for part, shown in shown_records(record, self._frame(kind, sensor_id)).items():
            self._add_shown(f"{name}/{part}_shown", shown, record.timestamp.nanoseconds)

    def _show_result(self, result: Result) -> None:
        record = result.record
        lidar, camera = self._frame("lidar", record.lidar_id), self._frame("camera", record.camera_id)
        in_camera = not isinstance(record, FusedDetections) and record.point_frame == "camera"
        for part, shown in shown_records(record, camera if in_camera else lidar, camera).items():
            topic = f"fused/camera{record.camera_id}_lidar{record.lidar_id}/{part}"
            if part != "image":  # it is there as it was sent
                self._add_shown(topic, shown, record.timestamp.nanoseconds)

    def _frame(self, kind: str, sensor_id: int) -> str:
        return f"{self._session}/{kind}{sensor_id}"

    def _record(self, name: str, record: SentRecord, what: str) -> None:
        message_type = getattr(fusion_pb2, kind_of(record).message_name)
        self._write(name, message_type, encode(record), what, record.timestamp.nanoseconds)

    def _add(self, name: str, message: Message, what: str) -> None:
        self._write(name, type(message), serialised(message), what)

    def _add_shown(self, name: str, record: AnyRecord, timestamp_ns: int | None = None) -> None:
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
        self._writer.add(
            f"/{self._session}/{name}",
            message_type,
            content,
            session=self._session,
            what=what,
            timestamp_ns=timestamp_ns,
            log_time_ns=self._time_ns,
        )


_WRITERS: dict[type, Callable[[SessionLog, Any], None]] = {
    Admitted: SessionLog.admitted,
    Refused: SessionLog.refused,
    Dropped: SessionLog.dropped,
    Moved: SessionLog.moved,
    Flushed: SessionLog.flushed,
    Result: SessionLog.given,
}
"""How each event is written."""


def _kept_by(event: Event) -> int:
    """How much memory an event keeps while it waits [byte], about."""
    held = event.admitted.record if isinstance(event, Dropped) else getattr(event, "record", None)
    return _OVERHEAD + (size_of(held) if isinstance(held, SentRecord | ResultRecord) else 0)


def _source(record: Any, sensor_id: int) -> str:
    """The topic of records of a sensor: `camera/1/image`."""
    return f"{_SENSORS[kind_of(record).name]}/{sensor_id}/{kind_of(record).name}"


_SENSORS = {
    "raw": "sensor",
    "image": "camera",
    "boxes_2d": "camera",
    "points": "lidar",
    "boxes_3d": "lidar",
}
