"""An annotation of any kind."""

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
