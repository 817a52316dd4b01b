"""What was assumed, left out or found to be wrong, as lines of the viewer's log."""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from types import MappingProxyType

from sceneloom.checks.validation import validate
from sceneloom.scene.findings import Finding, Severity
from sceneloom.scene.scene import Scene
from sceneloom.scene.warnings import DataWarning, WarningKind
from sceneloom.view.sdk import sdk
from sceneloom.view.stream import Stream

NOTES = "notes"

_LEVELS: Mapping[str, str] = MappingProxyType(
    {
        WarningKind.ASSUMED: "INFO",
        WarningKind.REPAIRED: "INFO",
        WarningKind.SKIPPED: "WARN",
        Severity.ERROR: "ERROR",
        Severity.WARNING: "WARN",
        Severity.HINT: "INFO",
    }
)


@dataclass(slots=True)
class Reported:
    """Gathers what could not be shown, counted by code and location."""

    lines: dict[tuple[str, str], tuple[str, int]] = field(default_factory=dict)

    def __call__(self, code: str, location: str, message: str) -> None:
        """Take one more."""
        first, count = self.lines.get((code, location), (message, 0))
        self.lines[code, location] = first, count + 1

    @property
    def warnings(self) -> tuple[DataWarning, ...]:
        """All of it."""
        return tuple(
            DataWarning(
                kind=WarningKind.REPAIRED if code == "straightened" else WarningKind.SKIPPED,
                code=code,
                location=location,
                message=message,
                count=count,
            )
            for (code, location), (message, count) in self.lines.items()
        )


def find_mistakes(scene: Scene) -> tuple[Finding, ...]:
    """What the rules of `validate` find that need no frames."""
    return validate(scene, frames=False).findings


def log_notes(
    stream: Stream, time_ns: int, warnings: Sequence[DataWarning], findings: Sequence[Finding]
) -> None:
    """Log them at a time, the worst first; warnings that a finding reports already are not repeated."""
    reported = {finding.message for finding in findings}
    order = {level: k for k, level in enumerate(("ERROR", "WARN", "INFO"))}
    lines = [
        (_LEVELS[one.severity], f"{one.path}: {one.message}; {one.remedy} [{one.rule}]") for one in findings
    ]
    lines += [
        (_LEVELS[one.kind], f"{one.kind}: {one.location}: {one.message}{_times(one.count)}")
        for one in warnings
        if one.message not in reported
    ]
    for level, text in sorted(lines, key=lambda line: order[line[0]]):
        stream.log(time_ns, stream.path(NOTES), sdk().TextLog(text, level=level), kind="notes")


def _times(count: int) -> str:
    return f" ({count} times)" if count > 1 else ""
