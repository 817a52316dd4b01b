"""Rows of annotations: each box at each moment, and each annotation as a whole."""

from collections.abc import Sequence
from dataclasses import dataclass, fields
from typing import Any

import numpy as np

from sceneloom.arrays import Float64Array, Int64Array
from sceneloom.catalog.ego import Ego
from sceneloom.catalog.values import Repeated, Rows, text_of
from sceneloom.geometry.rotations import rotate_vectors
from sceneloom.scene.angles import CuboidAngles
from sceneloom.scene.annotations.boxes_2d import Box2DAnnotation
from sceneloom.scene.annotations.cuboids import CuboidAnnotation
from sceneloom.scene.annotations_frame import annotations_frame
from sceneloom.scene.at import box_2d_at, cuboid_poses
from sceneloom.scene.scene import Scene
from sceneloom.scene.span import frame_times
from sceneloom.scene.types import Coordinates, key_of

_NOT_3D = np.full(8, np.nan)
_NOT_2D = np.full(4, np.nan)


@dataclass(frozen=True, slots=True, eq=False)
class BoxRows:
    """Boxes of one annotation, or of all.

    Attributes:
        tracks: (N,) int64, number of the annotation.
        timestamps_ns: (N,) int64 [ns].
        solids: (N, 8) float64: centre [m], length, width, height [m], yaw [rad], speed [m/s]; NaN of boxes in images.
        flats: (N, 4) float64 [px]: left, top, width, height; NaN of boxes in space.
    """

    tracks: Int64Array
    timestamps_ns: Int64Array
    solids: Float64Array
    flats: Float64Array

    @classmethod
    def joined(cls, parts: Sequence["BoxRows"]) -> "BoxRows":
        """Put those of many annotations together, in the order of time."""
        if not parts:
            none = np.zeros(0, np.int64)
            return cls(none, none, np.zeros((0, 8)), np.zeros((0, 4)))
        whole = [np.concatenate([getattr(part, field.name) for part in parts]) for field in fields(cls)]
        order = np.argsort(whole[1], kind="stable")
        return cls(*(column[order] for column in whole))


def box_rows(scene: Scene, moments_ns: Int64Array) -> BoxRows:
    """Give each box at each of the scene's moments at which it is there, or at its own timestamps where it is at none.

    Boxes in images are given at the times of their camera's images.

    Args:
        scene: the scene.
        moments_ns: (M,) int64 [ns], ascending.

    Raises:
        OptionError: unit or order of the cuboids' angles is none of those known.
    """
    angles = CuboidAngles.of(scene)
    images_ns = {key_of(sensor.id): np.unique(frame_times(sensor)) for sensor in scene.sensors}
    parts = []
    for track, annotation in enumerate(scene.annotations):
        if isinstance(annotation, CuboidAnnotation) and len(annotation.path.timestamps_ns):
            parts.append(_solid(track, annotation, _times(annotation, moments_ns), angles))
        elif isinstance(annotation, Box2DAnnotation) and len(annotation.path.timestamps_ns):
            own_ns = images_ns.get(key_of(annotation.sensor_id), moments_ns)
            parts.append(_flat(track, annotation, _times(annotation, own_ns)))
    return BoxRows.joined(parts)


def _times(annotation: CuboidAnnotation | Box2DAnnotation, moments_ns: Int64Array) -> Int64Array:
    timestamps = annotation.path.timestamps_ns
    if annotation.stationary and len(moments_ns):
        return moments_ns
    inside = slice(
        np.searchsorted(moments_ns, timestamps.min()), np.searchsorted(moments_ns, timestamps.max(), "right")
    )
    times = moments_ns[inside]
    return times if len(times) else np.unique(timestamps)


def _solid(track: int, annotation: CuboidAnnotation, times_ns: Int64Array, angles: CuboidAngles) -> BoxRows:
    found = cuboid_poses(annotation, times_ns, angles=angles)
    with np.errstate(invalid="ignore", over="ignore"):  # files hold numbers that are none
        forward = rotate_vectors(found.quaternions_xyzw, np.array([1.0, 0.0, 0.0]))
        yaws = np.arctan2(forward[:, 1], forward[:, 0])
        speeds = _speeds(found.centers_world, times_ns)
    solids = np.column_stack([found.centers_world, found.sizes_lwh, yaws, speeds])
    count = len(times_ns)
    return BoxRows(np.full(count, track), times_ns, solids, np.broadcast_to(_NOT_2D, (count, 4)))


def _flat(track: int, annotation: Box2DAnnotation, times_ns: Int64Array) -> BoxRows:
    boxes, _ = box_2d_at(annotation, times_ns)
    count = len(times_ns)
    return BoxRows(np.full(count, track), times_ns, np.broadcast_to(_NOT_3D, (count, 8)), boxes)


def _speeds(centers: Float64Array, times_ns: Int64Array) -> Float64Array:
    if len(times_ns) < 2:
        return np.full(len(times_ns), np.nan)
    seconds = (times_ns - times_ns[0]) / 1e9
    speeds: Float64Array = np.linalg.norm(np.gradient(centers, seconds, axis=0), axis=1)
    return speeds


def annotation_rows(scene: Scene, ego: Ego, rows: BoxRows, start_ns: int) -> Rows:
    """Give the table `annotations`."""
    stated = [_stated(annotation) for annotation in scene.annotations]
    texts = {
        name: Repeated(rows.tracks, tuple(row[name] for row in stated))
        for name in ("annotation", "type", "label", "sensor")
    }
    # all boxes of a moment share what is known of the ego then
    moments_ns, of_row = np.unique(rows.timestamps_ns, return_inverse=True)
    locations = ego.positions_lla(moments_ns)[of_row]
    names = ("x", "y", "z", "length", "width", "height", "yaw", "speed")
    flat_names = ("left_px", "top_px", "width_px", "height_px")
    return {
        "track": rows.tracks,
        **texts,
        "timestamp_ns": rows.timestamps_ns,
        "seconds": (rows.timestamps_ns - start_ns) / 1e9,
        **{name: rows.solids[:, k] for k, name in enumerate(names)},
        "distance": distances(scene, ego, rows),
        **{name: rows.flats[:, k] for k, name in enumerate(flat_names)},
        "latitude": locations[:, 0],
        "longitude": locations[:, 1],
        "ego_speed": ego.speeds(moments_ns)[of_row],
    }


@np.errstate(invalid="ignore", over="ignore")
def distances(scene: Scene, ego: Ego, rows: BoxRows) -> Float64Array:
    """How far the boxes' centres are from the ego, (N,) float64 [m]; NaN where that is not known."""
    centers = rows.solids[:, :3]
    if annotations_frame(scene) is Coordinates.WORLD:
        moments_ns, of_row = np.unique(rows.timestamps_ns, return_inverse=True)
        centers = centers - ego.positions(moments_ns)[of_row]
    away: Float64Array = np.linalg.norm(centers, axis=1)
    return away


def _stated(annotation: Any) -> dict[str, str | None]:
    return {
        "annotation": text_of(annotation.id),
        "type": str(annotation.type),
        "label": text_of(getattr(annotation, "label", None)),
        "parent": text_of(getattr(annotation, "parent_id", None)),
        "sensor": text_of(getattr(annotation, "sensor_id", None)),
    }


def track_rows(scene: Scene, rows: BoxRows, away: Float64Array, start_ns: int) -> Rows:
    """Give the table `tracks`: every annotation, whatever its type."""
    count = len(scene.annotations)
    order = np.argsort(rows.tracks, kind="stable")
    bounds = np.searchsorted(rows.tracks[order], np.arange(count + 1))
    numbers = np.full((count, 4), np.nan)
    for track in np.flatnonzero(np.diff(bounds)).tolist():
        mine = order[bounds[track] : bounds[track + 1]]
        times = rows.timestamps_ns[mine]
        numbers[track, :2] = (int(times[0]) - start_ns) / 1e9, (int(times[-1]) - start_ns) / 1e9
        numbers[track, 2] = np.linalg.norm(np.diff(rows.solids[mine, :3], axis=0), axis=1).sum()
        numbers[track, 3] = np.fmin.reduce(away[mine])
    stated = [_stated(annotation) for annotation in scene.annotations]
    texts = {
        name: [row[name] for row in stated] for name in ("annotation", "type", "label", "parent", "sensor")
    }
    return {
        "track": np.arange(count),
        **texts,
        "stationary": [getattr(annotation, "stationary", None) for annotation in scene.annotations],
        "boxes": np.diff(bounds),
        **{name: numbers[:, k] for k, name in enumerate(("start", "stop", "metres", "nearest"))},
    }
