"""The analytic scene factory: synthetic drives with exact answers, the test bench of everything else."""

from typing import TYPE_CHECKING

from sceneloom.lazy import names_on_first_use

if TYPE_CHECKING:
    from sceneloom.simulate.annotated import annotate
    from sceneloom.simulate.boxes import BoxTruth
    from sceneloom.simulate.camera import CameraSpec, ImageTruth, camera_mount
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
else:
    __getattr__, __dir__ = names_on_first_use(
        __name__,
        {
            "BoxTruth": "sceneloom.simulate.boxes:BoxTruth",
            "CameraSpec": "sceneloom.simulate.camera:CameraSpec",
            "ClassSpec": "sceneloom.simulate.detectors:ClassSpec",
            "CleanPoints": "sceneloom.simulate.truth:CleanPoints",
            "Detector2dSpec": "sceneloom.simulate.detectors:Detector2dSpec",
            "Detector3dSpec": "sceneloom.simulate.detectors:Detector3dSpec",
            "ExposureSpec": "sceneloom.simulate.exposure:ExposureSpec",
            "Faults": "sceneloom.simulate.faults:Faults",
            "GnssSpec": "sceneloom.simulate.satellite:GnssSpec",
            "ImuSpec": "sceneloom.simulate.inertial:ImuSpec",
            "ImuTruth": "sceneloom.simulate.inertial:ImuTruth",
            "LidarSpec": "sceneloom.simulate.lidar:LidarSpec",
            "MissSpec": "sceneloom.simulate.detectors:MissSpec",
            "Mover": "sceneloom.simulate.movers:Mover",
            "OcclusionTruth": "sceneloom.simulate.truth:OcclusionTruth",
            "PathSpec": "sceneloom.simulate.path:PathSpec",
            "ImageTruth": "sceneloom.simulate.camera:ImageTruth",
            "PointTimes": "sceneloom.simulate.faults:PointTimes",
            "RadarSpec": "sceneloom.simulate.radar:RadarSpec",
            "RadarTruth": "sceneloom.simulate.radar:RadarTruth",
            "Raster": "sceneloom.simulate.solid_state:Raster",
            "Rosette": "sceneloom.simulate.solid_state:Rosette",
            "ScoreSpec": "sceneloom.simulate.scores:ScoreSpec",
            "SensorFaults": "sceneloom.simulate.faults:SensorFaults",
            "SimulatedDetections": "sceneloom.simulate.detections:SimulatedDetections",
            "SimulatedDrive": "sceneloom.simulate.drive:SimulatedDrive",
            "SolidStateSpec": "sceneloom.simulate.solid_state:SolidStateSpec",
            "Stop": "sceneloom.simulate.warp:Stop",
            "StreetObject": "sceneloom.simulate.street:StreetObject",
            "Sweep": "sceneloom.simulate.lidar:Sweep",
            "TrafficSpec": "sceneloom.simulate.traffic:TrafficSpec",
            "Truth": "sceneloom.simulate.truth:Truth",
            "annotate": "sceneloom.simulate.annotated:annotate",
            "camera_mount": "sceneloom.simulate.camera:camera_mount",
            "demo_drive": "sceneloom.simulate.drive:demo_drive",
            "detect_2d": "sceneloom.simulate.detections_2d:detect_2d",
            "detect_3d": "sceneloom.simulate.detections_3d:detect_3d",
            "plant": "sceneloom.simulate.drive:plant",
            "sensor_mount": "sceneloom.simulate.mounts:sensor_mount",
            "simulate_street": "sceneloom.simulate.drive:simulate_street",
        },
    )

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
    "ImageTruth",
    "ImuSpec",
    "ImuTruth",
    "LidarSpec",
    "MissSpec",
    "Mover",
    "OcclusionTruth",
    "PathSpec",
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
