"""The recording format of Spectacular AI: a folder of JSON lines, videos, a calibration and lidar binaries."""

from importlib import import_module
from pathlib import Path
from typing import Any, cast

from sceneloom.errors import OptionError
from sceneloom.formats.loss import LossReport
from sceneloom.formats.recording.scene_from_recording import DATA_FILE, open_recording
from sceneloom.scene import Scene

__all__ = ["FORMAT", "RecordingFormat"]

_OPTIONS = ("lenient", "altitude")


class RecordingFormat:
    """Recordings as one of the formats; a path without a suffix names one."""

    name = "recording"
    suffixes: tuple[str, ...] = ("",)

    def recognises(self, path: Path) -> bool:
        """Say whether the path is a folder with a `data.jsonl`, or that file."""
        return (path / DATA_FILE).is_file() or (path.name == DATA_FILE and path.is_file())

    def open(self, path: Path, **options: Any) -> Scene:
        """Open a recording; `open_recording` describes the options.

        Raises:
            OptionError: an option is unknown.
            DataError: files are missing or wrong.
            CalibrationError: a lens or a mounting is unusable.
        """
        unknown = [name for name in options if name not in _OPTIONS]
        if unknown:
            raise OptionError(f"option {unknown[0]!r}; opening a recording takes {', '.join(_OPTIONS)}")
        return open_recording(path, **options)

    def write(self, scene: Scene, path: Path, *, overwrite: bool = False, **options: Any) -> LossReport:
        """Write a scene as a recording; `write_recording` describes the options.

        Raises:
            OutputError: the folder exists, or cannot be written.
        """
        writer = import_module("sceneloom.formats.recording.writer")
        return cast("LossReport", writer.write_recording(scene, path, overwrite=overwrite, **options))


FORMAT = RecordingFormat()
