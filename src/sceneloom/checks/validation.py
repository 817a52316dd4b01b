"""`sceneloom.validate`: open what is checked, run the rules, repair, and report the findings."""

from collections import Counter
from collections.abc import Iterable, Iterator, Sequence
from dataclasses import dataclass, replace
from importlib import import_module
from pathlib import Path
from typing import Any

import msgspec
import numpy as np

from sceneloom.checks.faults import FAULT_CODES, FAULT_RULES, RECORDING_FAULT_RULES, UNREADABLE
from sceneloom.checks.rule import ALL_PROFILES, FrameInHand, Hit, Rule, Subject
from sceneloom.errors import CalibrationError, DataError, OptionError, PoseError, SceneloomError, check_choice, redacted
from sceneloom.formats.base.diagnostics import PlacedFault
from sceneloom.formats.base.losses import Loss
from sceneloom.formats.base.registry import (
    check_scene_output,
    chosen_corrections,
    format_and_location,
    format_for_output,
    opened_by,
    part_of,
    write_scene,
)
from sceneloom.formats.base.spec import FormatSpec
from sceneloom.formats.recording.reader import RecordingExamination
from sceneloom.formats.sfs.container import collector_paused
from sceneloom.formats.sfs.reader import Examination
from sceneloom.scene.cameras import CameraImage, DepthFrame
from sceneloom.scene.scene import Corrections, Scene, frames_of
from sceneloom.scene.types import Progress, reporting
from sceneloom.stages import stage
from sceneloom.warnings import DataWarning, Finding, Severity, WarningKind


def open_subject(
    path: str | Path,
    *,
    format: str | None = None,
    start: float | None = None,
    stop: float | None = None,
    corrections: str = Corrections.APPLY,
    **reading: Any,
) -> Subject:
    """Open a file or folder; what cannot be read is a fault of the subject, not an error.

    Args:
        path: a file or folder, or the URL of a scene file.
        format: the format's name, where the content should not decide.
        start, stop: seconds after the first timestamp: the part between them is a scene of its own, without the texts
            of its file, with the faults of all of it.
        corrections: as of `open_scene`.
        reading: reading options of the format; `lenient` plays no part.

    Raises:
        UnknownFormatError: no format fits the path.
        OptionError: an option or its value is not known, or there is nothing between `start` and `stop`.
    """
    chosen = chosen_corrections(corrections)
    subject = _whole_subject(path, format, reading)
    if chosen is not subject.scene.corrections:
        subject = replace(subject, scene=replace(subject.scene, corrections=chosen))
    if start is None and stop is None:
        return subject
    part = part_of(subject.scene, start=start, stop=stop)
    return Subject(part, faults=subject.faults, warnings=subject.notes)


def _whole_subject(path: str | Path, format: str | None, reading: dict[str, Any]) -> Subject:
    form, where = format_and_location(path, format=format)
    options = {name: value for name, value in reading.items() if value is not None and name != "lenient"}
    if not form.examiner:
        return _opened(form, where, options)
    found = form.examine(where, **options)
    if isinstance(found, RecordingExamination):
        return _examined_recording(found, where)
    return _examined(found, where)


def _examined(examination: Examination, path: str | Path) -> Subject:
    if examination.scene is None:
        return Subject(_nothing(path, "sfs"), faults=examination.faults)
    return Subject(
        examination.scene,
        examination.header,
        examination.faults,
        examination.sensor_paths,
        examination.annotation_paths,
        examination.warnings,
        fetch=examination.fetch,
        frame_numbers=examination.frame_numbers,
    )


def _examined_recording(examination: RecordingExamination, path: Path) -> Subject:
    scene = examination.scene or _nothing(path, "recording")
    faults = tuple(
        fault if fault.code in FAULT_CODES else replace(fault, code=UNREADABLE) for fault in examination.faults
    )
    return Subject(scene, faults=faults, recording=examination.contents)


def _opened(form: FormatSpec, path: Path, options: dict[str, Any]) -> Subject:
    """Open what another format holds: whole, or without what is broken, or not at all."""
    try:
        return Subject(opened_by(form, path, **options))
    except DataError as error:
        fault = _unreadable(path, error)
    try:
        return Subject(opened_by(form, path, **options, lenient=True), faults=(fault,))
    except DataError as error:
        return Subject(_nothing(path, form.name), faults=(_unreadable(path, error),))


def _unreadable(path: Path, error: DataError) -> PlacedFault:
    location = ": ".join(part for part in (error.file.removeprefix(str(path)).lstrip("/"), error.location) if part)
    return PlacedFault(location, error.problem, "unreadable")


def _nothing(path: str | Path, format_name: str) -> Scene:
    return Scene((), source=redacted(path), format=format_name)


RULE_TABLES: tuple[str, ...] = (
    "faults:READING_RULES",
    "faults:FIELD_RULES",
    "faults:RECORDING_FAULT_RULES",
    "recordings.files:PRESENCE_RULES",
    "recordings.times:STREAM_RULES",
    "recordings.samples:SAMPLE_RULES",
    "recordings.samples:FIX_RULES",
    "poses:POSE_STEP_RULES",
    "recordings.files:CONFIGURATION_RULES",
    "recordings.files:FRAME_LINE_RULES",
    "recordings.files:CALIBRATION_RULES",
    "recordings.files:LIDAR_LINE_RULES",
    "times:TIME_RULES",
    "times:POINT_TIME_RULES",
    "poses:POSE_RULES",
    "poses:POSES_AND_IMU_RULES",
    "recordings.samples:POSES_AND_GNSS_RULES",
    "recordings.times:ORIENTATION_RULES",
    "sensors:SENSOR_RULES",
    "images:CAMERA_RULES",
    "points:POINT_RULES",
    "cuboids:POINT_FRAME_RULES",
    "images:IMAGE_RULES",
    "sensors:REFERENCE_RULES",
    "times:ANNOTATION_TIME_RULES",
    "shapes:ATTRIBUTE_RULES",
    "cuboids:CUBOID_RULES",
    "images:BOX_RULES",
    "shapes:SHAPE_RULES",
    "points:LABELLED_POINT_RULES",
    "poses:CORRECTION_RULES",
    "scale:SCALE_RULES",
)
"""All tables of rules, in the order in which findings are reported."""


def all_rules() -> tuple[Rule, ...]:
    """Every rule of every profile."""
    tables = (table.split(":") for table in RULE_TABLES)
    return tuple(r for module, name in tables for r in getattr(import_module(f"{__package__}.{module}"), name))


def chosen_rules(profile: str, *, only: Iterable[str] = (), ignored: Iterable[str] = ()) -> tuple[Rule, ...]:
    """The rules of a profile: only those that are named, but for those that are to be ignored.

    Raises:
        OptionError: there is no such profile, or no such rule.
    """
    check_choice("profile", profile, ALL_PROFILES)
    rules, only, ignored = all_rules(), frozenset(only), frozenset(ignored)
    known_ids = {rule.id for rule in rules}
    for identifier in sorted((only | ignored) - known_ids):
        raise OptionError(f"no rule {identifier!r}; `sceneloom validate --rules` lists them")
    return tuple(
        rule for rule in rules if profile in rule.profiles and rule.id not in ignored and (not only or rule.id in only)
    )


class RuleRow(msgspec.Struct, frozen=True, kw_only=True):
    """One rule as a list of rules reports it.

    Attributes:
        id: of the rule.
        severity: how bad a finding is.
        summary: what holds in a sound scene.
        remedy: what a person can do.
        fixable: whether `--fix` repairs it.
        only_in: the profiles that it is limited to; () for all.
    """

    id: str
    severity: str
    summary: str
    remedy: str
    fixable: bool
    only_in: tuple[str, ...] = ()


def catalogue() -> tuple[RuleRow, ...]:
    """All rules, those of one room together."""
    return tuple(
        RuleRow(
            id=rule.id,
            severity=rule.severity.value,
            summary=rule.summary,
            remedy=rule.remedy,
            fixable=rule.fix is not None,
            only_in=() if rule.profiles == ALL_PROFILES else rule.profiles,
        )
        for rule in all_rules()
    )


_Hits = dict[str, list[Hit]]  # what was found, by the id of the rule, in the order of the rules


@np.errstate(over="ignore", invalid="ignore", divide="ignore")
def find_all(
    subject: Subject, rules: Sequence[Rule], *, frames: bool = True, progress: Progress | None = None
) -> _Hits:
    """Run rules over a scene; they look at whatever numbers there are, and those that overflow are not within limits.

    Args:
        subject: the scene.
        rules: which.
        frames: whether frames and images are read for the rules that look at them; each is read once.
        progress: called with the number of frames done and of all.
    """
    # the tables of a scene with many annotations are very many objects that form no cycles
    with collector_paused():
        hits: _Hits = {rule.id: list(rule.find(subject)) if rule.find is not None else [] for rule in rules}
    looking = [rule for rule in rules if rule.look is not None]
    if not (frames and looking):
        return hits
    total = sum(len(frames_of(sensor)) for sensor in subject.scene.sensors)
    for frame in reporting(_frames_in_hand(subject), progress, total):
        for rule in looking:
            if rule.look is not None:
                hits[rule.id].extend(rule.look(subject, frame))
    for rule in looking:
        if rule.conclude is not None:
            hits[rule.id].extend(rule.conclude(subject))
    return hits


def _frames_in_hand(subject: Subject) -> Iterator[FrameInHand]:
    """Read every frame and decode every image once; one that cannot be read is handed out with its fault."""
    for path, sensor in subject.sensors():
        frames = frames_of(sensor)
        for number in range(len(frames)):
            try:
                frame = frames[number]
                shot = isinstance(frame, CameraImage | DepthFrame)
                yield FrameInHand(sensor, path, number, frame.loaded() if shot else frame)
            except SceneloomError as error:
                yield FrameInHand(sensor, path, number, None, str(error))


_MOST_ROUNDS = 8  # a fix may bring to light what another repairs; none needs more rounds than there are such steps


def _repaired(scene: Scene, rules: Sequence[Rule], hits: _Hits) -> tuple[Scene, frozenset[str]]:
    """Apply the rules' fixes until none would change what is found: the scene, and the ids of rules applied."""
    # `hits`: of the first search, in frames as well; later ones look at what is known without reading
    fixable = [rule for rule in rules if rule.fix is not None]
    applied: set[str] = set()
    for _ in range(_MOST_ROUNDS):
        before = scene
        for rule in fixable:
            if rule.fix is not None and hits.get(rule.id):
                scene = rule.fix(scene)
                applied.add(rule.id)
        if scene is before:
            break
        hits = find_all(Subject(scene), fixable, frames=False)
    return scene, frozenset(applied)


LOCATIONS = 20
"""So many locations of one rule are listed singly unless the caller wants all."""


class ValidationReport(msgspec.Struct, frozen=True, kw_only=True):
    """What was found in a scene.

    Attributes:
        source: the file or folder, or where the scene came from.
        format: name of its format.
        profile: what it was checked against: "sfs", "scale", or "recording" for the lines and files of one.
        strict: whether warnings count, too.
        passed: no errors, and where strict no warnings either.
        findings: by severity, then by rule.
        counts: how many locations were found, by severity.
        rules: ids of the rules that were run.
        frames_read: whether frames and images were read.
        fixed: what was found at first and is repaired in `output`.
        left_out: what stood in the source and could not be taken into `output`.
        losses: what `output` could not hold, though nothing was wrong with it.
        output: the file that the repaired scene was written to, or None; the findings are then those of it.
        unwritten: why there is no `output` though there was to be one, or None.
    """

    source: str
    format: str
    profile: str
    strict: bool
    passed: bool
    findings: tuple[Finding, ...]
    counts: dict[str, int]
    rules: tuple[str, ...]
    frames_read: bool = True
    fixed: tuple[Finding, ...] = ()
    left_out: tuple[Finding, ...] = ()
    losses: tuple[Loss, ...] = ()
    output: str | None = None
    unwritten: str | None = None


def findings_of(hits: _Hits, rules: Sequence[Rule], *, locations: int | None = LOCATIONS) -> tuple[Finding, ...]:
    """Make findings of hits, the worst first.

    Args:
        hits: of each rule.
        rules: the rules, in their order.
        locations: so many locations of one rule are listed singly, the others as one finding with their count; None for
            all.
    """
    ranked = sorted(rules, key=lambda rule: list(Severity).index(rule.severity))
    return tuple(finding for rule in ranked for finding in _of_rule(rule, hits.get(rule.id, []), locations))


def _of_rule(rule: Rule, hits: Sequence[Hit], locations: int | None) -> list[Finding]:
    shown = hits if locations is None or len(hits) <= locations + 1 else hits[:locations]
    findings = [_finding(rule, hit) for hit in shown]
    further = hits[len(shown) :]
    if further:
        count = sum(hit.count for hit in further)
        findings.append(_finding(rule, Hit(further[0].path, f"and more of the same, up to {further[-1].path}", count)))
    return findings


def _finding(rule: Rule, hit: Hit) -> Finding:
    return Finding(
        rule=rule.id,
        severity=rule.severity,
        path=hit.path,
        message=hit.message,
        remedy=rule.remedy,
        count=hit.count,
        fixable=rule.fix is not None,
    )


_MEANS_NOTHING = "what is at fault decides what the rest means"
_UNWRITABLE = (DataError, CalibrationError, PoseError)
"""What is wrong with a scene, not with the location that it is to be written to."""


@dataclass(frozen=True, slots=True)
class _Terms:
    """How a scene is checked; `profile` is None where what it is decides."""

    profile: str | None
    strict: bool
    frames: bool
    rules: tuple[Rule, ...]
    locations: int | None
    progress: Progress | None

    def hits(self, subject: Subject) -> _Hits:
        """Run the rules; of what could not be read at all, only those that state why."""
        if subject.faults and subject.holds_nothing:
            reported = {rule.id for rule in (*FAULT_RULES, *RECORDING_FAULT_RULES)}
            return find_all(subject, [rule for rule in self.rules if rule.id in reported], frames=False)
        hits = find_all(subject, self.rules, frames=self.frames, progress=self.progress)
        if not subject.frame_numbers:
            return hits
        of_file = {rule.id for rule in FAULT_RULES}
        return {
            rule: found if rule in of_file else [replace(hit, path=subject.path_in_file(hit.path)) for hit in found]
            for rule, found in hits.items()
        }

    def report(self, subject: Subject, hits: _Hits) -> ValidationReport:
        """Put what was found into a report."""
        findings = findings_of(hits, self.rules, locations=self.locations)
        counts = {severity.value: sum(f.count for f in findings if f.severity == severity) for severity in Severity}
        return ValidationReport(
            source=subject.scene.source,
            format=subject.scene.format,
            profile=self.profile or ("recording" if subject.is_recording else "sfs"),
            strict=self.strict,
            passed=not counts[Severity.ERROR] and not (self.strict and counts[Severity.WARNING]),
            findings=findings,
            counts=counts,
            rules=tuple(rule.id for rule in self.rules),
            frames_read=self.frames,
        )


def validate(
    source: str | Path | Scene,
    *,
    profile: str | None = None,
    fix: str | Path | None = None,
    overwrite: bool = False,
    strict: bool = False,
    frames: bool = True,
    rules: Iterable[str] = (),
    ignore: Iterable[str] = (),
    locations: int | None = LOCATIONS,
    progress: Progress | None = None,
    **reading: Any,
) -> ValidationReport:
    """Check a scene, a recording or a rig by the rules of a profile, and repair what can be repaired safely.

    Args:
        source: a file or folder, the URL of a scene file, or a scene that is open.
        profile: "sfs", or "scale" for what Scale's own library loads and validates; None: "sfs", and of a recording
            the rules over its lines and files, which the report calls "recording".
        fix: where to write the scene with all safe fixes applied; the findings are then those of what was written.
        overwrite: whether `fix` may be replaced.
        strict: let warnings count, too.
        frames: read every frame and image; without, only what is known at opening is checked.
        rules: ids of the only rules to run; () for all.
        ignore: ids of rules that are not to be run.
        locations: so many locations of one rule are listed singly, the others counted; None for all.
        progress: called with the number of frames done and of all.
        reading: reading options of the format, `start` and `stop` of a part among them; faulty parts are never an
            error here.

    Returns:
        The report; where nothing could be written to `fix`, its `output` is None, and `unwritten` says why.

    Raises:
        UnknownFormatError: no format fits the path.
        OptionError: there is no such profile, rule or reading option.
        OutputError: `fix` exists, or cannot be written.
    """
    terms = _Terms(
        profile, strict, frames, chosen_rules(profile or "sfs", only=rules, ignored=ignore), locations, progress
    )
    if fix is not None:
        check_scene_output(Path(fix), overwrite=overwrite)
    with stage("opening"):
        subject = Subject(source) if isinstance(source, Scene) else open_subject(source, **reading)
    try:
        with stage("checking"):
            hits = terms.hits(subject)
        report = terms.report(subject, hits)
        if fix is None:
            return report
        # a scene does not mean what its file means if its clock, say, had to be guessed
        if any(fault.vital for fault in subject.faults) or (subject.faults and subject.holds_nothing):
            return msgspec.structs.replace(report, unwritten=_MEANS_NOTHING)
        scene, applied = _repaired(subject.scene, terms.rules, hits)
        reported = replace(scene, warnings=(*scene.warnings, *_notes(subject.faults)))
        try:
            with stage("writing"):
                own = {"recording": {"images": "lossless"}, "sfs": {} if profile is None else {"profile": profile}}
                options = own.get(format_for_output(Path(fix)).name, {})
                losses = write_scene(reported, Path(fix), overwrite=overwrite, **options)
        except _UNWRITABLE as error:
            return msgspec.structs.replace(report, unwritten=str(error))
    finally:
        if subject.scene is not source:
            subject.scene.close()
    return msgspec.structs.replace(_after_fixing(report, applied, Path(fix), terms), losses=losses.losses)


def _notes(faults: Sequence[PlacedFault]) -> tuple[DataWarning, ...]:
    """What the written file is to state about the faults of the one that it was made from: one note for each kind."""
    kinds: dict[tuple[str, bool], list[PlacedFault]] = {}
    for fault in faults:
        kinds.setdefault((fault.code, fault.repaired), []).append(fault)
    return tuple(
        DataWarning(
            kind=WarningKind.REPAIRED if is_repaired else WarningKind.SKIPPED,
            code="repaired" if is_repaired else "at-fault",
            location=alike[0].where,
            message=f"{'repaired' if is_repaired else 'left out'} on validating: {alike[0].problem}",
            count=sum(fault.count for fault in alike),
        )
        for (_, is_repaired), alike in kinds.items()
    )


def _after_fixing(before: ValidationReport, applied: frozenset[str], output: Path, terms: _Terms) -> ValidationReport:
    """Check what was written, and state what of the findings before is repaired or was left out."""
    subject = open_subject(output)
    with subject.scene:
        after = terms.report(subject, terms.hits(subject))
    gone = _gone(before.findings, after.findings)
    unmended = {rule.id for rule in (*FAULT_RULES, *RECORDING_FAULT_RULES) if rule.fix is None} - applied
    return msgspec.structs.replace(
        after,
        source=before.source,
        format=before.format,
        fixed=tuple(finding for finding in gone if finding.rule in applied),
        left_out=tuple(finding for finding in gone if finding.rule in unmended),
        output=str(output),
    )


def _gone(before: Sequence[Finding], after: Sequence[Finding]) -> list[Finding]:
    """The findings that are not there any more; locations move up where something before them was left out."""
    still = Counter((finding.rule, finding.message) for finding in after)
    gone = []
    for finding in before:
        if still[finding.rule, finding.message]:
            still[finding.rule, finding.message] -= 1
        else:
            gone.append(finding)
    return gone
