"""The cameras of a manifest: camera model, mounting, and images from files or from a video."""

from collections.abc import Mapping
from typing import Any

import numpy as np

from sceneloom.arrays import Int64Array
from sceneloom.cameras.camera import Camera
from sceneloom.errors import DataError
from sceneloom.formats.rig.camera_models import frame_from_camera, read_camera_model
from sceneloom.formats.rig.drive import Drive
from sceneloom.formats.rig.images import IMAGE_SUFFIXES, ImageReader, image_size
from sceneloom.formats.rig.records import Record
from sceneloom.formats.rig.times import drop_unreadable
from sceneloom.formats.rig.transforms import frame_from_optical
from sceneloom.formats.rig.videos import VideoFile, VideoImages
from sceneloom.geometry.rigid import RigidTransform
from sceneloom.scene.cameras import CameraSensor
from sceneloom.scene.frames import LazyFrames
from sceneloom.scene.shutter import LONGEST_ROLL_S
from sceneloom.scene.types import NO_FIELDS
from sceneloom.scene.warnings import WarningKind

_RATIO_ERROR = 0.01


def build_camera(drive: Drive, record: Record, location: str) -> CameraSensor:
    """Build a camera; the head of its first image is read.

    Raises:
        DataError: images are missing or wrong, or the manifest contradicts them.
        CalibrationError: the camera model is unusable, or it is not known where the camera is.
    """
    if ("files" in record) == ("video" in record):
        found = "files and video" if "files" in record else "neither files nor video"
        raise DataError(drive.manifest.path, location, f"{found}; expected one of them")
    return (_from_files if "files" in record else _from_video)(drive, record, location)


def _mount(drive: Drive, record: Record) -> RigidTransform:
    axes = frame_from_optical(record.get("axes", ("optical",)))
    return drive.mount(record) @ axes @ frame_from_camera(record["camera_model"])


def _from_files(drive: Drive, record: Record, location: str) -> CameraSensor:
    root = drive.root(record, location)
    files = root.files(record["files"], f"{location}.files")
    for path in files:
        if path.suffix.lower() not in IMAGE_SUFFIXES:
            problem = f"{path.name!r}; expected files that end with {' '.join(IMAGE_SUFFIXES)}"
            raise DataError(drive.manifest.path, f"{location}.files", problem)
    timestamps = drive.time_source(record, location).timestamp_files(files)
    if not len(timestamps.chosen):
        raise DataError(drive.manifest.path, f"{location}.files", "none of the files has a time")
    timestamps = drop_unreadable(timestamps, lambda k: image_size(files[k]), drive.ledger)
    camera_model = _fitted_camera_model(drive, record, location, image_size(files[timestamps.chosen[0]]))
    mount = _mount(drive, record)
    used = tuple(files[k] for k in timestamps.chosen)
    reader = ImageReader(used, tuple(map(root.relative, used)), timestamps.timestamps_ns, camera_model)
    return CameraSensor(
        id=record["id"],
        camera=camera_model,
        images=LazyFrames(timestamps.timestamps_ns, reader),
        poses=drive.poses(mount, timestamps.timestamps_ns),
        mount=mount,
        extras=_shutter(drive, record, location),
    )


def _from_video(drive: Drive, record: Record, location: str) -> CameraSensor:
    path = drive.root(record, location).file(record["video"], f"{location}.video")
    video = VideoFile(path)
    drive.videos.append(video)
    reader = video.whole_or_left(drive.ledger)
    camera_model = _fitted_camera_model(drive, record, location, (reader.width, reader.height))
    mount = _mount(drive, record)
    source = drive.time_source(record, location)
    timestamps = source.timestamp_images(reader.count, video.container_ns, path.name)
    return CameraSensor(
        id=record["id"],
        camera=camera_model,
        images=LazyFrames(
            timestamps.timestamps_ns,
            VideoImages(video, timestamps.chosen, timestamps.timestamps_ns, camera_model),
        ),
        poses=drive.poses(mount, timestamps.timestamps_ns),
        mount=mount,
        video=video.content(timestamps.chosen),
        fps=_fps(record, reader.fps, np.diff(timestamps.timestamps_ns)),
        extras=_shutter(drive, record, location),
    )


def _shutter(drive: Drive, record: Record, location: str) -> Mapping[str, Any]:
    """What the manifest says of a rolling shutter, in the words in which recordings keep it."""
    if "shutter_roll_s" not in record:
        return NO_FIELDS
    seconds = record["shutter_roll_s"] / 1e9
    if seconds > LONGEST_ROLL_S:
        problem = f"{seconds:g} s; expected at most {LONGEST_ROLL_S:g} s"
        raise DataError(drive.manifest.path, f"{location}.shutter_roll_s", problem)
    entry = {"shutterRollTimeSeconds": seconds}
    left_to_right = {"rollingShutterLeftToRight": True} if record.get("shutter_left_to_right") else {}
    return {"calibration": entry | left_to_right}


def _fps(record: Record, nominal: float | None, intervals_ns: Int64Array) -> float | None:
    stated = record["times"].get("rate_hz")
    if stated is not None:
        return float(stated)
    return 1e9 / float(np.median(intervals_ns)) if len(intervals_ns) else nominal


def _fitted_camera_model(drive: Drive, record: Record, location: str, size: tuple[int, int]) -> Camera:
    """Give the camera model for the images as they are, with a warning where its numbers are for another size."""
    calibrated = read_camera_model(record["camera_model"], size)
    if (calibrated.width, calibrated.height) == size:
        return calibrated
    sizes = f"{calibrated.width}x{calibrated.height}, the images are {size[0]}x{size[1]}"
    ratio = (size[0] / calibrated.width) / (size[1] / calibrated.height)
    if abs(ratio - 1.0) > _RATIO_ERROR:
        swapped = (calibrated.height, calibrated.width) == size
        meant = (
            "are width and height exchanged?" if swapped else "if they were cut, cx and cy move with the cut"
        )
        problem = f"for {sizes}, another shape; expected the numbers of the images as they are; {meant}"
        raise DataError(drive.manifest.path, f"{location}.camera model", problem)
    message = f"the numbers are for {sizes}; the camera model was scaled"
    drive.ledger.note(
        WarningKind.REPAIRED,
        "camera-model-scaled",
        f"{drive.manifest.path}: {location}.camera model",
        message,
    )
    return calibrated.resized(*size)
