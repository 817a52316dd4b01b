"""Tracked objects as KITTI's tracking benchmark has results: boxes in images and in the rectified camera's frame."""

import numpy as np

from sceneloom.arrays import Float64Array
from sceneloom.cameras.camera import Camera
from sceneloom.formats.kitti.camera_boxes import CENTRE_TO_CORNER, observation_angles, rectified_boxes
from sceneloom.formats.kitti.labels import KittiLabels
from sceneloom.geometry.rigid import RigidTransform
from sceneloom.pipeline.detections.detected import poses_at
from sceneloom.pipeline.tracking.tracked import TrackedDrive
from sceneloom.scene.detections import Boxes3D
from sceneloom.scene.tracks import TrackedObjects
from sceneloom.scene.types import Identifier, PointsFrame
from sceneloom.tracking.settings import ImageBox
from sceneloom.visibility.outlines import FINE, box_extents

_NEAR = 0.1
"""What has a corner less far in front of the camera than this is not reported to have an outline [m]."""


def kitti_results(
    tracked: TrackedDrive,
    camera_id: Identifier,
    rectified_from_lidar: RigidTransform,
    *,
    box2d: ImageBox = ImageBox.IMAGE,
) -> KittiLabels:
    """Give the rows of a sequence's results; what the image does not show has none.

    Args:
        tracked: the objects.
        camera_id: the camera in whose images boxes are reported.
        rectified_from_lidar: into the frame of the boxes in space.
        box2d: which boxes in the image; where the tracker reports none, the outline of the box in space.
    """
    drive = tracked.drive
    camera = drive.cameras[camera_id]
    locations = drive.locations()
    seen_from = poses_at(camera.source, drive.timestamps_ns)
    rows, frames, ids, types = [_NO_ROWS], [_NO_NUMBERS], [_NO_NUMBERS], list[str]()
    for frame, objects in enumerate(tracked.moments):
        boxes = in_lidar(objects, locations[frame])
        camera_from_lidar = seen_from[frame].inverse() @ locations[frame]
        corners = image_boxes(objects, boxes, camera_id, camera.camera_model, camera_from_lidar, box2d)
        shown = np.flatnonzero((corners[:, 2] > corners[:, 0]) & (corners[:, 3] > corners[:, 1]))
        sizes, bottoms, rotations = rectified_boxes(
            boxes.centers[shown], boxes.sizes_lwh[shown], boxes.yaws[shown], rectified_from_lidar
        )
        rows.append(np.column_stack([corners[shown], sizes, bottoms, rotations, objects.scores[shown]]))
        frames.append(np.full(len(shown), frame))
        ids.append(objects.ids[shown])
        types += [objects.labels[k] for k in shown.tolist()]
    limits = np.tile([camera.camera_model.width - 1.0, camera.camera_model.height - 1.0], 2)
    values, count = np.concatenate(rows), len(types)
    return KittiLabels(
        frames=np.concatenate(frames),
        track_ids=np.concatenate(ids),
        types=tuple(types),
        truncations=np.full(count, -1.0),
        occlusions=np.full(count, -1),
        alphas=observation_angles(values[:, 7:10], values[:, 10]),
        corners_xyxy=np.clip(values[:, :4] - CENTRE_TO_CORNER, 0.0, limits),
        sizes_hwl=values[:, 4:7].copy(),
        bottoms=values[:, 7:10].copy(),
        rotations_y=values[:, 10].copy(),
        scores=values[:, 11].copy(),
    )


_NO_ROWS, _NO_NUMBERS = np.zeros((0, 12)), np.zeros(0, np.int64)


def in_lidar(objects: TrackedObjects, world_from_lidar: RigidTransform) -> Boxes3D:
    """The boxes of objects in the lidar's frame; of headings the horizontal part there counts."""
    boxes = Boxes3D(
        objects.timestamp_ns,
        objects.centers,
        objects.sizes_lwh,
        objects.yaws,
        objects.scores,
        objects.labels,
        frame=PointsFrame.WORLD,
    )
    return boxes.moved(world_from_lidar.inverse(), PointsFrame.SENSOR)


def image_boxes(
    objects: TrackedObjects,
    boxes: Boxes3D,
    camera_id: Identifier,
    camera_model: Camera,
    camera_from_lidar: RigidTransform,
    box2d: ImageBox,
) -> Float64Array:
    """A box in the image for each object, (N, 4) float64 [px] in the corner convention; zeros where none shows."""
    corners = projected_boxes(boxes, camera_model, camera_from_lidar)
    own = objects.corners_xyxy.get(camera_id)
    if box2d is ImageBox.IMAGE and own is not None:
        reported = np.isfinite(own).all(axis=1)
        corners[reported] = own[reported]
    return np.clip(corners, 0.0, np.tile([float(camera_model.width), float(camera_model.height)], 2))


def projected_boxes(boxes: Boxes3D, camera_model: Camera, camera_from_lidar: RigidTransform) -> Float64Array:
    """Outlines of boxes in the lidar's frame, (N, 4) float64 [px], cut at the image; zeros where none shows."""
    corners_camera = camera_from_lidar.apply(boxes.corners)
    found = np.zeros((len(boxes), 4))
    # a box around the camera has no outline; one that reaches behind it has that of its part in front
    ahead = np.flatnonzero(corners_camera[:, :, 2].max(axis=1) > _NEAR)
    if not len(ahead):
        return found
    extents, _ = box_extents(camera_model, corners_camera[ahead], steps=FINE)
    shown = (
        np.isfinite(extents).all(axis=1) & (extents[:, 2] > extents[:, 0]) & (extents[:, 3] > extents[:, 1])
    )
    found[ahead[shown]] = extents[shown]
    return found
