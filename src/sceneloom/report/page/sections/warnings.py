"""What was assumed, repaired or left out on reading, and what was lost on writing."""

from sceneloom.formats.loss import Loss, Support
from sceneloom.report.numbers.drive import DriveReport
from sceneloom.report.page.content import Block, Column, Section, Table
from sceneloom.report.page.texts import NOTHING, count, warning_text

MOST_WARNINGS = 300
_COLUMNS = (
    Column("Field", numeric=False),
    Column("Support", numeric=False),
    Column("What happened", numeric=False, wide=True),
    Column("Times"),
    Column("Largest error"),
    Column("Kept in", numeric=False),
)

_SUPPORTS = (
    Column("Format", numeric=False),
    Column("Kept"),
    Column("Converted"),
    Column("Approximated"),
    Column("Dropped"),
)


def warnings_section(report: DriveReport) -> Section:
    """List warnings by kind, and losses field by field."""
    blocks = []
    for kind in ("assumed", "repaired", "skipped"):
        lines = [warning_text(warning) for warning in report.warnings if str(warning.kind) == kind]
        untold = [f"and {len(lines) - MOST_WARNINGS:,} more"] if len(lines) > MOST_WARNINGS else []
        few = len(lines) <= 3
        blocks.append(
            Block(
                heading=f"{kind.capitalize()}: {len(lines):,}" if lines else "",
                lines=lines if few else [],
                list_title=f"All {len(lines):,}",
                listed=[] if few else [*lines[:MOST_WARNINGS], *untold],
            )
        )
    if report.losses:
        rows = [_row(loss) for loss in report.losses]
        table = Table("What the drive lost when it was written", _COLUMNS, rows)
        blocks.append(Block(heading=f"Losses: {len(rows):,}", tables=[table]))
    blocks += _conversions(report)
    reported = (
        None if report.warnings or report.losses else "Nothing was assumed, repaired, left out or lost."
    )
    return Section(key="warnings", name="Warnings and losses", absent=reported, blocks=blocks)


def _conversions(report: DriveReport) -> list[Block]:
    """What other formats would make of the drive."""
    if not report.conversions:
        return []
    rows = [
        [
            each.format,
            *(
                count(each.supports.get(support, 0))
                for support in ("kept", "converted", "approximated", "dropped")
            ),
        ]
        for each in report.conversions
    ]
    dropped = [f"{each.format}: {', '.join(each.dropped)}" for each in report.conversions if each.dropped]
    total = sum(report.conversions[0].supports.values())
    title = f"What formats would make of the {total} kinds of fields that the drive holds"
    table = Table(title, _SUPPORTS, rows, folded=True)
    reported = "`sceneloom convert DRIVE OUT --loss F` reports a conversion what became of every value."
    return [
        Block(heading="In other formats", tables=[table], list_title="What would be dropped", listed=dropped),
        Block(lines=[reported], faint=True),
    ]


def _row(loss: Loss) -> list[str]:
    error = NOTHING if loss.largest_error is None else f"{loss.largest_error:.4g}"
    support = "kept aside" if loss.kept and loss.support is Support.DROPPED else str(loss.support)
    return [loss.field, support, loss.what, count(loss.count), error, loss.kept or NOTHING]
