"""KITTI's tracking benchmark: sequences with labelled tracks."""

from sceneloom.formats.kitti.tracking.form import FORMAT

__all__ = ["FORMAT"]
