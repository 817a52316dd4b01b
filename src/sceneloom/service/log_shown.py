"""What MCAP viewers show of a session: records of the standard as the messages that logs of drives are written with."""

from collections.abc import Callable, Iterator, Sequence
from types import MappingProxyType

import numpy as np

from sceneloom.arrays import AnyArray, Float32Array, Float64Array
from sceneloom.formats.topics.camera_models import camera_model_record, is_foreign
from sceneloom.formats.topics.packed_points import pack
from sceneloom.formats.topics.records import (
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
from sceneloom.fusion.calibration.axes import SensorKind
from sceneloom.fusion.messages.array_bytes import bytes_view
from sceneloom.fusion.messages.boxes import Boxes2d, Boxes3d
from sceneloom.fusion.messages.encodings import ENCODINGS
from sceneloom.fusion.messages.fused import FusedDetections, SensorFusionData
from sceneloom.fusion.messages.records import ResultRecord, SentRecord
from sceneloom.fusion.messages.sensor_data import ImageData, PointCloudData
from sceneloom.fusion.setting import Setting
from sceneloom.geometry.rigid import RigidTransform

FrameName = Callable[[str, int], str]
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


def shown_camera_models(setting: Setting, frame_name: FrameName) -> dict[int, CameraModelRecord]:
    """Give the intrinsics of each camera whose model viewers know."""
    cameras = {camera_id: pair.camera for (camera_id, _), pair in setting.pairs.items()}
    return {
        camera_id: camera_model_record(camera, 0, frame_name("camera", camera_id), _FISHEYE)
        for camera_id, camera in cameras.items()
        if not is_foreign(camera)
    }


def shown_transforms(setting: Setting, frame_name: FrameName) -> Iterator[TransformRecord]:
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
