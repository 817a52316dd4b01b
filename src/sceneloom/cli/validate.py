"""`sceneloom validate` and `sceneloom salvage`."""

from collections.abc import Sequence
from itertools import groupby
from pathlib import Path
from typing import TYPE_CHECKING, Any

import click

from sceneloom.cli import options
from sceneloom.cli.help import Verb
from sceneloom.cli.options import option
from sceneloom.cli.printing import Printer, amount, marked, print_json, print_table, several, times, wrote
from sceneloom.cli.running import reading_verb, verb

if TYPE_CHECKING:
    from sceneloom.checks.validation import ValidationReport
    from sceneloom.formats.sfs.salvage import SalvageReport
    from sceneloom.warnings import Finding


@click.command(cls=Verb, examples=("drive.sfs", "drive/ --fix repaired/"))
@click.argument("path", type=options.location, required=False)
@option(
    "--profile=sfs|scale",
    "`scale`: also what Scale's own library refuses. Default: sfs, of a recording its lines and files.",
)
@option("--strict", "Treat warnings as errors.")
@option("--quick", "Do not read frames and images.")
@option("--fix=OUT", "Write the scene to OUT with all safe fixes applied.", options.target)
@options.overwrite
@option("--rule=ID… rules", "Run this rule only; may be repeated.")
@option("--ignore=ID…", "Do not run this rule; may be repeated.")
@option("--rules list_rules", "List the rules and stop.")
@options.part
@reading_verb
def validate(
    path: Path | str | None,
    quick: bool,
    list_rules: bool,
    printer: Printer,
    reading: dict[str, Any],
    start: float | None,
    stop: float | None,
    **given: Any,
) -> None:
    """Check a scene, recording or rig, and list what is wrong, where, and what to do; exit 1 where it does not pass.

    Every finding names the rule, its location in the file, the value and what was expected. `--fix OUT` writes what
    can be repaired safely, checks that, and reports what is left. Where it is ambiguous which image a line means, the
    choice is reported; `--image-index` makes another.
    """
    from sceneloom.checks.validation import LOCATIONS, catalogue
    from sceneloom.checks.validation import validate as validate_scene
    from sceneloom.stages import timed

    if list_rules:
        if printer.as_json:
            print_json(catalogue())
            return
        for rule in catalogue():
            marks = [rule.severity, *(["fix"] if rule.fixable else []), *rule.only_in]
            click.echo(f"{rule.id} ({', '.join(marks)})\n    {rule.summary}\n    {rule.remedy}")
        return
    if path is None:
        raise click.UsageError("Missing argument 'PATH'.", click.get_current_context())
    fix = given["fix"]
    with printer.progress("checking") as progress, timed() as stages:
        report = validate_scene(
            path,
            frames=not quick,
            locations=None if printer.as_json or printer.verbose else LOCATIONS,
            progress=progress,
            **given,
            **reading,
            **options.stated(start=start, stop=stop),
        )
    printer.show(report, _print_validation, fix is not None, stages=stages)
    if not report.passed or (fix is not None and report.output is None):
        click.get_current_context().exit(1)


def _print_validation(report: "ValidationReport", asked_to_fix: bool, printer: Printer) -> None:
    found = ", ".join(several(count, severity) for severity, count in report.counts.items() if count)
    verdict = marked("passed" if report.passed else "not passed")
    read = "" if report.frames_read else "; frames were not read"
    # what was written is known by what it was checked against: a recording, or a scene file
    against = [report.format] if report.output is None else []
    against += ["recording" if report.profile == "recording" else f"profile {report.profile}"]
    reported = ", ".join(dict.fromkeys(against))
    click.echo(f"{report.output or report.source}: {reported}: {verdict}, {found or 'nothing found'}{read}")
    _print_findings([f for f in report.findings if not (printer.quiet and f.severity == "hint")])
    if report.output is not None:
        losses = [(loss.kept, f"  {loss.field}: {loss.what}{times(loss.count)}") for loss in report.losses]
        changes = {
            "fixed": [f"  {finding.rule}: {_line(finding)}" for finding in report.fixed],
            "left out": [f"  {finding.rule}: {_line(finding)}" for finding in report.left_out],
            "lost": [line for kept, line in losses if kept is None],
            "kept aside": [f"{line}; it is in {kept}" for kept, line in losses if kept is not None],
        }
        for title, lines in changes.items():
            for line in [title, *lines] if lines else ():
                click.echo(line)
        wrote(report.output)
    elif asked_to_fix:
        click.echo(f"nothing was written: {report.unwritten}", err=True)


def _print_findings(findings: "Sequence[Finding]") -> None:
    """Print findings under their rules, the remedy once for each."""
    for severity, of_severity in groupby(findings, key=lambda finding: finding.severity):
        click.echo(f"{severity}s")
        for rule, group in groupby(of_severity, key=lambda finding: finding.rule):
            listed = list(group)
            fixable = ", --fix repairs it" if listed[0].fixable else ""
            click.echo(f"  {rule}: {several(sum(f.count for f in listed), 'time')}{fixable}")
            for finding in listed:
                click.echo(f"    {_line(finding)}")
            click.echo(f"    → {listed[0].remedy}")


def _line(finding: "Finding") -> str:
    return ": ".join(filter(None, (finding.path, finding.message))) + times(finding.count)


@click.command(cls=Verb, examples=("cut-off.sfs -o whole.sfs", "cut-off.sfs -o whole.sfs --json"))
@click.argument("path", type=options.location)
@options.output("The .sfs file to write.")
@options.overwrite
@verb
def salvage(path: Path | str, output: Path, overwrite: bool, printer: Printer) -> None:
    """Extract what is whole from a scene file that was truncated or damaged, and list what is not."""
    from sceneloom.formats.sfs.salvage import salvage as salvage_file

    printer.show(salvage_file(path, output, overwrite=overwrite), _print_salvaged)


def _print_salvaged(report: "SalvageReport", printer: Printer) -> None:
    click.echo(f"{report.source}, {amount(report.size_bytes)} → {report.output}")
    print_table(
        (str(sensor.id), sensor.type, f"{sensor.kept} of {sensor.count}" if sensor.count else "")
        for sensor in report.sensors
    )
    click.echo(several(report.annotations, "annotation"))
    if not report.lost:
        click.echo("nothing is lost")
        return
    click.echo(f"lost: {several(len(report.lost), 'part')}, {amount(report.lost_bytes)}")
    printer.notes([f"lost: {part.location}: {part.problem} ({amount(part.bytes)})" for part in report.lost])
