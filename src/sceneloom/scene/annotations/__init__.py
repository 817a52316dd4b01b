"""What people and programs say about a scene: every annotation of the Sensor Fusion Scene format, and attributes."""

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

Annotation = (
    CuboidAnnotation
    | Box2DAnnotation
    | ShapeAnnotation
    | PointsAnnotation
    | EventAnnotation
    | LabeledPointsAnnotation
    | LocalizationAdjustment
    | CameraCalibration
    | ObjectAnnotation
    | LinkAnnotation
    | GroupAnnotation
    | PlainAnnotation
)

__all__ = [
    "Activation",
    "Annotation",
    "AttributePath",
    "Box2DAnnotation",
    "BoxPath",
    "CameraCalibration",
    "CuboidAnnotation",
    "CuboidPath",
    "EventAnnotation",
    "GroupAnnotation",
    "LabeledPoints",
    "LabeledPointsAnnotation",
    "LinkAnnotation",
    "LocalizationAdjustment",
    "ObjectAnnotation",
    "PlainAnnotation",
    "PointPath",
    "PointProjection",
    "PointsAnnotation",
    "Projection",
    "ShapeAnnotation",
    "ShapeType",
    "VertexPath",
]
