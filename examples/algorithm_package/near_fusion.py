"""Two algorithms that a package brings by entry points: near points alone, and objects that both sensors saw."""

from collections.abc import Sequence
from dataclasses import fields, replace

import numpy as np

from sceneloom.arrays import Float64Array
from sceneloom.colouring.algorithms import ColouredPoints, ViewRequest, fuse_by_projection
from sceneloom.colouring.results import LidarTrajectory
from sceneloom.colouring.visibility import VisibilitySettings
from sceneloom.detections import DetectionPair, FusedBoxes
from sceneloom.detections import projection as boxes_by_projection

FARTHEST = 20.0
"""Points farther than this from every camera get no colour and no depth [m]."""


def fuse_near(
    points_world: Float64Array,
    requests: Sequence[ViewRequest],
    visibility: VisibilitySettings,
    /,
    *,
    trajectory: LidarTrajectory | None = None,
) -> ColouredPoints:
    """Fuse what is near a camera; a point that is not finite is in no image.

    Called with the points of one sweep, (N, 3) [m], and the images that belong to it, for `fusion_type` 0.
    """
    near = np.zeros(len(points_world), np.bool_)
    for request in requests:
        near |= np.linalg.norm(points_world - request.world_from_camera.translation, axis=1) <= FARTHEST
    return fuse_by_projection(
        np.where(near[:, None], points_world, np.nan), requests, visibility, trajectory=trajectory
    )


def fuse_agreed(pair: DetectionPair, /) -> FusedBoxes:
    """Keep what the detector of sweeps and that of images both saw.

    Called with the boxes of one sweep and one image, for `fusion_type` 1.
    """
    fused = boxes_by_projection.fuse_by_projection(pair)
    both = np.flatnonzero((fused.rows_3d >= 0) & (fused.rows_2d >= 0))
    kept = {
        field.name: getattr(fused, field.name)[both]
        for field in fields(fused)
        if isinstance(getattr(fused, field.name), np.ndarray)
    }
    return replace(fused, labels=tuple(fused.labels[k] for k in both), **kept)
