"""A scene as a drive of KITTI's raw data: one frame of all sensors (`sync`), or each sensor by itself (`extract`)."""

import re
from pathlib import Path

import numpy as np

from sceneloom.arrays import Int64Array
from sceneloom.errors import OptionError
from sceneloom.formats.kitti.raw.timestamps import format_timestamp
from sceneloom.formats.kitti.raw.tracklets import FILE as TRACKLETS
from sceneloom.formats.kitti.raw.tracklets import format_tracklets
from sceneloom.formats.kitti.raw.written_calibration import write_raw_calibration
from sceneloom.formats.kitti.raw.written_sweeps import RotationWriter
from sceneloom.formats.kitti.raw.written_tracklets import tracklets_of
from sceneloom.formats.kitti.scenes.inertial import IMU_ID
from sceneloom.formats.kitti.spec import RAW_CAMERAS
from sceneloom.formats.kitti.written.choice import (
    PARALLEL_WITHIN,
    Choice,
    choose,
    dropped_parts,
    ego_trajectory,
)
from sceneloom.formats.kitti.written.files import check_camera_model, image_losses, write_image
from sceneloom.formats.kitti.written.locations import egos_at, is_lidar, mounted_of
from sceneloom.formats.kitti.written.oxts_lines import oxts_lines
from sceneloom.formats.kitti.written.target import kept_of
from sceneloom.formats.kitti.written.timeline import NONE, Timeline, timeline_of
from sceneloom.formats.loss import Loss, LossReport
from sceneloom.formats.output import FolderKind, replacing
from sceneloom.formats.recording.written_mounts import mounting
from sceneloom.geometry.rotations import angle_between
from sceneloom.scene.annotations.cuboids import CuboidAnnotation
from sceneloom.scene.cameras import CameraSensor
from sceneloom.scene.clouds import LidarSensor
from sceneloom.scene.motion import GnssSensor, ImuSensor, OdometrySensor
from sceneloom.scene.scene import Scene

SLOTS = (2, 3, 0, 1)
"""Numbers of cameras, those of the coloured ones first."""

HELD = frozenset({LidarSensor, CameraSensor, ImuSensor, GnssSensor, OdometrySensor, CuboidAnnotation})
"""Kinds of sensors and annotations that a drive has a location for."""

_MODELS = {"sync": frozenset({"pinhole"}), "extract": frozenset({"pinhole", "brown_conrady"})}
_DRIVE = re.compile(r"(\d{4}_\d\d_\d\d)_drive_(\d{4})_(sync|extract)")

_DRIVE_PATH = r"\d{4}_\d\d_\d\d/(?P<one>.+)"
_KIND = FolderKind(
    "folder of KITTI's raw data",
    (
        r"\d{4}_\d\d_\d\d/calib_\w+\.txt",
        rf"{_DRIVE_PATH}/(velodyne_points|oxts|image_\d\d)/timestamps\w*\.txt",
        rf"{_DRIVE_PATH}/(velodyne_points|oxts|image_\d\d)/data/\d{{10}}\.(bin|txt|png|jpe?g)",
        rf"{_DRIVE_PATH}/{re.escape(TRACKLETS)}",
    ),
    r"\d{4}_\d\d_\d\d/calib_\w+\.txt",
)


def write_raw(
    scene: Scene, path: Path, *, overwrite: bool = False, kind: str | None = None, sequence: str | None = None
) -> LossReport:
    """Write a scene as a drive in the folder of its day.

    Args:
        scene: to be written.
        path: the folder above the day's.
        overwrite: replace a folder of such drives as a whole.
        kind: "sync", one frame of all sensors with rectified images, or "extract", each sensor by itself with the
            camera models' distortion; None for "sync" where all images are of camera models without distortion that
            look the same way, one for each sweep.
        sequence: number of the drive, four digits; None for that which the scene was read from, else "0001".

    Returns:
        What the folder could not hold.

    Raises:
        OptionError: the kind or the number is none.
        OutputError: the path exists, or cannot be written.
        DataError: what the scene is read from is damaged.
    """
    if kind not in (None, *_MODELS):
        raise OptionError(f"kind {kind!r}; expected one of {', '.join(_MODELS)}")
    kind = kind or _kind_of(scene)
    choice = choose(scene, SLOTS, rectified=kind == "sync", models=_MODELS[kind])
    losses = [*dropped_parts(scene, HELD), *choice.losses]
    day, drive = _names(scene, choice, kind, sequence)
    with replacing(path, overwrite=overwrite, folder=_KIND) as draft:
        folder = draft / day / drive
        folder.mkdir(parents=True)
        with_imu = choice.ego_path is not None or not is_lidar(choice)
        mounted = mounted_of(choice, with_imu=with_imu)
        kept = kept_of(scene)
        reported = kept.get("calibration") if kept.get("benchmark") == "raw" else None
        write_raw_calibration(draft / day, mounted, reported, rectified=kind == "sync")
        timeline = timeline_of(choice, one_time=False)
        if kind == "sync":
            losses += timeline.losses
            times, reported = _write_sync(choice, timeline, folder)
        else:
            times, reported = _write_extract(choice, timeline.timestamps_ns, folder)
        losses += reported
        losses += _write_oxts(scene, choice, _oxts_times(choice, times, kind), folder / "oxts")
        losses += _write_tracklets(choice, times, timeline, folder)
    return LossReport.of(losses)


def _kind_of(scene: Scene) -> str:
    """The kind that holds most: `extract` for images that are distorted, rotated, or not one for each sweep."""
    kept = kept_of(scene)
    if kept.get("benchmark") == "raw":
        return "sync" if kept.get("rectified", True) else "extract"
    path = ego_trajectory(scene)
    mounts = [
        mount for camera in scene.cameras if (mount := mounting(camera, path, each=True)[0]) is not None
    ]
    if any(camera.camera.model == "brown_conrady" for camera in scene.cameras):
        return "extract"
    if any(
        float(angle_between(mount.quaternion_xyzw, mounts[0].quaternion_xyzw)) > PARALLEL_WITHIN
        for mount in mounts
    ):
        return "extract"
    counts = {len(camera.images) for camera in scene.cameras if len(camera.images)}
    counts |= {len(lidar.frames) for lidar in scene.lidars[:1]}
    return "sync" if len(counts) <= 1 else "extract"


def _names(scene: Scene, choice: Choice, kind: str, sequence: str | None) -> tuple[str, str]:
    """Names of the day's folder and of the drive's."""
    kept = _DRIVE.fullmatch(str(kept_of(scene).get("drive", "")))
    number = sequence or (kept[2] if kept else "0001")
    if not (number.isascii() and number.isdigit() and len(number) <= 4):
        raise OptionError(f"sequence {number!r}; expected up to four digits, as 0001")
    timestamps = [] if choice.lidar is None else [choice.lidar.frames.timestamps_ns]
    timestamps += [camera.images.timestamps_ns for camera in choice.cameras.values()]
    first = min((int(times[0]) for times in timestamps if len(times)), default=0)
    day = kept[1] if kept else format_timestamp(first)[:10].replace("-", "_")
    return day, f"{day}_drive_{int(number):04d}_{kind}"


def _write_sync(choice: Choice, timeline: Timeline, folder: Path) -> tuple[Int64Array, list[Loss]]:
    """Write sweeps and images; gives the times of frames as they are reported, and what was lost."""
    losses = [loss for camera in choice.cameras.values() for loss in image_losses(camera)]
    lidar = choice.lidar
    rotations = (
        RotationWriter(choice, folder / "velodyne_points")
        if lidar is not None and len(lidar.frames)
        else None
    )
    timestamps: dict[int, list[str]] = {number: [] for number, c in choice.cameras.items() if len(c.images)}
    for number in timestamps:
        (folder / RAW_CAMERAS[number] / "data").mkdir(parents=True)
    for k in range(len(timeline)):
        sweep = int(timeline.sweeps[k])
        if rotations is not None and lidar is not None and sweep != NONE:
            rotations.write(lidar.frames[sweep], k)
        for number, lines in timestamps.items():
            row = int(timeline.images[number][k])
            if row == NONE:
                lines.append("")
                continue
            image = choice.cameras[number].images[row]
            check_camera_model(choice.cameras[number], image)
            write_image(image, folder / RAW_CAMERAS[number] / "data" / f"{k:010d}.png")
            lines.append(format_timestamp(image.timestamp_ns))
    for number, lines in timestamps.items():
        _write_lines(folder / RAW_CAMERAS[number] / "timestamps.txt", lines)
    if rotations is None:
        return timeline.timestamps_ns, losses
    return rotations.moments_ns(timeline.timestamps_ns), losses + rotations.close()


def _write_extract(choice: Choice, times: Int64Array, folder: Path) -> tuple[Int64Array, list[Loss]]:
    """Write sweeps and images; gives the times of sweeps as they are reported, else `times`, and what was lost."""
    losses = [loss for camera in choice.cameras.values() for loss in image_losses(camera)]
    if choice.lidar is not None and len(choice.lidar.frames):
        rotations = RotationWriter(choice, folder / "velodyne_points")
        for k, frame in enumerate(choice.lidar.frames):
            rotations.write(frame, k)
        times = rotations.moments_ns(choice.lidar.frames.timestamps_ns)
        losses += rotations.close()
    for number, camera in choice.cameras.items():
        if not len(camera.images):
            continue
        location = folder / RAW_CAMERAS[number]
        (location / "data").mkdir(parents=True)
        for k, image in enumerate(camera.images):
            check_camera_model(camera, image)
            write_image(image, location / "data" / f"{k:010d}.png")
        timestamps = [format_timestamp(time) for time in camera.images.timestamps_ns.tolist()]
        _write_lines(location / "timestamps.txt", timestamps)
    return times, losses


def _write_lines(path: Path, lines: list[str]) -> None:
    path.write_text("".join(f"{line}\n" for line in lines), "utf-8", newline="\n")


def _oxts_times(choice: Choice, times: Int64Array, kind: str) -> Int64Array:
    """When lines of the OXTS unit are: those that were read, else one for each frame, or for each value of the IMU."""
    path = choice.ego_path
    units = [sensor for sensor in choice.scene.sensors if isinstance(sensor, ImuSensor)]
    imu = next((sensor for sensor in units if sensor.streams), None)
    if imu is not None and imu.id == IMU_ID and kept_of(choice.scene).get("benchmark") == "raw":
        return next(iter(imu.streams.values())).timestamps_ns
    if kind == "sync" or path is None or path.static:
        return times
    timestamps = path.timestamps_ns
    if imu is not None and "accelerometer" in imu.streams:
        timestamps = imu.streams["accelerometer"].timestamps_ns
    inside: Int64Array = np.unique(timestamps[(timestamps >= path.start_ns) & (timestamps <= path.stop_ns)])
    return inside if len(inside) else path.timestamps_ns


def _write_oxts(scene: Scene, choice: Choice, times: Int64Array, folder: Path) -> list[Loss]:
    if choice.ego_path is None or not len(times):
        return []
    lines = oxts_lines(scene, choice.ego_path, times)
    (folder / "data").mkdir(parents=True)
    for k, line in enumerate(lines.texts()):
        (folder / "data" / f"{k:010d}.txt").write_text(f"{line}\n", "utf-8", newline="\n")
    _write_lines(folder / "timestamps.txt", [format_timestamp(time) for time in times.tolist()])
    return list(lines.losses)


def _write_tracklets(choice: Choice, times: Int64Array, timeline: Timeline, folder: Path) -> list[Loss]:
    """Write the boxes in their frames; those of an `extract` are the sweeps."""
    if not any(isinstance(annotation, CuboidAnnotation) for annotation in choice.scene.annotations):
        return []
    tracklets, losses = tracklets_of(
        choice.scene,
        times,
        np.minimum(timeline.starts_ns(choice.lidar), times),
        None if choice.lidar is None else choice.lidar.id,
        lambda timestamps: [ego @ choice.ego_from_lidar for ego in egos_at(choice, timestamps)],
    )
    (folder / TRACKLETS).write_text(format_tracklets(tracklets), "utf-8", newline="\n")
    return losses
