"""The cameras of a scene that an edit is about."""

from collections.abc import Iterable, Iterator
from dataclasses import asdict
from typing import Any

from sceneloom.cameras.camera import Camera
from sceneloom.errors import OptionError
from sceneloom.scene.annotations.corrections import CameraCalibration
from sceneloom.scene.assumed_camera_models import check_camera_models
from sceneloom.scene.cameras import CameraSensor
from sceneloom.scene.scene import Scene
from sceneloom.scene.types import Identifier, key_of


def chosen_cameras(
    scene: Scene, cameras: Iterable[Identifier] | None, *, unless: str | None = None
) -> Iterator[tuple[int, CameraSensor]]:
    """Give cameras with their locations among the sensors.

    Args:
        scene: whose cameras.
        cameras: ids of those wanted; None for all whose camera model is not of the model `unless`.
        unless: a model that needs no change.

    Raises:
        OptionError: the scene has no such camera, or none at all, or an annotation replaces its camera model.
        CalibrationError: nothing confirms the formula of a camera model, and computing with it was not asked for.
    """
    wanted = None if cameras is None else {key_of(scene.sensor(identifier).id) for identifier in cameras}
    if not scene.cameras:
        raise OptionError(f"{scene.source}: has no camera, and so no camera model to change")
    for index, sensor in enumerate(scene.sensors):
        if wanted is None:
            if isinstance(sensor, CameraSensor) and sensor.camera.model != unless:
                _check(scene, sensor)
                yield index, sensor
        elif key_of(sensor.id) in wanted:
            if not isinstance(sensor, CameraSensor):
                raise OptionError(
                    f"{scene.source}: sensor {sensor.id!r} is a {sensor.type}; expected a camera"
                )
            _check(scene, sensor)
            yield index, sensor


def _check(scene: Scene, sensor: CameraSensor) -> None:
    """Refuse camera models that cannot be computed with, or that an annotation replaces."""
    check_camera_models(scene, [sensor])
    for annotation in scene.annotations:
        if not isinstance(annotation, CameraCalibration) or annotation.intrinsics is None:
            continue
        if key_of(annotation.sensor_id) == key_of(sensor.id):
            raise OptionError(
                f"{scene.source}: annotations[{annotation.id}] gives camera {sensor.id!r} another camera model; apply "
                f"it first "
                "(`sceneloom edit apply`)"
            )


def camera_model_record(camera: Camera) -> dict[str, Any]:
    """A camera model as our metadata hold it."""
    return {**asdict(camera), "coefficients": list(camera.coefficients)}
