"""All faults of a recording at once, with the scene of all that is sound, and what its files state."""

from dataclasses import dataclass
from pathlib import Path

from sceneloom.errors import SceneloomError
from sceneloom.formats.faults import FaultLedger, PlacedFault, placed
from sceneloom.formats.recording.further_contents import RecordingContents
from sceneloom.formats.recording.scene_from_recording import check_values, find_location, read_recording
from sceneloom.scene.scene import Scene


@dataclass(frozen=True, slots=True, eq=False)
class RecordingExamination:
    """A recording with all that is wrong in it.

    Attributes:
        scene: what is sound, and what could be brought into order; None where nothing can be read.
        faults: in the order in which they came up.
        contents: what the files state, lines in the order of the file; None where nothing can be read.
    """

    scene: Scene | None
    faults: tuple[PlacedFault, ...]
    contents: RecordingContents | None = None


def examine_recording(
    path: Path, *, altitude: str = "wgs84", camera_shift: str = "ignore", image_index: str = "auto"
) -> RecordingExamination:
    """Read a recording as far as it is sound, and give every fault of it with its location; nothing is raised for them.

    Args:
        path: the folder, the `data.jsonl` in it, or a zip archive.
        altitude: what the altitudes of `gps` lines are above: "wgs84" or "msl".
        camera_shift: what becomes of `imuToCameraShiftSeconds`, as for `open_recording`.
        image_index: which image a `frames` line means, as for `open_recording`.

    Raises:
        OptionError: a value is unknown.
    """
    check_values(altitude, camera_shift, image_index)
    try:
        location = find_location(path)
    except SceneloomError as error:
        return RecordingExamination(None, (placed(error, "unreadable", str(path)),))
    ledger = FaultLedger(location.folder)
    try:
        scene, contents = read_recording(
            location, altitude, ledger, camera_shift=camera_shift, image_index=image_index
        )
    except SceneloomError as error:
        return RecordingExamination(None, (*ledger.faults, placed(error, "unreadable", str(location.folder))))
    return RecordingExamination(scene, ledger.faults, contents)
