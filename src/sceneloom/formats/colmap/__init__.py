"""COLMAP: cameras, posed images and points, as programs of photogrammetry and Gaussian splatting take them."""

from sceneloom.formats.colmap.form import FORMAT

__all__ = ["FORMAT"]
