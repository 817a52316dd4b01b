"""Every field of the model that can hold data, by name: the words in which formats state what they can hold.

A name is the way to the field through the model's classes, with the kind of sensor or annotation instead of its id and
without indices: the intensities `scene.sensors[k].frames[i].points.intensities` of a lidar are
`sensors.lidar.frames.points.intensities`. Camera models, mountings, paths of poses, videos and attributes are one field
each.
"""

from collections.abc import Mapping
from types import MappingProxyType
from typing import Any

from sceneloom.scene.annotations.boxes_2d import Box2DAnnotation
from sceneloom.scene.annotations.corrections import CameraCalibration, LocalizationAdjustment
from sceneloom.scene.annotations.cuboids import CuboidAnnotation
from sceneloom.scene.annotations.keypoints import PointsAnnotation
from sceneloom.scene.annotations.labelled_points import LabeledPointsAnnotation
from sceneloom.scene.annotations.plain import PlainAnnotation
from sceneloom.scene.annotations.relations import (
    EventAnnotation,
    GroupAnnotation,
    LinkAnnotation,
    ObjectAnnotation,
)
from sceneloom.scene.annotations.shapes import ShapeAnnotation
from sceneloom.scene.cameras import CameraSensor
from sceneloom.scene.clouds import LidarSensor, PointsSensor, RadarSensor
from sceneloom.scene.depth import DepthCameraSensor
from sceneloom.scene.motion import GnssSensor, ImuSensor, OdometrySensor
from sceneloom.scene.plain import PlainSensor

Words = dict[str, str]
"""What fields are, for a person, by their names."""

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


def _shots(name: str, image: Words) -> Words:
    """The fields of a camera's images or images."""
    shot = {
        "timestamp_ns": "time of each image",
        "camera": "a camera model of the image's own",
        "mount": "a mounting of the image's own",
        "extras": "further fields of each image",
    }
    return {f"{name}.{field}": words for field, words in {**shot, **image}.items()}


_CAMERA = {
    **_CAMERA_MODEL,
    **_shots(
        "images",
        {"rgb": "colours of each pixel", "encoded": "the image's file as it is, such as JPEG"},
    ),
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
    **{
        f"streams.{stream}.{field}": words
        for stream in (*IMU_STREAMS, "other")
        for field, words in _SAMPLES.items()
    },
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


def _path(name: str, values: Words) -> Words:
    """The fields of something that an annotation says over time."""
    reported = {"timestamps_ns": "time of each", "extras": "further fields of it", **values}
    return {f"{name}.{field}": words for field, words in reported.items()}


def _seen(location: Words) -> Words:
    """The fields of where cameras see something."""
    reported = {
        "sensor_id": "the camera that sees it",
        "confirmed": "whether a person confirmed it",
        **location,
    }
    return _path("projections", reported)


_STATIONARY = {**_STATED, "stationary": "whether it is stationary"}
_CUBOID = {
    **_STATIONARY,
    **_path("path", {"values": "size, location and angles of the box"}),
    **_path(
        "activations",
        {
            "sensor_id": "the sensor that sees it",
            "durations_ns": "how long it is seen",
            "cuboids": "the box as seen then",
        },
    ),
    **_seen({"boxes": "its box in the image", "cuboids": "the box as seen then"}),
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

_OF_KIND: Mapping[type[Any], Words] = {
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
    PlainAnnotation: {
        "id": "the annotation's id",
        "type": "the file's word for it",
        "fields": "all of its fields",
    },
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
