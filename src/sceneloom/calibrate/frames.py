"""The frames that a calibration is judged and repaired by: an image, and the points of a sweep at its time."""

from collections.abc import Iterator, Sequence
from dataclasses import dataclass, replace
from typing import TypeVar

import numpy as np

from sceneloom.arrays import Float32Array, Float64Array, UInt8Array, check_array
from sceneloom.calibrate.scan_order import ScanOrder, find_scan_order
from sceneloom.cameras.camera import Camera
from sceneloom.errors import DataError, OptionError, PoseError
from sceneloom.geometry.rigid import RigidTransform
from sceneloom.motion.deskew import BodyKnots
from sceneloom.motion.ego_motion import find_ego_motion
from sceneloom.scene.cameras import CameraImage, CameraSensor
from sceneloom.scene.clouds import LidarFrame, LidarSensor
from sceneloom.scene.ego import EgoMotion
from sceneloom.scene.pose_source import PoseSource
from sceneloom.scene.sample import Sample
from sceneloom.scene.sample_positions import WORLD, choose_ego
from sceneloom.scene.scene import Scene
from sceneloom.scene.sensor_sources import needs_ego, points_source, sensor_source
from sceneloom.scene.span import scene_period_ns
from sceneloom.scene.types import Identifier, PointsFrame, key_of

MOST = 20
"""Frames that are taken from a drive unless more are asked for."""

Kind = TypeVar("Kind", CameraSensor, LidarSensor)

_LUMA = np.array([0.299, 0.587, 0.114], np.float32)
_HALF_STEP_NS = 25_000_000
"""Half the time over which a velocity is measured [ns]."""


@dataclass(frozen=True, slots=True, eq=False)
class CalibrationFrame:
    """One image, and the points of the sweep nearest to it as they lay around the lidar when it was taken.

    Attributes:
        camera_id, lidar_id: the sensors.
        index: number of the image.
        image_ns: time of the image [ns].
        sweep_ns: reference time of the sweep [ns].
        camera: the camera model.
        camera_from_lidar: as stated, both at the image's time.
        points_lidar: (N, 3) float64 [m], lidar frame at the image's time; finite.
        intensities: (N,) uint8, or None.
        seconds: (N,) float32 [s], when each was measured after the image was taken, or None.
        scan: the points along the scan lines, or None where these are not known.
        grey: (H, W) float32, 0 to 255.
        rgb: (H, W, 3) uint8.
        twist_lidar: (6,) float64, yaw rate [rad/s] and velocity [m/s] of the lidar in its own axes at the image's
            time; None where the motion is not known, and the points were left as they were measured.
        world_from_lidar: where the lidar was at the image's time, or None.
    """

    camera_id: Identifier
    lidar_id: Identifier
    index: int
    image_ns: int
    sweep_ns: int
    camera: Camera
    camera_from_lidar: RigidTransform
    points_lidar: Float64Array
    intensities: UInt8Array | None
    seconds: Float32Array | None
    scan: ScanOrder | None
    grey: Float32Array
    rgb: UInt8Array
    twist_lidar: Float64Array | None = None
    world_from_lidar: RigidTransform | None = None

    def __post_init__(self) -> None:
        count = check_array("frame.points_lidar", self.points_lidar, (None, 3), np.float64)
        check_array("frame.intensities", self.intensities, (count,), np.uint8, optional=True)
        check_array("frame.seconds", self.seconds, (count,), np.float32, optional=True)
        check_array("frame.grey", self.grey, (self.camera.height, self.camera.width), np.float32)
        check_array("frame.twist_lidar", self.twist_lidar, (6,), np.float64, optional=True)

    def camera_from_points(self, camera_from_lidar: Float64Array, *, later: float = 0.0) -> Float64Array:
        """Give what takes `points_lidar` into the camera under a candidate calibration.

        Args:
            camera_from_lidar: (4, 4), the candidate.
            later: so many seconds after its timestamp the image was really taken; counts where the motion is known.

        Returns:
            (4, 4) float64, contiguous.
        """
        if later == 0.0 or self.twist_lidar is None:
            return np.ascontiguousarray(camera_from_lidar, np.float64)
        moved: Float64Array = camera_from_lidar @ moved_by(-later * self.twist_lidar)
        return np.ascontiguousarray(moved)


def moved_by(screw: Float64Array) -> Float64Array:
    """Give the (4, 4) transform of a constant rotate [rad] and shift [m], (6,), over a unit of time.

    Source: exponential map of SE(3), e.g. Barfoot 2017, State Estimation for Robotics, eq. 7.34 to 7.37.
    """
    rotation, shift = screw[:3], screw[3:]
    angle = float(np.linalg.norm(rotation))
    x = np.array(
        [[0.0, -rotation[2], rotation[1]], [rotation[2], 0.0, -rotation[0]], [-rotation[1], rotation[0], 0.0]]
    )
    if angle < 1e-8:
        a, b, c = 1.0, 0.5, 1.0 / 6.0
    else:
        a = np.sin(angle) / angle
        b = (1.0 - np.cos(angle)) / angle**2
        c = (1.0 - a) / angle**2
    matrix = np.eye(4)
    matrix[:3, :3] += a * x + b * (x @ x)
    matrix[:3, 3] = shift + b * (x @ shift) + c * (x @ (x @ shift))
    return matrix


def calibration_frames(
    scene: Scene,
    camera_id: Identifier | None = None,
    lidar_id: Identifier | None = None,
    most: int = MOST,
) -> tuple[CalibrationFrame, ...]:
    """Gather frames spread over a drive: images of a camera, each with the sweep nearest in time.

    The points are moved to the image's time along the ego trajectory: the recorded one, or that of the sweeps
    themselves. Where neither is known they stay as they are, and the mountings alone relate camera and lidar.

    Args:
        camera_id, lidar_id: None for the scene's first ones.
        most: so many at most, evenly spread.

    Raises:
        OptionError: there is no such camera or lidar, or `most` is less than 1.
        PoseError: it is not known how the camera lies to the lidar.
        DataError: an image or a sweep cannot be read, or an image has another size than its camera model; or no image
            has a sweep near enough in time.
    """
    if most < 1:
        raise OptionError(f"{most} frames; expected at least 1")
    camera, lidar = chosen_camera(scene, camera_id), chosen_lidar(scene, lidar_id)
    count = len(camera.images)
    rows = np.unique(np.linspace(0, count - 1, min(most, count)).round().astype(int)).tolist()
    found = tuple(_frames(scene, camera, lidar, rows, _known_trajectory(scene)))
    if not found:
        raise DataError(
            scene.source,
            f"sensors[{camera.id}].images",
            f"{len(camera.images)} images, none with a sweep of {lidar.id!r} near enough in time; "
            "expected one at least",
        )
    return found


def chosen_camera(scene: Scene, camera_id: Identifier | None) -> CameraSensor:
    """The camera of that id, or the first one with images.

    Raises:
        OptionError: there is none.
    """
    filled = (camera for camera in scene.cameras if len(camera.images))
    return _chosen(scene, "camera", camera_id, scene.cameras, filled, "images")


def chosen_lidar(scene: Scene, lidar_id: Identifier | None) -> LidarSensor:
    """The lidar of that id, or the first one with sweeps.

    Raises:
        OptionError: there is none.
    """
    filled = (lidar for lidar in scene.lidars if len(lidar.frames))
    return _chosen(scene, "lidar", lidar_id, scene.lidars, filled, "sweeps")


def _chosen(
    scene: Scene,
    kind: str,
    wanted: Identifier | None,
    there: tuple[Kind, ...],
    filled: Iterator[Kind],
    holds: str,
) -> Kind:
    """The sensor of that id, or the first that holds anything."""
    if wanted is not None:
        for sensor in there:
            if key_of(sensor.id) == key_of(wanted):
                return sensor
        listed = ", ".join(repr(sensor.id) for sensor in there) or "none"
        raise OptionError(f"{scene.source}: no {kind} {wanted!r}; it has {listed}")
    for sensor in filled:
        return sensor
    raise OptionError(f"{scene.source}: no {kind} with {holds}; a calibration is judged by images and sweeps")


def _known_trajectory(scene: Scene) -> EgoMotion | None:
    """The ego trajectory where poses need one: recorded, or found; None where it cannot be."""
    if not needs_ego(scene):
        return None
    try:
        return choose_ego(scene, None) or find_ego_motion(scene, lenient=True)
    except PoseError:
        return None


@dataclass(frozen=True, slots=True, eq=False)
class _Locations:
    """Where camera, lidar and points were; None where it is not known."""

    camera: PoseSource | None
    lidar: PoseSource | None
    points: PoseSource | None

    @classmethod
    def of(
        cls, scene: Scene, camera: CameraSensor, lidar: LidarSensor, ego: EgoMotion | None
    ) -> "_Locations":
        reach_ns = scene_period_ns(scene)
        try:
            at_camera = sensor_source(scene, camera, ego, reach_ns=reach_ns)
            of_points = points_source(scene, lidar, ego, reach_ns=reach_ns) or WORLD
        except PoseError:
            return cls(None, None, None)
        return cls(at_camera, _lidar_position(scene, lidar, ego, reach_ns) or of_points, of_points)


def _lidar_position(
    scene: Scene, lidar: LidarSensor, ego: EgoMotion | None, reach_ns: int
) -> PoseSource | None:
    try:
        return sensor_source(scene, lidar, ego, reach_ns=reach_ns)
    except PoseError:
        return None


def _frames(
    scene: Scene, camera: CameraSensor, lidar: LidarSensor, rows: Sequence[int], ego: EgoMotion | None
) -> Iterator[CalibrationFrame]:
    samples = scene.samples(
        reference=camera.id,
        cameras=camera.id,
        depth_cameras=(),
        lidars=lidar.id,
        trajectory=ego if needs_ego(scene) else None,
    )
    locations = _Locations.of(scene, camera, lidar, ego)
    for row in rows:
        sample = samples[row]
        image, sweep = sample.images[camera.id], sample.sweeps[lidar.id]
        if image is not None and sweep is not None:
            yield _frame(scene, lidar, sample, image, sweep, locations)


def _frame(
    scene: Scene,
    lidar: LidarSensor,
    sample: Sample,
    image: CameraImage,
    sweep: LidarFrame,
    locations: _Locations,
) -> CalibrationFrame:
    camera_id = sample.reference_id
    rgb = image.rgb
    if rgb.shape[:2] != (image.camera.height, image.camera.width):
        raise DataError(
            scene.source,
            f"sensors[{camera_id}].images[{sample.index}]",
            f"{rgb.shape[1]}x{rgb.shape[0]} pixels; expected {image.camera.width}x{image.camera.height}, the size "
            "that the camera was calibrated for",
        )
    placed = _placed(sweep, image, locations)
    if placed is None:
        placed = _by_mountings(scene, lidar, sample)
    points, measured, camera_from_lidar, twist, world_from_lidar = placed
    finite = np.isfinite(points).all(axis=1) & np.isfinite(measured).all(axis=1)
    times = sweep.points.timestamps_ns
    seconds = None if times is None else ((times - image.timestamp_ns) * 1e-9).astype(np.float32)[finite]
    of_lidar = lidar.points_frame is PointsFrame.SENSOR or _is_mounted(lidar)
    rings, levels = sweep.points.rings, sweep.points.intensities
    return CalibrationFrame(
        camera_id=camera_id,
        lidar_id=lidar.id,
        index=sample.index,
        image_ns=image.timestamp_ns,
        sweep_ns=sample.times_ns[lidar.id],
        camera=image.camera,
        camera_from_lidar=camera_from_lidar,
        points_lidar=np.ascontiguousarray(points[finite]),
        intensities=None if levels is None else levels[finite],
        seconds=seconds,
        scan=find_scan_order(measured[finite], None if rings is None else rings[finite])
        if of_lidar
        else None,
        grey=rgb @ _LUMA,
        rgb=rgb,
        twist_lidar=twist,
        world_from_lidar=world_from_lidar,
    )


def _is_mounted(lidar: LidarSensor) -> bool:
    """Whether the position of the lidar on the ego was measured; a mounting that is the identity was not."""
    return lidar.mount is not None and not np.array_equal(lidar.mount.matrix, np.eye(4))


_Placed = tuple[Float64Array, Float64Array, RigidTransform, Float64Array | None, RigidTransform | None]
"""Points at the image's time and as measured, (N, 3) in the lidar frame; camera_from_lidar; the lidar's motion and
location."""


def _placed(sweep: LidarFrame, image: CameraImage, locations: _Locations) -> _Placed | None:
    """Bring points to the image's time by the ways of the sensors; None where these do not reach."""
    if (
        locations.camera is None
        or locations.lidar is None
        or locations.points is None
        or len(sweep.points) == 0
    ):
        return None
    times = sweep.points.timestamps_ns
    if times is None:
        times = np.full(len(sweep.points), sweep.timestamp_ns, np.int64)
    at_image = _pose(locations.lidar, image.timestamp_ns)
    camera = _pose(locations.camera.mounted(image.mount), image.timestamp_ns)
    if at_image is None or camera is None:
        return None
    try:
        knots = BodyKnots.of(locations.points, int(times.min()), int(times.max()))
    except PoseError:
        return None
    points = knots.seen_from(at_image.inverse()).moved(sweep.points.positions, times, locations.points.mount)
    measured = sweep.points.positions.astype(np.float64)
    if locations.points is not locations.lidar:
        at_sweep = _pose(locations.lidar, sweep.reference_ns)
        of_points = _pose(locations.points, sweep.reference_ns)
        if at_sweep is None or of_points is None:
            return None
        measured = (at_sweep.inverse() @ of_points).apply(measured)
    twist = _twist(locations.lidar, image.timestamp_ns)
    return points, measured, camera.inverse() @ at_image, twist, at_image


def _by_mountings(scene: Scene, lidar: LidarSensor, sample: Sample) -> _Placed:
    """Relate lidar and camera as if nothing moved between the sweep and the image.

    Raises:
        PoseError: the mountings are not known.
    """
    camera_from_points = sample.camera_from_points[sample.reference_id]
    sweep = sample.sweeps[lidar.id]
    if camera_from_points is None or sweep is None:
        why = "; ".join(dict.fromkeys(sample.unposed.values())) or "neither poses nor mountings are known"
        raise PoseError(
            f"{scene.source}: it is not known how camera {sample.reference_id!r} lies to lidar {lidar.id!r}: {why}"
        )
    positions = sweep.points.positions.astype(np.float64)
    if lidar.points_frame is PointsFrame.EGO and lidar.mount is not None:
        positions = lidar.mount.inverse().apply(positions)
        camera_from_points = camera_from_points @ lidar.mount
    return positions, positions, camera_from_points, None, None


def _pose(source: PoseSource, time_ns: int) -> RigidTransform | None:
    """`world_from_sensor` at a time [ns]; None where the poses do not reach."""
    if not -(2**63) <= time_ns < 2**63:
        return None
    found = source.at(np.array([time_ns], np.int64))
    if not np.isfinite(found.positions).all():
        return None
    return RigidTransform.from_quaternion(found.positions[0], found.quaternions_xyzw[0])


def _twist(source: PoseSource, time_ns: int) -> Float64Array | None:
    """Rotate rate and velocity of a sensor in its own axes, (6,) [rad/s, m/s]."""
    if source.path.static or len(source.path.timestamps_ns) < 2:
        return None
    reaching = replace(source, reach_ns=max(source.reach_ns, _HALF_STEP_NS))
    before, after = (_pose(reaching, time_ns + step) for step in (-_HALF_STEP_NS, _HALF_STEP_NS))
    if before is None or after is None:
        return None
    step = before.inverse() @ after
    quaternion = step.quaternion_xyzw
    rotation = 2.0 * quaternion[:3]  # of small angles
    return np.concatenate([rotation, step.translation]) / (2e-9 * _HALF_STEP_NS)
