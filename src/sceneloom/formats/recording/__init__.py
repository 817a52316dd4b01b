"""The recording format of Spectacular AI: a folder of JSON lines, videos, a calibration and lidar binaries.

What decodes videos is imported when the format is first asked for.
"""

from importlib import import_module
from typing import TYPE_CHECKING, Any

if TYPE_CHECKING:
    from sceneloom.formats.recording.form import FORMAT, RecordingFormat

__all__ = ["FORMAT", "RecordingFormat"]


def __getattr__(name: str) -> Any:
    if name not in __all__:
        raise AttributeError(f"module 'sceneloom.formats.recording' has no attribute {name!r}")
    return getattr(import_module("sceneloom.formats.recording.form"), name)
