"""Paths with fewer keyframes, within a tolerance of interpolation."""

from collections.abc import Callable
from dataclasses import dataclass, field, replace
from math import radians
from typing import Any

import numpy as np

from sceneloom.arrays import Float64Array, Int64Array
from sceneloom.editing.references import with_warnings
from sceneloom.errors import OptionError
from sceneloom.geometry.rigid import angle_between, slerp
from sceneloom.scene.annotations import (
    CuboidAnnotation,
    LocalizationAdjustment,
    PointPath,
    PointsAnnotation,
    locations_of,
)
from sceneloom.scene.annotations_at import CuboidAngles
from sceneloom.scene.motion import OdometrySensor
from sceneloom.scene.scene import Posed, Scene
from sceneloom.scene.time_range import select_rows
from sceneloom.warnings import skipped

_ROUNDING = 1e-9  # tolerances are kept this share smaller, so that they hold for another order of the same sums
_NEAR_HALF_ROTATION = radians(179.0)  # beyond this, rounding decides which way is the shorter one


@np.errstate(invalid="ignore", over="ignore")  # files contain non-finite numbers
def simplify_scene(
    scene: Scene,
    *,
    tolerance_m: float = 0.01,
    tolerance_deg: float = 0.1,
    cuboids: bool = True,
    keypoints: bool = True,
    poses: bool = True,
) -> Scene:
    """Leave out the timestamps of paths that interpolation of the others gives within the tolerances.

    That is: centre, size and rotation of a cuboid, position of a keypoint, position and rotation of a pose. First and
    last timestamps stay; values that stay are not changed.

    Args:
        scene: the scene.
        tolerance_m: largest distance of positions and largest difference of sizes [m].
        tolerance_deg: largest angle between rotations [deg].
        cuboids: of cuboids.
        keypoints: of points annotations.
        poses: of sensors, trajectories and localization adjustments.

    Raises:
        OptionError: a tolerance is negative or not a number.
    """
    for name, value in (("tolerance_m", tolerance_m), ("tolerance_deg", tolerance_deg)):
        if not 0.0 <= value < float("inf"):
            raise OptionError(f"{name} {value}; expected a number from 0 on")
    smaller = 1.0 - _ROUNDING
    thinner = _Thinner(tolerance_m * smaller, radians(tolerance_deg) * smaller, CuboidAngles.of(scene))

    def annotation(one: Any) -> Any:
        if cuboids and isinstance(one, CuboidAnnotation):
            return replace(one, path=thinner.cuboids(one.path))
        if keypoints and isinstance(one, PointsAnnotation):
            return replace(one, paths=tuple(map(thinner.keypoints, one.paths)))
        if poses and isinstance(one, LocalizationAdjustment):
            return replace(one, poses=thinner.poses("adjustments", one.poses))
        return one

    def sensor(one: Any) -> Any:
        if not poses or not isinstance(one, OdometrySensor | Posed) or one.poses is None:
            return one
        return replace(one, poses=thinner.poses("sensors", one.poses))

    trajectories = {
        name: thinner.poses("trajectories", trajectory) if poses else trajectory
        for name, trajectory in scene.trajectories.items()
    }
    simplified = replace(
        scene,
        annotations=tuple(map(annotation, scene.annotations)),
        sensors=tuple(map(sensor, scene.sensors)),
        trajectories=trajectories,
    )
    what = "{} of {} timestamps of {} stay; the others are given by interpolation"
    return with_warnings(
        simplified,
        [
            skipped("timestamps-simplified", kind, what.format(after, before, kind), count=before - after)
            for kind, (before, after) in thinner.counts.items()
        ],
    )


@dataclass(frozen=True, slots=True, eq=False)
class _Thinner:
    """Thins paths."""

    tolerance: float  # of positions and sizes [m]
    rotation_tolerance: float  # [rad]
    angles: CuboidAngles
    counts: dict[str, list[int]] = field(default_factory=dict)  # timestamps before and after, by kind of path

    def cuboids(self, path: Any) -> Any:
        quaternions = self.angles.quaternions(path.values[:, 6:]) if len(path.values) else np.zeros((0, 4))
        return self._thinned("cuboids", path, path.values[:, :6].reshape(-1, 2, 3), quaternions)

    def keypoints(self, path: PointPath) -> Any:
        return path if path.values.shape[1] % 3 else self._thinned("keypoints", path, locations_of(path.values), None)

    def poses(self, kind: str, path: Any) -> Any:
        return self._thinned(kind, path, path.positions[:, None], path.quaternions_xyzw)

    def _thinned(self, kind: str, path: Any, straight: Float64Array, quaternions: Float64Array | None) -> Any:
        """Thin a path of positions or sizes (N, G, 3) [m] and, where it has some, of rotations (N, 4)."""
        times_ns, count = path.timestamps_ns, len(path.timestamps_ns)
        rows = np.arange(count)
        if count <= 2 or (np.diff(times_ns) > 0).all():
            rows = _thin_greedily(count, lambda a, b: self._misfits(times_ns, straight, quaternions, a, b))
        counts = self.counts.setdefault(kind, [0, 0])
        counts[0] += count
        counts[1] += len(rows)
        return path if len(rows) == count else select_rows(path, rows)

    def _misfits(
        self, times_ns: Int64Array, straight: Float64Array, quaternions: Float64Array | None, a: int, b: int
    ) -> Float64Array:
        """How many tolerances the rows between two are away from what interpolation between these gives."""
        share = (times_ns[a + 1 : b] - times_ns[a]) / (times_ns[b] - times_ns[a])
        between = straight[a] + share[:, None, None] * (straight[b] - straight[a])
        away = np.linalg.norm(between - straight[a + 1 : b], axis=2).max(axis=1)
        misfits = _in_tolerances(away, self.tolerance)
        if quaternions is None:
            return misfits
        if angle_between(quaternions[a], quaternions[b]) > _NEAR_HALF_ROTATION:
            return np.full(len(misfits), np.inf)
        apart = angle_between(slerp(quaternions[a], quaternions[b], share), quaternions[a + 1 : b])
        return np.maximum(misfits, _in_tolerances(apart, self.rotation_tolerance))


def _in_tolerances(away: Float64Array, tolerance: float) -> Float64Array:
    return away / tolerance if tolerance > 0.0 else np.where(away == 0.0, 0.0, np.inf)


def _thin_greedily(count: int, misfits: Callable[[int, int], Float64Array]) -> Int64Array:
    """Choose the points of a curve that stay, (K,) rising: from each the farthest with all between well enough given.

    `misfits(start, stop)` gives what would be lost by leaving out all between two, up to 1.0 is allowed, NaN is not.
    The reach is doubled while it fits and then halved down to the last point that does, so that a long curve that needs
    few points is not looked at point by point. What fits is tested, never inferred.
    """
    kept, start = [0] if count else [], 0

    def fits(stop: int) -> bool:
        return stop - start < 2 or bool((misfits(start, stop) <= 1.0).all())

    while start < count - 1:
        reach = 16
        good, bad = start + 1, count
        while good < count - 1:
            further = min(start + reach, count - 1)
            if not fits(further):
                bad = further
                break
            good, reach = further, 2 * reach
        while bad - good > 1 and good < count - 1:
            middle = (good + bad) // 2
            good, bad = (middle, bad) if fits(middle) else (good, middle)
        kept.append(good)
        start = good
    return np.array(kept, np.int64)
