"""Examinations as files: JSON for machines, Markdown and HTML for people."""

import json
from collections.abc import Callable, Iterable, Iterator, Mapping
from dataclasses import asdict
from html import escape
from pathlib import Path
from typing import Any

from sceneloom.errors import OptionError
from sceneloom.formats.output import replacing
from sceneloom.service.conformance.examination import Examination, Finding


def write_report(examination: Examination, path: Path, *, overwrite: bool = False) -> None:
    """Write a report in the form that the file's suffix says.

    Raises:
        OptionError: the suffix is none of .json, .md and .html.
        OutputError: the file exists already, or cannot be written.
    """
    text = form_of(path)(examination)
    with replacing(path, overwrite=overwrite) as draft:
        draft.write_text(text, "utf-8")


def form_of(path: Path) -> Callable[[Examination], str]:
    """How a report is written into a file of that name.

    Raises:
        OptionError: its suffix is none of .json, .md and .html.
    """
    form = FORMS.get(path.suffix.lower())
    if form is None:
        raise OptionError(f"report {path}; expected a name that ends with one of {', '.join(FORMS)}")
    return form


def as_builtins(examination: Examination) -> dict[str, Any]:
    """Give an examination as plain values."""
    return {
        "address": examination.address,
        "passed": examination.passed,
        "counts": examination.counts,
        "checks": [_plain(finding) for finding in examination.findings],
    }


def _plain(finding: Finding) -> dict[str, Any]:
    check = finding.check
    return {
        "id": check.id,
        "verdict": str(finding.verdict),
        "basis": str(check.basis),
        "location": check.location,
        "title": check.title,
        "english": check.quote.english,
        "chinese": check.quote.chinese,
        "seen": [asdict(seen) for seen in finding.seen],
    }


def as_json(examination: Examination) -> str:
    """Give an examination as JSON."""
    return json.dumps(as_builtins(examination), indent=2, ensure_ascii=False) + "\n"


def as_markdown(examination: Examination) -> str:
    """Give an examination as Markdown: a table of all checks, and what was found by those that failed."""
    return "\n".join(_markdown_lines(examination)) + "\n"


def _markdown_lines(examination: Examination) -> Iterator[str]:
    yield f"# DB34/T 4101-2022: conformance of {examination.address or 'a server'}"
    yield ""
    yield _summary(examination)
    yield ""
    yield "| check | verdict | basis | location | what has to be so |"
    yield "| --- | --- | --- | --- | --- |"
    for finding in examination.findings:
        check = finding.check
        cells = (check.id, str(finding.verdict), str(check.basis), check.location, check.title)
        yield _table_row(cells)
    for finding in examination.findings:
        if finding.failures:
            yield from _failed_in_markdown(finding)


def _failed_in_markdown(finding: Finding) -> Iterator[str]:
    check = finding.check
    yield ""
    yield f"## {check.id}: {check.title}"
    yield f"> {check.quote.english}"
    yield ">"
    yield f"> {check.quote.chinese}"
    yield ""
    yield "| sent | expected | found |"
    yield "| --- | --- | --- |"
    for seen in finding.failures:
        cells = (seen.sent, seen.expected, seen.found)
        yield _table_row(cells)


def _table_row(cells: Iterable[str]) -> str:
    """A row of a table, whatever a server wrote into its cells."""
    reported = (" ".join(escape(cell, quote=False).replace("|", "&#124;").split()) for cell in cells)
    return f"| {' | '.join(reported)} |"


def as_html(examination: Examination) -> str:
    """Give an examination as one page without anything from elsewhere: each check opens to what it saw."""
    rows = "\n".join(_html_of(finding) for finding in examination.findings)
    title = f"DB34/T 4101-2022: conformance of {escape(examination.address or 'a server')}"
    return (
        f'<!doctype html>\n<html lang="en">\n<meta charset="utf-8">\n<title>{title}</title>\n<style>{_STYLE}</style>\n'
        f"<h1>{title}</h1>\n<p>{escape(_summary(examination))}</p>\n{rows}\n</html>\n"
    )


_STYLE = (
    "body{font:15px/1.45 sans-serif;max-width:75em;margin:2em auto;padding:0 1em}"
    "summary{padding:.2em 0}.failed summary{color:#a00;font-weight:bold}.passed summary{color:#060}"
    "table{border-collapse:collapse;margin:.5em 0 1em 1.5em}td,th{border:1px solid #ccc;padding:.2em .5em;"
    "text-align:left;vertical-align:top}.no td{background:#fee}blockquote{margin:.3em 0 .3em 1.5em;color:#444}"
)


def _html_of(finding: Finding) -> str:
    check = finding.check
    rows = "".join(
        f"<tr{'' if seen.agrees else ' class=no'}>"
        + "".join(f"<td>{escape(cell)}</td>" for cell in (seen.sent, seen.expected, seen.found))
        + "</tr>"
        for seen in finding.seen
    )
    opened = " open" if finding.failures else ""
    return (
        f'<details class="{finding.verdict}"{opened}><summary>{check.id} {finding.verdict}: {escape(check.title)}'
        f"</summary><blockquote>{escape(check.location)} ({check.basis})<br>{escape(check.quote.english)}"
        f'<br><span lang="zh">{escape(check.quote.chinese)}</span></blockquote>'
        f"<table><tr><th>sent<th>expected<th>found</tr>{rows}</table></details>"
    )


def _summary(examination: Examination) -> str:
    reported = ", ".join(f"{count} {verdict}" for verdict, count in examination.counts.items())
    return f"{len(examination.findings)} checks: {reported}"


FORMS: Mapping[str, Callable[[Examination], str]] = {
    ".json": as_json,
    ".md": as_markdown,
    ".html": as_html,
}
"""By the suffix of the file."""
