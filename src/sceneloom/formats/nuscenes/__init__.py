"""The nuScenes schema: a folder of tables in JSON, and the files of sensors that they name."""

from sceneloom.formats.nuscenes.form import FORMAT

__all__ = ["FORMAT"]
