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
            "annotations": "annotate",
            "camera": "CameraSpec ExposureSpec ImageTruth camera_mount",
            "detections": "ClassSpec Detector2dSpec Detector3dSpec ScoreSpec SimulatedDetections detect_2d detect_3d",
            "drive": "Faults GnssSpec ImuSpec ImuTruth PointTimes SensorFaults SimulatedDrive demo_drive inject "
            "simulate_street",
            "lidar_radar": "LidarSpec RadarSpec Raster Rosette SolidStateSpec Sweep",
            "street": "BoxTruth Mover StreetObject TrafficSpec",
            "trajectory": "PathSpec Stop sensor_mount",
        },
    )

__all__ = [
    "BoxTruth", "CameraSpec", "ClassSpec", "Detector2dSpec", "Detector3dSpec", "ExposureSpec", "Faults", "GnssSpec",
    "ImageTruth", "ImuSpec", "ImuTruth", "LidarSpec", "Mover", "PathSpec", "PointTimes", "RadarSpec", "Raster",
    "Rosette", "ScoreSpec", "SensorFaults", "SimulatedDetections", "SimulatedDrive", "SolidStateSpec", "Stop",
    "StreetObject", "Sweep", "TrafficSpec", "annotate", "camera_mount", "demo_drive", "detect_2d", "detect_3d",
    "inject", "sensor_mount", "simulate_street",
]  # fmt: skip
