"""A checkerboard that camera and lidar see: a calibration where no guess of it exists."""

from sceneloom.calibrate.target.board import Board
from sceneloom.calibrate.target.board_pose import board_in_cloud, board_pose
from sceneloom.calibrate.target.corners import find_corners
from sceneloom.calibrate.target.target_start import BoardView, start_from_target
from sceneloom.calibrate.target.views import board_views

__all__ = [
    "Board",
    "BoardView",
    "board_in_cloud",
    "board_pose",
    "board_views",
    "find_corners",
    "start_from_target",
]
