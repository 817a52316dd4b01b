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
            "camera": "MODELS Camera Chart Model",
            "fitting": "Fit fit nearest",
            "projection": "PointsInImage check_camera domain_angle intrinsics_vector project project_unbounded "
            "projection_kernel unproject",
            "undistortion": "Undistortion undistort undistorted_camera",
        },
    )

__all__ = [
    "MODELS", "Camera", "Chart", "Fit", "Model", "PointsInImage", "Undistortion", "check_camera", "domain_angle", "fit",
    "intrinsics_vector", "nearest", "project", "project_unbounded", "projection_kernel", "undistort",
    "undistorted_camera", "unproject",
]  # fmt: skip
