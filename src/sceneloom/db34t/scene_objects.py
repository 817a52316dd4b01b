"""Records as objects of the scene model (boxes, lidar frames, images, depth images), and back."""

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from types import MappingProxyType
from typing import Any, cast

import numpy as np

from sceneloom.arrays import (
    AnyArray,
    Float32Array,
    Float64Array,
    Int64Array,
    UInt8Array,
    UInt16Array,
    UInt32Array,
    read_only,
)
from sceneloom.cameras.camera import Camera
from sceneloom.cameras.projection import unproject
from sceneloom.colouring.results import FusedFrame, FusedView
from sceneloom.db34t.calibration import SensorKind
from sceneloom.db34t.records import (
    DEPTH_KINDS,
    ENCODINGS,
    Boxes2d,
    Boxes3d,
    ImageData,
    PointCloudData,
    RawData,
    SensorFusionData,
)
from sceneloom.db34t.setting import Setting
from sceneloom.db34t.tables import IMAGE, POINT_CLOUD, RAW, SENSOR_FUSION
from sceneloom.db34t.types import INTEGER_RANGES, NANOSECONDS, BasicType, Timestamp, bytes_of
from sceneloom.errors import DataError, OptionError
from sceneloom.formats.base.images import EncodedImage
from sceneloom.formats.recording.lidars import XYZIRT
from sceneloom.kernels.projection import draw_depths
from sceneloom.scene.cameras import CameraImage, DepthFrame
from sceneloom.scene.clouds import LidarFrame, LidarPoints
from sceneloom.scene.detections import Boxes2D, Boxes3D, ScoreForm
from sceneloom.scene.types import Identifier, PointsFrame


def boxes_3d_of(record: Boxes3d, *, sensor_id: Identifier | None = None) -> Boxes3D:
    """Give the boxes of a list of table 7.

    A heading's vertical part is dropped: the model's boxes are upright. Velocities are the vectors, where the record
    has them, else the speeds along the directions.

    Args:
        sensor_id: the lidar in the scene; None for the record's own number.
    """
    directions = record.directions.astype(np.float64)
    if record.velocity_vectors is None:
        along = record.velocities / np.sqrt((directions * directions).sum(axis=1))
        velocities = directions * along[:, None]
    else:
        velocities = record.velocity_vectors.astype(np.float64)
    return Boxes3D(
        record.timestamp.nanoseconds,
        record.centers.astype(np.float64),
        record.sizes_lwh.astype(np.float64),
        np.arctan2(directions[:, 1], directions[:, 0]),
        record.confidence.astype(np.float64),
        record.class_names,
        velocities=velocities,
        ids=record.id.astype(np.int64),
        sensor_id=record.sensor_id if sensor_id is None else sensor_id,
    )


def boxes_3d_record(boxes: Boxes3D, *, sensor_id: int, seq: int) -> Boxes3d:
    """Give the list of table 7 of boxes in a lidar's frame.

    Boxes without ids are numbered, those without velocities are stationary, and covariances have no location. Scores of
    the form `logit` become probabilities.

    Raises:
        DataError: a number cannot stand in the record.
        OptionError: the boxes are in another frame.
    """
    if boxes.frame is not PointsFrame.SENSOR:
        raise OptionError(f"boxes in the {boxes.frame} frame; expected the lidar's")
    speeds = boxes.speeds
    return Boxes3d(
        sensor_id=sensor_id,
        seq=seq,
        timestamp=Timestamp.of(boxes.timestamp_ns),
        id=_ids(boxes),
        class_names=boxes.labels,
        confidence=_confidence(boxes),
        centers=boxes.centers.astype(np.float32),
        sizes_lwh=boxes.sizes_lwh.astype(np.float32),
        directions=boxes.directions.astype(np.float32),
        velocities=np.zeros(len(boxes), np.float32) if speeds is None else speeds.astype(np.float32),
        velocity_vectors=None if boxes.velocities is None else boxes.velocities.astype(np.float32),
    )


def boxes_2d_of(record: Boxes2d, *, sensor_id: Identifier | None = None) -> Boxes2D:
    """Give the boxes of a list of table 8; both count pixels from the image's own corner.

    Args:
        sensor_id: the camera in the scene; None for the record's own number.
    """
    return Boxes2D(
        record.timestamp.nanoseconds,
        record.corners_xyxy.astype(np.float64),
        record.confidence.astype(np.float64),
        record.class_names,
        ids=record.id.astype(np.int64),
        sensor_id=record.sensor_id if sensor_id is None else sensor_id,
    )


def boxes_2d_record(boxes: Boxes2D, *, sensor_id: int, seq: int, size_wh: tuple[int, int] | None = None) -> Boxes2d:
    """Give the list of table 8 of boxes in an image, with the whole pixels that each touches.

    Boxes that have no area within the image, or are not finite, are left out: the record has fewer then.

    Args:
        size_wh: of the image [px], to which boxes are cut; None to cut at 0 alone.

    Raises:
        DataError: a number cannot stand in the record.
    """
    corners = _whole_corners(boxes.corners_xyxy, size_wh)
    sides = corners[:, 2:] > corners[:, :2]
    kept = np.logical_and(sides[:, 0], sides[:, 1])
    return Boxes2d(
        sensor_id=sensor_id,
        seq=seq,
        timestamp=Timestamp.of(boxes.timestamp_ns),
        id=_ids(boxes)[kept],
        class_names=tuple(name for name, keep in zip(boxes.labels, kept.tolist(), strict=True) if keep),
        confidence=_confidence(boxes)[kept],
        corners_xyxy=corners[kept],
    )


def _whole_corners(corners_xyxy: Float64Array, size_wh: tuple[int, int] | None) -> UInt32Array:
    """Give the whole pixels that boxes touch.

    Args:
        corners_xyxy: (N, 4) [px], left, upper, right and lower edge; of a box that is not finite all become 0.
        size_wh: of the image [px], to which boxes are cut.

    Returns:
        (N, 4) uint32: lower edges rounded down, upper ones up.
    """
    largest = 2**32 - 1
    width, height = (largest, largest) if size_wh is None else size_wh
    finite = np.isfinite(corners_xyxy).all(axis=1, keepdims=True)
    corners = np.where(finite, corners_xyxy, 0.0)
    whole = np.column_stack([np.floor(corners[:, :2]), np.ceil(corners[:, 2:])])
    cut: UInt32Array = np.clip(whole, 0, [width, height, width, height]).astype(np.uint32)
    return cut


def _ids(boxes: Boxes3D | Boxes2D) -> AnyArray:
    if boxes.ids is None:
        return np.arange(len(boxes), dtype=np.int32)
    low, high = INTEGER_RANGES[BasicType.INT32]
    if len(boxes) and (boxes.ids.min() < low or boxes.ids.max() > high):
        raise OptionError(f"ids up to {boxes.ids.max()}; expected {low} to {high}")
    return boxes.ids.astype(np.int32)


def _confidence(boxes: Boxes3D | Boxes2D) -> Float32Array:
    scores = boxes.scores
    if boxes.score_form is ScoreForm.LOGIT:
        # of large numbers of either sign, the exponential of the negative one
        small = np.exp(-np.abs(scores))
        scores = np.where(scores >= 0, 1.0, small) / (1.0 + small)
    return scores.astype(np.float32)


_MOST_FIELDS = 255
"""Of a point of table 9, whose fields_number is a uint8."""


def measurement_of(
    record: RawData | ImageData | PointCloudData | Boxes3d | Boxes2d, setting: Setting
) -> tuple[LidarFrame | CameraImage | Boxes3d | Boxes2d, ImageData | None]:
    """Give what is fused of a record of one frame, and the record of an image where it is or makes one.

    Raises:
        DataError: the record does not fit its calibration, or cannot be read.
        CalibrationError: the calibrations of its camera are of images of several sizes.
    """
    match record:
        case PointCloudData():
            frame = lidar_frame_of(record)
            if len(result_fields(frame)) > _MOST_FIELDS:
                expected = f"expected so many that {_MOST_FIELDS} are left with r, g, b"
                raise POINT_CLOUD.fault("fields", f"{len(record.fields)} names; {expected}")
            return frame, None
        case ImageData():
            return image_of(record, setting.camera(record.sensor_id)), record
        case RawData():
            declared = setting.sensors[record.sensor_id]
            if declared.kind is SensorKind.LIDAR:
                return lidar_frame_of_raw(record), None
            camera = setting.camera(record.sensor_id)
            image = image_record_of_raw(record, camera, str(declared.raw))
            return image_of(image, camera), image
    return record, None


_REFLECTIVITY_NAMES = ("reflectivity", "intensity")
"""Fields that state how bright a return is; the first one is written."""

COLOR_NAMES = ("r", "g", "b")
"""Fields of a coloured point, 0 to 255."""

_RAW_FIELDS = ("reflectivity", "ring", "time")
"""What the 23-byte records of the recording format report a point beside its position."""

_LONGEST_OFFSET = 3600.0
"""Times of points that are farther than so many seconds from their cloud's are none."""

_SCALES = (255.0, 65535.0)


def lidar_frame_of(record: PointCloudData) -> LidarFrame:
    """Give the sweep of a point cloud record.

    `reflectivity` or `intensity` becomes intensities: whole numbers to 255 as they are, fractions to 1 times 255,
    larger ones scaled from 65535; `ring` rings; `time` [s, from the cloud's timestamp] times; `r`, `g`, `b` colours. A
    field that these do not hold exactly, and any other, stays as it is in `points.extras`. The frame's extras hold
    sensor_id, seq, fields, sensor_type, beam and ring of the record. Points with a number that is not finite are left
    out: the sweep has fewer then.
    """
    extras = {
        "sensor_id": record.sensor_id,
        "seq": record.seq,
        "fields": record.fields,
        "sensor_type": record.sensor_type,
        "beam": record.beam,
        "ring": record.ring,
    }
    values = record.points
    if not _are_finite(values):
        values = values[np.isfinite(values).all(axis=1)]
    points = _points_of(values, record.fields, record.timestamp.nanoseconds)
    return LidarFrame(record.timestamp.nanoseconds, points, extras=MappingProxyType(extras))


def lidar_frame_of_result(record: SensorFusionData) -> LidarFrame:
    """Give the points of a result of sensor-data fusion as a sweep, in the frame that `point_frame` names."""
    timestamp_ns = record.timestamp.nanoseconds
    points = _points_of(record.points, record.point_fields, timestamp_ns)
    extras = {"sensor_id": record.lidar_id, "seq": record.points_seq, "fields": record.point_fields}
    return LidarFrame(timestamp_ns, points, extras=MappingProxyType(extras))


def lidar_frame_of_raw(record: RawData) -> LidarFrame:
    """Give the sweep of raw data that are the 23-byte records of the recording format.

    Points with a number that is not finite are left out, as those of table 6 are.

    Raises:
        DataError: the bytes are no whole number of records, or times are none.
    """
    count, remainder = divmod(record.length, XYZIRT.itemsize)
    if remainder:
        expected = f"expected records of {XYZIRT.itemsize} bytes"
        raise RAW.fault("data", f"{count} records and a remainder of {remainder} bytes; {expected}")
    rows = np.frombuffer(record.data, XYZIRT)
    finite = np.ones(count, np.bool_)
    for name in ("x", "y", "z", "timestamp"):
        finite &= np.isfinite(rows[name])
    if not finite.all():
        rows = rows[finite]
        count = len(rows)
    latest = float(rows["timestamp"].max()) if count else 0.0
    if latest >= 2**32 or (count and rows["timestamp"].min() < 0):
        raise RAW.fault("data", f"times up to {latest} s; expected 0 to {2**32} s")
    seconds = np.floor(rows["timestamp"])
    parts = np.rint((rows["timestamp"] - seconds) * NANOSECONDS).astype(np.int64)
    points = LidarPoints(
        np.column_stack([rows[name] for name in "xyz"]).astype(np.float32, copy=False).reshape(count, 3),
        rows["intensity"].copy(),
        timestamps_ns=seconds.astype(np.int64) * NANOSECONDS + parts,
        rings=rows["ring"].astype(np.uint16),
    )
    extras = {"sensor_id": record.sensor_id, "seq": record.seq}
    return LidarFrame(record.timestamp.nanoseconds, points, extras=MappingProxyType(extras))


def point_cloud_of(
    frame: LidarFrame, *, sensor_id: int, seq: int, fields: Sequence[str] | None = None
) -> PointCloudData:
    """Give the record of a sweep; points without a finite position are left out.

    Args:
        fields: what to give of each point; None for what the sweep's record had, else for all that there is.

    Raises:
        DataError: a number cannot stand in the record.
        OptionError: the points have no such field.
    """
    extras = frame.extras
    names = tuple(fields if fields is not None else extras.get("fields") or _fields_of(frame.points))
    data = _point_columns(frame.points, names, frame.timestamp_ns)
    return PointCloudData(
        sensor_id=sensor_id,
        timestamp=Timestamp.of(frame.timestamp_ns),
        seq=seq,
        number=len(data),
        fields=names,
        fields_number=len(names),
        data=data,
        sensor_type=extras.get("sensor_type", 0),
        beam=extras.get("beam"),
        ring=extras.get("ring"),
    )


def _points_of(values: Float32Array, fields: Sequence[str], timestamp_ns: int) -> LidarPoints:
    """Give the points of a table of fields.

    Args:
        values: (N, F) float32, finite.
        fields: F names, x, y and z among them.
        timestamp_ns: that times are counted from [ns].
    """
    columns = {name: values[:, k] for k, name in enumerate(fields)}
    parts: dict[str, Any] = {}
    exact = set("xyz")
    for part, names, convert in _PARTS:
        name = next((name for name in names if name in columns), None)
        found = None if name is None else convert(columns[name], timestamp_ns)
        if name is not None and found is not None:
            parts[part] = read_only(found)
            if np.array_equal(_BACK[part](found, timestamp_ns), columns[name]):
                exact.add(name)
    colors = _colors(columns)
    if colors is not None:
        parts["colors"] = read_only(colors)
        exact.update(COLOR_NAMES)
    positions = values if tuple(fields) == ("x", "y", "z") else _together([columns[axis] for axis in "xyz"])
    extras = {name: read_only(column) for name, column in columns.items() if name not in exact}
    return LidarPoints(cast("Float32Array", read_only(positions)), extras=MappingProxyType(extras), **parts)


def result_fields(sent: LidarFrame) -> tuple[str, ...]:
    """The fields of the points of table 9, by the names of what was sent and by nothing else.

    Args:
        sent: the sweep of a record of table 6, or of raw data.

    Source: READING of point_fields in docs/CONVENTIONS.md.
    """
    names = sent.extras.get("fields", ("x", "y", "z", *_RAW_FIELDS))
    others = (name for name in names if name not in ("x", "y", "z", *COLOR_NAMES))
    return ("x", "y", "z", *others, *COLOR_NAMES)


def _fields_of(points: LidarPoints) -> tuple[str, ...]:
    """The names of all fields that points have; of further arrays those of 32-bit numbers."""
    there = (
        ("reflectivity",) * (points.intensities is not None),
        ("ring",) * (points.rings is not None),
        ("time",) * (points.timestamps_ns is not None),
        COLOR_NAMES * (points.colors is not None),
    )
    names = [*"xyz", *(name for names in there for name in names)]
    further = [name for name, array in points.extras.items() if array.ndim == 1 and array.dtype == np.float32]
    if any(name in further for name in _REFLECTIVITY_NAMES) and "reflectivity" in names:
        names.remove("reflectivity")
    return tuple(dict.fromkeys((*names, *further)))


def _point_columns(points: LidarPoints, fields: Sequence[str], timestamp_ns: int) -> Float32Array:
    """Give the table of fields of points, without those that have no finite position.

    Args:
        fields: F names; those of `points.extras` as they are there, else as `_points_of` reads them.
        timestamp_ns: that times are counted from [ns].

    Returns:
        (M, F) float32.

    Raises:
        OptionError: the points have no such field.
    """
    values = np.empty((len(points), len(fields)), np.float32)
    for k, name in enumerate(fields):
        values[:, k] = _column(points, name, timestamp_ns)
    # to look for the largest number takes a fortieth of the time of looking at each row
    return values if _are_finite(points.positions) else values[np.isfinite(points.positions).all(axis=1)]


def _are_finite(values: Float32Array) -> bool:
    return values.size == 0 or bool(np.isfinite(values.min()) and np.isfinite(values.max()))


def _column(points: LidarPoints, name: str, timestamp_ns: int) -> AnyArray:
    if name in ("x", "y", "z"):
        return points.positions[:, "xyz".index(name)]
    if name in points.extras:
        return points.extras[name]
    if name in COLOR_NAMES and points.colors is not None:
        return points.colors[:, COLOR_NAMES.index(name)]
    for part, names, _ in _PARTS:
        found = getattr(points, part)
        if name in names and found is not None:
            return _BACK[part](found, timestamp_ns)
    raise OptionError(f"field {name!r}; the points have {', '.join(_fields_of(points))}")


def _together(columns: Sequence[Float32Array]) -> Float32Array:
    table = np.empty((len(columns[0]), len(columns)), np.float32)
    for k, column in enumerate(columns):
        table[:, k] = column
    return table


def _intensities(values: Float32Array, timestamp_ns: int) -> UInt8Array | None:
    del timestamp_ns
    if values.size == 0:
        return np.zeros(0, np.uint8)
    low, high = float(values.min()), float(values.max())
    whole = np.rint(values)
    if low < 0 or high > _SCALES[-1]:
        return None
    scale = next(scale for scale in _SCALES if high <= scale)
    if high <= 1 and not np.array_equal(whole, values):
        scale = 1.0
    return whole.astype(np.uint8) if scale == 255.0 else np.rint(values * (255.0 / scale)).astype(np.uint8)


def _rings(values: Float32Array, timestamp_ns: int) -> UInt16Array | None:
    del timestamp_ns
    whole = np.rint(values)
    if values.size and (not np.array_equal(whole, values) or values.min() < 0 or values.max() > 65535):
        return None
    return whole.astype(np.uint16)


def _times(values: Float32Array, timestamp_ns: int) -> Int64Array | None:
    if values.size and max(-float(values.min()), float(values.max())) > _LONGEST_OFFSET:
        return None
    return timestamp_ns + np.rint(values.astype(np.float64) * NANOSECONDS).astype(np.int64)


def _colors(columns: Mapping[str, Float32Array]) -> UInt8Array | None:
    if not all(name in columns for name in COLOR_NAMES):
        return None
    colors = _together([columns[name] for name in COLOR_NAMES])
    return colors.astype(np.uint8) if not colors.size or _are_bytes(colors) else None


def _are_bytes(values: Float32Array) -> bool:
    return bool(values.min() >= 0 and values.max() <= 255 and np.array_equal(np.rint(values), values))


def _seconds(timestamps_ns: Int64Array, timestamp_ns: int) -> Float32Array:
    return ((timestamps_ns - timestamp_ns) / NANOSECONDS).astype(np.float32)


def _plain(values: AnyArray, timestamp_ns: int) -> Float32Array:
    del timestamp_ns
    return values.astype(np.float32)


_PARTS: tuple[tuple[str, tuple[str, ...], Callable[[Float32Array, int], AnyArray | None]], ...] = (
    ("intensities", _REFLECTIVITY_NAMES, _intensities),
    ("rings", ("ring",), _rings),
    ("timestamps_ns", ("time",), _times),
)
"""Which part of the points a field becomes, and how."""

_BACK: Mapping[str, Callable[[Any, int], Float32Array]] = {
    "intensities": _plain,
    "rings": _plain,
    "timestamps_ns": _seconds,
}
"""How the field comes back out of the part."""

_RAW_NAMES = {1: "mono8", 3: "rgb8", 4: "rgba8"}
"""What pixels of the encoding raw are taken for, by their number of values."""


@dataclass(frozen=True, slots=True, eq=False)
class _Pixels:
    """Gives the image that pixels in an encoding make."""

    pixels: UInt8Array
    encoding: str

    def __call__(self) -> UInt8Array:
        return rgb_of_pixels(self.pixels, self.encoding)


def image_of(record: ImageData, camera: Camera) -> CameraImage:
    """Give the image of an image record; a file is decoded when the image is asked for.

    Pixels of the encoding `raw` are taken for grey, red green blue, or red green blue and transparency by their number
    of values. The image's extras hold sensor_id, seq and encoding of the record.

    Raises:
        DataError: the record's size is not that of the camera, or raw pixels have 2 or more than 4 values.
    """
    for name in ("width", "height"):
        if getattr(record, name) != getattr(camera, name):
            problem = f"{getattr(record, name)}; expected {getattr(camera, name)} as in the calibration"
            raise IMAGE.fault(name, problem)
    extras = MappingProxyType({"sensor_id": record.sensor_id, "seq": record.seq, "encoding": record.encoding})
    timestamp_ns = record.timestamp.nanoseconds
    if record.pixels is not None:
        _check_shown(record.encoding, record.channel)
        return CameraImage(timestamp_ns, camera, _Pixels(record.pixels, record.encoding), extras=extras)
    file = EncodedImage(bytes_of(record.data), record.encoding, record.width, record.height, IMAGE.owner, "data")
    encoded = file.encoded if record.encoding == "jpeg" else None
    return CameraImage(timestamp_ns, camera, file, extras=extras, encoded=encoded)


def image_record_of_raw(record: RawData, camera: Camera, encoding: str) -> ImageData:
    """Give the image record of raw data.

    Args:
        encoding: what the bytes are: jpeg, png, or pixels of the camera's size in another one of `ENCODINGS`.

    Raises:
        DataError: there are more or fewer bytes than pixels need.
        OptionError: the encoding is not known, or does not state how many values a pixel has.
    """
    known = ENCODINGS.get(encoding)
    if known is None or encoding == "raw":
        names = ", ".join(name for name in ENCODINGS if name != "raw")
        raise OptionError(f"encoding {encoding!r}; expected one of {names}")
    channel = 3 if known.is_file else min(known.channels)
    length = camera.height * camera.width * channel
    if not known.is_file and record.length != length:
        expected = f"{length}, as {camera.width}x{camera.height} pixels of {encoding} have"
        raise RAW.fault("length", f"{record.length}; expected {expected}")
    if record.length == 0:
        raise RAW.fault("length", f"0; expected a file of {encoding}")
    return ImageData(
        sensor_id=record.sensor_id,
        timestamp=record.timestamp,
        seq=record.seq,
        height=camera.height,
        width=camera.width,
        encoding=encoding,
        channel=channel,
        data=np.frombuffer(record.data, np.uint8),
    )


def image_of_result(record: SensorFusionData, camera: Camera) -> CameraImage:
    """Give the image of a result of sensor-data fusion.

    Raises:
        DataError: the result's size is not that of the camera, or it cannot be decoded.
    """
    timestamp = record.timestamp if record.image_timestamp is None else record.image_timestamp
    image = ImageData(
        sensor_id=record.camera_id,
        timestamp=timestamp,
        seq=record.image_seq,
        height=record.height,
        width=record.width,
        encoding=record.encoding,
        channel=record.image_channel,
        data=record.image_data,
    )
    try:
        return image_of(image, camera)
    except DataError as error:
        location = {"data": "image_data", "channel": "image_channel"}.get(error.location, error.location)
        raise DataError(SENSOR_FUSION.owner, location, error.problem) from error


def image_data_of(image: CameraImage, *, sensor_id: int, seq: int, encoding: str = "rgb8") -> ImageData:
    """Give the record of an image.

    Args:
        encoding: rgb8, bgr8, rgba8, bgra8; mono8, which gives the mean of red, green and blue; jpeg where the image
            comes from such a file, which is then given as it is.

    Raises:
        DataError: the image cannot be decoded.
        OptionError: the encoding cannot be made of the image.
    """
    if encoding == "jpeg" and image.encoded is not None:
        data, channel = np.frombuffer(image.encoded(), np.uint8), 3
    else:
        pixels = _pixels_of_rgb(image.rgb, encoding)
        data, channel = pixels, pixels.shape[2]
    return ImageData(
        sensor_id=sensor_id,
        timestamp=Timestamp.of(image.timestamp_ns),
        seq=seq,
        height=image.camera.height,
        width=image.camera.width,
        encoding=encoding,
        channel=channel,
        data=data,
    )


def _check_shown(encoding: str, channel: int) -> None:
    """Check that it is known how pixels look.

    Raises:
        DataError: they are raw ones of 2 or more than 4 values.
    """
    if encoding == "raw" and channel not in _RAW_NAMES:
        raise IMAGE.fault("channel", f"{channel} of raw; expected 1, 3 or 4, to be shown")


def rgb_of_pixels(pixels: UInt8Array, encoding: str) -> UInt8Array:
    """Give red, green and blue of pixels.

    Args:
        pixels: (H, W, C) uint8 in the order of the encoding.
        encoding: one of `ENCODINGS` that is no file.

    Returns:
        (H, W, 3) uint8, read-only; a view where they are in this order already.
    """
    name = _RAW_NAMES[pixels.shape[2]] if encoding == "raw" else encoding
    order = ENCODINGS[name].order
    if name == "rgb8" or order is None:
        return cast("UInt8Array", read_only(pixels))
    rgb = np.empty((*pixels.shape[:2], 3), np.uint8)
    for k, channel in enumerate(order):  # a seventh of the time of numbers of channels as an index
        rgb[:, :, k] = pixels[:, :, channel]
    return cast("UInt8Array", read_only(rgb))


def _pixels_of_rgb(rgb: UInt8Array, encoding: str) -> UInt8Array:
    """Give pixels in an encoding.

    Args:
        rgb: (H, W, 3) uint8.
        encoding: rgb8, bgr8, rgba8, bgra8, or mono8 for the mean of the three.

    Raises:
        OptionError: pixels cannot be made in it.
    """
    if encoding == "mono8":
        total = rgb.astype(np.uint16).sum(axis=2, dtype=np.uint16)
        grey: UInt8Array = ((total + 1) // 3).astype(np.uint8)[:, :, None]
        return grey
    known = ENCODINGS.get(encoding)
    if known is None or known.order is None:
        raise OptionError(f"encoding {encoding!r}; expected rgb8, bgr8, rgba8, bgra8 or mono8")
    if encoding == "rgb8":
        return rgb
    pixels = np.full((*rgb.shape[:2], min(known.channels)), 255, np.uint8)
    for k, channel in enumerate(known.order):
        pixels[:, :, channel] = rgb[:, :, k]
    return pixels


def sensor_fusion_of(
    frame: FusedFrame,
    view: FusedView,
    points: LidarPoints,
    *,
    camera_id: int,
    lidar_id: int,
    image_seq: int,
    points_seq: int,
    depth_kind: str = "z",
    point_frame: str = "lidar",
    motion_compensated: bool = False,
    fields: Sequence[str] | None = None,
    image: ImageData | None = None,
) -> SensorFusionData:
    """Give the record of a sweep and one of the images that it was paired with.

    Args:
        frame: the sweep.
        view: the image.
        points: the points to give, in the frame that `point_frame` names.
        camera_id, lidar_id: numbers of the sensors in the record.
        image_seq, points_seq: numbers of the image and of the sweep.
        depth_kind: "z" along the optical axis, or "range" along the ray, from the camera's centre.
        point_frame: "lidar" or "camera".
        motion_compensated: whether the ego trajectory was taken into account.
        fields: what to give of each point; None for all that there is.
        image: the image as it was sent, whose encoding and data the record gets; None for its pixels as rgb8.

    Raises:
        DataError: a number cannot stand in the record.
        OptionError: the kind of depth is not known, or the points have no such field.
    """
    if depth_kind not in DEPTH_KINDS:
        raise OptionError(f"depth_kind {depth_kind!r}; expected one of {', '.join(DEPTH_KINDS)}")
    names = tuple(_fields_of(points) if fields is None else fields)
    data = _point_columns(points, names, frame.timestamp_ns)
    return SensorFusionData(
        timestamp=Timestamp.of(frame.timestamp_ns),
        image_seq=image_seq,
        points_seq=points_seq,
        camera_id=camera_id,
        lidar_id=lidar_id,
        height=view.camera.height,
        width=view.camera.width,
        encoding="rgb8" if image is None else image.encoding,
        image_channel=3 if image is None else image.channel,
        image_data=view.rgb if image is None else image.data,
        image_depth=view.depth_image if depth_kind == "z" else _range_image(frame, view),
        point_num=len(data),
        point_fields=names,
        fields_number=len(names),
        point_data=data,
        depth_kind=depth_kind,
        point_frame=point_frame,
        motion_compensated=motion_compensated,
        image_timestamp=Timestamp.of(view.timestamp_ns),
    )


def _range_image(frame: FusedFrame, view: FusedView) -> Float32Array:
    """Draw how far the visible points are from the camera's centre.

    Returns:
        (H, W) float32 [m], the nearest point of each pixel, 0 for none.
    """
    positions_world = frame.points.positions[view.point_ids].astype(np.float64)
    ranges = np.linalg.norm(positions_world - view.world_from_camera.translation, axis=1)
    image = np.zeros((view.camera.height, view.camera.width), np.float32)
    draw_depths(view.pixel_numbers, ranges.astype(np.float32), view.visible, image)
    return image


def depth_frame_of(record: SensorFusionData, camera: Camera) -> DepthFrame:
    """Give the depth image of a result; distances along the rays become depths along the axis at the pixels' centres.

    A record that does not state which kind it holds is taken to hold depths along the axis.

    Raises:
        DataError: the result's size is not that of the camera.
    """
    for name in ("width", "height"):
        if getattr(record, name) != getattr(camera, name):
            problem = f"{getattr(record, name)}; expected {getattr(camera, name)} as in the calibration"
            raise SENSOR_FUSION.fault(name, problem)
    timestamp = record.timestamp if record.image_timestamp is None else record.image_timestamp
    depth = record.depths
    if record.depth_kind == "range":
        depth = _along_axis(depth, camera)
    frame = DepthFrame.of(timestamp.nanoseconds, camera, depth)
    extras = MappingProxyType({"sensor_id": record.camera_id, "seq": record.image_seq})
    return DepthFrame(frame.timestamp_ns, camera, frame.decode, extras=extras)


def _along_axis(ranges: Float32Array, camera: Camera) -> Float32Array:
    rows, columns = np.nonzero(ranges)
    rays = unproject(camera, np.column_stack([columns, rows]).astype(np.float64))
    depth = np.zeros_like(ranges)
    depth[rows, columns] = ranges[rows, columns] * np.nan_to_num(np.maximum(rays[:, 2], 0.0))
    return depth
