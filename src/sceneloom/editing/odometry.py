"""The odometry sensor that stands for the ego in a scene of ego coordinates."""

from dataclasses import replace

from sceneloom.scene.motion import OdometrySensor
from sceneloom.scene.poses import Poses, same_direction
from sceneloom.scene.scene import Scene
from sceneloom.scene.types import Identifier

EGO_ID = "ego"
"""Id of an odometry sensor that is made, if it is free."""


def odometry_telling(scene: Scene, path: Poses) -> OdometrySensor | None:
    """The odometry sensor that reports this very path; None where there is none."""
    for sensor in scene.sensors:
        if isinstance(sensor, OdometrySensor) and same_direction(sensor.poses, path):
            return sensor
    return None


def with_odometry(scene: Scene, path: Poses) -> tuple[Scene, Identifier]:
    """Give the scene with an odometry sensor that reports this path, and the sensor's id."""
    reported = odometry_telling(scene, path)
    if reported is not None:
        return scene, reported.id
    sensor = OdometrySensor(free_id(scene, EGO_ID), path)
    return replace(scene, sensors=(*scene.sensors, sensor)), sensor.id


def free_id(scene: Scene, wanted: str) -> str:
    """The id itself, or with a number where another sensor has it."""
    taken = {sensor.id for sensor in scene.sensors}
    choices = (wanted if number == 1 else f"{wanted}{number}" for number in range(1, len(taken) + 2))
    return next(choice for choice in choices if choice not in taken)
