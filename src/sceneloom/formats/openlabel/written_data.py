"""Annotations as elements of data."""

from collections.abc import Callable, Iterator, Mapping
from types import MappingProxyType
from typing import Any

import numpy as np

from sceneloom.arrays import Int64Array
from sceneloom.formats.openlabel.read_attributes import TYPE
from sceneloom.formats.openlabel.read_geometry import RBBOX
from sceneloom.formats.openlabel.words import ABSOLUTE, CONFIRMED, INTERPOLATED
from sceneloom.scene.angles import CuboidAngles
from sceneloom.scene.annotations.attributes import AttributePath
from sceneloom.scene.annotations.boxes_2d import Box2DAnnotation
from sceneloom.scene.annotations.cuboids import CuboidAnnotation, Projection
from sceneloom.scene.annotations.keypoints import PointsAnnotation, locations_of
from sceneloom.scene.annotations.shapes import ShapeAnnotation, ShapeType
from sceneloom.scene.at import cuboid_poses

Datum = tuple[int | None, str, dict[str, Any]]
"""Time [ns], or None for always; type of the data; the element."""

_CLOSED = (ShapeType.POLYGON, ShapeType.POLYGON_2D, ShapeType.POLYGON_TOPDOWN)
_POINTS = (ShapeType.POINT, ShapeType.POINT_2D, ShapeType.POINT_TOPDOWN)


def cuboid_data(
    cuboid: CuboidAnnotation, name: str, system: str, angles: CuboidAngles, frames_ns: Int64Array
) -> Iterator[Datum]:
    """A cuboid in each row and, marked as such, in the frames between: centre, quaternion x y z w, sizes.

    Args:
        cuboid: over time.
        name: of the data.
        system: the coordinate system of the cuboid.
        angles: how its angles are meant.
        frames_ns: (M,) int64 [ns], the times of all frames; it is stated in those in which the cuboid is there.
    """
    values = cuboid.path.values
    quaternions = angles.quaternions(values[:, 6:9])
    rows = np.concatenate([values[:, 3:6], quaternions, values[:, :3]], axis=1).tolist()
    between_ns, between = _between(cuboid, angles, frames_ns)
    for time_ns, row in zip(cuboid.path.timestamps_ns.tolist(), rows, strict=True):
        reported = {"attributes": _flag(INTERPOLATED, value=False)} if between else {}
        yield time_ns, "cuboid", {"name": name, "val": row, "coordinate_system": system, **reported}
    for time_ns, row in zip(between_ns, between, strict=True):
        reported = {"attributes": _flag(INTERPOLATED, value=True)}
        yield time_ns, "cuboid", {"name": name, "val": row, "coordinate_system": system, **reported}


def _between(
    cuboid: CuboidAnnotation, angles: CuboidAngles, frames_ns: Int64Array
) -> tuple[list[int], list[list[float]]]:
    """Times and rows of a cuboid in the frames that have no row of its path, as far as it is there."""
    times = frames_ns[~np.isin(frames_ns, cuboid.path.timestamps_ns)]
    poses = cuboid_poses(cuboid, times, angles=angles)
    rows = np.concatenate([poses.centers_world, poses.quaternions_xyzw, poses.sizes_lwh], axis=1)
    there = poses.there & np.isfinite(rows).all(axis=1)
    return times[there].tolist(), rows[there].tolist()


def _flag(name: str, *, value: bool) -> dict[str, Any]:
    return {"boolean": [{"name": name, "val": value}]}


def projection_data(projection: Projection, name: str, system: str) -> Iterator[Datum]:
    """The box of a projection in each row that has one: centre and size, and whether a person confirmed it."""
    boxes = projection.boxes
    if boxes is None:
        return
    rows = np.concatenate([boxes[:, :2] + boxes[:, 2:] / 2, boxes[:, 2:]], axis=1)
    for k in np.flatnonzero(np.isfinite(rows).all(axis=1)).tolist():
        confirmed = None if projection.confirmed is None else projection.confirmed[k]
        reported = {} if confirmed is None else {"attributes": _flag(CONFIRMED, value=confirmed)}
        element = {"name": name, "val": rows[k].tolist(), "coordinate_system": system, **reported}
        yield int(projection.timestamps_ns[k]), "bbox", element


def box_data(box: Box2DAnnotation, name: str, system: str) -> Iterator[Datum]:
    """A box in each row: centre and size."""
    values = box.path.values
    rows = np.concatenate([values[:, :2] + values[:, 2:] / 2, values[:, 2:]], axis=1).tolist()
    for time_ns, row in zip(box.path.timestamps_ns.tolist(), rows, strict=True):
        yield time_ns, "bbox", {"name": name, "val": row, "coordinate_system": system}


def shape_data(shape: ShapeAnnotation, name: str, system: str) -> Iterator[Datum]:
    """A line, an area or a point in each row; areas that were rotated boxes as these."""
    times = shape.path.timestamps_ns.tolist()
    rotated = shape.path.extras.get(RBBOX)
    if rotated is not None and len(rotated) == len(times):
        for time_ns, row in zip(times, rotated, strict=True):
            yield time_ns, "rbbox", {"name": name, "val": list(row), "coordinate_system": system}
        return
    for time_ns, vertices in zip(times, shape.path.vertices, strict=True):
        kind = f"{'point' if shape.type in _POINTS and len(vertices) == 1 else 'poly'}{shape.dimensions}d"
        element: dict[str, Any] = {
            "name": name,
            "val": vertices.reshape(-1).tolist(),
            "coordinate_system": system,
        }
        if kind.startswith("poly"):
            element["closed"] = shape.type in _CLOSED or bool(shape.is_closed)
        if kind == "poly2d":
            element["mode"] = ABSOLUTE
        yield time_ns, kind, element


def keypoint_data(points: PointsAnnotation, system: str) -> Iterator[Datum]:
    """A point in each row of each path, by the names that the points have."""
    for k, path in enumerate(points.paths):
        name = points.labels[k] if points.labels is not None and k < len(points.labels) else f"point{k}"
        if path.values.shape[1] % 3:
            continue
        for time_ns, locations in zip(
            path.timestamps_ns.tolist(), locations_of(path.values).tolist(), strict=True
        ):
            for location in locations:
                yield (
                    time_ns,
                    "point3d",
                    {"name": f"{name}:{k}", "val": location, "coordinate_system": system},
                )


FURTHER = frozenset({"type", "attributes", TYPE})
"""Further fields of an attribute that its data state."""


def attribute_data(attribute: AttributePath, systems: Mapping[Any, str]) -> list[Datum] | None:
    """The values of an attribute; None where the format has no field for what it says.

    Args:
        attribute: of an object.
        systems: names of coordinate systems by the ids of sensors.
    """
    kinds = {_kind(value, attribute) for value in attribute.values}
    times = attribute.timestamps_ns
    sound = len(kinds) == 1 and None not in kinds and attribute.point_index is None
    if not sound or not (attribute.is_timed or (times is None and len(attribute.values) == 1)):
        return None
    if times is not None and len(np.unique(times)) < len(times):
        return None
    if attribute.sensor_id is not None and attribute.sensor_id not in systems:
        return None
    timestamps: list[int | None] = [None] if times is None else times.tolist()
    kind = str(next(iter(kinds)))
    further = {name: value for name, value in attribute.extras.items() if name in FURTHER - {TYPE}}
    if attribute.sensor_id is not None:
        further["coordinate_system"] = systems[attribute.sensor_id]
    return [
        (timestamp, kind, {"name": attribute.name, **further, **_reported(kind, value)})
        for timestamp, value in zip(timestamps, attribute.values, strict=True)
    ]


def _reported(kind: str, value: Any) -> dict[str, Any]:
    if isinstance(value, Mapping):
        return dict(value)
    return {"val": list(value) if kind == "vec" else value}


def _kind(value: Any, attribute: AttributePath) -> str | None:
    """The type of data that holds a value; None where none does."""
    if isinstance(value, Mapping):
        kind = attribute.extras.get(TYPE)
        return kind if isinstance(kind, str) else None
    return next((kind for kind, holds in _HOLDS.items() if holds(value)), None)


def _is_number(value: Any) -> bool:
    return isinstance(value, int | float) and not isinstance(value, bool) and abs(value) < 1e300


_HOLDS: Mapping[str, Callable[[Any], bool]] = MappingProxyType(
    {
        "text": lambda value: isinstance(value, str),
        "boolean": lambda value: isinstance(value, bool),
        "num": _is_number,
        "vec": lambda value: (
            isinstance(value, tuple | list) and all(isinstance(v, str) or _is_number(v) for v in value)
        ),
    }
)
