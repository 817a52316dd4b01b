"""The boxes of a scene at a moment."""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from functools import cached_property

import numpy as np

from sceneloom.arrays import BoolArray, Float64Array, Int64Array, hold_array
from sceneloom.geometry.boxes import box_corners
from sceneloom.geometry.rotations import matrix_from_quaternion
from sceneloom.scene.angles import CuboidAngles
from sceneloom.scene.annotations.cuboids import CuboidAnnotation
from sceneloom.scene.annotations_frame import annotations_frame, not_in_world
from sceneloom.scene.at import CuboidPoses, activated, active_at, cuboid_poses, rotated
from sceneloom.scene.scene import Scene
from sceneloom.scene.types import Coordinates, Identifier, Key, key_of


@dataclass(frozen=True, slots=True, eq=False)
class Boxes:
    """The objects that are there at a moment, one row each.

    Attributes:
        ids: ids of their annotations.
        labels: their classes, None where not stated.
        centers_world: (B, 3) float64 [m].
        sizes_lwh: (B, 3) float64 [m], length, width, height.
        quaternions_xyzw: (B, 4) float64, `world_from_box`.
        numbers: (B,) int64, of the annotations among the scene's cuboids: one object has the same in all samples.
    """

    ids: tuple[Identifier, ...]
    labels: tuple[str | None, ...]
    centers_world: Float64Array
    sizes_lwh: Float64Array
    quaternions_xyzw: Float64Array
    numbers: Int64Array | None = None

    def __post_init__(self) -> None:
        count = len(self.ids)
        hold_array(self, "boxes.numbers", (count,), np.int64, optional=True)
        hold_array(self, "boxes.centers_world", (count, 3), np.float64)
        hold_array(self, "boxes.sizes_lwh", (count, 3), np.float64)
        hold_array(self, "boxes.quaternions_xyzw", (count, 4), np.float64)

    def __len__(self) -> int:
        return len(self.ids)

    @property
    def rotations_world(self) -> Float64Array:
        """(B, 3, 3) float64 `world_from_box`: the columns are the boxes' forward, left and up."""
        return matrix_from_quaternion(self.quaternions_xyzw)

    @property
    def corners_world(self) -> Float64Array:
        """(B, 8, 3) float64 [m], in the order of `geometry.boxes.CORNER_SIGNS`."""
        return box_corners(self.centers_world, self.sizes_lwh, self.quaternions_xyzw)

    @property
    def yaws_world(self) -> Float64Array:
        """(B,) float64 [rad], direction of the boxes' forward axis, counter-clockwise from the world's x."""
        forward = self.rotations_world[:, :, 0]
        yaws: Float64Array = np.arctan2(forward[:, 1], forward[:, 0])
        return yaws


class BoxTable:
    """All boxes of a scene with their trajectories, to be asked for a moment.

    Attributes:
        annotations: the cuboids of the scene that have a path, in order.
        angles: how their angles are meant.
    """

    def __init__(self, scene: Scene) -> None:
        """Collect the boxes; unit and order of their angles are those that the scene's metadata name."""
        found = [
            a for a in scene.annotations if isinstance(a, CuboidAnnotation) and len(a.path.timestamps_ns)
        ]
        self.annotations = tuple(found)
        self._in_world = annotations_frame(scene) is Coordinates.WORLD
        self._source = scene.source
        self.angles = CuboidAngles.of(scene)

    @cached_property
    def _paths(self) -> tuple[Int64Array, Float64Array, Int64Array, Int64Array]:
        """Timestamps and rows of all paths one after the other, and where each path begins and ends."""
        if not self._in_world:
            raise not_in_world(self._source)
        paths = [annotation.path for annotation in self.annotations]
        lengths = np.array([len(path.timestamps_ns) for path in paths], np.int64)
        stops = np.cumsum(lengths)
        timestamps = np.concatenate([path.timestamps_ns for path in paths])
        return timestamps, np.concatenate([path.values for path in paths]), stops - lengths, stops

    def at(
        self, time_ns: int, *, sensor_id: Identifier | None = None, window_ns: tuple[int, int] | None = None
    ) -> Boxes:
        """Give the boxes that are there at a time [ns], as `find` does."""
        return self.find(time_ns, sensor_id=sensor_id, window_ns=window_ns)[1]

    def find(
        self, time_ns: int, *, sensor_id: Identifier | None = None, window_ns: tuple[int, int] | None = None
    ) -> tuple[Int64Array, Boxes]:
        """Give the boxes that are there at a time [ns], and whose they are: rows (B,) of `annotations`.

        A box is there from its first timestamp to its last, a stationary one always. Between two timestamps centre and
        size go straight and the rotation rotates the shorter arc. As a sensor sees them, boxes are there while they are
        active for it, by its own computed cuboids (`scene.at.cuboid_poses`).

        Args:
            time_ns: when.
            sensor_id: the sensor by which is asked; None for the objects themselves.
            window_ns: first and last time of the sensor's frame: boxes count that are active at any time of it.

        Raises:
            OptionError: unit or order of the angles is none of those known, or the annotations are not in the world.

        Source: READING of "paths" in docs/CONVENTIONS.md.
        """
        there = self._there(time_ns)
        for row, annotation in self._activated(sensor_id):
            first, last = (time_ns, time_ns) if window_ns is None else sorted(window_ns)
            if active_at(annotation, sensor_id, [last], since_ns=[first])[0]:
                there[row] = self._seen(annotation, sensor_id, time_ns).there[0]
            else:
                there[row] = False
        rows = np.flatnonzero(there)
        return rows, self.placed(rows, time_ns, sensor_id=sensor_id)

    def _activated(self, sensor_id: Identifier | None) -> Sequence[tuple[int, CuboidAnnotation]]:
        """The cuboids of whose activations some are for a sensor, by row."""
        return () if sensor_id is None else self._by_sensor.get(key_of(sensor_id), ())

    def _seen(self, annotation: CuboidAnnotation, sensor_id: Identifier | None, time_ns: int) -> CuboidPoses:
        """A cuboid with the own cuboids of activations, whether it is active or not."""
        path = cuboid_poses(annotation, [time_ns], angles=self.angles)
        return activated(annotation, sensor_id, np.array([time_ns], np.int64), path, angles=self.angles)

    @cached_property
    def _by_sensor(self) -> Mapping[Key, Sequence[tuple[int, CuboidAnnotation]]]:
        found: dict[Key, list[tuple[int, CuboidAnnotation]]] = {}
        for row, annotation in enumerate(self.annotations):
            for key in dict.fromkeys(key_of(activation.sensor_id) for activation in annotation.activations):
                found.setdefault(key, []).append((row, annotation))
        return found

    def placed(self, rows: Int64Array, time_ns: int, *, sensor_id: Identifier | None = None) -> Boxes:
        """Give some boxes at a time [ns], by rows of `annotations`; each holds beyond its first and last timestamp.

        Args:
            rows: which.
            time_ns: when.
            sensor_id: the sensor whose own computed cuboids count.

        Raises:
            OptionError: unit or order of the angles is none of those known.
        """
        boxes = self._placed(rows, time_ns)
        computed = [
            (k, annotation)
            for row, annotation in self._activated(sensor_id)
            for k in np.flatnonzero(rows == row).tolist()
        ]
        if not computed:
            return boxes
        parts = [part.copy() for part in (boxes.centers_world, boxes.sizes_lwh, boxes.quaternions_xyzw)]
        for k, annotation in computed:
            seen = self._seen(annotation, sensor_id, time_ns)
            if not seen.there[0]:
                continue  # it holds beyond the ends of its path
            for part, own in zip(
                parts, (seen.centers_world, seen.sizes_lwh, seen.quaternions_xyzw), strict=True
            ):
                part[k] = own[0]
        return replace(boxes, centers_world=parts[0], sizes_lwh=parts[1], quaternions_xyzw=parts[2])

    @np.errstate(invalid="ignore", over="ignore")  # files hold numbers that are none
    def _placed(self, rows: Int64Array, time_ns: int) -> Boxes:
        """The same by their paths."""
        if len(rows) == 0:
            nowhere = np.zeros((0, 3))
            return Boxes((), (), nowhere, nowhere, np.zeros((0, 4)), np.zeros(0, np.int64))
        timestamps, values, starts, stops = self._paths
        passed = np.add.reduceat((timestamps <= time_ns).astype(np.int64), starts)[rows]
        last = stops[rows] - 1
        before = np.clip(starts[rows] + passed - 1, starts[rows], last)
        after = np.minimum(before + 1, last)
        span = np.maximum(timestamps[after] - timestamps[before], 1)
        share = np.clip((time_ns - timestamps[before]) / span, 0.0, 1.0)
        blended = values[before, :6] + share[:, None] * (values[after, :6] - values[before, :6])
        chosen = [self.annotations[k] for k in rows.tolist()]
        return Boxes(
            tuple(annotation.id for annotation in chosen),
            tuple(annotation.label for annotation in chosen),
            np.ascontiguousarray(blended[:, 3:]),
            np.ascontiguousarray(blended[:, :3]),
            rotated(self.angles, values[before, 6:], values[after, 6:], share),
            np.asarray(rows, np.int64),
        )

    def _there(self, time_ns: int) -> BoolArray:
        if not self.annotations:
            return np.zeros(0, np.bool_)
        timestamps, _, starts, stops = self._paths
        covered: BoolArray = (timestamps[starts] <= time_ns) & (time_ns <= timestamps[stops - 1])
        return covered | self._stationary

    @cached_property
    def _stationary(self) -> BoolArray:
        return np.array([bool(annotation.stationary) for annotation in self.annotations], np.bool_)
