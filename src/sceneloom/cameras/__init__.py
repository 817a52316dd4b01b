"""Lenses: which pixel a point falls on, and which ray a pixel looks along; one projection model per file."""

from sceneloom.cameras.camera import Camera
from sceneloom.cameras.models import (
    check_camera,
    domain_angle,
    lens_vector,
    project,
    project_unbounded,
    projection_kernel,
    unproject,
)
from sceneloom.cameras.table import MODELS, Chart, Model

__all__ = [
    "MODELS",
    "Camera",
    "Chart",
    "Model",
    "check_camera",
    "domain_angle",
    "lens_vector",
    "project",
    "project_unbounded",
    "projection_kernel",
    "unproject",
]
