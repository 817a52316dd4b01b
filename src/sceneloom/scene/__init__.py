"""The scene model, in the words of the Sensor Fusion Scene format, with IMU and GNSS added."""

from typing import TYPE_CHECKING

from sceneloom.lazy import names_on_first_use

if TYPE_CHECKING:
    from sceneloom.scene.annotations.annotation import Annotation
    from sceneloom.scene.annotations.attributes import AttributePath
    from sceneloom.scene.annotations.boxes_2d import Box2DAnnotation, BoxPath
    from sceneloom.scene.annotations.corrections import CameraCalibration, LocalizationAdjustment
    from sceneloom.scene.annotations.cuboids import Activation, CuboidAnnotation, CuboidPath, Projection
    from sceneloom.scene.annotations.keypoints import PointPath, PointProjection, PointsAnnotation
    from sceneloom.scene.annotations.labelled_points import LabeledPoints, LabeledPointsAnnotation
    from sceneloom.scene.annotations.plain import PlainAnnotation
    from sceneloom.scene.annotations.relations import (
        EventAnnotation,
        GroupAnnotation,
        LinkAnnotation,
        ObjectAnnotation,
    )
    from sceneloom.scene.annotations.shapes import ShapeAnnotation, ShapeType, VertexPath
    from sceneloom.scene.cameras import CameraImage, CameraSensor, VideoContent
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
    from sceneloom.scene.plain import PlainSensor
    from sceneloom.scene.poses import Poses, PoseSamples, Trajectory
    from sceneloom.scene.sample import Sample
    from sceneloom.scene.sample_boxes import Boxes
    from sceneloom.scene.samples import Samples
    from sceneloom.scene.scene import Corrections, Scene, Sensor
    from sceneloom.scene.tracks import Support, Track, TrackedObjects, Tracks
    from sceneloom.scene.types import Coordinates, Identifier, PointsFrame, SensorType
    from sceneloom.scene.warnings import DataWarning, WarningKind
else:
    __getattr__, __dir__ = names_on_first_use(
        __name__,
        {
            "Activation": "sceneloom.scene.annotations.cuboids:Activation",
            "Annotation": "sceneloom.scene.annotations.annotation:Annotation",
            "AttributePath": "sceneloom.scene.annotations.attributes:AttributePath",
            "Box2DAnnotation": "sceneloom.scene.annotations.boxes_2d:Box2DAnnotation",
            "BoxPath": "sceneloom.scene.annotations.boxes_2d:BoxPath",
            "Boxes": "sceneloom.scene.sample_boxes:Boxes",
            "Boxes2D": "sceneloom.scene.detections:Boxes2D",
            "Boxes3D": "sceneloom.scene.detections:Boxes3D",
            "CameraCalibration": "sceneloom.scene.annotations.corrections:CameraCalibration",
            "CameraSensor": "sceneloom.scene.cameras:CameraSensor",
            "Coordinates": "sceneloom.scene.types:Coordinates",
            "Corrections": "sceneloom.scene.scene:Corrections",
            "CuboidAnnotation": "sceneloom.scene.annotations.cuboids:CuboidAnnotation",
            "CuboidPath": "sceneloom.scene.annotations.cuboids:CuboidPath",
            "DepthCameraSensor": "sceneloom.scene.depth:DepthCameraSensor",
            "DepthFrame": "sceneloom.scene.depth:DepthFrame",
            "EventAnnotation": "sceneloom.scene.annotations.relations:EventAnnotation",
            "Finding": "sceneloom.scene.findings:Finding",
            "GnssSensor": "sceneloom.scene.motion:GnssSensor",
            "GroupAnnotation": "sceneloom.scene.annotations.relations:GroupAnnotation",
            "Identifier": "sceneloom.scene.types:Identifier",
            "ImuSensor": "sceneloom.scene.motion:ImuSensor",
            "LabeledPoints": "sceneloom.scene.annotations.labelled_points:LabeledPoints",
            "LabeledPointsAnnotation": "sceneloom.scene.annotations.labelled_points:LabeledPointsAnnotation",
            "LazyFrames": "sceneloom.scene.frames:LazyFrames",
            "LidarFrame": "sceneloom.scene.clouds:LidarFrame",
            "LidarPoints": "sceneloom.scene.clouds:LidarPoints",
            "LidarSensor": "sceneloom.scene.clouds:LidarSensor",
            "LinkAnnotation": "sceneloom.scene.annotations.relations:LinkAnnotation",
            "LocalizationAdjustment": "sceneloom.scene.annotations.corrections:LocalizationAdjustment",
            "DataWarning": "sceneloom.scene.warnings:DataWarning",
            "WarningKind": "sceneloom.scene.warnings:WarningKind",
            "ObjectAnnotation": "sceneloom.scene.annotations.relations:ObjectAnnotation",
            "OdometrySensor": "sceneloom.scene.motion:OdometrySensor",
            "CameraImage": "sceneloom.scene.cameras:CameraImage",
            "PlainAnnotation": "sceneloom.scene.annotations.plain:PlainAnnotation",
            "PlainSensor": "sceneloom.scene.plain:PlainSensor",
            "PointPath": "sceneloom.scene.annotations.keypoints:PointPath",
            "PointProjection": "sceneloom.scene.annotations.keypoints:PointProjection",
            "PointsAnnotation": "sceneloom.scene.annotations.keypoints:PointsAnnotation",
            "PointsFrame": "sceneloom.scene.types:PointsFrame",
            "PointsSensor": "sceneloom.scene.clouds:PointsSensor",
            "Poses": "sceneloom.scene.poses:Poses",
            "PoseSamples": "sceneloom.scene.poses:PoseSamples",
            "Projection": "sceneloom.scene.annotations.cuboids:Projection",
            "RadarFrame": "sceneloom.scene.clouds:RadarFrame",
            "RadarPoints": "sceneloom.scene.clouds:RadarPoints",
            "RadarSensor": "sceneloom.scene.clouds:RadarSensor",
            "Sample": "sceneloom.scene.sample:Sample",
            "Samples": "sceneloom.scene.samples:Samples",
            "Scene": "sceneloom.scene.scene:Scene",
            "ScoreForm": "sceneloom.scene.detections:ScoreForm",
            "Sensor": "sceneloom.scene.scene:Sensor",
            "SensorType": "sceneloom.scene.types:SensorType",
            "Severity": "sceneloom.scene.findings:Severity",
            "ShapeAnnotation": "sceneloom.scene.annotations.shapes:ShapeAnnotation",
            "ShapeType": "sceneloom.scene.annotations.shapes:ShapeType",
            "Support": "sceneloom.scene.tracks:Support",
            "Track": "sceneloom.scene.tracks:Track",
            "TrackedObjects": "sceneloom.scene.tracks:TrackedObjects",
            "Tracks": "sceneloom.scene.tracks:Tracks",
            "Trajectory": "sceneloom.scene.poses:Trajectory",
            "VectorSamples": "sceneloom.scene.motion:VectorSamples",
            "VertexPath": "sceneloom.scene.annotations.shapes:VertexPath",
            "VideoContent": "sceneloom.scene.cameras:VideoContent",
        },
    )

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
    "CameraImage",
    "CameraSensor",
    "Coordinates",
    "Corrections",
    "CuboidAnnotation",
    "CuboidPath",
    "DataWarning",
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
    "ObjectAnnotation",
    "OdometrySensor",
    "PlainAnnotation",
    "PlainSensor",
    "PointPath",
    "PointProjection",
    "PointsAnnotation",
    "PointsFrame",
    "PointsSensor",
    "PoseSamples",
    "Poses",
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
    "WarningKind",
]
