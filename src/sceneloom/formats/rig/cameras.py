"""The cameras of a manifest: lens, mounting, and pictures from files or from a video."""

from collections.abc import Mapping
from typing import Any

import numpy as np

from sceneloom.arrays import Int64Array
from sceneloom.cameras.camera import Camera
from sceneloom.errors import DataError
from sceneloom.formats.rig.drive import Drive
from sceneloom.formats.rig.lenses import frame_from_camera, read_lens
from sceneloom.formats.rig.pictures import PICTURE_SUFFIXES, PictureReader, picture_size
from sceneloom.formats.rig.records import Record
from sceneloom.formats.rig.times import drop_unreadable
from sceneloom.formats.rig.transforms import frame_from_optical
from sceneloom.formats.rig.videos import VideoFile, VideoPictures
from sceneloom.geometry.rigid import RigidTransform
from sceneloom.scene.cameras import CameraSensor
from sceneloom.scene.frames import LazyFrames
from sceneloom.scene.notices import NoticeKind
from sceneloom.scene.shutter import LONGEST_ROLL_S
from sceneloom.scene.types import NO_FIELDS

_RATIO_ERROR = 0.01


def build_camera(drive: Drive, record: Record, place: str) -> CameraSensor:
    """Build a camera; the head of its first picture is read.

    Raises:
        DataError: pictures are missing or wrong, or the manifest contradicts them.
        CalibrationError: the lens is unusable, or it is not known where the camera is.
    """
    if ("files" in record) == ("video" in record):
        found = "files and video" if "files" in record else "neither files nor video"
        raise DataError(drive.manifest.path, place, f"{found}; expected one of them")
    return (_from_files if "files" in record else _from_video)(drive, record, place)


def _mount(drive: Drive, record: Record) -> RigidTransform:
    axes = frame_from_optical(record.get("axes", ("optical",)))
    return drive.mount(record) @ axes @ frame_from_camera(record["lens"])


def _from_files(drive: Drive, record: Record, place: str) -> CameraSensor:
    root = drive.root(record, place)
    files = root.files(record["files"], f"{place}.files")
    for path in files:
        if path.suffix.lower() not in PICTURE_SUFFIXES:
            problem = f"{path.name!r}; expected files that end with {' '.join(PICTURE_SUFFIXES)}"
            raise DataError(drive.manifest.path, f"{place}.files", problem)
    stamps = drive.time_source(record, place).stamp_files(files)
    if not len(stamps.chosen):
        raise DataError(drive.manifest.path, f"{place}.files", "none of the files has a time")
    stamps = drop_unreadable(stamps, lambda k: picture_size(files[k]), drive.ledger)
    lens = _fitted_lens(drive, record, place, picture_size(files[stamps.chosen[0]]))
    mount = _mount(drive, record)
    used = tuple(files[k] for k in stamps.chosen)
    reader = PictureReader(used, tuple(map(root.relative, used)), stamps.timestamps_ns, lens)
    return CameraSensor(
        id=record["id"],
        camera=lens,
        pictures=LazyFrames(stamps.timestamps_ns, reader),
        poses=drive.poses(mount, stamps.timestamps_ns),
        mount=mount,
        extras=_shutter(drive, record, place),
    )


def _from_video(drive: Drive, record: Record, place: str) -> CameraSensor:
    path = drive.root(record, place).file(record["video"], f"{place}.video")
    video = VideoFile(path)
    drive.videos.append(video)
    reader = video.whole_or_left(drive.ledger)
    lens = _fitted_lens(drive, record, place, (reader.width, reader.height))
    mount = _mount(drive, record)
    source = drive.time_source(record, place)
    stamps = source.stamp_pictures(reader.count, video.container_ns, path.name)
    return CameraSensor(
        id=record["id"],
        camera=lens,
        pictures=LazyFrames(
            stamps.timestamps_ns, VideoPictures(video, stamps.chosen, stamps.timestamps_ns, lens)
        ),
        poses=drive.poses(mount, stamps.timestamps_ns),
        mount=mount,
        video=video.content(stamps.chosen),
        fps=_fps(record, reader.fps, np.diff(stamps.timestamps_ns)),
        extras=_shutter(drive, record, place),
    )


def _shutter(drive: Drive, record: Record, place: str) -> Mapping[str, Any]:
    """What the manifest says of a rolling shutter, in the words in which recordings keep it."""
    if "shutter_roll_s" not in record:
        return NO_FIELDS
    seconds = record["shutter_roll_s"] / 1e9
    if seconds > LONGEST_ROLL_S:
        problem = f"{seconds:g} s; expected at most {LONGEST_ROLL_S:g} s"
        raise DataError(drive.manifest.path, f"{place}.shutter_roll_s", problem)
    entry = {"shutterRollTimeSeconds": seconds}
    left_to_right = {"rollingShutterLeftToRight": True} if record.get("shutter_left_to_right") else {}
    return {"calibration": entry | left_to_right}


def _fps(record: Record, nominal: float | None, intervals_ns: Int64Array) -> float | None:
    said = record["times"].get("rate_hz")
    if said is not None:
        return float(said)
    return 1e9 / float(np.median(intervals_ns)) if len(intervals_ns) else nominal


def _fitted_lens(drive: Drive, record: Record, place: str, size: tuple[int, int]) -> Camera:
    """Give the lens for the pictures as they are, with a notice where its numbers are for another size."""
    calibrated = read_lens(record["lens"], size)
    if (calibrated.width, calibrated.height) == size:
        return calibrated
    sizes = f"{calibrated.width}x{calibrated.height}, the pictures are {size[0]}x{size[1]}"
    ratio = (size[0] / calibrated.width) / (size[1] / calibrated.height)
    if abs(ratio - 1.0) > _RATIO_ERROR:
        swapped = (calibrated.height, calibrated.width) == size
        meant = (
            "are width and height exchanged?" if swapped else "if they were cut, cx and cy move with the cut"
        )
        problem = f"for {sizes}, another shape; expected the numbers of the pictures as they are; {meant}"
        raise DataError(drive.manifest.path, f"{place}.lens", problem)
    message = f"the numbers are for {sizes}; the lens was scaled"
    drive.ledger.note(NoticeKind.REPAIRED, "lens-scaled", f"{drive.manifest.path}: {place}.lens", message)
    return calibrated.resized(*size)
