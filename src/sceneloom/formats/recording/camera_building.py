"""The cameras of a recording: lens, mounting, pictures and poses brought together."""

import math
from collections.abc import Callable, Mapping
from dataclasses import dataclass, replace
from functools import partial
from pathlib import Path
from types import MappingProxyType
from typing import Any

import numpy as np

from sceneloom.arrays import Int64Array
from sceneloom.cameras.camera import Camera
from sceneloom.errors import CalibrationError, DataError
from sceneloom.formats.identity import FileIdentity
from sceneloom.formats.ledger import Ledger
from sceneloom.formats.recording.calibration import Calibration, CameraCalibration
from sceneloom.formats.recording.camera_shifts import entry_after, shift_of
from sceneloom.formats.recording.columns import CameraColumns, FrameColumns
from sceneloom.formats.recording.depth_building import (
    aligned_calibration,
    check_kind,
    depth_sensor,
    holds_depth,
)
from sceneloom.formats.recording.frame_parameters import read_mount, read_parameters, read_texts
from sceneloom.formats.recording.lenses import lens
from sceneloom.formats.recording.picture_files import (
    OpenPictures,
    PictureFiles,
    choose_pictures,
    expected_names,
    find_pictures,
    maybe_cut_off,
    open_pictures,
    other_videos,
    unused_pictures,
)
from sceneloom.formats.recording.picture_table import PictureTable, build_table, further_fields
from sceneloom.formats.video.reader import VideoReader, open_video
from sceneloom.geometry.rigid import RigidTransform
from sceneloom.geometry.rotations import angle_between
from sceneloom.scene.cameras import CameraSensor, VideoContent
from sceneloom.scene.depth import DepthCameraSensor
from sceneloom.scene.frames import LazyFrames
from sceneloom.scene.notices import NoticeKind
from sceneloom.scene.pose_source import poses_along
from sceneloom.scene.poses import PosePath

_SAME_M, _SAME_DEG = 1e-6, 1e-4
"""Mountings no further apart than this say the same."""


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
        ledger: takes notices and faults.
        open_files: takes the pictures of the cameras that are built.
        camera_shift: what becomes of `imuToCameraShiftSeconds`, a key of `CAMERA_SHIFTS`.
        image_index: which picture a `frames` line means, a key of `ALIGNMENTS`.
    """

    folder: Path
    data_path: Path
    data_file: FileIdentity
    calibration: Calibration
    frames: FrameColumns
    ego_path: PosePath | None
    ledger: Ledger
    open_files: OpenPictures
    camera_shift: str = "ignore"
    image_index: str = "auto"


def build_cameras(sources: CameraSources) -> list[CameraSensor | DepthCameraSensor]:
    """Build every camera that the calibration or a line names.

    Raises:
        DataError: pictures are missing, unreadable, or not as many as the lines say; or there is no calibration.
        CalibrationError: a lens or a mounting is unusable.
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
    """What kind of fault it is that a camera cannot be built: one that no calibration tells of can do so any time."""
    entries = sources.frames.cameras.get(index, CameraColumns()).parameters
    untold = index not in sources.calibration.cameras and (not entries or entries[0] < 0)
    return "cameras-without-calibration" if untold else "unusable-cameras"


def _note_unused(sources: CameraSources) -> None:
    unused = unused_pictures(sources.folder, {*sources.calibration.cameras, *sources.frames.cameras})
    if unused:
        names = ", ".join(path.name for path in unused)
        message = f"{names}: neither calibration.json nor a frames line names the camera; not used"
        ledger, place = sources.ledger, str(sources.folder)
        ledger.note(NoticeKind.SKIPPED, "videos-not-used", place, message, count=len(unused))


def _build(sources: CameraSources, index: int) -> list[CameraSensor | DepthCameraSensor]:
    """Build one camera; none where neither calibration nor pictures tell the picture's size, and no line needs it."""
    columns = sources.frames.cameras.get(index, CameraColumns())
    files, indices = _match_pictures(sources, index, columns)
    calibration = sources.calibration.cameras.get(index) or _calibration_of_lines(
        sources, index, columns, files
    )
    if files is None and not columns.rows and not calibration.parameters.has_size:
        message = "has no picture size, and there are no pictures of it; the camera was left out"
        sources.ledger.note(NoticeKind.SKIPPED, "cameras-without-size", calibration.place, message)
        return []
    calibration = _with_lens_of_lines(sources, calibration, columns)
    camera = _fitted_lens(sources, calibration, files)
    read_lens = _lens_reader(sources, calibration, camera)
    reading_mount = partial(read_mount, path=sources.data_path, ledger=sources.ledger)
    lenses = read_texts(sources.frames, columns.rows, columns.parameters, read_lens, sources.ledger)
    mounts = read_texts(sources.frames, columns.rows, columns.mounts, reading_mount, sources.ledger)
    shift = shift_of(calibration, sources.camera_shift, sources.ledger)
    table = build_table(
        index, camera, sources.frames, indices, lenses, mounts, sources.data_file, shift=shift
    )
    sensor = _sensor(sources, table, calibration, files)
    return [depth_sensor(sensor, table, files, sources.ledger) if holds_depth(files) else sensor]


def _calibration_of_lines(
    sources: CameraSources, index: int, columns: CameraColumns, files: PictureFiles | None
) -> CameraCalibration:
    """Take the lens of a camera's first line for a camera that the calibration does not have."""
    line = sources.frames.lines[columns.rows[0]]
    if columns.parameters[0] < 0:
        aligned = (
            aligned_calibration(sources.calibration, index, sources.ledger) if holds_depth(files) else None
        )
        if aligned is not None:
            return aligned
        path = sources.calibration.path
        place = f"cameras[{index}]" if path.exists() else ""
        problem = (
            f"missing, while {sources.data_path.name} has frames of camera {index} (line {line}); write its entry "
            "in `cameras` (model, focalLengthX, focalLengthY, principalPointX, principalPointY, imuToCamera), "
            "or give `cameraParameters` in every line"
        )
        raise DataError(path, place, problem)
    text = list(sources.frames.texts)[columns.parameters[0]]
    parameters = read_parameters(text, line, path=sources.data_path)
    return CameraCalibration(f"{sources.data_path}: line {line}: frames[].cameraParameters", parameters)


def _with_lens_of_lines(
    sources: CameraSources, calibration: CameraCalibration, columns: CameraColumns
) -> CameraCalibration:
    """Take the lens of a camera's first line where the calibration has a mounting only, as old recordings have."""
    if calibration.parameters.focalLengthX is not None or not columns.rows or columns.parameters[0] < 0:
        return calibration
    text, line = list(sources.frames.texts)[columns.parameters[0]], sources.frames.lines[columns.rows[0]]
    parameters = read_parameters(text, line, path=sources.data_path).over(calibration.parameters)
    return replace(calibration, parameters=parameters)


def _match_pictures(
    sources: CameraSources, index: int, columns: CameraColumns
) -> tuple[PictureFiles | None, Int64Array]:
    """Open a camera's pictures, and find the one that each of its entries means, -1 for none."""
    ledger, rows = sources.ledger, np.asarray(columns.rows, np.int64)
    none = np.full(len(rows), -1, np.int64)
    path = find_pictures(sources.folder, index, ledger)
    if path is None:
        if len(rows):
            problem = f"no pictures of camera {index}, while data.jsonl has {len(rows)} frames of it"
            expected = f"{expected_names(index)}{other_videos(sources.folder)}"
            ledger.fault("missing-videos", DataError(sources.folder, "", f"{problem}; expected {expected}"))
        return None, none
    try:
        files = open_pictures(path, sources.ledger)
        sources.open_files.add(files)
        check_kind(files, _first_fields(sources, index, columns))
        numbers = np.asarray(sources.frames.numbers, np.int64)
        cut_off = isinstance(files, VideoReader) and files.is_remainder
        choice = choose_pictures(numbers, files.count, alignment=sources.image_index, cut_off=cut_off)
        if choice.problem is not None and ledger.lenient and maybe_cut_off(files, len(numbers)):
            files = open_video(path, cut_off=True)
            sources.open_files.add(files)
            left = choose_pictures(numbers, files.count, alignment=sources.image_index)
            choice = replace(left, problem=choice.problem)
    except DataError as error:
        ledger.fault("unreadable-videos", error)
        return None, none
    if choice.problem is not None:
        left_out = int((choice.indices[rows] < 0).sum())
        ledger.fault("unmatched-pictures", DataError(path, "", choice.problem), count=max(left_out, 1))
    if choice.by_line:
        message = "frame numbers have gaps, while pictures and lines are equally many; they were counted line by line"
        ledger.note(NoticeKind.REPAIRED, "frame-numbers-not-used", str(path), message)
    return files, choice.indices[rows]


def _first_fields(sources: CameraSources, index: int, columns: CameraColumns) -> Mapping[str, Any]:
    """What a camera's first line says of it beside its columns."""
    offset = sources.frames.offsets[columns.rows[0]] if columns.rows else -1
    return further_fields(sources.data_file, offset, index)


def _size(files: PictureFiles | None) -> tuple[int, int] | None:
    return None if files is None else (files.width, files.height)


def _fitted_lens(
    sources: CameraSources, calibration: CameraCalibration, files: PictureFiles | None
) -> Camera:
    """Give the lens for the pictures as they are, with a notice where the calibration is for another size."""
    calibrated = lens(calibration.parameters, _size(files), calibration.place)
    width, height = _size(files) or (calibrated.width, calibrated.height)
    if (width, height) == (calibrated.width, calibrated.height):
        return calibrated
    sizes = f"{calibrated.width}x{calibrated.height}, pictures are {width}x{height}"
    message = f"calibrated for {sizes}; the lens was scaled"
    sources.ledger.note(NoticeKind.REPAIRED, "lens-scaled", calibration.place, message)
    return calibrated.resized(width, height)


def _lens_reader(
    sources: CameraSources, calibration: CameraCalibration, camera: Camera
) -> Callable[[bytes, int], Camera]:
    """Give the function that reads a line's own `cameraParameters` over those of the calibration."""

    def read(text: bytes, line: int) -> Camera:
        parameters = read_parameters(text, line, path=sources.data_path).over(calibration.parameters)
        place = f"{sources.data_path}: line {line}: frames[].cameraParameters"
        return lens(parameters, (camera.width, camera.height), place).resized(camera.width, camera.height)

    return read


def _sensor(
    sources: CameraSources, table: PictureTable, calibration: CameraCalibration, files: PictureFiles | None
) -> CameraSensor:
    camera, ego_from_camera = _lens_in_use(table), _own_mount(sources, table, calibration)
    _note_unused_rig(sources, table, calibration, camera, ego_from_camera)
    entry = entry_after(calibration, sources.camera_shift)
    mounts = table.mounts if ego_from_camera is None else {table.OWN: ego_from_camera, **table.mounts}
    if table.missing:
        message = f"frames of camera {table.camera_index} say `missingBitmap`; they have no picture"
        place = str(sources.data_path)
        sources.ledger.note(NoticeKind.SKIPPED, "missing-bitmaps", place, message, count=table.missing)
    return CameraSensor(
        id=f"camera{table.camera_index}",
        camera=camera,
        pictures=LazyFrames(table.timestamps_ns, partial(table.picture, files=files)),
        poses=poses_along(sources.ego_path, mounts, table.mount_texts, table.timestamps_ns),
        mount=ego_from_camera,
        video=_video(files, table.indices),
        fps=None if files is None else files.fps,
        extras=MappingProxyType({"calibration": entry} if entry else {}),
    )


def _lens_in_use(table: PictureTable) -> Camera:
    """The lens of the calibration; that of the first picture where each picture has its own, so that none uses it."""
    if len(table.lens_texts) and (table.lens_texts != table.OWN).all():
        return table.lenses[int(table.lens_texts[0])]
    return table.camera


def _own_mount(
    sources: CameraSources, table: PictureTable, calibration: CameraCalibration
) -> RigidTransform | None:
    """The mounting of the calibration; that of the first picture where each picture has its own."""
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
        sources.ledger.fault("mounts-missing", DataError(calibration.place, "", problem))
    elif (table.mount_texts == table.OWN).any():
        message = (
            "frames without imuToCamera, of a camera whose calibration has none: taken as in its first frame"
        )
        sources.ledger.note(NoticeKind.ASSUMED, "mounts-of-first-frame", calibration.place, message)
    return first


def _note_unused_rig(
    sources: CameraSources,
    table: PictureTable,
    calibration: CameraCalibration,
    camera: Camera,
    ego_from_camera: RigidTransform | None,
) -> None:
    """Say which values of calibration.json no picture uses, where those of the pictures are others."""
    place, name = calibration.place, sources.data_path.name
    if camera != table.camera:
        message = (
            f"every picture has cameraParameters of its own in {name}, and they differ from these "
            f"(focalLengthX {camera.fx:.6g} px in place of {table.camera.fx:.6g}); the pictures' are used"
        )
        sources.ledger.note(NoticeKind.SKIPPED, "calibration-not-used", place, message)
    told = calibration.camera_from_imu
    if told is None or ego_from_camera is None:
        return
    moved = told @ ego_from_camera
    turned = math.degrees(float(angle_between(moved.quaternion_xyzw, np.array([0.0, 0.0, 0.0, 1.0]))))
    metres = float(np.linalg.norm(moved.inverse().translation))
    if metres > _SAME_M or turned > _SAME_DEG:
        message = (
            f"every picture has an imuToCamera of its own in {name}, {metres:.3g} m and {turned:.3g} degrees from this "
            "one; the pictures' are used"
        )
        sources.ledger.note(NoticeKind.SKIPPED, "calibration-not-used", place, message)


def _video(files: PictureFiles | None, indices: Int64Array) -> VideoContent | None:
    # of what is left of a video the pictures can be decoded, but its file cannot be handed on
    if not isinstance(files, VideoReader) or files.is_remainder:
        return None
    all_in_order = np.array_equal(indices, np.arange(files.count))
    return VideoContent(
        open=files.open_file,
        codec=files.codec,
        frame_indices=None if all_in_order else tuple(indices.tolist()),
    )
