"""KITTI's text formats: tracking and object benchmark, and lists of detections beside them."""

from sceneloom.formats.kitti.labels import KittiLabels, read_labels, write_labels, write_object_labels
from sceneloom.formats.kitti.sequence_scene import sequence_scene
from sceneloom.formats.kitti.tracking_folder import KittiSequence, KittiTracking, open_tracking_folder

__all__ = [
    "KittiLabels",
    "KittiSequence",
    "KittiTracking",
    "open_tracking_folder",
    "read_labels",
    "sequence_scene",
    "write_labels",
    "write_object_labels",
]
