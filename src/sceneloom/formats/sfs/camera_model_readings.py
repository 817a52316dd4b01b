"""What the numbers of a camera model mean where the format leaves it open: as the caller says.

Or as the file records it.
"""

from collections.abc import Mapping
from dataclasses import replace
from typing import Any

from sceneloom.cameras.camera import Camera
from sceneloom.formats.sfs.source import Source
from sceneloom.formats.sfs.spec import BROWN, OPENCV, TANGENTIALS
from sceneloom.scene.assumed_camera_models import with_assumed_models
from sceneloom.scene.scene import Scene
from sceneloom.scene.warnings import WarningKind

_P1, _P2 = 2, 3


def note_tangential(source: Source, ours: Mapping[str, Any]) -> None:
    """Take what our metadata state of p1 and p2, and report a caller who says otherwise that it counts."""
    recorded = ours.get("tangential")
    source.tangential = recorded if recorded in TANGENTIALS else None
    if source.tangential is not None and source.options.tangential not in (None, source.tangential):
        message = f"p1 and p2 are recorded to be as in {source.tangential}; they are not exchanged again"
        source.warning(
            WarningKind.ASSUMED, "tangential-recorded", ("metadata", "sceneloom", "tangential"), message
        )


def in_opencvs_sense(camera: Camera, source: Source) -> Camera:
    """Exchange p1 and p2 where the file has them the other way round."""
    if camera.model != "brown_conrady" or (source.tangential or source.options.tangential) != BROWN:
        return camera
    padded = (*camera.coefficients, 0.0, 0.0, 0.0, 0.0)[: max(len(camera.coefficients), _P2 + 1)]
    return replace(camera, coefficients=(*padded[:_P1], padded[_P2], padded[_P1], *padded[_P2 + 1 :]))


def camera_model_records(source: Source) -> dict[str, str]:
    """What our metadata are to state of p1 and p2 from now on."""
    stated = source.tangential or source.options.tangential
    if stated is None:
        return {}
    return {"tangential": OPENCV, **({"tangential_before": BROWN} if stated == BROWN else {})}


def with_camera_model_readings(scene: Scene, source: Source) -> Scene:
    """The scene that may be computed with as the caller stated."""
    return with_assumed_models(scene) if source.options.assume_model else scene
