"""Lidar odometry: the ego's motion from its lidar sweeps alone, against a map of the surfaces around it."""

from sceneloom.motion.odometry.configuration import OdometryConfiguration
from sceneloom.motion.odometry.lidar_odometry import LidarOdometry, Outcome, PoseEstimate
from sceneloom.motion.odometry.run import OdometryRun, lidar_odometry

__all__ = [
    "LidarOdometry",
    "OdometryConfiguration",
    "OdometryRun",
    "Outcome",
    "PoseEstimate",
    "lidar_odometry",
]
