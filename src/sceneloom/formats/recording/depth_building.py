"""Cameras of a recording that measure depth: videos and pictures of 16-bit steps, each step so many metres."""

from collections.abc import Mapping
from dataclasses import replace
from functools import partial
from types import MappingProxyType
from typing import Any

import numpy as np

from sceneloom.arrays import Float32Array
from sceneloom.errors import DataError
from sceneloom.formats.ledger import Ledger
from sceneloom.formats.recording.calibration import Calibration, CameraCalibration
from sceneloom.formats.recording.picture_files import PictureFiles
from sceneloom.formats.recording.picture_table import PictureTable
from sceneloom.scene.cameras import CameraSensor
from sceneloom.scene.depth import DepthCameraSensor, DepthFrame
from sceneloom.scene.frames import LazyFrames
from sceneloom.scene.notices import NoticeKind

DEFAULT_SCALE = 0.001
"""Metres a step where nothing says it: the usual unit of depth cameras. ASSUMED, with a notice."""

DEPTH_FORMAT = "gray16"
"""`colorFormat` of lines whose picture holds depths."""

_LARGEST_SCALE = 100.0


def holds_depth(files: PictureFiles | None) -> bool:
    """Whether pictures are 16-bit grey, and so hold depths."""
    return files is not None and files.has_steps


def check_kind(files: PictureFiles, fields: Mapping[str, Any]) -> None:
    """Check that pictures are of the kind that the first line names.

    Args:
        files: the pictures.
        fields: what the first line says of the camera beside its columns.

    Raises:
        DataError: the line says that they hold depths, and they cannot.
    """
    if fields.get("colorFormat") == DEPTH_FORMAT and not holds_depth(files):
        problem = f"pixels are no 16-bit grey, while lines say colorFormat {DEPTH_FORMAT!r}"
        raise DataError(
            files.name, "", f"{problem}; expected a lossless video of 16 bits, as FFV1 makes them"
        )


def aligned_calibration(calibration: Calibration, index: int, ledger: Ledger) -> CameraCalibration | None:
    """Give the lens and mounting of the camera that depth images without a calibration are aligned to: the first one.

    Returns:
        None where there is no other camera.
    """
    first = min((other for other in calibration.cameras if other != index), default=None)
    if first is None:
        return None
    message = (
        f"depth images of camera {index} have no calibration; taken to lie in the pixels of camera {first}"
    )
    ledger.note(NoticeKind.ASSUMED, "depth-aligned", str(calibration.path), message)
    return replace(calibration.cameras[first], entry={})


def depth_sensor(
    camera: CameraSensor, table: PictureTable, files: PictureFiles | None, ledger: Ledger
) -> DepthCameraSensor:
    """Make a camera with pictures of steps into one that measures depth.

    Args:
        camera: the same camera, as if its pictures were colours.
        table: its pictures.
        files: where they are.
        ledger: takes the notice of an assumed scale.
    """
    scale = table.first_fields().get("depthScale")
    if scale is None and len(table.seconds):
        message = f"no depthScale for camera {table.camera_index}; taken to be {DEFAULT_SCALE:g} m a step"
        ledger.note(NoticeKind.ASSUMED, "depth-scale-assumed", table.data_file.name, message)
    usual = scale_of(DEFAULT_SCALE if scale is None else scale, table)
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


def scale_of(value: object, table: PictureTable) -> float:
    """Check a `depthScale`.

    Raises:
        DataError: it is no length.
    """
    is_number = isinstance(value, int | float) and not isinstance(value, bool)
    if not is_number or not 0 < float(value) <= _LARGEST_SCALE:  # type: ignore[arg-type]
        problem = f"frames[].depthScale: {value!r} of camera {table.camera_index}; expected metres a step"
        raise DataError(table.data_file.name, "", problem)
    return float(value)  # type: ignore[arg-type]


def _frame(k: int, *, table: PictureTable, files: PictureFiles | None, usual: float) -> DepthFrame:
    picture = table.picture(k, files=None)
    scale = scale_of(picture.extras.get("depthScale", usual), table)
    return DepthFrame(
        timestamp_ns=picture.timestamp_ns,
        camera=picture.camera,
        decode=partial(_metres, files, int(table.indices[k]), scale),
        scale=scale,
        mount=picture.mount,
        extras=MappingProxyType(dict(picture.extras)),
    )


def _metres(files: PictureFiles | None, index: int, scale: float) -> Float32Array:
    if files is None:
        raise DataError("", f"image {index}", "there are no images")
    # by way of float64: a step times a rounded scale is off by more than a step's own rounding
    return np.multiply(files.steps(index), scale, dtype=np.float64).astype(np.float32)
