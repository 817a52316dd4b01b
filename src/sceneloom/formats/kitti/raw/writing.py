"""A scene as a drive of KITTI's raw data: one frame of all sensors (`sync`), or each sensor by itself (`extract`)."""

import re
from pathlib import Path

import numpy as np

from sceneloom.arrays import Int64Array
from sceneloom.errors import OptionError
from sceneloom.formats.kitti.raw.stamps import format_stamp
from sceneloom.formats.kitti.raw.tracklets import FILE as TRACKLETS
from sceneloom.formats.kitti.raw.tracklets import format_tracklets
from sceneloom.formats.kitti.raw.written_calibration import write_raw_calibration
from sceneloom.formats.kitti.raw.written_sweeps import TurnWriter
from sceneloom.formats.kitti.raw.written_tracklets import tracklets_of
from sceneloom.formats.kitti.scenes.inertial import IMU_ID
from sceneloom.formats.kitti.spec import RAW_CAMERAS
from sceneloom.formats.kitti.written.choice import PARALLEL_WITHIN, Choice, choose, dropped_parts, ego_way
from sceneloom.formats.kitti.written.files import check_lens, picture_losses, write_picture
from sceneloom.formats.kitti.written.oxts_lines import oxts_lines
from sceneloom.formats.kitti.written.places import egos_at, is_lidar, mounted_of
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
"""Kinds of sensors and annotations that a drive has a place for."""

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
        kind: "sync", one frame of all sensors with rectified pictures, or "extract", each sensor by itself with the
            lenses' distortion; None for "sync" where all pictures are of lenses without distortion that look the same
            way, one for each sweep.
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
        told = kept.get("calibration") if kept.get("benchmark") == "raw" else None
        write_raw_calibration(draft / day, mounted, told, rectified=kind == "sync")
        timeline = timeline_of(choice, one_time=False)
        if kind == "sync":
            losses += timeline.losses
            times, told = _write_sync(choice, timeline, folder)
        else:
            times, told = _write_extract(choice, timeline.timestamps_ns, folder)
        losses += told
        losses += _write_oxts(scene, choice, _oxts_times(choice, times, kind), folder / "oxts")
        losses += _write_tracklets(choice, times, timeline, folder)
    return LossReport.of(losses)


def _kind_of(scene: Scene) -> str:
    """The kind that holds most: `extract` for pictures that are distorted, turned, or not one for each sweep."""
    kept = kept_of(scene)
    if kept.get("benchmark") == "raw":
        return "sync" if kept.get("rectified", True) else "extract"
    path = ego_way(scene)
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
    counts = {len(camera.pictures) for camera in scene.cameras if len(camera.pictures)}
    counts |= {len(lidar.frames) for lidar in scene.lidars[:1]}
    return "sync" if len(counts) <= 1 else "extract"


def _names(scene: Scene, choice: Choice, kind: str, sequence: str | None) -> tuple[str, str]:
    """Names of the day's folder and of the drive's."""
    kept = _DRIVE.fullmatch(str(kept_of(scene).get("drive", "")))
    number = sequence or (kept[2] if kept else "0001")
    if not (number.isascii() and number.isdigit() and len(number) <= 4):
        raise OptionError(f"sequence {number!r}; expected up to four digits, as 0001")
    stamps = [] if choice.lidar is None else [choice.lidar.frames.timestamps_ns]
    stamps += [camera.pictures.timestamps_ns for camera in choice.cameras.values()]
    first = min((int(times[0]) for times in stamps if len(times)), default=0)
    day = kept[1] if kept else format_stamp(first)[:10].replace("-", "_")
    return day, f"{day}_drive_{int(number):04d}_{kind}"


def _write_sync(choice: Choice, timeline: Timeline, folder: Path) -> tuple[Int64Array, list[Loss]]:
    """Write sweeps and pictures; gives the times of frames as they are told, and what was lost."""
    losses = [loss for camera in choice.cameras.values() for loss in picture_losses(camera)]
    lidar = choice.lidar
    turns = (
        TurnWriter(choice, folder / "velodyne_points") if lidar is not None and len(lidar.frames) else None
    )
    stamps: dict[int, list[str]] = {number: [] for number, c in choice.cameras.items() if len(c.pictures)}
    for number in stamps:
        (folder / RAW_CAMERAS[number] / "data").mkdir(parents=True)
    for k in range(len(timeline)):
        sweep = int(timeline.sweeps[k])
        if turns is not None and lidar is not None and sweep != NONE:
            turns.write(lidar.frames[sweep], k)
        for number, lines in stamps.items():
            row = int(timeline.pictures[number][k])
            if row == NONE:
                lines.append("")
                continue
            picture = choice.cameras[number].pictures[row]
            check_lens(choice.cameras[number], picture)
            write_picture(picture, folder / RAW_CAMERAS[number] / "data" / f"{k:010d}.png")
            lines.append(format_stamp(picture.timestamp_ns))
    for number, lines in stamps.items():
        _write_lines(folder / RAW_CAMERAS[number] / "timestamps.txt", lines)
    if turns is None:
        return timeline.timestamps_ns, losses
    return turns.moments_ns(timeline.timestamps_ns), losses + turns.close()


def _write_extract(choice: Choice, times: Int64Array, folder: Path) -> tuple[Int64Array, list[Loss]]:
    """Write sweeps and pictures; gives the times of sweeps as they are told, else `times`, and what was lost."""
    losses = [loss for camera in choice.cameras.values() for loss in picture_losses(camera)]
    if choice.lidar is not None and len(choice.lidar.frames):
        turns = TurnWriter(choice, folder / "velodyne_points")
        for k, frame in enumerate(choice.lidar.frames):
            turns.write(frame, k)
        times = turns.moments_ns(choice.lidar.frames.timestamps_ns)
        losses += turns.close()
    for number, camera in choice.cameras.items():
        if not len(camera.pictures):
            continue
        place = folder / RAW_CAMERAS[number]
        (place / "data").mkdir(parents=True)
        for k, picture in enumerate(camera.pictures):
            check_lens(camera, picture)
            write_picture(picture, place / "data" / f"{k:010d}.png")
        stamps = [format_stamp(time) for time in camera.pictures.timestamps_ns.tolist()]
        _write_lines(place / "timestamps.txt", stamps)
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
    if kind == "sync" or path is None or path.endless:
        return times
    stamps = path.timestamps_ns
    if imu is not None and "accelerometer" in imu.streams:
        stamps = imu.streams["accelerometer"].timestamps_ns
    inside: Int64Array = np.unique(stamps[(stamps >= path.start_ns) & (stamps <= path.stop_ns)])
    return inside if len(inside) else path.timestamps_ns


def _write_oxts(scene: Scene, choice: Choice, times: Int64Array, folder: Path) -> list[Loss]:
    if choice.ego_path is None or not len(times):
        return []
    lines = oxts_lines(scene, choice.ego_path, times)
    (folder / "data").mkdir(parents=True)
    for k, line in enumerate(lines.texts()):
        (folder / "data" / f"{k:010d}.txt").write_text(f"{line}\n", "utf-8", newline="\n")
    _write_lines(folder / "timestamps.txt", [format_stamp(time) for time in times.tolist()])
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
        lambda stamps: [ego @ choice.ego_from_lidar for ego in egos_at(choice, stamps)],
    )
    (folder / TRACKLETS).write_text(format_tracklets(tracklets), "utf-8", newline="\n")
    return losses
