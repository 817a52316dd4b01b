"""`camera_from_lidar` from a checkerboard that both see: the start where no guess exists.

Of each view the camera reports the board's pose and the lidar its plane and extent. Normals give the rotation, planes
and middles the translation; then all points are fitted at once: those of the cloud onto the board's plane, and the
board's extent, as far as the scan lines report it, onto its border.

Source: planes: Zhang and Pless 2004, "Extrinsic calibration of a camera and laser range finder", and Unnikrishnan and
Hebert 2005; planes and borders: Zhou, Li and Kaess 2018, "Automatic extrinsic calibration of a camera and a 3D lidar
using line and plane correspondences".
"""

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from scipy.optimize import least_squares

from sceneloom.arrays import Float64Array
from sceneloom.calibrate.mounting_estimate import MountingEstimate, moved_by, unobserved_directions
from sceneloom.calibrate.target.board import Board
from sceneloom.calibrate.target.board_pose import BoardInCloud
from sceneloom.errors import PoseError
from sceneloom.geometry.rigid import RigidTransform

LEAST_VIEWS = 3
_LEAST_ROTATION = np.radians(10.0)
_PLANE_SIGMA = 0.01
_MIDDLE_SIGMA = 0.02
"""How far a board's extent is off that scan lines report [m]: about a third of the trajectory between two lines."""


@dataclass(frozen=True, slots=True, eq=False)
class BoardView:
    """A board seen by both.

    Attributes:
        camera_from_board: by the corners; z away from the camera.
        cloud: by the lidar.
    """

    camera_from_board: RigidTransform
    cloud: BoardInCloud


def start_from_target(views: Sequence[BoardView], board: Board) -> MountingEstimate:
    """Find `camera_from_lidar` from several views of a board.

    Raises:
        PoseError: too few views, or all with the board rotated alike.
    """
    if len(views) < LEAST_VIEWS:
        raise PoseError(
            f"{len(views)} views of the board; expected {LEAST_VIEWS} or more, rotated differently"
        )
    normals = np.array([_towards_camera(view.camera_from_board) for view in views])
    seen = np.array([view.cloud.normal for view in views])
    spread = np.linalg.svd(normals)[1]
    if spread[1] < np.sin(_LEAST_ROTATION) * np.sqrt(len(views)) * 0.5:
        raise PoseError(
            "the board is rotated alike in all views; expected rotates by 10 deg or more about two axes"
        )
    start = _closed(views, normals, seen)

    def errors(step: Float64Array) -> Float64Array:
        camera_from_lidar = moved_by(start, step)
        return np.concatenate([_errors(view, camera_from_lidar, board) for view in views])

    found = least_squares(errors, np.zeros(6), loss="soft_l1", x_scale=[0.01] * 3 + [0.02] * 3)
    jacobian = np.asarray(found.jac, np.float64)
    variance = max(float(2.0 * found.cost / max(len(found.fun) - 6, 1)), 1.0)
    covariance = np.asarray(np.linalg.pinv(jacobian.T @ jacobian) * variance, np.float64)
    return MountingEstimate(moved_by(start, found.x), covariance, unobserved_directions(covariance, "camera"))


def _towards_camera(camera_from_board: RigidTransform) -> Float64Array:
    normal = camera_from_board.rotation[:, 2]
    return np.asarray(normal * -np.sign(normal @ camera_from_board.translation), np.float64)


def _closed(views: Sequence[BoardView], normals: Float64Array, seen: Float64Array) -> RigidTransform:
    """The rotation that takes the lidar's normals, and ways between middles, to the camera's; then the translation."""
    camera_middles = np.array([view.camera_from_board.translation for view in views])
    lidar_middles = np.array([view.cloud.center for view in views])
    a = np.concatenate([normals, camera_middles - camera_middles.mean(axis=0)])
    b = np.concatenate([seen, lidar_middles - lidar_middles.mean(axis=0)])
    u, _, vt = np.linalg.svd(a.T @ b)
    rotation = (u * [1.0, 1.0, np.linalg.det(u @ vt)]) @ vt
    return RigidTransform(rotation, (camera_middles - lidar_middles @ rotation.T).mean(axis=0))


def _errors(view: BoardView, camera_from_lidar: RigidTransform, board: Board) -> Float64Array:
    """Distances from the board's plane, and how far the extent is from the border on both sides, by their sigmas.

    Points of a plane that follow one another report the same: of many each counts less.
    """
    on_board = view.camera_from_board.inverse().apply(camera_from_lidar.apply(view.cloud.points))
    share = np.sqrt(min(1.0, 100.0 / len(on_board)))
    planes = on_board[:, 2] / max(view.cloud.noise, _PLANE_SIGMA) * share
    half = 0.5 * np.array([board.width, board.height])
    beyond = np.abs(on_board[:, :2]) - half
    outside = np.maximum(beyond, 0.0) / _MIDDLE_SIGMA * share
    low, high = (np.quantile(on_board[:, :2], q, axis=0) for q in (0.02, 0.98))
    middles = 0.5 * (low + high) / _MIDDLE_SIGMA
    return np.concatenate([planes, outside.ravel(), middles])
