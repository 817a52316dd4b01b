"""Camera models and transforms in the words of a recording: for `calibration.json`, and for single images."""

from collections.abc import Mapping
from functools import lru_cache
from typing import Any

from sceneloom.cameras.camera import MODELS, Camera
from sceneloom.cameras.fitting import nearest
from sceneloom.errors import CalibrationError
from sceneloom.geometry.rigid import RigidTransform

_CAMERA_MODELS: Mapping[str, tuple[tuple[str, tuple[int, ...]], ...]] = {
    "pinhole": (("pinhole", ()),),
    "fisheye": (("kannala-brandt4", (0, 1, 2, 3)),),
    "brown_conrady": (("brown-conrady", tuple(range(8))), ("brown-conrady", (*range(8), *range(10, 16)))),
    "kannala_brandt18": (("kannala-brandt18", tuple(range(18))),),
    "omnidir": (("omnidir", tuple(range(6))),),
}
"""By our model: the format's name, and which of our coefficients it has, in order; the shortest list that holds all
coefficients that are not 0 is written.

Source: "Calibration format" of the recording format's description, and the models that the vendor's software knows.
"""

_STAND_INS: Mapping[str, tuple[str, ...]] = {
    "brown_conrady": ("lx", "ly"),
    "fisheye": (),
    "omnidir": (),
    "kannala_brandt18": (),
}
"""Models that other camera models are fitted to, each with the coefficients of ours that the format does not have."""

_FARTHEST_SHARE, _LEAST_SHARE = 0.01, 0.5
"""A camera model whose root mean square error is a greater share of the image's width, or that covers a smaller share
of the image, does not stand in for another."""


def matrix_entry(transform: RigidTransform) -> list[list[float]]:
    """A transform as four rows of four numbers."""
    rows: list[list[float]] = transform.matrix.tolist()
    return rows


@lru_cache(maxsize=64)
def _holdable_camera_model(camera: Camera) -> tuple[Camera, str | None]:
    """The same camera model, or the nearest one that the format has, with how far it is off in words."""
    writings = _CAMERA_MODELS.get(camera.model, ())
    used = {k for k, value in enumerate(camera.coefficients) if value != 0}
    if writings and used <= {k for _, taken in writings for k in taken}:
        return camera, None
    known = f"a recording can hold {', '.join(_CAMERA_MODELS)}"
    if camera.model not in MODELS:
        raise CalibrationError(f"camera model {camera.model!r}; {known}")
    found = nearest(camera, _STAND_INS)
    if found.rms_px > _FARTHEST_SHARE * camera.width or found.share < _LEAST_SHARE:
        hint = "leave the camera out, or undistort its images with `sceneloom edit undistort`"
        raise CalibrationError(f"{found.message(camera)}; {known}: {hint}")
    return found.camera, found.message(camera)


def camera_model_entry(camera: Camera, *, model_key: str = "model") -> tuple[dict[str, Any], str | None]:
    """Write a camera model.

    Args:
        camera: the camera model.
        model_key: "model" in `calibration.json`, "distortionModel" in a line.

    Returns:
        The fields, and in words how far they are off the camera model; None where they hold it.

    Raises:
        CalibrationError: the model is unknown, or none of the format's comes near.
    """
    camera, how_far = _holdable_camera_model(camera)
    values = dict(enumerate(camera.coefficients))
    used = {k for k, value in values.items() if value != 0}
    model, taken = next((model, taken) for model, taken in _CAMERA_MODELS[camera.model] if used <= set(taken))
    fields = {
        model_key: model,
        "distortionCoefficients": [float(values.get(k, 0.0)) for k in taken],
        "focalLengthX": float(camera.fx),
        "focalLengthY": float(camera.fy),
        "principalPointX": float(camera.cx),
        "principalPointY": float(camera.cy),
        "imageWidth": camera.width,
        "imageHeight": camera.height,
    }
    return fields, how_far
