"""Where everything of a drive is in its world, the origin of the view, and poses as Rerun takes them."""

from collections.abc import Iterable
from dataclasses import dataclass, field, replace
from typing import Any

import numpy as np

from sceneloom.arrays import Float64Array, Int64Array
from sceneloom.errors import PoseError
from sceneloom.geometry.rigid import OUT_OF_REACH, RigidTransform
from sceneloom.motion.ego_trajectory import find_ego_motion
from sceneloom.scene.cameras import CameraSensor
from sceneloom.scene.clouds import LidarSensor
from sceneloom.scene.ego import EgoMotion, needs_ego, sensor_source
from sceneloom.scene.motion import OdometrySensor
from sceneloom.scene.poses import Poses, PoseSamples, PoseSource
from sceneloom.scene.scene import Posed, Scene, scene_period_ns
from sceneloom.scene.types import Progress
from sceneloom.view.stream import fits, sdk
from sceneloom.warnings import DataWarning, assumed

_FAR = 2_000.0
_GRID = 100.0


@dataclass(frozen=True, slots=True, eq=False)
class Locations:
    """Where the sensors of a scene are.

    Attributes:
        ego: the trajectory that they are placed by, or None where each has its own.
        path: the ego trajectory to be drawn, or None where none is known.
        origin_world: (3,) float64 [m], what is taken off all locations.
    """

    scene: Scene
    ego: EgoMotion | None
    path: Poses | None
    origin_world: Float64Array
    warnings: tuple[DataWarning, ...] = field(default=())

    @classmethod
    def of(
        cls,
        scene: Scene,
        *,
        trajectory: str | None = None,
        heading: str | None = None,
        progress: Progress | None = None,
    ) -> "Locations":
        """Find where the sensors of a scene are.

        Args:
            trajectory: the ego trajectory by name, computed if it is "gnss" or "lidar"; None: the scene's first one
                that has orientations, else an ego that is stationary.
            heading: "motion" to derive orientations.

        Raises:
            OptionError: there is no such trajectory.
            PoseError: the named one has no orientations, or cannot be found.
        """
        ego, warnings = _ego(scene, trajectory, heading, progress)
        path = _drawn_path(scene, ego)
        return cls(scene, ego, path, _origin(scene, path), warnings)

    def source(self, sensor: Posed) -> tuple[PoseSource, str | None]:
        """What gives `shown_from_sensor` over time, and why it is stationary where nothing else is known."""
        reach_ns = scene_period_ns(self.scene)
        try:
            found = sensor_source(self.scene, sensor, self.ego, reach_ns=reach_ns)
        except PoseError as error:
            mount = RigidTransform.identity() if sensor.mount is None else sensor.mount
            return PoseSource(Poses.identity(), mount), str(error)
        return self.shown(found), None

    def shown(self, source: PoseSource) -> PoseSource:
        """The same way, counted from the shown origin."""
        return replace(source, path=source.path.moved(self.origin_world))


def _ego(
    scene: Scene, trajectory: str | None, heading: str | None, progress: Progress | None
) -> tuple[EgoMotion | None, tuple[DataWarning, ...]]:
    if trajectory is not None or heading is not None:
        found = find_ego_motion(scene, name=trajectory, heading=heading, progress=progress)
        return found, found.warnings
    for estimated_trajectory in scene.trajectories.values():
        if estimated_trajectory.quaternions_xyzw is not None and len(estimated_trajectory.timestamps_ns):
            return EgoMotion.of(estimated_trajectory), ()
    if not needs_ego(scene):
        return None, ()
    message = (
        "no trajectory with orientations: everything is shown as seen from the ego; "
        "`--trajectory lidar` finds its trajectory from the sweeps"
    )
    return EgoMotion("identity", Poses.identity()), (assumed("ego-stands-still", "trajectories", message),)


def _drawn_path(scene: Scene, ego: EgoMotion | None) -> Poses | None:
    """The ego trajectory: the chosen one, an odometry sensor's, or that of the first lidar or camera."""
    if ego is not None:
        return None if ego.path.static else ego.path
    odometries = [sensor.poses for sensor in scene.sensors if isinstance(sensor, OdometrySensor)]
    return next((path for path in (*odometries, *_own_poses(scene)) if len(path.timestamps_ns) > 1), None)


def _origin(scene: Scene, path: Poses | None) -> Float64Array:
    locations = [] if path is None else [path.positions[0]]
    locations += [poses.positions[0] for poses in _own_poses(scene)]
    if not locations or np.abs(locations[0]).max() < _FAR:
        return np.zeros(3)
    origin: Float64Array = np.rint(locations[0] / _GRID) * _GRID
    return origin


def _own_poses(scene: Scene) -> list[Poses]:
    sensors: list[LidarSensor | CameraSensor] = [*scene.lidars, *scene.cameras]
    return [sensor.poses for sensor in sensors if sensor.poses is not None]


def poses_within_reach(source: PoseSource, times_ns: Int64Array) -> tuple[PoseSamples, Int64Array]:
    """Give the poses at times (M,) [ns], and the rows of those that the trajectory reaches and the viewer can hold."""
    poses = source.at(np.asarray(times_ns, np.int64))
    held = fits(poses.positions) & fits(poses.quaternions_xyzw)
    return poses, np.flatnonzero((poses.coverage != OUT_OF_REACH) & held)


def transform(shown_from_sensor: RigidTransform) -> Any:
    """A pose as the transform of an entity."""
    rr = sdk()
    rotation = rr.Quaternion(xyzw=shown_from_sensor.quaternion_xyzw)
    return rr.Transform3D(translation=shown_from_sensor.translation, quaternion=rotation)


def transform_columns(poses: PoseSamples, rows: Int64Array) -> Iterable[Any]:
    """Poses as columns of transforms, (M,) rows of them."""
    columns: Iterable[Any] = sdk().Transform3D.columns(
        translation=poses.positions[rows], quaternion=poses.quaternions_xyzw[rows]
    )
    return columns


def pose_at(source: PoseSource, time_ns: int) -> RigidTransform | None:
    """Give the pose at a time [ns]; None where the trajectory does not reach it, or lies beyond float32."""
    poses, rows = poses_within_reach(source, np.array([time_ns], np.int64))
    if len(rows) == 0:
        return None
    return RigidTransform.from_quaternion(poses.positions[0], poses.quaternions_xyzw[0])
