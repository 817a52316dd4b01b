"""The analytic scene factory: made-up drives with exact answers, the test bench of everything else."""

from sceneloom.simulate.camera import CameraSpec, PictureTruth, camera_mount
from sceneloom.simulate.drive import SimulatedDrive, demo_drive, plant, simulate_street
from sceneloom.simulate.faults import Faults, PointTimes, SensorFaults
from sceneloom.simulate.inertial import ImuSpec
from sceneloom.simulate.lidar import LidarSpec
from sceneloom.simulate.path import PathSpec
from sceneloom.simulate.satellite import GnssSpec
from sceneloom.simulate.traffic import TrafficSpec
from sceneloom.simulate.truth import CleanPoints, Truth
from sceneloom.simulate.warp import Stop

__all__ = [
    "CameraSpec",
    "CleanPoints",
    "Faults",
    "GnssSpec",
    "ImuSpec",
    "LidarSpec",
    "PathSpec",
    "PictureTruth",
    "PointTimes",
    "SensorFaults",
    "SimulatedDrive",
    "Stop",
    "TrafficSpec",
    "Truth",
    "camera_mount",
    "demo_drive",
    "plant",
    "simulate_street",
]
