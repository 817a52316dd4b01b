"""Every field of the model that can hold data, by name, and how much of each a scene holds.

A name is the way to the field through the model's classes, with the kind of sensor or annotation instead of its id and
without indices: the intensities `scene.sensors[k].frames[i].points.intensities` of a lidar are
`sensors.lidar.frames.points.intensities`. Camera models, mountings, paths of poses, videos and attributes are one field
each.
"""

from collections import Counter
from collections.abc import Callable, Iterator, Mapping
from dataclasses import MISSING, fields, is_dataclass, replace
from functools import cache, partial
from itertools import zip_longest
from types import MappingProxyType
from typing import Any

import numpy as np

from sceneloom.cameras.camera import Camera
from sceneloom.errors import SceneloomError
from sceneloom.geometry.rigid import RigidTransform
from sceneloom.scene.annotations import (
    AttributePath,
    Box2DAnnotation,
    CameraCalibration,
    CuboidAnnotation,
    EventAnnotation,
    GroupAnnotation,
    LabeledPointsAnnotation,
    LinkAnnotation,
    LocalizationAdjustment,
    ObjectAnnotation,
    PlainAnnotation,
    PointsAnnotation,
    ShapeAnnotation,
)
from sceneloom.scene.cameras import CameraImage, CameraSensor, DepthCameraSensor, DepthFrame, VideoContent
from sceneloom.scene.clouds import LidarFrame, LidarSensor, PointsSensor, RadarFrame, RadarSensor
from sceneloom.scene.frames import LazyFrames
from sceneloom.scene.motion import GnssSensor, ImuSensor, OdometrySensor, PlainSensor
from sceneloom.scene.poses import Poses
from sceneloom.scene.scene import Posed, Scene, Sensor, frames_of
from sceneloom.scene.types import Identifier, Key, key_of

_Words = dict[str, str]  # what fields are, for a person, by their names

KINDS: Mapping[type[Any], str] = MappingProxyType(
    {
        LidarSensor: "sensors.lidar",
        RadarSensor: "sensors.radar",
        PointsSensor: "sensors.points",
        CameraSensor: "sensors.camera",
        DepthCameraSensor: "sensors.depth_camera",
        OdometrySensor: "sensors.odometry",
        ImuSensor: "sensors.imu",
        GnssSensor: "sensors.gnss",
        PlainSensor: "sensors.plain",
        CuboidAnnotation: "annotations.cuboid",
        Box2DAnnotation: "annotations.box_2d",
        ShapeAnnotation: "annotations.shape",
        PointsAnnotation: "annotations.points",
        EventAnnotation: "annotations.event",
        LabeledPointsAnnotation: "annotations.labeled_points",
        LocalizationAdjustment: "annotations.localization_adjustment",
        CameraCalibration: "annotations.camera_calibration",
        ObjectAnnotation: "annotations.object",
        LinkAnnotation: "annotations.link",
        GroupAnnotation: "annotations.group",
        PlainAnnotation: "annotations.plain",
    }
)
"""The first part of the names of what each kind of sensor and annotation holds."""

IMU_STREAMS = ("accelerometer", "gyroscope", "magnetometer")
"""Streams of an IMU that have names of their own in the table; all further ones are `other`."""

NO_DATA = frozenset({"source", "format", "warnings", "on_close", "corrections"})
"""Fields of the scene that state where it comes from and how it was read."""

_SENSOR = {
    "id": "the sensor's id",
    "parent_id": "the sensor that it belongs to",
    "extras": "further fields of the sensor",
}

_POSED = {
    "poses": "where the sensor was over time",
    "mount": "how the sensor is mounted on the ego",
    "coordinates": "whether its poses lead into the world or onto the ego",
}

_SWEPT = {
    **_SENSOR,
    **_POSED,
    "points_frame": "the frame of the points: sensor, ego or world",
    "frames.timestamp_ns": "time of each sweep",
    "frames.points.positions": "where the points are",
    "frames.points.timestamps_ns": "time of each point",
    "frames.points.extras": "further values of each point",
    "frames.extras": "further fields of each sweep",
}

_LIDAR = {
    **_SWEPT,
    "model": "the maker's name for the device",
    "frames.points.intensities": "intensity of each point",
    "frames.points.colors": "colour of each point",
    "frames.points.rings": "number of the laser of each point",
    "frames.points.camera_index": "which camera coloured each point",
}

_RADAR = {
    **_SWEPT,
    "frames.points.directions": "direction in which each point's speed is measured",
    "frames.points.lengths": "speed of each point along its direction",
}

_MAP = {**_SENSOR, "positions": "where the points are", "colors": "colour of each point"}

_CAMERA_MODEL = {
    **_SENSOR,
    **_POSED,
    "camera": "the camera model: model, size and numbers",
    "video": "the encoded video as it is",
    "fps": "nominal images a second",
}


def _shots(name: str, image: _Words) -> _Words:
    """The fields of a camera's images or depth images."""
    shot = {
        "timestamp_ns": "time of each image",
        "camera": "a camera model of the image's own",
        "mount": "a mounting of the image's own",
        "extras": "further fields of each image",
    }
    return {f"{name}.{field}": words for field, words in {**shot, **image}.items()}


_CAMERA = {
    **_CAMERA_MODEL,
    **_shots("images", {"rgb": "colours of each pixel", "encoded": "the image's file as it is, such as JPEG"}),
}

_DEPTH_CAMERA = {
    **_CAMERA_MODEL,
    **_shots("frames", {"depth": "depth of each pixel", "scale": "metres per step of the source's depths"}),
}

_SAMPLES = {
    "timestamps_ns": "time of each value",
    "values": "the measured values",
    "file_seconds": "timestamps as the source has them",
}

_IMU = {
    **_SENSOR,
    **{f"streams.{stream}.{field}": words for stream in (*IMU_STREAMS, "other") for field, words in _SAMPLES.items()},
}

_GNSS = {
    **_SENSOR,
    "timestamps_ns": "time of each fix",
    "positions_lla": "latitude, longitude and altitude",
    "accuracies": "horizontal accuracy of each fix",
    "vertical_accuracies": "vertical accuracy of each fix",
    "file_seconds": "timestamps as the source has them",
    "mount": "where the antenna sits on the ego",
}

_ANNOTATION = {
    "id": "the annotation's id",
    "parent_id": "the annotation that it belongs to",
    "extras": "further fields of the annotation",
}

_STATED = {**_ANNOTATION, "label": "its class", "attributes": "what is stated about it, over time"}
_FOR_ONE = {"sensor_id": "the sensor that it is for"}


def _path(name: str, values: _Words) -> _Words:
    """The fields of something that an annotation says over time."""
    reported = {"timestamps_ns": "time of each", "extras": "further fields of it", **values}
    return {f"{name}.{field}": words for field, words in reported.items()}


def _seen(location: _Words) -> _Words:
    """The fields of where cameras see something."""
    reported = {"sensor_id": "the camera that sees it", "confirmed": "whether a person confirmed it"}
    return _path("projections", {**reported, **location})


_STATIONARY = {**_STATED, "stationary": "whether it is stationary"}

_AS_SEEN = {"cuboids": "the box as seen then"}

_CUBOID = {
    **_STATIONARY,
    **_path("path", {"values": "size, location and angles of the box"}),
    **_path("activations", {"sensor_id": "the sensor that sees it", "durations_ns": "how long it is seen", **_AS_SEEN}),
    **_seen({"boxes": "its box in the image", **_AS_SEEN}),
}

_BOX_2D = {**_STATIONARY, **_FOR_ONE, **_path("path", {"values": "the box in the image"})}

_SHAPE = {
    **_STATIONARY,
    **_FOR_ONE,
    **_path("path", {"vertices": "the vertices of the shape"}),
    "type": "which shape it is",
    "is_closed": "whether the line is closed",
}

_POINTS = {
    **{field: words for field, words in _STATIONARY.items() if field != "label"},
    **_FOR_ONE,
    **_path("paths", {"values": "the locations of the point", "id": "the point's id"}),
    "labels": "names of the points",
    **_seen({"points": "its location in the image", "positions": "the location as seen then"}),
}

_EVENT = {**_STATED, **_FOR_ONE, "start_ns": "when it begins", "duration_ns": "how long it lasts"}

_LABELED_POINTS = {
    **_STATED,
    "is_instance": "whether it is one object and not a class",
    "type": "the word for such an annotation",
    "labeled_points.sensor_id": "the sensor of the points",
    "labeled_points.point_ids": "which points they are",
    "labeled_points.sensor_frame": "the sweep of the points",
    "labeled_points.extras": "further fields of it",
}

_ADJUSTMENT = {**_ANNOTATION, "poses": "what repairs the localisation"}

_CALIBRATION = {
    **_ANNOTATION,
    **_FOR_ONE,
    "poses": "what repairs the camera's poses",
    "intrinsics": "the calibrated camera model",
    "time_offset_ns": "what repairs the camera's times",
}

_LINK = {
    **_STATED,
    **_FOR_ONE,
    "from_id": "the annotation that it leads from",
    "to_id": "the annotation that it leads to",
    "is_bidirectional": "whether it holds both ways",
}

_OF_KIND: Mapping[type[Any], _Words] = {
    LidarSensor: _LIDAR,
    RadarSensor: _RADAR,
    PointsSensor: _MAP,
    CameraSensor: _CAMERA,
    DepthCameraSensor: _DEPTH_CAMERA,
    OdometrySensor: {**_SENSOR, "poses": "where the ego was over time"},
    ImuSensor: _IMU,
    GnssSensor: _GNSS,
    PlainSensor: {"id": "the sensor's id", "type": "the file's word for it", "fields": "all of its fields"},
    CuboidAnnotation: _CUBOID,
    Box2DAnnotation: _BOX_2D,
    ShapeAnnotation: _SHAPE,
    PointsAnnotation: _POINTS,
    EventAnnotation: _EVENT,
    LabeledPointsAnnotation: _LABELED_POINTS,
    LocalizationAdjustment: _ADJUSTMENT,
    CameraCalibration: _CALIBRATION,
    ObjectAnnotation: {**_STATED, "type": "the word for such an annotation"},
    LinkAnnotation: _LINK,
    GroupAnnotation: _STATED,
    PlainAnnotation: {"id": "the annotation's id", "type": "the file's word for it", "fields": "all of its fields"},
}

MODEL_FIELDS: Mapping[str, str] = MappingProxyType(
    {
        "sensors.order": "the order of the sensors",
        **{f"{kind}.{field}": words for cls, kind in KINDS.items() for field, words in _OF_KIND[cls].items()},
        "annotations.order": "the order of the annotations",
        "trajectories.order": "which trajectory is the default, and the order of the others",
        "trajectories.name": "the trajectory's name",
        "trajectories.timestamps_ns": "time of each pose",
        "trajectories.positions": "where the ego was",
        "trajectories.quaternions_xyzw": "how the ego was rotated",
        "trajectories.file_seconds": "timestamps as the source has them",
        "trajectories.covariances": "how uncertain each pose is",
        "attributes": "what is stated about the scene and its sensors, over time",
        "metadata": "free fields of the scene",
        "time_offset_ns": "what the file's clock leaves out of its timestamps",
        "extras": "further fields of the scene",
    }
)
"""Each field and what it is, for a person. `order` is no field, but what the sequence of several says."""

AnyFrame = LidarFrame | RadarFrame | CameraImage | DepthFrame

_Reported = Callable[[Identifier, int, AnyFrame], None]
"""Is reported the sensor's id, the frame's number, and the frame."""


def watched(scene: Scene, reported: _Reported) -> Scene:
    """Give the same scene, which reports each sweep, radar cycle, image and depth image when it is read."""

    def watched_sensor(sensor: Any) -> Sensor:
        if not isinstance(sensor, Posed):
            return sensor  # type: ignore[no-any-return]
        frames = frames_of(sensor)
        seen: Any = LazyFrames(frames.timestamps_ns, partial(_read_and_report, frames, sensor.id, reported))
        return replace(sensor, images=seen) if isinstance(sensor, CameraSensor) else replace(sensor, frames=seen)

    return replace(scene, sensors=tuple(map(watched_sensor, scene.sensors)))


def _read_and_report(frames: LazyFrames[Any], sensor_id: Identifier, reported: _Reported, k: int) -> Any:
    frame = frames[k]
    reported(sensor_id, k, frame)
    return frame


_WHOLE = (Camera, RigidTransform, Poses, VideoContent, AttributePath)  # classes that are one field

_IMAGES = {"images.decode": "images.rgb", "frames.decode": "frames.depth"}
"""Functions that make an image are called by what they make."""


@cache
def _fields_of(cls: Any, prefix: str) -> tuple[tuple[str, str, Any], ...]:
    """Of the fields of a class: where the value is, what the field is called, and the value that says nothing."""
    found = []
    for field in fields(cls):
        if not field.name.startswith("_") and field.name not in NO_DATA:
            name = f"{prefix}.{field.name}".removeprefix(".")
            for function, image in _IMAGES.items():
                name = name.removesuffix(function) + image if name.endswith(function) else name
            found.append((field.name, name, None if field.default is MISSING else field.default))
    return tuple(found)


def _held_values(holder: Any, prefix: str) -> Iterator[tuple[str, Any]]:
    """Names, which begin with the prefix, and values of fields that are not absent, empty or default; no frames."""
    for attribute, name, default in _fields_of(holder.__class__, prefix):
        value = getattr(holder, attribute)
        if value is not None and not isinstance(value, LazyFrames) and _says_something(value, default):
            yield from _values_in(value, name)


def _says_something(value: Any, default: Any) -> bool:
    if isinstance(value, np.ndarray | tuple | Mapping):
        return len(value) > 0
    return default is None or bool(value != default)


def _values_in(value: Any, name: str) -> Iterator[tuple[str, Any]]:
    if name == "sensors.imu.streams":
        for stream, samples in value.items():
            yield from _held_values(samples, f"{name}.{stream if stream in IMU_STREAMS else 'other'}")
    elif isinstance(value, tuple) and (not value or isinstance(value[0], tuple) or _is_parted(value[0])):
        for part in value:  # parts, or lists of parts, of which some may be empty: a point that no camera sees
            yield from _values_in(part, name)
    elif _is_parted(value):
        yield from _held_values(value, name)
    else:
        yield name, value


def _is_parted(value: Any) -> bool:
    """Whether it is an object of the model with fields of its own; functions that make images may be objects, too."""
    return is_dataclass(value) and not isinstance(value, _WHOLE) and not callable(value)


def frame_values(sensor: Posed, frame: Any) -> Iterator[tuple[str, Any]]:
    """Give name and value of each field that one sweep, cycle, image or depth image holds."""
    prefix = f"{KINDS[type(sensor)]}.{'images' if isinstance(sensor, CameraSensor) else 'frames'}"
    own_camera_model = isinstance(frame, CameraImage | DepthFrame) and not _same_camera_model(frame.camera, sensor)
    for name, value in _held_values(frame, prefix):
        if own_camera_model or not isinstance(value, Camera):
            yield name, value


def _same_camera_model(camera_model: Camera, sensor: Posed) -> bool:
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
            yield from _held_values(item, KINDS[type(item)])
    if len(scene.trajectories) > 1:
        yield "trajectories.order", tuple(scene.trajectories)
    for trajectory in scene.trajectories.values():
        yield from _held_values(trajectory, "trajectories")
    for attribute, name, default in _fields_of(Scene, ""):
        value = getattr(scene, attribute)
        if name in MODEL_FIELDS and _says_something(value, default):
            yield name, value


class _FrameCounts:
    """What the frames of one sensor were found to hold."""

    def __init__(self, sensor: Posed) -> None:
        self.sensor = sensor
        self.seen: set[int] = set()
        self.counts: Counter[str] = Counter()
        self.like_first = 0
        self.first: tuple[str, ...] = ()
        try:
            if len(frames_of(sensor)):
                self.first = tuple({name: None for name, _ in frame_values(sensor, frames_of(sensor)[0])})
        except SceneloomError:
            # what is wrong with it is reported to those who need the frame
            part = "images" if isinstance(sensor, CameraSensor) else "frames"
            self.first = (f"{KINDS[type(sensor)]}.{part}.timestamp_ns",)

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


class Counting:
    """Counts what a scene holds; of its frames, what those that are read through `scene` are found to hold.

    Attributes:
        scene: the same scene, whose frames are counted when they are read; nothing is read twice for it but each
            sensor's first frame.
    """

    def __init__(self, scene: Scene) -> None:
        """Count all but the frames, and look at the first frame of each sensor."""
        self._stationary = Counter(name for name, _ in stationary_values(scene))
        self._frames: dict[Key, _FrameCounts] = {
            key_of(sensor.id): _FrameCounts(sensor) for sensor in scene.sensors if isinstance(sensor, Posed)
        }
        self.scene = watched(scene, self._reported)

    def _reported(self, sensor_id: Identifier, k: int, frame: AnyFrame) -> None:
        self._frames[key_of(sensor_id)].notify(k, frame)

    def counts(self) -> dict[str, int]:
        """How many objects or frames hold each field, by names of `MODEL_FIELDS`, in its order; none is left out."""
        found = sum((frames.total() for frames in self._frames.values()), self._stationary)
        return {field: found[field] for field in MODEL_FIELDS if found[field]}
