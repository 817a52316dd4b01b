"""Scenes out of scenes: cut, joined, thinned, moved, corrected."""

from sceneloom.editing.thin import thin_scene

__all__ = ["thin_scene"]
