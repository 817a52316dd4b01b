"""The camera model of a camera as a manifest writes it."""

from collections.abc import Mapping
from difflib import get_close_matches
from typing import Any

import numpy as np

from sceneloom.arrays import Float64Array
from sceneloom.cameras.camera import Camera
from sceneloom.cameras.models import check_camera
from sceneloom.cameras.table import MODELS
from sceneloom.errors import CalibrationError
from sceneloom.formats.rig.records import Record
from sceneloom.geometry.rigid import RigidTransform

MODEL_ALIASES: Mapping[str, str] = {
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
    model = MODEL_ALIASES.get(plain, plain)
    if model not in MODELS:
        known = [*MODELS, *MODEL_ALIASES]
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
