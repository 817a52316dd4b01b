"""Rules about what the reader of a recording had to leave out: one for each kind of fault that it distinguishes."""

from collections.abc import Iterator

from sceneloom.checks.reading import faults_of
from sceneloom.checks.recordings.lines_at_fault import lines_at_fault
from sceneloom.checks.rule import Find, Hit, Rule
from sceneloom.checks.subject import Subject
from sceneloom.scene.findings import Severity


def _without_calibration(subject: Subject) -> Iterator[Hit]:
    """Cameras that no calibration reports; not those whose entry is there and at fault itself."""
    spoilt = [fault.path for fault in subject.faults if fault.code in _SPOILING]
    for fault in subject.faults:
        if fault.code != "cameras-without-calibration":
            continue
        if not any(fault.path.startswith(path) or path.startswith(fault.path) for path in spoilt):
            yield Hit(fault.where, fault.problem, fault.count)


UNREADABLE = "recording-readable"
"""The code of what keeps a recording from being read at all."""

_SPOILING = frozenset({"unusable-calibrations", "unreadable-calibration"})


def _error(code: str, summary: str, remedy: str, find: Find | None = None) -> Rule:
    return Rule(code, Severity.ERROR, summary, remedy, find=find or faults_of(code))


FAULT_RULES: tuple[Rule, ...] = (
    _error(
        UNREADABLE,
        "A recording has a `data.jsonl` with lines of JSON in UTF-8, and can be opened.",
        "Do what the message says; a log without any line has to be recorded or exported again.",
    ),
    _error(
        "broken-lines",
        "Every line of a recording is a JSON object, whole and with finite numbers.",
        "Write the line again, or leave it out; `--lenient` and `--fix` leave it out.",
        lines_at_fault("broken-lines"),
    ),
    _error(
        "unfit-lines",
        "Every line of a recording has the fields that a line of its kind needs, of the kind that they need.",
        "Correct the line where it is made, or leave it out; `--lenient` and `--fix` leave it out.",
        lines_at_fault("unfit-lines"),
    ),
    _error(
        "unusable-orientations",
        "Every pose of a recording whose trajectory has orientations has one, of length 1 within 0.01.",
        "Normalise the quaternion, see whether its order is w, x, y, z by name, or leave the pose out.",
    ),
    _error(
        "unreadable-calibration",
        "`calibration.json` is a JSON object with a list of cameras.",
        "Export it again; until then it is not known where sensors are mounted.",
    ),
    _error(
        "unusable-calibrations",
        "Every entry of `calibration.json` has a camera model and a rigid mounting with numbers of the right kind.",
        "Correct the entry; a matrix is 4x4 by rows, takes points of the IMU into the sensor, and does not mirror.",
    ),
    _error(
        "repeated-lidars",
        "No two lidars of `calibration.json` have one `lidarInd`.",
        "Number them as the `lidar` lines do.",
    ),
    _error(
        "unusable-frame-parameters",
        "Camera models and mountings that `frames` lines bring along can be used.",
        "Correct `cameraParameters` or `imuToCamera`, or leave them out: those of the calibration hold then.",
    ),
    _error(
        "unusable-cameras",
        "Every camera of a recording has a camera model and images that can be used.",
        "Correct what the message names; the camera is left out until then.",
    ),
    _error(
        "contradicting-mounts",
        "An entry of `calibration.json` with `imuToCamera` and `imuToCameraMatrix` has the same numbers in both.",
        "Leave out the wrong one; other programs read `imuToCamera`, and so does `--lenient`.",
    ),
    _error(
        "mounts-missing",
        "Every camera has an `imuToCamera`, in its entry of `calibration.json` or in its lines.",
        "Write it; until then nothing can be brought into the images. `--lenient` keeps the camera without it.",
    ),
    _error(
        "cameras-without-calibration",
        "Every camera that `frames` lines name is in `calibration.json`, or has its camera model in its lines.",
        "Write its entry (model, focal lengths, principal point, imuToCamera); the camera is left out until then.",
        _without_calibration,
    ),
    _error(
        "missing-videos",
        "Every camera that `frames` lines name has a video, or a folder of images.",
        "Put the video where the message expects it, or take the camera out of the lines.",
    ),
    _error(
        "unreadable-videos",
        "Videos and folders of images can be opened.",
        "Record or export the video again; one that was cut off can be repaired by remuxing it.",
    ),
    _error(
        "repeated-videos",
        "Every camera has one video or one folder of images.",
        "Keep the one that the lines belong to.",
    ),
    _error(
        "unmatched-images",
        "A video has as many images as its `frames` lines state.",
        "Find out which images were lost; `--image-index` says which one a line means, the message "
        "which way it took.",
    ),
    _error(
        "unusable-lidar-files",
        "Every `lidar` line has its file, inside the folder, of whole records of 23 bytes.",
        "Copy the file again, or leave the line out.",
    ),
    _error(
        "unreadable-vio-config",
        "`vio_config.yaml` can be read as text.",
        "Export it again, or leave it out.",
    ),
)
"""Each for one code of the reader's faults, which is its id, too."""

FAULT_CODES = frozenset(rule.id for rule in FAULT_RULES)
RULES = FAULT_RULES
