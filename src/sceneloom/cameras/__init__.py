"""Lenses: which pixel a point falls on, and which ray a pixel looks along; one projection model per file."""

from sceneloom.cameras.camera import Camera
from sceneloom.cameras.models import (
    MODELS,
    Chart,
    check_camera,
    lens_vector,
    project,
    project_unbounded,
    projection_kernel,
    unproject,
)

__all__ = [
    "MODELS",
    "Camera",
    "Chart",
    "check_camera",
    "lens_vector",
    "project",
    "project_unbounded",
    "projection_kernel",
    "unproject",
]
