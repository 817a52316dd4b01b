"""`sceneloom.validate`: a path or a scene in, findings out."""

from collections import Counter
from collections.abc import Iterable, Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import msgspec

from sceneloom.checks.catalogue import chosen_rules
from sceneloom.checks.fixing import repaired
from sceneloom.checks.opening import open_subject
from sceneloom.checks.reading import FAULT_RULES
from sceneloom.checks.recordings.faults import FAULT_RULES as FAULT_RULES_OF_RECORDINGS
from sceneloom.checks.report import LOCATIONS, ValidationReport, counts_of, findings_of, is_passed
from sceneloom.checks.rule import Rule
from sceneloom.checks.subject import Subject
from sceneloom.checks.walk import Hits, find_all
from sceneloom.errors import CalibrationError, DataError, PoseError
from sceneloom.formats.faults import PlacedFault
from sceneloom.formats.loss import LossReport
from sceneloom.formats.table import check_scene_output, format_for_output, write_scene
from sceneloom.scene.findings import Finding
from sceneloom.scene.scene import Scene
from sceneloom.scene.types import Progress
from sceneloom.scene.warnings import DataWarning, WarningKind
from sceneloom.stages import stage

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

    def hits(self, subject: Subject) -> Hits:
        """Run the rules; of what could not be read at all, only those that state why."""
        if subject.faults and subject.holds_nothing:
            reported = {rule.id for rule in (*FAULT_RULES, *FAULT_RULES_OF_RECORDINGS)}
            return find_all(subject, [rule for rule in self.rules if rule.id in reported], frames=False)
        hits = find_all(subject, self.rules, frames=self.frames, progress=self.progress)
        if not subject.frame_numbers:
            return hits
        of_file = {rule.id for rule in FAULT_RULES}
        return {
            rule: found
            if rule in of_file
            else [replace(hit, path=subject.path_in_file(hit.path)) for hit in found]
            for rule, found in hits.items()
        }

    def report(self, subject: Subject, hits: Hits) -> ValidationReport:
        """Put what was found into a report."""
        findings = findings_of(hits, self.rules, locations=self.locations)
        counts = counts_of(findings)
        return ValidationReport(
            source=subject.scene.source,
            format=subject.scene.format,
            profile=self.profile or ("recording" if subject.is_recording else "sfs"),
            strict=self.strict,
            passed=is_passed(counts, strict=self.strict),
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
        profile,
        strict,
        frames,
        chosen_rules(profile or "sfs", only=rules, ignored=ignore),
        locations,
        progress,
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
        if not _can_be_written(subject):
            return msgspec.structs.replace(report, unwritten=_MEANS_NOTHING)
        scene, applied = repaired(subject.scene, terms.rules, hits)
        reported = replace(scene, warnings=(*scene.warnings, *_notes(subject.faults)))
        try:
            with stage("writing"):
                losses = _write(reported, Path(fix), profile, overwrite=overwrite)
        except _UNWRITABLE as error:
            return msgspec.structs.replace(report, unwritten=str(error))
    finally:
        if subject.scene is not source:
            subject.scene.close()
    return msgspec.structs.replace(_after_fixing(report, applied, Path(fix), terms), losses=losses.losses)


def _can_be_written(subject: Subject) -> bool:
    """Whether the scene means what its file means: not if its clock, state, had to be guessed."""
    return not any(fault.vital for fault in subject.faults) and not (subject.faults and subject.holds_nothing)


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


def _write(scene: Scene, path: Path, profile: str | None, *, overwrite: bool) -> LossReport:
    options = {"recording": {"images": "lossless"}, "sfs": {} if profile is None else {"profile": profile}}
    return write_scene(scene, path, overwrite=overwrite, **options.get(format_for_output(path).name, {}))


def _after_fixing(
    before: ValidationReport, applied: frozenset[str], output: Path, terms: _Terms
) -> ValidationReport:
    """Check what was written, and state what of the findings before is repaired or was left out."""
    subject = open_subject(output)
    with subject.scene:
        after = terms.report(subject, terms.hits(subject))
    gone = _gone(before.findings, after.findings)
    return msgspec.structs.replace(
        after,
        source=before.source,
        format=before.format,
        fixed=tuple(finding for finding in gone if finding.rule in applied),
        left_out=_left_out(gone, applied),
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


def _left_out(gone: Sequence[Finding], applied: frozenset[str]) -> tuple[Finding, ...]:
    rules = (*FAULT_RULES, *FAULT_RULES_OF_RECORDINGS)
    unmended = {rule.id for rule in rules if rule.fix is None} - applied
    return tuple(finding for finding in gone if finding.rule in unmended)
