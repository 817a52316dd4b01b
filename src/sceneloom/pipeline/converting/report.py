"""What a conversion says of itself, as JSON for programs and as tables for people."""

from collections.abc import Iterable
from pathlib import Path

import msgspec

from sceneloom.errors import OptionError
from sceneloom.formats.loss import LossReport, Support
from sceneloom.formats.output import replacing
from sceneloom.pipeline.converting.supports import FieldSupport, lost
from sceneloom.redaction import without_folders
from sceneloom.scene.warnings import DataWarning


class ConversionReport(msgspec.Struct, frozen=True, kw_only=True):
    """One conversion.

    Attributes:
        source, source_format: what was read, and as what.
        target, target_format: what was written, and as what.
        warnings: what was assumed, repaired or left out on reading.
        losses: what the writing reported this scene, location by location.
        fields: every field that the source holds, and what became of it.
        written: whether the target is there; false where losing something was refused.
    """

    source: str
    source_format: str
    target: str
    target_format: str
    warnings: tuple[DataWarning, ...]
    losses: LossReport
    fields: tuple[FieldSupport, ...] = ()
    written: bool = True

    def of_support(self, support: Support) -> tuple[FieldSupport, ...]:
        """The fields that this became of."""
        return tuple(field for field in self.fields if field.support == support)

    @property
    def lost(self) -> tuple[FieldSupport, ...]:
        """The fields that are not wholly in the target."""
        return lost(self.fields)


REPORT_SUFFIXES = (".json", ".md", ".txt")


def check_report_name(path: Path) -> None:
    """Refuse a name for a report that does not state how to write it.

    Raises:
        OptionError: its suffix is none of those of reports.
    """
    if path.suffix.lower() not in REPORT_SUFFIXES:
        raise OptionError(
            f"{path}: suffix {path.suffix!r}; a loss report is written as {', '.join(REPORT_SUFFIXES)}"
        )


def write_report(report: ConversionReport, path: Path, *, overwrite: bool = False) -> None:
    """Write what became of every field: as JSON, as Markdown or as text, as the suffix says.

    Raises:
        OptionError: the suffix is none of those of reports.
        OutputError: the file exists, or cannot be written.
    """
    check_report_name(path)
    both = f"{report.source} + {report.target}"
    with replacing(path, overwrite=overwrite) as draft:
        if path.suffix.lower() == ".json":
            text = msgspec.json.format(msgspec.json.encode(report), indent=2).decode()
            draft.write_text(without_folders(text, both) + "\n", encoding="utf-8", newline="\n")
        else:
            lines = _markdown(report) if path.suffix.lower() == ".md" else _text(report)
            text = without_folders("\n".join([*lines, ""]), both)
            draft.write_text(text, encoding="utf-8", newline="\n")


def headline(report: ConversionReport) -> str:
    """From where to where, on one line."""
    not_written = "" if report.written else " (not written)"
    return f"{report.source} ({report.source_format}) → {report.target} ({report.target_format}){not_written}"


def support_rows(fields: Iterable[FieldSupport]) -> list[tuple[str, str, str]]:
    """One row for each field: its name, how many objects or frames hold it, and what happened to it."""
    return [(field.field, str(field.count), explained(field)) for field in fields]


def short_rows(fields: Iterable[FieldSupport]) -> list[tuple[str, str, str]]:
    """As `support_rows`, with one row for all fields of a kind to which the same happened, by what their names share.

    Rows that name an option as a remedy come first: the others may not be shown.
    """
    together: dict[tuple[str, str], list[FieldSupport]] = {}
    for field in fields:
        kind = ".".join(field.field.split(".")[:2])
        together.setdefault((kind, explained(field)), []).append(field)
    return sorted(
        (
            support_rows(same)[0]
            if len(same) == 1
            else (f"{_beginning(same)}.*", f"{len(same)} fields", reported)
            for (_, reported), same in together.items()
        ),
        key=lambda row: "`--" not in row[2],
    )


def _beginning(fields: Iterable[FieldSupport]) -> str:
    """What the names have in common, up to a dot."""
    names = [field.field.split(".") for field in fields]
    shared = [parts[0] for parts in zip(*names, strict=False) if len(set(parts)) == 1]
    return ".".join(shared)


def explained(field: FieldSupport) -> str:
    """What happened to a field, and by how much its worst value is off."""
    reported = "; ".join(field.how)
    worst = "" if field.largest_error is None else f"largest error {field.largest_error:.3g}"
    return "; ".join(filter(None, (reported, worst)))


def support_groups(report: ConversionReport) -> list[tuple[str, tuple[FieldSupport, ...], bool]]:
    """The fields by what became of them, the worst first: a title, them, and whether there is more to state of them."""
    kept = report.of_support(Support.KEPT)
    groups = [
        (str(support), report.of_support(support), True)
        for support in reversed(Support)
        if support != Support.KEPT
    ]
    groups += [
        ("kept aside, where other programs do not look", tuple(field for field in kept if field.how), True),
        ("kept", tuple(field for field in kept if not field.how), False),
    ]
    return [group for group in groups if group[1]]


def _text(report: ConversionReport) -> list[str]:
    lines = [headline(report)]
    for title, fields, _ in support_groups(report):
        lines += ["", f"{title} ({len(fields)})"]
        lines += [
            f"  {name} [{count}]" + (f": {how}" if how else "") for name, count, how in support_rows(fields)
        ]
    return lines


def _markdown(report: ConversionReport) -> list[str]:
    lines = [f"# {headline(report)}"]
    for title, fields, _ in support_groups(report):
        lines += [
            "",
            f"## {title[0].upper()}{title[1:]}",
            "| field | held by | how |",
            "| --- | ---: | --- |",
        ]
        lines += [f"| `{name}` | {count} | {_cell(how)} |" for name, count, how in support_rows(fields)]
    return lines


def _cell(text: str) -> str:
    return text.replace("|", "\\|").replace("\n", " ")
