"""The cuboids of a scene as rows of a table, at times that are asked for."""

from dataclasses import replace

import numpy as np

from sceneloom.arrays import Float64Array, Int64Array
from sceneloom.errors import OptionError
from sceneloom.evaluate.objects import ObjectTable
from sceneloom.geometry.rotations import rotate_vectors
from sceneloom.scene.angles import CuboidAngles
from sceneloom.scene.annotations.attributes import AttributePath
from sceneloom.scene.annotations.cuboids import CuboidAnnotation
from sceneloom.scene.annotations_frame import annotations_frame, not_in_world
from sceneloom.scene.at import cuboid_poses
from sceneloom.scene.scene import Scene
from sceneloom.scene.span import frame_times
from sceneloom.scene.types import Coordinates, SensorType

SCORES = ("existence", "score", "confidence")
"""Attributes of cuboids that state how sure they are; the first one that a cuboid has counts."""

NO_LABEL = "object"
"""The class of cuboids that name none."""


def labelled_times(scene: Scene) -> Int64Array:
    """Times at which objects of a scene are compared: of its first lidar's frames, else the timestamps of its cuboids.

    Returns:
        (F,) int64 [ns], rising.
    """
    for sensor in scene.sensors:
        if sensor.type == SensorType.LIDAR and len(frame_times(sensor)):
            return np.unique(frame_times(sensor))
    timestamps = [cuboid.path.timestamps_ns for cuboid in _cuboids(scene)]
    return np.unique(np.concatenate([np.zeros(0, np.int64), *timestamps]))


def scene_objects(scene: Scene, times_ns: Int64Array) -> ObjectTable:
    """Give the cuboids of a scene at times (F,) [ns], which become its frames; boxes are in the scene's world.

    A cuboid is there from its first timestamp to its last, a stationary one always.

    Raises:
        OptionError: the scene has no cuboids, or they are not in the world.
    """
    cuboids = _cuboids(scene)
    if not cuboids:
        raise OptionError(f"{scene.source}: no cuboids; expected a scene with objects as boxes in space")
    if annotations_frame(scene) is not Coordinates.WORLD:
        raise not_in_world(scene.source)
    angles = CuboidAngles.of(scene)
    held = [_held_scores(cuboid) for cuboid in cuboids]
    tables = [_rows(cuboid, k, times_ns, angles, held[k]) for k, cuboid in enumerate(cuboids)]
    joined = ObjectTable.joined(tables).in_order()
    return joined if any(score is not None for score in held) else replace(joined, scores=None)


def _cuboids(scene: Scene) -> list[CuboidAnnotation]:
    return [annotation for annotation in scene.annotations if isinstance(annotation, CuboidAnnotation)]


def _rows(
    cuboid: CuboidAnnotation,
    number: int,
    times_ns: Int64Array,
    angles: CuboidAngles,
    held: AttributePath | None,
) -> ObjectTable:
    poses = cuboid_poses(cuboid, times_ns, angles=angles)
    frames = np.flatnonzero(poses.there).astype(np.int64)
    ahead = rotate_vectors(poses.quaternions_xyzw[frames], np.array([1.0, 0.0, 0.0]))
    boxes = (poses.centers_world[frames], poses.sizes_lwh[frames], np.arctan2(ahead[:, 1], ahead[:, 0]))
    return ObjectTable(
        frames,
        np.full(len(frames), number, np.int64),
        (cuboid.label or NO_LABEL,) * len(frames),
        boxes=np.column_stack(boxes).astype(np.float64),
        scores=_scores(held, times_ns[frames]),
    )


def _held_scores(cuboid: CuboidAnnotation) -> AttributePath | None:
    """The attribute that says how sure a cuboid is, if its values are numbers."""
    for name in SCORES:
        for attribute in cuboid.attributes:
            numbers = all(isinstance(value, int | float) for value in attribute.values)
            if attribute.name == name and attribute.values and numbers:
                return attribute
    return None


def _scores(held: AttributePath | None, times_ns: Int64Array) -> Float64Array:
    """How sure a cuboid is at times (M,) [ns]: a value holds until the next; 1 of cuboids that state nothing."""
    if held is None:
        return np.ones(len(times_ns))
    values = np.asarray(held.values, np.float64)
    if not held.is_timed or held.timestamps_ns is None:
        return np.full(len(times_ns), values[0])
    rows = np.searchsorted(held.timestamps_ns, times_ns, side="right") - 1
    return values[np.clip(rows, 0, len(values) - 1)]
