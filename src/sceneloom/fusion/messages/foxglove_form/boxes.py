"""Boxes in space as `foxglove.SceneUpdate`, boxes in pictures as `ImageAnnotations`.

Points of annotations count from the picture's own corner, as table 8 does. Of a box, what the drawing does not say
stands in its metadata.
"""

from collections.abc import Mapping
from dataclasses import dataclass
from typing import Any

import numpy as np

from sceneloom.fusion.messages.boxes import Boxes2d, Boxes3d
from sceneloom.fusion.messages.foreign_values import (
    ForeignMessage,
    direction_of_quaternion,
    quaternion_of_direction,
    rows_of_three,
)
from sceneloom.fusion.messages.foxglove_form.message import NO_TURN, FoxgloveMessage, time_content
from sceneloom.fusion.messages.fused import FusedDetections
from sceneloom.fusion.messages.scene_form.boxes import whole_corners
from sceneloom.fusion.messages.timestamps import Timestamp

_ALL_ENTITIES, _LINE_LOOP = 1, 2
_FACES = {"r": 0.1, "g": 0.6, "b": 1.0, "a": 0.35}
_EDGES = {"r": 0.1, "g": 0.6, "b": 1.0, "a": 1.0}


def write_boxes_3d(
    record: Boxes3d | FusedDetections, frame_id: str, image_frame_id: str
) -> dict[str, FoxgloveMessage]:
    """Draw boxes in place of those that the last message drew."""
    del image_frame_id
    time = time_content(record.timestamp)
    entities = [
        {
            "timestamp": time,
            "frame_id": frame_id,
            "id": str(k),
            "frame_locked": True,
            "metadata": _metadata(record, k, velocity=record.velocities[k], direction=record.directions[k]),
            "cubes": [_cube(record, k)],
            "texts": [_label(record, k)],
        }
        for k in range(len(record))
        if record.directions[k].any()
    ]
    content = {"deletions": [{"timestamp": time, "type": _ALL_ENTITIES}], "entities": entities}
    return {"boxes_3d": FoxgloveMessage("foxglove.SceneUpdate", content)}


def _cube(record: Boxes3d | FusedDetections, k: int) -> dict[str, Any]:
    quaternion = quaternion_of_direction(record.directions[k])
    pose = {
        "position": dict(zip("xyz", record.centers[k].tolist(), strict=True)),
        "orientation": dict(zip("xyzw", quaternion.tolist(), strict=True)),
    }
    return {
        "pose": pose,
        "size": dict(zip("xyz", record.sizes_lwh[k].tolist(), strict=True)),
        "color": _FACES,
    }


def _label(record: Boxes3d | FusedDetections, k: int) -> dict[str, Any]:
    x, y, z = record.centers[k].tolist()
    above = {"x": x, "y": y, "z": z + float(record.sizes_lwh[k, 2]) / 2 + 0.2}
    return {
        "pose": {"position": above, "orientation": NO_TURN},
        "billboard": True,
        "font_size": 12.0,
        "scale_invariant": True,
        "color": _EDGES,
        "text": _text(record, k),
    }


def _text(record: Any, k: int) -> str:
    return f"{record.class_names[k]} {record.id[k]} {record.confidence[k]:.2f}"


def _metadata(record: Any, k: int, **further: Any) -> list[dict[str, str]]:
    values = {
        "class": record.class_names[k],
        "id": record.id[k],
        "confidence": record.confidence[k],
        **further,
    }
    return [
        {"key": key, "value": " ".join(map(str, value)) if isinstance(value, np.ndarray) else str(value)}
        for key, value in values.items()
    ]


def read_boxes_3d(message: ForeignMessage, common: dict[str, Any]) -> Boxes3d:
    """Read the boxes of a drawing in space; what only our own drawings say has defaults."""
    boxes = [
        (cube, _Told.of(entity))
        for entity in (message.each("entities") if "entities" in message.content else [])
        for cube in (entity.each("cubes") if "cubes" in entity.content else [])
    ]
    poses = [cube.inner("pose") for cube, _ in boxes]
    directions = [
        told.vector("direction") or direction_of_quaternion(pose.inner("orientation"))
        for pose, (_, told) in zip(poses, boxes, strict=True)
    ]
    return Boxes3d(
        **common,
        **_named([told for _, told in boxes]),
        centers=rows_of_three([pose.inner("position").vector("xyz") for pose in poses]),
        sizes_lwh=rows_of_three([cube.inner("size").vector("xyz") for cube, _ in boxes]),
        directions=rows_of_three(directions),
        velocities=np.array([told.number("velocity", 0.0) for _, told in boxes], np.float32),
    )


@dataclass(frozen=True, slots=True)
class _Told:
    """What the metadata of a drawing say."""

    message: ForeignMessage
    values: Mapping[str, str]

    @classmethod
    def of(cls, message: ForeignMessage) -> "_Told":
        pairs = message.each("metadata") if "metadata" in message.content else []
        return cls(message, {pair.text("key"): pair.text("value") for pair in pairs})

    def number(self, key: str, default: float) -> float:
        text = self.values.get(key)
        if text is None:
            return default
        try:
            return float(text)
        except ValueError:
            raise self.message.fault("metadata", f"{key} {text!r}; expected a number") from None

    def vector(self, key: str) -> list[float] | None:
        text = self.values.get(key)
        if text is None:
            return None
        try:
            numbers = [float(part) for part in text.split()]
        except ValueError:
            numbers = []
        if len(numbers) != 3:
            raise self.message.fault("metadata", f"{key} {text!r}; expected three numbers")
        return numbers

    def whole(self, key: str, default: int) -> int:
        number = self.number(key, float(default))
        if not (number.is_integer() and -(2**31) <= number < 2**31):
            raise self.message.fault("metadata", f"{key} {number}; expected an int32")
        return int(number)


def _named(told: list[_Told]) -> dict[str, Any]:
    return {
        "id": np.array([one.whole("id", k) for k, one in enumerate(told)], np.int32),
        "class_names": tuple(one.values.get("class", "object") for one in told),
        "confidence": np.array([one.number("confidence", 1.0) for one in told], np.float32),
    }


def write_boxes_2d(record: Boxes2d, frame_id: str, image_frame_id: str) -> dict[str, FoxgloveMessage]:
    """Draw boxes in a picture."""
    del frame_id, image_frame_id
    return {"boxes_2d": annotations(record, record.timestamp)}


def annotations(record: Boxes2d | FusedDetections, timestamp: Timestamp) -> FoxgloveMessage:
    """Draw boxes in a picture of a time, as loops of lines with texts."""
    time = time_content(timestamp)
    points, texts = [], []
    for k, (x1, y1, x2, y2) in enumerate(record.corners_xyxy.tolist()):
        corners = ((x1, y1), (x2, y1), (x2, y2), (x1, y2))
        points.append(
            {
                "timestamp": time,
                "type": _LINE_LOOP,
                "points": [{"x": float(x), "y": float(y)} for x, y in corners],
                "outline_color": _EDGES,
                "thickness": 2.0,
                "metadata": _metadata(record, k),
            }
        )
        corner = {"x": float(x1), "y": float(y1)}
        text = {"timestamp": time, "position": corner, "text": _text(record, k), "font_size": 12.0}
        texts.append({**text, "text_color": _EDGES})
    return FoxgloveMessage("foxglove.ImageAnnotations", {"timestamp": time, "points": points, "texts": texts})


def read_boxes_2d(message: ForeignMessage, common: dict[str, Any]) -> Boxes2d:
    """Read the boxes of a drawing in a picture: its closed loops of lines."""
    loops = [
        loop
        for loop in (message.each("points") if "points" in message.content else [])
        if loop.whole("type") == _LINE_LOOP
    ]
    corners = np.array([_corners(loop) for loop in loops], np.float64).reshape(-1, 4)
    named = _named([_Told.of(loop) for loop in loops])
    return Boxes2d(**common, **named, corners_xyxy=whole_corners(corners, None))


def _corners(loop: ForeignMessage) -> list[float]:
    """Edges of the upright box around a loop of lines."""
    points = np.array([point.vector("xy") for point in loop.each("points")]).reshape(-1, 2)
    if len(points) == 0:
        raise loop.fault("points", "empty; expected the corners of a box")
    return [*points.min(axis=0), *points.max(axis=0)]
