"""Camera models: which pixel a point falls on, and which ray a pixel looks along; one projection model per file."""

from typing import TYPE_CHECKING

from sceneloom.lazy import names_on_first_use

if TYPE_CHECKING:
    from sceneloom.cameras.camera import Camera
    from sceneloom.cameras.fitting import Fit, fit, measured_fit, nearest
    from sceneloom.cameras.models import (
        check_camera,
        domain_angle,
        intrinsics_vector,
        project,
        project_unbounded,
        projection_kernel,
        unproject,
    )
    from sceneloom.cameras.points_in_image import PointsInImage
    from sceneloom.cameras.table import MODELS, Chart, Model
    from sceneloom.cameras.undistortion import Undistortion, undistort, undistorted_camera
else:
    __getattr__, __dir__ = names_on_first_use(
        __name__,
        {
            "MODELS": "sceneloom.cameras.table:MODELS",
            "Camera": "sceneloom.cameras.camera:Camera",
            "Chart": "sceneloom.cameras.table:Chart",
            "Fit": "sceneloom.cameras.fitting:Fit",
            "Model": "sceneloom.cameras.table:Model",
            "PointsInImage": "sceneloom.cameras.points_in_image:PointsInImage",
            "Undistortion": "sceneloom.cameras.undistortion:Undistortion",
            "check_camera": "sceneloom.cameras.models:check_camera",
            "domain_angle": "sceneloom.cameras.models:domain_angle",
            "fit": "sceneloom.cameras.fitting:fit",
            "intrinsics_vector": "sceneloom.cameras.models:intrinsics_vector",
            "measured_fit": "sceneloom.cameras.fitting:measured_fit",
            "nearest": "sceneloom.cameras.fitting:nearest",
            "project": "sceneloom.cameras.models:project",
            "project_unbounded": "sceneloom.cameras.models:project_unbounded",
            "projection_kernel": "sceneloom.cameras.models:projection_kernel",
            "undistort": "sceneloom.cameras.undistortion:undistort",
            "undistorted_camera": "sceneloom.cameras.undistortion:undistorted_camera",
            "unproject": "sceneloom.cameras.models:unproject",
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
    "measured_fit",
    "nearest",
    "project",
    "project_unbounded",
    "projection_kernel",
    "undistort",
    "undistorted_camera",
    "unproject",
]
