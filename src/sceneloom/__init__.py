"""Weave every sensor of a drive into one scene.

```python
import sceneloom

with sceneloom.open("drive/") as scene:
    report = sceneloom.fuse(scene, "drive.sfs")
```

Every name but the errors is imported when it is first used, so that a program that offers sceneloom starts quickly.
"""

from importlib import import_module
from typing import TYPE_CHECKING, Any

from sceneloom.errors import SceneloomError
from sceneloom.version import __version__

if TYPE_CHECKING:
    from sceneloom.checks import validate
    from sceneloom.editing import (
        apply_corrections,
        crop_scene,
        merge_scenes,
        thin_scene,
        to_ego,
        to_sensor,
        to_world,
    )
    from sceneloom.evaluate import evaluate_trajectory
    from sceneloom.evaluate.detection import compare_detections
    from sceneloom.evaluate.tracking import compare_tracks
    from sceneloom.formats.sfs import SceneWriter, salvage
    from sceneloom.formats.table import open_scene as open
    from sceneloom.formats.table import write_scene as write
    from sceneloom.formats.trajectories import read_trajectory, write_trajectory
    from sceneloom.motion.ego_motion import find_ego_motion
    from sceneloom.pipeline import colour, convert, deskew, fuse, iter_fused, sync
    from sceneloom.pipeline.depth_images import write_depth_images
    from sceneloom.pipeline.found_objects import fuse_detections, track_objects
    from sceneloom.scene import PosePath, Scene
    from sceneloom.service.client import FusionClient
    from sceneloom.simulate import simulate_street
    from sceneloom.visibility import count_points, project_cuboids

__all__ = [
    "FusionClient",
    "PosePath",
    "Scene",
    "SceneWriter",
    "SceneloomError",
    "__version__",
    "apply_corrections",
    "colour",
    "compare_detections",
    "compare_tracks",
    "convert",
    "count_points",
    "crop_scene",
    "deskew",
    "diff",
    "evaluate_trajectory",
    "find_ego_motion",
    "fuse",
    "fuse_detections",
    "iter_fused",
    "merge_scenes",
    "open",
    "project_cuboids",
    "read_trajectory",
    "salvage",
    "simulate_street",
    "sync",
    "thin_scene",
    "to_ego",
    "to_sensor",
    "to_world",
    "track_objects",
    "validate",
    "write",
    "write_depth_images",
    "write_trajectory",
]

_ON_FIRST_USE = {
    "FusionClient": ("sceneloom.service.client", "FusionClient"),
    "PosePath": ("sceneloom.scene", "PosePath"),
    "Scene": ("sceneloom.scene", "Scene"),
    "SceneWriter": ("sceneloom.formats.sfs", "SceneWriter"),
    "apply_corrections": ("sceneloom.editing", "apply_corrections"),
    "colour": ("sceneloom.pipeline", "colour"),
    "compare_detections": ("sceneloom.evaluate.detection", "compare_detections"),
    "compare_tracks": ("sceneloom.evaluate.tracking", "compare_tracks"),
    "convert": ("sceneloom.pipeline", "convert"),
    "count_points": ("sceneloom.visibility", "count_points"),
    "crop_scene": ("sceneloom.editing", "crop_scene"),
    "deskew": ("sceneloom.pipeline", "deskew"),
    "diff": ("sceneloom.editing.differences", "diff_scenes"),
    "evaluate_trajectory": ("sceneloom.evaluate", "evaluate_trajectory"),
    "find_ego_motion": ("sceneloom.motion.ego_motion", "find_ego_motion"),
    "fuse": ("sceneloom.pipeline", "fuse"),
    "fuse_detections": ("sceneloom.pipeline", "fuse_detections"),
    "iter_fused": ("sceneloom.pipeline", "iter_fused"),
    "merge_scenes": ("sceneloom.editing", "merge_scenes"),
    "open": ("sceneloom.formats.table", "open_scene"),
    "project_cuboids": ("sceneloom.visibility", "project_cuboids"),
    "read_trajectory": ("sceneloom.formats.trajectories", "read_trajectory"),
    "salvage": ("sceneloom.formats.sfs", "salvage"),
    "simulate_street": ("sceneloom.simulate", "simulate_street"),
    "sync": ("sceneloom.pipeline", "sync"),
    "thin_scene": ("sceneloom.editing", "thin_scene"),
    "to_ego": ("sceneloom.editing", "to_ego"),
    "to_sensor": ("sceneloom.editing", "to_sensor"),
    "to_world": ("sceneloom.editing", "to_world"),
    "track_objects": ("sceneloom.pipeline", "track_objects"),
    "validate": ("sceneloom.checks", "validate"),
    "write": ("sceneloom.formats.table", "write_scene"),
    "write_depth_images": ("sceneloom.pipeline", "write_depth_images"),
    "write_trajectory": ("sceneloom.formats.trajectories", "write_trajectory"),
}
"""Module and name there of everything that is imported when it is first asked for."""


def __getattr__(name: str) -> Any:
    if name not in _ON_FIRST_USE:
        raise AttributeError(f"module 'sceneloom' has no attribute {name!r}")
    module, attribute = _ON_FIRST_USE[name]
    value = getattr(import_module(module), attribute)
    globals()[name] = value
    return value


def __dir__() -> list[str]:
    return __all__
