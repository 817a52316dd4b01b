"""What a fused scene says of how it came about."""

from collections.abc import Mapping
from pathlib import Path
from typing import Any

import numpy as np

from sceneloom.arrays import Float64Array
from sceneloom.errors import DataError
from sceneloom.pipeline.aligned.scene import Aligned
from sceneloom.scene.scene import Scene


def provenance(aligned: Aligned) -> Mapping[str, Any]:
    """How the fused scene came about, for its metadata; what an earlier fusion stated there is kept below `earlier`.

    The cameras stand in the order that `camera_index` counts, since a profile may have no field for some of them.
    """
    world_from_file = _earlier_world(aligned.scene)
    world_from_file[:3, 3] += world_from_file[:3, :3] @ aligned.origin_world
    fusion = {
        "trajectory": None if aligned.ego is None else aligned.ego.name,
        "heading": None if aligned.ego is None else aligned.ego.heading,
        # the name of a folder may hold bytes that are no Unicode
        "source": Path(aligned.scene.source).name.encode(errors="replace").decode(),
        "source_format": aligned.scene.format,
        "cameras": [camera.id for camera in aligned.scene.cameras],
        "earlier": _ours(aligned.scene).get("fusion"),
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
        location = "metadata.sceneloom.world_from_file"
        raise DataError(scene.source, location, f"{earlier!r}; expected a 4x4 matrix of finite numbers")
    return matrix
