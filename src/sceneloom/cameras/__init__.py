"""Lenses: which pixel a point falls on, and which ray a pixel looks along; one projection model per file."""

from sceneloom.cameras.camera import Camera
from sceneloom.cameras.fitting import Fit, fit, measured_fit, nearest
from sceneloom.cameras.models import (
    check_camera,
    domain_angle,
    lens_vector,
    project,
    project_unbounded,
    projection_kernel,
    unproject,
)
from sceneloom.cameras.points_in_picture import PointsInPicture
from sceneloom.cameras.table import MODELS, Chart, Model
from sceneloom.cameras.undistortion import Undistortion, undistort, undistorted_camera

__all__ = [
    "MODELS",
    "Camera",
    "Chart",
    "Fit",
    "Model",
    "PointsInPicture",
    "Undistortion",
    "check_camera",
    "domain_angle",
    "fit",
    "lens_vector",
    "measured_fit",
    "nearest",
    "project",
    "project_unbounded",
    "projection_kernel",
    "undistort",
    "undistorted_camera",
    "unproject",
]
