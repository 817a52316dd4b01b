"""KITTI's raw data: drives with pictures, sweeps, OXTS lines and tracklets."""

from sceneloom.formats.kitti.raw.form import FORMAT

__all__ = ["FORMAT"]
