"""The added property `lenses`: lenses that table 3 cannot say, by camera_id."""

from collections.abc import Mapping
from typing import Any

from sceneloom.cameras.camera import Camera
from sceneloom.cameras.table import MODELS
from sceneloom.errors import CalibrationError, DataError
from sceneloom.fusion.json_property import read_by_sensor

LENSES = "lenses"
"""Name of the property, a string that a session adds where it needs it."""

_NUMBERS = ("fx", "fy", "cx", "cy")


def parse_lenses(text: str) -> Mapping[int, Camera]:
    """Read `{"1": {"model": "fisheye", "image_size": [w, h], "fx": …, "coefficients": […]}}`; empty: none.

    Raises:
        DataError: it is no JSON object of lenses.
        CalibrationError: a lens cannot be.
    """
    found = read_by_sensor(text, LENSES, '{"1": {"model": "fisheye", …}}')
    return {camera_id: _lens(entry, str(camera_id)) for camera_id, entry in found.items()}


def _lens(entry: Any, place: str) -> Camera:
    try:
        model, (width, height) = entry["model"], entry["image_size"]
        fx, fy, cx, cy = (float(entry[name]) for name in _NUMBERS)
        coefficients = tuple(float(value) for value in entry.get("coefficients", ()))
        if model not in MODELS or not all(isinstance(size, int) for size in (width, height)):
            raise DataError(
                LENSES, place, f"{entry!r}; expected a model out of {', '.join(MODELS)} and whole sizes"
            )
    except (AttributeError, KeyError, OverflowError, TypeError, ValueError) as error:
        raise DataError(
            LENSES, place, f"{entry!r}; expected model, image_size, fx, fy, cx, cy, coefficients"
        ) from error
    wanted = len(MODELS[model].coefficient_names)
    if len(coefficients) > wanted:
        raise CalibrationError(f"{LENSES}.{place}: {len(coefficients)} coefficients; {model} has {wanted}")
    padded = (*coefficients, *[0.0] * (wanted - len(coefficients)))
    return Camera(model, width, height, fx, fy, cx, cy, padded)
