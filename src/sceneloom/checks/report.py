"""What validating a scene gives."""

from collections.abc import Sequence

import msgspec

from sceneloom.checks.rule import Hit, Rule
from sceneloom.checks.walk import Hits
from sceneloom.formats.loss import Loss
from sceneloom.scene.findings import Finding, Severity

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


def findings_of(
    hits: Hits, rules: Sequence[Rule], *, locations: int | None = LOCATIONS
) -> tuple[Finding, ...]:
    """Make findings of hits, the worst first.

    Args:
        hits: of each rule.
        rules: the rules, in their order.
        locations: so many locations of one rule are listed singly, the others as one finding with their count; None for
            all.
    """
    ranked = sorted(rules, key=lambda rule: list(Severity).index(rule.severity))
    return tuple(finding for rule in ranked for finding in _of_rule(rule, hits.get(rule.id, []), locations))


def counts_of(findings: Sequence[Finding]) -> dict[str, int]:
    """How many locations were found, by severity."""
    return {severity.value: sum(f.count for f in findings if f.severity == severity) for severity in Severity}


def is_passed(counts: dict[str, int], *, strict: bool) -> bool:
    """Whether a scene with so many findings is good enough."""
    return not counts[Severity.ERROR] and not (strict and counts[Severity.WARNING])


def _of_rule(rule: Rule, hits: Sequence[Hit], locations: int | None) -> list[Finding]:
    shown = hits if locations is None or len(hits) <= locations + 1 else hits[:locations]
    findings = [_finding(rule, hit) for hit in shown]
    further = hits[len(shown) :]
    if further:
        count = sum(hit.count for hit in further)
        message = f"and more of the same, up to {further[-1].path}"
        findings.append(_finding(rule, Hit(further[0].path, message, count)))
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
