"""Frames on their way into a file: arrays spooled to disk as they come, the sensors that they belong to, the clock.

Points and images.
"""

import ctypes
import io
import os
import shutil
import sys
from collections.abc import Callable, Iterable, Mapping
from dataclasses import dataclass, field
from functools import lru_cache, partial
from mmap import ACCESS_READ, mmap
from pathlib import Path
from types import TracebackType
from typing import Any, Self

import numpy as np

from sceneloom.arrays import AnyArray, Float32Array, Int64Array
from sceneloom.errors import ArrayError, DataError, OptionError
from sceneloom.formats.base.files import open_file
from sceneloom.formats.base.images import JPEG_QUALITY, encode_jpeg
from sceneloom.formats.base.losses import Loss, Support, joined
from sceneloom.formats.sfs.clock import UINT32_MAX, UINT64_MAX, FileClock, chosen_offset_ns
from sceneloom.formats.sfs.images import declared_length, is_mp4
from sceneloom.formats.sfs.profiles import Profile
from sceneloom.formats.sfs.records import mount_rows, with_extras
from sceneloom.formats.sfs.sensors import ImageNotesWriter, exposure_ns
from sceneloom.geometry.rigid import RigidTransform
from sceneloom.scene.cameras import CameraImage, CameraSensor, VideoContent
from sceneloom.scene.clouds import LidarFrame, LidarPoints, RadarFrame
from sceneloom.scene.poses import Poses
from sceneloom.scene.types import Identifier, PointsFrame

_BLOCK = 4096
"""Space can be put into a file in multiples of the block of its file system, which is nearly always this [bytes]."""

_EXTEND, _INSERT_RANGE = 0x00, 0x20


def _allocate(descriptor: int, start: int, length: int) -> bool:
    """Have space for bytes that will be written; pages of it are then cheaper to fill. The file grows.

    Source: fallocate(2) of Linux, mode 0.
    """
    return _fallocate(descriptor, _EXTEND, start, length)


def _insert(descriptor: int, length: int) -> bool:
    """Put space before the first byte of a file without copying what follows.

    Args:
        length: a multiple of `_BLOCK`.

    Source: fallocate(2) of Linux, mode FALLOC_FL_INSERT_RANGE, which ext4 and XFS know.
    """
    return _fallocate(descriptor, _INSERT_RANGE, 0, length)


def _fallocate(descriptor: int, mode: int, start: int, length: int) -> bool:
    call = _system_call()
    return call is not None and call(descriptor, mode, start, length) == 0


@lru_cache(maxsize=1)
def _system_call() -> Any:
    """Find the function in the C library; unlike `os.posix_fallocate` it does not write zeros where it cannot."""
    if not sys.platform.startswith("linux"):
        return None
    try:
        call = ctypes.CDLL(None, use_errno=True).fallocate64
    except (OSError, AttributeError):
        return None
    call.argtypes = [ctypes.c_int, ctypes.c_int, ctypes.c_int64, ctypes.c_int64]
    call.restype = ctypes.c_int
    return call


ALIGNMENT = 64
"""A cache line, and enough for every dtype and vector instruction."""

_NULS = bytes(2 * ALIGNMENT)
_GAP = 4
_IN_MEMORY = 8 << 20
_GATHERED = 1 << 20
_SMALL = 1 << 16
_ALLOCATED = 64 << 20


@dataclass(frozen=True, slots=True, eq=False)
class Blob:
    """An array that stands in the spool, and in the header's tree until its item is written.

    Attributes:
        offset: of its first byte, from the end of the header.
        length: in bytes.
        dtype: NumPy's name.
        shape: as the array had it.
    """

    offset: int
    length: int
    dtype: str
    shape: tuple[int, ...]


class Spool:
    """Collects arrays for a file whose header comes last."""

    def __init__(self, draft: Path, *, reserve: Callable[[], int]) -> None:
        """Start empty.

        Args:
            draft: the file to be written.
            reserve: says how many bytes the header is expected to take; asked when the arrays go to disk.
        """
        self._draft = draft
        self._reserve = reserve
        self._file: io.FileIO | None = None
        self._start = 0
        self._gathered = bytearray(ALIGNMENT)
        self._end = ALIGNMENT
        self._allocated = 0

    def __enter__(self) -> Self:
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        if self._file is not None:
            self._file.close()

    def add(self, array: AnyArray) -> Blob:
        """Write an array, byte for byte, in little-endian order."""
        dtype, name = _form_of(array.dtype)
        if array.nbytes < _SMALL:
            content: Any = array.astype(dtype, copy=False).tobytes()
        else:
            content = np.ascontiguousarray(array, dtype).reshape(-1).view(np.uint8).data
        self._write(content, array.nbytes)
        return self._added(array.nbytes, name, array.shape)

    def add_file(self, path: Path) -> Blob:
        """Write the bytes of a file as an array of uint8."""
        length = path.stat().st_size
        with path.open("rb", buffering=0) as source:
            if length < _SMALL:
                self._write(source.read(), length)
            else:
                _copy(source, 0, self._file_for(length))
        return self._added(length, "uint8", (length,))

    def change(self, blob: Blob, change: Callable[[AnyArray], AnyArray]) -> None:
        """Replace an array by one of the same shape and dtype."""
        if self._file is None:
            location = slice(blob.offset, blob.offset + blob.length)
            old = bytes(self._gathered[location])
            self._gathered[location] = _changed(old, blob, change)
            return
        file = self._file_for(0)
        file.seek(self._start + blob.offset)
        content = _changed(_read_all(file, blob.length), blob, change)
        file.seek(self._start + blob.offset)
        _write_all(file, content)
        file.seek(self._start + self._end)

    def finish(self, header: bytes) -> None:
        """Put the header, padded with blanks, before the arrays; the draft is then complete."""
        if self._file is None:
            with self._draft.open("wb", buffering=0) as file:
                _write_all(file, header.ljust(_aligned(len(header))), self._gathered)
            return
        file = self._file_for(0)
        file.truncate(self._start + self._end)
        missing = -(-max(0, len(header) - self._start) // _BLOCK) * _BLOCK
        front = header.ljust(self._start + missing)
        if missing and not _insert(file.fileno(), missing):
            self._copy_behind(front, file)
        else:
            file.seek(0)
            _write_all(file, front)
        file.close()

    def _copy_behind(self, front: bytes, spooled: io.FileIO) -> None:
        whole = self._draft.with_name(self._draft.name + ".whole")
        with whole.open("wb", buffering=0) as file:
            _write_all(file, front)
            _copy(spooled, self._start, file)
        spooled.close()
        whole.replace(self._draft)

    def _write(self, content: Any, length: int) -> None:
        """Gather small arrays, write large ones; a caller may change its array as soon as this returns."""
        in_memory = self._file is None and self._end + length <= _IN_MEMORY
        if in_memory or (length < _SMALL and len(self._gathered) < _GATHERED):
            self._gathered += content
        else:
            _write_all(self._file_for(length), content)

    def _file_for(self, length: int) -> io.FileIO:
        """Give the draft, opened at its first use, all gathered arrays written, with room for `length` bytes more."""
        if self._file is None:
            self._start = _aligned(self._reserve())
            self._file = self._draft.open("w+b", buffering=0)
            self._file.seek(self._start)
        file, wanted = self._file, self._start + self._end + length
        if length and wanted > self._allocated:
            self._allocated = max(self._allocated, self._start) + max(_ALLOCATED, wanted - self._allocated)
            _allocate(file.fileno(), 0, self._allocated)
        if self._gathered:
            _write_all(file, self._gathered)
            self._gathered = bytearray()
        return file

    def _added(self, length: int, dtype: str, shape: tuple[int, ...]) -> Blob:
        start, stop = self._end, self._end + length
        self._end = -(-(stop + _GAP) // ALIGNMENT) * ALIGNMENT
        self._gathered += _NULS[: self._end - stop]
        return Blob(start, length, dtype, shape)


@lru_cache(maxsize=64)
def _form_of(dtype: np.dtype[Any]) -> tuple[np.dtype[Any], str]:
    """The little-endian dtype, and NumPy's name of it, which it takes long to put together."""
    return dtype.newbyteorder("<"), dtype.name


def _changed(content: bytes, blob: Blob, change: Callable[[AnyArray], AnyArray]) -> bytes:
    old = np.frombuffer(content, blob.dtype).reshape(blob.shape)
    return change(old).astype(blob.dtype, copy=False).tobytes()


def _aligned(length: int) -> int:
    return -(-length // ALIGNMENT) * ALIGNMENT


def _write_all(file: io.FileIO, *contents: Any) -> None:
    for content in contents:
        rest = memoryview(content)
        while rest:
            rest = rest[file.write(rest) :]


def _read_all(file: io.FileIO, length: int) -> bytes:
    content = bytearray()
    while len(content) < length and (piece := file.read(length - len(content))):
        content += piece
    return bytes(content)


def _copy(source: io.FileIO, start: int, target: io.FileIO) -> None:
    """Append what lies behind `start` of one file to another, inside the kernel where that is possible."""
    stop = os.fstat(source.fileno()).st_size
    try:
        while start < stop:
            start += os.copy_file_range(source.fileno(), target.fileno(), stop - start, start)
    except (AttributeError, OSError):
        source.seek(start)
        shutil.copyfileobj(source, target, _GATHERED)


_LATEST_STATIONARY_NS = 100_000_000_000


class Losses:
    """Counts what a file cannot hold, by field."""

    def __init__(self) -> None:
        """Start without losses."""
        self._found: dict[tuple[str, str, str | None, Support], Loss] = {}

    def add(
        self,
        field: str,
        what: str,
        *,
        count: int = 1,
        kept: str | None = None,
        support: Support = Support.DROPPED,
        largest_error: float | None = None,
    ) -> None:
        """Note a loss."""
        if count:
            reported = Loss(
                field=field, what=what, count=count, kept=kept, support=support, largest_error=largest_error
            )
            self._add(reported)

    def add_all(self, others: "Losses") -> None:
        """Note the losses of another count."""
        for loss in others.all():
            self._add(loss)

    def _add(self, loss: Loss) -> None:
        key = (loss.field, loss.what, loss.kept, loss.support)
        earlier = self._found.get(key)
        self._found[key] = loss if earlier is None else joined(earlier, loss)

    def all(self) -> list[Loss]:
        """All losses, those of one field and kind added up."""
        return list(self._found.values())


@dataclass(slots=True)
class SensorDraft:
    """One sensor.

    Attributes:
        id, type: as in the file.
        fields: what stands in its record besides poses and frames.
        note: what stands about it in our metadata.
        points_frame: the frame of its points, where it has any.
        poses: where it was; None: not known.
        mount: `ego_from_sensor`, where it is known.
        coordinates: the frame that `poses` lead into; None for sensors without.
        further_poses: unknown fields of `poses`.
        frames: records of its frames so far; None where it has none.
        point_times: the spooled times of points.
        lengths: of radar points, one entry per frame, where the profile has no field for them.
        streamed: whether frames may still come.
    """

    id: Identifier
    type: str
    fields: dict[str, Any]
    note: dict[str, Any] = field(default_factory=dict)
    points_frame: str | None = None
    poses: Poses | None = None
    mount: RigidTransform | None = None
    coordinates: str | None = None
    further_poses: Mapping[str, Any] = field(default_factory=dict)
    frames: list[dict[str, Any]] | None = None
    point_times: list[Blob] = field(default_factory=list)
    lengths: list[Any] = field(default_factory=list)
    streamed: bool = True

    @property
    def location(self) -> str:
        """Path of the sensor, for losses and messages."""
        return f"sensors[{self.id}]"

    def first_ns(self) -> int | None:
        """The earliest timestamp that stands in the sensor's record so far [ns]."""
        timestamps = [frame["timestamp"] for frame in self.frames or []]
        # sensors of unknown types may have fields of these names that are something else
        fields = self.fields if self.type == "camera" else {}
        timestamps += [image["timestamp"] for image in fields.get("images") or []]
        video = fields.get("video")
        if video is not None and len(video["timestamps"]):
            timestamps.append(int(min(video["timestamps"])))
        if self.poses is not None and not self.poses.static:
            timestamps.append(self.poses.start_ns)
        return min(timestamps, default=None)

    def record(self, clock: FileClock, losses: Losses) -> dict[str, Any]:
        """Make the sensor's record; poses get the file's resolution here."""
        record: dict[str, Any] = {"id": self.id, "type": self.type}
        if self.coordinates is not None:
            record |= self._position_in_world(clock, losses)
        elif self.poses is not None:
            record["poses"] = self._poses(self.poses, clock, losses)
        if self.poses is not None and len(self.poses.timestamps_ns) == 1:
            self.note["poses_static"] = self.poses.static
        if self.frames is not None:
            record["frames"] = self.frames
        if any(length is not None for length in self.lengths):
            self.note["lengths"] = self.lengths
        return {**record, **{name: value for name, value in self.fields.items() if name not in record}}

    def _position_in_world(self, clock: FileClock, losses: Losses) -> dict[str, Any]:
        """Write `coordinates` and `poses`; a sensor of which only the mounting is known is placed on the ego."""
        if self.mount is not None:
            self.note["mount"] = mount_rows(self.mount)
        if self.poses is not None:
            return {"coordinates": self.coordinates, "poses": self._poses(self.poses, clock, losses)}
        if self.mount is None:
            losses.add(f"{self.location}.poses", "not known, left out; the format wants them", support=Support.KEPT)
            return {"coordinates": self.coordinates}
        what = "not known; the mounting is written, in ego coordinates"
        losses.add(f"{self.location}.poses", what, support=Support.KEPT)
        self.note |= {"poses_from_mount": True, "coordinates": self.coordinates}
        values = [[*self.mount.translation.tolist(), *self.mount.quaternion_xyzw.tolist()]]
        return {"coordinates": "ego", "poses": {"timestamps": [self._stationary_ns(clock)], "values": values}}

    def _poses(self, path: Poses, clock: FileClock, losses: Losses) -> dict[str, Any]:
        """Write a path; of poses that fall on one timestamp the first stays."""
        rows = np.hstack([path.positions, path.quaternions_xyzw])
        if path.static:
            return with_extras({"timestamps": [self._stationary_ns(clock)], "values": rows}, self.further_poses)
        timestamps, _ = clock.timestamp_array(path.timestamps_ns)
        kept = np.concatenate([[True], np.diff(timestamps) > 0])
        what = "left out: within one tick of the pose before"
        losses.add(f"{self.location}.poses", what, count=int((~kept).sum()))
        return with_extras({"timestamps": path.timestamps_ns[kept], "values": rows[kept]}, self.further_poses)

    def _stationary_ns(self, clock: FileClock) -> int:
        """The time to be written for a pose that holds at all times."""
        if self.poses is not None and 0 <= self.poses.start_ns - clock.offset_ns <= _LATEST_STATIONARY_NS:
            return self.poses.start_ns
        timestamps = [frame["timestamp"] for frame in self.frames or []]
        timestamps += [image["timestamp"] for image in self.fields.get("images") or []]
        return min(timestamps, default=max(clock.offset_ns, 0))


def check_new(drafts: Mapping[tuple[type, Identifier], SensorDraft], identifier: Identifier) -> None:
    """Refuse an id that stands for a sensor already.

    Raises:
        OptionError: it does.
    """
    if (type(identifier), identifier) in drafts:
        raise OptionError(f"sensor {identifier!r} is in the file already; expected an id of its own")


@dataclass(slots=True)
class ClockKeeper:
    """Chooses the offset.

    Attributes:
        tick_ns: length of the file's unit [ns].
        offset_ns: the offset; None until the first time is known.
        fixed: whether the caller chose the offset, so that it cannot move.
        spool: holds point times that have to follow when it moves.
        drafts: the sensors so far.

    Raises:
        OptionError: the offset is no whole number of ticks.
    """

    tick_ns: int
    offset_ns: int | None
    fixed: bool
    spool: Spool
    drafts: Iterable[SensorDraft]

    def __post_init__(self) -> None:
        if self.offset_ns is not None and self.offset_ns % self.tick_ns:
            raise OptionError(f"time_offset_ns {self.offset_ns}; expected whole microseconds")

    def clock_for(self, first_ns: int) -> FileClock:
        """Give the clock, which after this call can hold times from `first_ns` on.

        Raises:
            OptionError: the caller's offset is later, or point times written before do not fit any more.
        """
        if self.offset_ns is None:
            self.offset_ns = chosen_offset_ns(first_ns)
        elif first_ns < self.offset_ns:
            self._move(first_ns)
        return FileClock(self.tick_ns, self.offset_ns)

    @property
    def clock(self) -> FileClock:
        """The clock as it is; with offset 0 where no time is known."""
        return FileClock(self.tick_ns, self.offset_ns or 0)

    def _move(self, first_ns: int) -> None:
        old_ns, new_ns = self.clock.offset_ns, chosen_offset_ns(first_ns)
        if self.fixed:
            raise OptionError(f"time_offset_ns {old_ns}; expected at most {first_ns}, the earliest time of the scene")
        later = (old_ns - new_ns) // self.tick_ns
        self.offset_ns = new_ns
        clock = self.clock

        for draft in self.drafts:
            for number, blob in enumerate(draft.point_times):
                location = f"{draft.location}.frames[{number}]"
                self.spool.change(blob, partial(_moved, later=later, clock=clock, location=location))


def _moved(timestamps: AnyArray, *, later: int, clock: FileClock, location: str) -> AnyArray:
    if abs(later) >= 2**63:
        raise OptionError(f"{location}: point times {later} ticks later do not fit 64 bits")
    since = timestamps.astype(np.int64) + later
    if since.size:
        _check_timestamps(int(since.min()), int(since.max()), clock, location)
    return since.astype(_timestamp_dtype(clock))


def _timestamp_dtype(clock: FileClock) -> type[np.unsignedinteger[Any]]:
    """The type of point times, as in `point_times_dtype`."""
    return np.uint64 if clock.tick_ns == 1 else np.uint32


def _check_timestamps(lowest: int, highest: int, clock: FileClock, location: str) -> None:
    """Refuse point times, of which the first and the last timestamp are given, that the file's integers cannot hold.

    Raises:
        OptionError: naming what would hold them.
    """
    limit = UINT64_MAX if clock.tick_ns == 1 else UINT32_MAX
    if lowest < 0 or highest > limit:
        seconds = (lowest if lowest < 0 else highest) * clock.tick_ns / 1e9
        raise OptionError(
            f"{location}.points.timestamps: {seconds:.3f} s after the clock's zero; microseconds in 32 bits hold 0 to "
            "4294.967 s: choose another time offset, or `--time-unit nanoseconds`"
        )


_FARTHEST = 10_000.0
"""float32 resolves about 1 mm there: positions in the world beyond it need a nearer origin [m]."""

_ROUNDING = 0.5
"""How far a time is off at most where it is rounded [µs]."""

_FLOAT_TIMES = "file_seconds"
"""Readers of float seconds keep the file's own number of each point beside its time."""


@dataclass(slots=True)
class CloudWriter:
    """Spools the arrays of frames.

    Attributes:
        spool: takes the arrays.
        profile: says what may be written.
        losses: collects what cannot be held.
        verbatim: the frames come from a file of this format: timestamps and far positions pass as they are.
        keeper: gives the clock.
    """

    spool: Spool
    profile: Profile
    losses: Losses
    verbatim: bool
    keeper: ClockKeeper

    def add_lidar_frame(self, draft: SensorDraft, frame: LidarFrame) -> None:
        """Spool one sweep.

        Raises:
            DataError: positions too far away.
            OptionError: times that the file cannot hold.
        """
        points = frame.points
        self._check_reach(draft, points.positions)
        arrays = {
            "positions": points.positions,
            "colors": points.colors,
            "intensities": points.intensities,
            "timestamps": self._point_times(draft, points.timestamps_ns),
            "ring": points.rings,
            "camera_index": points.camera_index,
        }
        self._add(draft, frame, arrays)

    def add_radar_frame(self, draft: SensorDraft, frame: RadarFrame) -> None:
        """Spool one cycle.

        Raises:
            DataError: positions too far away.
            OptionError: times that the file cannot hold.
        """
        points = frame.points
        self._check_reach(draft, points.positions)
        lengths = None if points.lengths is None else self.spool.add(points.lengths)
        if not self.profile.radar_lengths:
            draft.lengths.append(lengths)
            if lengths is not None:
                what, kept = "Scale's library cannot load them", "metadata.sceneloom.sensor_notes[].lengths"
                self.losses.add(f"{draft.location}.frames[].points.lengths", what, kept=kept)
            lengths = None
        arrays = {
            "positions": points.positions,
            "directions": points.directions,
            "lengths": lengths,
            "timestamps": self._point_times(draft, points.timestamps_ns),
        }
        self._add(draft, frame, arrays)

    def unfused_points(self, points: LidarPoints) -> dict[str, Any]:
        """Spool points that stand, in their sensor's frame, under our metadata."""
        arrays = {
            "positions": points.positions,
            "colors": points.colors,
            "intensities": points.intensities,
            "timestamps_ns": points.timestamps_ns,
            "ring": points.rings,
        }
        return {name: self.spool.add(array) for name, array in arrays.items() if array is not None}

    def _add(self, draft: SensorDraft, frame: LidarFrame | RadarFrame, arrays: dict[str, Any]) -> None:
        extras = frame.points.extras
        further = {name: v for name, v in extras.items() if arrays.get(name) is None} if extras else {}
        if arrays["timestamps"] is not None and further.pop(_FLOAT_TIMES, None) is not None:
            what = "left out: the same times in another form"
            self.losses.add(f"{draft.location}.frames[].points.{_FLOAT_TIMES}", what, support=Support.CONVERTED)
        blobs = {
            name: self.spool.add(array) if isinstance(array, np.ndarray) else array
            for name, array in ({**arrays, **further} if further else arrays).items()
            if array is not None or name in further
        }
        timestamp_ns = self._frame_timestamp(draft, frame)
        frames = draft.frames if draft.frames is not None else []
        frames.append(with_extras({"timestamp": timestamp_ns, "points": blobs}, frame.extras))

    def _frame_timestamp(self, draft: SensorDraft, frame: LidarFrame | RadarFrame) -> int:
        """The start of a frame: its earliest point time, rounded down, so that it is later than no point."""
        times_ns, tick_ns = frame.points.timestamps_ns, self.keeper.tick_ns
        start_ns = frame.timestamp_ns
        if times_ns is not None and len(times_ns) and not (self.verbatim and self.profile.late_frames):
            earliest_ns = int(times_ns.min())
            start_ns = min(start_ns, earliest_ns) if self.verbatim else earliest_ns
        if start_ns // tick_ns != frame.timestamp_ns // tick_ns:
            what = "moved to the earliest point of the frame"
            self.losses.add(f"{draft.location}.frames[].timestamp", what, support=Support.APPROXIMATED)
        if start_ns % tick_ns:
            what, location = "rounded down to a whole microsecond", f"{draft.location}.frames[].timestamp"
            self.losses.add(location, what, support=Support.CONVERTED, largest_error=(start_ns % tick_ns) / 1e3)
        self.keeper.clock_for(start_ns)
        return start_ns // tick_ns * tick_ns

    def _point_times(self, draft: SensorDraft, times_ns: Int64Array | None) -> Blob | None:
        if times_ns is None or (len(times_ns) == 0 and not self.profile.empty_point_times):
            return None
        clock, span_ns = self.keeper.clock, None
        if len(times_ns):
            span_ns = (int(times_ns.min()), int(times_ns.max()))
            clock = self.keeper.clock_for(span_ns[0])
            location = f"{draft.location}.frames[{len(draft.frames or [])}]"
            _check_timestamps(*clock.timestamps_of_span(*span_ns), clock, location)
        timestamps, inexact = clock.timestamp_array(times_ns, dtype=_timestamp_dtype(clock), span_ns=span_ns)
        what = "rounded to whole microseconds, halves to even: at most 0.5 µs off"
        location = f"{draft.location}.frames[].points.timestamps"
        self.losses.add(location, what, count=inexact, support=Support.CONVERTED, largest_error=_ROUNDING)
        blob = self.spool.add(timestamps)
        draft.point_times.append(blob)
        return blob

    def _check_reach(self, draft: SensorDraft, positions: Float32Array) -> None:
        if self.verbatim or draft.points_frame != PointsFrame.WORLD or len(positions) == 0:
            return
        # two passes without a copy; where a number is none, both are, and the slow way follows
        if float(positions.min()) >= -_FARTHEST and float(positions.max()) <= _FARTHEST:
            return
        distances = np.abs(positions)
        # a point that is infinitely far is no point, as one that is no number
        farthest = float(np.max(distances, initial=0.0, where=np.isfinite(distances)))
        if farthest > _FARTHEST:
            row = int(np.flatnonzero((distances == farthest).any(axis=1))[0])
            raise DataError(
                "",
                f"{draft.location}.frames[{len(draft.frames or [])}].points.positions[{row}]",
                f"{farthest:.6g} m from the origin; float32 holds millimetres up to {_FARTHEST:.0f} m: take the point "
                "out if it is wrong, else write the drive in parts, each with an origin of its own (of a recording "
                "`sceneloom fuse` with `--start`, `--stop`)",
            )


_JPEG_START = b"\xff\xd8\xff"
_USUAL_FPS = 10.0
_PIECE = 1 << 20
_KEPT = "metadata.sceneloom.sensor_notes[].images"


@dataclass(slots=True)
class CameraDraft:
    """What a camera needs while its images come in.

    Attributes:
        draft: its record.
        notes: what single images have of their own.
    """

    draft: SensorDraft
    notes: ImageNotesWriter


@dataclass(slots=True)
class ImageWriter:
    """Spools videos and images.

    Attributes:
        spool: takes them.
        folder: for files that are needed on the way.
        losses: collects what cannot be held.
        verbatim: the images come from a file of this format and are copied, whatever they are.
    """

    spool: Spool
    folder: Path
    losses: Losses
    verbatim: bool

    def add_sensor(self, camera: CameraDraft, sensor: CameraSensor) -> None:
        """Write all images that a camera has: its video, else each as a JPEG."""
        count = len(sensor.images)
        content = None if sensor.video is None or count == 0 else self._video(camera.draft, sensor, sensor.video)
        if content is None:
            if sensor.fps is not None:
                camera.draft.note["fps"] = sensor.fps
                kept = "metadata.sceneloom.sensor_notes[].fps"
                self.losses.add(f"{camera.draft.location}.fps", "only videos have a rate", kept=kept)
            for image in sensor.images:
                self.add_image(camera, image)
            return
        starts = []
        for image in sensor.images:
            starts.append(image.timestamp_ns - self._half_exposure_ns(camera, image))
            camera.notes.add(image, image.extras)
        further = sensor.extras.get("video")
        video = {"timestamps": starts, "content": content, "fps": _fps(sensor.fps, starts)}
        camera.draft.fields["video"] = with_extras(video, further if isinstance(further, Mapping) else {})
        camera.draft.streamed = False

    def add_image(self, camera: CameraDraft, image: CameraImage) -> None:
        """Write one image as a JPEG, copied where it is one already."""
        encoded = None if image.encoded is None else image.encoded()
        if encoded is None or not (self.verbatim or encoded.startswith(_JPEG_START)):
            what = f"encoded as JPEG of quality {JPEG_QUALITY}"
            self.losses.add(f"{camera.draft.location}.images[].content", what, support=Support.APPROXIMATED)
            encoded = encode_jpeg(image.rgb)
        start_ns = image.timestamp_ns - self._half_exposure_ns(camera, image)
        content = self.spool.add(np.frombuffer(encoded, np.uint8))
        images = camera.draft.fields.setdefault("images", [])
        images.append(with_extras({"timestamp": start_ns, "content": content}, image.extras))
        camera.notes.add(image, {})

    def _half_exposure_ns(self, camera: CameraDraft, image: CameraImage) -> int:
        usual = exposure_ns(camera.draft.fields, 0)
        return exposure_ns(image.extras, usual) // 2

    def _video(self, draft: SensorDraft, sensor: CameraSensor, video: VideoContent) -> Blob | None:
        """Spool a camera's video as mp4; None where its images have to go one by one."""
        draft_file = self.folder / "video.mp4"
        if video.frame_indices is None and _copy_mp4(video, draft_file):
            _check_whole(draft_file, f"{draft.location}.video")
            return self._spooled(draft_file)
        return self._remuxed(draft, sensor, video, draft_file)

    def _remuxed(self, draft: SensorDraft, sensor: CameraSensor, video: VideoContent, draft_file: Path) -> Blob | None:
        from sceneloom.formats.video.remux import remux_to_mp4

        times_ns = sensor.images.timestamps_ns
        increasing = bool((np.diff(times_ns) > 0).all())
        try:
            with draft_file.open("w+b") as target:
                result = remux_to_mp4(
                    video.open,
                    target,
                    timestamps_seconds=(times_ns - times_ns[0]) / 1e9 if increasing else None,
                    frame_indices=video.frame_indices,
                    name=f"{draft.location}.video",
                )
        except OptionError:
            # an odd size cannot be encoded as H.264: the images become JPEGs
            draft_file.unlink()
            return None
        except ArrayError as error:
            raise DataError(f"{draft.location}.video", "", f"does not fit its timestamps: {error}") from error
        if result.images != len(times_ns):
            problem = f"{result.images} images; expected {len(times_ns)} as its timestamps"
            raise DataError(f"{draft.location}.video", "", problem)
        if not result.copied:
            what = f"encoded as {result.codec}: {result.reason}"
            self.losses.add(f"{draft.location}.video.content", what, support=Support.APPROXIMATED)
        return self._spooled(draft_file)

    def _spooled(self, file: Path) -> Blob:
        blob = self.spool.add_file(file)
        file.unlink()
        return blob


def _copy_mp4(video: VideoContent, target: Path) -> bool:
    """Copy a video that is mp4 already; report whether it was."""
    with video.open() as source:
        start = source.read(_PIECE)
        if not is_mp4(memoryview(start)):
            return False
        with target.open("wb") as file:
            while start:
                file.write(start)
                start = source.read(_PIECE)
    return True


def _check_whole(file: Path, location: str) -> None:
    """Refuse a copy of a video that ends before its last image.

    Raises:
        DataError: it does.
    """
    with open_file(file) as opened, mmap(opened.fileno(), 0, access=ACCESS_READ) as content:
        length = declared_length(content)
        if length > len(content):
            problem = f"{len(content)} bytes; its boxes state {length}: the video was cut"
            raise DataError(location, "", problem)


def _fps(nominal: float | None, starts_ns: list[int]) -> float:
    if nominal is not None:
        return nominal
    span_ns = starts_ns[-1] - starts_ns[0]
    return (len(starts_ns) - 1) / (span_ns / 1e9) if span_ns > 0 else _USUAL_FPS


def note_losses(camera: CameraDraft, losses: Losses) -> dict[str, Any] | None:
    """Make the note about single images, and state what stands only there."""
    own = camera.notes.own_cameras
    losses.add(f"{camera.draft.location}.images[].camera", "one camera model per camera", count=own, kept=_KEPT)
    return camera.notes.record()
