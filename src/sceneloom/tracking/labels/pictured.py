"""The detector's boxes in images as annotations."""

from collections.abc import Iterator

import numpy as np

from sceneloom.arrays import Float64Array, Int64Array
from sceneloom.scene.annotations.boxes_2d import Box2DAnnotation, BoxPath
from sceneloom.scene.cameras import CameraSensor
from sceneloom.scene.scene import Scene
from sceneloom.scene.span import usual_period_ns
from sceneloom.scene.tracks import Track
from sceneloom.scene.types import Identifier, Key, key_of

_DECIMALS = 2
"""Of pixels that are written."""


def boxes_in_images(
    scene: Scene, track: Track, parent_id: Identifier, stem: str, *, longest_gap_ns: int
) -> Iterator[Box2DAnnotation]:
    """Give the boxes that the detector found of an object in images, by camera, at the times of these images.

    Args:
        scene: whose cameras have the images. Of a camera without images the times are those of the track.
        track: with boxes in images.
        parent_id: of the object.
        stem: how ids begin.
        longest_gap_ns: after a longer time without a box another annotation begins [ns].
    """
    cameras: dict[Key, CameraSensor] = {key_of(camera.id): camera for camera in scene.cameras}
    for camera_id, corners in track.corners_xyxy.items():
        rows = np.flatnonzero(
            np.isfinite(corners).all(axis=1) & (corners[:, 2:] > corners[:, :2]).all(axis=1)
        )
        if len(rows) == 0 or key_of(camera_id) not in cameras:
            continue
        times, chosen = _at_images(cameras[key_of(camera_id)], track.timestamps_ns[rows])
        breaks = np.flatnonzero(np.diff(times) > longest_gap_ns) + 1
        for part, own in enumerate(np.split(np.arange(len(times)), breaks)):
            tail = f"-{part + 1}" if len(breaks) else ""
            yield Box2DAnnotation(
                f"{stem}-{camera_id}{tail}",
                camera_id,
                BoxPath(times[own], _left_top_width_height(corners[rows[chosen[own]]])),
                label=track.label,
                parent_id=parent_id,
            )


def _left_top_width_height(corners_xyxy: Float64Array) -> Float64Array:
    rounded = np.round(corners_xyxy, _DECIMALS)
    return np.column_stack([rounded[:, :2], rounded[:, 2:] - rounded[:, :2]])


def _at_images(camera: CameraSensor, times_ns: Int64Array) -> tuple[Int64Array, Int64Array]:
    """The times of the images nearest to some times, each once, and which of these they are nearest to."""
    timestamps = camera.images.timestamps_ns
    if len(timestamps) == 0:
        return times_ns, np.arange(len(times_ns))
    after = np.clip(np.searchsorted(timestamps, times_ns), 1, max(len(timestamps) - 1, 1))
    after = np.minimum(after, len(timestamps) - 1)
    before = np.maximum(after - 1, 0)
    nearest = np.where(times_ns - timestamps[before] <= timestamps[after] - times_ns, before, after)
    away = np.abs(timestamps[nearest] - times_ns)
    near = np.flatnonzero(away <= max(usual_period_ns(timestamps), 1))
    found, first = np.unique(timestamps[nearest[near]], return_index=True)
    return found, near[first]
