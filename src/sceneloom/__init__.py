"""Align every sensor of a drive into one scene.

```python
import sceneloom

with sceneloom.open("drive/") as scene:
    report = sceneloom.fuse(scene, "drive.sfs")
```

Every name but the errors is imported when it is first used, so that a program that offers sceneloom starts quickly.
"""

from typing import TYPE_CHECKING

from sceneloom.errors import SceneloomError
from sceneloom.lazy import names_on_first_use
from sceneloom.version import __version__

if TYPE_CHECKING:
    from sceneloom.cameras.projection import project
    from sceneloom.checks.validation import validate
    from sceneloom.colouring.cuboid_projection import count_points, project_cuboids
    from sceneloom.editing.apply import apply_corrections
    from sceneloom.editing.crop import crop_scene
    from sceneloom.editing.diff import diff_scenes as diff
    from sceneloom.editing.merge import merge_scenes
    from sceneloom.editing.move_world import to_ego, to_sensor, to_world
    from sceneloom.editing.thin import thin_scene
    from sceneloom.evaluate.detection import compare_detections
    from sceneloom.evaluate.tracking import compare_tracks
    from sceneloom.evaluate.trajectory import evaluate_trajectory
    from sceneloom.formats.base.registry import open_scene as open
    from sceneloom.formats.base.registry import write_scene as write
    from sceneloom.formats.sfs.salvage import salvage
    from sceneloom.formats.sfs.writer import SceneWriter
    from sceneloom.formats.trajectories.table import read_trajectory, write_trajectory
    from sceneloom.motion.ego_trajectory import find_ego_motion
    from sceneloom.pipeline.colouring import colour
    from sceneloom.pipeline.converting import convert
    from sceneloom.pipeline.depth_images import write_depth_images
    from sceneloom.pipeline.deskewing import deskew
    from sceneloom.pipeline.fusing import fuse, iter_fused
    from sceneloom.pipeline.fusing_detections import fuse_detections
    from sceneloom.pipeline.syncing import sync
    from sceneloom.pipeline.tracking import track_objects
    from sceneloom.scene.annotations import CuboidAnnotation
    from sceneloom.scene.poses import Poses
    from sceneloom.scene.scene import Scene
    from sceneloom.service.client import FusionClient
    from sceneloom.simulate.drive import simulate_street
else:
    __getattr__, __dir__ = names_on_first_use(
        __name__,
        {
            "cameras.projection": "project",
            "checks.validation": "validate",
            "colouring.cuboid_projection": "count_points project_cuboids",
            "editing.apply": "apply_corrections",
            "editing.crop": "crop_scene",
            "editing.diff": "diff=diff_scenes",
            "editing.merge": "merge_scenes",
            "editing.move_world": "to_ego to_sensor to_world",
            "editing.thin": "thin_scene",
            "evaluate.detection": "compare_detections",
            "evaluate.tracking": "compare_tracks",
            "evaluate.trajectory": "evaluate_trajectory",
            "formats.base.registry": "open=open_scene write=write_scene",
            "formats.sfs.salvage": "salvage",
            "formats.sfs.writer": "SceneWriter",
            "formats.trajectories.table": "read_trajectory write_trajectory",
            "motion.ego_trajectory": "find_ego_motion",
            "pipeline.colouring": "colour",
            "pipeline.converting": "convert",
            "pipeline.depth_images": "write_depth_images",
            "pipeline.deskewing": "deskew",
            "pipeline.fusing": "fuse iter_fused",
            "pipeline.fusing_detections": "fuse_detections",
            "pipeline.syncing": "sync",
            "pipeline.tracking": "track_objects",
            "scene.annotations": "CuboidAnnotation",
            "scene.poses": "Poses",
            "scene.scene": "Scene",
            "service.client": "FusionClient",
            "simulate.drive": "simulate_street",
        },
    )

__all__ = [
    "CuboidAnnotation", "FusionClient", "Poses", "Scene", "SceneWriter", "SceneloomError", "__version__",
    "apply_corrections", "colour", "compare_detections", "compare_tracks", "convert", "count_points", "crop_scene",
    "deskew", "diff", "evaluate_trajectory", "find_ego_motion", "fuse", "fuse_detections", "iter_fused", "merge_scenes",
    "open", "project", "project_cuboids", "read_trajectory", "salvage", "simulate_street", "sync", "thin_scene",
    "to_ego", "to_sensor", "to_world", "track_objects", "validate", "write", "write_depth_images", "write_trajectory",
]  # fmt: skip
