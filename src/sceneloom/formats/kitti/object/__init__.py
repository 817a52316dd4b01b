"""KITTI's object benchmark: frames, each with a calibration of its own."""

from sceneloom.formats.kitti.object.form import FORMAT

__all__ = ["FORMAT"]
