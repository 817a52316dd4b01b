"""The ego's motion from satellite fixes and an IMU, smoothed over the whole drive."""

from sceneloom.motion.gnss_imu.preintegration import Preintegrated, preintegrated
from sceneloom.motion.gnss_imu.run import GnssImuRun, gnss_imu_motion
from sceneloom.motion.gnss_imu.settings import SmootherSettings

__all__ = ["GnssImuRun", "Preintegrated", "SmootherSettings", "gnss_imu_motion", "preintegrated"]
