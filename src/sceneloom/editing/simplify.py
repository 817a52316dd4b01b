"""Paths with fewer keyframes, within a tolerance of interpolation."""

from collections.abc import Callable, Mapping
from dataclasses import dataclass, field, replace
from math import radians
from types import MappingProxyType
from typing import Any

import numpy as np

from sceneloom.arrays import Float64Array, Int64Array
from sceneloom.editing.references import with_warnings
from sceneloom.errors import OptionError
from sceneloom.geometry.rotations import angle_between, slerp
from sceneloom.geometry.thinning import thin_greedily
from sceneloom.scene.annotations import (
    Annotation,
    CuboidAnnotation,
    LocalizationAdjustment,
    PointPath,
    PointsAnnotation,
    locations_of,
)
from sceneloom.scene.annotations_at import CuboidAngles
from sceneloom.scene.ego import Posed
from sceneloom.scene.motion import OdometrySensor
from sceneloom.scene.poses import Poses, Trajectory
from sceneloom.scene.scene import Scene, Sensor
from sceneloom.scene.time_range import select_rows
from sceneloom.warnings import DataWarning, WarningKind

_ROUNDING = 1e-9
"""Tolerances are kept this share smaller, so that another order of the same sums does not break the promise."""

_NEAR_HALF_ROTATION = radians(179.0)
"""Which way is the shorter one is for rounding to state beyond this."""


@dataclass(slots=True)
class Simplified:
    """What was left out, by kind of path: timestamps before and after."""

    counts: dict[str, list[int]] = field(default_factory=dict)

    def add(self, kind: str, before: int, after: int) -> None:
        """Count a path."""
        reported = self.counts.setdefault(kind, [0, 0])
        reported[0] += before
        reported[1] += after


@np.errstate(invalid="ignore", over="ignore")  # files hold numbers that are none
def simplify_scene(
    scene: Scene,
    *,
    tolerance_m: float = 0.01,
    tolerance_deg: float = 0.1,
    cuboids: bool = True,
    keypoints: bool = True,
    poses: bool = True,
) -> Scene:
    """Leave out the timestamps of paths that the others report well enough.

    Interpolating the others gives each one within the tolerances: centre, size and rotation of a cuboid, position of a
    keypoint, position and rotation of a pose. First and last timestamps stay; values that stay are not changed.

    Args:
        scene: the scene.
        tolerance_m: largest distance of locations and largest difference of sizes [m].
        tolerance_deg: largest angle between rotations [deg].
        cuboids: of cuboids.
        keypoints: of points annotations.
        poses: of sensors, trajectories and localisation adjustments.

    Raises:
        OptionError: a tolerance is negative or not a number.
    """
    for name, value in (("tolerance_m", tolerance_m), ("tolerance_deg", tolerance_deg)):
        if not 0.0 <= value < float("inf"):
            raise OptionError(f"{name} {value}; expected a number from 0 on")
    reported = Simplified()
    thinner = _Thinner(
        tolerance_m * (1.0 - _ROUNDING),
        radians(tolerance_deg) * (1.0 - _ROUNDING),
        CuboidAngles.of(scene),
        reported,
    )
    changes: dict[type, Callable[[Any], Any]] = {}
    if cuboids:
        changes[CuboidAnnotation] = thinner.cuboid
    if keypoints:
        changes[PointsAnnotation] = thinner.points
    if poses:
        changes[LocalizationAdjustment] = thinner.adjustment
    simplified = replace(
        scene,
        annotations=tuple(_changed(annotation, changes) for annotation in scene.annotations),
        sensors=tuple(thinner.sensor(sensor) for sensor in scene.sensors) if poses else scene.sensors,
        trajectories=_trajectories(scene, thinner) if poses else scene.trajectories,
    )
    return with_warnings(simplified, [_warning(kind, *counts) for kind, counts in reported.counts.items()])


def _changed(annotation: Annotation, changes: Mapping[type, Callable[[Any], Any]]) -> Annotation:
    change = changes.get(type(annotation))
    return annotation if change is None else change(annotation)


def _trajectories(scene: Scene, thinner: "_Thinner") -> Mapping[str, Trajectory]:
    return MappingProxyType({name: thinner.trajectory(trajectory) for name, trajectory in scene.trajectories.items()})


def _warning(kind: str, before: int, after: int) -> DataWarning:
    message = f"{after} of {before} timestamps of {kind} stay; the others are reported by interpolation"
    return DataWarning(
        kind=WarningKind.SKIPPED,
        code="timestamps-simplified",
        location=kind,
        message=message,
        count=before - after,
    )


@dataclass(frozen=True, slots=True, eq=False)
class _Thinner:
    """Thins paths; distances in tolerances: `tolerance` [m] and `rotation_tolerance` [rad].

    A little smaller than asked.
    """

    tolerance: float
    rotation_tolerance: float
    angles: CuboidAngles
    reported: Simplified

    def rows(
        self,
        kind: str,
        timestamps_ns: Int64Array,
        straight: Float64Array,
        quaternions_xyzw: Float64Array | None = None,
    ) -> Int64Array:
        """Which rows of a path stay; `straight` (N, G, 3) are locations or sizes [m]."""
        count = len(timestamps_ns)
        if count > 2 and not (np.diff(timestamps_ns) > 0).all():
            rows = np.arange(count)
        else:
            rows = thin_greedily(count, lambda a, b: self._misfits(timestamps_ns, straight, quaternions_xyzw, a, b))
        self.reported.add(kind, count, len(rows))
        return rows

    def _misfits(
        self,
        timestamps_ns: Int64Array,
        straight: Float64Array,
        quaternions: Float64Array | None,
        a: int,
        b: int,
    ) -> Float64Array:
        share = (timestamps_ns[a + 1 : b] - timestamps_ns[a]) / (timestamps_ns[b] - timestamps_ns[a])
        between = straight[a] + share[:, None, None] * (straight[b] - straight[a])
        away = np.linalg.norm(between - straight[a + 1 : b], axis=2).max(axis=1)
        misfits = _in_tolerances(away, self.tolerance)
        if quaternions is not None and angle_between(quaternions[a], quaternions[b]) > _NEAR_HALF_ROTATION:
            return np.full(len(misfits), np.inf)
        if quaternions is not None:
            rotations = slerp(quaternions[a], quaternions[b], share)
            apart = angle_between(rotations, quaternions[a + 1 : b])
            misfits = np.maximum(misfits, _in_tolerances(apart, self.rotation_tolerance))
        return misfits

    def cuboid(self, annotation: CuboidAnnotation) -> CuboidAnnotation:
        path = annotation.path
        straight = path.values[:, :6].reshape(-1, 2, 3)
        quaternions = self.angles.quaternions(path.values[:, 6:]) if len(path.values) else np.zeros((0, 4))
        rows = self.rows("cuboids", path.timestamps_ns, straight, quaternions)
        if len(rows) == len(path.timestamps_ns):
            return annotation
        return replace(annotation, path=select_rows(path, rows))

    def points(self, annotation: PointsAnnotation) -> PointsAnnotation:
        return replace(annotation, paths=tuple(self._point(path) for path in annotation.paths))

    def _point(self, path: PointPath) -> PointPath:
        if path.values.shape[1] % 3:
            return path
        rows = self.rows("keypoints", path.timestamps_ns, locations_of(path.values))
        return path if len(rows) == len(path.timestamps_ns) else select_rows(path, rows)

    def poses(self, kind: str, path: Poses) -> Poses:
        rows = self.rows(kind, path.timestamps_ns, path.positions[:, None], path.quaternions_xyzw)
        return path if len(rows) == len(path.timestamps_ns) else select_rows(path, rows)

    def adjustment(self, annotation: LocalizationAdjustment) -> LocalizationAdjustment:
        return replace(annotation, poses=self.poses("adjustments", annotation.poses))

    def sensor(self, sensor: Sensor) -> Sensor:
        if isinstance(sensor, OdometrySensor):
            return replace(sensor, poses=self.poses("sensors", sensor.poses))
        if isinstance(sensor, Posed) and sensor.poses is not None:
            return replace(sensor, poses=self.poses("sensors", sensor.poses))
        return sensor

    def trajectory(self, trajectory: Trajectory) -> Trajectory:
        quaternions = trajectory.quaternions_xyzw
        rows = self.rows("trajectories", trajectory.timestamps_ns, trajectory.positions[:, None], quaternions)
        return trajectory if len(rows) == len(trajectory.timestamps_ns) else select_rows(trajectory, rows)


def _in_tolerances(away: Float64Array, tolerance: float) -> Float64Array:
    if tolerance > 0.0:
        return away / tolerance
    return np.where(away == 0.0, 0.0, np.inf)
