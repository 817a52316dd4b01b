"""Pictures of what is said about a scene: in the photographs, from above, and over time."""

from sceneloom.pictures.annotations.above import draw_annotations_above
from sceneloom.pictures.annotations.corrections import draw_adjustment, draw_calibration
from sceneloom.pictures.annotations.figures import Figure, figures_in_picture, figures_in_world
from sceneloom.pictures.annotations.in_picture import draw_annotations_in_picture
from sceneloom.pictures.annotations.saving import save_annotation_pictures
from sceneloom.pictures.annotations.timeline import draw_timeline

__all__ = [
    "Figure",
    "draw_adjustment",
    "draw_annotations_above",
    "draw_annotations_in_picture",
    "draw_calibration",
    "draw_timeline",
    "figures_in_picture",
    "figures_in_world",
    "save_annotation_pictures",
]
