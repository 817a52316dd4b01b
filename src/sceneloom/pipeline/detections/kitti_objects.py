"""Fused objects as KITTI has results: boxes in images and in the rectified camera's frame, without tracks."""

from collections.abc import Sequence

import numpy as np

from sceneloom.formats.kitti.camera_boxes import CENTRE_TO_CORNER, observation_angles, rectified_boxes
from sceneloom.formats.kitti.labels import NO_TRACK, KittiLabels
from sceneloom.fusion.detection_fusion import FusedDetectionFrame
from sceneloom.geometry.rigid import RigidTransform


def kitti_objects(frames: Sequence[FusedDetectionFrame], rectified_from_lidar: RigidTransform) -> KittiLabels:
    """Give the rows of a sequence's objects; what the image does not show has none.

    Args:
        frames: of one lidar and one camera; the number of the sweep is that of the frame.
        rectified_from_lidar: into the frame of the boxes in space.
    """
    numbers, rows, types = [np.zeros(0, np.int64)], [np.zeros((0, 12))], list[str]()
    for frame in frames:
        fused, camera_model = frame.fused, frame.camera
        corners = np.clip(
            fused.corners_xyxy, 0.0, np.tile([float(camera_model.width), float(camera_model.height)], 2)
        )
        shown = np.flatnonzero((corners[:, 2] > corners[:, 0]) & (corners[:, 3] > corners[:, 1]))
        limits = np.tile([camera_model.width - 1.0, camera_model.height - 1.0], 2)
        pixels = np.clip(corners[shown] - CENTRE_TO_CORNER, 0.0, limits)
        placed = rectified_boxes(
            fused.centers[shown], fused.sizes_lwh[shown], fused.yaws[shown], rectified_from_lidar
        )
        rows.append(np.column_stack([pixels, *placed, fused.scores[shown]]))
        numbers.append(np.full(len(shown), frame.index))
        types += [fused.labels[k] for k in shown.tolist()]
    values, count = np.concatenate(rows), len(types)
    return KittiLabels(
        frames=np.concatenate(numbers),
        track_ids=np.full(count, NO_TRACK),
        types=tuple(types),
        truncations=np.full(count, -1.0),
        occlusions=np.full(count, -1),
        alphas=observation_angles(values[:, 7:10], values[:, 10]),
        corners_xyxy=values[:, :4].copy(),
        sizes_hwl=values[:, 4:7].copy(),
        bottoms=values[:, 7:10].copy(),
        rotations_y=values[:, 10].copy(),
        scores=values[:, 11].copy(),
    )
