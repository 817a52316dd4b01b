"""What a `frames` line reports, whether a camera takes images or measures depth."""

from collections.abc import Sequence

from sceneloom.scene.cameras import CameraSensor
from sceneloom.scene.depth import DepthCameraSensor
from sceneloom.scene.scene import Scene
from sceneloom.scene.shooting import ShootingSensor, shots_of

_DEFAULT_FPS = 10.0


def field_of(sensor: ShootingSensor) -> str:
    """The path of a camera's images or images, for loss reports."""
    return f"sensors[{sensor.id}].{'images' if isinstance(sensor, CameraSensor) else 'frames'}"


def shooting_sensors(scene: Scene) -> Sequence[ShootingSensor]:
    """The cameras in the order of `cameraInd`: as they were read from a recording, else those of depth last.

    The vendor's software takes the first two for a pair of stereo images, or for an image and its depth.
    """
    found = [sensor for sensor in scene.sensors if isinstance(sensor, CameraSensor | DepthCameraSensor)]
    if of_recording(scene):
        return found
    return sorted(found, key=lambda sensor: isinstance(sensor, DepthCameraSensor))


def of_recording(scene: Scene) -> bool:
    """Whether a scene was read from a recording, be it through a scene file."""
    return scene.format == "recording" or "recording" in scene.metadata


def frame_rate(sensor: ShootingSensor) -> float:
    """Nominal images a second."""
    timestamps = shots_of(sensor).timestamps_ns
    if sensor.fps:
        return sensor.fps
    span = (int(timestamps[-1]) - int(timestamps[0])) * 1e-9 if len(timestamps) > 1 else 0.0
    return (len(timestamps) - 1) / span if span > 0 else _DEFAULT_FPS
