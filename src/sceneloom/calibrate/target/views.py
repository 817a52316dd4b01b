"""The views of a checkerboard that a drive holds: images, each with the sweep nearest in time."""

from collections.abc import Iterator

import numpy as np

from sceneloom.arrays import Float64Array
from sceneloom.calibrate.frames import chosen_camera, chosen_lidar
from sceneloom.calibrate.target.board import Board
from sceneloom.calibrate.target.board_pose import board_in_cloud, board_pose
from sceneloom.calibrate.target.corners import find_corners
from sceneloom.calibrate.target.target_start import BoardView
from sceneloom.scene.scene import Scene
from sceneloom.scene.types import Identifier, PointsFrame, Progress

_LUMA = np.array([0.299, 0.587, 0.114], np.float32)
_FARTHEST_NS = 100_000_000
"""A sweep farther from an image does not show the board where the image does."""
_WORST_PX = 1.5
"""Corners that are farther off from a flat board under the camera model are not this board's [px]."""


def board_views(
    scene: Scene,
    board: Board,
    camera_id: Identifier | None = None,
    lidar_id: Identifier | None = None,
    *,
    most: int,
    progress: Progress | None = None,
) -> Iterator[BoardView]:
    """Look for the board in images spread over a drive; board and vehicle are taken to stand at these times.

    Args:
        camera_id, lidar_id: None for the scene's first ones.
        most: so many images at most.
        progress: reported after each image.

    Raises:
        OptionError: there is no such camera or lidar.
        DataError: an image or a sweep cannot be read.
    """
    camera, lidar = chosen_camera(scene, camera_id), chosen_lidar(scene, lidar_id)
    count = len(camera.images)
    chosen = np.unique(np.linspace(0, count - 1, min(most, count)).round().astype(int)).tolist()
    for done, k in enumerate(chosen, start=1):
        image = camera.images[k]
        near = int(np.argmin(np.abs(lidar.frames.timestamps_ns - image.timestamp_ns)))
        sweep = lidar.frames[near]
        if progress is not None:
            progress(done, len(chosen))
        if abs(sweep.reference_ns - image.timestamp_ns) > _FARTHEST_NS:
            continue
        corners = find_corners(image.rgb @ _LUMA, board)
        pose = None if corners is None else board_pose(image.camera, corners, board)
        if pose is None or pose[1] > _WORST_PX:
            continue
        points: Float64Array = sweep.points.positions.astype(np.float64)
        if lidar.points_frame is PointsFrame.EGO and lidar.mount is not None:
            points = lidar.mount.inverse().apply(points)
        found = board_in_cloud(points, board)
        if found is not None:
            yield BoardView(pose[0], found)
