"""All images of a scene's annotations, as files in a folder."""

from collections.abc import Iterator
from dataclasses import replace
from functools import partial
from pathlib import Path

import numpy as np

from sceneloom.errors import OptionError
from sceneloom.formats.file_names import file_stem
from sceneloom.formats.output import filling
from sceneloom.images.annotations.above import draw_annotations_above
from sceneloom.images.annotations.by_type import Drawing, plots_by_type
from sceneloom.images.annotations.in_image import draw_annotations_in_image
from sceneloom.images.annotations.timeline import draw_timeline
from sceneloom.images.sheets import save_image
from sceneloom.scene.sample import Sample
from sceneloom.scene.scene import Corrections, Scene
from sceneloom.scene.span import frame_times, time_span


def save_annotation_images(
    scene: Scene, folder: Path, *, at: float | None = None, overwrite: bool = False
) -> list[Path]:
    """Draw a scene's annotations at one moment into a folder, which is made where it is missing.

    `timeline.png`, `above.png`, `camera_<id>.png` for each camera with images, and `type_<type>.png` for each type
    of annotation that the scene has.

    Args:
        scene: what the annotations are of.
        folder: where the images go.
        at: seconds after the scene's first timestamp; None for its middle.
        overwrite: replace files that are there.

    Returns:
        The paths written.

    Raises:
        OutputError: the folder has something in it and `overwrite` is not stated, or it cannot be written.
        DataError: a sweep or image cannot be read.
    """
    corrected, pending = scene.corrected(), scene.pending_corrections
    given = replace(scene, annotations=pending, corrections=Corrections.IGNORE)
    with filling(folder, overwrite=overwrite) as drafts:
        plots = list(_plots(corrected, at))
        if len(corrected.pending_corrections) < len(
            pending
        ):  # what they change is seen before they are applied
            plots += [drawing for drawing in _plots(given, at) if drawing[0].startswith("type_")]
        for name, draw in plots:
            save_image(draw(), drafts / f"{name}.png")
    return [folder / f"{name}.png" for name, _ in plots]


def _plots(scene: Scene, at: float | None) -> Iterator[Drawing]:
    yield "timeline", partial(draw_timeline, scene)
    sample = _sample(scene, at)
    if sample is not None:
        yield "above", partial(draw_annotations_above, scene, sample)
        for camera_id, image in sample.images.items():
            if image is not None:
                drawn = partial(draw_annotations_in_image, scene, sample, camera_id)
                yield f"camera_{file_stem(camera_id)}", drawn
    for type_name, draw in plots_by_type(scene, sample):
        yield f"type_{file_stem(type_name)}", draw


def _sample(scene: Scene, at: float | None) -> Sample | None:
    """The synchronised set nearest to the chosen time; None for a scene without sweeps and images."""
    references = [lidar.id for lidar in scene.lidars if len(lidar.frames)]
    references += [camera.id for camera in scene.cameras if len(camera.images)]
    span_ns = time_span(scene)
    if not references or span_ns is None:
        return None
    length = (span_ns[1] - span_ns[0]) / 1e9
    if at is not None and not 0.0 <= at <= length:
        raise OptionError(f"{at} s; expected a time within the scene, from 0 to {length:.3f} s")
    time_ns = span_ns[0] + round((length / 2 if at is None else at) * 1e9)
    samples = scene.samples(reference=references[0])
    timestamps_ns = frame_times(scene.sensor(references[0]))
    return samples[int(np.argmin(np.abs(timestamps_ns - time_ns)))]
