"""The cameras of a manifest: camera model, extrinsics, and images from files or from a video."""

from collections.abc import Mapping
from difflib import get_close_matches
from typing import Any

import numpy as np

from sceneloom.arrays import Float64Array, Int64Array
from sceneloom.cameras.camera import MODELS, Camera
from sceneloom.cameras.projection import check_camera
from sceneloom.errors import CalibrationError, DataError
from sceneloom.formats.base.images import IMAGE_SUFFIXES, ImageReader, images_image_size
from sceneloom.formats.rig.manifest import drop_unreadable
from sceneloom.formats.rig.schema import Record
from sceneloom.formats.rig.transforms import Drive, frame_from_optical
from sceneloom.formats.video.reader import VideoFile, VideoImages
from sceneloom.geometry.rigid import RigidTransform
from sceneloom.scene.cameras import LONGEST_ROLL_S, CameraSensor
from sceneloom.scene.frames import LazyFrames
from sceneloom.scene.types import NO_FIELDS
from sceneloom.warnings import WarningKind

_MODEL_ALIASES: Mapping[str, str] = {
    "opencv": "brown_conrady",
    "plumb_bob": "brown_conrady",
    "radtan": "brown_conrady",
    "rational_polynomial": "brown_conrady",
    "equidistant": "fisheye",
    "opencv_fisheye": "fisheye",
    "kannala_brandt": "fisheye",
    "kannala_brandt4": "fisheye",
    "fisheye624": "fisheye_rad_tan_prism",
}
"""Names that ROS, OpenCV and others have for models of the table."""

_OPENCV_LENGTHS = (0, 4, 5, 8, 12, 14)

_OPENCV_NAMES = ("k1", "k2", "p1", "p2", "k3", "k4", "k5", "k6", "s1", "s2", "s3", "s4", "tx", "ty")
"""Source: "Camera Calibration and 3D Reconstruction" of the OpenCV documentation."""

_SKEW = 1e-3


def read_camera_model(record: Record, image_size: tuple[int, int]) -> Camera:
    """Build the camera model, for the image size that its numbers hold for.

    Args:
        record: the `camera_model` of a camera.
        image_size: width and height of the images [px], taken where the record names none.

    Raises:
        CalibrationError: it says too much or too little, or a number is impossible.
    """
    fx, fy, cx, cy = _pinhole(record)
    if ("width" in record) != ("height" in record):
        raise CalibrationError("width without height; expected both or neither")
    given = record.get("coefficients", [])
    model = _model(record, given)
    used = [] if record.get("undistorted", False) else given
    size = (record["width"], record["height"]) if "width" in record else image_size
    if record.get("undistorted", False):
        model = "pinhole"
    camera = Camera(model, size[0], size[1], fx, fy, cx, cy, _coefficients(model, used))
    check_camera(camera)
    return camera


def frame_from_camera(record: Record) -> RigidTransform:
    """The shift that a projection matrix P = K·[I t] has in it: p_camera = p_frame + t."""
    if "P" not in record:
        return RigidTransform.identity()
    return RigidTransform(np.eye(3), -np.linalg.solve(record["P"][:, :3], record["P"][:, 3]))


def _pinhole(record: Record) -> tuple[float, float, float, float]:
    forms = [form for form in ("fx", "K", "P") if form in record]
    if len(forms) != 1:
        raise CalibrationError(
            f"{' and '.join(forms) or 'no focal length'}; expected one of fx fy cx cy, K, P"
        )
    if forms == ["fx"]:
        missing = [name for name in ("cx", "cy") if name not in record]
        if missing:
            raise CalibrationError(f"{' and '.join(missing)} missing; expected fx fy cx cy [px]")
        fx: float = record["fx"]
        return fx, record.get("fy", fx), record["cx"], record["cy"]
    beside = [name for name in ("fy", "cx", "cy") if name in record]
    if beside:
        raise CalibrationError(f"{forms[0]} beside {', '.join(beside)}; expected one of them")
    matrix: Float64Array = record[forms[0]][:, :3]
    rest = np.array([matrix[0, 1], matrix[1, 0], matrix[2, 0], matrix[2, 1], matrix[2, 2] - 1.0])
    if np.abs(rest).max() > _SKEW:
        raise CalibrationError(
            f"{forms[0]} {matrix.tolist()}; expected [fx 0 cx; 0 fy cy; 0 0 1], row by row"
        )
    return float(matrix[0, 0]), float(matrix[1, 1]), float(matrix[0, 2]), float(matrix[1, 2])


def _model(record: Record, given: Any) -> str:
    name = record.get("model")
    if name is None:
        return "brown_conrady" if given else "pinhole"
    plain = name.lower().replace("-", "_").replace(" ", "_")
    model = _MODEL_ALIASES.get(plain, plain)
    if model not in MODELS:
        known = [*MODELS, *_MODEL_ALIASES]
        close = get_close_matches(plain, known, 1, 0.6)
        hint = f"; did you mean {close[0]!r}?" if close else ""
        raise CalibrationError(f"model {name!r}; expected one of {', '.join(known)}{hint}")
    return "brown_conrady" if model == "pinhole" and given else model


def _coefficients(model: str, given: list[float] | dict[str, float]) -> tuple[float, ...]:
    names = MODELS[model].coefficient_names
    if isinstance(given, dict):
        unknown = [name for name in given if name not in names]
        if unknown:
            raise CalibrationError(
                f"coefficients {', '.join(unknown)}; {model} has {' '.join(names) or 'none'}"
            )
        return tuple(given.get(name, 0.0) for name in names) if given else ()
    if model != "brown_conrady":
        return tuple(given)
    if len(given) not in _OPENCV_LENGTHS:
        lengths = ", ".join(map(str, _OPENCV_LENGTHS))
        raise CalibrationError(
            f"{len(given)} coefficients; expected {lengths} in OpenCV's order: {' '.join(_OPENCV_NAMES)}"
        )
    by_name = dict(zip(_OPENCV_NAMES, given, strict=False))
    return tuple(by_name.get(name, 0.0) for name in names) if len(given) > 8 else tuple(given)


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
    timestamps = drop_unreadable(timestamps, lambda k: images_image_size(files[k]), drive.ledger)
    camera_model = _fitted_camera_model(
        drive, record, location, images_image_size(files[timestamps.chosen[0]])
    )
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
