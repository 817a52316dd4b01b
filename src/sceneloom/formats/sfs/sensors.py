"""Sensors of a file: lidars, radars, points, cameras, odometry, IMU and GNSS, and the trajectories."""

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field, replace
from functools import partial
from itertools import pairwise
from types import MappingProxyType
from typing import TYPE_CHECKING, Any, Self, cast

import numpy as np

from sceneloom.arrays import AnyArray, Int64Array, UInt8Array, read_only
from sceneloom.cameras.camera import Camera
from sceneloom.errors import ArrayError, CalibrationError, DataError
from sceneloom.formats.base.files import Bytes, check_pixels
from sceneloom.formats.sfs.clock import TimeRangeError
from sceneloom.formats.sfs.container import Container, Content, format_keys
from sceneloom.formats.sfs.records import (
    Faults,
    FieldError,
    Location,
    Source,
    camera_of,
    extras_of_intrinsics,
    extras_of_poses,
    read_camera_model,
    repaired_poses,
    root_fault,
    rows_of,
    times_of,
    with_extras,
)
from sceneloom.formats.sfs.schema import RECORDS, SENSOR_ALIASES, SENSOR_RECORDS, sensor_record
from sceneloom.geometry.rigid import RigidTransform
from sceneloom.scene.cameras import CameraImage, CameraSensor, VideoContent
from sceneloom.scene.clouds import (
    LidarFrame,
    LidarPoints,
    LidarSensor,
    PointsSensor,
    RadarFrame,
    RadarPoints,
    RadarSensor,
)
from sceneloom.scene.frames import LazyFrames
from sceneloom.scene.motion import GnssSensor, ImuSensor, OdometrySensor, PlainSensor, VectorSamples
from sceneloom.scene.poses import Poses
from sceneloom.scene.scene import Sensor
from sceneloom.scene.types import NO_FIELDS, Coordinates, PointsFrame
from sceneloom.warnings import WarningKind

if TYPE_CHECKING:
    from sceneloom.formats.video.reader import VideoIndex, VideoReader

_CODECS: Mapping[bytes, str] = MappingProxyType({
    b"avc1": "h264", b"avc3": "h264", b"hvc1": "hevc", b"hev1": "hevc", b"av01": "av1", b"vp09": "vp9", b"vp08": "vp8",
    b"mp4v": "mpeg4", b"jpeg": "mjpeg", b"mjpa": "mjpeg", b"FFV1": "ffv1", b"png ": "png",
})  # fmt: skip
"""Sample entry of the video track, and what FFmpeg calls its codec. Source: the registry at mp4ra.org."""

_LONG_SIZE, _TO_THE_END = 1, 0
_MOST_BOXES = 10_000
UNKNOWN_CODEC = "unknown"


def is_mp4(content: Bytes) -> bool:
    """Whether the bytes begin as an mp4 file does; QuickTime's own brand is another format."""
    return bytes(content[4:8]) == b"ftyp" and bytes(content[8:12]) != b"qt  "


def declared_length(content: Any) -> int:
    """How long an mp4 video has to be by the sizes of its boxes [bytes].

    Args:
        content: its bytes, by slices.

    Source: ISO/IEC 14496-12, 4.2.
    """
    location, available = 0, len(content)
    while location + 8 <= available:
        head = bytes(content[location : location + 16])
        size = int.from_bytes(head[:4], "big")
        size = int.from_bytes(head[8:16], "big") if size == 1 else size
        if size < 8:  # up to the end, or no box
            return available
        location += size
    return max(location, available)


def video_codec(content: Bytes) -> str:
    """Name the codec of the first known track, as FFmpeg calls it; "unknown" where none is found.

    Source: ISO/IEC 14496-12, 4.2 (boxes) and 8.5.2 (sample description).
    """
    movie = _box(content, b"moov")
    location = 0
    while (location := movie.find(b"stsd", location)) >= 0:
        entry = movie[location + 16 : location + 20]
        if entry in _CODECS:
            return _CODECS[entry]
        location += 4
    return UNKNOWN_CODEC


def _box(content: Bytes, wanted: bytes) -> bytes:
    """Find a box of the outermost level and give what is in it; nothing where there is none."""
    location = 0
    for _ in range(_MOST_BOXES):
        size, name = (
            int.from_bytes(content[location : location + 4], "big"),
            bytes(content[location + 4 : location + 8]),
        )
        header = 8
        if size == _LONG_SIZE:
            size, header = int.from_bytes(content[location + 8 : location + 16], "big"), 16
        stop = len(content) if size == _TO_THE_END else location + size
        if name == wanted:
            return bytes(content[location + header : stop])
        if stop < location + header or stop >= len(content):
            break
        location = stop
    return b""


_Fields = dict[str, Any]


def read_sensors(source: Source, raw: Any, location: Location) -> tuple[Sensor, ...]:
    """Read a list of sensors; those at fault are left out."""
    if raw is None:
        return ()
    if not isinstance(raw, list):
        root_fault(source, location, "expected a list of sensors")
        return ()
    sensors = []
    for index, item in enumerate(raw):
        faults = Faults()
        sensor = _read_sensor(source, item, (*location, index), faults)
        if source.settle(faults, (*location, index)) and sensor is not None:
            sensors.append(sensor)
    return tuple(sensors)


def _read_sensor(source: Source, raw: Any, location: Location, faults: Faults) -> Sensor | None:
    type_name = raw.get("type") if isinstance(raw, dict) else None
    if not isinstance(type_name, str):
        faults.add(("type",), f"{type_name!r}; expected one of {', '.join(SENSOR_RECORDS)}")
        return None
    known = SENSOR_ALIASES.get(type_name, type_name)
    if known != type_name:
        source.warning(WarningKind.ASSUMED, "sensor-alias", location, f"type {type_name!r}; read as {known!r}")
    is_known = known in _READERS
    values = source.reader(forgiving=not is_known).read(raw, sensor_record(type_name), faults)
    if not is_known and not isinstance(values.get("id"), str | int):
        faults.add(("id",), f"{values.get('id')!r}; expected text or an integer")
    if faults:
        if is_known:
            fields = RECORDS[sensor_record(type_name)]
            _note_further_faults({name: v for name, v in values.items() if name in fields}, faults)
        return None
    if not is_known:
        return PlainSensor(values.pop("id"), values.pop("type"), values)
    return _READERS[known](_Record(source, values, location, faults, source.note(values["id"])))


@dataclass(frozen=True, slots=True)
class _Record:
    """The record of a sensor while it is read."""

    source: Source
    values: _Fields  # times in nanoseconds; readers take out what the model has attributes for
    location: Location
    faults: Faults  # with locations in the record
    note: Mapping[str, Any]  # what our metadata says about the sensor

    def warning(self, kind: WarningKind, code: str, message: str, *below: str) -> None:
        """Note something about a part of the sensor."""
        self.source.warning(kind, code, (*self.location, *below), message)

    def extras(self) -> _Fields:
        """The fields that no attribute of the model takes."""
        taken = {"id", "type", "parent_id", "poses", "coordinates", "points", "frames"}
        unknown = {name: value for name, value in self.values.items() if name not in taken}
        of_poses = extras_of_poses(self.values.get("poses") or {})
        return {**unknown, **({"poses": of_poses} if of_poses else {})}

    def moving(self, frame_count: int) -> _Fields:
        """What every sensor with poses has: `poses`, `mount`, `coordinates`, `parent_id`."""
        coordinates = self.values.get("coordinates") or Coordinates.WORLD.value
        if coordinates not in set(Coordinates):
            self.faults.add(("coordinates",), f"{coordinates!r}; expected one of {', '.join(Coordinates)}")
            return {}
        before = len(self.faults)
        poses = None if self.values.get("poses") is None else repaired_poses(self.values["poses"], self.faults)
        if poses is None and len(self.faults) == before:
            self.warning(WarningKind.SKIPPED, "no-poses", "no poses; expected where the sensor was", "poses")
        mount = None
        try:
            mount = None if self.note.get("mount") is None else _mount_of(self.note["mount"])
        except FieldError as error:
            self.faults.add(("mount",), f"our note: {error}")
        if self.note.get("poses_from_mount"):
            poses, coordinates = None, self.note.get("coordinates", Coordinates.WORLD.value)
        elif poses is not None and len(poses.timestamps_ns) == 1:
            static = self.note.get("poses_static", coordinates == Coordinates.EGO or frame_count != 1)
            poses = _with_static(poses, static=bool(static))
            if static and "poses_static" not in self.note:
                self.warning(WarningKind.ASSUMED, "single-pose", "a single pose; taken to hold at all times", "poses")
        return {
            "poses": poses,
            "mount": mount,
            "coordinates": Coordinates(coordinates),
            "parent_id": self.values.get("parent_id"),
        }


def _with_static(poses: Poses, *, static: bool) -> Poses:
    return Poses(poses.timestamps_ns, poses.positions, poses.quaternions_xyzw, static=static)


LIDAR_ARRAYS = {
    "positions": "positions",
    "colors": "colors",
    "intensities": "intensities",
    "timestamps": "timestamps_ns",
    "ring": "rings",
    "camera_index": "camera_index",
}
"""The arrays of a lidar's points in the file, and the attributes of the model."""

RADAR_ARRAYS = {
    "positions": "positions",
    "directions": "directions",
    "lengths": "lengths",
    "timestamps": "timestamps_ns",
}
"""The arrays of a radar's points in the file, and the attributes of the model."""

_OURS = {"ring": np.dtype(np.uint16), "camera_index": np.dtype(np.uint8)}
_OTHER_WIDTH = {4: "uint64", 8: "uint32"}
_TYPICAL_PERIOD_NS = 100_000_000


def _read_cloud(record: _Record) -> LidarSensor | RadarSensor | None:
    """Make a lidar or radar of its record."""
    source, values, note, faults = record.source, record.values, record.note, record.faults
    frames, is_lidar = values.pop("frames"), values["type"] == "lidar"
    if not is_lidar:
        _restore_lengths(frames, note, faults)
    relative = False
    if not faults.unrepaired:
        for index, frame in enumerate(frames):
            _check_counts(frame["points"], ("frames", index, "points"), faults)
        relative = not faults and _times_are_relative(source, frames)
    if relative:
        message = "point times lie before their frame and within one period; read as counted from the frame's start"
        record.warning(WarningKind.ASSUMED, "relative-point-times", message, "frames")
    moving = record.moving(len(frames))
    if faults.unrepaired:
        return None
    shared = {
        "id": values.pop("id"),
        "frames": LazyFrames(
            np.array([frame["timestamp"] for frame in frames], np.int64),
            _frame_reader(record, frames, relative=relative, is_lidar=is_lidar),
        ),
        "points_frame": _points_frame(record, moving["coordinates"]),
        **moving,
        "extras": record.extras(),
    }
    return LidarSensor(**shared, model=note.get("model")) if is_lidar else RadarSensor(**shared)


def _points_frame(record: _Record, coordinates: Coordinates) -> PointsFrame:
    """The frame of the points: by the caller's option, else as recorded, else as `coordinates` says."""
    if record.source.options.points_frame is not None:
        return PointsFrame(record.source.options.points_frame)
    recorded = record.note.get("points_frame")
    if recorded in set(PointsFrame):
        return PointsFrame(recorded)
    message = f"the frame of the points is not stated; taken to be the {coordinates.value} frame"
    record.warning(WarningKind.ASSUMED, "points-frame", message)
    return PointsFrame(coordinates.value)


def _frame_reader(record: _Record, frames: list[_Fields], *, relative: bool, is_lidar: bool) -> Callable[[int], Any]:
    container, clock, location = record.source.container, record.source.clock, (*record.location, "frames")

    def read(index: int) -> LidarFrame | RadarFrame:
        where = format_keys((*location, index))
        container.check_open(where)
        frame = container.fetch(frames[index])
        timestamp_ns, points = frame["timestamp"], frame["points"]
        times_ns, timestamps = None, points.get("timestamps")
        if timestamps is not None and relative:
            times_ns = read_only(timestamps.astype(np.int64) * clock.tick_ns + timestamp_ns)
        elif timestamps is not None:
            try:
                times_ns = read_only(clock.absolute_array(timestamps))
            except TimeRangeError as error:
                raise DataError(container.file, f"{where}.points.timestamps", str(error)) from None
        arrays, unknown = _known_arrays(points, LIDAR_ARRAYS if is_lidar else RADAR_ARRAYS)
        extras = {name: value for name, value in frame.items() if name not in {"timestamp", "points"}}
        if is_lidar:
            return LidarFrame(timestamp_ns, LidarPoints(**arrays, timestamps_ns=times_ns, extras=unknown), extras)
        return RadarFrame(timestamp_ns, RadarPoints(**arrays, timestamps_ns=times_ns, extras=unknown), extras)

    return record.source.parts.keep(format_keys(location), read)


def _known_arrays(points: _Fields, names: Mapping[str, str]) -> tuple[_Fields, _Fields]:
    """Part the arrays that the model knows, besides times, from those that it only carries along."""
    known, unknown = {}, {}
    for name, value in points.items():
        if name == "timestamps" or (name in names and value is None):
            continue
        if name in names and _is_as_named(name, value, points):
            known[names[name]] = _aligned(value)
        else:
            unknown[name] = value
    return known, unknown


def _is_as_named(name: str, value: Any, points: _Fields) -> bool:
    """Whether an array is what its name says; `ring` and `camera_index` may be a stranger's."""
    if name not in _OURS:
        return True
    return isinstance(value, np.ndarray) and value.dtype == _OURS[name] and value.shape == points["positions"].shape[:1]


def _aligned(array: AnyArray) -> AnyArray:
    """Copy an array whose items lie at odd addresses: compiled functions cannot take it."""
    return array if array.flags.aligned else read_only(array.copy())


def _check_counts(points: _Fields, location: Location, faults: Faults) -> None:
    count = len(points["positions"])
    for name in ("colors", "intensities", "timestamps", "directions", "lengths"):
        array = points.get(name)
        if isinstance(array, np.ndarray) and len(array) != count:
            problem = f"{len(array)} values for {count} points; expected as many"
            if name == "timestamps" and len(array) in {2 * count, count / 2}:
                problem += f": the bytes fit {_OTHER_WIDTH.get(array.dtype.itemsize, 'another width')}, not "
                problem += f"{array.dtype.name}; see `time_unit` of the scene, which decides where no dtype says it"
            faults.add((*location, name), problem)


def _note_further_faults(values: _Fields, faults: Faults) -> None:
    """Look through a sensor that is at fault for what else is wrong in its frames and poses."""
    frames = values.get("frames")
    for index, frame in enumerate(frames if isinstance(frames, list) else []):
        points = frame.get("points") if isinstance(frame, dict) else None
        if isinstance(points, dict) and isinstance(points.get("positions"), np.ndarray):
            _check_counts(points, ("frames", index, "points"), faults)
    poses = values.get("poses")
    if isinstance(poses, dict) and not any(poses.get(name) is None for name in ("timestamps", "values")):
        repaired_poses(poses, faults)


def _times_are_relative(source: Source, frames: list[_Fields]) -> bool:
    """Whether point times count from the frame's start: the last ones all lie below it, and within one period."""
    timestamps_ns = sorted(frame["timestamp"] for frame in frames)
    gaps_ns = sorted(after - before for before, after in pairwise(timestamps_ns))
    period_ns = gaps_ns[len(gaps_ns) // 2] if gaps_ns else _TYPICAL_PERIOD_NS
    tick_ns, offset_ns = source.clock.tick_ns, source.clock.offset_ns
    for frame in reversed(frames):
        times = frame["points"].get("timestamps")
        if isinstance(times, np.ndarray) and times.size:
            latest_ns = int(source.container.fetch(times).max()) * tick_ns
            return latest_ns < frame["timestamp"] - offset_ns and latest_ns <= period_ns
    return False


def _restore_lengths(frames: list[_Fields], note: Mapping[str, Any], faults: Faults) -> None:
    """Put back the lengths that the profile `scale` keeps under our metadata."""
    lengths = note.get("lengths")
    if lengths is None:
        return
    if len(lengths) != len(frames):
        faults.add(("frames",), f"our note holds lengths of {len(lengths)} frames; expected {len(frames)}")
        return
    for frame, values in zip(frames, lengths, strict=True):
        if isinstance(values, np.ndarray) and values.dtype == np.float32 and values.ndim == 1:
            frame.setdefault("points", {}).setdefault("lengths", values)


def _read_points(record: _Record) -> PointsSensor | None:
    """Make a points sensor of its record."""
    points = record.values.pop("points")
    _check_counts(points, ("points",), record.faults)
    if record.faults:
        return None
    extras, colors = record.extras(), points.get("colors")
    unknown = {name: array for name, array in points.items() if name not in {"positions", "colors"}}
    if unknown:
        extras["points"] = unknown
    return PointsSensor(
        record.values["id"],
        _aligned(points["positions"]),
        None if colors is None else _aligned(colors),
        parent_id=record.values.get("parent_id"),
        extras=extras,
    )


def _read_odometry(record: _Record) -> OdometrySensor | None:
    """Make an odometry sensor of its record."""
    poses = repaired_poses(record.values["poses"], record.faults)
    if poses is None:
        if not record.faults.unrepaired:
            record.faults.add(("poses",), "empty; expected at least one pose")
        return None
    if record.note.get("poses_static"):
        poses = _with_static(poses, static=len(poses.timestamps_ns) == 1)
    identifier, parent_id = record.values["id"], record.values.get("parent_id")
    return OdometrySensor(identifier, poses, parent_id=parent_id, extras=record.extras())


def _read_imu(record: _Record) -> ImuSensor | None:
    """Make an IMU of the record in our metadata."""
    streams = {}
    for name, samples in record.values.pop("streams").items():
        try:
            streams[name] = VectorSamples(samples["timestamps_ns"], samples["values"], samples.get("file_seconds"))
        except ArrayError as error:
            record.faults.add(("streams", name), str(error))
    if record.faults:
        return None
    identifier, parent_id = record.values["id"], record.values.get("parent_id")
    return ImuSensor(identifier, streams, parent_id=parent_id, extras=record.extras())


GNSS_ARRAYS = ("timestamps_ns", "positions_lla", "accuracies", "vertical_accuracies", "file_seconds")


def _read_gnss(record: _Record) -> GnssSensor | None:
    """Make a GNSS receiver of the record in our metadata."""
    values = record.values
    arrays = {name: values.pop(name) for name in GNSS_ARRAYS if values.get(name) is not None}
    rows = values.pop("mount", None)
    try:
        mount = None if rows is None else _mount_of(rows)
        parent_id, extras = values.get("parent_id"), record.extras()
        return GnssSensor(values["id"], **arrays, mount=mount, parent_id=parent_id, extras=extras)
    except FieldError as error:
        record.faults.add(("mount",), str(error))
    except ArrayError as error:
        record.faults.add((), str(error))
    return None


def _read_camera(record: _Record) -> CameraSensor | None:
    """Make a camera of its record."""
    source, values, note, faults = record.source, record.values, record.note, record.faults
    intrinsics, before = values.pop("intrinsics"), len(faults)
    try:
        camera = read_camera_model(source, intrinsics, note, (*record.location, "intrinsics"))
    except (FieldError, CalibrationError) as error:
        faults.add(("intrinsics",), str(error))
        return None
    content = _content(record, camera)
    count = len(content.starts_ns)
    moving = record.moving(count)
    own = _ImageNotes(camera)
    try:
        own = _ImageNotes.of(note.get("images") or {}, camera, count)
    except (FieldError, CalibrationError) as error:
        faults.add(("images",), f"our note: {error}")
    if any(not fault.repaired for fault in faults[before:]):
        return None
    extras = {**record.extras(), **content.extras}
    unknown = extras_of_intrinsics(intrinsics)
    if unknown:
        extras["intrinsics"] = unknown
    own_fields = content.own_fields or [own.extras(k) for k in range(count)]
    exposures_ns = np.array([exposure_ns(fields, extras) for fields in own_fields], np.int64)
    middles_ns = content.starts_ns + exposures_ns // 2

    def read(index: int) -> CameraImage:
        image = content.read(index, own.camera(index))
        extras = {**image.extras, **own.extras(index)}
        return replace(image, timestamp_ns=int(middles_ns[index]), mount=own.mount(index), extras=extras)

    noted_fps = note.get("fps")
    return CameraSensor(
        values["id"],
        camera,
        LazyFrames(middles_ns, source.parts.keep(format_keys((*record.location, "images")), read)),
        video=content.video,
        fps=float(noted_fps) if content.fps is None and isinstance(noted_fps, int | float) else content.fps,
        **moving,
        extras=extras,
    )


_READERS: Mapping[str, Callable[[_Record], Sensor | None]] = {
    "lidar": _read_cloud,
    "radar": _read_cloud,
    "points": _read_points,
    "camera": _read_camera,
    "odometry": _read_odometry,
    "imu": _read_imu,
    "gnss": _read_gnss,
}

_EXPOSURE = "exposureTimeSeconds"  # the field of a camera or an image with the exposure time [s]
_LONGEST_EXPOSURE = 3600.0


def exposure_ns(*fields: Mapping[str, Any]) -> int:
    """The exposure time of an image [ns], as the first fields state that state one; 0 where none do."""
    for seconds in (given.get(_EXPOSURE) for given in fields):
        if isinstance(seconds, int | float) and 0 <= seconds < _LONGEST_EXPOSURE:
            return round(seconds * 1e9)
    return 0


def _no_image(index: int, _: Camera) -> CameraImage:
    raise IndexError(index)


@dataclass(frozen=True, slots=True, eq=False)
class _ImageContent:
    """Where a camera's images come from; by default, from nowhere."""

    starts_ns: Int64Array = field(default_factory=lambda: np.zeros(0, np.int64))  # of each image
    read: Callable[[int, Camera], CameraImage] = _no_image  # image `k` by its camera model, timed by its start
    video: VideoContent | None = None
    fps: float | None = None
    extras: Mapping[str, Any] = field(default_factory=lambda: NO_FIELDS)  # without another location in the model
    own_fields: Sequence[Mapping[str, Any]] = ()  # unknown fields of each image; empty where none has any


def _content(record: _Record, camera: Camera) -> _ImageContent:
    """Choose between `video` and `images`; what is not chosen stays among the unknown fields."""
    video, images = record.values.pop("video", None), record.values.pop("images", None)
    if video is not None:
        if images is not None:
            record.values["images"] = images
            message = "both video and images; the video is taken, the images are carried along"
            record.warning(WarningKind.ASSUMED, "video-and-images", message)
        return _video_content(record.source, video, (*record.location, "video"))
    if images is not None:
        return _image_content(record.source, images, (*record.location, "images"))
    record.warning(WarningKind.SKIPPED, "no-images", f"neither video nor images; {camera.model} camera model only")
    return _ImageContent()


def _video_content(source: Source, video: Mapping[str, Any], location: Location) -> _ImageContent:
    """Give the images of a `video` record; the video is opened when its first image is read."""
    where = format_keys((*location, "content"))
    coded = source.container.bytes_of(video["content"])
    player = _Player(source.container, coded, where)
    source.parts.videos[where] = player
    rgb, open_file = source.parts.keep(where, player.rgb), source.parts.keep(f"{where}: file", player.open)
    starts_ns = times_of(video["timestamps"])
    starts = starts_ns.tolist()

    def read(index: int, camera: Camera) -> CameraImage:
        return CameraImage(starts[index], _with_size(camera, player.size()), partial(rgb, index))

    unknown = {name: value for name, value in video.items() if name not in {"timestamps", "content", "fps"}}
    return _ImageContent(
        starts_ns,
        read,
        VideoContent(open_file, video_codec(coded)),
        None if video.get("fps") is None else float(video["fps"]),
        {"video": unknown} if unknown else NO_FIELDS,
    )


def _image_content(source: Source, images: list[Mapping[str, Any]], location: Location) -> _ImageContent:
    """Give the images of an `images` list."""
    container = source.container

    def encoded(index: int) -> tuple[AnyArray, str]:
        where = format_keys((*location, index, "content"))
        container.check_open(where)
        return container.fetch(images[index]["content"]), where

    def decode(index: int) -> UInt8Array:
        from simplejpeg import decode_jpeg, decode_jpeg_header

        content, where = encoded(index)
        try:
            height, width = decode_jpeg_header(content.data)[:2]
            check_pixels(container.file, where, width, height)
            return cast("UInt8Array", decode_jpeg(content.data, "RGB"))
        except (ValueError, RuntimeError, MemoryError) as error:
            raise DataError(container.file, where, f"cannot be decoded as JPEG: {error}") from None

    rgb = source.parts.keep(f"{format_keys(location)}: content", decode)
    own = [{k: v for k, v in image.items() if k not in {"timestamp", "content"}} for image in images]

    def read(index: int, camera: Camera) -> CameraImage:
        from simplejpeg import decode_jpeg_header

        content, _ = encoded(index)
        try:
            height, width = decode_jpeg_header(content.data)[:2]
        except (ValueError, RuntimeError):  # an image without a head may still be copied
            height, width = camera.height, camera.width
        camera = _with_size(camera, (width, height))
        timestamp_ns, image_rgb = images[index]["timestamp"], partial(rgb, index)
        return CameraImage(timestamp_ns, camera, image_rgb, extras=own[index], encoded=content.tobytes)

    starts_ns = np.array([image["timestamp"] for image in images], np.int64)
    return _ImageContent(starts_ns, read, own_fields=own)


def _with_size(camera: Camera, size: tuple[int, int]) -> Camera:
    return camera if size == (camera.width, camera.height) else camera.resized(*size)


class _Player:
    """Opens a video at its first use and keeps it open; `index` is the list of its images."""

    # It has no lock, which a fork could leave locked for good: two threads may both open the video, and one wins.

    def __init__(self, container: Container, content: Content, location: str) -> None:
        self._container, self._content, self._location = container, content, location
        self._reader: VideoReader | None = None
        self.index: VideoIndex | None = None
        container.on_close(self._close)

    def open(self) -> Any:
        """Open the video's bytes as a file."""
        from sceneloom.formats.video.reader import open_bytes

        self._container.check_open(self._location)
        return open_bytes(self._content)

    def size(self) -> tuple[int, int]:
        """Width and height of its images [px]."""
        reader = self._opened()
        check_pixels(self._container.file, self._location, reader.width, reader.height)
        return reader.width, reader.height

    def rgb(self, index: int) -> UInt8Array:
        """Decode one image."""
        reader = self._opened()
        if self.index is None:
            self.index = reader.index
        return reader.rgb(index)

    def _opened(self) -> "VideoReader":
        from sceneloom.formats.video.reader import VideoReader, read_table_index

        self._container.check_open(self._location)
        reader = self._reader
        if reader is None:
            name = f"{self._container.file}: {self._location}"
            if self.index is None and self._container.is_remote and is_mp4(self._content):
                self.index = read_table_index(self._content, name)
            reader = self._reader = VideoReader(self._content, name=name, index=self.index)
        return reader

    def _close(self) -> None:
        reader, self._reader = self._reader, None
        if reader is not None:
            reader.close()


@dataclass(frozen=True, slots=True, eq=False)
class _ImageNotes:
    """The own camera models, mountings and fields of a camera's images; each list is empty where no image has one."""

    camera_model: Camera
    cameras: Sequence[Camera] = ()
    mounts: Sequence[RigidTransform | None] = ()
    fields: Sequence[Mapping[str, Any]] = ()

    @classmethod
    def of(cls, note: Mapping[str, Any], camera_model: Camera, count: int) -> Self:
        """Read the note of a camera with so many images."""

        def listed(name: str) -> list[Any]:
            values = note.get(name)
            found = values.tolist() if isinstance(values, np.ndarray) else values or []
            if not isinstance(found, list) or (found and len(found) != count):
                raise FieldError(f"{name}: expected a list of one entry per image")
            return found

        cameras = [camera_of(record) for record in note.get("cameras") or []]
        chosen, fields = listed("camera_of_image"), listed("extras")
        if any(type(k) is not int or not 0 <= k < len(cameras) for k in chosen):
            raise FieldError(f"camera_of_image: expected numbers below {len(cameras)}")
        if any(not isinstance(extra, dict | None) for extra in fields):
            raise FieldError("extras: expected objects")
        mounts = [None if row is None else _mount_of(row) for row in listed("mounts")]
        return cls(camera_model, [cameras[k] for k in chosen], mounts, [extra or NO_FIELDS for extra in fields])

    def camera(self, index: int) -> Camera:
        """The camera model of an image."""
        return self.cameras[index] if self.cameras else self.camera_model

    def mount(self, index: int) -> RigidTransform | None:
        """The mounting of an image where it has one of its own."""
        return self.mounts[index] if self.mounts else None

    def extras(self, index: int) -> Mapping[str, Any]:
        """Unknown fields of an image."""
        return self.fields[index] if self.fields else NO_FIELDS


def intrinsics_record(camera: Camera, extras: Any) -> _Fields:
    """Make the `intrinsics` record of a camera model that the format can hold, with unknown fields, if any."""
    record: _Fields = {name: getattr(camera, name) for name in ("fx", "fy", "cx", "cy", "width", "height")}
    if camera.model != "pinhole":
        record["distortion"] = {"model": camera.model, "params": list(camera.coefficients)}
    if not isinstance(extras, Mapping):
        return record
    of_distortion = extras.get("distortion")
    if isinstance(of_distortion, Mapping):
        record["distortion"] = with_extras(record.get("distortion") or {}, of_distortion)
    return with_extras(record, extras)


def _mount_of(rows: Any) -> RigidTransform:
    """Make a mounting of the three rows of R and t; a FieldError where they are no rigid transform."""
    matrix = rows_of(rows, 4)
    if len(matrix) != 3:
        raise FieldError(f"{len(matrix)} rows; expected three of R and t")
    try:
        with np.errstate(over="ignore", invalid="ignore"):
            return RigidTransform(matrix[:, :3], matrix[:, 3])
    except (ArrayError, CalibrationError) as error:
        raise FieldError(str(error)) from None
