"""`sceneloom doctor`: what this installation can do, and what it lacks."""

from itertools import groupby
from typing import TYPE_CHECKING

import click

from sceneloom.cli import options
from sceneloom.cli.printing import print_json, print_table

if TYPE_CHECKING:
    from sceneloom.pipeline.installation import Finding

_MARKS = {"good": "ok", "missing": "--", "broken": "BROKEN"}


@click.command()
@options.printing
def doctor(as_json: bool, quiet: bool, verbose: bool) -> int:
    """Report what this installation can do and what it lacks; exit 1 if something needed is broken."""
    from sceneloom.pipeline.installation import examine_installation

    report = examine_installation()
    if as_json:
        print_json({"sound": report.is_sound, "findings": report.findings})
        return int(not report.is_sound)
    for group, findings in groupby(report.findings, key=lambda finding: finding.group):
        rows = [_row(one) for one in findings if not quiet or one.status != "good"]
        if rows:
            click.echo(group)
            print_table(rows)
    del verbose
    if not report.is_sound:
        click.echo("sceneloom: something that is needed is broken; what to do stands beside it", err=True)
    return int(not report.is_sound)


def _row(finding: "Finding") -> tuple[str, str, str]:
    stated = finding.stated if finding.remedy is None else f"{finding.stated}: {finding.remedy}"
    return _MARKS[finding.status], finding.name, stated
