"""Folders as Scale's lidar toolkit recommends them: clouds, pictures and poses that share the names of frames."""

from sceneloom.formats.scale_toolkit.form import FORMAT

__all__ = ["FORMAT"]
