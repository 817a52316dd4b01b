"""How much of each field of the model a scene holds, counted while its frames are read by others."""

from collections import Counter
from collections.abc import Iterator, Mapping
from dataclasses import MISSING, Field, dataclass, fields, is_dataclass, replace
from functools import cache
from itertools import zip_longest
from typing import Any

import numpy as np

from sceneloom.cameras.camera import Camera
from sceneloom.errors import SceneloomError
from sceneloom.geometry.rigid import RigidTransform
from sceneloom.scene.annotations.attributes import AttributePath
from sceneloom.scene.cameras import CameraImage, CameraSensor, VideoContent
from sceneloom.scene.clouds import LidarFrame, LidarSensor, RadarSensor
from sceneloom.scene.contents import IMU_STREAMS, KINDS, MODEL_FIELDS, NO_DATA
from sceneloom.scene.depth import DepthCameraSensor, DepthFrame
from sceneloom.scene.frames import LazyFrames
from sceneloom.scene.poses import Poses
from sceneloom.scene.scene import Scene
from sceneloom.scene.types import Identifier, Key, key_of
from sceneloom.scene.watched import AnyFrame, watched

_WHOLE = (Camera, RigidTransform, Poses, VideoContent, AttributePath)
"""Classes that are one field."""

_IMAGES = {"images.decode": "images.rgb", "frames.decode": "frames.depth"}
"""Functions that make an image are called by what they make."""

FramedSensor = LidarSensor | RadarSensor | CameraSensor | DepthCameraSensor


def frames_of(sensor: FramedSensor) -> LazyFrames[Any]:
    """The sweeps, images or images of a sensor."""
    return sensor.images if isinstance(sensor, CameraSensor) else sensor.frames


@dataclass(frozen=True, slots=True)
class _Location:
    """A field of a class: where its value is, what it is called, and the value that says nothing."""

    attribute: str
    name: str
    default: Any


@cache
def _locations(cls: Any, trajectory: str) -> tuple[_Location, ...]:
    found = (field for field in fields(cls) if not field.name.startswith("_") and field.name not in NO_DATA)
    return tuple(
        _Location(field.name, _named(f"{trajectory}.{field.name}"), _default(field)) for field in found
    )


def _named(name: str) -> str:
    for function, image in _IMAGES.items():
        if name.endswith(function):
            return name.removesuffix(function) + image
    return name.removeprefix(".")


def _default(field: Field[Any]) -> Any:
    return None if field.default is MISSING else field.default


def held_values(holder: Any, trajectory: str) -> Iterator[tuple[str, Any]]:
    """Give name and value of each field that an object of the model holds, and of those within it; frames left out.

    What is absent, empty, or as it is where nobody says anything is not held.

    Args:
        holder: an object of one of the model's classes.
        trajectory: the name of what it is.
    """
    for location in _locations(holder.__class__, trajectory):
        value = getattr(holder, location.attribute)
        if (
            value is not None
            and not isinstance(value, LazyFrames)
            and _says_something(value, location.default)
        ):
            yield from _values_in(value, location.name)


def _says_something(value: Any, default: Any) -> bool:
    if isinstance(value, np.ndarray | tuple | Mapping):
        return len(value) > 0
    return default is None or bool(value != default)


def _values_in(value: Any, name: str) -> Iterator[tuple[str, Any]]:
    if name == "sensors.imu.streams":
        for stream, samples in value.items():
            yield from held_values(samples, f"{name}.{stream if stream in IMU_STREAMS else 'other'}")
    elif isinstance(value, tuple) and _has_parts(value):
        for part in value:
            yield from _values_in(part, name)
    elif _is_parted(value):
        yield from held_values(value, name)
    else:
        yield name, value


def _has_parts(values: tuple[Any, ...]) -> bool:
    """Whether its entries are parts, or lists of parts, of which some may be empty: a point that no camera sees."""
    return not values or isinstance(values[0], tuple) or _is_parted(values[0])


def _is_parted(value: Any) -> bool:
    """Whether it is an object of the model with fields of its own; functions that make images may be objects, too."""
    return is_dataclass(value) and not isinstance(value, _WHOLE) and not callable(value)


def frame_values(sensor: FramedSensor, frame: Any) -> Iterator[tuple[str, Any]]:
    """Give name and value of each field that one sweep, image or image holds."""
    trajectory = f"{KINDS[type(sensor)]}.{'images' if isinstance(sensor, CameraSensor) else 'frames'}"
    own_camera_model = isinstance(frame, CameraImage | DepthFrame) and not _same_camera_model(
        frame.camera, sensor
    )
    for name, value in held_values(frame, trajectory):
        if own_camera_model or not isinstance(value, Camera):
            yield name, value


def _same_camera_model(camera_model: Camera, sensor: FramedSensor) -> bool:
    """Whether an image's camera model is that of its camera, but for zeros at the end of the coefficients."""
    usual = getattr(sensor, "camera", camera_model)
    return camera_model == usual or bool(
        replace(camera_model, coefficients=()) == replace(usual, coefficients=())
        and all(a == b for a, b in zip_longest(camera_model.coefficients, usual.coefficients, fillvalue=0.0))
    )


def stationary_values(scene: Scene) -> Iterator[tuple[str, Any]]:
    """Give name and value of each field that a scene holds outside of its frames; `order` is the ids or names."""
    for several, items in (("sensors", scene.sensors), ("annotations", scene.annotations)):
        if len(items) > 1:
            yield f"{several}.order", tuple(item.id for item in items)
        for item in items:
            yield from held_values(item, KINDS[type(item)])
    if len(scene.trajectories) > 1:
        yield "trajectories.order", tuple(scene.trajectories)
    for trajectory in scene.trajectories.values():
        yield from held_values(trajectory, "trajectories")
    for location in _locations(Scene, ""):
        value = getattr(scene, location.attribute)
        if location.name in MODEL_FIELDS and _says_something(value, location.default):
            yield location.name, value


class _Sweeping:
    """What the frames of one sensor were found to hold."""

    def __init__(self, sensor: FramedSensor) -> None:
        self.sensor = sensor
        self.seen: set[int] = set()
        self.counts: Counter[str] = Counter()
        self.like_first = 0
        self.first = _first_frame_holds(sensor)

    def notify(self, k: int, frame: AnyFrame) -> None:
        if k in self.seen:
            return
        self.seen.add(k)
        if isinstance(frame, LidarFrame) and frame.points.packed_count() is not None:
            # others may copy the records as they are: they are not unpacked for the sake of counting
            self.like_first += 1
        else:
            self.counts.update(name for name, _ in frame_values(self.sensor, frame))

    def total(self) -> Counter[str]:
        """How many frames have each field; frames that nobody read are taken to be like the first one."""
        unread = self.like_first + len(frames_of(self.sensor)) - len(self.seen)
        return self.counts + Counter(dict.fromkeys(self.first, unread))


def _first_frame_holds(sensor: FramedSensor) -> tuple[str, ...]:
    frames = frames_of(sensor)
    if not len(frames):
        return ()
    try:
        return tuple({name: None for name, _ in frame_values(sensor, frames[0])})
    except SceneloomError:
        # what is wrong with it is reported to those who need the frame
        part = "images" if isinstance(sensor, CameraSensor) else "frames"
        return (f"{KINDS[type(sensor)]}.{part}.timestamp_ns",)


class Counting:
    """Counts what a scene holds; of its frames, what those that are read through `scene` are found to hold.

    Attributes:
        scene: the same scene, whose frames are counted when they are read; nothing is read twice for it but each
            sensor's first frame.
    """

    def __init__(self, scene: Scene) -> None:
        """Count all but the frames, and look at the first frame of each sensor."""
        self._stationary = Counter(name for name, _ in stationary_values(scene))
        self._sweeping: dict[Key, _Sweeping] = {
            key_of(sensor.id): _Sweeping(sensor)
            for sensor in scene.sensors
            if isinstance(sensor, LidarSensor | RadarSensor | CameraSensor | DepthCameraSensor)
        }
        self.scene = watched(scene, self._reported)

    def _reported(self, sensor_id: Identifier, k: int, frame: AnyFrame) -> None:
        self._sweeping[key_of(sensor_id)].notify(k, frame)

    def counts(self) -> dict[str, int]:
        """How many objects or frames hold each field, by names of `MODEL_FIELDS`, in its order; none is left out."""
        found = sum((sweeping.total() for sweeping in self._sweeping.values()), self._stationary)
        return {field: found[field] for field in MODEL_FIELDS if found[field]}


def contents_of(scene: Scene) -> dict[str, int]:
    """Report how many objects or frames of a scene hold each field, by its names; only first frames are looked at."""
    return Counting(scene).counts()
