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
            "apply": "apply_corrections",
            "cameras": "convert_camera_models undistort_scene",
            "crop": "crop_scene",
            "merge": "merge_scenes",
            "move_world": "annotations_to_world to_ego to_sensor to_world",
            "simplify": "simplify_scene",
            "thin": "thin_scene",
        },
    )

__all__ = [
    "annotations_to_world", "apply_corrections", "convert_camera_models", "crop_scene", "merge_scenes",
    "simplify_scene", "thin_scene", "to_ego", "to_sensor", "to_world", "undistort_scene",
]  # fmt: skip
