"""Rules about what cannot be read, and what a reader remarked."""

from collections.abc import Callable, Iterator

from sceneloom.checks.rule import Find, Hit, Rule
from sceneloom.checks.subject import FrameInHand, Subject
from sceneloom.formats.faults import PlacedFault
from sceneloom.scene.findings import Severity
from sceneloom.scene.scene import Scene
from sceneloom.scene.warnings import WarningKind

_REPORTED_BY_RULES_OF_RECORDINGS = frozenset(
    {
        "blank-lines-at-end",
        "byte-order-mark",
        "camera-model-scaled",
        "lines-sorted",
        "missing-bitmaps",
        "poses-without-orientation",
        "repeated-poses",
        "rotation-normalised",
    }
)
"""Warnings of the recording's reader that rules over its lines report better."""

_REPORTED_BY_RULES = frozenset(
    {
        "at-fault",
        "item-at-fault",
        "repaired",
        "no-images",
        "no-poses",
        "relative-point-times",
        "short-distortion",
        "unknown-distortion",
        "video-and-images",
    }
)
"""Warnings of readers that other rules report better."""


def faults_of(code: str) -> Find:
    """Report the faults of a code that the reader found."""

    def find(subject: Subject) -> Iterator[Hit]:
        return (Hit(f.where, _with_cost(f), f.count) for f in subject.faults if f.code == code)

    return find


def _with_cost(fault: PlacedFault) -> str:
    """What is wrong, and what cannot be read because of it."""
    return f"{fault.problem}; left out: {fault.costs}" if fault.costs else fault.problem


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


def _rule(
    identifier: str,
    code: str,
    summary: str,
    remedy: str,
    fix: Callable[[Scene], Scene] | None = None,
) -> Rule:
    return Rule(identifier, Severity.ERROR, summary, remedy, find=faults_of(code), fix=fix)


FAULT_RULES: tuple[Rule, ...] = (
    _rule(
        "file-readable",
        "unreadable",
        "The file or folder can be read.",
        "Export it again; of a scene file that was cut off, `sceneloom salvage` takes out what is whole.",
    ),
    _rule(
        "version-known",
        "version",
        "The file says a version that begins with 1.0 or 5.1.",
        "Write `version` as 1.0 if the file follows the description of the format.",
    ),
    _rule(
        "fields-valid",
        "malformed",
        "Every field has the kind, dtype, shape and length that the format says, and required fields are there.",
        "Correct the field where the file is made; `--fix` leaves it out, or what needs it.",
    ),
    _rule(
        "arrays-whole",
        "item",
        "Every array lies inside the file, overlaps no other, and its keys lead to a location of the header.",
        "Write the file again; `--fix` leaves the array out, and what cannot be without it.",
    ),
    _rule(
        "ids-unique",
        "duplicate-id",
        "No two sensors and no two annotations share an id.",
        "Give each its own id; `--fix` keeps the first of them.",
    ),
    _rule(
        "quaternion-norm",
        "quaternion-norm",
        "Quaternions of poses have length 1, within 0.01.",
        "Normalise them; the direction that they report stays.",
        as_read,
    ),
    _rule(
        "pose-times-increasing",
        "pose-times-increasing",
        "Poses have strictly increasing times.",
        "Sort the poses by time, and leave out those that stand there twice.",
        as_read,
    ),
    _rule(
        "poses-finite",
        "not-finite",
        "Poses hold finite numbers only.",
        "Leave the pose out, or compute it again; between its neighbours it is interpolated.",
    ),
)
"""Rules that hold only where a file was read, each for one code of the reader's faults."""

RULES: tuple[Rule, ...] = (
    *FAULT_RULES,
    Rule(
        "frame-readable",
        Severity.ERROR,
        "Every frame can be read and every image decoded.",
        "Record or export the frame again, or leave it out.",
        look=_unreadable,
    ),
    Rule(
        "reading-skipped",
        Severity.HINT,
        "Nothing had to be left out on reading.",
        "See whether what was left out is needed.",
        find=_warnings_of(WarningKind.SKIPPED),
    ),
    Rule(
        "reading-repaired",
        Severity.HINT,
        "Nothing had to be brought into order on reading.",
        "Correct it where the data are made, so that every program reads the same.",
        find=_warnings_of(WarningKind.REPAIRED),
    ),
    Rule(
        "reading-assumed",
        Severity.HINT,
        "Nothing had to be assumed on reading.",
        "Where it is otherwise, report it in the files, or with the option that the message names, if it names one.",
        find=_warnings_of(WarningKind.ASSUMED),
    ),
)
