"""Pictures of what is said about a drive, at its middle."""

from sceneloom.errors import OptionError
from sceneloom.pictures.annotations.above import draw_annotations_above
from sceneloom.pictures.annotations.in_picture import draw_annotations_in_picture
from sceneloom.report.album import Album
from sceneloom.scene.scene import Scene

ANNOTATIONS = "annotations"
"""The section that the pictures stand in."""
MOST_CAMERAS = 4
"""Cameras whose pictures are shown with annotations."""


def draw_labels(scene: Scene, album: Album) -> None:
    """Draw the annotations at the middle of a drive from above and in pictures; nothing without frames.

    Raises:
        DataError: a sweep or picture cannot be read.
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
    text = (
        "The sweep in the middle of the drive as a map, with everything of the annotations that has a place"
    )
    album.add(ANNOTATIONS, "Annotations from above", text, draw_annotations_above(scene, sample))
    shown = [camera_id for camera_id, picture in sample.pictures.items() if picture is not None]
    for camera_id in shown[:MOST_CAMERAS]:
        text = f"The picture of camera {camera_id} at the middle of the drive, with the outlines of the annotations"
        image = draw_annotations_in_picture(scene, sample, camera_id)
        album.add(ANNOTATIONS, f"Annotations in {camera_id}", text, image)
