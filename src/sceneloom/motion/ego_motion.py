"""The way of the ego that a scene is placed by: recorded, or found from what the lidar saw."""

from dataclasses import replace

from sceneloom.errors import PoseError
from sceneloom.geometry.rigid import RigidTransform
from sceneloom.motion.trajectories import IMU, LIDAR, choose_trajectory
from sceneloom.scene import LidarSensor, Notice, NoticeKind, PointsFrame, Scene, Trajectory
from sceneloom.scene.ego import EgoMotion
from sceneloom.scene.types import Progress


def find_ego_motion(
    scene: Scene,
    *,
    name: str | None = None,
    heading: str | None = None,
    progress: Progress | None = None,
    lenient: bool = False,
) -> EgoMotion:
    """Take a recorded way of the ego, or find it from the lidar's sweeps.

    Args:
        name: a name out of `scene.trajectories`; "identity" for an ego that stands still; "lidar" to find the way from
            the sweeps; None for the scene's default trajectory, and for "lidar" where it has none.
        heading: "motion" to derive orientations from positions where a trajectory has none.
        progress: told after each sweep, where the way is found from the sweeps.
        lenient: pass over sweeps that cannot be read.

    Raises:
        OptionError: the name or the heading is unknown.
        PoseError: the scene has neither a trajectory nor a lidar to find one from, or the trajectory has no
            orientations, or the way cannot be found from what is named.
        DataError: a sweep cannot be read.
    """
    if name == IMU and name not in scene.trajectories:
        raise PoseError(
            f"{scene.source}: an IMU alone tells how the ego turned, but not where it was; it serves "
            "`sceneloom edit deskew --trajectory imu` only"
        )
    if is_computed(scene, name):
        return _from_lidar(scene, by_default=name is None, progress=progress, lenient=lenient)
    return choose_trajectory(scene, name=name, heading=heading)


def is_computed(scene: Scene, name: str | None) -> bool:
    """Whether the way of that name is found from the lidar's sweeps, rather than recorded in the scene."""
    if name is None:
        return not scene.trajectories and bool(placeable_lidars(scene))
    return name == LIDAR and name not in scene.trajectories


def with_way_found(scene: Scene, ego: EgoMotion) -> Scene:
    """The scene with the way that was found in it as its default trajectory, and with what is to be said of it."""
    path = ego.path
    way = Trajectory(
        ego.name, path.timestamps_ns, path.positions, path.quaternions_xyzw, covariances=ego.covariances
    )
    others = {name: other for name, other in scene.trajectories.items() if name != ego.name}
    return replace(scene, trajectories={ego.name: way, **others}, notices=(*scene.notices, *ego.notices))


def placeable_lidars(scene: Scene) -> tuple[LidarSensor, ...]:
    """The lidars whose points are not in the world yet, so that they tell how the ego moved."""
    return tuple(
        lidar
        for lidar in scene.lidars
        if lidar.points_frame is not PointsFrame.WORLD and len(lidar.frames) > 0
    )


def _from_lidar(scene: Scene, *, by_default: bool, progress: Progress | None, lenient: bool) -> EgoMotion:
    from sceneloom.motion.odometry import lidar_odometry

    run = lidar_odometry(scene, progress=progress, lenient=lenient)
    notices = (_assumed(scene), *run.notices) if by_default else tuple(run.notices)
    return _in_known_world(replace(EgoMotion.of(run.trajectory), notices=notices), scene)


def _in_known_world(ego: EgoMotion, scene: Scene) -> EgoMotion:
    """Begin where a recorded trajectory says that the ego was then, so that what stands in its world stays right."""
    first_ns = ego.path.timestamps_ns[:1]
    for way in scene.trajectories.values():
        if way.quaternions_xyzw is None:
            continue
        known = way.poses.interpolate(first_ns)
        if known.coverage[0] == 0:
            return ego.seen_from(
                RigidTransform.from_quaternion(known.positions[0], known.quaternions_xyzw[0])
            )
    return ego


def _assumed(scene: Scene) -> Notice:
    message = (
        "no trajectory in it; the way of the ego was found from the lidar's sweeps (`--trajectory lidar`)"
    )
    return Notice(kind=NoticeKind.ASSUMED, code="trajectory-from-lidar", place=scene.source, message=message)
