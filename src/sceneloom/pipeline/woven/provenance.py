"""What a fused scene says of how it came about."""

from collections.abc import Mapping
from pathlib import Path
from typing import Any

import numpy as np

from sceneloom.arrays import Float64Array
from sceneloom.errors import DataError
from sceneloom.pipeline.woven.scene import Woven
from sceneloom.scene.scene import Scene


def provenance(woven: Woven) -> Mapping[str, Any]:
    """How the fused scene came about, for its metadata; what an earlier fusion said there is kept below `earlier`.

    The cameras stand in the order that `camera_index` counts, since a profile may have no place for some of them.
    """
    world_from_file = _earlier_world(woven.scene)
    world_from_file[:3, 3] += world_from_file[:3, :3] @ woven.origin_world
    fusion = {
        "trajectory": None if woven.ego is None else woven.ego.name,
        "heading": None if woven.ego is None else woven.ego.heading,
        # the name of a folder may hold bytes that are no Unicode
        "source": Path(woven.scene.source).name.encode(errors="replace").decode(),
        "source_format": woven.scene.format,
        "cameras": [camera.id for camera in woven.scene.cameras],
        "earlier": _ours(woven.scene).get("fusion"),
    }
    return {"sceneloom": {"world_from_file": world_from_file.tolist(), "fusion": fusion}}


def _ours(scene: Scene) -> Mapping[str, Any]:
    ours = scene.metadata.get("sceneloom")
    return ours if isinstance(ours, Mapping) else {}


def _earlier_world(scene: Scene) -> Float64Array:
    """The (4, 4) transform that an earlier fusion took off, else the identity."""
    earlier = _ours(scene).get("world_from_file")
    try:
        matrix = np.eye(4) if earlier is None else np.array(earlier, np.float64)
    except (TypeError, ValueError):
        matrix = np.zeros(0)
    if matrix.shape != (4, 4) or not np.isfinite(matrix).all():
        place = "metadata.sceneloom.world_from_file"
        raise DataError(scene.source, place, f"{earlier!r}; expected a 4x4 matrix of finite numbers")
    return matrix
