"""The descriptions of sensors: the small part of YAML that they are written in.

Source: Burri et al. 2016, "The EuRoC micro aerial vehicle datasets", and the files `sensor.yaml` of these.
"""

import re
from pathlib import Path
from typing import Any

import numpy as np

from sceneloom.cameras.camera import Camera
from sceneloom.errors import DataError, SceneloomError
from sceneloom.formats.files import read_bytes
from sceneloom.geometry.rigid import RigidTransform

_ENTRY = re.compile(r"(?P<indent> *)(?P<key>[^\s:#][^:#]*):(?P<value>.*)")
_GREATEST_ERROR = 0.01
_MODELS = {
    ("radial-tangential", 4): "brown_conrady",
    ("radial-tangential", 5): "brown_conrady",
    ("radtan", 4): "brown_conrady",
    ("equidistant", 4): "fisheye",
    ("none", 0): "pinhole",
}
"""Our models by the distortion model and the count of its coefficients."""


def read_sensor_yaml(path: Path) -> dict[str, Any]:
    """Read keys with texts, numbers, lists of them in brackets, and one level of keys below.

    Raises:
        DataError: the file cannot be read, or a line is something else.
    """
    try:
        text = read_bytes(path).decode("utf-8-sig")
    except UnicodeDecodeError as error:
        raise DataError(path, f"byte {error.start}", "is no UTF-8 text") from error
    found: dict[str, Any] = {}
    above: dict[str, Any] = found
    for number, line in _lines(text):
        match = _ENTRY.fullmatch(line)
        if match is None:
            raise DataError(path, f"line {number}", f"{line.strip()[:60]!r}; expected `key: value`")
        value = match["value"].strip()
        target = above if match["indent"] else found
        if value:
            target[match["key"].strip()] = _value(value)
        else:
            above = found.setdefault(match["key"].strip(), {})
            if not isinstance(above, dict):
                raise DataError(path, f"line {number}", f"{match['key'].strip()!r} stands there twice")
    return found


def _lines(text: str) -> list[tuple[int, str]]:
    """The lines without comments; lists that go over several lines are put into one."""
    found: list[tuple[int, str]] = []
    for number, raw in enumerate(text.replace("\r\n", "\n").split("\n"), 1):
        line = re.sub(r"(^|\s)#.*$", "", raw).rstrip()
        if not line.strip() or line.startswith(("%", "---")):
            continue
        if found and found[-1][1].count("[") > found[-1][1].count("]"):
            found[-1] = (found[-1][0], f"{found[-1][1]} {line.strip()}")
        else:
            found.append((number, line))
    return found


def _value(text: str) -> Any:
    if text.startswith("[") and text.endswith("]"):
        return [_scalar(part.strip()) for part in text[1:-1].split(",") if part.strip()]
    return _scalar(text)


def _scalar(text: str) -> Any:
    for kind in (int, float):
        try:
            return kind(text)
        except ValueError:
            continue
    return text.strip("\"'")


def body_from_sensor(path: Path, description: dict[str, Any]) -> RigidTransform | None:
    """The location of a sensor on the body, `T_BS`; None where it is not stated.

    Raises:
        DataError: it is no rigid transform.
    """
    reported = description.get("T_BS")
    if reported is None:
        return None
    data = reported.get("data") if isinstance(reported, dict) else reported
    try:
        transform, error = RigidTransform.nearest(np.array(data, np.float64).reshape(4, 4))
    except (SceneloomError, ValueError, TypeError) as fault:
        raise DataError(path, "T_BS", f"{fault}; expected 16 numbers by rows") from fault
    if not error <= _GREATEST_ERROR:
        raise DataError(path, "T_BS", f"its rotation is off by {error:.2g}; expected 0.01 at most")
    return transform


def camera_model(path: Path, description: dict[str, Any], size: tuple[int, int]) -> Camera:
    """The camera model of a camera, for images of a size: pixels are counted from the centre of the first one.

    Raises:
        DataError: it is missing, wrong, or of a model that is not known.
    """
    intrinsics = _numbers(path, description, "intrinsics")
    if description.get("camera_model", "pinhole") != "pinhole" or len(intrinsics) != 4:
        problem = (
            f"{description.get('camera_model')!r} with {len(intrinsics)} numbers; expected pinhole with 4"
        )
        raise DataError(path, "camera_model, intrinsics", problem)
    coefficients = (
        _numbers(path, description, "distortion_coefficients")
        if "distortion_coefficients" in description
        else []
    )
    kind = str(description.get("distortion_model", "none")).lower()
    model = "pinhole" if not coefficients else _MODELS.get((kind, len(coefficients)))
    if model is None:
        known = ", ".join(f"{name} with {count}" for name, count in _MODELS)
        problem = f"{kind!r} with {len(coefficients)} coefficients; expected one of {known}"
        raise DataError(path, "distortion_model", problem)
    stated = _numbers(path, description, "resolution") if "resolution" in description else list(size)
    try:
        fx, fy, cx, cy = intrinsics
        camera = Camera(model, int(stated[0]), int(stated[1]), fx, fy, cx, cy, tuple(coefficients))
        return camera if (camera.width, camera.height) == size else camera.resized(*size)
    except (SceneloomError, IndexError) as error:
        raise DataError(path, "intrinsics, resolution", str(error)) from error


def _numbers(path: Path, description: dict[str, Any], name: str) -> list[float]:
    values = description.get(name)
    if not isinstance(values, list) or not all(isinstance(value, int | float) for value in values):
        raise DataError(path, name, f"{values!r}; expected a list of numbers")
    return [float(value) for value in values]
