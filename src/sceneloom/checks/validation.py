"""`sceneloom.validate`: a path or a scene in, findings out."""

from collections import Counter
from collections.abc import Iterable, Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import msgspec

from sceneloom.checks.catalogue import chosen_rules
from sceneloom.checks.fixing import mended
from sceneloom.checks.opening import open_subject
from sceneloom.checks.reading import FAULT_RULES
from sceneloom.checks.recordings.faults import FAULT_RULES as FAULT_RULES_OF_RECORDINGS
from sceneloom.checks.report import PLACES, ValidationReport, counts_of, findings_of, is_passed
from sceneloom.checks.rule import Rule
from sceneloom.checks.subject import Subject
from sceneloom.checks.walk import Hits, find_all
from sceneloom.errors import CalibrationError, DataError, PoseError
from sceneloom.formats.faults import PlacedFault
from sceneloom.formats.loss import LossReport
from sceneloom.formats.table import check_scene_output, format_for_output, write_scene
from sceneloom.scene.findings import Finding
from sceneloom.scene.notices import Notice, NoticeKind
from sceneloom.scene.scene import Scene
from sceneloom.scene.types import Progress
from sceneloom.stages import stage

_MEANS_NOTHING = "what is at fault decides what the rest means"

_UNWRITABLE = (DataError, CalibrationError, PoseError)
"""What is wrong with a scene, not with the place that it is to be written to."""


@dataclass(frozen=True, slots=True)
class _Terms:
    """How a scene is checked; `profile` is None where what it is decides."""

    profile: str | None
    strict: bool
    frames: bool
    rules: tuple[Rule, ...]
    places: int | None
    progress: Progress | None

    def hits(self, subject: Subject) -> Hits:
        """Run the rules; of what could not be read at all, only those that say why."""
        if subject.faults and subject.holds_nothing:
            told = {rule.id for rule in (*FAULT_RULES, *FAULT_RULES_OF_RECORDINGS)}
            return find_all(subject, [rule for rule in self.rules if rule.id in told], frames=False)
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
        findings = findings_of(hits, self.rules, places=self.places)
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
    places: int | None = PLACES,
    progress: Progress | None = None,
    **reading: Any,
) -> ValidationReport:
    """Check a scene, a recording or a rig by the rules of a profile, and mend what can be mended safely.

    Args:
        source: a file or folder, the URL of a scene file, or a scene that is open.
        profile: "sfs", or "scale" for what Scale's own library loads and validates; None: "sfs", and of a recording
            the rules over its lines and files, which the report calls "recording".
        fix: where to write the scene with all safe fixes applied; the findings are then those of what was written.
        overwrite: whether `fix` may be replaced.
        strict: let warnings count, too.
        frames: read every frame and picture; without, only what is known at opening is checked.
        rules: ids of the only rules to run; () for all.
        ignore: ids of rules that are not to be run.
        places: so many places of one rule are told singly, the others counted; None for all.
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
        profile, strict, frames, chosen_rules(profile or "sfs", only=rules, ignored=ignore), places, progress
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
        scene, applied = mended(subject.scene, terms.rules, hits)
        told = replace(scene, notices=(*scene.notices, *_remarks(subject.faults)))
        try:
            with stage("writing"):
                losses = _write(told, Path(fix), profile, overwrite=overwrite)
        except _UNWRITABLE as error:
            return msgspec.structs.replace(report, unwritten=str(error))
    finally:
        if subject.scene is not source:
            subject.scene.close()
    return msgspec.structs.replace(_after_fixing(report, applied, Path(fix), terms), losses=losses.losses)


def _can_be_written(subject: Subject) -> bool:
    """Whether the scene means what its file means: not if its clock, say, had to be guessed."""
    return not any(fault.vital for fault in subject.faults) and not (subject.faults and subject.holds_nothing)


def _remarks(faults: Sequence[PlacedFault]) -> tuple[Notice, ...]:
    """What the written file is to say about the faults of the one that it was made from: one remark for each kind."""
    kinds: dict[tuple[str, bool], list[PlacedFault]] = {}
    for fault in faults:
        kinds.setdefault((fault.code, fault.mended), []).append(fault)
    return tuple(
        Notice(
            kind=NoticeKind.REPAIRED if is_mended else NoticeKind.SKIPPED,
            code="mended" if is_mended else "at-fault",
            place=alike[0].where,
            message=f"{'mended' if is_mended else 'left out'} on validating: {alike[0].problem}",
            count=sum(fault.count for fault in alike),
        )
        for (_, is_mended), alike in kinds.items()
    )


def _write(scene: Scene, path: Path, profile: str | None, *, overwrite: bool) -> LossReport:
    options = {"recording": {"pictures": "lossless"}, "sfs": {} if profile is None else {"profile": profile}}
    return write_scene(scene, path, overwrite=overwrite, **options.get(format_for_output(path).name, {}))


def _after_fixing(
    before: ValidationReport, applied: frozenset[str], output: Path, terms: _Terms
) -> ValidationReport:
    """Check what was written, and say what of the findings before is mended or was left out."""
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
    """The findings that are not there any more; places move up where something before them was left out."""
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
