"""Records as messages of Foxglove's schemas: their bytes in chunks, so that large fields are not copied.

Source: the Foxglove schemas, package foxglove-schemas-protobuf 0.4.
"""

from collections.abc import Callable, Mapping
from types import MappingProxyType
from typing import Any

import msgspec
import numpy as np

from sceneloom.errors import OutputError
from sceneloom.formats.mcap.schemas import SAMPLE_SCHEMA, foxglove_type, serialised
from sceneloom.formats.topics.records import (
    AnyRecord,
    Boxes2DRecord,
    Boxes3DRecord,
    CameraModelRecord,
    CloudRecord,
    CompressedImageRecord,
    FixRecord,
    ImageRecord,
    PoseRecord,
    SampleRecord,
    TransformRecord,
)
from sceneloom.formats.wire_bytes import field_head

Parts = list[bytes | memoryview]

_NUMERIC = {"u1": 1, "i1": 2, "u2": 3, "i2": 4, "u4": 5, "i4": 6, "f4": 7, "f8": 8}
_DIAGONAL = 2
_LINE_LOOP = 2
_MATCHING_ID = 0
_VIDEOS = frozenset({"h264", "h265", "vp9", "av1"})
_FACES = {"r": 0.1, "g": 0.6, "b": 1.0, "a": 0.35}
_EDGES = {"r": 0.1, "g": 0.6, "b": 1.0, "a": 1.0}


def encode(record: AnyRecord) -> tuple[str, Parts]:
    """Give the schema of a record's message, and the message.

    Raises:
        OutputError: there is no schema for such records.
    """
    write = _WRITERS.get(type(record))
    if write is None:
        raise OutputError(f"a {type(record).__name__}; there is no schema for it")
    return write(record)


def _time(time_ns: int) -> dict[str, int]:
    seconds, nanos = divmod(time_ns, 1_000_000_000)
    return {"seconds": seconds, "nanos": nanos}


def _xyz(values: Any) -> dict[str, float]:
    return dict(zip("xyz", map(float, values), strict=True))


def _xyzw(values: Any) -> dict[str, float]:
    return dict(zip("xyzw", map(float, values), strict=True))


def _message(schema: str, data: memoryview | None = None, **fields: Any) -> tuple[str, Parts]:
    message_type = foxglove_type(schema)
    rest = serialised(message_type(**fields))
    if data is None:
        return schema, [rest]
    number = message_type.DESCRIPTOR.fields_by_name["data"].number
    return schema, [rest, field_head(number, len(data)), data]


def _transform(record: TransformRecord) -> tuple[str, Parts]:
    return _message(
        "foxglove.FrameTransform",
        timestamp=_time(record.timestamp_ns),
        parent_frame_id=record.parent,
        child_frame_id=record.child,
        translation=_xyz(record.position),
        rotation=_xyzw(record.quaternion_xyzw),
    )


def _cloud(record: CloudRecord) -> tuple[str, Parts]:
    return _message(
        "foxglove.PointCloud",
        record.data,
        timestamp=_time(record.timestamp_ns),
        frame_id=record.frame_id,
        pose={"position": _xyz((0, 0, 0)), "orientation": _xyzw((0, 0, 0, 1))},
        point_stride=record.stride,
        fields=[
            {"name": field.name, "offset": field.offset, "type": _NUMERIC[field.dtype.str[1:]]}
            for field in record.fields
        ],
    )


def _image(record: ImageRecord) -> tuple[str, Parts]:
    return _message(
        "foxglove.RawImage",
        record.data,
        timestamp=_time(record.timestamp_ns),
        frame_id=record.frame_id,
        width=record.width,
        height=record.height,
        encoding=record.encoding,
        step=record.step,
    )


def _compressed_image(record: CompressedImageRecord) -> tuple[str, Parts]:
    schema = "foxglove.CompressedVideo" if record.form in _VIDEOS else "foxglove.CompressedImage"
    head = {"timestamp": _time(record.timestamp_ns), "frame_id": record.frame_id, "format": record.form}
    return _message(schema, record.data, **head)


def _camera_model(record: CameraModelRecord) -> tuple[str, Parts]:
    return _message(
        "foxglove.CameraCalibration",
        timestamp=_time(record.timestamp_ns),
        frame_id=record.frame_id,
        width=record.width,
        height=record.height,
        distortion_model=record.model,
        D=record.coefficients,
        K=record.k,
        R=np.eye(3).reshape(-1).tolist(),
        P=record.p,
    )


def _pose(record: PoseRecord) -> tuple[str, Parts]:
    pose: dict[str, Any] = {"position": _xyz(record.position)}
    if record.quaternion_xyzw is not None:
        pose["orientation"] = _xyzw(record.quaternion_xyzw)
    return _message(
        "foxglove.PoseInFrame", timestamp=_time(record.timestamp_ns), frame_id=record.frame_id, pose=pose
    )


def _fix(record: FixRecord) -> tuple[str, Parts]:
    latitude, longitude, altitude = record.lla
    fields: dict[str, Any] = {"latitude": latitude, "longitude": longitude, "altitude": altitude}
    if record.variances is not None:
        fields["position_covariance"] = np.diag(record.variances).reshape(-1).tolist()
        fields["position_covariance_type"] = _DIAGONAL
    return _message(
        "foxglove.LocationFix", timestamp=_time(record.timestamp_ns), frame_id=record.frame_id, **fields
    )


def _sample(record: SampleRecord) -> tuple[str, Parts]:
    seconds, nanos = divmod(record.timestamp_ns, 1_000_000_000)
    content = {
        "timestamp": {"sec": seconds, "nsec": nanos},
        "frame_id": record.frame_id,
        "values": record.values,
    }
    return SAMPLE_SCHEMA, [msgspec.json.encode(content)]


def _boxes_3d(record: Boxes3DRecord) -> tuple[str, Parts]:
    time = _time(record.timestamp_ns)
    entities = [
        {
            "timestamp": time,
            "frame_id": box.frame_id,
            "id": box.id,
            "frame_locked": True,
            "metadata": _pairs({**({} if box.label is None else {"label": box.label}), **box.reported}),
            "cubes": [
                {
                    "pose": {"position": _xyz(box.center), "orientation": _xyzw(box.quaternion_xyzw)},
                    "size": _xyz(box.size_lwh),
                    "color": _FACES,
                }
            ],
        }
        for box in record.boxes
    ]
    gone = [{"timestamp": time, "type": _MATCHING_ID, "id": identifier} for identifier in record.gone]
    return _message("foxglove.SceneUpdate", deletions=gone, entities=entities)


def _boxes_2d(record: Boxes2DRecord) -> tuple[str, Parts]:
    time, points = _time(record.timestamp_ns), []
    for box in record.boxes:
        left, top, width, height = box.box_ltwh
        corners = ((left, top), (left + width, top), (left + width, top + height), (left, top + height))
        reported = {"id": box.id, **({} if box.label is None else {"label": box.label}), **box.reported}
        points.append(
            {
                "timestamp": time,
                "type": _LINE_LOOP,
                "points": [{"x": x, "y": y} for x, y in corners],
                "outline_color": _EDGES,
                "thickness": 2.0,
                "metadata": _pairs(reported),
            }
        )
    return _message("foxglove.ImageAnnotations", points=points)


def _pairs(reported: Mapping[str, str]) -> list[dict[str, str]]:
    return [{"key": key, "value": value} for key, value in reported.items()]


_WRITERS: Mapping[type[Any], Callable[[Any], tuple[str, Parts]]] = MappingProxyType(
    {
        TransformRecord: _transform,
        CloudRecord: _cloud,
        ImageRecord: _image,
        CompressedImageRecord: _compressed_image,
        CameraModelRecord: _camera_model,
        PoseRecord: _pose,
        FixRecord: _fix,
        SampleRecord: _sample,
        Boxes3DRecord: _boxes_3d,
        Boxes2DRecord: _boxes_2d,
    }
)
