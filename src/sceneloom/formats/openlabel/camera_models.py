"""Camera models as stream properties, read and written.

Source: ASAM OpenLABEL 1.0.0, "Streams", and the names of its reference program VCD: `intrinsics_pinhole` with a camera
matrix of 3 times 4 by rows and OpenCV's coefficients, `intrinsics_fisheye` of the model `opencv_fisheye`; the project
RailLabel leaves the endings of these names away. Pixels are counted from the centre of the first one, as OpenCV does.
"""

from typing import Any

from sceneloom.cameras.camera import Camera
from sceneloom.cameras.table import MODELS
from sceneloom.errors import DataError, SceneloomError
from sceneloom.formats.openlabel.document import Part
from sceneloom.formats.openlabel.words import OURS

_OPENCV_COUNTS = (0, 4, 5, 8, 12, 14)
_OPENCV_ORDER = ("k1", "k2", "p1", "p2", "k3", "k4", "k5", "k6", "s1", "s2", "s3", "s4", "tx", "ty")
"""Source: `cv::projectPoints`."""

_NAMES = ("model", "width", "height", "fx", "fy", "cx", "cy", "coefficients")


def read_camera_model(properties: Part) -> Camera | None:
    """Read the camera model of a stream; None where none is stated, or one of a model that is not known.

    Raises:
        DataError: it is wrong.
    """
    ours = properties.get(OURS)
    camera_model = None if ours is None else ours.get("camera_model")
    if camera_model is not None:
        return _ours(camera_model)
    pinhole, fisheye = properties.get("intrinsics_pinhole"), properties.get("intrinsics_fisheye")
    if pinhole is not None:
        return _pinhole(pinhole)
    return None if fisheye is None else _fisheye(fisheye)


def _built(part: Part, *values: Any) -> Camera:
    try:
        return Camera(*values)
    except (SceneloomError, TypeError) as error:
        raise DataError(part.file, part.location, str(error)) from error


def _ours(part: Part) -> Camera:
    model = part.need("model").text()
    if model not in MODELS:
        raise part.need("model").fault(f"one of {', '.join(MODELS)}")
    numbers = [_number(part.need(name)) for name in _NAMES[3:7]]
    coefficients = tuple(part.need("coefficients").numbers())
    return _built(part, model, _pixels(part, "width"), _pixels(part, "height"), *numbers, coefficients)


def _number(part: Part) -> float:
    return Part(part.file, part.location, [part.value]).numbers((1,))[0]


def _pixels(part: Part, name: str) -> int:
    found = part.need(name)
    if not isinstance(found.value, int) or not 0 < found.value < 1 << 20:
        raise found.fault("a number of pixels")
    return found.value


def _either(part: Part, *names: str) -> Part | None:
    return next((found for name in names if (found := part.get(name)) is not None), None)


def _pinhole(part: Part) -> Camera:
    matrix = _either(part, "camera_matrix_3x4", "camera_matrix")
    if matrix is None:
        raise DataError(part.file, f"{part.location}.camera_matrix_3x4", "missing")
    values = matrix.numbers((12, 9))
    row = len(values) // 3
    fx, skew, cx, fy, cy = values[0], values[1], values[2], values[row + 1], values[row + 2]
    if abs(skew) > 1e-9 * abs(fx):
        raise matrix.fault("a camera matrix without skew")
    listed = _either(part, "distortion_coeffs_1xN", "distortion_coeffs")
    coefficients = [] if listed is None else listed.numbers(_OPENCV_COUNTS)
    size = (_pixels(part, "width_px"), _pixels(part, "height_px"))
    if not any(coefficients):
        return _built(part, "pinhole", *size, fx, fy, cx, cy)
    named = dict(zip(_OPENCV_ORDER, coefficients, strict=False))
    names = MODELS["brown_conrady"].coefficient_names
    ordered = tuple(named.get(name, 0.0) for name in names)
    return _built(part, "brown_conrady", *size, fx, fy, cx, cy, _without_zeros(ordered))


def _without_zeros(values: tuple[float, ...]) -> tuple[float, ...]:
    count = next((k for k in range(len(values), 0, -1) if values[k - 1]), 0)
    return values[: max(count, 5)]


def _fisheye(part: Part) -> Camera | None:
    locations = [part.get(name) for name in ("focal_length_x", "focal_length_y", "center_x", "center_y")]
    listed = _either(part, "camera_model_coeffs_1xN", "camera_model_coeffs_1x4")
    model = part.get("model")
    if listed is None or any(location is None for location in locations):
        return None
    if model is not None and model.text() != "opencv_fisheye":
        return None
    numbers = [_number(location) for location in locations if location is not None]
    size = (_pixels(part, "width_px"), _pixels(part, "height_px"))
    return _built(part, "fisheye", *size, *numbers, tuple(listed.numbers((4,))))


def camera_model_properties(camera: Camera) -> dict[str, Any]:
    """Report a camera model in the words of the format where it has some, and in ours, which state it exactly."""
    ours = {name: getattr(camera, name) for name in _NAMES[:7]}
    found: dict[str, Any] = {OURS: {"camera_model": {**ours, "coefficients": list(camera.coefficients)}}}
    named = dict(zip(MODELS[camera.model].coefficient_names, camera.coefficients, strict=False))
    size = {"width_px": camera.width, "height_px": camera.height}
    if camera.model == "fisheye":
        found["intrinsics_fisheye"] = {
            **size,
            "center_x": camera.cx,
            "center_y": camera.cy,
            "focal_length_x": camera.fx,
            "focal_length_y": camera.fy,
            "camera_model_coeffs_1xN": [named.get(name, 0.0) for name in ("k1", "k2", "k3", "k4")],
            "model": "opencv_fisheye",
        }
    elif is_pinhole(camera):
        coefficients = [named.get(name, 0.0) for name in _OPENCV_ORDER]
        count = next(count for count in _OPENCV_COUNTS[1:] if not any(coefficients[count:]))
        matrix = [camera.fx, 0.0, camera.cx, 0.0, 0.0, camera.fy, camera.cy, 0.0, 0.0, 0.0, 1.0, 0.0]
        found["intrinsics_pinhole"] = {
            **size,
            "camera_matrix_3x4": matrix,
            "distortion_coeffs_1xN": coefficients[: max(count, 5)],
        }
    else:
        found["intrinsics_custom"] = {**size, "model": camera.model, **ours, **named}
    return found


def is_pinhole(camera: Camera) -> bool:
    """Whether OpenCV's pinhole with distortion says the camera model.

    One that does not shift the centre of distortion.
    """
    if camera.model == "pinhole":
        return True
    named = dict(zip(MODELS[camera.model].coefficient_names, camera.coefficients, strict=False))
    return camera.model == "brown_conrady" and not (named.get("lx") or named.get("ly"))
