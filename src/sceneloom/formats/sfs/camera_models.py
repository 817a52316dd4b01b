"""Camera models as the format can state them, and how many pixels are lost where it cannot."""

from collections.abc import Mapping
from dataclasses import replace
from typing import Any

from sceneloom.cameras.camera import Camera
from sceneloom.cameras.fitting import nearest
from sceneloom.cameras.table import MODELS
from sceneloom.formats.loss import Support
from sceneloom.formats.sfs.distortion import COEFFICIENT_COUNTS
from sceneloom.formats.sfs.drafts import Losses, with_further
from sceneloom.scene.annotations.corrections import CameraCalibration

_STAND_INS = ("brown_conrady", "fisheye", "fisheye_rad_tan_prism", "omnidirectional")
"""Models of the format that camera models of other models are fitted to: those whose formulas have a source."""


def written_camera_model(camera: Camera, *, any_model: bool) -> tuple[Camera, str | None]:
    """Give the camera model that an `intrinsics` record can hold: the same.

    Or the nearest one of a model of the format.

    Args:
        camera: the exact camera model.
        any_model: whether a model that the format does not list may stand there by its own name.

    Returns:
        The camera model, and in words how far it is off; None where it is the same.
    """
    count = COEFFICIENT_COUNTS.get(camera.model)
    padded = (*camera.coefficients, *(0.0,) * (count or 0))[:count]
    if camera.model == "pinhole" or (any_model and count is None):
        return camera, None
    if count is not None and not any(camera.coefficients[count:]):
        return replace(camera, coefficients=padded), None
    if camera.model not in MODELS:
        pinhole = replace(camera, model="pinhole", coefficients=())
        return pinhole, f"{camera.model} camera model reported as pinhole, off by an unknown number of pixels"
    found = nearest(camera, _candidates())
    count = COEFFICIENT_COUNTS[found.camera.model]
    return replace(found.camera, coefficients=found.camera.coefficients[:count]), found.message(camera)


def with_written_camera_model(
    calibration: CameraCalibration, losses: Losses, *, any_model: bool
) -> CameraCalibration:
    """Give a calibration the camera model that its record can hold, with all numbers of its model.

    Args:
        calibration: with the exact camera model, or without one.
        losses: collects how far the camera model is off.
        any_model: as in `written_camera_model`.
    """
    if calibration.intrinsics is None:
        return calibration
    written, how_far = written_camera_model(calibration.intrinsics, any_model=any_model)
    if how_far is not None:
        location = f"annotations[{calibration.id}].intrinsics.distortion"
        losses.add(location, how_far, support=Support.APPROXIMATED)
    return replace(calibration, intrinsics=written)


def _candidates() -> dict[str, tuple[str, ...]]:
    """The models that may stand in for others, each with the coefficients of ours that the format does not have."""
    return {
        model: MODELS[model].coefficient_names[COEFFICIENT_COUNTS[model] :]
        for model in _STAND_INS
        if model in MODELS
    }


def intrinsics_record(camera: Camera) -> dict[str, Any]:
    """Make the `intrinsics` record of a camera model that the format can hold."""
    record: dict[str, Any] = {
        name: getattr(camera, name) for name in ("fx", "fy", "cx", "cy", "width", "height")
    }
    if camera.model != "pinhole":
        record["distortion"] = {"model": camera.model, "params": list(camera.coefficients)}
    return record


def merged_intrinsics(record: dict[str, Any], further: Any) -> dict[str, Any]:
    """Add unknown fields of an `intrinsics` record and of its `distortion`; known ones win."""
    if not isinstance(further, Mapping):
        return record
    of_distortion = further.get("distortion")
    if isinstance(of_distortion, Mapping):
        record["distortion"] = with_further(record.get("distortion") or {}, of_distortion)
    return with_further(record, further)
