"""Lenses in the models that a target has: as they are, or by the nearest lens, with what that costs."""

from collections.abc import Collection, Mapping
from dataclasses import dataclass

from sceneloom.cameras.camera import Camera
from sceneloom.cameras.fitting import nearest
from sceneloom.cameras.table import MODELS
from sceneloom.formats.loss import Fate, Loss
from sceneloom.scene.types import Identifier

Models = Mapping[str, Collection[str]]
"""Names of models, each with the coefficients of it that the target does not have."""


@dataclass(frozen=True, slots=True)
class ToldLens:
    """A lens as a target has it.

    Attributes:
        camera: of one of the target's models.
        loss: what it costs, None where it is exact.
    """

    camera: Camera
    loss: Loss | None = None


def coefficients(camera: Camera) -> dict[str, float]:
    """The coefficients by name; those that are not said are 0."""
    names = MODELS[camera.model].coefficient_names
    return {**dict.fromkeys(names, 0.0), **dict(zip(names, camera.coefficients, strict=False))}


def told_lens(camera: Camera, models: Models, sensor_id: Identifier) -> ToldLens:
    """Say a lens in one of some models.

    Args:
        camera: the lens.
        models: those of the target, the simplest first.
        sensor_id: of the camera, for the loss.

    Raises:
        CalibrationError: no model holds anything of what the lens sees.
    """
    for model, missing in models.items():
        plain = camera.model == "pinhole" and model == "brown_conrady"
        named = coefficients(camera)
        if plain or (camera.model == model and not any(named[name] for name in missing)):
            return ToldLens(camera)
    fit = nearest(camera, models)
    loss = Loss(
        field=f"sensors[{sensor_id}].camera",
        what=f"{fit.message(camera)} [px]",
        fate=Fate.APPROXIMATED,
        largest_error=fit.largest_px,
    )
    return ToldLens(fit.camera, loss)
