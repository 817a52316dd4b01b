"""What the recording format offers to the table of formats."""

from pathlib import Path
from typing import Any

from sceneloom.errors import check_option_names
from sceneloom.formats.loss import LossReport
from sceneloom.formats.recording.examination import RecordingExamination, examine_recording
from sceneloom.formats.recording.holdings import HOLDS
from sceneloom.formats.recording.place import DATA_FILE, is_log, near_miss
from sceneloom.formats.recording.scene_from_recording import open_recording
from sceneloom.formats.recording.writer import check_outside_recordings, write_recording
from sceneloom.formats.recording.zipped import holds_recording
from sceneloom.scene.scene import Scene

_READING_OPTIONS = ("lenient", "altitude", "camera_shift", "image_index")
_WRITING_OPTIONS = ("pictures",)


class RecordingFormat:
    """Recordings as one of the formats; a path without a suffix names one."""

    name = "recording"
    suffixes: tuple[str, ...] = ("",)
    looks_like = "a folder with a data.jsonl, a zip file of one, or a file of such lines"
    holds = HOLDS

    def recognises(self, path: Path) -> bool:
        """Say whether the path is a folder with a `data.jsonl`, a file of such lines, or a zip archive of a folder."""
        if path.is_dir():
            return (path / DATA_FILE).is_file()
        return path.is_file() and (path.name == DATA_FILE or is_log(path) or holds_recording(path, DATA_FILE))

    def near_miss(self, path: Path) -> str | None:
        """Say what keeps a path that is no recording from being one, where that can be guessed."""
        return near_miss(path)

    def open(self, path: Path, **options: Any) -> Scene:
        """Open a recording; `open_recording` describes the options.

        Raises:
            UnknownOptionError: an option is unknown.
            DataError: files are missing or wrong.
            CalibrationError: a lens or a mounting is unusable.
        """
        check_option_names("opening a recording", options, _READING_OPTIONS)
        return open_recording(path, **options)

    def examine(self, path: Path, **options: Any) -> RecordingExamination:
        """Give all faults of a recording; `examine_recording` describes the options.

        Raises:
            UnknownOptionError: an option is unknown.
        """
        check_option_names("examining a recording", options, _READING_OPTIONS[1:])
        return examine_recording(path, **options)

    def check_place(self, path: Path) -> None:
        """Refuse places inside a recording.

        Raises:
            OutputError: the path is one.
        """
        check_outside_recordings(path)

    def write(self, scene: Scene, path: Path, *, overwrite: bool = False, **options: Any) -> LossReport:
        """Write a scene as a recording; `write_recording` describes the options.

        Raises:
            UnknownOptionError: an option is unknown.
            OutputError: the folder exists, or cannot be written.
        """
        check_option_names("writing a recording", options, _WRITING_OPTIONS)
        return write_recording(scene, path, overwrite=overwrite, **options)


FORMAT = RecordingFormat()
