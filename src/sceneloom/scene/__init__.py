"""The scene model, in the words of the Sensor Fusion Scene format, with IMU and GNSS added."""

from sceneloom.scene.annotations import Annotation, CuboidAnnotation, CuboidPath, PlainAnnotation
from sceneloom.scene.cameras import CameraSensor, Picture, VideoContent
from sceneloom.scene.clouds import (
    LidarFrame,
    LidarPoints,
    LidarSensor,
    PointsSensor,
    RadarFrame,
    RadarPoints,
    RadarSensor,
)
from sceneloom.scene.detections import Boxes2D, Boxes3D, ScoreForm
from sceneloom.scene.frames import LazyFrames
from sceneloom.scene.motion import GnssSensor, ImuSensor, OdometrySensor, VectorSamples
from sceneloom.scene.notices import Notice, NoticeKind
from sceneloom.scene.plain import PlainSensor
from sceneloom.scene.poses import PosePath, PoseSamples, Trajectory
from sceneloom.scene.sample import Sample
from sceneloom.scene.sample_boxes import Boxes
from sceneloom.scene.samples import Samples
from sceneloom.scene.scene import Scene, Sensor
from sceneloom.scene.types import Coordinates, Identifier, PointsFrame, SensorType

__all__ = [
    "Annotation",
    "Boxes",
    "Boxes2D",
    "Boxes3D",
    "CameraSensor",
    "Coordinates",
    "CuboidAnnotation",
    "CuboidPath",
    "GnssSensor",
    "Identifier",
    "ImuSensor",
    "LazyFrames",
    "LidarFrame",
    "LidarPoints",
    "LidarSensor",
    "Notice",
    "NoticeKind",
    "OdometrySensor",
    "Picture",
    "PlainAnnotation",
    "PlainSensor",
    "PointsFrame",
    "PointsSensor",
    "PosePath",
    "PoseSamples",
    "RadarFrame",
    "RadarPoints",
    "RadarSensor",
    "Sample",
    "Samples",
    "Scene",
    "ScoreForm",
    "Sensor",
    "SensorType",
    "Trajectory",
    "VectorSamples",
    "VideoContent",
]
