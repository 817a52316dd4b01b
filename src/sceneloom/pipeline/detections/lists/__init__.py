"""What detectors wrote into files, whatever the form: lists of boxes in space and in pictures, by frame."""

from sceneloom.pipeline.detections.lists.context import ListContext
from sceneloom.pipeline.detections.lists.table import FORMS, form_of, read_boxes_2d, read_boxes_3d

__all__ = ["FORMS", "ListContext", "form_of", "read_boxes_2d", "read_boxes_3d"]
