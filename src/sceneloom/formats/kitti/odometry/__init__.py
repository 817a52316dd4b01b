"""KITTI's odometry benchmark: sequences with poses, and SemanticKITTI's labels of points."""

from sceneloom.formats.kitti.odometry.form import FORMAT

__all__ = ["FORMAT"]
