"""Scenes out of scenes: cut, joined, thinned, moved, corrected."""

from sceneloom.editing.apply import apply_corrections
from sceneloom.editing.crop import crop_scene
from sceneloom.editing.frames import annotations_to_world, to_ego, to_sensor, to_world
from sceneloom.editing.lenses import convert_lenses
from sceneloom.editing.merge import merge_scenes
from sceneloom.editing.simplify import simplify_scene
from sceneloom.editing.thin import thin_scene
from sceneloom.editing.undistortion import undistort_scene

__all__ = [
    "annotations_to_world",
    "apply_corrections",
    "convert_lenses",
    "crop_scene",
    "merge_scenes",
    "simplify_scene",
    "thin_scene",
    "to_ego",
    "to_sensor",
    "to_world",
    "undistort_scene",
]
