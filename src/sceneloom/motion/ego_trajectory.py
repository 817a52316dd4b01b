"""The ego trajectory that positions a scene: recorded, from GNSS/IMU smoothing or lidar odometry, or stationary."""

from collections.abc import Mapping
from dataclasses import replace
from typing import TYPE_CHECKING

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
from sceneloom.warnings import DataWarning, WarningKind

if TYPE_CHECKING:
    from sceneloom.motion.odometry import OdometryRun

_HIGHEST = 1e6
"""Heights beyond it [m] no receiver reports that is carried by an ego; NaN stands for one that is not reported."""


def gnss_receivers(scene: Scene) -> tuple[GnssSensor, ...]:
    """The receivers of a scene that have at least two usable fixes."""
    return tuple(s for s in scene.sensors if isinstance(s, GnssSensor) and usable_fixes(s).sum() >= 2)


def usable_fixes(receiver: GnssSensor) -> BoolArray:
    """(N,) fixes that are locations; a receiver without reception reports 0, 0."""
    latitude, longitude, height = receiver.positions_lla.T
    usable: BoolArray = (np.abs(latitude) <= 90.0) & (np.abs(longitude) <= 360.0)
    usable &= (latitude != 0.0) | (longitude != 0.0)
    usable &= np.isnan(height) | (np.abs(height) <= _HIGHEST)
    return usable


def usable_positions(receiver: GnssSensor) -> tuple[Int64Array, Float64Array]:
    """The rows (M,) of usable fixes, and their locations (M, 3): latitude, longitude [deg] and height [m].

    A height that is not reported is the median of those that are, 0 where none is.
    """
    rows = np.flatnonzero(usable_fixes(receiver))
    locations = receiver.positions_lla[rows]
    untold = np.isnan(locations[:, 2])
    locations[untold, 2] = 0.0 if untold.all() else np.median(locations[~untold, 2])
    return rows, locations


_CHORD = 0.5
"""Length [m] of the chord that gives a direction: well above the noise of a smoothed position."""


def headed_poses(trajectory: Trajectory) -> Poses:
    """Give each position the yaw and pitch of the trajectory around it, without roll.

    The direction is the chord from the last position at least `_CHORD` behind to the first at least that far ahead;
    a stationary ego keeps the direction that it came with.

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
    directions = positions[ahead] - positions[behind]
    return Poses(trajectory.timestamps_ns, positions, _quaternions_along(directions))


def _quaternions_along(directions: Float64Array) -> Float64Array:
    """(N, 4) xyzw: x axis along (N, 3) directions, y axis level."""
    half_yaw = 0.5 * np.unwrap(np.arctan2(directions[:, 1], directions[:, 0]))
    half_pitch = -0.5 * np.arctan2(directions[:, 2], np.hypot(directions[:, 0], directions[:, 1]))
    sin_y, cos_y, sin_p, cos_p = np.sin(half_yaw), np.cos(half_yaw), np.sin(half_pitch), np.cos(half_pitch)
    return np.stack([-sin_y * sin_p, cos_y * sin_p, sin_y * cos_p, cos_y * cos_p], axis=1)


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


def find_ego_motion(
    scene: Scene,
    *,
    name: str | None = None,
    heading: str | None = None,
    progress: Progress | None = None,
    lenient: bool = False,
) -> EgoMotion:
    """Take a recorded ego trajectory, or find it from satellite fixes, IMU and lidar; corrections are applied first.

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
    """Take a recorded ego trajectory, or find it, in the world of a scene whose corrections stay as they are.

    Args:
        name: a name out of `scene.trajectories`; "identity" for an ego that is stationary; "gnss" to find the
            trajectory from satellite fixes, with IMU and lidar sweeps as far as there are; "lidar" to find it from the
            sweeps alone; None for the scene's default trajectory, and where it has none for "gnss", then "lidar".
        heading: "motion" to derive orientations from positions where a trajectory has none.
        progress: reported after each sweep, where the trajectory is found from the sweeps.
        lenient: pass over sweeps that cannot be read.

    Raises:
        OptionError: the name or the heading is unknown.
        PoseError: the scene has neither a trajectory nor a lidar to find one from, or the trajectory has no
            orientations, or the trajectory cannot be found from what is named.
        DataError: a sweep cannot be read.
    """
    if name == IMU and name not in scene.trajectories:
        raise PoseError(
            f"{scene.source}: an IMU alone reports how the ego rotated, but not where it was; it serves "
            "`sceneloom edit deskew --trajectory imu` only"
        )
    if name is None and not scene.trajectories:
        check_odometry(scene)
    match computed_name(scene, name):
        case "gnss":
            return _from_gnss(scene, heading, progress=progress, lenient=lenient)
        case "lidar":
            run = _followed(scene, progress, lenient=lenient)
            return _from_lidar(scene, run, by_default=name is None)
    return choose_trajectory(scene, name=name, heading=heading)


def check_odometry(scene: Scene) -> None:
    """Refuse to choose what stands in for the ego that poses lead into.

    Raises:
        PoseError: poses are in ego coordinates, and nothing recorded says where the ego was.
    """
    for sensor in scene.sensors:
        on_ego = getattr(sensor, "coordinates", None) is Coordinates.EGO and getattr(sensor, "mount", None) is None
        if on_ego and getattr(sensor, "poses", None) is not None:
            ego_path(scene, sensor, None)  # type: ignore[arg-type]


def is_computed(scene: Scene, name: str | None) -> bool:
    """Whether the trajectory of that name is found from the scene's measurements, rather than recorded in it."""
    return computed_name(scene, name) is not None


def computed_name(scene: Scene, name: str | None) -> str | None:
    """What the trajectory of that name is found from, "gnss" or "lidar"; None where it is recorded.

    Or cannot be found.
    """
    if name is not None:
        return name if name in {GNSS, LIDAR} and name not in scene.trajectories else None
    if scene.trajectories:
        return None
    if gnss_receivers(scene):
        return GNSS
    return LIDAR if placeable_lidars(scene) else None


def with_trajectory_estimated(scene: Scene, ego: EgoMotion) -> Scene:
    """The scene with its estimated trajectory as the default one, and the warnings that go with it.

    Where the world's axes are east, north and up at a known location, `metadata.sceneloom.enu_origin` reports it. A
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
    reported = {**(ours if isinstance(ours, Mapping) else {}), "enu_origin": origin}
    return replace(found, metadata={**scene.metadata, "sceneloom": reported})


def placeable_lidars(scene: Scene) -> tuple[LidarSensor, ...]:
    """The lidars whose points are not in the world yet, so that they report how the ego moved."""
    return tuple(
        lidar for lidar in scene.lidars if lidar.points_frame is not PointsFrame.WORLD and len(lidar.frames) > 0
    )


def _followed(scene: Scene, progress: Progress | None, *, lenient: bool) -> "OdometryRun":
    from sceneloom.motion.odometry import lidar_odometry

    return lidar_odometry(scene, progress=progress, lenient=lenient)


def _from_lidar(scene: Scene, run: "OdometryRun", *, by_default: bool) -> EgoMotion:
    warnings = (_assumed(scene), *run.warnings) if by_default else tuple(run.warnings)
    return _in_known_world(replace(EgoMotion.of(run.trajectory), warnings=warnings), scene)


def _from_gnss(
    scene: Scene,
    heading: str | None,
    *,
    progress: Progress | None,
    lenient: bool,
) -> EgoMotion:
    from sceneloom.motion.gnss_imu.smoother import gnss_imu_motion

    if heading not in {None, "motion"}:
        raise OptionError(f"heading {heading!r}; expected 'motion'")
    lidar, reported = _lidar_beside_gnss(scene, progress, lenient=lenient)
    run = gnss_imu_motion(scene, lidar=lidar)
    latitude, longitude, height = run.origin_lla.tolist()
    trajectory = run.trajectory
    if trajectory.quaternions_xyzw is None and heading == "motion":
        ego = EgoMotion(trajectory.name, headed_poses(trajectory), heading)
    elif trajectory.quaternions_xyzw is None:
        raise PoseError(
            f"{scene.source}: GNSS fixes report positions without orientations, and there is no IMU; derive the "
            f"heading "
            "from the motion with `--orientation-from motion`, or choose another with `--trajectory NAME`"
        )
    else:
        ego = EgoMotion.of(trajectory)
    warnings = (*reported, *run.warnings, *_left_behind(scene))
    return replace(ego, warnings=warnings, enu_origin_lla=(latitude, longitude, height))


def _lidar_beside_gnss(
    scene: Scene, progress: Progress | None, *, lenient: bool
) -> tuple[Trajectory | None, tuple[DataWarning, ...]]:
    """The trajectory by lidar odometry to be taken in with the fixes, where there is one."""
    if not gnss_receivers(scene) or not placeable_lidars(scene):
        return None, ()
    try:
        run = _followed(scene, progress, lenient=lenient)
    except PoseError as error:
        message = f"the lidar could not be taken in with the fixes: {error}"
        return None, (
            DataWarning(kind=WarningKind.SKIPPED, code="gnss-without-lidar", location=scene.source, message=message),
        )
    return run.trajectory, run.warnings


def _in_known_world(ego: EgoMotion, scene: Scene) -> EgoMotion:
    """Begin where a recorded trajectory says that the ego was then, so that what stands in its world stays right."""
    first_ns = ego.path.timestamps_ns[:1]
    for trajectory in scene.trajectories.values():
        if trajectory.quaternions_xyzw is None:
            continue
        known = trajectory.poses.interpolate(first_ns)
        if known.coverage[0] == 0:
            return ego.seen_from(RigidTransform.from_quaternion(known.positions[0], known.quaternions_xyzw[0]))
    return ego


def _left_behind(scene: Scene) -> tuple[DataWarning, ...]:
    """Report that annotations stand in the world of a recorded trajectory, which is not that of the fixes."""
    if not (scene.annotations and scene.trajectories) or annotations_frame(scene) is not Coordinates.WORLD:
        return ()
    names = ", ".join(scene.trajectories)
    message = (
        f"annotations stand in the world of the recorded trajectory ({names}) and were left there; the world of the "
        "fixes has its axes east, north and up at the first of them, so that they may be misplaced"
    )
    location, count = f"{scene.source}: annotations", len(scene.annotations)
    return (
        DataWarning(
            kind=WarningKind.ASSUMED,
            code="annotations-not-moved",
            location=location,
            message=message,
            count=count,
        ),
    )


def _assumed(scene: Scene) -> DataWarning:
    message = "no trajectory in it; the ego trajectory was found from the lidar's sweeps (`--trajectory lidar`)"
    return DataWarning(kind=WarningKind.ASSUMED, code="trajectory-from-lidar", location=scene.source, message=message)
