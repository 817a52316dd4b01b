"""Rules about what a recording ought to have."""

from collections.abc import Iterator

from sceneloom.checks.reading import as_read, warnings_of_code
from sceneloom.checks.recordings.streams import Kind, streams_of, streams_of_kind
from sceneloom.checks.rule import Hit, Rule
from sceneloom.checks.subject import Subject
from sceneloom.formats.recording.calibration import CALIBRATION_FILE
from sceneloom.scene.findings import Severity

_IMU = (Kind.ACCELEROMETER, Kind.GYROSCOPE)


def _without_imu(subject: Subject) -> Iterator[Hit]:
    if subject.recording is None or subject.recording.alone or not streams_of(subject):
        return
    there = {stream.kind for stream in streams_of_kind(subject, *_IMU)}
    lacking = [kind.value for kind in _IMU if kind not in there]
    if lacking:
        yield Hit(subject.recording.data_name, f"no {' and no '.join(lacking)} lines")


def _without_calibration(subject: Subject) -> Iterator[Hit]:
    """A recording without the file; where that leaves cameras out, these are reported instead."""
    if subject.recording is None or subject.recording.alone or subject.recording.calibration.path.exists():
        return
    if not any(fault.code == "cameras-without-calibration" for fault in subject.faults):
        yield Hit(CALIBRATION_FILE, "there is none")


RULES: tuple[Rule, ...] = (
    Rule(
        "imu-there",
        Severity.WARNING,
        "A recording has an accelerometer and a gyroscope.",
        "Record them; software for visual-inertial odometry, the vendor's too, gives nothing without.",
        find=_without_imu,
    ),
    Rule(
        "calibration-there",
        Severity.WARNING,
        "A recording has a `calibration.json`.",
        "Write one, though its list of cameras be empty: the format asks for it.",
        find=_without_calibration,
    ),
    Rule(
        "json-plain",
        Severity.WARNING,
        "Files of JSON begin without a byte order mark, and `data.jsonl` ends without blank lines.",
        "Write them without: other programs stop at them; `--fix` does.",
        find=warnings_of_code("byte-order-mark", "blank-lines-at-end"),
        fix=as_read,
    ),
    Rule(
        "poses-without-orientation",
        Severity.WARNING,
        "Either all poses of a trajectory have an orientation, or none.",
        "See why some lack it; they are left out of the trajectory, and their lines are kept.",
        find=warnings_of_code("poses-without-orientation"),
    ),
)
