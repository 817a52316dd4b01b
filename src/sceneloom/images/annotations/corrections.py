"""What corrections change: where a calibrated camera sees things, and how an adjustment moves the ego trajectory."""

import numpy as np

from sceneloom.arrays import Float64Array
from sceneloom.cameras.camera import Camera
from sceneloom.cameras.models import project_unbounded, unproject
from sceneloom.geometry.rigid import RigidTransform
from sceneloom.geometry.rotations import rotate_vectors
from sceneloom.images.annotations.marking import draw_marks, image
from sceneloom.images.canvas import FAINT_INK, Canvas, PilImage
from sceneloom.images.cloud_above import SIZE_PX, MapLayout, draw_cloud_above
from sceneloom.images.ego import EgoPosition
from sceneloom.images.views import framed
from sceneloom.scene.annotations.corrections import CameraCalibration, LocalizationAdjustment
from sceneloom.scene.cameras import CameraSensor
from sceneloom.scene.clouds import LidarSensor
from sceneloom.scene.motion import OdometrySensor
from sceneloom.scene.poses import Poses
from sceneloom.scene.sample import Sample
from sceneloom.scene.scene import Scene

_GRID = (16, 9)
_DISTANCE = 20.0
"""How far away the things are whose pixels are compared [m]."""
_BEFORE, _AFTER = FAINT_INK, (255, 206, 84)


def draw_calibration(sample: Sample, calibration: CameraCalibration) -> PilImage:
    """Draw where the pixels of a camera go by its calibration: things 20 m away, from where they were seen.

    Raises:
        DataError: the image cannot be decoded.
        CalibrationError: a camera model has no projection.
    """
    camera = sample.cameras[calibration.sensor_id]
    plot = image(sample, calibration.sensor_id)
    columns, rows = (
        (np.arange(n) + 0.5) * size / n for n, size in zip(_GRID, (camera.width, camera.height), strict=True)
    )
    before = np.stack(np.meshgrid(columns, rows), axis=-1).reshape(-1, 2)
    points = _DISTANCE * unproject(camera, before)
    correction = _correction(calibration, sample.times_ns.get(calibration.sensor_id, sample.timestamp_ns))
    after = project_unbounded(calibration.intrinsics or camera, correction.inverse().apply(points))
    shifts = np.linalg.norm(after - before, axis=1)
    for start, stop in zip(before, after, strict=True):
        if np.isfinite(stop).all():
            plot.line([(start[0], start[1]), (stop[0], stop[1])], _AFTER, width=2)
    draw_marks(plot, before, _BEFORE, 1.5)
    largest = float(np.nanmax(shifts)) if np.isfinite(shifts).any() else float("nan")
    stated = f"things {_DISTANCE:g} m away move by {largest:.1f} px at most"
    if calibration.time_offset_ns is not None:
        stated += f"; times by {calibration.time_offset_ns / 1e6:g} ms"
    return framed(plot, [f"{calibration.type} {calibration.id} of {calibration.sensor_id}", stated])


def draw_adjustment(
    scene: Scene, adjustment: LocalizationAdjustment, *, size_px: tuple[int, int] = SIZE_PX
) -> PilImage:
    """Draw the ego trajectory before and after a localisation adjustment, from above."""
    trajectory = _trajectory(scene)
    before = np.zeros((0, 3)) if trajectory is None else trajectory.positions
    after = before if trajectory is None else _adjusted(trajectory, adjustment.poses)
    both = np.concatenate([before, after]) if len(before) else np.zeros((1, 3))
    middle = (both.min(axis=0) + both.max(axis=0)) / 2
    reach = max(0.6 * float(np.ptp(both[:, :2], axis=0).max()), 1.0)

    def over(plot: Canvas, layout: MapLayout) -> None:
        for line, colour, width in ((before, _BEFORE, 2), (after, _AFTER, 3)):
            pixels = [(float(u), float(v)) for u, v in layout.pixels(line)] if len(line) else []
            if len(pixels) > 1:
                plot.line(pixels, colour, width=width)

    moved = float(np.nanmax(np.linalg.norm(after - before, axis=1))) if len(before) else 0.0
    lines = [
        f"{adjustment.type} {adjustment.id}",
        f"the trajectory moves by {moved:.2f} m at most; grey before, yellow after",
    ]
    return draw_cloud_above(
        middle[None], None, ego=EgoPosition(middle, np.array([1.0, 0.0, 0.0])), caption=lines, reach=reach,
        size_px=size_px, over=over,
    )  # fmt: skip


def _grid(camera: Camera) -> Float64Array:
    columns = (np.arange(_GRID[0]) + 0.5) * camera.width / _GRID[0]
    rows = (np.arange(_GRID[1]) + 0.5) * camera.height / _GRID[1]
    return np.stack(np.meshgrid(columns, rows), axis=-1).reshape(-1, 2)


def _correction(calibration: CameraCalibration, timestamp_ns: int) -> RigidTransform:
    if calibration.poses is None:
        return RigidTransform.identity()
    pose = calibration.poses.held(np.array([timestamp_ns], np.int64))
    return RigidTransform.from_quaternion(pose.positions[0], pose.quaternions_xyzw[0])


def _trajectory(scene: Scene) -> Poses | None:
    """Some way through the world: an odometry sensor's, else a trajectory's, else a lidar's."""
    for sensor in scene.sensors:
        if isinstance(sensor, OdometrySensor) and not sensor.poses.static:
            return sensor.poses
    for trajectory in scene.trajectories.values():
        if trajectory.quaternions_xyzw is not None:
            return trajectory.poses
    lidars = [
        s.poses for s in scene.sensors if isinstance(s, LidarSensor | CameraSensor) and s.poses is not None
    ]
    return lidars[0] if lidars else None


def _adjusted(trajectory: Poses, adjustment: Poses) -> Float64Array:
    """P' = A(t) p; beyond its ends the adjustment holds."""
    at = adjustment.held(trajectory.timestamps_ns)
    return rotate_vectors(at.quaternions_xyzw, trajectory.positions) + at.positions
