"""Cameras of a recording that measure depth: videos and images of 16-bit steps, each step so many metres."""

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
from sceneloom.formats.recording.image_files import ImageFiles
from sceneloom.formats.recording.image_table import ImageTable
from sceneloom.scene.cameras import CameraSensor
from sceneloom.scene.depth import DepthCameraSensor, DepthFrame
from sceneloom.scene.frames import LazyFrames
from sceneloom.scene.warnings import WarningKind

DEFAULT_SCALE = 0.001
"""Metres a step where nothing says it: the usual unit of depth cameras. ASSUMED, with a warning."""

DEPTH_FORMAT = "gray16"
"""`colorFormat` of lines whose image holds depths."""

_LARGEST_SCALE = 100.0


def holds_depth(files: ImageFiles | None) -> bool:
    """Whether images are 16-bit grey, and so hold depths."""
    return files is not None and files.has_steps


def check_kind(files: ImageFiles, fields: Mapping[str, Any]) -> None:
    """Check that images are of the kind that the first line names.

    Args:
        files: the images.
        fields: what the first line says of the camera beside its columns.

    Raises:
        DataError: the line says that they hold depths, and they cannot.
    """
    if fields.get("colorFormat") == DEPTH_FORMAT and not holds_depth(files):
        problem = f"pixels are no 16-bit grey, while lines state colorFormat {DEPTH_FORMAT!r}"
        raise DataError(
            files.name, "", f"{problem}; expected a lossless video of 16 bits, as FFV1 makes them"
        )


def aligned_calibration(calibration: Calibration, index: int, ledger: Ledger) -> CameraCalibration | None:
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


def depth_sensor(
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
        message = f"no depthScale for camera {table.camera_index}; taken to be {DEFAULT_SCALE:g} m a step"
        ledger.note(WarningKind.ASSUMED, "depth-scale-assumed", table.data_file.name, message)
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


def scale_of(value: object, table: ImageTable) -> float:
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
    scale = scale_of(image.extras.get("depthScale", usual), table)
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
