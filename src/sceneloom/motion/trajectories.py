"""Which ego trajectory a scene is fused by."""

from sceneloom.errors import OptionError, PoseError
from sceneloom.motion.heading import headed_poses
from sceneloom.scene.ego import EgoMotion
from sceneloom.scene.motion import GnssSensor
from sceneloom.scene.poses import Poses, Trajectory
from sceneloom.scene.scene import Scene

IDENTITY = "identity"
GNSS = "gnss"
LIDAR = "lidar"
IMU = "imu"
RESERVED = (GNSS, LIDAR, IMU)


def choose_trajectory(scene: Scene, *, name: str | None = None, heading: str | None = None) -> EgoMotion:
    """Take the trajectory of that name, or the scene's default one.

    Args:
        name: a name out of `scene.trajectories`, "identity" for an ego that is stationary, None for the default.
        heading: "motion" to derive orientations from positions where a trajectory has none.

    Raises:
        OptionError: the name or the heading is unknown.
        PoseError: the scene has no trajectory, or one without orientations.
    """
    if heading not in {None, "motion"}:
        raise OptionError(f"heading {heading!r}; expected 'motion'")
    if name == IDENTITY:
        return EgoMotion(IDENTITY, Poses.identity())
    if name in RESERVED and name not in scene.trajectories:
        raise PoseError(
            f"{scene.source}: nothing in it reports the trajectory by {name!r}; choose one of: {_choices(scene)}"
        )
    if name is None and not scene.trajectories and not scene.lidars:
        raise PoseError(
            f"{scene.source}: no trajectory in it, and no lidar to find one from; "
            "state `--trajectory identity` for an ego that was stationary"
        )
    if name is None and not scene.trajectories:
        raise PoseError(
            f"{scene.source}: no trajectory in it, so where the ego was at each time is unknown; "
            "state `--trajectory identity` for an ego that was stationary"
        )
    chosen = next(iter(scene.trajectories)) if name is None else name
    if chosen not in scene.trajectories:
        raise OptionError(f"{scene.source}: no trajectory {chosen!r}; there are: {_choices(scene)}")
    return _ego_motion(scene.trajectories[chosen], heading)


def _ego_motion(trajectory: Trajectory, heading: str | None) -> EgoMotion:
    if trajectory.quaternions_xyzw is None and heading == "motion":
        return EgoMotion(trajectory.name, headed_poses(trajectory), heading)
    return EgoMotion.of(trajectory)


def _choices(scene: Scene) -> str:
    has_fixes = any(isinstance(sensor, GnssSensor) for sensor in scene.sensors)
    computed = {GNSS: has_fixes, LIDAR: bool(scene.lidars)}
    found = [name for name, is_there in computed.items() if is_there and name not in scene.trajectories]
    return ", ".join([*scene.trajectories, *found, IDENTITY])
