"""Writing that is refused where it would lose something, and leaves nothing behind then."""

from collections.abc import Callable, Iterable
from pathlib import Path

from sceneloom.errors import LossError
from sceneloom.formats.loss import LossReport
from sceneloom.formats.output import on_trial
from sceneloom.pipeline.converting.report import ConversionReport
from sceneloom.pipeline.converting.supports import FieldSupport, lost

_NAMED = 6
"""How many fields a message names."""

Judged = Callable[[LossReport], ConversionReport]
"""Makes the report of a conversion out of what the writing reported."""


def check_nothing_lost(report: ConversionReport) -> None:
    """Refuse a conversion that does not keep every field.

    Raises:
        LossError: naming the fields; it bears the report.
    """
    gone = lost(report.fields)
    if gone:
        raise LossError(report.target, _problem(gone, report.target_format), report)


def write_strictly(
    write: Callable[[Path], LossReport], target: Path, judged: Judged, *, overwrite: bool
) -> ConversionReport:
    """Write beside the target, and let it take the target's location if nothing was lost.

    Args:
        write: writes to a path.
        target: where the output shall be in the end.
        judged: makes the report.
        overwrite: whether something there may be replaced.

    Raises:
        LossError: something was lost; nothing is left behind.
        OutputError: the target exists, or cannot be written.
    """
    with on_trial(target, overwrite=overwrite) as (draft, accept):
        report = judged(write(draft))
        check_nothing_lost(report)
        if accept():
            return report
    return judged(write(target))


def _problem(gone: Iterable[FieldSupport], target_format: str) -> str:
    fields = list(gone)
    named = "; ".join(
        f"{field.field} ({field.support}{': ' + field.how[0] if field.how else ''})"
        for field in fields[:_NAMED]
    )
    further = f"; and {len(fields) - _NAMED} more" if len(fields) > _NAMED else ""
    return (
        f"is not written, since {target_format} would not hold all: {named}{further}; state what to leave out first "
        "(`sceneloom edit`), choose a format that holds it (`sceneloom formats NAME`), or convert without `--strict`"
    )
