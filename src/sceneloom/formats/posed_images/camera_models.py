"""Camera models in the models that a target has: as they are, or by the nearest camera model, with what that costs."""

from collections.abc import Collection, Mapping
from dataclasses import dataclass

from sceneloom.cameras.camera import Camera
from sceneloom.cameras.fitting import nearest
from sceneloom.cameras.table import MODELS
from sceneloom.formats.loss import Loss, Support
from sceneloom.scene.types import Identifier

Models = Mapping[str, Collection[str]]
"""Names of models, each with the coefficients of it that the target does not have."""


@dataclass(frozen=True, slots=True)
class StatedCameraModel:
    """A camera model as a target has it.

    Attributes:
        camera: of one of the target's models.
        loss: what it costs, None where it is exact.
    """

    camera: Camera
    loss: Loss | None = None


def coefficients(camera: Camera) -> dict[str, float]:
    """The coefficients by name; those that are not stated are 0."""
    names = MODELS[camera.model].coefficient_names
    return {**dict.fromkeys(names, 0.0), **dict(zip(names, camera.coefficients, strict=False))}


def stated_camera_model(camera: Camera, models: Models, sensor_id: Identifier) -> StatedCameraModel:
    """Report a camera model in one of some models.

    Args:
        camera: the camera model.
        models: those of the target, the simplest first.
        sensor_id: of the camera, for the loss.

    Raises:
        CalibrationError: no model holds anything of what the camera model sees.
    """
    for model, missing in models.items():
        plain = camera.model == "pinhole" and model == "brown_conrady"
        named = coefficients(camera)
        if plain or (camera.model == model and not any(named[name] for name in missing)):
            return StatedCameraModel(camera)
    fit = nearest(camera, models)
    loss = Loss(
        field=f"sensors[{sensor_id}].camera",
        what=f"{fit.message(camera)} [px]",
        support=Support.APPROXIMATED,
        largest_error=fit.largest_px,
    )
    return StatedCameraModel(fit.camera, loss)
