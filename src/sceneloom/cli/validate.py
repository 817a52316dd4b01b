"""`sceneloom validate`."""

from itertools import groupby
from pathlib import Path
from typing import TYPE_CHECKING, Any

import click

from sceneloom.cli import options
from sceneloom.cli.printing import print_json, progress_bar, several

if TYPE_CHECKING:
    from collections.abc import Sequence

    from sceneloom.checks.validation import ValidationReport
    from sceneloom.formats.base.losses import Loss
    from sceneloom.warnings import Finding


@click.command()
@click.argument("path", type=options.location, required=False)
@click.option(
    "--profile",
    type=click.Choice(["sfs", "scale"]),
    help="`scale`: also what Scale's own library refuses. Default: sfs, of a recording its lines and files.",
)
@click.option("--strict", is_flag=True, help="Warnings count as errors do.")
@click.option("--quick", is_flag=True, help="Read no frames and images.")
@click.option(
    "--fix",
    type=options.target,
    metavar="OUT",
    help="Write the scene to OUT with all safe fixes applied.",
)
@click.option("--overwrite", is_flag=True, help="Replace OUT if it exists.")
@click.option("--rule", "rules", multiple=True, metavar="ID", help="Run this rule only; may be stated again.")
@click.option("--ignore", multiple=True, metavar="ID", help="Leave this rule out; may be stated again.")
@click.option("--rules", "list_rules", is_flag=True, help="List the rules and stop.")
@options.part
@options.reading
@options.printing
@click.pass_context
def validate(
    context: click.Context,
    /,
    path: Path | str | None,
    profile: str | None,
    strict: bool,
    quick: bool,
    fix: Path | None,
    overwrite: bool,
    rules: tuple[str, ...],
    ignore: tuple[str, ...],
    list_rules: bool,
    as_json: bool,
    quiet: bool,
    verbose: bool,
    **reading: Any,
) -> None:
    """Check a scene, recording or rig, and state what is wrong, where, and what to do; exit 1 where it does not pass.

    Every finding names the rule, its location in the file, the value and what was expected. `--fix OUT` writes what
    can be repaired safely, checks that, and reports what is left. Where it is open which image a line means, it says
    which way it took; `--image-index` takes another.
    """
    if list_rules:
        _print_rules(as_json=as_json)
        return
    if path is None:
        raise click.UsageError("Missing argument 'PATH'.", context)
    from sceneloom.checks.validation import LOCATIONS
    from sceneloom.checks.validation import validate as validate_scene
    from sceneloom.stages import timed

    with progress_bar("checking", quiet=quiet) as progress, timed() as stages:
        report = validate_scene(
            path,
            profile=profile,
            fix=fix,
            overwrite=overwrite,
            strict=strict,
            frames=not quick,
            rules=rules,
            ignore=ignore,
            locations=None if as_json or verbose else LOCATIONS,
            progress=progress,
            **options.stated(**reading),
        )
    if as_json:
        print_json(report, stages=stages)
    else:
        _print_report(report, asked_to_fix=fix is not None, quiet=quiet)
    if not report.passed or (fix is not None and report.output is None):
        context.exit(1)


def _print_rules(*, as_json: bool) -> None:
    from sceneloom.checks.validation import catalogue

    rows = catalogue()
    if as_json:
        print_json(rows)
        return
    for row in rows:
        marks = [row.severity, *(["fix"] if row.fixable else []), *row.only_in]
        click.echo(f"{row.id} ({', '.join(marks)})\n    {row.summary}\n    {row.remedy}")


def _print_report(report: "ValidationReport", *, asked_to_fix: bool, quiet: bool) -> None:
    found = ", ".join(several(count, severity) for severity, count in report.counts.items() if count)
    verdict = "passed" if report.passed else "not passed"
    read = "" if report.frames_read else "; frames were not read"
    # what was written is known by what it was checked against: a recording, or a scene file
    against = [report.format] if report.output is None else []
    against += ["recording" if report.profile == "recording" else f"profile {report.profile}"]
    reported = ", ".join(dict.fromkeys(against))
    click.echo(f"{report.output or report.source}: {reported}: {verdict}, {found or 'nothing found'}{read}")
    _print_findings([f for f in report.findings if not (quiet and f.severity == "hint")])
    if report.output is not None:
        _print_changes("fixed", report.fixed)
        _print_changes("left out", report.left_out)
        _print_losses(report.losses)
        click.echo(f"written: {report.output}")
    elif asked_to_fix:
        click.echo(f"nothing was written: {report.unwritten}", err=True)


def _print_findings(findings: "Sequence[Finding]") -> None:
    """Findings under their rules, the remedy once for each."""
    for severity, of_severity in groupby(findings, key=lambda finding: finding.severity):
        click.echo(f"{severity}s")
        for rule, group in groupby(of_severity, key=lambda finding: finding.rule):
            listed = list(group)
            fixable = ", --fix repairs it" if listed[0].fixable else ""
            click.echo(f"  {rule}: {several(sum(f.count for f in listed), 'time')}{fixable}")
            for finding in listed:
                click.echo(f"    {_line(finding)}")
            click.echo(f"    → {listed[0].remedy}")


def _print_changes(title: str, findings: "Sequence[Finding]") -> None:
    if findings:
        click.echo(title)
    for finding in findings:
        click.echo(f"  {finding.rule}: {_line(finding)}")


def _print_losses(losses: "Sequence[Loss]") -> None:
    for title, kept in (("lost", False), ("kept aside", True)):
        group = [loss for loss in losses if (loss.kept is not None) is kept]
        if group:
            click.echo(title)
        for loss in group:
            location = f"; it is in {loss.kept}" if kept else ""
            click.echo(f"  {loss.field}: {loss.what}{_times(loss.count)}{location}")


def _times(count: int) -> str:
    return f" ({count} times)" if count > 1 else ""


def _line(finding: "Finding") -> str:
    return ": ".join(filter(None, (finding.path, finding.message))) + _times(finding.count)
