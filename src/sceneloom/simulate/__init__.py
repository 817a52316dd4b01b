"""The analytic scene factory: synthetic drives with exact answers, the test bench of everything else."""

from typing import TYPE_CHECKING

from sceneloom.lazy import names_on_first_use

if TYPE_CHECKING:
    from sceneloom.simulate.annotations import annotate
    from sceneloom.simulate.camera import CameraSpec, ExposureSpec, ImageTruth, camera_mount
    from sceneloom.simulate.detections import (
        ClassSpec,
        Detector2dSpec,
        Detector3dSpec,
        ScoreSpec,
        SimulatedDetections,
        detect_2d,
        detect_3d,
    )
    from sceneloom.simulate.drive import (
        Faults,
        GnssSpec,
        ImuSpec,
        ImuTruth,
        PointTimes,
        SensorFaults,
        SimulatedDrive,
        demo_drive,
        inject,
        simulate_street,
    )
    from sceneloom.simulate.lidar_radar import LidarSpec, RadarSpec, Raster, Rosette, SolidStateSpec, Sweep
    from sceneloom.simulate.street import BoxTruth, Mover, StreetObject, TrafficSpec
    from sceneloom.simulate.trajectory import PathSpec, Stop, sensor_mount
else:
    __getattr__, __dir__ = names_on_first_use(
        __name__,
        {
            "BoxTruth": "sceneloom.simulate.street:BoxTruth",
            "CameraSpec": "sceneloom.simulate.camera:CameraSpec",
            "ClassSpec": "sceneloom.simulate.detections:ClassSpec",
            "Detector2dSpec": "sceneloom.simulate.detections:Detector2dSpec",
            "Detector3dSpec": "sceneloom.simulate.detections:Detector3dSpec",
            "ExposureSpec": "sceneloom.simulate.camera:ExposureSpec",
            "Faults": "sceneloom.simulate.drive:Faults",
            "GnssSpec": "sceneloom.simulate.drive:GnssSpec",
            "ImuSpec": "sceneloom.simulate.drive:ImuSpec",
            "ImuTruth": "sceneloom.simulate.drive:ImuTruth",
            "LidarSpec": "sceneloom.simulate.lidar_radar:LidarSpec",
            "Mover": "sceneloom.simulate.street:Mover",
            "PathSpec": "sceneloom.simulate.trajectory:PathSpec",
            "ImageTruth": "sceneloom.simulate.camera:ImageTruth",
            "PointTimes": "sceneloom.simulate.drive:PointTimes",
            "RadarSpec": "sceneloom.simulate.lidar_radar:RadarSpec",
            "Raster": "sceneloom.simulate.lidar_radar:Raster",
            "Rosette": "sceneloom.simulate.lidar_radar:Rosette",
            "ScoreSpec": "sceneloom.simulate.detections:ScoreSpec",
            "SensorFaults": "sceneloom.simulate.drive:SensorFaults",
            "SimulatedDetections": "sceneloom.simulate.detections:SimulatedDetections",
            "SimulatedDrive": "sceneloom.simulate.drive:SimulatedDrive",
            "SolidStateSpec": "sceneloom.simulate.lidar_radar:SolidStateSpec",
            "Stop": "sceneloom.simulate.trajectory:Stop",
            "StreetObject": "sceneloom.simulate.street:StreetObject",
            "Sweep": "sceneloom.simulate.lidar_radar:Sweep",
            "TrafficSpec": "sceneloom.simulate.street:TrafficSpec",
            "annotate": "sceneloom.simulate.annotations:annotate",
            "camera_mount": "sceneloom.simulate.camera:camera_mount",
            "demo_drive": "sceneloom.simulate.drive:demo_drive",
            "detect_2d": "sceneloom.simulate.detections:detect_2d",
            "detect_3d": "sceneloom.simulate.detections:detect_3d",
            "inject": "sceneloom.simulate.drive:inject",
            "sensor_mount": "sceneloom.simulate.trajectory:sensor_mount",
            "simulate_street": "sceneloom.simulate.drive:simulate_street",
        },
    )

__all__ = [
    "BoxTruth",
    "CameraSpec",
    "ClassSpec",
    "Detector2dSpec",
    "Detector3dSpec",
    "ExposureSpec",
    "Faults",
    "GnssSpec",
    "ImageTruth",
    "ImuSpec",
    "ImuTruth",
    "LidarSpec",
    "Mover",
    "PathSpec",
    "PointTimes",
    "RadarSpec",
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
    "annotate",
    "camera_mount",
    "demo_drive",
    "detect_2d",
    "detect_3d",
    "inject",
    "sensor_mount",
    "simulate_street",
]
