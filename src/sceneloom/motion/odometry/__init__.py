"""Lidar odometry: the ego's motion from its lidar sweeps alone, against a map of the surfaces around it."""

from sceneloom.motion.odometry.configuration import OdometryConfiguration
from sceneloom.motion.odometry.lidar_odometry import LidarOdometry, Outcome, PoseEstimate
from sceneloom.motion.odometry.run import OdometryRun, joined_odometry, lidar_odometry, odometry_piece
from sceneloom.motion.odometry.stitching import OdometryPiece

__all__ = [
    "LidarOdometry",
    "OdometryConfiguration",
    "OdometryPiece",
    "OdometryRun",
    "Outcome",
    "PoseEstimate",
    "joined_odometry",
    "lidar_odometry",
    "odometry_piece",
]
