"""The analytic scene factory: made-up drives with exact answers, the test bench of everything else."""

from sceneloom.simulate.camera import CameraSpec, PictureTruth, camera_mount
from sceneloom.simulate.drive import SimulatedDrive, demo_drive, plant, simulate_street
from sceneloom.simulate.exposure import ExposureSpec
from sceneloom.simulate.faults import Faults, PointTimes, SensorFaults
from sceneloom.simulate.inertial import ImuSpec
from sceneloom.simulate.lidar import LidarSpec
from sceneloom.simulate.mounts import sensor_mount
from sceneloom.simulate.path import PathSpec
from sceneloom.simulate.radar import RadarSpec, RadarTruth
from sceneloom.simulate.satellite import GnssSpec
from sceneloom.simulate.solid_state import Raster, Rosette, SolidStateSpec
from sceneloom.simulate.traffic import TrafficSpec
from sceneloom.simulate.truth import CleanPoints, Truth
from sceneloom.simulate.warp import Stop

__all__ = [
    "CameraSpec",
    "CleanPoints",
    "ExposureSpec",
    "Faults",
    "GnssSpec",
    "ImuSpec",
    "LidarSpec",
    "PathSpec",
    "PictureTruth",
    "PointTimes",
    "RadarSpec",
    "RadarTruth",
    "Raster",
    "Rosette",
    "SensorFaults",
    "SimulatedDrive",
    "SolidStateSpec",
    "Stop",
    "TrafficSpec",
    "Truth",
    "camera_mount",
    "demo_drive",
    "plant",
    "sensor_mount",
    "simulate_street",
]
