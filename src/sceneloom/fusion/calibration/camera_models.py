"""The added property `camera_models`: camera models that table 3 cannot state, by camera_id."""

from collections.abc import Mapping
from typing import Any

from sceneloom.cameras.camera import Camera
from sceneloom.cameras.table import MODELS
from sceneloom.errors import CalibrationError, DataError
from sceneloom.fusion.json_property import read_by_sensor

CAMERA_MODELS = "camera_models"
"""Name of the property, a string that a session adds where it needs it."""

_NUMBERS = ("fx", "fy", "cx", "cy")


def parse_camera_models(text: str) -> Mapping[int, Camera]:
    """Read `{"1": {"model": "fisheye", "image_size": [w, h], "fx": …, "coefficients": […]}}`; empty: none.

    Raises:
        DataError: it is no JSON object of camera models.
        CalibrationError: a camera model cannot be.
    """
    found = read_by_sensor(text, CAMERA_MODELS, '{"1": {"model": "fisheye", …}}')
    return {camera_id: _camera_model(entry, str(camera_id)) for camera_id, entry in found.items()}


def _camera_model(entry: Any, location: str) -> Camera:
    try:
        model, (width, height) = entry["model"], entry["image_size"]
        fx, fy, cx, cy = (float(entry[name]) for name in _NUMBERS)
        coefficients = tuple(float(value) for value in entry.get("coefficients", ()))
        if model not in MODELS or not all(isinstance(size, int) for size in (width, height)):
            raise DataError(
                CAMERA_MODELS,
                location,
                f"{entry!r}; expected a model out of {', '.join(MODELS)} and whole sizes",
            )
    except (AttributeError, KeyError, OverflowError, TypeError, ValueError) as error:
        raise DataError(
            CAMERA_MODELS, location, f"{entry!r}; expected model, image_size, fx, fy, cx, cy, coefficients"
        ) from error
    wanted = len(MODELS[model].coefficient_names)
    if len(coefficients) > wanted:
        raise CalibrationError(
            f"{CAMERA_MODELS}.{location}: {len(coefficients)} coefficients; {model} has {wanted}"
        )
    padded = (*coefficients, *[0.0] * (wanted - len(coefficients)))
    return Camera(model, width, height, fx, fy, cx, cy, padded)
