"""What was assumed, left out or found to be wrong, as lines of the viewer's log."""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from types import MappingProxyType

from sceneloom.checks.validation import validate
from sceneloom.scene.findings import Finding, Severity
from sceneloom.scene.notices import Notice, NoticeKind
from sceneloom.scene.scene import Scene
from sceneloom.view.sdk import sdk
from sceneloom.view.stream import Stream

REMARKS = "remarks"

_LEVELS: Mapping[str, str] = MappingProxyType(
    {
        NoticeKind.ASSUMED: "INFO",
        NoticeKind.REPAIRED: "INFO",
        NoticeKind.SKIPPED: "WARN",
        Severity.ERROR: "ERROR",
        Severity.WARNING: "WARN",
        Severity.HINT: "INFO",
    }
)


@dataclass(slots=True)
class Told:
    """Gathers what could not be shown, counted by code and place."""

    lines: dict[tuple[str, str], tuple[str, int]] = field(default_factory=dict)

    def __call__(self, code: str, place: str, message: str) -> None:
        """Take one more."""
        first, count = self.lines.get((code, place), (message, 0))
        self.lines[code, place] = first, count + 1

    @property
    def notices(self) -> tuple[Notice, ...]:
        """All of it."""
        return tuple(
            Notice(
                kind=NoticeKind.REPAIRED if code == "straightened" else NoticeKind.SKIPPED,
                code=code,
                place=place,
                message=message,
                count=count,
            )
            for (code, place), (message, count) in self.lines.items()
        )


def find_mistakes(scene: Scene) -> tuple[Finding, ...]:
    """What the rules of `validate` find that need no frames."""
    return validate(scene, frames=False).findings


def log_remarks(stream: Stream, time_ns: int, notices: Sequence[Notice], findings: Sequence[Finding]) -> None:
    """Log them at a time, the worst first; notices that a finding tells already are not repeated."""
    told = {finding.message for finding in findings}
    order = {level: k for k, level in enumerate(("ERROR", "WARN", "INFO"))}
    lines = [
        (_LEVELS[one.severity], f"{one.path}: {one.message}; {one.remedy} [{one.rule}]") for one in findings
    ]
    lines += [
        (_LEVELS[one.kind], f"{one.kind}: {one.place}: {one.message}{_times(one.count)}")
        for one in notices
        if one.message not in told
    ]
    for level, text in sorted(lines, key=lambda line: order[line[0]]):
        stream.log(time_ns, stream.path(REMARKS), sdk().TextLog(text, level=level), kind="remarks")


def _times(count: int) -> str:
    return f" ({count} times)" if count > 1 else ""
