"""What a scene keeps of KITTI's folder that it was read from."""

from collections.abc import Mapping
from typing import Any

from sceneloom.scene.scene import Scene


def kept_of(scene: Scene) -> Mapping[str, Any]:
    """What a scene that was read from KITTI's folders keeps of them; empty of others."""
    kept: Any = scene.metadata.get("kitti")
    return kept if isinstance(kept, Mapping) else {}


def kept_calibration(scene: Scene) -> Mapping[str, Any] | None:
    """The entries of the only calibration of a scene that was read from a sequence, or None."""
    kept = kept_of(scene)
    entries = kept.get("calibration")
    is_one = kept.get("benchmark") in ("tracking", "odometry") and isinstance(entries, Mapping)
    return entries if is_one else None
