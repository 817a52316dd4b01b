"""The page about a run: one file that asks for nothing from outside, readable in the light and in the dark."""

from collections.abc import Iterable
from datetime import UTC, datetime
from html import escape
from pathlib import Path

from sceneloom.batch.watching.figures import RunFigures, Span
from sceneloom.formats.output import replacing

_STYLE = """
:root { color-scheme: light dark; --ink: #1b1e24; --paper: #fff; --faint: #555c68; --rule: #d4d8de; --done: #2f6fb3;
  --failed: #a8201a; }
@media (prefers-color-scheme: dark) { :root { --ink: #e8eaed; --paper: #14161a; --faint: #a9b0bb; --rule: #363b44;
  --done: #6aa5e8; --failed: #ff9d94; } }
body { margin: 0 auto; max-width: 64rem; padding: 1rem; background: var(--paper); color: var(--ink);
  font: 16px/1.5 system-ui, sans-serif; overflow-wrap: anywhere; }
table { border-collapse: collapse; width: 100%; } caption { text-align: left; color: var(--faint); }
th, td { text-align: left; padding: .25rem .75rem .25rem 0; border-bottom: 1px solid var(--rule); vertical-align: top; }
.number { text-align: right; font-variant-numeric: tabular-nums; white-space: nowrap; }
svg { width: 100%; height: auto; } svg text { fill: var(--faint); font-size: 11px; }
.done { fill: var(--done); } .failed { fill: var(--failed); } .faint { color: var(--faint); }
"""
_WIDTH, _HEIGHT, _MARGIN = 720.0, 180.0, 40.0


def write_page(figures: RunFigures, target: Path, *, overwrite: bool = False) -> None:
    """Write the page.

    Args:
        figures: of the run.
        target: the file.
        overwrite: whether it may be replaced.

    Raises:
        OutputError: it exists, or cannot be written.
    """
    with replacing(target, overwrite=overwrite) as draft:
        draft.write_text(format_page(figures), encoding="utf-8")


def format_page(figures: RunFigures) -> str:
    """Put figures into a page of HTML."""
    title = escape(f"{figures.verb} over {figures.total} drives")
    head = (
        f'<!doctype html>\n<html lang="en">\n<head>\n<meta charset="utf-8">\n<title>{title}</title>\n'
        '<meta name="viewport" content="width=device-width, initial-scale=1">\n'
        f"<style>{_STYLE}</style>\n</head>\n<body>\n<h1>{title}</h1>"
    )
    parts = [
        head,
        _summary(figures),
        f"<h2>Throughput</h2>\n{_bars(figures.spans)}" if figures.spans else "",
        _table("Why drives failed", ("drives", "cause", "the first of them"), _causes(figures)),
        _table("Where the time went", ("seconds", "stage"), _stages(figures)),
        _table(
            "Slowest drives",
            ("seconds", "drive"),
            ((f"{taken:.1f}", name) for name, taken in figures.slowest),
        ),
        _table(
            "Workers",
            ("drives", "seconds", "of its processor", "most memory [MB]", "worker"),
            _workers(figures),
        ),
        "</body>\n</html>\n",
    ]
    return "\n".join(part for part in parts if part)


def _summary(figures: RunFigures) -> str:
    counts = ", ".join(f"{count} {state}" for state, count in figures.states.items() if count)
    more = figures.tries - sum(figures.states.get(state, 0) for state in ("done", "failed", "running"))
    facts = [f"{counts}; {more} further {'try' if more == 1 else 'tries'}" if more > 0 else counts]
    if figures.begun_ns is not None and figures.seconds > 0:
        begun = datetime.fromtimestamp(figures.begun_ns // 10**9, UTC)
        rate = 60.0 * len(figures.drive_seconds) / figures.seconds
        middle = figures.drive_seconds[len(figures.drive_seconds) // 2]
        facts.append(
            f"begun {begun:%Y-%m-%d %H:%M:%S} UTC; {figures.seconds:.0f} s; {rate:.1f} drives a minute"
        )
        facts.append(f"a drive: {middle:.1f} s in the middle, {figures.drive_seconds[-1]:.1f} s at most")
    facts.append(f"{figures.folder}, by sceneloom {figures.version}")
    return "\n".join(f"<p>{escape(fact)}</p>" for fact in facts)


def _bars(spans: tuple[Span, ...]) -> str:
    """Draw how many drives ended in each span, those that failed on top."""
    most = max(1, *(span.done + span.failed for span in spans))
    wide = (_WIDTH - _MARGIN) / len(spans)
    drawn = []
    for k, span in enumerate(spans):
        done, failed = (count * _HEIGHT / most for count in (span.done, span.failed))
        left = _MARGIN + k * wide
        told = f"{span.start:.0f} to {span.stop:.0f} s: {span.done} done, {span.failed} failed"
        drawn.append(f"<g><title>{told}</title>{_bar(left, _HEIGHT - done, wide, done, 'done')}")
        drawn.append(f"{_bar(left, _HEIGHT - done - failed, wide, failed, 'failed')}</g>")
    width = spans[0].stop - spans[0].start
    marks = [
        f'<text x="0" y="12">{most}</text>', f'<text x="0" y="{_HEIGHT:.0f}">0</text>',
        f'<text x="{_MARGIN:.0f}" y="{_HEIGHT + 16:.0f}">0 s</text>',
        f'<text x="{_WIDTH:.0f}" y="{_HEIGHT + 16:.0f}" text-anchor="end">{spans[-1].stop:.0f} s</text>',
    ]  # fmt: skip
    label = f"Drives that ended in each span of {width:.1f} s; those that failed are on top"
    return (
        f'<svg viewBox="0 0 {_WIDTH:.0f} {_HEIGHT + 20:.0f}" role="img" aria-label="{label}">'
        f'{"".join(drawn + marks)}</svg>\n<p class="faint">{label}.</p>'
    )


def _bar(left: float, top: float, wide: float, high: float, kind: str) -> str:
    if not high:
        return ""
    return f'<rect class="{kind}" x="{left:.1f}" y="{top:.1f}" width="{max(wide - 1, 0.5):.1f}" height="{high:.1f}"/>'


def _causes(figures: RunFigures) -> Iterable[tuple[str, str, str]]:
    return (
        (str(len(cause.drives)), f"{cause.kind}: {cause.error}", cause.drives[0]) for cause in figures.causes
    )


def _stages(figures: RunFigures) -> Iterable[tuple[str, str]]:
    longest_first = sorted(figures.stages.items(), key=lambda stage: -stage[1])
    return ((f"{seconds:.1f}", name) for name, seconds in longest_first)


def _workers(figures: RunFigures) -> Iterable[tuple[str, ...]]:
    return (
        (
            str(one.drives),
            f"{one.seconds:.1f}",
            f"{one.processor_seconds:.1f}",
            f"{one.peak_bytes / 1e6:.0f}",
            one.name,
        )
        for one in figures.workers
    )


def _table(title: str, heads: tuple[str, ...], rows: Iterable[tuple[str, ...]]) -> str:
    """Make a table; nothing where it has no rows."""
    cells = [
        "<tr>" + "".join(f"<td{_class(value)}>{escape(value)}</td>" for value in row) + "</tr>"
        for row in rows
    ]
    if not cells:
        return ""
    top = "".join(f'<th scope="col">{escape(head)}</th>' for head in heads)
    return f"<h2>{escape(title)}</h2>\n<table>\n<tr>{top}</tr>\n" + "\n".join(cells) + "\n</table>"


def _class(value: str) -> str:
    return ' class="number"' if value.replace(".", "", 1).isdigit() else ""
