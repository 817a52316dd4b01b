"""The ego trajectory that positions a scene: recorded, from GNSS/IMU smoothing or lidar odometry, or stationary."""

from collections.abc import Mapping
from dataclasses import replace

import numpy as np

from sceneloom.arrays import BoolArray, Float64Array, Int64Array
from sceneloom.errors import OptionError, PoseError
from sceneloom.geometry.rigid import RigidTransform
from sceneloom.scene.annotations_at import annotations_frame
from sceneloom.scene.clouds import LidarSensor
from sceneloom.scene.ego import EgoMotion, ego_path
from sceneloom.scene.motion import GnssSensor
from sceneloom.scene.poses import Poses, Trajectory
from sceneloom.scene.scene import Scene
from sceneloom.scene.types import Coordinates, PointsFrame, Progress
from sceneloom.warnings import DataWarning, assumed, skipped

IDENTITY, GNSS, LIDAR, IMU = "identity", "gnss", "lidar", "imu"
RESERVED = (GNSS, LIDAR, IMU)
_HIGHEST = 1e6  # larger heights are invalid [m]; NaN stands for one that is not reported
_CHORD = 0.5  # length [m] of the chord that gives a direction: well above the noise of a smoothed position


def gnss_receivers(scene: Scene) -> tuple[GnssSensor, ...]:
    """The receivers of a scene that have at least two usable fixes."""
    return tuple(s for s in scene.sensors if isinstance(s, GnssSensor) and usable_fixes(s).sum() >= 2)


def usable_fixes(receiver: GnssSensor) -> BoolArray:
    """(N,) whether each fix is a valid position; a receiver without reception reports 0, 0."""
    latitude, longitude, height = receiver.positions_lla.T
    usable: BoolArray = (np.abs(latitude) <= 90.0) & (np.abs(longitude) <= 360.0)
    usable &= (latitude != 0.0) | (longitude != 0.0)
    usable &= np.isnan(height) | (np.abs(height) <= _HIGHEST)
    return usable


def usable_positions(receiver: GnssSensor) -> tuple[Int64Array, Float64Array]:
    """The rows (M,) of usable fixes, and their positions (M, 3): latitude, longitude [deg] and height [m].

    A height that is not reported is the median of those that are, 0 where none is.
    """
    rows = np.flatnonzero(usable_fixes(receiver))
    positions = receiver.positions_lla[rows]
    unknown = np.isnan(positions[:, 2])
    positions[unknown, 2] = 0.0 if unknown.all() else np.median(positions[~unknown, 2])
    return rows, positions


def headed_poses(trajectory: Trajectory) -> Poses:
    """Give each position the yaw and pitch of the trajectory around it, without roll.

    The direction is the chord from the last position at least `_CHORD` behind to the first at least that far ahead;
    a stationary ego keeps its last direction.

    Raises:
        PoseError: the ego never moves `_CHORD`.
    """
    positions = trajectory.positions
    travelled = np.append(0.0, np.cumsum(np.linalg.norm(np.diff(positions, axis=0), axis=1)))
    if travelled[-1] < _CHORD:
        raise PoseError(
            f"trajectory {trajectory.name!r} moves {travelled[-1]:.2f} m in all; a heading needs at least {_CHORD} m; "
            "choose another with `--trajectory NAME`"
        )
    behind = np.maximum(np.searchsorted(travelled, travelled - _CHORD, side="right") - 1, 0)
    ahead = np.minimum(np.searchsorted(travelled, travelled + _CHORD, side="left"), len(travelled) - 1)
    x, y, z = (positions[ahead] - positions[behind]).T
    # x axis along the direction, y axis level
    half_yaw, half_pitch = 0.5 * np.unwrap(np.arctan2(y, x)), -0.5 * np.arctan2(z, np.hypot(x, y))
    sin_y, cos_y, sin_p, cos_p = np.sin(half_yaw), np.cos(half_yaw), np.sin(half_pitch), np.cos(half_pitch)
    quaternions = np.stack([-sin_y * sin_p, cos_y * sin_p, sin_y * cos_p, cos_y * cos_p], axis=1)
    return Poses(trajectory.timestamps_ns, positions, quaternions)


def choose_trajectory(scene: Scene, *, name: str | None = None, heading: str | None = None) -> EgoMotion:
    """Take the trajectory of that name, or the scene's default one.

    Args:
        name: a name out of `scene.trajectories`, "identity" for a stationary ego, None for the default.
        heading: "motion" to derive orientations from positions where a trajectory has none.

    Raises:
        OptionError: the name or the heading is unknown.
        PoseError: the scene has no trajectory, or one without orientations.
    """
    _check_heading(heading)
    if name == IDENTITY:
        return EgoMotion(IDENTITY, Poses.identity())
    if name in RESERVED and name not in scene.trajectories:
        raise PoseError(f"{scene.source}: no data for the trajectory {name!r}; choose one of: {_choices(scene)}")
    if name is None and not scene.trajectories:
        why = "so the ego's poses are unknown" if scene.lidars else "and no lidar to estimate one from"
        raise PoseError(f"{scene.source}: no trajectory in it, {why}; use `--trajectory identity` for a stationary ego")
    chosen = next(iter(scene.trajectories)) if name is None else name
    if chosen not in scene.trajectories:
        raise OptionError(f"{scene.source}: no trajectory {chosen!r}; there are: {_choices(scene)}")
    return _oriented(scene.trajectories[chosen], heading)


def _check_heading(heading: str | None) -> None:
    if heading not in {None, "motion"}:
        raise OptionError(f"heading {heading!r}; expected 'motion'")


def _oriented(trajectory: Trajectory, heading: str | None) -> EgoMotion:
    if trajectory.quaternions_xyzw is None and heading == "motion":
        return EgoMotion(trajectory.name, headed_poses(trajectory), heading)
    return EgoMotion.of(trajectory)


def _choices(scene: Scene) -> str:
    has_fixes = any(isinstance(sensor, GnssSensor) for sensor in scene.sensors)
    computed = {GNSS: has_fixes, LIDAR: bool(scene.lidars)}
    found = [name for name, is_there in computed.items() if is_there and name not in scene.trajectories]
    return ", ".join([*scene.trajectories, *found, IDENTITY])


def find_ego_motion(
    scene: Scene,
    *,
    name: str | None = None,
    heading: str | None = None,
    progress: Progress | None = None,
    lenient: bool = False,
) -> EgoMotion:
    """Take a recorded ego trajectory, or estimate it from GNSS, IMU and lidar; corrections are applied first.

    The arguments and errors are those of `ego_motion_as_given`.
    """
    return ego_motion_as_given(scene.corrected(), name=name, heading=heading, progress=progress, lenient=lenient)


def ego_motion_as_given(
    scene: Scene,
    *,
    name: str | None = None,
    heading: str | None = None,
    progress: Progress | None = None,
    lenient: bool = False,
) -> EgoMotion:
    """Take a recorded ego trajectory, or estimate it, in the world of a scene whose corrections are not applied.

    Args:
        name: a name out of `scene.trajectories`; "identity" for a stationary ego; "gnss" for GNSS fixes smoothed with
            IMU and lidar sweeps as far as there are; "lidar" for lidar odometry; None for the scene's default
            trajectory, and where it has none for "gnss", then "lidar".
        heading: "motion" to derive orientations from positions where a trajectory has none.
        progress: called after each sweep of lidar odometry.
        lenient: leave out sweeps that cannot be read.

    Raises:
        OptionError: the name or the heading is unknown.
        PoseError: the scene has neither a trajectory nor a lidar to estimate one from, or the trajectory has no
            orientations, or cannot be estimated from what is named.
        DataError: a sweep cannot be read.
    """
    if name == IMU and name not in scene.trajectories:
        raise PoseError(
            f"{scene.source}: an IMU alone measures the ego's rotation, not its position; it serves "
            "`sceneloom edit deskew --trajectory imu` only"
        )
    if name is None and not scene.trajectories:
        check_odometry(scene)
    source = computed_name(scene, name)
    if source == GNSS:
        return _from_gnss(scene, heading, progress=progress, lenient=lenient)
    if source == LIDAR:
        return _from_lidar(scene, progress, lenient=lenient, by_default=name is None)
    return choose_trajectory(scene, name=name, heading=heading)


def check_odometry(scene: Scene) -> None:
    """Refuse to estimate the trajectory of an ego in whose frame poses are given.

    Raises:
        PoseError: poses are in ego coordinates, and the ego's own poses are not recorded.
    """
    for sensor in scene.sensors:
        on_ego = getattr(sensor, "coordinates", None) is Coordinates.EGO and getattr(sensor, "mount", None) is None
        if on_ego and getattr(sensor, "poses", None) is not None:
            ego_path(scene, sensor, None)  # type: ignore[arg-type]


def is_computed(scene: Scene, name: str | None) -> bool:
    """Whether the trajectory of that name is estimated from the scene's measurements, rather than recorded in it."""
    return computed_name(scene, name) is not None


def computed_name(scene: Scene, name: str | None) -> str | None:
    """From what the trajectory of that name is estimated, "gnss" or "lidar"; None where it is recorded, or unknown."""
    if name is not None:
        return name if name in {GNSS, LIDAR} and name not in scene.trajectories else None
    if scene.trajectories:
        return None
    if gnss_receivers(scene):
        return GNSS
    return LIDAR if placeable_lidars(scene) else None


def with_trajectory_estimated(scene: Scene, ego: EgoMotion) -> Scene:
    """The scene with its estimated trajectory as the default one, and the warnings about it.

    Where the world's axes are east, north and up at a known position, `metadata.sceneloom.enu_origin` gives it. A
    fusion shifts the world; `world_from_file`, which it adds, leads back into this one.
    """
    path = ego.path
    trajectory = Trajectory(
        ego.name, path.timestamps_ns, path.positions, path.quaternions_xyzw, covariances=ego.covariances
    )
    others = {name: other for name, other in scene.trajectories.items() if name != ego.name}
    found = replace(scene, trajectories={ego.name: trajectory, **others}, warnings=(*scene.warnings, *ego.warnings))
    if ego.enu_origin_lla is None:
        return found
    origin = dict(zip(("latitude", "longitude", "altitude"), ego.enu_origin_lla, strict=True))
    ours = scene.metadata.get("sceneloom")
    ours = {**(ours if isinstance(ours, Mapping) else {}), "enu_origin": origin}
    return replace(found, metadata={**scene.metadata, "sceneloom": ours})


def placeable_lidars(scene: Scene) -> tuple[LidarSensor, ...]:
    """The lidars whose points are not in world coordinates yet, so that they show the ego's motion."""
    return tuple(
        lidar for lidar in scene.lidars if lidar.points_frame is not PointsFrame.WORLD and len(lidar.frames) > 0
    )


def _from_lidar(scene: Scene, progress: Progress | None, *, lenient: bool, by_default: bool) -> EgoMotion:
    from sceneloom.motion.odometry import lidar_odometry

    run = lidar_odometry(scene, progress=progress, lenient=lenient)
    warnings: tuple[DataWarning, ...] = run.warnings
    if by_default:
        message = "no trajectory in it; the ego trajectory was estimated by lidar odometry (`--trajectory lidar`)"
        warnings = (assumed("trajectory-from-lidar", scene.source, message), *warnings)
    ego = replace(EgoMotion.of(run.trajectory), warnings=warnings)
    # begin at a recorded pose, where there is one, so that what is in its world stays right
    first_ns = ego.path.timestamps_ns[:1]
    for trajectory in scene.trajectories.values():
        if trajectory.quaternions_xyzw is not None:
            known = trajectory.poses.interpolate(first_ns)
            if known.coverage[0] == 0:
                return ego.seen_from(RigidTransform.from_quaternion(known.positions[0], known.quaternions_xyzw[0]))
    return ego


def _from_gnss(scene: Scene, heading: str | None, *, progress: Progress | None, lenient: bool) -> EgoMotion:
    from sceneloom.motion.gnss_imu import gnss_imu_motion

    _check_heading(heading)
    lidar, warnings = None, tuple[DataWarning, ...]()
    if gnss_receivers(scene) and placeable_lidars(scene):
        from sceneloom.motion.odometry import lidar_odometry

        try:
            odometry = lidar_odometry(scene, progress=progress, lenient=lenient)
            lidar, warnings = odometry.trajectory, odometry.warnings
        except PoseError as error:
            message = f"lidar odometry failed and was not used with the fixes: {error}"
            warnings = (skipped("gnss-without-lidar", scene.source, message),)
    run = gnss_imu_motion(scene, lidar=lidar)
    if run.trajectory.quaternions_xyzw is None and heading is None:
        raise PoseError(
            f"{scene.source}: GNSS fixes give positions without orientations, and there is no IMU; derive the heading "
            "from the motion with `--orientation-from motion`, or choose another with `--trajectory NAME`"
        )
    warnings = (*warnings, *run.warnings)
    if scene.annotations and scene.trajectories and annotations_frame(scene) is Coordinates.WORLD:
        message = (
            f"annotations are in the world of the recorded trajectory ({', '.join(scene.trajectories)}) and were not "
            "moved; the world of the fixes has its axes east, north and up at the first of them, so that they may be "
            "misplaced"
        )
        location, count = f"{scene.source}: annotations", len(scene.annotations)
        warnings = (*warnings, assumed("annotations-not-moved", location, message, count=count))
    latitude, longitude, height = run.origin_lla.tolist()
    ego = _oriented(run.trajectory, heading)
    return replace(ego, warnings=warnings, enu_origin_lla=(latitude, longitude, height))
