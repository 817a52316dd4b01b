"""Where everything of a drive is in its world, and the origin that the viewer counts from.

The viewer computes with 32 bits a number: a world whose origin is far away (as of map coordinates) would be shown in
steps of decimetres. So all places are shown relative to one near the drive, in whole hundreds of metres.
"""

from dataclasses import dataclass, field, replace

import numpy as np

from sceneloom.arrays import Float64Array, Int64Array
from sceneloom.errors import PoseError
from sceneloom.geometry.interpolation import OUT_OF_REACH
from sceneloom.geometry.rigid import RigidTransform
from sceneloom.motion.ego_motion import find_ego_motion
from sceneloom.scene.cameras import CameraSensor
from sceneloom.scene.clouds import LidarSensor
from sceneloom.scene.ego import EgoMotion
from sceneloom.scene.motion import OdometrySensor
from sceneloom.scene.notices import Notice, NoticeKind
from sceneloom.scene.pose_source import PoseSource
from sceneloom.scene.poses import PosePath, PoseSamples
from sceneloom.scene.scene import Scene
from sceneloom.scene.sensor_sources import Posed, needs_ego, sensor_source
from sceneloom.scene.span import scene_period_ns
from sceneloom.scene.types import Progress
from sceneloom.view.stream import fits

_FAR = 2_000.0
_GRID = 100.0


@dataclass(frozen=True, slots=True, eq=False)
class Places:
    """Where the sensors of a scene are.

    Attributes:
        scene: whose sensors they are.
        ego: the way that they are placed by, or None where each has its own.
        path: the way of the ego to be drawn, or None where none is known.
        origin_world: (3,) float64 [m], what is taken off all places.
        notices: what was assumed.
    """

    scene: Scene
    ego: EgoMotion | None
    path: PosePath | None
    origin_world: Float64Array
    notices: tuple[Notice, ...] = field(default=())

    def source(self, sensor: Posed) -> tuple[PoseSource, str | None]:
        """What gives `shown_from_sensor` over time, and why it stands still where nothing else is known."""
        reach_ns = scene_period_ns(self.scene)
        try:
            found = sensor_source(self.scene, sensor, self.ego, reach_ns=reach_ns)
        except PoseError as error:
            mount = RigidTransform.identity() if sensor.mount is None else sensor.mount
            return PoseSource(PosePath.identity(), mount), str(error)
        return self.shown(found), None

    def shown(self, source: PoseSource) -> PoseSource:
        """The same way, counted from the shown origin."""
        return replace(source, path=source.path.moved(self.origin_world))


def find_places(
    scene: Scene,
    *,
    trajectory: str | None = None,
    heading: str | None = None,
    progress: Progress | None = None,
) -> Places:
    """Find where the sensors of a scene are.

    Args:
        trajectory: the way of the ego by name, computed if it is "gnss" or "lidar"; None: the scene's first one that
            has orientations, else an ego that stands still.
        heading: "motion" to derive orientations.
        progress: told while a way is computed.

    Raises:
        OptionError: there is no such trajectory.
        PoseError: the named one has no orientations, or cannot be found.
    """
    ego, notices = _ego(scene, trajectory, heading, progress)
    path = _drawn_path(scene, ego)
    return Places(scene, ego, path, _origin(scene, path), notices)


def _ego(
    scene: Scene, trajectory: str | None, heading: str | None, progress: Progress | None
) -> tuple[EgoMotion | None, tuple[Notice, ...]]:
    if trajectory is not None or heading is not None:
        found = find_ego_motion(scene, name=trajectory, heading=heading, progress=progress)
        return found, found.notices
    for way in scene.trajectories.values():
        if way.quaternions_xyzw is not None and len(way.timestamps_ns):
            return EgoMotion.of(way), ()
    if not needs_ego(scene):
        return None, ()
    told = Notice(
        kind=NoticeKind.ASSUMED,
        code="ego-stands-still",
        place="trajectories",
        message="no trajectory with orientations: everything is shown as seen from the ego; "
        "`--trajectory lidar` finds its way from the sweeps",
    )
    return EgoMotion("identity", PosePath.identity()), (told,)


def _drawn_path(scene: Scene, ego: EgoMotion | None) -> PosePath | None:
    """The ego's way: the chosen one, an odometry sensor's, or that of the first lidar or camera."""
    if ego is not None:
        return None if ego.path.endless else ego.path
    odometries = [sensor.poses for sensor in scene.sensors if isinstance(sensor, OdometrySensor)]
    return next((path for path in (*odometries, *_own_poses(scene)) if len(path.timestamps_ns) > 1), None)


def _origin(scene: Scene, path: PosePath | None) -> Float64Array:
    places = [] if path is None else [path.positions[0]]
    places += [poses.positions[0] for poses in _own_poses(scene)]
    if not places or np.abs(places[0]).max() < _FAR:
        return np.zeros(3)
    origin: Float64Array = np.rint(places[0] / _GRID) * _GRID
    return origin


def _own_poses(scene: Scene) -> list[PosePath]:
    sensors: list[LidarSensor | CameraSensor] = [*scene.lidars, *scene.cameras]
    return [sensor.poses for sensor in sensors if sensor.poses is not None]


def poses_within_reach(source: PoseSource, times_ns: Int64Array) -> tuple[PoseSamples, Int64Array]:
    """Give the poses at times (M,) [ns], and the rows of those that the way reaches and the viewer can hold."""
    poses = source.at(np.asarray(times_ns, np.int64))
    held = fits(poses.positions) & fits(poses.quaternions_xyzw)
    return poses, np.flatnonzero((poses.coverage != OUT_OF_REACH) & held)
