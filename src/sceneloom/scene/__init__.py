"""The scene model, in the words of the Sensor Fusion Scene format, with IMU and GNSS added."""

from typing import TYPE_CHECKING

from sceneloom.lazy import names_on_first_use

if TYPE_CHECKING:
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
    from sceneloom.scene.annotations_at import Boxes
    from sceneloom.scene.cameras import CameraImage, CameraSensor, DepthCameraSensor, DepthFrame, VideoContent
    from sceneloom.scene.clouds import (
        LidarFrame,
        LidarPoints,
        LidarSensor,
        PointsSensor,
        RadarFrame,
        RadarPoints,
        RadarSensor,
    )
    from sceneloom.scene.detections import Boxes2D, Boxes3D, ScoreForm, Support, Track, TrackedObjects, Tracks
    from sceneloom.scene.frames import LazyFrames
    from sceneloom.scene.motion import GnssSensor, ImuSensor, OdometrySensor, PlainSensor, VectorSamples
    from sceneloom.scene.poses import Poses, PoseSamples, Trajectory
    from sceneloom.scene.samples import Sample, Samples
    from sceneloom.scene.scene import Corrections, Scene, Sensor
    from sceneloom.scene.types import Coordinates, Identifier, PointsFrame, SensorType
    from sceneloom.warnings import DataWarning, Finding, Severity, WarningKind
else:
    __getattr__, __dir__ = names_on_first_use(
        __name__,
        {
            "annotations": "Activation Annotation AttributePath Box2DAnnotation BoxPath CameraCalibration "
            "CuboidAnnotation CuboidPath EventAnnotation GroupAnnotation LabeledPoints LabeledPointsAnnotation "
            "LinkAnnotation LocalizationAdjustment ObjectAnnotation PlainAnnotation PointPath PointProjection "
            "PointsAnnotation Projection ShapeAnnotation ShapeType VertexPath",
            "annotations_at": "Boxes",
            "cameras": "CameraImage CameraSensor DepthCameraSensor DepthFrame VideoContent",
            "clouds": "LidarFrame LidarPoints LidarSensor PointsSensor RadarFrame RadarPoints RadarSensor",
            "detections": "Boxes2D Boxes3D ScoreForm Support Track TrackedObjects Tracks",
            "frames": "LazyFrames",
            "motion": "GnssSensor ImuSensor OdometrySensor PlainSensor VectorSamples",
            "poses": "PoseSamples Poses Trajectory",
            "samples": "Sample Samples",
            "scene": "Corrections Scene Sensor",
            "sceneloom.warnings": "DataWarning Finding Severity WarningKind",
            "types": "Coordinates Identifier PointsFrame SensorType",
        },
    )

__all__ = [
    "Activation", "Annotation", "AttributePath", "Box2DAnnotation", "BoxPath", "Boxes", "Boxes2D", "Boxes3D",
    "CameraCalibration", "CameraImage", "CameraSensor", "Coordinates", "Corrections", "CuboidAnnotation", "CuboidPath",
    "DataWarning", "DepthCameraSensor", "DepthFrame", "EventAnnotation", "Finding", "GnssSensor", "GroupAnnotation",
    "Identifier", "ImuSensor", "LabeledPoints", "LabeledPointsAnnotation", "LazyFrames", "LidarFrame", "LidarPoints",
    "LidarSensor", "LinkAnnotation", "LocalizationAdjustment", "ObjectAnnotation", "OdometrySensor", "PlainAnnotation",
    "PlainSensor", "PointPath", "PointProjection", "PointsAnnotation", "PointsFrame", "PointsSensor", "PoseSamples",
    "Poses", "Projection", "RadarFrame", "RadarPoints", "RadarSensor", "Sample", "Samples", "Scene", "ScoreForm",
    "Sensor", "SensorType", "Severity", "ShapeAnnotation", "ShapeType", "Support", "Track", "TrackedObjects", "Tracks",
    "Trajectory", "VectorSamples", "VertexPath", "VideoContent", "WarningKind",
]  # fmt: skip
