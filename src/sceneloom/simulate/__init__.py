"""The analytic scene factory: made-up drives with exact answers, the test bench of everything else."""

from sceneloom.simulate.camera import CameraSpec, PictureTruth, camera_mount
from sceneloom.simulate.drive import SimulatedDrive, demo_drive, simulate_street
from sceneloom.simulate.inertial import ImuSpec
from sceneloom.simulate.lidar import LidarSpec
from sceneloom.simulate.satellite import GnssSpec
from sceneloom.simulate.truth import CleanPoints, Truth

__all__ = [
    "CameraSpec",
    "CleanPoints",
    "GnssSpec",
    "ImuSpec",
    "LidarSpec",
    "PictureTruth",
    "SimulatedDrive",
    "Truth",
    "camera_mount",
    "demo_drive",
    "simulate_street",
]
