"""Which part of the surroundings each sensor sees, around the ego, ahead upwards."""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field

import msgspec
import numpy as np

from sceneloom.arrays import BoolArray, Float64Array
from sceneloom.cameras.camera import Camera
from sceneloom.cameras.models import unproject
from sceneloom.errors import CalibrationError, DataError, SceneloomError
from sceneloom.geometry.rigid import RigidTransform
from sceneloom.report.numbers.clouds import CloudCoverage, CloudStatistics
from sceneloom.report.numbers.sampling import spread_rows
from sceneloom.scene.cameras import CameraSensor
from sceneloom.scene.clouds import LidarSensor, RadarSensor
from sceneloom.scene.ego import EgoMotion
from sceneloom.scene.sample_positions import choose_ego, frame_of_points, locations_of, poses_at
from sceneloom.scene.scene import Scene
from sceneloom.scene.types import Identifier

SWEEPS = 12
"""Sweeps of each lidar and radar that are looked at, at most."""
_RAYS = 65
_MOVES = 0.5
"""Between two looks the ego has to move so far for its motion to state where ahead is [m]."""

_AROUND_NS = 1_000_000_000
"""Where ahead is, is reported by the motion so long before and after the middle of the drive, at most [ns]."""

Surveying = LidarSensor | RadarSensor


class CameraView(msgspec.Struct, frozen=True, kw_only=True):
    """Where a camera looks.

    Attributes:
        sensor: the camera.
        width, height: of its images [px].
        model: of its camera model.
        across_deg, upright_deg: angles of view along the middle row and column [deg].
        left_deg, right_deg: ends of the middle row, counter-clockwise from straight ahead [deg], `left_deg` the larger
            one; None where the mounting is not known.
        heading_deg, pitch_deg: where the middle of the image looks: counter-clockwise from ahead, up [deg].
    """

    sensor: Identifier
    width: int
    height: int
    model: str
    across_deg: float | None = None
    upright_deg: float | None = None
    left_deg: float | None = None
    right_deg: float | None = None
    heading_deg: float | None = None
    pitch_deg: float | None = None


class Coverage(msgspec.Struct, frozen=True, kw_only=True):
    """What the sensors see together.

    Attributes:
        clouds: of lidars and radars.
        cameras: where they look.
        ahead_by: how it is known where ahead is: "motion", "camera" or "axes".
        lidar_share, camera_share, both_share: of the horizon, what lidars, cameras, and both see.
        skipped: frames that could not be read or placed, and why.
    """

    clouds: tuple[CloudCoverage, ...] = ()
    cameras: tuple[CameraView, ...] = ()
    ahead_by: str = "axes"
    lidar_share: float = 0.0
    camera_share: float = 0.0
    both_share: float = 0.0
    skipped: tuple[str, ...] = ()


def coverage_of(scene: Scene, *, sweeps: int = SWEEPS, ego: EgoMotion | None = None) -> Coverage:
    """Look at some sweeps of each lidar and radar, and at all camera models."""
    survey = _Survey.of(scene, ego)
    surveying = [s for s in scene.sensors if isinstance(s, LidarSensor | RadarSensor)]
    clouds = tuple(survey.cloud(sensor, sweeps) for sensor in surveying)
    cameras = tuple(survey.view(camera) for camera in scene.cameras)
    lidar = _seen_by_lidars(clouds)
    camera = _seen_by_cameras(cameras)
    return Coverage(
        clouds=clouds,
        cameras=cameras,
        ahead_by=survey.ahead_by,
        lidar_share=float(lidar.mean()),
        camera_share=float(camera.mean()),
        both_share=float((lidar & camera).mean()),
        skipped=tuple(survey.skipped),
    )


@dataclass(slots=True)
class _Survey:
    """Knows how each sensor lies in a level frame whose x axis leads ahead."""

    scene: Scene
    ego: EgoMotion | None
    level_from_sensor: Mapping[Identifier, Float64Array]
    ahead_by: str
    skipped: list[str] = field(default_factory=list)

    @classmethod
    def of(cls, scene: Scene, ego: EgoMotion | None) -> "_Survey":
        chosen = ego
        if chosen is None:
            try:
                chosen = choose_ego(scene, None)
            except SceneloomError:
                chosen = None
        rotations, ahead_by = _rotations_to_level(scene, chosen)
        return cls(scene, chosen, rotations, ahead_by)

    def cloud(self, sensor: Surveying, most: int) -> CloudCoverage:
        statistics = CloudStatistics()
        rotation = self.level_from_sensor.get(sensor.id, np.eye(3))
        rows = spread_rows(len(sensor.frames), most)
        for row in rows.tolist():
            try:
                frame = sensor.frames[row]
            except DataError as error:
                self.skipped.append(str(error))
                continue
            sensor_from_points = self._sensor_from_points(sensor, frame.timestamp_ns)
            if sensor_from_points is None:
                self.skipped.append(f"{sensor.id}: it is not known where its points are seen from")
                break
            positions = sensor_from_points.apply(frame.points.positions)
            statistics.add(positions @ rotation.T, frame.points if isinstance(sensor, LidarSensor) else None)
        return statistics.coverage(sensor.id, str(sensor.type), of=len(sensor.frames))

    def _sensor_from_points(self, sensor: Surveying, time_ns: int) -> RigidTransform | None:
        if sensor.points_frame == "sensor":
            return RigidTransform.identity()
        if sensor.points_frame == "ego" and sensor.mount is not None:
            return sensor.mount.inverse()
        points = frame_of_points(self.scene, sensor, self.ego)
        own = locations_of(self.scene, [sensor], self.ego)[sensor.id]
        of_points, of_sensor = (
            pose.world_from_sensor for pose in poses_at([(points, time_ns), (own, time_ns)])
        )
        if of_points is None or of_sensor is None:
            return None
        return of_sensor.inverse() @ of_points

    def view(self, sensor: CameraSensor) -> CameraView:
        camera = sensor.camera
        known = CameraView(sensor=sensor.id, width=camera.width, height=camera.height, model=camera.model)
        try:
            across, upright = _rays(camera, 0), _rays(camera, 1)
        except CalibrationError:
            return known
        known = msgspec.structs.replace(known, across_deg=_bend(across), upright_deg=_bend(upright))
        rotation = self.level_from_sensor.get(sensor.id)
        if rotation is None or len(across) < 2:
            return known
        level = across @ rotation.T
        angles = np.degrees(np.unwrap(np.arctan2(level[:, 1], level[:, 0])))
        ahead = rotation @ _middle(camera)
        return msgspec.structs.replace(
            known,
            left_deg=float(angles.max()),
            right_deg=float(angles.min()),
            heading_deg=float(np.degrees(np.arctan2(ahead[1], ahead[0]))),
            pitch_deg=float(np.degrees(np.arcsin(np.clip(ahead[2], -1.0, 1.0)))),
        )


def _rays(camera: Camera, axis: int) -> Float64Array:
    """Unit rays of the pixels along the middle row (axis 0) or column (1), from edge to edge; (M, 3)."""
    size = (camera.width, camera.height)
    pixels = np.empty((_RAYS, 2))
    pixels[:, axis] = np.linspace(-0.5, size[axis] - 0.5, _RAYS)
    pixels[:, 1 - axis] = (size[1 - axis] - 1) / 2
    rays = unproject(camera, pixels)
    return rays[np.isfinite(rays).all(axis=1)]


def _middle(camera: Camera) -> Float64Array:
    ray = unproject(camera, np.array([[(camera.width - 1) / 2, (camera.height - 1) / 2]]))[0]
    return ray if np.isfinite(ray).all() else np.array([0.0, 0.0, 1.0])


def _bend(rays: Float64Array) -> float | None:
    """The angle from the first ray to the last along all between them [deg]."""
    if len(rays) < 2:
        return None
    cosines = np.clip((rays[1:] * rays[:-1]).sum(axis=1), -1.0, 1.0)
    return float(np.degrees(np.arccos(cosines)).sum())


def _rotations_to_level(scene: Scene, ego: EgoMotion | None) -> tuple[dict[Identifier, Float64Array], str]:
    """(3, 3) rotations from each sensor's frame into a level one that looks ahead, and how ahead is known."""
    sensors = [s for s in scene.sensors if isinstance(s, LidarSensor | RadarSensor | CameraSensor)]
    locations = locations_of(scene, sensors, ego)
    times = _times(scene, ego)
    poses = {
        sensor.id: [pose.world_from_sensor for pose in poses_at([(locations[sensor.id], t) for t in times])]
        for sensor in sensors
    }
    world = {key: [p for p in found if p is not None] for key, found in poses.items()}
    if any(world.values()):
        middle = {key: found[len(found) // 2].rotation for key, found in world.items() if found}
        ahead, known_by = _ahead_in_world(scene, world, middle)
        # each sensor is levelled where it stood: all looked at the same moment lie alike to one another
        level_from_world = _looking(ahead, np.array([0.0, 0.0, 1.0]))
        rotated = {key: level_from_world @ rotation for key, rotation in middle.items()}
        return _joined(rotated, {s.id: locations[s.id].mount for s in sensors}), known_by
    mounts = {s.id: locations[s.id].mount for s in sensors}
    known = {key: mount.rotation for key, mount in mounts.items() if mount is not None}
    ahead, known_by = np.array([1.0, 0.0, 0.0]), "axes"
    first = next((camera for camera in scene.cameras if camera.id in known), None)
    if first is not None and abs((known[first.id] @ [0.0, 0.0, 1.0])[2]) < 0.9:
        ahead, known_by = known[first.id] @ np.array([0.0, 0.0, 1.0]), "camera"
    level_from_ego = _looking(ahead, np.array([0.0, 0.0, 1.0]))
    return {key: level_from_ego @ rotation for key, rotation in known.items()}, known_by


def _joined(
    rotated: dict[Identifier, Float64Array], mounts: Mapping[Identifier, RigidTransform | None]
) -> dict[Identifier, Float64Array]:
    """Add sensors that have a mounting, but no pose at the moments looked at, through one that has both."""
    both = next((key for key in rotated if mounts.get(key) is not None), None)
    if both is None:
        return rotated
    mount = mounts[both]
    if mount is None:
        return rotated
    level_from_ego = rotated[both] @ mount.rotation.T
    for key, other in mounts.items():
        if key not in rotated and other is not None:
            rotated[key] = level_from_ego @ other.rotation
    return rotated


def _times(scene: Scene, ego: EgoMotion | None) -> list[int]:
    """The middle of the time in which poses are known, and a moment before and after it [ns]."""
    timestamps: Sequence[int] = ()
    if ego is not None and not ego.path.static:
        timestamps = ego.path.timestamps_ns.tolist()
    else:
        for sensor in scene.sensors:
            path = getattr(sensor, "poses", None)
            if path is not None and not path.static and len(path.timestamps_ns) > len(timestamps):
                timestamps = path.timestamps_ns.tolist()
    if not len(timestamps):
        return [0]
    half_ns = min(_AROUND_NS, round(0.45 * (timestamps[-1] - timestamps[0])))
    middle_ns = (timestamps[0] + timestamps[-1]) // 2
    return [middle_ns - half_ns, middle_ns, middle_ns + half_ns]


def _ahead_in_world(
    scene: Scene, world: Mapping[Identifier, list[RigidTransform]], middle: Mapping[Identifier, Float64Array]
) -> tuple[Float64Array, str]:
    for found in world.values():
        if len(found) >= 2:
            step = found[-1].translation - found[0].translation
            if np.hypot(step[0], step[1]) >= _MOVES:
                return step, "motion"
    for camera in scene.cameras:
        if camera.id in middle:
            ray = middle[camera.id] @ np.array([0.0, 0.0, 1.0])
            if abs(ray[2]) < 0.9:
                return ray, "camera"
    return next(iter(middle.values()))[:, 0], "axes"


def _looking(ahead: Float64Array, up: Float64Array) -> Float64Array:
    """The (3, 3) rotation into a frame whose z axis is `up`, and whose x axis is `ahead` made level."""
    level = ahead - (ahead @ up) * up
    length = float(np.linalg.norm(level))
    x = level / length if length > 1e-6 else np.array([1.0, 0.0, 0.0])
    return np.stack([x, np.cross(up, x), up])


def _seen_by_lidars(clouds: Sequence[CloudCoverage]) -> BoolArray:
    seen: BoolArray = np.zeros(360, np.bool_)
    for cloud in clouds:
        if cloud.type == "lidar" and cloud.sectors:
            seen |= np.repeat(np.array(cloud.sectors) > 0, 360 // len(cloud.sectors))
    return seen


def _seen_by_cameras(cameras: Sequence[CameraView]) -> BoolArray:
    seen: BoolArray = np.zeros(360, np.bool_)
    middles = np.arange(360) + 0.5
    for camera in cameras:
        if camera.left_deg is not None and camera.right_deg is not None:
            seen |= (middles - camera.right_deg) % 360 <= camera.left_deg - camera.right_deg
    return seen
