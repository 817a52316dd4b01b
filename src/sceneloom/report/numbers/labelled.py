"""Images of what is stated about a drive, at its middle."""

from sceneloom.errors import OptionError
from sceneloom.images.annotations.above import draw_annotations_above
from sceneloom.images.annotations.in_image import draw_annotations_in_image
from sceneloom.report.figures import Figures
from sceneloom.scene.scene import Scene

ANNOTATIONS = "annotations"
"""The section that the images stand in."""
MOST_CAMERAS = 4
"""Cameras whose images are shown with annotations."""


def draw_labels(scene: Scene, figures: Figures) -> None:
    """Draw the annotations at the middle of a drive from above and in images; nothing without frames.

    Raises:
        DataError: a sweep or image cannot be read.
    """
    if not scene.annotations:
        return
    try:
        samples = scene.samples(
            reference="lidar" if any(len(x.frames) for x in scene.lidars[:1]) else "camera"
        )
        sample = samples[len(samples) // 2] if len(samples) else None
    except OptionError:
        return
    if sample is None:
        return
    text = "The sweep in the middle of the drive as a map, with everything of the annotations that has a location"
    figures.add(ANNOTATIONS, "Annotations from above", text, draw_annotations_above(scene, sample))
    shown = [camera_id for camera_id, image in sample.images.items() if image is not None]
    for camera_id in shown[:MOST_CAMERAS]:
        text = f"The image of camera {camera_id} at the middle of the drive, with the outlines of the annotations"
        image = draw_annotations_in_image(scene, sample, camera_id)
        figures.add(ANNOTATIONS, f"Annotations in {camera_id}", text, image)
