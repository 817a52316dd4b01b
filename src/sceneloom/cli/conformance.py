"""`sceneloom conformance`."""

from itertools import groupby
from pathlib import Path
from typing import TYPE_CHECKING

import click

from sceneloom.cli import options
from sceneloom.cli.printing import Printer, print_json
from sceneloom.cli.running import verb
from sceneloom.cli.service import access, certificate_of, host_and_port

if TYPE_CHECKING:
    from sceneloom.db34t.conformance.catalogue import Check
    from sceneloom.db34t.conformance.examination import Examination, Finding


@click.command()
@click.argument("address", type=host_and_port, metavar="HOST:PORT", required=False)
@click.option(
    "--report",
    type=options.target,
    metavar="FILE",
    help="Write all that was sent, expected and found to a .json, .md or .html file.",
)
@options.overwrite
@click.option(
    "--only",
    multiple=True,
    metavar="ID",
    help="Run this check (5.4-3), or those of a clause or table (5.4, T9); may be repeated.",
)
@click.option("--checks", "list_checks", is_flag=True, help="List the checks and stop.")
@access
@verb
def conformance(
    address: str | None,
    report: Path | None,
    overwrite: bool,
    only: tuple[str, ...],
    list_checks: bool,
    ca: Path | None,
    token_file: Path | None,
    client_cert: Path | None,
    client_key: Path | None,
    printer: Printer,
) -> None:
    """Check a fusion service against DB34/T 4101-2022, clause by clause and row by row; exit 1 where a check fails.

    Any server of the project's .proto can be checked, whoever wrote it. Each check works in a session of its own,
    which is ended after it.
    """
    from sceneloom.db34t.conformance.examination import check_report, chosen, examine
    from sceneloom.db34t.transport import Access, GrpcTransport
    from sceneloom.formats.base.output import check_output

    checks = chosen(only)
    if list_checks:
        _print_checks(checks, printer)
        return
    if address is None:
        raise click.UsageError("Missing argument 'HOST:PORT'.", click.get_current_context())
    certificate = certificate_of(client_cert, client_key)
    if report is not None:
        check_report(report)
        check_output(report, overwrite=overwrite)
    with (
        GrpcTransport.connected(address, Access(ca, token_file, certificate)) as transport,
        printer.progress("checking") as progress,
    ):
        examination = examine(transport, address=address, only=only, progress=progress)
    if report is not None:
        examination.write(report, overwrite=overwrite)
    if printer.as_json:
        print_json(examination.as_builtins())
    else:
        _print_examination(examination, verbose=printer.verbose, report=report)
    if not examination.passed:
        click.get_current_context().exit(1)


def _print_checks(checks: "tuple[Check, ...]", printer: Printer) -> None:
    rows = [
        {
            "id": check.id,
            "location": check.location,
            "title": check.title,
            "basis": str(check.basis),
            "english": check.quote.english,
            "chinese": check.quote.chinese,
        }
        for check in checks
    ]
    if printer.as_json:
        print_json(rows)
        return
    for row in rows:
        click.echo(f"{row['id']:8} {row['title']} ({row['basis']}: {row['location']})")


def _print_examination(examination: "Examination", *, verbose: bool, report: Path | None) -> None:
    shown = [finding for finding in examination.findings if verbose or finding.failures]
    for part, findings in groupby(shown, key=lambda finding: finding.check.id.split("-")[0]):
        click.echo(part)
        for finding in findings:
            _print_finding(finding)
    counts = ", ".join(f"{count} {verdict}" for verdict, count in examination.counts.items())
    click.echo(f"{examination.address}: {len(examination.findings)} checks: {counts}")
    if report is not None:
        click.echo(f"written: {report}")


def _print_finding(finding: "Finding") -> None:
    check = finding.check
    click.echo(f"  {check.id:7} {finding.verdict}  {check.title} ({check.location})")
    if not finding.failures:
        return
    click.echo(f"          {check.quote.english}")
    click.echo(f"          {check.quote.chinese}")
    for seen in finding.failures:
        click.echo(f"          sent {seen.sent}: expected {seen.expected}, found {seen.found}")
