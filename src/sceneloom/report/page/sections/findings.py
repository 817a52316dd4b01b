"""All that the rules of `validate` found."""

from itertools import groupby

from sceneloom.report.numbers.drive import DriveReport
from sceneloom.report.page.content import Block, Section
from sceneloom.report.page.texts import joined, several, times
from sceneloom.scene.findings import Finding


def findings_section(report: DriveReport) -> Section:
    """List the findings by rule, the worst first, each with its location and what to do."""
    found = report.validation
    if found is None:
        return Section(key="findings", name="Findings of validate", missing=report.left_out.get("findings"))
    passed = "Passed" if found.passed else "Not passed"
    read = "frames and images read" if found.frames_read else "no frames and images read"
    blocks = [Block(lines=[f"{passed}, by {len(found.rules)} rules of the profile {found.profile}, {read}."])]
    for (severity, rule), group in groupby(
        found.findings, key=lambda finding: (finding.severity, finding.rule)
    ):
        listed = list(group)
        blocks.append(
            Block(
                heading=f"{rule}: {several(sum(finding.count for finding in listed), 'time')}",
                badge=(str(severity), str(severity)),
                lines=[f"What to do: {listed[0].remedy}", *_fixable(listed[0]), *_shown(listed)],
                list_title=f"All {len(listed)} locations",
                listed=[_line(finding) for finding in listed] if len(listed) > 1 else [],
            )
        )
    facts = [(f"{name}s".capitalize(), f"{number:,}") for name, number in found.counts.items()]
    return Section(
        key="findings",
        name="Findings of validate",
        missing=report.left_out.get("findings"),
        facts=facts,
        blocks=blocks,
    )


def _fixable(finding: Finding) -> list[str]:
    return ["`sceneloom validate --fix` repairs it."] if finding.fixable else []


def _shown(listed: list[Finding]) -> list[str]:
    return [f"Where: {_line(listed[0])}"]


def _line(finding: Finding) -> str:
    return joined(finding.path, finding.message) + times(finding.count)
