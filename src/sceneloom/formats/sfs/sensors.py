"""Sensors of a file: lidars, radars, points, cameras, odometry, IMU and GNSS, and the trajectories."""

from collections.abc import Callable, Mapping
from dataclasses import dataclass, field, replace
from functools import partial
from itertools import pairwise
from types import MappingProxyType
from typing import TYPE_CHECKING, Any, Self, cast

import numpy as np

from sceneloom.arrays import AnyArray, Int64Array, UInt8Array, read_only
from sceneloom.cameras.camera import Camera
from sceneloom.errors import ArrayError, CalibrationError, DataError
from sceneloom.formats.base.files import check_pixels
from sceneloom.formats.sfs.clock import TimeRangeError
from sceneloom.formats.sfs.container import Container, MappedContent, RemoteContent, format_keys
from sceneloom.formats.sfs.images import is_mp4, video_codec
from sceneloom.formats.sfs.metadata import Source, root_fault
from sceneloom.formats.sfs.records import (
    Faults,
    FieldError,
    Location,
    extras_of_poses,
    mount_of,
    mount_rows,
    repaired_poses,
    times_of,
    with_extras,
)
from sceneloom.formats.sfs.schema import (
    COEFFICIENT_COUNTS,
    RECORDS,
    SENSOR_ALIASES,
    SENSOR_RECORDS,
    sensor_record,
)
from sceneloom.formats.sfs.spec import BROWN
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
from sceneloom.scene.poses import Poses, Trajectory
from sceneloom.scene.scene import Sensor
from sceneloom.scene.types import NO_FIELDS, Coordinates, PointsFrame
from sceneloom.warnings import WarningKind

if TYPE_CHECKING:
    from sceneloom.formats.video.index import VideoIndex
    from sceneloom.formats.video.reader import VideoReader


_EXPOSURE = "exposureTimeSeconds"
"""The field that says how long an image was exposed [s], on the camera or on an image."""


_LONGEST_EXPOSURE = 3600.0


def exposure_ns(fields: Mapping[str, Any], otherwise_ns: int) -> int:
    """How long an image was exposed [ns], as its fields state."""
    seconds = fields.get(_EXPOSURE)
    if isinstance(seconds, int | float) and 0 <= seconds < _LONGEST_EXPOSURE:
        return round(seconds * 1e9)
    return otherwise_ns


def _camera_of(record: Mapping[str, Any]) -> Camera:
    """Make a camera model of a `camera` record.

    Raises:
        FieldError: its coefficients are no numbers.
        CalibrationError: the numbers are those of no camera model.
    """
    return _camera_model_of(record, record["model"], _numbers_of(record["coefficients"]))


def _camera_model_of(record: Mapping[str, Any], model: str, coefficients: tuple[float, ...]) -> Camera:
    """Make a camera model of a record that has size, focal lengths and centre by name."""
    fx, fy, cx, cy = (float(record[name]) for name in ("fx", "fy", "cx", "cy"))
    return Camera(model, record["width"], record["height"], fx, fy, cx, cy, coefficients)


def camera_record(camera: Camera) -> dict[str, Any]:
    """Make the `camera` record of a camera model."""
    names = ("model", "width", "height", "fx", "fy", "cx", "cy")
    return {**{name: getattr(camera, name) for name in names}, "coefficients": list(camera.coefficients)}


def _numbers_of(values: Any) -> tuple[float, ...]:
    """Take a list of numbers.

    Raises:
        FieldError: it is none.
    """
    numbers = values.tolist() if isinstance(values, np.ndarray) else values
    if not isinstance(numbers, list) or any(type(number) not in (int, float) for number in numbers):
        raise FieldError(f"{str(numbers)[:60]}; expected a list of numbers")
    try:
        return tuple(float(number) for number in numbers)
    except OverflowError:
        raise FieldError("a number is beyond what a float can hold") from None


@dataclass(frozen=True, slots=True, eq=False)
class _ImageNotes:
    """The own camera models, mountings and fields of a camera's images; each list is empty where no image has one."""

    camera_model: Camera
    cameras: list[Camera]
    mounts: list[RigidTransform | None]
    fields: list[Mapping[str, Any]]

    @classmethod
    def of(cls, note: Mapping[str, Any], camera_model: Camera, count: int) -> Self:
        """Read the note of a camera with so many images.

        Raises:
            FieldError: the note does not fit.
            CalibrationError: it holds numbers that are those of no camera model.
        """
        cameras = [_camera_of(record) for record in note.get("cameras") or []]
        chosen = _listed(note, "camera_of_image", count)
        if any(type(k) is not int or not 0 <= k < len(cameras) for k in chosen):
            raise FieldError(f"camera_of_image: expected numbers below {len(cameras)}")
        fields = _listed(note, "extras", count)
        if any(not isinstance(extra, dict | None) for extra in fields):
            raise FieldError("extras: expected objects")
        mounts = _listed(note, "mounts", count)
        return cls(
            camera_model,
            [cameras[k] for k in chosen],
            [None if row is None else mount_of(row) for row in mounts],
            [extra or NO_FIELDS for extra in fields],
        )

    def camera(self, index: int) -> Camera:
        """The camera model of an image."""
        return self.cameras[index] if self.cameras else self.camera_model

    def mount(self, index: int) -> RigidTransform | None:
        """The mounting of an image where it has one of its own."""
        return self.mounts[index] if self.mounts else None

    def extras(self, index: int) -> Mapping[str, Any]:
        """Further fields of an image."""
        return self.fields[index] if self.fields else NO_FIELDS


def _listed(note: Mapping[str, Any], name: str, count: int) -> list[Any]:
    values = note.get(name)
    listed = values.tolist() if isinstance(values, np.ndarray) else values or []
    if not isinstance(listed, list) or (listed and len(listed) != count):
        raise FieldError(f"{name}: expected a list of one entry per image")
    return listed


@dataclass(slots=True)
class ImageNotesWriter:
    """Collects what single images have of their own.

    Attributes:
        camera_model: the camera model; images that have the same need no note.
    """

    camera_model: Camera
    _cameras: dict[Camera, int]
    _chosen: list[int]
    _mounts: list[list[list[float]] | None]
    _extras: list[Mapping[str, Any]]

    @classmethod
    def empty(cls, camera_model: Camera) -> Self:
        """Begin without images."""
        return cls(camera_model, {camera_model: 0}, [], [], [])

    def add(self, image: CameraImage, extras: Mapping[str, Any]) -> None:
        """Note one image, with the fields that have no other location."""
        self._chosen.append(self._cameras.setdefault(image.camera, len(self._cameras)))
        self._mounts.append(None if image.mount is None else mount_rows(image.mount))
        self._extras.append(extras)

    @property
    def own_cameras(self) -> int:
        """How many images have a camera model of their own."""
        return sum(k > 0 for k in self._chosen)

    def record(self) -> dict[str, Any] | None:
        """Make the note; None where no image has anything of its own."""
        note: dict[str, Any] = {}
        if any(self._chosen):
            note["cameras"] = [camera_record(camera) for camera in self._cameras]
            note["camera_of_image"] = self._chosen
        if any(row is not None for row in self._mounts):
            note["mounts"] = self._mounts
        if any(self._extras):
            note["extras"] = self._extras
        return note or None


@dataclass(frozen=True, slots=True, eq=False)
class _ImageContent:
    """Where a camera's images come from.

    Attributes:
        starts_ns: (N,) int64 [ns], start of each image.
        read: makes image `k`, taken by the given camera model, its time still that of its start.
        video: the encoded video, where there is one.
        fps: nominal images a second.
        further: fields that have no other location in the model.
        own_fields: further fields of each image; empty where no image has any.
    """

    starts_ns: Int64Array
    read: Callable[[int, Camera], CameraImage]
    video: VideoContent | None = None
    fps: float | None = None
    further: Mapping[str, Any] = field(default_factory=lambda: NO_FIELDS)
    own_fields: tuple[Mapping[str, Any], ...] = ()


def _no_image(index: int, _: Camera) -> CameraImage:
    raise IndexError(index)


def _no_content() -> _ImageContent:
    """A camera without images."""
    return _ImageContent(np.zeros(0, np.int64), _no_image)


def _video_content(
    source: Source, video: Mapping[str, Any], starts_ns: Int64Array, location: Location
) -> _ImageContent:
    """Give the images of a `video` record; the video is opened when its first image is asked for."""
    content: AnyArray = video["content"]
    where = format_keys((*location, "content"))
    coded = source.container.bytes_of(content)
    player = _Player(source.container, coded, where)
    source.parts.videos[where] = player
    rgb, open_file = source.parts.keep(where, player.rgb), source.parts.keep(f"{where}: file", player.open)
    starts = starts_ns.tolist()

    def read(index: int, camera: Camera) -> CameraImage:
        size = player.size()
        camera_model = camera if size == (camera.width, camera.height) else camera.resized(*size)
        return CameraImage(starts[index], camera_model, partial(rgb, index))

    further = {name: value for name, value in video.items() if name not in {"timestamps", "content", "fps"}}
    return _ImageContent(
        starts_ns,
        read,
        VideoContent(open_file, video_codec(coded)),
        None if video.get("fps") is None else float(video["fps"]),
        {"video": further} if further else NO_FIELDS,
    )


def _image_content(source: Source, images: list[Mapping[str, Any]], location: Location) -> _ImageContent:
    """Give the images of an `images` list."""
    container = source.container
    rgb = source.parts.keep(f"{format_keys(location)}: content", partial(_decode_image, container, images, location))
    own = tuple({k: v for k, v in image.items() if k not in {"timestamp", "content"}} for image in images)

    def read(index: int, camera: Camera) -> CameraImage:
        container.check_open(format_keys((*location, index, "content")))
        content: AnyArray = container.fetch(images[index]["content"])
        return CameraImage(
            images[index]["timestamp"],
            _camera_model_for(content, camera),
            partial(rgb, index),
            extras=own[index],
            encoded=content.tobytes,
        )

    starts_ns = np.array([image["timestamp"] for image in images], np.int64)
    return _ImageContent(starts_ns, read, own_fields=own)


def _camera_model_for(content: AnyArray, camera: Camera) -> Camera:
    """Fit the camera model to the size that an image's head reports; one without a head may still be copied."""
    from simplejpeg import decode_jpeg_header

    try:
        height, width = decode_jpeg_header(content.data)[:2]
    except (ValueError, RuntimeError):
        return camera
    return camera if (width, height) == (camera.width, camera.height) else camera.resized(width, height)


def _decode_image(container: Container, images: list[Mapping[str, Any]], location: Location, index: int) -> UInt8Array:
    where = format_keys((*location, index, "content"))
    container.check_open(where)
    return _decode_jpeg(container, container.fetch(images[index]["content"]), where)


def _decode_jpeg(container: Container, content: AnyArray, location: str) -> UInt8Array:
    from simplejpeg import decode_jpeg, decode_jpeg_header

    try:
        height, width = decode_jpeg_header(content.data)[:2]
        check_pixels(container.file, location, width, height)
        return cast("UInt8Array", decode_jpeg(content.data, "RGB"))
    except (ValueError, RuntimeError, MemoryError) as error:
        raise DataError(container.file, location, f"cannot be decoded as JPEG: {error}") from None


class _Player:
    """Opens a video at its first use and keeps it open.

    It has no lock, which a fork could leave locked for good: two threads may both open the video, and one wins.

    Attributes:
        index: the list of its images, None until it is known.
    """

    def __init__(self, container: Container, content: MappedContent | RemoteContent, location: str) -> None:
        self._container, self._content, self._location = container, content, location
        self._reader: VideoReader | None = None
        self.index: VideoIndex | None = None
        container.on_close(self._close)

    def open(self) -> Any:
        """Open the video's bytes as a file."""
        from sceneloom.formats.video.index import open_bytes

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
        from sceneloom.formats.video.index import read_table_index
        from sceneloom.formats.video.reader import VideoReader

        self._container.check_open(self._location)
        reader = self._reader
        if reader is None:
            name = f"{self._container.file}: {self._location}"
            if self.index is None and isinstance(self._content, RemoteContent) and is_mp4(self._content):
                self.index = read_table_index(self._content, name)
            reader = self._reader = VideoReader(self._content, name=name, index=self.index)
        return reader

    def _close(self) -> None:
        reader, self._reader = self._reader, None
        if reader is not None:
            reader.close()


_Record = dict[str, Any]


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


_OURS = {"ring": np.dtype(np.uint16), "camera_index": np.dtype(np.uint8)}


_OTHER_WIDTH = {4: "uint64", 8: "uint32"}


_TYPICAL_PERIOD_NS = 100_000_000


def _read_lidar(source: Source, values: _Record, location: Location, faults: Faults) -> LidarSensor | None:
    """Make a lidar of its record."""
    frames = values.pop("frames")
    relative = _check_frames(source, frames, location, faults)
    moving = _read_moving(source, values, location, faults, frame_count=len(frames))
    if faults.unrepaired:
        return None
    note = source.note(values["id"])
    read = _frame_reader(source, frames, location, relative=relative, make=_lidar_frame)
    return LidarSensor(
        values.pop("id"),
        LazyFrames(_timestamps(frames), read),
        points_frame=_points_frame(source, note, moving["coordinates"], location),
        model=note.get("model"),
        **moving,
        extras=_rest_of(values),
    )


def _read_radar(source: Source, values: _Record, location: Location, faults: Faults) -> RadarSensor | None:
    """Make a radar of its record."""
    frames = values.pop("frames")
    note = source.note(values["id"])
    _restore_lengths(frames, note, faults)
    relative = _check_frames(source, frames, location, faults)
    moving = _read_moving(source, values, location, faults, frame_count=len(frames))
    if faults.unrepaired:
        return None
    read = _frame_reader(source, frames, location, relative=relative, make=_radar_frame)
    return RadarSensor(
        values.pop("id"),
        LazyFrames(_timestamps(frames), read),
        points_frame=_points_frame(source, note, moving["coordinates"], location),
        **moving,
        extras=_rest_of(values),
    )


def _read_points(source: Source, values: _Record, location: Location, faults: Faults) -> PointsSensor | None:
    """Make a points sensor of its record."""
    del source, location
    points = values.pop("points")
    _check_counts(points, ("points",), faults)
    if faults:
        return None
    extras = _rest_of(values)
    further = {name: array for name, array in points.items() if name not in {"positions", "colors"}}
    if further:
        extras["points"] = further
    return PointsSensor(
        values["id"],
        _aligned(points["positions"]),
        None if points.get("colors") is None else _aligned(points["colors"]),
        parent_id=values.get("parent_id"),
        extras=extras,
    )


def _rest_of(values: _Record) -> _Record:
    """The fields that no attribute of the model takes."""
    taken = {"id", "type", "parent_id", "poses", "coordinates", "points", "frames"}
    further = {name: value for name, value in values.items() if name not in taken}
    of_poses = extras_of_poses(values.get("poses") or {})
    return {**further, **({"poses": of_poses} if of_poses else {})}


def _read_moving(source: Source, values: _Record, location: Location, faults: Faults, *, frame_count: int) -> _Record:
    """Read what every sensor with poses has: `poses`, `mount`, `coordinates`, `parent_id`."""
    note = source.note(values["id"])
    coordinates = values.get("coordinates") or Coordinates.WORLD.value
    if coordinates not in set(Coordinates):
        faults.add(("coordinates",), f"{coordinates!r}; expected one of {', '.join(Coordinates)}")
        return {}
    poses = _poses(source, values, location, faults)
    mount = _mount(note, faults)
    if note.get("poses_from_mount"):
        poses, coordinates = None, note.get("coordinates", Coordinates.WORLD.value)
    elif poses is not None and len(poses.timestamps_ns) == 1:
        stationary = note.get("poses_static", coordinates == Coordinates.EGO or frame_count != 1)
        poses = Poses(poses.timestamps_ns, poses.positions, poses.quaternions_xyzw, static=bool(stationary))
        if stationary and "poses_static" not in note:
            message = "a single pose; taken to hold at all times"
            source.warning(WarningKind.ASSUMED, "single-pose", (*location, "poses"), message)
    return {
        "poses": poses,
        "mount": mount,
        "coordinates": Coordinates(coordinates),
        "parent_id": values.get("parent_id"),
    }


def _poses(source: Source, values: _Record, location: Location, faults: Faults) -> Poses | None:
    record = values.get("poses")
    found = Faults()
    path = None if record is None else repaired_poses(record, found)
    faults.extend(found)
    if path is None and not found:
        message = "no poses; expected where the sensor was"
        source.warning(WarningKind.SKIPPED, "no-poses", (*location, "poses"), message)
    return path


def _mount(note: Mapping[str, Any], faults: Faults) -> RigidTransform | None:
    try:
        return None if note.get("mount") is None else mount_of(note["mount"])
    except FieldError as error:
        faults.add(("mount",), f"our note: {error}")
        return None


def _points_frame(source: Source, note: Mapping[str, Any], coordinates: Coordinates, location: Location) -> PointsFrame:
    """Report in which frame the points are: as the caller says, else as recorded, else as `coordinates` says."""
    if source.options.points_frame is not None:
        return PointsFrame(source.options.points_frame)
    recorded = note.get("points_frame")
    if recorded in set(PointsFrame):
        return PointsFrame(recorded)
    message = f"the frame of the points is not stated; taken to be the {coordinates.value} frame"
    source.warning(WarningKind.ASSUMED, "points-frame", location, message)
    return PointsFrame(coordinates.value)


def _timestamps(frames: list[_Record]) -> Int64Array:
    return np.array([frame["timestamp"] for frame in frames], np.int64)


def _frame_reader(
    source: Source, frames: list[_Record], location: Location, *, relative: bool, make: Callable[..., Any]
) -> Callable[[int], Any]:
    container, clock = source.container, source.clock

    def read(index: int) -> Any:
        where = format_keys((*location, "frames", index))
        container.check_open(where)
        frame = container.fetch(frames[index])
        try:
            times_ns = _point_times(frame, clock.absolute_array, clock.tick_ns, relative=relative)
        except TimeRangeError as error:
            raise DataError(container.file, f"{where}.points.timestamps", str(error)) from None
        extras = {name: value for name, value in frame.items() if name not in {"timestamp", "points"}}
        return make(frame["timestamp"], frame["points"], times_ns, extras)

    return source.parts.keep(format_keys((*location, "frames")), read)


def _point_times(
    frame: _Record, absolute: Callable[[AnyArray], Int64Array], tick_ns: int, *, relative: bool
) -> Int64Array | None:
    timestamps = frame["points"].get("timestamps")
    if timestamps is None:
        return None
    if relative:
        return read_only(timestamps.astype(np.int64) * tick_ns + frame["timestamp"])
    return read_only(absolute(timestamps))


def _lidar_frame(timestamp_ns: int, points: _Record, times_ns: Int64Array | None, extras: _Record) -> LidarFrame:
    arrays, further = _known_arrays(points, LIDAR_ARRAYS)
    return LidarFrame(timestamp_ns, LidarPoints(**arrays, timestamps_ns=times_ns, extras=further), extras)


def _radar_frame(timestamp_ns: int, points: _Record, times_ns: Int64Array | None, extras: _Record) -> RadarFrame:
    arrays, further = _known_arrays(points, RADAR_ARRAYS)
    return RadarFrame(timestamp_ns, RadarPoints(**arrays, timestamps_ns=times_ns, extras=further), extras)


def _known_arrays(points: _Record, names: Mapping[str, str]) -> tuple[_Record, _Record]:
    """Part the arrays that the model knows from those that it only carries along."""
    known, further = {}, {}
    for name, value in points.items():
        if name == "timestamps":
            continue
        if name in names and value is not None and _is_ours_or_known(name, value, points):
            known[names[name]] = _aligned(value)
        elif not (name in names and value is None):
            further[name] = value
    return known, further


def _is_ours_or_known(name: str, value: Any, points: _Record) -> bool:
    """Whether an array is what its name says; `ring` and `camera_index` may be a stranger's."""
    if name not in _OURS:
        return True
    return isinstance(value, np.ndarray) and value.dtype == _OURS[name] and value.shape == points["positions"].shape[:1]


def _aligned(array: AnyArray) -> AnyArray:
    """Copy an array whose items lie at odd addresses: compiled functions cannot take it."""
    return array if array.flags.aligned else read_only(array.copy())


def _check_frames(source: Source, frames: list[_Record], location: Location, faults: Faults) -> bool:
    """Check that the arrays of each frame are of one length.

    Report whether point times count from the frame's start.
    """
    if faults.unrepaired:
        return False
    for index, frame in enumerate(frames):
        _check_counts(frame["points"], ("frames", index, "points"), faults)
    relative = not faults and _times_are_relative(source, frames)
    if relative:
        message = "point times lie before their frame and within one period; read as counted from the frame's start"
        source.warning(WarningKind.ASSUMED, "relative-point-times", (*location, "frames"), message)
    return relative


def _note_further_faults(values: _Record, faults: Faults) -> None:
    """Look through a sensor that is at fault for what else is wrong in its frames and poses."""
    frames = values.get("frames")
    for index, frame in enumerate(frames if isinstance(frames, list) else []):
        points = frame.get("points") if isinstance(frame, dict) else None
        if isinstance(points, dict) and isinstance(points.get("positions"), np.ndarray):
            _check_counts(points, ("frames", index, "points"), faults)
    poses = values.get("poses")
    if isinstance(poses, dict) and not any(poses.get(name) is None for name in ("timestamps", "values")):
        repaired_poses(poses, faults)


def _check_counts(points: _Record, location: Location, faults: Faults) -> None:
    count = len(points["positions"])
    for name in ("colors", "intensities", "timestamps", "directions", "lengths"):
        array = points.get(name)
        if isinstance(array, np.ndarray) and len(array) != count:
            problem = f"{len(array)} values for {count} points; expected as many"
            if name == "timestamps" and len(array) in {2 * count, count / 2}:
                problem += f": the bytes fit {_OTHER_WIDTH.get(array.dtype.itemsize, 'another width')}, not "
                problem += f"{array.dtype.name}; see `time_unit` of the scene, which decides where no dtype says it"
            faults.add((*location, name), problem)


def _times_are_relative(source: Source, frames: list[_Record]) -> bool:
    """Judge by the last frame that has point times: all of them below its start and within one period."""
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


def _restore_lengths(frames: list[_Record], note: Mapping[str, Any], faults: Faults) -> None:
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


def _read_odometry(source: Source, values: _Record, location: Location, faults: Faults) -> OdometrySensor | None:
    """Make an odometry sensor of its record."""
    del location
    path = repaired_poses(values["poses"], faults)
    if path is None and faults.unrepaired:
        return None
    if path is None:
        faults.add(("poses",), "empty; expected at least one pose")
        return None
    if source.note(values["id"]).get("poses_static"):
        path = Poses(path.timestamps_ns, path.positions, path.quaternions_xyzw, static=len(path.timestamps_ns) == 1)
    return OdometrySensor(values["id"], path, parent_id=values.get("parent_id"), extras=_rest_of(values))


def _read_imu(source: Source, values: _Record, location: Location, faults: Faults) -> ImuSensor | None:
    """Make an IMU of the record in our metadata."""
    del source, location
    streams = {}
    for name, samples in values.pop("streams").items():
        try:
            streams[name] = VectorSamples(samples["timestamps_ns"], samples["values"], samples.get("file_seconds"))
        except ArrayError as error:
            faults.add(("streams", name), str(error))
    if faults:
        return None
    return ImuSensor(values["id"], streams, parent_id=values.get("parent_id"), extras=_rest_of(values))


GNSS_ARRAYS = ("timestamps_ns", "positions_lla", "accuracies", "vertical_accuracies", "file_seconds")


def _read_gnss(source: Source, values: _Record, location: Location, faults: Faults) -> GnssSensor | None:
    """Make a satellite receiver of the record in our metadata."""
    del source, location
    arrays = {name: values.pop(name) for name in GNSS_ARRAYS if values.get(name) is not None}
    rows = values.pop("mount", None)
    try:
        mount = None if rows is None else mount_of(rows)
    except FieldError as error:
        faults.add(("mount",), str(error))
        return None
    parent_id, extras = values.get("parent_id"), _rest_of(values)
    try:
        return GnssSensor(values["id"], **arrays, mount=mount, parent_id=parent_id, extras=extras)
    except ArrayError as error:
        faults.add((), str(error))
        return None


def _read_plain_sensor(source: Source, values: _Record, location: Location, faults: Faults) -> PlainSensor | None:
    """Keep a sensor of a type that we do not know."""
    del source, location, faults
    identifier, type_name = values.pop("id"), values.pop("type")
    return PlainSensor(identifier, type_name, values)


def read_trajectories(
    records: Any, sensors: tuple[Sensor, ...], location: Location, faults: Faults
) -> Mapping[str, Trajectory]:
    """Collect the trajectories of the ego: those of our metadata in their order, then one per odometry sensor."""
    odometry = {str(sensor.id): sensor for sensor in sensors if isinstance(sensor, OdometrySensor)}
    trajectories: dict[str, Trajectory] = {}
    for index, record in enumerate(records if isinstance(records, list) else []):
        sensor = odometry.get(str(record.get("sensor_id")))
        try:
            trajectories[record["name"]] = _trajectory(record, sensor)
        except (ArrayError, KeyError) as error:
            faults.add((*location, index), f"no trajectory: {error}")
    for name, sensor in odometry.items():
        trajectories.setdefault(name, _of_odometry(name, sensor))
    return trajectories


def _trajectory(record: _Record, sensor: OdometrySensor | None) -> Trajectory:
    rows = record.get("covariances")
    covariances = None if rows is None else rows.reshape(-1, 6, 6)
    if record.get("timestamps_ns") is None and sensor is not None:
        return replace(_of_odometry(record["name"], sensor), covariances=covariances)
    return Trajectory(
        record["name"],
        record["timestamps_ns"],
        record["positions"],
        record.get("quaternions_xyzw"),
        record.get("file_seconds"),
        covariances,
    )


def _of_odometry(name: str, sensor: OdometrySensor) -> Trajectory:
    """The ego trajectory that an odometry sensor reports."""
    return Trajectory(name, sensor.poses.timestamps_ns, sensor.poses.positions, sensor.poses.quaternions_xyzw)


def _read_camera(source: Source, values: _Record, location: Location, faults: Faults) -> CameraSensor | None:
    """Make a camera of its record."""
    note = source.note(values["id"])
    intrinsics = values.pop("intrinsics")
    inner = Faults()
    try:
        camera_model = read_camera_model(source, intrinsics, note, (*location, "intrinsics"))
    except (FieldError, CalibrationError) as error:
        faults.add(("intrinsics",), str(error))
        return None
    content = _content(source, values, camera_model, location)
    moving = _read_moving(source, values, location, inner, frame_count=len(content.starts_ns))
    try:
        own = _ImageNotes.of(note.get("images") or {}, camera_model, len(content.starts_ns))
    except (FieldError, CalibrationError) as error:
        inner.add(("images",), f"our note: {error}")
    faults.extend(inner)
    if inner.unrepaired:
        return None
    extras = {**_rest_of(values), **content.further}
    if of_intrinsics := extras_of_intrinsics(intrinsics):
        extras["intrinsics"] = of_intrinsics
    images = _images(source, content, own, exposure_ns(extras, 0), location)
    return CameraSensor(
        values["id"],
        camera_model,
        images,
        video=content.video,
        fps=_fps(content, note),
        **moving,
        extras=extras,
    )


def _images(
    source: Source, content: _ImageContent, own: _ImageNotes, usual: int, location: Location
) -> LazyFrames[CameraImage]:
    """Join images, their own camera models and mountings, and the times of their middles."""
    own_fields = content.own_fields or tuple(own.extras(k) for k in range(len(content.starts_ns)))
    exposures = np.array([exposure_ns(extra, usual) for extra in own_fields], np.int64)
    middles_ns = content.starts_ns + exposures // 2

    def read(index: int) -> CameraImage:
        image = content.read(index, own.camera(index))
        extras = {**image.extras, **own.extras(index)}
        return replace(image, timestamp_ns=int(middles_ns[index]), mount=own.mount(index), extras=extras)

    return LazyFrames(middles_ns, source.parts.keep(format_keys((*location, "images")), read))


def _fps(content: _ImageContent, note: Mapping[str, Any]) -> float | None:
    """The rate that the video says, or our note of a camera with single images."""
    noted = note.get("fps")
    return float(noted) if content.fps is None and isinstance(noted, int | float) else content.fps


def _content(source: Source, values: _Record, camera_model: Camera, location: Location) -> _ImageContent:
    """Choose between `video` and `images`; what is not chosen stays among the further fields."""
    video, images = values.get("video"), values.get("images")
    if video is not None:
        values.pop("video")
        if images is None:
            values.pop("images", None)
        else:
            message = "both video and images; the video is taken, the images are carried along"
            source.warning(WarningKind.ASSUMED, "video-and-images", location, message)
        timestamps_ns = times_of(video["timestamps"])
        return _video_content(source, video, timestamps_ns, (*location, "video"))
    values.pop("video", None)
    values.pop("images", None)
    if images is not None:
        return _image_content(source, images, (*location, "images"))
    source.warning(
        WarningKind.SKIPPED,
        "no-images",
        location,
        f"neither video nor images; {camera_model.model} camera model only",
    )
    return _no_content()


def read_camera_model(source: Source, intrinsics: _Record, note: Mapping[str, Any], location: Location) -> Camera:
    """Make a camera model of an `intrinsics` record.

    Or of our note where the record stands in for the camera model noted there.

    A record that was changed since it was written counts, not the note. Files of before the fit have no camera model as
    written in the note: there the focal lengths and the centre report.

    Raises:
        FieldError: the distortion is not what its model has.
        CalibrationError: the numbers are those of no camera model.
    """
    distortion = intrinsics.get("distortion") or {}
    model = distortion.get("model") or "pinhole"
    written = _camera_model_of(intrinsics, model, _coefficients(source, model, distortion.get("params"), location))
    if note.get("camera") is None:
        return _in_opencvs_sense(written, source)
    exact = _camera_of(note["camera"])
    if note.get("written_camera") is not None:
        same = _camera_of(note["written_camera"]) == written
    else:
        same = (exact.fx, exact.fy, exact.cx, exact.cy) == (written.fx, written.fy, written.cx, written.cy)
    return exact if same else _in_opencvs_sense(written, source)


_P1, _P2 = 2, 3


def _in_opencvs_sense(camera: Camera, source: Source) -> Camera:
    """Exchange p1 and p2 where the file has them the other way round."""
    if camera.model != "brown_conrady" or (source.tangential or source.options.tangential) != BROWN:
        return camera
    padded = (*camera.coefficients, 0.0, 0.0, 0.0, 0.0)[: max(len(camera.coefficients), _P2 + 1)]
    return replace(camera, coefficients=(*padded[:_P1], padded[_P2], padded[_P1], *padded[_P2 + 1 :]))


def _coefficients(source: Source, model: str, params: Any, location: Location) -> tuple[float, ...]:
    coefficients = _numbers_of([] if params is None else params)
    if model == "pinhole":
        if any(coefficients):
            raise FieldError(f"distortion.params: {list(coefficients)} without a model")
        return ()
    expected = COEFFICIENT_COUNTS.get(model)
    if expected is None:
        message = f"distortion model {model!r} is none of the format's; it is kept, but cannot be computed with"
        source.warning(WarningKind.SKIPPED, "unknown-distortion", (*location, "distortion"), message)
    elif len(coefficients) > expected:
        raise FieldError(f"distortion.params: {len(coefficients)} numbers; {model} has {expected}")
    elif len(coefficients) < expected:
        message = f"{len(coefficients)} of the {expected} numbers of {model}; the others are taken as 0"
        source.warning(WarningKind.REPAIRED, "short-distortion", (*location, "distortion"), message)
    return coefficients


def extras_of_intrinsics(intrinsics: Mapping[str, Any]) -> _Record:
    """Give the unknown fields of an `intrinsics` record and of its `distortion`."""
    unknown = {name: value for name, value in intrinsics.items() if name not in RECORDS["intrinsics"]}
    distortion = intrinsics.get("distortion") or {}
    of_distortion = {k: value for k, value in distortion.items() if k not in RECORDS["distortion"]}
    return {**unknown, **({"distortion": of_distortion} if of_distortion else {})}


def intrinsics_record(camera: Camera, extras: Any) -> _Record:
    """Make the `intrinsics` record of a camera model that the format can hold, with unknown fields, if any."""
    names = ("fx", "fy", "cx", "cy", "width", "height")
    record: _Record = {name: getattr(camera, name) for name in names}
    if camera.model != "pinhole":
        record["distortion"] = {"model": camera.model, "params": list(camera.coefficients)}
    if not isinstance(extras, Mapping):
        return record
    of_distortion = extras.get("distortion")
    if isinstance(of_distortion, Mapping):
        record["distortion"] = with_extras(record.get("distortion") or {}, of_distortion)
    return with_extras(record, extras)


_SENSOR_READERS: Mapping[str, Callable[[Source, dict[str, Any], Location, Faults], Sensor | None]] = MappingProxyType(
    {
        "lidar": _read_lidar,
        "radar": _read_radar,
        "points": _read_points,
        "camera": _read_camera,
        "odometry": _read_odometry,
        "imu": _read_imu,
        "gnss": _read_gnss,
    }
)


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
        sensor = _sensor(source, item, (*location, index), faults)
        if source.settle(faults, (*location, index)) and sensor is not None:
            sensors.append(sensor)
    return tuple(sensors)


def _sensor(source: Source, raw: Any, location: Location, faults: Faults) -> Sensor | None:
    type_name = raw.get("type") if isinstance(raw, dict) else None
    if not isinstance(type_name, str):
        faults.add(("type",), f"{type_name!r}; expected one of {', '.join(SENSOR_RECORDS)}")
        return None
    known = SENSOR_ALIASES.get(type_name, type_name)
    if known != type_name:
        source.warning(WarningKind.ASSUMED, "sensor-alias", location, f"type {type_name!r}; read as {known!r}")
    is_known = known in _SENSOR_READERS
    values = source.reader(forgiving=not is_known).read(raw, sensor_record(type_name), faults)
    if not is_known and not isinstance(values.get("id"), str | int):
        faults.add(("id",), f"{values.get('id')!r}; expected text or an integer")
    if faults:
        if is_known:
            fields = RECORDS[sensor_record(type_name)]
            _note_further_faults({name: v for name, v in values.items() if name in fields}, faults)
        return None
    return _SENSOR_READERS.get(known, _read_plain_sensor)(source, values, location, faults)
