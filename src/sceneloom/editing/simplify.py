"""Paths with fewer stamps: between those that stay, interpolation gives the others within a tolerance."""

from collections.abc import Callable, Mapping
from dataclasses import dataclass, field, replace
from math import radians
from types import MappingProxyType
from typing import Any

import numpy as np

from sceneloom.arrays import Float64Array, Int64Array
from sceneloom.editing.record import with_notices
from sceneloom.errors import OptionError
from sceneloom.geometry.rotations import angle_between, slerp
from sceneloom.geometry.thinning import thin_greedily
from sceneloom.scene.angles import CuboidAngles
from sceneloom.scene.annotations.annotation import Annotation
from sceneloom.scene.annotations.corrections import LocalizationAdjustment
from sceneloom.scene.annotations.cuboids import CuboidAnnotation, CuboidPath
from sceneloom.scene.annotations.keypoints import PointPath, PointsAnnotation, places_of
from sceneloom.scene.motion import OdometrySensor
from sceneloom.scene.notices import Notice, NoticeKind
from sceneloom.scene.poses import PosePath, Trajectory
from sceneloom.scene.scene import Scene, Sensor
from sceneloom.scene.sensor_sources import Posed

ROUNDING = 1e-9
"""Tolerances are kept this share smaller, so that another order of the same sums does not break the promise."""

_NEAR_HALF_TURN = radians(179.0)
"""Which way is the shorter one is for rounding to say beyond this."""


@dataclass(slots=True)
class Simplified:
    """What was left out, by kind of path: stamps before and after."""

    counts: dict[str, list[int]] = field(default_factory=dict)

    def add(self, kind: str, before: int, after: int) -> None:
        """Count a path."""
        told = self.counts.setdefault(kind, [0, 0])
        told[0] += before
        told[1] += after


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
    """Leave out the stamps of paths that the others tell well enough.

    Interpolating what stays gives every stamp that was left out within the tolerances: of a cuboid centre, size and
    turn, of a keypoint its place, of a pose place and turn. First and last stamps stay, values that stay are not
    changed.

    Args:
        scene: the scene.
        tolerance_m: largest distance of places and largest difference of sizes [m].
        tolerance_deg: largest angle between turns [deg].
        cuboids: of cuboids.
        keypoints: of points annotations.
        poses: of sensors, trajectories and localisation adjustments.

    Raises:
        OptionError: a tolerance is negative or not a number.
    """
    for name, value in (("tolerance_m", tolerance_m), ("tolerance_deg", tolerance_deg)):
        if not 0.0 <= value < float("inf"):
            raise OptionError(f"{name} {value}; expected a number from 0 on")
    told = Simplified()
    thinner = _Thinner(
        tolerance_m * (1.0 - ROUNDING),
        radians(tolerance_deg) * (1.0 - ROUNDING),
        CuboidAngles.of(scene),
        told,
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
    return with_notices(simplified, [_notice(kind, *counts) for kind, counts in told.counts.items()])


def _changed(annotation: Annotation, changes: Mapping[type, Callable[[Any], Any]]) -> Annotation:
    change = changes.get(type(annotation))
    return annotation if change is None else change(annotation)


def _trajectories(scene: Scene, thinner: "_Thinner") -> Mapping[str, Trajectory]:
    return MappingProxyType({name: thinner.trajectory(way) for name, way in scene.trajectories.items()})


def _notice(kind: str, before: int, after: int) -> Notice:
    message = f"{after} of {before} stamps of {kind} stay; the others are told by interpolation"
    return Notice(
        kind=NoticeKind.SKIPPED, code="stamps-simplified", place=kind, message=message, count=before - after
    )


@dataclass(frozen=True, slots=True, eq=False)
class _Thinner:
    """Thins paths; distances in tolerances: `tolerance` [m] and `turn_tolerance` [rad], a little smaller than asked."""

    tolerance: float
    turn_tolerance: float
    angles: CuboidAngles
    told: Simplified

    def rows(
        self,
        kind: str,
        stamps_ns: Int64Array,
        straight: Float64Array,
        quaternions_xyzw: Float64Array | None = None,
    ) -> Int64Array:
        """Which rows of a path stay; `straight` (N, G, 3) are places or sizes [m]."""
        count = len(stamps_ns)
        if count > 2 and not (np.diff(stamps_ns) > 0).all():
            rows = np.arange(count)
        else:
            rows = thin_greedily(
                count, lambda a, b: self._misfits(stamps_ns, straight, quaternions_xyzw, a, b)
            )
        self.told.add(kind, count, len(rows))
        return rows

    def _misfits(
        self, stamps_ns: Int64Array, straight: Float64Array, quaternions: Float64Array | None, a: int, b: int
    ) -> Float64Array:
        share = (stamps_ns[a + 1 : b] - stamps_ns[a]) / (stamps_ns[b] - stamps_ns[a])
        between = straight[a] + share[:, None, None] * (straight[b] - straight[a])
        away = np.linalg.norm(between - straight[a + 1 : b], axis=2).max(axis=1)
        misfits = _in_tolerances(away, self.tolerance)
        if quaternions is not None and angle_between(quaternions[a], quaternions[b]) > _NEAR_HALF_TURN:
            return np.full(len(misfits), np.inf)
        if quaternions is not None:
            turns = slerp(quaternions[a], quaternions[b], share)
            apart = angle_between(turns, quaternions[a + 1 : b])
            misfits = np.maximum(misfits, _in_tolerances(apart, self.turn_tolerance))
        return misfits

    def cuboid(self, annotation: CuboidAnnotation) -> CuboidAnnotation:
        path = annotation.path
        straight = path.values[:, :6].reshape(-1, 2, 3)
        quaternions = self.angles.quaternions(path.values[:, 6:]) if len(path.values) else np.zeros((0, 4))
        rows = self.rows("cuboids", path.timestamps_ns, straight, quaternions)
        if len(rows) == len(path.timestamps_ns):
            return annotation
        return replace(annotation, path=CuboidPath(path.timestamps_ns[rows], path.values[rows], path.extras))

    def points(self, annotation: PointsAnnotation) -> PointsAnnotation:
        return replace(annotation, paths=tuple(self._point(path) for path in annotation.paths))

    def _point(self, path: PointPath) -> PointPath:
        if path.values.shape[1] % 3:
            return path
        rows = self.rows("keypoints", path.timestamps_ns, places_of(path.values))
        if len(rows) == len(path.timestamps_ns):
            return path
        return replace(path, timestamps_ns=path.timestamps_ns[rows], values=path.values[rows])

    def poses(self, kind: str, path: PosePath) -> PosePath:
        rows = self.rows(kind, path.timestamps_ns, path.positions[:, None], path.quaternions_xyzw)
        if len(rows) == len(path.timestamps_ns):
            return path
        return PosePath(path.timestamps_ns[rows], path.positions[rows], path.quaternions_xyzw[rows])

    def adjustment(self, annotation: LocalizationAdjustment) -> LocalizationAdjustment:
        return replace(annotation, poses=self.poses("adjustments", annotation.poses))

    def sensor(self, sensor: Sensor) -> Sensor:
        if isinstance(sensor, OdometrySensor):
            return replace(sensor, poses=self.poses("sensors", sensor.poses))
        if isinstance(sensor, Posed) and sensor.poses is not None:
            return replace(sensor, poses=self.poses("sensors", sensor.poses))
        return sensor

    def trajectory(self, way: Trajectory) -> Trajectory:
        quaternions = way.quaternions_xyzw
        rows = self.rows("trajectories", way.timestamps_ns, way.positions[:, None], quaternions)
        if len(rows) == len(way.timestamps_ns):
            return way
        return replace(
            way,
            timestamps_ns=way.timestamps_ns[rows],
            positions=way.positions[rows],
            quaternions_xyzw=None if quaternions is None else quaternions[rows],
            file_seconds=None if way.file_seconds is None else way.file_seconds[rows],
            covariances=None if way.covariances is None else way.covariances[rows],
        )


def _in_tolerances(away: Float64Array, tolerance: float) -> Float64Array:
    if tolerance > 0.0:
        return away / tolerance
    return np.where(away == 0.0, 0.0, np.inf)
