"""Where KITTI's folders may be written, and what a scene keeps of the one that it was read from."""

from collections.abc import Callable, Mapping
from pathlib import Path
from typing import Any

from sceneloom.errors import OutputError
from sceneloom.scene import Scene


def check_replaceable(path: Path, recognises: Callable[[Path], bool], what: str) -> None:
    """Refuse a folder that holds anything but what would be written, which overwriting would take away.

    Raises:
        OutputError: it is a file, or a folder with other things in it.
    """
    if path.is_file():
        raise OutputError(f"{path}: is a file; expected a folder or a new name")
    if path.is_dir() and any(path.iterdir()) and not recognises(path):
        raise OutputError(
            f"{path}: holds something that is no {what}, and is left alone; choose another name"
        )


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
