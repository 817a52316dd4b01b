"""Rules about what cannot be read: faults and warnings of readers, required and misspelt fields.

And faulty lines of a recording.
"""

import re
from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from difflib import get_close_matches
from typing import Any, NamedTuple

from sceneloom.checks.rule import ERROR, HINT, WARNING, Find, FrameInHand, Hit, Rule, Subject
from sceneloom.formats.base.diagnostics import PlacedFault
from sceneloom.formats.sfs.container import format_keys
from sceneloom.formats.sfs.schema import RECORDS, annotation_record, sensor_record
from sceneloom.scene.scene import Scene
from sceneloom.warnings import Severity, WarningKind

_REPORTED_BY_RULES_OF_RECORDINGS = frozenset(
    (
        *("blank-lines-at-end", "byte-order-mark", "camera-model-scaled", "lines-sorted", "missing-bitmaps"),
        *("poses-without-orientation", "repeated-poses", "rotation-normalised"),
    )
)  # warnings of the recording's reader that rules over its lines report better

_REPORTED_BY_RULES = frozenset(
    (
        *("at-fault", "item-at-fault", "repaired", "no-images", "no-poses", "relative-point-times"),
        *("short-distortion", "unknown-distortion", "video-and-images"),
    )
)  # warnings of readers that other rules report better


def faults_of(code: str) -> Find:
    """Report the faults of a code that the reader found."""

    def find(subject: Subject) -> Iterator[Hit]:
        for f in subject.faults:
            if f.code == code:
                yield Hit(f.where, f"{f.problem}; left out: {f.costs}" if f.costs else f.problem, f.count)

    return find


def _warnings_of(kind: WarningKind) -> Find:
    def find(subject: Subject) -> Iterator[Hit]:
        reported = _REPORTED_BY_RULES
        if subject.recording is not None:
            reported = reported | _REPORTED_BY_RULES_OF_RECORDINGS
        for warning in subject.notes:
            if warning.kind == kind and warning.code not in reported:
                yield Hit(_within_recording(subject, warning.location), warning.message, warning.count)

    return find


def _within_recording(subject: Subject, location: str) -> str:
    """A location as faults of recordings report it: from the folder on."""
    if subject.recording is None:
        return location
    return location.removeprefix(str(subject.recording.folder)).lstrip("/")


def warnings_of_code(*codes: str) -> Find:
    """Report what the reader remarked under some codes."""

    def find(subject: Subject) -> Iterator[Hit]:
        notes = (note for note in subject.notes if note.code in codes)
        return (Hit(_within_recording(subject, r.location), r.message, r.count) for r in notes)

    return find


def as_read(scene: Scene) -> Scene:
    """What the reader brought into order needs only to be written."""
    return scene


def _unreadable(subject: Subject, frame: FrameInHand) -> Iterator[Hit]:
    del subject
    if frame.fault is not None:
        yield Hit(frame.path, frame.fault)


def _rule(identifier: str, code: str, summary: str, remedy: str, fix: Callable[[Scene], Scene] | None = None) -> Rule:
    return Rule(identifier, Severity.ERROR, summary, remedy, find=faults_of(code), fix=fix)


# fmt: off
FAULT_RULES: tuple[Rule, ...] = (
    _rule("file-readable", "unreadable", "The file or folder can be read.",
          "Export it again; of a scene file that was cut off, `sceneloom salvage` takes out what is whole."),
    _rule("version-known", "version", "The file says a version that begins with 1.0 or 5.1.",
          "Write `version` as 1.0 if the file follows the description of the format."),
    _rule("fields-valid", "malformed",
          "Every field has the kind, dtype, shape and length that the format says, and required fields are there.",
          "Correct the field where the file is made; `--fix` leaves it out, or what needs it."),
    _rule("arrays-whole", "item",
          "Every array lies inside the file, overlaps no other, and its keys lead to a location of the header.",
          "Write the file again; `--fix` leaves the array out, and what cannot be without it."),
    _rule("ids-unique", "duplicate-id", "No two sensors and no two annotations share an id.",
          "Give each its own id; `--fix` keeps the first of them."),
    _rule("quaternion-norm", "quaternion-norm", "Quaternions of poses have length 1, within 0.01.",
          "Normalise them; the direction that they report stays.", as_read),
    _rule("pose-times-increasing", "pose-times-increasing", "Poses have strictly increasing times.",
          "Sort the poses by time, and leave out those that stand there twice.", as_read),
    _rule("poses-finite", "not-finite", "Poses hold finite numbers only.",
          "Leave the pose out, or compute it again; between its neighbours it is interpolated."),
)
# fmt: on
"""Rules that hold only where a file was read, each for one code of the reader's faults."""

# fmt: off
READING_RULES: tuple[Rule, ...] = (
    *FAULT_RULES,
    Rule("frame-readable", ERROR, "Every frame can be read and every image decoded.",
         "Record or export the frame again, or leave it out.", look=_unreadable),
    Rule("reading-skipped", HINT, "Nothing had to be left out on reading.",
         "See whether what was left out is needed.", find=_warnings_of(WarningKind.SKIPPED)),
    Rule("reading-repaired", HINT, "Nothing had to be brought into order on reading.",
         "Correct it where the data are made, so that every program reads the same.",
         find=_warnings_of(WarningKind.REPAIRED)),
    Rule("reading-assumed", HINT, "Nothing had to be assumed on reading.",
         "Where it is otherwise, report it in the files, or with the option that the message names, if it names one.",
         find=_warnings_of(WarningKind.ASSUMED)),
)
# fmt: on

_ALIKE = 0.8  # how like a known name an unknown one has to be, to be taken for it
_TYPED = {"sensors": sensor_record, "annotations": annotation_record}

_EXPECTED = {
    record: tuple(name for name, field in fields.items() if field.expected) for record, fields in RECORDS.items()
}

_INNER = {
    record: tuple((name, field.record) for name, field in fields.items() if field.record)
    for record, fields in RECORDS.items()
}


class _Found(NamedTuple):
    """An object of the header: the keys that lead to it, the name of its record, and its fields."""

    keys: tuple[str | int, ...]
    record: str
    fields: Mapping[str, Any]


def _objects(subject: Subject) -> Iterator[_Found]:
    """All objects of the header whose record is known."""
    header = subject.header
    if header is None:
        return
    yield _Found((), "scene", header)
    yield from _below(header.get("attributes"), "attribute", ("attributes",))
    for name, record_of in _TYPED.items():
        listed = header.get(name)
        for k, thing in enumerate(listed if isinstance(listed, list) else ()):
            kind = thing.get("type") if isinstance(thing, dict) else None
            if isinstance(kind, str):
                yield from _below(thing, record_of(kind), (name, k))


def _below(node: Any, record: str, keys: tuple[str | int, ...]) -> Iterator[_Found]:
    if isinstance(node, list):
        for k, entry in enumerate(node):
            yield from _below(entry, record, (*keys, k))
    elif isinstance(node, dict):
        yield _Found(keys, record, node)
        for name, inner in _INNER[record]:
            if name in node:
                yield from _below(node[name], inner, (*keys, name))


def _missing(subject: Subject) -> Iterator[Hit]:
    for keys, record, fields in _objects(subject):
        if record.startswith("unknown"):
            continue
        for name in _EXPECTED[record]:
            always = record == "attribute" and name == "timestamps" and fields.get("static") is True
            if fields.get(name) is None and not always:
                expected = RECORDS[record][name].kind.value
                yield Hit(format_keys((*keys, name)), f"missing; expected {expected}")


def _misspelt(subject: Subject) -> Iterator[Hit]:
    for keys, record, fields in _objects(subject):
        known = RECORDS[record]
        for name in fields:
            if name in known or record.startswith("unknown"):
                continue
            absent = [other for other in known if fields.get(other) is None]
            near = get_close_matches(name, absent, n=1, cutoff=_ALIKE)
            if near:
                problem = f"{name!r} is no field of the format; {near[0]!r} is, and is not there"
                yield Hit(format_keys((*keys, name)), problem)


# fmt: off
FIELD_RULES: tuple[Rule, ...] = (
    Rule("fields-required", WARNING,
         "Fields that the description requires are there, also where a file can be read without them.",
         "Write the field: programs that follow the description need it.", find=_missing),
    Rule("fields-spelling", WARNING, "No field has a name that is nearly one of the format, which is missing.",
         "Correct the name, or choose another one for a field of your own.", find=_misspelt),
)
# fmt: on

_GREAT_PART = 0.25  # where so many of all lines are at fault, that lies not in them but in what wrote them
_FEWEST = 4  # fewer lines with a fault of one kind are listed singly even then
_CODES = frozenset({"broken-lines", "unfit-lines"})  # the codes of what is wrong with single lines
_LOCATIONS = 3
_LINE = re.compile(r"(?P<file>.*): line (?P<number>\d+)")
_BYTE = re.compile(r" \(byte \d+\)|in position \d+| 0x[0-9a-f]{2}")


def _lines_at_fault(code: str) -> Find:
    """Report the faults of a code that lines have: singly, or where a great part of all lines is so, by their kinds."""

    def find(subject: Subject) -> Iterator[Hit]:
        lines = 0 if subject.recording is None else subject.recording.columns.count
        at_fault = sum(fault.count for fault in subject.faults if fault.code in _CODES)
        is_wholly_wrong = lines > 0 and at_fault >= _GREAT_PART * lines
        for alike in _kinds(subject.faults, code):
            count = sum(fault.count for fault in alike)
            if is_wholly_wrong and count >= _FEWEST:
                yield _as_one(alike, count, lines)
            else:
                yield from (Hit(fault.where, fault.problem, fault.count) for fault in alike)

    return find


def _kinds(faults: Iterable[PlacedFault], code: str) -> Iterable[list[PlacedFault]]:
    kinds: dict[str, list[PlacedFault]] = {}
    for fault in faults:
        if fault.code == code:
            kinds.setdefault(_kind(fault), []).append(fault)
    return kinds.values()


def _kind(fault: PlacedFault) -> str:
    """The path in the line, where the problem begins with one, and what was expected, without the value between."""
    problem = fault.problem
    if fault.count > 1:
        problem = problem.partition(": ")[2]
    first, *between, last = ["", *problem.split(": ")]
    is_path = len(between) > 1 and re.fullmatch(r"[A-Za-z][\w.\[\]]*", between[0]) is not None
    return f"{first}{between[0] if is_path else ''}: {_BYTE.sub('', last)}"


def _as_one(alike: Sequence[PlacedFault], count: int, lines: int) -> Hit:
    found = [match for fault in alike if (match := _LINE.fullmatch(fault.path))]
    if not found:
        return Hit(alike[0].where, alike[0].problem, count)
    numbers = [match["number"] for match in found]
    shown = ", ".join(numbers[:_LOCATIONS])
    location = f"{found[0]['file']}: lines {shown}, … {numbers[-1]}"
    return Hit(location, f"{alike[0].problem}; such are {count} of {lines} lines", count)


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


# fmt: off
RECORDING_FAULT_RULES: tuple[Rule, ...] = (
    _error(UNREADABLE, "A recording has a `data.jsonl` with lines of JSON in UTF-8, and can be opened.",
           "Do what the message says; a log without any line has to be recorded or exported again."),
    _error("broken-lines", "Every line of a recording is a JSON object, whole and with finite numbers.",
           "Write the line again, or leave it out; `--lenient` and `--fix` leave it out.",
           _lines_at_fault("broken-lines")),
    _error("unfit-lines",
           "Every line of a recording has the fields that a line of its kind needs, of the kind that they need.",
           "Correct the line where it is made, or leave it out; `--lenient` and `--fix` leave it out.",
           _lines_at_fault("unfit-lines")),
    _error("unusable-orientations",
           "Every pose of a recording whose trajectory has orientations has one, of length 1 within 0.01.",
           "Normalise the quaternion, see whether its order is w, x, y, z by name, or leave the pose out."),
    _error("unreadable-calibration", "`calibration.json` is a JSON object with a list of cameras.",
           "Export it again; until then it is not known where sensors are mounted."),
    _error("unusable-calibrations",
           "Every entry of `calibration.json` has a camera model and a rigid mounting with numbers of the right "
           "kind.", "Correct the entry; a matrix is 4x4 by rows, takes points of the IMU into the sensor, and does not "
           "mirror."),
    _error("repeated-lidars", "No two lidars of `calibration.json` have one `lidarInd`.",
           "Number them as the `lidar` lines do."),
    _error("unusable-frame-parameters", "Camera models and mountings that `frames` lines bring along can be used.",
           "Correct `cameraParameters` or `imuToCamera`, or leave them out: those of the calibration hold then."),
    _error("unusable-cameras", "Every camera of a recording has a camera model and images that can be used.",
           "Correct what the message names; the camera is left out until then."),
    _error("contradicting-mounts",
           "An entry of `calibration.json` with `imuToCamera` and `imuToCameraMatrix` has the same numbers in both.",
           "Leave out the wrong one; other programs read `imuToCamera`, and so does `--lenient`."),
    _error("mounts-missing", "Every camera has an `imuToCamera`, in its entry of `calibration.json` or in its lines.",
           "Write it; until then nothing can be brought into the images. `--lenient` keeps the camera without it."),
    _error("cameras-without-calibration",
           "Every camera that `frames` lines name is in `calibration.json`, or has its camera model in its lines.",
           "Write its entry (model, focal lengths, principal point, imuToCamera); the camera is left out until then.",
           _without_calibration),
    _error("missing-videos", "Every camera that `frames` lines name has a video, or a folder of images.",
           "Put the video where the message expects it, or take the camera out of the lines."),
    _error("unreadable-videos", "Videos and folders of images can be opened.",
           "Record or export the video again; one that was cut off can be repaired by remuxing it."),
    _error("repeated-videos", "Every camera has one video or one folder of images.",
           "Keep the one that the lines belong to."),
    _error("unmatched-images", "A video has as many images as its `frames` lines state.",
           "Find out which images were lost; `--image-index` says which one a line means, the message which way "
           "it took."),
    _error("unusable-lidar-files", "Every `lidar` line has its file, inside the folder, of whole records of 23 bytes.",
           "Copy the file again, or leave the line out."),
    _error("unreadable-vio-config", "`vio_config.yaml` can be read as text.", "Export it again, or leave it out."),
)
# fmt: on
"""Each for one code of the reader's faults, which is its id, too."""

FAULT_CODES = frozenset(rule.id for rule in RECORDING_FAULT_RULES)
