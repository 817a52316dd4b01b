"""`sceneloom.validate`: a path or a scene in, findings out."""

from collections.abc import Iterable
from pathlib import Path
from typing import Any

from sceneloom.checks.catalogue import chosen_rules
from sceneloom.checks.report import PLACES, ValidationReport, counts_of, findings_of, is_passed
from sceneloom.checks.subject import Subject
from sceneloom.checks.walk import Progress, find_all
from sceneloom.formats.table import open_scene
from sceneloom.scene import Scene


def validate(
    source: str | Path | Scene,
    *,
    profile: str = "sfs",
    strict: bool = False,
    frames: bool = True,
    rules: Iterable[str] = (),
    ignore: Iterable[str] = (),
    places: int | None = PLACES,
    progress: Progress | None = None,
    **reading: Any,
) -> ValidationReport:
    """Check a scene, a recording or a rig by the rules of a profile.

    Args:
        source: a file or folder, or a scene that is open.
        profile: "sfs", or "scale" for what Scale's own library loads and validates.
        strict: let warnings count, too.
        frames: read every frame and picture; without, only what is known at opening is checked.
        rules: ids of the only rules to run; () for all.
        ignore: ids of rules that are not to be run.
        places: so many places of one rule are told singly, the others counted; None for all.
        progress: called with the number of frames done and of all.
        reading: reading options of the format.

    Raises:
        UnknownFormatError: no format fits the path.
        OptionError: there is no such profile or rule.
    """
    if not isinstance(source, Scene):
        with open_scene(source, **reading) as scene:
            return validate(
                scene,
                profile=profile,
                strict=strict,
                frames=frames,
                rules=rules,
                ignore=ignore,
                places=places,
                progress=progress,
            )
    chosen = chosen_rules(profile, only=rules, ignored=ignore)
    hits = find_all(Subject(source), chosen, frames=frames, progress=progress)
    findings = findings_of(hits, chosen, places=places)
    counts = counts_of(findings)
    return ValidationReport(
        source=source.source,
        format=source.format,
        profile=profile,
        strict=strict,
        passed=is_passed(counts, strict=strict),
        findings=findings,
        counts=counts,
        rules=tuple(rule.id for rule in chosen),
        frames_read=frames,
    )
