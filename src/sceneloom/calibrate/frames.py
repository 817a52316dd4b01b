"""The frames that a calibration is checked and refined by: an image with the points of a sweep in scan order."""

from collections.abc import Sequence
from contextlib import suppress
from dataclasses import dataclass, replace
from typing import Any, TypeVar

import numpy as np

from sceneloom.arrays import Float32Array, Float64Array, Int64Array, UInt8Array, UInt16Array, check_array, spread_rows
from sceneloom.cameras.camera import Camera
from sceneloom.errors import DataError, OptionError, PoseError
from sceneloom.geometry.rigid import RigidTransform
from sceneloom.motion.deskew import BodyKnots
from sceneloom.motion.ego_trajectory import find_ego_motion
from sceneloom.scene.cameras import CameraImage, CameraSensor
from sceneloom.scene.clouds import LidarFrame, LidarSensor
from sceneloom.scene.ego import EgoMotion, needs_ego, points_source, sensor_source
from sceneloom.scene.poses import PoseSource
from sceneloom.scene.samples import WORLD, Sample, choose_ego
from sceneloom.scene.scene import Scene, scene_period_ns
from sceneloom.scene.types import Identifier, PointsFrame, key_of

MOST = 20
"""Frames that are taken from a drive unless more are asked for."""

LUMA = np.array([0.299, 0.587, 0.114], np.float32)
"""Weights of red, green and blue in brightness."""

_LEAST_LINES, _MOST_LINES, _LEAST_POINTS, _MOST_PEAKS = 4, 512, 64, 160
_ORDERED_SHARE = 0.95  # of the steps in the order of a file that goes along its lines, so many rotate the same way

_JITTER = np.radians(5.0)
_BIN, _PEAKED_SHARE, _PEAKED_BINS, _FEW_SHARE = np.radians(0.02), 0.9, 0.35, 0.1
_LEVEL_SHARE = 0.25  # a line's elevations deviate by less than this part of the angle to the next line

_HALF_STEP_NS = 25_000_000  # half the time over which a velocity is measured [ns]

_Kind = TypeVar("_Kind", CameraSensor, LidarSensor)


@dataclass(frozen=True, slots=True, eq=False)
class ScanOrder:
    """The points of a sweep along its scan lines.

    Attributes:
        order: (M,) int64, the points line by line, each line by azimuth; points at the lidar itself are left out.
        lines: (M,) int64, the line of each of them, 0 for the lowest one.
        azimuths: (M,) float64 [rad], about the lidar's z axis where it was when it measured them, -π to π.
        ranges: (M,) float64 [m].
        count: number of lines.
        spacing: the usual angle from one line to the next [rad]; 0 for a single line.
    """

    order: Int64Array
    lines: Int64Array
    azimuths: Float64Array
    ranges: Float64Array
    count: int
    spacing: float

    @property
    def step(self) -> float:
        """The usual angle from one point of a line to the next [rad]; 0 where there are none."""
        steps = np.diff(self.azimuths)[np.diff(self.lines) == 0]
        return float(np.median(steps)) if len(steps) else 0.0

    def part(self, points: Int64Array) -> "ScanOrder":
        """Some of the points, (K,) int64 numbers of the frame, in the same order."""
        wanted = np.zeros(max(int(self.order.max(initial=0)), int(points.max(initial=0))) + 1, np.bool_)
        wanted[points] = True
        rows = np.flatnonzero(wanted[self.order])
        names = ("order", "lines", "azimuths", "ranges")
        columns: dict[str, Any] = {name: getattr(self, name)[rows] for name in names}
        return replace(self, **columns)

    def along(self, most_steps: float) -> tuple[Int64Array, float]:
        """Rows (K,) whose next one is beside them on a line, at most so many usual steps away; that step [rad]."""
        steps, same, usual = np.diff(self.azimuths), np.diff(self.lines) == 0, self.step
        return np.flatnonzero(same & (steps <= most_steps * usual)), usual

    def above(self, step: float) -> Int64Array:
        """The row of the next line above at the same azimuth, within two usual steps [rad], of each; -1 for none."""
        rotation = 8.0  # more than all azimuths span, so that lines follow one another
        keys, wanted = self.lines * rotation + self.azimuths, (self.lines + 1) * rotation + self.azimuths
        after = np.clip(np.searchsorted(keys, wanted), 1, len(keys) - 1)
        nearer = np.where(np.abs(keys[after] - wanted) < np.abs(keys[after - 1] - wanted), after, after - 1)
        found: Int64Array = np.where(np.abs(keys[nearer] - wanted) <= 2.0 * max(step, 1e-4), nearer, -1)
        found[self.lines + 1 >= self.count] = -1
        return found


def find_scan_order(measured_lidar: Float64Array, rings: UInt16Array | None) -> ScanOrder | None:
    """Find the scan lines of a sweep: by the rings it states, by its order, or by peaks among the elevations.

    Args:
        measured_lidar: (N, 3) float64 [m], each point as the lidar measured it, before any motion was undone.
        rings: (N,) index of the laser, or None.

    Returns:
        None where no lines are found: too few points, or a lidar that does not scan in lines.
    """
    ranges = np.sqrt(np.einsum("ij,ij->i", measured_lidar, measured_lidar))
    used = np.flatnonzero(ranges > 1e-3)
    if len(used) < _LEAST_POINTS:
        return None
    points, ranges = measured_lidar[used], ranges[used]
    azimuths = np.arctan2(points[:, 1], points[:, 0])
    elevations = np.arcsin(np.clip(points[:, 2] / ranges, -1.0, 1.0))
    lines = None if rings is None else rings[used].astype(np.int64)
    if lines is None or not _LEAST_LINES <= len(np.unique(lines)) <= _MOST_LINES:
        lines = _most_level(_by_file_order(azimuths), elevations)
        if lines is None:
            lines = _most_level([_by_elevations(elevations)], elevations)
    if lines is None:
        return None
    numbers, count = _from_below(lines, elevations)
    rows = np.lexsort((azimuths, numbers))
    means = _means_of_lines(numbers, elevations, count)
    spacing = float(np.median(np.diff(means))) if count > 1 else 0.0
    return ScanOrder(used[rows], numbers[rows], azimuths[rows], ranges[rows], count, spacing)


def _by_file_order(azimuths: Float64Array) -> list[Int64Array | None]:
    """Number the rotations of a file that has one line after another, by the azimuths at which each may begin."""
    steps = np.mod(np.diff(azimuths) + np.pi, 2.0 * np.pi) - np.pi
    forward = np.mean(steps > 0) >= 0.5
    if np.mean(steps > 0 if forward else steps < 0) < _ORDERED_SHARE:
        return []
    # a gap may be wider than half a rotation; what seems a small step back is one
    ahead = np.mod(steps if forward else -steps, 2.0 * np.pi)
    ahead[ahead > 2.0 * np.pi - _JITTER] -= 2.0 * np.pi
    rotated = np.concatenate([[0.0], np.cumsum(ahead)])
    found: list[Int64Array | None] = []
    for cut in (0.0, np.pi, float(azimuths[0])):
        begun = np.mod(azimuths[0] - cut if forward else cut - azimuths[0], 2.0 * np.pi)
        rotations = np.floor((begun + rotated) / (2.0 * np.pi)).astype(np.int64)
        lines: Int64Array = rotations - rotations.min()
        found.append(lines if _LEAST_LINES <= lines.max() + 1 <= _MOST_LINES else None)
    return found


def _by_elevations(elevations: Float64Array) -> Int64Array | None:
    """Number lines by the elevations at which most points lie, where these are few."""
    bins = ((elevations - float(elevations.min())) / _BIN).astype(np.int64)
    counts = np.bincount(bins)
    full = np.sort(counts)[::-1]
    needed = int(np.searchsorted(np.cumsum(full), _PEAKED_SHARE * len(elevations))) + 1
    if needed > _PEAKED_BINS * len(counts):
        return None
    occupied = counts >= _FEW_SHARE * full[needed // 2]
    lines = np.cumsum(np.diff(occupied.astype(np.int64), prepend=0) == 1)
    if not _LEAST_LINES <= int(lines[-1]) <= _MOST_PEAKS:
        return None
    of_line = lines[bins[occupied[bins]]] - 1
    means = np.bincount(of_line, elevations[occupied[bins]]) / np.bincount(of_line)
    return np.searchsorted(0.5 * (means[1:] + means[:-1]), elevations).astype(np.int64)


def _most_level(numberings: list[Int64Array | None], elevations: Float64Array) -> Int64Array | None:
    """The numbering of lines, (N,), whose lines keep their elevations best; None where none does."""
    found = [(_unevenness(lines, elevations), lines) for lines in numberings if lines is not None]
    unevenness, lines = min(found, key=lambda pair: pair[0], default=(np.inf, None))
    return lines if unevenness <= _LEVEL_SHARE else None


def _unevenness(lines: Int64Array, elevations: Float64Array) -> float:
    """How much the elevations within a line differ, as part of the angle to the next line."""
    numbers, count = _from_below(lines, elevations)
    means = _means_of_lines(numbers, elevations, count)
    deviations = _means_of_lines(numbers, np.abs(elevations - means[numbers]), count)
    return float(np.median(deviations) / max(np.median(np.diff(means)), 1e-9))


def _from_below(lines: Int64Array, elevations: Float64Array) -> tuple[Int64Array, int]:
    """Number lines anew from the lowest to the highest, those without points left out."""
    counts = np.bincount(lines)
    filled = np.flatnonzero(counts)
    means = np.bincount(lines, elevations)[filled] / counts[filled]
    ranks = np.zeros(len(counts), np.int64)
    ranks[filled[np.argsort(means, kind="stable")]] = np.arange(len(filled))
    return ranks[lines], len(filled)


def _means_of_lines(lines: Int64Array, values: Float64Array, count: int) -> Float64Array:
    return np.asarray(np.bincount(lines, values, count) / np.maximum(np.bincount(lines, minlength=count), 1))


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
        twist_lidar: (6,) float64, angular velocity [rad/s] and velocity [m/s] of the lidar in its own axes at the
            image's time; None where the motion is not known, and the points were left as they were measured.
        world_from_lidar: where the lidar was at the image's time, or None.
        points_frame: the frame in which the drive states the points; beyond that of the sensor, `camera_from_lidar`
            and `points_lidar` depend on the lidar's extrinsics alike, and together not at all.
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
    points_frame: PointsFrame = PointsFrame.SENSOR

    def __post_init__(self) -> None:
        count = check_array("frame.points_lidar", self.points_lidar, (None, 3), np.float64)
        check_array("frame.intensities", self.intensities, (count,), np.uint8, optional=True)
        check_array("frame.seconds", self.seconds, (count,), np.float32, optional=True)
        check_array("frame.grey", self.grey, (self.camera.height, self.camera.width), np.float32)
        check_array("frame.twist_lidar", self.twist_lidar, (6,), np.float64, optional=True)


def calibration_frames(
    scene: Scene, camera_id: Identifier | None = None, lidar_id: Identifier | None = None, most: int = MOST
) -> tuple[CalibrationFrame, ...]:
    """Gather frames spread over a drive: images of a camera, each with the sweep nearest in time.

    The points are moved to the image's time along the ego trajectory: the recorded one, or that of lidar odometry.
    Where neither is known they stay as they are, and the extrinsics alone relate camera and lidar.

    Args:
        camera_id, lidar_id: None for the scene's first ones.
        most: so many at most, evenly spread.

    Raises:
        OptionError: there is no such camera or lidar, or `most` is less than 1.
        PoseError: the pose of the camera relative to the lidar is not known.
        DataError: an image or a sweep cannot be read, or an image has another size than its camera model; or no image
            has a sweep near enough in time.
    """
    if most < 1:
        raise OptionError(f"{most} frames; expected at least 1")
    camera, lidar = chosen_camera(scene, camera_id), chosen_lidar(scene, lidar_id)
    drive = _Drive(scene, camera, lidar)
    samples = scene.samples(
        reference=camera.id, cameras=camera.id, depth_cameras=(), lidars=lidar.id, trajectory=drive.ego
    )
    found = []
    for row in spread_rows(len(camera.images), most).tolist():
        sample = samples[row]
        image, sweep = sample.images[camera.id], sample.sweeps[lidar.id]
        if image is not None and sweep is not None:
            found.append(drive.frame(sample, image, sweep))
    if not found:
        raise DataError(
            scene.source,
            f"sensors[{camera.id}].images",
            f"{len(camera.images)} images, none with a sweep of {lidar.id!r} near enough in time; "
            "expected one at least",
        )
    return tuple(found)


def chosen_camera(scene: Scene, camera_id: Identifier | None) -> CameraSensor:
    """The camera of that id, or the first one with images.

    Raises:
        OptionError: there is none.
    """
    filled = [camera for camera in scene.cameras if len(camera.images)]
    return _chosen(scene, "camera", camera_id, scene.cameras, filled, "images")


def chosen_lidar(scene: Scene, lidar_id: Identifier | None) -> LidarSensor:
    """The lidar of that id, or the first one with sweeps.

    Raises:
        OptionError: there is none.
    """
    filled = [lidar for lidar in scene.lidars if len(lidar.frames)]
    return _chosen(scene, "lidar", lidar_id, scene.lidars, filled, "sweeps")


def _chosen(
    scene: Scene, kind: str, wanted: Identifier | None, there: Sequence[_Kind], filled: Sequence[_Kind], content: str
) -> _Kind:
    if wanted is None:
        if filled:
            return filled[0]
        raise OptionError(f"{scene.source}: no {kind} with {content}; a calibration is judged by images and sweeps")
    for sensor in there:
        if key_of(sensor.id) == key_of(wanted):
            return sensor
    listed = ", ".join(repr(sensor.id) for sensor in there) or "none"
    raise OptionError(f"{scene.source}: no {kind} {wanted!r}; it has {listed}")


_Placed = tuple[Float64Array, Float64Array, RigidTransform, Float64Array | None, RigidTransform | None]
"""Points at the image's time and as measured, (N, 3) in the lidar frame; camera_from_lidar; the lidar's motion and
location."""


class _Drive:
    """A camera and a lidar of a scene, with the poses of both and of the points, which are None where not known."""

    def __init__(self, scene: Scene, camera: CameraSensor, lidar: LidarSensor) -> None:
        """Find the trajectory where poses need one: recorded, or estimated; None where it cannot be."""
        self.scene, self.lidar = scene, lidar
        self.ego: EgoMotion | None = None
        if needs_ego(scene):
            with suppress(PoseError):
                self.ego = choose_ego(scene, None) or find_ego_motion(scene, lenient=True)
        self.poses: tuple[PoseSource, PoseSource, PoseSource] | None = None
        with suppress(PoseError):
            reach_ns = scene_period_ns(scene)
            at_camera = sensor_source(scene, camera, self.ego, reach_ns=reach_ns)
            of_points = points_source(scene, lidar, self.ego, reach_ns=reach_ns) or WORLD
            at_lidar = None
            with suppress(PoseError):
                at_lidar = sensor_source(scene, lidar, self.ego, reach_ns=reach_ns)
            self.poses = at_camera, at_lidar or of_points, of_points

    def frame(self, sample: Sample, image: CameraImage, sweep: LidarFrame) -> CalibrationFrame:
        """Make the frame of one image; refuses one of another size than its camera model, and unknown extrinsics."""
        rgb, lidar = image.rgb, self.lidar
        if rgb.shape[:2] != (image.camera.height, image.camera.width):
            raise DataError(
                self.scene.source,
                f"sensors[{sample.reference_id}].images[{sample.index}]",
                f"{rgb.shape[1]}x{rgb.shape[0]} pixels; expected {image.camera.width}x{image.camera.height}, the size "
                "that the camera was calibrated for",
            )
        placed = self._by_poses(sweep, image) or self._by_extrinsics(sample, sweep)
        points, measured, camera_from_lidar, twist, world_from_lidar = placed
        finite = np.isfinite(points).all(axis=1) & np.isfinite(measured).all(axis=1)
        times, rings, levels = sweep.points.timestamps_ns, sweep.points.rings, sweep.points.intensities
        # extrinsics that are the identity were not measured
        is_mounted = lidar.mount is not None and not np.array_equal(lidar.mount.matrix, np.eye(4))
        of_lidar = lidar.points_frame is PointsFrame.SENSOR or is_mounted
        return CalibrationFrame(
            camera_id=sample.reference_id,
            lidar_id=lidar.id,
            index=sample.index,
            image_ns=image.timestamp_ns,
            sweep_ns=sample.times_ns[lidar.id],
            camera=image.camera,
            camera_from_lidar=camera_from_lidar,
            points_lidar=np.ascontiguousarray(points[finite]),
            intensities=None if levels is None else levels[finite],
            seconds=None if times is None else ((times - image.timestamp_ns) * 1e-9).astype(np.float32)[finite],
            scan=find_scan_order(measured[finite], None if rings is None else rings[finite]) if of_lidar else None,
            grey=rgb @ LUMA,
            rgb=rgb,
            twist_lidar=twist,
            world_from_lidar=world_from_lidar,
            points_frame=lidar.points_frame,
        )

    def _by_poses(self, sweep: LidarFrame, image: CameraImage) -> _Placed | None:
        """Bring points to the image's time by the poses of the sensors; None where these do not reach."""
        if self.poses is None or len(sweep.points) == 0:
            return None
        at_camera, at_lidar, of_points = self.poses
        times = sweep.point_times_ns
        at_image = _pose(at_lidar, image.timestamp_ns)
        camera = _pose(at_camera.mounted(image.mount), image.timestamp_ns)
        if at_image is None or camera is None:
            return None
        try:
            knots = BodyKnots.of(of_points, int(times.min()), int(times.max()))
        except PoseError:
            return None
        points = knots.seen_from(at_image.inverse()).moved(sweep.points.positions, times, of_points.mount)
        measured = sweep.points.positions.astype(np.float64)
        if of_points is not at_lidar:
            at_sweep, points_at_sweep = _pose(at_lidar, sweep.reference_ns), _pose(of_points, sweep.reference_ns)
            if at_sweep is None or points_at_sweep is None:
                return None
            measured = (at_sweep.inverse() @ points_at_sweep).apply(measured)
        return points, measured, camera.inverse() @ at_image, _twist(at_lidar, image.timestamp_ns), at_image

    def _by_extrinsics(self, sample: Sample, sweep: LidarFrame) -> _Placed:
        """Relate lidar and camera as if nothing moved between the sweep and the image."""
        lidar, camera_from_points = self.lidar, sample.camera_from_points[sample.reference_id]
        if camera_from_points is None:
            why = "; ".join(dict.fromkeys(sample.unposed.values())) or "neither poses nor extrinsics are known"
            raise PoseError(
                f"{self.scene.source}: the pose of camera {sample.reference_id!r} relative to lidar {lidar.id!r} is "
                f"not known: {why}"
            )
        positions = sweep.points.positions.astype(np.float64)
        if lidar.points_frame is PointsFrame.EGO and lidar.mount is not None:
            positions = lidar.mount.inverse().apply(positions)
            camera_from_points = camera_from_points @ lidar.mount
        return positions, positions, camera_from_points, None, None


def _pose(source: PoseSource, time_ns: int) -> RigidTransform | None:
    """`world_from_sensor` at a time [ns]; None where the poses do not reach."""
    return source.pose_at(time_ns) if -(2**63) <= time_ns < 2**63 else None


def _twist(source: PoseSource, time_ns: int) -> Float64Array | None:
    """Angular velocity and velocity of a sensor in its own axes, (6,) [rad/s, m/s]."""
    if source.path.static or len(source.path.timestamps_ns) < 2:
        return None
    reaching = replace(source, reach_ns=max(source.reach_ns, _HALF_STEP_NS))
    before, after = (_pose(reaching, time_ns + step) for step in (-_HALF_STEP_NS, _HALF_STEP_NS))
    if before is None or after is None:
        return None
    step = before.inverse() @ after
    rotation = 2.0 * step.quaternion_xyzw[:3]  # of small angles
    return np.concatenate([rotation, step.translation]) / (2e-9 * _HALF_STEP_NS)
