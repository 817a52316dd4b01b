"""Records as objects of the scene model (boxes, lidar frames, images), and back; results of fusion as records."""

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, replace
from functools import partial
from types import MappingProxyType
from typing import Any, cast

import numpy as np

from sceneloom.arrays import AnyArray, Float32Array, Float64Array, Int64Array, UInt8Array, UInt32Array, read_only
from sceneloom.cameras.camera import Camera
from sceneloom.colouring.blending import NO_CAMERA, colour_points
from sceneloom.colouring.results import FusedFrame, FusedView
from sceneloom.db34t.records import ENCODINGS, Boxes2d, Boxes3d, ImageData, PointCloudData, RawData, SensorFusionData
from sceneloom.db34t.setting import SensorKind, Setting
from sceneloom.db34t.tables import IMAGE, POINT_CLOUD, RAW
from sceneloom.db34t.types import INTEGER_RANGES, NANOSECONDS, BasicType, Timestamp, bytes_of
from sceneloom.detections.results import FusedBoxes
from sceneloom.errors import OptionError
from sceneloom.formats.base.images import EncodedImage
from sceneloom.formats.recording.contents import XYZIRT
from sceneloom.fusion.algorithms import BUILT_IN, FusionType
from sceneloom.fusion.system import FusedDetectionFrame
from sceneloom.geometry.rigid import RigidTransform
from sceneloom.kernels.box_fusion import single_precision
from sceneloom.kernels.projection import draw_depths
from sceneloom.scene.cameras import CameraImage
from sceneloom.scene.clouds import LidarFrame, LidarPoints
from sceneloom.scene.detections import Boxes2D, Boxes3D, ScoreForm
from sceneloom.scene.types import Identifier, PointsFrame


def boxes_3d_of(record: Boxes3d, *, sensor_id: Identifier | None = None) -> Boxes3D:
    """The boxes of a list of table 7; `sensor_id` is the lidar in the scene, None for the record's own number.

    A heading's vertical part is dropped: the model's boxes are upright. Velocities are the vectors, where the record
    has them, else the speeds along the directions.
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
    """The list of table 7 of boxes in a lidar's frame.

    Boxes without ids are numbered, those without velocities are stationary, covariances are left out, and scores of the
    form `logit` become probabilities.

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
    """The boxes of a list of table 8; `sensor_id` is the camera in the scene, None for the record's own number.

    Both count pixels from the image's own corner.
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
    """The list of table 8 of boxes in an image, with the whole pixels that each touches.

    Boxes are cut to the image of `size_wh` [px], or at 0 alone. Those that have no area then, or are not finite, are
    left out: the record has fewer.

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


def _whole_corners(corners_xyxy: Float64Array, size_wh: tuple[int, int] | None = None) -> UInt32Array:
    """The whole pixels that boxes (N, 4) [px] touch, (N, 4) uint32, cut to an image; of one that is not finite 0."""
    largest = 2**32 - 1
    width, height = (largest, largest) if size_wh is None else size_wh
    finite = np.isfinite(corners_xyxy).all(axis=1, keepdims=True)
    whole = np.where(finite, corners_xyxy, 0.0)
    np.floor(whole[:, :2], out=whole[:, :2])
    np.ceil(whole[:, 2:], out=whole[:, 2:])
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


_COLOR_NAMES = ("r", "g", "b")
"""Fields of a coloured point, 0 to 255."""

_REFLECTIVITY_NAMES = ("reflectivity", "intensity")
"""Fields that state how bright a return is; the first one is written."""

_RAW_FIELDS = ("reflectivity", "ring", "time")
"""What the 23-byte records of the recording format report of a point beside its position."""

_LONGEST_OFFSET = 3600.0  # times of points that are farther than so many seconds from their cloud's are none


def lidar_frame_of(record: PointCloudData) -> LidarFrame:
    """The sweep of a point cloud record.

    `reflectivity` or `intensity` becomes intensities: whole numbers to 255 as they are, fractions to 1 times 255,
    larger ones scaled from 65535; `ring` rings; `time` [s, from the cloud's timestamp] times; `r`, `g`, `b` colours. A
    field that these do not hold exactly, and any other, stays as it is in `points.extras`. The frame's extras hold
    sensor_id, seq, fields, sensor_type, beam and ring of the record. Points with a number that is not finite are left
    out: the sweep has fewer then.
    """
    names = ("sensor_id", "seq", "fields", "sensor_type", "beam", "ring")
    values = record.points
    if not _are_finite(values):
        values = values[np.isfinite(values).all(axis=1)]
    return _frame_of(values, record.fields, record.timestamp, {name: getattr(record, name) for name in names})


def lidar_frame_of_result(record: SensorFusionData) -> LidarFrame:
    """The points of a result of sensor-data fusion as a sweep, in the frame that `point_frame` names."""
    extras = {"sensor_id": record.lidar_id, "seq": record.points_seq, "fields": record.point_fields}
    return _frame_of(record.points, record.point_fields, record.timestamp, extras)


def point_cloud_of(
    frame: LidarFrame, *, sensor_id: int, seq: int, fields: Sequence[str] | None = None
) -> PointCloudData:
    """The record of a sweep; points without a finite position are left out.

    Args:
        fields: what to give of each point; None for what the sweep's record had, else for all that there is.

    Raises:
        DataError: a number cannot stand in the record.
        OptionError: the points have no such field.
    """
    extras = frame.extras
    names = tuple(fields if fields is not None else extras.get("fields") or _fields_of(frame.points))
    data = _point_table(frame.points, names, frame.timestamp_ns)
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


def _frame_of(
    values: Float32Array, fields: Sequence[str], timestamp: Timestamp, extras: Mapping[str, Any]
) -> LidarFrame:
    """The sweep of a table of fields: (N, F) float32, finite, and F names, x, y and z among them."""
    columns = {name: values[:, k] for k, name in enumerate(fields)}
    timestamp_ns = timestamp.nanoseconds
    parts: dict[str, Any] = {}
    exact = set("xyz")
    for part, (names, part_of, field_of) in _PARTS.items():
        name = next((name for name in names if name in columns), None)
        found = None if name is None else part_of(columns[name], timestamp_ns)
        if name is not None and found is not None:
            parts[part] = read_only(found)
            if np.array_equal(field_of(found, timestamp_ns), columns[name]):
                exact.add(name)
    if all(name in columns for name in _COLOR_NAMES):
        colors = _together([columns[name] for name in _COLOR_NAMES])
        bounded = not colors.size or (colors.min() >= 0 and colors.max() <= 255)
        if bounded and np.array_equal(np.rint(colors), colors):
            parts["colors"] = read_only(colors.astype(np.uint8))
            exact.update(_COLOR_NAMES)
    positions = values if tuple(fields) == ("x", "y", "z") else _together([columns[axis] for axis in "xyz"])
    others = {name: read_only(column) for name, column in columns.items() if name not in exact}
    points = LidarPoints(cast("Float32Array", read_only(positions)), extras=MappingProxyType(others), **parts)
    return LidarFrame(timestamp_ns, points, extras=MappingProxyType(dict(extras)))


def _result_fields(sent: LidarFrame) -> tuple[str, ...]:
    """The fields of the points of table 9, by the names of what was sent (table 6, or raw data) and by nothing else."""
    # Source: READING of point_fields in docs/db34t-4101.md
    names = sent.extras.get("fields", ("x", "y", "z", *_RAW_FIELDS))
    others = (name for name in names if name not in ("x", "y", "z", *_COLOR_NAMES))
    return ("x", "y", "z", *others, *_COLOR_NAMES)


def _fields_of(points: LidarPoints) -> tuple[str, ...]:
    """The names of all fields that points have; of further arrays those of 32-bit numbers."""
    names = [*"xyz", *(names[0] for part, (names, _, _) in _PARTS.items() if getattr(points, part) is not None)]
    names += _COLOR_NAMES if points.colors is not None else ()
    further = [name for name, array in points.extras.items() if array.ndim == 1 and array.dtype == np.float32]
    if any(name in further for name in _REFLECTIVITY_NAMES) and "reflectivity" in names:
        names.remove("reflectivity")
    return tuple(dict.fromkeys((*names, *further)))


def _point_table(points: LidarPoints, fields: Sequence[str], timestamp_ns: int) -> Float32Array:
    """The table of F fields of points with a finite position, (M, F) float32, times counted from `timestamp_ns`."""
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
    if name in _COLOR_NAMES and points.colors is not None:
        return points.colors[:, _COLOR_NAMES.index(name)]
    for part, (names, _, field_of) in _PARTS.items():
        found = getattr(points, part)
        if name in names and found is not None:
            return field_of(found, timestamp_ns)
    raise OptionError(f"field {name!r}; the points have {', '.join(_fields_of(points))}")


def _together(columns: Sequence[Float32Array]) -> Float32Array:
    table = np.empty((len(columns[0]), len(columns)), np.float32)
    for k, column in enumerate(columns):
        table[:, k] = column
    return table


def _intensities(values: Float32Array, _: int) -> UInt8Array | None:
    if values.size == 0:
        return np.zeros(0, np.uint8)
    low, high = float(values.min()), float(values.max())
    if low < 0 or high > 65535:
        return None
    whole = np.rint(values)
    if high <= 1 and not np.array_equal(whole, values):
        whole = np.rint(values * 255.0)
    elif high > 255:
        whole = np.rint(values * (255.0 / 65535.0))
    return whole.astype(np.uint8)


def _rings(values: Float32Array, _: int) -> AnyArray | None:
    whole = np.rint(values)
    if values.size and (not np.array_equal(whole, values) or values.min() < 0 or values.max() > 65535):
        return None
    return whole.astype(np.uint16)


def _times(values: Float32Array, timestamp_ns: int) -> Int64Array | None:
    if values.size and max(-float(values.min()), float(values.max())) > _LONGEST_OFFSET:
        return None
    times_ns: Int64Array = timestamp_ns + np.rint(values.astype(np.float64) * NANOSECONDS).astype(np.int64)
    return times_ns


def _numbers(values: AnyArray, _: int) -> Float32Array:
    return values.astype(np.float32)


def _seconds(timestamps_ns: AnyArray, timestamp_ns: int) -> Float32Array:
    return ((timestamps_ns - timestamp_ns) / NANOSECONDS).astype(np.float32)


_PARTS: Mapping[
    str, tuple[tuple[str, ...], Callable[[Float32Array, int], AnyArray | None], Callable[[AnyArray, int], Float32Array]]
] = {
    "intensities": (_REFLECTIVITY_NAMES, _intensities, _numbers),
    "rings": (("ring",), _rings, _numbers),
    "timestamps_ns": (("time",), _times, _seconds),
}  # by part of the points: the fields that become it, how, and how the field comes back out of it


def image_of(record: ImageData, camera: Camera) -> CameraImage:
    """The image of an image record; a file is decoded when the image is asked for.

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
        if record.encoding == "raw" and record.channel not in (1, 3, 4):
            raise IMAGE.fault("channel", f"{record.channel} of raw; expected 1, 3 or 4, to be shown")
        decode = partial(ENCODINGS[record.encoding].rgb, record.pixels)
        return CameraImage(timestamp_ns, camera, decode, extras=extras)
    file = EncodedImage(bytes_of(record.data), record.encoding, record.width, record.height, IMAGE.owner, "data")
    encoded = file.encoded if record.encoding == "jpeg" else None
    return CameraImage(timestamp_ns, camera, file, extras=extras, encoded=encoded)


def image_data_of(image: CameraImage, *, sensor_id: int, seq: int, encoding: str = "rgb8") -> ImageData:
    """The record of an image.

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


def _pixels_of_rgb(rgb: UInt8Array, encoding: str) -> UInt8Array:
    """(H, W, 3) uint8 as pixels of an encoding; mono8 is the mean of the three."""
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


def lidar_frame_of_raw(record: RawData) -> LidarFrame:
    """The sweep of raw data that are the 23-byte records of the recording format.

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
    times = rows["timestamp"]
    if len(times) and (times.max() >= 2**32 or times.min() < 0):
        raise RAW.fault("data", f"times up to {float(times.max())} s; expected 0 to {2**32} s")
    seconds = np.floor(times)
    points = LidarPoints(
        np.column_stack([rows[name] for name in "xyz"]).astype(np.float32, copy=False).reshape(len(rows), 3),
        rows["intensity"].copy(),
        timestamps_ns=seconds.astype(np.int64) * NANOSECONDS
        + np.rint((times - seconds) * NANOSECONDS).astype(np.int64),
        rings=rows["ring"].astype(np.uint16),
    )
    extras = {"sensor_id": record.sensor_id, "seq": record.seq}
    return LidarFrame(record.timestamp.nanoseconds, points, extras=MappingProxyType(extras))


def image_record_of_raw(record: RawData, camera: Camera, encoding: str) -> ImageData:
    """The image record of raw data: jpeg, png, or pixels of the camera's size in another one of `ENCODINGS`.

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


_MOST_FIELDS = 255  # of a point of table 9, whose fields_number is a uint8


def measurement_of(
    record: RawData | ImageData | PointCloudData | Boxes3d | Boxes2d, setting: Setting
) -> tuple[LidarFrame | CameraImage | Boxes3d | Boxes2d, ImageData | None]:
    """What is fused of a record of one frame, and the record of an image where it is or makes one.

    Raises:
        DataError: the record does not fit its calibration, or cannot be read.
        CalibrationError: the calibrations of its camera are of images of several sizes.
    """
    match record:
        case PointCloudData():
            frame = lidar_frame_of(record)
            if len(_result_fields(frame)) > _MOST_FIELDS:
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


@dataclass(frozen=True, slots=True, eq=False)
class FoundObjects:
    """The objects of a sweep and an image, and where the lidar was.

    Attributes:
        frame: the objects, in the lidar's frame of the standard axes.
        world_from_lidar: at the time of the sweep; the identity where the ego trajectory did not count.
        origin: (3,) float64 [m], where that world's origin is in the world of the vehicle's trajectory.
        setting: the configuration in force when the sweep came.
    """

    frame: FusedDetectionFrame
    world_from_lidar: RigidTransform
    origin: Float64Array
    setting: Setting


def declared_columns(
    fused: FusedBoxes, declared_from_standard: Float64Array, camera: Camera
) -> tuple[dict[str, Any], bool]:
    """The columns of numbers of objects as records of table 10 have them, and whether all of them make sense.

    Scores are cut to 0 to 1, covariances made symmetric, and boxes rounded outwards to whole pixels within the camera's
    image. Objects make sense where all numbers are finite, no size or variance is below 0, no box is inside out, and
    what a lidar saw has a size.

    Args:
        declared_from_standard: (3, 3) float64, a signed permutation: from the standard axes of the lidar to those of
            the record.
    """
    velocities = np.zeros((len(fused), 3)) if fused.velocities is None else fused.velocities
    *numbers, sound = single_precision(
        fused.scores,
        fused.centers,
        fused.center_covariances,
        fused.sizes_lwh,
        fused.size_covariances,
        fused.yaws,
        velocities,
        fused.rows_3d,
        np.ascontiguousarray(declared_from_standard),
    )
    columns: dict[str, Any] = dict(zip(_COLUMNS, numbers, strict=True))
    corners = _whole_corners(fused.corners_xyxy, (camera.width, camera.height))
    sound = sound and bool((corners[:, :2] <= corners[:, 2:]).all())
    # what is cut off at the image's edge is beside the view, and has no outline
    corners[~(corners[:, 2:] > corners[:, :2]).all(axis=1)] = 0
    columns["corners_xyxy"] = corners
    if fused.velocities is None:
        columns["velocity_vectors"] = None
    return columns, sound


_COLUMNS = (
    *("confidence", "centers", "center_covs", "sizes_lwh", "size_covs", "directions"),
    *("velocities", "velocity_vectors"),
)  # what `single_precision` gives


def sensor_fusion_record(
    frame: FusedFrame,
    view: FusedView,
    world_from_lidar: RigidTransform,
    setting: Setting,
    *,
    sent: LidarFrame,
    image: ImageData,
    numbers: Mapping[str, Any],
    motion_compensated: bool,
) -> SensorFusionData:
    """The record of a sweep and one of its images.

    The points have x, y, z, then what else was sent of them in its order, then r, g, b, whatever the values are.

    Args:
        world_from_lidar: the lidar at the sweep's reference time; where the ego stood, the identity.
        numbers: camera_id, lidar_id, image_seq and points_seq.

    Source: DB34/T 4101-2022, table 9; READINGS of table 9 in docs/CONVENTIONS.md.
    """
    of_lidar = setting.properties["reference_frame"] == 1
    world_from_frame = world_from_lidar if of_lidar else view.world_from_camera
    kind = SensorKind.LIDAR if of_lidar else SensorKind.CAMERA
    points = replace(
        sent.points,
        positions=_moved(frame.points, world_from_frame, setting.axes[kind].standard_from_declared(kind).T),
        colors=_colors_of(frame, view, setting),
        camera_index=None,
        extras={name: values for name, values in sent.points.extras.items() if name not in _COLOR_NAMES},
    )
    fields, depth_kind = _result_fields(sent), setting.properties["depth_kind"]
    data = _point_table(points, fields, frame.timestamp_ns)
    return SensorFusionData(
        **numbers,
        timestamp=Timestamp.of(frame.timestamp_ns),
        height=view.camera.height,
        width=view.camera.width,
        encoding=image.encoding,
        image_channel=image.channel,
        image_data=image.data,
        image_depth=view.depth_image if depth_kind == "z" else _range_image(frame, view),
        point_num=len(data),
        point_fields=fields,
        fields_number=len(fields),
        point_data=data,
        depth_kind=depth_kind,
        point_frame=kind.value,
        motion_compensated=motion_compensated,
        image_timestamp=Timestamp.of(view.timestamp_ns),
    )


def _range_image(frame: FusedFrame, view: FusedView) -> Float32Array:
    """Distances [m] of the nearest visible points from the camera's centre, (H, W) float32, 0 for none."""
    positions_world = frame.points.positions[view.point_ids].astype(np.float64)
    ranges = np.linalg.norm(positions_world - view.world_from_camera.translation, axis=1)
    image = np.zeros((view.camera.height, view.camera.width), np.float32)
    draw_depths(view.pixel_numbers, ranges.astype(np.float32), view.visible, image)
    return image


def _colors_of(frame: FusedFrame, view: FusedView, setting: Setting) -> UInt8Array:
    """One image's colours of the points: the cloud's, if it alone gave them; grey where it does not show them."""
    # algorithms of other packages may colour a cloud as they like
    own = setting.properties.algorithms[FusionType.SENSOR_DATA] in BUILT_IN[FusionType.SENSOR_DATA]
    colors, shown_by = frame.points.colors, frame.points.camera_index
    if not own or len(frame.views) != 1 or colors is None or shown_by is None:
        colors, shown_by = colour_points(len(frame.points), [view], [0])
    unseen = shown_by == NO_CAMERA
    if unseen.any():
        colors = colors.copy()
        colors[unseen] = 128  # red, green and blue alike: grey
    return colors


def _moved(points: LidarPoints, world_from_frame: RigidTransform, declared_from_standard: Float64Array) -> Float32Array:
    """Give points of the world in a frame of declared axes, (N, 3) float32 [m]."""
    frame_from_world = world_from_frame.inverse()
    rotation = declared_from_standard @ frame_from_world.rotation
    translation = declared_from_standard @ frame_from_world.translation
    if np.array_equal(rotation, np.eye(3)) and not translation.any():
        return points.positions
    return (points.positions @ rotation.T + translation).astype(np.float32)
