"""Scenes whose camera models are reported by another model, as near as it comes; the images stay as they are."""

from collections.abc import Iterable
from dataclasses import dataclass, field, replace
from typing import Any

from sceneloom.cameras.camera import Camera
from sceneloom.cameras.fitting import Fit, fit
from sceneloom.cameras.table import MODELS
from sceneloom.editing.chosen_cameras import camera_model_record, chosen_cameras
from sceneloom.editing.record import assumed, ours_of, skipped, with_ours, with_warnings
from sceneloom.errors import CalibrationError, OptionError
from sceneloom.scene.cameras import CameraImage, CameraSensor
from sceneloom.scene.frames import LazyFrames
from sceneloom.scene.scene import Scene
from sceneloom.scene.types import Identifier
from sceneloom.scene.warnings import DataWarning

LIMIT_PX = 1.0
"""How far a point may move at most, where the caller says nothing [px]."""


def convert_camera_models(
    scene: Scene,
    model: str,
    *,
    cameras: Iterable[Identifier] | None = None,
    limit_px: float = LIMIT_PX,
    share: float = 0.99,
) -> Scene:
    """Give the scene with camera models of another model, each fitted to the one that stood there.

    Corrections are applied first.

    How far the two put what the images show apart, at most, stands in a warning for each camera, and with the
    camera model that it was in the metadata, as `sceneloom.camera_models`.

    Args:
        scene: as it is.
        model: a name out of `cameras.MODELS`.
        cameras: ids of the only cameras to change; None for all.
        limit_px: how many pixels that may be.
        share: which part of what an image shows the new camera model must hold at least.

    Raises:
        OptionError: the model is unknown, a camera is not there, or a limit is none.
        CalibrationError: the model comes no nearer than the limits state.
    """
    if model not in MODELS:
        raise OptionError(f"camera model {model!r}; expected one of {', '.join(MODELS)}")
    if not limit_px >= 0 or not 0 <= share <= 1:
        raise OptionError(f"limit {limit_px} px, share {share}; expected 0 px or more and a share of 0 to 1")
    scene = scene.corrected()
    sensors: list[Any] = list(scene.sensors)
    entries, warnings = list(ours_of(scene).get("camera_models") or ()), list[DataWarning]()
    for index, sensor in chosen_cameras(scene, cameras, unless=model):
        camera_models = _CameraModels(model, f"sensors[{sensor.id}].camera", limit_px, share)
        found = camera_models.fit(sensor.camera)
        sensors[index] = _with_camera_model(sensor, found.camera, camera_models)
        warnings.append(assumed("camera-model-fitted", camera_models.location, found.message(sensor.camera)))
        entries.append(
            {
                "sensor": sensor.id,
                "largest_px": found.largest_px,
                "rms_px": found.rms_px,
                "share": found.share,
                "camera": camera_model_record(sensor.camera),
            }
        )
    if not warnings:
        message = f"every camera model is reported as {model} already; none was changed"
        warnings.append(skipped("nothing-to-convert", "sensors", message))
    changed = replace(scene, sensors=tuple(sensors))
    return with_warnings(with_ours(changed, camera_models=entries or None), warnings)


def _with_camera_model(sensor: CameraSensor, camera: Camera, camera_models: "_CameraModels") -> CameraSensor:
    images = LazyFrames(
        sensor.images.timestamps_ns, _Relensed(sensor.images, camera_models, {sensor.camera: camera})
    )
    return replace(sensor, camera=camera, images=images)


@dataclass(frozen=True, slots=True)
class _CameraModels:
    """Fits camera models, and refuses what is too far off."""

    model: str
    location: str
    limit_px: float
    share: float

    def fit(self, camera: Camera) -> Fit:
        found = fit(camera, self.model)
        if not found.largest_px <= self.limit_px or found.share < self.share:
            raise CalibrationError(
                f"{self.location}: {found.message(camera)}; expected at most {self.limit_px:g} px and "
                f"{100 * (1 - self.share):g} %: choose another model or other limits"
            )
        return found


@dataclass(frozen=True, slots=True, eq=False)
class _Relensed:
    """Reads images with camera models of the new model; a camera model that an image has of its own is fitted then."""

    images: LazyFrames[CameraImage]
    camera_models: _CameraModels
    known: dict[Camera, Camera] = field(default_factory=dict)

    def __call__(self, k: int) -> CameraImage:
        image = self.images[k]
        exact = image.camera
        if exact not in self.known:
            self.known[exact] = (
                exact if exact.model == self.camera_models.model else self.camera_models.fit(exact).camera
            )
        return replace(image, camera=self.known[exact])
