"""What the report was made of and by."""

from sceneloom.report.numbers.drive import DriveReport
from sceneloom.report.page.content import Block, Column, Section, Table
from sceneloom.report.page.texts import megabytes

_HASHED = {
    "file": "SHA-256 of the file, as `sha256sum` gives it",
    "folder": "SHA-256 of the names and contents of all files, in order of the names",
    "ends": "SHA-256 of the names, sizes, first and last megabytes of all files: it is too large to read it all",
}
_COLUMNS = (Column("What", numeric=False), Column("Value", numeric=False, wide=True))


def source_section(report: DriveReport) -> Section:
    """Report which data, versions and settings the report stands on."""
    made = report.provenance
    rows = [
        ["Source", report.summary.source],
        ["Format", report.summary.format],
        ["Made", made.made],
        ["sceneloom", made.sceneloom],
        ["Python", f"{made.python} on {made.system}"],
        ["Packages", ", ".join(f"{name} {version}" for name, version in made.packages.items())],
        [
            "Settings",
            ", ".join(f"{name} = {value}" for name, value in made.settings.items()) or "the usual ones",
        ],
    ]
    if made.size_bytes is not None:
        rows.append(["Size", megabytes(made.size_bytes)])
    if made.sha256 is not None:
        rows.append([_HASHED.get(made.hashed or "", "SHA-256"), made.sha256])
    reported = [[name, text] for name, text in made.reported.items()]
    tables = [
        Table("Where this report comes from", _COLUMNS, rows),
        Table(
            f"What the drive reports itself: {len(reported)} entries of its metadata",
            _COLUMNS,
            reported,
            folded=True,
        ),
    ]
    return Section(key="source", name="Provenance", blocks=[Block(tables=tables)])
