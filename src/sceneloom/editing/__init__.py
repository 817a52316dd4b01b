"""Scenes out of scenes: cut, joined, thinned, moved, corrected."""

from typing import TYPE_CHECKING

from sceneloom.lazy import names_on_first_use

if TYPE_CHECKING:
    from sceneloom.editing.apply import apply_corrections
    from sceneloom.editing.cameras import convert_camera_models, undistort_scene
    from sceneloom.editing.crop import crop_scene
    from sceneloom.editing.merge import merge_scenes
    from sceneloom.editing.move_world import annotations_to_world, to_ego, to_sensor, to_world
    from sceneloom.editing.simplify import simplify_scene
    from sceneloom.editing.thin import thin_scene
else:
    __getattr__, __dir__ = names_on_first_use(
        __name__,
        {
            "annotations_to_world": "sceneloom.editing.move_world:annotations_to_world",
            "apply_corrections": "sceneloom.editing.apply:apply_corrections",
            "convert_camera_models": "sceneloom.editing.cameras:convert_camera_models",
            "crop_scene": "sceneloom.editing.crop:crop_scene",
            "merge_scenes": "sceneloom.editing.merge:merge_scenes",
            "simplify_scene": "sceneloom.editing.simplify:simplify_scene",
            "thin_scene": "sceneloom.editing.thin:thin_scene",
            "to_ego": "sceneloom.editing.move_world:to_ego",
            "to_sensor": "sceneloom.editing.move_world:to_sensor",
            "to_world": "sceneloom.editing.move_world:to_world",
            "undistort_scene": "sceneloom.editing.cameras:undistort_scene",
        },
    )

__all__ = [
    "annotations_to_world",
    "apply_corrections",
    "convert_camera_models",
    "crop_scene",
    "merge_scenes",
    "simplify_scene",
    "thin_scene",
    "to_ego",
    "to_sensor",
    "to_world",
    "undistort_scene",
]
