"""The analytic scene factory: made-up drives with exact answers, the test bench of everything else."""

from sceneloom.simulate.annotated import annotate
from sceneloom.simulate.boxes import BoxTruth
from sceneloom.simulate.camera import CameraSpec, PictureTruth, camera_mount
from sceneloom.simulate.detections import SimulatedDetections
from sceneloom.simulate.detections_2d import detect_2d
from sceneloom.simulate.detections_3d import detect_3d
from sceneloom.simulate.detectors import ClassSpec, Detector2dSpec, Detector3dSpec, MissSpec
from sceneloom.simulate.drive import SimulatedDrive, demo_drive, plant, simulate_street
from sceneloom.simulate.exposure import ExposureSpec
from sceneloom.simulate.faults import Faults, PointTimes, SensorFaults
from sceneloom.simulate.inertial import ImuSpec, ImuTruth
from sceneloom.simulate.lidar import LidarSpec, Sweep
from sceneloom.simulate.mounts import sensor_mount
from sceneloom.simulate.movers import Mover
from sceneloom.simulate.path import PathSpec
from sceneloom.simulate.radar import RadarSpec, RadarTruth
from sceneloom.simulate.satellite import GnssSpec
from sceneloom.simulate.scores import ScoreSpec
from sceneloom.simulate.solid_state import Raster, Rosette, SolidStateSpec
from sceneloom.simulate.street import StreetObject
from sceneloom.simulate.traffic import TrafficSpec
from sceneloom.simulate.truth import CleanPoints, OcclusionTruth, Truth
from sceneloom.simulate.warp import Stop

__all__ = [
    "BoxTruth",
    "CameraSpec",
    "ClassSpec",
    "CleanPoints",
    "Detector2dSpec",
    "Detector3dSpec",
    "ExposureSpec",
    "Faults",
    "GnssSpec",
    "ImuSpec",
    "ImuTruth",
    "LidarSpec",
    "MissSpec",
    "Mover",
    "OcclusionTruth",
    "PathSpec",
    "PictureTruth",
    "PointTimes",
    "RadarSpec",
    "RadarTruth",
    "Raster",
    "Rosette",
    "ScoreSpec",
    "SensorFaults",
    "SimulatedDetections",
    "SimulatedDrive",
    "SolidStateSpec",
    "Stop",
    "StreetObject",
    "Sweep",
    "TrafficSpec",
    "Truth",
    "annotate",
    "camera_mount",
    "demo_drive",
    "detect_2d",
    "detect_3d",
    "plant",
    "sensor_mount",
    "simulate_street",
]
