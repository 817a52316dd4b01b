"""Camera models: which pixel a point falls on, and which ray a pixel looks along; one projection model per file."""

from typing import TYPE_CHECKING

from sceneloom.lazy import names_on_first_use

if TYPE_CHECKING:
    from sceneloom.cameras.camera import MODELS, Camera, Chart, Model
    from sceneloom.cameras.fitting import Fit, fit, nearest
    from sceneloom.cameras.projection import (
        PointsInImage,
        check_camera,
        domain_angle,
        intrinsics_vector,
        project,
        project_unbounded,
        projection_kernel,
        unproject,
    )
    from sceneloom.cameras.undistortion import Undistortion, undistort, undistorted_camera
else:
    __getattr__, __dir__ = names_on_first_use(
        __name__,
        {
            "MODELS": "sceneloom.cameras.camera:MODELS",
            "Camera": "sceneloom.cameras.camera:Camera",
            "Chart": "sceneloom.cameras.camera:Chart",
            "Fit": "sceneloom.cameras.fitting:Fit",
            "Model": "sceneloom.cameras.camera:Model",
            "PointsInImage": "sceneloom.cameras.projection:PointsInImage",
            "Undistortion": "sceneloom.cameras.undistortion:Undistortion",
            "check_camera": "sceneloom.cameras.projection:check_camera",
            "domain_angle": "sceneloom.cameras.projection:domain_angle",
            "fit": "sceneloom.cameras.fitting:fit",
            "intrinsics_vector": "sceneloom.cameras.projection:intrinsics_vector",
            "nearest": "sceneloom.cameras.fitting:nearest",
            "project": "sceneloom.cameras.projection:project",
            "project_unbounded": "sceneloom.cameras.projection:project_unbounded",
            "projection_kernel": "sceneloom.cameras.projection:projection_kernel",
            "undistort": "sceneloom.cameras.undistortion:undistort",
            "undistorted_camera": "sceneloom.cameras.undistortion:undistorted_camera",
            "unproject": "sceneloom.cameras.projection:unproject",
        },
    )

__all__ = [
    "MODELS",
    "Camera",
    "Chart",
    "Fit",
    "Model",
    "PointsInImage",
    "Undistortion",
    "check_camera",
    "domain_angle",
    "fit",
    "intrinsics_vector",
    "nearest",
    "project",
    "project_unbounded",
    "projection_kernel",
    "undistort",
    "undistorted_camera",
    "unproject",
]
