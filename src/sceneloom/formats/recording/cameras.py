"""The cameras and depth cameras of a recording: intrinsics, extrinsics, images.

Poses and time offsets brought together.
"""

import math
from collections.abc import Callable, Mapping
from dataclasses import dataclass, replace
from functools import partial
from pathlib import Path
from types import MappingProxyType
from typing import Any

import numpy as np

from sceneloom.arrays import Float32Array, Int64Array
from sceneloom.cameras.camera import Camera
from sceneloom.errors import CalibrationError, DataError
from sceneloom.formats.base.diagnostics import Ledger
from sceneloom.formats.base.files import FileIdentity
from sceneloom.formats.recording.calibration import (
    Calibration,
    CameraCalibration,
    camera_model,
    read_mount,
    read_parameters,
    read_texts,
)
from sceneloom.formats.recording.columns import CameraColumns, FrameColumns
from sceneloom.formats.recording.images import (
    ImageFiles,
    ImageTable,
    OpenImages,
    build_table,
    choose_images,
    expected_names,
    find_images,
    further_fields,
    maybe_cut_off,
    open_images,
    other_videos,
    unused_images,
)
from sceneloom.formats.video.reader import VideoReader, open_video
from sceneloom.geometry.rigid import RigidTransform
from sceneloom.geometry.rotations import angle_between
from sceneloom.scene.cameras import CameraSensor, DepthCameraSensor, DepthFrame, VideoContent
from sceneloom.scene.frames import LazyFrames
from sceneloom.scene.poses import Poses, poses_along
from sceneloom.warnings import WarningKind

_SHIFT_KEY = "imuToCameraShiftSeconds"

CAMERA_SHIFTS: Mapping[str, int] = {"ignore": 0, "apply": 1, "subtract": -1}
"""What becomes of `imuToCameraShiftSeconds`: by how many times it is added to the times of images.

The description of the format has no such field. "apply": t_imu = t_camera + shift (ASSUMED). "subtract": the sense in
which the open part of the vendor's software takes it.

Source: `imuToCameraShiftSeconds` in `codegen/parameter_definitions.c` and `src/odometry/sample_sync.cpp` of HybVIO.
"""


def _shift_of(calibration: CameraCalibration, camera_shift: str, ledger: Ledger) -> float:
    """Give what is to be added to the times of a camera's images [s], with a warning where the calibration has any."""
    if not calibration.shift:
        return 0.0
    factor, stated = CAMERA_SHIFTS[camera_shift], f"{_SHIFT_KEY} {calibration.shift}"
    code, message = {
        0: (
            "camera-shift-not-applied",
            f"{stated} is not applied: frame times are taken to be on the recording's clock",
        ),
        1: ("camera-shift-applied", f"{stated} was added to the times of the camera's images"),
        -1: ("camera-shift-applied", f"{stated} was taken off the times of the camera's images"),
    }[factor]
    ledger.note(WarningKind.ASSUMED, code, calibration.location, message)
    return factor * calibration.shift


def _entry_after(calibration: CameraCalibration, camera_shift: str) -> Mapping[str, Any]:
    """Give the entry that holds for the images as they are read: one that was applied is not in it any more."""
    if not CAMERA_SHIFTS[camera_shift]:
        return calibration.entry
    return {key: value for key, value in calibration.entry.items() if key != _SHIFT_KEY}


def applied_shifts(calibration: Calibration, camera_shift: str) -> dict[str, Any]:
    """Record which cameras' times were shifted, and by how much [s]; nothing where none was."""
    factor = CAMERA_SHIFTS[camera_shift]
    shifts = {
        f"camera{index}": factor * camera.shift
        for index, camera in calibration.cameras.items()
        if camera.shift
    }
    return {"camera_shifts": shifts} if factor and shifts else {}


_DEFAULT_SCALE = 0.001
"""Metres a step where nothing says it: the usual unit of depth cameras. ASSUMED, with a warning."""

_DEPTH_FORMAT = "gray16"
"""`colorFormat` of lines whose image holds depths."""

_LARGEST_SCALE = 100.0


def _holds_depth(files: ImageFiles | None) -> bool:
    """Whether images are 16-bit grey, and so hold depths."""
    return files is not None and files.has_steps


def _check_kind(files: ImageFiles, fields: Mapping[str, Any]) -> None:
    """Check that images are of the kind that the first line names.

    Args:
        files: the images.
        fields: what the first line says of the camera beside its columns.

    Raises:
        DataError: the line says that they hold depths, and they cannot.
    """
    if fields.get("colorFormat") == _DEPTH_FORMAT and not _holds_depth(files):
        problem = f"pixels are no 16-bit grey, while lines state colorFormat {_DEPTH_FORMAT!r}"
        raise DataError(
            files.name, "", f"{problem}; expected a lossless video of 16 bits, as FFV1 makes them"
        )


def _aligned_calibration(calibration: Calibration, index: int, ledger: Ledger) -> CameraCalibration | None:
    """Give the camera model and mounting of the camera that depth images without a calibration are aligned to.

    The first one.

    Returns:
        None where there is no other camera.
    """
    first = min((other for other in calibration.cameras if other != index), default=None)
    if first is None:
        return None
    message = (
        f"depth images of camera {index} have no calibration; taken to lie in the pixels of camera {first}"
    )
    ledger.note(WarningKind.ASSUMED, "depth-aligned", str(calibration.path), message)
    return replace(calibration.cameras[first], entry={})


def _depth_sensor(
    camera: CameraSensor, table: ImageTable, files: ImageFiles | None, ledger: Ledger
) -> DepthCameraSensor:
    """Make a camera with images of steps into one that measures depth.

    Args:
        camera: the same camera, as if its images were colours.
        table: its images.
        files: where they are.
        ledger: takes the warning of an assumed scale.
    """
    scale = table.first_fields().get("depthScale")
    if scale is None and len(table.seconds):
        message = f"no depthScale for camera {table.camera_index}; taken to be {_DEFAULT_SCALE:g} m a step"
        ledger.note(WarningKind.ASSUMED, "depth-scale-assumed", table.data_file.name, message)
    usual = _scale_of(_DEFAULT_SCALE if scale is None else scale, table)
    return DepthCameraSensor(
        id=camera.id,
        camera=camera.camera,
        frames=LazyFrames(table.timestamps_ns, partial(_frame, table=table, files=files, usual=usual)),
        poses=camera.poses,
        mount=camera.mount,
        coordinates=camera.coordinates,
        video=camera.video,
        fps=camera.fps,
        extras=camera.extras,
    )


def _scale_of(value: object, table: ImageTable) -> float:
    """Check a `depthScale`.

    Raises:
        DataError: it is no length.
    """
    is_number = isinstance(value, int | float) and not isinstance(value, bool)
    if not is_number or not 0 < float(value) <= _LARGEST_SCALE:  # type: ignore[arg-type]
        problem = f"frames[].depthScale: {value!r} of camera {table.camera_index}; expected metres a step"
        raise DataError(table.data_file.name, "", problem)
    return float(value)  # type: ignore[arg-type]


def _frame(k: int, *, table: ImageTable, files: ImageFiles | None, usual: float) -> DepthFrame:
    image = table.image(k, files=None)
    scale = _scale_of(image.extras.get("depthScale", usual), table)
    return DepthFrame(
        timestamp_ns=image.timestamp_ns,
        camera=image.camera,
        decode=partial(_metres, files, int(table.indices[k]), scale),
        scale=scale,
        mount=image.mount,
        extras=MappingProxyType(dict(image.extras)),
    )


def _metres(files: ImageFiles | None, index: int, scale: float) -> Float32Array:
    if files is None:
        raise DataError("", f"image {index}", "there are no images")
    # through float64: a step times a rounded scale is off by more than a step's own rounding
    return np.multiply(files.steps(index), scale, dtype=np.float64).astype(np.float32)


_SAME_M, _SAME_DEG = 1e-6, 1e-4
"""Mountings no further apart than this state the same."""


@dataclass(frozen=True, slots=True, eq=False)
class CameraSources:
    """What the cameras of a recording are built from.

    Attributes:
        folder: the recording.
        data_path: `data.jsonl`.
        data_file: the same, as it was when its lines were read.
        calibration: all of `calibration.json`.
        frames: the `frames` lines.
        ego_path: `world_from_ego` of the default trajectory, or None.
        ledger: takes warnings and faults.
        open_files: takes the images of the cameras that are built.
        camera_shift: what becomes of `imuToCameraShiftSeconds`, a key of `CAMERA_SHIFTS`.
        image_index: which image a `frames` line means, a key of `ALIGNMENTS`.
    """

    folder: Path
    data_path: Path
    data_file: FileIdentity
    calibration: Calibration
    frames: FrameColumns
    ego_path: Poses | None
    ledger: Ledger
    open_files: OpenImages
    camera_shift: str = "ignore"
    image_index: str = "auto"


def build_cameras(sources: CameraSources) -> list[CameraSensor | DepthCameraSensor]:
    """Build every camera that the calibration or a line names.

    Raises:
        DataError: images are missing, unreadable, or not as many as the lines state; or there is no calibration.
        CalibrationError: a camera model or a mounting is unusable.
    """
    cameras: list[CameraSensor | DepthCameraSensor] = []
    for index in sorted({*sources.calibration.cameras, *sources.frames.cameras}):
        try:
            cameras.extend(_build(sources, index))
        except (DataError, CalibrationError) as error:
            sources.ledger.fault(_fault_code(sources, index), error)
    _note_unused(sources)
    return cameras


def _fault_code(sources: CameraSources, index: int) -> str:
    """What kind of fault it is that a camera cannot be built: one that no calibration reports can do so any time."""
    entries = sources.frames.cameras.get(index, CameraColumns()).parameters
    untold = index not in sources.calibration.cameras and (not entries or entries[0] < 0)
    return "cameras-without-calibration" if untold else "unusable-cameras"


def _note_unused(sources: CameraSources) -> None:
    unused = unused_images(sources.folder, {*sources.calibration.cameras, *sources.frames.cameras})
    if unused:
        names = ", ".join(path.name for path in unused)
        message = f"{names}: neither calibration.json nor a frames line names the camera; not used"
        ledger, location = sources.ledger, str(sources.folder)
        ledger.note(WarningKind.SKIPPED, "videos-not-used", location, message, count=len(unused))


def _build(sources: CameraSources, index: int) -> list[CameraSensor | DepthCameraSensor]:
    """Build one camera; none where neither calibration nor images report the image's size, and no line needs it."""
    columns = sources.frames.cameras.get(index, CameraColumns())
    files, indices = _match_images(sources, index, columns)
    calibration = sources.calibration.cameras.get(index) or _calibration_of_lines(
        sources, index, columns, files
    )
    if files is None and not columns.rows and not calibration.parameters.has_size:
        message = "has no image size, and there are no images of it; the camera was left out"
        sources.ledger.note(WarningKind.SKIPPED, "cameras-without-size", calibration.location, message)
        return []
    calibration = _with_camera_model_of_lines(sources, calibration, columns)
    camera = _fitted_camera_model(sources, calibration, files)
    read_camera_model = _camera_model_reader(sources, calibration, camera)
    reading_mount = partial(read_mount, path=sources.data_path, ledger=sources.ledger)
    camera_models = read_texts(
        sources.frames, columns.rows, columns.parameters, read_camera_model, sources.ledger
    )
    mounts = read_texts(sources.frames, columns.rows, columns.mounts, reading_mount, sources.ledger)
    shift = _shift_of(calibration, sources.camera_shift, sources.ledger)
    table = build_table(
        index, camera, sources.frames, indices, camera_models, mounts, sources.data_file, shift=shift
    )
    sensor = _sensor(sources, table, calibration, files)
    return [_depth_sensor(sensor, table, files, sources.ledger) if _holds_depth(files) else sensor]


def _calibration_of_lines(
    sources: CameraSources, index: int, columns: CameraColumns, files: ImageFiles | None
) -> CameraCalibration:
    """Take the camera model of a camera's first line for a camera that the calibration does not have."""
    line = sources.frames.lines[columns.rows[0]]
    if columns.parameters[0] < 0:
        aligned = (
            _aligned_calibration(sources.calibration, index, sources.ledger) if _holds_depth(files) else None
        )
        if aligned is not None:
            return aligned
        path = sources.calibration.path
        location = f"cameras[{index}]" if path.exists() else ""
        problem = (
            f"missing, while {sources.data_path.name} has frames of camera {index} (line {line}); write its entry "
            "in `cameras` (model, focalLengthX, focalLengthY, principalPointX, principalPointY, imuToCamera), "
            "or give `cameraParameters` in every line"
        )
        raise DataError(path, location, problem)
    text = list(sources.frames.texts)[columns.parameters[0]]
    parameters = read_parameters(text, line, path=sources.data_path)
    return CameraCalibration(f"{sources.data_path}: line {line}: frames[].cameraParameters", parameters)


def _with_camera_model_of_lines(
    sources: CameraSources, calibration: CameraCalibration, columns: CameraColumns
) -> CameraCalibration:
    """Take the camera model of a camera's first line where the calibration has a mounting only.

    As old recordings have.
    """
    if calibration.parameters.focalLengthX is not None or not columns.rows or columns.parameters[0] < 0:
        return calibration
    text, line = list(sources.frames.texts)[columns.parameters[0]], sources.frames.lines[columns.rows[0]]
    parameters = read_parameters(text, line, path=sources.data_path).over(calibration.parameters)
    return replace(calibration, parameters=parameters)


def _match_images(
    sources: CameraSources, index: int, columns: CameraColumns
) -> tuple[ImageFiles | None, Int64Array]:
    """Open a camera's images, and find the one that each of its entries means, -1 for none."""
    ledger, rows = sources.ledger, np.asarray(columns.rows, np.int64)
    none = np.full(len(rows), -1, np.int64)
    path = find_images(sources.folder, index, ledger)
    if path is None:
        if len(rows):
            problem = f"no images of camera {index}, while data.jsonl has {len(rows)} frames of it"
            expected = f"{expected_names(index)}{other_videos(sources.folder)}"
            ledger.fault("missing-videos", DataError(sources.folder, "", f"{problem}; expected {expected}"))
        return None, none
    try:
        files = open_images(path, sources.ledger)
        sources.open_files.add(files)
        _check_kind(files, _first_fields(sources, index, columns))
        numbers = np.asarray(sources.frames.numbers, np.int64)
        cut_off = isinstance(files, VideoReader) and files.is_remainder
        choice = choose_images(numbers, files.count, alignment=sources.image_index, cut_off=cut_off)
        if choice.problem is not None and ledger.lenient and maybe_cut_off(files, len(numbers)):
            files = open_video(path, cut_off=True)
            sources.open_files.add(files)
            left = choose_images(numbers, files.count, alignment=sources.image_index)
            choice = replace(left, problem=choice.problem)
    except DataError as error:
        ledger.fault("unreadable-videos", error)
        return None, none
    if choice.problem is not None:
        left_out = int((choice.indices[rows] < 0).sum())
        ledger.fault("unmatched-images", DataError(path, "", choice.problem), count=max(left_out, 1))
    if choice.by_line:
        message = (
            "frame numbers have gaps, while images and lines are equally many; they were counted line by line"
        )
        ledger.note(WarningKind.REPAIRED, "frame-numbers-not-used", str(path), message)
    return files, choice.indices[rows]


def _first_fields(sources: CameraSources, index: int, columns: CameraColumns) -> Mapping[str, Any]:
    """What a camera's first line says of it beside its columns."""
    offset = sources.frames.offsets[columns.rows[0]] if columns.rows else -1
    return further_fields(sources.data_file, offset, index)


def _size(files: ImageFiles | None) -> tuple[int, int] | None:
    return None if files is None else (files.width, files.height)


def _fitted_camera_model(
    sources: CameraSources, calibration: CameraCalibration, files: ImageFiles | None
) -> Camera:
    """Give the camera model for the images as they are, with a warning where the calibration is for another size."""
    calibrated = camera_model(calibration.parameters, _size(files), calibration.location)
    width, height = _size(files) or (calibrated.width, calibrated.height)
    if (width, height) == (calibrated.width, calibrated.height):
        return calibrated
    sizes = f"{calibrated.width}x{calibrated.height}, images are {width}x{height}"
    message = f"calibrated for {sizes}; the camera model was scaled"
    sources.ledger.note(WarningKind.REPAIRED, "camera-model-scaled", calibration.location, message)
    return calibrated.resized(width, height)


def _camera_model_reader(
    sources: CameraSources, calibration: CameraCalibration, camera: Camera
) -> Callable[[bytes, int], Camera]:
    """Give the function that reads a line's own `cameraParameters` over those of the calibration."""

    def read(text: bytes, line: int) -> Camera:
        parameters = read_parameters(text, line, path=sources.data_path).over(calibration.parameters)
        location = f"{sources.data_path}: line {line}: frames[].cameraParameters"
        return camera_model(parameters, (camera.width, camera.height), location).resized(
            camera.width, camera.height
        )

    return read


def _sensor(
    sources: CameraSources, table: ImageTable, calibration: CameraCalibration, files: ImageFiles | None
) -> CameraSensor:
    camera, ego_from_camera = _camera_model_in_use(table), _own_mount(sources, table, calibration)
    _note_unused_rig(sources, table, calibration, camera, ego_from_camera)
    entry = _entry_after(calibration, sources.camera_shift)
    mounts = table.mounts if ego_from_camera is None else {table.OWN: ego_from_camera, **table.mounts}
    if table.missing:
        message = f"frames of camera {table.camera_index} state `missingBitmap`; they have no image"
        location = str(sources.data_path)
        sources.ledger.note(WarningKind.SKIPPED, "missing-bitmaps", location, message, count=table.missing)
    return CameraSensor(
        id=f"camera{table.camera_index}",
        camera=camera,
        images=LazyFrames(table.timestamps_ns, partial(table.image, files=files)),
        poses=poses_along(sources.ego_path, mounts, table.mount_texts, table.timestamps_ns),
        mount=ego_from_camera,
        video=_video(files, table.indices),
        fps=None if files is None else files.fps,
        extras=MappingProxyType({"calibration": entry} if entry else {}),
    )


def _camera_model_in_use(table: ImageTable) -> Camera:
    """The camera model of the calibration; that of the first image where each image has its own.

    So that none uses it.
    """
    if len(table.camera_model_texts) and (table.camera_model_texts != table.OWN).all():
        return table.camera_models[int(table.camera_model_texts[0])]
    return table.camera


def _own_mount(
    sources: CameraSources, table: ImageTable, calibration: CameraCalibration
) -> RigidTransform | None:
    """The mounting of the calibration; that of the first image where each image has its own."""
    if len(table.mount_texts) and (table.mount_texts != table.OWN).all():
        return table.mounts[int(table.mount_texts[0])]
    if calibration.camera_from_imu is not None:
        return calibration.camera_from_imu.inverse()
    first = next(iter(table.mounts.values()), None)
    if first is None:
        problem = (
            "imuToCamera is missing: where the camera is on the vehicle; expected 4 rows of 4 numbers, which take "
            "points of the IMU into the camera (a lenient reading keeps the camera without it)"
        )
        sources.ledger.fault("mounts-missing", DataError(calibration.location, "", problem))
    elif (table.mount_texts == table.OWN).any():
        message = (
            "frames without imuToCamera, of a camera whose calibration has none: taken as in its first frame"
        )
        sources.ledger.note(WarningKind.ASSUMED, "mounts-of-first-frame", calibration.location, message)
    return first


def _note_unused_rig(
    sources: CameraSources,
    table: ImageTable,
    calibration: CameraCalibration,
    camera: Camera,
    ego_from_camera: RigidTransform | None,
) -> None:
    """Report which values of calibration.json no image uses, where those of the images are others."""
    location, name = calibration.location, sources.data_path.name
    if camera != table.camera:
        message = (
            f"every image has cameraParameters of its own in {name}, and they differ from these "
            f"(focalLengthX {camera.fx:.6g} px instead of {table.camera.fx:.6g}); the images' are used"
        )
        sources.ledger.note(WarningKind.SKIPPED, "calibration-not-used", location, message)
    reported = calibration.camera_from_imu
    if reported is None or ego_from_camera is None:
        return
    moved = reported @ ego_from_camera
    rotated = math.degrees(float(angle_between(moved.quaternion_xyzw, np.array([0.0, 0.0, 0.0, 1.0]))))
    metres = float(np.linalg.norm(moved.inverse().translation))
    if metres > _SAME_M or rotated > _SAME_DEG:
        message = (
            f"every image has an imuToCamera of its own in {name}, {metres:.3g} m and {rotated:.3g} degrees from this "
            "one; the images' are used"
        )
        sources.ledger.note(WarningKind.SKIPPED, "calibration-not-used", location, message)


def _video(files: ImageFiles | None, indices: Int64Array) -> VideoContent | None:
    # of what is left of a video the images can be decoded, but its file cannot be handed on
    if not isinstance(files, VideoReader) or files.is_remainder:
        return None
    all_in_order = np.array_equal(indices, np.arange(files.count))
    return VideoContent(
        open=files.open_file,
        codec=files.codec,
        frame_indices=None if all_in_order else tuple(indices.tolist()),
    )
