"""Writing a scene as a whole or as a stream; arrays are spooled as they come, and the header is made at the end."""

import ctypes
import io
import math
import os
import shutil
import sys
from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from contextlib import ExitStack, contextmanager
from dataclasses import dataclass, field, replace
from functools import lru_cache, partial
from mmap import ACCESS_READ, mmap
from pathlib import Path
from types import TracebackType
from typing import Any, Self

import msgspec
import numpy as np

from sceneloom.arrays import AnyArray, Float32Array, Int64Array
from sceneloom.cameras.camera import MODELS, Camera
from sceneloom.cameras.fitting import nearest
from sceneloom.errors import ArrayError, DataError, OptionError, without_folders
from sceneloom.formats.base.files import open_file
from sceneloom.formats.base.images import JPEG_QUALITY, encode_jpeg
from sceneloom.formats.base.losses import Losses, LossReport
from sceneloom.formats.base.output import replacing
from sceneloom.formats.base.registry import FORMATS
from sceneloom.formats.sfs.annotations import attribute_record, encode_annotation
from sceneloom.formats.sfs.clock import (
    READABLE_TICKS_NS,
    TICKS_NS,
    UINT32_MAX,
    UINT64_MAX,
    FileClock,
    StaticTime,
    chosen_offset_ns,
    point_times_dtype,
)
from sceneloom.formats.sfs.container import DTYPES, ITEMS, collector_paused, format_keys
from sceneloom.formats.sfs.profiles import Profile
from sceneloom.formats.sfs.reader import DEFAULT_EULER
from sceneloom.formats.sfs.records import OURS, Location, with_extras
from sceneloom.formats.sfs.schema import COEFFICIENT_COUNTS, RECORDS, Field, Kind, annotation_record, sensor_record
from sceneloom.formats.sfs.sensors import (
    GNSS_ARRAYS,
    LIDAR_ARRAYS,
    RADAR_ARRAYS,
    declared_length,
    exposure_ns,
    intrinsics_record,
    is_mp4,
)
from sceneloom.geometry.rigid import RigidTransform
from sceneloom.scene.annotations import (
    Annotation,
    Box2DAnnotation,
    CameraCalibration,
    CuboidAnnotation,
    EventAnnotation,
    LocalizationAdjustment,
    PointsAnnotation,
    ShapeAnnotation,
)
from sceneloom.scene.cameras import CameraImage, CameraSensor, DepthCameraSensor, VideoContent
from sceneloom.scene.clouds import LidarFrame, LidarSensor, PointsSensor, RadarFrame, RadarSensor
from sceneloom.scene.motion import GnssSensor, ImuSensor, OdometrySensor, PlainSensor
from sceneloom.scene.poses import Poses, Trajectory, same_direction
from sceneloom.scene.scene import Scene, Sensor
from sceneloom.scene.types import Identifier, PointsFrame, key_of
from sceneloom.warnings import DataWarning, WarningKind

ALIGNMENT = 64
"""A cache line, and enough for every dtype and vector instruction."""

_NULS = bytes(2 * ALIGNMENT)
_GAP = 4
_IN_MEMORY = 8 << 20
_GATHERED = 1 << 20
_SMALL = 1 << 16
_ALLOCATED = 64 << 20

_BLOCK = 4096
"""Space can be put into a file in multiples of the block of its file system, which is nearly always this [bytes]."""

_EXTEND, _INSERT_RANGE = 0x00, 0x20
"""Modes of fallocate(2) of Linux: reserve space, which is then cheaper to fill; put space before the first byte of a
file without copying what follows (FALLOC_FL_INSERT_RANGE, which ext4 and XFS know)."""


@dataclass(frozen=True, slots=True, eq=False)
class _Blob:
    """An array that stands in the spool, and in the header's tree until its item is written."""

    offset: int  # of its first byte, from the end of the header
    length: int  # in bytes
    dtype: str  # NumPy's name
    shape: tuple[int, ...]


class Spool:
    """Collects arrays for a file whose header comes last."""

    def __init__(self, draft: Path, *, reserve: Callable[[], int]) -> None:
        """Start empty.

        Args:
            draft: the file to be written.
            reserve: gives the bytes that the header is expected to take; called when the arrays go to disk.
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

    def add(self, array: AnyArray) -> _Blob:
        """Write an array, byte for byte, in little-endian order."""
        dtype, name = _form_of(array.dtype)
        if array.nbytes < _SMALL:
            content: Any = array.astype(dtype, copy=False).tobytes()
        else:
            content = np.ascontiguousarray(array, dtype).reshape(-1).view(np.uint8).data
        self._write(content, array.nbytes)
        return self._added(array.nbytes, name, array.shape)

    def add_file(self, path: Path) -> _Blob:
        """Write the bytes of a file as an array of uint8."""
        length = path.stat().st_size
        with path.open("rb", buffering=0) as source:
            if length < _SMALL:
                self._write(source.read(), length)
            else:
                _copy(source, 0, self._file_for(length))
        return self._added(length, "uint8", (length,))

    def change(self, blob: _Blob, change: Callable[[AnyArray], AnyArray]) -> None:
        """Replace an array by one of the same shape and dtype."""
        if self._file is None:
            location = slice(blob.offset, blob.offset + blob.length)
            self._gathered[location] = _changed(bytes(self._gathered[location]), blob, change)
            return
        file = self._file_for(0)
        file.seek(self._start + blob.offset)
        content = bytearray()
        while len(content) < blob.length and (chunk := file.read(blob.length - len(content))):
            content += chunk
        file.seek(self._start + blob.offset)
        _write_all(file, _changed(bytes(content), blob, change))
        file.seek(self._start + self._end)

    def finish(self, header: bytes) -> None:
        """Put the header, padded with blanks, before the arrays; the draft is then complete."""
        if self._file is None:
            with self._draft.open("wb", buffering=0) as file:
                _write_all(file, header.ljust(_aligned(len(header))), self._gathered)
            return
        spooled = self._file_for(0)
        spooled.truncate(self._start + self._end)
        missing = -(-max(0, len(header) - self._start) // _BLOCK) * _BLOCK
        front = header.ljust(self._start + missing)
        if not missing or _fallocate(spooled.fileno(), _INSERT_RANGE, 0, missing):
            spooled.seek(0)
            _write_all(spooled, front)
            spooled.close()
            return
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
            _fallocate(file.fileno(), _EXTEND, 0, self._allocated)
        if self._gathered:
            _write_all(file, self._gathered)
            self._gathered = bytearray()
        return file

    def _added(self, length: int, dtype: str, shape: tuple[int, ...]) -> _Blob:
        start, stop = self._end, self._end + length
        self._end = -(-(stop + _GAP) // ALIGNMENT) * ALIGNMENT
        self._gathered += _NULS[: self._end - stop]
        return _Blob(start, length, dtype, shape)


@lru_cache(maxsize=64)
def _form_of(dtype: np.dtype[Any]) -> tuple[np.dtype[Any], str]:
    """The little-endian dtype, and NumPy's name of it, which takes long to compute."""
    return dtype.newbyteorder("<"), dtype.name


def _changed(content: bytes, blob: _Blob, change: Callable[[AnyArray], AnyArray]) -> bytes:
    old = np.frombuffer(content, blob.dtype).reshape(blob.shape)
    return change(old).astype(blob.dtype, copy=False).tobytes()


def _aligned(length: int) -> int:
    return -(-length // ALIGNMENT) * ALIGNMENT


def _write_all(file: io.FileIO, *contents: Any) -> None:
    for content in contents:
        rest = memoryview(content)
        while rest:
            rest = rest[file.write(rest) :]


def _copy(source: io.FileIO, start: int, target: io.FileIO) -> None:
    """Append what lies behind `start` of one file to another, inside the kernel where that is possible."""
    stop = os.fstat(source.fileno()).st_size
    try:
        while start < stop:
            start += os.copy_file_range(source.fileno(), target.fileno(), stop - start, start)
    except (AttributeError, OSError):
        source.seek(start)
        shutil.copyfileobj(source, target, _GATHERED)


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


_Frame = LidarFrame | RadarFrame | CameraImage

_RESERVED = frozenset(
    {
        *("layout", "time_shift_ns", "sensor_notes", "sensors", "annotations", "attributes"),
        *("trajectories", "exact_attributes", "warnings"),
    }
)

_ROOT = frozenset({"version", "time_unit", "time_offset"})
_PER_FRAME, _PER_POSE, _PER_ANNOTATION = 2048, 180, 2048
_LEAST_HEADER, _UNKNOWN_HEADER = 1 << 17, 1 << 20
_NOTES = "metadata.sceneloom.sensor_notes[]"


class SceneWriter:
    """Writes a scene file sensor by sensor, frame by frame; memory holds the header and the frame at hand.

    ```python
    with SceneWriter("drive.sfs") as writer:
        writer.add_sensor(LidarSensor("top", LazyFrames.of([], []), points_frame=PointsFrame.WORLD))
        for timestamp_ns, positions in sweeps:
            writer.add_frame("top", LidarFrame(timestamp_ns, LidarPoints(positions)))
        writer.set_poses("top", Poses(timestamps_ns, positions_world, quaternions_xyzw))
    ```

    The file is there, whole, when the block ends without an error; else nothing is there.

    Attributes:
        losses: what the file cannot hold; empty before `finish`.
    """

    def __init__(
        self,
        path: str | Path,
        *,
        overwrite: bool = False,
        profile: str = "sfs",
        time_unit: str = "microseconds",
        time_offset_ns: int | None = None,
        usual_offset_ns: int | None = None,
        first_ns: int | None = None,
        frame_count: int = 0,
        metadata: Mapping[str, Any] | None = None,
        verbatim: bool = False,
    ) -> None:
        """Check the arguments; the file is opened on entering the context.

        Args:
            path: the file to be made.
            overwrite: whether a file there may be replaced.
            profile: "sfs", or "scale" for a file that Scale's own library loads and validates.
            time_unit: "microseconds" or "nanoseconds".
            time_offset_ns: the absolute time of the file's zero [ns]; None to choose it by the earliest time.
            usual_offset_ns: an offset to begin with; unlike `time_offset_ns` it moves if something earlier comes.
            first_ns: the earliest time that will come, if known [ns]; saves moving the offset later.
            frame_count: how many frames will come, if known; saves copying arrays behind the header.
            metadata: free fields of the scene.
            verbatim: the contents come from a file of this format: frame timestamps and far positions pass
                unchanged.

        Raises:
            OptionError: an argument has an invalid value.
        """
        self._path, self._overwrite, self._verbatim = Path(path), overwrite, verbatim
        self._profile = Profile.named(profile)
        if time_unit not in self._profile.time_units:
            known = ", ".join(self._profile.time_units)
            raise OptionError(f"time_unit {time_unit!r}; expected {known} in profile {profile!r}")
        self._tick_ns = TICKS_NS[time_unit]
        self._fixed_offset_ns, self._frame_count = time_offset_ns, frame_count
        self._usual_offset_ns = usual_offset_ns
        if usual_offset_ns is None and first_ns is not None:
            self._usual_offset_ns = chosen_offset_ns(first_ns)
        self._contents = _Contents()
        self._unfused: list[Mapping[str, Any]] = []
        self._losses = Losses()
        self._stack = ExitStack()
        self._open: _OpenFile | None = None
        self.losses = LossReport()
        self.set_metadata(metadata or {})

    def __enter__(self) -> Self:
        with ExitStack() as stack:
            draft = stack.enter_context(replacing(self._path, overwrite=self._overwrite))
            spool = stack.enter_context(Spool(draft, reserve=self._expected_header))
            fixed = self._fixed_offset_ns is not None
            offset_ns = self._fixed_offset_ns if fixed else self._usual_offset_ns
            keeper = _ClockKeeper(self._tick_ns, offset_ns, fixed, spool, self._contents.drafts)
            self._open = _OpenFile(spool, draft.parent, keeper, self._profile, self._losses, self._verbatim)
            self._stack = stack.pop_all()
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        if kind is not None:
            self._open = None
            self._stack.__exit__(kind, error, trace)
        elif self._open is not None:
            self.finish()

    def finish(self) -> LossReport:
        """Complete the file and put it in its location; leaving the context does it, too.

        Raises:
            OptionError: something cannot be held by the format.
            OutputError: the file cannot be written.
        """
        opened, contents = self._opened(), self._contents
        with self._stack.pop_all():
            self._open = None
            for draft in contents.drafts.values():
                draft.add_image_notes(self._losses)
            if any(record["type"] == "cuboid" for record in contents.annotations):
                contents.ours = {**DEFAULT_EULER, **contents.ours}
            contents.ours["unfused"] = self._unfused or None
            with collector_paused():
                header = _make_header(contents, self._profile, opened.keeper, self._losses)
            opened.spool.finish(header)
        self.losses = LossReport.of(self._losses)
        return self.losses

    def add_sensor(self, sensor: Sensor) -> None:
        """Add a sensor, and write the frames or images that it holds; more may follow with `add_frame`.

        Raises:
            OptionError: its id stands in the file already, or something in it cannot be held by the format.
            DataError: a frame or image of it cannot be read.
        """
        opened, key = self._opened(), key_of(sensor.id)
        if key in self._contents.drafts:
            raise OptionError(f"sensor {sensor.id!r} is in the file already; expected an id of its own")
        any_distortion = not self._profile.scale and self._verbatim
        draft = _draft_of(sensor, self._losses, any_distortion=any_distortion)
        self._contents.drafts[key] = draft
        if isinstance(sensor, CameraSensor):
            opened.add_images(draft, sensor)
        elif isinstance(sensor, LidarSensor | RadarSensor):
            for frame in sensor.frames:
                opened.add_points(draft, frame)

    def add_frame(self, sensor_id: Identifier, frame: _Frame) -> None:
        """Write one more frame of a lidar or radar, or one more image of a camera without a video.

        Raises:
            OptionError: the sensor takes no such frame, positions lie too far away, or times cannot be held.
        """
        opened, draft = self._opened(), self._draft(sensor_id)
        kinds = {"lidar": LidarFrame, "radar": RadarFrame, "camera": CameraImage}
        if not isinstance(frame, kinds.get(draft.type, ())) or (draft.type == "camera" and not draft.streamed):
            held = "a video" if draft.type == "camera" else f"a {draft.type}"
            raise OptionError(f"{draft.location} is {held}; it takes no {type(frame).__name__}")
        if isinstance(frame, CameraImage):
            opened.add_image(draft, frame)
        else:
            opened.add_points(draft, frame)

    def add_unfused(self, sensor_id: Identifier, frame: LidarFrame, reason: str) -> None:
        """Keep a sweep that could not be brought into the world, in its sensor's frame, under our metadata.

        Raises:
            OptionError: the sensor is not in the file.
        """
        draft, spool = self._draft(sensor_id), self._opened().spool
        names = {**LIDAR_ARRAYS, "timestamps": None, "camera_index": None, "timestamps_ns": "timestamps_ns"}
        arrays = {name: getattr(frame.points, attribute) for name, attribute in names.items() if attribute}
        record = {
            "sensor_id": draft.id,
            "timestamp_ns": frame.timestamp_ns,
            "reason": reason,
            "points": {name: spool.add(array) for name, array in arrays.items() if array is not None},
        }
        self._unfused.append(record)
        # what stands behind a colon differs from sweep to sweep
        what = f"left out of the frames: {reason.partition(':')[0]}"
        self._losses.dropped(f"{draft.location}.frames[]", what, kept="metadata.sceneloom.unfused")

    def set_poses(self, sensor_id: Identifier, poses: Poses) -> None:
        """Set the poses of a sensor, in the frame that its `coordinates` name.

        Raises:
            OptionError: the sensor is not in the file.
        """
        self._draft(sensor_id).poses = poses

    def add_annotation(self, annotation: Annotation) -> None:
        """Add an annotation.

        Raises:
            OptionError: a number of it is not finite.
        """
        if isinstance(annotation, CameraCalibration) and annotation.intrinsics is not None:
            written, error = _written_camera_model(annotation.intrinsics, any_model=not self._profile.scale)
            if error is not None:
                self._losses.approximated(f"annotations[{annotation.id}].intrinsics.distortion", error)
            annotation = replace(annotation, intrinsics=written)
        self._contents.annotations.append(encode_annotation(annotation))

    def set_metadata(self, fields: Mapping[str, Any]) -> None:
        """Add free fields; those under "sceneloom" join ours.

        Raises:
            OptionError: a field under "sceneloom" is one that the writer fills itself.
        """
        ours = dict(fields.get(OURS) or {})
        taken = sorted(_RESERVED.intersection(ours))
        if taken:
            raise OptionError(f"metadata.{OURS}.{taken[0]} is filled by the writer; expected another name")
        self._unfused.extend(ours.pop("unfused", []))
        self._contents.metadata.update({name: value for name, value in fields.items() if name != OURS})
        self._contents.ours.update(ours)

    def spell_time_unit(self, spelling: str) -> None:
        """Write the unit of time by another of its names, as the file that a scene comes from has it."""
        self._contents.time_unit = spelling

    def add_scene(self, scene: Scene) -> None:
        """Add everything that a scene holds.

        Raises:
            OptionError: something in it cannot be held by the format.
            DataError: a frame or image cannot be read.
        """
        self.set_metadata(scene.metadata)
        self._contents.extras.update({name: v for name, v in scene.extras.items() if name not in _ROOT})
        self._contents.attributes.extend(map(attribute_record, scene.attributes))
        # what was repaired of the source is in order in the file; a correction that was applied stays one
        reported = [
            _warning_record(warning, scene.source)
            for warning in scene.warnings
            if self._verbatim or warning.kind != WarningKind.REPAIRED or warning.code == "correction-applied"
        ]
        if reported:
            self._contents.ours["warnings"] = reported
        for annotation in scene.annotations:
            try:
                self.add_annotation(annotation)
            except OptionError as error:  # of an annotation that was read from a file, it is a fault of that file
                if scene.format not in FORMATS:
                    raise
                raise DataError(scene.source, "", str(error)) from None
        self._add_trajectories(scene)
        for sensor in scene.sensors:
            if isinstance(sensor, DepthCameraSensor):
                what = f"left out, with {len(sensor.frames)} depth images: the format has no cameras that measure depth"
                self._losses.dropped(f"sensors[{sensor.id}]", what)
            else:
                self.add_sensor(sensor)

    def _add_trajectories(self, scene: Scene) -> None:
        odometry = [sensor for sensor in scene.sensors if isinstance(sensor, OdometrySensor)]
        records = [_trajectory_record(name, trajectory, odometry) for name, trajectory in scene.trajectories.items()]
        alone = sum("sensor_id" not in record for record in records)
        what, kept = "the format knows odometry sensors only", "metadata.sceneloom.trajectories"
        self._losses.dropped("trajectories[]", what, count=alone, kept=kept)
        reported = [{"name": str(sensor.id), "sensor_id": sensor.id} for sensor in odometry]
        if records and records != reported:
            self._contents.ours["trajectories"] = records

    def _opened(self) -> "_OpenFile":
        if self._open is None:
            raise OptionError(f"{self._path}: not open; use the writer in a `with` block, before `finish`")
        return self._open

    def _draft(self, sensor_id: Identifier) -> "_SensorDraft":
        draft = self._contents.drafts.get((type(sensor_id), sensor_id))
        if draft is None:
            known = ", ".join(repr(identifier) for _, identifier in self._contents.drafts)
            raise OptionError(f"no sensor {sensor_id!r} in the file; it has {known or 'none'}")
        return draft

    def _expected_header(self) -> int:
        """About how many bytes the header will take, by what is known of the scene now."""
        drafts = self._contents.drafts.values()
        poses = sum(0 if draft.poses is None else len(draft.poses.timestamps_ns) for draft in drafts)
        frames = max(self._frame_count, sum(len(draft.frames or ()) for draft in drafts))
        annotations = len(self._contents.annotations)
        expected = frames * _PER_FRAME + poses * _PER_POSE + annotations * _PER_ANNOTATION
        return max(expected, _LEAST_HEADER if self._frame_count else _UNKNOWN_HEADER)


def _trajectory_record(name: str, trajectory: Trajectory, odometry: Iterable[OdometrySensor]) -> dict[str, Any]:
    """Make the record of a trajectory; where an odometry sensor holds all of it, only that sensor is named."""
    exact = trajectory.file_seconds is None
    same = next((sensor for sensor in odometry if exact and same_direction(sensor.poses, trajectory)), None)
    record: dict[str, Any] = {"name": name}
    if same is None:
        parts = ("timestamps_ns", "positions", "quaternions_xyzw", "file_seconds")
        record |= {part: getattr(trajectory, part) for part in parts}
    else:
        record["sensor_id"] = same.id
    if trajectory.covariances is not None:
        record["covariances"] = trajectory.covariances.reshape(-1, 36)
    return record


def _warning_record(warning: DataWarning, source: str) -> dict[str, Any]:
    """Make the record of a warning on a scene, without the folders above its source."""
    return {
        "kind": warning.kind.value,
        "code": warning.code,
        "location": without_folders(warning.location, source),
        "message": without_folders(warning.message, source),
        "count": warning.count,
    }


_LATEST_START_NS = 90_000_000_000  # Scale's validator refuses series that start much later than this


def write_scene(
    scene: Scene,
    path: str | Path,
    *,
    overwrite: bool = False,
    profile: str = "sfs",
    time_unit: str | None = None,
    time_offset_ns: int | None = None,
) -> LossReport:
    """Write a scene to a file.

    Args:
        scene: any scene; one that was read from a file of this format keeps its unit, offset and timestamps.
        profile: "sfs", or "scale" for a file that Scale's own library loads and validates.
        time_unit: "microseconds" or "nanoseconds"; None for the scene's own, else microseconds.
        time_offset_ns: the absolute time of the file's zero [ns]; None to choose it.

    Raises:
        OptionError: an argument has an invalid value, or something cannot be held by the format.
        DataError: a frame or image cannot be read.
        OutputError: the file exists, or cannot be written.
    """
    times_ns = _known_times(scene)
    own_spelling = scene.extras.get("time_unit")
    own_tick_ns = READABLE_TICKS_NS.get(own_spelling) if isinstance(own_spelling, str) else None
    unit = time_unit or "microseconds"
    if time_unit is None and profile != "scale" and own_tick_ns is not None:
        unit = next(name for name, tick_ns in TICKS_NS.items() if tick_ns == own_tick_ns)
    from_sfs = scene.format == "sfs"
    keeps_offset = from_sfs and time_offset_ns is None and _offset_serves(scene, times_ns, TICKS_NS[unit], profile)
    with SceneWriter(
        path,
        overwrite=overwrite,
        profile=profile,
        time_unit=unit,
        time_offset_ns=time_offset_ns,
        usual_offset_ns=scene.time_offset_ns if keeps_offset else None,
        first_ns=min(times_ns, default=None),
        frame_count=sum(len(s.frames) for s in scene.sensors if isinstance(s, LidarSensor | RadarSensor)),
        verbatim=from_sfs,
    ) as writer:
        writer.add_scene(scene)
        if from_sfs and time_unit is None and profile == "sfs" and own_tick_ns == TICKS_NS[unit]:
            writer.spell_time_unit(str(own_spelling))
    return writer.losses


def _offset_serves(scene: Scene, times_ns: list[int], tick_ns: int, profile: str) -> bool:
    """Whether the offset of the file that the scene comes from can stay."""
    offset_ns = scene.time_offset_ns
    if offset_ns % tick_ns or not times_ns:
        return offset_ns % tick_ns == 0
    starts_late = profile == "scale" and min(times_ns) - offset_ns > _LATEST_START_NS
    wraps = tick_ns > 1 and (max(times_ns) - offset_ns) // tick_ns > UINT32_MAX
    return offset_ns <= min(times_ns) and not starts_late and not wraps


def _known_times(scene: Scene) -> list[int]:
    """First and last of all times that are known without reading a frame [ns]."""
    series: list[Int64Array] = []
    for sensor in scene.sensors:
        if isinstance(sensor, LidarSensor | RadarSensor):
            series.append(sensor.frames.timestamps_ns)
        if isinstance(sensor, CameraSensor):
            series.append(sensor.images.timestamps_ns)
        if isinstance(sensor, LidarSensor | RadarSensor | CameraSensor | OdometrySensor):
            series += _times_of_poses(sensor.poses)
    for annotation in scene.annotations:
        if isinstance(annotation, CuboidAnnotation | Box2DAnnotation | ShapeAnnotation):
            series.append(annotation.path.timestamps_ns)
        elif isinstance(annotation, PointsAnnotation):
            series += [path.timestamps_ns for path in annotation.paths]
        elif isinstance(annotation, EventAnnotation):
            series.append(np.array([annotation.start_ns], np.int64))
        elif isinstance(annotation, LocalizationAdjustment | CameraCalibration):
            series += _times_of_poses(annotation.poses)
    return [int(time) for times in series if len(times) for time in (times.min(), times.max())]


def _times_of_poses(poses: Poses | None) -> list[Int64Array]:
    return [] if poses is None or poses.static else [poses.timestamps_ns]


_LATEST_STATIONARY_NS = 100_000_000_000


@dataclass(slots=True)
class _ImageNotes:
    """Collects what single images have of their own."""

    cameras: dict[Camera, int]  # numbers; 0 is the camera's own model, whose images need no note
    _chosen: list[int] = field(default_factory=list)
    _mounts: list[list[list[float]] | None] = field(default_factory=list)
    _extras: list[Mapping[str, Any]] = field(default_factory=list)

    def add(self, image: CameraImage, extras: Mapping[str, Any]) -> None:
        """Note one image, with the fields that have no other location."""
        self._chosen.append(self.cameras.setdefault(image.camera, len(self.cameras)))
        self._mounts.append(None if image.mount is None else _mount_rows(image.mount))
        self._extras.append(extras)

    @property
    def own_cameras(self) -> int:
        """How many images have a camera model of their own."""
        return sum(k > 0 for k in self._chosen)

    def record(self) -> dict[str, Any] | None:
        """Make the note; None where no image has anything of its own."""
        note: dict[str, Any] = {}
        if any(self._chosen):
            note["cameras"] = [_camera_record(camera) for camera in self.cameras]
            note["camera_of_image"] = self._chosen
        if any(row is not None for row in self._mounts):
            note["mounts"] = self._mounts
        if any(self._extras):
            note["extras"] = self._extras
        return note or None


def _camera_record(camera: Camera) -> dict[str, Any]:
    """Make the `camera` record of a camera model."""
    names = ("model", "width", "height", "fx", "fy", "cx", "cy")
    return {**{name: getattr(camera, name) for name in names}, "coefficients": list(camera.coefficients)}


@dataclass(slots=True)
class _SensorDraft:
    """One sensor while its frames come in."""

    id: Identifier
    type: str
    fields: dict[str, Any]  # its record besides poses and frames
    note: dict[str, Any] = field(default_factory=dict)  # what stands about it in our metadata
    points_frame: str | None = None  # where it has points
    poses: Poses | None = None  # None: not known
    mount: Any = None  # `ego_from_sensor`, where it is known
    coordinates: str | None = None  # the frame that `poses` lead into
    further_poses: Mapping[str, Any] = field(default_factory=dict)  # unknown fields of `poses`
    frames: list[dict[str, Any]] | None = None  # records so far; None where it has none
    point_times: list[_Blob] = field(default_factory=list)
    lengths: list[Any] = field(default_factory=list)  # of radar points by frame, where there is no field for them
    images: _ImageNotes | None = None
    streamed: bool = True  # frames may still come

    @property
    def location(self) -> str:
        """Path of the sensor, for losses and messages."""
        return f"sensors[{self.id}]"

    def add_image_notes(self, losses: Losses) -> None:
        """Add the note about single images, and report what stands only there."""
        if self.images is not None:
            what, count = "one camera model per camera", self.images.own_cameras
            losses.dropped(f"{self.location}.images[].camera", what, count=count, kept=f"{_NOTES}.images")
            note = self.images.record()
            self.note |= {} if note is None else {"images": note}

    def _frame_times(self) -> list[int]:
        """Timestamps of frames, and of the images of a camera: other sensors may have fields of that name."""
        images = self.fields.get("images") if self.type == "camera" else None
        return [frame["timestamp"] for frame in (*(self.frames or ()), *(images or ()))]

    def first_ns(self) -> int | None:
        """The earliest timestamp that stands in the sensor's record so far [ns]."""
        timestamps = self._frame_times()
        video = self.fields.get("video") if self.type == "camera" else None
        if video is not None and len(video["timestamps"]):
            timestamps.append(int(min(video["timestamps"])))
        if self.poses is not None and not self.poses.static:
            timestamps.append(self.poses.start_ns)
        return min(timestamps, default=None)

    def record(self, clock: FileClock, losses: Losses) -> dict[str, Any]:
        """Make the sensor's record; poses get the file's resolution here."""
        record: dict[str, Any] = {"id": self.id, "type": self.type}
        if self.coordinates is not None:
            record |= self._placed(clock, losses)
        elif self.poses is not None:
            record["poses"] = self._poses(self.poses, clock, losses)
        if self.poses is not None and len(self.poses.timestamps_ns) == 1:
            self.note["poses_static"] = self.poses.static
        if self.frames is not None:
            record["frames"] = self.frames
        if any(length is not None for length in self.lengths):
            self.note["lengths"] = self.lengths
        return {**record, **{name: value for name, value in self.fields.items() if name not in record}}

    def _placed(self, clock: FileClock, losses: Losses) -> dict[str, Any]:
        """Write `coordinates` and `poses`; a sensor of which only the mounting is known is placed on the ego."""
        if self.mount is not None:
            self.note["mount"] = _mount_rows(self.mount)
        if self.poses is not None:
            return {"coordinates": self.coordinates, "poses": self._poses(self.poses, clock, losses)}
        if self.mount is None:
            losses.kept(f"{self.location}.poses", "not known, left out; the format wants them")
            return {"coordinates": self.coordinates}
        losses.kept(f"{self.location}.poses", "not known; the mounting is written, in ego coordinates")
        self.note |= {"poses_from_mount": True, "coordinates": self.coordinates}
        values = [[*self.mount.translation.tolist(), *self.mount.quaternion_xyzw.tolist()]]
        return {"coordinates": "ego", "poses": {"timestamps": [self._stationary_ns(clock)], "values": values}}

    def _poses(self, path: Poses, clock: FileClock, losses: Losses) -> dict[str, Any]:
        """Write poses; of those that fall on one timestamp the first stays."""
        rows = np.hstack([path.positions, path.quaternions_xyzw])
        if path.static:
            return with_extras({"timestamps": [self._stationary_ns(clock)], "values": rows}, self.further_poses)
        timestamps, _ = clock.timestamp_array(path.timestamps_ns)
        kept = np.concatenate([[True], np.diff(timestamps) > 0])
        what = "left out: within one tick of the pose before"
        losses.dropped(f"{self.location}.poses", what, count=int((~kept).sum()))
        return with_extras({"timestamps": path.timestamps_ns[kept], "values": rows[kept]}, self.further_poses)

    def _stationary_ns(self, clock: FileClock) -> int:
        """The time to be written for a pose that holds at all times."""
        if self.poses is not None and 0 <= self.poses.start_ns - clock.offset_ns <= _LATEST_STATIONARY_NS:
            return self.poses.start_ns
        return min(self._frame_times(), default=max(clock.offset_ns, 0))


_MERGED = frozenset({"intrinsics", "video", "points", "poses"})
"""Unknown fields that go into parts of the sensor's record."""


def _draft_of(sensor: Sensor, losses: Losses, *, any_distortion: bool) -> _SensorDraft:  # noqa: PLR0912 - one a kind
    """Make the draft of a sensor, still without frames."""
    if isinstance(sensor, PlainSensor):
        return _SensorDraft(sensor.id, sensor.type, dict(sensor.fields), streamed=False)
    if isinstance(sensor, DepthCameraSensor):
        raise OptionError(f"a {type(sensor).__name__}; the format has no cameras that measure depth")
    parts = {name: part for name in _MERGED if isinstance(part := sensor.extras.get(name), Mapping)}
    extras = {name: value for name, value in sensor.extras.items() if name not in parts}
    draft = _SensorDraft(sensor.id, str(sensor.type), with_extras({"parent_id": sensor.parent_id}, extras))
    draft.further_poses = parts.get("poses", {})
    if isinstance(sensor, LidarSensor | RadarSensor | CameraSensor):
        draft.poses, draft.mount, draft.coordinates = sensor.poses, sensor.mount, sensor.coordinates.value
    else:
        draft.streamed = False
    if isinstance(sensor, LidarSensor | RadarSensor):
        draft.frames = []
        draft.points_frame = draft.note["points_frame"] = sensor.points_frame.value
        if isinstance(sensor, LidarSensor) and sensor.model is not None:
            draft.note["model"] = sensor.model
        if draft.points_frame != draft.coordinates:
            what = f"points are in the {draft.points_frame} frame, which the format cannot state"
            losses.dropped(f"{draft.location}.points_frame", what, kept=f"{_NOTES}.points_frame")
    elif isinstance(sensor, CameraSensor):
        draft.images = _ImageNotes({sensor.camera: 0})
        written, error = _written_camera_model(sensor.camera, any_model=any_distortion)
        if error is not None:
            draft.note |= {"camera": _camera_record(sensor.camera), "written_camera": _camera_record(written)}
            losses.dropped(f"{draft.location}.intrinsics.distortion", error, kept=f"{_NOTES}.camera")
        draft.fields["intrinsics"] = intrinsics_record(written, parts.get("intrinsics"))
    elif isinstance(sensor, OdometrySensor):
        draft.poses = sensor.poses
    elif isinstance(sensor, PointsSensor):
        points = {"positions": sensor.positions, "colors": sensor.colors}
        draft.fields["points"] = with_extras(points, parts.get("points", {}))
    elif isinstance(sensor, ImuSensor):
        names = ("timestamps_ns", "values", "file_seconds")
        streams = {k: {name: getattr(samples, name) for name in names} for k, samples in sensor.streams.items()}
        draft.fields["streams"] = streams
    elif isinstance(sensor, GnssSensor):
        draft.fields |= {name: getattr(sensor, name) for name in GNSS_ARRAYS}
        draft.fields |= {} if sensor.mount is None else {"mount": _mount_rows(sensor.mount)}
    return draft


_STAND_INS = ("brown_conrady", "fisheye", "fisheye_rad_tan_prism", "omnidirectional")
"""Models of the format that camera models of other models are fitted to: those whose formulas have a source."""


def _written_camera_model(camera: Camera, *, any_model: bool) -> tuple[Camera, str | None]:
    """The model, or the nearest that an `intrinsics` record can hold, and in words how far off; None: the same."""
    count = COEFFICIENT_COUNTS.get(camera.model)
    if camera.model == "pinhole" or (any_model and count is None):
        return camera, None
    if count is not None and not any(camera.coefficients[count:]):
        return replace(camera, coefficients=(*camera.coefficients, *(0.0,) * count)[:count]), None
    if camera.model not in MODELS:
        pinhole = replace(camera, model="pinhole", coefficients=())
        return pinhole, f"{camera.model} camera model written as pinhole, off by an unknown number of pixels"
    # each with the coefficients of ours that the format does not have
    candidates = {model: MODELS[model].coefficient_names[COEFFICIENT_COUNTS[model] :] for model in _STAND_INS}
    found = nearest(camera, candidates)
    count = COEFFICIENT_COUNTS[found.camera.model]
    return replace(found.camera, coefficients=found.camera.coefficients[:count]), found.message(camera)


@dataclass(slots=True)
class _ClockKeeper:
    """Chooses the offset."""

    tick_ns: int  # length of the file's unit [ns]
    offset_ns: int | None  # None until the first time is known
    fixed: bool  # the caller chose the offset, so that it cannot move
    spool: Spool  # holds point times that have to follow when it moves
    drafts: Mapping[Any, _SensorDraft]

    def __post_init__(self) -> None:
        if self.offset_ns is not None and self.offset_ns % self.tick_ns:
            raise OptionError(f"time_offset_ns {self.offset_ns}; expected whole microseconds")

    @property
    def clock(self) -> FileClock:
        """The clock as it is; with offset 0 where no time is known."""
        return FileClock(self.tick_ns, self.offset_ns or 0)

    def clock_for(self, first_ns: int) -> FileClock:
        """Give the clock, which after this call can hold times from `first_ns` on."""
        if self.offset_ns is None:
            self.offset_ns = chosen_offset_ns(first_ns)
        elif first_ns < self.offset_ns:
            if self.fixed:
                expected = f"at most {first_ns}, the earliest time of the scene"
                raise OptionError(f"time_offset_ns {self.offset_ns}; expected {expected}")
            new_ns = chosen_offset_ns(first_ns)
            later, self.offset_ns = (self.offset_ns - new_ns) // self.tick_ns, new_ns
            for draft in self.drafts.values():
                for number, blob in enumerate(draft.point_times):
                    location = f"{draft.location}.frames[{number}]"
                    self.spool.change(blob, partial(_moved, later=later, clock=self.clock, location=location))
        return self.clock


def _moved(timestamps: AnyArray, *, later: int, clock: FileClock, location: str) -> AnyArray:
    if abs(later) >= 2**63:
        raise OptionError(f"{location}: point times {later} ticks later do not fit 64 bits")
    since = timestamps.astype(np.int64) + later
    if since.size:
        _check_timestamps(int(since.min()), int(since.max()), clock, location)
    return since.astype(point_times_dtype(clock))


def _check_timestamps(lowest: int, highest: int, clock: FileClock, location: str) -> None:
    """Refuse point times, from the lowest to the highest timestamp, that the file's integers cannot hold."""
    if lowest < 0 or highest > (UINT64_MAX if clock.tick_ns == 1 else UINT32_MAX):
        seconds = (lowest if lowest < 0 else highest) * clock.tick_ns / 1e9
        raise OptionError(
            f"{location}.points.timestamps: {seconds:.3f} s after the clock's zero; microseconds in 32 bits hold 0 to "
            "4294.967 s: choose another time offset, or `--time-unit nanoseconds`"
        )


_FARTHEST = 10_000.0  # float32 resolves about 1 mm there: positions in the world beyond it need a nearer origin [m]
_ROUNDING = 0.5  # how far a time is off at most where it is rounded [µs]
_FLOAT_TIMES = "file_seconds"  # readers of float seconds keep the file's own number of each point beside its time
_JPEG_START = b"\xff\xd8\xff"
_USUAL_FPS = 10.0
_CHUNK = 1 << 20


@dataclass(frozen=True, slots=True)
class _OpenFile:
    """A file that is being written."""

    spool: Spool  # arrays of points, images and videos
    folder: Path  # for files that are needed on the way
    keeper: _ClockKeeper  # gives the clock
    profile: Profile
    losses: Losses
    verbatim: bool  # contents of a file of this format: times, far positions and images of any kind pass

    def add_points(self, draft: _SensorDraft, frame: LidarFrame | RadarFrame) -> None:
        """Spool one sweep or cycle."""
        points = frame.points
        self._check_reach(draft, points.positions)
        names = LIDAR_ARRAYS if isinstance(frame, LidarFrame) else RADAR_ARRAYS
        arrays: dict[str, Any] = {name: getattr(points, attribute) for name, attribute in names.items()}
        if isinstance(frame, RadarFrame) and self.profile.scale:
            lengths = arrays.pop("lengths")
            draft.lengths.append(None if lengths is None else self.spool.add(lengths))
            if lengths is not None:
                what = "Scale's library cannot load them"
                self.losses.dropped(f"{draft.location}.frames[].points.lengths", what, kept=f"{_NOTES}.lengths")
        arrays["timestamps"] = self._point_times(draft, points.timestamps_ns)
        extras = points.extras
        further = {name: value for name, value in extras.items() if arrays.get(name) is None} if extras else {}
        if arrays["timestamps"] is not None and further.pop(_FLOAT_TIMES, None) is not None:
            what = "left out: the same times in another form"
            self.losses.converted(f"{draft.location}.frames[].points.{_FLOAT_TIMES}", what)
        blobs = {
            name: self.spool.add(array) if isinstance(array, np.ndarray) else array
            for name, array in {**arrays, **further}.items()
            if array is not None or name in further
        }
        record = {"timestamp": self._frame_timestamp(draft, frame), "points": blobs}
        if draft.frames is not None:
            draft.frames.append(with_extras(record, frame.extras))

    def _frame_timestamp(self, draft: _SensorDraft, frame: LidarFrame | RadarFrame) -> int:
        """The start of a frame: its earliest point time, rounded down, so that it is later than no point."""
        times_ns, tick_ns = frame.points.timestamps_ns, self.keeper.tick_ns
        start_ns, location = frame.timestamp_ns, f"{draft.location}.frames[].timestamp"
        if times_ns is not None and len(times_ns) and not (self.verbatim and not self.profile.scale):
            earliest_ns = int(times_ns.min())
            start_ns = min(start_ns, earliest_ns) if self.verbatim else earliest_ns
        if start_ns // tick_ns != frame.timestamp_ns // tick_ns:
            self.losses.approximated(location, "moved to the earliest point of the frame")
        if start_ns % tick_ns:
            self.losses.converted(location, "rounded down to a whole microsecond", error=(start_ns % tick_ns) / 1e3)
        self.keeper.clock_for(start_ns)
        return start_ns // tick_ns * tick_ns

    def _point_times(self, draft: _SensorDraft, times_ns: Int64Array | None) -> _Blob | None:
        if times_ns is None or (len(times_ns) == 0 and self.profile.scale):
            return None
        clock, span_ns = self.keeper.clock, None
        if len(times_ns):
            span_ns = (int(times_ns.min()), int(times_ns.max()))
            clock = self.keeper.clock_for(span_ns[0])
            location = f"{draft.location}.frames[{len(draft.frames or [])}]"
            _check_timestamps(*clock.timestamps_of_span(*span_ns), clock, location)
        timestamps, inexact = clock.timestamp_array(times_ns, dtype=point_times_dtype(clock).type, span_ns=span_ns)
        what = "rounded to whole microseconds, halves to even: at most 0.5 µs off"
        self.losses.converted(f"{draft.location}.frames[].points.timestamps", what, count=inexact, error=_ROUNDING)
        blob = self.spool.add(timestamps)
        draft.point_times.append(blob)
        return blob

    def _check_reach(self, draft: _SensorDraft, positions: Float32Array) -> None:
        if self.verbatim or draft.points_frame != PointsFrame.WORLD or len(positions) == 0:
            return
        # two passes without a copy; where a number is NaN, both are, and the slow way follows
        if float(positions.min()) >= -_FARTHEST and float(positions.max()) <= _FARTHEST:
            return
        distances = np.abs(positions)
        # a point that is infinitely far is no point, nor is one that is not a number
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

    def add_images(self, draft: _SensorDraft, sensor: CameraSensor) -> None:
        """Write all images that a camera has: its video, else each as a JPEG."""
        count = len(sensor.images)
        content = None if sensor.video is None or count == 0 else self._video(draft, sensor, sensor.video)
        if content is None:
            if sensor.fps is not None:
                draft.note["fps"] = sensor.fps
                self.losses.dropped(f"{draft.location}.fps", "only videos have a rate", kept=f"{_NOTES}.fps")
            for image in sensor.images:
                self.add_image(draft, image)
            return
        starts = []
        for image in sensor.images:
            starts.append(_start_ns(draft, image))
            if draft.images is not None:
                draft.images.add(image, image.extras)
        span_ns = starts[-1] - starts[0]
        counted = (len(starts) - 1) / (span_ns / 1e9) if span_ns > 0 else _USUAL_FPS
        video = {"timestamps": starts, "content": content, "fps": counted if sensor.fps is None else sensor.fps}
        further = sensor.extras.get("video")
        draft.fields["video"] = with_extras(video, further if isinstance(further, Mapping) else {})
        draft.streamed = False

    def add_image(self, draft: _SensorDraft, image: CameraImage) -> None:
        """Write one image as a JPEG, copied where it is one already."""
        encoded = None if image.encoded is None else image.encoded()
        if encoded is None or not (self.verbatim or encoded.startswith(_JPEG_START)):
            what = f"encoded as JPEG of quality {JPEG_QUALITY}"
            self.losses.approximated(f"{draft.location}.images[].content", what)
            encoded = encode_jpeg(image.rgb)
        record = {"timestamp": _start_ns(draft, image), "content": self.spool.add(np.frombuffer(encoded, np.uint8))}
        draft.fields.setdefault("images", []).append(with_extras(record, image.extras))
        if draft.images is not None:
            draft.images.add(image, {})

    def _video(self, draft: _SensorDraft, sensor: CameraSensor, video: VideoContent) -> _Blob | None:
        """Spool a camera's video as mp4; None where its images have to go one by one."""
        file, location = self.folder / "video.mp4", f"{draft.location}.video"
        if video.frame_indices is None and _copy_mp4(video, file):
            with open_file(file) as opened, mmap(opened.fileno(), 0, access=ACCESS_READ) as content:
                length = declared_length(content)
                if length > len(content):
                    problem = f"{len(content)} bytes; its boxes state {length}: the video was cut"
                    raise DataError(location, "", problem)
        elif not self._remux(sensor, video, file, location):
            file.unlink()
            return None
        blob = self.spool.add_file(file)
        file.unlink()
        return blob

    def _remux(self, sensor: CameraSensor, video: VideoContent, file: Path, location: str) -> bool:
        from sceneloom.formats.video.writer import remux_to_mp4

        times_ns = sensor.images.timestamps_ns
        increasing = bool((np.diff(times_ns) > 0).all())
        try:
            with file.open("w+b") as target:
                result = remux_to_mp4(
                    video.open,
                    target,
                    timestamps_seconds=(times_ns - times_ns[0]) / 1e9 if increasing else None,
                    frame_indices=video.frame_indices,
                    name=location,
                )
        except OptionError:  # an odd size cannot be encoded as H.264: the images become JPEGs
            return False
        except ArrayError as error:
            raise DataError(location, "", f"does not fit its timestamps: {error}") from error
        if result.images != len(times_ns):
            problem = f"{result.images} images; expected {len(times_ns)} as its timestamps"
            raise DataError(location, "", problem)
        if not result.copied:
            self.losses.approximated(f"{location}.content", f"encoded as {result.codec}: {result.reason}")
        return True


def _start_ns(draft: _SensorDraft, image: CameraImage) -> int:
    """The start of an image's exposure [ns]; the model has its middle."""
    return image.timestamp_ns - exposure_ns(image.extras, draft.fields) // 2


def _copy_mp4(video: VideoContent, target: Path) -> bool:
    """Copy a video that is mp4 already; report whether it was."""
    with video.open() as source:
        start = source.read(_CHUNK)
        if not is_mp4(memoryview(start)):
            return False
        with target.open("wb") as file:
            while start:
                file.write(start)
                start = source.read(_CHUNK)
    return True


class _Arrays:
    """Spools the arrays of records, each once, though the header may be made twice."""

    def __init__(self, spool: Spool) -> None:
        self._spool = spool
        self._ready: dict[int, tuple[AnyArray, _Blob]] = {}
        self._added: dict[int, tuple[AnyArray, _Blob]] = {}

    def add(self, array: AnyArray) -> _Blob:
        """Spool an array, unless it was spooled for the header that was made before."""
        blob = self._ready.pop(id(array))[1] if id(array) in self._ready else self._spool.add(array)
        self._added[id(array)] = array, blob
        return blob

    def start_again(self) -> None:
        """Be ready to give each blob again."""
        self._ready, self._added = self._added, {}


class _RecordWriter:
    """Writes records of a file whose clock is known, and counts times that were `rounded` to its unit."""

    def __init__(self, clock: FileClock, arrays: _Arrays) -> None:
        self.clock, self._arrays = clock, arrays
        self.items: list[tuple[Location, _Blob]] = []  # with locations in the header, where each leaves an empty text
        self.lowest = self.rounded = self.not_numbers = 0  # lowest time, 0 at most; numbers that JSON cannot state
        self._keys: list[str | int] = []

    @contextmanager
    def at(self, *keys: str | int) -> Iterator[None]:
        """Write what follows below these keys."""
        count = len(self._keys)
        self._keys += keys
        yield
        del self._keys[count:]

    def write(self, values: Mapping[str, Any], record: str) -> dict[str, Any]:
        """Write one record; fields that are None where the table knows them are left out."""
        fields = RECORDS[record]
        written: dict[str, Any] = {}
        for name, value in values.items():
            known = fields.get(name)
            if type(value) is _Blob:
                written[name] = ""
                self.items.append(((*self._keys, name), value))
            elif value is not None:
                self._keys.append(name)
                write = _WRITERS.get(known.kind) if known is not None else None
                written[name] = self.plain(value) if write is None else write(self, value, known)
                self._keys.pop()
            elif known is None:
                written[name] = None
        return written

    def write_list(self, values: Any, record: str) -> list[Any]:
        """Write a list of records, or, as in the projections of keypoints, a list of lists of them."""
        written: list[Any] = []
        for index, value in enumerate(values):
            self._keys.append(index)
            is_record = type(value) is dict or isinstance(value, Mapping)
            written.append(self.write(value, record) if is_record else self.write_list(value, record))
            self._keys.pop()
        return written

    def plain(self, value: Any) -> Any:  # noqa: PLR0911 - one a kind
        """Write any value that JSON and the container can hold."""
        if value is None or type(value) in _JSON_TYPES:
            return value
        if isinstance(value, _Blob | np.ndarray):
            if isinstance(value, np.ndarray) and value.dtype.name not in DTYPES:
                raise OptionError(f"{format_keys(self._keys)}: an array of {value.dtype}; expected numbers")
            self.items.append((tuple(self._keys), value if isinstance(value, _Blob) else self._arrays.add(value)))
            return ""
        if isinstance(value, np.generic):
            return self.plain(value.item())
        if isinstance(value, Mapping):
            return self._parts((str(key), part) for key, part in value.items())
        if isinstance(value, list | tuple):
            types = set(map(type, value))
            if types <= _JSON_TYPES or (types <= {int, float} and _all_finite(value)):
                return list(value)
            return list(self._parts(enumerate(value)).values())
        if isinstance(value, float):
            if abs(value) < float("inf"):
                return float(value)
            self.not_numbers += 1
            return None
        if isinstance(value, str | int):
            return str(value) if isinstance(value, str) else int(value)
        raise OptionError(f"{format_keys(self._keys)}: a {type(value).__name__}; JSON and arrays cannot hold it")

    def _parts(self, parts: Iterable[tuple[str | int, Any]]) -> dict[Any, Any]:
        written = {}
        for key, part in parts:
            self._keys.append(key)
            written[key] = self.plain(part)
            self._keys.pop()
        return written

    def time(self, value: Any, _: Field) -> Any:
        """Write nanoseconds as a timestamp."""
        if type(value) is not int:
            return self.plain(value)
        self.rounded += (value - self.clock.offset_ns) % self.clock.tick_ns != 0
        timestamp = self.clock.timestamp(value)
        self.lowest = min(self.lowest, timestamp)
        return timestamp

    def times(self, value: Any, field: Field) -> Any:
        """Write many times."""
        if isinstance(value, StaticTime):
            return [max(self.clock.timestamp(value), 0)]
        if isinstance(value, np.ndarray) and value.dtype.kind in "iu" and value.ndim == 1:
            timestamps, inexact = self.clock.timestamp_array(value.astype(np.int64))
            self.rounded += inexact
            written: list[int] = timestamps.tolist()
            self.lowest = min(self.lowest, *written) if written else self.lowest
            return written
        if isinstance(value, list | tuple) and set(map(type, value)) <= {int}:
            tick_ns, offset_ns = self.clock.tick_ns, self.clock.offset_ns
            if any((time - offset_ns) % tick_ns for time in value):
                return [self.time(time, field) for time in value]
            self.lowest = min(self.lowest, (min(value, default=offset_ns) - offset_ns) // tick_ns)
            return [(time - offset_ns) // tick_ns for time in value]
        return self.plain(value)

    def duration(self, value: Any, _: Field) -> Any:
        """Write nanoseconds as a duration."""
        return self.plain(self.clock.duration(value) if type(value) in (int, float) else value)

    def durations(self, value: Any, field: Field) -> Any:
        """Write many durations."""
        is_list = isinstance(value, list | tuple)
        return [self.duration(duration, field) for duration in value] if is_list else self.plain(value)

    def rows(self, value: Any, _: Field) -> Any:
        """Write rows of numbers as JSON: the description calls none of them binary."""
        if isinstance(value, np.ndarray) and value.dtype.kind in "biuf":
            values = value.tolist()
            return values if np.isfinite(value).all() else self.plain(values)
        return self.plain(value)

    def array(self, value: Any, field: Field) -> Any:
        """Write numbers as an array, if they are of its dtype."""
        if isinstance(value, list | tuple):
            try:
                return self.plain(np.asarray(value, field.dtype))
            except (ValueError, TypeError, OverflowError):
                pass
        return self.plain(value)

    def records(self, value: Any, field: Field) -> Any:
        """Write a record, or records; fields of unknown types may be anything."""
        if isinstance(value, Mapping):
            return self.write(value, field.record)
        return self.write_list(value, field.record) if _are_records(value) else self.plain(value)

    def record_map(self, value: Any, field: Field) -> Any:
        """Write records by name."""
        written = {}
        for name, record in value.items():
            with self.at(name):
                written[name] = self.write(record, field.record)
        return written


def _are_records(value: Any) -> bool:
    """Whether a value is a list of records, or a list of such lists."""
    return isinstance(value, list | tuple) and all(
        type(item) is dict or isinstance(item, Mapping) or _are_records(item) for item in value
    )


def _all_finite(values: Iterable[float]) -> bool:
    """Whether all numbers are finite; their sum shows it at once, unless it is beyond float64 itself."""
    try:
        return math.isfinite(math.fsum(values))
    except OverflowError:
        return all(value - value == 0 for value in values)
    except ValueError:  # infinity less infinity
        return False


_JSON_TYPES = frozenset({bool, int, str})

_WRITERS: Mapping[Kind, Callable[[_RecordWriter, Any, Any], Any]] = {
    Kind.TIME: _RecordWriter.time,
    Kind.TIMES: _RecordWriter.times,
    Kind.DURATION: _RecordWriter.duration,
    Kind.DURATIONS: _RecordWriter.durations,
    Kind.LIST: _RecordWriter.rows,
    Kind.ARRAY: _RecordWriter.array,
    Kind.RECORD: _RecordWriter.records,
    Kind.RECORDS: _RecordWriter.records,
    Kind.RECORD_OR_RECORDS: _RecordWriter.records,
    Kind.RECORD_LISTS: _RecordWriter.records,
    Kind.RECORD_MAP: _RecordWriter.record_map,
}
"""How the values of each kind are written; those of other kinds are plain."""

_VERSION = "1.0"
_LAYOUT = 1  # number of the layout of our metadata
_UNIT_OF = {tick_ns: unit for unit, tick_ns in TICKS_NS.items()}
_EVERYWHERE = "sensors[], annotations[], attributes[]"


@dataclass(slots=True)
class _Contents:
    """Everything that a writer was given, arrays of frames spooled already."""

    drafts: dict[tuple[type, Identifier], _SensorDraft] = field(default_factory=dict)
    annotations: list[dict[str, Any]] = field(default_factory=list)
    attributes: list[Mapping[str, Any]] = field(default_factory=list)  # of the scene and its sensors
    metadata: dict[str, Any] = field(default_factory=dict)  # free fields
    ours: dict[str, Any] = field(default_factory=dict)  # fields of our entry of the metadata
    extras: dict[str, Any] = field(default_factory=dict)  # unknown root fields
    time_unit: str | None = None  # its spelling; None for the usual one


def _make_header(contents: _Contents, profile: Profile, keeper: _ClockKeeper, losses: Losses) -> bytes:
    """Make the header's bytes; `$items` comes last."""
    firsts = [first for draft in contents.drafts.values() if (first := draft.first_ns()) is not None]
    if firsts:
        keeper.clock_for(min(firsts))
    arrays = _Arrays(keeper.spool)
    attempt = _Header(contents, profile, _RecordWriter(keeper.clock, arrays), Losses())
    header = attempt.make()
    if attempt.writer.lowest < 0:
        # a time that stands only in annotations or attributes is earlier than all frames and poses
        keeper.clock_for(attempt.writer.lowest * keeper.tick_ns + keeper.clock.offset_ns)
        arrays.start_again()
        attempt = _Header(contents, profile, _RecordWriter(keeper.clock, arrays), Losses())
        header = attempt.make()
    losses.extend(attempt.losses)
    header[ITEMS] = [
        {"keys": list(keys), "length": b.length, "offset": b.offset, "dtype": b.dtype, "shape": list(b.shape)}
        for keys, b in attempt.writer.items
    ]
    try:
        return msgspec.json.encode(header)
    except RecursionError:
        raise OptionError("the scene's fields nest too deeply for JSON") from None
    except UnicodeEncodeError as error:
        raise OptionError(f"the scene holds text that is no Unicode: {error}") from None


@dataclass(frozen=True, slots=True)
class _Header:
    """One attempt at the header."""

    contents: _Contents
    profile: Profile
    writer: _RecordWriter
    losses: Losses

    def make(self) -> dict[str, Any]:
        """Write everything; the locations of arrays are left empty."""
        contents, clock = self.contents, self.writer.clock
        sensors, sensors_aside, notes = self._sensors()
        annotations, annotations_aside, exact = self._annotations()
        attributes, attributes_aside, exact_of_scene = self._attributes()
        header: dict[str, Any] = {
            "version": _VERSION,
            "time_unit": contents.time_unit or _UNIT_OF[clock.tick_ns],
            "time_offset": max(clock.offset_ns, 0) // clock.tick_ns,
            "sensors": sensors,
            "annotations": annotations,
            "attributes": attributes,
        }
        with self.writer.at("metadata"):
            header["metadata"] = self.writer.plain(contents.metadata)
        ours = {
            **contents.ours,
            "time_shift_ns": -clock.offset_ns if clock.offset_ns < 0 else None,
            "sensor_notes": notes or None,
            "attributes": attributes_aside or None,
            "exact_attributes": exact_of_scene + exact or None,
        }
        with self.writer.at("metadata", OURS):
            written = self.writer.write(ours, OURS)
        # what the format or the profile has no field for
        if sensors_aside:
            written["sensors"] = self._list(sensors_aside, sensor_record, "metadata", OURS, "sensors")
        if annotations_aside:
            written["annotations"] = self._list(annotations_aside, annotation_record, "metadata", OURS, "annotations")
        if written:
            header["metadata"][OURS] = {"layout": _LAYOUT, **written}
        further = {name: value for name, value in contents.extras.items() if name not in header}
        header |= self.writer.write(further, "scene")
        what = "times rounded to whole microseconds, halves to even: at most 0.5 µs off"
        self.losses.converted(_EVERYWHERE, what, count=self.writer.rounded, error=_ROUNDING)
        what = "numbers that are infinite or none, written as null"
        self.losses.dropped(_EVERYWHERE, what, count=self.writer.not_numbers)
        return header

    def _list(self, records: Sequence[Mapping[str, Any]], record_of: Any, *keys: str) -> list[dict[str, Any]]:
        written = []
        for index, record in enumerate(records):
            with self.writer.at(*keys, index):
                written.append(self.writer.write(record, record_of(record["type"])))
        return written

    def _sensors(self) -> tuple[list[Any], list[dict[str, Any]], list[dict[str, Any]]]:
        """Write the sensors; give those that must stand aside, and the notes."""
        kept: list[dict[str, Any]] = []
        aside: list[dict[str, Any]] = []
        notes: list[dict[str, Any]] = []
        for draft in self.contents.drafts.values():
            record = draft.record(self.writer.clock, self.losses)
            obstacle = self.profile.sensor_obstacle(record, self.writer.clock)
            (kept if obstacle is None else aside).append(record)
            if obstacle is not None:
                self.losses.dropped(draft.location, obstacle, kept="metadata.sceneloom.sensors")
            if draft.note:
                notes.append({"id": draft.id, **draft.note})
        return self._list(kept, sensor_record, "sensors"), aside, notes

    def _annotations(self) -> tuple[list[Any], list[dict[str, Any]], list[Mapping[str, Any]]]:
        """Write the annotations; give those that must stand aside, and the exact attributes."""
        kept: list[dict[str, Any]] = []
        aside: list[dict[str, Any]] = []
        exact: list[Mapping[str, Any]] = []
        for record in self.contents.annotations:
            simple, exact_records = record, list[Mapping[str, Any]]()
            if isinstance(record.get("attributes"), list | tuple):
                attributes, exact_records = self.profile.simplified_attributes(record["attributes"], record["id"])
                simple = {**record, "attributes": attributes}
            obstacle = self.profile.annotation_obstacle(simple)
            if obstacle is None:
                kept.append(simple)
                exact += exact_records
            else:
                aside.append(record)
                where = "metadata.sceneloom.annotations"
                self.losses.dropped(f"annotations[{record['type']}]", obstacle, kept=where)
        self._note_exact(exact, "annotations[].attributes[]")
        return self._list(kept, annotation_record, "annotations"), aside, exact

    def _attributes(self) -> tuple[list[Any], list[Mapping[str, Any]], list[Mapping[str, Any]]]:
        """Write the scene's attributes; give those that must stand aside, and the exact ones."""
        fitting, aside = self.profile.fitting_attributes(self.contents.attributes)
        simple, exact = self.profile.simplified_attributes(fitting, None)
        what = "Scale's loader takes text and integers only"
        self.losses.dropped("attributes[]", what, count=len(aside), kept="metadata.sceneloom.attributes")
        self._note_exact(exact, "attributes[]")
        return self.writer.write({"attributes": simple}, "scene")["attributes"], aside, exact

    def _note_exact(self, exact: Sequence[Mapping[str, Any]], where: str) -> None:
        what = "made integers (fractions in thousandths), static ones with one time stamp"
        self.losses.dropped(where, what, count=len(exact), kept="metadata.sceneloom.exact_attributes")


def _mount_rows(mount: RigidTransform) -> list[list[float]]:
    """Write a mounting as the three rows of R and t, digit for digit."""
    rows: list[list[float]] = mount.matrix[:3].tolist()
    return rows
