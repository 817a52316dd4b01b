"""The scene model, in the words of the Sensor Fusion Scene format, with IMU and GNSS added."""

from sceneloom.scene.annotations import (
    Activation,
    Annotation,
    AttributePath,
    Box2DAnnotation,
    BoxPath,
    CameraCalibration,
    CuboidAnnotation,
    CuboidPath,
    EventAnnotation,
    GroupAnnotation,
    LabeledPoints,
    LabeledPointsAnnotation,
    LinkAnnotation,
    LocalizationAdjustment,
    ObjectAnnotation,
    PlainAnnotation,
    PointPath,
    PointProjection,
    PointsAnnotation,
    Projection,
    ShapeAnnotation,
    ShapeType,
    VertexPath,
)
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
from sceneloom.scene.depth import DepthCameraSensor, DepthFrame
from sceneloom.scene.detections import Boxes2D, Boxes3D, ScoreForm
from sceneloom.scene.findings import Finding, Severity
from sceneloom.scene.frames import LazyFrames
from sceneloom.scene.motion import GnssSensor, ImuSensor, OdometrySensor, VectorSamples
from sceneloom.scene.notices import Notice, NoticeKind
from sceneloom.scene.plain import PlainSensor
from sceneloom.scene.poses import PosePath, PoseSamples, Trajectory
from sceneloom.scene.sample import Sample
from sceneloom.scene.sample_boxes import Boxes
from sceneloom.scene.samples import Samples
from sceneloom.scene.scene import Corrections, Scene, Sensor
from sceneloom.scene.tracks import Support, Track, TrackedObjects, Tracks
from sceneloom.scene.types import Coordinates, Identifier, PointsFrame, SensorType

__all__ = [
    "Activation",
    "Annotation",
    "AttributePath",
    "Box2DAnnotation",
    "BoxPath",
    "Boxes",
    "Boxes2D",
    "Boxes3D",
    "CameraCalibration",
    "CameraSensor",
    "Coordinates",
    "Corrections",
    "CuboidAnnotation",
    "CuboidPath",
    "DepthCameraSensor",
    "DepthFrame",
    "EventAnnotation",
    "Finding",
    "GnssSensor",
    "GroupAnnotation",
    "Identifier",
    "ImuSensor",
    "LabeledPoints",
    "LabeledPointsAnnotation",
    "LazyFrames",
    "LidarFrame",
    "LidarPoints",
    "LidarSensor",
    "LinkAnnotation",
    "LocalizationAdjustment",
    "Notice",
    "NoticeKind",
    "ObjectAnnotation",
    "OdometrySensor",
    "Picture",
    "PlainAnnotation",
    "PlainSensor",
    "PointPath",
    "PointProjection",
    "PointsAnnotation",
    "PointsFrame",
    "PointsSensor",
    "PosePath",
    "PoseSamples",
    "Projection",
    "RadarFrame",
    "RadarPoints",
    "RadarSensor",
    "Sample",
    "Samples",
    "Scene",
    "ScoreForm",
    "Sensor",
    "SensorType",
    "Severity",
    "ShapeAnnotation",
    "ShapeType",
    "Support",
    "Track",
    "TrackedObjects",
    "Tracks",
    "Trajectory",
    "VectorSamples",
    "VertexPath",
    "VideoContent",
]
