"""Camera models of models whose formulas are assumed: they are computed with only where a user says so."""

from collections.abc import Iterable, Mapping
from dataclasses import replace
from types import MappingProxyType
from typing import Any

from sceneloom.cameras.table import MODELS
from sceneloom.errors import CalibrationError
from sceneloom.scene.cameras import CameraSensor
from sceneloom.scene.depth import DepthCameraSensor
from sceneloom.scene.scene import Scene
from sceneloom.scene.warnings import DataWarning, WarningKind

OURS, ENTRY = "sceneloom", "assumed_models"
"""Where a scene's metadata state with which of these models it may be computed."""


def check_camera_models(
    scene: Scene, cameras: Iterable[CameraSensor | DepthCameraSensor] | None = None
) -> None:
    """Refuse to compute with camera models of models that no source confirms, unless that was asked for on opening.

    Args:
        scene: whose metadata state what was asked for.
        cameras: those that are computed with; None for all.

    Raises:
        CalibrationError: naming the camera, the model and the option.
    """
    allowed = assumed_models(scene)
    for camera in scene.cameras if cameras is None else cameras:
        model = camera.camera.model
        if model in MODELS and MODELS[model].on_request and model not in allowed:
            raise CalibrationError(
                f"{scene.source}: sensors[{camera.id}].camera: {model!r} is named by the format, but nothing says "
                "its formula; state `--assume-model` (assume_model=True on opening) to compute with the one that "
                "docs/CONVENTIONS.md gives"
            )


def assumed_models(scene: Scene) -> tuple[str, ...]:
    """The models that were asked for."""
    reported = _ours(scene).get(ENTRY)
    return (
        tuple(name for name in reported if isinstance(name, str))
        if isinstance(reported, list | tuple)
        else ()
    )


def _ours(scene: Scene) -> Mapping[str, Any]:
    ours = scene.metadata.get(OURS)
    return ours if isinstance(ours, Mapping) else {}


def with_assumed_models(scene: Scene) -> Scene:
    """Give the scene that may be computed with; its metadata and a warning for each such model report it."""
    models = {
        camera.camera.model: camera.id
        for camera in scene.cameras
        if camera.camera.model in MODELS and MODELS[camera.camera.model].on_request
    }
    if not models:
        return scene
    reported = sorted({*assumed_models(scene), *models})
    metadata = {**scene.metadata, OURS: {**_ours(scene), ENTRY: reported}}
    warnings = (
        DataWarning(
            kind=WarningKind.ASSUMED,
            code="assumed-model",
            location=f"sensors[{camera_id}].camera",
            message=f"{model}: computed with by a formula that nothing confirms, as asked for",
        )
        for model, camera_id in models.items()
    )
    return replace(scene, metadata=MappingProxyType(metadata), warnings=(*scene.warnings, *warnings))
