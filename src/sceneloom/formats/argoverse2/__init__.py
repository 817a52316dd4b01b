"""Logs of the Argoverse 2 sensor and lidar data sets: feather tables and JPEG pictures."""

from sceneloom.formats.argoverse2.form import FORMAT

__all__ = ["FORMAT"]
