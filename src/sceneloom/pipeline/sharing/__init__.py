"""Drives made ready for others' eyes: places in pictures hidden, positions and times made relative."""

from sceneloom.pipeline.sharing.blurring import BlurReport, CameraBlur, blur_files

__all__ = ["BlurReport", "CameraBlur", "blur_files"]
